"""The compiled time stepper on plain arrays; `plant.plan` makes them and explains the method.

One loop serves records (T samples) and closed loops (one sample a call), so both give the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import njit

Real = npt.NDArray[np.float64]
Integer = npt.NDArray[np.int64]
_F = TypeVar("_F", bound=Callable[..., object])

# Elements that switch, and smooth force channels.
FRICTION, CONTACT = 0, 1
SINE, CUBIC, STRIBECK, GRAVITY = 0, 1, 2, 3


def _compiled(function: _F) -> _F:
    return cast(_F, njit(cache=True, error_model="numpy")(function))


@_compiled
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
    """Fill force (3, J) at the nodes first..last from position (3, J)."""
    for node in range(first, last + 1):
        j = 0
        while j < channel_kind.size:
            kind = channel_kind[j]
            y = position[node, j]
            if kind == SINE:
                force[node, j] = channel[j, 0] * np.sin(channel[j, 1] * y + channel[j, 2])
            elif kind == CUBIC:
                force[node, j] = -channel[j, 0] * y**3
            elif kind == STRIBECK:
                slip = mode[int(channel[j, 2])]
                force[node, j] = 0.0 if slip == 0 else -slip * channel[j, 0] * np.exp(-abs(y) / channel[j, 1])
            else:
                # Root angle first, then every modal deflection:
                # V = g [S (1 - cos) + s.q sin + 1/2 cos q.K.q].
                g = channel[j, 0]
                sine, cosine = np.sin(y), np.cos(y)
                moment, shortening = 0.0, 0.0
                n = static_moment.size
                for i in range(n):
                    q = position[node, j + 1 + i]
                    moment += static_moment[i] * q
                    row = 0.0
                    for m in range(n):
                        row += geometric_stiffness[i, m] * position[node, j + 1 + m]
                    shortening += row * q
                    force[node, j + 1 + i] = -g * (sine * static_moment[i] + cosine * row)
                force[node, j] = -g * (channel[j, 1] * sine + cosine * moment - 0.5 * sine * shortening)
                j += n
            j += 1


@_compiled
def run(
    inputs: Real,
    observed: Real,
    x: Real,
    reference: Real,
    mode: Integer,
    substeps: Integer,
    step: Real,
    reach: Real,
    output_rows: Real,
    element: Real,
    element_rows: Real,
    element_rate: Real,
    channel_kind: Integer,
    channel: Real,
    channel_rows: Real,
    static_moment: Real,
    geometric_stiffness: Real,
) -> None:
    """Advance the state over T samples, writing the outputs at the start of each.

    inputs (T, 4): voltage of the first and second part of the sample, hub torque, tip force.
    observed (T, O): filled with output_rows (N, O) applied to the state at the start of each sample.
    x (N,), reference (E,), mode (E,): state, friction slider positions, slip and contact signs; changed in
        place.
    substeps (G,): steps per part of the sample (G = 1, or 2 with a fractional delay).
    step (G, Q, L, N + 3 + E + 3J, N): transition of (x, held inputs, node forces) per matrix set and step
        size 2^l.
    reach (G, Q, L, N + 3 + E + 3J, 2J): the same to the channel positions at the middle and the end of the
        step.
    element (E, 6): kind, then friction (k, Tc, Ts - Tc, vs, 0) or contact (gap/2, kc, cc, 0, 0).
    element_rows (E, 2, N): relative angle and speed.
    element_rate (Q, E, N + 3 + E + J): relative acceleration.
    channel_kind (J,), channel (J, 3), channel_rows (N, J): smooth forces and the position each depends on.
    static_moment (M,), geometric_stiffness (M, M): of the modes under gravity; empty without it.
    """
    n, n_elements, n_channels = x.size, mode.size, channel_kind.size
    n_held = 3 + n_elements
    levels = step.shape[2]
    held = np.zeros(n_held)
    new = np.empty(n)
    free = np.empty(2 * n_channels)
    position, f = np.zeros((3, n_channels)), np.zeros((3, n_channels))
    wanted = np.zeros(n_elements, dtype=np.int64)
    for k in range(inputs.shape[0]):
        for o in range(observed.shape[1]):
            total = 0.0
            for i in range(n):
                total += output_rows[i, o] * x[i]
            observed[k, o] = total
        for part in range(substeps.size):
            held[0], held[1], held[2] = inputs[k, part], inputs[k, 2], inputs[k, 3]
            for _ in range(substeps[part]):
                remaining, level = 1 << (levels - 1), levels - 1
                while remaining > 0:
                    # Which linear system holds, and with which constant forces.
                    q = 0
                    for e in range(n_elements):
                        if element[e, 0] == FRICTION:
                            if mode[e] == 0:
                                q += 1 << e
                                held[3 + e] = element[e, 1] * reference[e]
                            else:
                                held[3 + e] = -mode[e] * element[e, 2]
                        elif mode[e] != 0:
                            q += 1 << e
                            held[3 + e] = -mode[e] * element[e, 1] * element[e, 2]
                        else:
                            held[3 + e] = 0.0
                    w = step[part, q, level]
                    for i in range(n):
                        new[i] = 0.0
                    for m in range(n):
                        value = x[m]
                        for i in range(n):
                            new[i] += w[m, i] * value
                    for m in range(n_held):
                        value = held[m]
                        if value != 0.0:
                            for i in range(n):
                                new[i] += w[n + m, i] * value
                    if n_channels > 0:
                        g = reach[part, q, level]
                        for j in range(n_channels):
                            total = 0.0
                            for i in range(n):
                                total += channel_rows[i, j] * x[i]
                            position[0, j] = total
                        for j in range(2 * n_channels):
                            total = 0.0
                            for m in range(n):
                                total += g[m, j] * x[m]
                            for m in range(n_held):
                                total += g[n + m, j] * held[m]
                            free[j] = total
                        _smooth_forces(
                            0, 0, position, f, mode, channel_kind, channel, static_moment, geometric_stiffness
                        )
                        for j in range(n_channels):
                            f[1, j], f[2, j] = f[0, j], f[0, j]
                        # Collocation at start, middle and end (order 4). The sweeps contract by h |df/dv| / J,
                        # which `plant.plan` keeps below 0.3.
                        for sweep in range(12):
                            change, size = 0.0, 1e-3
                            for later in range(2):
                                for j in range(n_channels):
                                    column = later * n_channels + j
                                    total = free[column]
                                    for node in range(3):
                                        for c in range(n_channels):
                                            row = n + n_held + node * n_channels + c
                                            total += g[row, column] * f[node, c]
                                    change = max(change, abs(total - position[1 + later, j]))
                                    size = max(size, abs(total))
                                    position[1 + later, j] = total
                            if sweep > 0 and change <= 1e-9 * size:
                                break
                            _smooth_forces(
                                1,
                                2,
                                position,
                                f,
                                mode,
                                channel_kind,
                                channel,
                                static_moment,
                                geometric_stiffness,
                            )
                        for node in range(3):
                            for c in range(n_channels):
                                value = f[node, c]
                                row = n + n_held + node * n_channels + c
                                for i in range(n):
                                    new[i] += w[row, i] * value
                    # Does every element still hold its mode at the end of the step?
                    event = False
                    for e in range(n_elements):
                        angle, speed = 0.0, 0.0
                        for i in range(n):
                            angle += element_rows[e, 0, i] * new[i]
                            speed += element_rows[e, 1, i] * new[i]
                        wanted[e] = mode[e]
                        if element[e, 0] == FRICTION:
                            limit = element[e, 2]
                            if element[e, 3] != 0.0:
                                limit += element[e, 3] * np.exp(-abs(speed) / element[e, 4])
                            limit /= element[e, 1]
                            if mode[e] == 0:
                                stretch = angle - reference[e]
                                if abs(stretch) >= limit:
                                    wanted[e] = 1 if stretch > 0 else -1
                            else:
                                # The slider follows only while its own speed, shaft minus stretch rate,
                                # keeps the sign.
                                slider = speed
                                if element[e, 3] != 0.0:
                                    rate = 0.0
                                    for i in range(n):
                                        rate += element_rate[q, e, i] * new[i]
                                    for m in range(n_held):
                                        rate += element_rate[q, e, n + m] * held[m]
                                    for j in range(n_channels):
                                        rate += element_rate[q, e, n + n_held + j] * f[2, j]
                                    softening = (
                                        element[e, 3] / element[e, 4] * np.exp(-abs(speed) / element[e, 4])
                                    )
                                    slider += mode[e] * np.sign(speed) * softening * rate / element[e, 1]
                                if mode[e] * slider <= 0.0 or mode[e] * speed <= 0.0:
                                    wanted[e] = 0
                        else:
                            side = 1 if angle > 0 else -1
                            depth = side * angle - element[e, 1]
                            push = element[e, 2] * depth + element[e, 3] * side * speed
                            wanted[e] = side if depth > 0.0 and push > 0.0 else 0
                        event = event or wanted[e] != mode[e]
                    if event and level > 0:
                        level -= 1
                        continue
                    for i in range(n):
                        x[i] = new[i]
                    if event:
                        for e in range(n_elements):
                            if wanted[e] != mode[e]:
                                if element[e, 0] == FRICTION and wanted[e] == 0:
                                    angle, speed = 0.0, 0.0
                                    for i in range(n):
                                        angle += element_rows[e, 0, i] * x[i]
                                        speed += element_rows[e, 1, i] * x[i]
                                    limit = element[e, 2]
                                    if element[e, 3] != 0.0:
                                        limit += element[e, 3] * np.exp(-abs(speed) / element[e, 4])
                                    reference[e] = angle - mode[e] * limit / element[e, 1]
                                mode[e] = wanted[e]
                    remaining -= 1 << level
                    level = 0
                    while remaining > 0 and (remaining >> level) & 1 == 0:
                        level += 1
