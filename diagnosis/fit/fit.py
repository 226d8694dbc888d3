"""Maximum a posteriori fit of deviations and effect parameters, and the evidence of a set of candidates.

Minimises |e|^2 + |d|^2 over the deviations d of the nominal parameters (more beyond two tolerances) and
the coordinates x of the candidates (inside their boxes), e being the whitened residuals:
Levenberg-Marquardt with difference quotients, inside the boxes; sizes on which the cost does not depend
smoothly (backlash, rounding) on grids, all else following.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from diagnosis.fit.nominal import prior_cost, prior_curvature, prior_slope
from diagnosis.fit.residual import ResidualModel
from diagnosis.machine.machine_protocol import Real, RecordOfMachine, Weighing
from plant.effects.search_space import Candidate

# Steps of difference quotients along the deviations. Where contacts switch, a small step measures which way
# one contact fell; a large one averages over many.
_DEVIATION_STEP = {"smooth": 1e-4, "continuous": 1e-3, "non-smooth": 3e-2}
# The same for coordinates of effects beside a non-smooth one, which have small steps of their own.
_STEP_BESIDE_NON_SMOOTH = {"log": 4e-2, "angle": 4e-2, "linear": 5e-3}
# Damping of a step: in proportion to the Hessian's diagonal and, so that values the records say little about
# do not run away along a bent valley, to this (times 1 per tolerance squared, or per unit of a logarithm).
_UNIT = 1e3
# Geodesic acceleration: second derivative along the step from a point this far along it, and the largest
# correction, in steps, that is believed.
_PROBE, _BEND = 0.1, 0.75
# Decrease that the quadratic model may still promise where a fit ends.
_LEFT = 0.5
# Grids of a non-smooth size: how far they reach to either side, one after the other, and their points.
_REACHES = (0.12, 0.04, 0.012)
_POINTS = 15


@dataclass(frozen=True, eq=False)
class Fit:
    """End of a fit: d (P,), x per candidate, residuals e (N,), Jacobian (N, P + A), cost |e|^2 + |d|^2."""

    candidates: tuple[Candidate, ...]
    deviations: Real
    coordinates: tuple[Real, ...]
    residuals: Real
    jacobian: Real
    cost: float
    converged: bool
    weighing: Weighing = field(default_factory=Weighing)

    @property
    def effects(self) -> tuple[Any, ...]:
        return tuple(c.effect_at(x) for c, x in zip(self.candidates, self.coordinates, strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.effect for c in self.candidates)

    @property
    def non_smooth(self) -> bool:
        """Whether contacts switch: the cost jumps from one sequence of them to the next."""
        return non_smooth(self.candidates)

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def hessian(self) -> Real:
        """Half the Gauss-Newton Hessian of the cost: J^T J plus the prior's curvature."""
        P = self.deviations.size
        H = self.jacobian.T @ self.jacobian
        H[range(P), range(P)] += prior_curvature(self.deviations)
        return H

    def covariance(self) -> Real:
        """Of (d, x), (P + A, P + A)."""
        return np.asarray(np.linalg.pinv(self.hessian, hermitian=True))


