"""Compiled time stepping of the blind protocol's machine: classical Runge-Kutta, four stages.

Rotary bodies are base, motor side, hub, link root and what is attached to the hub; a matrix maps the free
angles to these five, so that a rigid coupling is a missing coordinate and not a stiff spring. `p` is the
record of constants of `Truth`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]

# Places of the rotary bodies in a row of the coupling.
BASE = 0
# Motor side of a backlash.
MOTOR = 1
# Hub side of it.
HUB = 2
# Root of the link, behind a joint's compliance.
ROOT = 3
# What is attached to the hub by a spring.
ATTACHED = 4
# Number of the bodies.
BODIES = 5


class Link(NamedTuple):
    """Coupling (5, R) of the bodies to the free angles, and the link as in `beam.LinkBasis`.

    lumps (G + 1,): mass at the Gauss points and at the tip; weights (G,).
    """

    couple: Real
    angle: Real
    integral: Real
    lumps: Real
    weights: Real
    stiffness: Real
    tip_angle: Real


@numba.njit(cache=True)
def _level(p: Any, speed: float) -> float:
    fall = np.exp(-abs(speed) / p.stribeck_velocity)
    return float(p.stribeck_coulomb + (p.stribeck_static - p.stribeck_coulomb) * fall)


@numba.njit(cache=True)
def _clipped(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@numba.njit(cache=True)
def _coulomb(p: Any, stretch: float) -> float:
    """Stretch of the pre-sliding spring after the slider has moved along."""
    return _clipped(stretch, -p.pre_sliding * p.dry_minus / max(p.dry_static, 1e-300), p.pre_sliding)


@numba.njit(cache=True)
def _stribeck(p: Any, stretch: float, speed: float) -> float:
    limit = p.pre_sliding * _level(p, speed) / max(p.stribeck_static, 1e-300)
    return _clipped(stretch, -limit, limit)


@numba.njit(cache=True)
def _lagged(p: Any, asked: float, filtered: float, ready: float, after_s: float) -> float:
    """Voltage at the motor behind two lags in series, whose outputs were filtered and ready after_s ago."""
    slow = filtered - asked if p.lag > 0.0 else 0.0
    if p.amplifier_lag <= 0.0:
        return float(asked + (slow * np.exp(-after_s / p.lag) if p.lag > 0.0 else 0.0))
    slow *= p.lag / (p.lag - p.amplifier_lag)
    value = asked + (ready - asked - slow) * np.exp(-after_s / p.amplifier_lag)
    return float(value + (slow * np.exp(-after_s / p.lag) if p.lag > 0.0 else 0.0))


# Sums may be taken in any order, so that they run in parallel.
@numba.njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def _accelerations(
    p: Any,
    link: Link,
    arms: Real,
    q: Real,
    v: Real,
    current: float,
    voltage: float,
    time: float,
    dry: Real,
    from_angle: float,
    work: Real,
    M: Real,
    a: Real,
) -> float:
    """Fill a with the accelerations; returns the derivative of the motor current."""
    couple, angle, integral, lumps, weights, stiffness, _ = link
    G, n = angle.shape
    R = couple.shape[1]
    size = R + n
    body = np.zeros(BODIES)
    speed = np.zeros(BODIES)
    for i in range(BODIES):
        for k in range(R):
            body[i] += couple[i, k] * q[k]
            speed[i] += couple[i, k] * v[k]
    alpha = body[ROOT]
    alpha_dot = speed[ROOT]
    # Directions in the frame of the link root.
    cosine = work[0]
    sine = work[1]
    bend_x = work[2]
    bend_y = work[3]
    for h in range(G):
        turn = 0.0
        rate = alpha_dot
        for i in range(n):
            turn += angle[h, i] * q[R + i]
            rate += angle[h, i] * v[R + i]
        cosine[h] = np.cos(turn)
        sine[h] = np.sin(turn)
        bend_x[h] = -rate * rate * cosine[h]
        bend_y[h] = -rate * rate * sine[h]
    for i in range(size):
        a[i] = 0.0
        for j in range(size):
            M[i, j] = 0.0
    # In-plane gravity in this frame.
    ux = p.gravity * np.cos(alpha) + p.gravity_across * np.sin(alpha)
    uy = p.gravity_across * np.cos(alpha) - p.gravity * np.sin(alpha)
    dx = work[4]
    dy = work[5]
    for g in range(G + 1):
        x = p.radius_m
        y = 0.0
        bx = -p.radius_m * alpha_dot * alpha_dot
        by = 0.0
        for h in range(G):
            w = integral[g, h]
            x += w * cosine[h]
            y += w * sine[h]
            bx += w * bend_x[h]
            by += w * bend_y[h]
        dx[0] = -y
        dy[0] = x
        for i in range(n):
            sx = 0.0
            sy = 0.0
            for h in range(G):
                w = arms[i, g, h]
                sx -= w * sine[h]
                sy += w * cosine[h]
            dx[1 + i] = sx
            dy[1 + i] = sy
        lump = lumps[g]
        fx = lump * (ux - bx)
        fy = lump * (uy - by)
        if p.drag > 0.0 and g < G:
            vx = dx[0] * alpha_dot
            vy = dy[0] * alpha_dot
            for i in range(n):
                vx += dx[1 + i] * v[R + i]
                vy += dy[1 + i] * v[R + i]
            drag = p.drag * weights[g] * np.sqrt(vx * vx + vy * vy)
            fx -= drag * vx
            fy -= drag * vy
        # Root first; it is spread over the free angles below.
        root_force = dx[0] * fx + dy[0] * fy
        root_mass = lump * (dx[0] * dx[0] + dy[0] * dy[0])
        for k in range(R):
            c = couple[ROOT, k]
            if c != 0.0:
                a[k] += c * root_force
                for m in range(R):
                    M[k, m] += c * couple[ROOT, m] * root_mass
        for i in range(n):
            a[R + i] += dx[1 + i] * fx + dy[1 + i] * fy
            coupling = lump * (dx[0] * dx[1 + i] + dy[0] * dy[1 + i])
            for k in range(R):
                M[R + i, k] += couple[ROOT, k] * coupling
            for j in range(i + 1):
                M[R + i, R + j] += lump * (dx[1 + i] * dx[1 + j] + dy[1 + i] * dy[1 + j])
    for i in range(n):
        a[R + i] -= stiffness[i] * (q[R + i] + p.kelvin_voigt_s * v[R + i])
    # Motor, between base and motor side.
    slip = speed[MOTOR] - speed[BASE]
    shaft = body[MOTOR] - body[BASE]
    kt = p.torque_constant
    if p.cogging != 0.0:
        kt *= 1.0 + p.cogging * np.cos(p.cogging_cycles * shaft + p.cogging_phase)
    resistance = p.resistance * (1.0 + p.heating_1_s * time)
    drive = voltage - p.gear * p.back_emf * slip
    current_rate = 0.0
    if p.inductance > 0.0:
        current_rate = (drive - resistance * current) / p.inductance
        amps = current
    else:
        amps = drive / resistance
    amps = _clipped(amps, -p.current_limit, p.current_limit)
    torque = p.gear * kt * amps - p.viscous * slip
    if p.dry_static > 0.0:
        stretch = _coulomb(p, dry[0] + shaft - from_angle)
        torque -= p.dry_static / p.pre_sliding * stretch
    if p.stribeck_static > 0.0:
        stretch = _stribeck(p, dry[1] + shaft - from_angle, slip)
        torque -= p.stribeck_static / p.pre_sliding * stretch
    if p.seal_static > 0.0:
        stretch = _clipped(dry[2] + shaft - from_angle, -p.seal_sliding, p.seal_sliding)
        torque -= p.seal_static / p.seal_sliding * stretch
    torque -= p.gear_drag * abs(slip) * slip
    if p.detent != 0.0:
        torque += p.detent * np.sin(p.detent_cycles * shaft + p.detent_phase)
    if p.ripple != 0.0:
        torque += p.ripple * np.sin(p.ripple_cycles * shaft + p.ripple_phase)
    force = np.zeros(BODIES)
    force[MOTOR] += torque
    force[BASE] -= torque + p.base_stiffness * body[BASE] + p.base_damping * speed[BASE]
    force[MOTOR] -= p.cubic_spring * body[MOTOR] ** 3 + p.linear_spring * body[MOTOR]
    if p.disturbance != 0.0:
        force[HUB] += p.disturbance * np.sin(p.disturbance_omega * time + p.disturbance_phase)
    twist = p.joint_stiffness * (alpha - body[HUB]) + p.joint_damping * (alpha_dot - speed[HUB])
    force[HUB] += twist
    force[ROOT] -= twist
    pull = p.attached_stiffness * (body[ATTACHED] - body[HUB])
    pull += p.attached_damping * (speed[ATTACHED] - speed[HUB])
    force[HUB] += pull
    force[ATTACHED] -= pull
    if p.backlash >= 0.0:
        lead = body[MOTOR] - body[HUB]
        closing = speed[MOTOR] - speed[HUB]
        push = 0.0
        if lead > 0.5 * p.backlash:
            push = max(p.contact_stiffness * (lead - 0.5 * p.backlash) + p.contact_damping * closing, 0.0)
        elif lead < -0.5 * p.backlash:
            push = -max(p.contact_stiffness * (-lead - 0.5 * p.backlash) - p.contact_damping * closing, 0.0)
        force[MOTOR] -= push
        force[HUB] += push
    for k in range(R):
        for i in range(BODIES):
            a[k] += couple[i, k] * force[i]
        for m in range(R):
            M[k, m] += (
                couple[BASE, k] * couple[BASE, m] * p.base_inertia
                + couple[MOTOR, k] * couple[MOTOR, m] * p.motor_inertia
                + couple[HUB, k] * couple[HUB, m] * p.hub_inertia
                + couple[ATTACHED, k] * couple[ATTACHED, m] * p.attached_inertia
            )
    # Cholesky in the lower triangle, then the two triangular systems.
    for j in range(size):
        for k in range(j):
            M[j, j] -= M[j, k] * M[j, k]
        M[j, j] = np.sqrt(M[j, j])
        for i in range(j + 1, size):
            for k in range(j):
                M[i, j] -= M[i, k] * M[j, k]
            M[i, j] /= M[j, j]
    for i in range(size):
        for k in range(i):
            a[i] -= M[i, k] * a[k]
        a[i] /= M[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            a[i] -= M[k, i] * a[k]
        a[i] /= M[i, i]
    return current_rate


@numba.njit(cache=True)
def _outputs(p: Any, link: Link, q: Real) -> tuple[float, float]:
    """Hub angle as an encoder sees it, and (r + L) theta + deflection across the turned hub axis."""
    couple, angle, integral, _, _, _, _ = link
    G, n = angle.shape
    R = couple.shape[1]
    base = 0.0
    hub = 0.0
    root = 0.0
    for k in range(R):
        base += couple[BASE, k] * q[k]
        hub += couple[HUB, k] * q[k]
        root += couple[ROOT, k] * q[k]
    x = p.radius_m
    y = 0.0
    for h in range(G):
        turn = 0.0
        for i in range(n):
            turn += angle[h, i] * q[R + i]
        x += integral[G, h] * np.cos(turn)
        y += integral[G, h] * np.sin(turn)
    ahead = root - hub
    deflection = x * np.sin(ahead) + y * np.cos(ahead)
    return hub - base, (p.radius_m + p.length_m) * hub + deflection


@numba.njit(cache=True)
def _tip_acceleration(p: Any, link: Link, q: Real, v: Real, a: Real) -> float:
    """What an accelerometer at the tip feels across the link there; a: accelerations of the coordinates."""
    couple, angle, integral, _, _, _, tip_angle = link
    G, n = angle.shape
    R = couple.shape[1]
    alpha_dot = 0.0
    alpha_ddot = 0.0
    for k in range(R):
        alpha_dot += couple[ROOT, k] * v[k]
        alpha_ddot += couple[ROOT, k] * a[k]
    x = -p.radius_m * alpha_dot * alpha_dot
    y = p.radius_m * alpha_ddot
    for h in range(G):
        turn = 0.0
        rate = alpha_dot
        gain = alpha_ddot
        for i in range(n):
            turn += angle[h, i] * q[R + i]
            rate += angle[h, i] * v[R + i]
            gain += angle[h, i] * a[R + i]
        w = integral[G, h]
        x -= w * (gain * np.sin(turn) + rate * rate * np.cos(turn))
        y += w * (gain * np.cos(turn) - rate * rate * np.sin(turn))
    turn = 0.0
    for i in range(n):
        turn += tip_angle[i] * q[R + i]
    return float(y * np.cos(turn) - x * np.sin(turn))


@numba.njit(cache=True)
def run(
    p: Any,
    link: Link,
    acting: Real,
    commanded: Real,
    late_s: float,
    dt_s: float,
    substeps: int,
    feedback: Real,
    static: Real,
    hub_noise: Real,
    reference: Real,
    delay_samples: int,
    start: Real,
    encoder: Real,
    outputs: Real,
) -> bool:
    """Step through T samples; outputs (T, 3) hub angle, tip behind a sensor lag and acceleration across the
    tip, before every other error.

    acting: (T,) voltage behind the static part of the amplifier, which acts late_s + delay_samples dt later;
    with a `feedback` of (proportional, derivative, filter pole, limit) that is not empty, `commanded` and
    `acting` are filled in on the way: the command of row k + 1 is computed from the noisy hub angle of row k,
    as the `encoder` (offset, step or 0, eccentricity, its phase) shows it. start: hub angle of the straight
    link at rest, time of the first sample. static: (gain, dead zone, limit, cubic part, dead zone of the
    negative side). Returns whether everything stayed finite and within a turn.
    """
    couple, angle, integral, _, _, _, _ = link
    G, n = angle.shape
    R = couple.shape[1]
    size = R + n
    arms = np.empty((n, G + 1, G))
    for i in range(n):
        for g in range(G + 1):
            for h in range(G):
                arms[i, g, h] = integral[g, h] * angle[h, i]
    q = np.zeros(size)
    v = np.zeros(size)
    q_stage = np.zeros(size)
    v_stage = np.zeros(size)
    kv = np.zeros((4, size))
    kq = np.zeros((4, size))
    ki = np.zeros(4)
    M = np.zeros((size, size))
    work = np.zeros((6, max(G, n + 1) + 1))
    dry = np.zeros(3)
    current = 0.0
    filtered = 0.0
    ready = 0.0
    slewed = 0.0
    voltage = 0.0
    rate = 0.0
    for k in range(R):
        if couple[BASE, k] == 0.0:
            q[k] = start[0]
    before = start[0] + encoder[0]
    _, seen_tip = _outputs(p, link, q)
    fractions = np.array([0.0, 0.5, 0.5, 1.0])
    T = commanded.size
    for k in range(T):
        hub, tip = _outputs(p, link, q)
        if not (abs(hub) < 7.0 and abs(tip) < 50.0):
            return False
        outputs[k, 0] = hub
        outputs[k, 1] = seen_tip if p.sensor_lag > 0.0 else tip
        shaft = 0.0
        for m in range(R):
            shaft += (couple[MOTOR, m] - couple[BASE, m]) * q[m]
        at_s = start[1] + k * dt_s
        _accelerations(p, link, arms, q, v, current, voltage, at_s, dry, shaft, work, M, kv[0])
        outputs[k, 2] = _tip_acceleration(p, link, q, v, kv[0])
        if feedback.size:
            measured = hub + encoder[2] * (np.sin(hub + encoder[3]) - np.sin(encoder[3]))
            measured += encoder[0] + hub_noise[k]
            if encoder[1] > 0.0:
                measured = encoder[1] * np.rint(measured / encoder[1])
            rate = feedback[2] * rate + (1 - feedback[2]) * (measured - before) / dt_s
            before = measured
            if k + 1 < T:
                command = feedback[0] * (reference[k] - measured) - feedback[1] * rate
                command = _clipped(command, -feedback[3], feedback[3])
                commanded[k + 1] = np.round(command * 1e4) * 1e-4
                value = static[0] * commanded[k + 1]
                value += static[3] * value**3
                dead = static[1] if value >= 0 else static[4]
                size_V = min(max(abs(value) - dead, 0.0), static[2])
                acting[k + 1] = size_V if value >= 0 else -size_V
        for piece in range(2):
            span = late_s if piece == 0 else dt_s - late_s
            if span <= 1e-12:
                continue
            at = k - delay_samples - (1 if piece == 0 else 0)
            held = acting[at] if at >= 0 else 0.0
            begin = start[1] + k * dt_s + (0.0 if piece == 0 else late_s)
            count = max(1, int(np.ceil(substeps * span / dt_s - 1e-9)))
            step = span / count
            for s in range(count):
                time = begin + s * step
                asked = held
                if p.slew_V_s < 1e8:
                    # Held at its mean over the substep.
                    move = _clipped(held - slewed, -p.slew_V_s * step, p.slew_V_s * step)
                    asked = slewed + move * (1.0 - 0.5 * abs(move) / (p.slew_V_s * step))
                    slewed += move
                shaft = 0.0
                for m in range(R):
                    shaft += (couple[MOTOR, m] - couple[BASE, m]) * q[m]
                for stage in range(4):
                    f = fractions[stage] * step
                    amps = current
                    if stage == 0:
                        for i in range(size):
                            q_stage[i] = q[i]
                            v_stage[i] = v[i]
                    else:
                        for i in range(size):
                            q_stage[i] = q[i] + f * kq[stage - 1, i]
                            v_stage[i] = v[i] + f * kv[stage - 1, i]
                        amps = current + f * ki[stage - 1]
                    voltage = _lagged(p, asked, filtered, ready, f)
                    for i in range(size):
                        kq[stage, i] = v_stage[i]
                    ki[stage] = _accelerations(
                        p,
                        link,
                        arms,
                        q_stage,
                        v_stage,
                        amps,
                        voltage,
                        time + f,
                        dry,
                        shaft,
                        work,
                        M,
                        kv[stage],
                    )
                for i in range(size):
                    q[i] += step / 6 * (kq[0, i] + 2 * kq[1, i] + 2 * kq[2, i] + kq[3, i])
                    v[i] += step / 6 * (kv[0, i] + 2 * kv[1, i] + 2 * kv[2, i] + kv[3, i])
                current += step / 6 * (ki[0] + 2 * ki[1] + 2 * ki[2] + ki[3])
                current = _clipped(current, -p.current_limit, p.current_limit)
                voltage = _lagged(p, asked, filtered, ready, step)
                ready = voltage
                if p.lag > 0.0:
                    filtered = asked + (filtered - asked) * np.exp(-step / p.lag)
                turned = -shaft
                slip = 0.0
                for m in range(R):
                    turned += (couple[MOTOR, m] - couple[BASE, m]) * q[m]
                    slip += (couple[MOTOR, m] - couple[BASE, m]) * v[m]
                if p.dry_static > 0.0:
                    dry[0] = _coulomb(p, dry[0] + turned)
                if p.stribeck_static > 0.0:
                    dry[1] = _stribeck(p, dry[1] + turned, slip)
                dry[2] = _clipped(dry[2] + turned, -p.seal_sliding, p.seal_sliding)
                if p.sensor_lag > 0.0:
                    # Exact for a tip that moves linearly over the substep.
                    _, now = _outputs(p, link, q)
                    slope = (now - tip) / step
                    decay = np.exp(-step / p.sensor_lag)
                    seen_tip = now - slope * p.sensor_lag + (seen_tip - tip + slope * p.sensor_lag) * decay
                    tip = now
    return True
