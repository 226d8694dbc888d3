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
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh, expm

from plant.kernel import CONTACT, FRICTION, run
from plant.machine import GRAVITY, SINE, STRIBECK, Integer, Machine, Real
from plant.modal import MOTOR_SIDE_SHARE, Equations, default_n_modes, equations_of_motion, static_moment_kg_m

# Basic step where something switches: 8 a sample at 5 ms. Twice that where forces are smooth.
SUBSTEP_S = 6.25e-4
# A ripple of N cycles advances by at most this phase in one step at the speed of a brisk slew. That is so at
# the basic step above, and in proportion at others, up to the last.
_RIPPLE_PHASE_RAD, _SLEW_RAD_S, _LARGEST_PHASE_RAD = 0.25, 5.0, 0.5
# A basic step is halved this many times to place a switching instant (to 1.2 us at the basic step above).
_HALVINGS = 9
# A stuck friction element or a closed contact oscillates; its phase may advance by this much in one basic
# step; by no more than that of a ripple for contacts: the bounces that follow amplify what a step misses.
# That is so at the basic step above, and in proportion at others, up to as much as for friction.
_PHASE_PER_STEP_RAD = 0.8
# Falling Stribeck friction is a negative damper; a step may cover this much of its growth time.
_GROWTH_PER_STEP = 0.3
# A fraction of a sample below this is no separate part of it.
_SMALLEST_PART = 1e-9


# Corner and damping ratio of the accelerometer: far above any mode, and its delay of 0.1 ms is none here.
_ACCELEROMETER_RAD_S, _ACCELEROMETER_DAMPING = 2 * np.pi * 2000.0, float(np.sqrt(0.5))
# The last arguments of `plant.kernel.run`, from `signals` on, for a record.
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


@dataclass(frozen=True, eq=False)
class Plan:
    """The arguments of `plant.kernel.run` that are the machine's, from `substeps` on, and what is needed
    beside them.

    parts: of a sample, two with a fractional delay. delay_samples: whole ones. output_rows: (6, N).
    start_columns: (N, 3 + 2M). State per unit of hub angle, hub speed, voltage, modal deflections and rates.
    slider_rows: (E, N). Angle of every switching element.
    oscillators: of every disturbance, where its sine stands in the state, its cosine behind it, and its
        angular frequency.
    """

    arguments: tuple[Any, ...]
    output_rows: Real
    initial_state: Real
    start_columns: Real
    slider_rows: Real
    parts: int
    delay_samples: int
    oscillators: tuple[tuple[int, float], ...]

    def advance(self, inputs: Real, state: PlanState) -> Real:
        """(T, N) states at the start of every sample of inputs (T, 4); changes the state."""
        states = np.empty((len(inputs), state.x.size))
        run(inputs, states, *state, *self.arguments, *_NO_LOOP)
        return states

    def at(self, start: Real | None = None, time_s: float = 0.0) -> PlanState:
        """The state at the start: every friction element stuck without a load, every contact open.

        start (3 + 2m,): hub angle, hub speed, acting voltage, first m modal deflections and their rates;
        without it at rest at zero. time_s: how long disturbances have been running.
        """
        x = self.initial_state.copy()
        for sine, omega_rad_s in self.oscillators if time_s else ():
            s, c = np.sin(omega_rad_s * time_s), np.cos(omega_rad_s * time_s)
            x[sine : sine + 2] = [[c, s], [-s, c]] @ x[sine : sine + 2]
        if start is not None:
            m, modes = (start.size - 3) // 2, (self.start_columns.shape[1] - 3) // 2
            x += self.start_columns[:, : 3 + m] @ start[: 3 + m]
            x += self.start_columns[:, 3 + modes : 3 + modes + m] @ start[3 + m :]
        sliders = self.slider_rows @ x
        return PlanState(x, sliders, np.zeros(sliders.size, dtype=np.int64))


