"""The loop over moves that every search is, and the moves that a judge asks for."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, Self

import numpy as np

from diagnosis.evidence.explanation import E, best_of_sets
from diagnosis.fit.descent import Fit, best_after_following, descend
from diagnosis.fit.likelihood import DECISIVE
from diagnosis.fit.records import FittedStart, RecordsToFit
from diagnosis.fit.starts import StartPoint, point_of
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from plant.effects.search_space import Candidate

# Called with the share done (0 to 1) and what is being done.
Progress = Callable[[float, str], None]

# How many of a ranking are followed where each takes many simulations: ends refined where contacts switch,
# scans. The best and its nearest rival.
FOLLOWED_COSTLY = 2
# How many sets, or starts of one effect, are followed.
FOLLOWED_SETS = 4
# How many effects are followed, alone or beside another.
FOLLOWED_EFFECTS = 6
# What an effect needs that a time limit left out, in the answer's words.
TIME = "more time"


class Move(ABC):
    """Something that a search may try next."""

    @property
    @abstractmethod
    def what(self) -> str:
        """In words, for whoever waits, and for what a time limit left out."""

    @abstractmethod
    def apply(self, search: SearchLoop[Any]) -> None:
        """Fit, and add what comes of it to the search's explanations or start points."""


class OutOfTimeError(BaseException):
    """Ends a fit on its way.

    No Exception, so that nobody who catches a simulation's own errors catches this one.
    """


