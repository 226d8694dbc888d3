"""Simulation of records that start anywhere, with an encoder whose zero nobody knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from diagnosis.fit.coordinates import difference_quotients
from diagnosis.fit.levels import Levels
from diagnosis.fit.likelihood import Likelihood
from diagnosis.fit.nominal import LogNormalParameters, NominalParameters
from diagnosis.fit.windows import Windows
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from diagnosis.machine.rounding import rounding_effect

_ANGLE_STEP_RAD = 1e-3  # of difference quotients: small in a turn, large beside rounding
# Of the spread of a state at the start.
_STATE_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class FittedStart:
    """What is fitted beside parameters: states (R, S) at the start of every record, zeros (Z,) of sensors."""

    states: Real
    zeros: Real

    def with_zeros(self, zeros: Real, columns: Real) -> FittedStart:
        """The same measured start with other zeros; columns (S, Z): states per unit of a zero."""
        return FittedStart(self.states + (zeros - self.zeros) @ columns.T, zeros)


@dataclass(frozen=True, eq=False)
class StartColumns:
    """Derivatives of the coefficients by a `FittedStart`: zeros (N, Z), states of every record (T Y, S) each.
    A zero takes the measured start along, per_zero (S, Z) as in `with_zeros`: apart, steps go nowhere."""

    zeros: Real
    states: tuple[Real, ...]
    per_zero: Real

    @classmethod
    def of(cls, fixed: Real, states: Sequence[Real], per_zero: Real) -> StartColumns:
        """fixed (N, Z): derivatives by the zeros with the states held."""
        return cls(fixed + np.concatenate([own @ per_zero for own in states]), tuple(states), per_zero)

    def moved(self, start: FittedStart, step: Real) -> FittedStart:
        """step: (Z + R S,)."""
        Z = start.zeros.size
        turned = start.with_zeros(start.zeros + step[:Z], self.per_zero)
        return FittedStart(turned.states + step[Z:].reshape(start.states.shape), turned.zeros)


class RecordsToFit:
    """Some records of a case as coefficients (N,) that a likelihood sees; counts its simulations."""

    def __init__(
        self,
        case: CaseOfMachine,
        experiments: Sequence[RecordOfMachine],
        likelihood: Likelihood,
        nominal: NominalParameters,
    ) -> None:
        self.case, self.experiments = case, tuple(experiments)
        self.likelihood, self.nominal = likelihood, nominal
        self.simulations = 0
        self.before_each: Callable[[], None] = lambda: None
        ends = np.cumsum([e.output.size for e in experiments])
        self.record_slices = [
            slice(int(b - e.output.size), int(b)) for b, e in zip(ends, experiments, strict=True)
        ]
        self._firsts = [part.start // case.noise.size for part in self.record_slices]
        self._lengths = np.array([[len(e.output)] for e in experiments])
        lacking = [list(getattr(e, "missing", ())) for e in experiments]
        self._missing = [
            (rows, np.setdiff1d(np.arange(len(e.output)), rows))
            for e, rows in zip(experiments, lacking, strict=True)
        ]
        # What no machine does counts so much and no more, in every octave: of a constant all but the lowest
        # would seem to be explained.
        rng = np.random.default_rng(0)
        self._far = [
            1e6 * np.std(e.output, axis=0) * rng.choice([-1.0, 1.0], e.output.shape) for e in experiments
        ]
        unknown = case.machine.unknown_start
        self.state_spread, self.zero_spread = unknown.state_spread, unknown.zero_spread
        known = np.isfinite(self.state_spread)
        self.state_steps = np.where(known, _STATE_STEP * self.state_spread, _ANGLE_STEP_RAD)

    def guessed_start(self) -> FittedStart:
        """Starts as the first samples say, sensors at their zeros."""
        guess = self.case.machine.unknown_start.guess
        return FittedStart(np.array([guess(e) for e in self.experiments]), np.zeros(self.zero_spread.size))

    def residuals(self, deviations: Real, effects: Sequence[Any], start: FittedStart) -> list[Real]:
        """measured - model (T, Y) of every record, in the outputs' units."""
        simulate = self.nominal.at(deviations).simulator(effects)
        return [self._left(simulate, r, state, start.zeros) for r, state in enumerate(start.states)]

    def _left(self, simulate: Callable[..., Real], r: int, state: Real, zeros: Real) -> Real:
        """measured - model (T, Y) of the r-th record."""
        experiment, far = self.experiments[r], self._far[r]
        self.simulations += 1
        self.before_each()
        begun = (state, zeros) if state.size or zeros.size else ()
        e = experiment.output - simulate(experiment.input, *begun, **run_start(experiment))
        missing, kept = self._missing[r]
        if missing:
            for column in e.T:
                column[missing] = np.interp(missing, kept, column[kept])
        # Written so that nan is far, too.
        within = np.abs(e) <= np.abs(far)
        return e if np.all(within) else np.where(within, e, far)

    def coefficients_of_record(
        self, deviations: Real, effects: Sequence[Any], zeros: Real
    ) -> Callable[[int, Real], Real]:
        """Coefficients (T Y,) of the r-th record by r and the state at its start."""
        simulate = self.nominal.at(deviations).simulator(effects)
        return lambda r, state: self.likelihood.to_coefficients(self._left(simulate, r, state, zeros))

    def coefficients(self, deviations: Real, effects: Sequence[Any], start: FittedStart) -> Real:
        return np.concatenate(
            [self.likelihood.to_coefficients(e) for e in self.residuals(deviations, effects, start)]
        )

    def largest_rms(self, change: Real) -> float:
        """Largest RMS, over records and outputs, of a change of the coefficients (N,)."""
        energies = np.add.reduceat(np.square(change).reshape(-1, self.case.noise.size), self._firsts)
        return float(np.sqrt(np.max(energies / self._lengths)))

    def residuals_from(self, e: Real) -> tuple[Real, ...]:
        """measured - model (T, Y) of every record from their coefficients (N,)."""
        return tuple(
            self.likelihood.to_residuals(e[part], self.case.noise.size) for part in self.record_slices
        )

    def start_columns(
        self, deviations: Real, effects: Sequence[Any], start: FittedStart, *, touching: bool = False
    ) -> StartColumns:
        """Of the linear part of the machine; where nobody knows that, and where contacts are to be felt
        (touching), difference quotients."""
        longest = max(len(e.output) for e in self.experiments)
        outputs = self.case.noise.size
        responses = self.nominal.at(deviations).unknown_start.responses
        if responses is None or touching:
            of_each = self.coefficients_of_record(deviations, effects, start.zeros)
            states = [
                difference_quotients(partial(of_each, r), state, of_each(r, state), self.state_steps)
                for r, state in enumerate(start.states)
            ]
        else:
            whole = responses(effects, longest)
            states = [
                -np.array([self.likelihood.linearised(response[: len(e.output)]) for response in whole])
                .reshape(-1, e.output.size)
                .T
                for e in self.experiments
            ]
        zeros = []
        for e in self.experiments:
            T, shapes = len(e.output), self.case.machine.unknown_start.zero_outputs
            constant = [self.likelihood.linearised(np.broadcast_to(shape, (T, outputs))) for shape in shapes]
            zeros.append(-np.array(constant).reshape(-1, T * outputs).T)
        return StartColumns.of(np.concatenate(zeros), states, self.case.machine.unknown_start.state_per_zero)

    def with_true_angles(
        self, columns: StartColumns, deviations: Real, effects: Sequence[Any], start: FittedStart, e: Real
    ) -> StartColumns:
        """The columns with those by the first state (the true hub angle) as difference quotients: what an
        effect does with that angle is in them. e (N,): coefficients at the point."""
        shift = np.zeros_like(start.states)
        shift[:, 0] = _ANGLE_STEP_RAD
        moved = self.coefficients(deviations, effects, FittedStart(start.states + shift, start.zeros)) - e
        states = tuple(
            np.column_stack([moved[part] / _ANGLE_STEP_RAD, own[:, 1:]])
            for part, own in zip(self.record_slices, columns.states, strict=True)
        )
        before = np.concatenate([own @ columns.per_zero for own in columns.states])
        return StartColumns.of(columns.zeros - before, states, columns.per_zero)

    def prior_cost(self, start: FittedStart) -> float:
        """-2 log prior density of a start."""
        return float(
            np.sum((start.states / self.state_spread) ** 2) + np.sum((start.zeros / self.zero_spread) ** 2)
        )