def make_plan(
    machine: Machine, dt_s: float, n_modes: int | None, substep_s: float, *, accelerometer: bool = False
) -> Plan:
    """Prepare the stepper for a machine sampled at dt_s.

    Its outputs are the hub angle, the true tip position, the tip position behind the sensor's lag, with an
    accelerometer the second derivative of the true tip position (else zero), hub speed and tip deflection.
    """
    equations = equations_of_motion(machine, default_n_modes(machine.rig) if n_modes is None else n_modes)
    builder = _Builder(machine, equations, accelerometer=accelerometer)
    element, element_rows = builder.elements()
    kinds, channel, channel_rows, force_columns = builder.channels()
    n, n_elements, n_channels = builder.n, element.shape[0], kinds.size
    held_columns = builder.held_columns()
    switching = n_elements + n_channels > 0
    halvings = _HALVINGS if n_elements else 0
    state_matrices = [builder.state_matrix(q, element, element_rows) for q in range(2**n_elements)]
    longest = builder.longest_step_s(element, element_rows, held_columns, substep_s)

    delay_samples, fraction = _split_delay(machine.voltage.delay_s, dt_s)
    lengths = (dt_s,) if fraction == 0.0 else (fraction * dt_s, (1 - fraction) * dt_s)
    substeps = [int(np.ceil(length / longest * (1 - 1e-12))) if switching else 1 for length in lengths]
    parts = len(lengths)
    whole = parts == 2 and (dt_s <= longest or not switching)
    if whole:
        # Only where an element may switch are its parts ever taken.
        lengths, substeps = ((dt_s, *lengths), [1, *substeps]) if n_elements else ((dt_s,), [1])
    tables = len(lengths), len(state_matrices), halvings + 1, n + held_columns.shape[1] + 3 * n_channels
    step, reach = (np.zeros((*tables, -(-columns // 4) * 4)) for columns in (n, 2 * n_channels))
    for part, (length, count) in enumerate(zip(lengths, substeps, strict=True)):
        for q, a in enumerate(state_matrices):
            into = step[part, q, ..., :n], reach[part, q, ..., : 2 * n_channels]
            if part < whole:
                into = into[0][-1:], into[1][-1:]
            _transitions(a, held_columns, force_columns, channel_rows, length / count, *into)
            if part < whole:
                _change_inside(a, held_columns[:, 1], channel_rows, dt_s, fraction, into[0][0], into[1][0])
    rate = np.zeros((len(state_matrices), n_elements, n + held_columns.shape[1] + n_channels))
    for q, a in enumerate(state_matrices):
        for e in range(n_elements):
            rate[q, e] = element_rows[e, 1] @ np.hstack([a, held_columns, force_columns])
    arguments = (
        np.array(substeps, dtype=np.int64),
        int(whole),
        step.reshape(-1, step.shape[-1]),
        reach.reshape(-1, reach.shape[-1]) if n_channels else np.zeros((0, 0)),
        element,
        element_rows.reshape(-1, n),
        rate.reshape(-1, rate.shape[2]),
        kinds,
        channel,
        channel_rows,
        *builder.gravity(),
    )
    return Plan(
        arguments,
        builder.outputs(),
        builder.initial_state(),
        builder.start_columns(state_matrices[0]),
        element_rows[:, 0],
        parts,
        delay_samples,
        builder.disturbances(),
    )


def _split_delay(delay_s: float, dt_s: float) -> tuple[int, float]:
    """Whole samples and the remaining fraction of one."""
    samples = delay_s / dt_s
    whole = int(np.floor(samples))
    fraction = samples - whole
    if fraction < _SMALLEST_PART:
        return whole, 0.0
    return (whole + 1, 0.0) if fraction > 1 - _SMALLEST_PART else (whole, fraction)


class _Builder:
    """State layout: coordinates, speeds, voltage lag, tip sensor lag, accelerometer (position, speed over its
    corner frequency), a sine and cosine per disturbance."""

    def __init__(self, machine: Machine, equations: Equations, *, accelerometer: bool = False) -> None:
        self.machine, self.equations = machine, equations
        size = 2 * equations.mass.shape[0]
        self.mechanical = size
        self.voltage_state = size if machine.voltage.lag_s > 0 else -1
        size += self.voltage_state >= 0
        self.sensor_state = size if machine.sensor.lag_s > 0 else -1
        size += self.sensor_state >= 0
        self.accelerometer = size if accelerometer else -1
        size += 2 * accelerometer
        self.oscillators = size
        self.n = size + 2 * len(machine.joint.disturbance)

    def _column(self, direction: Real) -> Real:
        return np.pad(self.equations.input_column(direction), (0, self.n - self.mechanical))

    def _position(self, direction: Real) -> Real:
        return np.pad(direction, (0, self.n - direction.size))

    def _speed(self, direction: Real) -> Real:
        return np.pad(direction, (direction.size, self.n - self.mechanical))

    def _motor_column(self) -> Real:
        return self.machine.rig.motor.torque_per_volt_Nm_V * self._column(self.equations.shaft)

    def state_matrix(self, q: int, element: Real, element_rows: Real) -> Real:
        """A with the springs of the elements whose bit is set in q: stuck friction, closed contact."""
        machine, eq = self.machine, self.equations
        a = np.zeros((self.n, self.n))
        a[: self.mechanical, : self.mechanical] = eq.state_matrix()
        if self.voltage_state >= 0:
            a[:, self.voltage_state] += self._motor_column()
            a[self.voltage_state, self.voltage_state] = -1 / machine.voltage.lag_s
        if self.sensor_state >= 0:
            a[self.sensor_state] += self._position(eq.tip) / machine.sensor.lag_s
            a[self.sensor_state, self.sensor_state] = -1 / machine.sensor.lag_s
        if self.accelerometer >= 0:
            at, corner = self.accelerometer, _ACCELEROMETER_RAD_S
            a[at, at + 1] = corner
            a[at + 1] = self._acceleration() / corner
        for (sine, omega), disturbance in zip(self.disturbances(), machine.joint.disturbance, strict=True):
            a[:, sine] += disturbance.amplitude_Nm * self._column(eq.hub)
            a[sine, sine + 1], a[sine + 1, sine] = omega, -omega
        columns = self._element_columns()
        for e in range(element.shape[0]):
            if q >> e & 1:
                if element[e, 0] == FRICTION:
                    a -= element[e, 1] * np.outer(columns[:, e], element_rows[e, 0])
                else:
                    a += np.outer(
                        columns[:, e], element[e, 2] * element_rows[e, 0] + element[e, 3] * element_rows[e, 1]
                    )
        return a

    def held_columns(self) -> Real:
        """Columns of what is constant over a step: voltage before and after it changes in it, hub torque, tip
        force, one force per element. The first is filled in where it does (`_change_inside`)."""
        eq = self.equations
        if self.voltage_state >= 0:
            voltage = np.eye(self.n)[self.voltage_state] / self.machine.voltage.lag_s
        else:
            voltage = self._motor_column()
        before, forces = np.zeros(self.n), self._element_columns()
        return np.column_stack([before, voltage, self._column(eq.hub), self._column(eq.tip), forces])

    def _element_columns(self) -> Real:
        """One column per element: friction drives the shaft, contact the hub against the motor side."""
        columns = [self._column(self.equations.shaft) for _ in self._friction()]
        if self.equations.backlash is not None:
            columns.append(-self._column(self.equations.backlash))
        return np.column_stack(columns) if columns else np.zeros((self.n, 0))

    def _friction(self) -> list[tuple[float, float, float, float]]:
        return [
            (
                f.stiffness_Nm_rad,
                f.coulomb_torque_Nm,
                f.static_torque_Nm - f.coulomb_torque_Nm,
                f.stribeck_velocity_rad_s,
            )
            for f in self.machine.joint.friction
            if f.static_torque_Nm > 0
        ]

    def elements(self) -> tuple[Real, Real]:
        """Parameters (E, 6) and rows of relative angle and speed (E, 2, N)."""
        eq = self.equations
        parameters: list[tuple[float, ...]] = [(FRICTION, *f, 0.0) for f in self._friction()]
        directions = [eq.shaft] * len(parameters)
        gap = self.machine.joint.backlash_gap_rad
        if gap is not None and eq.backlash is not None:
            inertia = self.machine.rig.hub.inertia_kg_m2
            stiffness = 0.21 * inertia * (2 * np.pi * 180) ** 2
            damping = 0.8 * np.sqrt(MOTOR_SIDE_SHARE * inertia * stiffness)
            parameters.append((CONTACT, gap / 2, stiffness, damping, 0.0, 0.0))
            directions.append(eq.backlash)
        rows = np.array([[self._position(d), self._speed(d)] for d in directions])
        return np.array(parameters).reshape(-1, 6), rows.reshape(-1, 2, self.n)

    def channels(self) -> tuple[Integer, Real, Real, Real]:
        """Smooth forces: kinds (J,), parameters (J, 3), position rows (J, N), force columns (N, J)."""
        machine, eq = self.machine, self.equations
        found: list[tuple[int, tuple[float, ...], Real, Real]] = []
        for e, (_, _, excess, velocity) in enumerate(self._friction()):
            if excess != 0:
                both = self._speed(eq.shaft), self._column(eq.shaft)
                found.append((STRIBECK, (excess, velocity, e), *both))
        # By law: sums of two of them are the same to the last digit for either order of the effects.
        for torque in sorted(machine.joint.torques, key=lambda t: t.law):
            if torque.values[0] != 0:
                place = eq.shaft if torque.at == "shaft" else eq.motor
                row = self._position(place) if torque.of == "angle" else self._speed(place)
                found.append((torque.law, torque.values, row, self._column(place)))
        if machine.gravity_m_s2 != 0:
            values = machine.gravity_m_s2, static_moment_kg_m(machine.rig), machine.gravity_direction_rad
            for direction in (eq.root, *np.eye(eq.mass.shape[0])[eq.first_mode :]):
                found.append((GRAVITY, values, self._position(direction), self._column(direction)))
        return (
            np.array([kind for kind, *_ in found], dtype=np.int64),
            np.array([(*values, 0.0, 0.0, 0.0)[:3] for _, values, *_ in found]).reshape(-1, 3),
            np.array([row for *_, row, _ in found]).reshape(-1, self.n),
            np.array([column for *_, column in found]).reshape(-1, self.n).T,
        )

    def gravity(self) -> tuple[Real, Real]:
        """First moments of the modes, int m phi_i dx + mp phi_i(L), and the stiffness of the hanging weight.

        The latter is int (mass outboard of x) phi_i' phi_j' dx, per unit of gravity.
        """
        if self.machine.gravity_m_s2 == 0:
            return np.zeros(0), np.zeros((0, 0))
        rig, modes = self.machine.rig, self.equations.modes
        nodes, weights = _gauss_legendre(8 * modes.tip.size + 16)
        x = 0.5 * rig.link.length_m * (nodes + 1)
        outboard = rig.link.mass_per_length_kg_m * (rig.link.length_m - x) + rig.payload.mass_kg
        slope = modes.slope(x)
        return modes.first_moment.copy(), slope.T @ (
            (0.5 * rig.link.length_m * weights * outboard)[:, None] * slope
        )

    def outputs(self) -> Real:
        """Rows: encoder, tip, tip behind the sensor lag, tip acceleration, encoder speed, deflection."""
        eq = self.equations
        tip, encoder = self._position(eq.tip), self._position(eq.encoder)
        behind = np.eye(self.n)[self.sensor_state] if self.sensor_state >= 0 else tip
        acceleration = self._acceleration() if self.accelerometer >= 0 else np.zeros(self.n)
        return np.array(
            [encoder, tip, behind, acceleration, self._speed(eq.encoder), self._position(eq.bending)]
        )

    def _acceleration(self) -> Real:
        """The accelerometer as a spring-mass system: the force on its mass per unit of mass."""
        row, at = self._position(self.equations.tip), self.accelerometer
        row[at], row[at + 1] = -1.0, -2 * _ACCELEROMETER_DAMPING
        return _ACCELEROMETER_RAD_S**2 * row

    def start_columns(self, free: Real) -> Real:
        """See `Plan`: base at rest in its middle, motor side and link root turned with the hub; modes of the
        link with the hub held.

        free (N, N): state matrix with everything that slips slipping.
        """
        eq, n = self.equations, self.mechanical // 2
        turned = np.zeros(n)
        turned[: eq.first_mode] = 1.0
        if self.machine.joint.base is not None:
            turned[1] = 0.0
        stiff = self.machine.joint.compliance is None
        modes = np.eye(n)[:, eq.first_mode :] if stiff else self._modes_with_root()
        columns = np.zeros((self.n, 3 + 2 * modes.shape[1]))
        columns[:n, 0] = columns[n : 2 * n, 1] = turned
        columns[:n, 3 : 3 + modes.shape[1]] = columns[n : 2 * n, 3 + modes.shape[1] :] = modes
        if self.voltage_state >= 0:
            columns[self.voltage_state, 2] = 1.0
        if self.sensor_state >= 0:
            columns[self.sensor_state] = self._position(eq.tip) @ columns
        if self.accelerometer >= 0:
            # As if the tip had moved with this speed and acceleration for long.
            corner, twice = _ACCELEROMETER_RAD_S, 2 * _ACCELEROMETER_DAMPING
            rates = free @ columns
            if self.voltage_state < 0:
                rates[:, 2] += self._motor_column()
            acceleration = self._speed(eq.tip) @ rates
            speed = (self._speed(eq.tip) @ columns - twice * acceleration / corner) / corner
            behind = twice * speed + acceleration / corner**2
            columns[self.accelerometer] = self._position(eq.tip) @ columns - behind
            columns[self.accelerometer + 1] = speed
        return columns

    def _modes_with_root(self) -> Real:
        """(n, M + 1): behind a held hub a link swings with its root, where the joint gives way."""
        eq, free = self.equations, slice(self.equations.first_mode - 1, None)
        shapes = eigh(eq.stiffness[free, free], eq.mass[free, free])[1]
        # Every one by the sign of the mode it would be with a rigid joint.
        signs = np.sign(eq.tip[free] @ shapes)
        signs[:-1] *= np.sign(eq.modes.tip)
        modes = np.zeros((eq.mass.shape[0], shapes.shape[1]))
        modes[free] = shapes * signs
        return modes

    def initial_state(self) -> Real:
        x = np.zeros(self.n)
        for (sine, _), disturbance in zip(self.disturbances(), self.machine.joint.disturbance, strict=True):
            x[sine], x[sine + 1] = np.sin(disturbance.phase_rad), np.cos(disturbance.phase_rad)
        return x

    def disturbances(self) -> tuple[tuple[int, float], ...]:
        """Where the sine of each stands in the state, and its angular frequency."""
        frequencies = (disturbance.frequency_Hz for disturbance in self.machine.joint.disturbance)
        return tuple((self.oscillators + 2 * i, 2 * np.pi * f) for i, f in enumerate(frequencies))

    def longest_step_s(
        self, element: Real, element_rows: Real, held_columns: Real, substep_s: float
    ) -> float:
        longest, coarse = substep_s if element.shape[0] else 2 * substep_s, substep_s / SUBSTEP_S
        for torque in self.machine.joint.torques:
            if torque.law == SINE:
                phase = min(_RIPPLE_PHASE_RAD * coarse, _LARGEST_PHASE_RAD)
                longest = min(longest, phase / (_SLEW_RAD_S * max(torque.values[1], 1.0)))
        for e in range(element.shape[0]):
            stiffness = element[e, 1] if element[e, 0] == FRICTION else element[e, 2]  # see `run`
            mobility = abs(element_rows[e, 1] @ held_columns[:, 4 + e])
            if element[e, 0] == FRICTION and element[e, 3] != 0:
                longest = min(longest, _GROWTH_PER_STEP * element[e, 4] / (element[e, 3] * mobility))
            most = _RIPPLE_PHASE_RAD * coarse if element[e, 0] == CONTACT else np.inf
            phase = min(_PHASE_PER_STEP_RAD, most)
            longest = min(longest, phase / np.sqrt(stiffness * mobility))
        return float(longest)


def _transitions(
    a: Real, held: Real, force: Real, rows: Real, length: float, step: Real, reach: Real
) -> None:
    """Fill step (L, N + H + 3J, N) and reach (L, N + H + 3J, 2J) for the lengths length * 2^(l - L + 1)."""
    n, n_held, n_force = a.shape[0], held.shape[1], force.shape[1]
    levels = step.shape[0]
    size = n + n_held + 3 * n_force
    block = np.zeros((size, size))
    block[:n] = np.hstack([a, held, force, np.zeros((n, 2 * n_force))])
    # Force, slope and curvature in time: a chain of integrators.
    first = n + n_held
    block[first : first + 2 * n_force, first + n_force :] = np.eye(2 * n_force)
    shortest = length / 2 ** (levels - 1)
    if n_force == 0:
        transition = expm(block * shortest)
        for level in range(levels):
            step[level] = transition[:n].T
            transition = transition @ transition
        return
    powers = [expm(block * (shortest / 2))]
    for _ in range(levels):
        powers.append(powers[-1] @ powers[-1])
    halves = np.array(powers)[:, :n]
    h = shortest * 2.0 ** np.arange(levels)[:, None, None]
    end = _by_nodes(halves[1:], first, n_force, h)
    step[:] = end.swapaxes(1, 2)
    reach[:, :, :n_force] = (rows @ _by_nodes(halves[:-1], first, n_force, h)).swapaxes(1, 2)
    reach[:, :, n_force:] = (rows @ end).swapaxes(1, 2)


def _change_inside(
    a: Real, voltage: Real, rows: Real, length: float, fraction: float, step: Real, reach: Real
) -> None:
    """Share out what a voltage held over a step does in step (N + H + 3J, N) and reach (N + H + 3J, 2J) to
    that before and after it changes at a fraction of the step's length."""
    n, n_force = a.shape[0], len(rows)
    block = np.zeros((n + 1, n + 1))
    block[:n] = np.column_stack([a, voltage])
    ends = (1.0, 0.5) if n_force else (1.0,)
    changed = [expm(block * (max(end - fraction, 0.0) * length))[:n, n] for end in ends]
    step[n] = step[n + 1] - changed[0]
    step[n + 1] = changed[0]
    for columns, after in zip((slice(n_force, None), slice(n_force)), changed, strict=False):
        reach[n, columns] = reach[n + 1, columns] - rows @ after
        reach[n + 1, columns] = rows @ after


def _by_nodes(transition: Real, first: int, n_force: int, h: Real) -> Real:
    """Columns for the forces at start, middle and end, from force, slope and curvature at the start."""
    value, slope, curve = (transition[..., first + i * n_force : first + (i + 1) * n_force] for i in range(3))
    return np.concatenate(
        [
            transition[..., :first],
            value - 3 / h * slope + 4 / h**2 * curve,
            4 / h * slope - 8 / h**2 * curve,
            -slope / h + 4 / h**2 * curve,
        ],
        axis=-1,
    )
