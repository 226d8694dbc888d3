"""The search where the noise is known: what it looks for, finishes and extends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from diagnosis.evidence.hypotheses import DISAGREEMENT, UNLISTED, Hypothesis
from diagnosis.fit.descent import FINE, Fit, descend, refine_sizes
from diagnosis.fit.discrepancy import discrepancy
from diagnosis.fit.likelihood import DECISIVE, WORTH_IT
from diagnosis.fit.records import FittedStart
from diagnosis.fit.residual import ResidualModel
from diagnosis.fit.solver_spread import NO_DRIFT, solver_spread, without_drift
from diagnosis.fit.starts import StartPoint, beside, superposed
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from diagnosis.search.loop import FOLLOWED_COSTLY, FOLLOWED_SETS, Progress, SearchLoop
from diagnosis.search.moves import Alone, BesideSet, Enlarge, FromPoints, InPlaceOf, LookAlike
from plant.effects.search_space import Candidate

# Smallest change of a record, RMS in noise deviations, of an effect that is looked for alone.
_SMALLEST_CHANGE = 0.06
# Smallest change of an effect that is looked for beside others, where two dozen further effects have as many
# chances to follow noise and solver errors.
_SMALLEST_CHANGE_BESIDE = 0.2
# Share of the gap, as an energy beyond the noise, of which a third effect would only follow something unknown
# where two leave more.
_HOPELESS_SHARE = 0.1
# Share of the gap, as an energy beyond the noise, or this energy itself, from which on sizes of non-smooth
# effects are refined: beside more of a gap jumps do not matter.
_NEAR_SHARE = 0.25
# Smallest change whose logarithm is taken.
_SMALLEST_LOG_CHANGE = 1e-9


def descend_to_end(
    model: ResidualModel, candidates: Sequence[Candidate], coordinates: Real, deviations: Real
) -> Fit:
    """The end of a fine descent.

    Parameters
    ----------
    model : ResidualModel
        Records under white noise; its start is not fitted where the machine's is known.
    candidates : sequence of Candidate
        Effects to be fitted.
    coordinates : (A,) array
        Of all candidates in a row, where the descent begins.
    deviations : (P,) array
        Nominal values there, in tolerances off.
    """
    return descend(model, candidates, deviations, coordinates, model.start, **FINE)


class WhiteSearch(SearchLoop[Hypothesis]):
    """The search for a machine whose simulation, with the right effects, is as good as the sensors."""

    records: ResidualModel

    def __init__(self, case: CaseOfMachine, progress: Progress, deadline_s: float = np.inf) -> None:
        super().__init__(case, progress, deadline_s)
        self.records = ResidualModel(case)
        self.timed_records = (self.records,)

    def run(self) -> None:
        """The nominal, every effect alone, and sets of effects as long as they gain."""
        no_coordinates = np.zeros(0)
        as_stated = np.zeros(self.records.nominal.count)
        self.add(descend_to_end(self.records, (), no_coordinates, as_stated))
        self.apply_moves(Alone.proposed(self), 0.05, 0.1)
        self.apply_moves(FromPoints.proposed(self), 0.15, 0.3)
        self.finish_single_effects()
        self.apply_moves(Enlarge.proposed(self, self.explanations), 0.5)
        self.apply_moves(InPlaceOf.proposed(self, self.nominal_alone.fit), 0.55)

        for count in range(2, self.case.machine.weighing.most_effects + 1):
            besides = BesideSet.proposed(self, count)
            if not besides or (count > 2 and self._is_hopeless(besides[0].parent)):
                break
            in_place = [
                move for beside_set in besides for move in InPlaceOf.proposed(self, beside_set.parent)
            ]
            self.apply_moves([*besides, *in_place], 0.4 + 0.1 * count, 0.1)
            # Of the likeliest sets every part is an answer, too.
            likeliest = sorted(self.explanations, key=lambda hypothesis: -hypothesis.log_weight)
            for hypothesis in likeliest[:FOLLOWED_COSTLY]:
                if len(hypothesis.names) > 1 and self._is_near(hypothesis.fit):
                    self.add_simpler(hypothesis)
                    for k in range(len(hypothesis.names)):
                        self.without_effect(hypothesis, k)

        self.apply_moves(LookAlike.proposed(self), 0.95)

    @property
    def unexplained(self) -> bool:
        """Whether the best set leaves something over, by its own evidence against that of an unknown rest."""
        exactly = max(hypothesis.log_weight for hypothesis in self.explanations)
        return exactly < max(hypothesis.log_weight_with_unknown for hypothesis in self.explanations)

    def _is_hopeless(self, parent: Fit) -> bool:
        """Whether a third effect would follow something unknown, or what correct solvers of backlash differ
        by."""
        gap = _energy_beyond_noise(self.nominal_alone.fit)
        if _energy_beyond_noise(parent) > _HOPELESS_SHARE * gap:
            return True
        if not parent.non_smooth:
            return False
        spread = solver_spread(self.records, parent)
        e, drift = without_drift(parent.residual_coefficients, spread)
        disagreement = max(DISAGREEMENT["non-smooth"], drift.size)
        return float(np.mean(e**2)) - 1.0 < disagreement**2

    def candidate_alone(
        self, candidate: Candidate, points: list[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """See `SearchLoop.candidate_alone`; from the size on at which it changes a record."""
        smallest = smallest_size(candidate, points, _SMALLEST_CHANGE)
        if smallest is None:
            return candidate, []
        return candidate.from_size(smallest), points

    def candidate_beside(
        self, parent: Fit, candidate: Candidate, points: Sequence[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """The candidate and the start points from which it is fitted beside the effects of a fit.

        The `FOLLOWED_SETS` points that superposition likes best: where outputs changed by each effect alone
        are added, they leave least. Sizes begin where the candidate changes outputs at all.
        """
        smallest = smallest_size(candidate, points, _SMALLEST_CHANGE_BESIDE)
        if smallest is not None:
            candidate = candidate.from_size(smallest)
        best_points = superposed(self.records, parent, points)[:FOLLOWED_SETS]
        return candidate, beside(self.records, parent, candidate, best_points or points[:1])

    def polish(self, fit: Fit, rank: int, around: Fit) -> Fit:
        """See `SearchLoop.polish`.

        A fit is finished where it may matter: among faint effects alone a few units of loss decide, and
        stated values that a gap has pulled far off need more than rough steps to come back.
        """
        best_loss = min(hypothesis.fit.loss for hypothesis in self.explanations)
        is_smooth_alone = not around.candidates and all(
            candidate.dependence == "smooth" for candidate in fit.candidates
        )
        is_worth_it = is_smooth_alone or fit.loss < around.loss - WORTH_IT
        is_close = fit.loss < best_loss + DECISIVE and is_worth_it
        if rank > 0 and not is_close:
            return fit
        # A backlash that only looks like something else takes as long as everything besides.
        if rank > 0 and fit.non_smooth and not self._is_near(fit):
            return fit
        finished = descend_to_end(self.records, fit.candidates, fit.coordinates, fit.deviations)
        best = min(finished, fit, key=lambda fit: fit.loss)
        if self._is_near(best):
            return refine_sizes(self.records, best)
        return best

    def _is_near(self, fit: Fit) -> bool:
        """Whether so little is left that backlash or the like may be the answer."""
        gap = _energy_beyond_noise(self.nominal_alone.fit)
        return _energy_beyond_noise(fit) < max(_NEAR_SHARE * gap, _NEAR_SHARE)

    def explain(self, fit: Fit) -> Hypothesis:
        """The fit with its log weights; a cause beyond the list is no answer but part of what is unknown."""
        e = fit.residual_coefficients
        drift = NO_DRIFT
        # The first one is the nominal machine, which the gap is measured from.
        if not self.explanations or self._is_near(fit):
            e, drift = without_drift(e, solver_spread(self.records, fit))
        segments = [len(experiment.output) for experiment in self.case.estimation]
        left = discrepancy(e, segments, self.case.noise.size)
        listed = self.case.machine.weighing.listed
        hypothesis = Hypothesis.of(fit, left, drift, listed)
        if set(fit.names) <= set(listed):
            return hypothesis
        log_weight_unlisted = hypothesis.log_weight + float(np.log(UNLISTED))
        return replace(hypothesis, log_weight=-np.inf, log_weight_with_unknown=log_weight_unlisted)

    def whitened_residuals(
        self, explanation: Hypothesis, experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """See `SearchLoop.whitened_residuals`; the records are simulated."""
        fit = explanation.fit
        return self.records.by_experiment(fit.deviations, fit.effects, experiments)

    def prediction_residuals(
        self, log: int, deviations: Real, effects: Sequence[Any], start: FittedStart
    ) -> Real:
        """See `SearchLoop.prediction_residuals`; starts are known here."""
        record = self.case.estimation[log]
        return self.records.by_experiment(deviations, effects, (record,))[record.name]


def _energy_beyond_noise(fit: Fit) -> float:
    """Mean square left beyond white noise, in units of the noise's; at least 0."""
    return max(fit.rms**2 - 1.0, 0.0)


