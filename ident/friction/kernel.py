"""The compiled time stepper of a linear arm with dry friction at its shaft, alone and in a sampled control
loop.

The arm is linear in real states, driven by drive - friction (`ArmSteps`).

Friction is an elastic element whose force is limited: to level + excess exp(-|v| / fall) at the speed v
before a step (Stribeck), reached after a deflection by `presliding`; law is (level, presliding, excess,
fall). The mean force over a step follows from the deflection in the middle of it (implicit). Steps are as
long in every log (`steps_of`), a 32nd of a sample of 5 ms: with a pre-sliding of ten microradians the
position is right to a hundredth of a milliradian. Half a sample of slipping in one direction is taken at
once.

The friction is told as the held force that moves a slow arm just as far: its mean plus (M of the sample
before - M of the sample after) / 2, M the first moment of the force about the middle of a sample.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from ident.data.arrays import COMPILED, INSIDE

# Strides of a sample: half a sample of slipping is taken at once.
STRIDES = 2
# Length of a step, s: the position is right to a hundredth of a milliradian then (module's docstring); half
# of it takes twice the time.
_STEP_S = 5e-3 / 32
# Steps of a stride at least: a turn within a sample is still seen.
_FEWEST_STEPS = 4
# At most: logs slower than 200 Hz have longer steps, and take no more time a sample.
_MOST_STEPS = 16
# Length of a step of the load behind a spring, s. Chosen: its swing is slower than a shaft's stop.
_LOAD_STEP_S = 5e-3 / 8
# Steps of the load in a sample at least, as those of the shaft.
_FEWEST_LOAD_STEPS = 2
# At most, as those of the shaft.
_MOST_LOAD_STEPS = 8
# Speed, in units of `fall`, from which on the excess is gone: e^-8 of it is left, 3e-4.
_EXCESS_GONE = 8.0
# Smallest normal double: a level or pulse of zero must not be divided by.
_TINY = np.finfo(np.float64).tiny


def steps_of(dt_s: float) -> int:
    """Steps of a stride in a sample of dt_s, s."""
    steps = int(np.ceil(dt_s / (STRIDES * _STEP_S)))
    return min(max(steps, _FEWEST_STEPS), _MOST_STEPS)


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


# Loops over single numbers, here and below: array expressions would compile for seconds and allocate in every
# step. Sums are in a fixed order, so that a log has the same friction in every process.
@numba.njit(**INSIDE)
def advance(drive: float, state: Any, shaft: Any, free: Any, arm: ArmSteps, dt_s: float, law: Any) -> Any:
    """Mean and first moment (in samples) of the friction over one sample, in units of the drive.

    Parameters
    ----------
    drive : float
        Input, held over the sample.
    state : ndarray, shape (M,)
        Real states of the arm; changed in place.
    shaft : ndarray, shape (3,)
        Position, deflection of the elastic element and speed; changed in place.
    free : ndarray, shape (S + M,)
        Room to work in: positions of a stride without friction, then states at its end.
    arm : ArmSteps
    dt_s : float
        Length of the sample, s.
    law : ndarray, shape (4,)
        Level, presliding, excess, fall.
    """
    n = state.size
    n_steps = arm.pulse.size
    n_in_sample = STRIDES * n_steps
    # What a unit of effort adds to the position in one step.
    gain = max(arm.pulse[0], _TINY)
    level = law[0]
    presliding = law[1]
    excess = law[2]
    fall = law[3]
    position = shaft[0]
    deflection = shaft[1]
    speed = shaft[2]
    breakaway = max(level + excess, _TINY)
    stiffness = breakaway / presliding
    limit = level
    steps_per_s = n_in_sample / dt_s
    largest_deflection = max(limit, _TINY) / stiffness
    # Stiffness of element and arm in series over half a step: the step is implicit.
    soft = stiffness / (1 + 0.5 * stiffness * gain)
    yields = 1 / stiffness
    fading = -1 / fall
    total = 0.0
    moment = 0.0
    # What a unit of effort that is held adds to the position over a stride.
    pulses = 0.0
    for i in range(n_steps):
        pulses += arm.pulse[i]
    for stride in range(STRIDES):
        # A shaft that slips on in one direction has constant friction: the stride is one matrix product. It
        # counts where position and speed at its end have gone on in that direction.
        constant = excess == 0 or abs(speed) > _EXCESS_GONE * fall
        if constant and abs(deflection) >= max(level, _TINY) / stiffness:
            force = level if deflection > 0 else -level
            end = pulses * drive
            for j in range(n):
                end += arm.ahead[j, n_steps - 1] * state[j]
            end -= pulses * force
            speed = arm.slope[n] * (drive - force)
            start_speed = speed
            for i in range(n):
                start_speed += arm.slope[i] * state[i]
                free[n_steps + i] = arm.held[i] * (drive - force)
                for j in range(n):
                    free[n_steps + i] += arm.stride[i, j] * state[j]
                speed += arm.slope[i] * free[n_steps + i]
            still_constant = excess == 0 or abs(speed) > _EXCESS_GONE * fall
            if (end - position) * deflection > 0 and speed * deflection > 0 and still_constant:
                for j in range(n):  # state[:] = ... compiles for two seconds
                    state[j] = free[n_steps + j]
                position = end
                total += n_steps * force
                moment += n_steps * force * (n_steps * (stride + 0.5) - 0.5 * n_in_sample)
                continue
            speed = start_speed

        # Positions that the arm would have without friction, from the state on.
        adds = 0.0
        for i in range(n_steps):
            adds += arm.pulse[i]
            free[i] = adds * drive
        for j in range(n):
            for i in range(n_steps):
                free[i] += arm.ahead[j, i] * state[j]

        # Otherwise step by step: each force moves the positions and the final state that follow it.
        for i in range(n):
            free[n_steps + i] = arm.held[i] * drive
            for j in range(n):
                free[n_steps + i] += arm.stride[i, j] * state[j]
        for step in range(n_steps):
            if excess != 0:
                limit = max(level + excess * np.exp(abs(speed) * fading), 0.0)
                largest_deflection = yields * max(limit, _TINY)
            force = soft * (deflection + 0.5 * (free[step] - position))
            force = min(max(force, -limit), limit)
            total += force
            moment += force * (n_steps * stride + step + 0.5 - 0.5 * n_in_sample)
            end = free[step] - gain * force
            deflection = min(max(deflection + end - position, -largest_deflection), largest_deflection)
            speed = (end - position) * steps_per_s
            position = end
            for i in range(step + 1, n_steps):
                free[i] -= arm.pulse[i - step] * force
            for j in range(n):
                free[n_steps + j] -= arm.pushes[step, j] * force
        for j in range(n):
            state[j] = free[n_steps + j]
    shaft[0] = position
    shaft[1] = deflection
    shaft[2] = speed
    return total / n_in_sample, moment / n_in_sample**2


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
    a free run. law (4,): level, presliding, excess, fall; forces are in units of the drive.
    """
    n = arm.held.size
    moments = np.empty(drive.size)
    state = np.zeros(n)
    shaft = np.zeros(3)
    free = np.empty(arm.pulse.size + n)
    for k in range(drive.size):
        position[k] = shaft[0]
        if correction.size:
            off = measured[k] - shaft[0]
            for j in range(n):
                state[j] += correction[j] * off
            shaft[0] += correction[n] * off
        friction[k], moments[k] = advance(drive[k], state, shaft, free, arm, dt_s, law)
    # The force that moves a slow arm as far, held over a sample (module's docstring).
    for k in range(1, drive.size - 1):
        friction[k] += 0.5 * (moments[k - 1] - moments[k + 1])


