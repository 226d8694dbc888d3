"""Maximum a posteriori fit of deviations, effects, starts and zeros under levels that the residuals show.

Levenberg-Marquardt on the reweighted squares: `Levels.weights` of the present residuals majorise the concave
likelihood, so that a step that lowers the weighted squares lowers the loss (iteratively reweighted least
squares). Derivatives by difference quotients; those by starts from the linear part of the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from diagnosis.fit.coordinates import (
    bounds_of,
    difference_quotients,
    effects_at,
    non_smooth,
    solve_or_least_squares,
)
from diagnosis.fit.likelihood import WORTH_IT
from diagnosis.fit.nominal import prior_cost, prior_curvature, prior_slope
from diagnosis.fit.records import FittedStart, RecordsToFit, StartColumns
from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate

# Of difference quotients by deviations, and the smallest by coordinates of effects: known far better where
# nothing but noise is left.
_STEP, _SMALLEST_STEP = 1e-3, 1e-4
# The same where contacts switch, deviations as logarithms: the loss is jagged below it, and how one contact
# fell says nothing of where the others lead.
_COARSE_STEP = {"log": 0.1, "angle": 0.1, "linear": 0.0125}
# Of a coordinate or deviation in one iteration: beyond it a linearisation holds no further.
LARGEST_STEP = 2.0
# Grids around a size on which the loss does not depend smoothly: how far, points of each.
_NEAR = tuple(np.linspace(-reach, reach, 9) for reach in (0.1, 0.03))
_FAR = np.array([-3.0, -2.0, -1.2, -0.6, -0.25, -0.08, 0.08, 0.25, 0.6, 1.2, 2.0, 3.0])
# To an end, along flat valleys too.
FINE: dict[str, Any] = {"iterations": 40, "tolerance": 0.02}
# The Jacobian by the deviations, of the nominal or of a point nearby, is renewed at every third iteration,
# where one simulation along all of them together differs from it by more than this share.
_AGAIN, _AS_BEFORE = 3, 0.03


@dataclass(frozen=True, eq=False)
class Fit:
    """End of a fit: deviations (P,), coordinates (A,) of the candidates, start, coefficients (N,) left.

    jacobian (N, P + A), weights (N,) of the coefficients. loss: -log posterior density; prior: the part of it
    that deviations and start pay.
    """

    candidates: tuple[Candidate, ...]
    deviations: Real
    coordinates: Real
    start: FittedStart
    residual_coefficients: Real
    weights: Real
    jacobian: Real
    start_columns: StartColumns
    loss: float
    prior_loss: float
    converged: bool

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.effect for c in self.candidates)

    @property
    def effects(self) -> tuple[Any, ...]:
        return effects_at(self.candidates, self.coordinates)

    def unknowns_of(self, k: int) -> slice:
        """Where the coordinates of the k-th candidate stand among the unknowns."""
        first = self.deviations.size + sum(len(c.axes) for c in self.candidates[:k])
        return slice(first, first + len(self.candidates[k].axes))

    @property
    def non_smooth(self) -> bool:
        """Whether contacts switch."""
        return non_smooth(self.candidates)

    @property
    def cost(self) -> float:
        """Twice the loss: under white noise |e|^2 + |d|^2."""
        return 2 * self.loss

    @property
    def rms(self) -> float:
        """Of what is left, in noise deviations where the noise is known."""
        return float(np.sqrt(np.mean(self.residual_coefficients**2)))

    @property
    def hessian(self) -> Real:
        """(P + A, P + A) Gauss-Newton, of deviations and coordinates, starts and zeros held."""
        H, P = self.jacobian.T @ (self.weights[:, None] * self.jacobian), self.deviations.size
        H[range(P), range(P)] += prior_curvature(self.deviations)
        return np.asarray(H)

    def coordinates_of(self, k: int) -> Real:
        """Those of the k-th candidate."""
        first = sum(len(c.axes) for c in self.candidates[:k])
        return self.coordinates[first : first + len(self.candidates[k].axes)]

    def normal_equations(self, records: RecordsToFit) -> NormalEquations:
        """Of its linearisation."""
        return _normal_at(self, records)

    def continued(self, records: RecordsToFit, start: FittedStart | None = None, **settings: Any) -> Fit:
        """Descended on, from another start where one is given."""
        start = self.start if start is None else start
        return descend(records, self.candidates, self.deviations, self.coordinates, start, **settings)

    def precision(self, records: RecordsToFit) -> Real:
        """(P + A, P + A) of deviations and coordinates, whatever the starts and zeros are."""
        H, n = self.normal_equations(records).hessian, self.jacobian.shape[1]
        return np.asarray(H[:n, :n] - H[:n, n:] @ np.linalg.pinv(H[n:, n:], hermitian=True) @ H[n:, :n])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Weighted, in (d, x, zeros, states of record 1, 2, ...): hessian (M, M).

    weighted : (N, P + A + Z) and (T Y, S) of every record, columns times the weights.
    """

    records: RecordsToFit
    deviations: Real
    weighted: tuple[Real, tuple[Real, ...]]
    hessian: Real

    @classmethod
    def of(
        cls, records: RecordsToFit, weights: Real, jacobian: Real, columns: StartColumns, deviations: Real
    ) -> NormalEquations:
        shared = np.column_stack([jacobian, columns.zeros])
        P, k, S = deviations.size, shared.shape[1], records.state_spread.size
        M = k + len(records.record_slices) * S
        weighted, of_states = shared * weights[:, None], []
        H = np.zeros((M, M))
        H[:k, :k] = shared.T @ weighted
        for r, (part, own) in enumerate(zip(records.record_slices, columns.states, strict=True)):
            at = slice(k + r * S, k + (r + 1) * S)
            of_states.append(own * weights[part, None])
            H[at, at] = own.T @ of_states[r] + np.diag(1 / records.state_spread**2)
            H[:k, at] = weighted[part].T @ own
            H[at, :k] = H[:k, at].T
        H[range(P), range(P)] += prior_curvature(deviations)
        zeros = range(jacobian.shape[1], k)
        H[zeros, zeros] += 1 / records.zero_spread**2
        return cls(records, deviations, (weighted, tuple(of_states)), H)

    def gradient(self, start: FittedStart, e: Real) -> Real:
        """(M,) where coefficients e (N,) are left from a start."""
        weighted, of_states = self.weighted
        shared, Z = weighted.T @ e, start.zeros.size
        shared[: self.deviations.size] += prior_slope(self.deviations)
        shared[shared.size - Z :] += start.zeros / self.records.zero_spread**2
        own = [
            columns.T @ e[part] + states / self.records.state_spread**2
            for part, columns, states in zip(self.records.record_slices, of_states, start.states, strict=True)
        ]
        return np.concatenate([shared, *own])


