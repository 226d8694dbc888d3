"""Closed-loop simulation on anything that can be sampled, and what a run tells: step metrics, measured S.

A machine is measured every dt_s and holds its command until the next sample: the nonlinear arm, a linear
model (`LinearMachine`), a real machine. `simulate` runs one loop u = K (r - y) on it, with limits,
quantisation, delay and disturbances, `simulate_joints` one of several commands; machines that offer the whole
loop compiled are asked for it, others are stepped sample by sample. `step_metrics` puts a step response into
numbers. `sensitivity_of` measures S by random-phase multisines (Pintelon and Schoukens, System
Identification, 2nd ed., ch. 4). Without limits and quantisation the loop is exactly the one of the analysis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Boolean, Complex, Real
from ident.data.arrays import COMPILED, INSIDE, kernel_array, lock
from ident.data.keywords import clear_constructor
from ident.data.shown import Shown

if TYPE_CHECKING:
    import control

# Relative difference of two sampling times that counts as none: rounding of decimal numbers.
_SAME_PERIOD = 1e-9
# Levels, as shares of a step, between which its rise time is taken: the usual 10 % and 90 %.
_RISE_FROM = 0.1

# The upper one of the two levels.
_RISE_TO = 0.9
# Band around the final value, as a share of a step, in which it counts as settled: the usual 2 %.
_SETTLING_BAND = 0.02
# Part of the samples after a step, one n-th at their end, over which the steady error is averaged. Chosen: a
# tenth is enough to average noise, and short beside any settling time that fits the record.
_STEADY_PARTS = 10


class MeasuredMachine(Protocol):
    """A machine that is measured every dt_s, and holds its commands until then: one, or one of each joint."""

    @property
    def dt_s(self) -> float:
        """Sampling time, s."""
        ...

    def reset(self) -> None:
        """Bring it to rest."""
        ...

    def measure(self) -> Real:
        """Outputs (Y,) at this sample.

        In the machine's units; a value that is not finite is passed on as it is.
        """
        ...

    def advance(self, u: Any, /) -> None:
        """Hold the command, or commands (U,), for one sample.

        A machine without a model of its own refuses what it cannot hold; nothing is said of that here.
        """
        ...


class SampledMachine(MeasuredMachine, Protocol):
    """A machine with one command: measured at t_k, then holding its input until t_{k+1}.

    `plant.SampledArm` and `LinearMachine` are such; they have the whole loop compiled too, as `in_loop`,
    which `simulate` then calls.
    """

    def advance(self, u: float, /, *, hub_torque_Nm: float = 0.0) -> None:
        """Hold the command and a disturbance torque (N m) for one sample.

        A machine without an input for the torque raises ValueError where it is not zero.
        """
        ...


class LinearMachine:
    """A discrete linear system as a machine.

    Parameters
    ----------
    system : control.StateSpace
        With dt in seconds. Inputs: the commands, and optionally one more driven by `hub_torque_Nm`; any
        number of outputs. D must be zero: a sampled machine cannot answer at t_k to a command that is applied
        from t_k on.

    Raises
    ------
    ValueError
        The system is not discrete, or D is not zero.
    """

    def __init__(self, system: control.StateSpace) -> None:
        """Take the matrices A (n, n), B (n, inputs), C (Y, n) and the period, and bring all states to
        zero; raises the ValueError that the class names."""
        if system.dt is None or system.dt is True or not system.dt > 0:
            raise ValueError(
                f"LinearMachine needs a discrete system with dt in seconds; got dt = {system.dt}"
            )
        if np.any(np.asarray(system.D) != 0):
            raise ValueError(
                "LinearMachine needs D = 0: the measurement at t_k comes before the command at t_k"
            )
        self._a = np.array(system.A, dtype=np.float64, order="C")
        self._b = np.array(system.B, dtype=np.float64, order="C")
        self._c = np.array(system.C, dtype=np.float64, order="C")
        self.dt_s = float(system.dt)
        self.reset()

    def __init_subclass__(cls) -> None:
        """Take the compiled loop from a subclass that measures or advances otherwise, and must be stepped.

        Nothing is refused: `simulate` then finds no `in_loop` and goes sample by sample.
        """
        if {"measure", "advance"} & vars(cls).keys():
            cls.in_loop = cls.joints_in_loop = None  # type: ignore[assignment]

    def reset(self) -> None:
        """Bring all states to zero."""
        self._x = np.zeros(self._a.shape[0])

    def measure(self) -> Real:
        """Outputs (Y,) at t_k, units of the system; nan once a state is."""
        return np.asarray(self._c @ self._x, dtype=np.float64)

    def advance(self, u: npt.ArrayLike, /, *, hub_torque_Nm: float = 0.0) -> None:
        """Hold the command, or commands (U,), for one sample.

        Raises
        ------
        ValueError
            A disturbance torque is given and the system has no input for it; or, by numpy, another number of
            commands than the system has inputs. Values that are not finite are not refused.
        """
        # Without an input for the torque it is cut off, and must be zero.
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
        """Outputs (T, Y), commands (T,) and whether these were limited (T,), of a loop from rest.

        Parameters
        ----------
        signals : (T, 5) array
            Set point, what joins the command, what joins the measurement, what joins the applied command, and
            the hub torque, N m.
        law, limits : (n + 1, n + 2), (2,) arrays
            The controller's matrices [A, B, M; C, D, 0] and its limits of command and of change per sample,
            as `law_arrays` makes them.
        steps : (2,) array
            Quantisation of measurement and command; 0: none.
        delay : int
            Computational delay, samples.
        measured : int
            Index of the controlled output.
        clip : float
            The machine clips its input there.

        Raises
        ------
        ValueError
            A torque is given without an input for it, or the machine has no such output. Shapes of the other
            arrays are not checked, nor whether values are finite: `simulate` does that.
        """
        self._refuse_torque(signals[:, 4])
        # What joins the applied command, and the torque where the system has an input for it.
        added = signals[:, 3 : 3 + self._b.shape[1]]
        outputs, commands, limited = self.joints_in_loop(
            signals[:, :3], added, law, limits, steps, delay, np.array([measured]), clip
        )
        return outputs, commands[:, 0], limited

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
        """Outputs (T, Y), commands (T, U) and whether any was limited (T,), of a loop from rest.

        Parameters
        ----------
        given : (T, 2 M + U) array
            Set points (M), what joins the commands (U), what joins the measurements (M).
        added : (T, inputs) array
            What joins the applied commands, up to the number of the machine's inputs.
        law, limits : (n + U, n + M + U), (2 U,) arrays
            The controller's matrices [A, B, anti-windup; C, D, 0] and its limits of commands and of their
            changes per sample, as `law_arrays` makes them.
        steps : (2,) array
            Quantisation of measurements and commands; 0: none.
        delay : int
            Computational delay, samples.
        measured : (M,) array of int
            Indices of the controlled outputs.
        clip : float
            The machine clips its inputs there.

        Raises
        ------
        ValueError
            The machine has fewer outputs or inputs, which compiled code would not see; or, by numpy, more
            columns are added than there are inputs. Other shapes are not checked.
        """
        n_samples = len(given)
        n_outputs = len(self._c)
        n_inputs = self._b.shape[1]
        # Half of the limits are of size, half of rate.
        n_commands = limits.size // 2
        if max(measured) >= n_outputs or n_commands > n_inputs:
            raise ValueError(f"the machine has {n_outputs} outputs and {n_inputs} inputs only")
        output = np.empty((n_samples, n_outputs))
        command = np.empty((n_samples, n_commands))
        limited = np.zeros(n_samples, dtype=np.bool_)
        # Inputs to which nothing is added.
        not_added = np.zeros((n_samples, n_inputs - added.shape[1]))
        drive = np.hstack([added, not_added])
        # A sparse A, because a model of many taps is a shift register.
        rows = scipy.sparse.csr_array(self._a)
        machine = (rows.data, rows.indices, rows.indptr, self._b, self._c)
        arrays = map(kernel_array, (given, drive, *machine, law, limits, steps))
        _run(*arrays, delay, measured, clip, output, command, limited)
        return output, command, limited

    def _refuse_torque(self, torque_Nm: npt.ArrayLike) -> None:
        """Raise ValueError for a disturbance torque, number or (T,), that the system has no input for."""
        if self._b.shape[1] == 1 and np.any(torque_Nm):
            raise ValueError("this LinearMachine has one input; a hub torque needs a second one")


@numba.njit(**INSIDE)
def _along(rows: Any, i: int, values: Any) -> float:
    """Product of row i of a matrix (R, N) and a vector (N,), summed from left to right.

    Not checked: compiled code looks at no bounds.
    """
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
    """Fill output (T, Y), command (T, U) and limited (T,) of `LinearMachine.joints_in_loop`.

    values, columns, starts: rows of the machine's A, as `data`, `indices`, `indptr` of
    `scipy.sparse.csr_array`; b (n, inputs) and c (Y, n) its other matrices. Other arguments as there. Loops
    instead of matrix products: for so few rows a call of BLAS costs more than the arithmetic. Nothing is
    checked, and indices are not bounded: `joints_in_loop` makes the arrays fit.
    """
    n_u = command.shape[1]
    n_y = measured.size
    n = law.shape[0] - n_u
    # The controller's states, errors and what the limits take off: what the rows of the law multiply.
    signals = np.zeros(law.shape[1])
    next_states = np.zeros(n)
    last_command = np.zeros(n_u)
    queue = np.zeros((delay + 1, n_u))
    x = np.zeros(len(b))
    next_x = np.zeros(len(b))
    drive = np.zeros(b.shape[1])
    for k in range(len(given)):
        # Measure, quantise, and take the errors.
        for i in range(len(c)):
            output[k, i] = _along(c, i, x)
        for i in range(n_y):
            y = output[k, measured[i]] + given[k, n_y + n_u + i]
            if steps[0] != 0:
                y = steps[0] * np.rint(y / steps[0])
            output[k, measured[i]] = y
            signals[n + i] = given[k, i] - y

        # Commands, limited in rate and then in size, quantised and queued for the delay: a ring of delay + 1
        # samples, of which the oldest is applied.
        for i in range(n_u):
            wanted = _along(law, n + i, signals) + given[k, n_y + i]
            lowest = last_command[i] - limits[n_u + i]
            highest = last_command[i] + limits[n_u + i]
            u = min(max(wanted, lowest), highest)
            u = min(max(u, -limits[i]), limits[i])
            last_command[i] = u
            if u != wanted:
                limited[k] = True
            # What the limits took off, which the anti-windup gain hands to the states.
            signals[n + n_y + i] = u - wanted
            if steps[1] != 0:
                u = steps[1] * np.rint(u / steps[1])
            queue[k % (delay + 1), i] = u
            command[k, i] = queue[(k + 1) % (delay + 1), i]
            drive[i] = min(max(command[k, i] + added[k, i], -clip), clip)

        # The controller's next states, and the machine's.
        for i in range(n):
            next_states[i] = _along(law, i, signals)
        signals[:n] = next_states
        # Inputs beyond the commands (a torque) get what is added alone.
        for i in range(n_u, drive.size):
            drive[i] = added[k, i]
        for i in range(x.size):
            next_x[i] = _along(b, i, drive)
            for j in range(starts[i], starts[i + 1]):
                next_x[i] += values[j] * x[columns[j]]
        x[:] = next_x


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class ClosedLoopTrajectory(Shown):
    """What happened in one run of a loop over T samples.

    Attributes
    ----------
    time_s : (T,) array
        From 0, s.
    reference : (T,) array
        Set point, unit of the controlled output.
    output : (T, Y) array
        As measured.
    command : (T,) array
        As applied during [t_k, t_{k+1}), input unit.
    limited : (T,) array of bool
        A limit was active when the command at t_k was computed.
    dt_s : float
        Sampling time, s.
    measured_index : int
        Column of the controlled output.

    Raises
    ------
    ValueError
        The arrays differ in length, or `output` is not (T, Y). Values are not checked: a run that diverged
        holds inf and nan.

    Examples
    --------
    >>> law = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> run = flexlink.simulate_loop(law, example_plant(), [1.0] * 400)
    >>> run.output.shape, run.command.shape
    ((400, 1), (400,))
    """

    time_s: Real
    reference: Real
    output: Real
    command: Real
    limited: Boolean
    dt_s: float
    measured_index: int = 0

    def __post_init__(self) -> None:
        """Make the arrays read-only and check their shapes.

        Raises the ValueError that the class names.
        """
        lock(self, "time_s", "reference", "output", "command")
        lock(self, "limited", dtype=np.bool_)
        names = ("time_s", "reference", "output", "command", "limited")
        shapes = {name: np.shape(getattr(self, name)) for name in names}
        differs = any(shape[0] != self.time_s.size for shape in shapes.values())
        if self.output.ndim != 2 or differs:
            raise ValueError(f"trajectory needs (T,) arrays and output (T, Y); got {shapes}")

    @property
    def measured(self) -> Real:
        """The controlled output, (T,); IndexError where `measured_index` is no column of `output`."""
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

    Parameters
    ----------
    controller : Controller
        One error, one command, with its limits and its computational delay.
    machine : SampledMachine
        With the controller's sampling time.
    reference : (T,) array
        Set point at t_k, unit of the measured output.
    measured_index : int
        The machine's output that is controlled.
    hub_torque_Nm, input_disturbance, output_disturbance : (T,) arrays, optional
        Torque handed to the machine; added to the applied command; added to the measured output.
    measurement_step, command_step : float
        Quantisation (mid-tread rounding) in output and input units; 0: none.
    clip : float
        The machine clips its input there without telling the controller; inf: nowhere.

    Returns
    -------
    ClosedLoopTrajectory

    Raises
    ------
    ValueError
        Sampling times or lengths do not match, a signal has a value that is not finite, a quantisation step
        is negative, or a `LinearMachine` has no such output (IndexError of other machines). What the machine
        measures is not checked: a loop that diverges ends in inf and nan.

    Notes
    -----
    At t_k: measure y_k, add output_disturbance, quantise with measurement_step, compute the limited command,
    quantise it with command_step, queue it for t_{k + delay}; then the machine holds the queued command (plus
    input_disturbance) until t_{k+1}. With no limits and no quantisation this is exactly the feedback of K
    z^-delay and the machine used in the loop analysis.
    """
    wanted = _signal("reference", reference, None)
    n_samples = wanted.size
    torque = _signal("hub_torque_Nm", hub_torque_Nm, n_samples)
    added = _signal("input_disturbance", input_disturbance, n_samples)
    shift = _signal("output_disturbance", output_disturbance, n_samples)
    if not np.isclose(machine.dt_s, controller.dt_s, rtol=_SAME_PERIOD, atol=0):
        raise ValueError(
            f"controller and machine differ in dt_s: {controller.dt_s} and {machine.dt_s}; sample both with "
            "the period of the loop"
        )
    if not (measurement_step >= 0 and command_step >= 0):
        raise ValueError("measurement_step and command_step must not be negative")
    time_s = np.asarray(np.arange(n_samples) * controller.dt_s, dtype=np.float64)
    delay = controller.computational_delay_samples

    # The whole loop compiled, where the machine has it.
    in_loop = getattr(machine, "in_loop", None)
    if in_loop is not None:
        # The stepper makes the feed-forward sample by sample; here it is a signal that joins the command.
        from_feedforward = np.zeros(n_samples)
        if controller.feedforward is not None:
            from_feedforward = controller.feedforward.signal(wanted, controller.dt_s)
        signals = np.column_stack([wanted, from_feedforward, shift, added, torque])
        law, limits = law_arrays(controller)
        steps = np.array([measurement_step, command_step])
        outputs, commands, at_limit = in_loop(signals, law, limits, steps, delay, measured_index, clip)
        return ClosedLoopTrajectory(
            time_s, wanted, outputs, commands, at_limit, controller.dt_s, measured_index
        )

    # Sample by sample; the queue holds the commands that wait for the delay to pass.
    machine.reset()
    stepper = controller.stepper()
    queue = [0.0] * delay
    output: list[Real] = []
    command = np.empty(n_samples)
    limited = np.zeros(n_samples, dtype=np.bool_)
    for k in range(n_samples):
        y = np.array(machine.measure(), dtype=np.float64)
        y[measured_index] += shift[k]
        if measurement_step > 0:
            y[measured_index] = np.round(y[measured_index] / measurement_step) * measurement_step
        # The stepper takes the reference, too: it makes the feed-forward of it.
        error = float(wanted[k] - y[measured_index])
        u = stepper.step(error, float(wanted[k]))
        limited[k] = stepper.limited[0]
        if command_step > 0:
            u = float(np.round(u / command_step) * command_step)
        queue.append(u)
        applied = queue.pop(0)
        output.append(y)
        command[k] = applied
        drive = min(max(applied + added[k], -clip), clip)
        machine.advance(drive, hub_torque_Nm=float(torque[k]))
    return ClosedLoopTrajectory(
        time_s, wanted, np.array(output), command, limited, controller.dt_s, measured_index
    )


