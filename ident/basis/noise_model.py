"""What is known of the noise on an output: the type that every fit and every ellipse takes.

Noise is taken as v = H(q) e, with e white of unit variance, and H = 1 + h_1 q^-1 + ... stable with a stable
inverse (spectral factorisation: Ljung, System Identification, 2nd ed., section 3.2; every stationary noise
with a rational spectrum has one such H, up to its size, which the users estimate by themselves). H^-1 makes
the noise white, and least squares on whitened rows is then efficient. `NoiseModel` says what such a model
must be able to do. A kind of noise is a class of its own in a file of its own (`autoregressive_noise`,
`arma_noise`); it writes the abstract members, and inherits how the first rows of a record are whitened.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular, toeplitz

from ident.data.arrays import RealArray

# Largest over smallest variance among the directions of a record's first rows up to which they are whitened.
# Beyond it they are left out: the start of a record is never quite stationary, and whitening would multiply
# what is not by up to the root of this number, 100. From 1e2 to 1e8 no ellipse of ten simulated arms in noise
# with a pole at .9 moved by 1 %.
LARGEST_CONDITION = 1e4
# Largest magnitude of a root that was reflected: one on the circle itself, which reflection leaves there, is
# pulled in by a millionth, a time constant of a million rows. That is as good as none in records of up to
# some hundred thousand. Chosen.
_LARGEST_REFLECTED = 1 - 1e-6


class NoiseModel(ABC):
    """Stationary noise v = H(q) e of one output, e white of unit variance, H(q) = 1 + h_1 q^-1 + ...

    Every model can be inverted: `coloured` undoes `filtered`. A new kind of noise is one subclass, which
    refuses coefficients that it cannot use when it is made; signals are not checked, and NaN in them stays.
    """

    @property
    @abstractmethod
    def order(self) -> int:
        """Number of coefficients of the model; 0 for white noise."""

    @property
    @abstractmethod
    def n_start(self) -> int:
        """Rows at the start of a record on which the missing past acts; `filtered` is exact after them."""

    @property
    @abstractmethod
    def ar_coefficients(self) -> tuple[float, ...]:
        """a_1 .. a_n of H^-1(q) = 1 + a_1 q^-1 + ... + a_n q^-n, what a stored report keeps of the model.

        Exact for autoregressive noise; of other kinds the expansion, cut where it has died out.
        """

    @property
    @abstractmethod
    def words(self) -> str:
        """What the noise is, in words for a report, such as "white noise"."""

    @abstractmethod
    def filtered(self, signals: RealArray) -> RealArray:
        """H^-1(q) signals from rest, (T,) or (T, n) along the first axis, in their units."""

    @abstractmethod
    def coloured(self, innovations: RealArray) -> RealArray:
        """H(q) innovations from rest, (T,) or (T, n) along the first axis: the inverse of `filtered`.

        Not checked: the innovations' shape; NaN stays.
        """

    @abstractmethod
    def autocovariance(self, max_lag: int) -> RealArray:
        """E v_t v_(t-k), k = 0 .. max_lag, (max_lag + 1,), for innovations of unit variance.

        max_lag: at least 0, which need not be checked.
        """

    @abstractmethod
    def relative_spectrum(self, n_samples: int) -> RealArray:
        """|H|^2 over the variance of the noise at the lines of an FFT of n_samples, (n_samples // 2 + 1,).

        Line k stands at 2 pi k / n_samples radians a sample. The mean over the whole circle is 1. n_samples
        has to exceed the order, which need not be checked.
        """

    @property
    def is_white(self) -> bool:
        """Whether the noise is white, so that nothing needs to be filtered."""
        return self.order == 0

    @property
    def predictable_percent(self) -> float:
        """Share of the variance, in per cent, that the noise's own past predicts; 0 for white noise."""
        return 100.0 * (1.0 - 1.0 / float(self.autocovariance(0)[0]))

    @cached_property
    def first_rows(self) -> RealArray:
        """(n_start, n_start) lower triangle that whitens the first samples of a record of this noise.

        It is the inverse Cholesky factor of their covariance, or zeros where that is nearly singular
        (`LARGEST_CONDITION`) or has NaN: then these rows are left out. (0, 0) for white noise.
        """
        n = self.n_start
        if n == 0:
            return np.zeros((0, 0))
        covariance = toeplitz(self.autocovariance(n - 1))
        variances = np.linalg.eigvalsh(covariance)
        # Written so that a NaN, or a negative variance by rounding, counts as nearly singular.
        well_conditioned = variances[0] * LARGEST_CONDITION >= variances[-1]
        if not well_conditioned:
            return np.zeros((n, n))
        factor = cholesky(covariance, lower=True)
        return np.asarray(solve_triangular(factor, np.eye(n), lower=True), dtype=np.float64)

    @property
    def drops_start(self) -> bool:
        """Whether the first `n_start` rows of every record are left out (`first_rows` is zero)."""
        return not self.is_white and not np.any(self.first_rows)

    def whiten(self, signals: RealArray) -> RealArray:
        """White noise of unit variance, if `signals` are this noise without a recorded past.

        Parameters
        ----------
        signals : ndarray, shape (T,) or (T, n)
            Along the first axis.

        Returns
        -------
        ndarray, of the same shape
            The first `n_start` rows by `first_rows` (zero where they are left out), the others `filtered`.
            White noise, and signals without rows or columns, give back `signals` itself. Fewer rows than
            n_start get the corner of `first_rows`.
        """
        if self.is_white or signals.size == 0:
            return signals
        white = self.filtered(signals)
        n = min(self.n_start, len(signals))
        white[:n] = self.first_rows[:n, :n] @ signals[:n]
        return white

    def without_start(self, signals: RealArray) -> RealArray:
        """`filtered` signals (T,) or (T, n) without the first `n_start` rows: the past is in the record.

        No rows where T is not more than n_start.
        """
        return self.filtered(signals)[self.n_start :]


def monic_polynomial(coefficients: RealArray, name: str) -> RealArray:
    """Coefficients [1, c_1 .. c_n] of a polynomial in q^-1, checked.

    Parameters
    ----------
    coefficients : ndarray, shape (n + 1,)
    name : str
        What the message calls the polynomial.

    Returns
    -------
    ndarray, shape (n + 1,)
        As float64; roots may be anywhere.

    Raises
    ------
    ValueError
        If they are no vector of finite numbers that begins with 1.
    """
    polynomial = np.asarray(coefficients, dtype=np.float64)
    if polynomial.ndim != 1 or polynomial.size == 0:
        raise ValueError(f"{name} must be a vector [1, ...]; got an array of shape {polynomial.shape}")
    if polynomial[0] != 1 or not np.all(np.isfinite(polynomial)):
        raise ValueError(f"{name} must be finite numbers that begin with 1; got {polynomial.tolist()}")
    return polynomial


def reflected_inside(polynomial: RealArray) -> RealArray:
    """The monic polynomial (n + 1,) in q^-1 of the same magnitude on the unit circle, with all roots inside.

    Its magnitude is the same up to a constant factor. Roots on or outside the circle are reflected; a
    polynomial that has none there is given back itself. Its numbers are finite (`monic_polynomial`): numpy's
    LinAlgError else.
    """
    roots = np.asarray(np.roots(polynomial), dtype=np.complex128)
    outside = np.abs(roots) >= 1
    if not np.any(outside):
        return polynomial
    radius = np.minimum(1.0 / np.abs(roots[outside]), _LARGEST_REFLECTED)
    roots[outside] = radius * np.exp(1j * np.angle(roots[outside]))
    return np.asarray(np.real(np.poly(roots)), dtype=np.float64)
