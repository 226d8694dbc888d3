"""The compiled time stepper on plain arrays; `plant.plan` makes them and explains the method.

One loop serves records and closed loops, so both give the same numbers and are compiled once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

from plant.machine import CUBIC, QUADRATIC, SINE, STRIBECK, Integer, Real

_F = TypeVar("_F", bound=Callable[..., object])

FRICTION, CONTACT = 0, 1  # elements that switch
_NOTHING = 1e-100  # far above 2e-308, below which numbers lose digits and take long
_SLACK_RAD = 1e-13  # rounding of some hundred steps of a radian
# Nodes of a step; of Python's own integers numba compiles a version of the called function for each value.
_AT_START: Any = np.int64(0)
_IN_THE_MIDDLE: Any = np.int64(1)
_AT_END: Any = np.int64(2)
_HUB, _TIP = _AT_START, _IN_THE_MIDDLE  # rows of what a loop measures
_1, _2, _3, _4 = (np.uint64(i) for i in (1, 2, 3, 4))  # steps of unsigned indices
_ENTRY: Any = {"cache": True, "no_cfunc_wrapper": True, "error_model": "numpy"}  # C calls none
_COMPILED: Any = {**_ENTRY, "no_cpython_wrapper": True}


def _called(function: _F) -> _F:
    # By compiled code alone: the ways in for Python and C are not compiled.
    return cast(_F, njit(**_COMPILED)(function))


def _inlined(function: _F) -> _F:
    # Pieces of `run`, kept apart for the reader. As calls they would cost a factor of two: the compiler no
    # longer sees that the work arrays do not overlap. Put together in the source (inline="always") they count
    # references to every array, and so does a loop that is left by `break`.
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
    """Fill force (3J,) at the nodes first..last from position (3J,), node by node."""
    for node in range(first, last + 1):
        k = node * channel_kind.size
        j = 0
        while j < channel_kind.size:
            kind = channel_kind[j]
            y = position[k + j]
            if kind == SINE:
                force[k + j] = channel[j, 0] * np.sin(channel[j, 1] * y + channel[j, 2])
            elif kind == CUBIC:
                force[k + j] = -channel[j, 0] * y**3
            elif kind == QUADRATIC:
                force[k + j] = -channel[j, 0] * y * abs(y)
            elif kind == STRIBECK:
                slip = mode[int(channel[j, 2])]
                force[k + j] = 0.0 if slip == 0 else -slip * channel[j, 0] * np.exp(-abs(y) / channel[j, 1])
            else:
                # Root angle first, then every modal deflection:
                # V = g [S (1 - cos) + s.q sin + 1/2 cos q.K.q].
                g = channel[j, 0]
                sine, cosine = np.sin(y - channel[j, 2]), np.cos(y - channel[j, 2])
                moment, shortening = 0.0, 0.0
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
    """Fill in the constant force of every element in its mode; return the index of the matrix set."""
    q = 0
    for e in range(mode.size):
        if element[e, 0] == FRICTION:
            if mode[e] == 0:
                q += 1 << e
                held[4 + e] = element[e, 1] * reference[e]
            else:
                held[4 + e] = -mode[e] * element[e, 2]
        elif mode[e] != 0:
            q += 1 << e
            held[4 + e] = -mode[e] * element[e, 1] * element[e, 2]
        else:
            held[4 + e] = 0.0
    return q


@_inlined
def _add_rows(table: Real, first: int, values: Real, begin: int, end: int, total: Real) -> None:
    """Add values begin..end - 1 times their rows of the table; that of values[0] is the first.

    Four columns at a time, of a multiple of four: their sums stay in registers, and a row costs no loop of
    its own. Unsigned, because an index that may be negative is looked at before every access.
    """
    base = np.uint64(first)
    for i in range(np.uint64(0), np.uint64(total.size), _4):
        a, b, c, d = total[i], total[i + _1], total[i + _2], total[i + _3]
        for m in range(np.uint64(begin), np.uint64(end)):
            value, row = values[m], base + m
            a += table[row, i] * value
            b += table[row, i + _1] * value
            c += table[row, i + _2] * value
            d += table[row, i + _3] * value
        total[i], total[i + _1], total[i + _2], total[i + _3] = a, b, c, d


@_inlined
def _along(rows: Real, row: int, x: Real) -> float:
    total, r = 0.0, np.uint64(row)
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
    """Add to new what the smooth forces do in the step, by collocation at its start, middle and end (order
    4).

    base: row of these tables where the step's begin. free, later (2J, filled up as reach), position (3J,) and
    force (3J,) are work space; the last force is that at the end of the step.
    """
    n, n_channels = x.size, channel_kind.size
    first = base + n + held.size
    for i in range(free.size):
        free[i] = 0.0
    for j in range(n_channels):
        position[j] = _along(channel_rows, j, x)
    _add_rows(reach, base, x, 0, n, free)
    _add_rows(reach, base + n, held, 0, held.size, free)
    _smooth_forces(
        _AT_START, _AT_START, position, force, mode, channel_kind, channel, static_moment, geometric_stiffness
    )
    _add_rows(reach, first, force, 0, n_channels, free)
    for j in range(n_channels):
        force[n_channels + j] = force[2 * n_channels + j] = force[j]
    # The sweeps contract by h |df/dv| / J, which `plant.plan` keeps below 0.3.
    sweep, change, size = 0, 1.0, 0.0
    while sweep < 12 and (sweep < 2 or change > 1e-9 * size):
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
        change, size = 0.0, 1e-3
        for i in range(np.uint64(2 * n_channels)):
            before = np.uint64(n_channels) + i
            change = max(change, abs(later[i] - position[before]))
            size = max(size, abs(later[i]))
            position[before] = later[i]
        sweep += 1
    _add_rows(step, first, force, 0, 3 * n_channels, new)


@_called
def _largest_stretch(element: Real, e: int, speed: float) -> float:
    """Stretch of a friction element at which its force is the friction level of this speed."""
    level = element[e, 2]
    if element[e, 3] != 0.0:
        level += element[e, 3] * np.exp(-abs(speed) / element[e, 4])
    return float(level / element[e, 1])


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
    """Fill wanted with the mode every element has in the state new; whether all are as assumed."""
    n, n_held = element_rows.shape[1], held.size
    same = True
    for e in range(mode.size):
        angle, speed = _along(element_rows, 2 * e, new), _along(element_rows, 2 * e + 1, new)
        wanted[e] = mode[e]
        if element[e, 0] == CONTACT:
            side = 1 if angle > 0 else -1
            depth = side * angle - element[e, 1]
            push = element[e, 2] * depth + element[e, 3] * side * speed
            # Where all has come to rest steps are lost in rounding: a contact would never get to open.
            slack = _SLACK_RAD if mode[e] == side else 0.0
            wanted[e] = side if depth > -slack and push > -element[e, 2] * slack else 0
        elif mode[e] == 0:
            stretch = angle - reference[e]
            if abs(stretch) >= _largest_stretch(element, e, speed):
                wanted[e] = 1 if stretch > 0 else -1
        else:
            # The slider follows only while its own speed, shaft minus rate of stretch, keeps the sign.
            slider = speed
            if element[e, 3] != 0.0:
                rate, row = 0.0, q * mode.size + e
                for i in range(n):
                    rate += element_rate[row, i] * new[i]
                for m in range(n_held):
                    rate += element_rate[row, n + m] * held[m]
                n_channels = force.size // 3
                for j in range(n_channels):
                    rate += element_rate[row, n + n_held + j] * force[2 * n_channels + j]
                softening = element[e, 3] / element[e, 4] * np.exp(-abs(speed) / element[e, 4])
                slider += mode[e] * np.sign(speed) * softening * rate / element[e, 1]
            if mode[e] * slider <= 0.0 or mode[e] * speed <= 0.0:
                wanted[e] = 0
        same = same and wanted[e] == mode[e]
    return same


@_inlined
def _switch(
    x: Real, mode: Integer, wanted: Integer, reference: Real, element: Real, element_rows: Real
) -> None:
    """Take over the wanted modes; a friction element that sticks keeps the stretch it has."""
    for e in range(mode.size):
        if wanted[e] != mode[e] and element[e, 0] == FRICTION and wanted[e] == 0:
            angle, speed = _along(element_rows, 2 * e, x), _along(element_rows, 2 * e + 1, x)
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
    """Advance the state over T samples: of a record, signals (0, 8), writing down the state at the start of
    each; or of a loop around hub angle or tip, filling output (T, 2), command (T,) and limited (T,).

    inputs (T, 4): voltage of the first and second part of the sample, hub torque, tip force. states (T, N):
        filled. Of a loop both are work space, T = 1.
    x (N,), reference (E,), mode (E,): state, friction slider positions, slip and contact signs; changed in
        place.
    substeps (G,): steps per part of the sample: itself, or two with a fractional delay.
    whole: 1 if the first of these parts is the sample as one step, in which the voltage changes: those behind
        it are taken where in that step an element does not hold its mode. Else 0.
    step (G Q L R, N): transition of the R = N + 4 + E + 3J values (x, held inputs with the voltage before and
        after it changes, node forces) per part of the sample, matrix set and step size 2^l, one below the
        other: views of them cost up to a fourth.
    reach (G Q L R, 2J): the same to the channel positions at the middle and the end of the step. Columns of
        zeros fill both up to a multiple of four.
    element (E, 6): kind, then friction (k, Tc, Ts - Tc, vs, 0) or contact (gap/2, kc, cc, 0, 0).
    element_rows (2E, N): relative angle and speed.
    element_rate (Q E, N + 4 + E + J): relative acceleration.
    channel_kind (J,), channel (J, 3), channel_rows (J, N): smooth forces and the position each depends on.
    static_moment (M,), geometric_stiffness (M, M): of the modes under gravity; empty without it.
    signals (T, 8): set point, what joins the law's command before its limits, what joins the measurement and
        the command that acts, hub torque, tip force, noise of hub angle and tip.
    law (n + 1, n + 2): rows of the state and the output, columns A, B, M and C, D, - of x+ = A x + B e + M
        (limited - wanted), wanted = C x + D e. limits (2,): of the command and of its change in a sample.
        grids (2,): steps of measurement and command, 0 for none.
    path (4,): limit that the machine clips its input at, then gain, dead zone and saturation of its voltage.
    sensor (4,): step of the hub's encoder; gain, drift per sample and step of the tip sensor.
    counts (4,): samples from computing a command to handing it over, column that is measured, samples of the
        voltage's delay, parts of a sample.
    rows (2, N): hub angle and tip of the state.
    """
    n, n_elements, n_channels = x.size, mode.size, channel_kind.size
    n_rows, n_sets = n + 4 + n_elements + 3 * n_channels, 1 << n_elements
    n_levels = step.shape[0] // (n_rows * n_sets * substeps.size)
    held, new = np.zeros(4 + n_elements), np.empty(step.shape[1])
    free, later = np.empty(reach.shape[1]), np.empty(reach.shape[1])
    position, force = np.zeros(3 * n_channels), np.zeros(3 * n_channels)
    wanted = np.zeros(n_elements, dtype=np.int64)
    own, own_later = np.zeros(law.shape[0]), np.zeros(law.shape[0])
    order, delay, column, wait, last = law.shape[0] - 1, counts[0], counts[1], counts[2], 0.0
    queue, acting = np.zeros(delay + 1), np.zeros(wait + 2)
    for sample in range(max(inputs.shape[0], signals.shape[0])):
        k = sample
        if signals.shape[0] > 0:
            k = 0
            hub = _along(rows, _HUB, x) + signals[sample, 6]
            output[sample, 0] = hub if sensor[0] == 0 else sensor[0] * np.rint(hub / sensor[0])
            tip = sensor[1] * _along(rows, _TIP, x) + sensor[2] * sample + signals[sample, 7]
            output[sample, 1] = tip if sensor[3] == 0 else sensor[3] * np.rint(tip / sensor[3])
            y = output[sample, column] + signals[sample, 2]
            if grids[0] > 0:
                y = grids[0] * np.rint(y / grids[0])
            output[sample, column] = y
            error = signals[sample, 0] - y
            wanted_u = law[order, order] * error + signals[sample, 1]
            for i in range(order):
                wanted_u += law[order, i] * own[i]
            u = min(max(wanted_u, last - limits[1]), last + limits[1])
            u = min(max(u, -limits[0]), limits[0])
            for i in range(order):
                own_later[i] = law[i, order] * error + law[i, order + 1] * (u - wanted_u)
                for j in range(order):
                    own_later[i] += law[i, j] * own[j]
            for i in range(order):
                own[i] = own_later[i]
            last, limited[sample] = u, u != wanted_u
            if grids[1] > 0:
                u = grids[1] * np.rint(u / grids[1])
            queue[sample % (delay + 1)] = u
            u = queue[(sample + 1) % (delay + 1)]
            command[sample] = u
            voltage = path[1] * min(max(u + signals[sample, 3], -path[0]), path[0])
            acting[sample % (wait + 2)] = np.copysign(min(max(abs(voltage) - path[2], 0.0), path[3]), voltage)
            inputs[0, 1] = acting[(sample - wait) % (wait + 2)]
            inputs[0, 0] = acting[(sample + 1) % (wait + 2)] if counts[3] == 2 else inputs[0, 1]
            inputs[0, 2], inputs[0, 3] = signals[sample, 4], signals[sample, 5]
        # What has died away is zero: numbers near the smallest there is take a hundred times as long.
        for i in range(n):
            states[k, i] = x[i]
            if abs(x[i]) < _NOTHING:
                x[i] = 0.0
        held[2], held[3] = inputs[k, 2], inputs[k, 3]
        part = 0
        while part < substeps.size:
            if part < whole:
                held[0], held[1] = inputs[k, 0], inputs[k, 1]
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
                    if part < whole:
                        next_part = substeps.size
                    remaining -= 1 << level
                    level = 0
                    while remaining > 0 and (remaining >> level) & 1 == 0:
                        level += 1
            part = next_part
