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

Progress = Callable[[float, str], None]

# How many of what is ranked are followed: what takes many simulations each (ends refined where contacts
# switch, scans), sets, and effects alone or beside another.
FOLLOWED_COSTLY, FOLLOWED_SETS, FOLLOWED_EFFECTS = 2, 4, 6


class Move(ABC):
    """what: in words, for whoever waits, and for what a time limit left out."""

    @property
    @abstractmethod
    def what(self) -> str: ...

    @abstractmethod
    def apply(self, search: SearchLoop[Any]) -> None: ...


# What an effect needs that a time limit left out.
TIME = "more time"


class OutOfTimeError(BaseException):
    """Ends a fit on its way; a simulation's own errors are none of it."""


class SearchLoop(ABC, Generic[E]):
    """All that was fitted to the records of a case, the nominal alone first.

    deadline_s : of time.monotonic(); after it nothing more is tried, and `skipped_for_time` names what was
    not.
    points : of every candidate, where it may start, best first. rough : ends of effects alone that are not
        yet finished, with these.
    """

    records: RecordsToFit

    def __init__(self, case: CaseOfMachine, progress: Progress, deadline_s: float = np.inf) -> None:
        self.case, self.progress, self.deadline_s = case, progress, deadline_s
        self.explanations: list[E] = []
        self.skipped_for_time: list[str] = []
        self.start_points: list[tuple[Candidate, list[StartPoint]]] = []
        self.unfinished: list[tuple[Fit, list[StartPoint]]] = []
        # Whose simulations are counted, and ended by a time limit.
        self.timed_records: tuple[RecordsToFit, ...] = ()
        # Whether starts of records that are only predicted feel contacts.
        self.starts_feel_contacts = False
        # Already tried: sets without one of their effects, with a simpler one, with another in its place.
        self._reduced: set[tuple[object, ...]] = set()

    def for_case(self, case: CaseOfMachine) -> SearchLoop[E]:
        """Of the same records in another form."""
        return type(self)(case, self.progress, self.deadline_s)

    @property
    def nominal_alone(self) -> E:
        return self.explanations[0]

    @property
    def likeliest(self) -> E:
        return max(self.explanations, key=lambda e: e.log_evidence)

    @property
    def simulations(self) -> int:
        return sum(records.simulations for records in self.timed_records)

    @property
    def out_of_time(self) -> bool:
        return time.monotonic() > self.deadline_s

    @abstractmethod
    def run(self) -> None:
        """All of it, the nominal first."""

    def run_in_time(self) -> Self:
        """To its end or to its deadline, whatever is being fitted then, once the nominal is."""

        def watch() -> None:
            if self.explanations and self.out_of_time:
                raise OutOfTimeError

        watched = self.timed_records if np.isfinite(self.deadline_s) else ()
        for records in watched:
            records.before_each = watch
        try:
            self.run()
        except OutOfTimeError:
            fitted = {name for e in self.explanations for name in e.names} | {*self.skipped_for_time}
            self.skipped_for_time += [n for n in self.case.machine.weighing.listed if n not in fitted]
            self.skipped_for_time.append("what was being fitted")
        for records in watched:
            records.before_each = lambda: None
        return self

    @property
    def untried(self) -> dict[str, str]:
        """Effect -> what it needs to be tried."""
        late = {name: TIME for name in self.case.machine.weighing.listed if name in self.skipped_for_time}
        return late | getattr(self.case.machine, "inactive", {})

    @property
    @abstractmethod
    def unexplained(self) -> bool:
        """Whether the likeliest leaves something that interests."""

    @abstractmethod
    def explain(self, end: Fit) -> E:
        """An end with what it leaves, weighed."""

    @abstractmethod
    def whitened_residuals(
        self, found: E, experiments: Sequence[RecordOfMachine] | None = None
    ) -> dict[str, Real]:
        """experiment -> (measured - model)/noise (T, Y), of the given ones (default: all)."""

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
        """A candidate and its points beside the nominal as they are tried from then on."""

    @abstractmethod
    def candidate_beside(
        self, parent: Fit, candidate: Candidate, points: Sequence[StartPoint]
    ) -> tuple[Candidate, list[StartPoint]]:
        """A candidate and some of its points beside a set, simulated, best first."""

    @abstractmethod
    def polish(self, end: Fit, rank: int, around: Fit) -> Fit:
        """An end beside a fit, the rank-th of those tried together, as far as it is worth."""

    def apply_moves(self, moves: Iterable[Move], begin: float, share: float = 0.0) -> None:
        """As long as there is time; begin, share: of the progress."""
        count = len(moves) if isinstance(moves, Sequence) else 1
        for k, move in enumerate(moves):
            self.progress(begin + share * min(k / count, 1.0), move.what)
            if not self.skips(move.what):
                move.apply(self)

    def skips(self, what: str) -> bool:
        if not self.out_of_time:
            return False
        if what not in self.skipped_for_time:
            self.skipped_for_time.append(what)
        return True

    def add(self, end: Fit) -> E:
        explained = self.explain(end)
        self.explanations.append(explained)
        return explained

    def finish_single_effects(self) -> None:
        """What was found of every effect alone, as far as it is worth."""
        for k, (end, points) in enumerate(sorted(self.unfinished, key=lambda one: one[0].loss)):
            found = self.add(self.polish(end, k, self.nominal_alone.fit))
            # Where it ended alone may be far from every start, and right beside another effect.
            points.insert(0, point_of(found.fit))

    def add_simpler(self, explanation: E) -> None:
        """The same with effects in place of those that contain them, from where these ended: further values
        may have led out of a minimum in which the simpler effect was left."""
        end = explanation.fit
        for k, containing in enumerate(end.candidates):
            for candidate in [c for c, _ in self.start_points if c.effect == containing.kind.contains]:
                if (
                    this := (*explanation.names, explanation.log_evidence, candidate.effect)
                ) in self._reduced:
                    continue
                self._reduced.add(this)
                candidates = (*end.candidates[:k], candidate, *end.candidates[k + 1 :])
                first = sum(len(c.axes) for c in end.candidates[:k]) + len(candidate.axes)
                x = np.delete(
                    end.coordinates, slice(first, first + len(containing.axes) - len(candidate.axes))
                )
                self.add(descend(self.records, candidates, end.deviations, x, end.start))

    def add_exchanged(self, explanation: E, sought: Iterable[str]) -> None:
        """The same with one of the effects sought replaced by another, as likely in a part of the set.

        Larger sets are sought beside the likeliest parts alone: of two effects that no record tells apart,
        the one that was extended would win by what was found beside it.
        """
        best = best_of_sets(self.explanations)
        for k, name in enumerate(explanation.names):
            if name not in sought:
                continue
            rest = {c.effect: c.kind.contains for c in explanation.fit.candidates if c.effect != name}
            for rival in [*best.values()]:
                new = set(rival.names) - {*explanation.names}
                kept = set(rival.names) - new
                part = best.get(tuple(sorted({*kept, name})))
                if len(new) != 1 or not kept <= rest.keys() or part is None:
                    continue
                (other,) = (c for c in rival.fit.candidates if c.effect in new)
                key = tuple(sorted((*rest, other.effect)))
                contained = other.effect in rest.values() or other.kind.contains in rest
                if key in best or contained or rival.log_evidence < part.log_evidence - DECISIVE:
                    continue
                around = (best.get(tuple(sorted(rest))) or self.without_effect(explanation, k)).fit
                if (
                    this := (*key, around.loss, explanation.log_evidence, rival.log_evidence)
                ) in self._reduced:
                    continue
                self._reduced.add(this)
                at = rival.fit.coordinates_of(rival.names.index(other.effect))
                x, candidates = np.concatenate([around.coordinates, at]), (*around.candidates, other)
                # Not where much more is left than with the effect that is replaced.
                followed, d, x = best_after_following(self.records, around, candidates, [x])
                if followed < explanation.fit.loss + DECISIVE:
                    best[key] = self.add(descend(self.records, candidates, d, x, around.start))

    def without_effect(self, explanation: E, k: int) -> E:
        """The best explanation by the same effects but the k-th."""
        end = explanation.fit
        rest = tuple(c for j, c in enumerate(end.candidates) if j != k)
        key = tuple(sorted(c.effect for c in rest))
        if rest and (this := (*explanation.names, explanation.log_evidence, k)) not in self._reduced:
            self._reduced.add(this)
            x = np.concatenate([end.coordinates_of(j) for j in range(len(end.candidates)) if j != k])
            self.add(descend(self.records, rest, end.deviations, x, end.start))
        return max((e for e in self.explanations if e.sorted_names == key), key=lambda e: e.log_evidence)

    def with_only(self, chosen: Sequence[str], within: E) -> E:
        """The best explanation by these effects alone, `within` itself where it has no others."""
        key = tuple(sorted(chosen))
        if within.sorted_names == key:
            return within
        while not any(e.sorted_names == key for e in self.explanations):
            k = next(k for k, name in enumerate(within.names) if name not in chosen)
            within = self.without_effect(within, k)
        return max((e for e in self.explanations if e.sorted_names == key), key=lambda e: e.log_evidence)
