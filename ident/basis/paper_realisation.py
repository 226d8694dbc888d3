"""The paper's own state space (22) to (26): complex states, E x(k+1) = A x(k) + B u(k), E inverted, then
made real.

Kept as an independent check of `ident.basis.functions.basis_state_space`, which gives the same functions
without inverting E (whose condition number reaches 5e5) and without complex numbers.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from ident.basis.poles import Poles
from ident.basis.real_pair import combination, kautz_numerators
from ident.data.arrays import ComplexArray, RealArray


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
