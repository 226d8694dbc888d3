"""Stable monic polynomials in a box: products of second-order sections, each in its stability triangle."""

from __future__ import annotations

import numpy as np

from ident.data.arrays import RealArray

LARGEST = 1 - 1e-9
"""Bound of the coordinates; at 1 a root would lie on the unit circle."""


def stabilised(polynomial: RealArray) -> RealArray:
    """The monic polynomial in q^-1 with every root outside the unit circle mirrored into it."""
    if polynomial.size == 1:
        return polynomial
    roots = np.roots(polynomial)
    radius = np.abs(roots)
    outside = radius > LARGEST
    if not np.any(outside):
        return polynomial
    roots[outside] *= np.minimum(1 / radius[outside], LARGEST) / radius[outside]
    inside = np.real(np.poly(roots))
    # np.roots leaves out trailing zero coefficients: those are roots at 0, which stay.
    return np.concatenate([inside, np.zeros(polynomial.size - inside.size)])


def to_sections(polynomial: RealArray) -> RealArray:
    """Coordinates (n,) of the stabilised monic polynomial (n + 1,): (s, t) per section, last p if n is odd.

    A section is 1 + s (1 + t) q^-1 + t q^-2, stable exactly for |s| < 1 and |t| < 1; p is 1 + p q^-1.
    """
    order = polynomial.size - 1
    roots = np.roots(polynomial)
    roots = np.concatenate([roots, np.zeros(order - roots.size)])
    outside = np.abs(roots) > LARGEST
    roots[outside] = LARGEST**2 / np.conj(roots[outside])
    pairs = roots[roots.imag > 0]
    # Sorted, so that the two that may meet and become a pair share a section.
    real = np.sort(roots[roots.imag == 0].real)[::-1]
    sums = [*(-2 * pairs.real), *(-(real[:-1:2] + real[1::2]))]
    products = [*np.abs(pairs) ** 2, *(real[:-1:2] * real[1::2])]
    coordinates = [item for s, t in zip(sums, products, strict=True) for item in (s / (1 + t), t)]
    if order % 2:
        coordinates.append(-real[-1])
    return np.asarray(np.clip(coordinates, -LARGEST, LARGEST), dtype=np.float64)


def _factors(coordinates: RealArray) -> list[RealArray]:
    even = coordinates.size - coordinates.size % 2
    factors = [np.array([1.0, s * (1 + t), t]) for s, t in coordinates[:even].reshape(-1, 2)]
    return factors + [np.array([1.0, p]) for p in coordinates[even:]]


def from_sections(coordinates: RealArray) -> RealArray:
    """Monic polynomial (n + 1,) of coordinates (n,)."""
    product = np.ones(1)
    for factor in _factors(coordinates):
        product = np.convolve(product, factor)
    return product


def sections_derivative(coordinates: RealArray) -> RealArray:
    """d(coefficients of q^-1 .. q^-n)/d(coordinates) (n, n)."""
    n = coordinates.size
    factors = _factors(coordinates)
    derivative = np.zeros((n, n))
    for i in range(len(factors)):
        others = np.ones(1)
        for j, factor in enumerate(factors):
            if j != i:
                others = np.convolve(others, factor)
        if factors[i].size == 2:
            derivative[:, 2 * i] = others
        else:
            s, t = coordinates[2 * i : 2 * i + 2]
            derivative[:, 2 * i] = np.convolve(others, [1 + t, 0])
            derivative[:, 2 * i + 1] = np.convolve(others, [s, 1])
    return derivative