def solved(matrix: Real, right: Real) -> Real:
    """x of matrix x = right, the smallest where trials that ran away leave the matrix singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


def fit(
    model: ResidualModel,
    candidates: Sequence[Candidate],
    coordinates: Sequence[Real],
    deviations: Real,
    *,
    nominal_jacobian: Real | None = None,
    iterations: int = 20,
    tolerance: float = 0.02,
) -> Fit:
    """Descend from the given point.

    nominal_jacobian (N, P): taken for the derivatives by the deviations in place of new difference quotients,
    which saves most simulations far from the end; the minimum then is not exactly stationary. tolerance:
    least decrease of the cost of an iteration worth going on.
    """
    P = deviations.size
    splits = np.cumsum([len(c.axes) for c in candidates])
    low, high = box(candidates)
    x = np.clip(np.concatenate([np.zeros(0), *coordinates]), low, high)
    d = deviations.copy()

    def residuals(d: Real, x: Real) -> Real:
        return model.of(d, effects_at(candidates, x))

    exact = nominal_jacobian is None and all(c.dependence == "smooth" for c in candidates)
    e = residuals(d, x)
    cost = float(e @ e) + prior_cost(d)
    damping, converged = 1e-3, False
    for _ in range(iterations):
        J = _jacobian(model, candidates, d, x, e, nominal_jacobian)
        H = J.T @ J
        H[range(P), range(P)] += prior_curvature(d)
        gradient = J.T @ e
        gradient[:P] += prior_slope(d)
        free = _free(x, gradient[P:], low, high)
        use = np.concatenate([np.arange(P), P + np.flatnonzero(free)]).astype(int)
        if use.size == 0:
            converged = True
            break
        Hu, gu, Ju = H[np.ix_(use, use)], gradient[use], J[:, use]
        size = np.sqrt(np.maximum(np.diag(Hu), 1e-12))
        reached = None
        for _try in range(9):
            damped = Hu + damping * np.diag(size**2 + _UNIT)
            step = np.zeros(P + x.size)
            step[use] = -solved(damped, gu)
            if exact:
                probe = _PROBE * step
                ahead = residuals(model.nominal.within(d + probe[:P]), np.clip(x + probe[P:], low, high))
                bend = 2 / _PROBE * ((ahead - e) / _PROBE - J @ step)
                second = -0.5 * solved(damped, Ju.T @ bend)
                if float(np.linalg.norm(size * second)) < _BEND * float(np.linalg.norm(size * step[use])):
                    step[use] += second
            trial_d = model.nominal.within(d + step[:P])
            trial_x = np.clip(x + step[P:], low, high)
            trial_e = residuals(trial_d, trial_x)
            trial_cost = float(trial_e @ trial_e) + prior_cost(trial_d)
            if trial_cost < cost:
                reached = trial_cost
                break
            damping = max(6 * damping, 1e-5)
        if reached is None:
            converged = True
            break
        gain, cost = cost - reached, reached
        d, x, e = trial_d, trial_x, trial_e
        damping *= 0.2
        if gain < tolerance:
            # A short step is no end where the valley bends: there it is damping that shortens it.
            left = float(gu @ np.linalg.solve(Hu + 1e-10 * np.diag(size**2), gu)) if exact else 0.0
            if left < _LEFT:
                converged = True
                break
    J = _jacobian(model, candidates, d, x, e, nominal_jacobian)
    parts = tuple(np.split(x, splits[:-1])) if candidates else ()
    return Fit(tuple(candidates), d, parts, e, J, cost, converged, model.case.machine.weighing)


def refined(model: ResidualModel, end: Fit) -> Fit:
    """The fit with the sizes of its non-smooth effects sought on grids around where a descent has left them.

    Difference quotients along a non-smooth size say little, and a descent ends in the nearest jump. Each grid
    is evaluated with everything else moved along the Jacobian of the present point; the best point is refined
    without moving the size.
    """
    best = end
    for k, candidate in enumerate(end.candidates):
        if candidate.dependence != "non-smooth":
            continue
        for reach in _REACHES:
            best = _round(model, best, k, reach)
    return best


def _round(model: ResidualModel, best: Fit, k: int, reach: float) -> Fit:
    P = best.deviations.size
    sizes = [len(c.axes) for c in best.candidates]
    at = P + sum(sizes[:k])
    others = np.delete(np.arange(best.jacobian.shape[1]), at)
    J = best.jacobian[:, others]
    H = J.T @ J
    H[range(P), range(P)] += prior_curvature(best.deviations)
    scale = np.sqrt(np.maximum(np.diag(H), 1e-12))
    low, high = best.candidates[k].box
    trials = []
    for shift in np.linspace(-reach, reach, _POINTS):
        x = [part.copy() for part in best.coordinates]
        x[k][0] = np.clip(x[k][0] + shift, low[0], high[0])
        effects = tuple(c.effect_at(part) for c, part in zip(best.candidates, x, strict=True))
        e = model.of(best.deviations, effects)
        gradient = J.T @ e
        gradient[:P] += prior_slope(best.deviations)
        step = -np.linalg.solve(H + 1e-6 * np.diag(scale**2), gradient)
        cost = float(e @ e + gradient @ step) + prior_cost(best.deviations)
        trials.append((cost, x, best.deviations + np.clip(step[:P], -1.5, 1.5)))
    cost, x, d = min(trials, key=lambda trial: trial[0])
    if not cost < best.cost:
        return best
    found = fit(model, best.candidates, x, model.nominal.within(d), iterations=5, tolerance=0.5)
    return found if found.cost < best.cost else best


def cost_at(
    model: ResidualModel, candidates: Sequence[Candidate], coordinates: Sequence[Real], deviations: Real
) -> float:
    """|e|^2 + |d|^2 at a point."""
    e = model.of(deviations, [c.effect_at(x) for c, x in zip(candidates, coordinates, strict=True)])
    return float(e @ e) + prior_cost(deviations)


def difference_quotients(
    model: ResidualModel, end: Fit, e: Real, experiments: Sequence[RecordOfMachine]
) -> Real:
    """Derivatives (N, P + A) by (d, x) of the residuals e (N,) that a fit leaves in these experiments."""

    x = np.concatenate([np.zeros(0), *end.coordinates])
    return _jacobian(model, end.candidates, end.deviations, x, e, experiments=experiments)


def quotients(
    function: Callable[[Real], Real], at: Real, start: Real, steps: Real, high: Real | float = np.inf
) -> Real:
    """Derivatives (N, A) at a point (A,) of a function (A,) -> (N,) that is `start` there.

    Difference quotients, forwards by steps (A,) where that stays below `high`, else backwards.
    """
    J = np.empty((start.size, at.size))
    for i, step in enumerate(np.where(at + steps <= high, steps, -steps)):
        moved = at.copy()
        moved[i] += step
        J[:, i] = (function(moved) - start) / step
    return J


def box(candidates: Sequence[Candidate]) -> tuple[Real, Real]:
    """Bounds (A,), (A,) of all coordinates in a row."""
    boxes = [candidate.box for candidate in candidates]
    low = np.concatenate([np.zeros(0), *(box[0] for box in boxes)])
    return low, np.concatenate([np.zeros(0), *(box[1] for box in boxes)])


def _steps(candidates: Sequence[Candidate]) -> Real:
    """Of difference quotients along all coordinates (A,)."""
    jumps = non_smooth(candidates)
    return np.array(
        [
            max(axis.step, _STEP_BESIDE_NON_SMOOTH[axis.scale])
            if jumps and c.dependence != "non-smooth"
            else axis.step
            for c in candidates
            for axis in c.axes
        ]
    )


def non_smooth(candidates: Sequence[Candidate]) -> bool:
    """Whether contacts switch in any of these."""
    return any(c.dependence == "non-smooth" for c in candidates)


def effects_at(candidates: Sequence[Candidate], x: Real) -> tuple[Any, ...]:
    """Effects at the coordinates of all candidates in a row (A,)."""
    splits = np.cumsum([len(c.axes) for c in candidates])[:-1]
    return tuple(c.effect_at(part) for c, part in zip(candidates, np.split(x, splits), strict=False))


def _jacobian(
    model: ResidualModel,
    candidates: Sequence[Candidate],
    d: Real,
    x: Real,
    e: Real,
    nominal_jacobian: Real | None = None,
    experiments: Sequence[RecordOfMachine] | None = None,
) -> Real:
    if nominal_jacobian is None:
        here = effects_at(candidates, x)
        step = max([_DEVIATION_STEP["smooth"], *(_DEVIATION_STEP[c.dependence] for c in candidates)])
        nominal_jacobian = quotients(lambda d: model.of(d, here, experiments), d, e, np.full(d.size, step))
    by_x = quotients(
        lambda x: model.of(d, effects_at(candidates, x), experiments),
        x,
        e,
        _steps(candidates),
        box(candidates)[1],
    )
    return np.hstack([nominal_jacobian, by_x])


def _free(x: Real, gradient: Real, low: Real, high: Real) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Coordinates that are not held by a bound (a descent goes along -gradient)."""
    return np.asarray(~(((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))))


