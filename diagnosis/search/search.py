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
from diagnosis.search.loop import (
    FOLLOWED_COSTLY,
    FOLLOWED_EFFECTS,
    FOLLOWED_SETS,
    Progress,
    SearchLoop,
)
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

# Iterations of the nominal machine alone: everything begins there, and its starts may be far off.
_NOMINAL_ITERATIONS = 12
# Largest sets that are sought whatever they gain: two effects may show only together with a third.
_SOUGHT_IN_ANY_CASE = 3


class Search(SearchLoop[Explanation]):
    """Everything that was fitted to a case beside a model error.

    Attributes
    ----------
    windows : Windows or None
        Windows that records are seen in, each from its own start; None: as they run freely.
    refuted : set of str
        Effects that validation records do not have, whatever the others say; a judge adds to it.
    held_out : Records
        Records that are only predicted, but for their starts.
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
        self.timed_records = (self.records, self.held_out)
        # Estimation records each by itself, as `prediction_residuals` asks for them.
        self._single_logs: dict[int, Records] = {}

    @cached_property
    def drift_free_windows(self) -> Windows | None:
        """Windows in which no drift grows.

        None for a machine that forgets its inputs, or whose simulation is held near the records and fits
        their starts itself.
        """
        if self.windows is not None:
            return self.windows
        fits_starts_itself = getattr(self.case.machine, "settled", None) is not None
        if fits_starts_itself:
            return None
        return Windows.of(self.case)

    def for_case(self, case: CaseOfMachine) -> Search:
        """An empty search of another form of the same records, in the same windows, within the same time."""
        return Search(case, self.progress, self.deadline_s, self.windows)

    def run(self) -> None:
        """The nominal, every effect alone, then sets of two, three and more beside the likeliest.

        Beyond three only while the likeliest leaves more of the motion than is stated not to interest, and
        the last size was worth it.
        """
        as_stated = np.zeros(self.records.nominal.count)
        start, _ = fit_record_starts(self.records, as_stated, (), self.records.guessed_start())
        no_coordinates = np.zeros(0)
        self.add(descend(self.records, (), as_stated, no_coordinates, start, iterations=_NOMINAL_ITERATIONS))

        self.apply_moves(Alone.proposed(self), 0.05, 0.1)
        self.apply_moves(FromPoints.proposed(self), 0.15, 0.3)
        self.finish_single_effects()
        self.apply_moves(Enlarge.proposed(self, self.explanations), 0.45)

        for count in range(2, self.case.machine.weighing.most_effects + 1):
            if count > _SOUGHT_IN_ANY_CASE:
                was_worth_it = self._best_of_count(count - 1) > self._best_of_count(count - 2) + DECISIVE
                if not (self.unexplained and was_worth_it):
                    break
            begin = min(0.45 + 0.25 * (count - 2), 0.9)
            self.apply_moves(BesideSet.proposed(self, count), begin, 0.1)

        if self.unexplained:
            self.apply_moves(InWindows.proposed(self), 0.95)
            self.apply_moves(Scan.proposed(self), 0.97)
            self.apply_moves(FromContacts.proposed(self), 0.97)
        self.apply_moves(LookAlike.proposed(self), 0.98)

    def _best_of_count(self, count: int) -> float:
        """The largest log evidence of sets of so many effects; -inf without one."""
        of_count = [e.log_evidence for e in self.explanations if len(e.names) == count]
        return max(of_count, default=-np.inf)

    @property
    def unexplained(self) -> bool:
        """Whether the likeliest leaves more of the motion than is stated not to interest."""
        return bool(np.max(self.likeliest.residual_shares) > self.case.machine.weighing.model_error)

    def candidate_alone(
        self, candidate: Candidate, points: list[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """See `SearchLoop.candidate_alone`; beside a model error every candidate is tried as it is."""
        return candidate, points

    def candidate_beside(
        self, parent: Fit, candidate: Candidate, points: Sequence[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """See `SearchLoop.candidate_beside`.

        The best points and, because beside another effect any size may be right, some of the others.
        """
        worse_points = points[FOLLOWED_SETS:]
        every = max(1, len(worse_points) // FOLLOWED_SETS)
        simulated = [*points[:FOLLOWED_SETS], *worse_points[::every]]
        return candidate, beside(self.records, parent, candidate, simulated)

    def polish(self, fit: Fit, rank: int, around: Fit) -> Fit:
        """See `SearchLoop.polish`; the first few by loss are worth it."""
        is_alone = not around.candidates
        if rank >= (FOLLOWED_EFFECTS if is_alone else FOLLOWED_COSTLY):
            return fit
        if is_alone:
            # Slopes of the nominal lead to an end that need not be one by slopes of its own.
            fit = fit.continued(self.records, **FINE)
        return refine_sizes(self.records, self.restarted(fit))

    def restarted(self, fit: Fit) -> Fit:
        """The fit descended on where starts sought with its effects leave less.

        Those of the nominal may be far off, and where nobody knows a linear part no step leads from there.
        """
        has_linear_part = self.case.machine.unknown_start.responses is not None
        if has_linear_part or fit.start.states.size == 0:
            return fit
        start, e = fit_record_starts(self.records, fit.deviations, fit.effects, fit.start)
        loss, _ = loss_at(self.records, e, fit.deviations, start)
        if loss > fit.loss - SUBSTANTIAL:
            return fit
        return fit.continued(self.records, start)

    def held_out_share_of(self, explanation: Explanation, k: int) -> float:
        """Share of the motion that the k-th effect changes of held-out records, all else as it is.

        An RMS over an RMS, of the output that shows most of it.
        """
        fit = explanation.fit
        held_out = self.held_out
        other_effects = [effect for j, effect in enumerate(fit.effects) if j != k]
        start = self._start_with_zeros(held_out, fit.start)
        with_effect = held_out.residuals(fit.deviations, fit.effects, start)
        without_effect = held_out.residuals(fit.deviations, other_effects, start)
        motion = held_out.levels.motion_energy.reshape(-1, self.case.noise.size).sum(axis=0)
        changed = sum(
            np.sum((present - absent) ** 2, axis=0)
            for present, absent in zip(with_effect, without_effect, strict=True)
        )
        return float(np.sqrt(np.max(changed / motion)))

    def at_stated_values(self, explanation: Explanation | None = None) -> Explanation:
        """An explanation (default: no effect) with nominal values as stated, effects as they are.

        Only the starts are fitted; it is not added to the others.
        """
        if explanation is None:
            explanation = self.nominal_alone
        fit = explanation.fit
        as_stated = np.zeros(fit.deviations.size)
        begin = self._start_with_zeros(self.records, fit.start)
        start, e = fit_record_starts(self.records, as_stated, fit.effects, begin)
        loss, prior_loss = loss_at(self.records, e, as_stated, start)
        stated_fit = replace(
            fit,
            deviations=as_stated,
            start=start,
            residual_coefficients=e,
            weights=self.records.levels.weights(e),
            loss=loss,
            prior_loss=prior_loss,
        )
        return self.explain(stated_fit)

    def explain(self, fit: Fit) -> Explanation:
        """The fit with what it predicts of the held-out records, their starts fitted."""
        records = self.records
        held_out = self.held_out
        begin = self._start_with_zeros(held_out, fit.start)
        touching = self.starts_feel_contacts and fit.non_smooth
        start, e = fit_record_starts(held_out, fit.deviations, fit.effects, begin, touching=touching)
        residuals = records.residuals_from(fit.residual_coefficients)
        held_out_residuals = held_out.residuals_from(e)
        start_cost = 0.5 * np.sum((start.states / held_out.state_spread) ** 2, axis=1)
        losses = np.concatenate([records.losses(fit.residual_coefficients), held_out.losses(e) + start_cost])
        shares = [records.rms_shares(residuals), held_out.rms_shares(held_out_residuals)]
        ratios = [
            mean_square_left(records.energies(residuals, carried=True)),
            mean_square_left(held_out.energies(held_out_residuals, carried=True)),
        ]
        return Explanation(
            fit,
            log_likelihoods=-losses,
            log_prior=-fit.prior_loss,
            log_volume=log_occam_factor(records, fit),
            residuals=residuals,
            held_out_residuals=held_out_residuals,
            residual_shares=np.array(shares),
            energy_ratios=np.array(ratios),
        )

    def whitened_residuals(
        self, explanation: Explanation, experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """See `SearchLoop.whitened_residuals`; what the explanation holds, nothing is simulated."""
        records = (*self.records.experiments, *self.held_out.experiments)
        residuals = (*explanation.residuals, *explanation.held_out_residuals)
        of_all = {e.name: left / self.case.noise for e, left in zip(records, residuals, strict=True)}
        if experiments is None:
            experiments = self.case.experiments
        return {e.name: of_all[e.name] for e in experiments}

    @cached_property
    def uninteresting_energy(self) -> float:
        """See `SearchLoop.uninteresting_energy`: the share of the motion that no fit follows either."""
        share = UNINTERESTING * self.case.machine.weighing.model_error
        # A single estimation record is no log that is left out.
        compared = [self.held_out]
        if len(self.case.estimation) > 1:
            compared = [self.records, self.held_out]
        motion = [records.levels.motion_energy.reshape(-1, self.case.noise.size) for records in compared]
        return share**2 * float(np.sum(np.concatenate(motion) / self.case.noise**2))

    def prediction_residuals(
        self, log: int, deviations: Real, effects: Sequence[Any], start: FittedStart
    ) -> Real:
        """(T, Y) (measured - model) / noise of an estimation record of which nothing but its start is fitted.

        log : its place among the estimation records. deviations : (P,), in tolerances off. start : of all
        estimation records. In windows what is left has no part of what starts of windows do. Not finite where
        the simulation runs away.
        """
        if log not in self._single_logs:
            record = self.case.estimation[log]
            self._single_logs[log] = Records(self.case, (record,), self.windows)
            self.timed_records = (*self.timed_records, self._single_logs[log])
        records = self._single_logs[log]
        begin = FittedStart(start.states[log : log + 1], start.zeros)
        _, e = fit_record_starts(records, deviations, effects, begin)
        return np.asarray(records.residuals_from(e)[0] / self.case.noise)

    def _start_with_zeros(self, records: Records, fitted: FittedStart) -> FittedStart:
        """Starts of records as their first samples say, sensors at the zeros that others were fitted to."""
        start = records.guessed_start()
        if start.zeros.size == 0:
            return start
        return start.with_zeros(fitted.zeros, self.case.machine.unknown_start.state_per_zero)
