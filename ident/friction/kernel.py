"""The compiled time stepper of a linear arm with dry friction at its shaft, alone and in a sampled control
loop.

The arm is linear in real states, driven by drive - friction (`ArmSteps`).

Friction is an elastic element whose force is limited: to level + excess exp(-|v| / fall) at the speed v
before a step (Stribeck), reached after a deflection by `presliding`; law is (level, presliding, excess,
fall). The mean force over a step follows from the deflection in the middle of it (implicit). A sample has 32
steps: with a pre-sliding of ten microradians and samples of 5 ms the position is right to a hundredth of a
milliradian. Half a sample of slipping in one direction is taken at once.

The friction is told as the held force that moves a slow arm just as far: its mean plus (M of the sample
before - M of the sample after) / 2, M the first moment of the force about the middle of a sample.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from ident.data.arrays import COMPILED, INSIDE

STRIDES, _STEPS = 2, 16  # strides of a sample, steps of a stride
STEPS = STRIDES * _STEPS  # of a sample
_LOAD_STEPS = 8  # steps of a sample of the load behind a spring, whose swing is slower than a shaft's stop
_OVER = 8.0  # speeds, in units of `fall`, from which on the excess is gone
_TINY = np.finfo(np.float64).tiny


class ArmSteps(NamedTuple):
    """What the kernels know of a linear arm of M real states, input held over a step, and over a stride.

    stride (M, M): states over a stride, held (M,) what a unit of effort adds to them; pushes (S, M) by the
    end of a stride of S steps, of a unit of effort in one step. ahead (S, M): of the states onto the position
    after each step; pulse (S,): of a unit of effort in one step, after so many more. slope (M + 1,): of
    states and effort onto the speed.
    """

    stride: Any
    held: Any
    pushes: Any
    ahead: Any
    pulse: Any
    slope: Any


@numba.njit(**INSIDE)
def advance(drive: float, state: Any, shaft: Any, free: Any, arm: ArmSteps, dt_s: float, law: Any) -> Any:
    """One sample: mean and first moment (in samples) of the friction. Changes state (M,) and shaft (3,), its
    position, deflection and speed, in place; free (S + M,) is room to work in."""
    n = state.size
    gain = max(arm.pulse[0], _TINY)  # what a unit of effort adds to the position in one step
    level, presliding, excess, fall = law[0], law[1], law[2], law[3]
    position, deflection, speed = shaft[0], shaft[1], shaft[2]
    breakaway = max(level + excess, _TINY)
    stiffness, limit, per_s = breakaway / presliding, level, STEPS / dt_s
    most = max(limit, _TINY) / stiffness
    soft, yields, fading = stiffness / (1 + 0.5 * stiffness * gain), 1 / stiffness, -1 / fall
    total, moment = 0.0, 0.0
    for stride in range(STRIDES):
        # Positions that the arm would have without friction, from the state on.
        pulses = 0.0
        for i in range(_STEPS):
            pulses += arm.pulse[i]
            free[i] = pulses * drive
            for j in range(n):
                free[i] += arm.ahead[i, j] * state[j]
        constant = excess == 0 or abs(speed) > _OVER * fall
        if constant and abs(deflection) >= max(level, _TINY) / stiffness:
            force = level if deflection > 0 else -level
            new = free[_STEPS - 1] - pulses * force
            start = speed = arm.slope[n] * (drive - force)
            for i in range(n):
                start += arm.slope[i] * state[i]
                free[_STEPS + i] = arm.held[i] * (drive - force)
                for j in range(n):
                    free[_STEPS + i] += arm.stride[i, j] * state[j]
                speed += arm.slope[i] * free[_STEPS + i]
            still = excess == 0 or abs(speed) > _OVER * fall
            if (new - position) * deflection > 0 and speed * deflection > 0 and still:
                for j in range(n):  # state[:] = ... compiles for two seconds
                    state[j] = free[_STEPS + j]
                position = new
                total += _STEPS * force
                moment += _STEPS * force * (_STEPS * (stride + 0.5) - 0.5 * STEPS)
                continue
            speed = start
        for i in range(n):
            free[_STEPS + i] = arm.held[i] * drive
            for j in range(n):
                free[_STEPS + i] += arm.stride[i, j] * state[j]
        for step in range(_STEPS):
            if excess != 0:
                limit = max(level + excess * np.exp(abs(speed) * fading), 0.0)
                most = yields * max(limit, _TINY)
            force = soft * (deflection + 0.5 * (free[step] - position))
            force = min(max(force, -limit), limit)
            total += force
            moment += force * (_STEPS * stride + step + 0.5 - 0.5 * STEPS)
            new = free[step] - gain * force
            deflection = min(max(deflection + new - position, -most), most)
            speed = (new - position) * per_s
            position = new
            for i in range(step + 1, _STEPS):
                free[i] -= arm.pulse[i - step] * force
            for j in range(n):
                free[_STEPS + j] -= arm.pushes[step, j] * force
        for j in range(n):
            state[j] = free[_STEPS + j]
    shaft[0], shaft[1], shaft[2] = position, deflection, speed
    return total / STEPS, moment / STEPS**2


@numba.njit(**COMPILED)
def step_through(
    drive: Any,
    arm: ArmSteps,
    dt_s: float,
    law: Any,
    measured: Any,
    correction: Any,
    position: Any,
    friction: Any,
) -> None:
    """Fill position (T,) and the friction (T,), held over every sample, for a drive (T,) held over each.

    At every sample the states take correction (M,) times what the measured (T,) position is off the one
    predicted, which is the one that is told, and the position correction[M] times that; correction of size 0:
    a free run.
    """
    moments = np.empty(drive.size)
    n = arm.held.size
    state, shaft, free = np.zeros(n), np.zeros(3), np.empty(_STEPS + n)
    for k in range(drive.size):
        position[k] = shaft[0]
        if correction.size:
            off = measured[k] - shaft[0]
            for j in range(n):
                state[j] += correction[j] * off
            shaft[0] += correction[n] * off
        friction[k], moments[k] = advance(drive[k], state, shaft, free, arm, dt_s, law)
    for k in range(1, drive.size - 1):
        friction[k] += 0.5 * (moments[k - 1] - moments[k + 1])


@numba.njit(**INSIDE)
def hold_load(load: Any, start: float, end: float, spring: Any, dt_s: float) -> float:
    """One sample of a load behind a motor that moves evenly from start to end: the mean of what reaches the
    motor of its friction, per unit of the level. Changes load (4,) in place: position and speed, and those
    that the friction by itself gives it, the motor held. spring: `ident.friction.spring.Spring.array`. Half
    a drift, a kick in the middle, half a drift."""
    h, soft, damp = dt_s / _LOAD_STEPS, spring[0] ** 2, 2 * spring[1] * spring[0]
    level, excess, fall = spring[2], spring[3], spring[4]
    place, speed, x, v = load[0], load[1], load[2], load[3]
    rate, total = (end - start) / dt_s, 0.0
    for step in range(_LOAD_STEPS):
        place += 0.5 * h * speed
        x += 0.5 * h * v
        twist = start + (step + 0.5) * h * rate - place
        free = speed + h * (soft * twist + damp * (rate - speed))
        most = 1.0 if excess == 0 else 1 + excess * np.exp(-abs(speed) / fall)
        kept = max(abs(free) - h * level * most, 0.0)
        force = np.sign(free) * ((abs(free) - kept) / (h * level) if level > 0 else most)
        speed = np.sign(free) * kept
        v += h * (force - soft * x - damp * v)
        total += soft * x + damp * v
        place += 0.5 * h * speed
        x += 0.5 * h * v
    load[0], load[1], load[2], load[3] = place, speed, x, v
    return total / _LOAD_STEPS


@numba.njit(**COMPILED)
def behind_motor(motor: Any, spring: Any, dt_s: float, found: Any) -> None:
    """Fill found (T,) with what `hold_load` tells of each sample of a motor (T,), from rest."""
    load = np.zeros(4)
    load[0] = motor[0]
    for k in range(motor.size):
        found[k] = hold_load(load, motor[k], motor[min(k + 1, motor.size - 1)], spring, dt_s)


@numba.njit(**COMPILED)
def loop_through(
    reference: Any,
    noise: Any,
    added: Any,
    law: Any,
    limits: Any,
    steps: Any,
    delay: int,
    input_delay: int,
    lag: float,
    arm: ArmSteps,
    dt_s: float,
    law_of_friction: Any,
    spring: Any,
    measured: Any,
    command: Any,
    limited: Any,
) -> None:
    """Fill measured (T,), command (T,) and limited (T,) of a loop from rest: that of
    `control_design.analysis.closed_loop.simulate` on this arm.

    reference, noise (T,): set point, and what is added to the position before it is measured in steps[0].
    added (T,): joins the law's command before it is limited. law (n + 1, n + 2): rows of the state and the
    output, columns A, B, M and C, D, - of x+ = A x + B e + M (limited - wanted), wanted = C x + D e + added.
    limits: of the command and of its change per sample, inf for none; steps: of measurement and command, 0
    for none. delay, input_delay: samples until a command is given to the arm, and until it acts, through a
    drive that lags by `lag` samples. spring: as of `hold_load`, level 0 for no friction at the load; it acts
    a sample after its motion.
    """
    order = law.shape[0] - 1
    state, x, later = np.zeros(arm.held.size), np.zeros(order), np.zeros(order)
    shaft, free, last = np.zeros(3), np.empty(_STEPS + arm.held.size), 0.0
    load, held, applied = np.zeros(4), 0.0, 0.0
    queue, waiting = np.zeros(delay + 1), np.zeros(input_delay + 1)
    for k in range(reference.size):
        y = shaft[0] + noise[k]
        if steps[0] > 0:
            y = steps[0] * np.rint(y / steps[0])
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
            u = steps[1] * np.rint(u / steps[1])
        queue[k % (delay + 1)] = u
        u = queue[(k + 1) % (delay + 1)]
        measured[k], command[k], limited[k] = y, u, last != wanted
        waiting[k % (input_delay + 1)] = u
        applied += (waiting[(k + 1) % (input_delay + 1)] - applied) / (1 + lag)
        before = shaft[0]
        advance(applied - held, state, shaft, free, arm, dt_s, law_of_friction)
        if spring[5] > 0:
            held = spring[5] * hold_load(load, before, shaft[0], spring, dt_s)