def log_evidence(fit: Fit) -> float:
    """log of the integral of exp(-(|e|^2 + |d|^2)/2) over d (standard normal) and x (`Axis.log_density`).

    Laplace's approximation, cut off at the boxes: along every coordinate that ends at or near a bound, the
    Gaussian (or the slope down from the bound) is integrated over the inside only, given the others at their
    best. Constants common to all hypotheses of a case are left out.
    """
    P = fit.deviations.size
    H = fit.hessian
    scale = np.sqrt(np.maximum(np.diag(H), 1e-12))
    scaled = H / np.outer(scale, scale) + 1e-10 * np.eye(scale.size)
    _, logdet = np.linalg.slogdet(scaled)
    logdet += 2 * float(np.sum(np.log(scale)))
    A = H.shape[0] - P
    value = -0.5 * fit.cost - 0.5 * logdet + 0.5 * A * np.log(2 * np.pi)
    if not A:
        return float(value)
    # Of the same matrix as the determinant: a coordinate that nothing depends on integrates to its range.
    spread = (np.sqrt(np.diag(np.linalg.inv(scaled))) / scale)[P:]
    gradient = (fit.jacobian.T @ fit.residuals)[P:]
    at = 0
    for candidate, x in zip(fit.candidates, fit.coordinates, strict=True):
        value += candidate.log_density(x)
        low, high = candidate.box
        for i in range(x.size):
            value += _inside(x[i], gradient[at], spread[at], low[i], high[i])
            at += 1
    return float(value)


