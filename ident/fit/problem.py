"""What search, order selection and refinement ask of data, whatever kind of data it is.

A pole search needs the cost at given poles, coefficients and nuisances re-fitted (`CandidateCost`); a local
refinement needs how it changes with the poles (`Linearisation`); an order selection needs how much a residual
is worth (`ResidualColour`, `criterion`). `PoleProblem` lists these questions; records of one or several
outputs and measured frequency responses answer them (`ident.fit.least_squares.Regression`,
`ident.fit.several_outputs.OutputRegressions`, `ident.fit.frf_regression.FrfRegression`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
from scipy.fft import next_fast_len
from scipy.special import chdtri

from ident.basis.coordinates import SearchSpace
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, IntArray, RealArray, kernel_array
from ident.data.finding import TEST_LEVEL, WHITE_LAGS

# Share of |y|^2 below which products of columns, rounded to 1e-15 of it and summed, know nothing of a
# residual: the logarithm that DIRECT sees ends here. A refinement sees the true residual.
_FLOOR = 1e-13
# Most lags whose autocorrelation says how much a residual is worth. Chosen: what a model leaves is forgotten
# within 200 samples unless it is a drift, and more lags add the scatter of what is none.
_MOST_LAGS = 200

# Samples of the shortest record per lag: an autocorrelation is known to one over the root of the number of
# its products, of which so nine tenths are there at the last lag. Chosen. Its product with `WHITE_LAGS` is
# the shortest record in which a residual can count as white, 250 samples.
_SAMPLES_PER_LAG = 10


class Linearisation(NamedTuple):
    """How the residual sum of squares rss changes with the poles, coefficients re-fitted all the time.

    Directions S (N, B): the states of each block driven by the fitted output (one per real pole, two per
    pair), projected off the regression; r (N,): the residual.

    Attributes
    ----------
    rss : float
        J = |r|^2.
    normal : ndarray, shape (B, B)
        S^T S, the Gauss-Newton (Kaufman) Hessian. Empty, or not filled, where rss was not below what the
        caller had asked for (`below`).
    gradient : ndarray, shape (B,)
        S^T r; where normal is.
    """

    rss: float
    normal: RealArray
    gradient: RealArray


class CandidateCost:
    """Residual sum of squares J over the unit cube of a search space, with other poles frozen.

    It counts how often it was asked (`evaluations`). Points are not checked.
    """

    def __init__(
        self,
        space: SearchSpace,
        power: float,
        one: Callable[[RealArray], float],
        many: Callable[[RealArray], RealArray] | None = None,
    ) -> None:
        """Cost over `space`.

        Parameters
        ----------
        space : SearchSpace
            What a point of the cube stands for.
        power : float
            |y|^2, in the unit of J; of zero `log` fails for a J of zero.
        one : callable
            J at a point (D,).
        many : callable, optional
            J (E,) at points (E, D), where that is faster than one by one. Nothing is checked here.
        """
        self.space = space
        self.evaluations = 0
        self._one = one
        self._many = many
        self._floor = _FLOOR * power

    def rss(self, units: RealArray) -> RealArray:
        """Residual sums of squares (E,) at points (E, D) of the unit cube, in the unit of `power`.

        A point outside the cube, or of another D, is not refused: its value means nothing.
        """
        self.evaluations += len(units)
        if self._many is not None:
            return self._many(units)
        # One by one: compiled code takes a contiguous, writable point.
        return np.array([self._one(unit) for unit in kernel_array(units)])

    def at(self, unit: RealArray) -> float:
        """Residual sum of squares at a point (D,) of the unit cube; as `rss`, nothing is checked.

        The point has to be contiguous and writable, as compiled code takes it.
        """
        self.evaluations += 1
        return self._one(unit)

    def log(self, unit: RealArray) -> float:
        """Logarithm of J at a point (D,), as DIRECT sees it: never below that of rounding, `_FLOOR` |y|^2.

        A J of NaN stays NaN; where J and |y|^2 are both zero, ValueError of the logarithm.
        """
        return math.log(max(self.at(unit), self._floor))


class Linearised(Protocol):
    """Cost of poles and its change: what a local refinement needs of a `PoleProblem`; a protocol as that."""

    @property
    def power(self) -> float:
        """Square sum |y|^2 of the data without the part of constants and the like."""

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and linearisation (B = R + 2 P) at real poles (R,) and pairs (P,), the poles above the axis.

        Only the cost counts where it is not under `below`: the caller then drops the rest. A refinement asks
        for poles inside the circle alone; what others do is the implementation's.
        """


