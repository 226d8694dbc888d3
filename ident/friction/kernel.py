"""The compiled time stepper of a linear arm with dry friction at its shaft."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

STRIDES = 2
"""Parts of a sample, each taken in one step where nothing switches."""


@numba.njit(cache=True)
def _transition(rates: Any, chain: Any, step_s: float) -> tuple[Any, Any, Any]:
    """What a step does to a state: its decay, a unit of effort onto it, the state before it onto it."""
    n = rates.size
    decay, onto = np.empty(n, dtype=np.complex128), np.empty(n, dtype=np.complex128)
    carried = np.zeros(n, dtype=np.complex128)
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
    return decay, onto, carried


@numba.njit(cache=True)
def step_through(
    drive: Any,
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
    position in one step. A sample has `STRIDES` strides of `substeps` steps of step_s.

    Friction is an elastic element whose force is limited to `level`: it deflects by `presliding` before it
    slips. Its mean force over a step follows from the deflection in the middle of the step (implicit, so
    that a stiff element needs no shorter step). A stride over which the shaft slips on in one direction is
    taken at once: the force is constant there.
    """
    n = rates.size
    state, tried = np.zeros(n, dtype=np.complex128), np.empty(n, dtype=np.complex128)
    decay, onto, carried = _transition(rates, chain, step_s)
    far_decay, far_onto, far_carried = _transition(rates, chain, step_s * substeps)
    stiffness = level / presliding
    deflection, shaft = 0.0, 0.0
    for k in range(drive.size):
        position[k] = shaft
        total = 0.0
        for _ in range(STRIDES):
            if abs(deflection) == presliding:
                force = level if deflection > 0 else -level
                new, speed = 0.0, 0.0
                for j in range(n):
                    tried[j] = far_decay[j] * state[j] + far_onto[j] * (drive[k] - force)
                    pushed = tried[j - 1] if chain[j] else drive[k] - force + 0j
                    if chain[j]:
                        tried[j] += far_carried[j] * state[j - 1]
                    new += (weights[j] * tried[j]).real
                    speed += (weights[j] * (rates[j] * tried[j] + pushed)).real
                if (new - shaft) * deflection > 0 and speed * deflection > 0:
                    state, tried, shaft = tried, state, new
                    total += substeps * force
                    continue
            for _ in range(substeps):
                free = speed_gain * drive[k]
                for j in range(n - 1, -1, -1):
                    state[j] *= decay[j]
                    if chain[j]:
                        state[j] += carried[j] * state[j - 1]
                    free += (weights[j] * state[j]).real
                advance = free - shaft
                force = stiffness * (deflection + 0.5 * advance) / (1 + 0.5 * stiffness * speed_gain)
                force = min(max(force, -level), level)
                total += force
                new = free - speed_gain * force
                deflection = min(max(deflection + new - shaft, -presliding), presliding)
                shaft = new
                effort = drive[k] - force
                for j in range(n):
                    state[j] += onto[j] * effort
        friction[k] = total / (STRIDES * substeps)
