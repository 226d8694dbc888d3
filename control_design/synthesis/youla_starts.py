"""Starts from the controllers of the Youla bound: responses of no order, fitted by ones of the asked order.

`free_controllers` solves a small Youla problem for every plant; its answers K (for inscribed discs,
ellipses and enclosing discs) are responses on a grid. `fitted` approximates such a response by the
structure of a cascade: vector fitting (Gustavsen and Semlyen, IEEE Transactions on Power Delivery 14, 1999)
relocates poles until

    (sum c_i / (p - a_i) + d) / (sum c'_i / (p - a_i) + 1)

comes nearest to K, in the Tustin plane p of the cascade; the numerator then is linear least squares. Errors
are weighted by 1/|K|: a relative change of K moves S by -T and K S by S times it. Which frequencies a low
order can do without is not known beforehand: further starts weigh them at random.

In shapes: F frequencies, n poles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from control_design.controllers.biquads import Cascade, tustin_frequency
from control_design.convex.convex_options import YoulaOptions
from control_design.convex.youla import UNKNOWN_TO_BOUND, BracketProblem
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.starts import in_sections
from ident.data.arrays import real_rows

# Basis and grids of the small problem, each about a third of the default ones, no exchange of frequencies: a
# sixth of the time of the default bound, and 1 to 8 % above it on links with long ellipses.
_SMALL = YoulaOptions(
    real_poles=12,
    mirrored_poles=0,
    pairs_per_mode=4,
    grid_points=70,
    mode_points=40,
    exchange_rounds=0,
    dense_points=1000,
)
# Relative accuracy of the small problems: a tenth of the 3 % that the search asks of them.
_ACCURACY = 3e-3
# Bounds that are remembered: a search for a bandwidth asks for those of each trial's bandwidth again, for the
# whole design and for controllers of fewer states. Chosen; it costs memory alone.
_REMEMBERED = 64
# Relocations of the poles; the fifth already moves them by less than a per cent, the others are for slow
# cases.
_RELOCATIONS = 12
# Slowest of the first poles, in units of the scale: they are real, over two decades around it, where a
# controller acts. Relocation moves them from wherever they begin. Chosen.
_SLOWEST_POLE = 0.1

# The fastest of the first poles, in units of the scale.
_FASTEST_POLE = 10.0
# Standard deviation of the logarithms of random weights: factors of 4.5 up and down are usual. Chosen.
_SPREAD = 1.5
# Frequencies at which they are drawn; over four decades two a decade: weights bend, and do not jitter.
_KNOTS = 8
# |p| from which on a frequency is left out: p is infinite at Nyquist, and its powers would overflow the
# columns. 1e6 scales is within a millionth of Nyquist.
_HIGHEST = 1e6
# Least modulus of a pole, in units of the scale: one at 0 would be an integrator that nobody asked for.
_LEAST_POLE = 1e-9
# Singular values below this share of the largest are rounding: some thousand times that of one number.
_ROUNDING = 1e-12
# No division by zero.
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class FreeController:
    """Response of a controller of no order.

    Attributes
    ----------
    omega_rad_s : ndarray, shape (F,)
        Ascending, positive, up to Nyquist.
    k : ndarray, shape (F,)
        K, command per error, without the computational delay. Nothing is checked.
    """

    omega_rad_s: Real
    k: Complex


@dataclass(frozen=True, eq=False)
class FreeControllers:
    """Controllers of the Youla bound of every plant by itself.

    Attributes
    ----------
    each : tuple of FreeController
        Up to three of each plant: for its ellipses, enclosing and inscribed discs, where the value is finite.
    gamma : float
        Largest of their worst cases over the ellipses, one for each plant; inf: some plant has none.
    floor : float
        Largest of their worst cases over the inscribed discs, below which no controller of any order goes,
        but for the size of the basis; 0: some plant has none.
    """

    each: tuple[FreeController, ...]
    gamma: float
    floor: float = 0.0


def free_controllers(
    plants: Sequence[UncertainPlant], specification: Specification, options: YoulaOptions = _SMALL
) -> FreeControllers:
    """Controllers of the Youla bound, one plant after the other.

    Parameters
    ----------
    plants : sequence of UncertainPlant
        Without any, gamma is 0 and there are no controllers.
    specification : Specification
        Its weighted requirements count; damping of the controller and delay margin are not part of the bound.
    options : YoulaOptions
        By default a small basis and coarse grids.

    Returns
    -------
    FreeControllers
        Where a plant has no such bound (its problem raises ValueError or ArithmeticError), gamma is inf and
        floor 0, and the plants that follow are left out. What was asked before is remembered: plants are
        compared by identity, specifications by what the bound knows of them.
    """
    anything = Specification()
    unknown = {name: getattr(anything, name) for name in UNKNOWN_TO_BOUND}
    return _free_controllers(tuple(plants), specification.model_copy(update=unknown), options)


@lru_cache(maxsize=_REMEMBERED)
def _free_controllers(
    plants: tuple[UncertainPlant, ...], specification: Specification, options: YoulaOptions
) -> FreeControllers:
    """As `free_controllers`, of arguments that can be compared."""
    controllers: list[FreeController] = []
    gamma = 0.0
    floor = 0.0
    for plant in plants:
        try:
            problem = BracketProblem(plant, specification, options, accuracy=_ACCURACY)
        except (ValueError, ArithmeticError):
            # No factorisation: the bound does not know such a plant.
            return FreeControllers(tuple(controllers), np.inf)
        answers = problem.answers()
        for value, x in answers:
            if np.isfinite(value):
                controllers.append(FreeController(*problem.controller(x)))
        (over_ellipses, _), _, (over_inscribed, _) = answers
        gamma = max(gamma, over_ellipses)
        # What a controller reaches over the ellipses it reaches over discs within them. Where nothing stable
        # was found nothing is known.
        least = min(over_inscribed, over_ellipses)
        if np.isfinite(least):
            floor = max(floor, least)
    return FreeControllers(tuple(controllers), gamma, floor)


def fitted(
    cascade: Cascade, free: FreeController, *, least_damping: float, rng: np.random.Generator | None = None
) -> Real | None:
    """Parameters of the cascade nearest to a free controller.

    Parameters
    ----------
    cascade : Cascade
        Structure, scale and sampling time of the fit.
    free : FreeController
        Finite, at more frequencies than the fit has coefficients (neither is checked).
    least_damping : float
        Damping ratio that no pair of poles goes below; from 1 on all poles are real.
    rng : numpy.random.Generator, optional
        Draws weights over frequency; without it all relative errors count the same.

    Returns
    -------
    ndarray, shape (parameters,), or None
        None for structures with parts, whose zeros are not free, or a fit that degenerates: a relocation
        that does not converge, or a numerator that vanishes. Poles are stable; the loop need not be.

    Raises
    ------
    numpy.linalg.LinAlgError
        The numerator's least squares do not converge; a response that is not finite gives this or None.
    """
    if cascade.has_parts:
        return None
    weight = 1.0 / np.maximum(np.abs(free.k), _TINY)
    log_omega = np.log(free.omega_rad_s)
    if rng is not None:
        knots = np.linspace(log_omega[0], log_omega[-1], _KNOTS)
        log_factors = rng.normal(0.0, _SPREAD, _KNOTS)
        weight = weight * np.exp(np.interp(log_omega, knots, log_factors))
    p = 1j * tustin_frequency(free.omega_rad_s, cascade.dt_s) / cascade.scale_rad_s
    use = np.abs(p) < _HIGHEST
    p = p[use]
    k = free.k[use]
    weight = weight[use]

    # An integrator's pole stays at 0, the direct term at infinity; all others are relocated.
    fixed = [1.0 / p] if "integrator" in cascade.sections else []
    unmoved = np.stack([np.ones_like(p), *fixed], axis=1)
    moving_count = cascade.order - len(fixed)
    poles = -np.geomspace(_SLOWEST_POLE, _FASTEST_POLE, moving_count).astype(np.complex128)
    try:
        for _ in range(_RELOCATIONS if poles.size else 0):
            # Numerator - K (denominator - 1) = K: linear in both; the zeros of the denominator become poles.
            functions = _functions(p, poles)
            unweighted = np.hstack([functions, unmoved, -k[:, None] * functions])
            coefficients = _least_squares(unweighted * weight[:, None], k * weight)
            denominator = coefficients[-poles.size :]
            poles = _usable(_zeros(poles, denominator), least_damping)
    except np.linalg.LinAlgError:
        return None

    # With poles that stay: the numerator by least squares, its roots dealt to the sections.
    denominators = _dealt(cascade, poles)
    whole = np.prod([np.polyval(denominator, p) for denominator in denominators], axis=0)
    powers = range(cascade.order, -1, -1)
    columns = np.stack([p**power / whole for power in powers], axis=1)
    numerator = _least_squares(columns * weight[:, None], k * weight)
    return in_sections(cascade.sections, numerator, denominators)


def _functions(p: Complex, poles: Complex) -> Complex:
    """Partial fractions (F, n) of poles (n,) at p (F,), with real coefficients for real responses.

    1/(p - a) of real poles. Of a pair, whose poles stand next to each other, the upper one first, the sum of
    both fractions, and j times their difference. p on a pole gives inf, which stable poles exclude.
    """
    fractions = 1.0 / (p[:, None] - poles)
    upper = poles.imag > 0
    lower = poles.imag < 0
    of_upper = fractions[:, upper]
    of_lower = fractions[:, lower]
    functions = fractions.copy()
    functions[:, upper] = of_upper + of_lower
    functions[:, lower] = 1j * (of_upper - of_lower)
    return functions


def _zeros(poles: Complex, coefficients: Real) -> Complex:
    """Zeros (n,) of 1 + sum of coefficients (n,) times `_functions` of poles (n,).

    Eigenvalues of A - b c with A, b of the real realisation of the partial fractions: b is 1 for a real pole,
    (2, 0) for a pair. Raises LinAlgError where they are not finite.
    """
    a = np.diag(poles.real)
    is_upper = poles.imag > 0
    is_lower = poles.imag < 0
    b = np.where(is_upper, 2.0, np.where(is_lower, 0.0, 1.0))
    for upper in np.flatnonzero(is_upper):
        a[upper, upper + 1] = poles[upper].imag
        a[upper + 1, upper] = -poles[upper].imag
    return np.asarray(np.linalg.eigvals(a - np.outer(b, coefficients)), dtype=np.complex128)


def _usable(roots: Complex, least_damping: float) -> Complex:
    """Roots (n,) mirrored into the left half plane, pairs next to each other and damped as asked.

    A pair whose damping would reach 1, as asked, becomes a double real pole. Moduli below `_LEAST_POLE` are
    raised to it; roots come in conjugates (not checked), of which the lower ones are left out and made anew.
    """
    poles: list[complex] = []
    upper_or_real = roots.imag >= 0
    for root in roots[upper_or_real].tolist():
        size = max(abs(root), _LEAST_POLE)
        zeta = max(abs(root.real) / size, least_damping)
        if root.imag == 0:
            poles.append(complex(-size))
        elif zeta >= 1.0:
            poles += [complex(-size), complex(-size)]
        else:
            pole = size * complex(-zeta, np.sqrt(1.0 - zeta**2))
            poles += [pole, pole.conjugate()]
    return np.array(poles)


def _dealt(cascade: Cascade, poles: Complex) -> list[Real]:
    """Denominators of the sections, highest power of p first: poles (n,) dealt to them.

    Pairs go to sections of second order, and where there are fewer pairs, the slowest real poles in twos.
    Each is monic: (2,) or (3,). Poles of another number, or more pairs than sections of second order, are an
    IndexError; with at most one section of first order, as specifications have, neither happens.
    """
    upper_poles = [pole for pole in poles if pole.imag > 0]
    pairs = [np.real(np.poly([pole, pole.conjugate()])) for pole in upper_poles]
    corners = sorted(-float(pole.real) for pole in poles if pole.imag == 0)
    second_order_sections = sum(kind == "second_order" for kind in cascade.sections)
    while len(pairs) < second_order_sections:
        slowest = -corners.pop(0)
        next_slowest = -corners.pop(0)
        pairs.append(np.poly([slowest, next_slowest]))
    denominators = []
    for kind in cascade.sections:
        if kind == "integrator":
            denominators.append(np.array([1.0, 0.0]))
        elif kind == "first_order":
            denominators.append(np.array([1.0, corners.pop(0)]))
        else:
            denominators.append(pairs.pop(0))
    return denominators


def _least_squares(columns: Complex, right: Complex) -> Real:
    """Real coefficients (n,) with which complex columns (F, n) come nearest to the right side (F,).

    Columns are scaled to one size first; directions below `_ROUNDING` of the largest are left out. Raises
    LinAlgError where the solution does not converge.
    """
    rows = real_rows(columns)
    size = np.maximum(np.linalg.norm(rows, axis=0), _TINY)
    solution = np.linalg.lstsq(rows / size, real_rows(right), rcond=_ROUNDING)[0]
    return np.asarray(solution / size)
