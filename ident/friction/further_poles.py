"""A posterior whose response is stated over frequency, put onto more poles than those it stood on.

Where what is not known of a response is bent (`ident.friction.posterior.of_force`) or covered member by
member (`ident.friction.rate_members`), centre and columns are functions of frequency. `on_further_poles`
finds the coefficients that have them, so that the result is a posterior at any frequency like every other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import ComplexArray, RealArray, real_rows
from ident.data.frequency_uncertainty import FREQUENCIES

# Lowest frequency of the ellipses, as a part of that of one radian in the longest record. Chosen: far below
# what a record tells.
_LENGTHS = 100
# Further real poles over the grid, which bent gains stand on: to .1 %, where four about the slowest left 16.
_FURTHER = 20
# Slowest of them in units of the lowest frequency. Chosen: within the grid, where their shapes differ.
_SLOWEST_FURTHER = 10
# Fastest of them, as this part of the highest frequency. Chosen likewise.
_FASTEST_FURTHER = 3
# Singular values of the fit that count, as a share of the largest. Chosen, a thousandth of the size of parts
# that count.
_SMALL = 1e-6


def frequencies_of(response: ResponsePosterior, longest_s: float) -> RealArray:
    """Frequencies (F,), rad/s, as dense as what a kernel of the response does between them.

    From far below one radian in the longest record (s) to the Nyquist frequency.
    """
    nyquist = np.pi / response.dt_s
    spaced = np.geomspace(1 / (_LENGTHS * longest_s), nyquist, FREQUENCIES)
    # Two points for each tap of the kernel.
    n_points = 2 * response.fir_length
    even = nyquist * np.arange(1, n_points + 1) / (n_points + 1)
    return np.union1d(spaced, even)


def on_further_poles(
    response: ResponsePosterior,
    poles: Poles,
    omega: RealArray,
    wanted: ComplexArray,
    weight: RealArray,
) -> ResponsePosterior:
    """A posterior with the stated centre and columns, on the poles of another and further ones.

    Parameters
    ----------
    response : ResponsePosterior
        With no unstable poles.
    poles : Poles
        Of the arm, which stand once more in the result, with real ones over the grid.
    omega : ndarray, shape (F,)
        Frequencies, rad/s (`frequencies_of`).
    wanted : ndarray of complex, shape (F, 1 + N)
        Centre and columns over the gain of `response` at the frequencies.
    weight : ndarray, shape (F,)
        Of the errors relative to that gain.

    Returns
    -------
    ResponsePosterior
        On N normals, by weighted least squares.
    """
    gain = response.frequency_rows(omega) @ response.mean
    slowest = _SLOWEST_FURTHER * omega[0]
    fastest = omega[-1] / _FASTEST_FURTHER
    further_rates = np.geomspace(slowest, fastest, _FURTHER)
    poles = poles.appended(Poles(np.exp(-further_rates * response.dt_s)))
    nothing = np.zeros((response.mean.size + poles.order, 1))
    bent = replace(
        response, poles=response.poles.appended(poles), mean=nothing[:, 0], covariance_factor=nothing
    )
    # Nearly equal poles would get large coefficients, and proofs between grid points fail.
    basis = real_rows(bent.frequency_rows(omega) / gain[:, None] * weight[:, None])
    length = np.maximum(np.linalg.norm(basis, axis=0), np.finfo(np.float64).tiny)[:, None]
    target = real_rows(wanted * weight[:, None])
    solved = np.linalg.lstsq(basis / length.T, target, rcond=_SMALL)[0] / length
    return replace(bent, mean=solved[:, 0], covariance_factor=solved[:, 1:])
