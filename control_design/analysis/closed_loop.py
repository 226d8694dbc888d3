"""Closed-loop simulation on anything that can be sampled: the nonlinear arm, a linear model, later a real
machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Protocol

import control
import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Boolean, Complex, Real
from ident.data.arrays import COMPILED, INSIDE, kernel_array, lock
from ident.data.shown import Shown


class MeasuredMachine(Protocol):
    """A machine that is measured every dt_s, and holds its commands until then: one, or one of each joint."""

    @property
    def dt_s(self) -> float: ...
    def reset(self) -> None: ...
    def measure(self) -> Real: ...
    def advance(self, u: Any, /) -> None: ...


class SampledMachine(MeasuredMachine, Protocol):
    """A machine sampled every dt_s: measure at t_k, then hold the input until t_{k+1}. `plant.SampledArm` and
    `LinearMachine` are; they have the whole loop compiled too, as `in_loop`, which `simulate` then calls."""

    def advance(self, u: float, /, *, hub_torque_Nm: float = 0.0) -> None: ...


class LinearMachine:
    """A discrete `control.StateSpace` as a SampledMachine.

    Inputs: the commands, and optionally one more driven by `hub_torque_Nm`; any number of outputs. D must be
    zero: a sampled machine cannot answer at t_k to a command that is applied from t_k on.
    """

    def __init__(self, system: control.StateSpace) -> None:
        if system.dt is None or system.dt is True or not system.dt > 0:
            raise ValueError(
                f"LinearMachine needs a discrete system with dt in seconds; got dt = {system.dt}"
            )
        if np.any(np.asarray(system.D) != 0):
            raise ValueError(
                "LinearMachine needs D = 0: the measurement at t_k comes before the command at t_k"
            )
        self._a, self._b, self._c = (np.array(getattr(system, m), dtype=np.float64, order="C") for m in "ABC")
        self.dt_s = float(system.dt)
        self.reset()

    def __init_subclass__(cls) -> None:
        if {"measure", "advance"} & vars(cls).keys():  # the compiled loop would not know of it
            cls.in_loop = cls.joints_in_loop = None  # type: ignore[assignment]

    def reset(self) -> None:
        self._x = np.zeros(self._a.shape[0])

    def measure(self) -> Real:
        """Outputs (Y,) at t_k."""
        return np.asarray(self._c @ self._x, dtype=np.float64)

    def advance(self, u: npt.ArrayLike, /, *, hub_torque_Nm: float = 0.0) -> None:
        """Hold the command, or commands (U,), for one sample.

        Raises ValueError if a disturbance torque is given and the system has no input for it.
        """
        drive = np.append(u, hub_torque_Nm)[: self._b.shape[1]]
        self._refuse_torque(hub_torque_Nm)
        self._x = self._a @ self._x + self._b @ drive

    def in_loop(
        self,
        signals: Real,
        law: Real,
        limits: Real,
        steps: Real,
        delay: int,
        measured: int,
        clip: float = np.inf,
    ) -> tuple[Real, Real, Boolean]:
        """Outputs (T, Y), commands (T,) and whether they were limited (T,) of a loop, from rest; arguments as
        of `plant.simulation.SampledArm.in_loop`."""
        self._refuse_torque(signals[:, 4])
        added = signals[:, 3 : 3 + self._b.shape[1]]
        y, u, limited = self.joints_in_loop(
            signals[:, :3], added, law, limits, steps, delay, np.array([measured]), clip
        )
        return y, u[:, 0], limited

    def joints_in_loop(
        self,
        given: Real,
        added: Real,
        law: Real,
        limits: Real,
        steps: Real,
        delay: int,
        measured: npt.NDArray[np.int64],
        clip: float = np.inf,
    ) -> tuple[Real, Real, Boolean]:
        """The same of a law (`law_arrays`) of errors at the outputs `measured` (M,). given (T, 2 M + U): set
        points, what joins the commands, what joins the measurements. added (T, inputs)."""
        n, commands = len(given), limits.size // 2
        if max(measured) >= len(self._c) or commands > self._b.shape[1]:  # compiled code would not see it
            raise ValueError(f"the machine has {len(self._c)} outputs and {self._b.shape[1]} inputs only")
        found = np.empty((n, len(self._c))), np.empty((n, commands)), np.zeros(n, dtype=np.bool_)
        drive = np.hstack([added, np.zeros((n, self._b.shape[1] - added.shape[1]))])
        rows = scipy.sparse.csr_array(self._a)  # a kernel of many taps is a shift register
        machine = rows.data, rows.indices, rows.indptr, self._b, self._c
        _run(*map(kernel_array, (given, drive, *machine, law, limits, steps)), delay, measured, clip, *found)
        return found

    def _refuse_torque(self, torque_Nm: npt.ArrayLike) -> None:
        if self._b.shape[1] == 1 and np.any(torque_Nm):
            raise ValueError("this LinearMachine has one input; a hub torque needs a second one")


@numba.njit(**INSIDE)
def _along(rows: Any, i: int, values: Any) -> float:
    total = 0.0
    for j in range(values.size):
        total += rows[i, j] * values[j]
    return total


@numba.njit(**COMPILED)
def _run(
    given: Any,
    added: Any,
    values: Any,
    columns: Any,
    starts: Any,
    b: Any,
    c: Any,
    law: Any,
    limits: Any,
    steps: Any,
    delay: int,
    measured: Any,
    clip: float,
    output: Any,
    command: Any,
    limited: Any,
) -> None:
    """Fill output, command, limited of `LinearMachine.joints_in_loop`; values, columns, starts: rows of the
    machine's A, as of `scipy.sparse.csr_array`."""
    n, n_u, n_y = law.shape[0] - command.shape[1], command.shape[1], measured.size
    x, new, drive = np.zeros(len(b)), np.zeros(len(b)), np.zeros(b.shape[1])
    own, later, last = np.zeros(law.shape[1]), np.zeros(n), np.zeros(n_u)
    queue = np.zeros((delay + 1, n_u))
    for k in range(len(given)):
        for i in range(len(c)):
            output[k, i] = _along(c, i, x)
        for i in range(n_y):
            y = output[k, measured[i]] + given[k, n_y + n_u + i]
            output[k, measured[i]] = y = y if steps[0] == 0 else steps[0] * np.rint(y / steps[0])
            own[n + i] = given[k, i] - y
        for i in range(n_u):
            wanted = _along(law, n + i, own) + given[k, n_y + i]
            u = min(max(wanted, last[i] - limits[n_u + i]), last[i] + limits[n_u + i])
            last[i] = min(max(u, -limits[i]), limits[i])
            limited[k] |= last[i] != wanted
            own[n + n_y + i] = last[i] - wanted
            queue[k % (delay + 1), i] = last[i] if steps[1] == 0 else steps[1] * np.rint(last[i] / steps[1])
            command[k, i] = queue[(k + 1) % (delay + 1), i]
            drive[i] = min(max(command[k, i] + added[k, i], -clip), clip)
        for i in range(n):
            later[i] = _along(law, i, own)
        own[:n] = later
        for i in range(n_u, drive.size):
            drive[i] = added[k, i]
        for i in range(x.size):
            new[i] = _along(b, i, drive)
            for j in range(starts[i], starts[i + 1]):
                new[i] += values[j] * x[columns[j]]
        x[:] = new


