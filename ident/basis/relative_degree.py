"""Relative degree of the continuous-time plant as linear conditions on the coefficients.

A plant of relative degree r behind a zero-order hold has C B_c = C A_c B_c = ... = C A_c^(r-2) B_c = 0, where
[[A_c, B_c], [0, 0]] dt is the logarithm of [[A, B], [0, 1]] and (A, B) are the discrete states. For given
poles each condition is a linear functional of the transfer function, so it also acts on the change of it when
a pole moves. `conditions` gives the rows, `null_space` what they leave free, for a fit that keeps them.

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

# Square roots are drawn until the matrix is this near the identity (largest row sum of the difference). The
# quadrature then gives the logarithm to ((sqrt(1.25) - 1)/(sqrt(1.25) + 1))^16 = 1e-20. With .5 it is 1e-16
# at best, one root less; each further root costs a bit where the identity is taken off again.
_NEAR_IDENTITY = 0.25
# Nodes of the Gauss-Legendre quadrature of log(T) = int_0^1 (T - 1) (1 + s (T - 1))^-1 ds. Four would leave
# 1e-10, sixteen change nothing.
_N_NODES = 8
_gauss_nodes, _gauss_weights = np.polynomial.legendre.leggauss(_N_NODES)
# Nodes moved from -1 .. 1, where numpy has them, to 0 .. 1.
_NODES = (_gauss_nodes + 1) / 2

# Weights for the same interval: half as long, so half of each.
_WEIGHTS = _gauss_weights / 2
# Least length of a column, in place of zero, so that a division by it is none by zero.
_TINY = 1e-300


def conditions(poles: Poles, integrators: int, relative_degree: int) -> RealArray:
    """Rows R with R c = 0 for the coefficients c of a plant of a relative degree.

    Parameters
    ----------
    poles : Poles
        B poles as in `GobfModel`: with integrators, the first real poles are the zeros that their filters
        cancel.
    integrators : int
        Number of integrators, as many as there are zeros among the first real poles.
    relative_degree : int
        r, at least 1.

    Returns
    -------
    ndarray, shape (r - 1, B)
        Row k is C A_c^k B_c dt^(k + 1), no unit. (0, B) for r = 1, whatever the poles.

    Raises
    ------
    ValueError
        r is below 1; for r above 1: a real pole behind the first `integrators` is not above 0, one of those
        is not 0, or there are fewer than r poles in all.
    """
    no_coefficients = np.zeros(poles.order)
    rows, _ = conditions_with_sensitivities(poles, integrators, relative_degree, no_coefficients, ())
    return rows


def conditions_with_sensitivities(
    poles: Poles, integrators: int, relative_degree: int, coefficients: RealArray, blocks: tuple[Poles, ...]
) -> tuple[RealArray, RealArray]:
    """Rows of the conditions, and how the conditions answer to a change of poles.

    Parameters
    ----------
    poles, integrators, relative_degree
        B poles, the zeros of the integrators first, and r, as for `conditions`.
    coefficients : ndarray, shape (B,)
        Those of the model whose poles change.
    blocks : tuple of Poles
        One real pole or one pair each, S poles in all, both of each pair counted. Their basis functions are
        driven by the output of the model: in this direction the model moves with that pole.

    Returns
    -------
    rows : ndarray, shape (r - 1, B)
        R as in `conditions`.
    functionals : ndarray, shape (r - 1, S)
        The conditions of the basis functions of the blocks.

    Raises
    ------
    ValueError
        As `conditions`; also if a block is not one real pole or one pair. Not checked: that the blocks are
        among the poles, and coefficients that are not finite, which make the functionals so.
    """
    if not relative_degree >= 1:
        raise ValueError(f"relative_degree must be at least 1; got {relative_degree}")
    if relative_degree == 1:
        n_directions = sum(block.order for block in blocks)
        return np.zeros((0, poles.order)), np.zeros((0, n_directions))
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

    # The columns of the model are z^(k - j)/(z - 1)^k (j = 1 .. k) and the cascade behind 1/(z - 1)^k;
    # expand z^(k - j) = ((z - 1) + 1)^(k - j) over the states 1/(z - 1)^m.
    cascade_poles = Poles(poles.real[integrators:], poles.pairs)
    k = integrators
    powers = np.arange(1, k + 1)
    expansion = comb(k - powers[:, None], k - powers[None, :])

    # Transition matrix of [hold, integrators, cascade]: the hold keeps its value, each integrator adds the
    # one before it, the last of them drives the cascade.
    first = 1 + k
    size = first + cascade_poles.order
    parts = [basis_state_space(block) for block in blocks]
    total = size + sum(part.A.shape[0] for part in parts)
    matrix = np.zeros((total, total))
    matrix[:first, :first] = np.eye(first) + np.eye(first, k=-1)
    cascade = basis_state_space(cascade_poles)
    matrix[first:size, first:size] = cascade.A
    matrix[first:size, k] = cascade.B[:, 0]
    first_pair = first + cascade_poles.real.size
    pairs = [(first_pair + 2 * i, pole) for i, pole in enumerate(cascade_poles.pairs)]

    # Below it the states of the blocks, driven by the model's output. That is scaled to 1, so that large
    # coefficients cost no digits of the logarithm.
    drive = np.concatenate([coefficients[:k] @ expansion, coefficients[k:]])
    scale = float(np.max(np.abs(drive), initial=0.0)) or 1.0
    at = size
    for part, block in zip(parts, blocks, strict=True):
        if block.real.size + block.pairs.size != 1:
            raise ValueError("a block is one real pole or one pair")
        states = slice(at, at + block.order)
        matrix[states, states] = part.A
        matrix[states, 1:size] = part.B @ (drive / scale)[None, :]
        pairs += [(at, complex(pole)) for pole in block.pairs]
        at = states.stop

    # Unitary U with U^* block U lower triangular for each pair; the block is [[., .], [b, c]] with b != 0.
    change = np.eye(total, dtype=np.complex128)
    for at, pole in pairs:
        x = pole.conjugate() - matrix[at + 1, at + 1]
        y = matrix[at + 1, at]
        turn = np.array([[y, x], [-np.conj(x), y]])
        change[at : at + 2, at : at + 2] = turn / np.hypot(abs(x), y)

    # First columns of the powers of the logarithm, in the old states: A_c^k B_c dt^(k + 1).
    triangular = change.conj().T @ matrix @ change
    values = (_log_moments(triangular, relative_degree - 1) @ change.T).real
    rows = values[:, 1:size].copy()
    rows[:, :k] = rows[:, :k] @ expansion.T
    return rows, values[:, size:] * scale


@numba.njit(**COMPILED)
def _square_root(matrix: Any) -> Any:
    """Square root (n, n) of a lower triangular complex matrix (n, n), from the diagonal outwards.

    Written out because scipy's sqrtm loses two digits. Compiled: shape and triangle are not checked (what
    stands above the diagonal is not read). An eigenvalue on the negative axis, or twice zero, has no such
    root: the numbers are then wrong or not finite.
    """
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
    """First columns of log(T)^m for m = 1 .. count, as rows (count, n).

    matrix: T (n, n), lower triangular, no eigenvalue on (-inf, 0], which is not checked. With T =
    root^factor, log(T) = factor log(root), and the quadrature is exact where the root is near the identity
    (`_NEAR_IDENTITY`). count: at least 0. T with NaN ends in NaN.
    """
    identity = np.eye(len(matrix))
    root = matrix
    factor = 1.0
    while np.linalg.norm(root - identity, np.inf) > _NEAR_IDENTITY:
        root = _square_root(root)
        factor = 2 * factor

    moments = [identity[0]]
    offset = root - identity
    for _ in range(count):
        product = offset @ moments[-1]
        # All `_N_NODES` nodes at once: (8, n, n) equations for (8, n, 1).
        at_nodes = identity + _NODES[:, None, None] * offset
        parts = np.linalg.solve(at_nodes, product[:, None])
        moments.append(factor * _WEIGHTS @ parts[..., 0])
    return np.array(moments[1:])


def null_space(rows: RealArray, column_scale: npt.ArrayLike) -> tuple[RealArray, RealArray]:
    """Basis of the coefficients that keep the conditions, and a right inverse of the conditions.

    Parameters
    ----------
    rows : ndarray, shape (K, B)
        Conditions rows @ c = 0, of full rank, K from 0 to B: not checked. A row of zeros gives NaN, more rows
        than columns numpy's LinAlgError.
    column_scale : array-like, shape (B,)
        Lengths of the regression columns. Both results are orthogonal in coefficients times these lengths: a
        column that moves the output much shall count as much.

    Returns
    -------
    basis : ndarray, shape (B, B - K)
        rows @ basis = 0.
    inverse : ndarray, shape (B, K)
        rows @ inverse = 1.
    """
    scale = np.maximum(np.asarray(column_scale, dtype=np.float64), _TINY)
    n_rows, n_columns = rows.shape
    scaled = rows / scale
    # Rows of unit length: those of higher powers of A_c dt are smaller by decades.
    lengths = np.linalg.norm(scaled, axis=1)
    unit_columns = (scaled / lengths[:, None]).T
    q, triangle = np.linalg.qr(unit_columns, mode="complete")
    inverse = q[:, :n_rows] @ np.linalg.solve(triangle[:n_rows].T, np.diag(1 / lengths))
    basis = q[:, n_rows:] / scale[:, None]
    return basis, np.asarray(inverse.reshape(n_columns, n_rows) / scale[:, None])
