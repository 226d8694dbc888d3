"""A transfer function in powers of q^-1 with its noise filter: what the comparison methods return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

from ident.data.arrays import ComplexArray, RealArray, readonly_real


@dataclass(frozen=True, eq=False)
class PolynomialModel:
    """A(q) y(k) = [B(q) / F(q)] u(k - delay_samples) + C(q) e(k), with e white.

    Attributes
    ----------
    a, b, c, f : (n,) arrays
        Coefficients of q^0, q^-1, ...; a, c and f begin with 1, b[0] multiplies u(k - delay_samples).
    delay_samples : int
        1 where the output does not answer within the same sample.
    dt_s : float
        Sampling time in seconds.
    input_name, output_name : str

    Raises
    ------
    ValueError
        If a polynomial is empty, not finite or (a, c, f) does not begin with 1, or the times make no sense.
    """

    a: RealArray
    b: RealArray
    c: RealArray
    f: RealArray
    delay_samples: int
    dt_s: float
    input_name: str = "u"
    output_name: str = "y"

    def __post_init__(self) -> None:
        for key in ("a", "b", "c", "f"):
            values = readonly_real(getattr(self, key))
            object.__setattr__(self, key, values)
            if values.ndim != 1 or values.size == 0 or not np.all(np.isfinite(values)):
                raise ValueError(f"{key} must be (n,) finite numbers, n >= 1; got {values}")
            if key != "b" and values[0] != 1:
                raise ValueError(f"{key} must begin with 1; got {values[0]}")
        if self.delay_samples < 0:
            raise ValueError(f"delay_samples must not be negative; got {self.delay_samples}")
        if not 0 < self.dt_s < np.inf:
            raise ValueError(f"dt_s must be positive and finite; got {self.dt_s}")

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
        """omega (F,) in rad/s, |omega| <= pi/dt -> response from u to y (F,)."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        if omega.ndim != 1 or not np.all(np.abs(omega) <= np.pi / self.dt_s * (1 + 1e-12)):
            raise ValueError(f"omega_rad_s must be (F,) and stop at pi/dt = {np.pi / self.dt_s:.6g} rad/s")
        backward = np.exp(-1j * omega * self.dt_s)
        numerator, denominator = (np.polyval(part[::-1], backward) for part in self._fraction)
        if not np.all(denominator != 0):
            raise ValueError(
                "the model has a pole at one of the frequencies; it has no finite response there"
            )
        return np.asarray(numerator / denominator, dtype=np.complex128)

    def simulate(self, u: RealArray) -> RealArray:
        """Noise-free output (T,) for the input u (T,), from rest; grows without bound if |poles| > 1."""
        u = np.asarray(u, dtype=np.float64)
        if u.ndim != 1:
            raise ValueError(f"u must be (T,); got shape {u.shape}")
        numerator, denominator = self._fraction
        return np.asarray(lfilter(numerator, denominator, u), dtype=np.float64)

    def to_control(self) -> Any:
        """The response from u to y as a `control.TransferFunction` with dt = dt_s."""
        import control

        numerator, denominator = self._fraction
        # Powers of q^-1 become powers of z once both polynomials are equally long.
        size = max(numerator.size, denominator.size)
        padded = [np.pad(part, (0, size - part.size)) for part in (numerator, denominator)]
        return control.tf(*padded, self.dt_s, inputs=[self.input_name], outputs=[self.output_name])
