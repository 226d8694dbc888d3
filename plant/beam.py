"""Exact vibration modes of a uniform clamped-free link with a point mass at the tip.

Euler-Bernoulli: E I phi'''' = m omega^2 phi, phi(0) = phi'(0) = 0, phi''(L) = 0 and, because the tip mass
is part of the boundary condition, E I phi'''(L) = -mp omega^2 phi(L). With lambda = beta L and mu = mp / (m
L),

    1 + cos(lambda) cosh(lambda) + mu lambda (cos(lambda) sinh(lambda) - sin(lambda) cosh(lambda)) = 0.

Every hyperbolic function is written in exp(-lambda), so no mode number overflows. Shear and the rotary
inertia of the cross section are neglected.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BeamModes:
    """The first M modes, normalised to unit modal mass (tip mass included).

    wave_number_rad_m : (M,). beta, ascending.
    omega_rad_s : (M,). Natural frequencies with the root clamped.
    tip : (M,). phi(L), 1/sqrt(kg).
    coupling : (M,)
        int m (r + x) phi dx + mp (r + L) phi(L): inertial coupling to a rotation about the hub axis.
    first_moment : (M,). int m phi dx + mp phi(L): inertial coupling to a translation.
    length_m : float
    scale : (M,). Factor that turns cosh - cos - sigma (sinh - sin) into phi.
    """

    wave_number_rad_m: Real
    omega_rad_s: Real
    tip: Real
    coupling: Real
    first_moment: Real
    length_m: float
    scale: Real

    def shape(self, x_m: Real) -> Real:
        """phi (X, M) at the positions x (X,), 0 <= x <= L."""
        return self.scale * self._parts(x_m)[0]

    def slope(self, x_m: Real) -> Real:
        """phi' (X, M)."""
        return self.scale * self.wave_number_rad_m * self._parts(x_m)[1]

    def curvature(self, x_m: Real) -> Real:
        """phi'' (X, M)."""
        return self.scale * self.wave_number_rad_m**2 * self._parts(x_m)[2]

    def _parts(self, x_m: Real) -> tuple[Real, Real, Real]:
        if not np.all((x_m >= 0) & (x_m <= self.length_m * (1 + 1e-12))):
            raise ValueError(f"x is measured from the clamp and stops at {self.length_m} m")
        lam = self.wave_number_rad_m * self.length_m
        a = np.outer(x_m, self.wave_number_rad_m)
        # cosh a - sigma sinh a = exp(-a) + (1 - sigma) sinh a, and (1 - sigma) sinh a without overflow:
        e = np.exp(-lam)
        one_less_sigma = (np.sin(lam) - np.cos(lam) - e) / (1 - e * e + 2 * e * np.sin(lam))
        grow = one_less_sigma * np.exp(a - lam)
        shrink = one_less_sigma * np.exp(-a - lam)
        sigma = _sigma(lam)
        decay = np.exp(-a)
        hyperbolic = decay + grow - shrink  # cosh - sigma sinh
        odd = -decay + grow + shrink  # sinh - sigma cosh
        return (
            hyperbolic - np.cos(a) + sigma * np.sin(a),
            odd + np.sin(a) + sigma * np.cos(a),
            hyperbolic + np.cos(a) - sigma * np.sin(a),
        )


@lru_cache(maxsize=256)
def clamped_free_modes(
    bending_stiffness_Nm2: float,
    mass_per_length_kg_m: float,
    length_m: float,
    n_modes: int,
    tip_mass_kg: float = 0.0,
    radius_m: float = 0.0,
) -> BeamModes:
    """The first n_modes modes of the link, root clamped at the distance radius_m from the hub axis.

    Raises ValueError if stiffness, mass or length is not positive, tip mass or radius negative, or n_modes <
    1.
    """
    positive = bending_stiffness_Nm2, mass_per_length_kg_m, length_m
    if not all(0 < value < np.inf for value in positive):
        raise ValueError(f"stiffness, mass and length must be positive; got {positive}")
    if not (0 <= tip_mass_kg < np.inf and 0 <= radius_m < np.inf):
        raise ValueError(f"tip mass and radius must not be negative; got {tip_mass_kg} and {radius_m}")
    if n_modes < 1:
        raise ValueError(f"need at least one mode; got {n_modes}")
    m, length = mass_per_length_kg_m, length_m
    mu = tip_mass_kg / (m * length)
    lam = np.array([_root(k, mu) for k in range(n_modes)])
    beta = lam / length
    sech = 2 * np.exp(-lam) / (1 + np.exp(-2 * lam))
    tanh = np.tanh(lam)
    denominator = tanh + np.sin(lam) * sech
    end = 2 * (np.sin(lam) - np.cos(lam) * tanh) / denominator
    end_slope = 2 * beta * tanh * np.sin(lam) / denominator
    # 4 beta^4 int phi^2 = [3 phi phi''' - phi' phi'' + x (beta^4 phi^2 - 2 phi' phi''' + phi''^2)] from 0
    # to L: the bracket's derivative is 4 beta^4 phi^2 for every solution of the beam equation, its ends are
    # boundary conditions.
    square = 0.25 * length * (end**2 * (1 - 3 * mu) + 2 * mu * length * end_slope * end)
    scale = 1 / np.sqrt(m * square + tip_mass_kg * end**2)
    # Twice by parts: int m (r + x) phi dx + mp (r + L) phi(L) = (m / beta^4) (phi''(0) - r phi'''(0)).
    moment = 2 * m * scale / beta**2
    force = 2 * m * scale * _sigma(lam) / beta
    modes = BeamModes(
        wave_number_rad_m=beta,
        omega_rad_s=beta**2 * np.sqrt(bending_stiffness_Nm2 / m),
        tip=scale * end,
        coupling=moment + radius_m * force,
        first_moment=force,
        length_m=length,
        scale=scale,
    )
    for array in (beta, modes.omega_rad_s, modes.tip, modes.coupling, modes.first_moment, scale):
        array.setflags(write=False)  # one object serves every caller
    return modes


def _sigma(lam: Real) -> Real:
    e = np.exp(-lam)
    return np.asarray((1 + e * e + 2 * e * np.cos(lam)) / (1 - e * e + 2 * e * np.sin(lam)))


@lru_cache(maxsize=4096)
def _root(k: int, mu: float) -> float:
    """Root k of the frequency equation divided by cosh: exactly one lies in (k pi, (k + 1) pi)."""

    def characteristic(x: float) -> float:
        sech = 2 * np.exp(-x) / (1 + np.exp(-2 * x))
        return float(sech + np.cos(x) + mu * x * (np.cos(x) * np.tanh(x) - np.sin(x)))

    from scipy.optimize import brentq  # here: every command would wait for it

    return float(brentq(characteristic, max(k * np.pi, 1e-6), (k + 1) * np.pi, xtol=1e-14, rtol=1e-14))
