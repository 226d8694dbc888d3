"""Simulation of a machine: whole records, and sample by sample for a closed loop.

`simulate` makes one record of a rig with effects. `Simulator` prepares a machine once for many records: the
voltage path is applied to the command, the compiled stepper (`plant.plan`, `plant.kernel`) gives the states,
rows of the plan what sensors observe, and the sensor path their readings, to which white noise is added.
`SampledArm` is the machine as a controller sees it, by the same stepper: `measure`, `advance`, or a whole
loop compiled in `in_loop`. Inputs are held over a sample; sensors read at its start, before the input takes
effect.
"""

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

# Column of what is observed (`plant.plan.Plan.output_rows`) for every sensor, in the order of their noise
# (`_noise`). Column 1, the true tip, is behind no sensor; the tip sensor reads column 2, behind its lag.
_OBSERVED = {
    "hub_angle_rad": 0,
    "tip_m": 2,
    "tip_acceleration_m_s2": 3,
    "hub_speed_rad_s": 4,
    "tip_deflection_m": 5,
}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A simulated record; all arrays (T,), read-only. Raises ValueError where one has another shape.

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
            # Set once, against the frozen class: several readers share a record.
            array.setflags(write=False)
            object.__setattr__(self, entry.name, array)

    @property
    def output(self) -> Real:
        """Outputs (T, 2): hub_angle_rad and tip_m as measured."""
        return self.columns(OUTPUT_NAMES)

    def columns(self, names: Sequence[str]) -> Real:
        """Quantities (T, Y) of these names, which are names of the class's fields."""
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
        """Start (3 + 2m,) for `Plan.at`: hub angle, hub speed, voltage, deflections, rates.

        Raises ValueError if deflections and rates differ in number.
        """
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
    """Record of a machine that is driven from rest with a held voltage.

    Parameters
    ----------
    rig : Rig
        The nominal arm.
    effects : sequence of Effect
        What the machine has beside it.
    voltage_V : (T,)
        Commanded voltage; before the first sample it is zero.
    rng : numpy.random.Generator, optional
        Source of the sensor noise; without it the measurement is noise-free.
    dt_s : float, optional
        Sampling period, if not the rig's.
    hub_torque_Nm, tip_force_N : (T,), optional
        Outside torque on the hub and transverse outside force at the tip, held over the sample.
    n_modes : int, optional
        Number of modes, if not `plant.modal.default_n_modes`.
    substep_s : float
        Longest step where the machine is not linear; see `plant.plan`.

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        In one line: a signal that is not (T,) or not finite, dt_s that is not positive, an effect given
        twice.
    """
    simulator = Simulator(rig, effects, dt_s=dt_s, n_modes=n_modes, substep_s=substep_s)
    return simulator.run(voltage_V, rng=rng, hub_torque_Nm=hub_torque_Nm, tip_force_N=tip_force_N)