@lru_cache(maxsize=2)
def _normal_at(end: Fit, records: RecordsToFit) -> NormalEquations:
    """Once for all that is tried beside a fit."""
    return NormalEquations.of(records, end.weights, end.jacobian, end.start_columns, end.deviations)


def loss_at(records: RecordsToFit, e: Real, deviations: Real, start: FittedStart) -> tuple[float, float]:
    """-log posterior density of a point, and the part of it that the prior of deviations and start is."""
    prior = 0.5 * (prior_cost(deviations) + records.prior_cost(start))
    return records.likelihood.loss(e) + prior, prior


def descend(
    records: RecordsToFit,
    candidates: Sequence[Candidate],
    deviations: Real,
    coordinates: Real,
    start: FittedStart,
    *,
    nominal_jacobian: Real | None = None,
    columns: StartColumns | None = None,
    iterations: int = 10,
    tolerance: float = 0.5,
    touching: bool = False,
    moved: npt.NDArray[np.bool_] | None = None,
) -> Fit:
    """Descend from a point; the Jacobian by the deviations and the start columns may be those of a point
    nearby, and are renewed on the way. touching: the latter feel contacts (`settled`). moved (P,): deviations
    that may change; None: all."""
    P, A = deviations.size, coordinates.size
    fixed = np.zeros(0, dtype=np.int64) if moved is None else np.flatnonzero(~moved)
    low, high = bounds_of(candidates)
    d, x = deviations.copy(), np.clip(coordinates, low, high)
    deviation_step, steps = steps_of(candidates)

    def left(d: Real, x: Real, start: FittedStart) -> Real:
        return records.coefficients(d, effects_at(candidates, x), start)

    e = left(d, x, start)
    loss, prior = loss_at(records, e, d, start)
    damping, converged = 1e-3, False
    by_effects = np.zeros((e.size, A))
    for iteration in range(iterations):
        if nominal_jacobian is None or (
            iteration % _AGAIN == _AGAIN - 1
            and _moved_on(nominal_jacobian, lambda d: left(d, x, start), d, e, deviation_step)  # noqa: B023
        ):
            step = np.full(P, deviation_step)
            nominal_jacobian = difference_quotients(lambda d: left(d, x, start), d, e, step)  # noqa: B023
        if columns is None or iteration == _AGAIN - 1:
            columns = records.start_columns(d, effects_at(candidates, x), start, touching=touching)
        if columns.zeros.shape[1] and any(c.kind.absolute_angle for c in candidates):
            columns = records.with_true_angles(columns, d, effects_at(candidates, x), start, e)
        by_effects = difference_quotients(lambda x: left(d, x, start), x, e, steps, high)  # noqa: B023
        jacobian = np.column_stack([nominal_jacobian, by_effects])
        normal = NormalEquations.of(records, records.likelihood.weights(e), jacobian, columns, d)
        H, g = normal.hessian, normal.gradient(start, e)
        held = ((x <= low) & (g[P : P + A] > 0)) | ((x >= high) & (g[P : P + A] < 0))
        free = np.setdiff1d(np.arange(g.size), np.concatenate([fixed, P + np.flatnonzero(held)]))
        reached = None
        for _ in range(7):
            damped = H + damping * np.diag(np.diag(H) + 1e-9)
            damped[range(P, P + A), range(P, P + A)] += 1e2 * damping
            step = np.zeros(g.size)
            step[free] = -solve_or_least_squares(damped[np.ix_(free, free)], g[free])
            d2 = records.nominal.clipped(d + np.clip(step[:P], -LARGEST_STEP, LARGEST_STEP))
            x2 = np.clip(x + np.clip(step[P : P + A], -LARGEST_STEP, LARGEST_STEP), low, high)
            start2 = columns.moved(start, step[P + A :])
            e2 = left(d2, x2, start2)
            loss2, prior2 = loss_at(records, e2, d2, start2)
            if loss2 < loss:
                reached = loss2
                break
            damping = max(6 * damping, 1e-4)
        if reached is None:
            converged = True
            break
        gain = loss - reached
        d, x, start, e, loss, prior = d2, x2, start2, e2, loss2, prior2
        damping *= 0.2
        if gain < tolerance:
            converged = True
            break
    assert nominal_jacobian is not None
    assert columns is not None
    jacobian = np.column_stack([nominal_jacobian, by_effects])
    weights = records.likelihood.weights(e)
    return Fit(tuple(candidates), d, x, start, e, weights, jacobian, columns, loss, prior, converged)


