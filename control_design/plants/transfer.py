"""Transfer functions and zeros, poles, gain in z as state spaces that rounding does not spoil."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import numpy.typing as npt


def of_polynomials(numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt_s: float) -> control.StateSpace:
    """numerator(z)/denominator(z), highest power first, as of `of_roots`. Raises ValueError for more zeros
    than poles."""
    above, below = (np.trim_zeros(np.atleast_1d(part), "f") for part in (numerator, denominator))
    if above.size > below.size:
        raise ValueError(
            "has more zeros than poles, so it answers before it is asked: expected as many poles, "
            "control.tf(num, den, dt_s) with num no longer than den"
        )
    if not above.size:
        return control.ss([], [], [], 0.0, dt_s)
    # Poles that the rounding of coefficients cannot tell from one are one.
    integrators, rest = 0, below
    while rest.size > 1 and abs(np.sum(rest)) <= rest.size * np.finfo(float).eps * np.sum(np.abs(rest)):
        integrators, rest = integrators + 1, np.cumsum(rest)[:-1]
    poles = np.append(np.roots(rest), np.ones(integrators))
    return of_roots(np.roots(above), poles, above[0] / below[0], dt_s)


def of_roots(zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float, dt_s: float) -> control.StateSpace:
    """gain prod(z - zeros)/prod(z - poles) as sections of first and second order in a row: of slow poles that
    are close together one companion form leaves nothing but rounding. Of a conjugate pair both are given, and
    there are no more zeros than poles."""
    below, above = _factors(np.atleast_1d(poles)), _factors(np.atleast_1d(zeros))
    above += [np.ones(1)] * (len(below) - len(above))
    found = control.ss([], [], [], gain, dt_s)
    for pole, zero in zip(below, above, strict=True):
        found = control.series(found, control.tf2ss(control.tf(zero, pole, dt_s)))
    return found


def _factors(roots: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """Factors of second order and, of an odd number of roots, one of first order."""
    real = np.sort(roots[roots.imag == 0].real)[::-1]
    pairs = [np.poly([root, root.conj()]).real for root in roots[roots.imag > 0]]
    return pairs + [np.poly(real[at : at + 2]) for at in range(0, real.size, 2)]