def smallest_size(candidate: Candidate, starts: Sequence[StartPoint], change: float) -> float | None:
    """Coordinate of the size at which an effect changes the model by so many noise deviations.

    From the grid: interpolated between points in log-log, extrapolated in proportion; over several points of
    equal size the largest change counts.

    Parameters
    ----------
    candidate : Candidate
        Its first coordinate is its size; `grows` says whether the effect does with it.
    starts : sequence of StartPoint
        Of its grid, with what each changes.
    change : float
        RMS in noise deviations, above 0.

    Returns
    -------
    float or None
        None if the grid never changes anything.
    """
    change_of_size: dict[float, float] = {}
    for start in starts:
        size = float(start.coordinates[0])
        change_of_size[size] = max(change_of_size.get(size, 0.0), start.size)
    sizes = np.array(sorted(change_of_size))
    changes = np.array([change_of_size[size] for size in sizes])
    if not np.any(changes > 0):
        return None
    log_changes = np.log(np.maximum(changes, _SMALLEST_LOG_CHANGE))
    if not candidate.grows:
        # Mirrored, so that it grows.
        sizes = -sizes[::-1]
        log_changes = log_changes[::-1]
    log_changes = np.maximum.accumulate(log_changes)

    # One more point on each side, in proportion to the size, as far as the change that is sought.
    log_change = np.log(change)
    reach = np.abs(log_change - log_changes).max()
    extended_changes = np.array([log_changes[0] - reach, *log_changes, log_changes[-1] + reach])
    extended_sizes = np.array([sizes[0] - reach, *sizes, sizes[-1] + reach])
    smallest = np.interp(log_change, extended_changes, extended_sizes)
    return float(smallest if candidate.grows else -smallest)
