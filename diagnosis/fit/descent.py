"""Maximum a posteriori fit of deviations, effects, starts and zeros under levels that the residuals show.

Levenberg-Marquardt on the reweighted squares: `Likelihood.weights` of the present residuals majorise the
concave likelihood, so that a step that lowers the weighted squares lowers the loss (iteratively reweighted
least squares). Derivatives by difference quotients; those by starts from the linear part of the machine.

Letters of the shapes: N coefficients of R records with T samples of Y outputs each; P deviations of nominal
values, A coordinates of all candidates in a row, Z zeros of sensors, S states at the start of a record. M is
P + A + Z + R S, the unknowns in that order.

Steps, dampings and limits only say how an end is reached: each step and limit doubled changed what is left of
six cases by 0.6 % at most (`python -m benchmarks.frozen_answers --change`).
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

# Step of difference quotients by a deviation, in tolerances: a thousandth of what a stated value may be off.
_DEVIATION_STEP = 1e-3
# Smallest step of difference quotients by a coordinate of an effect, which is known far better where nothing
# but noise is left.
_SMALLEST_STEP = 1e-4
# Steps by the scale of a coordinate where contacts switch; deviations as logarithms. The loss is jagged below
# them, and how one contact fell says nothing of where the others lead.
_COARSE_STEP = {"log": 0.1, "angle": 0.1, "linear": 0.0125}
# Largest change of a coordinate or deviation in one iteration: beyond it a linearisation holds no further.
LARGEST_STEP = 2.0
# Reaches of the grids around a size on which the loss does not depend smoothly, in its logarithm: 10 %, which
# is more than one step above, then 3 %.
_NEAR_REACHES = (0.1, 0.03)
# Points of such a grid: one in the middle, four on each side.
_NEAR_POINTS = 9
# Changes of the logarithm of a parameter that a scan tries where contacts switch: 8 % to a factor of 20, each
# two or three times the last.
_FAR_CHANGES = np.array([-3.0, -2.0, -1.2, -0.6, -0.25, -0.08, 0.08, 0.25, 0.6, 1.2, 2.0, 3.0])
# Options of `descend` that lead to an end, along flat valleys too: four times the usual iterations, and a
# gain that is a hundredth of what `SUBSTANTIAL` asks of a difference between sets.
FINE: dict[str, Any] = {"iterations": 40, "tolerance": 0.02}
# Iterations after which the Jacobian by the deviations, of the nominal or of a point nearby, is looked at
# again, and the number of deviations from which on that is worth a simulation.
_RENEWED_EVERY = 3
# It is renewed where one simulation along all deviations together differs from it by more than this share.
_UNCHANGED_SHARE = 0.03
# Smallest column of that direction, over the largest: a deviation that does nothing would move far.
_SMALLEST_COLUMN = 1e-2
# Damping of the first step: next to none.
_FIRST_DAMPING = 1e-3
# Smallest damping after a step that failed.
_SMALLEST_DAMPING = 1e-4
# Factor of the damping after a step that failed; chosen with the next one.
_DAMPING_UP = 6.0
# Factor after a good one: a failed step takes back a little more than one good step has given, 6 times 0.2.
_DAMPING_DOWN = 0.2
# Added to the diagonal of the Hessian before it is damped, so that no unknown is without damping.
_DAMPED_CURVATURE = 1e-9
# Damping of coordinates and deviations in their own units, over that in proportion to the Hessian: without it
# values that the records hardly determine run along the curved valley.
_UNIT_DAMPING = 1e2
# Steps tried in an iteration; after so many the damping is 6^6 times as large, and the point is a minimum.
_MOST_TRIALS = 7
# Iterations of a descent from a point of a grid that is already near its end.
_NEAR_ITERATIONS = 5
# Added to the diagonal of a Hessian that is solved without damping, relative to it: far above rounding.
_RIDGE = 1e-9
# Added to such a diagonal, absolute, where an unknown changes nothing at all.
_SMALLEST_CURVATURE = 1e-12
# Added to a Hessian that is scaled to a diagonal of one: only rounding is smaller.
_SCALED_RIDGE = 1e-10
# Precision of a uniform density times its width squared.
_UNIFORM_PRECISION = 12.0


@dataclass(frozen=True, eq=False)
class Fit:
    """End of a descent.

    Attributes
    ----------
    candidates : tuple of Candidate
        Effects that were fitted, in the order in which they were added.
    deviations : (P,) array
        Nominal values, in tolerances off.
    coordinates : (A,) array
        Of all candidates in a row.
    start : FittedStart
        Of all records.
    residual_coefficients : (N,) array
        Coefficients of what is left, as the likelihood sees them.
    weights : (N,) array
        Of these, from `Likelihood.weights`.
    jacobian : (N, P + A) array
        Derivatives of the coefficients by deviations and coordinates; perhaps those of a point nearby.
    start_columns : StartColumns
        Derivatives of the coefficients by the start.
    loss : float
        -log posterior density, up to a constant of the records.
    prior_loss : float
        The part of it that deviations and start pay.
    converged : bool
        Whether the last step gained less than the tolerance, or none was found that gains.
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
        """Names of the effects, in the order of the candidates."""
        return tuple(candidate.effect for candidate in self.candidates)

    @property
    def effects(self) -> tuple[Any, ...]:
        """Effects with their fitted sizes, in the order of the candidates."""
        return effects_at(self.candidates, self.coordinates)

    def coordinates_of(self, k: int) -> Real:
        """(A_k,) coordinates of the k-th candidate."""
        first = sum(len(candidate.axes) for candidate in self.candidates[:k])
        return self.coordinates[first : first + len(self.candidates[k].axes)]

    def unknowns_of(self, k: int) -> slice:
        """Where the coordinates of the k-th candidate stand among the unknowns (P + A)."""
        first = self.deviations.size + sum(len(candidate.axes) for candidate in self.candidates[:k])
        return slice(first, first + len(self.candidates[k].axes))

    @property
    def non_smooth(self) -> bool:
        """Whether contacts switch in any effect."""
        return non_smooth(self.candidates)

    @property
    def cost(self) -> float:
        """Twice the loss: under white noise |e|^2 + |d|^2."""
        return 2 * self.loss

    @property
    def rms(self) -> float:
        """Root mean square of the coefficients left, in noise deviations where the noise is known."""
        return float(np.sqrt(np.mean(self.residual_coefficients**2)))

    @property
    def hessian(self) -> Real:
        """(P + A, P + A) Gauss-Newton Hessian by deviations and coordinates, starts and zeros held."""
        P = self.deviations.size
        hessian = self.jacobian.T @ (self.weights[:, None] * self.jacobian)
        hessian[range(P), range(P)] += prior_curvature(self.deviations)
        return np.asarray(hessian)

    def normal_equations(self, records: RecordsToFit) -> NormalEquations:
        """Normal equations of the linearisation at the end; the last few are kept."""
        return _normal_equations_at(self, records)

    def continued(self, records: RecordsToFit, start: FittedStart | None = None, **settings: Any) -> Fit:
        """The end of a further descent from here, from another start where one is given.

        Settings are the keyword arguments of `descend`.
        """
        if start is None:
            start = self.start
        return descend(records, self.candidates, self.deviations, self.coordinates, start, **settings)

    def precision(self, records: RecordsToFit) -> Real:
        """(P + A, P + A) inverse covariance of deviations and coordinates, whatever starts and zeros are.

        The Schur complement of the Hessian by all unknowns.
        """
        hessian = self.normal_equations(records).hessian
        n = self.jacobian.shape[1]
        of_starts = np.linalg.pinv(hessian[n:, n:], hermitian=True)
        return np.asarray(hessian[:n, :n] - hessian[:n, n:] @ of_starts @ hessian[n:, :n])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of the weighted squares with their priors, by all M unknowns.

    Attributes
    ----------
    records : RecordsToFit
        Records that were linearised.
    deviations : (P,) array
        Where they were.
    shared : (N, P + A + Z) array
        Derivatives by deviations, coordinates and zeros.
    weighted_shared : (N, P + A + Z) array
        These times the weights.
    weighted_states : tuple of (T Y, S) arrays
        Derivatives by the states of every record, times the weights.
    hessian : (M, M) array
        States of different records have no mixed entries.
    """

    records: RecordsToFit
    deviations: Real
    shared: Real
    weighted_shared: Real
    weighted_states: tuple[Real, ...]
    hessian: Real

    @classmethod
    def of(
        cls, records: RecordsToFit, weights: Real, jacobian: Real, columns: StartColumns, deviations: Real
    ) -> NormalEquations:
        """Normal equations of a linearisation.

        Parameters
        ----------
        records : RecordsToFit
            Gives the priors of starts and zeros.
        weights : (N,) array
            Of the coefficients.
        jacobian : (N, P + A) array
            By deviations and coordinates.
        columns : StartColumns
            By zeros and states.
        deviations : (P,) array
            Where the prior is linearised.
        """
        shared = np.column_stack([jacobian, columns.zeros])
        weighted_shared = shared * weights[:, None]
        weighted_states = []
        P = deviations.size
        n_shared = shared.shape[1]
        n_states = records.state_spread.size
        M = n_shared + len(records.record_slices) * n_states
        hessian = np.zeros((M, M))
        hessian[:n_shared, :n_shared] = shared.T @ weighted_shared
        for r, part in enumerate(records.record_slices):
            by_states = columns.states[r]
            weighted = by_states * weights[part, None]
            weighted_states.append(weighted)
            rows = slice(n_shared + r * n_states, n_shared + (r + 1) * n_states)
            hessian[rows, rows] = by_states.T @ weighted + np.diag(1 / records.state_spread**2)
            hessian[:n_shared, rows] = weighted_shared[part].T @ by_states
            hessian[rows, :n_shared] = hessian[:n_shared, rows].T
        hessian[range(P), range(P)] += prior_curvature(deviations)
        zeros = range(jacobian.shape[1], n_shared)
        hessian[zeros, zeros] += 1 / records.zero_spread**2
        return cls(records, deviations, shared, weighted_shared, tuple(weighted_states), hessian)

    def gradient(self, start: FittedStart, e: Real) -> Real:
        """(M,) gradient of the loss where coefficients e (N,) are left from a start."""
        records = self.records
        shared = self.weighted_shared.T @ e
        n_zeros = start.zeros.size
        shared[: self.deviations.size] += prior_slope(self.deviations)
        shared[shared.size - n_zeros :] += start.zeros / records.zero_spread**2
        by_states = []
        for r, part in enumerate(records.record_slices):
            prior = start.states[r] / records.state_spread**2
            by_states.append(self.weighted_states[r].T @ e[part] + prior)
        return np.concatenate([shared, *by_states])


@lru_cache(maxsize=2)
def _normal_equations_at(fit: Fit, records: RecordsToFit) -> NormalEquations:
    """Normal equations of a fit, made once for all that is tried beside it."""
    return NormalEquations.of(records, fit.weights, fit.jacobian, fit.start_columns, fit.deviations)


def loss_at(records: RecordsToFit, e: Real, deviations: Real, start: FittedStart) -> tuple[float, float]:
    """-log posterior density where coefficients e (N,) are left, and the part of it that the prior of
    deviations (P,) and start is."""
    prior_loss = 0.5 * (prior_cost(deviations) + records.prior_cost(start))
    return records.likelihood.loss(e) + prior_loss, prior_loss


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
    """Descend from a point.

    Parameters
    ----------
    records : RecordsToFit
        Simulates A times an iteration and once for every step that is tried; P times more where derivatives
        by the nominal values are made anew (at first unless given, then where they have changed).
    candidates : sequence of Candidate
        Effects to be fitted.
    deviations : (P,) array
        Nominal values to begin with, in tolerances off.
    coordinates : (A,) array
        Of all candidates in a row; brought inside their bounds.
    start : FittedStart
        Of all records.
    nominal_jacobian : (N, P) array, optional
        Derivatives by the deviations at a point nearby; renewed on the way where they have changed.
    columns : StartColumns, optional
        Derivatives by the start at a point nearby; renewed once on the way.
    iterations : int
        At most, at least 1. Ten reach the neighbourhood of an end, which is what sets are ranked by; `FINE`
        goes to the end.
    tolerance : float
        A gain of the loss below it ends the descent. Half a nat is a fourth of what `SUBSTANTIAL` asks of a
        difference between sets.
    touching : bool
        Starts feel contacts (`RecordsToFit.start_columns`).
    moved : (P,) bool array, optional
        Deviations that may change; by default all.

    Returns
    -------
    Fit
        Its loss is never larger than that at the point.
    """
    P = deviations.size
    A = coordinates.size
    fixed = np.zeros(0, dtype=np.int64)
    if moved is not None:
        fixed = np.flatnonzero(~moved)
    low, high = bounds_of(candidates)
    d = deviations.copy()
    x = np.clip(coordinates, low, high)
    deviation_step, steps = steps_of(candidates)
    has_absolute_angle = any(candidate.kind.absolute_angle for candidate in candidates)

    def coefficients(d: Real, x: Real, start: FittedStart) -> Real:
        return records.coefficients(d, effects_at(candidates, x), start)

    e = coefficients(d, x, start)
    loss, prior_loss = loss_at(records, e, d, start)
    damping = _FIRST_DAMPING
    converged = False
    by_effects = np.zeros((e.size, A))
    for iteration in range(iterations):
        # Linearise. Derivatives by nominal values and starts change little on the way, those by the effects
        # do.
        def by_deviations(d: Real, x: Real = x, start: FittedStart = start) -> Real:
            return coefficients(d, x, start)

        def by_coordinates(x: Real, d: Real = d, start: FittedStart = start) -> Real:
            return coefficients(d, x, start)

        is_due = iteration % _RENEWED_EVERY == _RENEWED_EVERY - 1
        if nominal_jacobian is None or (
            is_due and _has_changed(nominal_jacobian, by_deviations, d, e, deviation_step)
        ):
            nominal_jacobian = difference_quotients(by_deviations, d, e, np.full(P, deviation_step))
        if columns is None or iteration == _RENEWED_EVERY - 1:
            columns = records.start_columns(d, effects_at(candidates, x), start, touching=touching)
        if columns.zeros.shape[1] and has_absolute_angle:
            columns = records.with_true_angles(columns, d, effects_at(candidates, x), start, e)
        by_effects = difference_quotients(by_coordinates, x, e, steps, high)
        jacobian = np.column_stack([nominal_jacobian, by_effects])
        normal = NormalEquations.of(records, records.likelihood.weights(e), jacobian, columns, d)
        hessian = normal.hessian
        gradient = normal.gradient(start, e)

        # A coordinate at a bound whose slope leads out of it stays there.
        slope = gradient[P : P + A]
        is_held = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        unmoved = np.concatenate([fixed, P + np.flatnonzero(is_held)])
        free = np.setdiff1d(np.arange(gradient.size), unmoved)

        # Steps with ever more damping until one lowers the loss.
        reached = None
        for _ in range(_MOST_TRIALS):
            damped = hessian + damping * np.diag(np.diag(hessian) + _DAMPED_CURVATURE)
            damped[range(P, P + A), range(P, P + A)] += _UNIT_DAMPING * damping
            step = np.zeros(gradient.size)
            step[free] = -solve_or_least_squares(damped[np.ix_(free, free)], gradient[free])
            next_d = records.nominal.clipped(d + np.clip(step[:P], -LARGEST_STEP, LARGEST_STEP))
            next_x = np.clip(x + np.clip(step[P : P + A], -LARGEST_STEP, LARGEST_STEP), low, high)
            next_start = columns.moved(start, step[P + A :])
            next_e = coefficients(next_d, next_x, next_start)
            next_loss, next_prior_loss = loss_at(records, next_e, next_d, next_start)
            if next_loss < loss:
                reached = next_loss
                break
            damping = max(_DAMPING_UP * damping, _SMALLEST_DAMPING)
        if reached is None:
            converged = True
            break

        gain = loss - reached
        d = next_d
        x = next_x
        start = next_start
        e = next_e
        loss = next_loss
        prior_loss = next_prior_loss
        damping *= _DAMPING_DOWN
        if gain < tolerance:
            converged = True
            break
    assert nominal_jacobian is not None
    assert columns is not None
    return Fit(
        candidates=tuple(candidates),
        deviations=d,
        coordinates=x,
        start=start,
        residual_coefficients=e,
        weights=records.likelihood.weights(e),
        jacobian=np.column_stack([nominal_jacobian, by_effects]),
        start_columns=columns,
        loss=loss,
        prior_loss=prior_loss,
        converged=converged,
    )


def _has_changed(
    jacobian: Real, function: Callable[[Real], Real], point: Real, value: Real, step: float
) -> bool:
    """Whether derivatives (N, P) of a function (P,) -> (N,) are others at a point, where it has a value (N,).

    Seen by one call along a direction of random signs in which every column counts alike, so that the
    difference is the mean of theirs. True without a call where there are few columns, where contacts switch
    (another step), and where nothing depends on any of them.
    """
    sizes = np.linalg.norm(jacobian, axis=0)
    if point.size < _RENEWED_EVERY or step != _DEVIATION_STEP or not np.any(sizes):
        return True
    signs = np.random.default_rng(0).choice([-1.0, 1.0], point.size)
    direction = signs / np.maximum(sizes, _SMALLEST_COLUMN * np.max(sizes))
    direction *= step / np.max(np.abs(direction))
    missed = function(point + direction) - value - jacobian @ direction
    return bool(np.linalg.norm(missed) > _UNCHANGED_SHARE * np.linalg.norm(direction * sizes))


def steps_of(candidates: Sequence[Candidate]) -> tuple[float, Real]:
    """Steps of difference quotients: by every deviation, and along all coordinates (A,)."""
    coarse = _COARSE_STEP if non_smooth(candidates) else {}
    steps = []
    for candidate in candidates:
        for axis in candidate.axes:
            steps.append(max(axis.step, coarse.get(axis.scale, _SMALLEST_STEP)))
    return coarse.get("log", _DEVIATION_STEP), np.array(steps)


def refine_sizes(records: RecordsToFit, fit: Fit) -> Fit:
    """The fit with the sizes on which the loss does not depend smoothly sought on grids around it.

    All else follows linearly, and is descended from the best point of each grid; a fit without contacts is
    given back as it is.
    """
    size_place = 0
    for candidate in fit.candidates:
        if candidate.dependence == "non-smooth":
            for reach in _NEAR_REACHES:
                changes = np.linspace(-reach, reach, _NEAR_POINTS)
                fit = _best_along(records, fit, size_place, changes)
        size_place += len(candidate.axes)
    return fit


def scan_far_values(records: RecordsToFit, fit: Fit) -> Fit:
    """The fit with every parameter on a logarithmic scale sought at far values, one after the other.

    Where contacts switch, the loss along any of them is jagged, and slopes lead no further than the next
    tooth.
    """
    axes = [axis for candidate in fit.candidates for axis in candidate.axes]
    for place, axis in enumerate(axes):
        if axis.scale == "log":
            fit = _best_along(records, fit, place, _FAR_CHANGES)
    return fit


def _best_along(records: RecordsToFit, fit: Fit, place: int, changes: Real) -> Fit:
    """The better of the fit and what is descended to from the best of some changes of one coordinate."""
    low, high = bounds_of(fit.candidates)
    trials = []
    for change in changes:
        x = fit.coordinates.copy()
        x[place] = np.clip(x[place] + change, low[place], high[place])
        trials.append(x)
    loss, d, x = best_after_following(records, fit, fit.candidates, trials)
    if loss > fit.loss + WORTH_IT:
        return fit
    descended = descend(
        records,
        fit.candidates,
        d,
        x,
        fit.start,
        nominal_jacobian=fit.jacobian[:, : d.size],
        columns=fit.start_columns,
        iterations=_NEAR_ITERATIONS,
    )
    return min(fit, descended, key=lambda fit: fit.loss)


def best_after_following(
    records: RecordsToFit, around: Fit, candidates: Sequence[Candidate], trials: Sequence[Real]
) -> tuple[float, Real, Real]:
    """The best of some coordinates of candidates once all else has followed.

    Parameters
    ----------
    records : RecordsToFit
        Simulates once for every trial.
    around : Fit
        Its nominal values and starts are those of the trials, and follow linearly.
    candidates : sequence of Candidate
        Effects in the place of those of the fit.
    trials : sequence of (A,) arrays
        At least one.

    Returns
    -------
    float, (P,) array, (A,) array
        Loss, deviations and coordinates of the best.
    """
    followed = []
    for x in trials:
        e = records.coefficients(around.deviations, effects_at(candidates, x), around.start)
        loss, deviations = follow_linearly(records, around, e, around.start)
        followed.append((loss, deviations, x))
    return min(followed, key=lambda trial: trial[0])


def follow_linearly(records: RecordsToFit, around: Fit, e: Real, start: FittedStart) -> tuple[float, Real]:
    """What a loss becomes once everything that a fit holds has followed linearly, and where deviations go.

    Parameters
    ----------
    records : RecordsToFit
        Not simulated.
    around : Fit
        Its linearisation is taken, and its deviations are where the step begins.
    e : (N,) array
        Coefficients left beside the fit once something else has changed.
    start : FittedStart
        From which they are left.

    Returns
    -------
    float, (P,) array
        Loss of the linearised coefficients, and deviations inside their limits.
    """
    P = around.deviations.size
    n_columns = around.jacobian.shape[1]
    n_states = start.states.shape[1]
    normal = around.normal_equations(records)
    ridge = np.diag(_RIDGE * np.diag(normal.hessian) + _SMALLEST_CURVATURE)
    step = -solve_or_least_squares(normal.hessian + ridge, normal.gradient(start, e))
    step[:P] = np.clip(step[:P], -LARGEST_STEP, LARGEST_STEP)

    first_state = step.size - start.states.size
    followed = e + normal.shared @ step[:first_state]
    for r, part in enumerate(records.record_slices):
        rows = slice(first_state + r * n_states, first_state + (r + 1) * n_states)
        followed[part] += around.start_columns.states[r] @ step[rows]

    d = around.deviations + step[:P]
    moved_start = around.start_columns.moved(start, step[n_columns:])
    loss, _ = loss_at(records, followed, d, moved_start)
    return loss, records.nominal.clipped(d)


def log_occam_factor(records: RecordsToFit, fit: Fit) -> float:
    """log of the prior density of the effects' coordinates times the volume that the records leave them.

    That is the volume of coordinates and deviations, whatever the starts and zeros are. Those have no volume
    here: their spread only says that a record may begin anywhere, and a model is not less likely because its
    motion feels more of how it began.
    """
    low, high = bounds_of(fit.candidates)
    # What the records say nothing about keeps the width of its range; an angle has a turn.
    width = np.where(np.isfinite(high - low), high - low, 2 * np.pi)
    precision = fit.precision(records)
    P = fit.deviations.size
    rows = range(P, P + width.size)
    precision[rows, rows] += _UNIFORM_PRECISION / width**2
    scale = np.sqrt(np.diag(precision) + _SMALLEST_CURVATURE)
    scaled = precision / np.outer(scale, scale) + _SCALED_RIDGE * np.eye(scale.size)
    log_determinant = np.linalg.slogdet(scaled)[1] + 2 * float(np.sum(np.log(scale)))
    log_density = sum(c.log_density(fit.coordinates_of(k)) for k, c in enumerate(fit.candidates))
    return float(log_density - 0.5 * log_determinant + 0.5 * fit.coordinates.size * np.log(2 * np.pi))
