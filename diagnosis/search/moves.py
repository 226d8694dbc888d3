"""What a search may try next. Each move says what it is, and descends when it is applied.

What moves lead to is added to `SearchLoop.explanations` or `SearchLoop.start_points`; which of them are
proposed depends on what is there.
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
from diagnosis.fit.starts import StartPoint, beside, by_loss, point_of, points_of, superposed
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from diagnosis.search.loop import (
    FOLLOWED_COSTLY,
    FOLLOWED_EFFECTS,
    FOLLOWED_SETS,
    Move,
    SearchLoop,
)
from diagnosis.search.settled import fit_record_starts
from diagnosis.search.windows import in_windows
from plant.effects import LOOK_ALIKES, Effect
from plant.effects.search_space import Candidate

# Iterations of a descent from each start (with five the serial link's first stage ends 5 % higher).
_ITERATIONS = 9
# Most effects that are descended on alone, those whose starts leave least: the registry and a few more.
# Longer lists are those of simulators with many bodies.
_MOST_DESCENDED = 36
# Of a longer list, effects of which superposition leaves least that are simulated beside a set.
_MOST_SIMULATED = 24
# Sets of one effect beside which a second is sought: what is left says little about which member of the true
# set has been found.
_PARENTS_OF_PAIRS = 3
# Sets of two and more beside which a further effect is sought: the likeliest.
_PARENTS_OF_MORE = 1
# Every so many points of a grid are tried anew beside another effect, or with a further value: half of them
# are as good starts.
_EVERY_OTHER = 2


@dataclass(frozen=True, eq=False)
class Alone(Move):
    """Simulate where an effect alone may start."""

    candidate: Candidate

    @property
    def what(self) -> str:
        """Name of the effect."""
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> list[Alone]:
        """One for every candidate but those that contain a simpler one (see `Enlarge`)."""
        candidates = search.case.machine.candidates(search.case.experiments)
        return [cls(candidate) for candidate in candidates if candidate.kind.contains is None]

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the start points, unless the effect changes nothing."""
        candidate = self.candidate
        points = points_of(search.records, search.nominal_alone.fit, candidate)
        if points:
            candidate, points = search.candidate_alone(candidate, points)
        if points:
            search.start_points.append((candidate, points))


@dataclass(frozen=True, eq=False)
class FromPoints(Move):
    """Descend an effect alone, from the best of its start points."""

    candidate: Candidate
    points: list[StartPoint]

    @property
    def what(self) -> str:
        """Name of the effect."""
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> list[FromPoints]:
        """One for every candidate with start points; of many, for those whose starts leave least.

        The others are still tried beside these.
        """
        ranked = sorted(search.start_points, key=lambda pair: pair[1][0].loss)
        return [cls(candidate, points) for candidate, points in ranked[:_MOST_DESCENDED]]

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the end to the search's unfinished fits."""
        around = search.nominal_alone.fit
        fit = descend_from_best(search, around, self.candidate, self.points, around.jacobian)
        search.unfinished.append((fit, self.points))


def descend_from_best(
    search: SearchLoop[Any],
    around: Fit,
    candidate: Candidate,
    points: Sequence[StartPoint],
    nominal_jacobian: Real,
) -> Fit:
    """The best end of a candidate beside a fit, from its best points that are apart.

    Parameters
    ----------
    search
        Whose records are fitted.
    around : Fit
        Beside which the candidate acts.
    candidate : Candidate
        The further effect.
    points : sequence of StartPoint
        Best first, at least one.
    nominal_jacobian : (N, P) array
        Derivatives by the nominal values near the points.
    """
    # Zeros all around a turn have more ends.
    most_points = FOLLOWED_SETS if _has_free_zero(search, candidate) else FOLLOWED_COSTLY
    chosen = [points[0]]
    for point in points[1:]:
        if len(chosen) == most_points or point.loss > search.nominal_alone.fit.loss + WORTH_IT:
            break
        if all(point.far_from(other) for other in chosen):
            chosen.append(point)
    # One more local minimum of the grid, even where it is worse than no effect.
    for point in _local_minima(points):
        if all(point.far_from(other) for other in chosen):
            chosen.append(point)
            break
    fits = [_descend_from(search, around, candidate, point, nominal_jacobian) for point in chosen]
    return min(fits, key=lambda fit: fit.loss)


