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

# Windows of the longest record, and samples between which a speed is read off.
_WINDOWS, _SPEED_SAMPLES = 8, 5
_FREE_RAD = 100.0  # sixteen turns: the prior of a state that nobody knows, nearly flat


@dataclass(frozen=True, eq=False)
class ArmInWindows(FlexibleArm):
    """States of all windows after each other. Neglected: delays and lags begin each window at rest,
    disturbances and drifts as the record did."""

    window_samples: int = 1
    windows: int = 1

    @property
    def _once(self) -> FlexibleArm:
        return FlexibleArm(self.rig, self.outputs, self.model_error)

    @property
    def unknown_start(self) -> UnknownStart:
        once = self._once.unknown_start
        L, dt_s = self.window_samples, self.rig.sampling.dt_s

        def guess(record: RecordOfMachine) -> Real:
            angle = record.output[:, 0]
            found = np.zeros((self.windows, once.state_spread.size))
            at = np.minimum(np.arange(self.windows) * L, angle.size - _SPEED_SAMPLES - 1)
            found[:, 0] = angle[at]
            found[1:, 1] = (angle[at + _SPEED_SAMPLES] - angle[at])[1:] / (_SPEED_SAMPLES * dt_s)
            return found.ravel()

        def responses(effects: Sequence[Effect], samples: int) -> list[Real]:
            whole, each = [], once.responses(effects, L) if once.responses else ()
            for first in range(0, self.windows * L, L):
                for response in each:
                    placed = np.zeros((samples, response.shape[1]))
                    placed[first : first + L] = response[: max(samples - first, 0)]
                    whole.append(placed)
            return whole

        spread = np.where(np.isfinite(once.state_spread), once.state_spread, _FREE_RAD)
        return replace(
            once,
            state_spread=np.tile(spread, self.windows),
            state_per_zero=np.tile(once.state_per_zero, (self.windows, 1)),
            guess=guess,
            responses=responses,
            tried=np.zeros((0, 0)),
        )

    def simulator(self, effects: Sequence[Effect]) -> Callable[..., Real]:
        simulate, L = self._once.simulator(effects), self.window_samples
        states = self._once.unknown_start.state_spread.size

        def outputs(inputs: Real, state: Real, zeros: Real, first_row: int = 0) -> Real:
            runs = [
                simulate(inputs[first : first + L], state[k * states : (k + 1) * states], zeros, first_row)
                for k, first in enumerate(range(0, len(inputs), L))
            ]
            return np.concatenate(runs)

        return outputs


@dataclass(frozen=True, eq=False)
class CaseInWindows(Case):
    """The case with its arm started anew in every window."""

    @property
    def machine(self) -> ArmInWindows:
        longest = max(len(e.output) for e in self.experiments)
        return ArmInWindows(self.rig, self.outputs, self.model_error, -(-longest // _WINDOWS), _WINDOWS)


def in_windows(case: Case) -> CaseInWindows:
    return CaseInWindows(case.name, case.rig, case.experiments, case.model_error)