class Simulator:
    """A machine prepared once for many records; see `simulate` for arguments and errors.

    accelerometer : bool
        The tip's acceleration is observed too.
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
        self.dt_s = rig.sampling.dt_s
        if dt_s is not None:
            self.dt_s = _positive("dt_s", dt_s)
        if n_modes is not None and not n_modes >= 1:
            raise ValueError(f"n_modes must be at least 1; got {n_modes}")
        longest_step_s = _positive("substep_s", substep_s)
        self.plan = make_plan(self.machine, self.dt_s, n_modes, longest_step_s, accelerometer=accelerometer)

    def run(
        self,
        voltage_V: npt.ArrayLike,
        *,
        rng: np.random.Generator | None = None,
        hub_torque_Nm: npt.ArrayLike | None = None,
        tip_force_N: npt.ArrayLike | None = None,
        start: Start | None = None,
    ) -> Trajectory:
        """One record, from rest at zero unless a start is stated; arguments and errors as of `simulate`.

        start : Start, optional
            State and time of the first sample. The record's own time begins at zero all the same.
        """
        voltage = _signal("voltage_V", voltage_V, None)
        observed = self._observed(slice(None), voltage, hub_torque_Nm, tip_force_N, start)
        time_s = np.arange(voltage.size, dtype=np.float64) * self.dt_s
        # What drifts has drifted since time zero of the start.
        sensor_time_s = (0.0 if start is None else start.time_s) + time_s
        noise = _noise(self.machine, rng, voltage.size, accelerometer=self.accelerometer)
        readings = {}
        for (name, column), sensor_noise in zip(_OBSERVED.items(), noise.T, strict=True):
            readings[name] = self._reading(name, observed[:, column], sensor_time_s, sensor_noise)
        return Trajectory(
            time_s=time_s,
            voltage_V=voltage,
            hub_angle_true_rad=observed[:, 0],
            tip_true_m=observed[:, 1],
            **readings,
        )

    def measured(
        self,
        names: Sequence[str],
        voltage_V: npt.ArrayLike,
        *,
        hub_torque_Nm: npt.ArrayLike | None = None,
        start: Start | None = None,
    ) -> Real:
        """Quantities (T, Y) of these names of one record, as sensors read them but without noise.

        names : of `plant.rig.Output`. Otherwise like `run`, and faster: only what is asked for is made.

        Raises ValueError for another name, and as `run`.
        """
        unknown = [name for name in names if name not in _OBSERVED]
        if unknown:
            raise ValueError(f"no sensor is called {unknown[0]!r}; expected names out of {list(_OBSERVED)}")
        voltage = _signal("voltage_V", voltage_V, None)
        columns = [_OBSERVED[name] for name in names]
        observed = self._observed(columns, voltage, hub_torque_Nm, None, start)
        begin_s = 0.0 if start is None else start.time_s
        time_s = begin_s + np.arange(voltage.size, dtype=np.float64) * self.dt_s
        for name, values in zip(names, observed.T, strict=True):
            values[:] = self._reading(name, values, time_s, 0.0)
        return observed

    def _observed(
        self,
        columns: list[int] | slice,
        voltage: Real,
        hub_torque_Nm: npt.ArrayLike | None,
        tip_force_N: npt.ArrayLike | None,
        start: Start | None,
    ) -> Real:
        """What sensors observe, (T, 6) in the columns of `Plan.output_rows`, or some of these columns.

        voltage (T,): as commanded, V; checked already, unlike torque and force.
        """
        plan = self.plan
        n_samples = voltage.size
        before_V = 0.0
        begin_s = 0.0
        if start is not None:
            before_V = start.voltage_V
            begin_s = start.time_s
        # Acting voltages, the first of them those of the whole samples of the delay and of one more.
        acting = np.full(plan.delay_samples + 1 + n_samples, before_V)
        acting[plan.delay_samples + 1 :] = self.machine.voltage.static(voltage)
        inputs = np.zeros((n_samples, 4))
        inputs[:, 1] = acting[1 : n_samples + 1]
        # In the first part of a divided sample the voltage of the sample before still acts.
        if plan.parts == 2:
            inputs[:, 0] = acting[:n_samples]
        else:
            inputs[:, 0] = inputs[:, 1]
        if hub_torque_Nm is not None:
            inputs[:, 2] = _signal("hub_torque_Nm", hub_torque_Nm, n_samples)
        if tip_force_N is not None:
            inputs[:, 3] = _signal("tip_force_N", tip_force_N, n_samples)
        start_vector = None if start is None else start.vector()
        states = plan.advance(inputs, plan.at(start_vector, begin_s))
        return np.asarray(states @ plan.output_rows[columns].T)

    def _reading(self, name: str, values: Real, time_s: Real, noise: Real | float) -> Real:
        """Readings (T,) of the sensor of this name from what it observes, values (T,).

        Drift and quantisation are effects of the tip's position sensor; every sensor at the tip has its gain.
        """
        sensor = self.machine.sensor
        if name == "tip_m":
            return _tip_reading(sensor, values, time_s, noise)
        gain = 1.0 if name.startswith("hub") else sensor.gain
        return np.asarray(gain * values + noise)


class SampledArm(Simulator):
    """The machine as a controller sees it: measure at t_k, then hold a voltage until t_(k+1).

    Same compiled stepper and same numbers as `simulate`. It has a state: `measure`, `advance`, `reset`.

    Parameters
    ----------
    rig : Rig
        The nominal arm.
    effects : sequence of Effect
        What the machine has beside it.
    rng : numpy.random.Generator, optional
        Source of the sensor noise; without it the measurement is noise-free.
    dt_s : float, optional
        Sampling time, s; by default the rig's.
    n_modes : int, optional
        Modes of the link; by default those that the sampling time shows.
    substep_s : float
        Longest step, s, where the machine is not linear.
    encoder_step_rad : float
        Step of the measured hub angle, 0 for none.
    tip_force_N : (T,), optional
        Acts at the tip from rest on, one value for each sample, beside what `advance` is given.

    Raises
    ------
    ValueError
        A time, a number of modes or an effect that cannot be.

    Examples
    --------
    >>> arm = flexlink.SampledArm(flexlink.paper_link(), encoder_step_rad=0.001)
    >>> arm.advance(6.0)
    >>> arm.measure().shape
    (2,)
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
        self.encoder_step_rad = encoder_step_rad
        self.tip_force_N = tip_force_N
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
        """Outputs (2,) hub_angle_rad, tip_m at t_k before sensor effects and noise."""
        return np.asarray((self._rows @ self._state.x)[:2])

    def measure(self) -> Real:
        """Outputs (2,) hub_angle_rad, tip_m at t_k as measured; asked twice, the same sample."""
        if self._measurement is None:
            hub, _, tip, *_ = (self._rows @ self._state.x).tolist()
            hub_noise = 0.0
            tip_noise = 0.0
            if self._rng is not None:
                hub_noise, tip_noise = self._rng.standard_normal(2).tolist()
            sensors = self.machine.rig.sensors
            time_s = self._sample * self.dt_s
            reading = _tip_reading(self.machine.sensor, tip, time_s, sensors.tip_noise_m * tip_noise)
            angle = hub + sensors.hub_angle_noise_rad * hub_noise
            self._measurement = quantised(np.array([angle, reading]), self.encoder_step_rad)
        return self._measurement.copy()

    def advance(self, voltage_V: float, hub_torque_Nm: float = 0.0, tip_force_N: float = 0.0) -> None:
        """Hold voltage, outside hub torque and outside tip force until t_(k+1).

        Raises ValueError where one of them is not finite.
        """
        if not (abs(voltage_V) < np.inf and abs(hub_torque_Nm) < np.inf and abs(tip_force_N) < np.inf):
            raise ValueError(
                f"inputs must be finite; got {voltage_V} V, {hub_torque_Nm} N m, {tip_force_N} N"
            )
        if self._rng is not None and self._measurement is None:
            self.measure()  # every instant takes its noise, looked at or not
        # Behind the whole samples of the delay: the voltage that acts, and the one before it, which still
        # acts in the first part of a divided sample.
        self._pending.append(self.machine.voltage.static(float(voltage_V)))
        earlier_V = self._pending.popleft()
        acting_V = self._pending[0]
        row = self._inputs[0]
        row[0] = acting_V
        if self.plan.parts == 2:
            row[0] = earlier_V
        row[1] = acting_V
        if self.tip_force_N is not None and self._sample < self.tip_force_N.size:
            tip_force_N += float(self.tip_force_N[self._sample])
        row[2] = hub_torque_Nm
        row[3] = tip_force_N
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
        """Outputs (T, 2), commands (T,) and whether they were limited (T,) of a closed loop, from rest.

        The numbers are those of `control_design.analysis.closed_loop.simulate`, compiled. A subclass that
        measures or advances otherwise sets `in_loop` to None.

        Parameters
        ----------
        signals : (T, 5)
            Set point, what joins the law's command before its limits, what joins the measurement and the
            command that acts, hub torque, N m.
        law : (n + 1, n + 2)
            The controller's matrices, see `plant.kernel.run`.
        limits : (2,)
            Of the command and of its change in a sample, V.
        steps : (2,)
            Steps of measurement and command, 0 for none.
        delay_samples : int
            From computing a command to handing it over.
        measured : int
            Output in the loop: 0 for the hub angle, 1 for the tip.
        clip : float
            Limit of the machine's input, V.

        Raises
        ------
        ValueError
            A command is not finite: the loop is unstable and ran away.
        """
        n_samples = len(signals)
        voltage = self.machine.voltage
        sensor = self.machine.sensor
        tip_force_N = np.zeros(n_samples)
        if self.tip_force_N is not None:
            tip_force_N[: self.tip_force_N.size] = self.tip_force_N[:n_samples]
        noise = np.zeros((n_samples, 2))
        if self._rng is not None:
            sensors = self.machine.rig.sensors
            levels = (sensors.hub_angle_noise_rad, sensors.tip_noise_m)
            noise = self._rng.standard_normal((n_samples, 2)) * levels
        output = np.empty((n_samples, 2))
        command = np.empty(n_samples)
        limited = np.empty(n_samples, dtype=np.bool_)
        # The last arguments of `plant.kernel.run`, in its order and with its names.
        loop_arguments: tuple[Any, ...] = (
            np.column_stack([signals, tip_force_N, noise]),
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
        state = self.plan.at()
        # In a loop the stepper makes its own inputs and writes no states.
        inputs = np.zeros((1, 4))
        states = np.empty((1, state.x.size))
        run(inputs, states, *state, *self.plan.arguments, *loop_arguments)
        if not np.all(np.isfinite(command)):
            raise ValueError("the loop ran away: its command is not finite")
        return output, command, limited


def quantised(output: Real, encoder_step_rad: float) -> Real:
    """Measured outputs (..., 2) with the hub angle rounded to encoder steps, rad; as they are for 0."""
    if encoder_step_rad == 0:
        return output
    result = output.copy()
    result[..., 0] = encoder_step_rad * np.rint(output[..., 0] / encoder_step_rad)
    return result


def _noise(machine: Machine, rng: np.random.Generator | None, n_samples: int, *, accelerometer: bool) -> Real:
    """Noise (T, 5) of hub angle, tip, tip acceleration, hub speed and tip deflection; zero without rng.

    Hub angle, tip and, where there is one, accelerometer are drawn sample by sample, as `SampledArm` draws
    them; then whole columns of hub speed and deflection, where these have noise.
    """
    noise = np.zeros((n_samples, 5))
    if rng is None:
        return noise
    sensors = machine.rig.sensors
    levels = [sensors.hub_angle_noise_rad, sensors.tip_noise_m]
    if accelerometer:
        levels.append(sensors.tip_acceleration_noise_m_s2)
    n_drawn = len(levels)
    noise[:, :n_drawn] = rng.standard_normal((n_samples, n_drawn)) * levels
    for column, level in ((3, sensors.hub_speed_noise_rad_s), (4, sensors.tip_deflection_noise_m)):
        if level > 0:
            noise[:, column] = level * rng.standard_normal(n_samples)
    return noise


def _tip_reading(sensor: SensorPath, tip: F, time_s: F, noise: F | float) -> F:
    """Reading, m, from a tip position, m, that is already behind the sensor lag: one sample or (T,).

    Gain and drift (per second of time_s) act before the noise, quantisation behind it.
    """
    reading = sensor.gain * tip + sensor.drift_m_s * time_s + noise
    if sensor.step_m > 0:
        reading = sensor.step_m * np.rint(reading / sensor.step_m)
    return reading


def _positive(name: str, value: float) -> float:
    """The value as a float. Raises ValueError, naming it, where it is not positive and finite."""
    if not 0 < value < np.inf:
        raise ValueError(f"{name} must be positive and finite; got {value}")
    return float(value)


def _signal(name: str, values: npt.ArrayLike, n_samples: int | None) -> Real:
    """The values as an array (T,) of its own; T is n_samples, or anything above zero for None.

    Raises ValueError, naming the signal, where the values are no numbers, not finite or of another shape.
    """
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
