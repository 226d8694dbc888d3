"""What search, order selection and local refinement ask of the data: the cost at given poles, coefficients
and nuisances re-fitted, and its change; and how much a residual is worth."""

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

# Below this share of |y|^2 products of columns know nothing; a refinement sees the true residual.
_FLOOR = 1e-13


class Linearisation(NamedTuple):
    """How the residual sum of squares rss changes with the poles, coefficients re-fitted all the time.

    Directions S: the states of each block driven by the fitted output (one per real pole, two per pair),
    projected off the regression. normal (B, B) = S^T S, the Gauss-Newton (Kaufman) Hessian; gradient (B,) =
    S^T r.
    """

    rss: float
    normal: RealArray
    gradient: RealArray


class CandidateCost:
    """Residual sum of squares over the unit cube of a search space, with other poles frozen.

    `one` gives it at a point (D,), `many` (E,) at points (E, D); `power` is |y|^2.
    """

    def __init__(
        self,
        space: SearchSpace,
        power: float,
        one: Callable[[RealArray], float],
        many: Callable[[RealArray], RealArray] | None = None,
    ) -> None:
        self.space = space
        self.evaluations = 0
        self._one, self._many = one, many
        self._floor = _FLOOR * power

    def rss(self, units: RealArray) -> RealArray:
        """Residual sums of squares (E,) at points (E, D)."""
        self.evaluations += len(units)
        if self._many is not None:
            return self._many(units)
        return np.array([self._one(unit) for unit in kernel_array(units)])

    def at(self, unit: RealArray) -> float:
        """Residual sum of squares at a point (D,)."""
        self.evaluations += 1
        return self._one(unit)

    def log(self, unit: RealArray) -> float:
        """log J at a point (D,), as DIRECT sees it."""
        return math.log(max(self.at(unit), self._floor))


class Linearised(Protocol):
    """The part of a `PoleProblem` that a local refinement needs."""

    @property
    def power(self) -> float:
        """|y|^2 without the part of constants and the like."""

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and linearisation at these poles; only the cost counts where it is not under `below`."""


class PoleProblem(Linearised, Protocol):
    """A least-squares problem, linear in everything but the poles."""

    @property
    def dt_s(self) -> float: ...

    @property
    def omega_max_rad_s(self) -> float | None:
        """Largest frequency at which the data could show a pair; None: up to the Nyquist frequency."""

    @property
    def longest(self) -> int:
        """Samples of the longest record: what is slower cannot be told from a pole on the circle."""

    @property
    def n_samples(self) -> int:
        """How many real numbers were measured."""

    def n_parameters(self, order: int) -> int:
        """Free real numbers of a fit with `order` poles: coefficients, poles, nuisances."""

    def residual(self, poles: Poles) -> RealArray:
        """What the fit leaves of the data, (N,)."""

    def colour(self, residual: RealArray) -> ResidualColour:
        """Whiteness of a residual, and how many independent numbers it is worth."""

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles: `shared` behind the input, `local` in free responses."""

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """Criterion (J, order) -> number, lower is better, read from a model with this J and order whose
        residual is worth so many independent numbers."""


@dataclass(frozen=True)
class ResidualColour:
    """What the autocorrelation of a residual says.

    effective_samples: independent samples it is worth, N / (1 + 2 sum rho_k^2) over lags to 200 or a tenth
    (Bartlett): by that factor colour widens the scatter of J. white: autocorrelations at lags 1 .. 25 are no
    larger, all together, than those of white noise 99 times in 100 (Box and Pierce).
    """

    effective_samples: float
    white: bool


def residual_colour(residual: RealArray, starts: IntArray) -> ResidualColour:
    """Colour of a residual (N,) of records that begin at `starts` (K + 1,)."""
    n = residual.size
    lags = min(200, int(np.min(np.diff(starts))) // 10)
    covariance = np.zeros(lags + 1)
    for lo, hi in pairwise(starts):
        part = residual[lo:hi]
        size = next_fast_len(part.size + lags, real=True)  # no lag up to there wraps around
        covariance += np.fft.irfft(np.abs(np.fft.rfft(part, size)) ** 2, size)[: lags + 1]
    if not covariance[0] > 0:
        return ResidualColour(float(n), False)
    squares = (covariance[1:] / covariance[0]) ** 2
    few = squares[:WHITE_LAGS]
    return ResidualColour(
        # What white noise shows by chance, 1/N per lag, is no colour.
        effective_samples=float(n / (1 + 2 * np.sum(np.maximum(squares - 1 / n, 0.0)))),
        white=few.size == WHITE_LAGS and bool(n * np.sum(few) < chdtri(few.size, 1 - TEST_LEVEL)),
    )
