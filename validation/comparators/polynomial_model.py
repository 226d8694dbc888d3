"""A transfer function in powers of q^-1 with its noise filter: what the comparison methods return."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from ident.data.arrays import ComplexArray, RealArray, readonly
from ident.data.record import Record


@dataclass(frozen=True, eq=False)
class PolynomialModel:
    """A(q) y(k) = [B(q) / F(q)] u(k - delay_samples) + C(q) e(k), with e white.

    a, b, c, f : (n,) arrays
        Coefficients of q^0, q^-1, ...; a, c and f begin with 1, b[0] multiplies u(k - delay_samples).
    delay_samples : int. 1 where the output does not answer within the same sample.
    dt_s : float. Sampling time in seconds.
    """

    a: RealArray
    b: RealArray
    c: RealArray
    f: RealArray
    delay_samples: int = 0
    dt_s: float = 1.0

    def __post_init__(self) -> None:
        for key in ("a", "b", "c", "f"):
            object.__setattr__(self, key, readonly(getattr(self, key)))

    def of(self, record: Record, delay_samples: int) -> PolynomialModel:
        """The polynomials found between a record's delayed input and its output, as a model of the record."""
        return replace(self, delay_samples=delay_samples, dt_s=record.dt_s)

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
