"""Worst-case gain over complex matrix blocks of uncertainty: the D-scaled bound at every frequency.

The plant is G + sum_i B_i Delta_i L_i with |Delta_i| <= 1. With v at the plant's output, x = S v and y = K x,

    A(t) = S^H (K^H (V_u + sum_i L_i^H L_i / t_i) K + V_y) S,   C(t) = sum_i t_i B_i B_i^H,

the weighted gain is at most gamma where A <= (C + I / gamma^2)^-1, for any t_i > 0: gamma^2 = largest
eigenvalue of (A^-1 - C)^-1, whose logarithm is convex in log t. The smallest bound is the worst case itself
for one or two blocks (with the performance three), an upper bound beyond (Packard and Doyle, Automatica 29,
1993).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import Boolean, Integer

Array = npt.NDArray[Any]  # real or complex

_STEPS = 40  # of Newton's method in log t; 3 to 8 are usual
_FINE = 1e-4  # shift of log t in the difference quotient of the slope
_LONGEST = 2.0  # step in log t


def conjugate(matrix: Array) -> Array:
    """Conjugate transpose of the last two axes."""
    return np.asarray(np.conj(np.swapaxes(matrix, -1, -2)))


def apply(matrix: Array, vector: Array) -> Array:
    """Matrices (..., M, N) times vectors (..., N)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class BoundRows:
    """R weighted requirements at one frequency each: nominal response G (R, Y, U); seen (R, N, U, U) =
    L_i^H L_i and entering (R, N, Y, Y) = B_i B_i^H of N blocks; V_y (R, Y, Y) and V_u (R, U, U), Gram
    matrices of the weights on S and K S. together: the blocks grow with 1/gamma as the performance does (mu)
    instead of keeping their size (worst-case gain)."""

    G: Array
    seen: Array
    entering: Array
    V_y: Array
    V_u: Array
    together: bool
    base: Array | None = None  # (R, Y, Y): Gram matrix of how the performance input enters, None = identity

    def part(self, index: Integer | Boolean) -> BoundRows:
        """Some of them."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return BoundRows(**{k: v if k == "together" or v is None else v[index] for k, v in values.items()})


@dataclass(frozen=True, eq=False)
class Bound:
    """gamma (R,), inf where no scaling shows stability; log_t (R, N) of the scalings. left (R, U) and right
    (R, Y): log gamma changes by Re(left^H dK right) with the controller, scalings at their optimum."""

    gamma: Array
    log_t: Array
    left: Array
    right: Array


def stability_bound(rows: BoundRows, K: Array) -> Array:
    """mu of the blocks alone (R,): the loop is stable for all blocks of size one where it stays below 1, and
    tolerates them enlarged by its inverse. The last block stands for the performance."""
    last = rows.entering[:, -1]
    jitter = 1e-12 * np.trace(last, axis1=1, axis2=2).real[:, None, None] * np.eye(last.shape[1])
    alone = BoundRows(
        rows.G, rows.seen[:, :-1], rows.entering[:, :-1], 0 * rows.V_y, rows.seen[:, -1], True, last + jitter
    )  # fmt: skip
    return scaled_bound(alone, K).gamma


def structured_norm(M: Array) -> Array:
    """min over diagonal D of the largest singular value of D M D^-1, (F,) for M (F, n, n): mu up to n = 3."""
    count, n = M.shape[0], M.shape[1]
    each = np.broadcast_to(np.eye(n)[:, :, None] * np.eye(n)[:, None, :], (count, n, n, n)).astype(
        np.complex128
    )
    rows = BoundRows(np.zeros_like(M), each, each, np.zeros((count, n, n)), np.zeros((count, n, n)), True)
    return stability_bound(rows, M)


class _Point(NamedTuple):
    """At given scalings: log gamma^2 (R,), its slope in log t (R, N), x = S s (R, Y), s the vector with
    d gamma^2 = s^H dA s, and 1 / gamma^2."""

    value: Array
    slope: Array
    x: Array
    share: Array

    def take(self, index: Integer, new: _Point, t: Array, trial: Array) -> Boolean:
        """Put the new ones that are lower in place, and their scalings; which these are."""
        lower = new.value < self.value[index]
        at = index[lower]
        for own, other in zip(self, new, strict=True):
            own[at] = other[lower]
        t[at] = trial[lower]
        return np.asarray(lower)


def scaled_bound(
    rows: BoundRows, K: Array, log_t: Array | None = None, *, accuracy: float = 1e-9, within: float = np.inf
) -> Bound:
    """Smallest bound over the scalings for controller values K (R, U, Y), to a relative accuracy of gamma.

    log_t (R, N): where to begin; None: from the sizes of the blocks. within: rows whose log gamma^2 stays by
    more than this below the largest keep a bound that is not the smallest. Neglected: rounding.
    """
    S = np.linalg.inv(np.eye(K.shape[2]) + rows.G @ K)
    KS = K @ S
    seen = conjugate(KS)[:, None] @ rows.seen @ KS[:, None]  # (R, N, Y, Y)
    own = conjugate(KS) @ rows.V_u @ KS + conjugate(S) @ rows.V_y @ S
    problem = _Problem(rows, S, seen, own)
    if seen.shape[1] == 0:
        t = np.zeros((K.shape[0], 0))
        point = problem.at(t)
    else:
        t = problem.begin() if log_t is None else log_t.copy()
        point = problem.at(t)
        lost = ~np.isfinite(point.value)
        if log_t is not None and np.any(lost):
            t[lost] = problem.begin()[lost]
            point = problem.at(t)
        left = np.isfinite(point.value)
        while np.any(left):
            most = np.max(point.value, where=np.isfinite(point.value), initial=-np.inf)
            index = np.flatnonzero(left & (point.value > most - within))
            if not index.size:
                break
            few = _Point(point.value[index], point.slope[index], point.x[index], point.share[index])
            lowest, few = problem.part(index).lower(t[index], few, accuracy)
            for whole, part in zip((t, *point), (lowest, *few), strict=True):
                whole[index] = part
            left[index] = False
    gamma = np.sqrt(np.exp(point.value))
    x = point.x
    y = apply(K, x)
    with np.errstate(over="ignore", invalid="ignore"):
        V = rows.V_u + np.sum(rows.seen / np.exp(t)[:, :, None, None], axis=1)
        pulled = apply(V, y)
        back = apply(conjugate(K), pulled) + apply(rows.V_y, x)
        left = pulled - apply(conjugate(rows.G), apply(conjugate(S), back))
        left = left * point.share[:, None]
    return Bound(gamma, t, np.where(np.isfinite(left), left, 0.0), x)


def largest_channel(rows: BoundRows, K: Array, right: Array) -> Integer:
    """Output (weight on S) or actuator (weight on K S) that carries most of each worst case (R,); right: of
    its `Bound`."""
    shares = [
        np.diagonal(weight, axis1=1, axis2=2).real * np.abs(signal) ** 2
        for weight, signal in ((rows.V_y, right), (rows.V_u, apply(K, right)))
    ]
    of_y, of_u = (np.argmax(share, axis=1) for share in shares)
    return np.asarray(np.where(np.any(rows.V_u, axis=(1, 2)), of_u, of_y))


@dataclass(frozen=True, eq=False)
class Expansion:
    """The matrix H = (A^-1 - C)^-1 (R, Y, Y), whose largest eigenvalue is gamma^2, to first order:
    dH = left^H dK right + (.)^H + sum_i in_t_i d log t_i; left (R, U, Y), right (R, Y, Y), in_t (R, N, Y,
    Y)."""

    H: Array
    left: Array
    right: Array
    in_t: Array


def expansion(rows: BoundRows, K: Array, log_t: Array) -> Expansion:
    """Around controller values K (R, U, Y) and scalings log_t (R, N); worst-case gain only."""
    eye = np.eye(K.shape[2])
    S = np.linalg.inv(eye + rows.G @ K)
    t = np.exp(log_t)[:, :, None, None]
    V, C = rows.V_u + np.sum(rows.seen / t, axis=1), np.sum(t * rows.entering, axis=1)
    KS = K @ S
    A = conjugate(KS) @ V @ KS + conjugate(S) @ rows.V_y @ S
    Z = np.linalg.inv(eye - C @ A)
    H, right = A @ Z, S @ Z
    y = K @ right
    pulled = V @ y
    left = pulled - conjugate(S @ rows.G) @ (conjugate(K) @ pulled + rows.V_y @ right)
    falls = conjugate(y)[:, None] @ rows.seen @ y[:, None] / t
    rises = t * (conjugate(H)[:, None] @ rows.entering @ H[:, None])
    return Expansion(0.5 * (H + conjugate(H)), left, right, rises - falls)


class _Problem:
    def __init__(self, rows: BoundRows, S: Array, seen: Array, own: Array) -> None:
        self.rows, self.S, self.seen, self.own = rows, S, seen, own
        self.eye = np.eye(own.shape[-1])

    def begin(self) -> Array:
        """Scalings of stationarity for blocks and performance that have one direction each."""
        seen = np.sqrt(np.trace(self.seen, axis1=-2, axis2=-1).real)
        enter = np.sqrt(np.trace(self.rows.entering, axis1=-2, axis2=-1).real)
        own = np.trace(self.own, axis1=-2, axis2=-1).real[:, None]
        t: Array = np.log(np.maximum(seen, 1e-150) / np.maximum(enter * own, 1e-150))
        if self.rows.together:
            return t
        total = np.sum(seen * enter, axis=1)[:, None]
        t += np.log(np.maximum(1.0 - total, 0.05))
        for _ in range(12):  # towards small t, where robust stability alone counts
            lost = ~np.isfinite(self.at(t).value)
            if not np.any(lost):
                break
            t[lost] -= 3.0
        return t

    def lower(self, t: Array, point: _Point, accuracy: float) -> tuple[Array, _Point]:
        """The smallest value of each row by itself."""
        best = _Point(point.value.copy(), point.slope.copy(), point.x.copy(), point.share.copy())
        lowest = (self._bracketed if t.shape[1] == 1 else self._newton)(t, best, accuracy)
        return lowest, best

    def _bracketed(self, t: Array, best: _Point, accuracy: float) -> Array:
        """One scaling: steps of the secant of the slope, within a bracket of its sign: kinks (two eigenvalues
        that cross) do no harm."""
        t = t.copy()
        low, high = np.full(t.size, -np.inf), np.full(t.size, np.inf)
        active = np.flatnonzero(np.isfinite(best.value))
        slope = best.slope[:, 0].copy()
        bend = np.full(t.size, 0.5)
        here = t[:, 0].copy()
        for _ in range(_STEPS):
            rises = ~(slope[active] < 0)
            high[active[rises]], low[active[~rises]] = here[active[rises]], here[active[~rises]]
            step = np.clip(
                np.where(np.isfinite(slope[active]), -slope[active] / bend[active], -1.0), -3.0, 3.0
            )
            trial = here[active] + step
            width = high[active] - low[active]
            out = (trial <= low[active] + 0.05 * np.minimum(width, 1.0)) | (
                trial >= high[active] - 0.05 * np.minimum(width, 1.0)
            )
            middle = np.isfinite(width) & out
            trial[middle] = 0.5 * (low[active[middle]] + high[active[middle]])
            gain = np.where(np.isfinite(slope[active]), np.abs(slope[active]), 1.0) * np.minimum(
                np.abs(trial - here[active]), width
            )
            keep = gain > accuracy
            active, trial = active[keep], trial[keep]
            if not active.size:
                break
            new = self.part(active).at(trial[:, None])
            moved = trial - here[active]
            with np.errstate(invalid="ignore", divide="ignore"):
                found = (new.slope[:, 0] - slope[active]) / moved
            bend[active] = np.where(np.isfinite(found), np.clip(found, 0.02, 1e6), bend[active])
            here[active] = trial
            slope[active] = np.where(np.isfinite(new.value), new.slope[:, 0], np.inf)
            best.take(active, new, t, trial[:, None])
        return t

    def _newton(self, t: Array, best: _Point, accuracy: float) -> Array:
        """Several scalings: Newton's method with a curvature from differences of slopes."""
        t = t.copy()
        n = t.shape[1]
        active = np.flatnonzero(np.isfinite(best.value))
        for _ in range(_STEPS):
            if not active.size:
                break
            here, slope = self.part(active), best.slope[active]
            bent = np.empty((active.size, n, n))
            for i in range(n):
                moved = t[active]
                moved[:, i] -= _FINE
                bent[:, :, i] = (slope - here.at(moved).slope) / _FINE
            bent = np.where(np.isfinite(bent), 0.5 * (bent + np.swapaxes(bent, 1, 2)), 0.0)
            sizes, axes = np.linalg.eigh(bent)
            along = np.einsum("rji,rj->ri", axes, slope)
            step = -np.einsum("rij,rj->ri", axes, along / np.maximum(np.abs(sizes), 1e-3))
            length = np.max(np.abs(step), axis=1)
            step *= np.minimum(1.0, _LONGEST / np.maximum(length, 1e-300))[:, None]
            promised = -np.einsum("ri,ri->r", step, slope)
            left, better = np.arange(active.size), np.zeros(active.size, dtype=bool)
            for _ in range(8):
                index = active[left]
                trial = t[index] + step[left]
                good = best.take(index, self.part(index).at(trial), t, trial)
                better[left[good]] = True
                left = left[~good]
                step[left] *= 0.3
                promised[left] *= 0.3
                left = left[promised[left] > accuracy]
                if not left.size:
                    break
            active = active[better & (promised > accuracy)]
        return t

    def part(self, index: Integer) -> _Problem:
        return _Problem(self.rows.part(index), self.S[index], self.seen[index], self.own[index])

    def at(self, log_t: Array) -> _Point:
        """Everything at scalings log_t (R, N)."""
        t = np.exp(np.clip(log_t, -300, 300))[:, :, None, None]
        seen, entering = self.seen / t, t * self.rows.entering
        A, C = self.own + np.sum(seen, axis=1), np.sum(entering, axis=1)
        if self.rows.together:
            base = self.eye if self.rows.base is None else self.rows.base
            L = np.linalg.cholesky(C + base)
            size, vectors = np.linalg.eigh(conjugate(L) @ A @ L)
            top = np.maximum(size[:, -1], 1e-300)
            u = vectors[:, :, -1]
            s, p = apply(L, u), apply(np.linalg.inv(conjugate(L)), u) * np.sqrt(top)[:, None]
            good = np.ones(top.size, dtype=bool)
        else:
            half = np.linalg.cholesky(
                A + 1e-14 * np.trace(A, axis1=1, axis2=2).real[:, None, None] * self.eye
            )
            # I - C A > 0 on its spectrum: the loop is stable for all blocks of size one.
            inside = self.eye - conjugate(half) @ C @ half
            size, vectors = np.linalg.eigh(inside)
            good = size[:, 0] > 1e-12
            root = half @ (vectors / np.sqrt(np.where(good[:, None], size, 1.0))[:, None, :])
            size, vectors = np.linalg.eigh(root @ conjugate(root))
            top = np.maximum(size[:, -1], 1e-300)
            u = vectors[:, :, -1]
            p = top[:, None] * u
            s = u + apply(C, p)
        x = apply(self.S, s)
        share = 1.0 / top
        falls = np.einsum("ri,rnij,rj->rn", np.conj(s), seen, s).real
        rises = np.einsum("ri,rnij,rj->rn", np.conj(p), entering, p).real
        value = np.where(good, np.log(top), np.inf)
        return _Point(value, (rises - falls) * share[:, None], x, share)
