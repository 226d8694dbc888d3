"""A matrix controller in real modal form, as the optimiser sees it: values and slopes in its parameters.

    K(s) = D + C_0 / s + sum_b C_b (s / w_b - M_b)^-1 B_b,   M_b = [[0, 1], [-1, -2 zeta_b]],

two states per block, s of Tustin's rule. Parameters: log w_b, log zeta_b, then the free entries of C, B and
D. A block belongs to the rows and columns of K that its masks name, so that zeros of K stay zeros.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from control_design.plants.ellipses import Boolean, Complex, Real

_FASTEST = 60.0  # corner of a block, in units of the scale
_MOST_DAMPED = 50.0  # two real poles (2 zeta)^2 = 10^4 apart: any pair of real poles, nearly


class ModalForm:
    """Structure of K (U, Y): pattern (U, Y) of entries, number of states, integrating outputs (Y,)."""

    def __init__(
        self,
        pattern: Boolean,
        order: int,
        integrates: Boolean,
        scale_rad_s: float,
        slowest_rad_s: float,
        dt_s: float,
        damping: float,
    ) -> None:
        self.pattern, self.scale, self.dt_s, self.damping = pattern, scale_rad_s, dt_s, damping
        self.slowest = slowest_rad_s
        self.inputs, self.outputs = pattern.shape
        self.integrates = np.flatnonzero(integrates)
        left = order - self.integrates.size
        if left < 0 or left % 2:
            raise ValueError(
                f"controller_order must be {self.integrates.size} (integrators) and two per modal block; "
                f"got {order}"
            )
        self.blocks, self.order = left // 2, order
        row_mask, column_mask = (
            np.zeros((self.blocks, self.inputs), bool),
            np.zeros((self.blocks, self.outputs), bool),
        )
        for b, (rows, columns) in zip(range(self.blocks), _rectangles(pattern, self.blocks), strict=False):
            row_mask[b], column_mask[b] = rows, columns
        m = self.blocks
        # Positions of free entries in C (m, U, 2), B (m, 2, Y), D (U, Y), C_0 (U, integrators).
        self._c = np.nonzero(np.repeat(row_mask[:, :, None], 2, axis=2))
        self._b = np.nonzero(np.repeat(column_mask[:, None, :], 2, axis=1))
        self._d = np.nonzero(pattern)
        self._i = np.nonzero(pattern[:, self.integrates])
        self.ends = np.cumsum([m, m, self._c[0].size, self._b[0].size, self._d[0].size, self._i[0].size])
        self.parameters = int(self.ends[-1])

    def split(self, x: Real) -> tuple[Real, Real, Real, Real, Real, Real]:
        """log w (P, m), log zeta (P, m), C (P, m, U, 2), B (P, m, 2, Y), D (P, U, Y), C_0 (P, U, i) of
        parameters (P, n)."""
        count, m = x.shape[0], self.blocks
        log_w, log_z, c, b, d, i, _ = np.split(x, self.ends, axis=1)
        C, B = np.zeros((count, m, self.inputs, 2)), np.zeros((count, m, 2, self.outputs))
        D, C_0 = (
            np.zeros((count, self.inputs, self.outputs)),
            np.zeros((count, self.inputs, self.integrates.size)),
        )
        every: Any = slice(None)
        C[(every, *self._c)], B[(every, *self._b)] = c, b
        D[(every, *self._d)], C_0[(every, *self._i)] = d, i
        return log_w, log_z, C, B, D, C_0

    def join(self, log_w: Real, log_z: Real, C: Real, B: Real, D: Real, C_0: Real) -> Real:
        """Parameters (n,) of one controller; what the pattern forbids is left out."""
        return np.concatenate([log_w, log_z, C[self._c], B[self._b], D[self._d], C_0[self._i]])

    def spread(self, lowest: float, highest: float, zeta: float) -> tuple[Real, Real, Real, Real]:
        """log w, log zeta, C, B of blocks from lowest to highest times the scale, one for each actuator at a
        corner where they belong to one, that do nothing yet: C is zero."""
        turns = 1 if self.pattern.all() else self.inputs
        corners = np.geomspace(lowest, highest, max(-(-self.blocks // turns), 1)) * self.scale
        B = np.zeros((self.blocks, 2, self.outputs))
        for block, state in np.ndindex(self.blocks, 2):
            if turns == 1:
                B[block, state, (block + state) % self.outputs] = 1.0
            elif state == 0:
                B[block, state] = 1.0
        log_w, log_z = np.log(np.repeat(corners, turns)[: self.blocks]), np.log(max(zeta, self.damping))
        return log_w, np.full(self.blocks, log_z), np.zeros((self.blocks, self.inputs, 2)), B

    def bounds(self) -> tuple[Real, Real]:
        low, high = np.full(self.parameters, -np.inf), np.full(self.parameters, np.inf)
        m = self.blocks
        low[:m], high[:m] = np.log(self.slowest), np.log(_FASTEST * self.scale)
        low[m : 2 * m], high[m : 2 * m] = np.log(self.damping), np.log(_MOST_DAMPED)
        return low, high

    def units(self, x: Real) -> Real:
        """A substantial change of each parameter (n,)."""
        _, _, C, B, D, C_0 = (part[0] for part in self.split(x[None]))
        gain = max(float(np.sqrt(np.mean(D[self.pattern] ** 2))), 1e-9)
        in_b = np.maximum(np.sqrt(np.mean(B**2, axis=(1, 2))), 1e-3)
        in_c = np.maximum(np.sqrt(np.mean(C**2, axis=(1, 2))), 0.05 * gain / in_b)
        ones = np.ones(self.blocks)
        slow = max(float(np.sqrt(np.mean(C_0**2))) if C_0.size else 0.0, 0.01 * gain * self.scale)
        return self.join(
            ones, ones, in_c[:, None, None] * np.ones_like(C), in_b[:, None, None] * np.ones_like(B),
            gain * np.ones_like(D), slow * np.ones_like(C_0),
        )  # fmt: skip

    def _resolvent(self, log_w: Real, log_z: Real, s: Complex) -> tuple[Complex, Complex]:
        """s / w (P, R, m) and (s / w - M)^-1 (P, R, m, 2, 2)."""
        ratio = s[None, :, None] / np.exp(log_w)[:, None, :]
        swing = ratio + 2 * np.exp(log_z)[:, None, :]
        E = np.empty((*ratio.shape, 2, 2), dtype=np.complex128)
        E[..., 0, 0], E[..., 0, 1], E[..., 1, 0], E[..., 1, 1] = swing, 1.0, -1.0, ratio
        E /= (ratio * swing + 1.0)[..., None, None]
        return ratio, E

    def response(self, x: Real, s: Complex) -> Complex:
        """K (P, R, U, Y) for parameters (P, n) at s (R,)."""
        log_w, log_z, C, B, D, C_0 = self.split(x)
        _, E = self._resolvent(log_w, log_z, s)
        K = np.sum(C[:, None] @ (E @ B[:, None]), axis=2) + D[:, None]
        if self.integrates.size:
            K[..., self.integrates] += C_0[:, None] / s[None, :, None, None]
        return np.asarray(K)

    def slopes(self, x: Real, s: Complex, left: Complex, right: Complex) -> Complex:
        """left^H dK right for every parameter, (P, R, n); left (P, R, U), right (P, R, Y)."""
        log_w, log_z, C, B, _, _ = self.split(x)
        ratio, E = self._resolvent(log_w, log_z, s)
        away = np.conj(left)[:, :, None, :, None]
        g = E @ (B[:, None] @ right[:, :, None, :, None])  # (P, R, m, 2, 1)
        h = np.swapaxes(E, -1, -2) @ (np.swapaxes(C, -1, -2)[:, None] @ away)  # conj: left^H C E
        g, h = g[..., 0], h[..., 0]
        in_w = ratio * np.sum(h * g, axis=-1)
        in_z = -2 * np.exp(log_z)[:, None, :] * h[..., 1] * g[..., 1]
        m, u, k = self._c
        in_c = np.conj(left)[:, :, u] * g[:, :, m, k]
        m, k, y = self._b
        in_b = h[:, :, m, k] * right[:, :, y]
        u, y = self._d
        in_d = np.conj(left)[:, :, u] * right[:, :, y]
        u, i = self._i
        in_i = np.conj(left)[:, :, u] * right[:, :, self.integrates[i]] / s[None, :, None]
        return np.concatenate([in_w, in_z, in_c, in_b, in_d, in_i], axis=2)

    def continuous(self, x: Real) -> tuple[Real, Real, Real, Real]:
        """A, B, C, D of K(s)."""
        log_w, log_z, C, B, D, C_0 = (part[0].copy() for part in self.split(x[None]))
        n, m, i = self.order, self.blocks, self.integrates.size
        w, z = np.exp(log_w), np.exp(log_z)
        A, inputs, outputs = np.zeros((n, n)), np.zeros((n, self.outputs)), np.zeros((self.inputs, n))
        for b in range(m):
            at = slice(i + 2 * b, i + 2 * b + 2)
            A[at, at] = w[b] * np.array([[0, 1], [-1, -2 * z[b]]])
            inputs[at], outputs[:, at] = w[b] * B[b], C[b]
        inputs[np.arange(i), self.integrates] = 1.0
        outputs[:, :i] = C_0
        return A, inputs, outputs, D

    def realised(self, A: Real, B: Real, C: Real, D: Real) -> Real | None:
        """Parameters (n,) of a full controller of as many states, unstable poles mirrored and its slowest
        real ones as the integrators; None where real ones do not pair or two poles are the same. Every block
        has unit norm at its input."""
        poles, axes = np.linalg.eig(A)
        inverse = np.linalg.inv(axes)
        paired = np.flatnonzero(poles.imag > 1e-9 * np.abs(poles))
        real = sorted(np.flatnonzero(np.abs(poles.imag) <= 1e-9 * np.abs(poles)), key=lambda k: abs(poles[k]))
        slow, real = real[: self.integrates.size], real[self.integrates.size :]
        if len(real) % 2 or len(slow) < self.integrates.size:
            return None
        poles = -np.abs(poles.real) + 1j * poles.imag
        pairs = [np.array([k, np.argmin(np.abs(poles - np.conj(poles[k])))]) for k in paired]
        pairs += [np.array(real[k : k + 2]) for k in range(0, len(real), 2)]
        log_w, log_z, C_b, B_b = self.spread(1.0, 1.0, 1.0)
        for block, pair in enumerate(pairs):
            w = max(float(np.sqrt(np.prod(poles[pair]).real)), np.finfo(float).tiny)
            a = np.diag(poles[pair]) / w
            found = []
            for angle in np.linspace(0, np.pi, 24, endpoint=False):
                # T M = a T for T = [v, -a v] with any v, real or of conjugates: what is small at both ends.
                v = (
                    np.exp([1j * angle, -1j * angle])
                    if block < paired.size
                    else np.array([np.cos(angle), np.sin(angle)])
                )
                T = np.column_stack([v, -a @ v])
                if np.linalg.cond(T) < 1e9:
                    found.append(
                        (np.linalg.solve(T, inverse[pair] @ B / w).real, (C @ axes[:, pair] @ T).real)
                    )
            if not found:
                return None
            b, c = min(found, key=lambda each: float(np.linalg.norm(each[0]) * np.linalg.norm(each[1])))
            size = float(np.linalg.norm(b)) or 1.0
            log_w[block], log_z[block] = np.log(w), np.log(-np.sum(poles[pair]).real / (2 * w))
            C_b[block], B_b[block] = c * size, b / size
        C_0 = (C @ axes[:, slow] @ inverse[slow] @ B).real[:, self.integrates]
        return np.clip(self.join(log_w, log_z, C_b, B_b, D, C_0), *self.bounds())

    def discrete(self, x: Real) -> tuple[Real, Real, Real, Real]:
        """A, B, C, D of K at the sampling time, by Tustin's rule: the same K at the same frequencies."""
        return tustin(*self.continuous(x), self.dt_s)


def tustin(A: Real, B: Real, C: Real, D: Real, dt_s: float) -> tuple[Real, Real, Real, Real]:
    """Discrete state space with the values of the continuous one at s = (2/dt) (z - 1)/(z + 1)."""
    eye = np.eye(A.shape[0])
    inverse = np.linalg.inv(eye - A * dt_s / 2)
    return inverse @ (eye + A * dt_s / 2), inverse @ B * dt_s, C @ inverse, D + C @ inverse @ B * dt_s / 2


def _rectangles(pattern: Boolean, count: int) -> list[tuple[Boolean, Boolean]]:
    """Rows and columns of K for each block: all of it if full, else one actuator at a time, in turn."""
    inputs, outputs = pattern.shape
    if pattern.all():
        return [(np.ones(inputs, bool), np.ones(outputs, bool))] * count
    rows = [u for u in range(inputs) if pattern[u].any()]
    return [(np.arange(inputs) == rows[b % len(rows)], pattern[rows[b % len(rows)]]) for b in range(count)]