def _has_free_zero(search: SearchLoop[Any], candidate: Candidate) -> bool:
    """Whether a candidate depends on the true angle, and no output tells where its zero is."""
    return candidate.kind.absolute_angle and not search.case.machine.unknown_start.zero_seen


def _descend_from(
    search: SearchLoop[Any],
    around: Fit,
    candidate: Candidate,
    point: StartPoint,
    nominal_jacobian: Real,
) -> Fit:
    """The end of a candidate beside a fit, from one start point; arguments are those of
    `descend_from_best`."""
    return descend(
        search.records,
        (*around.candidates, candidate),
        point.deviations,
        np.concatenate([around.coordinates, point.coordinates]),
        point.start,
        nominal_jacobian=nominal_jacobian,
        columns=around.start_columns,
        iterations=_ITERATIONS,
    )


@dataclass(frozen=True, eq=False)
class Enlarge(Move):
    """An effect that contains a simpler one (Stribeck friction Coulomb's), from where a set of that ended.

    Attributes
    ----------
    candidate : Candidate
        In the place of the one that it contains.
    inner : Fit
        With the simpler effect.
    starts : sequence of arrays
        Further values, behind those that both have, from which it is descended.
    """

    candidate: Candidate
    inner: Fit
    starts: Sequence[Real]

    @property
    def what(self) -> str:
        """Name of the effect."""
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any], sets: Sequence[WeighedFit]) -> Iterator[Enlarge]:
        """One for every set with a simpler effect.

        With several further values the first time, then with those that this found.
        """
        best = list(best_of_sets(sets).values())
        for candidate in search.case.machine.candidates(search.case.experiments):
            for inner in [
                explanation.fit for explanation in best if candidate.kind.contains in explanation.names
            ]:
                starts = [
                    points[0].coordinates[1:]
                    for known, points in search.start_points
                    if known.effect == candidate.effect
                ]
                if not starts:
                    further_values = sorted({coordinates[1:] for coordinates in candidate.starts})
                    starts = [np.array(values) for values in further_values[::_EVERY_OTHER]]
                yield cls(candidate, inner, starts)

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the best end; of an effect alone it is a start point, too."""
        inner = self.inner
        k = inner.names.index(str(self.candidate.kind.contains))
        first = sum(len(candidate.axes) for candidate in inner.candidates[: k + 1])
        candidates = (*inner.candidates[:k], self.candidate, *inner.candidates[k + 1 :])
        fits = []
        for further_values in self.starts:
            before = inner.coordinates[:first]
            after = inner.coordinates[first:]
            fits.append(
                descend(
                    search.records,
                    candidates,
                    inner.deviations,
                    np.concatenate([before, further_values, after]),
                    inner.start,
                    nominal_jacobian=_nominal_jacobian(inner),
                    columns=inner.start_columns,
                    iterations=_ITERATIONS,
                )
            )
        best = min(fits, key=lambda fit: fit.loss)
        if len(best.names) == 1:
            search.start_points.append((self.candidate, [point_of(best)]))
        search.add(best)


def _nominal_jacobian(fit: Fit) -> Real:
    """(N, P) derivatives of a fit by the deviations of its nominal values."""
    return fit.jacobian[:, : fit.deviations.size]


@dataclass(frozen=True, eq=False)
class BesideSet(Move):
    """The most promising effects beside a set.

    Attributes
    ----------
    parent : Fit
        The set.
    most_effects : int
        Further effects that are descended on.
    """

    parent: Fit
    most_effects: int

    @property
    def what(self) -> str:
        """The set in words."""
        return f"further effects beside {' and '.join(self.parent.names)}"

    @classmethod
    def proposed(cls, search: SearchLoop[Any], count: int) -> list[BesideSet]:
        """Sets of so many effects, from the likeliest of one fewer.

        Several of these while something that interests is left, for what is left says little about which
        member of the true set has been found; then those as likely as the likeliest of all sets: a small
        effect beside one of two that look alike decides between them. What interests is unknown where nobody
        has stated it.
        """
        ranked = list(best_of_sets(search.explanations).values())
        most_parents = _PARENTS_OF_PAIRS if count == 2 else _PARENTS_OF_MORE
        parents = [explanation for explanation in ranked if len(explanation.names) == count - 1]
        parents = parents[:most_parents]
        if search.case.machine.weighing.stated and not search.unexplained:
            least = ranked[0].log_evidence - DECISIVE
            parents = [explanation for explanation in parents if explanation.log_evidence > least]
        most_effects = FOLLOWED_EFFECTS if count == 2 else FOLLOWED_SETS
        return [cls(parent.fit, most_effects) for parent in parents]

    def apply(self, search: SearchLoop[Any]) -> None:
        """Descend from the best points of the most promising effects, and add the ends."""
        parent = self.parent
        points = sorted(self._best_points(search), key=lambda pair: pair[1].loss)
        # Effects that multiply a nominal value are all tried where one is pulled far, of a long list some.
        most_with_pulled = len(points)
        if len(search.start_points) > _MOST_DESCENDED:
            most_with_pulled = FOLLOWED_COSTLY * self.most_effects
        values_are_pulled = np.any(np.abs(parent.deviations) > EDGE)
        chosen: dict[tuple[str, float], tuple[Candidate, StartPoint]] = {}
        for candidate, point in points:
            is_pulled = candidate.kind.multiplies is not None and values_are_pulled
            if len(chosen) < self.most_effects or (is_pulled and len(chosen) < most_with_pulled):
                # Beside contacts that switch, and values pulled far, the one side may look better and the
                # other be so.
                side = candidate.axes[0].low if parent.non_smooth or is_pulled else 0.0
                chosen.setdefault((candidate.effect, side), (candidate, point))

        # What is not worth it once all else has followed is not descended on; unless it is so much worse that
        # the linearisation says nothing (of 325 in between, one ended more than 15 below).
        fits = []
        for candidate, point in chosen.values():
            gain = parent.loss - point.loss
            if not -DECISIVE < gain < SUBSTANTIAL:
                fits.append(_descend_from(search, parent, candidate, point, _nominal_jacobian(parent)))
        for rank, fit in enumerate(sorted(fits, key=lambda fit: fit.loss)):
            search.add(search.polish(fit, rank, parent))

    def _best_points(self, search: SearchLoop[Any]) -> Iterator[tuple[Candidate, StartPoint]]:
        """The best point of every candidate beside the parent, but of those that it has in some form."""
        parent = self.parent
        held = set()
        for candidate in parent.candidates:
            held |= {candidate.effect, candidate.kind.contains}
        held -= {None}
        listed = [
            (candidate, points)
            for candidate, points in search.start_points
            if not {candidate.effect, candidate.kind.contains} & held
        ]
        if len(search.start_points) > _MOST_DESCENDED:

            def superposed_loss(pair: tuple[Candidate, list[StartPoint]]) -> float:
                losses = [point.loss for point in superposed(search.records, parent, pair[1])]
                # What cannot be superposed is simulated in any case.
                return min(losses, default=-np.inf)

            listed = sorted(listed, key=superposed_loss)[:_MOST_SIMULATED]
        for candidate, points in listed:
            # A frequency, and a zero that no other output tells, may be any other beside another effect.
            is_sought_anew = candidate.kind.harmonic is not None or _has_free_zero(search, candidate)
            known = points[:1] if is_sought_anew else points
            candidate, near = search.candidate_beside(parent, candidate, known)
            if is_sought_anew:
                anew = points_of(search.records, parent, candidate, every=_EVERY_OTHER)[:FOLLOWED_SETS]
                if candidate.kind.harmonic is not None:
                    # Their losses are a linear arm's; where it is not, they may leave less than it would.
                    anew += beside(search.records, parent, candidate, anew)
                near += anew
            if near:
                yield candidate, min(near, key=by_loss)


@dataclass(frozen=True, eq=False)
class InPlaceOf(Move):
    """An effect that multiplies a nominal value, in place of that value pulled beyond belief.

    Attributes
    ----------
    parent : Fit
        In which the value is pulled.
    candidate : Candidate
        The effect.
    coordinates : (A,) array
        Where it does to the machine what the value did.
    deviations : (P,) array
        Of the parent, the value's own back at what is stated.
    """

    parent: Fit
    candidate: Candidate
    coordinates: Real
    deviations: Real

    @property
    def what(self) -> str:
        """Name of the effect."""
        return self.candidate.effect

    @classmethod
    def proposed(cls, search: SearchLoop[Any], parent: Fit) -> Iterator[InPlaceOf]:
        """One for every value beyond the edge of its prior that an effect multiplies, which is listed and not
        in the set."""
        nominal = search.records.nominal
        listed = [candidate for candidate, _ in search.start_points]
        factors = nominal.factors(parent.deviations)
        for k, key in enumerate(nominal.keys):
            if abs(parent.deviations[k]) < EDGE:
                continue
            effect = in_place_of(key, factors[key], listed)
            if effect is None:
                continue
            candidate, coordinates = effect
            if candidate.effect not in parent.names:
                is_this_value = np.arange(nominal.count) == k
                yield cls(parent, candidate, coordinates, np.where(is_this_value, 0.0, parent.deviations))

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the end of the descent from there."""
        point = StartPoint(self.parent.loss, self.coordinates, self.deviations, self.parent.start)
        nominal_jacobian = _nominal_jacobian(self.parent)
        fit = _descend_from(search, self.parent, self.candidate, point, nominal_jacobian)
        search.add(search.polish(fit, 0, self.parent))