class SearchLoop(ABC, Generic[E]):
    """Everything that was fitted to the records of a case.

    Attributes
    ----------
    case, progress
        As given.
    deadline_s : float
        Of time.monotonic(); after it nothing more is tried.
    records : RecordsToFit
        Estimation records that are fitted.
    explanations : list
        Everything that was fitted, in the order in which it was; the nominal machine alone is the first.
    skipped_for_time : list of str
        What was not tried because of the deadline, as moves call it.
    start_points : list of (Candidate, list of StartPoint)
        Of every candidate that may be there, where it may be descended from, best first.
    unfinished : list of (Fit, list of StartPoint)
        Ends of effects alone that are not yet finished, with their start points.
    timed_records : tuple of RecordsToFit
        Whose simulations are counted, and ended by a time limit.
    starts_feel_contacts : bool
        Whether starts of records that are only predicted are sought with contacts that switch.
    """

    records: RecordsToFit

    def __init__(self, case: CaseOfMachine, progress: Progress, deadline_s: float = np.inf) -> None:
        self.case = case
        self.progress = progress
        self.deadline_s = deadline_s
        self.explanations: list[E] = []
        self.skipped_for_time: list[str] = []
        self.start_points: list[tuple[Candidate, list[StartPoint]]] = []
        self.unfinished: list[tuple[Fit, list[StartPoint]]] = []
        self.timed_records: tuple[RecordsToFit, ...] = ()
        self.starts_feel_contacts = False
        # Already fitted: sets without one of their effects, with a simpler one, with another in its place.
        self._already_reduced: set[tuple[object, ...]] = set()

    def for_case(self, case: CaseOfMachine) -> SearchLoop[E]:
        """An empty search of another form of the same records, within the same time."""
        return type(self)(case, self.progress, self.deadline_s)

    @property
    def nominal_alone(self) -> E:
        """The explanation by no effect. Raises IndexError before it is fitted."""
        return self.explanations[0]

    @property
    def likeliest(self) -> E:
        """The explanation of the largest evidence."""
        return max(self.explanations, key=lambda explanation: explanation.log_evidence)

    @property
    def simulations(self) -> int:
        """Records that were simulated so far."""
        return sum(records.simulations for records in self.timed_records)

    @property
    def out_of_time(self) -> bool:
        """Whether the deadline is over."""
        return time.monotonic() > self.deadline_s

    @abstractmethod
    def run(self) -> None:
        """The whole search, the nominal machine first."""

    def run_in_time(self) -> Self:
        """The search after its end or its deadline, whatever is being fitted then.

        The nominal machine is fitted in any case. Effects of which nothing was fitted are named among
        `skipped_for_time`.
        """

        def end_when_late() -> None:
            if self.explanations and self.out_of_time:
                raise OutOfTimeError

        timed_records = self.timed_records if np.isfinite(self.deadline_s) else ()
        for records in timed_records:
            records.before_each = end_when_late
        try:
            self.run()
        except OutOfTimeError:
            fitted = {name for explanation in self.explanations for name in explanation.names}
            known = fitted | set(self.skipped_for_time)
            self.skipped_for_time += [name for name in self.case.machine.weighing.listed if name not in known]
            self.skipped_for_time.append("what was being fitted")
        for records in timed_records:
            records.before_each = lambda: None
        return self

    @property
    def untried(self) -> dict[str, str]:
        """Effect that was not tried -> what it needs: more time, or what the machine says."""
        listed = self.case.machine.weighing.listed
        late = {name: TIME for name in listed if name in self.skipped_for_time}
        return late | getattr(self.case.machine, "inactive", {})

    @property
    @abstractmethod
    def unexplained(self) -> bool:
        """Whether the likeliest leaves something that interests."""

    @abstractmethod
    def explain(self, fit: Fit) -> E:
        """A fit with what it leaves, weighed; not added to the explanations."""

    @abstractmethod
    def whitened_residuals(
        self, explanation: E, experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """Name of the record -> (measured - model)/noise (T, Y), of the given records (default: all)."""

    @property
    def uninteresting_energy(self) -> float:
        """Energy, over noise, of what a good model may miss in the logs that repairs are compared in; 0 where
        the simulation is to be as good as the sensors."""
        return 0.0

    @abstractmethod
    def prediction_residuals(
        self, log: int, deviations: Real, effects: Sequence[Any], start: FittedStart
    ) -> Real:
        """What a model leaves of an estimation record of which nothing but its start is fitted.

        Parameters
        ----------
        log : int
            Place of the record among the estimation records.
        deviations : (P,) array
            Nominal values, in tolerances off.
        effects : sequence
            With their sizes.
        start : FittedStart
            Of all estimation records; the states of this one are where its own are sought from.

        Returns
        -------
        (T, Y) array
            (measured - model) / noise; not finite where the simulation runs away.
        """

    @abstractmethod
    def candidate_alone(
        self, candidate: Candidate, points: list[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """A candidate and its start points beside the nominal machine, as they are tried from then on.

        No points where it need not be tried.
        """

    @abstractmethod
    def candidate_beside(
        self, parent: Fit, candidate: Candidate, points: Sequence[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """A candidate and some of its start points beside a set, simulated, best first."""

    @abstractmethod
    def polish(self, fit: Fit, rank: int, around: Fit) -> Fit:
        """A fit descended on as far as it is worth.

        Parameters
        ----------
        fit : Fit
            With one more effect than `around`, roughly descended.
        rank : int
            Its place, from 0, by loss among those that were tried together.
        around : Fit
            Beside which they were tried.
        """

    def apply_moves(self, moves: Iterable[Move], begin: float, share: float = 0.0) -> None:
        """Apply moves as long as there is time.

        Moves of an iterator may depend on what those before them led to.

        Parameters
        ----------
        moves : iterable
            In the order in which they are applied.
        begin, share : float
            Of the progress, 0 to 1: where it stands before, and what all of them are.
        """
        count = len(moves) if isinstance(moves, Sequence) else 1
        for k, move in enumerate(moves):
            self.progress(begin + share * min(k / count, 1.0), move.what)
            if not self.skips(move.what):
                move.apply(self)

    def skips(self, what: str) -> bool:
        """Whether there is no time for something, which is then noted."""
        if not self.out_of_time:
            return False
        if what not in self.skipped_for_time:
            self.skipped_for_time.append(what)
        return True

    def add(self, fit: Fit) -> E:
        """The explanation by a fit, added to all others."""
        explanation = self.explain(fit)
        self.explanations.append(explanation)
        return explanation

    def finish_single_effects(self) -> None:
        """Descend the unfinished ends of effects alone as far as they are worth, and add them."""
        ranked = sorted(self.unfinished, key=lambda pair: pair[0].loss)
        for rank, (fit, points) in enumerate(ranked):
            explanation = self.add(self.polish(fit, rank, self.nominal_alone.fit))
            # Where it ended alone may be far from every start, and right beside another effect.
            points.insert(0, point_of(explanation.fit))

    def add_simpler(self, explanation: E) -> None:
        """Add the set with effects in place of those that contain them, from where these ended.

        Further values may have led out of a minimum in which the simpler effect was left.
        """
        fit = explanation.fit
        first = 0
        for k, containing in enumerate(fit.candidates):
            for simpler, _ in self.start_points:
                if simpler.effect != containing.kind.contains:
                    continue
                if self._is_known(*explanation.names, explanation.log_evidence, simpler.effect):
                    continue
                candidates = (*fit.candidates[:k], simpler, *fit.candidates[k + 1 :])
                # The further values stand behind those that both have.
                further = slice(first + len(simpler.axes), first + len(containing.axes))
                coordinates = np.delete(fit.coordinates, further)
                self.add(descend(self.records, candidates, fit.deviations, coordinates, fit.start))
            first += len(containing.axes)

    def add_exchanged(self, explanation: E, sought: Iterable[str]) -> None:
        """Add the set with one of its effects replaced by another that is as likely in a part of the set.

        Larger sets are sought beside the likeliest parts alone: of two effects that no record tells apart,
        the one that was extended would win by what was found beside it.

        Parameters
        ----------
        explanation
            The set.
        sought : iterable of str
            Effects that may be replaced.
        """
        best = best_of_sets(self.explanations)
        for k, name in enumerate(explanation.names):
            if name not in sought:
                continue
            # The other effects of the set, and what each of them contains.
            remaining = {c.effect: c.kind.contains for c in explanation.fit.candidates if c.effect != name}
            for rival in list(best.values()):
                # A rival is a part of the set with one new effect in the place of this one.
                new_names = set(rival.names) - set(explanation.names)
                shared = set(rival.names) - new_names
                part = best.get(tuple(sorted({*shared, name})))
                if len(new_names) != 1 or not shared <= remaining.keys() or part is None:
                    continue
                (new,) = (c for c in rival.fit.candidates if c.effect in new_names)
                exchanged_set = tuple(sorted((*remaining, new.effect)))
                is_contained = new.effect in remaining.values() or new.kind.contains in remaining
                is_unlikely = rival.log_evidence < part.log_evidence - DECISIVE
                if exchanged_set in best or is_contained or is_unlikely:
                    continue

                without = best.get(tuple(sorted(remaining))) or self.without_effect(explanation, k)
                around = without.fit
                if self._is_known(*exchanged_set, around.loss, explanation.log_evidence, rival.log_evidence):
                    continue
                new_coordinates = rival.fit.coordinates_of(rival.names.index(new.effect))
                coordinates = np.concatenate([around.coordinates, new_coordinates])
                candidates = (*around.candidates, new)
                # Not where much more is left than with the effect that is replaced.
                loss, d, x = best_after_following(self.records, around, candidates, [coordinates])
                if loss < explanation.fit.loss + DECISIVE:
                    fit = descend(self.records, candidates, d, x, around.start)
                    best[exchanged_set] = self.add(fit)

    def without_effect(self, explanation: E, k: int) -> E:
        """The best explanation by the same effects but the k-th, fitted from here if it was not before."""
        fit = explanation.fit
        kept_places = [j for j in range(len(fit.candidates)) if j != k]
        candidates = tuple(fit.candidates[j] for j in kept_places)
        sorted_names = tuple(sorted(candidate.effect for candidate in candidates))
        if candidates and not self._is_known(*explanation.names, explanation.log_evidence, k):
            coordinates = np.concatenate([fit.coordinates_of(j) for j in kept_places])
            self.add(descend(self.records, candidates, fit.deviations, coordinates, fit.start))
        return self._best_of_set(sorted_names)

    def with_only(self, names: Sequence[str], explanation: E) -> E:
        """The best explanation by some of the effects of an explanation alone.

        Parameters
        ----------
        names : sequence of str
            Effects to be kept, all of them among those of the explanation.
        explanation
            Where a fit by these begins if there is none; it is the answer itself if it has no others.
        """
        sorted_names = tuple(sorted(names))
        if explanation.sorted_names == sorted_names:
            return explanation
        while not any(other.sorted_names == sorted_names for other in self.explanations):
            k = next(k for k, name in enumerate(explanation.names) if name not in names)
            explanation = self.without_effect(explanation, k)
        return self._best_of_set(sorted_names)

    def _best_of_set(self, sorted_names: tuple[str, ...]) -> E:
        """The likeliest explanation by a set, which must have one."""
        of_set = [
            explanation for explanation in self.explanations if explanation.sorted_names == sorted_names
        ]
        return max(of_set, key=lambda explanation: explanation.log_evidence)

    def _is_known(self, *reduction: object) -> bool:
        """Whether a reduction of a set was fitted before; from now on it was."""
        if reduction in self._already_reduced:
            return True
        self._already_reduced.add(reduction)
        return False
