"""Noise that is a weighted sum of its own last values and something new: A(q) v = e.

A(q) = 1 + a_1 q^-1 + ... + a_n q^-n whitens by a finite sum, so that a record loses no more than its first n
rows, and least squares fits it (`ident.uncertainty.autoregression`, `ident.coloured_noise`). Slow drift,
friction and sensor noise together need a few coefficients; a sharp notch in the spectrum needs many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import hankel, toeplitz
from scipy.signal import lfilter

from ident.basis.noise_model import NoiseModel, monic_polynomial
from ident.data.arrays import RealArray, lock

# Polynomial 1: a filter without a denominator, or without a numerator.
_ONE = np.ones(1)


@dataclass(frozen=True, eq=False)
class AutoregressiveNoise(NoiseModel):
    """Noise v with A(q) v = e, e white of unit variance.

    Attributes
    ----------
    a_polynomial : ndarray, shape (n + 1,)
        [1, a_1, ..., a_n]; [1] is white noise. Roots outside the unit circle are allowed, as a least-squares
        fit to an unstable plant has them: such an A(q) still filters, but it is the model of no stationary
        noise, so that `autocovariance`, `first_rows` and `words` then mean nothing.

    Raises
    ------
    ValueError
        If a_polynomial is no vector of finite numbers that begins with 1.
    """

    a_polynomial: RealArray

    def __post_init__(self) -> None:
        """Check the polynomial and lock it. Raises ValueError as the class says."""
        monic_polynomial(self.a_polynomial, "a_polynomial")
        lock(self, "a_polynomial")

    @property
    def order(self) -> int:
        """n, the number of coefficients a_1 .. a_n."""
        return self.a_polynomial.size - 1

    @property
    def n_start(self) -> int:
        """n: A(q) looks back over so many rows."""
        return self.order

    @property
    def ar_coefficients(self) -> tuple[float, ...]:
        """a_1 .. a_n, exact."""
        return tuple(float(a) for a in self.a_polynomial[1:])

    @property
    def words(self) -> str:
        """Order, and how much of the noise its past predicts, in words."""
        if self.is_white:
            return "white noise"
        return (
            f"autoregressive noise of order {self.order}, of whose variance its past predicts "
            f"{self.predictable_percent:.0f} %"
        )

    def filtered(self, signals: RealArray) -> RealArray:
        """A(q) signals from rest, (T,) or (T, n), in their units; NaN spreads over the next n rows."""
        return np.asarray(lfilter(self.a_polynomial, _ONE, signals, axis=0), dtype=np.float64)

    def coloured(self, innovations: RealArray) -> RealArray:
        """innovations / A(q) from rest, (T,) or (T, n), in their units.

        From a NaN on all is NaN; with roots of A on or outside the circle it grows.
        """
        return np.asarray(lfilter(_ONE, self.a_polynomial, innovations, axis=0), dtype=np.float64)

    def autocovariance(self, max_lag: int) -> RealArray:
        """gamma_k, k = 0 .. max_lag, by the Yule-Walker equations and then their recursion.

        (max_lag + 1,), of innovations of unit variance; empty for max_lag = -1. sum_i a_i gamma_|k - i| = 1
        for k = 0, and 0 for k = 1 .. n, are solved for gamma_0 .. gamma_n. Roots of A outside the circle give
        numbers that are no covariance, on it numpy's LinAlgError.
        """
        order = self.order
        # Unknown gamma_j stands at i = k - j (Toeplitz part) and, for j > 0, at i = k + j (Hankel part).
        equations = toeplitz(self.a_polynomial, np.zeros(order + 1))
        equations[:, 1:] += hankel(self.a_polynomial)[:, 1:]
        unit_innovation = np.eye(order + 1)[0]
        gamma = np.zeros(max(order, max_lag) + 1)
        gamma[: order + 1] = np.linalg.solve(equations, unit_innovation)
        for k in range(order + 1, max_lag + 1):
            # a_n .. a_1 against gamma_(k-n) .. gamma_(k-1).
            gamma[k] = -self.a_polynomial[:0:-1] @ gamma[k - order : k]
        return gamma[: max_lag + 1]

    def relative_spectrum(self, n_samples: int) -> RealArray:
        """1 / |A|^2 over the variance at the lines of an FFT of n_samples, (n_samples // 2 + 1,).

        n_samples: at least n + 1, or the transform cuts A off, which is not refused; numpy refuses 0.
        """
        of_unit_power = self.a_polynomial * np.sqrt(self.autocovariance(0)[0])
        return np.asarray(1 / np.abs(np.fft.rfft(of_unit_power, n_samples)) ** 2)


# Noise without memory: nothing is filtered, and no row is left out.
WHITE_NOISE = AutoregressiveNoise(np.ones(1))
