"""The search beside a model error: sets of effects that explain records beside what no effect explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from diagnosis.evidence.explanation import Explanation
from diagnosis.fit.descent import FINE, Fit, descend, log_occam_factor, loss_at, refine_sizes
from diagnosis.fit.levels import UNINTERESTING
from diagnosis.fit.likelihood import DECISIVE, SUBSTANTIAL
from diagnosis.fit.records import FittedStart, Records, mean_square_left
from diagnosis.fit.starts import StartPoint, beside
from diagnosis.fit.windows import Windows
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from diagnosis.search.loop import FOLLOWED_COSTLY, FOLLOWED_EFFECTS, FOLLOWED_SETS, Progress, SearchLoop
from diagnosis.search.moves import (
    Alone,
    BesideSet,
    Enlarge,
    FromContacts,
    FromPoints,
    InWindows,
    LookAlike,
    Scan,
)
from diagnosis.search.settled import fit_record_starts
from plant.effects.search_space import Candidate


class Search(SearchLoop[Explanation]):
    """All that was fitted to a case, the nominal alone first.

    windows : that records are seen in, each from its own start; None: as they run freely. refuted : effects
    that validation records do not have, whatever the others say.
    """

    records: Records

    def __init__(
        self,
        case: CaseOfMachine,
        progress: Progress,
        deadline_s: float = np.inf,
        windows: Windows | None = None,
    ) -> None:
        super().__init__(case, progress, deadline_s)
        self.windows = windows
        self.refuted: set[str] = set()
        self.records = Records(case, case.estimation, windows)
        self.held_out = Records(case, case.held_out, windows)
        self.timed_records = self.records, self.held_out
        # Estimation records each by itself, as `prediction_residuals` asks for them.
        self._single_logs: dict[int, Records] = {}

    @cached_property
    def drift_free_windows(self) -> Windows | None:
        """Windows in which no drift grows; None for a machine that forgets its inputs, or whose simulation is
        held near the records and fits their starts itself."""
        settles = getattr(self.case.machine, "settled", None) is not None
        return self.windows or (None if settles else Windows.of(self.case))

    def for_case(self, case: CaseOfMachine) -> Search:
        """Of the same records in another form."""
        return Search(case, self.progress, self.deadline_s, self.windows)

    def run(self) -> None:
        """The nominal, every effect alone, then sets of two, three and more beside the likeliest.

        Beyond three only while the likeliest leaves more of the motion than is stated not to interest, and
        the last size was worth it.
        """
        nothing = np.zeros(self.records.nominal.count)
        start, _ = fit_record_starts(self.records, nothing, (), self.records.guessed_start())
        self.add(descend(self.records, (), nothing, np.zeros(0), start, iterations=12))
        self.apply_moves(Alone.proposed(self), 0.05, 0.1)
        self.apply_moves(FromPoints.proposed(self), 0.15, 0.3)
        self.finish_single_effects()
        self.apply_moves(Enlarge.proposed(self, self.explanations), 0.45)
        for count in range(2, self.case.machine.weighing.most_effects + 1):
            # Whether the likeliest set of so many effects is much likelier than that of one fewer.
            largest, smaller = (
                max((e.log_evidence for e in self.explanations if len(e.names) == n), default=-np.inf)
                for n in (count - 1, count - 2)
            )
            if count > 3 and not (self.unexplained and largest > smaller + DECISIVE):
                break
            self.apply_moves(BesideSet.proposed(self, count), min(0.45 + 0.25 * (count - 2), 0.9), 0.1)
        if self.unexplained:
            self.apply_moves(InWindows.proposed(self), 0.95)
            self.apply_moves(Scan.proposed(self), 0.97)
            self.apply_moves(FromContacts.proposed(self), 0.97)
        self.apply_moves(LookAlike.proposed(self), 0.98)

    @property
    def unexplained(self) -> bool:
        """Whether the likeliest leaves more of the motion than is stated not to interest."""
        return bool(np.max(self.likeliest.residual_shares) > self.case.machine.weighing.model_error)

    def candidate_alone(
        self, candidate: Candidate, points: list[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        return candidate, points

    def candidate_beside(
        self, parent: Fit, candidate: Candidate, points: Sequence[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """The best and, because beside another effect any size may be right, some of the rest."""
        rest = points[FOLLOWED_SETS:]
        some = [*points[:FOLLOWED_SETS], *rest[:: max(1, len(rest) // FOLLOWED_SETS)]]
        return candidate, beside(self.records, parent, candidate, some)

    def polish(self, end: Fit, rank: int, around: Fit) -> Fit:
        alone = not around.candidates
        if rank >= (FOLLOWED_EFFECTS if alone else FOLLOWED_COSTLY):
            return end
        if alone:
            # Slopes of the nominal lead to an end that need not be one by slopes of its own.
            end = end.continued(self.records, **FINE)
        return refine_sizes(self.records, self.restarted(end))

    def restarted(self, end: Fit) -> Fit:
        """Descended on where starts sought with these effects leave less: the nominal's may be far off, and
        where nobody knows a linear part no step leads from there."""
        if self.case.machine.unknown_start.responses is not None or not end.start.states.size:
            return end
        start, e = fit_record_starts(self.records, end.deviations, end.effects, end.start)
        loss, _ = loss_at(self.records, e, end.deviations, start)
        return end if loss > end.loss - SUBSTANTIAL else end.continued(self.records, start)

    def held_out_share_of(self, explanation: Explanation, k: int) -> float:
        """Share of the motion that the k-th effect changes of held-out records, all else as it is; of the
        output that shows most of it."""
        end, held = explanation.fit, self.held_out
        rest = [effect for j, effect in enumerate(end.effects) if j != k]
        start = self._beginning(held, end.start)
        pairs = zip(
            held.residuals(end.deviations, end.effects, start),
            held.residuals(end.deviations, rest, start),
            strict=True,
        )
        motion = held.levels.motion_energy.reshape(-1, self.case.noise.size).sum(axis=0)
        changed = sum(np.sum((with_it - without) ** 2, axis=0) for with_it, without in pairs)
        return float(np.sqrt(np.max(changed / motion)))

    def descended_to_end(self, explanation: Explanation) -> Explanation:
        """Descended to its end."""
        return self.add(explanation.fit.continued(self.records, **FINE))

    def at_stated_values(self, of: Explanation | None = None) -> Explanation:
        """With nominal values as stated, effects as they are: only the starts are fitted."""
        end = (of or self.nominal_alone).fit
        stated = np.zeros(end.deviations.size)
        start, e = fit_record_starts(
            self.records, stated, end.effects, self._beginning(self.records, end.start)
        )
        loss, prior = loss_at(self.records, e, stated, start)
        weights = self.records.levels.weights(e)
        moved = replace(
            end,
            deviations=stated,
            start=start,
            residual_coefficients=e,
            weights=weights,
            loss=loss,
            prior_loss=prior,
        )
        return self.explain(moved)

    def explain(self, end: Fit) -> Explanation:
        """With what it predicts of the held-out records, their starts fitted (`settled`)."""
        records, held = self.records, self.held_out
        beginning = self._beginning(held, end.start)
        touching = self.starts_feel_contacts and end.non_smooth
        start, e = fit_record_starts(held, end.deviations, end.effects, beginning, touching=touching)
        left, left_held_out = records.residuals_from(end.residual_coefficients), held.residuals_from(e)
        states = 0.5 * np.sum((start.states / held.state_spread) ** 2, axis=1)
        return Explanation(
            end,
            -np.concatenate([records.losses(end.residual_coefficients), held.losses(e) + states]),
            -end.prior_loss,
            log_occam_factor(records, end),
            left,
            left_held_out,
            np.array([records.rms_shares(left), held.rms_shares(left_held_out)]),
            np.array(
                [
                    mean_square_left(of.energies(e, carried=True))
                    for of, e in ((records, left), (held, left_held_out))
                ]
            ),
        )

    def whitened_residuals(
        self, found: Explanation, experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        records = (*self.records.experiments, *self.held_out.experiments)
        parts = zip(records, (*found.residuals, *found.held_out_residuals), strict=True)
        left = {e.name: part / self.case.noise for e, part in parts}
        return {e.name: left[e.name] for e in experiments or self.case.experiments}

    @cached_property
    def uninteresting_energy(self) -> float:
        """See `SearchLoop.uninteresting_energy`: the share of the motion that no fit follows either."""
        share = UNINTERESTING * self.case.machine.weighing.model_error
        logs = (self.records, self.held_out) if len(self.case.estimation) > 1 else (self.held_out,)
        motion = [records.levels.motion_energy.reshape(-1, self.case.noise.size) for records in logs]
        return share**2 * float(np.sum(np.concatenate(motion) / self.case.noise**2))

    def prediction_residuals(
        self, log: int, deviations: Real, effects: Sequence[Any], start: FittedStart
    ) -> Real:
        """See `SearchLoop.predicted`; in windows what is left has no part of what starts of windows do."""
        record = self.case.estimation[log]
        if log not in self._single_logs:
            self._single_logs[log] = Records(self.case, (record,), self.windows)
            self.timed_records = (*self.timed_records, self._single_logs[log])
        records = self._single_logs[log]
        near = FittedStart(start.states[log : log + 1], start.zeros)
        _, e = fit_record_starts(records, deviations, effects, near)
        return np.asarray(records.residuals_from(e)[0] / self.case.noise)

    def _beginning(self, held: Records, fitted: FittedStart) -> FittedStart:
        """Starts of records as their first samples say, sensors at the zeros that others have."""
        start = held.guessed_start()
        if not start.zeros.size:
            return start
        return start.with_zeros(fitted.zeros, self.case.machine.unknown_start.state_per_zero)