class Records(RecordsToFit):
    """Records beside a model error, their levels unknown."""

    levels: Levels

    def __init__(
        self, case: CaseOfMachine, experiments: Sequence[RecordOfMachine], windows: Windows | None = None
    ) -> None:
        rounding = rounding_effect(case)
        rounded = np.zeros(case.noise.size) if rounding is None else rounding.variances
        self.levels = Levels.of(experiments, case.noise, case.machine.weighing.model_error, rounded, windows)
        super().__init__(case, experiments, self.levels, LogNormalParameters(case.machine))

    def losses(self, e: Real) -> Real:
        """(R,) -log likelihood of every record, from coefficients (N,)."""
        return np.array([self.levels.of_record(part).loss(e[part]) for part in self.record_slices])

    def rms_shares(self, residuals: Sequence[Real]) -> Real:
        """(Y,) RMS left beyond what sensors may have over the RMS of the motion (about the mean), all
        records."""
        return np.asarray(np.sqrt(mean_square_left(self.energies(residuals))))

    def energies(self, residuals: Sequence[Real], *, carried: bool = False) -> Real:
        """(2, R, Y) energies left beyond what sensors may have, and of the motion, of every record. carried:
        to compare, noise included, and the motion as far as windows have it."""
        levels, Y = self.levels, self.case.noise.size
        energy = levels.energy(np.concatenate([levels.to_coefficients(e) for e in residuals]))
        left = np.bincount(levels.output_of_band, energy if carried else energy - levels.noise)
        motion = levels.motion_energy if carried else levels.whole_motion_energy
        return np.array([np.maximum(left, 0.0), motion]).reshape(2, -1, Y)


def run_start(experiment: RecordOfMachine) -> dict[str, int]:
    """What a simulation of a part of a run is told beside its start."""
    first_row: int = getattr(experiment, "first_row", 0)
    return {"first_row": first_row} if first_row else {}


def mean_square_left(energies: Real) -> Real:
    """(2, R, Y) energies of `Records.energies` -> (Y,) energy left over that of the motion."""
    left, motion = energies.sum(axis=1)
    return np.asarray(left / motion)
