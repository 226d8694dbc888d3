"""Oracles: the paper's freedom in the two real functions of a conjugate pair, equations (7) to (19).

After the all-pass of the poles before it, a pair xi, conj(xi) may use any two functions
sqrt(1 - |xi|^2) (m1 z + m2)/D(z), D = z^2 - 2 Re(xi) z + |xi|^2, whose numerators x1 = (m1, m2), x2 = (m3,
m4) satisfy x_k^T M x_k = |1 - xi^2|^2 (14) and x1^T M x2 = 0 (15) with the M of (16). They all span the
same space.

The state space (22) to (26) of the paper, complex and with E inverted, stands below; the product needs none
of it (`ident.basis.functions.basis_state_space`; the condition number of E reaches 5e5): both are oracles.

The all-pass factor that (13) writes out, (1 - conj(xi_{i-1}) z) on L_{i-1}, is the all-pass that drives the
pair here.
"""

import numpy as np
import scipy.linalg

from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, RealArray


def pair_metric(pole: complex) -> RealArray:
    """M of (16), (2, 2): [[1 + |xi|^2, 2 Re xi], [2 Re xi, 1 + |xi|^2]], positive definite for |xi| < 1."""
    size = 1 + abs(pole) ** 2
    return np.array([[size, 2 * pole.real], [2 * pole.real, size]])


def paper_numerators(pole: complex) -> tuple[RealArray, RealArray]:
    """The solution (18), (19) with m2 = 0: x1 = (|1 - xi^2|, 0)/s, x2 = (-2 Re xi/s, s), s = sqrt(1 +
    |xi|^2)."""
    size = 1 + abs(pole) ** 2
    x1 = np.array([abs(1 - pole**2) / np.sqrt(size), 0.0])
    x2 = np.array([-2 * pole.real / np.sqrt(size), np.sqrt(size)])
    return x1, x2


def rotated_numerators(pole: complex, angle_rad: float) -> tuple[RealArray, RealArray]:
    """Any solution of (14): x1 = |1 - xi^2| M^-1/2 (cos t, sin t), and x2 by the quarter turn of (17)."""
    values, vectors = np.linalg.eigh(pair_metric(pole))
    inverse_root = (vectors / np.sqrt(values)) @ vectors.T
    unit = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    quarter = np.array([-unit[1], unit[0]])
    size = abs(1 - pole**2)
    return size * inverse_root @ unit, size * inverse_root @ quarter


def kautz_numerators(pole: complex) -> tuple[RealArray, RealArray]:
    """The solution used by `ident.basis.functions`: sg (z - beta) and sg sb, divided by sqrt(1 - |xi|^2)."""
    gamma = abs(pole) ** 2
    beta = 2 * pole.real / (1 + gamma)
    scale = np.sqrt(1 + gamma)  # sg / sqrt(1 - gamma)
    return scale * np.array([1.0, -beta]), scale * np.array([0.0, np.sqrt((1 - beta) * (1 + beta))])


def combination(pole: complex, x1: RealArray, x2: RealArray) -> ComplexArray:
    """[[c1, c2], [c3, c4]] of (7): the two real functions as combinations of the complex L_i, L_{i+1} of (5).

    Over the width sqrt(1 - |xi|^2)/D these have the numerators z - conj(xi) and 1 - conj(xi) z, so (13) asks
    for c1 (z - conj(xi)) + c2 (1 - conj(xi) z) = m1 z + m2. The matrix is unitary, (8) to (10), exactly when
    x1 and x2 satisfy (14) and (15).
    """
    numerators = np.array([[1, -np.conj(pole)], [-np.conj(pole), 1]])
    return np.asarray(np.array([x1, x2]) @ np.linalg.inv(numerators), dtype=np.complex128)


def complex_realisation(poles: Poles) -> tuple[ComplexArray, ComplexArray]:
    """(A_bar, B_bar) = (E^-1 A, E^-1 B) of (24), states x_i = L_i(q) u with L_i of (5); (n, n) and (n, 1).

    Row i of (22) is x_i(k+1) = xi_i x_i(k) + f_i [x_{i-1}(k) - conj(xi_{i-1}) x_{i-1}(k+1)],
    f_i = sqrt((1 - |xi_i|^2)/(1 - |xi_{i-1}|^2)).
    """
    xi = poles.values
    n = xi.size
    width = np.sqrt((1 - np.abs(xi)) * (1 + np.abs(xi)))
    E = np.eye(n, dtype=np.complex128)
    A = np.diag(xi).astype(np.complex128)
    for i in range(1, n):
        factor = width[i] / width[i - 1]
        E[i, i - 1] = np.conj(xi[i - 1]) * factor
        A[i, i - 1] = factor
    B = np.zeros((n, 1), dtype=np.complex128)
    B[0, 0] = width[0]
    inverse = np.linalg.inv(E)
    return np.asarray(inverse @ A, dtype=np.complex128), np.asarray(inverse @ B, dtype=np.complex128)


def real_realisation(poles: Poles) -> tuple[RealArray, RealArray]:
    """(T A_bar T^-1, T B_bar) of (25), (26): real states, the pair functions those of `kautz_numerators`."""
    A, B = complex_realisation(poles)
    blocks: list[ComplexArray] = [np.eye(poles.real.size, dtype=np.complex128)]
    for pole in poles.pairs:
        blocks.append(combination(complex(pole), *kautz_numerators(complex(pole))))
    T = scipy.linalg.block_diag(*blocks)
    return np.real(T @ A @ np.linalg.inv(T)), np.real(T @ B)


def printed_functions(xi: ComplexArray, z: ComplexArray) -> ComplexArray:
    """(5) as it stands at the points z (F,), one column a pole of xi (B,); complex for complex poles."""
    columns, product = [], np.ones_like(z)
    for pole in xi:
        columns.append(np.sqrt(1 - abs(pole) ** 2) / (z - pole) * product)
        product = product * (1 - np.conj(pole) * z) / (z - pole)
    return np.column_stack(columns)
