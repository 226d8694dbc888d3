"""A flexible link on a motor, described by a rig, as a machine the diagnosis can ask."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.machine.force_places import ForcePlace
from diagnosis.machine.machine_protocol import KNOWN_START, Real, RecordOfMachine, UnknownStart, Weighing
from plant.effects import EFFECTS, Effect, make_machine
from plant.effects.search_space import Candidate, Scales
from plant.plan import SUBSTEP_S
from plant.rig import Output, Rig
from plant.simulation import Simulator, Start

NOISE: dict[Output, str] = {
    "hub_angle_rad": "hub_angle_noise_rad",
    "tip_m": "tip_noise_m",
    "tip_acceleration_m_s2": "tip_acceleration_noise_m_s2",
    "hub_speed_rad_s": "hub_speed_noise_rad_s",
    "tip_deflection_m": "tip_deflection_noise_m",
}
# What a zero may be off by (standard deviation): an encoder's by any angle; that of tip_m is known.
_ZERO: dict[Output, float] = {
    "hub_angle_rad": np.pi,
    "tip_acceleration_m_s2": 1.0,
    "hub_speed_rad_s": 1.0,
    "tip_deflection_m": 0.05,
}
_TIP: Output = "tip_m"
_ACCELERATION: Output = "tip_acceleration_m_s2"
# Unknown starts: modes of the link that may still swing, and how far anything may be from rest.
_MODES = 2
_SPEED_RAD_S, _DEFLECTION, _RATE = 5.0, 1.0, 20.0
# In free play the hub drifts until it touches, however slowly it did at first.
_DRIFTS_RAD_S = np.outer([-1.0, 1.0], np.geomspace(3e-3, 0.1, 7)).ravel()
# Beside a model error of per cents: within a thousandth of the motion in a third of the time, but for bounces
# in a wide gap, which no step repeats. Accelerations feel modes that angles do not: on a light link three
# miss 2.6 % of one, four 1.3 %.
_COARSE_MODES, _COARSE_ACCELERATION_MODES, _COARSE_S = 3, 4, 8 * SUBSTEP_S
_SPEED_SAMPLES = 10  # a mean over these holds a tenth of the noise of a difference of neighbours


@dataclass(frozen=True, eq=False)
class FlexibleArm:
    """A rig with the registry of `plant.effects`: voltage (T, 1) -> the outputs (T, Y) that are measured."""

    rig: Rig
    outputs: tuple[Output, ...] = ("hub_angle_rad", "tip_m")
    model_error: float = 0.0

    input_names = ("voltage_V",)

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
        """Beside a model error: hub angle and speed, first modes of the link, zeros of the sensors."""
        if not self.model_error > 0:
            return KNOWN_START
        spread = [np.inf, _SPEED_RAD_S, *[_DEFLECTION] * _MODES, *[_RATE] * _MODES]
        moved = [k for k, name in enumerate(self.outputs) if name in _ZERO]
        per_zero = np.zeros((len(spread), len(moved)))
        per_zero[0, 0] = -1.0
        return UnknownStart(
            np.array(spread),
            np.array([_ZERO[self.outputs[k]] for k in moved]),
            np.eye(len(self.outputs))[moved],
            per_zero,
            lambda record: np.array([record.output[0, 0], *[0.0] * (1 + 2 * _MODES)]),
            self._responses,
            zero_seen=_TIP in self.outputs,
            tried=np.outer(_DRIFTS_RAD_S, np.eye(len(spread))[1]),
        )

    def _responses(self, effects: Sequence[Effect], samples: int) -> list[Real]:
        linear = [effect for effect in effects if make_machine(self.rig, [effect]).linear]
        simulate, still = self.simulator(linear), np.zeros((samples, 1))
        return [simulate(still, state) for state in np.eye(2 + 2 * _MODES)]

    def simulator(self, effects: Sequence[Effect]) -> Callable[..., Real]:
        prepared = self._prepared(effects)
        moved = [k for k, name in enumerate(self.outputs) if name in _ZERO]

        def outputs(
            inputs: Real, state: Real | None = None, zeros: Real | None = None, first_row: int = 0
        ) -> Real:
            start = None
            if state is not None:
                modes, time_s = state[2:], first_row * self.rig.sampling.dt_s
                start = Start(state[0], state[1], modes[:_MODES], modes[_MODES:], time_s=time_s)
            found = prepared.measured(self.outputs, inputs[:, 0], start=start)
            if zeros is not None:
                found[:, moved] += zeros
            return found

        return outputs

    def _prepared(self, effects: Sequence[Effect]) -> Simulator:
        accelerometer = _ACCELERATION in self.outputs
        if not self.model_error > 0:
            return Simulator(self.rig, effects, accelerometer=accelerometer)
        modes = _COARSE_ACCELERATION_MODES if accelerometer else _COARSE_MODES
        return Simulator(self.rig, effects, n_modes=modes, substep_s=_COARSE_S, accelerometer=accelerometer)

    def torque_response(self, samples: int) -> tuple[Real, float]:
        pulse = np.zeros(samples)
        pulse[0] = 1.0
        found = self._prepared(()).measured(self.outputs, np.zeros(samples), hub_torque_Nm=pulse)
        return found, self.rig.sampling.dt_s

    def force_places(self, inputs: int) -> tuple[ForcePlace, ...]:
        """The hub, on which a torque acts [N m]; `inputs` is always one, the voltage."""
        return (ForcePlace("hub", "N m", motion=self.outputs.index("hub_angle_rad"), command=0),)

    def other_coordinates(self, outputs: Real) -> dict[str, Real]:
        """The deflection (T,) of the link [m], of outputs (T, Y) that hold the tip's position."""
        if _TIP not in self.outputs:
            return {}
        reach = self.rig.hub.radius_m + self.rig.link.length_m
        angle, tip = (outputs[:, self.outputs.index(name)] for name in ("hub_angle_rad", _TIP))
        return {"deflection_m": tip - reach * angle}

    def pushed(self, inputs: Real, forces: Real) -> Real:
        """(T, Y) outputs of the nominal rig from rest under the voltage (T, 1) and a hub torque (T, 1) [N
        m]."""
        return self._prepared(()).measured(self.outputs, inputs[:, 0], hub_torque_Nm=forces[:, 0])

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        """Every effect of the registry that a fit can find; signed ones twice. Of a sensor of the link that
        is not tip_m only its gain is one. Magnitudes: of the largest motion, speeds means of ten samples."""
        angles = [e.output[:, 0] for e in experiments]
        k, dt = _SPEED_SAMPLES, self.rig.sampling.dt_s
        scales = Scales(
            self.rig,
            voltage_V=max(float(np.max(np.abs(e.input))) for e in experiments),
            angle_rad=max(float(np.max(np.abs(angle))) for angle in angles),
            swing_rad=max(float(np.ptp(angle)) for angle in angles),
            speed_rad_s=max(float(np.max(np.abs(angle[k:] - angle[:-k]))) / k for angle in angles) / dt,
            duration_s=max(len(e.input) for e in experiments) * dt,
            any_direction=self.model_error > 0 and _TIP in self.outputs,
        )
        gain = ("sensor_gain",) if set(self.outputs) - {"hub_angle_rad", "hub_speed_rad_s"} else ()
        seen = [
            effect
            for effect in EFFECTS.values()
            if effect.group != "sensor" or _TIP in self.outputs or effect.id in gain
        ]
        return tuple(found for effect in seen for found in effect.candidates(scales))