def _moved_on(jacobian: Real, function: Callable[[Real], Real], at: Real, start: Real, step: float) -> bool:
    """Whether derivatives (N, P) of a function (P,) -> (N,) are others at a point: along a direction of
    random signs in which every column counts alike, so that the difference is the mean of theirs."""
    sizes = np.linalg.norm(jacobian, axis=0)
    if at.size < _AGAIN or step != _STEP or not np.any(sizes):
        return True
    v = np.random.default_rng(0).choice([-1.0, 1.0], at.size) / np.maximum(sizes, 1e-2 * np.max(sizes))
    v *= step / np.max(np.abs(v))
    missed = function(at + v) - start - jacobian @ v
    return bool(np.linalg.norm(missed) > _AS_BEFORE * np.linalg.norm(v * sizes))


def steps_of(candidates: Sequence[Candidate]) -> tuple[float, Real]:
    """Of difference quotients: by every deviation, and along all coordinates (A,)."""
    coarse = _COARSE_STEP if non_smooth(candidates) else {}
    steps = [max(axis.step, coarse.get(axis.scale, _SMALLEST_STEP)) for c in candidates for axis in c.axes]
    return coarse.get("log", _STEP), np.array(steps)


def refine_sizes(records: RecordsToFit, end: Fit) -> Fit:
    """The end with the sizes on which the loss does not depend smoothly sought on grids around it, all else
    following, and descended from the best of each."""
    first = 0
    for candidate in end.candidates:
        for shifts in _NEAR if candidate.dependence == "non-smooth" else ():
            end = _sought(records, end, first, shifts)
        first += len(candidate.axes)
    return end


