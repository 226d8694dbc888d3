"""Two masses and a spring (Wie and Bernstein): peaks of S and T over the stiffness range at published gains,
and an exact robust stability margin.

Peaks: P = k/(s^2 (s^2 + 2 k)), m1 = m2 = 1, k in [0.5, 2]; DC gain of K at least 0.032, high-frequency
|s K| at most 0.08, as for Chait's QFT design 0.032 (10 s + 1)/(4 s^2 + 2 s + 1). Direct search of the
continuous-time controller on 13 stiffnesses, then the peaks over 100 log-spaced ones and 8000 frequencies.
The structured synthesis of this project is discrete-time and has no weight on T; it is not used here.

Margin of C = 100 ((s + 1)/(0.001 s + 1))^3, unity feedback, P = k/(m1 s^2 (m2 s^2 + (1 + m2/m1) k)),
m1, m2, k = 1 +- 20 %: the factor t by which all three intervals may be widened together before some plant in
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
from functools import partial

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.optimize import differential_evolution, minimize

from benchmarks.harness import Print, main, timed

DC_GAIN, HIGH_GAIN = 0.032, 0.08
STIFFNESS = np.geomspace(0.5, 2.0, 100)
GAIN, ZERO, POLE, EXPONENT = 100.0, 1.0, 1000.0, 3
SPREAD = 0.2
PUBLISHED = (2.8826, 2.8864, 575.03)


@dataclass(frozen=True, eq=False)
class Design:
    """K = numerator/denominator, highest power first, denominator monic."""

    numerator: np.ndarray
    denominator: np.ndarray

    @property
    def dc_gain(self) -> float:
        return float(self.numerator[-1] / self.denominator[-1])

    @property
    def high_gain(self) -> float:
        """lim |s K|."""
        short = self.denominator.size - self.numerator.size
        return float(abs(self.numerator[0])) if short == 1 else 0.0


CHAIT = Design(0.032 * np.array([10.0, 1.0]) / 4, np.array([4.0, 2.0, 1.0]) / 4)


def peaks(
    numerator: np.ndarray, denominator: np.ndarray, stiffness: np.ndarray, omega: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(max|S|, max|T|) (P,) over stiffness and omega, numerators (P, m), denominators (P, n); inf if
    unstable."""
    count, order = denominator.shape[0], denominator.shape[1] - 1
    s = 1j * omega
    n = polyval(s, numerator.T[::-1])[:, None]
    d = polyval(s, denominator.T[::-1])[:, None]
    k = stiffness[None, :, None]
    open_part = s**2 * (s**2 + 2 * k) * d
    closed = open_part + k * n
    with np.errstate(divide="ignore"):
        s_peak = np.max(np.abs(open_part / closed), axis=2)
        t_peak = np.max(np.abs(k * n / closed), axis=2)
    full = np.zeros((count, stiffness.size, order + 5))
    full[:, :, : order + 1] += denominator[:, None, :]
    full[:, :, 2 : order + 3] += 2 * stiffness[None, :, None] * denominator[:, None, :]
    full[:, :, order + 5 - numerator.shape[1] :] += stiffness[None, :, None] * numerator[:, None, :]
    companion = np.zeros((count, stiffness.size, order + 4, order + 4))
    companion[:, :, 0] = -full[:, :, 1:]
    companion[:, :, np.arange(1, order + 4), np.arange(order + 3)] = 1.0
    unstable = np.max(np.linalg.eigvals(companion).real, axis=2) >= 0
    s_peak[unstable] = t_peak[unstable] = np.inf
    return s_peak, t_peak


def dense_peaks(design: Design, stiffness: np.ndarray = STIFFNESS) -> tuple[float, float]:
    """(max|S|, max|T|) on 8000 frequencies: 0.2 % apart, so a peak is met to 1e-5 of its value."""
    found = peaks(design.numerator[None], design.denominator[None], stiffness, np.geomspace(1e-3, 1e3, 8000))
    return float(np.max(found[0])), float(np.max(found[1]))


