"""A linear control law around a linear arm with dry friction, stepped between the samples.

The sampled loop of `control_design.analysis.closed_loop.simulate` on the arm of `ident.friction.kernel`, in
one compiled function: the friction of a small reference turns round many times in a record, and an interval
over draws and sizes takes a million samples.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from ident.friction.kernel import advance, transitions


@numba.njit(cache=True)
def loop_through(
    reference: Any,
    noise: Any,
    added: Any,
    law: Any,
    limits: Any,
    steps: Any,
    delay: int,
    input_delay: int,
    rates: Any,
    chain: Any,
    weights: Any,
    dt_s: float,
    law_of_friction: Any,
    measured: Any,
    command: Any,
    limited: Any,
) -> None:
    """Fill measured (T,), command (T,) and limited (T,) of a loop from rest.

    reference, noise (T,): set point, and what is added to the position before it is measured in steps[0].
    added (T,): joins the law's command before it is limited. law (n + 1, n + 2): rows of the state and the
    output, columns A, B, M and C, D, - of x+ = A x + B e + M (limited - wanted), wanted = C x + D e + added.
    limits: of the command and of its change per sample, inf for none; steps: of measurement and command, 0
    for none. delay, input_delay: samples between computing a command and giving it to the arm, and until it
    acts there. The arm as in `step_through`.
    """
    order = law.shape[0] - 1
    moves = transitions(rates, chain, dt_s)
    state, x, later = np.zeros(rates.size, dtype=np.complex128), np.zeros(order), np.zeros(order)
    shaft, last = np.zeros(3), 0.0
    queue, waiting = np.zeros(delay + 1), np.zeros(input_delay + 1)
    for k in range(reference.size):
        y = shaft[0] + noise[k]
        if steps[0] > 0:
            y = steps[0] * np.round(y / steps[0])
        error = reference[k] - y
        wanted = law[order, order] * error + added[k]
        for i in range(order):
            wanted += law[order, i] * x[i]
        u = min(max(wanted, last - limits[1]), last + limits[1])
        u = min(max(u, -limits[0]), limits[0])
        for i in range(order):
            later[i] = law[i, order] * error + law[i, order + 1] * (u - wanted)
            for j in range(order):
                later[i] += law[i, j] * x[j]
        for i in range(order):
            x[i] = later[i]
        last = u
        if steps[1] > 0:
            u = steps[1] * np.round(u / steps[1])
        queue[k % (delay + 1)] = u
        u = queue[(k + 1) % (delay + 1)]
        measured[k], command[k], limited[k] = y, u, last != wanted
        waiting[k % (input_delay + 1)] = u
        applied = waiting[(k + 1) % (input_delay + 1)]
        advance(applied, state, shaft, moves, rates, chain, weights, dt_s, law_of_friction)