@numba.njit(**INSIDE)
def hold_load(load: Any, start: float, end: float, spring: Any, dt_s: float) -> float:
    """Mean over one sample of what reaches the motor of the load's friction, per unit of its level.

    Parameters
    ----------
    load : ndarray, shape (4,)
        Position and speed of the load, and those that its friction by itself gives it, the motor held;
        changed in place.
    start, end : float
        Positions of the motor, which moves evenly between them.
    spring : ndarray, shape (6,)
        `ident.friction.spring.Spring.array`.
    dt_s : float
        Length of the sample, s.

    Notes
    -----
    Each step is half a drift, a kick in the middle, half a drift.
    """
    n_steps = min(max(int(np.ceil(dt_s / _LOAD_STEP_S)), _FEWEST_LOAD_STEPS), _MOST_LOAD_STEPS)
    step_s = dt_s / n_steps
    soft = spring[0] ** 2
    damp = 2 * spring[1] * spring[0]
    # The damper's force is that of the speed in the middle of a step.
    halved = 1 / (1 + 0.5 * damp * step_s)
    level = spring[2]
    excess = spring[3]
    fall = spring[4]
    place = load[0]
    speed = load[1]
    held_place = load[2]
    held_speed = load[3]
    motor_speed = (end - start) / dt_s
    total = 0.0
    for step in range(n_steps):
        place += 0.5 * step_s * speed
        held_place += 0.5 * step_s * held_speed
        twist = start + (step + 0.5) * step_s * motor_speed - place
        # What the spring pulls, as an acceleration, and what friction takes of it.
        pull = halved * (soft * twist + damp * (motor_speed - speed))
        breakaway = 1.0 if excess == 0 else 1 + excess * np.exp(-abs(speed) / fall)
        resists = halved * level * breakaway
        way = np.sign(speed)
        slips_s = step_s
        if way * (speed + step_s * pull) < step_s * resists:
            # The load stops within the step: a turn counts when it happens, not with the step.
            slips_s = way * speed / max(resists - way * pull, _TINY)
        rests_s = step_s - slips_s
        # Then it stands and pulls back what the spring pulls, or is pulled off the other way.
        back = np.sign(pull)
        over = max(abs(pull) - resists, 0.0)
        if slips_s == step_s:
            speed += step_s * (pull - way * resists)
        else:
            speed = back * over * rests_s
        if level > 0:
            force = (way * resists * slips_s + (pull - back * over) * rests_s) / (step_s * halved * level)
        else:
            force = breakaway * np.sign(speed)
        change = step_s * halved * (force - soft * held_place - damp * held_speed)
        total += soft * held_place + damp * (held_speed + 0.5 * change)
        held_speed += change
        place += 0.5 * step_s * speed
        held_place += 0.5 * step_s * held_speed
    load[0] = place
    load[1] = speed
    load[2] = held_place
    load[3] = held_speed
    return total / n_steps


