"""A flexible link on a motor, described by a rig, as a machine the diagnosis can ask.

Shapes: T rows of a record, Y outputs, S = 2 + 2 m states of a start (hub angle [rad], hub speed [rad/s], then
deflections and rates of the link's first m modes), Z sensors whose zero is not known.
"""

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

# Output -> key of its noise in the `sensors` of a rig.
NOISE: dict[Output, str] = {
    "hub_angle_rad": "hub_angle_noise_rad",
    "tip_m": "tip_noise_m",
    "tip_acceleration_m_s2": "tip_acceleration_noise_m_s2",
    "hub_speed_rad_s": "hub_speed_noise_rad_s",
    "tip_deflection_m": "tip_deflection_noise_m",
}
# What a sensor's zero may be off by, in the output's unit (standard deviation): an encoder's by any angle, a
# tenth of gravity of an accelerometer, a mounting by centimetres. Chosen wide: any record tells them far
# better. That of tip_m is known: it is where the tip stands on the straight arm.
_ZERO: dict[Output, float] = {
    "hub_angle_rad": np.pi,
    "tip_acceleration_m_s2": 1.0,
    "hub_speed_rad_s": 1.0,
    "tip_deflection_m": 0.05,
}
_HUB_ANGLE: Output = "hub_angle_rad"
_TIP: Output = "tip_m"
_ACCELERATION: Output = "tip_acceleration_m_s2"
# Modes of the link that may still swing when a record starts; higher ones are damped out. Chosen.
_START_MODES = 2
# Standard deviation of the hub's speed when a record starts. Chosen wide; a small machine does not reach it.
_START_SPEED_RAD_S = 5.0
# The same of the deflections of modes [sqrt(kg) m].
_START_DEFLECTION = 1.0
# The same of their rates [sqrt(kg) m/s].
_START_RATE = 20.0
# Hub speeds that are tried as a start beside contacts that switch: in free play the hub drifts until it
# touches, however slowly it did at first. Seven each way, from one that takes ten seconds through a gap of
# 0.03 rad to one that takes a third of a second; chosen.
_DRIFTS_RAD_S = np.outer([-1.0, 1.0], np.geomspace(3e-3, 0.1, 7)).ravel()
# Modes of a simulation beside a model error of per cents: within a thousandth of the motion in a third of the
# time, but for bounces in a wide gap, which no step repeats.
_COARSE_MODES = 3
# Modes of it with an accelerometer, which feels modes that angles do not: on a light link three miss 2.6 % of
# an acceleration, four 1.3 %.
_COARSE_ACCELERATION_MODES = 4
# Its steps, seconds: eight of a usual one, with the accuracy stated for its modes.
_COARSE_STEP_S = 8 * SUBSTEP_S
# Samples between the angles whose difference is a mean speed: that holds a tenth of the noise of a difference
# of neighbours. It gives ranges only; chosen.
_SPEED_SAMPLES = 10


