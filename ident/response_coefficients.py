"""Coefficients of basis functions that give responses which are known at frequencies."""

from __future__ import annotations

import numpy as np

from ident.data.arrays import ComplexArray, RealArray, real_rows

# Singular values below this share of the largest are rounding: poles that nearly meet make columns that are
# alike to many digits, which would get coefficients that cancel each other, and proofs between frequencies
# would not get through. From 1e-12 to 1e-6 the responses stay.
SMALLEST_SINGULAR = 1e-8


def coefficients_of(rows: ComplexArray, wanted: ComplexArray, weight: RealArray) -> RealArray:
    """Real coefficients of the columns whose responses come nearest to those that are wanted.

    Parameters
    ----------
    rows : ndarray, shape (F, P), complex
        Responses of the columns.
    wanted : ndarray, shape (F, N), complex
        Responses that are to be given.
    weight : ndarray, shape (F,)
        Of the errors at each frequency.

    Returns
    -------
    ndarray, shape (P, N)
        Least squares over real and imaginary parts, columns scaled to one length first.
    """
    weighted = rows * weight[:, None]
    length = np.linalg.norm(weighted, axis=0)
    length[length == 0] = 1.0
    left = real_rows(np.asarray(weighted / length, dtype=np.complex128))
    right = real_rows(np.asarray(wanted * weight[:, None], dtype=np.complex128))
    solved = np.linalg.lstsq(left, right, rcond=SMALLEST_SINGULAR)[0]
    return np.asarray(solved / length[:, None], dtype=np.float64)
