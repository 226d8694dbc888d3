"""Records of several outputs made ready for one fit: poles are shared, coefficients are every output's own.

`OutputRegressions` answers what a pole search and a refinement ask (`ident.fit.problem.PoleProblem`) with the
sums of what the single outputs answer. The cost is the sum of theirs, which is the likelihood where their
noises are independent and equally strong: `whitened` makes them so, `prepare_outputs` stacks the records.
"""

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
    """One `Regression` per output, of the same inputs; a `PoleProblem` whose numbers are those of all.

    Attributes
    ----------
    each : tuple of Regression
        Y of them, at least one, with the same records, structure and sampling time; `prepare_outputs` makes
        them so, nothing is checked here.
    """

    each: tuple[Regression, ...]

    @property
    def structure(self) -> Structure:
        """Integrators, delay and nuisance columns, of every output."""
        return self.each[0].structure

    @property
    def dt_s(self) -> float:
        """Sampling time, s."""
        return self.each[0].dt_s

    @property
    def starts(self) -> IntArray:
        """Where the records begin, output after output, (Y K + 1,)."""
        # The next output's records follow after all of this one's.
        ends = self.each[0].starts
        n_samples = ends[-1]
        of_outputs = [ends[1:] + k * n_samples for k in range(len(self.each))]
        return np.concatenate([ends[:1], *of_outputs])

    @property
    def power(self) -> float:
        """Square sum of the outputs without the part of constants and the like; of whitened ones no unit."""
        return sum(output.power for output in self.each)

    @property
    def omega_max_rad_s(self) -> float | None:
        """None: records show what lies below the Nyquist frequency."""
        return None

    @property
    def n_samples(self) -> int:
        """Measured numbers, Y N."""
        return sum(output.n_samples for output in self.each)

    @property
    def n_inputs(self) -> int:
        """Number of inputs U."""
        return self.each[0].n_inputs

    @property
    def longest(self) -> int:
        """Samples of the longest record."""
        return self.each[0].longest

    def n_parameters(self, order: int) -> int:
        """Free real numbers of a fit with `order` poles: what every output has of its own, the poles once.

        order: at least 0, not checked.
        """
        without_poles = [output.n_parameters(order) - order for output in self.each]
        return order + sum(without_poles)

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Sums of the outputs' costs, normal matrices (B, B) and gradients (B,) at these poles.

        real (R,), pairs (P,): poles above the axis, B = R + 2 P; inside the circle, as `Regression.linearise`
        checks or not. `below` is not used: which output alone stays below says nothing of the sum. NaN of one
        output is NaN of the sums.
        """
        # Each output has columns and coefficients of its own; only the poles are shared, so all three add up.
        parts = [output.linearise(real, pairs) for output in self.each]
        return Linearisation(
            sum(part.rss for part in parts),
            np.sum([part.normal for part in parts], axis=0),
            np.sum([part.gradient for part in parts], axis=0),
        )

    def residual(self, poles: Poles) -> RealArray:
        """What the fits with these poles leave, output after output, (Y N,), in the units of the outputs.

        As `Regression.residual` it does not refuse more columns than samples.
        """
        return np.concatenate([output.residual(poles) for output in self.each])

    def colour(self, residual: RealArray) -> ResidualColour:
        """Colour of a residual (Y N,), every record of every output by itself: see `residual_colour`."""
        return residual_colour(residual, self.starts)

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """Criterion (J, order) -> number, lower is better: see `information_criterion`.

        rss and order are not used. worth: independent numbers of a residual, positive.
        """
        # With its constants: what counts as rounding depends on the numbers as they were logged.
        power = sum(float(output.y @ output.y) for output in self.each)
        return information_criterion(power, self, worth)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles: the sum of the outputs' costs.

        space: the box of the candidates, D numbers a point. `shared` are driven by the inputs, `local` are
        those of the free responses. Points are not checked, as with `Regression.candidate_cost`.
        """
        costs = [output.candidate_cost(space, shared, local) for output in self.each]
        power = sum(float(output.y @ output.y) for output in self.each)

        def total(unit: RealArray) -> float:
            """J, sum over the outputs, at a point (D,) of the unit cube; nothing is checked."""
            return sum(cost.at(unit) for cost in costs)

        return CandidateCost(space, power, total)


def prepare_outputs(records: Sequence[Record], structure: Structure) -> OutputRegressions:
    """Records of equal inputs and outputs stacked for one fit.

    Parameters
    ----------
    records : sequence of Record
        input (T, U), output (T, Y).
    structure : Structure
        Integrators, delay and nuisance columns, of every output.

    Returns
    -------
    OutputRegressions
        Y regressions, one per output, in the records' order of outputs.

    Raises
    ------
    ValueError
        Names of outputs differ between records; also as `prepare_inputs`: no record, a record not longer than
        the delay, other inputs or sampling times.
    """
    # Without records there is one nameless output, so that `prepare_inputs` says what is missing.
    names = records[0].output_names if records else ("",)
    for record in records:
        if record.output_names != names:
            raise ValueError(
                f"{record.label}: outputs {list(record.output_names)}, but the first record has {list(names)}"
            )
    regressions = []
    for k in range(len(names)):
        of_output = [record.only(k) for record in records]
        regressions.append(prepare_inputs(of_output, structure))
    return OutputRegressions(tuple(regressions))


def whitened(records: Sequence[Record], white: RealArray) -> list[Record]:
    """Records with outputs white y, white (Y, Y) from the noise covariance of the outputs: units are gone.

    white: the inverse of the covariance's Cholesky factor, one over units. ValueError (numpy's) where a
    record has other than Y outputs; a matrix with NaN is refused by `Record`.
    """
    return [replace(record, output=record.output @ white.T, output_units=()) for record in records]
