"""Records of several outputs made ready for one fit: poles are shared, coefficients are every output's own.
The cost is the sum of theirs, the likelihood where their noises are independent and equally strong
(`whitened`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.basis.coordinates import SearchSpace
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.data.record import Record
from ident.fit.least_squares import Regression, information_criterion
from ident.fit.problem import CandidateCost, Linearisation, ResidualColour, residual_colour
from ident.fit.regression import prepare_inputs


@dataclass(frozen=True, eq=False)
class OutputRegressions:
    """One `Regression` per output, of the same inputs; a `PoleProblem` whose numbers are those of all."""

    each: tuple[Regression, ...]

    @property
    def structure(self) -> Structure:
        return self.each[0].structure

    @property
    def dt_s(self) -> float:
        return self.each[0].dt_s

    @property
    def starts(self) -> IntArray:
        """Where the records begin, output after output, (Y K + 1,)."""
        ends = self.each[0].starts
        return np.concatenate([ends[:1], *[ends[1:] + k * ends[-1] for k in range(len(self.each))]])

    @property
    def power(self) -> float:
        return sum(one.power for one in self.each)

    @property
    def omega_max_rad_s(self) -> float | None:
        return None

    @property
    def n_samples(self) -> int:
        """Measured numbers, Y N."""
        return sum(one.n_samples for one in self.each)

    @property
    def n_inputs(self) -> int:
        return self.each[0].n_inputs

    @property
    def longest(self) -> int:
        return self.each[0].longest

    def n_parameters(self, order: int) -> int:
        """Coefficients and nuisances of every output; the poles once."""
        return order + sum(one.n_parameters(order) - order for one in self.each)

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Sum of the outputs' costs, normal matrices and gradients."""
        parts = [one.linearise(real, pairs) for one in self.each]
        return Linearisation(
            sum(part.rss for part in parts),
            np.sum([part.normal for part in parts], axis=0),
            np.sum([part.gradient for part in parts], axis=0),
        )

    def residual(self, poles: Poles) -> RealArray:
        """Output after output, (Y N,)."""
        return np.concatenate([one.residual(poles) for one in self.each])

    def colour(self, residual: RealArray) -> ResidualColour:
        return residual_colour(residual, self.starts)

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        return information_criterion(sum(float(one.y @ one.y) for one in self.each), self, worth)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        costs = [one.candidate_cost(space, shared, local) for one in self.each]
        power = sum(float(one.y @ one.y) for one in self.each)
        return CandidateCost(space, power, lambda unit: sum(cost.at(unit) for cost in costs))


def prepare_outputs(records: Sequence[Record], structure: Structure) -> OutputRegressions:
    """Stack records of equal inputs and outputs for one fit; raises ValueError as `prepare_inputs`."""
    names = records[0].output_names if records else ("",)
    for record in records:
        if record.output_names != names:
            raise ValueError(
                f"{record.label}: outputs {list(record.output_names)}, but the first record has {list(names)}"
            )
    return OutputRegressions(
        tuple(prepare_inputs([record.only(k) for record in records], structure) for k in range(len(names)))
    )


def whitened(records: Sequence[Record], white: RealArray) -> list[Record]:
    """The records with outputs white y, white (Y, Y): units are gone."""
    return [replace(record, output=record.output @ white.T, output_units=()) for record in records]
