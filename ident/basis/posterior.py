"""What identification knows about a response, as a Gaussian over coefficients: evaluable at any frequency.

The response of a model is linear in its coefficients, so a Gaussian over them is, at each frequency, a
Gaussian over a complex number: an ellipse. The coefficients are those of the basis, of a direct term and of
the taps of a kernel for what the poles do not explain (Pillonetto et al., Automatica 50(3), 2014); poles that
are not certain are linearised (the tangent method, whose basis has every pole twice). `ResponsePosterior`
gives ellipses, draws and their responses; how it came about is its `EmbeddingReport`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from ident.basis.autoregressive_noise import AutoregressiveNoise
from ident.basis.functions import all_pass_response, basis_response, log_all_pass_slopes, regressor
from ident.basis.model import refuse_unstable
from ident.basis.poles import NO_POLES, Poles
from ident.basis.structure import filter_input, front_response
from ident.data.arrays import ComplexArray, RealArray, lock
from ident.data.ellipses import spread_covariance
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.shown import Shown


@dataclass(frozen=True)
class EmbeddingReport:
    """How a posterior came about.

    Attributes
    ----------
    method : str
        Name of the method, as reports show it.
    noise_std : float
        Of the noise, output units; whitened, if ar_coefficients is not empty.
    alpha, lam : float
        Kernel of the taps at the largest weight: scale in noise variances, decay per sample.
    probability_no_remainder : float
        Probability that the poles explain everything.
    log_evidence : float
        Of the best kernel over none.
    n_rows, n_regressors : int
        Samples after nuisance columns; columns of the regression.
    ar_coefficients : tuple of float
        a_1 .. a_n of the noise 1 / (1 + a_1 q^-1 + ...); empty: white.
    probability_missed_mode : float
        Probability that the poles lack a lightly damped mode.
    missed_mode_rad_s : float
        Where that is most probably, rad/s; 0: nowhere.
    n_added_modes : int
        Modes beyond the model's poles, too plain to be left to a probability.
    """

    method: str
    noise_std: float
    alpha: float
    lam: float
    probability_no_remainder: float
    log_evidence: float
    n_rows: int
    n_regressors: int
    ar_coefficients: tuple[float, ...] = ()
    probability_missed_mode: float = 0.0
    missed_mode_rad_s: float = 0.0
    n_added_modes: int = 0

    @property
    def noise(self) -> AutoregressiveNoise:
        """Noise model behind the posterior, of `ar_coefficients`; white where there are none."""
        return AutoregressiveNoise(np.array([1.0, *self.ar_coefficients]))


# Pairs of a posterior and a frequency grid whose ellipses are remembered: trials of other bandwidths, checks
# at other levels, and stages after one another ask for the same ones again, a search for a bandwidth for some
# ninety. Chosen; it costs memory alone, about 50 kB each.
_REMEMBERED = 256
# How far above pi / dt, as a share of it, a frequency may lie: the rounding of tables with ten digits.
_NYQUIST_ROUNDING = 1e-9


@lru_cache(maxsize=_REMEMBERED)
def _centre_and_covariance(
    posterior: ResponsePosterior, omega: bytes, shape: tuple[int, ...]
) -> tuple[ComplexArray, RealArray]:
    """Centre (F,) and covariances (F, 2, 2) of real and imaginary part at frequencies, rad/s.

    They are given as the bytes and the shape of a float64 array, which a cache can compare; the posterior is
    compared by identity. Raises ValueError as `ResponsePosterior.frequency_rows`.
    """
    omega_rad_s = np.frombuffer(omega).reshape(shape)
    rows = posterior.frequency_rows(omega_rad_s)
    return rows @ posterior.mean, spread_covariance(rows, posterior.square_factor)


def _delays(z: ComplexArray, most: int) -> ComplexArray:
    """z^-1 .. z^-most at points z (F,) of the unit circle, (F, most).

    By doubling: an exponential of each takes many times as long. (F, 0) for most = 0. That z is on the circle
    is not checked: elsewhere the numbers are powers of conj(z).
    """
    powers = np.empty((z.size, most), dtype=np.complex128)
    # On the unit circle 1/z is the conjugate.
    powers[:, :1] = z.conj()[:, None]
    n_known = 1
    while n_known < most:
        n_new = min(n_known, most - n_known)
        known_powers = powers[:, :n_new]
        highest_power = powers[:, n_known - 1 : n_known]
        np.multiply(known_powers, highest_power, out=powers[:, n_known : n_known + n_new])
        n_known += n_new
    return powers


def _misfit(omega: RealArray, nyquist_rad_s: float) -> str:
    """What of frequencies is no (F,) array from 0 to Nyquist, in words: their shape, or the first outside."""
    if omega.ndim == 0:
        return f"a number: give [{omega:g}]"
    if omega.ndim > 1:
        return f"shape {omega.shape}"
    is_inside = (omega >= 0) & (omega <= nyquist_rad_s)
    return f"{omega[np.argmin(is_inside)]:g}"


@dataclass(frozen=True, eq=False, repr=False)
class ResponsePosterior(Shown):
    """Gaussian coefficients of G(z) = [sum a_i L_i(z) + d + sum h_k z^-k] (z / (z - 1))^integrators z^-delay.

    Raises ValueError if shapes do not fit, mean, factor or dt_s is not finite, dt_s is not positive, or a
    count is negative.

    Attributes
    ----------
    poles : Poles
        Of the L_i, B of them (doubled ones for the tangent method).
    mean : ndarray, shape (P,)
        In the order a (B,), d if has_feedthrough, h_1 .. h_L, and how far each mirror image of an unstable
        pole is off, to first order (real; real and imaginary part of a pair). Output units per unit of the
        input, but for these last ones, which have none.
    covariance_factor : ndarray, shape (P, P')
        S, where the covariance is S S^T.
    dt_s : float
        Sampling time, s.
    fir_length : int
        L, number of taps.
    has_feedthrough : bool
        Whether d is among the coefficients.
    integrators, input_delay_samples : int
        The known factor.
    input_name, output_name : str
        Names of the channel.
    report : EmbeddingReport or None
        How it came about.
    unstable : Poles
        Mirror images of the unstable poles, as in `GobfModel`.
    """

    poles: Poles
    mean: RealArray
    covariance_factor: RealArray
    dt_s: float
    fir_length: int = 0
    has_feedthrough: bool = False
    integrators: int = 0
    input_delay_samples: int = 0
    input_name: str = "u"
    output_name: str = "y"
    report: EmbeddingReport | None = None
    unstable: Poles = field(default=NO_POLES, metadata={"since": 2})

    def __post_init__(self) -> None:
        """Lock the arrays and check all fields. Raises ValueError as the class says."""
        lock(self, "mean", "covariance_factor")
        mean = self.mean
        factor = self.covariance_factor
        n_direct = int(self.has_feedthrough)
        size = self.poles.order + n_direct + self.fir_length + self.unstable.order
        if mean.shape != (size,) or factor.ndim != 2 or factor.shape[0] != size:
            raise ValueError(
                f"need mean ({size},) and covariance_factor ({size}, P'); got {mean.shape}, {factor.shape}"
            )
        if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(factor))):
            raise ValueError("mean and covariance_factor must be finite")
        if not 0 < self.dt_s < np.inf:
            raise ValueError(f"dt_s must be positive and finite; got {self.dt_s}")
        if min(self.fir_length, self.integrators, self.input_delay_samples) < 0:
            raise ValueError("fir_length, integrators and input_delay_samples must not be negative")

    def frequency_rows(self, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """Matrix that maps coefficients (P,) to the response.

        Parameters
        ----------
        omega_rad_s : array-like, shape (F,)
            Frequencies, rad/s, 0 <= omega <= pi / dt_s.

        Returns
        -------
        ndarray of complex, shape (F, P)

        Raises
        ------
        ValueError
            A frequency outside that range or NaN, another shape, or omega = 0 when there are integrators.

        Notes
        -----
        With unstable poles G = N / B, and a change of a mirror image p moves G by -G d log B / dp: these are
        the last columns, with G at the mean.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        nyquist = np.pi / self.dt_s
        is_below = omega <= nyquist * (1 + _NYQUIST_ROUNDING)
        is_positive = omega >= 0
        if omega.ndim != 1 or not np.all(is_positive & is_below):
            raise ValueError(
                f"omega (F,) is in rad/s, from 0 to pi / dt_s = {nyquist:.6g}; got {_misfit(omega, nyquist)}"
            )
        if self.integrators and not np.all(omega > 0):
            raise ValueError(
                "the response of an integrator has no value at omega = 0: expected frequencies above 0, up "
                f"to pi / dt_s = {nyquist:.6g} rad/s"
            )

        # Basis, direct term and taps, side by side; then the factor that they share.
        z = np.exp(1j * omega * self.dt_s)
        parts = [basis_response(self.poles, z)]
        if self.has_feedthrough:
            parts.append(np.ones((omega.size, 1), dtype=np.complex128))
        parts.append(_delays(z, self.fir_length))
        # The factor of all columns: integrators, delay, and one over the all-pass of unstable poles.
        common = front_response(omega, self.dt_s, self.integrators, self.input_delay_samples)
        rows: ComplexArray = np.hstack(parts)
        rows *= (common / all_pass_response(self.unstable, z))[:, None]
        if not self.unstable.order:
            return rows
        # How the response moves with each mirror image, at the mean.
        response = rows @ self.mean[: rows.shape[1]]
        by_unstable = -response[:, None] * log_all_pass_slopes(self.unstable, z)
        return np.hstack([rows, by_unstable])

    @cached_property
    def square_factor(self) -> RealArray:
        """Lower triangle L (P, P) of the covariance L L^T, column-major, as BLAS takes it."""
        # P' may be larger than P, and half of a triangle is zero.
        # S^T = Q R, so that S S^T = R^T R.
        triangle = np.asarray(np.linalg.qr(self.covariance_factor.T, mode="r"))
        square = np.zeros((self.mean.size, self.mean.size), order="F")
        square[:, : len(triangle)] = triangle.T
        return square

    def at(self, omega_rad_s: npt.ArrayLike, level: float = 0.95) -> FrequencyUncertainty:
        """Ellipses of the response at given frequencies.

        Parameters
        ----------
        omega_rad_s : array-like, shape (F,)
            Strictly increasing frequencies, rad/s; limits as in `frequency_rows`.
        level : float
            Probability that an ellipse holds the response at its frequency; 0.95 is what all reports use.

        Returns
        -------
        FrequencyUncertainty
            Centre (F,) and covariances (F, 2, 2) of real and imaginary part.

        Raises
        ------
        ValueError
            As `frequency_rows`; by `FrequencyUncertainty` for no frequency, frequencies that do not increase
            and a level outside (0, 1).
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        centre, covariance = _centre_and_covariance(self, omega.tobytes(), omega.shape)
        method = self.report.method if self.report is not None else "coefficient posterior"
        return FrequencyUncertainty(omega, centre, covariance, self.dt_s, level, method)

    def centre(self, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """Posterior mean response (F,) at omega (F,), rad/s, in any order, without its uncertainty.

        Output units per unit of the input. Raises ValueError as `frequency_rows`.
        """
        return np.asarray(self.frequency_rows(omega_rad_s) @ self.mean)

    def sample(self, rng: np.random.Generator, n_draws: int) -> RealArray:
        """Draws (n_draws, P) of the coefficients, in the order of `mean`; n_draws at least 0 (ValueError
        else)."""
        noise = rng.standard_normal((n_draws, self.covariance_factor.shape[1]))
        return np.asarray(self.mean + noise @ self.covariance_factor.T)

    def response_of(self, draws: RealArray, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """Responses (n_draws, F) of coefficient draws (n_draws, P), at omega_rad_s (F,), rad/s, in any order.

        Linear also in the places of unstable poles. Raises ValueError as `frequency_rows`, and (numpy's) for
        draws of another P.
        """
        return np.asarray(draws @ self.frequency_rows(omega_rad_s).T)

    def simulate(self, u: RealArray, coefficients: RealArray | None = None) -> RealArray:
        """Output (T,) from rest for the input u (T,), with the mean coefficients or a draw (P,).

        In units of the output; from a NaN on NaN. Raises ValueError for an unstable plant, for another number
        of coefficients, and for another shape of u than (T,) or (T, 1).
        """
        refuse_unstable(self.unstable)
        values = self.mean if coefficients is None else np.asarray(coefficients, dtype=np.float64)
        if values.shape != self.mean.shape:
            raise ValueError(f"need coefficients {self.mean.shape}; got {values.shape}")
        filtered = filter_input(u, self.integrators, self.input_delay_samples)
        # The direct term is the tap of the present sample.
        n_poles = self.poles.order
        n_before_taps = n_poles + int(self.has_feedthrough)
        taps = np.concatenate([np.zeros(1), values[n_before_taps:]])
        if self.has_feedthrough:
            taps[0] = values[n_poles]
        through_basis = regressor(self.poles, filtered) @ values[:n_poles]
        return np.asarray(through_basis + lfilter(taps, np.ones(1), filtered))

    @property
    def stable_part(self) -> ResponsePosterior:
        """Posterior of the stable part B G: without the unstable poles and their coefficients."""
        of_stable = slice(self.mean.size - self.unstable.order)
        return replace(
            self,
            mean=self.mean[of_stable],
            covariance_factor=self.covariance_factor[of_stable],
            unstable=NO_POLES,
        )
