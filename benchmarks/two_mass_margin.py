"""Robust stability margin of C = 100 ((s + 1)/(0.001 s + 1))^3 on two masses and a spring, exact.

    python -m benchmarks.two_mass_margin

P = k/(m1 s^2 (m2 s^2 + (1 + m2/m1) k)), unity feedback; m1, m2, k = 1 +- 20 %. The margin is the factor t by
which all three intervals may be widened together, m1, m2, k in [1 - 0.2 t, 1 + 0.2 t], before some plant in
the box has a closed-loop pole on the imaginary axis. Published: bounds [2.8826, 2.8864] at 575.03 rad/s.

Exact solution. On s = j omega the closed loop has a pole where

    m1 m2 omega^4 - (m1 + m2) k omega^2 + k C(j omega) = 0,

and everything but C is real: C(j omega) must be real, which fixes the frequencies without the parameters.
With three equal lead terms Im C = 0 means a phase of 60 degrees each (0 and 90 only at the ends), tan: 0.001
sqrt(3) omega^2 - 0.999 omega + sqrt(3) = 0. At such a frequency C = -c, c > 0, and the condition is

    f = k ((m1 + m2) omega^2 + c) - m1 m2 omega^4 = 0,

affine in each parameter alone, so its extremes over a box lie at corners: the smallest box that holds a zero
of f has it at a corner (m1, m2, k) = (1 +- x, 1 +- x, 1 +- x), a root of a cubic in x. Nothing else can
happen before: the degree drops only at m1 m2 = 0 and a pole passes s = 0 only at k = 0, both at t = 5.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from benchmarks.harness import Print, main

GAIN, ZERO, POLE, EXPONENT = 100.0, 1.0, 1000.0, 3
SPREAD = 0.2
PUBLISHED = (2.8826, 2.8864, 575.03)


@dataclass(frozen=True)
class Margin:
    """scaling of the box, frequency of the pole on the axis, and the plant (m1, m2, k) that has it."""

    scaling: float
    omega_rad_s: float
    plant: tuple[float, float, float]


def real_axis_frequencies() -> list[float]:
    """omega > 0 with C(j omega) real: phase of one lead term a multiple of 180 / EXPONENT degrees."""
    found: list[float] = []
    for multiple in range(1, EXPONENT):
        tangent = np.tan(np.pi * multiple / EXPONENT)
        # (omega/z - omega/p)/(1 + omega^2/(z p)) = tan; the lead's phase stays below 90 degrees
        if tangent > 0:
            roots = np.roots([tangent / (ZERO * POLE), -(1 / ZERO - 1 / POLE), tangent])
            found += [float(r.real) for r in roots if abs(r.imag) < 1e-12 and r.real > 0]
    return sorted(found)


def controller(s: complex) -> complex:
    """C(s)."""
    return complex(GAIN * ((s / ZERO + 1) / (s / POLE + 1)) ** EXPONENT)


def corner_scalings(omega_rad_s: float, signs: tuple[int, int, int]) -> list[float]:
    """x > 0 at which the corner (1 + signs x) has a pole at j omega: positive roots of a cubic in x."""
    c = float(controller(1j * omega_rad_s).real)
    m1, m2, k = (np.poly1d([sign, 1.0]) for sign in signs)
    f = m1 * m2 * omega_rad_s**4 - (m1 + m2) * k * omega_rad_s**2 + k * c
    return [float(x.real) for x in f.roots if abs(x.imag) < 1e-9 * (1 + abs(x)) and x.real > 0]


def margin() -> Margin:
    """The exact margin: f is affine in each parameter, so over the box it first vanishes at a corner."""
    best = Margin(1.0 / SPREAD, 0.0, (0.0, 0.0, 0.0))
    for omega in real_axis_frequencies():
        for s1, s2, s3 in itertools.product((-1, 1), repeat=3):
            for x in corner_scalings(omega, (s1, s2, s3)):
                if x / SPREAD < best.scaling:
                    best = Margin(x / SPREAD, omega, (1 + s1 * x, 1 + s2 * x, 1 + s3 * x))
    return best


def closed_loop_poles(m1: float, m2: float, k: float) -> np.ndarray:
    """Roots of the closed-loop polynomial (an independent check: no frequency, no box)."""
    numerator, denominator = np.poly1d([1.0]), np.poly1d([1.0])
    for _ in range(EXPONENT):
        numerator, denominator = numerator * np.poly1d([1 / ZERO, 1]), denominator * np.poly1d([1 / POLE, 1])
    plant = np.poly1d([m1 * m2, 0, (m1 + m2) * k, 0, 0])
    return np.asarray((plant * denominator + GAIN * k * numerator).roots)


def largest_real_part(scaling: float, per_side: int) -> float:
    """Largest real part of a closed-loop pole over a grid on the scaled box, corners included."""
    side = 1 + SPREAD * scaling * np.linspace(-1, 1, per_side)
    return float(max(np.max(closed_loop_poles(*plant).real) for plant in itertools.product(side, side, side)))


def run(out: Print) -> None:
    found = margin()
    low, high, omega = PUBLISHED
    out(f"exact margin       {found.scaling:.6f} at {found.omega_rad_s:.4f} rad/s")
    out("worst plant        m1 = {:.6f}, m2 = {:.6f}, k = {:.6f}".format(*found.plant))
    out(f"published bounds   [{low}, {high}] at {omega} rad/s")
    out("check by the roots of the closed-loop polynomial, 9^3 plants of the box, largest real part:")
    for share in (0.99, 0.999, 1.0, 1.001):
        out(f"  {share:5.3f} x margin    {largest_real_part(share * found.scaling, 9):+.3e}")


if __name__ == "__main__":
    main(run)