@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoopTrajectory(Shown):
    """What happened: time_s (T,), reference (T,), output (T, Y) as measured, command (T,) as applied during
    [t_k, t_{k+1}), limited (T,) whether a limit was active when the command at t_k was computed; dt_s,
    measured_index of the controlled output."""

    time_s: Real
    reference: Real
    output: Real
    command: Real
    limited: Boolean
    dt_s: float
    measured_index: int = 0

    def __post_init__(self) -> None:
        lock(self, "time_s", "reference", "output", "command")
        lock(self, "limited", dtype=np.bool_)
        n = self.time_s.size
        shapes = {f.name: np.shape(getattr(self, f.name)) for f in fields(self)[:5]}
        if self.output.ndim != 2 or any(shape[0] != n for shape in shapes.values()):
            raise ValueError(f"trajectory needs (T,) arrays and output (T, Y); got {shapes}")

    @property
    def measured(self) -> Real:
        """The controlled output, (T,)."""
        return self.output[:, self.measured_index]


def simulate(
    controller: Controller,
    machine: SampledMachine,
    reference: npt.ArrayLike,
    *,
    measured_index: int = 0,
    hub_torque_Nm: npt.ArrayLike | None = None,
    input_disturbance: npt.ArrayLike | None = None,
    output_disturbance: npt.ArrayLike | None = None,
    measurement_step: float = 0.0,
    command_step: float = 0.0,
    clip: float = np.inf,
) -> ClosedLoopTrajectory:
    """Run u = K (r - y), with the controller's feed-forward if it has one, on a machine from rest.

    At t_k: measure y_k, add output_disturbance, quantise with measurement_step, compute the limited command,
    quantise it with command_step, queue it for t_{k + delay}; then the machine holds the queued command (plus
    input_disturbance) until t_{k+1}. With no limits and no quantisation this is exactly the feedback of K
    z^-delay and the machine used in the loop analysis.

    reference : (T,) array. Set point at t_k, unit of the measured output.
    hub_torque_Nm, input_disturbance, output_disturbance : (T,) arrays, optional
        Torque handed to the machine; added to the applied command; added to the measured output.
    measurement_step, command_step : float
        Quantisation (mid-tread rounding) in output and input units; 0 = none.
    clip : float
        The machine clips its input there without telling the controller; inf = nowhere.

    Raises ValueError if sampling times or lengths do not match, or a value is not finite.
    """
    wanted = _signal("reference", reference, None)
    n = wanted.size
    torque = _signal("hub_torque_Nm", hub_torque_Nm, n)
    added = _signal("input_disturbance", input_disturbance, n)
    shift = _signal("output_disturbance", output_disturbance, n)
    if not np.isclose(machine.dt_s, controller.dt_s, rtol=1e-9, atol=0):
        raise ValueError(
            f"controller and machine differ in dt_s: {controller.dt_s} and {machine.dt_s}; sample both with "
            "the period of the loop"
        )
    if not (measurement_step >= 0 and command_step >= 0):
        raise ValueError("measurement_step and command_step must not be negative")
    time_s = np.asarray(np.arange(n) * controller.dt_s, dtype=np.float64)
    if (in_loop := getattr(machine, "in_loop", None)) is not None:
        own = controller.feedforward
        joins = np.zeros(n) if own is None else own.signal(wanted, controller.dt_s)
        delay, steps = controller.computational_delay_samples, np.array([measurement_step, command_step])
        signals = np.column_stack([wanted, joins, shift, added, torque])
        y, u, at_limit = in_loop(signals, *law_arrays(controller), steps, delay, measured_index, clip)
        return ClosedLoopTrajectory(time_s, wanted, y, u, at_limit, controller.dt_s, measured_index)
    machine.reset()
    stepper = controller.stepper()
    queue = [0.0] * controller.computational_delay_samples
    output: list[Real] = []
    command = np.empty(n)
    limited = np.zeros(n, dtype=np.bool_)
    for k in range(n):
        y = np.array(machine.measure(), dtype=np.float64)
        y[measured_index] += shift[k]
        if measurement_step > 0:
            y[measured_index] = np.round(y[measured_index] / measurement_step) * measurement_step
        u = stepper.step(float(wanted[k] - y[measured_index]), float(wanted[k]))
        limited[k] = stepper.limited[0]
        if command_step > 0:
            u = float(np.round(u / command_step) * command_step)
        queue.append(u)
        applied = queue.pop(0)
        output.append(y)
        command[k] = applied
        machine.advance(min(max(applied + added[k], -clip), clip), hub_torque_Nm=float(torque[k]))
    return ClosedLoopTrajectory(
        time_s, wanted, np.array(output), command, limited, controller.dt_s, measured_index
    )


