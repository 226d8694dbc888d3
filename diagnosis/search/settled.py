"""States at the start of records that fit them best, everything else as it is.

Each record depends on its own start alone. What a start does is what the linear part of the machine makes of
it, until contacts switch: in free play a hub goes on as it went until it touches. Where nobody knows a linear
part, a whole record says little far from its start (a pendulum that dry friction holds at rest does not feel
its angle): the start is then sought on its first samples, and more of them.
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

_ITERATIONS, _STILL = 30, 1e-7
# Steps of a start, and what a further one must gain; beside contacts parts of a step are tried as well.
_STEPS, _GAIN = 5, 0.2
_PARTS = (1.0, 0.3, 0.1, 0.03)
# Beginnings of a record that its start is sought on, the fewest samples, steps in spreads of a state and
# least squares of each; and what a spread weighs beside the motion.
_BEGINNINGS, _FEWEST, _STEP, _CALLS, _LITTLE = (16, 4), 20, 0.02, 15, 1e-3


def fit_record_starts(
    records: Records, d: Real, effects: Sequence[Any], start: FittedStart, *, touching: bool = False
) -> tuple[FittedStart, Real]:
    """The start from which the records fit best, and their coefficients (N,) there.

    touching : from where the steps of the linear arm end and from the guess, states some way off are tried
        (`UnknownStart.tried`), and columns are difference quotients at every further step.
    """
    if not start.states.size:
        return start, records.coefficients(d, effects, start)
    columns, unknown = records.start_columns(d, effects, start).states, records.case.machine.unknown_start
    rest = records.guessed_start().with_zeros(start.zeros, unknown.state_per_zero)
    left = records.coefficients_of_record(d, effects, start.zeros)
    found = []
    for r, state in enumerate(start.states):
        best = _RecordStart(records, r, left, state)
        best.descend(columns[r])
        more = unknown.responses is None and best.loss > best.levels.loss_of(best.levels.floor)
        # More is left than does not interest, and nobody knows a linear part.
        if more and best.better(_begun(records, r, d, effects, FittedStart(state, start.zeros))):
            best.descend()
        for near in (best.state, rest.states[r]) if touching else ():
            one = _RecordStart(records, r, left, near)
            for moved in near + unknown.tried:
                one.better(moved)
            one.descend()
            best = min(best, one, key=lambda one: one.loss)
        found.append(best)
    e = np.concatenate([one.e for one in found])
    return FittedStart(np.array([one.state for one in found]), start.zeros), e


def _begun(records: Records, r: int, d: Real, effects: Sequence[Any], start: FittedStart) -> Real:
    """States (S,) that fit the beginnings of the r-th record best, from states (S,)."""
    record, spread = records.experiments[r], records.state_spread
    simulate, scale = records.nominal.at(d).simulator(effects), np.std(record.output, axis=0)
    z = start.states / spread
    for part in _BEGINNINGS:
        T = max(len(record.output) // part, _FEWEST)

        def left(z: Real, T: int = T) -> Real:
            e = (
                record.output[:T] - simulate(record.input[:T], z * spread, start.zeros, **run_start(record))
            ) / scale
            return np.append(np.clip(e, -1 / _LITTLE, 1 / _LITTLE), _LITTLE * z)

        def slopes(z: Real, left: Callable[[Real], Real] = left) -> Real:
            return difference_quotients(left, z, left(z), np.full(z.size, _STEP))

        z = least_squares(left, z, slopes, max_nfev=_CALLS).x
    return np.asarray(z * spread)


class _RecordStart:
    """The best so far of the states (S,) at the start of the r-th record, e (T Y,) its coefficients there."""

    def __init__(self, records: Records, r: int, left: Callable[[int, Real], Real], state: Real) -> None:
        self.records, self.levels = records, records.levels.of_record(records.record_slices[r])
        self.left = partial(left, r)
        self.state, self.e = state, self.left(state)
        self.loss = self._loss(state, self.e)

    def _loss(self, state: Real, e: Real) -> float:
        return self.levels.loss(e) + 0.5 * float(np.sum((state / self.records.state_spread) ** 2))

    def better(self, state: Real) -> bool:
        """Whether a state is, which then is taken."""
        e = self.left(state)
        if (loss := self._loss(state, e)) < self.loss:
            self.state, self.e, self.loss = state, e, loss
            return True
        return False

    def descend(self, columns: Real | None = None) -> None:
        """By steps that are linear in the columns (T Y, S); without, in difference quotients at each state,
        and by parts of such steps."""
        records, parts = self.records, _PARTS if columns is None else (1.0,)
        for _ in range(_STEPS):
            own = (
                difference_quotients(self.left, self.state, self.e, records.state_steps)
                if columns is None
                else columns
            )
            before, move = (
                self.loss,
                best_state_step(self.levels, records.state_spread, own, self.e, self.state),
            )
            if not any(self.better(self.state + part * move) for part in parts) or self.loss > before - _GAIN:
                return


def best_state_step(levels: Levels, spread: Real, columns: Real, e: Real, state: Real) -> Real:
    """(S,) from the state at the start of a record to the one that leaves least of its coefficients e (T Y,),
    these being linear in it; columns (T Y, S), levels: of this record.

    Far from it the loss is flat, and weights of what is left there lead to it in many small steps: they are
    taken on the energies of the bands, and once more from where all bands weigh as their floors do.
    """
    rows = np.column_stack([columns, e])
    energies = np.array([own.T @ own for b in range(levels.floor.size) for own in [rows[levels.band == b]]])

    def left(move: Real) -> Real:
        whole = np.append(move, 1.0)
        return np.asarray(np.maximum(energies @ whole @ whole, 0.0))

    def loss(move: Real) -> float:
        return levels.loss_of(left(move)) + 0.5 * float(np.sum(((state + move) / spread) ** 2))

    found: list[Real] = []
    for weights in (
        levels.independent_counts / (left(np.zeros(state.size)) + levels.floor),
        1 / levels.floor,
    ):
        move = np.zeros(state.size)
        for _ in range(_ITERATIONS):
            weighted, before = np.tensordot(weights, energies, 1), move
            H, g = weighted[:-1, :-1] + np.diag(1 / spread**2), weighted[:-1, -1] + state / spread**2
            move = -solve_or_least_squares(H, g)
            if np.all(np.abs(move - before) < _STILL * spread):
                break
            weights = levels.independent_counts / (left(move) + levels.floor)
        found.append(move)
    return min(found, key=loss)