def law_arrays(controller: Controller) -> tuple[Real, Real]:
    """Arrays of a controller of n states, U commands and Y errors, for compiled loops.

    Of the controller its matrices, its anti-windup gain (n, U) and its limits are read; a `Controller` has
    checked them.

    Returns
    -------
    law : (n + U, n + Y + U) array
        Rows A, B, M (M the anti-windup gain) above rows C, D, 0.
    limits : (2 U,) array
        Of the commands, input units, and of their changes in a sample; inf: none.
    """
    assert controller.anti_windup_gain is not None
    n = controller.order
    n_commands, n_errors = controller.D.shape
    law = np.zeros((n + n_commands, n + n_errors + n_commands))
    law[:n] = np.hstack([controller.A, controller.B, controller.anti_windup_gain])
    law[n:, : n + n_errors] = np.hstack([controller.C, controller.D])
    largest_change = controller.limits("rate_limit") * controller.dt_s
    limits = np.concatenate([controller.limits("input_limit"), largest_change])
    return law, limits


def simulate_joints(
    controller: Controller, machine: MeasuredMachine, reference: Real, input_disturbance: Real | None = None
) -> tuple[Real, Real]:
    """Run u = K (r - y) of several loops from rest.

    Parameters
    ----------
    controller : Controller
        Y errors, U commands.
    machine : MeasuredMachine
        Y outputs, U inputs, with the controller's sampling time.
    reference : (T, Y) array
        Set points.
    input_disturbance : (T, U) array, optional
        Added to what is applied.

    Returns
    -------
    output : (T, Y) array
        As measured.
    command : (T, U) array
        As applied, without the disturbance.

    Raises
    ------
    ValueError
        Sampling times or the shape of the reference do not match, or a `LinearMachine` has too few outputs or
        inputs. The shape of `input_disturbance`, values that are not finite and the number of outputs of
        other machines are not checked: numpy raises where they do not fit.

    Notes
    -----
    Order of events as in `simulate`, without quantisation.
    """
    if not np.isclose(machine.dt_s, controller.dt_s, rtol=_SAME_PERIOD, atol=0):
        raise ValueError(f"controller and machine differ in dt_s: {controller.dt_s} and {machine.dt_s}")
    n_commands, n_errors = controller.D.shape
    if reference.ndim != 2 or reference.shape[1] != n_errors:
        raise ValueError(f"reference must be (T, {n_errors}); got {reference.shape}")
    n_samples = reference.shape[0]
    delay = controller.computational_delay_samples
    added = input_disturbance
    if added is None:
        added = np.zeros((n_samples, n_commands))

    # The whole loop compiled, where the machine has it.
    in_loop = getattr(machine, "joints_in_loop", None)
    if in_loop is not None:
        set_points_first = np.zeros((n_samples, 2 * n_errors + n_commands))
        set_points_first[:, :n_errors] = reference
        law, limits = law_arrays(controller)
        no_steps = np.zeros(2)
        output, command, _ = in_loop(
            set_points_first, added, law, limits, no_steps, delay, np.arange(n_errors)
        )
        return output, command

    # Sample by sample.
    machine.reset()
    stepper = controller.stepper()
    queue = [np.zeros(n_commands)] * delay
    output = np.empty((n_samples, n_errors))
    command = np.empty((n_samples, n_commands))
    for k in range(n_samples):
        output[k] = machine.measure()
        queue.append(stepper.step(reference[k] - output[k]))
        command[k] = queue.pop(0)
        machine.advance(command[k] + added[k])
    return output, command