def law_arrays(controller: Controller) -> tuple[Real, Real]:
    """For compiled loops of U commands and Y errors: (n + U, n + Y + U), columns A, B, M and C, D, -; limits
    (2 U,) of the commands and of their changes in a sample."""
    assert controller.anti_windup_gain is not None
    n, (commands, errors) = controller.order, controller.D.shape
    law = np.zeros((n + commands, n + errors + commands))
    law[:n] = np.hstack([controller.A, controller.B, controller.anti_windup_gain])
    law[n:, : n + errors] = np.hstack([controller.C, controller.D])
    change = controller.limits("rate_limit") * controller.dt_s
    return law, np.concatenate([controller.limits("input_limit"), change])


def simulate_joints(
    controller: Controller, machine: MeasuredMachine, reference: Real, input_disturbance: Real | None = None
) -> tuple[Real, Real]:
    """Run u = K (r - y) from rest for references (T, Y): measured outputs (T, Y), applied commands (T, U).

    As `simulate`; input_disturbance (T, U) is added to what is applied. Raises ValueError if sampling times
    or shapes do not match.
    """
    if not np.isclose(machine.dt_s, controller.dt_s, rtol=1e-9, atol=0):
        raise ValueError(f"controller and machine differ in dt_s: {controller.dt_s} and {machine.dt_s}")
    inputs, outputs = controller.D.shape
    if reference.ndim != 2 or reference.shape[1] != outputs:
        raise ValueError(f"reference must be (T, {outputs}); got {reference.shape}")
    n = reference.shape[0]
    added = np.zeros((n, inputs)) if input_disturbance is None else input_disturbance
    if (in_loop := getattr(machine, "joints_in_loop", None)) is not None:
        given, delay = np.zeros((n, 2 * outputs + inputs)), controller.computational_delay_samples
        given[:, :outputs] = reference
        law, limits = law_arrays(controller)
        output, command, _ = in_loop(given, added, law, limits, np.zeros(2), delay, np.arange(outputs))
        return output, command
    machine.reset()
    stepper = controller.stepper()
    queue = [np.zeros(inputs)] * controller.computational_delay_samples
    output, command = np.empty((n, outputs)), np.empty((n, inputs))
    for k in range(n):
        output[k] = machine.measure()
        queue.append(stepper.step(reference[k] - output[k]))
        command[k] = queue.pop(0)
        machine.advance(command[k] + added[k])
    return output, command