def design_of(x: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Numerators and denominators (P, .) of search points x (P, 4 or 6).

    x: log frequency and log damping of the pole pair, log DC gain over its limit, leading numerator
    coefficient as share of its limit; for order 3 also log of the real pole and the middle numerator
    coefficient.
    """
    frequency, damping = np.exp(x[:, 0]), np.exp(x[:, 1])
    denominator = np.stack([np.ones_like(frequency), 2 * damping * frequency, frequency**2], axis=1)
    gain = DC_GAIN * np.exp(x[:, 2])
    lead = HIGH_GAIN * x[:, 3]
    if order == 2:
        return np.stack([lead, gain * denominator[:, -1]], axis=1), denominator
    pole = np.exp(x[:, 4])[:, None]
    longer = np.pad(denominator, ((0, 0), (0, 1))) + pole * np.pad(denominator, ((0, 0), (1, 0)))
    return np.stack([lead, x[:, 5], gain * longer[:, -1]], axis=1), longer


def optimised(order: int, seed: int) -> Design:
    """Smallest larger peak by differential evolution, polished by SLSQP."""
    stiffness, omega = np.geomspace(0.5, 2.0, 13), np.geomspace(0.02, 20, 220)

    def cost(x: np.ndarray) -> np.ndarray:
        points = np.atleast_2d(x.T)
        s_peak, t_peak = peaks(*design_of(points, order), stiffness, omega)
        return np.minimum(np.max(np.maximum(s_peak, t_peak), axis=1), 1e3)

    bounds = [(np.log(0.05), np.log(5)), (np.log(0.05), np.log(3)), (0.0, 1.0), (-1.0, 1.0)]
    if order == 3:
        bounds += [(np.log(0.1), np.log(10)), (-0.5, 0.5)]
    found = differential_evolution(
        cost,
        bounds,
        vectorized=True,
        updating="deferred",
        popsize=12,
        maxiter=120,
        polish=False,
        tol=0.0,
        atol=1e-5,
        rng=np.random.default_rng(seed),
    )
    low, high = np.array(bounds).T
    fine = np.geomspace(0.02, 20, 1500)

    def all_peaks(x: np.ndarray) -> np.ndarray:
        """(P, 26) of x (P, n)."""
        both = peaks(*design_of(np.clip(x, low, high), order), stiffness, fine)
        return np.minimum(np.concatenate(both, axis=1), 1e3)

    def room(v: np.ndarray) -> np.ndarray:
        return v[-1] - all_peaks(v[None, :-1])[0]

    def room_slope(v: np.ndarray) -> np.ndarray:
        step = 1e-6 * np.eye(v.size - 1)
        moved = all_peaks(np.concatenate([v[:-1] + step, v[:-1] - step]))
        slope = (moved[: v.size - 1] - moved[v.size - 1 :]).T / 2e-6
        return np.hstack([-slope, np.ones((slope.shape[0], 1))])

    # Smallest bound over all 26 peaks: smooth constraints, where the largest peak itself has kinks. Several
    # members of the last population, because the valley of order 3 is long and has more than one end.
    order_of = np.argsort(found.population_energies)
    candidates = [found.population[i] for i in order_of[:: max(1, order_of.size // 12)][:6]]
    for start in list(candidates):
        answer = minimize(
            lambda v: v[-1],
            np.append(start, cost(start[:, None])[0]),
            jac=lambda v: np.append(np.zeros(v.size - 1), 1.0),
            method="SLSQP",
            bounds=[*bounds, (1.0, 1e3)],
            constraints={"type": "ineq", "fun": room, "jac": room_slope},
            options={"maxiter": 120, "ftol": 1e-9},
        )
        candidates.append(np.clip(answer.x[:-1], low, high))
    best = candidates[int(np.argmin(np.max(all_peaks(np.stack(candidates)), axis=1)))]
    numerator, denominator = design_of(best[None], order)
    return Design(numerator[0], denominator[0])


@dataclass(frozen=True)
class Margin:
    """scaling of the box, frequency of the pole on the axis, and the plant (m1, m2, k) that has it."""

    scaling: float
    omega_rad_s: float
    plant: tuple[float, float, float]


def real_axis_frequencies() -> list[float]:
    """omega > 0 with C(j omega) real: phase of one lead term 60 degrees."""
    tangent = np.sqrt(3.0)
    return sorted(np.roots([tangent / (ZERO * POLE), -(1 / ZERO - 1 / POLE), tangent]).tolist())


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


def run(out: Print, *, seeds: tuple[int, ...] = (1, 2, 3)) -> None:
    s_peak, t_peak = dense_peaks(CHAIT)
    out("Peaks over 100 log-spaced k in [0.5, 2]; DC gain >= 0.032, high-frequency |s K| <= 0.08.")
    out(f"Chait: max|S| {s_peak:.3f} (published 2.191), max|T| {t_peak:.3f} (published 1.618)")
    out("order  seed  max|S|  max|T|  larger  reach    DC gain  |s K|   CPU s  numerator / denominator")
    for order, reach in ((2, 1.79), (3, 1.62)):
        for seed in seeds:
            design, spent = timed(partial(optimised, order, seed))
            s_peak, t_peak = dense_peaks(design)
            out(
                f"{order:>5}  {seed:>4}  {s_peak:>6.3f}  {t_peak:>6.3f}  {max(s_peak, t_peak):>6.4f}"
                f"  <= {reach:.2f}  {design.dc_gain:.5f}  {design.high_gain:.5f}  {spent:>5.1f}"
                f"  {np.round(design.numerator, 6).tolist()} / {np.round(design.denominator, 6).tolist()}"
            )
    out()
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
