"""What identification knows about a response, as a Gaussian over coefficients: evaluable at any frequency."""

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

    noise_std: of the (whitened, if ar_coefficients is not empty) noise, output units; alpha, lam: scale of
    the kernel (in noise variances) and decay per sample at the largest weight; probability_no_remainder: that
    the poles explain everything; log_evidence: of the best kernel over none; n_rows: samples after nuisance
    columns; ar_coefficients: a_1 .. a_n of 1 / (1 + a_1 q^-1 + ...). probability_missed_mode: that the poles
    lack a lightly damped mode, most probably at missed_mode_rad_s (0: nowhere); n_added_modes: beyond the
    model's poles, too plain to be left to a probability.
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


# Checks at other levels, and stages after one another, ask for the same frequencies again.
@lru_cache(maxsize=16)
def _centre_and_covariance(
    posterior: ResponsePosterior, omega: bytes, shape: tuple[int, ...]
) -> tuple[ComplexArray, RealArray]:
    rows = posterior.frequency_rows(np.frombuffer(omega).reshape(shape))
    return rows @ posterior.mean, spread_covariance(rows, posterior.square_factor)


def _delays(z: ComplexArray, most: int) -> ComplexArray:
    """z^-1 .. z^-most (F, most), by doubling: an exponential of each takes many times as long."""
    powers = np.empty((z.size, most), dtype=np.complex128)
    powers[:, :1] = z.conj()[:, None]  # on the unit circle
    known = 1
    while known < most:
        more = min(known, most - known)
        np.multiply(powers[:, :more], powers[:, known - 1 : known], out=powers[:, known : known + more])
        known += more
    return powers


@dataclass(frozen=True, eq=False, repr=False)
class ResponsePosterior(Shown):
    """Gaussian coefficients of G(z) = [sum a_i L_i(z) + d + sum h_k z^-k] (z / (z - 1))^integrators z^-delay.

    poles: of the L_i (doubled ones for the tangent method); has_feedthrough: whether d is among the
    coefficients; fir_length L. mean (P,), covariance S S^T of covariance_factor S (P,P'), P = poles.order +
    has_feedthrough + L, in the order a, d, h_1 .. h_L. unstable: as in `GobfModel`; how far each image is off
    (real; real and imaginary part of a pair) are further coefficients, to first order.
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
        lock(self, "mean", "covariance_factor")
        mean, factor = self.mean, self.covariance_factor
        size = self.poles.order + int(self.has_feedthrough) + self.fir_length + self.unstable.order
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
        """(F,P) matrix that maps coefficients to the response at omega (F,) [rad/s], 0 <= omega <= pi / dt_s.

        Raises ValueError outside that range, and at omega = 0 when there are integrators.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        nyquist = np.pi / self.dt_s
        if omega.ndim != 1 or not np.all((omega >= 0) & (omega <= nyquist * (1 + 1e-9))):
            raise ValueError(f"omega (F,) is in rad/s, from 0 to pi / dt_s = {nyquist:.6g}")
        if self.integrators and not np.all(omega > 0):
            raise ValueError("the response of an integrator has no value at omega = 0")
        z = np.exp(1j * omega * self.dt_s)
        parts = [basis_response(self.poles, z)]
        if self.has_feedthrough:
            parts.append(np.ones((omega.size, 1), dtype=np.complex128))
        parts.append(_delays(z, self.fir_length))
        common = front_response(omega, self.dt_s, self.integrators, self.input_delay_samples)
        rows: ComplexArray = np.hstack(parts)
        rows *= (common / all_pass_response(self.unstable, z))[:, None]
        if not self.unstable.order:
            return rows
        response = rows @ self.mean[: rows.shape[1]]
        return np.hstack([rows, -response[:, None] * log_all_pass_slopes(self.unstable, z)])

    @cached_property
    def square_factor(self) -> RealArray:
        """(P,P) lower triangle L of the covariance L L^T, column-major."""
        # P' may be larger than P, and half of a triangle is zero.
        triangle = np.asarray(np.linalg.qr(self.covariance_factor.T, mode="r"))
        square = np.zeros((self.mean.size, self.mean.size), order="F")
        square[:, : len(triangle)] = triangle.T
        return square

    def at(self, omega_rad_s: npt.ArrayLike, level: float = 0.95) -> FrequencyUncertainty:
        """Centre and 2x2 covariances at any strictly increasing omega (F,) [rad/s]."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        centre, covariance = _centre_and_covariance(self, omega.tobytes(), omega.shape)
        method = self.report.method if self.report is not None else "coefficient posterior"
        return FrequencyUncertainty(omega, centre, covariance, self.dt_s, level, method)

    def centre(self, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """Posterior mean response (F,) alone."""
        return np.asarray(self.frequency_rows(omega_rad_s) @ self.mean)

    def sample(self, rng: np.random.Generator, n_draws: int) -> RealArray:
        """(n_draws, P) coefficient draws."""
        noise = rng.standard_normal((n_draws, self.covariance_factor.shape[1]))
        return np.asarray(self.mean + noise @ self.covariance_factor.T)

    def response_of(self, draws: RealArray, omega_rad_s: npt.ArrayLike) -> ComplexArray:
        """Responses (n_draws, F) of coefficient draws (n_draws, P)."""
        return np.asarray(draws @ self.frequency_rows(omega_rad_s).T)

    def simulate(self, u: RealArray, coefficients: RealArray | None = None) -> RealArray:
        """Output (T,) from rest for the input u (T,), with the mean coefficients or a draw (P,). Raises
        ValueError for an unstable plant."""
        refuse_unstable(self.unstable)
        values = self.mean if coefficients is None else np.asarray(coefficients, dtype=np.float64)
        if values.shape != self.mean.shape:
            raise ValueError(f"need coefficients {self.mean.shape}; got {values.shape}")
        filtered = filter_input(u, self.integrators, self.input_delay_samples)
        n_poles, n_direct = self.poles.order, int(self.has_feedthrough)
        taps = np.concatenate([np.zeros(1), values[n_poles + n_direct :]])
        if self.has_feedthrough:
            taps[0] = values[n_poles]
        return np.asarray(
            regressor(self.poles, filtered) @ values[:n_poles] + lfilter(taps, np.ones(1), filtered)
        )

    @property
    def stable_part(self) -> ResponsePosterior:
        """B G, without the unstable poles."""
        kept = slice(self.mean.size - self.unstable.order)
        return replace(
            self, mean=self.mean[kept], covariance_factor=self.covariance_factor[kept], unstable=NO_POLES
        )