def in_place_of(key: str, factor: float, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The effect that multiplies a nominal value, and its coordinates (A,).

    Parameters
    ----------
    key : str
        Of the value.
    factor : float
        By which it is to be multiplied; where that is outside the effect's range, the nearest one inside.
    listed : sequence of Candidate
        Among which the effect is sought, on the factor's side of 1.

    Returns
    -------
    (Candidate, array) or None
        None where no candidate multiplies the value.
    """
    sign = 1 if factor > 1 else -1
    for candidate in listed:
        if candidate.kind.multiplies == key and candidate.sign == sign:
            coordinates = np.clip([candidate.axes[0].coordinate(factor)], *candidate.box)
            return candidate, coordinates
    return None


@dataclass(frozen=True, eq=False)
class InWindows(Move):
    """Torques over the angle and what stands beside them, from where fits in windows ended.

    Attributes
    ----------
    acting : sequence of Candidate
        Effects whose torque depends on the angle.
    """

    acting: Sequence[Candidate]

    @property
    def what(self) -> str:
        """The move in words."""
        return "fits in windows"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> list[InWindows]:
        """One, for a flexible link with such a candidate."""
        acting = [
            candidate
            for candidate, _ in search.start_points
            if candidate.kind.absolute_angle or candidate.kind.harmonic == "hub_angle"
        ]
        if acting and isinstance(search.case, Case):
            return [cls(acting)]
        return []

    def apply(self, search: SearchLoop[Any]) -> None:
        """Fit the effects alone and in pairs in windows; add what the best lead to in free runs."""
        assert isinstance(search.case, Case)
        nominal_fit = search.nominal_alone.fit
        windows = search.for_case(in_windows(search.case))
        assert isinstance(windows.records, Records)
        guess = windows.records.guessed_start()
        start, _ = fit_record_starts(windows.records, nominal_fit.deviations, (), guess)
        around = windows.add(nominal_fit.continued(windows.records, start)).fit
        for candidate in self.acting:
            points = points_of(windows.records, around, candidate)
            if points and not search.skips(self.what):
                windows.add(descend_from_best(windows, around, candidate, points, around.jacobian))
        # Every window begins a torque over time anew, so that its frequency says nothing.
        windows.start_points = [
            (candidate, points)
            for candidate, points in search.start_points
            if candidate.kind.harmonic != "time"
        ]
        best = min((explanation.fit for explanation in windows.explanations), key=lambda fit: fit.loss)
        if best.loss > around.loss - DECISIVE:
            return
        if not search.skips(self.what):
            BesideSet(best, FOLLOWED_SETS).apply(windows)

        states = search.records.state_spread.size
        for count in (1, 2):
            of_count = [e.fit for e in windows.explanations if len(e.names) == count]
            for fit in sorted(of_count, key=lambda fit: fit.loss)[:FOLLOWED_COSTLY]:
                # The start of the first window is that of the record.
                start = FittedStart(fit.start.states[:, :states], fit.start.zeros)
                search.add(refine_sizes(search.records, fit.continued(search.records, start)))


@dataclass(frozen=True, eq=False)
class Scan(Move):
    """A set with contacts once more from far values of all its parameters."""

    fit: Fit

    @property
    def what(self) -> str:
        """The move in words."""
        return "scans of sets with contacts"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> Iterator[Scan]:
        """The likeliest set that is left, or has gained since its last scan; a few in all."""
        loss_at_scan: dict[tuple[str, ...], float] = {}
        for _ in range(FOLLOWED_COSTLY):
            for sorted_names, explanation in best_of_sets(search.explanations).items():
                last_loss = loss_at_scan.get(sorted_names, np.inf)
                if explanation.fit.non_smooth and explanation.fit.loss < last_loss - SUBSTANTIAL:
                    break
            else:
                return
            loss_at_scan[sorted_names] = explanation.fit.loss
            yield cls(explanation.fit)

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the best that is found."""
        search.add(refine_sizes(search.records, scan_far_values(search.records, self.fit)))


@dataclass(frozen=True, eq=False)
class FromContacts(Move):
    """A set with contacts once more from starts of the records that feel them."""

    fit: Fit

    @property
    def what(self) -> str:
        """The move in words."""
        return "starts of records in free play"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> Iterator[FromContacts]:
        """The likeliest sets of each size; from then on starts of all records feel contacts."""
        if search.case.machine.unknown_start.tried.size == 0:
            return
        search.starts_feel_contacts = True
        best = best_of_sets(search.explanations).values()
        with_contacts = [explanation for explanation in best if explanation.fit.non_smooth]
        for count in range(1, search.case.machine.weighing.most_effects + 1):
            of_count = [explanation for explanation in with_contacts if len(explanation.names) == count]
            for explanation in of_count[:FOLLOWED_COSTLY]:
                yield cls(explanation.fit)

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the better of the fit and its descent from such starts."""
        assert isinstance(search.records, Records)
        fit = self.fit
        start, _ = fit_record_starts(search.records, fit.deviations, fit.effects, fit.start, touching=True)
        descended = fit.continued(
            search.records,
            start,
            nominal_jacobian=_nominal_jacobian(fit),
            touching=True,
            iterations=_ITERATIONS,
        )
        search.add(min(fit, descended, key=lambda fit: fit.loss))


@dataclass(frozen=True, eq=False)
class LookAlike(Move):
    """A cause beyond the list in place of the effect that it looks like.

    Attributes
    ----------
    fit : Fit
        With the effect.
    kind : type of Effect
        The cause, of `plant.effects.LOOK_ALIKES`.
    """

    fit: Fit
    kind: type[Effect]

    @property
    def what(self) -> str:
        """The move in words."""
        return "causes beyond the list that look like an effect"

    @classmethod
    def proposed(cls, search: SearchLoop[Any]) -> Iterator[LookAlike]:
        """Wherever that may be the answer, and alone: what one effect looks like may look like two others as
        well. None but for a flexible link."""
        if not isinstance(search.case, Case):
            return
        best = best_of_sets(search.explanations)
        likeliest = list(best.values())[:FOLLOWED_EFFECTS]
        for kind in LOOK_ALIKES.values():
            with_effect = [e for e in likeliest if kind.look_alike_of in e.names][:FOLLOWED_SETS]
            effect_alone = best.get((str(kind.look_alike_of),))
            if effect_alone is not None and effect_alone not in with_effect:
                with_effect.append(effect_alone)
            for explanation in with_effect:
                yield cls(explanation.fit, kind)

    def apply(self, search: SearchLoop[Any]) -> None:
        """Add the end from the best of the cause's starts."""
        fit = self.fit
        k = fit.names.index(str(self.kind.look_alike_of))
        replaced = fit.candidates[k]
        rig = search.records.nominal.at(fit.deviations).description
        look_alike = self.kind.in_place_of(replaced, fit.coordinates_of(k), rig)
        candidates = (*fit.candidates[:k], look_alike, *fit.candidates[k + 1 :])
        first = sum(len(candidate.axes) for candidate in fit.candidates[:k])
        before = fit.coordinates[:first]
        after = fit.coordinates[first + len(replaced.axes) :]
        trials = [np.concatenate([before, coordinates, after]) for coordinates in look_alike.starts]
        _, d, x = best_after_following(search.records, fit, candidates, trials)
        search.add(descend(search.records, candidates, d, x, fit.start))


def _local_minima(points: Sequence[StartPoint]) -> list[StartPoint]:
    """Local minima of the loss over a grid of one coordinate, best first; none of a grid of several."""
    if points[0].coordinates.size != 1:
        return []
    along_grid = sorted(points, key=lambda point: float(point.coordinates[0]))
    # A minimum may be at an end of the grid.
    peaks, _ = find_peaks([-np.inf, *(-point.loss for point in along_grid), -np.inf])
    return sorted([along_grid[peak - 1] for peak in peaks], key=by_loss)