@numba.njit(**COMPILED)
def behind_motor(motor: Any, spring: Any, dt_s: float, force: Any) -> None:
    """Fill force (T,), per unit of its level, with what `hold_load` says of each sample of a motor (T,).

    The load starts at rest with the motor; after the last sample the motor stands.
    """
    load = np.zeros(4)
    load[0] = motor[0]
    for k in range(motor.size):
        force[k] = hold_load(load, motor[k], motor[min(k + 1, motor.size - 1)], spring, dt_s)


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
    lag: Any,
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

    Parameters
    ----------
    reference, noise : ndarray, shape (T,)
        Set point, and what is added to the position before it is measured in steps[0].
    added : ndarray, shape (T,)
        Joins the law's command before it is limited.
    law : ndarray, shape (n + 1, n + 2)
        Rows of the state and the output, columns A, B, M and C, D, - of x+ = A x + B e + M (limited -
        wanted), wanted = C x + D e + added.
    limits : ndarray, shape (2,)
        Of the command and of its change per sample, inf for none.
    steps : ndarray, shape (2,)
        Of measurement and command, 0 for none.
    delay, input_delay : int
        Samples until a command is given to the arm, and until it acts.
    lag : ndarray, shape (2,)
        Of the drive between both: pole of its state, and share of a sample by which its mean over the sample
        stays with the state (`ident.friction.gauss_newton.lag_filter`); zeros for none.
    arm : ArmSteps
    dt_s : float
    law_of_friction : ndarray, shape (4,)
        Level, presliding, excess, fall.
    spring : ndarray, shape (6,)
        Of `hold_load`, level 0 for no friction at the load; it acts a sample after its motion.
    measured, command : ndarray, shape (T,)
        Position and command as the loop has them.
    limited : ndarray of bool, shape (T,)
        The command is not the one that the law wanted.
    """
    order = law.shape[0] - 1
    state = np.zeros(arm.held.size)
    x = np.zeros(order)
    later = np.zeros(order)
    shaft = np.zeros(3)
    free = np.empty(arm.pulse.size + arm.held.size)
    last = 0.0
    load = np.zeros(4)
    load_force = 0.0
    driven = 0.0
    queue = np.zeros(delay + 1)
    waiting = np.zeros(input_delay + 1)
    for k in range(reference.size):
        # The control law.
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

        # From the command to the force: rounding, computing time, dead time and lag of the drive.
        if steps[1] > 0:
            u = steps[1] * np.rint(u / steps[1])
        queue[k % (delay + 1)] = u
        u = queue[(k + 1) % (delay + 1)]
        measured[k] = y
        command[k] = u
        limited[k] = last != wanted
        waiting[k % (input_delay + 1)] = u
        given = waiting[(k + 1) % (input_delay + 1)]
        applied = given - lag[1] * (given - driven)
        driven = given - lag[0] * (given - driven)

        # The arm, and the load behind it.
        before = shaft[0]
        advance(applied - load_force, state, shaft, free, arm, dt_s, law_of_friction)
        if spring[5] > 0:
            load_force = spring[5] * hold_load(load, before, shaft[0], spring, dt_s)