class PoleProblem(Linearised, Protocol):
    """A least-squares problem, linear in everything but the poles.

    A protocol: the classes of the module text answer, and say what they make of bad input.
    """

    @property
    def dt_s(self) -> float:
        """Sampling time, s."""

    @property
    def omega_max_rad_s(self) -> float | None:
        """Largest frequency at which the data could show a pair, rad/s; None: up to the Nyquist frequency."""

    @property
    def longest(self) -> int:
        """Number of samples of the longest record: slower poles cannot be told from one on the circle."""

    @property
    def n_samples(self) -> int:
        """Number of real numbers that were measured."""

    def n_parameters(self, order: int) -> int:
        """Free real numbers of a fit with `order` poles (at least 0): coefficients, poles, nuisances."""

    def residual(self, poles: Poles) -> RealArray:
        """Residual (N,) that the fit with these poles leaves of the data, in their unit."""

    def colour(self, residual: RealArray) -> ResidualColour:
        """Whiteness of a residual (N,) of `residual`, and how many independent numbers it is worth."""

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles: `shared` behind the input, `local` in free responses.

        space: the box of the candidates, R real poles and P pairs, D = R + 2 P numbers a point.
        """

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """Criterion (J, order) -> number, lower is better.

        A model with J = rss and this order, whose residual is worth `worth` independent numbers, tells the
        noise; every model is then judged by the same criterion.
        """


@dataclass(frozen=True)
class ResidualColour:
    """What the autocorrelation of a residual says.

    Attributes
    ----------
    effective_samples : float
        Independent samples it is worth, N / (1 + 2 sum (rho_k^2 - 1/N)) over lags to 200 or a tenth of the
        shortest record (Bartlett; 1/N is what white noise has by chance): by that factor colour widens the
        scatter of J.
    white : bool
        Autocorrelations at lags 1 .. 25 (`WHITE_LAGS`) are no larger, all together, than those of white noise
        99 times in 100 (`TEST_LEVEL`; Box and Pierce); never so where a record has less than 250 samples, ten
        a lag.
    """

    effective_samples: float
    white: bool


def residual_colour(residual: RealArray, starts: IntArray) -> ResidualColour:
    """Colour of a residual.

    Parameters
    ----------
    residual : ndarray, shape (N,)
        Residuals of all records, one after the other.
    starts : ndarray of int, shape (K + 1,)
        Where the records begin, and N; a record has at least one sample (numpy's ValueError else).

    Returns
    -------
    ResidualColour
        Of a residual of zeros, or with NaN: N samples, not white.
    """
    n = residual.size
    shortest = int(np.min(np.diff(starts)))
    lags = min(_MOST_LAGS, shortest // _SAMPLES_PER_LAG)

    # Autocovariances of all records, summed, by the squared spectrum of each.
    covariance = np.zeros(lags + 1)
    for lo, hi in pairwise(starts):
        part = residual[lo:hi]
        # So long that no lag up to there wraps around.
        size = next_fast_len(part.size + lags, real=True)
        spectrum = np.fft.rfft(part, size)
        covariance += np.fft.irfft(np.abs(spectrum) ** 2, size)[: lags + 1]
    if not covariance[0] > 0:
        return ResidualColour(float(n), False)

    # What white noise shows by chance, 1/N per lag, is no colour.
    squares = (covariance[1:] / covariance[0]) ** 2
    colour = np.sum(np.maximum(squares - 1 / n, 0.0))
    effective_samples = float(n / (1 + 2 * colour))

    first_squares = squares[:WHITE_LAGS]
    white = False
    if first_squares.size == WHITE_LAGS:
        statistic = n * np.sum(first_squares)
        white = bool(statistic < chdtri(first_squares.size, 1 - TEST_LEVEL))
    return ResidualColour(effective_samples, white)
