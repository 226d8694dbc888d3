"""Ritz basis of an inextensible elastica that is clamped at one end, in its angle instead of its deflection.

phi(x) = alpha + sum_i q_i P_i(x) is the absolute direction of the centre line; the position follows by
integration of (cos phi, sin phi). Strain and damping energy are exactly quadratic in phi', so all geometric
nonlinearity sits in the kinetic energy. This is the truth of the blind protocol and shares nothing with
`plant`, which uses the linear beam's transverse eigenfunctions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.linalg import eigh

Real = npt.NDArray[np.float64]

# Polynomials of the Ritz basis, of degree 1 to 10.
_POLYNOMIALS = 10
# Gauss points: products of two polynomials are integrated exactly.
_POINTS = 13


@dataclass(frozen=True, eq=False)
class LinkBasis:
    """Modes of the clamped link with its tip mass, sampled at Gauss points.

    angle : (G, M). P_i at the Gauss points; mass-normalised.
    integral : (G + 1, G). Row g integrates a function given at the Gauss points from the clamp to point g;
        the last row to the tip.
    weights_m : (G,). Quadrature weights over the length.
    stiffness : (M,). Squared natural frequencies [rad^2/s^2] of the clamped link.
    tip_angle : (M,). P_i at the tip.
    """

    angle: Real
    integral: Real
    weights_m: Real
    stiffness: Real
    tip_angle: Real


@cache
def _polynomials() -> tuple[Real, Real, Real, Real]:
    """On (-1, 1): integral (G + 1, G), weights (G,), angles (G, N), and (G,) from the points to the tip."""
    nodes, weights = legendre.leggauss(_POINTS)
    integral = np.empty((_POINTS + 1, _POINTS))
    to_series = np.linalg.inv(legendre.legvander(nodes, _POINTS - 1))
    for h in range(_POINTS):
        antiderivative = legendre.legint(to_series[:, h], lbnd=-1.0)
        integral[:_POINTS, h] = legendre.legval(nodes, antiderivative)
    integral[_POINTS] = weights
    angles = np.empty((_POINTS, _POLYNOMIALS))
    for k in range(_POLYNOMIALS):
        series = np.zeros(k + 1)
        series[k] = 1.0
        angles[:, k] = legendre.legval(nodes, legendre.legint(series, lbnd=-1.0))
    return integral, weights, angles, legendre.legvander(np.ones(1), _POINTS - 1)[0] @ to_series


def link_basis(
    length_m: float,
    bending_stiffness_Nm2: float,
    mass_per_length_kg_m: float,
    tip_mass_kg: float,
    n_modes: int,
) -> LinkBasis:
    """Polynomials of degree 1 to 10 that vanish at the clamp, reduced to the lowest n_modes modes.

    Their derivatives are Legendre polynomials, so that the stiffness is diagonal; the free end's natural
    conditions are met in the limit. Neglected: extension, shear, rotary inertia of the section.
    """
    if not 1 <= n_modes <= _POLYNOMIALS - 3:
        raise ValueError(f"n_modes must be 1..{_POLYNOMIALS - 3}; got {n_modes}")
    unit_integral, weights, unit_angles, to_tip = _polynomials()
    integral = 0.5 * length_m * unit_integral
    angles = 0.5 * length_m * unit_angles
    stiffness = np.diag(bending_stiffness_Nm2 * length_m / (2 * np.arange(_POLYNOMIALS) + 1))
    deflection = integral @ angles
    lumps = mass_per_length_kg_m * 0.5 * length_m * np.append(weights, 0.0)
    lumps[-1] = tip_mass_kg
    mass = deflection.T @ (lumps[:, None] * deflection)
    squares, shapes = eigh(stiffness, mass)
    # Polynomials of degree 12 at most: the Gauss points determine them at the tip.
    modes = angles @ shapes[:, :n_modes]
    return LinkBasis(
        modes,
        integral,
        0.5 * length_m * weights,
        np.asarray(squares[:n_modes]),
        to_tip @ modes,
    )