@dataclass(frozen=True, eq=False)
class FlexibleArm:
    """A rig with the effects of `plant.effects`: voltage (T, 1) [V] -> the outputs (T, Y) that are measured.

    Parameters
    ----------
    rig : Rig
        The arm as its makers know it.
    outputs : (Y,) names
        The hub angle first.
    model_error : float
        Share of the motion (RMS of an output about its mean) that a good model may miss. Above zero the
        simulation is coarser and faster, and starts of records and zeros of sensors are unknown.
    """

    rig: Rig
    outputs: tuple[Output, ...] = ("hub_angle_rad", "tip_m")
    model_error: float = 0.0

    input_names = ("voltage_V",)

    @property
    def output_names(self) -> Sequence[str]:
        """(Y,) names of the outputs, which end with their units."""
        return self.outputs

    @property
    def noise(self) -> Real:
        """(Y,) noise standard deviations of the outputs, in their units."""
        return np.array([self.rig.value(f"sensors.{NOISE[name]}") for name in self.outputs])

    @property
    def tolerances(self) -> Mapping[str, float]:
        """Key of a value of the rig -> its relative standard deviation."""
        return self.rig.tolerances

    @property
    def weighing(self) -> Weighing:
        """All effects of the registry, with this model error."""
        return Weighing(model_error=self.model_error)

    @property
    def description(self) -> Rig:
        """The rig."""
        return self.rig

    def scaled(self, factors: Mapping[str, float]) -> FlexibleArm:
        """The arm with values of its rig multiplied by factors (key -> factor)."""
        return replace(self, rig=self.rig.scaled(factors))

    @property
    def _unknown_zeros(self) -> list[int]:
        """(Z,) columns of the outputs whose sensor's zero is not known."""
        return [column for column, name in enumerate(self.outputs) if name in _ZERO]

    @property
    def unknown_start(self) -> UnknownStart:
        """Beside a model error hub angle and speed, first modes of the link, zeros of the sensors; else
        nothing is unknown: records start at rest at zero."""
        if not self.model_error > 0:
            return KNOWN_START
        of_modes = [_START_DEFLECTION] * _START_MODES + [_START_RATE] * _START_MODES
        spread = np.array([np.inf, _START_SPEED_RAD_S, *of_modes])
        columns = self._unknown_zeros
        # The guess of the hub angle is a reading of the first sensor: a higher zero is a lower angle.
        state_per_zero = np.zeros((spread.size, len(columns)))
        state_per_zero[0, 0] = -1.0
        drifts = np.zeros((_DRIFTS_RAD_S.size, spread.size))
        drifts[:, 1] = _DRIFTS_RAD_S
        return UnknownStart(
            state_spread=spread,
            zero_spread=np.array([_ZERO[self.outputs[column]] for column in columns]),
            zero_outputs=np.eye(len(self.outputs))[columns],
            state_per_zero=state_per_zero,
            guess=_at_rest_as_read,
            responses=self._responses,
            zero_seen=_TIP in self.outputs,
            tried=drifts,
        )

    def _responses(self, effects: Sequence[Effect], samples: int) -> list[Real]:
        """(S,) arrays (samples, Y): outputs without voltage per unit of each state of the start.

        Effects that are not linear are left out: what they make of a start is not proportional to it.
        """
        linear = [effect for effect in effects if make_machine(self.rig, [effect]).linear]
        simulate = self.simulator(linear)
        no_voltage = np.zeros((samples, 1))
        return [simulate(no_voltage, state) for state in np.eye(2 + 2 * _START_MODES)]

    def simulator(self, effects: Sequence[Effect]) -> Callable[..., Real]:
        """Voltage (T, 1) -> outputs (T, Y) without noise, of the rig with these effects.

        Further arguments: state (S,) of the start, None for rest at zero; zeros (Z,) that the readings are
        off by; first_row of the run that the record is a part of, for what depends on time, which only a
        state brings: from rest at zero the run begins with the record.
        """
        prepared = self._prepared(effects)
        dt_s = self.rig.sampling.dt_s
        columns = self._unknown_zeros

        def outputs(
            inputs: Real, state: Real | None = None, zeros: Real | None = None, first_row: int = 0
        ) -> Real:
            start = None
            if state is not None:
                start = Start(
                    hub_angle_rad=state[0],
                    hub_speed_rad_s=state[1],
                    deflections=state[2 : 2 + _START_MODES],
                    rates=state[2 + _START_MODES :],
                    time_s=first_row * dt_s,
                )
            measured = prepared.measured(self.outputs, inputs[:, 0], start=start)
            if zeros is not None:
                measured[:, columns] += zeros
            return measured

        return outputs

    def _prepared(self, effects: Sequence[Effect]) -> Simulator:
        """The rig with effects, prepared for many records; coarser beside a model error."""
        accelerometer = _ACCELERATION in self.outputs
        if not self.model_error > 0:
            return Simulator(self.rig, effects, accelerometer=accelerometer)
        modes = _COARSE_ACCELERATION_MODES if accelerometer else _COARSE_MODES
        return Simulator(
            self.rig, effects, n_modes=modes, substep_s=_COARSE_STEP_S, accelerometer=accelerometer
        )

    def torque_response(self, samples: int) -> tuple[Real, float]:
        """(samples, Y) outputs after 1 N m on the hub over the first sample, and the sampling period [s]."""
        pulse = np.zeros((samples, 1))
        pulse[0] = 1.0
        return self.pushed(np.zeros((samples, 1)), pulse), self.rig.sampling.dt_s

    def force_places(self, inputs: int) -> tuple[ForcePlace, ...]:
        """The hub, on which a torque acts [N m]; `inputs` is always one, the voltage."""
        return (ForcePlace("hub", "N m", motion=self.outputs.index(_HUB_ANGLE), command=0),)

    def other_coordinates(self, outputs: Real) -> dict[str, Real]:
        """Deflection (T,) of the link [m], of outputs (T, Y) that hold the tip's position; else nothing."""
        if _TIP not in self.outputs:
            return {}
        reach_m = self.rig.hub.radius_m + self.rig.link.length_m
        angle = outputs[:, self.outputs.index(_HUB_ANGLE)]
        tip = outputs[:, self.outputs.index(_TIP)]
        return {"deflection_m": tip - reach_m * angle}

    def pushed(self, inputs: Real, forces: Real) -> Real:
        """(T, Y) outputs of the nominal rig from rest under voltage (T, 1) and hub torque (T, 1) [N m].

        Without noise; both are held over each sample.
        """
        return self._prepared(()).measured(self.outputs, inputs[:, 0], hub_torque_Nm=forces[:, 0])

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        """Every effect of the registry that a fit can find, as search spaces; signed ones twice.

        Ranges are multiples of the largest voltage and motion of the records. A sensor of the link that is
        not `tip_m` has only its gain as a candidate, a rig with neither has no effect of a sensor at all.
        """
        dt_s = self.rig.sampling.dt_s
        angles = [e.output[:, 0] for e in experiments]
        changes = [np.max(np.abs(angle[_SPEED_SAMPLES:] - angle[:-_SPEED_SAMPLES])) for angle in angles]
        scales = Scales(
            self.rig,
            voltage_V=max(float(np.max(np.abs(e.input))) for e in experiments),
            angle_rad=max(float(np.max(np.abs(angle))) for angle in angles),
            swing_rad=max(float(np.ptp(angle)) for angle in angles),
            speed_rad_s=max(float(change) / _SPEED_SAMPLES for change in changes) / dt_s,
            duration_s=max(len(e.input) for e in experiments) * dt_s,
            any_direction=self.model_error > 0 and _TIP in self.outputs,
        )
        senses_link = bool(set(self.outputs) - {"hub_angle_rad", "hub_speed_rad_s"})
        candidates: list[Candidate] = []
        for effect in EFFECTS.values():
            only_a_gain = effect.group == "sensor" and _TIP not in self.outputs
            if only_a_gain and not (senses_link and effect.id == "sensor_gain"):
                continue
            candidates += effect.candidates(scales)
        return tuple(candidates)


def _at_rest_as_read(record: RecordOfMachine) -> Real:
    """(S,) a start at rest in the hub angle that a record reads first."""
    state = np.zeros(2 + 2 * _START_MODES)
    state[0] = record.output[0, 0]
    return state