def _signal(name: str, value: npt.ArrayLike | None, n: int | None) -> Real:
    if value is None:
        return np.zeros(n or 0)
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 2 and array.shape[1] == 1:  # the one column of a record
        array = array[:, 0]
    if array.ndim != 1 or array.size == 0 or (n is not None and array.size != n):
        raise ValueError(f"{name} must be (T,) with T = {n or 'at least 1'}; got {array.shape}")
    if not np.all(np.isfinite(array)):
        raise ValueError(
            f"{name} has a value that is not finite at sample {int(np.argmin(np.isfinite(array)))}"
        )
    return array


@dataclass(frozen=True, eq=False)
class MeasuredSensitivity:
    """S measured in closed loop on a machine, from reference to error.

    omega_rad_s (F,) the excited lines, response (F,) mean over periods and phase draws, std (F,) standard
    deviation of that mean (of its modulus, nearly), from the scatter between draws, or between periods of a
    single draw. peak_command and limited_fraction say whether the command stayed within its limits: with a
    limit active the loop is not the one of the analysis. reference_rms: size of the excitation.
    """

    omega_rad_s: Real
    response: Complex
    std: Real
    reference_rms: float
    peak_command: float
    limited_fraction: float

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s", "std")
        lock(self, "response", dtype=np.complex128)
        if not self.omega_rad_s.shape == self.response.shape == self.std.shape == (self.omega_rad_s.size,):
            raise ValueError("omega_rad_s, response and std must be (F,)")

    @property
    def peak(self) -> tuple[float, float, float]:
        """Largest |S| over the lines, its standard deviation, its frequency [rad/s]."""
        at = int(np.argmax(np.abs(self.response)))
        return float(np.abs(self.response[at])), float(self.std[at]), float(self.omega_rad_s[at])


def measure_sensitivity(
    controller: Controller,
    machine: SampledMachine,
    rng: np.random.Generator,
    *,
    measured_index: int = 0,
    measurement_step: float = 0.0,
    command_step: float = 0.0,
    clip: float = np.inf,
    **excitation: Any,
) -> MeasuredSensitivity:
    """S measured on a machine: excitation as of `sensitivity_of`, the other keywords as of `simulate`."""
    run = partial(
        simulate,
        controller,
        machine,
        measured_index=measured_index,
        measurement_step=measurement_step,
        command_step=command_step,
        clip=clip,
    )
    return sensitivity_of(run, rng, dt_s=controller.dt_s, **excitation)


