"""Simulation of records that start anywhere, with an encoder whose zero nobody knows.

Letters of the shapes: N coefficients of R records with T samples of Y outputs each; P nominal values, S
states at the start of a record, Z zeros of sensors.
"""

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

# Step of difference quotients along an angle, or any state whose spread is infinite: small in a turn, large
# beside rounding.
_ANGLE_STEP_RAD = 1e-3
# Step of difference quotients along a state, as a share of its spread: as `_ANGLE_STEP_RAD`, without a unit.
_STATE_STEP = 1e-3
# Residuals beyond so many standard deviations of their output are those of a simulation that ran away: no
# machine does that, and squares of larger ones would lose the others in rounding.
_RUN_AWAY = 1e6


@dataclass(frozen=True, eq=False)
class FittedStart:
    """What is fitted beside parameters.

    Attributes
    ----------
    states : (R, S) array
        At the start of every record.
    zeros : (Z,) array
        Of sensors, which all records share.
    """

    states: Real
    zeros: Real

    def with_zeros(self, zeros: Real, columns: Real) -> FittedStart:
        """The start that was measured, read with other zeros (Z,); columns (S, Z): states per zero."""
        return FittedStart(self.states + (zeros - self.zeros) @ columns.T, zeros)


@dataclass(frozen=True, eq=False)
class StartColumns:
    """Derivatives of the coefficients by a `FittedStart`.

    Attributes
    ----------
    zeros : (N, Z) array
        By the zeros, each of which takes the measured start along: apart, steps would go nowhere.
    states : tuple of (T Y, S) arrays
        By the states, of every record.
    per_zero : (S, Z) array
        States per unit of a zero, as in `FittedStart.with_zeros`.
    """

    zeros: Real
    states: tuple[Real, ...]
    per_zero: Real

    @classmethod
    def of(cls, fixed: Real, states: Sequence[Real], per_zero: Real) -> StartColumns:
        """Columns from derivatives `fixed` (N, Z) by the zeros with the states held, and those by states."""
        taken_along = np.concatenate([by_states @ per_zero for by_states in states])
        return cls(fixed + taken_along, tuple(states), per_zero)

    def moved(self, start: FittedStart, step: Real) -> FittedStart:
        """The start after a step (Z + R S,): zeros first, then the states of record after record."""
        Z = start.zeros.size
        turned = start.with_zeros(start.zeros + step[:Z], self.per_zero)
        return FittedStart(turned.states + step[Z:].reshape(start.states.shape), turned.zeros)


