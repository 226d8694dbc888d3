"""Quantiles and tails of the distributions that tests and intervals here are made of.

`scipy.stats` has them under one roof and takes longer to load than a model takes to identify; these are the
functions of `scipy.special` behind it, to the same digit, under names that say what they return.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.special

from ident.data.arrays import RealArray

# All numbers here are doubles, of which the types of scipy.special want to be told at each call.
_SPECIAL: Any = scipy.special


def chi_square_quantile(probability: npt.ArrayLike, freedom: npt.ArrayLike) -> RealArray:
    """Return below what chi-square numbers of so many degrees of freedom stay with this probability.

    Arrays of any shape, a number for numbers; nan without a degree of freedom and outside 0 to 1.
    """
    quantile: RealArray = 2 * _SPECIAL.gammaincinv(_positive(freedom) / 2, probability)
    return quantile


def chi_square_tail(value: npt.ArrayLike, freedom: npt.ArrayLike) -> RealArray:
    """Return the probability of a larger chi-square number; nan without a degree of freedom.

    Arrays of any shape, a number for numbers; 1 below zero.
    """
    tail: RealArray = _SPECIAL.chdtrc(_positive(freedom), value)
    return tail


def normal_quantile(probability: npt.ArrayLike) -> RealArray:
    """Return below what standard normal numbers stay with this probability.

    Of any shape; nan outside 0 to 1.
    """
    quantile: RealArray = _SPECIAL.ndtri(probability)
    return quantile


def normal_tail(value: npt.ArrayLike) -> RealArray:
    """Return the probability of a larger standard normal number; of any shape."""
    tail: RealArray = _SPECIAL.ndtr(np.negative(value))
    return tail


def student_quantile(probability: npt.ArrayLike, freedom: npt.ArrayLike) -> RealArray:
    """Return below what Student's t of so many degrees of freedom stays with this probability.

    Of any shape, probabilities between 0 and 1 alone; nan without a degree of freedom.
    """
    quantile: RealArray = _SPECIAL.stdtrit(_positive(freedom), probability)
    return quantile


def student_tail(value: npt.ArrayLike, freedom: npt.ArrayLike) -> RealArray:
    """Return the probability of a larger Student's t; of any shape, nan without a degree of freedom."""
    tail: RealArray = _SPECIAL.stdtr(_positive(freedom), np.negative(value))
    return tail


def fisher_tail(value: npt.ArrayLike, above: npt.ArrayLike, below: npt.ArrayLike) -> RealArray:
    """Return the probability of a larger F, from zero on, of so many degrees of freedom above and below the
    line; of any shape, nan without one."""
    tail: RealArray = _SPECIAL.fdtrc(_positive(above), _positive(below), value)
    return tail


def _positive(freedom: npt.ArrayLike) -> RealArray:
    """Degrees of freedom, nan where there are none."""
    given = np.asarray(freedom, dtype=np.float64)
    return np.where(given > 0, given, np.nan)
