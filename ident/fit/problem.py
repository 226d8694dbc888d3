"""What search, order selection and local refinement ask of the data: the cost at given poles, its change.

Records with one or several inputs (`ident.fit.least_squares.Regression`) and measured frequency responses
(`ident.fit.frf_regression.FrfRegression`) answer; coefficients and nuisances are re-fitted at every question.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from ident.basis.coordinates import SearchSpace
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray, RealArray, kernel_array
from ident.fit.residual_colour import ResidualColour

# Below this fraction of |y|^2 the products of the candidates' columns know nothing; a refinement sees the
# true residual.
_FLOOR = 1e-13


class Linearisation(NamedTuple):
    """How the residual sum of squares changes with the poles, coefficients re-fitted all the time.

    The directions are the states of each block driven by the fitted output (one per real pole, two per pair),
    projected off the regression: every pole sensitivity is a combination of them and of regression columns.

    rss : float
    normal : (B, B) array. S^T S of the projected directions: the Gauss-Newton (Kaufman) Hessian.
    gradient : (B,) array. S^T r.
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

    def log(self, unit: RealArray) -> float:
        """log J at a point (D,), as DIRECT sees it."""
        self.evaluations += 1
        return math.log(max(self._one(unit), self._floor))


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
    def n_rows(self) -> int:
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
