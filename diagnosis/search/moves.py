"""What a search may try next. Each move says what it is, and descends when it is applied.

What moves lead to is one of `Search.explanations`; which of them are proposed depends on what was found
before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import find_peaks

from diagnosis.evidence.explanation import WeighedFit, best_of_sets
from diagnosis.fit.descent import Fit, best_after_following, descend, refine_sizes, scan_far_values
from diagnosis.fit.likelihood import DECISIVE, SUBSTANTIAL, WORTH_IT
from diagnosis.fit.nominal import EDGE
from diagnosis.fit.records import FittedStart, Records
from diagnosis.fit.starts import StartPoint, beside, point_of, points_of, superposed
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from diagnosis.search.loop import FOLLOWED_COSTLY, FOLLOWED_EFFECTS, FOLLOWED_SETS, Move, SearchLoop
from diagnosis.search.settled import fit_record_starts
from diagnosis.search.windows import in_windows
from plant.effects import LOOK_ALIKES, Effect
from plant.effects.search_space import Candidate

# Iterations from each start (with five the serial link's first stage ends 5 % higher).
_ITERATIONS = 9
# Effects that are descended on alone; of more, those of which superposition leaves least that are simulated
# beside a set.
_DESCENDED, _SIMULATED = 36, 24


@dataclass(frozen=True, eq=False)
class Alone(Move):
    """Where an effect alone may start."""

    candidate: Candidate

    @property
    def what(self) -> str:
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> list[Alone]:
        """But those that contain a simpler one."""
        spaces = search.case.machine.candidates(search.case.experiments)
        return [cls(candidate) for candidate in spaces if candidate.kind.contains is None]

    def apply(self, search: SearchLoop[Any]) -> None:
        points = points_of(search.records, search.nominal_alone.fit, self.candidate)
        if points:
            candidate, points = search.candidate_alone(self.candidate, points)
        if points:
            search.start_points.append((candidate, points))


@dataclass(frozen=True, eq=False)
class FromPoints(Move):
    """An effect alone, from the best of its starts."""

    candidate: Candidate
    points: list[StartPoint]

    @property
    def what(self) -> str:
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> list[FromPoints]:
        """Of many those whose starts leave least; the others are still tried beside these."""
        return [cls(*one) for one in sorted(search.start_points, key=lambda one: one[1][0].loss)[:_DESCENDED]]

    def apply(self, search: SearchLoop[Any]) -> None:
        around = search.nominal_alone.fit
        end = descended(search, around, self.candidate, self.points, around.jacobian)
        search.unfinished.append((end, self.points))


def descended(
    search: SearchLoop[Any],
    around: Fit,
    candidate: Candidate,
    points: Sequence[StartPoint],
    nominal: Real,
) -> Fit:
    """The best end of a candidate beside a fit, from its best points that are apart."""
    chosen, most = [points[0]], FOLLOWED_SETS if _turned(search, candidate) else FOLLOWED_COSTLY
    for point in points[1:]:
        if len(chosen) == most or point.loss > search.nominal_alone.fit.loss + WORTH_IT:
            break
        if all(point.far_from(other) for other in chosen):
            chosen.append(point)
    further = [point for point in _local_minima(points) if all(map(point.far_from, chosen))]
    chosen += further[:1]
    ends = [_from(search, around, candidate, point, nominal) for point in chosen]
    return min(ends, key=lambda end: end.loss)


def _turned(search: SearchLoop[Any], candidate: Candidate) -> bool:
    return candidate.kind.absolute_angle and not search.case.machine.unknown_start.zero_seen


def _from(
    search: SearchLoop[Any],
    around: Fit,
    candidate: Candidate,
    point: StartPoint,
    nominal: Real,
) -> Fit:
    return descend(
        search.records,
        (*around.candidates, candidate),
        point.deviations,
        np.concatenate([around.coordinates, point.coordinates]),
        point.start,
        nominal_jacobian=nominal,
        columns=around.start_columns,
        iterations=_ITERATIONS,
    )


@dataclass(frozen=True, eq=False)
class Enlarge(Move):
    """An effect that contains a simpler one (Stribeck friction Coulomb's), from where a set of that ended."""

    candidate: Candidate
    inner: Fit
    starts: Sequence[Real]

    @property
    def what(self) -> str:
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any], sets: Sequence[WeighedFit]) -> Iterator[Enlarge]:
        """With several further values the first time, then with those that this found."""
        pool = list(best_of_sets(sets).values())
        for candidate in search.case.machine.candidates(search.case.experiments):
            for inner in [e.fit for e in pool if candidate.kind.contains in e.names]:
                known = [points[0] for c, points in search.start_points if c.effect == candidate.effect]
                starts = [point.coordinates[1:] for point in known]
                starts = starts or [np.array(x) for x in sorted({x[1:] for x in candidate.starts})[::2]]
                yield cls(candidate, inner, starts)

    def apply(self, search: SearchLoop[Any]) -> None:
        inner, candidate = self.inner, self.candidate
        k = inner.names.index(str(candidate.kind.contains))
        first = sum(len(c.axes) for c in inner.candidates[: k + 1])
        ends = [
            descend(
                search.records,
                (*inner.candidates[:k], candidate, *inner.candidates[k + 1 :]),
                inner.deviations,
                np.concatenate([inner.coordinates[:first], further, inner.coordinates[first:]]),
                inner.start,
                nominal_jacobian=inner.jacobian[:, : inner.deviations.size],
                columns=inner.start_columns,
                iterations=_ITERATIONS,
            )
            for further in self.starts
        ]
        best = min(ends, key=lambda end: end.loss)
        if len(best.names) == 1:
            search.start_points.append((candidate, [point_of(best)]))
        search.add(best)