class RecordsToFit:
    """Some records of a case as coefficients (N,) that a likelihood sees.

    Attributes
    ----------
    case, experiments, likelihood, nominal
        As given.
    simulations : int
        Records that were simulated so far.
    before_each : callable
        Called before every simulation of a record; it may raise to end a fit.
    record_slices : list of slices
        Where the coefficients of every record stand among the N.
    state_spread : (S,) array
        Prior standard deviations of the states at the start of a record; infinite: free.
    zero_spread : (Z,) array
        Prior standard deviations of the zeros.
    state_steps : (S,) array
        Of difference quotients by the states.
    """

    def __init__(
        self,
        case: CaseOfMachine,
        experiments: Sequence[RecordOfMachine],
        likelihood: Likelihood,
        nominal: NominalParameters,
    ) -> None:
        self.case = case
        self.experiments = tuple(experiments)
        self.likelihood = likelihood
        self.nominal = nominal
        self.simulations = 0
        self.before_each: Callable[[], None] = lambda: None

        ends = np.cumsum([e.output.size for e in experiments])
        self.record_slices = [
            slice(int(end - e.output.size), int(end)) for end, e in zip(ends, experiments, strict=True)
        ]
        self._first_samples = [part.start // case.noise.size for part in self.record_slices]
        self._lengths = np.array([[len(e.output)] for e in experiments])
        # Rows of a record that were not measured, and all others.
        self._missing_rows = []
        for experiment in experiments:
            missing = list(getattr(experiment, "missing", ()))
            measured = np.setdiff1d(np.arange(len(experiment.output)), missing)
            self._missing_rows.append((missing, measured))
        # What no machine does counts so much and no more, in every octave: of a constant all but the lowest
        # would seem to be explained.
        rng = np.random.default_rng(0)
        self._run_away = [
            _RUN_AWAY * np.std(e.output, axis=0) * rng.choice([-1.0, 1.0], e.output.shape)
            for e in experiments
        ]

        unknown = case.machine.unknown_start
        self.state_spread = unknown.state_spread
        self.zero_spread = unknown.zero_spread
        is_bounded = np.isfinite(self.state_spread)
        self.state_steps = np.where(is_bounded, _STATE_STEP * self.state_spread, _ANGLE_STEP_RAD)

    def guessed_start(self) -> FittedStart:
        """Starts as the first samples say, sensors at their zeros."""
        guess = self.case.machine.unknown_start.guess
        states = np.array([guess(e) for e in self.experiments])
        return FittedStart(states, np.zeros(self.zero_spread.size))

    def residuals(self, deviations: Real, effects: Sequence[Any], start: FittedStart) -> list[Real]:
        """measured - model (T, Y) of every record, in the outputs' units.

        Parameters
        ----------
        deviations : (P,) array
            Nominal values, in tolerances off.
        effects : sequence
            With their sizes.
        start : FittedStart
            Of these records, one row of states each.

        Raises
        ------
        ValueError
            Starts of another number of records.
        """
        simulate = self.nominal.at(deviations).simulator(effects)
        return [
            self._residuals_of_record(simulate, r, states, start.zeros)
            for r, states in zip(range(len(self.experiments)), start.states, strict=True)
        ]

    def _residuals_of_record(self, simulate: Callable[..., Real], r: int, states: Real, zeros: Real) -> Real:
        """measured - model (T, Y) of the r-th record; where that is not finite, or far, its `_RUN_AWAY`."""
        experiment = self.experiments[r]
        run_away = self._run_away[r]
        self.simulations += 1
        self.before_each()
        start = (states, zeros) if states.size or zeros.size else ()
        residuals = experiment.output - simulate(experiment.input, *start, **run_start(experiment))
        # Rows that were not measured leave what those around them do.
        missing, measured = self._missing_rows[r]
        if missing:
            for column in residuals.T:
                column[missing] = np.interp(missing, measured, column[measured])
        # Written so that nan is far, too.
        is_near = np.abs(residuals) <= np.abs(run_away)
        if np.all(is_near):
            return residuals
        return np.where(is_near, residuals, run_away)

    def coefficients_of_record(
        self, deviations: Real, effects: Sequence[Any], zeros: Real
    ) -> Callable[[int, Real], Real]:
        """Function of a record's place r and the states (S,) at its start; gives its coefficients (T Y,)."""
        simulate = self.nominal.at(deviations).simulator(effects)

        def coefficients(r: int, states: Real) -> Real:
            return self.likelihood.to_coefficients(self._residuals_of_record(simulate, r, states, zeros))

        return coefficients

    def coefficients(self, deviations: Real, effects: Sequence[Any], start: FittedStart) -> Real:
        """(N,) coefficients of all records; arguments are those of `residuals`."""
        residuals = self.residuals(deviations, effects, start)
        return np.concatenate([self.likelihood.to_coefficients(left) for left in residuals])

    def largest_rms(self, change: Real) -> float:
        """Largest RMS, over records and outputs, of a change of the coefficients (N,)."""
        squares = np.square(change).reshape(-1, self.case.noise.size)
        energies = np.add.reduceat(squares, self._first_samples)
        return float(np.sqrt(np.max(energies / self._lengths)))

    def residuals_from(self, e: Real) -> tuple[Real, ...]:
        """measured - model (T, Y) of every record from their coefficients (N,)."""
        outputs = self.case.noise.size
        return tuple(self.likelihood.to_residuals(e[part], outputs) for part in self.record_slices)

    def start_columns(
        self, deviations: Real, effects: Sequence[Any], start: FittedStart, *, touching: bool = False
    ) -> StartColumns:
        """Derivatives of the coefficients by the start.

        By states they are responses of the linear part of the machine; where nobody knows that, and where
        contacts are to be felt, difference quotients.

        Parameters
        ----------
        deviations, effects, start
            The point, as in `residuals`.
        touching : bool
            Contacts are to be felt.
        """
        unknown = self.case.machine.unknown_start
        responses = self.nominal.at(deviations).unknown_start.responses
        by_states = []
        if responses is None or touching:
            coefficients = self.coefficients_of_record(deviations, effects, start.zeros)
            for r, states in enumerate(start.states):
                of_record = partial(coefficients, r)
                by_states.append(difference_quotients(of_record, states, of_record(states), self.state_steps))
        else:
            longest = max(len(e.output) for e in self.experiments)
            state_responses = responses(effects, longest)
            for e in self.experiments:
                columns = [
                    self.likelihood.linearised(response[: len(e.output)]) for response in state_responses
                ]
                by_states.append(-np.array(columns).reshape(-1, e.output.size).T)
        by_zeros = []
        for e in self.experiments:
            constants = [
                self.likelihood.linearised(np.broadcast_to(outputs, e.output.shape))
                for outputs in unknown.zero_outputs
            ]
            by_zeros.append(-np.array(constants).reshape(-1, e.output.size).T)
        return StartColumns.of(np.concatenate(by_zeros), by_states, unknown.state_per_zero)

    def with_true_angles(
        self, columns: StartColumns, deviations: Real, effects: Sequence[Any], start: FittedStart, e: Real
    ) -> StartColumns:
        """The columns with those by the first state (the true hub angle) as difference quotients.

        What an effect does with that angle is in them, as it is not in those of the linear part.

        Parameters
        ----------
        columns : StartColumns
            At the point or nearby.
        deviations, effects, start
            The point, as in `residuals`.
        e : (N,) array
            Coefficients there.
        """
        shift = np.zeros_like(start.states)
        shift[:, 0] = _ANGLE_STEP_RAD
        turned = FittedStart(start.states + shift, start.zeros)
        change = self.coefficients(deviations, effects, turned) - e
        states = tuple(
            np.column_stack([change[part] / _ANGLE_STEP_RAD, by_states[:, 1:]])
            for part, by_states in zip(self.record_slices, columns.states, strict=True)
        )
        taken_along = np.concatenate([by_states @ columns.per_zero for by_states in columns.states])
        return StartColumns.of(columns.zeros - taken_along, states, columns.per_zero)

    def prior_cost(self, start: FittedStart) -> float:
        """-2 log of the prior density of a start, up to a constant: squares over those of the spreads."""
        states = np.sum((start.states / self.state_spread) ** 2)
        zeros = np.sum((start.zeros / self.zero_spread) ** 2)
        return float(states + zeros)


class Records(RecordsToFit):
    """Records beside a model error, their levels unknown (`diagnosis.fit.levels`).

    Attributes
    ----------
    levels : Levels
        The likelihood, in whole records or in windows.
    """

    levels: Levels

    def __init__(
        self, case: CaseOfMachine, experiments: Sequence[RecordOfMachine], windows: Windows | None = None
    ) -> None:
        rounding = rounding_effect(case)
        rounding_variances: Real = np.zeros(case.noise.size)
        if rounding is not None:
            rounding_variances = rounding.variances
        model_error = case.machine.weighing.model_error
        self.levels = Levels.of(experiments, case.noise, model_error, rounding_variances, windows)
        super().__init__(case, experiments, self.levels, LogNormalParameters(case.machine))

    def losses(self, e: Real) -> Real:
        """(R,) -log likelihood of every record, from coefficients (N,)."""
        return np.array([self.levels.of_record(part).loss(e[part]) for part in self.record_slices])

    def rms_shares(self, residuals: Sequence[Real]) -> Real:
        """(Y,) RMS left beyond what sensors may have over the RMS of the motion (about the mean), all
        records."""
        return np.asarray(np.sqrt(mean_square_left(self.energies(residuals))))

    def energies(self, residuals: Sequence[Real], *, carried: bool = False) -> Real:
        """Energy left, and energy of the motion, of every record and output.

        Parameters
        ----------
        residuals : sequence of (T, Y) arrays
            Of every record, in the outputs' units.
        carried : bool
            For comparing two models: noise is part of what is left, and the motion is that in windows where
            there are some. Else what sensors may have is taken off, and the motion is about its mean.

        Returns
        -------
        (2, R, Y) array
            Squares of the outputs' units: left, at least 0, and motion.
        """
        levels = self.levels
        energy = levels.energy(np.concatenate([levels.to_coefficients(left) for left in residuals]))
        motion = levels.motion_energy
        if not carried:
            energy = energy - levels.noise
            motion = levels.whole_motion_energy
        left_energy = np.bincount(levels.output_of_band, energy)
        return np.array([np.maximum(left_energy, 0.0), motion]).reshape(2, -1, self.case.noise.size)


def run_start(experiment: RecordOfMachine) -> dict[str, int]:
    """What a simulation of a part of a run is told beside its start: `first_row` of the part, where not 0."""
    first_row: int = getattr(experiment, "first_row", 0)
    if first_row == 0:
        return {}
    return {"first_row": first_row}


def mean_square_left(energies: Real) -> Real:
    """(Y,) energy left over that of the motion, of all records together; energies (2, R, Y) are those of
    `Records.energies`."""
    left, motion = energies.sum(axis=1)
    return np.asarray(left / motion)
