"""From a machine to the arrays the compiled stepper works on.

Method. Dry friction (an elastic element whose force is limited) and contact in a gear with backlash are
*piecewise linear*: in each of their modes the arm is one linear system, stepped exactly with its matrix
exponential. A step at whose end some element no longer holds its mode is halved, down to 1/512 of the basic
step, and only there the mode changes; step sizes are the basic one divided by powers of two, so their
matrices are prepared once. Smooth forces (ripple, cubic spring, gravity, the falling part of Stribeck
friction) enter as a parabola through their values at start, middle and end of the step (collocation, order
4); linear dynamics stay exact. Lags and a sinusoidal disturbance are linear systems of their own and part
of the state matrix. A delay splits every sample at the instant where the held voltage changes; where a
sample is no longer than a basic step it is one step all the same, with this change inside it, unless an
element does not hold its mode in it. Without switching or smooth forces there is one exact step a sample.

`make_plan` gathers all this for `plant.simulation`. `_Builder` holds the layout of the state and the matrices
over it; `_transitions` and `_change_inside` make the tables of steps. Letters of the shapes: N states, n
coordinates, M modes, E switching elements, J smooth forces, H = 4 + E held inputs, L step sizes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh, expm

from plant.kernel import (
    CONTACT,
    CONTACT_DAMPING,
    CONTACT_STIFFNESS,
    FRICTION,
    FRICTION_STIFFNESS,
    HELD_INPUTS,
    KIND,
    STRIBECK_EXCESS,
    STRIBECK_SPEED,
    run,
)
from plant.machine import GRAVITY, SINE, STRIBECK, Integer, Machine, Real
from plant.modal import MOTOR_SIDE_SHARE, Equations, default_n_modes, equations_of_motion, static_moment_kg_m

# The errors below are those of a 5 s record of the paper's link under a multisine of 3 V, against steps of
# 20 us, as a share of the sensor noise (root mean squares).

# Basic step where something switches, s: 8 a sample at 5 ms. Twice that where forces are smooth. Errors are
# 3e-6 (Coulomb friction), 5e-5 (backlash) and 3e-3 (steep Stribeck friction); doubled 2e-5, 2e-4 and 3e-3.
SUBSTEP_S = 6.25e-4
# A ripple of N cycles advances by at most this phase in one step at the speed of a brisk slew. That is so at
# the basic step above, and in proportion at others, up to the last. A contact has the same bound on the phase
# of its oscillation; doubled, the error of backlash is 2e-4 in place of 5e-5.
_RIPPLE_PHASE_RAD = 0.25
# Speed of a brisk slew, rad/s: half a turn in 0.6 s. Doubled, the error of a ripple of 40 cycles is 1e-7 in
# place of 2e-6.
_SLEW_RAD_S = 5.0
# Largest phase of a ripple in one step, however coarse the basic step is: a parabola follows a sine no
# further. With it the error of that ripple stays at 3e-5 for a basic step four times as long.
_LARGEST_PHASE_RAD = 0.5
# A basic step is halved this many times to place a switching instant (to 1.2 us at the basic step above).
# One fewer makes the errors of Coulomb friction and backlash four to five times as large.
_HALVINGS = 9
# A stuck friction element or a closed contact oscillates; its phase may advance by this much in one basic
# step; by no more than that of a ripple for contacts: the bounces that follow amplify what a step misses.
# That is so at the basic step above, and in proportion at others, up to as much as for friction. Doubled, no
# error above moves: on the paper's link the basic step is the shorter bound. It acts for stiffer friction.
_PHASE_PER_STEP_RAD = 0.8
# Falling Stribeck friction is a negative damper; a step may cover this much of its growth time. By that the
# sweeps of `plant.kernel` contract by as much each. Doubled, the error of steep friction above stays.
_GROWTH_PER_STEP = 0.3
# A fraction of a sample below this is no separate part of it: rounding of a delay that is meant as whole.
_SMALLEST_PART = 1e-9
# Rounding of a part that is a whole number of longest steps, relative: it is not divided once more.
_ROUNDING = 1e-12
# Frequency at which the two sides of a closed backlash bounce against each other, Hz. Above the modes of the
# link that matter, so that a contact looks rigid, and low enough for the steps above. Chosen.
_CONTACT_HZ = 180.0
# Damping of the contact over sqrt(motor-side inertia times stiffness); of critical damping with the inertia
# reduced between both sides that is 0.48: a bounce keeps little of its speed. Chosen.
_CONTACT_DAMPING_SHARE = 0.8
# Corner frequency of the accelerometer, rad/s: far above any mode, and its delay of 0.1 ms is none here.
_ACCELEROMETER_RAD_S = 2 * np.pi * 2000.0
# Damping ratio of the accelerometer: the flattest gain below its corner (Butterworth).
_ACCELEROMETER_DAMPING = float(np.sqrt(0.5))
# Parameters of a smooth force in the table of `plant.kernel`; a law with fewer leaves the last ones zero.
_CHANNEL_PARAMETERS = 3
# Columns in a table of `plant.kernel` come in fours, which it adds together.
_COLUMNS_TOGETHER = 4
# The last arguments of `plant.kernel.run`, from `signals` on, for a record: no loop around the arm.
_NO_LOOP = (
    np.zeros((0, 8)),
    np.zeros((1, 2)),
    *np.zeros((2, 2)),
    *np.zeros((2, 4)),
    np.zeros(4, dtype=np.int64),
    *np.zeros((2, 0, 2)),
    np.zeros(0),
    np.zeros(0, dtype=np.bool_),
)
# A search makes thousands of plans, always with the same nodes.
_gauss_legendre = lru_cache(maxsize=16)(np.polynomial.legendre.leggauss)


class PlanState(NamedTuple):
    """What the stepper changes in place: state (N,), slider positions (E,), slip and contact signs (E,)."""

    x: Real
    reference: Real
    mode: Integer


class Oscillator(NamedTuple):
    """A sinusoidal disturbance: index of its sine in the state, before its cosine, and angular frequency."""

    sine: int
    omega_rad_s: float


class _Elements(NamedTuple):
    """Switching elements: parameters (E, 6), columns of `plant.kernel`; rows (E, 2, N) of angle and speed."""

    parameters: Real
    rows: Real


class _Channel(NamedTuple):
    """One smooth force: law, up to three parameters, row (N,) of its position, column (N,) of its force."""

    law: int
    values: tuple[float, ...]
    row: Real
    column: Real


class _Channels(NamedTuple):
    """Smooth forces: laws (J,), parameters (J, 3), position rows (J, N), force columns (N, J)."""

    laws: Integer
    parameters: Real
    rows: Real
    columns: Real


@dataclass(frozen=True, eq=False)
class Plan:
    """The machine's arguments of `plant.kernel.run`, and what is needed beside them.

    arguments : tuple
        From `substeps` to `geometric_stiffness`.
    output_rows : (6, N)
        Hub angle as the encoder sees it, tip, tip behind the sensor's lag, tip acceleration, hub speed and
        tip deflection of the state; rad, m and s.
    initial_state : (N,)
        At rest at zero: only disturbances are not zero.
    start_columns : (N, 3 + 2M)
        State per unit of hub angle, hub speed, voltage, modal deflections and rates.
    slider_rows : (E, N)
        Angle of every switching element, rad.
    parts : int
        Of a sample, two with a fractional delay.
    delay_samples : int
        Whole samples of the voltage's delay.
    oscillators : tuple of Oscillator
        One per disturbance.
    """

    arguments: tuple[Any, ...]
    output_rows: Real
    initial_state: Real
    start_columns: Real
    slider_rows: Real
    parts: int
    delay_samples: int
    oscillators: tuple[Oscillator, ...]

    def advance(self, inputs: Real, state: PlanState) -> Real:
        """States (T, N) at the start of every sample under inputs (T, 4); changes the state to the end.

        Columns of the inputs: acting voltage in the first and in the second part of the sample, V, outside
        torque on the hub, N m, outside force at the tip, N.
        """
        states = np.empty((len(inputs), state.x.size))
        run(inputs, states, *state, *self.arguments, *_NO_LOOP)
        return states

    def at(self, start: Real | None = None, time_s: float = 0.0) -> PlanState:
        """State at the start of a record: every friction element stuck without a load, every contact open.

        Parameters
        ----------
        start : (3 + 2m,), optional
            Hub angle, hub speed, acting voltage, first m modal deflections and their rates; without it at
            rest at zero.
        time_s : float
            How long disturbances have been running.

        Returns
        -------
        PlanState
            Arrays of its own, which `advance` may change.
        """
        x = self.initial_state.copy()
        if time_s != 0.0:
            for oscillator in self.oscillators:
                sine = np.sin(oscillator.omega_rad_s * time_s)
                cosine = np.cos(oscillator.omega_rad_s * time_s)
                rotation = [[cosine, sine], [-sine, cosine]]
                pair = slice(oscillator.sine, oscillator.sine + 2)
                x[pair] = rotation @ x[pair]
        if start is not None:
            n_started = (start.size - 3) // 2
            n_modes = (self.start_columns.shape[1] - 3) // 2
            # Modes beyond the first m start at zero.
            x += self.start_columns[:, : 3 + n_started] @ start[: 3 + n_started]
            x += self.start_columns[:, 3 + n_modes : 3 + n_modes + n_started] @ start[3 + n_started :]
        sliders = self.slider_rows @ x
        return PlanState(x, sliders, np.zeros(sliders.size, dtype=np.int64))


def make_plan(
    machine: Machine, dt_s: float, n_modes: int | None, substep_s: float, *, accelerometer: bool = False
) -> Plan:
    """The stepper's arrays for a machine that is sampled at dt_s.

    Parameters
    ----------
    machine : Machine
        Rig and paths; nothing is checked here (`plant.simulation` does).
    dt_s : float
        Sampling period.
    n_modes : int or None
        Modes of the link; None takes `plant.modal.default_n_modes`.
    substep_s : float
        Longest step where something switches; twice that where forces are smooth.
    accelerometer : bool
        The second derivative of the true tip position is an output too; else that row is zero.

    Returns
    -------
    Plan
    """
    if n_modes is None:
        n_modes = default_n_modes(machine.rig)
    builder = _Builder(machine, equations_of_motion(machine, n_modes), accelerometer=accelerometer)
    elements = builder.elements()
    channels = builder.channels()
    held_columns = builder.held_columns()
    n_states = builder.n_states
    n_held = held_columns.shape[1]
    n_elements = len(elements.parameters)
    n_channels = channels.laws.size
    # Every element is a spring or none: a matrix for each combination.
    state_matrices = [builder.state_matrix(q, elements) for q in range(2**n_elements)]

    # A fractional delay splits a sample where the voltage changes; each part is divided into equal steps.
    longest_s = builder.longest_step_s(elements, held_columns, substep_s)
    delay_samples, fraction = _split_delay(machine.voltage.delay_s, dt_s)
    lengths_s = [dt_s]
    if fraction != 0.0:
        lengths_s = [fraction * dt_s, (1 - fraction) * dt_s]
    parts = len(lengths_s)
    is_linear = n_elements + n_channels == 0
    substeps = [1] * parts
    if not is_linear:
        substeps = [int(np.ceil(length_s / longest_s * (1 - _ROUNDING))) for length_s in lengths_s]

    # Where it is no longer than a step, a split sample is one step with the change of voltage inside it.
    as_one_step = parts == 2 and (dt_s <= longest_s or is_linear)
    if as_one_step and n_elements > 0:
        # Its parts follow for the samples in which an element switches.
        lengths_s = [dt_s, *lengths_s]
        substeps = [1, *substeps]
    elif as_one_step:
        lengths_s = [dt_s]
        substeps = [1]

    # Only a switching instant needs steps smaller than the basic one.
    n_levels = 1
    if n_elements > 0:
        n_levels = _HALVINGS + 1
    n_rows = n_states + n_held + 3 * n_channels
    table_shape = (len(lengths_s), len(state_matrices), n_levels, n_rows)
    step = np.zeros((*table_shape, _filled_up(n_states)))
    reach = np.zeros((*table_shape, _filled_up(2 * n_channels)))
    for part, (length_s, count) in enumerate(zip(lengths_s, substeps, strict=True)):
        is_whole_sample = as_one_step and part == 0
        for q, a in enumerate(state_matrices):
            step_levels = step[part, q, ..., :n_states]
            reach_levels = reach[part, q, ..., : 2 * n_channels]
            if is_whole_sample:
                # This step is never halved: its parts are taken instead.
                step_levels = step_levels[-1:]
                reach_levels = reach_levels[-1:]
            _transitions(a, held_columns, channels, length_s / count, step_levels, reach_levels)
            if is_whole_sample:
                voltage = held_columns[:, 1]
                _change_inside(a, voltage, channels.rows, dt_s, fraction, step_levels[0], reach_levels[0])

    # Acceleration of every element's angle, by which `plant.kernel` sees how friction that slips softens.
    element_rate = np.zeros((len(state_matrices), n_elements, n_states + n_held + n_channels))
    for q, a in enumerate(state_matrices):
        for e in range(n_elements):
            derivative = np.hstack([a, held_columns, channels.columns])
            element_rate[q, e] = elements.rows[e, 1] @ derivative
    # A table without columns has no rows either, which `reshape` cannot know.
    reach_table = np.zeros((0, 0))
    if n_channels > 0:
        reach_table = reach.reshape(-1, reach.shape[-1])
    arguments = (
        np.array(substeps, dtype=np.int64),
        int(as_one_step),
        step.reshape(-1, step.shape[-1]),
        reach_table,
        elements.parameters,
        elements.rows.reshape(-1, n_states),
        element_rate.reshape(-1, element_rate.shape[2]),
        channels.laws,
        channels.parameters,
        channels.rows,
        *builder.gravity(),
    )
    return Plan(
        arguments=arguments,
        output_rows=builder.outputs(),
        initial_state=builder.initial_state(),
        start_columns=builder.start_columns(state_matrices[0]),
        slider_rows=elements.rows[:, 0],
        parts=parts,
        delay_samples=delay_samples,
        oscillators=builder.oscillators,
    )


def _filled_up(columns: int) -> int:
    """Number of columns of a table that holds so many and is a multiple of those that are added together."""
    return -(-columns // _COLUMNS_TOGETHER) * _COLUMNS_TOGETHER


def _split_delay(delay_s: float, dt_s: float) -> tuple[int, float]:
    """Whole samples of a delay, and the remaining fraction of one, 0 where rounding alone made one."""
    samples = delay_s / dt_s
    whole = int(np.floor(samples))
    fraction = samples - whole
    if fraction < _SMALLEST_PART:
        return whole, 0.0
    if fraction > 1 - _SMALLEST_PART:
        return whole + 1, 0.0
    return whole, fraction


class _Builder:
    """Matrices, rows and columns of a machine over one layout of the state (N,).

    Layout: n coordinates of `plant.modal`, their n speeds; then, where the machine has them, the voltage
    behind its lag, V, the tip behind its sensor's lag, m, the accelerometer's mass (position, m, and speed
    over the corner frequency, m); then a sine and a cosine per disturbance. An index is None where the
    machine has no such state.
    """

    def __init__(self, machine: Machine, equations: Equations, *, accelerometer: bool = False) -> None:
        self.machine = machine
        self.equations = equations
        self.n_coordinates = equations.mass.shape[0]
        self.voltage_state: int | None = None
        self.sensor_state: int | None = None
        self.accelerometer_state: int | None = None
        size = 2 * self.n_coordinates
        if machine.voltage.lag_s > 0:
            self.voltage_state = size
            size += 1
        if machine.sensor.lag_s > 0:
            self.sensor_state = size
            size += 1
        if accelerometer:
            self.accelerometer_state = size
            size += 2
        oscillators = []
        for disturbance in machine.joint.disturbance:
            oscillators.append(Oscillator(size, 2 * np.pi * disturbance.frequency_Hz))
            size += 2
        self.oscillators = tuple(oscillators)
        self.n_states = size
        # Friction without a level is none, and has no stiffness either.
        self.frictions = [friction for friction in machine.joint.friction if friction.static_torque_Nm > 0]

    def _column(self, direction: Real) -> Real:
        """State derivative (N,) by a unit generalised force along a direction (n,) of `plant.modal`."""
        column = np.zeros(self.n_states)
        column[: 2 * self.n_coordinates] = self.equations.input_column(direction)
        return column

    def _position(self, direction: Real) -> Real:
        """Row (N,) that gives the displacement along a direction (n,) from the state."""
        row = np.zeros(self.n_states)
        row[: self.n_coordinates] = direction
        return row

    def _speed(self, direction: Real) -> Real:
        """Row (N,) that gives the speed along a direction (n,) from the state."""
        row = np.zeros(self.n_states)
        row[self.n_coordinates : 2 * self.n_coordinates] = direction
        return row

    def _motor_column(self) -> Real:
        """State derivative (N,) by one volt at the motor."""
        return self.machine.rig.motor.torque_per_volt_Nm_V * self._column(self.equations.shaft)

    def state_matrix(self, q: int, elements: _Elements) -> Real:
        """A (N, N) with the springs of the elements whose bit is set in q: stuck friction, closed contact."""
        n_mechanical = 2 * self.n_coordinates
        a = np.zeros((self.n_states, self.n_states))
        a[:n_mechanical, :n_mechanical] = self.equations.state_matrix()
        voltage = self.voltage_state
        if voltage is not None:
            a[:, voltage] += self._motor_column()
            a[voltage, voltage] = -1 / self.machine.voltage.lag_s
        sensor = self.sensor_state
        if sensor is not None:
            sensor_lag_s = self.machine.sensor.lag_s
            a[sensor] += self._position(self.equations.tip) / sensor_lag_s
            a[sensor, sensor] = -1 / sensor_lag_s
        position = self.accelerometer_state
        if position is not None:
            # The second state is a speed over the corner frequency: both are of one size.
            a[position, position + 1] = _ACCELEROMETER_RAD_S
            a[position + 1] = self._acceleration(position) / _ACCELEROMETER_RAD_S
        for (sine, omega), disturbance in zip(self.oscillators, self.machine.joint.disturbance, strict=True):
            a[:, sine] += disturbance.amplitude_Nm * self._column(self.equations.hub)
            a[sine, sine + 1] = omega
            a[sine + 1, sine] = -omega
        columns = self._element_columns()
        for e, element in enumerate(elements.parameters):
            is_spring = q >> e & 1
            if not is_spring:
                continue
            angle_row, speed_row = elements.rows[e]
            if element[KIND] == FRICTION:
                a -= element[FRICTION_STIFFNESS] * np.outer(columns[:, e], angle_row)
            else:
                push_row = element[CONTACT_STIFFNESS] * angle_row + element[CONTACT_DAMPING] * speed_row
                a += np.outer(columns[:, e], push_row)
        return a

    def held_columns(self) -> Real:
        """Columns (N, 4 + E) of what is constant over a step.

        They are the voltage before and after it changes in the step, hub torque, tip force, and one force per
        element. The first is zero here: `_change_inside` fills its transition where the voltage does change.
        """
        if self.voltage_state is None:
            voltage = self._motor_column()
        else:
            voltage = np.eye(self.n_states)[self.voltage_state] / self.machine.voltage.lag_s
        voltage_before = np.zeros(self.n_states)
        hub_torque = self._column(self.equations.hub)
        tip_force = self._column(self.equations.tip)
        return np.column_stack([voltage_before, voltage, hub_torque, tip_force, self._element_columns()])

    def _element_columns(self) -> Real:
        """Columns (N, E) of the forces of friction, on the shaft, and contact, on hub against motor side."""
        columns = [self._column(self.equations.shaft) for _ in self.frictions]
        if self.equations.backlash is not None:
            columns.append(-self._column(self.equations.backlash))
        if not columns:
            return np.zeros((self.n_states, 0))
        return np.column_stack(columns)

    def elements(self) -> _Elements:
        """The friction elements, in the order of the machine, then the contact of a backlash."""
        parameters: list[tuple[float, ...]] = []
        directions = []
        for friction in self.frictions:
            excess_Nm = friction.static_torque_Nm - friction.coulomb_torque_Nm
            speed_rad_s = friction.stribeck_velocity_rad_s
            stiffness = friction.stiffness_Nm_rad
            parameters.append((FRICTION, stiffness, friction.coulomb_torque_Nm, excess_Nm, speed_rad_s, 0.0))
            directions.append(self.equations.shaft)
        gap_rad = self.machine.joint.backlash_gap_rad
        if gap_rad is not None and self.equations.backlash is not None:
            # Two inertias of 0.3 and 0.7 J against each other move like one of 0.3 * 0.7 J = 0.21 J.
            inertia = self.machine.rig.hub.inertia_kg_m2
            stiffness = 0.21 * inertia * (2 * np.pi * _CONTACT_HZ) ** 2
            damping = _CONTACT_DAMPING_SHARE * np.sqrt(MOTOR_SIDE_SHARE * inertia * stiffness)
            parameters.append((CONTACT, gap_rad / 2, stiffness, damping, 0.0, 0.0))
            directions.append(self.equations.backlash)
        rows = np.array([[self._position(direction), self._speed(direction)] for direction in directions])
        # Without elements the shapes are those of empty tables.
        return _Elements(np.array(parameters).reshape(-1, 6), rows.reshape(-1, 2, self.n_states))

    def channels(self) -> _Channels:
        """The smooth forces: what friction has above its Coulomb level, torques by law, gravity last."""
        equations = self.equations
        channels: list[_Channel] = []
        for e, friction in enumerate(self.frictions):
            excess_Nm = friction.static_torque_Nm - friction.coulomb_torque_Nm
            if excess_Nm != 0:
                # Its third parameter is the element whose slip gives the direction.
                values = (excess_Nm, friction.stribeck_velocity_rad_s, float(e))
                row = self._speed(equations.shaft)
                channels.append(_Channel(STRIBECK, values, row, self._column(equations.shaft)))
        # By law: sums of two of them are the same to the last digit for either order of the effects.
        for torque in sorted(self.machine.joint.torques, key=lambda torque: torque.law):
            if torque.values[0] != 0:
                place = equations.shaft if torque.at == "shaft" else equations.motor
                row = self._position(place) if torque.of == "angle" else self._speed(place)
                channels.append(_Channel(torque.law, torque.values, row, self._column(place)))
        if self.machine.gravity_m_s2 != 0:
            static_moment = static_moment_kg_m(self.machine.rig)
            values = (self.machine.gravity_m_s2, static_moment, self.machine.gravity_direction_rad)
            # It acts on the root's angle and on every mode, in this order, as `plant.kernel` expects.
            modal_directions = np.eye(self.n_coordinates)[equations.first_mode :]
            for direction in (equations.root, *modal_directions):
                row = self._position(direction)
                channels.append(_Channel(GRAVITY, values, row, self._column(direction)))

        parameters = [(*channel.values, 0.0, 0.0, 0.0)[:_CHANNEL_PARAMETERS] for channel in channels]
        rows = np.array([channel.row for channel in channels])
        columns = np.array([channel.column for channel in channels])
        return _Channels(
            laws=np.array([channel.law for channel in channels], dtype=np.int64),
            parameters=np.array(parameters).reshape(-1, _CHANNEL_PARAMETERS),
            rows=rows.reshape(-1, self.n_states),
            columns=columns.reshape(-1, self.n_states).T,
        )

    def gravity(self) -> tuple[Real, Real]:
        """First moments (M,) of the modes and stiffness (M, M) of the hanging weight, by unit of gravity.

        The moments are int m phi_i dx + mp phi_i(L); the stiffness is int (mass outboard of x) phi_i' phi_j'
        dx, by Gauss-Legendre quadrature. Both are empty without gravity.
        """
        if self.machine.gravity_m_s2 == 0:
            return np.zeros(0), np.zeros((0, 0))
        link = self.machine.rig.link
        modes = self.equations.modes
        # A mode has at most as many half waves as its number: eight nodes for each and sixteen for the ends
        # integrate products of two slopes to rounding.
        nodes, weights = _gauss_legendre(8 * modes.tip.size + 16)
        x_m = 0.5 * link.length_m * (nodes + 1)
        outboard_kg = link.mass_per_length_kg_m * (link.length_m - x_m) + self.machine.rig.payload.mass_kg
        slope = modes.slope(x_m)
        weighted_slope = (0.5 * link.length_m * weights * outboard_kg)[:, None] * slope
        return modes.first_moment.copy(), slope.T @ weighted_slope

    def outputs(self) -> Real:
        """Rows (6, N) of encoder, tip, tip behind its lag, tip acceleration, hub speed, deflection."""
        encoder = self._position(self.equations.encoder)
        tip = self._position(self.equations.tip)
        tip_behind_lag = tip
        if self.sensor_state is not None:
            tip_behind_lag = np.eye(self.n_states)[self.sensor_state]
        acceleration = np.zeros(self.n_states)
        if self.accelerometer_state is not None:
            acceleration = self._acceleration(self.accelerometer_state)
        encoder_speed = self._speed(self.equations.encoder)
        deflection = self._position(self.equations.bending)
        return np.array([encoder, tip, tip_behind_lag, acceleration, encoder_speed, deflection])

    def _acceleration(self, position: int) -> Real:
        """Row (N,) of the acceleration, m/s^2, that the accelerometer shows.

        A mass on a spring and a damper rides on the tip; shown is the force on the mass per unit of mass,
        w^2 (tip - mass) - 2 zeta w speed of the mass. position: index of the mass's position in the state.
        """
        row = self._position(self.equations.tip)
        row[position] = -1.0
        row[position + 1] = -2 * _ACCELEROMETER_DAMPING
        return _ACCELEROMETER_RAD_S**2 * row

    def start_columns(self, free: Real) -> Real:
        """State (N, 3 + 2M) per unit of hub angle, hub speed, voltage, modal deflections and their rates.

        The base is at rest in its middle, motor side and link root are turned with the hub; modes are those
        of the link with the hub held, one more with a compliant joint.

        free (N, N): state matrix with everything that slips slipping and every contact open.
        """
        equations = self.equations
        n = self.n_coordinates
        turned = np.zeros(n)
        turned[: equations.first_mode] = 1.0
        if self.machine.joint.base is not None:
            # Coordinate 1 is the base where there is one (`plant.modal.equations_of_motion`).
            turned[1] = 0.0
        if self.machine.joint.compliance is None:
            modes = np.eye(n)[:, equations.first_mode :]
        else:
            modes = self._modes_with_root()
        n_modes = modes.shape[1]
        columns = np.zeros((self.n_states, 3 + 2 * n_modes))
        columns[:n, 0] = turned
        columns[n : 2 * n, 1] = turned
        columns[:n, 3 : 3 + n_modes] = modes
        columns[n : 2 * n, 3 + n_modes :] = modes
        # Lags have settled.
        if self.voltage_state is not None:
            columns[self.voltage_state, 2] = 1.0
        if self.sensor_state is not None:
            columns[self.sensor_state] = self._position(equations.tip) @ columns
        position = self.accelerometer_state
        if position is not None:
            # As if the tip had moved with this speed and acceleration for long: the mass stays behind it by
            # 2 zeta / w times the speed and 1 / w^2 times the acceleration.
            corner = _ACCELEROMETER_RAD_S
            twice_damping = 2 * _ACCELEROMETER_DAMPING
            rates = free @ columns
            if self.voltage_state is None:
                rates[:, 2] += self._motor_column()
            acceleration = self._speed(equations.tip) @ rates
            tip_speed = self._speed(equations.tip) @ columns
            scaled_speed = (tip_speed - twice_damping * acceleration / corner) / corner
            distance_behind = twice_damping * scaled_speed + acceleration / corner**2
            columns[position] = self._position(equations.tip) @ columns - distance_behind
            columns[position + 1] = scaled_speed
        return columns

    def _modes_with_root(self) -> Real:
        """Mode shapes (n, M + 1) behind a held hub whose joint gives way: the link swings with its root."""
        equations = self.equations
        # The root is the coordinate before the first mode.
        free = slice(equations.first_mode - 1, None)
        shapes = eigh(equations.stiffness[free, free], equations.mass[free, free])[1]
        # Every one by the sign of the mode it would be with a rigid joint.
        signs = np.sign(equations.tip[free] @ shapes)
        signs[:-1] *= np.sign(equations.modes.tip)
        modes = np.zeros((self.n_coordinates, shapes.shape[1]))
        modes[free] = shapes * signs
        return modes

    def initial_state(self) -> Real:
        """State (N,) at rest at zero and at time zero, with the phases of the disturbances."""
        x = np.zeros(self.n_states)
        for oscillator, disturbance in zip(self.oscillators, self.machine.joint.disturbance, strict=True):
            x[oscillator.sine] = np.sin(disturbance.phase_rad)
            x[oscillator.sine + 1] = np.cos(disturbance.phase_rad)
        return x

    def longest_step_s(self, elements: _Elements, held_columns: Real, substep_s: float) -> float:
        """Longest step, s: the shortest of the bounds that ripple, friction and contact set.

        held_columns (N, 4 + E): the last E are the forces of the elements. substep_s: the basic step.
        """
        longest_s = 2 * substep_s
        if len(elements.parameters) > 0:
            longest_s = substep_s
        # Coarser than usual everywhere, if the caller wants the basic step coarser.
        coarseness = substep_s / SUBSTEP_S

        # A ripple must not turn by too much at a brisk slew.
        ripple_phase = min(_RIPPLE_PHASE_RAD * coarseness, _LARGEST_PHASE_RAD)
        for torque in self.machine.joint.torques:
            if torque.law == SINE:
                cycles = max(torque.values[1], 1.0)
                longest_s = min(longest_s, ripple_phase / (_SLEW_RAD_S * cycles))

        for e, element in enumerate(elements.parameters):
            # Acceleration of the element's angle by a unit of its force: one over the inertia that it sees.
            mobility = abs(elements.rows[e, 1] @ held_columns[:, HELD_INPUTS + e])
            phase = _PHASE_PER_STEP_RAD
            if element[KIND] == FRICTION:
                stiffness = element[FRICTION_STIFFNESS]
                if element[STRIBECK_EXCESS] != 0:
                    growth = element[STRIBECK_EXCESS] * mobility
                    longest_s = min(longest_s, _GROWTH_PER_STEP * element[STRIBECK_SPEED] / growth)
            else:
                stiffness = element[CONTACT_STIFFNESS]
                phase = min(phase, _RIPPLE_PHASE_RAD * coarseness)
            omega_rad_s = np.sqrt(stiffness * mobility)
            longest_s = min(longest_s, phase / omega_rad_s)
        return float(longest_s)


def _transitions(a: Real, held: Real, channels: _Channels, length_s: float, step: Real, reach: Real) -> None:
    """Fill step (L, N + H + 3J, N) and reach (L, N + H + 3J, 2J) for steps of length_s * 2^(l - L + 1).

    Both are transposed transitions by the matrix exponential of the system that has a (N, N), the H held
    inputs, held (N, H), and per smooth force a chain of three integrators, for its value, slope and curvature
    in time. step leads to the state at the end, reach to the positions of the J forces at middle and end.
    Doubling a step squares its transition.
    """
    n = a.shape[0]
    n_held = held.shape[1]
    n_force = channels.columns.shape[1]
    n_levels = step.shape[0]
    first_force = n + n_held
    size = first_force + 3 * n_force
    block = np.zeros((size, size))
    block[:n] = np.hstack([a, held, channels.columns, np.zeros((n, 2 * n_force))])
    # Force, slope and curvature in time: a chain of integrators.
    block[first_force : first_force + 2 * n_force, first_force + n_force :] = np.eye(2 * n_force)
    shortest_s = length_s / 2 ** (n_levels - 1)
    if n_force == 0:
        transition = expm(block * shortest_s)
        for level in range(n_levels):
            step[level] = transition[:n].T
            transition = transition @ transition
        return
    # From half the shortest step on: the middle of a step is the end of the one of half its length.
    powers = [expm(block * (shortest_s / 2))]
    for _ in range(n_levels):
        powers.append(powers[-1] @ powers[-1])
    halves = np.array(powers)[:, :n]
    h = shortest_s * 2.0 ** np.arange(n_levels)[:, None, None]
    to_middle = _by_nodes(halves[:-1], first_force, n_force, h)
    to_end = _by_nodes(halves[1:], first_force, n_force, h)
    step[:] = to_end.swapaxes(1, 2)
    reach[:, :, :n_force] = (channels.rows @ to_middle).swapaxes(1, 2)
    reach[:, :, n_force:] = (channels.rows @ to_end).swapaxes(1, 2)


def _change_inside(
    a: Real, voltage: Real, rows: Real, length_s: float, fraction: float, step: Real, reach: Real
) -> None:
    """Change step (N + H + 3J, N) and reach (N + H + 3J, 2J) for a voltage that changes inside the step.

    What a voltage held over the whole step does is shared out to that before and that after the change, which
    is at a fraction of the step's length. a (N, N), voltage (N,): state matrix and input column; rows (J, N):
    positions of the smooth forces.
    """
    n = a.shape[0]
    n_force = len(rows)
    before = n
    after = n + 1
    block = np.zeros((n + 1, n + 1))
    block[:n] = np.column_stack([a, voltage])

    def effect_of_late_voltage(instant: float) -> Real:
        """State (N,) at an instant, as a fraction of the step, by one volt since the change."""
        held_s = max(instant - fraction, 0.0) * length_s
        return np.asarray(expm(block * held_s)[:n, n])

    at_end = effect_of_late_voltage(1.0)
    step[before] = step[after] - at_end
    step[after] = at_end
    if n_force > 0:
        at_middle = effect_of_late_voltage(0.5)
        # Columns of reach: positions at the end stand behind those in the middle.
        for columns, state in ((slice(n_force, None), at_end), (slice(n_force), at_middle)):
            position = rows @ state
            reach[before, columns] = reach[after, columns] - position
            reach[after, columns] = position


def _by_nodes(transition: Real, first: int, n_force: int, h: Real) -> Real:
    """Transitions (L, N, first + 3J) from the forces at start, middle and end of steps h (L, 1, 1), s.

    transition (L, N, first + 3J) has columns for value, slope and curvature of the J forces at the start,
    from column `first` on. A parabola through values f0, f1, f2 at 0, h / 2 and h has there the slope
    (-3 f0 + 4 f1 - f2) / h and the curvature 4 (f0 - 2 f1 + f2) / h^2.
    """
    value = transition[..., first : first + n_force]
    slope = transition[..., first + n_force : first + 2 * n_force]
    curvature = transition[..., first + 2 * n_force : first + 3 * n_force]
    at_start = value - 3 / h * slope + 4 / h**2 * curvature
    at_middle = 4 / h * slope - 8 / h**2 * curvature
    at_end = -slope / h + 4 / h**2 * curvature
    return np.concatenate([transition[..., :first], at_start, at_middle, at_end], axis=-1)
