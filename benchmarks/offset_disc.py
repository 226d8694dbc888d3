"""The disc around a low-order nominal model that holds the truth at a level, to compare ellipses with."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import chi2_radius, standard_axes

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(120)


def offset_disc_radius(offset: ComplexArray, covariance: RealArray, level: float) -> RealArray:
    """rho (F,) with P(|offset + e| <= rho) = level for e ~ N(0, covariance), per frequency.

    This is the additive weight of a low-order nominal model (design 4.5): offset (F,) = posterior centre
    minus nominal response, covariance (F,2,2) that of (Re, Im). Solved by bisection on the exact probability
    (one Gauss-Legendre integral over the minor axis, the major one in closed form); relative accuracy about
    1e-6.
    """
    if not 0 < level < 1:
        raise ValueError(f"a confidence level lies between 0 and 1; got {level}")
    offset = np.asarray(offset, dtype=np.complex128)
    if offset.ndim != 1 or covariance.shape != (offset.size, 2, 2):
        raise ValueError(
            f"need (F,) offsets and (F,2,2) covariances; got {offset.shape} and {covariance.shape}"
        )
    if not (np.all(np.isfinite(offset)) and np.all(np.isfinite(covariance))):
        raise ValueError("offsets and covariances must be finite")
    s1, s2, u1 = standard_axes(np.asarray(covariance, dtype=np.float64))
    size = np.abs(offset) + s1
    unit = np.where(size > 0, size, 1.0)
    # Axes below 1e-9 of the whole change nothing in rho beyond that and would make the integrand a step.
    m = np.abs((offset * np.conj(u1)).real) / unit, np.abs((offset * np.conj(u1)).imag) / unit
    a, b = np.maximum(s1 / unit, 1e-9), np.maximum(s2 / unit, 1e-9)
    low, high = np.zeros_like(a), np.hypot(*m) + a * (chi2_radius(level) + 1.0)
    for _ in range(48):
        middle = 0.5 * (low + high)
        below = _disc_probability(middle, m[0], m[1], a, b) < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high) * unit)


def _disc_probability(
    rho: RealArray, m1: RealArray, m2: RealArray, s1: RealArray, s2: RealArray
) -> RealArray:
    """P(x1^2 + x2^2 <= rho^2), x1 ~ N(m1, s1^2), x2 ~ N(m2, s2^2) independent; all (F,)."""
    # x2 = rho sin t removes the square-root ends of the disc; only +-9 sigma of x2 carry weight.
    first = np.arcsin(np.clip((m2 - 9 * s2) / rho, -1.0, 1.0))
    last = np.arcsin(np.clip((m2 + 9 * s2) / rho, -1.0, 1.0))
    half = 0.5 * (last - first)
    t = 0.5 * (first + last)[:, None] + half[:, None] * _NODES
    chord = rho[:, None] * np.cos(t)
    score = np.clip((rho[:, None] * np.sin(t) - m2[:, None]) / s2[:, None], -38.0, 38.0)
    density = np.exp(-0.5 * score**2) / (np.sqrt(2 * np.pi) * s2[:, None])
    inside = ndtr((chord - m1[:, None]) / s1[:, None]) - ndtr((-chord - m1[:, None]) / s1[:, None])
    return np.asarray(half * np.sum(_WEIGHTS * density * inside * chord, axis=1))
