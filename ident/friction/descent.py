"""A fit of friction in a loop brought to its optimum: least prediction errors of an observer.

The prediction errors of the observer are those of the whole nonlinear arm, so that arm, friction and noise
are one least-squares problem (the prediction-error method: Ljung, System Identification, 2nd ed., chapter 7).
`converged` solves it by Levenberg-Marquardt steps (Madsen, Nielsen and Tingleff, Methods for Non-Linear Least
Squares Problems, 2004), until what is left of the way is a small share of what noise leaves open. Where steps
end does then not hinge on where they began, nor on the last digit of the log.

Derivatives are secants, each over about one standard deviation of its parameter. Friction turns at other
times after a change, which makes the errors rough at a smaller scale; at that of the noise they are smooth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ident.basis.options import IdentOptions
from ident.data.arrays import BoolArray, RealArray
from ident.friction.arm import SteppedArm
from ident.friction.gauss_newton import STD_LOG, FrictionFit, LostError
from ident.friction.logs import LoopLogs
from ident.friction.observer import observed
from ident.friction.parameters import (
    LEAST_LAG_SAMPLES,
    NOT_NEGATIVE,
    FrictionParameters,
    has_least_damping,
)
from ident.uncertainty.embedding_algebra import triangle_of

# Times that derivatives are taken, at most. Chosen: from inverse dynamics five are usual, from a fit nearby
# two; twice as many change no test.
_MOST_DERIVATIVES = 12
# Times that derivatives are taken before steps are given up (`to_beat`): the first ones are those of a start.
_BEFORE_GIVING_UP = 2
# Steps on the same derivatives, at most: derivatives take as long as all parameters have runs. Chosen.
_STEPS_ON_DERIVATIVES = 4
# Way that is left at the end, squared, in standard deviations that noise leaves open (Newton's decrement): a
# third of one over all parameters together, which moves none of them by a tenth of its interval.
_WAY_LEFT = 0.1
# Fall of the sum of squares that ends the steps too, in noise variances: as far as rounding of the kernel's
# steps moves it.
_LEAST_FALL = 0.05
# Damping of the first step, in units of the squared lengths of the derivatives. Chosen, as the factors below:
# Madsen's for a start that is not far away.
_FIRST_DAMPING = 1e-3
# A step that fails is tried again with so many times the damping, and one that helps is followed by as much
# less.
_DAMPING_FACTOR = 10.0
# Largest damping: a step that fails with it would be rounding.
_MOST_DAMPING = 1e3
# Least damping, which only keeps the factor from becoming zero.
_LEAST_DAMPING = 1e-9
# Largest step of a logarithm (a factor of e) and of the drive's lag (a sample): the linearised law holds no
# further.
_LARGEST_LOG_STEP = 1.0
# Largest step of a level, as a share of all friction: the inverse dynamics that it begins with are right to a
# third.
_LARGEST_LEVEL_STEP = 0.3
# The same in units of the smallest level, so that a level of nearly nothing can grow. Chosen.
_LARGEST_STEP_OF_LEAST = 10
# Changes from which the first derivatives are taken, later ones are standard deviations: of logarithms and of
# the lag, samples,
_CHANGE_OF_LOG = 0.02
# of levels, as a share of the friction,
_CHANGE_OF_LEVEL = 2e-3
# of responses, relative to those of the start. All three chosen.
_CHANGE_OF_RESPONSE = 1e-3
# Factor by which a change grows or shrinks at most from one set of derivatives to the next. Chosen.
_CHANGE_GROWS = 10.0
# Parts that are levels of a force.
_LEVELS = ("coulomb_level", "level_at_load", "stribeck_excess", "bias")
# Part in which the prediction errors are rough: a shaft sticks and slips at other times. A wrong step of it
# would damp those of all others.
_ROUGH = "log_presliding"
# Directions whose derivatives are below this share of the largest tell nothing. Rounding of doubles.
_RANK = 1e-12


@dataclass(frozen=True, eq=False)
class ConvergedFit:
    """A fit at its optimum.

    Attributes
    ----------
    fit : FrictionFit
        With an observer; its arm has each pole once.
    errors : float
        Sum of squares of its prediction errors, output units squared.
    n_rows : int
        Number of these errors.
    n_parameters : int
    level_std : float
        Standard deviation of the friction's level on both sides of a spring, units of the input.
    has_empty_part : bool
        A Stribeck excess, a lag or a friction at the load has come out as nothing, or a Stribeck speed or a
        pair's damping as the limit at which it is none: without it about the same errors cost a parameter
        less.
    is_converged : bool
        The way that is left is small; otherwise the steps were given up, or were too few.
    """

    fit: FrictionFit
    errors: float
    n_rows: int
    n_parameters: int
    level_std: float
    has_empty_part: bool
    is_converged: bool

    @property
    def criterion(self) -> float:
        """Bayesian information criterion of the fit (`information_criterion`); least is best."""
        return information_criterion(self.errors, self.n_rows, self.n_parameters)

    @property
    def significant(self) -> bool:
        """The level is more than three of its standard deviations above zero."""
        return self.fit.level > 3 * self.level_std


def information_criterion(errors: float, n_rows: int, n_parameters: int) -> float:
    """Bayesian information criterion, n log(errors / n) + parameters log(n): least is best.

    `errors` : sum of squares of `n_rows` prediction errors, above zero. Schwarz, Annals of Statistics 6(2),
    1978.
    """
    return float(n_rows * np.log(errors / n_rows) + n_parameters * np.log(n_rows))


def converged(
    fit: FrictionFit,
    logs: LoopLogs,
    options: IdentOptions,
    *,
    most_derivatives: int = _MOST_DERIVATIVES,
    to_beat: float = np.inf,
) -> ConvergedFit:
    """A fit with all of its parameters where its prediction errors are least.

    Parameters
    ----------
    fit : FrictionFit
        Where the steps begin; its arm has each pole once. Without an observer the one is taken that predicts
        best.
    logs : LoopLogs
    options : IdentOptions
        With the limits of the poles.
    most_derivatives : int
        Times that derivatives are taken, at most.
    to_beat : float
        Criterion of another structure. Steps are given up where not even the linearised optimum is below it.

    Returns
    -------
    ConvergedFit

    Raises
    ------
    LostError
        No observer follows the logs.
    """
    if fit.correction is None:
        fit = observed(fit, logs.records)
    problem = _Problem.of(fit, logs, options)
    point = _Point(fit, problem.parameters.pack(), logs.prediction_errors(fit))
    if not np.all(np.isfinite(point.errors)):
        raise LostError

    n_rows = point.errors.size
    n_parameters = point.vector.size
    changes = problem.first_changes(fit)
    damping = _FIRST_DAMPING
    is_converged = False
    for times_taken in range(most_derivatives):
        # Some steps on the same derivatives, which are corrected by what each step shows.
        derivatives = problem.secants(point, changes)
        fell_in_all = 0.0
        for step_number in range(_STEPS_ON_DERIVATIVES):
            equations = problem.equations(point, derivatives)
            moves, way_left = problem.free_parameters(point, equations)
            if way_left < _WAY_LEFT:
                is_converged = True
                break
            has_fresh_derivatives = step_number == 0
            if has_fresh_derivatives and times_taken >= _BEFORE_GIVING_UP:
                # The linearised fall is more than most steps reach.
                least = max(n_rows - way_left, 1.0) / n_rows * float(point.errors @ point.errors)
                if information_criterion(least, n_rows, n_parameters) > to_beat:
                    break

            # Shorter steps, ever more along the steepest descent, until one predicts better. Where corrected
            # derivatives fail at once, new ones are taken.
            trial = None
            while trial is None and damping <= _MOST_DAMPING:
                trial = problem.trial(point, equations, moves, damping)
                if trial is None and not has_fresh_derivatives:
                    break
                if trial is None:
                    damping = damping * _DAMPING_FACTOR
            if trial is None:
                break
            fell_in_all += equations.cost - problem.cost(trial, equations.noise)
            derivatives = _corrected(derivatives, point, trial, equations.lengths)
            point = trial
            damping = max(damping / _DAMPING_FACTOR, _LEAST_DAMPING)

        # Nothing falls any more: at the optimum as far as rounding lets it be seen, or given up.
        if fell_in_all < _LEAST_FALL:
            is_converged = is_converged or damping > _MOST_DAMPING or fell_in_all > 0
            break
        changes = np.clip(1 / equations.lengths, changes / _CHANGE_GROWS, changes * _CHANGE_GROWS)

    factor = np.linalg.pinv(equations.triangle[:-1, :-1], rcond=_RANK) / equations.lengths[:, None]
    is_level = np.isin(problem.names, ("coulomb_level", "level_at_load"))
    nothing = np.where(problem.names == "drive_lag_samples", LEAST_LAG_SAMPLES, 0.0)
    is_empty = np.isin(problem.names, NOT_NEGATIVE) & (point.vector <= nothing)
    # Friction that falls over all speeds of the logs is less viscous friction.
    is_empty |= (problem.names == "log_stribeck_speed") & (point.vector >= problem.highest)
    is_damping = problem.names == "log_dampings"
    is_empty[is_damping] = has_least_damping(np.exp(point.vector[is_damping]), options)
    return ConvergedFit(
        fit=point.fit,
        errors=float(point.errors @ point.errors),
        n_rows=n_rows,
        n_parameters=n_parameters,
        level_std=float(np.linalg.norm(factor[is_level].sum(axis=0))),
        has_empty_part=bool(np.any(is_empty)),
        is_converged=is_converged,
    )


class _Point(NamedTuple):
    """A fit, its parameters as a vector (N,), and its prediction errors (T,), output units."""

    fit: FrictionFit
    vector: RealArray
    errors: RealArray


class _Equations(NamedTuple):
    """Equations of a step, in noise deviations, their columns at unit length.

    triangle (N + 1, N + 1): R of the equations, the last column what a step is to take away; lengths (N,): of
    the columns before; cost: sum of squares of the last column; noise: its unit, output units.
    """

    triangle: RealArray
    lengths: RealArray
    cost: float
    noise: float


@dataclass(frozen=True, eq=False)
class _Problem:
    """Least squares of the prediction errors of a structure over its N parameters.

    parameters: of the start; names (N,); lowest and highest (N,) values; expected (N,) values, each known
    beforehand to a deviation known_std (N,), inf where nothing is known.
    """

    logs: LoopLogs
    parameters: FrictionParameters
    names: NDArray[np.str_]
    lowest: RealArray
    highest: RealArray
    expected: RealArray
    known_std: RealArray

    @classmethod
    def of(cls, fit: FrictionFit, logs: LoopLogs, options: IdentOptions) -> _Problem:
        """The problem of a fit's structure on logs, poles limited by options."""
        parameters = FrictionParameters.of(fit)
        names = np.array(parameters.names)
        lowest, highest = parameters.limits(
            options,
            least_level=logs.least_level,
            largest_ratio=logs.largest_ratio,
            largest_fall=logs.rms_speed,
            dt_s=logs.dt_s,
        )
        # Known beforehand: logarithms of the law to their deviation, a bias within the command's rms.
        expected = parameters.pack()
        expected[names == "log_presliding"] = np.log(logs.presliding)
        expected[names == "bias"] = 0.0
        known_std = np.full(names.size, np.inf)
        known_std[np.isin(names, ("log_presliding", "log_stribeck_speed"))] = STD_LOG
        known_std[names == "bias"] = logs.input_rms
        return cls(logs, parameters, names, lowest, highest, expected, known_std)

    def first_changes(self, fit: FrictionFit) -> RealArray:
        """Changes (N,) from which the first derivatives are taken, in the units of the parameters."""
        changes = np.full(self.names.size, _CHANGE_OF_LOG)
        changes[np.isin(self.names, _LEVELS)] = _CHANGE_OF_LEVEL * fit.level
        changes[self.names == "responses"] = _CHANGE_OF_RESPONSE
        return changes

    def secants(self, point: _Point, changes: RealArray) -> RealArray:
        """Derivatives (T, N) of the prediction errors, each over a change (N,) that stays within the limits.

        Raises LostError where one is not finite.
        """
        derivatives = np.empty((point.errors.size, changes.size))
        for place in range(changes.size):
            # Upwards where there is room, else downwards, else as far as the wider side goes.
            room_above = self.highest[place] - point.vector[place]
            room_below = point.vector[place] - self.lowest[place]
            change = changes[place]
            if change > room_above and room_below > min(room_above, change):
                change = -min(change, room_below)
            elif change > room_above:
                change = room_above
            changed = point.vector.copy()
            changed[place] += change
            errors = self.logs.prediction_errors(self.parameters.unpack(changed).onto(point.fit))
            derivatives[:, place] = (errors - point.errors) / change
        if not np.all(np.isfinite(derivatives)):
            raise LostError
        return derivatives

    def cost(self, point: _Point, noise: float) -> float:
        """Sum of squares of prediction errors, in noise deviations, and of what is known beforehand; inf or
        nan where the simulation is lost."""
        off_expected = (point.vector - self.expected) / self.known_std
        with np.errstate(over="ignore", invalid="ignore"):
            return float(point.errors @ point.errors / noise**2 + off_expected @ off_expected)

    def equations(self, point: _Point, derivatives: RealArray) -> _Equations:
        """Equations of a step from a point, with derivatives (T, N) of its prediction errors."""
        noise = float(np.sqrt(np.mean(point.errors**2)))
        noise = max(noise, np.finfo(np.float64).tiny)
        rows = np.vstack([derivatives / noise, np.diag(1 / self.known_std)])
        off_expected = (point.vector - self.expected) / self.known_std
        target = np.concatenate([point.errors / noise, off_expected])
        lengths = np.linalg.norm(rows, axis=0)
        lengths[lengths == 0] = 1.0
        triangle = triangle_of(np.column_stack([rows / lengths, target]))
        return _Equations(triangle, lengths, float(target @ target), noise)

    def free_parameters(self, point: _Point, equations: _Equations) -> tuple[BoolArray, float]:
        """Mask (N,) of the parameters that a step may move, and by how much the cost falls by such a step to
        first order. Those at a limit that would go beyond it stay."""
        moves = np.ones(point.vector.size, np.bool_)
        while True:
            step, way_left = _damped_step(equations.triangle, moves, _LEAST_DAMPING)
            is_down = (point.vector <= self.lowest) & (step < 0)
            is_up = (point.vector >= self.highest) & (step > 0)
            leaves = moves & (is_down | is_up)
            if not np.any(leaves):
                return moves, way_left
            moves = moves & ~leaves

    def trial(self, point: _Point, equations: _Equations, moves: BoolArray, damping: float) -> _Point | None:
        """The point after a damped step of the parameters that move (N,), None where it is no better.

        Tried with the deflection before sliding, then without it.
        """
        largest = self._largest_steps(point.fit)
        for moved in (moves, moves & (self.names != _ROUGH)):
            step = _damped_step(equations.triangle, moved, damping)[0] / equations.lengths
            # Each by itself: one that the logs hardly tell would shorten the steps of all others.
            vector = np.clip(point.vector + np.clip(step, -largest, largest), self.lowest, self.highest)
            try:
                fit = self.parameters.unpack(vector).onto(point.fit)
                trial = _Point(fit, vector, self.logs.prediction_errors(fit))
            except (ValueError, np.linalg.LinAlgError):  # no observer follows there
                continue
            if self.cost(trial, equations.noise) < equations.cost:
                return trial
        return None

    def _largest_steps(self, fit: FrictionFit) -> RealArray:
        """Largest steps (N,) of the parameters: up to where the linearised law and arm hold."""
        largest = np.full(self.names.size, np.inf)
        largest[np.char.startswith(self.names, "log_")] = _LARGEST_LOG_STEP
        largest[self.names == "drive_lag_samples"] = _LARGEST_LOG_STEP
        of_level = max(_LARGEST_LEVEL_STEP * fit.level, _LARGEST_STEP_OF_LEAST * self.logs.least_level)
        largest[np.isin(self.names, ("coulomb_level", "level_at_load", "stribeck_excess"))] = of_level
        return largest