@dataclass(frozen=True, eq=False)
class BesideSet(Move):
    """The most promising effects beside a set."""

    parent: Fit
    most: int

    @property
    def what(self) -> str:
        return f"further effects beside {' and '.join(self.parent.names)}"

    @classmethod
    def proposed(cls, search: SearchLoop[Any], count: int) -> list[BesideSet]:
        """Sets of so many effects, from the likeliest of one fewer. Several of these while something that
        interests is left, for what is left says little about which member of the true set has been found;
        then those as likely as the likeliest of all sets: a small effect beside one of two that look alike
        decides between them. What interests is unknown where nobody has stated it."""
        pool = list(best_of_sets(search.explanations).values())
        parents = [e for e in pool if len(e.names) == count - 1][: 3 if count == 2 else 1]
        if search.case.machine.weighing.stated and not search.unexplained:
            parents = [e for e in parents if e.log_evidence > pool[0].log_evidence - DECISIVE]
        return [cls(parent.fit, FOLLOWED_EFFECTS if count == 2 else FOLLOWED_SETS) for parent in parents]

    def apply(self, search: SearchLoop[Any]) -> None:
        parent = self.parent
        trials = sorted(self._trials(search), key=lambda trial: trial[1].loss)
        most_pulled = FOLLOWED_COSTLY * self.most if len(search.start_points) > _DESCENDED else len(trials)
        chosen: dict[tuple[str, float], tuple[Candidate, StartPoint]] = {}
        for candidate, point in trials:
            pulled = candidate.kind.multiplies is not None and np.any(np.abs(parent.deviations) > EDGE)
            if len(chosen) < self.most or (pulled and len(chosen) < most_pulled):
                # Beside contacts that switch, and values pulled far, the one side may look better and the
                # other be so.
                side = candidate.axes[0].low if parent.non_smooth or pulled else 0.0
                chosen.setdefault((candidate.effect, side), (candidate, point))
        nominal = parent.jacobian[:, : parent.deviations.size]
        # What is not worth it once all else has followed is not descended on; unless it is so much worse that
        # the linearisation says nothing (of 325 in between, one ended more than 15 below).
        ends = [
            _from(search, parent, candidate, point, nominal)
            for candidate, point in chosen.values()
            if not -DECISIVE < parent.loss - point.loss < SUBSTANTIAL
        ]
        for k, end in enumerate(sorted(ends, key=lambda end: end.loss)):
            search.add(search.polish(end, k, parent))

    def _trials(self, search: SearchLoop[Any]) -> Iterator[tuple[Candidate, StartPoint]]:
        """The best point of every candidate beside the parent."""
        held = {name for c in self.parent.candidates for name in (c.effect, c.kind.contains)} - {None}
        listed = [(c, p) for c, p in search.start_points if not {c.effect, c.kind.contains} & held]
        if len(search.start_points) > _DESCENDED:

            def left(one: tuple[Candidate, list[StartPoint]]) -> float:
                return min((p.loss for p in superposed(search.records, self.parent, one[1])), default=-np.inf)

            listed = sorted(listed, key=left)[:_SIMULATED]
        for candidate, points in listed:
            # A frequency, and a zero that no other output tells, may be any other beside another effect.
            anew = candidate.kind.harmonic is not None or _turned(search, candidate)
            candidate, near = search.candidate_beside(self.parent, candidate, points[:1] if anew else points)
            if anew:
                further = points_of(search.records, self.parent, candidate, every=2)[:FOLLOWED_SETS]
                if candidate.kind.harmonic is not None:
                    # Their losses are a linear arm's; where it is not, they may leave less than it would.
                    further += beside(search.records, self.parent, candidate, further)
                near += further
            yield from ((candidate, point) for point in sorted(near, key=lambda point: point.loss)[:1])