def scan_far_values(records: RecordsToFit, end: Fit) -> Fit:
    """The same over far values of all parameters on logarithmic scales: where contacts switch, the loss
    along any of them is jagged, and slopes lead no further than the next tooth."""
    for k, axis in enumerate(axis for c in end.candidates for axis in c.axes):
        if axis.scale == "log":
            end = _sought(records, end, k, _FAR)
    return end


def _sought(records: RecordsToFit, end: Fit, k: int, shifts: Real) -> Fit:
    """The best of the end and what is descended to from the best of some shifts of its k-th coordinate."""
    low, high = bounds_of(end.candidates)
    trials = []
    for shift in shifts:
        x = end.coordinates.copy()
        x[k] = np.clip(x[k] + shift, low[k], high[k])
        trials.append(x)
    loss, d, x = best_after_following(records, end, end.candidates, trials)
    if loss > end.loss + WORTH_IT:
        return end
    again = descend(
        records,
        end.candidates,
        d,
        x,
        end.start,
        nominal_jacobian=end.jacobian[:, : d.size],
        columns=end.start_columns,
        iterations=5,
    )
    return min(end, again, key=lambda one: one.loss)


def best_after_following(
    records: RecordsToFit, around: Fit, candidates: Sequence[Candidate], trials: Sequence[Real]
) -> tuple[float, Real, Real]:
    """The best of some coordinates of the candidates once all else has followed (`follow`): loss,
    deviations, coordinates."""
    followed = []
    for x in trials:
        e = records.coefficients(around.deviations, effects_at(candidates, x), around.start)
        followed.append((*follow_linearly(records, around, e, around.start), x))
    return min(followed, key=lambda trial: trial[0])


def follow_linearly(records: RecordsToFit, around: Fit, e: Real, start: FittedStart) -> tuple[float, Real]:
    """What the loss of coefficients e (N,) becomes, and where the deviations go, once everything that
    `around` holds has followed linearly."""
    P, normal = around.deviations.size, around.normal_equations(records)
    H = normal.hessian + np.diag(1e-9 * np.diag(normal.hessian) + 1e-12)
    step = -solve_or_least_squares(H, normal.gradient(start, e))
    step[:P] = np.clip(step[:P], -LARGEST_STEP, LARGEST_STEP)
    moved = (
        e
        + np.column_stack([around.jacobian, around.start_columns.zeros]) @ step[: -start.states.size or None]
    )
    d, start2 = (
        around.deviations + step[:P],
        around.start_columns.moved(start, step[around.jacobian.shape[1] :]),
    )
    S, first = start.states.shape[1], step.size - start.states.size
    for r, (part, own) in enumerate(zip(records.record_slices, around.start_columns.states, strict=True)):
        moved[part] += own @ step[first + r * S : first + (r + 1) * S]
    loss, _ = loss_at(records, moved, d, start2)
    return loss, records.nominal.clipped(d)


def log_occam_factor(records: RecordsToFit, end: Fit) -> float:
    """log of the prior density of the effects' coordinates times the volume that the records leave them and
    the deviations, whatever the starts and zeros are.

    Those have no volume here: their spread only says that a record may begin anywhere, and a model is not
    less likely because its motion feels more of how it began.
    """
    # What the records say nothing about keeps the width of its range.
    low, high = bounds_of(end.candidates)
    width = np.where(np.isfinite(high - low), high - low, 2 * np.pi)
    precision, P = end.precision(records), end.deviations.size
    rows = range(P, P + width.size)
    precision[rows, rows] += 12 / width**2
    scale = np.sqrt(np.diag(precision) + 1e-12)
    scaled = precision / np.outer(scale, scale) + 1e-10 * np.eye(scale.size)
    logdet = np.linalg.slogdet(scaled)[1] + 2 * float(np.sum(np.log(scale)))
    density = sum(c.log_density(end.coordinates_of(k)) for k, c in enumerate(end.candidates))
    return float(density - 0.5 * logdet + 0.5 * end.coordinates.size * np.log(2 * np.pi))
