"""Simulation of a machine: whole records, and sample by sample for a closed loop."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from plant.effects import Effect, make_machine
from plant.kernel import run
from plant.machine import Machine, Real, SensorPath
from plant.modal import OUTPUT_NAMES
from plant.plan import SUBSTEP_S, make_plan
from plant.rig import Rig

F = TypeVar("F", float, Real)

# Column of what is observed (`plant.plan`) of every sensor, in the order of their noise (`_noise`).
_OBSERVED = {
    "hub_angle_rad": 0,
    "tip_m": 2,
    "tip_acceleration_m_s2": 3,
    "hub_speed_rad_s": 4,
    "tip_deflection_m": 5,
}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A simulated record; all arrays (T,), read-only.

    time_s : t_k = k dt.
    voltage_V : Commanded voltage, held over [t_k, t_(k+1)).
    hub_angle_rad, tip_m : As measured at t_k, before the voltage of the same row takes effect: with the
        effects on the sensors, and with noise if the simulation was given a generator.
    hub_angle_true_rad, tip_true_m : Before every sensor effect and without noise.
    tip_acceleration_m_s2 : Second derivative of the tip position as measured; zero unless the simulator has
        an accelerometer.
    hub_speed_rad_s, tip_deflection_m : Speed of the hub, and deflection of the tip from the straight link, as
        measured. The gain of the sensor is that of tip position, acceleration and deflection alike.
    """

    time_s: Real
    voltage_V: Real
    hub_angle_rad: Real
    tip_m: Real
    hub_angle_true_rad: Real
    tip_true_m: Real
    tip_acceleration_m_s2: Real
    hub_speed_rad_s: Real
    tip_deflection_m: Real

    def __post_init__(self) -> None:
        for entry in fields(self):
            array = np.array(getattr(self, entry.name), dtype=np.float64)
            if array.ndim != 1 or array.shape != np.shape(self.time_s):
                raise ValueError(f"{entry.name} must be (T,) like time_s; got shape {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, entry.name, array)

    @property
    def output(self) -> Real:
        """(T, 2): hub_angle_rad, tip_m as measured."""
        return self.columns(OUTPUT_NAMES)

    def columns(self, names: Sequence[str]) -> Real:
        """(T, Y): the quantities of these names."""
        return np.column_stack([getattr(self, name) for name in names])


@dataclass(frozen=True, eq=False)
class Start:
    """Where a record starts, if not at rest at zero.

    hub_angle_rad, hub_speed_rad_s : float. With the link straight behind the hub but for `deflections`.
    deflections, rates : (m,). Of the first m modes of the link (`plant.modal`), sqrt(kg) m and per second.
    voltage_V : float. Acting voltage up to the first sample.
    time_s : float. Of the first sample, for what depends on time: a disturbance, a drift.
    """

    hub_angle_rad: float = 0.0
    hub_speed_rad_s: float = 0.0
    deflections: Real = field(default_factory=lambda: np.zeros(0))
    rates: Real = field(default_factory=lambda: np.zeros(0))
    voltage_V: float = 0.0
    time_s: float = 0.0

    def vector(self) -> Real:
        """(3 + 2m,) as `plant.plan` takes it. Raises ValueError if deflections and rates differ in number."""
        if np.shape(self.deflections) != np.shape(self.rates):
            raise ValueError(f"as many rates as deflections: {len(self.deflections)}, {len(self.rates)}")
        scalars = [self.hub_angle_rad, self.hub_speed_rad_s, self.voltage_V]
        return np.concatenate([scalars, self.deflections, self.rates])


def simulate(
    rig: Rig,
    voltage_V: npt.ArrayLike,
    effects: Sequence[Effect] = (),
    *,
    rng: np.random.Generator | None = None,
    dt_s: float | None = None,
    hub_torque_Nm: npt.ArrayLike | None = None,
    tip_force_N: npt.ArrayLike | None = None,
    n_modes: int | None = None,
    substep_s: float = SUBSTEP_S,
) -> Trajectory:
    """Drive a machine from rest with a held voltage.

    rig, effects : The machine.
    voltage_V : (T,). Commanded voltage; before the first sample it is zero.
    rng : Source of the sensor noise; without it the measurement is noise-free.
    dt_s : Sampling period, if not the rig's.
    hub_torque_Nm, tip_force_N : (T,), optional
        Outside torque on the hub and transverse outside force at the tip, held over the sample.
    n_modes : Number of modes, if not `plant.modal.default_n_modes`.
    substep_s : Longest step where the machine is not linear; see `plant.plan`.

    Raises ValueError: one line: a signal that is not (T,) or not finite, dt_s that is not positive, an effect
    given twice.
    """
    simulator = Simulator(rig, effects, dt_s=dt_s, n_modes=n_modes, substep_s=substep_s)
    return simulator.run(voltage_V, rng=rng, hub_torque_Nm=hub_torque_Nm, tip_force_N=tip_force_N)


class Simulator:
    """A machine prepared once for many records; see `simulate` for arguments and errors.

    accelerometer: whether the tip's acceleration is observed too.
    """

    def __init__(
        self,
        rig: Rig,
        effects: Sequence[Effect] = (),
        *,
        dt_s: float | None = None,
        n_modes: int | None = None,
        substep_s: float = SUBSTEP_S,
        accelerometer: bool = False,
    ) -> None:
        self.machine = make_machine(rig, effects)
        self.accelerometer = accelerometer
        self.dt_s = rig.sampling.dt_s if dt_s is None else _positive("dt_s", dt_s)
        if n_modes is not None and not n_modes >= 1:
            raise ValueError(f"n_modes must be at least 1; got {n_modes}")
        self.plan = make_plan(
            self.machine, self.dt_s, n_modes, _positive("substep_s", substep_s), accelerometer=accelerometer
        )

    def run(
        self,
        voltage_V: npt.ArrayLike,
        *,
        rng: np.random.Generator | None = None,
        hub_torque_Nm: npt.ArrayLike | None = None,
        tip_force_N: npt.ArrayLike | None = None,
        start: Start | None = None,
    ) -> Trajectory:
        """One record, from rest at zero unless told."""
        voltage, begun_s = _signal("voltage_V", voltage_V, None), 0.0 if start is None else start.time_s
        observed = self._observed(slice(None), voltage, hub_torque_Nm, tip_force_N, start)
        time = np.arange(voltage.size, dtype=np.float64) * self.dt_s
        noise = _noise(self.machine, rng, voltage.size, accelerometer=self.accelerometer)
        read = {
            name: self._reading(name, observed[:, k], begun_s + time, own)
            for (name, k), own in zip(_OBSERVED.items(), noise.T, strict=True)
        }
        true = {"hub_angle_true_rad": observed[:, 0], "tip_true_m": observed[:, 1]}
        return Trajectory(time_s=time, voltage_V=voltage, **true, **read)

    def measured(
        self,
        names: Sequence[str],
        voltage_V: npt.ArrayLike,
        *,
        hub_torque_Nm: npt.ArrayLike | None = None,
        start: Start | None = None,
    ) -> Real:
        """(T, Y): the quantities of these names of one record, without noise."""
        voltage, begun_s = _signal("voltage_V", voltage_V, None), 0.0 if start is None else start.time_s
        observed = self._observed([_OBSERVED[name] for name in names], voltage, hub_torque_Nm, None, start)
        time = begun_s + np.arange(voltage.size, dtype=np.float64) * self.dt_s
        for name, column in zip(names, observed.T, strict=True):
            column[:] = self._reading(name, column, time, 0.0)
        return observed

    def _observed(
        self,
        columns: list[int] | slice,
        voltage: Real,
        hub_torque_Nm: npt.ArrayLike | None,
        tip_force_N: npt.ArrayLike | None,
        start: Start | None,
    ) -> Real:
        """(T, 6) as `plant.plan` orders them, or some columns of these."""
        plan, n_samples = self.plan, voltage.size
        before, begun_s = (0.0, 0.0) if start is None else (start.voltage_V, start.time_s)
        acting = np.full(plan.delay_samples + 1 + n_samples, before)
        acting[plan.delay_samples + 1 :] = self.machine.voltage.static(voltage)
        inputs = np.zeros((n_samples, 4))
        late, early = acting[:n_samples], acting[1 : n_samples + 1]
        inputs[:, 0], inputs[:, 1] = (late if plan.parts == 2 else early), early
        if hub_torque_Nm is not None:
            inputs[:, 2] = _signal("hub_torque_Nm", hub_torque_Nm, n_samples)
        if tip_force_N is not None:
            inputs[:, 3] = _signal("tip_force_N", tip_force_N, n_samples)
        states = plan.advance(inputs, plan.at(None if start is None else start.vector(), begun_s))
        return np.asarray(states @ plan.output_rows[columns].T)

    def _reading(self, name: str, values: Real, time_s: Real, noise: Real | float) -> Real:
        """(T,) of a sensor from what it observes (T,)."""
        sensor = self.machine.sensor
        if name == "tip_m":
            return _tip_reading(sensor, values, time_s, noise)
        return np.asarray((1.0 if name.startswith("hub") else sensor.gain) * values + noise)


class SampledArm(Simulator):
    """The machine as a controller sees it: measure at t_k, then hold a voltage until t_(k+1).

    Same compiled stepper and same numbers as `simulate`. The only object of this package with a state.

    encoder_step_rad: of the measured hub angle, 0 for none. tip_force_N (T,): acts at the tip from rest on,
    one value for each sample, beside what `advance` is given.
    """

    output_names = OUTPUT_NAMES

    def __init__(
        self,
        rig: Rig,
        effects: Sequence[Effect] = (),
        rng: np.random.Generator | None = None,
        *,
        dt_s: float | None = None,
        n_modes: int | None = None,
        substep_s: float = SUBSTEP_S,
        encoder_step_rad: float = 0.0,
        tip_force_N: Real | None = None,
    ) -> None:
        super().__init__(rig, effects, dt_s=dt_s, n_modes=n_modes, substep_s=substep_s)
        self._rng = rng
        self.encoder_step_rad, self.tip_force_N = encoder_step_rad, tip_force_N
        self._inputs = np.zeros((1, 4))
        self._rows = self.plan.output_rows
        self.reset()

    def reset(self) -> None:
        """Back to rest at time zero. The noise generator goes on; it is not rewound."""
        self._state = self.plan.at()
        self._sample = 0
        self._pending: deque[float] = deque([0.0] * (self.plan.delay_samples + 1))
        self._measurement: Real | None = None

    @property
    def true_output(self) -> Real:
        """(2,) hub_angle_rad, tip_m at t_k before sensor effects and noise."""
        return np.asarray((self._rows @ self._state.x)[:2])

    def measure(self) -> Real:
        """(2,) hub_angle_rad, tip_m at t_k as measured; asking twice at one instant gives the same sample."""
        if self._measurement is None:
            hub, _, tip, *_ = (self._rows @ self._state.x).tolist()
            hub_noise, tip_noise = (0.0, 0.0) if self._rng is None else self._rng.standard_normal(2).tolist()
            sensors = self.machine.rig.sensors
            time = self._sample * self.dt_s
            reading = _tip_reading(self.machine.sensor, tip, time, sensors.tip_noise_m * tip_noise)
            angle = hub + sensors.hub_angle_noise_rad * hub_noise
            self._measurement = quantised(np.array([angle, reading]), self.encoder_step_rad)
        return self._measurement.copy()

    def advance(self, voltage_V: float, hub_torque_Nm: float = 0.0, tip_force_N: float = 0.0) -> None:
        """Hold voltage, outside hub torque and outside tip force until t_(k+1)."""
        if not (abs(voltage_V) < np.inf and abs(hub_torque_Nm) < np.inf and abs(tip_force_N) < np.inf):
            raise ValueError(
                f"inputs must be finite; got {voltage_V} V, {hub_torque_Nm} N m, {tip_force_N} N"
            )
        if self._rng is not None and self._measurement is None:
            self.measure()  # every instant takes its noise, looked at or not
        self._pending.append(self.machine.voltage.static(float(voltage_V)))
        late = self._pending.popleft()
        row = self._inputs[0]
        row[0], row[1] = late if self.plan.parts == 2 else self._pending[0], self._pending[0]
        if self.tip_force_N is not None and self._sample < self.tip_force_N.size:
            tip_force_N += float(self.tip_force_N[self._sample])
        row[2], row[3] = hub_torque_Nm, tip_force_N
        self.plan.advance(self._inputs, self._state)
        self._sample += 1
        self._measurement = None

    def in_loop(
        self,
        signals: Real,
        law: Real,
        limits: Real,
        steps: Real,
        delay_samples: int,
        measured: int,
        clip: float = np.inf,
    ) -> tuple[Real, Real, npt.NDArray[np.bool_]]:
        """Outputs (T, 2), commands (T,) and whether they were limited (T,) of a loop, from rest: what
        `control_design.analysis.closed_loop.simulate` does, compiled.

        signals (T, 5) and the law's arrays as of `plant.kernel.run`; clip: of the machine's input.
        A subclass that measures or advances otherwise sets `in_loop` to None.
        """
        n, voltage, sensor = len(signals), self.machine.voltage, self.machine.sensor
        force, noise = np.zeros(n), np.zeros((n, 2))
        if self.tip_force_N is not None:
            force[: self.tip_force_N.size] = self.tip_force_N[:n]
        if self._rng is not None:
            levels = self.machine.rig.sensors
            noise = self._rng.standard_normal((n, 2)) * (levels.hub_angle_noise_rad, levels.tip_noise_m)
        output, command, limited = np.empty((n, 2)), np.empty(n), np.empty(n, dtype=np.bool_)
        state = self.plan.at()
        loop: tuple[Any, ...] = (
            np.column_stack([signals, force, noise]),
            law,
            limits,
            steps,
            np.array([clip, voltage.gain, voltage.dead_zone_V, voltage.limit_V]),
            np.array([self.encoder_step_rad, sensor.gain, sensor.drift_m_s * self.dt_s, sensor.step_m]),
            np.array([delay_samples, measured, self.plan.delay_samples, self.plan.parts]),
            np.ascontiguousarray(self._rows[[0, 2]]),
            output,
            command,
            limited,
        )
        run(np.zeros((1, 4)), np.empty((1, state.x.size)), *state, *self.plan.arguments, *loop)
        if not np.all(np.isfinite(command)):
            raise ValueError("the loop ran away: its command is not finite")
        return output, command, limited


def quantised(output: Real, encoder_step_rad: float) -> Real:
    """(..., 2) measured outputs with the hub angle rounded to encoder steps (0 = no encoder)."""
    if encoder_step_rad == 0:
        return output
    result = output.copy()
    result[..., 0] = encoder_step_rad * np.rint(output[..., 0] / encoder_step_rad)
    return result


def _noise(machine: Machine, rng: np.random.Generator | None, n_samples: int, *, accelerometer: bool) -> Real:
    """(T, 5) noise of hub angle, tip and, where there is one, accelerometer, drawn sample by sample; then of
    hub speed and deflection, where they have any."""
    noise = np.zeros((n_samples, 5))
    if rng is not None:
        sensors, drawn = machine.rig.sensors, 3 if accelerometer else 2
        levels = sensors.hub_angle_noise_rad, sensors.tip_noise_m, sensors.tip_acceleration_noise_m_s2
        noise[:, :drawn] = rng.standard_normal((n_samples, drawn)) * levels[:drawn]
        for column, level in ((3, sensors.hub_speed_noise_rad_s), (4, sensors.tip_deflection_noise_m)):
            if level > 0:
                noise[:, column] = level * rng.standard_normal(n_samples)
    return noise


def _tip_reading(sensor: SensorPath, tip: F, time_s: F, noise: F | float) -> F:
    """Gain, drift, noise and quantisation of a tip position that is already behind the sensor lag."""
    reading = sensor.gain * tip + sensor.drift_m_s * time_s + noise
    if sensor.step_m > 0:
        reading = sensor.step_m * np.rint(reading / sensor.step_m)
    return reading


def _positive(name: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise ValueError(f"{name} must be positive and finite; got {value}")
    return float(value)


def _signal(name: str, values: npt.ArrayLike, n_samples: int | None) -> Real:
    try:
        signal = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers: {error}") from error
    if signal.ndim == 2 and signal.shape[1] == 1:  # the one column of a record
        signal = signal[:, 0]
    if signal.ndim != 1 or signal.size == 0 or (n_samples is not None and signal.size != n_samples):
        raise ValueError(f"{name} must have shape ({n_samples or 'T'},), T >= 1; got {signal.shape}")
    if not np.all(np.isfinite(signal)):
        first = int(np.flatnonzero(~np.isfinite(signal))[0])
        raise ValueError(f"{name} must be finite; got {signal[first]} at sample {first}")
    return signal
