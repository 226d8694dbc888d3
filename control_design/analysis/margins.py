"""Gain, phase and delay margins over ellipses of the loop gain, exact at every grid frequency.

A crossing is a member x of the ellipse K E on the negative real axis (gain) or on the unit circle (phase,
delay).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from control_design.plants.ellipses import Complex, Ellipses, Real


@dataclass(frozen=True)
class Margins:
    """Margins of a loop; infinity where there is no crossing.

    gain_up: factor the gain may rise (> 1). gain_down: factor it may fall to (< 1; 0 = no lower limit).
    phase_rad: smallest rotation to -1 either way. delay_s: smallest extra delay to -1. modulus: smallest
    distance from -1.
    """

    gain_up: float
    gain_down: float
    phase_rad: float
    delay_s: float
    modulus: float

    def worse(self, other: Margins) -> Margins:
        """The smaller of each."""
        return Margins(
            min(self.gain_up, other.gain_up),
            max(self.gain_down, other.gain_down),
            min(self.phase_rad, other.phase_rad),
            min(self.delay_s, other.delay_s),
            min(self.modulus, other.modulus),
        )


def crossing_margins(x: Complex, omega_rad_s: Real, modulus: float) -> Margins:
    """Margins of loop values x already on a crossing: real negative ones count for gain, those of size 1 for
    phase."""
    real = np.real(x[np.abs(np.imag(x)) <= 1e-7 * np.abs(x)])
    inside = -real[(real < 0) & (real > -1)]
    beyond = -real[real < -1]
    unit = np.abs(np.abs(x) - 1.0) <= 1e-6
    angle = np.mod(np.angle(-x[unit]), 2 * np.pi)
    either = np.minimum(angle, 2 * np.pi - angle)
    delay = angle / omega_rad_s[unit]
    return Margins(
        gain_up=float(1 / np.max(inside)) if inside.size else np.inf,
        gain_down=float(1 / np.min(beyond)) if beyond.size else 0.0,
        phase_rad=float(np.min(either)) if either.size else np.inf,
        delay_s=float(np.min(delay)) if delay.size else np.inf,
        modulus=modulus,
    )


def nominal_margins(
    loop_gain: Callable[[Real], Complex], omega_rad_s: Real, *, refinable: bool = True
) -> Margins:
    """Margins of one loop: crossings bracketed on the grid, then refined by root finding (or
    interpolated)."""
    value = loop_gain(omega_rad_s)
    found: list[tuple[float, complex]] = []

    def refine(function: Callable[[complex], float], k: int) -> tuple[float, complex]:
        low, high = float(omega_rad_s[k]), float(omega_rad_s[k + 1])
        if refinable:

            def at(omega: float) -> complex:
                return complex(loop_gain(np.array([omega]))[0])

            omega = float(brentq(lambda w: function(at(w)), low, high, xtol=1e-13 * high, rtol=1e-14))
            return omega, at(omega)
        a, b = function(complex(value[k])), function(complex(value[k + 1]))
        share = a / (a - b)
        return low + share * (high - low), complex(value[k] + share * (value[k + 1] - value[k]))

    imag, size = np.imag(value), np.abs(value) - 1.0
    for k in np.flatnonzero(np.sign(imag[:-1]) * np.sign(imag[1:]) < 0):
        if min(value[k].real, value[k + 1].real) < 0:
            omega, x = refine(lambda v: v.imag, int(k))
            found.append((omega, complex(x.real, 0.0)))
    for k in np.flatnonzero(size[:-1] * size[1:] < 0):
        omega, x = refine(lambda v: abs(v) - 1.0, int(k))
        found.append((omega, x / abs(x)))
    # At Nyquist the loop is real: the gain limit may sit there without a sign change.
    if value[-1].real < 0 and abs(value[-1].imag) <= 1e-9 * abs(value[-1]):
        found.append((float(omega_rad_s[-1]), complex(value[-1].real, 0.0)))
    places, crossings = np.array([omega for omega, _ in found]), np.array([x for _, x in found], complex)
    return crossing_margins(crossings, places, float(np.min(np.abs(1 + value))))


def ellipse_margins(loop_gain: Complex, ellipses: Ellipses, distance: Real) -> Margins:
    """Smallest margins over all members of K E at every grid frequency; distance (F,) is dist(-1, K E)."""
    modulus = float(np.min(distance))
    if modulus <= 0:
        return Margins(1.0, 1.0, 0.0, 0.0, 0.0)
    centre = loop_gain * ellipses.centre
    major = loop_gain * ellipses.direction * ellipses.semi_major
    minor = 1j * loop_gain * ellipses.direction * ellipses.semi_minor
    omega = ellipses.omega_rad_s
    real, real_omega = _real_axis(centre, major, minor, omega)
    unit, unit_omega = _unit_circle(centre, major, minor, omega)
    return crossing_margins(np.concatenate([real, unit]), np.concatenate([real_omega, unit_omega]), modulus)


def _real_axis(centre: Complex, major: Complex, minor: Complex, omega: Real) -> tuple[Complex, Real]:
    """Ends of the segment each ellipse cuts out of the real axis."""
    p, q = major.imag, minor.imag
    reach = np.hypot(p, q)
    hit = (np.abs(centre.imag) <= reach) & (reach > 0)
    c, p, q, reach, omega = centre[hit], p[hit], q[hit], reach[hit], omega[hit]
    # Im = c.imag + reach cos(f - f0) = 0
    spread = np.arccos(np.clip(-c.imag / reach, -1.0, 1.0))
    middle = np.arctan2(q, p)
    ends = [
        c.real + major.real[hit] * np.cos(f) + minor.real[hit] * np.sin(f)
        for f in (middle + spread, middle - spread)
    ]
    # A segment that covers part of (-1, 0) or (-inf, -1) has its extreme there at an end: -1 itself is
    # outside.
    return np.concatenate(ends).astype(np.complex128), np.concatenate([omega, omega])


def _unit_circle(centre: Complex, major: Complex, minor: Complex, omega: Real) -> tuple[Complex, Real]:
    """Points of each ellipse's boundary on the unit circle: roots w = e^{jf} of |c + a w + b/w|^2 = 1
    (quartic)."""
    reach = np.abs(major)
    hit = (np.abs(np.abs(centre) - 1.0) <= reach) & (reach > 1e-12)
    if not np.any(hit):
        return np.zeros(0, complex), np.zeros(0)
    c, omega = centre[hit], omega[hit]
    a, b = (major[hit] - 1j * minor[hit]) / 2, (major[hit] + 1j * minor[hit]) / 2
    second = a * np.conj(b)
    first = a * np.conj(c) + c * np.conj(b)
    zeroth = np.abs(c) ** 2 + np.abs(a) ** 2 + np.abs(b) ** 2 - 1.0 + 0j
    # Circles (b = 0) have no second-order term; a tiny one keeps the companion form and sends two roots away.
    second = np.where(np.abs(second) < 1e-14 * np.abs(first), 1e-14 * np.abs(first) + 1e-300, second)
    companion = np.zeros((c.size, 4, 4), dtype=np.complex128)
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1.0
    for row, coefficient in enumerate([np.conj(second), np.conj(first), zeroth, first]):
        companion[:, row, 3] = -coefficient / second
    w = np.linalg.eigvals(companion)
    on = np.abs(np.abs(w) - 1.0) < 1e-5  # a tangent crossing is a double root: half the digits
    w = np.where(on, w / np.maximum(np.abs(w), 1e-300), 1.0)
    x = c[:, None] + a[:, None] * w + b[:, None] / w
    good = on & (np.abs(np.abs(x) - 1.0) < 1e-5)
    x = np.where(good, x / np.maximum(np.abs(x), 1e-300), 0.0)
    return x[good], np.broadcast_to(omega[:, None], x.shape)[good]
