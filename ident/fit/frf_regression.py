"""A measured frequency response as a weighted least-squares problem, linear in everything but the poles.

With the response g_f ~ N(G(z_f), Sigma_f) over (Re, Im) the rows of a frequency are its error turned into the
axes of its ellipse and divided by their standard deviations: two real numbers of unit variance. All rows
together play the part of the samples in the time domain (design 4.2): thin QR, residual r, J = |r|^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.basis.functions import basis_response
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import standard_axes
from ident.data.frequency_uncertainty import FrequencyUncertainty

# A minor axis below this part of the major one would let one direction of one frequency overrule the rest.
_THINNEST = 1e-4
# Directions of the columns weaker than this fraction of the strongest are left at zero: nothing shows them.
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class FrfRegression:
    """Everything a fit of a frequency response needs but the poles.

    Attributes
    ----------
    z : (F,) complex array
        exp(j omega dt).
    common : (F,) complex array
        Known factor of the response: integrators (z / (z - 1))^k and delay z^-d.
    turn, weight : (F,) complex and (2, F) real arrays
        `turn` rotates into the axes of the ellipse, `weight` is one over the standard deviations there. At 0
        and at pi/dt both responses are real: the second weight is zero.
    y : (2 F,) array
        The whitened measurement.
    feedthrough : bool
    dt_s : float
    """

    z: ComplexArray
    common: ComplexArray
    turn: ComplexArray
    weight: RealArray
    y: RealArray
    feedthrough: bool
    dt_s: float

    @property
    def n_rows(self) -> int:
        """Number of real numbers that were measured: two per frequency, one at 0 and at pi/dt."""
        return int(np.count_nonzero(self.weight))

    def n_parameters(self, order: int, n_fixed: int = 0) -> int:
        """Number of free real numbers of a fit: coefficients, direct term, poles that are not known."""
        return int(2 * order - n_fixed + self.feedthrough)

    def whiten(self, response: ComplexArray) -> RealArray:
        """Complex columns (..., F, K) -> real rows of unit variance (..., 2 F, K)."""
        aligned = response * self.turn[:, np.newaxis]
        return np.concatenate(
            [aligned.real * self.weight[0][:, np.newaxis], aligned.imag * self.weight[1][:, np.newaxis]],
            axis=-2,
        )

    def responses(self, poles: Poles) -> ComplexArray:
        """Basis functions, and the direct term if there is one, times the known factor, (F, B or B + 1)."""
        parts = [basis_response(poles, self.z)]
        if self.feedthrough:
            parts.append(np.ones((self.z.size, 1), dtype=np.complex128))
        return np.asarray(self.common[:, np.newaxis] * np.hstack(parts))

    def columns(self, poles: Poles) -> RealArray:
        """The same whitened, (2 F, B or B + 1)."""
        return self.whiten(self.responses(poles))


def prepare_response(
    response: FrequencyUncertainty, *, integrators: int, delay_samples: int, feedthrough: bool
) -> FrfRegression:
    """Whiten a measured response. Raises ValueError at a frequency without any uncertainty, or at omega = 0
    with integrators."""
    omega = response.omega_rad_s
    s1, s2, direction = standard_axes(response.covariance)
    turn = np.conj(direction)
    real_only = (omega == 0) | (omega >= np.pi / response.dt_s * (1 - 1e-9))
    turn[real_only] = 1.0
    s1 = np.where(real_only, np.sqrt(response.covariance[:, 0, 0]), s1)
    if not np.all(s1 > 0):
        at = omega[int(np.argmax(~(s1 > 0)))]
        raise ValueError(
            f"at omega = {at:.6g} rad/s the response is given as exactly known: a fit needs a covariance at "
            "every frequency, the smallest that is still honest"
        )
    across = 1 / np.maximum(s2, _THINNEST * s1)
    weight = np.stack([1 / s1, np.where(real_only, 0.0, across)])
    z = np.exp(1j * omega * response.dt_s)
    frame = FrfRegression(
        z=z,
        common=common_factor(omega, response.dt_s, integrators, delay_samples),
        turn=turn,
        weight=weight,
        y=np.zeros(2 * omega.size),
        feedthrough=feedthrough,
        dt_s=response.dt_s,
    )
    y = frame.whiten(response.centre[:, np.newaxis])[:, 0]
    return FrfRegression(z, frame.common, turn, weight, y, feedthrough, response.dt_s)


def common_factor(omega_rad_s: RealArray, dt_s: float, integrators: int, delay_samples: int) -> ComplexArray:
    """(z / (z - 1))^integrators z^-delay at omega (F,)."""
    alone = ResponsePosterior(  # a direct term of 1 and no poles: the known factor alone
        Poles(),
        np.ones(1),
        np.zeros((1, 1)),
        dt_s,
        has_feedthrough=True,
        integrators=integrators,
        input_delay_samples=delay_samples,
    )
    return alone.centre(omega_rad_s)


@dataclass(frozen=True, eq=False)
class FrfFit:
    """Weighted least-squares fit for given poles.

    coefficients (B,), direct term, fitted response (F,), whitened residual (2 F,) and its sum of squares;
    q (2 F, K): orthonormal columns of the fit.
    """

    coefficients: RealArray
    feedthrough: float
    response: ComplexArray
    residual: RealArray
    rss: float
    q: RealArray


def fit_response(data: FrfRegression, poles: Poles) -> FrfFit:
    """theta = R^-1 Q^T y by thin QR (27), on the whitened rows."""
    responses = data.responses(poles)
    q, triangle = np.linalg.qr(data.whiten(responses))
    projected = q.T @ data.y
    residual = data.y - q @ projected
    theta = np.linalg.lstsq(triangle, projected, rcond=_RANK_TOLERANCE)[0]
    return FrfFit(
        coefficients=np.asarray(theta[: poles.order], dtype=np.float64),
        feedthrough=float(theta[-1]) if data.feedthrough else 0.0,
        response=np.asarray(responses @ theta),
        residual=residual,
        rss=float(residual @ residual),
        q=q,
    )


def pole_directions(data: FrfRegression, poles: Poles, fit: FrfFit, n_real: int, n_pairs: int) -> RealArray:
    """Whitened sensitivities (2 F, R + 2 P) of the fit to (ln(1 - a); ln omega, ln zeta), coefficients
    re-fitted all the time.

    The first n_real and n_pairs poles are fixed and have no column. Modulo the columns of the fit, moving a
    pole changes the response G by -(dD_b / D_b) G, D_b the denominator of its block; what the columns explain
    is projected off (Kaufman). J changes by -2 r^T s.
    """
    z, g = data.z, fit.response
    parts = [-(1 - a) / (z - a) * g for a in poles.real[n_real:]]
    for p in poles.pairs[n_pairs:]:
        # D = z^2 - t z + h with t = 2 exp(-s) cos f, h = exp(-2 s); s = zeta omega, f = omega sqrt(1 -
        # zeta^2).
        s, f = -np.log(abs(p)), float(np.angle(p))
        by_s = (-2 * p.real * z + 2 * abs(p) ** 2) / ((z - p) * (z - np.conj(p))) * g
        by_f = -2 * p.imag * z / ((z - p) * (z - np.conj(p))) * g
        parts += [s * by_s + f * by_f, s * by_s - s**2 / f * by_f]
    if not parts:
        return np.zeros((2 * z.size, 0))
    rows = data.whiten(np.column_stack(parts))
    return rows - fit.q @ (fit.q.T @ rows)
