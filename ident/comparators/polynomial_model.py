"""A transfer function in powers of q^-1 with its noise filter: what the comparison methods return."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from ident.comparators.innovation_model import InnovationModel
from ident.data.arrays import ComplexArray, RealArray, readonly
from ident.data.record import Record
from ident.data.shown import Shown


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialModel(Shown):
    """A(q) y(k) = [B(q) / F(q)] u(k - delay_samples) + C(q) e(k), with e white.

    a, b, c, f : (n,) arrays
        Coefficients of q^0, q^-1, ...; a, c and f begin with 1, b[0] multiplies u(k - delay_samples).
    delay_samples : int. 1 where the output does not answer within the same sample.
    dt_s : float. Sampling time in seconds.
    method : str. What made it: 'ARX', 'ARMAX' or 'OE'.
    fit_s : float. Seconds that the fit took; nan where nobody measured.
    """

    a: RealArray
    b: RealArray
    c: RealArray
    f: RealArray
    delay_samples: int = 0
    dt_s: float = 1.0
    method: str = "polynomials"
    fit_s: float = np.nan

    def __post_init__(self) -> None:
        for key in ("a", "b", "c", "f"):
            object.__setattr__(self, key, readonly(getattr(self, key)))

    def of(self, record: Record, delay_samples: int, method: str) -> PolynomialModel:
        """The polynomials found between a record's delayed input and its output, as a model of the record."""
        return replace(self, delay_samples=delay_samples, dt_s=record.dt_s, method=method)

    @property
    def order(self) -> int:
        """Number of poles, without those at z = 0 of a delay."""
        return self.a.size + self.f.size - 2

    def innovation_form(self) -> InnovationModel:
        """This model as a state space with its noise: y = B/(A F) u + (C F)/(A F) e in observer form."""
        numerator, denominator = self._fraction
        noise_numerator = np.convolve(self.c, self.f)
        n = max(numerator.size, denominator.size, noise_numerator.size) - 1
        alpha = np.pad(denominator, (0, n + 1 - denominator.size))
        beta = np.pad(numerator, (0, n + 1 - numerator.size))
        gamma = np.pad(noise_numerator, (0, n + 1 - noise_numerator.size))
        # The first state is the output without direct term and innovation; each takes over the next one.
        A = np.eye(n, k=1)
        A[:, 0] = -alpha[1:]
        B = (beta[1:] - alpha[1:] * beta[0])[:, None]
        C = np.eye(1, n)
        K = (gamma[1:] - alpha[1:])[:, None]
        return InnovationModel(A, B, C, beta[:1, None], K, self.dt_s, self.method, self.fit_s)

    def to_control(self) -> Any:
        """The response to u as a `control.StateSpace` of period dt_s, without the noise."""
        return self.innovation_form().to_control()

    @property
    def _fraction(self) -> tuple[RealArray, RealArray]:
        """Numerator (with the delay) and denominator of the response to u, in powers of q^-1."""
        return np.concatenate([np.zeros(self.delay_samples), self.b]), np.convolve(self.a, self.f)

    @property
    def poles(self) -> ComplexArray:
        """Roots of A F in the z plane (na + nf,); the poles at z = 0 of a delay are not among them."""
        roots = [np.roots(part).astype(np.complex128) for part in (self.a, self.f)]
        return np.concatenate(roots)

    def frequency_response(self, omega_rad_s: RealArray) -> ComplexArray:
        """omega (F,) in rad/s -> response from u to y (F,)."""
        backward = np.exp(-1j * np.asarray(omega_rad_s) * self.dt_s)
        numerator, denominator = (np.polyval(part[::-1], backward) for part in self._fraction)
        return np.asarray(numerator / denominator, dtype=np.complex128)

    def simulate(self, u: RealArray) -> RealArray:
        """Noise-free output (T,) for the input u (T,), from rest; grows without bound if |poles| > 1."""
        return np.asarray(lfilter(*self._fraction, u), dtype=np.float64)