def _inside(x: float, slope: float, spread: float, low: float, high: float) -> float:
    """log of the integral of exp(-slope t - t^2/(2 spread^2)) inside the box, over spread sqrt(2 pi)."""
    if not np.isfinite(low):
        return min(0.0, float(np.log(2 * np.pi / (spread * np.sqrt(2 * np.pi)))))
    # Complete the square only where a bound holds the coordinate; elsewhere the slope is rounding, or a jump.
    held = (x <= low and slope > 0) or (x >= high and slope < 0)
    centre = x - slope * spread**2 if held else x
    shift = 0.5 * (slope * spread) ** 2 if held else 0.0
    a, b = (low - centre) / spread, (high - centre) / spread
    # log(Phi(b) - Phi(a)), from the tail that keeps digits.
    if a > 0:
        a, b = -b, -a
    upper, lower = log_ndtr(b), log_ndtr(a)
    return float(shift + upper + np.log1p(-np.exp(min(lower - upper, -1e-300))))


def parameter_intervals(
    candidate: Candidate, coordinates: Real, covariance: Real, rng: np.random.Generator, draws: int
) -> dict[str, tuple[float, float]]:
    """95 % intervals by Gaussian draws of the coordinates (A,), kept inside their box; covariance (A, A)."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    moved = coordinates + rng.standard_normal((draws, coordinates.size)) @ root.T
    sampled = [candidate.parameters(draw) for draw in np.clip(moved, *candidate.box)]
    found = {}
    for key, value in candidate.parameters(coordinates).items():
        spread = np.array([p[key] for p in sampled]) - value
        if key == "phase_rad":
            spread = np.mod(spread + np.pi, 2 * np.pi) - np.pi
        below, above = np.quantile(spread, [0.025, 0.975])
        found[key] = (float(value + below), float(value + above))
    return found
