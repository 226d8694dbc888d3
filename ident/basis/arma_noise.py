"""Noise of a few poles and zeros: A(q) v = C(q) e, an autoregression with a moving average.

A drifting offset under sensor noise, or a sensor behind a notch filter, is a few coefficients here and many
of an autoregression. The price is that the whitening A / C remembers everything since the record began, so
that its first rows need a matrix (innovations form: Brockwell and Davis, Time Series: Theory and Methods,
2nd ed., sections 3.3 and 5.2). This file is all that this kind of noise needs: it writes the abstract members
of `NoiseModel`, and whatever takes a `NoiseModel` takes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ident.basis.autoregressive_noise import AutoregressiveNoise
from ident.basis.noise_model import NoiseModel, monic_polynomial, reflected_inside
from ident.data.arrays import RealArray, lock

# Share of its beginning below which the memory of 1 / C counts as gone. Whitening and the expansion of A / C
# are exact to this share. Halved in its exponent, a zero at .9 needs 100 first rows in place of 200. Chosen:
# below the digits of any log, above the rounding of a sum of so many rows.
_DIED_OUT = 1e-9
# Rows that the memory of 1 / C may last, which allows zeros up to .9795: their covariance is factored, which
# takes a tenth of a second for so many, and eight times as long for twice as many.
_LONGEST_MEMORY = 1000


@dataclass(frozen=True, eq=False)
class ArmaNoise(NoiseModel):
    """Noise v with A(q) v = C(q) e, e white of unit variance.

    No identification fits this model: identification uses `AutoregressiveNoise`. It is for noise that is
    known beforehand, from a sensor's data sheet or a record at rest, and is given to
    `ident.uncertainty.embedding.tangent` (noise=...).

    Attributes
    ----------
    a_polynomial : ndarray, shape (p + 1,)
        [1, a_1, ..., a_p], roots inside the unit circle: the noise is stationary.
    c_polynomial : ndarray, shape (q + 1,)
        [1, c_1, ..., c_q], roots inside the unit circle: the noise can be whitened.

    Raises
    ------
    ValueError
        If one is no vector of finite numbers that begins with 1, or has roots on or outside the circle (see
        `spectral_factor`), or if the roots of C are so near to it that whitening never forgets.
    """

    a_polynomial: RealArray
    c_polynomial: RealArray

    def __post_init__(self) -> None:
        """Check the polynomials and lock them. Raises ValueError as the class says."""
        for name in ("a_polynomial", "c_polynomial"):
            polynomial = monic_polynomial(getattr(self, name), name)
            largest = _largest_root(polynomial)
            if not largest < 1:
                raise ValueError(
                    f"{name} has a root of magnitude {largest:.6g}; expected all below 1 "
                    "(ArmaNoise.spectral_factor reflects them)"
                )
        lock(self, "a_polynomial", "c_polynomial")
        if self._memory > _LONGEST_MEMORY:
            raise ValueError(
                f"c_polynomial has a root of magnitude {_largest_root(self.c_polynomial):.6g}: its whitening "
                f"remembers {self._memory} rows; expected at most {_LONGEST_MEMORY}"
            )

    @classmethod
    def spectral_factor(cls, a_polynomial: RealArray, c_polynomial: RealArray) -> ArmaNoise:
        """The model whose spectrum is |C / A|^2 up to a constant, for polynomials with roots anywhere.

        Parameters
        ----------
        a_polynomial, c_polynomial : ndarray, shapes (p + 1,) and (q + 1,)
            Beginning with 1. Roots outside the unit circle are reflected into it.

        Returns
        -------
        ArmaNoise

        Raises
        ------
        ValueError
            As the class: no vector that begins with 1, or roots of C so near to the circle that whitening
            never forgets, as those on the circle are after they were pulled in.
        """
        a_checked = monic_polynomial(a_polynomial, "a_polynomial")
        c_checked = monic_polynomial(c_polynomial, "c_polynomial")
        return cls(reflected_inside(a_checked), reflected_inside(c_checked))

    @property
    def _memory(self) -> int:
        """Rows after which the impulse response of 1 / C has fallen to `_DIED_OUT`, by its slowest root."""
        slowest = _largest_root(self.c_polynomial)
        if slowest == 0.0:
            return 0
        return int(np.ceil(np.log(_DIED_OUT) / np.log(slowest)))

    @property
    def order(self) -> int:
        """p + q, the number of coefficients of both polynomials."""
        return self.a_polynomial.size - 1 + self.c_polynomial.size - 1

    @property
    def n_start(self) -> int:
        """Rows that A and C look back over, and those that 1 / C remembers."""
        looked_back = max(self.a_polynomial.size, self.c_polynomial.size) - 1
        return looked_back + self._memory

    @property
    def ar_coefficients(self) -> tuple[float, ...]:
        """Coefficients of A / C after the leading 1, cut where they have fallen to `_DIED_OUT`."""
        impulse = np.zeros(self.n_start + 1)
        impulse[0] = 1.0
        return tuple(float(a) for a in self.filtered(impulse)[1:])

    @property
    def words(self) -> str:
        """Numbers of poles and zeros, and how much of the noise its past predicts, in words."""
        if self.is_white:
            return "white noise"
        n_poles = self.a_polynomial.size - 1
        n_zeros = self.c_polynomial.size - 1
        return (
            f"noise with poles and zeros (order {n_poles} and {n_zeros}), of whose variance its past "
            f"predicts {self.predictable_percent:.0f} %"
        )

    def filtered(self, signals: RealArray) -> RealArray:
        """A / C signals from rest, (T,) or (T, n), in their units; from a NaN on all is NaN."""
        return np.asarray(lfilter(self.a_polynomial, self.c_polynomial, signals, axis=0), dtype=np.float64)

    def coloured(self, innovations: RealArray) -> RealArray:
        """C / A innovations from rest, (T,) or (T, n), in their units; from a NaN on all is NaN."""
        return np.asarray(
            lfilter(self.c_polynomial, self.a_polynomial, innovations, axis=0), dtype=np.float64
        )

    def autocovariance(self, max_lag: int) -> RealArray:
        """gamma_k, k = 0 .. max_lag, from the autocovariance of w = e / A.

        (max_lag + 1,), of innovations of unit variance; max_lag at least 0, not checked. With v = C w it is
        sum_ij c_i c_j E w_(t-i) w_(t-k-j), the correlation of the c_i among themselves against the
        autocovariance of w.
        """
        q = self.c_polynomial.size - 1
        of_denominator = AutoregressiveNoise(self.a_polynomial).autocovariance(max_lag + q)
        both_sides = np.concatenate([of_denominator[:0:-1], of_denominator])
        # Lags -q .. q of the coefficients.
        correlation = np.correlate(self.c_polynomial, self.c_polynomial, mode="full")
        # Lags -max_lag .. max_lag of v.
        two_sided = np.convolve(both_sides, correlation, mode="valid")
        return np.asarray(two_sided[max_lag:], dtype=np.float64)

    def relative_spectrum(self, n_samples: int) -> RealArray:
        """|C / A|^2 over the variance at the lines of an FFT of n_samples, (n_samples // 2 + 1,).

        n_samples: more than the order of A and of C, or the transform cuts them off, which is not refused.
        """
        numerator = np.abs(np.fft.rfft(self.c_polynomial, n_samples)) ** 2
        denominator = np.abs(np.fft.rfft(self.a_polynomial, n_samples)) ** 2
        return np.asarray(numerator / denominator / self.autocovariance(0)[0])


def _largest_root(polynomial: RealArray) -> float:
    """Largest magnitude of the roots of a monic polynomial (n + 1,) in q^-1; 0 where it has none.

    Its numbers are finite (`monic_polynomial`); numpy's LinAlgError else.
    """
    return float(np.max(np.abs(np.roots(polynomial)), initial=0.0))
