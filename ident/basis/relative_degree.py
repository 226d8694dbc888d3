"""Relative degree of the continuous-time plant as linear conditions on the coefficients.

A plant of relative degree r behind a zero-order hold has C B_c = C A_c B_c = ... = C A_c^(r-2) B_c = 0, where
[[A_c, B_c], [0, 0]] dt is the logarithm of [[A, B], [0, 1]] and (A, B) are the discrete states. For given
poles each condition is a linear functional of the transfer function, so it also acts on the change of it when
a pole moves.

The states are [hold, integrators 1/(z - 1)^j, lossless cascade of the other poles]. A unitary change of the
two states of each pair makes them triangular, and the logarithm is taken there by repeated square roots and
quadrature; scipy's general one takes a hundred times as long.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from scipy.special import comb

from ident.basis.functions import basis_state_space
from ident.basis.poles import Poles
from ident.data.arrays import COMPILED, ComplexArray, RealArray

# Square roots are drawn until the matrix is this near the identity; 8 Gauss nodes then give the logarithm to
# ((sqrt(1.25) - 1)/(sqrt(1.25) + 1))^16 = 1e-20.
_NEAR_IDENTITY = 0.25
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


def conditions(poles: Poles, integrators: int, relative_degree: int) -> RealArray:
    """Rows R (r - 1, B) with R c = 0 for coefficients c of a plant of relative degree r.

    `poles` as in `GobfModel`: with integrators, the first real poles are the zeros that their filters cancel.
    Row k is C A_c^k B_c dt^(k + 1).

    Raises ValueError if a pole has no continuous-time counterpart, or there are fewer than r poles in all.
    """
    return conditions_with_sensitivities(poles, integrators, relative_degree, np.zeros(poles.order), ())[0]


def conditions_with_sensitivities(
    poles: Poles, integrators: int, relative_degree: int, coefficients: RealArray, blocks: tuple[Poles, ...]
) -> tuple[RealArray, RealArray]:
    """Rows R as in `conditions`, and the same functionals (r - 1, S) of further blocks: poles whose basis
    functions are driven by the output of the model with coefficients (B,), in which the model moves with that
    pole."""
    if not relative_degree >= 1:
        raise ValueError(f"relative_degree must be at least 1; got {relative_degree}")
    if relative_degree == 1:
        return np.zeros((0, poles.order)), np.zeros((0, sum(block.order for block in blocks)))
    for a in poles.real[integrators:]:
        if not a > 0:
            raise ValueError(
                f"relative_degree needs poles with a continuous-time counterpart; the real pole {a:.6g} in "
                "the z plane has none (expected 0 < pole < 1)"
            )
    if np.any(poles.real[:integrators] != 0):
        raise ValueError("the first real poles must be the zeros that the integrators bring")
    if poles.order < relative_degree:
        raise ValueError(
            f"relative_degree = {relative_degree} needs at least that many poles, integrators counted; got "
            f"{poles.order}"
        )
    rest = Poles(poles.real[integrators:], poles.pairs)
    # The columns of the model are z^(k - j)/(z - 1)^k (j = 1 .. k) and the cascade behind 1/(z - 1)^k;
    # expand z^(k - j) = ((z - 1) + 1)^(k - j) over the states 1/(z - 1)^m.
    k = integrators
    expansion = comb(k - np.arange(1, k + 1)[:, None], k - np.arange(1, k + 1)[None, :])
    first, size = 1 + k, 1 + k + rest.order
    parts = [basis_state_space(block) for block in blocks]
    total = size + sum(part.A.shape[0] for part in parts)
    matrix = np.zeros((total, total))
    matrix[: k + 1, : k + 1] = np.eye(k + 1) + np.eye(k + 1, k=-1)
    cascade = basis_state_space(rest)
    matrix[first:size, first:size] = cascade.A
    matrix[first:size, k] = cascade.B[:, 0]
    pairs = [(first + rest.real.size + 2 * i, pole) for i, pole in enumerate(rest.pairs)]
    drive = np.concatenate([coefficients[:k] @ expansion, coefficients[k:]])
    scale = float(np.max(np.abs(drive), initial=0.0)) or 1.0
    at = size
    for part, block in zip(parts, blocks, strict=True):
        if block.real.size + block.pairs.size != 1:
            raise ValueError("a block is one real pole or one pair")
        here = slice(at, at + block.order)
        matrix[here, here] = part.A
        matrix[here, 1:size] = part.B @ (drive / scale)[None, :]
        pairs += [(at, complex(pole)) for pole in block.pairs]
        at = here.stop
    change = np.eye(total, dtype=np.complex128)
    for at, pole in pairs:
        # Unitary U with U^* block U lower triangular; the block is [[., .], [b, c]] with b != 0.
        x, y = pole.conjugate() - matrix[at + 1, at + 1], matrix[at + 1, at]
        change[at : at + 2, at : at + 2] = np.array([[y, x], [-np.conj(x), y]]) / np.hypot(abs(x), y)
    values = (_log_moments(change.conj().T @ matrix @ change, relative_degree - 1) @ change.T).real
    rows = values[:, 1:size].copy()
    rows[:, :k] = rows[:, :k] @ expansion.T
    return rows, values[:, size:] * scale


@numba.njit(**COMPILED)
def _square_root(matrix: Any) -> Any:
    """Of a lower triangular complex matrix, from the diagonal outwards (scipy's sqrtm loses two digits)."""
    root = np.zeros_like(matrix)
    for i in range(len(matrix)):
        root[i, i] = np.sqrt(matrix[i, i])
    for gap in range(1, len(matrix)):
        for j in range(len(matrix) - gap):
            i = j + gap
            value = matrix[i, j]
            for k in range(j + 1, i):
                value -= root[i, k] * root[k, j]
            root[i, j] = value / (root[i, i] + root[j, j])
    return root


def _log_moments(matrix: ComplexArray, count: int) -> ComplexArray:
    """First columns of log(T)^m for m = 1 .. count, rows (count, n); T (n, n) lower triangular, no eigenvalue
    on (-inf, 0]."""
    one, root, factor = np.eye(len(matrix)), matrix, 1.0
    while np.linalg.norm(root - one, np.inf) > _NEAR_IDENTITY:
        root, factor = _square_root(root), 2 * factor
    moments = [one[0]]
    for _ in range(count):
        product = (root - one) @ moments[-1]
        parts = np.linalg.solve(one + _NODES[:, None, None] * (root - one), product[:, None])
        moments.append(factor * _WEIGHTS @ parts[..., 0])
    return np.array(moments[1:])


def null_space(rows: RealArray, column_scale: npt.ArrayLike) -> tuple[RealArray, RealArray]:
    """Basis N (B, B - K) of the coefficients with rows @ c = 0 (rows (K, B)), and a right inverse (B, K).

    Both are taken in coefficients times `column_scale` (B,), the lengths of the regression columns: a column
    that moves the output much shall count as much.
    """
    scale = np.maximum(np.asarray(column_scale, dtype=np.float64), 1e-300)
    n_rows, n_columns = rows.shape
    scaled = rows / scale
    lengths = np.linalg.norm(scaled, axis=1)
    q, triangle = np.linalg.qr((scaled / lengths[:, None]).T, mode="complete")
    inverse = q[:, :n_rows] @ np.linalg.solve(triangle[:n_rows].T, np.diag(1 / lengths))
    return q[:, n_rows:] / scale[:, None], np.asarray(inverse.reshape(n_columns, n_rows) / scale[:, None])
