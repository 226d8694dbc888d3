"""Starts from the controllers of the Youla bound: of no order, fitted by rational functions of the asked one.

The bound's answers K (inscribed discs, ellipses, enclosing discs) are responses on a grid. Vector fitting
relocates poles until (sum c_i/(p - a_i) + d)/(sum c'_i/(p - a_i) + 1) comes nearest to K, in the Tustin plane
p of the cascade; the numerator then is linear least squares. Errors are weighted by 1/|K|: a relative change
of K moves S by -T and K S by S times it. Which frequencies a low order can do without is not known
beforehand: further starts weigh them at random.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control_design.controllers.biquads import Cascade, tustin_frequency
from control_design.convex.convex_options import YoulaOptions
from control_design.convex.youla import BracketProblem
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.starts import in_sections
from ident.data.arrays import real_rows

# A sixth of the time of the default bound, and 1 to 8 % above it on links with long ellipses.
_SMALL = YoulaOptions(
    real_poles=12,
    mirrored_poles=0,
    pairs_per_mode=4,
    grid_points=70,
    mode_points=40,
    exchange_rounds=0,
    dense_points=1000,
)
_ACCURACY = 3e-3  # relative, of the small problems: a tenth of the 3 % that the search asks of them
_RELOCATIONS = 12  # of the poles; the fifth already moves them by less than a per cent
_SPREAD = 1.5  # standard deviation of the logarithms of random weights, at `_KNOTS` frequencies
_KNOTS = 8  # over four decades of frequency two a decade: weights bend, and do not jitter
_HIGHEST = 1e6  # |p| towards Nyquist, where nothing of the fit is left


@dataclass(frozen=True, eq=False)
class FreeController:
    """Response k (F,) at omega (F,) of a controller of no order."""

    omega_rad_s: Real
    k: Complex


@dataclass(frozen=True, eq=False)
class FreeControllers:
    """Of every plant by itself, and the largest of their worst cases over the ellipses (inf: some plant has
    none)."""

    each: tuple[FreeController, ...]
    gamma: float


def free_controllers(
    plants: Sequence[UncertainPlant], specification: Specification, options: YoulaOptions = _SMALL
) -> FreeControllers:
    """Controllers of the Youla bound, on a small basis if not told otherwise, one plant after the other."""
    found: list[FreeController] = []
    gamma = 0.0
    for plant in plants:
        try:
            problem = BracketProblem(plant, specification, options, accuracy=_ACCURACY)
        except (ValueError, ArithmeticError):  # no factorisation: the bound does not know such a plant
            return FreeControllers(tuple(found), np.inf)
        answers = problem.answers()
        found += [FreeController(*problem.controller(x)) for value, x in answers if np.isfinite(value)]
        gamma = max(gamma, answers[0][0])
    return FreeControllers(tuple(found), gamma)


def fitted(
    cascade: Cascade, free: FreeController, *, least_damping: float, rng: np.random.Generator | None = None
) -> Real | None:
    """Parameters of the cascade nearest to a free controller; rng: with random weights over frequency.

    None for structures with notches, whose zeros are not free, or a fit that degenerates.
    """
    if "notch" in cascade.sections:
        return None
    weight = 1.0 / np.maximum(np.abs(free.k), 1e-300)
    log = np.log(free.omega_rad_s)
    if rng is not None:
        knots = np.linspace(log[0], log[-1], _KNOTS)
        weight = weight * np.exp(np.interp(log, knots, rng.normal(0.0, _SPREAD, _KNOTS)))
    p = 1j * tustin_frequency(free.omega_rad_s, cascade.dt_s) / cascade.scale_rad_s
    use = np.abs(p) < _HIGHEST
    p, k, weight = p[use], free.k[use], weight[use]
    fixed = [1.0 / p] if "integrator" in cascade.sections else []
    poles = -np.geomspace(0.1, 10.0, cascade.order - len(fixed)).astype(np.complex128)
    still = np.stack([np.ones_like(p), *fixed], axis=1)
    try:
        for _ in range(_RELOCATIONS if poles.size else 0):
            functions = _functions(p, poles)
            columns = np.hstack([functions, still, -k[:, None] * functions]) * weight[:, None]
            denominator = _least_squares(columns, k * weight)[-poles.size :]
            poles = _usable(_zeros(poles, denominator), least_damping)
    except np.linalg.LinAlgError:
        return None
    denominators = _dealt(cascade, poles)
    whole = np.prod([np.polyval(each, p) for each in denominators], axis=0)
    powers = np.stack([p**power / whole for power in range(cascade.order, -1, -1)], axis=1)
    return in_sections(cascade.sections, _least_squares(powers * weight[:, None], k * weight), denominators)


def _functions(p: Complex, poles: Complex) -> Complex:
    """Partial fractions (F, n): 1/(p - a) of real poles; of a pair, which stands next to each other, the real
    and the imaginary combination."""
    one = 1.0 / (p[:, None] - poles)
    upper, lower = poles.imag > 0, poles.imag < 0
    both = one.copy()
    both[:, upper], both[:, lower] = one[:, upper] + one[:, lower], 1j * (one[:, upper] - one[:, lower])
    return both


def _zeros(poles: Complex, coefficients: Real) -> Complex:
    """Zeros of 1 + sum of coefficients times `_functions`."""
    a, b = np.diag(poles.real), np.where(poles.imag > 0, 2.0, np.where(poles.imag < 0, 0.0, 1.0))
    for at in np.flatnonzero(poles.imag > 0):
        a[at, at + 1], a[at + 1, at] = poles[at].imag, -poles[at].imag
    return np.asarray(np.linalg.eigvals(a - np.outer(b, coefficients)), dtype=np.complex128)


def _usable(roots: Complex, least_damping: float) -> Complex:
    """In the left half plane, pairs next to each other and damped as asked."""
    found: list[complex] = []
    for root in roots[roots.imag >= 0].tolist():
        size = max(abs(root), 1e-9)
        zeta = max(abs(root.real) / size, least_damping)
        if root.imag == 0 or zeta >= 1.0:
            found += [complex(-size)] * (1 if root.imag == 0 else 2)
        else:
            pole = size * complex(-zeta, np.sqrt(1.0 - zeta**2))
            found += [pole, pole.conjugate()]
    return np.array(found)


def _dealt(cascade: Cascade, poles: Complex) -> list[Real]:
    """Denominators of the sections: pairs to those of second order, and the slowest real poles in twos."""
    pairs = [np.real(np.poly([pole, pole.conjugate()])) for pole in poles if pole.imag > 0]
    real = sorted(-float(pole.real) for pole in poles if pole.imag == 0)
    while len(pairs) < sum(kind == "second_order" for kind in cascade.sections):
        pairs.append(np.poly([-real.pop(0), -real.pop(0)]))
    return [
        np.array([1.0, 0.0])
        if kind == "integrator"
        else np.array([1.0, real.pop(0)])
        if kind == "first_order"
        else pairs.pop(0)
        for kind in cascade.sections
    ]


def _least_squares(columns: Complex, right: Complex) -> Real:
    rows = real_rows(columns)
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(rows / size, real_rows(right), rcond=1e-12)[0] / size)
