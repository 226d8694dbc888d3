"""The search where the noise is known: what it looks for, finishes and extends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from diagnosis.evidence.hypotheses import (
    DISAGREEMENT,
    UNLISTED,
    Hypothesis,
)
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

# An effect that changes no record by more than this many noise deviations (RMS) is not looked for: alone, and
# beside others, where two dozen further effects have as many chances to follow noise and solver errors.
_SMALLEST, _SMALLEST_BESIDE = 0.06, 0.2
# Where two effects leave more than this share of the gap, a third would only follow something unknown.
_HOPELESS = 0.1
# Sizes of non-smooth effects are refined where no more than this share of the gap, or this energy, is left.
_NEAR = 0.25


def descend_to_end(
    model: ResidualModel, candidates: Sequence[Candidate], coordinates: Real, deviations: Real
) -> Fit:
    """Descended to its end."""
    return descend(
        model,
        candidates,
        deviations,
        coordinates,
        model.start,
        **FINE,
    )


class WhiteSearch(SearchLoop[Hypothesis]):
    """Of a machine whose simulation, with the right effects, is as good as the sensors."""

    records: ResidualModel

    def __init__(self, case: CaseOfMachine, progress: Progress, deadline_s: float = np.inf) -> None:
        super().__init__(case, progress, deadline_s)
        self.records = ResidualModel(case)
        self.timed_records = (self.records,)

    def run(self) -> None:
        """The nominal, every effect alone, and sets of effects as long as they gain."""
        self.add(descend_to_end(self.records, (), np.zeros(0), np.zeros(self.records.nominal.count)))
        self.apply_moves(Alone.proposed(self), 0.05, 0.1)
        self.apply_moves(FromPoints.proposed(self), 0.15, 0.3)
        self.finish_single_effects()
        self.apply_moves(Enlarge.proposed(self, self.explanations), 0.5)
        self.apply_moves(InPlaceOf.proposed(self, self.nominal_alone.fit), 0.55)
        for count in range(2, self.case.machine.weighing.most_effects + 1):
            moves = BesideSet.proposed(self, count)
            if not moves or (count > 2 and self._hopeless(moves[0].parent)):
                break
            pulled = [m for move in moves for m in InPlaceOf.proposed(self, move.parent)]
            self.apply_moves([*moves, *pulled], 0.4 + 0.1 * count, 0.1)
            for one in sorted(self.explanations, key=lambda h: -h.log_weight)[:FOLLOWED_COSTLY]:
                if self._near(one.fit) and len(one.names) > 1:
                    self.add_simpler(one)
                    for k in range(len(one.names)):
                        self.without_effect(one, k)
        self.apply_moves(LookAlike.proposed(self), 0.95)

    @property
    def unexplained(self) -> bool:
        """Whether the best set leaves something over, by its own evidence against that of an unknown rest."""
        return max(h.log_weight for h in self.explanations) < max(
            h.log_weight_with_unknown for h in self.explanations
        )

    def _hopeless(self, parent: Fit) -> bool:
        """Whether a third effect would follow something unknown, or what correct solvers of backlash differ
        by."""
        if _beyond_noise(parent) > _HOPELESS * _beyond_noise(self.nominal_alone.fit):
            return True
        if not parent.non_smooth:
            return False
        e, drift = without_drift(parent.residual_coefficients, solver_spread(self.records, parent))
        return float(np.mean(e**2)) - 1.0 < max(DISAGREEMENT["non-smooth"], drift.size) ** 2

    def candidate_alone(
        self, candidate: Candidate, points: list[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """From the size on at which it changes a record."""
        smallest = smallest_size(candidate, points, _SMALLEST)
        return (candidate, []) if smallest is None else (candidate.from_size(smallest), points)

    def candidate_beside(
        self, parent: Fit, candidate: Candidate, points: Sequence[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        smallest = smallest_size(candidate, points, _SMALLEST_BESIDE)
        if smallest is not None:
            candidate = candidate.from_size(smallest)
        near = superposed(self.records, parent, points)[:FOLLOWED_SETS]
        return candidate, beside(self.records, parent, candidate, near or points[:1])

    def polish(self, end: Fit, rank: int, around: Fit) -> Fit:
        """Finished where it may matter: among faint effects alone a few units of loss decide, and stated
        values that a gap has pulled far off need more than rough steps to come back."""
        best = min(h.fit.loss for h in self.explanations)
        faint = all(c.dependence == "smooth" for c in end.candidates) and not around.candidates
        close = end.loss < best + DECISIVE and (faint or end.loss < around.loss - WORTH_IT)
        # A backlash that only looks like something else takes as long as everything besides.
        if not (close or rank == 0) or (rank > 0 and end.non_smooth and not self._near(end)):
            return end
        fine = descend_to_end(self.records, end.candidates, end.coordinates, end.deviations)
        best_end = min(fine, end, key=lambda one: one.loss)
        return refine_sizes(self.records, best_end) if self._near(best_end) else best_end

    def _near(self, end: Fit) -> bool:
        """Whether backlash or the like may be the answer; beside much of a gap jumps do not matter."""
        return _beyond_noise(end) < max(_NEAR * _beyond_noise(self.explanations[0].fit), _NEAR)

    def explain(self, end: Fit) -> Hypothesis:
        """With its log weights; a cause beyond the list is no answer but part of what is unknown."""
        model, e, drift = self.records, end.residual_coefficients, NO_DRIFT
        if not self.explanations or self._near(end):
            e, drift = without_drift(e, solver_spread(model, end))
        segments = [len(experiment.output) for experiment in self.case.estimation]
        left, listed = discrepancy(e, segments, self.case.noise.size), self.case.machine.weighing.listed
        found = Hypothesis.of(end, left, drift, listed)
        if {*end.names} <= {*listed}:
            return found
        return replace(
            found, log_weight=-np.inf, log_weight_with_unknown=found.log_weight + float(np.log(UNLISTED))
        )

    def whitened_residuals(
        self, found: Hypothesis, experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        return self.records.by_experiment(found.fit.deviations, found.fit.effects, experiments)

    def prediction_residuals(
        self, log: int, deviations: Real, effects: Sequence[Any], start: FittedStart
    ) -> Real:
        """See `SearchLoop.predicted`; starts are known here."""
        record = self.case.estimation[log]
        return self.records.by_experiment(deviations, effects, (record,))[record.name]


def _beyond_noise(end: Fit) -> float:
    return max(end.rms**2 - 1.0, 0.0)


def smallest_size(candidate: Candidate, starts: Sequence[StartPoint], ratio: float) -> float | None:
    """Coordinate of the size at which the effect changes the model by `ratio` noise deviations.

    From the grid: interpolated between points in log-log, extrapolated in proportion; over several points of
    equal size the largest change counts. None if the grid never changes anything.
    """
    sizes: dict[float, float] = {}
    for start in starts:
        key = float(start.coordinates[0])
        sizes[key] = max(sizes.get(key, 0.0), start.size)
    x = np.array(sorted(sizes))
    change = np.array([sizes[v] for v in x])
    if not np.any(change > 0):
        return None
    change = np.log(np.maximum(change, 1e-9))
    if not candidate.grows:
        x, change = -x[::-1], change[::-1]
    change = np.maximum.accumulate(change)
    reach = np.abs(np.log(ratio) - change).max()
    changes, sizes_at = (np.array([part[0] - reach, *part, part[-1] + reach]) for part in (change, x))
    found = np.interp(np.log(ratio), changes, sizes_at)
    return float(found if candidate.grows else -found)
