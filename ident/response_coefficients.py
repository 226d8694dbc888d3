"""Coefficients of basis functions that give responses which are known at frequencies.

Real coefficients are fitted to complex responses by weighted linear least squares. `ident.command_timing` and
`ident.resampling` write responses with it that they know only frequency by frequency. Directions in which the
columns are alike but for rounding get no coefficient.
"""

from __future__ import annotations

import numpy as np

from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, RealArray, real_rows

# Singular values below this share of the largest are taken for rounding: poles that nearly meet make columns
# that are alike to many digits, which would get coefficients that cancel each other, and proofs between
# frequencies would not get through. From 1e-12 to 1e-6 the responses do not change.
SMALLEST_SINGULAR = 1e-8
# Lowest frequency times step at which a response is fitted, rad: a motion of a week in a log at 10 Hz, far
# below what a loop is designed for. Slower poles lower it.
_LOWEST_ANGLE_RAD = 1e-6
# Share of the slowest pole's decay at which the frequencies begin: below it a response is a power of
# frequency within .5 %. Begun above a pole, the fit is free to turn below it, and ellipses grew threefold.
_BELOW_SLOWEST = 0.1
# A pole that decays by less in a sample counts as an integrator. Chosen, as for the grids of a design.
_INTEGRATES = 1e-9
# Frequencies in a decade: 2.6 % from one to the next. Chosen.
_POINTS_IN_A_DECADE = 90


def slow_angles(poles: Poles, highest_rad: float) -> RealArray:
    """Frequencies times step, rad, at which slow motions of a response are fitted.

    Parameters
    ----------
    poles : Poles
        Of the response, in z. Not above 1 (not checked).
    highest_rad : float
        Where they end.

    Returns
    -------
    ndarray, shape (F,)
        At equal ratios, from below the slowest pole that decays.
    """
    decays = poles.real[poles.real > 0]
    decay_rad = -np.log(decays)
    slowest_rad = np.min(decay_rad, initial=np.inf, where=decay_rad > _INTEGRATES)
    lowest_rad = min(_LOWEST_ANGLE_RAD, _BELOW_SLOWEST * float(slowest_rad))
    n_points = int(_POINTS_IN_A_DECADE * np.log10(highest_rad / lowest_rad))
    return np.geomspace(lowest_rad, highest_rad, n_points)


def coefficients_of(rows: ComplexArray, wanted: ComplexArray, weight: RealArray) -> RealArray:
    """Real coefficients of the columns whose responses come nearest to those that are wanted.

    Parameters
    ----------
    rows : ndarray, shape (F, P), complex
        Responses of the P columns at F frequencies.
    wanted : ndarray, shape (F, N), complex
        N responses that are to be given.
    weight : ndarray, shape (F,)
        By which the errors at each frequency count.

    Returns
    -------
    ndarray, shape (P, N)
        Least squares over real and imaginary parts. A column of zeros gets a coefficient of zero.

    Notes
    -----
    Numbers are not checked: with nan or infinity NumPy raises LinAlgError; with another F ValueError. Of
    fewer equations (2 F) than columns the solution is the shortest one.
    """
    weighted = rows * weight[:, None]
    weighted_wanted = wanted * weight[:, None]
    # Columns of one length, so that what counts as alike does not depend on their units.
    length = np.linalg.norm(weighted, axis=0)
    is_zero = length == 0
    length[is_zero] = 1.0
    left = real_rows(np.asarray(weighted / length, dtype=np.complex128))
    right = real_rows(np.asarray(weighted_wanted, dtype=np.complex128))
    solution, *_ = np.linalg.lstsq(left, right, rcond=SMALLEST_SINGULAR)
    return np.asarray(solution / length[:, None], dtype=np.float64)
