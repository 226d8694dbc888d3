"""The compiled time stepper of the arm, on plain arrays.

`run` advances the state over a record, or over a closed loop together with its controller. `plant.plan`
makes the arrays from a machine and derives the method: exact steps of a linear system between the switching
instants of dry friction and backlash, with smooth forces by collocation. One loop serves records and closed
loops, so both give the same numbers and are compiled once.

`run` stands last. For each step it calls `_hold` (forces of the modes that the elements are in), `_add_rows`
(one exact linear step), `_add_smooth_forces` (nonlinear forces), `_modes_still_hold` (whether an element
switches) and `_switch` (takes over the new modes).

Letters of the shapes: T samples, N states, E switching elements (dry friction, contact in a backlash), J
smooth forces, M modes of the link, G parts of a sample, Q = 2^E sets of matrices, L step sizes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

from plant.force_laws import force_of_law
from plant.machine import GRAVITY, STRIBECK, Integer, Real

_F = TypeVar("_F", bound=Callable[..., object])

# Kind of a switching element: dry friction. Kinds are labels in the column KIND.
FRICTION = 0
# Kind of a switching element: contact of the two sides of a backlash.
CONTACT = 1

# Columns of the table `element` (E, 6), which has a row for each switching element.
# Column of the kind, FRICTION or CONTACT.
KIND = 0
# Friction: column of the stiffness before sliding, N m/rad.
FRICTION_STIFFNESS = 1
# Friction: column of the Coulomb level Tc, N m.
COULOMB_LEVEL = 2
# Friction: column of what the static level has above the Coulomb level, Ts - Tc, N m.
STRIBECK_EXCESS = 3
# Friction: column of the speed vs over which the excess falls, rad/s.
STRIBECK_SPEED = 4
# Contact: column of half the gap, rad.
HALF_GAP = 1
# Contact: column of the stiffness, N m/rad.
CONTACT_STIFFNESS = 2
# Contact: column of the damping, N m s/rad.
CONTACT_DAMPING = 3

# Inputs that are held over a step, before the forces of the elements: the voltage before and the voltage
# after it changes in the step, hub torque, tip force.
HELD_INPUTS = 4

# A state smaller than this is set to zero. Far above 2e-308, below which numbers lose digits and take long;
# far below any motion.
_NOTHING = 1e-100
# Tolerance of an open or closed contact, rad: rounding of some hundred steps of a radian (2e-16 each).
# Far below the penetration of a contact that carries a load.
_SLACK_RAD = 1e-13
# The iteration for smooth forces ends when positions change by less than this share of the largest one.
# Measured on the paper's link (ripple, Stribeck friction, gravity, cubic spring): against 1e-12 the outputs
# move by less than 1e-7 of the sensor noise, and with 1e-7 by up to 5e-5 of it.
_SWEEP_TOLERANCE = 1e-9
# Positions smaller than this (rad, or sqrt(kg) m of a mode) count as this large in that comparison.
_SMALLEST_POSITION = 1e-3
# Sweeps at the most. Contracting by 0.3 or better (`plant.plan`), 12 sweeps gain at least six digits.
_MOST_SWEEPS = 12

# Nodes of a step. Typed: of Python's own integers numba compiles a version of the called function for each.
# Node at the start of the step.
_AT_START: Any = np.int64(0)
# Node in the middle of the step.
_IN_THE_MIDDLE: Any = np.int64(1)
# Node at the end of the step.
_AT_END: Any = np.int64(2)
# Row of the hub angle in what a loop measures; typed for the same reason.
_HUB: Any = np.int64(0)
# Row of the tip position in what a loop measures.
_TIP: Any = np.int64(1)
# Steps of an unsigned index (see `_add_rows`): a signed one beside it would turn the sum into a float.
_1, _2, _3, _4 = (np.uint64(i) for i in (1, 2, 3, 4))
# Compilation of a function that Python calls. C calls none; a division by zero gives inf, as in NumPy.
_ENTRY: Any = {"cache": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
# Compilation of a function that only compiled code calls.
_COMPILED: Any = {**_ENTRY, "no_cpython_wrapper": True}


def _called(function: _F) -> _F:
    """The function compiled for callers that are compiled too; Python cannot call it."""
    return cast(_F, njit(**_COMPILED)(function))


def _inlined(function: _F) -> _F:
    """The function compiled into its compiled callers: a piece of `run` that is kept apart for the reader.

    As calls such pieces would cost a factor of two: the compiler no longer sees that the work arrays do not
    overlap. Put together in the source (inline="always") they count references to every array, and so does a
    loop that is left by `break`.
    """
    return cast(_F, njit(**_COMPILED, forceinline=True)(function))


@_inlined
def _smooth_forces(
    first: int,
    last: int,
    position: Real,
    force: Real,
    mode: Integer,
    channel_kind: Integer,
    channel: Real,
    static_moment: Real,
    geometric_stiffness: Real,
) -> None:
    """Fill force (3J,) at the nodes first..last of a step from position (3J,), both node by node.

    A position is what the force of its channel depends on: an angle, rad, a speed, rad/s, or a modal
    deflection, sqrt(kg) m. Forces are in N m, or the generalised ones of a mode. mode (E,) are the slip signs
    of friction elements; the other arrays are those of `run`.
    The parameters channel[j] of a law stand with its label in `plant.machine`; Stribeck friction has the
    index of its element as the third.
    """
    for node in range(first, last + 1):
        k = node * channel_kind.size
        j = 0
        while j < channel_kind.size:
            kind = channel_kind[j]
            y = position[k + j]
            if kind == STRIBECK:
                slip = mode[int(channel[j, 2])]
                # What friction has above its Coulomb level while it slips; the level itself is held.
                force[k + j] = 0.0 if slip == 0 else -slip * channel[j, 0] * np.exp(-abs(y) / channel[j, 1])
            elif kind != GRAVITY:
                force[k + j] = force_of_law(kind, channel[j, 0], channel[j, 1], channel[j, 2], y)
            else:
                # Gravity g takes 1 + M channels in a row: the root angle, then every modal deflection q. With
                # S the static moment of the straight link, s and K those of the modes, and the angle from
                # where the link hangs, all are minus the derivatives of the potential
                # V = g [S (1 - cos) + s.q sin + 1/2 cos q.K.q].
                g = channel[j, 0]
                sine = np.sin(y - channel[j, 2])
                cosine = np.cos(y - channel[j, 2])
                moment = 0.0
                shortening = 0.0
                n = static_moment.size
                for i in range(n):
                    q = position[k + j + 1 + i]
                    moment += static_moment[i] * q
                    row = 0.0
                    for m in range(n):
                        row += geometric_stiffness[i, m] * position[k + j + 1 + m]
                    shortening += row * q
                    force[k + j + 1 + i] = -g * (sine * static_moment[i] + cosine * row)
                force[k + j] = -g * (channel[j, 1] * sine + cosine * moment - 0.5 * sine * shortening)
                j += n
            j += 1


@_inlined
def _hold(held: Real, mode: Integer, reference: Real, element: Real) -> int:
    """Index q of the matrix set for the modes (E,) of the elements; fills their constant forces into held.

    Bit e of q is set where element e is a spring: stuck friction or a closed contact. The spring itself is in
    the matrices of the set, what is constant of its force in held (4 + E,), N m: stiffness times reference
    (E,), where a stuck spring is without load, rad, or times half the gap. Friction that slips has its
    Coulomb level against the motion.
    """
    q = 0
    for e in range(mode.size):
        if element[e, KIND] == FRICTION:
            if mode[e] == 0:
                q += 1 << e
                held[HELD_INPUTS + e] = element[e, FRICTION_STIFFNESS] * reference[e]
            else:
                held[HELD_INPUTS + e] = -mode[e] * element[e, COULOMB_LEVEL]
        elif mode[e] != 0:
            q += 1 << e
            held[HELD_INPUTS + e] = -mode[e] * element[e, HALF_GAP] * element[e, CONTACT_STIFFNESS]
        else:
            held[HELD_INPUTS + e] = 0.0
    return q


@_inlined
def _add_rows(table: Real, first: int, values: Real, begin: int, end: int, total: Real) -> None:
    """Add to total (C,) the values begin..end - 1, each times its row of the table (R, C).

    The row of values[0] is `first`. Four columns at a time, of a multiple of four: their sums stay in
    registers, and a row costs no loop of its own. Indices are unsigned, because one that may be negative is
    looked at before every access.
    """
    base = np.uint64(first)
    for i in range(np.uint64(0), np.uint64(total.size), _4):
        a, b, c, d = total[i], total[i + _1], total[i + _2], total[i + _3]
        for m in range(np.uint64(begin), np.uint64(end)):
            value = values[m]
            row = base + m
            a += table[row, i] * value
            b += table[row, i + _1] * value
            c += table[row, i + _2] * value
            d += table[row, i + _3] * value
        total[i], total[i + _1], total[i + _2], total[i + _3] = a, b, c, d


@_inlined
def _along(rows: Real, row: int, x: Real) -> float:
    """Product of one row (N,) of the table with the vector x (N,); unsigned indices as in `_add_rows`."""
    total = 0.0
    r = np.uint64(row)
    for i in range(np.uint64(rows.shape[1])):
        total += rows[r, i] * x[i]
    return total


@_inlined
def _add_smooth_forces(
    step: Real,
    reach: Real,
    base: int,
    x: Real,
    held: Real,
    new: Real,
    free: Real,
    later: Real,
    position: Real,
    force: Real,
    mode: Integer,
    channel_kind: Integer,
    channel: Real,
    channel_rows: Real,
    static_moment: Real,
    geometric_stiffness: Real,
) -> None:
    """Add to the state `new` (N,) at the end of a step what the smooth forces do in it.

    The forces are a parabola in time through their values at start, middle and end (collocation, order 4),
    which depend on the positions there. They are found by fixed-point sweeps: positions, forces, positions.

    base : row of the tables step and reach where those of this step's part, matrix set and size begin.
    free, later (2J, filled up as reach) : work space, positions at middle and end without and with the
    forces.
    position (3J,), force (3J,) : work space, by node; the last J forces are those at the end of the step,
        which `_modes_still_hold` takes.
    """
    n = x.size
    n_channels = channel_kind.size
    first = base + n + held.size
    for i in range(free.size):
        free[i] = 0.0
    for j in range(n_channels):
        position[j] = _along(channel_rows, j, x)

    # What does not change from sweep to sweep: state, held inputs and the forces at the start.
    _add_rows(reach, base, x, 0, n, free)
    _add_rows(reach, base + n, held, 0, held.size, free)
    _smooth_forces(
        _AT_START, _AT_START, position, force, mode, channel_kind, channel, static_moment, geometric_stiffness
    )
    _add_rows(reach, first, force, 0, n_channels, free)
    # The first sweep takes the forces at the start for those at middle and end.
    for j in range(n_channels):
        force[n_channels + j] = force[2 * n_channels + j] = force[j]
    # The sweeps contract by h |df/dv| / J, which `plant.plan` keeps below 0.3.
    sweep = 0
    change = 1.0
    size = 0.0
    while sweep < _MOST_SWEEPS and (sweep < 2 or change > _SWEEP_TOLERANCE * size):
        if sweep > 0:
            _smooth_forces(
                _IN_THE_MIDDLE,
                _AT_END,
                position,
                force,
                mode,
                channel_kind,
                channel,
                static_moment,
                geometric_stiffness,
            )
        for i in range(free.size):
            later[i] = free[i]
        _add_rows(reach, first, force, n_channels, 3 * n_channels, later)
        change = 0.0
        size = _SMALLEST_POSITION
        for i in range(np.uint64(2 * n_channels)):
            before = np.uint64(n_channels) + i
            change = max(change, abs(later[i] - position[before]))
            size = max(size, abs(later[i]))
            position[before] = later[i]
        sweep += 1
    _add_rows(step, first, force, 0, 3 * n_channels, new)


@_called
def _largest_stretch(element: Real, e: int, speed: float) -> float:
    """Stretch, rad, of friction element e at which its force is the friction level at this speed, rad/s.

    The level is Tc + (Ts - Tc) exp(-|speed| / vs).
    """
    level = element[e, COULOMB_LEVEL]
    if element[e, STRIBECK_EXCESS] != 0.0:
        level += element[e, STRIBECK_EXCESS] * np.exp(-abs(speed) / element[e, STRIBECK_SPEED])
    return float(level / element[e, FRICTION_STIFFNESS])


@_inlined
def _modes_still_hold(
    new: Real,
    held: Real,
    force: Real,
    mode: Integer,
    wanted: Integer,
    reference: Real,
    element: Real,
    element_rows: Real,
    element_rate: Real,
    q: int,
) -> bool:
    """Whether every element has the mode (E,) that the step to the state `new` (N,) took it to have.

    Fills wanted (E,) with the mode that each has in `new`: the sign of the side at which a contact touches,
    the sign of the direction in which friction slips; 0 for open and for stuck. q is the index of the matrix
    set of the step; held (4 + E,) and the last J of force (3J,) are the inputs and the smooth forces at its
    end. reference (E,), rad, is the slider of a friction element.
    """
    n = element_rows.shape[1]
    n_held = held.size
    same = True
    for e in range(mode.size):
        angle = _along(element_rows, 2 * e, new)
        speed = _along(element_rows, 2 * e + 1, new)
        wanted[e] = mode[e]
        if element[e, KIND] == CONTACT:
            # Closed while the sides overlap and the damped spring between them pushes: it never pulls.
            side = 1 if angle > 0 else -1
            depth = side * angle - element[e, HALF_GAP]
            push = element[e, CONTACT_STIFFNESS] * depth + element[e, CONTACT_DAMPING] * side * speed
            # Where all has come to rest steps are lost in rounding: a contact would never get to open.
            slack = _SLACK_RAD if mode[e] == side else 0.0
            wanted[e] = side if depth > -slack and push > -element[e, CONTACT_STIFFNESS] * slack else 0
        elif mode[e] == 0:
            # Stuck until the spring before sliding carries the friction level.
            stretch = angle - reference[e]
            if abs(stretch) >= _largest_stretch(element, e, speed):
                wanted[e] = 1 if stretch > 0 else -1
        else:
            # The slider follows only while its own speed, shaft minus rate of stretch, keeps the sign. The
            # stretch changes where the level falls with speed; its rate has the acceleration as a factor.
            slider = speed
            if element[e, STRIBECK_EXCESS] != 0.0:
                rate = 0.0
                row = q * mode.size + e
                for i in range(n):
                    rate += element_rate[row, i] * new[i]
                for m in range(n_held):
                    rate += element_rate[row, n + m] * held[m]
                n_channels = force.size // 3
                for j in range(n_channels):
                    rate += element_rate[row, n + n_held + j] * force[2 * n_channels + j]
                fall = np.exp(-abs(speed) / element[e, STRIBECK_SPEED])
                softening = element[e, STRIBECK_EXCESS] / element[e, STRIBECK_SPEED] * fall
                slider += mode[e] * np.sign(speed) * softening * rate / element[e, FRICTION_STIFFNESS]
            if mode[e] * slider <= 0.0 or mode[e] * speed <= 0.0:
                wanted[e] = 0
        same = same and wanted[e] == mode[e]
    return same


@_inlined
def _switch(
    x: Real, mode: Integer, wanted: Integer, reference: Real, element: Real, element_rows: Real
) -> None:
    """Take the wanted modes (E,) over into mode (E,), in the state x (N,).

    A friction element that comes to stick keeps the stretch it has: its slider in reference (E,), rad, is set
    by the friction level against the motion that it had. One that begins to slip has no use for a slider.
    """
    for e in range(mode.size):
        if wanted[e] != mode[e] and element[e, KIND] == FRICTION and wanted[e] == 0:
            angle = _along(element_rows, 2 * e, x)
            speed = _along(element_rows, 2 * e + 1, x)
            reference[e] = angle - mode[e] * _largest_stretch(element, e, speed)
        mode[e] = wanted[e]


@njit(**_ENTRY)
def run(
    inputs: Real,
    states: Real,
    x: Real,
    reference: Real,
    mode: Integer,
    substeps: Integer,
    whole: int,
    step: Real,
    reach: Real,
    element: Real,
    element_rows: Real,
    element_rate: Real,
    channel_kind: Integer,
    channel: Real,
    channel_rows: Real,
    static_moment: Real,
    geometric_stiffness: Real,
    signals: Real,
    law: Real,
    limits: Real,
    grids: Real,
    path: Real,
    sensor: Real,
    counts: Integer,
    rows: Real,
    output: Real,
    command: Real,
    limited: Any,
) -> None:
    """Advance the state over T samples, of a record or of a closed loop.

    Of a record, signals is (0, 8), and states (T, N) are written, each at the start of its sample. Of a loop
    around hub angle or tip, output (T, 2), command (T,) and limited (T,) are filled; inputs and states are
    work space then, T = 1. Nothing is returned, and nothing is checked: `plant.simulation` calls this.

    Parameters
    ----------
    inputs : (T, 4)
        Acting voltage of the first and of the second part of the sample, V; hub torque, N m; tip force, N.
    states : (T, N)
        Filled with the state at the start of each sample (layout: `plant.plan._Builder`).
    x : (N,)
        State at the start; changed in place to that at the end, as are reference and mode.
    reference : (E,)
        Slider positions of friction elements, rad.
    mode : (E,) of int
        Slip and contact signs; 0 for stuck and for open.
    substeps : (G,) of int
        Steps per part of the sample: the sample itself, or two parts with a fractional delay.
    whole : int
        1 if the first of these parts is the sample as one step, in which the voltage changes: those behind it
        are taken where in that step an element does not hold its mode. Else 0.
    step : (G Q L R, N)
        Transition of the R = N + 4 + E + 3J values (x, held inputs with the voltage before and after it
        changes and a force per element, node forces) per part of the sample, matrix set and step size 2^l,
        one below the other: views of them cost up to a fourth.
    reach : (G Q L R, 2J)
        Transition of these values to the channel positions at the middle and the end of the step. Columns of
        zeros fill step and reach up to a multiple of four.
    element : (E, 6)
        Columns KIND, then friction (k, Tc, Ts - Tc, vs, 0) or contact (gap/2, kc, cc, 0, 0).
    element_rows : (2E, N)
        Relative angle and speed of each element.
    element_rate : (Q E, N + 4 + E + J)
        Relative acceleration of each element, by matrix set, from state, held values and forces.
    channel_kind : (J,) of int
        Law of each smooth force, one of those in `plant.machine`.
    channel : (J, 3)
        Parameters of each smooth force.
    channel_rows : (J, N)
        The position, or the speed, that each smooth force depends on.
    static_moment, geometric_stiffness : (M,), (M, M)
        Of the modes under gravity; empty without it.
    signals : (T, 8)
        Set point, what joins the law's command before its limits, what joins the measurement and the command
        that acts, hub torque, tip force, noise of hub angle and tip.
    law : (n + 1, n + 2)
        Controller of order n: rows of the state and the output, columns A, B, M and C, D, - of
        x+ = A x + B e + M (limited - wanted), wanted = C x + D e.
    limits : (2,)
        Of the command and of its change in a sample, V.
    grids : (2,)
        Steps of measurement and command, 0 for none.
    path : (4,)
        Limit that the machine clips its input at, then gain, dead zone and saturation of its voltage.
    sensor : (4,)
        Step of the hub's encoder, rad; gain, drift per sample, m, and step, m, of the tip sensor.
    counts : (4,) of int
        Samples from computing a command to handing it over, column that is measured, samples of the voltage's
        delay, parts of a sample.
    rows : (2, N)
        Hub angle and tip of the state.
    output : (T, 2)
        Filled with hub angle, rad, and tip position, m, as measured.
    command : (T,)
        Filled with the command, V, that is handed to the machine.
    limited : (T,) of bool
        Filled with whether a limit changed the law's command.
    """
    n = x.size
    n_elements = mode.size
    n_channels = channel_kind.size
    n_rows = n + HELD_INPUTS + n_elements + 3 * n_channels
    n_sets = 1 << n_elements
    n_levels = step.shape[0] // (n_rows * n_sets * substeps.size)
    held = np.zeros(HELD_INPUTS + n_elements)
    new = np.empty(step.shape[1])
    free = np.empty(reach.shape[1])
    later = np.empty(reach.shape[1])
    position = np.zeros(3 * n_channels)
    force = np.zeros(3 * n_channels)
    wanted = np.zeros(n_elements, dtype=np.int64)

    order = law.shape[0] - 1
    law_state = np.zeros(law.shape[0])
    next_law_state = np.zeros(law.shape[0])
    delay = counts[0]
    column = counts[1]
    wait = counts[2]
    last_command = 0.0
    # Ring buffers: commands that are computed and not yet handed over, voltages that do not act yet.
    queue = np.zeros(delay + 1)
    acting = np.zeros(wait + 2)

    for sample in range(max(inputs.shape[0], signals.shape[0])):
        k = sample
        if signals.shape[0] > 0:
            k = 0
            # Measure: encoder steps after the noise; gain and drift of the tip sensor before it.
            hub = _along(rows, _HUB, x) + signals[sample, 6]
            output[sample, 0] = hub if sensor[0] == 0 else sensor[0] * np.rint(hub / sensor[0])
            tip = sensor[1] * _along(rows, _TIP, x) + sensor[2] * sample + signals[sample, 7]
            output[sample, 1] = tip if sensor[3] == 0 else sensor[3] * np.rint(tip / sensor[3])
            y = output[sample, column] + signals[sample, 2]
            if grids[0] > 0:
                y = grids[0] * np.rint(y / grids[0])
            output[sample, column] = y

            # The law's command, limited in its change and then in its size.
            error = signals[sample, 0] - y
            wanted_u = law[order, order] * error + signals[sample, 1]
            for i in range(order):
                wanted_u += law[order, i] * law_state[i]
            u = min(max(wanted_u, last_command - limits[1]), last_command + limits[1])
            u = min(max(u, -limits[0]), limits[0])
            for i in range(order):
                next_law_state[i] = law[i, order] * error + law[i, order + 1] * (u - wanted_u)
                for j in range(order):
                    next_law_state[i] += law[i, j] * law_state[j]
            for i in range(order):
                law_state[i] = next_law_state[i]
            last_command = u
            limited[sample] = u != wanted_u

            # From the command to the voltage that acts: steps of the converter, delay of the controller,
            # the machine's input limit, gain, dead zone and saturation, delay of the voltage.
            if grids[1] > 0:
                u = grids[1] * np.rint(u / grids[1])
            queue[sample % (delay + 1)] = u
            u = queue[(sample + 1) % (delay + 1)]
            command[sample] = u
            voltage = path[1] * min(max(u + signals[sample, 3], -path[0]), path[0])
            acting[sample % (wait + 2)] = np.copysign(min(max(abs(voltage) - path[2], 0.0), path[3]), voltage)
            inputs[0, 1] = acting[(sample - wait) % (wait + 2)]
            # With two parts, a voltage one sample older acts in the first.
            inputs[0, 0] = acting[(sample + 1) % (wait + 2)] if counts[3] == 2 else inputs[0, 1]
            inputs[0, 2] = signals[sample, 4]
            inputs[0, 3] = signals[sample, 5]

        # What has died away is zero: numbers near the smallest there is take a hundred times as long.
        for i in range(n):
            states[k, i] = x[i]
            if abs(x[i]) < _NOTHING:
                x[i] = 0.0
        held[2] = inputs[k, 2]
        held[3] = inputs[k, 3]
        part = 0
        while part < substeps.size:
            if part < whole:
                held[0] = inputs[k, 0]
                held[1] = inputs[k, 1]
            else:
                held[1] = inputs[k, part - whole]
            next_part = part + 1
            steps = substeps[part]
            while steps > 0:
                steps -= 1
                # Time left in this step in units of the smallest one; a step of size 2^level starts on a
                # multiple of it.
                level = n_levels - 1
                remaining = 1 << level
                while remaining > 0:
                    # The linear step, exact, with the elements in the modes they have.
                    q = _hold(held, mode, reference, element)
                    base = ((part * n_sets + q) * n_levels + level) * n_rows
                    for i in range(new.size):
                        new[i] = 0.0
                    _add_rows(step, base, x, 0, n, new)
                    _add_rows(step, base + n, held, 0, held.size, new)
                    if n_channels > 0:
                        _add_smooth_forces(
                            step,
                            reach,
                            base,
                            x,
                            held,
                            new,
                            free,
                            later,
                            position,
                            force,
                            mode,
                            channel_kind,
                            channel,
                            channel_rows,
                            static_moment,
                            geometric_stiffness,
                        )
                    if n_elements > 0:
                        same = _modes_still_hold(
                            new, held, force, mode, wanted, reference, element, element_rows, element_rate, q
                        )
                        # An element switches: not in the sample as one step, whose parts are taken instead;
                        # else in the smallest step, down to which this one is halved.
                        if not same and part < whole:
                            remaining = 0
                            continue
                        if not same and level > 0:
                            level -= 1
                            continue
                        if not same:
                            _switch(new, mode, wanted, reference, element, element_rows)
                    for i in range(n):
                        x[i] = new[i]
                    # The sample as one step went through: its parts are done with.
                    if part < whole:
                        next_part = substeps.size
                    # The next step is the largest that may start here.
                    remaining -= 1 << level
                    level = 0
                    while remaining > 0 and (remaining >> level) & 1 == 0:
                        level += 1
            part = next_part
