"""Inertias, springs with play, gravity and dry friction under a sampled controller; numpy and numba only.

m_i q_i'' = torques of springs + g_i sin(q_i) - c_i q_i' - dry friction, the motor on inertia 0. Fixed fine
step, second order: half a drift, a kick by all torques in the middle, half a drift (position Verlet). Dry
friction is solved inside the kick (an inertia sticks exactly, at zero speed), or is a LuGre bristle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
import scipy.linalg

Array = Any


class Law(NamedTuple):
    """x+ = A x + B [r, y] + L (clipped u - u), u = bias + C x + D [r, y]."""

    A: Array  # (n, n)
    B: Array  # (n, 2)
    C: Array  # (n,)
    D: Array  # (2,)
    L: Array  # (n,), anti-windup
    bias: float = 0.0


@dataclass(frozen=True, eq=False)
class Plant:
    """SI units; the output is scale q[out], the input u with torque_per_u u on inertia 0."""

    inertia: Array  # (N,)
    viscous: Array  # (N,)
    gravity: Array  # (N,), N m: + g sin(q), zero is upright
    springs: Array  # (S, 5): from, to, stiffness, damping, half of the play in rad
    friction: Array  # (N, 5): sliding N m, breakaway N m, Stribeck speed, bristle N m/rad or 0, its damping
    ripple: Array  # (3,): N m, periods per rad, phase
    torque_per_u: float
    out: int
    scale: float
    dt_s: float
    delay: int  # samples of computation
    count: float  # of the encoder, in output units
    limit: float  # of the input

    def linear(self, q_operating: float = 0.0) -> tuple[Array, Array, Array, Array]:
        """A, B, C of the friction-free continuous plant from u to y, play closed, and its poles in 1/s."""
        n = self.inertia.size
        stiff = -np.diag(self.gravity * np.cos(q_operating))
        damp = np.diag(self.viscous)
        for i, j, k, d, _ in self.springs:
            across = np.zeros(n)
            across[int(i)] = 1
            across[int(j)] = -1
            stiff = stiff + k * np.outer(across, across)
            damp = damp + d * np.outer(across, across)
        forces = -np.hstack([stiff, damp]) / self.inertia[:, None]
        a = np.vstack([np.eye(2 * n)[n:], forces])
        b = np.zeros((2 * n, 1))
        c = np.zeros((1, 2 * n))
        b[n, 0] = self.torque_per_u / self.inertia[0]
        c[0, self.out] = self.scale
        return a, b, c, np.linalg.eigvals(a)

    def sampled(self, q_operating: float = 0.0) -> tuple[Array, Array, Array]:
        """A, B, C of the friction-free plant at the sampling instants: zero-order hold, delay included."""
        a, b, c, _ = self.linear(q_operating)
        n = a.shape[0]
        sampled = scipy.linalg.expm(np.block([[a, b], [np.zeros((1, n + 1))]]) * self.dt_s)
        a = sampled[:n, :n]
        b = sampled[:n, n:]
        for _ in range(self.delay):  # the command waits one sample in each further state
            n = a.shape[0]
            a = np.block([[a, b], [np.zeros((1, n + 1))]])
            c = np.append(c, [[0.0]], 1)
            b = np.eye(n + 1)[:, n:]
        return a, b, c

    def step_s(self) -> float:
        """Fine step: a hundredth of a radian of the fastest mode, a twentieth of the stiffest bristle."""
        fastest = np.max(np.abs(self.linear()[3]))
        bristle = np.sqrt(np.max(self.friction[:, 3] / self.inertia))
        return float(min(2e-5, 0.01 / max(fastest, 1e-9), 0.05 / max(bristle, 1e-9)))

    def run(self, law: Law, reference: Array, q_start: float, noise: Array, count_from: int = 0) -> Any:
        """The loop from rest at q_start. reference (T,), noise (T,) in output units.

        y: encoder; u: command; applied: after the limit; true: output without encoder; speed: of inertia 0
        at the samples, rad/s; friction_Nm: friction work over path from sample `count_from` on, all inertias.
        """
        sub = int(np.ceil(self.dt_s / self.step_s()))
        names = ("y", "u", "applied", "true", "speed", "work", "path")
        law_arrays = [np.ascontiguousarray(each, float) for each in law[:5]]
        p = self
        parts = p.inertia, p.viscous, p.gravity, p.springs, p.friction, p.ripple, p.torque_per_u
        sensor = p.out, p.scale, p.delay, p.count, p.limit
        signals = np.ascontiguousarray(reference, float), float(q_start), np.ascontiguousarray(noise, float)
        every = _run(sub, p.dt_s / sub, *parts, *sensor, *law_arrays, float(law.bias), *signals, count_from)
        got = dict(zip(names, every, strict=True))
        got["friction_Nm"] = np.sum(got.pop("work") / np.maximum(got.pop("path"), 1e-12))
        return got


def response(a: Array, b: Array, c: Array, omega_rad_s: Array, dt_s: float) -> Array:
    """C (z - A)^-1 B at z = exp(j omega dt), (F,)."""
    z = np.exp(1j * np.asarray(omega_rad_s) * dt_s)
    every = np.broadcast_to(b + 0j, (z.size, *b.shape))
    states = np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, every)
    return (c @ states)[:, 0, 0]


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _run(sub, h, m, c, g, springs, friction, ripple, kt, out, scale, delay, count, limit, A, B, C, D, L, bias,
         r, q_start, noise, count_from):  # fmt: skip
    n = r.size
    size = m.size
    states = A.shape[0]
    y = np.zeros(n)
    u = np.zeros(n)
    applied = np.zeros(n)
    true = np.zeros(n)
    speed = np.zeros(n)
    q = np.full(size, q_start)
    v = np.zeros(size)
    acc = np.zeros(size)
    z = np.zeros(size)
    f = np.zeros(size)
    work = np.zeros(size)
    path = np.zeros(size)
    x = np.zeros(states)
    new = np.zeros(states)
    waiting = np.full(max(delay, 1), bias)
    for t in range(n):
        true[t] = q[out] * scale
        speed[t] = v[0]
        y[t] = true[t] + noise[t]
        if count > 0:
            y[t] = np.round(y[t] / count) * count
        command = bias + D[0] * r[t] + D[1] * y[t]
        for i in range(states):
            command += C[i] * x[i]
        clipped = min(max(command, -limit), limit)
        for i in range(states):
            new[i] = B[i, 0] * r[t] + B[i, 1] * y[t] + L[i] * (clipped - command)
            for j in range(states):
                new[i] += A[i, j] * x[j]
        x[:] = new
        u[t] = command
        applied[t] = waiting[t % delay] if delay else clipped
        waiting[t % max(delay, 1)] = clipped
        for _ in range(sub):
            for i in range(size):
                q[i] += 0.5 * h * v[i]
                f[i] = g[i] * np.sin(q[i])
            f[0] += kt * applied[t] + ripple[0] * np.sin(ripple[1] * q[0] + ripple[2])
            for s in range(springs.shape[0]):
                i = int(springs[s, 0])
                j = int(springs[s, 1])
                twist = q[i] - q[j]
                play = springs[s, 4]
                if abs(twist) > play:  # without play: always, but for a point
                    twist -= np.sign(twist) * play
                    # Speeds of the middle of the step, from the last acceleration.
                    rate = v[i] - v[j] + 0.5 * h * (acc[i] - acc[j])
                    torque = springs[s, 2] * twist + springs[s, 3] * rate
                    f[i] -= torque
                    f[j] += torque
            for i in range(size):
                before = v[i]
                low = friction[i, 0]
                high = friction[i, 1]
                slow = friction[i, 2]
                level = low + (high - low) * np.exp(-((before / slow) ** 2))
                if friction[i, 3] > 0:
                    grown = (z[i] + h * before) / (1 + h * friction[i, 3] * abs(before) / level)
                    force = friction[i, 3] * grown
                    # Damped where it creeps only, or the bristle would add energy at speed.
                    force += friction[i, 4] * np.exp(-((before / slow) ** 2)) * (grown - z[i]) / h
                    z[i] = grown
                    v[i] = ((m[i] - 0.5 * h * c[i]) * before + h * (f[i] - force)) / (m[i] + 0.5 * h * c[i])
                else:
                    free = (m[i] - 0.5 * h * c[i]) * before + h * f[i]
                    after_friction = max(abs(free) - h * level, 0.0)
                    force = (free - np.sign(free) * after_friction) / h
                    v[i] = np.sign(free) * after_friction / (m[i] + 0.5 * h * c[i])
                acc[i] = (v[i] - before) / h
                q[i] += 0.5 * h * v[i]
                if t >= count_from:
                    work[i] += force * v[i] * h
                    path[i] += abs(v[i]) * h
    return y, u, applied, true, speed, work, path
