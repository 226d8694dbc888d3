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


# Rounding of a position that is meant as the tip, relative.
_ROUNDING = 1e-12
# Lower end of the first root's interval, where the frequency equation is not to be asked at zero: without a
# tip mass the root is 1.875, and it falls below this only for tip masses of 1e24 links.
_SMALLEST_ROOT = 1e-6


@dataclass(frozen=True, eq=False)
class BeamModes:
    """The first M modes of a link, normalised to unit modal mass (tip mass included).

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
        """Mode shapes phi (X, M), 1/sqrt(kg), at the positions x (X,), 0 <= x <= L.

        Raises ValueError for a position outside the link, as do `slope` and `curvature`.
        """
        return self.scale * self._parts(x_m)[0]

    def slope(self, x_m: Real) -> Real:
        """Slopes phi' (X, M) at the positions x (X,)."""
        return self.scale * self.wave_number_rad_m * self._parts(x_m)[1]

    def curvature(self, x_m: Real) -> Real:
        """Curvatures phi'' (X, M) at the positions x (X,)."""
        return self.scale * self.wave_number_rad_m**2 * self._parts(x_m)[2]

    def _parts(self, x_m: Real) -> tuple[Real, Real, Real]:
        """Shape, first and second derivative (X, M) without the factors scale and wave number.

        They are cosh a - cos a - sigma (sinh a - sin a) with a = beta x, and its derivatives by a.
        """
        last_m = self.length_m * (1 + _ROUNDING)
        is_on_link = np.logical_and(x_m >= 0, x_m <= last_m)
        if not np.all(is_on_link):
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
        shape = hyperbolic - np.cos(a) + sigma * np.sin(a)
        slope = odd + np.sin(a) + sigma * np.cos(a)
        curvature = hyperbolic + np.cos(a) - sigma * np.sin(a)
        return shape, slope, curvature


@lru_cache(maxsize=256)
def clamped_free_modes(
    bending_stiffness_Nm2: float,
    mass_per_length_kg_m: float,
    length_m: float,
    n_modes: int,
    tip_mass_kg: float = 0.0,
    radius_m: float = 0.0,
) -> BeamModes:
    """The first n_modes modes of a link whose root is clamped at the distance radius_m from the hub axis.

    Parameters
    ----------
    bending_stiffness_Nm2, mass_per_length_kg_m, length_m : float
        E I, m and L of the link.
    n_modes : int
        Number of modes.
    tip_mass_kg : float
        Point mass at the tip.
    radius_m : float
        Distance of the root from the hub axis; it enters the inertial coupling alone.

    Returns
    -------
    BeamModes
        Arrays (n_modes,), read-only.

    Raises
    ------
    ValueError
        Stiffness, mass or length is not positive, tip mass or radius is negative, or n_modes < 1.
    """
    positive = bending_stiffness_Nm2, mass_per_length_kg_m, length_m
    if not all(0 < value < np.inf for value in positive):
        raise ValueError(f"stiffness, mass and length must be positive; got {positive}")
    if not (0 <= tip_mass_kg < np.inf and 0 <= radius_m < np.inf):
        raise ValueError(f"tip mass and radius must not be negative; got {tip_mass_kg} and {radius_m}")
    if n_modes < 1:
        raise ValueError(f"need at least one mode; got {n_modes}")
    m = mass_per_length_kg_m
    length = length_m
    mu = tip_mass_kg / (m * length)
    lam = np.array([_root(k, mu) for k in range(n_modes)])
    beta = lam / length
    # Deflection and slope at the tip, before scaling, divided by cosh above and below the line.
    sech = 2 * np.exp(-lam) / (1 + np.exp(-2 * lam))
    tanh = np.tanh(lam)
    denominator = tanh + np.sin(lam) * sech
    end = 2 * (np.sin(lam) - np.cos(lam) * tanh) / denominator
    end_slope = 2 * beta * tanh * np.sin(lam) / denominator
    # 4 beta^4 int phi^2 = [3 phi phi''' - phi' phi'' + x (beta^4 phi^2 - 2 phi' phi''' + phi''^2)] from 0
    # to L: the bracket's derivative is 4 beta^4 phi^2 for every solution of the beam equation, its ends are
    # boundary conditions.
    bracket = end**2 * (1 - 3 * mu) + 2 * mu * length * end_slope * end
    square = 0.25 * length * bracket
    modal_mass = m * square + tip_mass_kg * end**2
    scale = 1 / np.sqrt(modal_mass)
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
    """Ratio sigma (M,) = (cosh + cos) / (sinh + sin) of lambda (M,), by which phi'' vanishes at the tip."""
    e = np.exp(-lam)
    numerator = 1 + e * e + 2 * e * np.cos(lam)
    denominator = 1 - e * e + 2 * e * np.sin(lam)
    return np.asarray(numerator / denominator)


@lru_cache(maxsize=4096)
def _root(k: int, mu: float) -> float:
    """Root k = 0, 1, ... of the frequency equation for the ratio mu of tip mass to link mass.

    Exactly one lies in (k pi, (k + 1) pi). The equation is divided by cosh, so that no term overflows.
    """

    def characteristic(x: float) -> float:
        """Frequency equation over cosh at lambda = x."""
        sech = 2 * np.exp(-x) / (1 + np.exp(-2 * x))
        from_tip_mass = mu * x * (np.cos(x) * np.tanh(x) - np.sin(x))
        return float(sech + np.cos(x) + from_tip_mass)

    from scipy.optimize import brentq  # here: every command would wait for it

    low = max(k * np.pi, _SMALLEST_ROOT)
    high = (k + 1) * np.pi
    # To rounding.
    return float(brentq(characteristic, low, high, xtol=1e-14, rtol=1e-14))