@dataclass(frozen=True, eq=False)
class InPlaceOf(Move):
    """An effect that multiplies a nominal value, in place of that value pulled beyond belief."""

    parent: Fit
    candidate: Candidate
    coordinates: Real
    deviations: Real

    @property
    def what(self) -> str:
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any], parent: Fit) -> Iterator[InPlaceOf]:
        nominal, listed = search.records.nominal, [candidate for candidate, _ in search.start_points]
        factors = nominal.factors(parent.deviations)
        for k, key in enumerate(nominal.keys):
            if abs(parent.deviations[k]) < EDGE:
                continue
            found = in_place_of(key, factors[key], listed)
            if found is not None and found[0].effect not in parent.names:
                yield cls(parent, *found, np.where(np.arange(nominal.count) == k, 0.0, parent.deviations))

    def apply(self, search: SearchLoop[Any]) -> None:
        point = StartPoint(self.parent.loss, self.coordinates, self.deviations, self.parent.start)
        nominal = self.parent.jacobian[:, : self.deviations.size]
        end = _from(search, self.parent, self.candidate, point, nominal)
        search.add(search.polish(end, 0, self.parent))


def in_place_of(key: str, factor: float, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The effect that multiplies a nominal parameter by this factor, or by the nearest one worth a name."""
    sign = 1 if factor > 1 else -1
    for candidate in listed:
        if candidate.kind.multiplies == key and candidate.sign == sign:
            return candidate, np.clip([candidate.axes[0].coordinate(factor)], *candidate.box)
    return None


@dataclass(frozen=True, eq=False)
class InWindows(Move):
    """Torques over the angle and what stands beside them, from where fits in windows ended."""

    acting: Sequence[Candidate]

    @property
    def what(self) -> str:
        return "fits in windows"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> list[InWindows]:
        acting = [
            c for c, _ in search.start_points if c.kind.absolute_angle or c.kind.harmonic == "hub_angle"
        ]
        return [cls(acting)] if acting and isinstance(search.case, Case) else []

    def apply(self, search: SearchLoop[Any]) -> None:
        assert isinstance(search.case, Case)
        base, states = search.nominal_alone.fit, search.records.state_spread.size
        windows = search.for_case(in_windows(search.case))
        assert isinstance(windows.records, Records)
        start, _ = fit_record_starts(windows.records, base.deviations, (), windows.records.guessed_start())
        windows.add(base.continued(windows.records, start))
        around = windows.nominal_alone.fit
        for candidate in self.acting:
            points = points_of(windows.records, around, candidate)
            if points and not search.skips(self.what):
                windows.add(descended(windows, around, candidate, points, around.jacobian))
        windows.start_points = [(c, points) for c, points in search.start_points if c.kind.harmonic != "time"]
        best = min((e.fit for e in windows.explanations), key=lambda end: end.loss)
        if best.loss > around.loss - DECISIVE:
            return
        if not search.skips(self.what):
            BesideSet(best, FOLLOWED_SETS).apply(windows)
        for count in (1, 2):
            of_count = [e.fit for e in windows.explanations if len(e.names) == count]
            for end in sorted(of_count, key=lambda end: end.loss)[:FOLLOWED_COSTLY]:
                start = FittedStart(end.start.states[:, :states], end.start.zeros)
                search.add(refine_sizes(search.records, end.continued(search.records, start)))


@dataclass(frozen=True, eq=False)
class Scan(Move):
    """A set with contacts once more from far values of all its parameters."""

    end: Fit

    @property
    def what(self) -> str:
        return "scans of sets with contacts"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> Iterator[Scan]:
        """The likeliest that is left, or has gained since its last."""
        done: dict[tuple[str, ...], float] = {}
        for _ in range(FOLLOWED_COSTLY):
            likeliest = (
                e
                for key, e in best_of_sets(search.explanations).items()
                if e.fit.non_smooth and e.fit.loss < done.get(key, np.inf) - SUBSTANTIAL
            )
            this = next(likeliest, None)
            if this is None:
                return
            done[this.sorted_names] = this.fit.loss
            yield cls(this.fit)

    def apply(self, search: SearchLoop[Any]) -> None:
        search.add(refine_sizes(search.records, scan_far_values(search.records, self.end)))


@dataclass(frozen=True, eq=False)
class FromContacts(Move):
    """A set with contacts once more from starts of the records that feel them."""

    end: Fit

    @property
    def what(self) -> str:
        return "starts of records in free play"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> Iterator[FromContacts]:
        """The likeliest sets of each size."""
        if not search.case.machine.unknown_start.tried.size:
            return
        search.starts_feel_contacts = True
        sets = [e for e in best_of_sets(search.explanations).values() if e.fit.non_smooth]
        for count in range(1, search.case.machine.weighing.most_effects + 1):
            for e in [e for e in sets if len(e.names) == count][:FOLLOWED_COSTLY]:
                yield cls(e.fit)

    def apply(self, search: SearchLoop[Any]) -> None:
        end = self.end
        assert isinstance(search.records, Records)
        start, _ = fit_record_starts(search.records, end.deviations, end.effects, end.start, touching=True)
        nominal = end.jacobian[:, : end.deviations.size]
        again = end.continued(
            search.records, start, nominal_jacobian=nominal, touching=True, iterations=_ITERATIONS
        )
        search.add(min(end, again, key=lambda one: one.loss))


@dataclass(frozen=True, eq=False)
class LookAlike(Move):
    """A cause beyond the list in place of the effect that it looks like."""

    end: Fit
    kind: type[Effect]

    @property
    def what(self) -> str:
        return "causes beyond the list that look like an effect"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> Iterator[LookAlike]:
        """Wherever that may be the answer, and alone: what one effect looks like may look like two others as
        well."""
        if not isinstance(search.case, Case):
            return
        best = best_of_sets(search.explanations)
        likeliest = list(best.values())[:FOLLOWED_EFFECTS]
        for kind in LOOK_ALIKES.values():
            sets = [e for e in likeliest if kind.look_alike_of in e.names][:FOLLOWED_SETS]
            alone = [e for e in best.values() if e.names == (kind.look_alike_of,) and e not in sets]
            yield from (cls(e.fit, kind) for e in (*sets, *alone))

    def apply(self, search: SearchLoop[Any]) -> None:
        end, k = self.end, self.end.names.index(str(self.kind.look_alike_of))
        rig = search.records.nominal.at(end.deviations).description
        other = self.kind.in_place_of(end.candidates[k], end.coordinates_of(k), rig)
        candidates = (*end.candidates[:k], other, *end.candidates[k + 1 :])
        first = sum(len(c.axes) for c in end.candidates[:k])
        rest = end.coordinates[:first], end.coordinates[first + len(end.candidates[k].axes) :]
        trials = [np.concatenate([rest[0], start, rest[1]]) for start in other.starts]
        _, d, x = best_after_following(search.records, end, candidates, trials)
        search.add(descend(search.records, candidates, d, x, end.start))


def _local_minima(points: Sequence[StartPoint]) -> list[StartPoint]:
    """Of a grid of one value, best first; of several values none is sought."""
    if points[0].coordinates.size != 1:
        return []
    line = sorted(points, key=lambda point: float(point.coordinates[0]))
    peaks, _ = find_peaks([-np.inf, *(-point.loss for point in line), -np.inf])
    return sorted([line[k - 1] for k in peaks], key=lambda point: point.loss)
