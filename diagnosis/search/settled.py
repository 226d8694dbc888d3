"""States at the start of records that fit them best, everything else as it is.

Each record depends on its own start alone. What a start does is what the linear part of the machine makes of
it, until contacts switch: in free play a hub goes on as it went until it touches. Where nobody knows a linear
part, a whole record says little far from its start (a pendulum that dry friction holds at rest does not feel
its angle): the start is then sought on its first samples, and more of them.

Letters of the shapes: T samples of Y outputs of a record, S states at its start, B bands of its coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from diagnosis.fit.coordinates import difference_quotients, solve_or_least_squares
from diagnosis.fit.levels import Levels
from diagnosis.fit.records import FittedStart, Records, run_start
from diagnosis.machine.machine_protocol import Real

# Most reweighted least squares for one step of a start; they converge in a few.
_REWEIGHTED_ITERATIONS = 30
# Change of a state, in its spread, below which they have converged.
_CONVERGED = 1e-7
# Most steps of a start: linear columns lead there in one or two.
_STEPS = 5
# What a step must gain for another one to be tried, in units of the loss: a tenth of what `SUBSTANTIAL` asks
# of a difference between sets, so that starts do not decide one.
_LEAST_GAIN = 0.2
# Shares of a step that are tried, the largest first, where columns are difference quotients: beside contacts
# a whole step may jump over what it seeks. Each about a third of the last.
_SHARES_OF_STEP = (1.0, 0.3, 0.1, 0.03)
# Beginnings of a record that its start is sought on: a sixteenth, then a quarter.
_BEGINNINGS = (16, 4)
# Fewest samples of such a beginning, as of a record.
_FEWEST_SAMPLES = 20
# Step of difference quotients there, in the spread of a state: coarse, for a start far off.
_BEGINNING_STEP = 0.02
# Most evaluations of the least squares on a beginning; the next one, or the whole record, goes on.
_BEGINNING_CALLS = 15
# What a state's spread weighs there, beside the standard deviation of the outputs: it only keeps a state that
# nothing depends on where it is. One over it bounds what a residual counts.
_SPREAD_WEIGHT = 1e-3


def fit_record_starts(
    records: Records, d: Real, effects: Sequence[Any], start: FittedStart, *, touching: bool = False
) -> tuple[FittedStart, Real]:
    """The start from which the records fit best, and what they leave there.

    Parameters
    ----------
    records : Records
        Simulated, a few times each.
    d : (P,) array
        Deviations of the nominal values.
    effects : sequence
        With their sizes.
    start : FittedStart
        Where the states are sought from; zeros stay as they are.
    touching : bool
        From where the steps of the linear arm end and from the guess, states some way off are tried
        (`UnknownStart.tried`), and columns are difference quotients at every further step.

    Returns
    -------
    FittedStart, (N,) array
        The start and the coefficients there; as given, of machines whose start is known.
    """
    if start.states.size == 0:
        return start, records.coefficients(d, effects, start)
    unknown = records.case.machine.unknown_start
    columns = records.start_columns(d, effects, start).states
    guess = records.guessed_start().with_zeros(start.zeros, unknown.state_per_zero)
    coefficients = records.coefficients_of_record(d, effects, start.zeros)
    best_starts = []
    for r, states in enumerate(start.states):
        best = _RecordStart(records, r, coefficients, states)
        best.descend(columns[r])
        # More is left than does not interest, and nobody knows a linear part.
        if unknown.responses is None and best.loss > best.levels.loss_of(best.levels.floor):
            near_beginning = _states_of_beginnings(records, r, d, effects, FittedStart(states, start.zeros))
            if best.take_if_better(near_beginning):
                best.descend()
        for nearby in (best.states, guess.states[r]) if touching else ():
            other = _RecordStart(records, r, coefficients, nearby)
            for moved in nearby + unknown.tried:
                other.take_if_better(moved)
            other.descend()
            best = min(best, other, key=lambda record_start: record_start.loss)
        best_starts.append(best)
    e = np.concatenate([best.e for best in best_starts])
    return FittedStart(np.array([best.states for best in best_starts]), start.zeros), e


def _states_of_beginnings(
    records: Records, r: int, d: Real, effects: Sequence[Any], start: FittedStart
) -> Real:
    """States (S,) that fit the beginnings of the r-th record best, one after the other.

    `start` has the states (S,) of this record alone, from which the first beginning is fitted. Least squares
    of the outputs over their standard deviations, whatever the likelihood is.
    """
    record = records.experiments[r]
    spread = records.state_spread
    simulate = records.nominal.at(d).simulator(effects)
    scale = np.std(record.output, axis=0)
    z = start.states / spread
    for share in _BEGINNINGS:
        samples = max(len(record.output) // share, _FEWEST_SAMPLES)

        def residuals(z: Real, samples: int = samples) -> Real:
            simulated = simulate(record.input[:samples], z * spread, start.zeros, **run_start(record))
            e = (record.output[:samples] - simulated) / scale
            return np.append(np.clip(e, -1 / _SPREAD_WEIGHT, 1 / _SPREAD_WEIGHT), _SPREAD_WEIGHT * z)

        def jacobian(z: Real, residuals: Callable[[Real], Real] = residuals) -> Real:
            return difference_quotients(residuals, z, residuals(z), np.full(z.size, _BEGINNING_STEP))

        z = least_squares(residuals, z, jacobian, max_nfev=_BEGINNING_CALLS).x
    return np.asarray(z * spread)


class _RecordStart:
    """The best so far of the states at the start of one record.

    Attributes
    ----------
    levels : Levels
        Of this record alone.
    states : (S,) array
        At its start.
    e : (T Y,) array
        Coefficients left from there.
    loss : float
        Their loss and that of the prior of the states.
    """

    def __init__(
        self, records: Records, r: int, coefficients: Callable[[int, Real], Real], states: Real
    ) -> None:
        self.records = records
        self.levels = records.levels.of_record(records.record_slices[r])
        self.coefficients = partial(coefficients, r)
        self.states = states
        self.e = self.coefficients(states)
        self.loss = self._loss(states, self.e)

    def _loss(self, states: Real, e: Real) -> float:
        """-log posterior density of states (S,) that leave coefficients e (T Y,)."""
        return self.levels.loss(e) + 0.5 * float(np.sum((states / self.records.state_spread) ** 2))

    def take_if_better(self, states: Real) -> bool:
        """Whether states (S,) leave less; they are taken then."""
        e = self.coefficients(states)
        loss = self._loss(states, e)
        # Written so that a loss that is not a number is no better.
        if not loss < self.loss:
            return False
        self.states = states
        self.e = e
        self.loss = loss
        return True

    def descend(self, columns: Real | None = None) -> None:
        """Take steps to better states until they gain next to nothing.

        columns (T Y, S): derivatives of the coefficients, in which every step is linear. Without them they
        are difference quotients at each state, and parts of a step are tried as well.
        """
        spread = self.records.state_spread
        shares: tuple[float, ...] = (1.0,)
        if columns is None:
            shares = _SHARES_OF_STEP
        for _ in range(_STEPS):
            derivatives = columns
            if derivatives is None:
                derivatives = difference_quotients(
                    self.coefficients, self.states, self.e, self.records.state_steps
                )
            before = self.loss
            step = best_state_step(self.levels, spread, derivatives, self.e, self.states)
            has_gained = any(self.take_if_better(self.states + share * step) for share in shares)
            if not has_gained or self.loss > before - _LEAST_GAIN:
                return


def best_state_step(levels: Levels, spread: Real, columns: Real, e: Real, states: Real) -> Real:
    """Step from the states at the start of a record to those that leave least of its coefficients.

    Far from them the loss is flat, and weights of what is left there lead to them in many small steps: they
    are taken on the energies of the bands, which are quadratic in the step, and once more from where all
    bands weigh as their floors do.

    Parameters
    ----------
    levels : Levels
        Of this record.
    spread : (S,) array
        Prior standard deviations of the states.
    columns : (T Y, S) array
        Derivatives of the coefficients by the states, which are taken to be linear.
    e : (T Y,) array
        Coefficients that are left.
    states : (S,) array
        From which they are left.

    Returns
    -------
    (S,) array
        The better of both steps.
    """
    # Energy of every band is (move, 1) @ products @ (move, 1), by (B, S + 1, S + 1) products.
    rows = np.column_stack([columns, e])
    products = []
    for b in range(levels.floor.size):
        in_band = rows[levels.band == b]
        products.append(in_band.T @ in_band)
    energies = np.array(products)

    def energy_left(move: Real) -> Real:
        extended = np.append(move, 1.0)
        return np.asarray(np.maximum(energies @ extended @ extended, 0.0))

    def loss(move: Real) -> float:
        prior = 0.5 * float(np.sum(((states + move) / spread) ** 2))
        return levels.loss_of(energy_left(move)) + prior

    weights_here = levels.independent_counts / (energy_left(np.zeros(states.size)) + levels.floor)
    weights_of_floors = 1 / levels.floor
    steps: list[Real] = []
    for weights in (weights_here, weights_of_floors):
        move = np.zeros(states.size)
        for _ in range(_REWEIGHTED_ITERATIONS):
            before = move
            weighted = np.tensordot(weights, energies, 1)
            hessian = weighted[:-1, :-1] + np.diag(1 / spread**2)
            gradient = weighted[:-1, -1] + states / spread**2
            move = -solve_or_least_squares(hessian, gradient)
            if np.all(np.abs(move - before) < _CONVERGED * spread):
                break
            weights = levels.independent_counts / (energy_left(move) + levels.floor)
        steps.append(move)
    return min(steps, key=loss)
