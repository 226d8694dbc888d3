"""Transfer functions and zeros, poles, gain in z as state spaces that rounding does not spoil.

One companion form of a whole transfer function squares its rounding errors: of slow poles that lie close
together (two integrators beside a slow mode) it keeps no digit. Here the function is split into sections of
first and second order, which follow one another in series. `of_polynomials` takes coefficients, finds the
poles at exactly one (integrators) and calls `of_roots`, which builds the sections.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import control


def of_polynomials(numerator: npt.ArrayLike, denominator: npt.ArrayLike, dt_s: float) -> control.StateSpace:
    """State space of numerator(z)/denominator(z), built from sections of first and second order.

    Parameters
    ----------
    numerator, denominator : array_like
        Real coefficients of z, highest power first; leading zeros are dropped.
    dt_s : float
        Sampling period in seconds.

    Returns
    -------
    control.StateSpace
        One input, one output. Poles within rounding of z = 1 are integrators, exactly at one.

    Raises
    ------
    ValueError
        If there are more zeros than poles. A nan is LinAlgError of numpy. A numerator of zeros alone gives a
        system that answers nothing.
    """
    import control  # here, because it brings a plotting library with it

    zeros_polynomial = np.trim_zeros(np.atleast_1d(numerator), "f")
    poles_polynomial = np.trim_zeros(np.atleast_1d(denominator), "f")
    if zeros_polynomial.size > poles_polynomial.size:
        raise ValueError(
            "has more zeros than poles, so it answers before it is asked: expected as many poles, "
            "control.tf(num, den, dt_s) with num no longer than den"
        )
    if not zeros_polynomial.size:
        return control.ss([], [], [], 0.0, dt_s)
    # A polynomial whose coefficients add up to rounding has a root at one that they cannot tell from one;
    # the running sums are what is left when that root is divided out.
    n_integrators = 0
    remaining = poles_polynomial
    while remaining.size > 1:
        # Rounding of a sum of so many terms: one unit of the last digit each.
        rounding = remaining.size * np.finfo(float).eps * np.sum(np.abs(remaining))
        # Also where a coefficient is nan: the roots then refuse it.
        if not abs(np.sum(remaining)) <= rounding:
            break
        n_integrators += 1
        remaining = np.cumsum(remaining)[:-1]
    poles = np.append(np.roots(remaining), np.ones(n_integrators))
    gain = zeros_polynomial[0] / poles_polynomial[0]
    return of_roots(np.roots(zeros_polynomial), poles, gain, dt_s)


def of_roots(zeros: npt.ArrayLike, poles: npt.ArrayLike, gain: float, dt_s: float) -> control.StateSpace:
    """State space of gain prod(z - zeros)/prod(z - poles), sections of first and second order in series.

    Parameters
    ----------
    zeros, poles : array_like
        Complex; of a conjugate pair both are given. No more zeros than poles (not checked).
    gain : float
        Factor before the products.
    dt_s : float
        Sampling period in seconds.

    Returns
    -------
    control.StateSpace
        One input, one output, as many states as poles.

    Raises
    ------
    ValueError
        By `zip`, where there are more factors of zeros than of poles. A complex root without its conjugate is
        not seen: it counts as a pair in the upper half plane, and is left out in the lower one.
    """
    import control  # here, because it brings a plotting library with it

    denominators = _factors(np.atleast_1d(poles))
    numerators = _factors(np.atleast_1d(zeros))
    # Sections without a zero of their own have the numerator 1.
    numerators += [np.ones(1)] * (len(denominators) - len(numerators))
    series = control.ss([], [], [], gain, dt_s)
    for zero_factor, pole_factor in zip(numerators, denominators, strict=True):
        section = control.tf2ss(control.tf(zero_factor, pole_factor, dt_s))
        series = control.series(series, section)
    return series


def _factors(roots: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """Real polynomials (3,) or (2,), highest power first, whose product has the roots (N,).

    Conjugate pairs come first, one polynomial each; real roots follow two by two from the largest on, and the
    last one alone where their number is odd.

    A root of the lower half plane alone is left out, one of the upper half gets a conjugate; nothing is
    checked.
    """
    factors = []
    upper_half_plane = roots.imag > 0
    for root in roots[upper_half_plane]:
        factors.append(np.poly([root, root.conj()]).real)
    is_real = roots.imag == 0
    real_roots = np.sort(roots[is_real].real)[::-1]
    for start in range(0, real_roots.size, 2):
        factors.append(np.poly(real_roots[start : start + 2]))
    return factors
