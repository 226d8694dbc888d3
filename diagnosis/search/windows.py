"""An arm started anew in every window of its records (multiple shooting).

Where a torque has several minima over the angle, an arm that falls into another of them than its simulation
did leaves a residual that says nothing of how far off the simulation is: free runs have as many minima. From
states of its own in every window a simulation stays near the record, and a fit of the effects ends in the
right one far more often; from there free runs are descended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.machine.case import Case
from diagnosis.machine.flexible_arm import FlexibleArm
from diagnosis.machine.machine_protocol import Real, RecordOfMachine, UnknownStart
from plant.effects import Effect

# Windows of the longest record: an eighth of it is too short to fall into another minimum, and eight times
# the states of one start are still few beside its samples.
_WINDOWS = 8
# Samples between which the speed at the start of a window is read off: their noise divided by their time.
_SPEED_SAMPLES = 5
# Prior standard deviation of a hub angle that nobody knows, rad: sixteen turns, nearly flat.
_FREE_ANGLE_RAD = 100.0


@dataclass(frozen=True, eq=False)
class ArmInWindows(FlexibleArm):
    """A flexible arm whose states at the start are those of all windows after each other.

    Neglected: delays and lags begin each window at rest, disturbances and drifts as the record did.

    Attributes
    ----------
    window_samples : int
        Samples of a window; the last one of a record may be shorter.
    windows : int
        Of the longest record. States of windows that a shorter record does not have do nothing.
    """

    window_samples: int = 1
    windows: int = 1

    @property
    def _in_one_window(self) -> FlexibleArm:
        """The arm as it runs freely."""
        return FlexibleArm(self.rig, self.outputs, self.model_error)

    @property
    def unknown_start(self) -> UnknownStart:
        """States of all windows, window by window; guesses are read off the measured hub angle."""
        of_window = self._in_one_window.unknown_start
        n_states = of_window.state_spread.size
        samples = self.window_samples
        dt_s = self.rig.sampling.dt_s

        def guess(record: RecordOfMachine) -> Real:
            angle = record.output[:, 0]
            states = np.zeros((self.windows, n_states))
            # A window beyond the end of the record takes its last angles.
            first_rows = np.minimum(np.arange(self.windows) * samples, angle.size - _SPEED_SAMPLES - 1)
            states[:, 0] = angle[first_rows]
            speeds_rad_s = (angle[first_rows + _SPEED_SAMPLES] - angle[first_rows]) / (_SPEED_SAMPLES * dt_s)
            # The record itself begins at rest.
            states[1:, 1] = speeds_rad_s[1:]
            return states.ravel()

        def responses(effects: Sequence[Effect], record_samples: int) -> list[Real]:
            in_window = of_window.responses(effects, samples) if of_window.responses else ()
            in_record = []
            for first in range(0, self.windows * samples, samples):
                for response in in_window:
                    placed = np.zeros((record_samples, response.shape[1]))
                    placed[first : first + samples] = response[: max(record_samples - first, 0)]
                    in_record.append(placed)
            return in_record

        spread = np.where(np.isfinite(of_window.state_spread), of_window.state_spread, _FREE_ANGLE_RAD)
        return replace(
            of_window,
            state_spread=np.tile(spread, self.windows),
            state_per_zero=np.tile(of_window.state_per_zero, (self.windows, 1)),
            guess=guess,
            responses=responses,
            tried=np.zeros((0, 0)),
        )

    def simulator(self, effects: Sequence[Effect]) -> Callable[..., Real]:
        """Inputs (T, 1), states of all windows (windows S,), zeros (Z,) -> outputs (T, Y) without noise."""
        simulate = self._in_one_window.simulator(effects)
        n_states = self._in_one_window.unknown_start.state_spread.size
        samples = self.window_samples

        def outputs(inputs: Real, state: Real, zeros: Real, first_row: int = 0) -> Real:
            runs = []
            for window, first in enumerate(range(0, len(inputs), samples)):
                window_state = state[window * n_states : (window + 1) * n_states]
                runs.append(simulate(inputs[first : first + samples], window_state, zeros, first_row))
            return np.concatenate(runs)

        return outputs


@dataclass(frozen=True, eq=False)
class CaseInWindows(Case):
    """A case with its arm started anew in every window."""

    @property
    def machine(self) -> ArmInWindows:
        """The arm with windows as long as an eighth of the longest record."""
        longest = max(len(experiment.output) for experiment in self.experiments)
        window_samples = -(-longest // _WINDOWS)
        return ArmInWindows(self.rig, self.outputs, self.model_error, window_samples, _WINDOWS)


def in_windows(case: Case) -> CaseInWindows:
    """The case with the same records, its arm started anew in every window."""
    return CaseInWindows(case.name, case.rig, case.experiments, case.model_error)