def sensitivity_of(
    loop: Callable[[Real], ClosedLoopTrajectory],
    rng: np.random.Generator,
    *,
    dt_s: float,
    rms: float,
    band_rad_s: tuple[float, float],
    period_samples: int,
    periods: int = 2,
    draws: int = 1,
    lead_in_periods: int = 1,
) -> MeasuredSensitivity:
    """S of a loop that runs a reference (T,) from rest: random-phase multisines, ratio of error to reference.

    Every draw has phases of its own; its first `lead_in_periods` periods are left out, so that the loop has
    come to its periodic motion. On a nonlinear machine the mean over draws is the best linear approximation
    for this spectrum and size, and the scatter between draws holds the distortion.

    Raises ValueError if the band holds no line of the period, or nothing would be left to take a scatter
    from.
    """
    if periods < 1 or draws < 1 or periods * draws < 2:
        raise ValueError(f"a scatter needs two periods or two draws; got {periods} and {draws}")
    if not (rms > 0 and np.isfinite(rms)):
        raise ValueError(f"rms must be positive; got {rms}")
    lines = np.arange(1, (period_samples - 1) // 2 + 1)
    omega = np.asarray(2 * np.pi * lines / (period_samples * dt_s), dtype=np.float64)
    inside = (omega >= band_rad_s[0]) & (omega <= band_rad_s[1])
    lines, omega = lines[inside], omega[inside]
    if lines.size == 0:
        raise ValueError(f"no line of {period_samples} samples lies in {band_rad_s} rad/s")
    found, peak, limited = [], 0.0, 0.0
    for _ in range(draws):
        spectrum = np.zeros(period_samples // 2 + 1, dtype=np.complex128)
        spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
        period = np.fft.irfft(spectrum, period_samples)
        period *= rms / np.sqrt(np.mean(period**2))
        run = loop(np.tile(period, lead_in_periods + periods))
        error = (run.reference - run.measured)[lead_in_periods * period_samples :]
        by_period = np.fft.rfft(error.reshape(periods, period_samples), axis=1)[:, lines]
        found.append(by_period / np.fft.rfft(period)[lines])
        peak = max(peak, float(np.max(np.abs(run.command))))
        limited += float(np.mean(run.limited)) / draws
    ratios = np.array(found)
    each = ratios.mean(axis=1) if draws > 1 else ratios[0]
    # Of a complex mean's scatter half lies along the modulus.
    variance = np.sum(np.abs(each - each.mean(axis=0)) ** 2, axis=0) / (len(each) - 1) / len(each)
    std = np.asarray(np.sqrt(0.5 * variance), dtype=np.float64)
    return MeasuredSensitivity(omega, ratios.mean(axis=(0, 1)), std, rms, peak, limited)


@dataclass(frozen=True)
class StepMetrics:
    """Step response in words; times in s from the step, None where the response never gets there."""

    step_size: float
    rise_time_s: float | None
    overshoot_percent: float
    undershoot_percent: float
    settling_time_s: float | None
    steady_error: float
    peak_command: float
    limited_fraction: float


def step_metrics(trajectory: ClosedLoopTrajectory, *, settling_band: float = 0.02) -> StepMetrics:
    """Rise time (10-90 %), overshoot, undershoot, settling time (into +-band of the step), steady error, peak
    command.

    All are relative to the reference step, from its first to its last value. Time starts at the first sample
    that differs from the first value. Steady error is the mean error over the last tenth of the record.

    Raises ValueError if the reference is not a step (no change, or more than one level after the change).
    """
    r, y, t = trajectory.reference, trajectory.measured, trajectory.time_s
    changed = np.flatnonzero(r != r[0])
    at = 0 if changed.size == 0 else int(changed[0])
    size = float(r[-1] - r[0]) if changed.size else float(r[-1])
    if size == 0.0 or not np.all(r[at:] == r[-1]):
        raise ValueError("step_metrics needs a reference that steps once to a new level")
    progress = (y[at:] - (float(r[0]) if changed.size else 0.0)) / size
    time = t[at:] - t[at]
    ten, ninety = _first_crossing(time, progress, 0.1), _first_crossing(time, progress, 0.9)
    outside = np.flatnonzero(np.abs(progress - 1.0) > settling_band)
    if outside.size == 0:
        settling: float | None = 0.0
    elif outside[-1] + 1 < progress.size:
        settling = float(time[outside[-1] + 1])
    else:
        settling = None
    tail = max(1, progress.size // 10)
    return StepMetrics(
        step_size=size,
        rise_time_s=None if ten is None or ninety is None else ninety - ten,
        overshoot_percent=100.0 * max(0.0, float(np.max(progress)) - 1.0),
        undershoot_percent=100.0 * max(0.0, -float(np.min(progress))),
        settling_time_s=settling,
        steady_error=float(np.mean(r[-tail:] - y[-tail:])),
        peak_command=float(np.max(np.abs(trajectory.command))),
        limited_fraction=float(np.mean(trajectory.limited[at:])),
    )


def _first_crossing(time: Real, value: Real, level: float) -> float | None:
    """First time the signal reaches the level, interpolated between samples."""
    above = np.flatnonzero(value >= level)
    if above.size == 0:
        return None
    k = int(above[0])
    if k == 0:
        return float(time[0])
    share = (level - value[k - 1]) / (value[k] - value[k - 1])
    return float(time[k - 1] + share * (time[k] - time[k - 1]))