def _corrected(derivatives: RealArray, before: _Point, after: _Point, lengths: RealArray) -> RealArray:
    """Derivatives (T, N) that foresee the errors after a step, and are the same across it.

    Broyden's update, in parameters scaled by `lengths` (N,).
    """
    step = after.vector - before.vector
    scaled = step * lengths
    unforeseen = after.errors - before.errors - derivatives @ step
    return np.asarray(derivatives + np.outer(unforeseen, scaled * lengths) / (scaled @ scaled))


def _damped_step(triangle: RealArray, moves: BoolArray, damping: float) -> tuple[RealArray, float]:
    """Step (N,) of equations in triangular form, their columns at unit length, and its squared length.

    `triangle` (N + 1, N + 1): the last column is what the step is to take away; `moves` (N,): mask of the
    parameters that take part, the others get 0. The squared length is in units of the equations: how much
    the sum of squares falls by the undamped step.
    """
    step = np.zeros(moves.size)
    if not np.any(moves):
        return step, 0.0
    left, sizes, right = np.linalg.svd(triangle[:, :-1][:, moves], full_matrices=False)
    along = left.T @ triangle[:, -1]
    counts = sizes > _RANK * sizes[0]
    step[moves] = -right.T @ np.where(counts, sizes * along / (sizes**2 + damping), 0.0)
    return step, float(np.sum(along[counts] ** 2))


def with_each_pole_once(fit: FrictionFit) -> FrictionFit:
    """A fit whose arm has each pole of its model once, as a descent moves them; without an observer."""
    arm = SteppedArm.of(fit.model.poles, fit.arm.structure, fit.model.dt_s, doubled=False)
    return replace(fit, arm=arm, coefficients=fit.model.coefficients, correction=None, ratio=0.0)