def _signal(name: str, value: npt.ArrayLike | None, n_samples: int | None) -> Real:
    """Signal (T,) from what a user gave; zeros where it is None.

    name: its parameter, for messages. n_samples: T, None where this signal sets it. A record's one column
    (T, 1) is taken as (T,).

    Raises
    ------
    ValueError
        Another shape, no sample, or a value that is not finite (the message has its index).
    """
    if value is None:
        return np.zeros(n_samples or 0)
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    has_other_length = n_samples is not None and array.size != n_samples
    if array.ndim != 1 or array.size == 0 or has_other_length:
        raise ValueError(f"{name} must be (T,) with T = {n_samples or 'at least 1'}; got {array.shape}")
    is_finite = np.isfinite(array)
    if not np.all(is_finite):
        first_bad = int(np.argmin(is_finite))
        raise ValueError(f"{name} has a value that is not finite at sample {first_bad}")
    return array


@dataclass(frozen=True, eq=False)
class MeasuredSensitivity:
    """S measured in closed loop on a machine, from reference to error, at F lines.

    Attributes
    ----------
    omega_rad_s : (F,) array
        The excited lines, rad/s.
    response : (F,) complex array
        Mean over periods and phase draws.
    std : (F,) array
        Standard deviation of that mean (of its modulus, nearly), from the scatter between draws, or between
        periods of a single draw.
    reference_rms : float
        Root mean square of the reference, unit of the output.
    peak_command : float
        Largest |command|, input unit.
    limited_fraction : float
        Share of samples at which the command was limited: then the loop is not the one of the analysis.

    Raises
    ------
    ValueError
        The arrays differ in shape.
    """

    omega_rad_s: Real
    response: Complex
    std: Real
    reference_rms: float
    peak_command: float
    limited_fraction: float

    def __post_init__(self) -> None:
        """Make the arrays read-only and check their shapes.

        Raises the ValueError that the class names; values are not checked.
        """
        lock(self, "omega_rad_s", "std")
        lock(self, "response", dtype=np.complex128)
        if not self.omega_rad_s.shape == self.response.shape == self.std.shape == (self.omega_rad_s.size,):
            raise ValueError("omega_rad_s, response and std must be (F,)")

    @property
    def peak(self) -> tuple[float, float, float]:
        """Largest |S| over the lines, its standard deviation, and its frequency, rad/s.

        ValueError, by numpy, without any line.
        """
        size = np.abs(self.response)
        at = int(np.argmax(size))
        return float(size[at]), float(self.std[at]), float(self.omega_rad_s[at])


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
    """S measured on a machine.

    Parameters
    ----------
    controller, machine, measured_index, measurement_step, command_step, clip
        As of `simulate`.
    rng : numpy.random.Generator
        Draws the phases of the excitation.
    **excitation
        Keywords of `sensitivity_of`: rms, band_rad_s, period_samples and others.

    Returns
    -------
    MeasuredSensitivity

    Raises
    ------
    ValueError
        What `simulate` and `sensitivity_of` refuse.
    """
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
    """S of a loop, measured by random-phase multisines: ratio of error to reference at their lines.

    Parameters
    ----------
    loop : callable
        Runs a reference (T,) from rest and gives the trajectory, of which `reference`, `measured`, `command`
        and `limited` (T,) are read.
    rng : numpy.random.Generator
        Draws the phases.
    dt_s : float
        Sampling time of the loop, s.
    rms : float
        Root mean square of the reference, unit of the output.
    band_rad_s : tuple of float
        Lowest and highest frequency that is excited, with equal amplitudes.
    period_samples : int
        Samples of a period; the lines are multiples of 2 pi / (period_samples dt_s).
    periods, draws : int
        Periods that count in each draw, and draws with phases of their own. Two periods of one draw are the
        fewest that show a scatter; only several draws show distortion.
    lead_in_periods : int
        Periods before, which are left out so that the loop has come to its periodic motion. One is chosen: a
        period that resolves the loop's slowest mode is as long as its transient. Whether the loop has come to
        rest is not checked; a slowly decaying one needs more.

    Returns
    -------
    MeasuredSensitivity

    Raises
    ------
    ValueError
        The band holds no line of the period, nothing would be left to take a scatter from, or rms is not
        positive. Not checked: dt_s and period_samples above zero, lead_in_periods not negative, and that the
        loop returns as many samples as it is given (numpy raises where the periods do not fit).

    Notes
    -----
    On a nonlinear machine the mean over draws is the best linear approximation for this spectrum and size,
    and the scatter between draws holds the distortion.
    """
    if periods < 1 or draws < 1 or periods * draws < 2:
        raise ValueError(f"a scatter needs two periods or two draws; got {periods} and {draws}")
    if not (rms > 0 and np.isfinite(rms)):
        raise ValueError(f"rms must be positive; got {rms}")
    # Lines below the Nyquist frequency, in the band.
    lines = np.arange(1, (period_samples - 1) // 2 + 1)
    omega = np.asarray(2 * np.pi * lines / (period_samples * dt_s), dtype=np.float64)
    is_excited = (omega >= band_rad_s[0]) & (omega <= band_rad_s[1])
    lines = lines[is_excited]
    omega = omega[is_excited]
    if lines.size == 0:
        raise ValueError(f"no line of {period_samples} samples lies in {band_rad_s} rad/s")

    # Ratios by draw, period and line.
    by_draw = []
    peak_command = 0.0
    limited_fraction = 0.0
    for _ in range(draws):
        # Equal amplitudes at the lines, random phases, scaled to the root mean square that is asked for.
        spectrum = np.zeros(period_samples // 2 + 1, dtype=np.complex128)
        spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
        period = np.fft.irfft(spectrum, period_samples)
        period *= rms / np.sqrt(np.mean(period**2))
        # Whole periods after the lead-in, so that their Fourier transform has no leakage.
        run = loop(np.tile(period, lead_in_periods + periods))
        error = (run.reference - run.measured)[lead_in_periods * period_samples :]
        error_lines = np.fft.rfft(error.reshape(periods, period_samples), axis=1)[:, lines]
        by_draw.append(error_lines / np.fft.rfft(period)[lines])
        peak_command = max(peak_command, float(np.max(np.abs(run.command))))
        limited_fraction += float(np.mean(run.limited)) / draws
    ratios = np.array(by_draw)

    # Scatter of the draws' means, or of the periods of a single draw.
    samples = ratios.mean(axis=1) if draws > 1 else ratios[0]
    n_samples = len(samples)
    squares = np.abs(samples - samples.mean(axis=0)) ** 2
    variance_of_mean = np.sum(squares, axis=0) / (n_samples - 1) / n_samples
    # Half of a complex mean's scatter lies along the modulus.
    std = np.asarray(np.sqrt(0.5 * variance_of_mean), dtype=np.float64)
    response = ratios.mean(axis=(0, 1))
    return MeasuredSensitivity(omega, response, std, rms, peak_command, limited_fraction)


@dataclass(frozen=True)
class StepMetrics:
    """Step response in numbers.

    Attributes
    ----------
    step_size : float
        Of the reference, from its first to its last value, unit of the output.
    rise_time_s : float or None
        From 10 % to 90 % of the step, s; None where the response never gets there.
    overshoot_percent, undershoot_percent : float
        Largest excess over the final level, and largest motion against the step, in % of it.
    settling_time_s : float or None
        From the step to the last time the response enters the band around the reference's final level, s;
        None where it does not stay there.
    steady_error : float
        Mean error over the last tenth of the samples after the step, unit of the output.
    peak_command : float
        Largest |command| of the whole record, input unit.
    limited_fraction : float
        Share of samples after the step at which the command was limited.
    """

    step_size: float
    rise_time_s: float | None
    overshoot_percent: float
    undershoot_percent: float
    settling_time_s: float | None
    steady_error: float
    peak_command: float
    limited_fraction: float


def step_metrics(trajectory: ClosedLoopTrajectory, *, settling_band: float = _SETTLING_BAND) -> StepMetrics:
    """Rise time, overshoot, undershoot, settling time, steady error and peak command of a step response.

    Parameters
    ----------
    trajectory : ClosedLoopTrajectory
        Its reference changes once: time starts at the first sample that differs from the first value. A
        reference that stands at one level from the beginning is a step from zero at the first sample.
    settling_band : float
        Half width of the band, as a share of the step; the usual 2 %. Not checked: positive.

    Returns
    -------
    StepMetrics

    Raises
    ------
    ValueError
        The reference is not a step: it stays at zero, or has more than one level after the change.

    Notes
    -----
    An output of nan, as of a simulation that ran away, is inside of no band: it does not settle, and
    overshoot, undershoot and steady error are nan.

    Examples
    --------
    >>> law = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> metrics = flexlink.step_metrics(flexlink.simulate_loop(law, example_plant(), [1.0] * 400))
    >>> round(metrics.rise_time_s, 2), round(metrics.overshoot_percent, 1)
    (0.27, 6.8)
    """
    reference = trajectory.reference
    measured = trajectory.measured

    # Where the step begins, from which level, and how large it is.
    changed = np.flatnonzero(reference != reference[0])
    at = 0
    first_level = 0.0
    if changed.size:
        at = int(changed[0])
        first_level = float(reference[0])
    size = float(reference[-1] - first_level)
    if size == 0.0 or not np.all(reference[at:] == reference[-1]):
        raise ValueError("step_metrics needs a reference that steps once to a new level")
    progress = (measured[at:] - first_level) / size
    time = trajectory.time_s[at:] - trajectory.time_s[at]

    rise_begins = _first_crossing(time, progress, _RISE_FROM)
    rise_ends = _first_crossing(time, progress, _RISE_TO)
    rise_time_s = None
    if rise_begins is not None and rise_ends is not None:
        rise_time_s = rise_ends - rise_begins

    # Settled one sample after the last one outside the band. Written with "not", so that nan is outside.
    outside = np.flatnonzero(~(np.abs(progress - 1.0) <= settling_band))
    settling_time_s: float | None
    if outside.size == 0:
        settling_time_s = 0.0
    elif outside[-1] + 1 < progress.size:
        settling_time_s = float(time[outside[-1] + 1])
    else:
        settling_time_s = None

    tail = max(1, progress.size // _STEADY_PARTS)
    excess = float(np.max(progress)) - 1.0
    lowest = float(np.min(progress))
    return StepMetrics(
        step_size=size,
        rise_time_s=rise_time_s,
        overshoot_percent=100.0 * float(np.maximum(0.0, excess)),
        undershoot_percent=100.0 * float(np.maximum(0.0, 0.0 - lowest)),
        settling_time_s=settling_time_s,
        steady_error=float(np.mean(reference[-tail:] - measured[-tail:])),
        peak_command=float(np.max(np.abs(trajectory.command))),
        limited_fraction=float(np.mean(trajectory.limited[at:])),
    )


def _first_crossing(time: Real, value: Real, level: float) -> float | None:
    """First time (s) at which a signal (T,) reaches a level, interpolated; None if it never does.

    time (T,) in s, value and level in one unit. Not checked; a nan reaches no level.
    """
    above = np.flatnonzero(value >= level)
    if above.size == 0:
        return None
    k = int(above[0])
    if k == 0:
        return float(time[0])
    share = (level - value[k - 1]) / (value[k] - value[k - 1])
    step = time[k] - time[k - 1]
    return float(time[k - 1] + share * step)
