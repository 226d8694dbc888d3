"""The compiled time stepper of a linear arm with dry friction at its shaft."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True)
def step_through(
    drive: Any,
    moved: Any,
    rates: Any,
    chain: Any,
    weights: Any,
    speed_gain: float,
    step_s: float,
    substeps: int,
    level: float,
    presliding: float,
    position: Any,
    friction: Any,
) -> None:
    """Fill position (T,) and the mean friction of every sample (T,) for a drive (T,) held over each.

    The arm is a sum of states: a state j with rate s_j (1/s) obeys x' = s_j x + e, or, where chain[j] is
    true, x' = s_j x + x_before with x_before the state before it (a pole taken twice); e = drive - friction,
    and the position is the real part of sum weights_j x_j. speed_gain is what a unit of e adds to the
    position in one step.

    Friction is an elastic element whose force is limited to `level`: it deflects by `presliding` before it
    slips. Its mean force over a step follows from the deflection in the middle of the step (implicit, so
    that a stiff element needs no shorter step). moved (T,) is a further motion of the shaft from outside.
    """
    n = rates.size
    state = np.zeros(n, dtype=np.complex128)
    decay, onto, carried = np.empty_like(state), np.empty_like(state), np.zeros_like(state)
    for j in range(n):
        s = rates[j]
        if s == 0:
            decay[j], onto[j] = 1.0, step_s
        else:
            decay[j] = np.exp(s * step_s)
            onto[j] = (decay[j] - 1) / s
            if chain[j]:
                carried[j] = step_s * decay[j]
                onto[j] = (step_s * decay[j] - onto[j]) / s
    stiffness = level / presliding
    deflection, shaft = 0.0, 0.0
    for k in range(drive.size):
        position[k] = shaft + moved[k]
        outside = (moved[k + 1] - moved[k]) / substeps if k + 1 < drive.size else 0.0
        total = 0.0
        for _ in range(substeps):
            free = speed_gain * drive[k]
            for j in range(n - 1, -1, -1):
                state[j] *= decay[j]
                if chain[j]:
                    state[j] += carried[j] * state[j - 1]
                free += (weights[j] * state[j]).real
            advance = free - shaft + outside
            force = stiffness * (deflection + 0.5 * advance) / (1 + 0.5 * stiffness * speed_gain)
            force = min(max(force, -level), level)
            total += force
            new = free - speed_gain * force
            deflection = min(max(deflection + new - shaft + outside, -presliding), presliding)
            shaft = new
            effort = drive[k] - force
            for j in range(n):
                state[j] += onto[j] * effort
        friction[k] = total / substeps
