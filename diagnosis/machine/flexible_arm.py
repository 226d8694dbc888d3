"""A flexible link on a motor, described by a rig, as a machine the diagnosis can ask."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.machine.machine_protocol import KNOWN_START, Real, RecordOfMachine, UnknownStart, Weighing
from plant.effects import EFFECTS, Effect, make_machine
from plant.effects.search_space import Candidate, Scales
from plant.plan import SUBSTEP_S
from plant.rig import Output, Rig
from plant.simulation import Simulator, Start

"""What a flexible link can be measured by, in the order of a record's columns."""

NOISE: dict[Output, str] = {
    "hub_angle_rad": "hub_angle_noise_rad",
    "tip_m": "tip_noise_m",
    "tip_acceleration_m_s2": "tip_acceleration_noise_m_s2",
}
_TIP: Output = "tip_m"
_ACCELERATION: Output = "tip_acceleration_m_s2"
# Unknown starts: modes of the link that may still swing, and how far anything may be from rest.
_MODES = 2
_SPEED_RAD_S, _DEFLECTION, _RATE = 5.0, 1.0, 20.0
# Beside a model error of per cents: within a thousandth of the motion in a third of the time.
_COARSE_MODES, _COARSE_S = 3, 4 * SUBSTEP_S
_SPEED_SAMPLES = 10


@dataclass(frozen=True, eq=False)
class FlexibleArm:
    """A rig with the registry of `plant.effects`: voltage (T, 1) -> the outputs (T, Y) that are measured."""

    rig: Rig
    outputs: tuple[Output, ...] = ("hub_angle_rad", "tip_m")
    model_error: float = 0.0

    @property
    def output_names(self) -> Sequence[str]:
        return self.outputs

    @property
    def noise(self) -> Real:
        return np.array([self.rig.value(f"sensors.{NOISE[name]}") for name in self.outputs])

    @property
    def tolerances(self) -> Mapping[str, float]:
        return self.rig.tolerances

    @property
    def weighing(self) -> Weighing:
        return Weighing(model_error=self.model_error)

    @property
    def description(self) -> Rig:
        return self.rig

    def scaled(self, factors: Mapping[str, float]) -> FlexibleArm:
        return replace(self, rig=self.rig.scaled(factors))

    @property
    def unknown_start(self) -> UnknownStart:
        """Beside a model error: hub angle and speed, first modes of the link, and the encoder's zero."""
        if not self.model_error > 0:
            return KNOWN_START
        spread = [np.inf, _SPEED_RAD_S, *[_DEFLECTION] * _MODES, *[_RATE] * _MODES]
        hub = np.eye(len(self.outputs))[:1]
        per_zero = -np.eye(len(spread))[:, :1]
        return UnknownStart(
            np.array(spread),
            np.array([np.pi]),
            hub,
            per_zero,
            self._first_sample,
            self._responses,
            zero_seen=_TIP in self.outputs,
        )

    def _first_sample(self, record: RecordOfMachine) -> Real:
        return np.array([record.output[0, 0], *[0.0] * (1 + 2 * _MODES)])

    def _responses(self, effects: Sequence[Effect], samples: int) -> list[Real]:
        linear = [effect for effect in effects if make_machine(self.rig, [effect]).linear]
        simulate, still = self.simulator(linear), np.zeros((samples, 1))
        return [simulate(still, state, np.zeros(1)) for state in np.eye(2 + 2 * _MODES)]

    def simulator(self, effects: Sequence[Effect]) -> Callable[..., Real]:
        prepared = self._prepared(effects)

        def outputs(inputs: Real, state: Real | None = None, zeros: Real | None = None) -> Real:
            start = None
            if state is not None:
                start = Start(state[0], state[1], state[2 : 2 + _MODES], state[2 + _MODES :])
            found = prepared.run(inputs[:, 0], start=start).columns(self.outputs)
            if zeros is not None:
                found[:, 0] += zeros[0]
            return found

        return outputs

    def _prepared(self, effects: Sequence[Effect]) -> Simulator:
        accelerometer = _ACCELERATION in self.outputs
        if not self.model_error > 0:
            return Simulator(self.rig, effects, accelerometer=accelerometer)
        return Simulator(
            self.rig, effects, n_modes=_COARSE_MODES, substep_s=_COARSE_S, accelerometer=accelerometer
        )

    def torque_response(self, samples: int) -> tuple[Real, float]:
        pulse = np.zeros(samples)
        pulse[0] = 1.0
        found = self._prepared(()).run(np.zeros(samples), hub_torque_Nm=pulse).columns(self.outputs)
        return found, self.rig.sampling.dt_s

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        """Every effect of the registry that a fit can find; signed ones twice. Those on the sensor of tip_m
        only where it is measured."""
        scales = scales_of(self.rig, experiments)
        seen = [effect for effect in EFFECTS.values() if effect.group != "sensor" or _TIP in self.outputs]
        return tuple(found for effect in seen for found in effect.candidates(scales))


def scales_of(rig: Rig, experiments: Sequence[RecordOfMachine]) -> Scales:
    """Magnitudes of the largest motion in the records; speeds are means over ten samples."""
    angles = [e.output[:, 0] for e in experiments]
    k, dt = _SPEED_SAMPLES, rig.sampling.dt_s
    return Scales(
        rig,
        voltage_V=max(float(np.max(np.abs(e.input))) for e in experiments),
        angle_rad=max(float(np.max(np.abs(angle))) for angle in angles),
        swing_rad=max(float(np.ptp(angle)) for angle in angles),
        speed_rad_s=max(float(np.max(np.abs(angle[k:] - angle[:-k]))) / k for angle in angles) / dt,
        duration_s=max(len(e.input) for e in experiments) * dt,
    )
