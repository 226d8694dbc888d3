"""Sets of effects that explain the records of a machine beside what no effect explains."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.signal import find_peaks

from diagnosis.fit.descent import Descent, best_following, descend, loss_at, occam, refined, scanned
from diagnosis.fit.records import Records, Start, share_left
from diagnosis.fit.starts import Point, beside, points_of
from diagnosis.imperfect.settled import settled
from diagnosis.imperfect.windows import in_windows
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from plant.effects import LOOK_ALIKES
from plant.effects.search_space import Candidate

Progress = Callable[[float, str], None]

# Starts descended from alone; parents extended and effects fitted beside each: pairs, larger sets.
_ALONE, _BESIDE_POINTS = 2, 4
_PARENTS, _TRIED = (3, 1), (6, 4)
# Further starts alone, local minima of a grid of one value, whatever they leave.
_LOCAL_MINIMA = 1
# Further parents beside which only what every machine has some of is fitted, how many of these beside each,
# and how far behind in evidence they may be.
_FURTHER, _TRIED_BESIDE_FURTHER, _FAR_BEHIND = 2, 2, 100.0
_FINISHED, _REFINED = 6, 2
# Sets of an effect in which what looks like it takes its place.
_ALIKE = 3
# Sets of several whose simple effects are also continued as those that contain them.
_CONTINUED = 3
# Beside values pulled this far (tolerances), effects that multiply one are tried as well.
_PULLED = 1.8
# Evidence that larger sets gain, or none that are larger still are tried.
_WORTH = 15.0
# Fits in windows: effects tried beside the best, and sets of one and of two continued in free runs.
_BESIDE_IN_WINDOWS, _FREED = 4, (2, 3)
# Loss that the best of them gains in windows, or none is continued.
_GAINED = 15.0
# Frequencies tried beside others.
_FREQUENCIES = 3
# Loss that an effect beside others gains once all else has followed, or its set is not descended on; unless
# it is so much worse that the linearisation says nothing (set on 44 generated cases: of 325 in between, one
# ended more than 15 below).
_PROMISING, _ASTRAY = 3.0, 20.0
# Loss that other starts of the records gain, or a set is not descended on from there.
_GAINED_BY_START = 2.0
# Scans of sets with contacts, each of the likeliest that is left or has gained this since its last.
_SCANS, _GAINED_BY_SCAN = 2, 2.0
# Sets of each size with contacts whose starts feel them, and how far behind in evidence they may be.
_TOUCHING, _TOUCHING_ITERATIONS, _UNLIKELY = 2, 5, 150.0
# An effect is exchanged for one that is no further behind in evidence in a part of the set, nor in loss in
# its place once all else has followed; nor further are sets, before they are fitted together.
_AS_LIKELY = 15.0
# Of octaves, what is felt where disturbances of the inputs are amplified.
_AMPLIFIED = 0.5
_LAST_ITERATIONS, _LAST_TOLERANCE = 20, 0.02


@dataclass(frozen=True, eq=False)
class Explanation:
    """A fitted set of effects and what it leaves.

    log_likelihoods : (R,) of every record, estimation and held-out.
    log_prior, log_volume : of deviations, start and effects; what the records leave of them.
    left, left_held_out : experiment residuals (T, Y) in the outputs' units.
    shares : (2, Y) RMS left over the motion: estimation records, held-out records.
    """

    end: Descent
    log_likelihoods: Real
    log_prior: float
    log_volume: float
    left: tuple[Real, ...]
    left_held_out: tuple[Real, ...]
    shares: Real

    @property
    def names(self) -> tuple[str, ...]:
        return self.end.names

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(sorted(self.names))

    def pooled_held_out(self, noise: Real) -> float:
        """Energy left of the held-out records, in noise deviations (Y,)."""
        return float(sum(np.sum((part / noise) ** 2) for part in self.left_held_out))

    @property
    def log_likelihood(self) -> float:
        return float(np.sum(self.log_likelihoods))

    @property
    def evidence(self) -> float:
        return self.log_likelihood + self.log_prior + self.log_volume


@dataclass(eq=False)
class Search:
    """All that was fitted to a case, the nominal alone first.

    at_inputs : the model error is one of the inputs, whatever the machine makes of it (`Levels`).
    first_halves : names of the estimation records that are first halves of held-out ones (`Case.in_halves`):
        what a set leaves of these counts as left of held-out records. A second look.
    """

    case: CaseOfMachine
    progress: Progress
    deadline_s: float = np.inf
    at_inputs: bool = False
    first_halves: tuple[str, ...] = ()
    found: list[Explanation] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.records = Records(self.case, self.case.estimation, at_inputs=self.at_inputs)
        self.held_out = Records(self.case, self.case.held_out, at_inputs=self.at_inputs)
        self.points: list[tuple[Candidate, list[Point]]] = []
        # Already tried: sets without one of their effects, with a simpler one, with another in its place.
        self._reduced: set[tuple[object, ...]] = set()
        # Whether starts of held-out records feel contacts.
        self._touching = False

    @property
    def base(self) -> Explanation:
        return self.found[0]

    @property
    def _likeliest(self) -> Explanation:
        return max(self.found, key=lambda e: e.evidence)

    @property
    def simulations(self) -> int:
        return self.records.simulations + self.held_out.simulations

    @property
    def amplifies(self) -> bool:
        """Whether the machine makes much more of a disturbance of its inputs than of the inputs."""
        return bool(np.min(self.records.levels.felt) < _AMPLIFIED)

    def run(self) -> None:
        """The nominal, every effect alone, then sets of two, three and more beside the likeliest.

        Beyond three only while the likeliest leaves more of the motion than is stated not to interest, and
        the last size was worth it. A second look is to take less time than the first: none beyond two where
        contacts switch, and no scans, windows and starts of contacts.
        """
        weighing = self.case.machine.weighing
        P = self.records.nominal.count
        start, _ = settled(self.records, np.zeros(P), (), self.records.at_rest())
        nominal = descend(self.records, (), np.zeros(P), np.zeros(0), start, iterations=12)
        self.add(nominal)
        self._alone()
        self._containing(self.found)
        for count in range(2, weighing.most_effects + 1):
            if count > 3 and not (self._unexplained and self._worth(count - 1)):
                break
            if count > 2 and self.first_halves and self._likeliest.end.non_smooth:
                break
            self._together(count)
        if self._unexplained and not self.first_halves:
            self._from_windows()
        several = best_of_sets(e for e in self.found if len(e.names) > 1)
        self._containing(list(several.values())[:_CONTINUED])
        if self._unexplained and not self.first_halves:
            self._scanned()
            self._from_contacts()
        self._look_alikes()

    @property
    def _unexplained(self) -> bool:
        """Whether the likeliest leaves more of the motion than is stated not to interest."""
        return bool(np.max(self._likeliest.shares) > self.case.machine.weighing.model_error)

    def _worth(self, count: int) -> bool:
        """Whether the likeliest set of so many effects is much likelier than that of one fewer."""
        largest, smaller = (
            max((e.evidence for e in self.found if len(e.names) == n), default=-np.inf)
            for n in (count, count - 1)
        )
        return largest > smaller + _WORTH

    def _late(self, what: str) -> bool:
        if time.monotonic() < self.deadline_s:
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def _alone(self) -> None:
        around = self.base.end
        spaces = self.case.machine.candidates(self.case.experiments)
        ends: list[tuple[Descent, list[Point]]] = []
        for k, candidate in enumerate(spaces):
            self.progress(0.05 + 0.4 * k / len(spaces), f"fitting {candidate.effect}")
            if candidate.kind.contains is not None or self._late(candidate.effect):
                continue
            points = points_of(self.records, around, candidate)
            if not points:
                continue
            self.points.append((candidate, points))
            ends.append((self._descended(around, candidate, points, around.jacobian), points))
        for k, (end, points) in enumerate(sorted(ends, key=lambda one: one[0].loss)):
            if k < _FINISHED and not end.converged:
                end = descend(self.records, end.candidates, end.deviations, end.coordinates, end.start)
            found = self.add(refined(self.records, self._begun(end)) if k < _FINISHED else end)
            # Where it ended alone may be far from every start, and right beside another effect.
            points.insert(0, _point(found.end))

    def _descended(
        self, around: Descent, candidate: Candidate, points: Sequence[Point], nominal: Real
    ) -> Descent:
        chosen = [points[0]]
        for point in points[1:]:
            if (
                len(chosen) == (2 * _ALONE if self._turned(candidate) else _ALONE)
                or point.loss > self.base.end.loss + 5
            ):
                break
            if all(point.far_from(other) for other in chosen):
                chosen.append(point)
        further = [point for point in _local_minima(points) if all(map(point.far_from, chosen))]
        chosen += further[:_LOCAL_MINIMA]
        ends = [self._from(around, candidate, point, nominal) for point in chosen]
        return min(ends, key=lambda end: end.loss)

    def _turned(self, candidate: Candidate) -> bool:
        return candidate.kind.absolute_angle and not self.case.machine.unknown_start.zero_seen

    def _from(self, around: Descent, candidate: Candidate, point: Point, nominal: Real) -> Descent:
        return descend(
            self.records,
            (*around.candidates, candidate),
            point.deviations,
            np.concatenate([around.coordinates, point.coordinates]),
            point.start,
            nominal_jacobian=nominal,
            columns=around.columns,
            iterations=9,
        )

    def _containing(self, sets: Sequence[Explanation]) -> None:
        """Effects that contain a simpler one (Stribeck friction Coulomb's), from where sets of it ended: with
        several further values the first time, then with those that this found."""
        pool = list(best_of_sets(sets).values())
        for candidate in self.case.machine.candidates(self.case.experiments):
            simple = candidate.kind.contains
            starts = [points[0].coordinates[1:] for c, points in self.points if c.effect == candidate.effect]
            starts = starts or [np.array(x) for x in sorted({x[1:] for x in candidate.starts})[::2]]
            for inner in [e.end for e in pool if simple in e.names]:
                if self._late(candidate.effect):
                    return
                k = inner.names.index(str(simple))
                first = sum(len(c.axes) for c in inner.candidates[: k + 1])
                ends = [
                    descend(
                        self.records,
                        (*inner.candidates[:k], candidate, *inner.candidates[k + 1 :]),
                        inner.deviations,
                        np.concatenate([inner.coordinates[:first], further, inner.coordinates[first:]]),
                        inner.start,
                        nominal_jacobian=inner.jacobian[:, : inner.deviations.size],
                        columns=inner.columns,
                        iterations=6,
                    )
                    for further in starts
                ]
                best = min(ends, key=lambda end: end.loss)
                if len(best.names) == 1:
                    self.points.append((candidate, [_point(best)]))
                self.add(best)

    def _together(self, count: int) -> None:
        pool = list(best_of_sets(e for e in self.found if len(e.names) == count - 1).values())
        parents = pool[: _PARENTS[count > 2]]
        for k, parent in enumerate(parents):
            words = f"fitting more beside {' and '.join(parent.names)}"
            self.progress(min(0.45 + 0.25 * (count - 2) + 0.25 * k / len(parents), 0.95), words)
            if self._late(f"further effects beside {' and '.join(parent.names)}"):
                return
            self._beside(parent.end, _TRIED[count > 2])
        if not self._unexplained:
            return
        # Friction and tilt, which may be more than what is sought, take the first places; what else is likely
        # shows what it explains once they are beside it.
        tried, further = {_unusual(parent) for parent in parents} | {frozenset[str]()}, 0
        for parent in pool[len(parents) :]:
            if further == _FURTHER or parent.evidence < pool[0].evidence - _FAR_BEHIND:
                break
            if _unusual(parent) not in tried and not self._late("friction and tilt beside further sets"):
                tried, further = tried | {_unusual(parent)}, further + 1
                self._beside(parent.end, _TRIED_BESIDE_FURTHER, everywhere=True)

    def _beside(self, parent: Descent, most: int, *, everywhere: bool = False) -> None:
        """everywhere : only what every machine has some of."""
        trials: list[tuple[Candidate, Point]] = []
        held = {name for c in parent.candidates for name in (c.effect, c.kind.contains)} - {None}
        for candidate, points in self.points:
            if candidate.effect in held or candidate.kind.contains in held:
                continue
            if everywhere and not candidate.kind.everywhere:
                continue
            # A frequency, and a zero that no other output tells, may be any other beside another effect.
            anew = candidate.kind.harmonic is not None or self._turned(candidate)
            near = beside(self.records, parent, candidate, points[:1] if anew else _spread(points))
            further = points_of(self.records, parent, candidate, every=2)[:_FREQUENCIES] if anew else []
            if candidate.kind.harmonic is not None:
                # Their losses are a linear arm's; where it is not, they may leave less than it would.
                further += beside(self.records, parent, candidate, further)
            near += further
            trials += [(candidate, point) for point in sorted(near, key=lambda point: point.loss)[:1]]
        trials.sort(key=lambda trial: trial[1].loss)
        chosen: dict[tuple[str, float], tuple[Candidate, Point]] = {}
        for candidate, point in trials:
            pulled = candidate.kind.multiplies is not None and np.any(np.abs(parent.deviations) > _PULLED)
            if len(chosen) < most or pulled:
                # Beside contacts that switch, and values pulled far, the one side may look better and the
                # other be so.
                side = candidate.axes[0].low if parent.non_smooth or pulled else 0.0
                chosen.setdefault((candidate.effect, side), (candidate, point))
        nominal = parent.jacobian[:, : parent.deviations.size]
        ends = [
            self._from(parent, candidate, point, nominal)
            for candidate, point in chosen.values()
            if not -_ASTRAY < parent.loss - point.loss < _PROMISING
        ]
        for k, end in enumerate(sorted(ends, key=lambda end: end.loss)):
            self.add(refined(self.records, self._begun(end)) if k < _REFINED else end)

    def _begun(self, end: Descent) -> Descent:
        """Descended on where starts sought with these effects leave less: the nominal's may be far off, and
        where nobody knows a linear part no step leads from there."""
        if self.case.machine.unknown_start.responses is not None or not end.start.states.size:
            return end
        start, e = settled(self.records, end.deviations, end.effects, end.start)
        loss, _ = loss_at(self.records, e, end.deviations, start)
        if loss > end.loss - _GAINED_BY_START:
            return end
        return descend(self.records, end.candidates, end.deviations, end.coordinates, start)

    def _from_windows(self) -> None:
        """Torques over the angle and what stands beside them, from where fits in windows ended."""
        acting = [c for c, _ in self.points if c.kind.absolute_angle or c.kind.harmonic == "hub_angle"]
        if not acting or not isinstance(self.case, Case) or self._late("fits in windows"):
            return
        self.progress(0.95, "fitting in windows")
        base, states = self.base.end, self.records.state_spread.size
        windows = Search(in_windows(self.case), self.progress, self.deadline_s, self.at_inputs)
        start, _ = settled(windows.records, base.deviations, (), windows.records.at_rest())
        windows.add(descend(windows.records, (), base.deviations, base.coordinates, start))
        around = windows.base.end
        for candidate in acting:
            points = points_of(windows.records, around, candidate)
            if points and not self._late("fits in windows"):
                windows.add(windows._descended(around, candidate, points, around.jacobian))
        windows.points = [(c, points) for c, points in self.points if c.kind.harmonic != "time"]
        best = min((e.end for e in windows.found), key=lambda end: end.loss)
        if best.loss > around.loss - _GAINED:
            return
        if not self._late("fits in windows"):
            windows._beside(best, _BESIDE_IN_WINDOWS)
        for count, most in enumerate(_FREED, start=1):
            of_count = [e.end for e in windows.found if len(e.names) == count]
            for end in sorted(of_count, key=lambda end: end.loss)[:most]:
                start = Start(end.start.states[:, :states], end.start.zeros)
                freed = descend(self.records, end.candidates, end.deviations, end.coordinates, start)
                self.add(refined(self.records, freed))

    def _scanned(self) -> None:
        """The likeliest sets with contacts once more from far values of all their parameters."""
        done: dict[tuple[str, ...], float] = {}
        for _ in range(_SCANS):
            likeliest = (
                e
                for key, e in best_of_sets(self.found).items()
                if e.end.non_smooth and e.end.loss < done.get(key, np.inf) - _GAINED_BY_SCAN
            )
            this = next(likeliest, None)
            if this is None or self._late("scans of sets with contacts"):
                return
            self.progress(0.97, f"scanning {' and '.join(this.names)}")
            done[this.key] = this.end.loss
            self.add(refined(self.records, scanned(self.records, this.end)))

    def _from_contacts(self) -> None:
        """The likeliest sets of each size with contacts once more from starts that feel them."""
        if not self.case.machine.unknown_start.tried.size:
            return
        self._touching = True
        sets = [e for e in best_of_sets(self.found).values() if e.end.non_smooth]
        for count in range(1, self.case.machine.weighing.most_effects + 1):
            for e in [e for e in sets if len(e.names) == count][:_TOUCHING]:
                if e.evidence < max(other.evidence for other in self.found) - _UNLIKELY:
                    continue
                if self._late("starts of records in free play"):
                    return
                self.progress(0.97, f"starts in free play, {' and '.join(e.names)}")
                end = e.end
                start, _ = settled(self.records, end.deviations, end.effects, end.start, touching=True)
                again = descend(
                    self.records,
                    end.candidates,
                    end.deviations,
                    end.coordinates,
                    start,
                    nominal_jacobian=end.jacobian[:, : end.deviations.size],
                    touching=True,
                    iterations=_TOUCHING_ITERATIONS,
                )
                self.add(min(end, again, key=lambda one: one.loss))

    def _look_alikes(self) -> None:
        """Causes beyond the list in place of what they look like, wherever that may be the answer, and alone:
        what one effect looks like may look like two others as well."""
        if not isinstance(self.case, Case):
            return
        best = best_of_sets(self.found)
        likeliest = list(best.values())[:_FINISHED]
        for kind in LOOK_ALIKES.values():
            sets = [e for e in likeliest if kind.look_alike_of in e.names][:_ALIKE]
            alone = [e for e in best.values() if e.names == (kind.look_alike_of,) and e not in sets]
            for explanation in (*sets, *alone):
                end = explanation.end
                k = end.names.index(str(kind.look_alike_of))
                rig = self.records.nominal.at(end.deviations).description
                other = kind.in_place_of(end.candidates[k], end.coordinates_of(k), rig)
                candidates = (*end.candidates[:k], other, *end.candidates[k + 1 :])
                first = sum(len(c.axes) for c in end.candidates[:k])
                rest = end.coordinates[:first], end.coordinates[first + len(end.candidates[k].axes) :]
                trials = [np.concatenate([rest[0], start, rest[1]]) for start in other.starts]
                _, d, x = best_following(self.records, end, candidates, trials)
                self.add(descend(self.records, candidates, d, x, end.start))

    def simpler(self, explanation: Explanation) -> None:
        """The same with effects in place of those that contain them, from where these ended: further values
        may have led out of a minimum in which the simpler effect was left."""
        end = explanation.end
        for k, containing in enumerate(end.candidates):
            for candidate in [c for c, _ in self.points if c.effect == containing.kind.contains]:
                if (this := (*explanation.names, explanation.evidence, candidate.effect)) in self._reduced:
                    continue
                self._reduced.add(this)
                candidates = (*end.candidates[:k], candidate, *end.candidates[k + 1 :])
                first = sum(len(c.axes) for c in end.candidates[:k]) + len(candidate.axes)
                x = np.delete(
                    end.coordinates, slice(first, first + len(containing.axes) - len(candidate.axes))
                )
                self.add(descend(self.records, candidates, end.deviations, x, end.start))

    def exchanged(self, explanation: Explanation, sought: Iterable[str]) -> None:
        """The same with one of the effects sought replaced by another, as likely in a part of the set.

        Larger sets are sought beside the likeliest parts alone: of two effects that no record tells apart,
        the one that was extended would win by what was found beside it.
        """
        best = best_of_sets(self.found)
        for k, name in enumerate(explanation.names):
            if name not in sought:
                continue
            rest = {c.effect: c.kind.contains for c in explanation.end.candidates if c.effect != name}
            for rival in [*best.values()]:
                new = set(rival.names) - {*explanation.names}
                kept = set(rival.names) - new
                part = best.get(tuple(sorted({*kept, name})))
                if len(new) != 1 or not kept <= rest.keys() or part is None:
                    continue
                (other,) = (c for c in rival.end.candidates if c.effect in new)
                key = tuple(sorted((*rest, other.effect)))
                contained = other.effect in rest.values() or other.kind.contains in rest
                if key in best or contained or rival.evidence < part.evidence - _AS_LIKELY:
                    continue
                around = (best.get(tuple(sorted(rest))) or self.without(explanation, k)).end
                if (this := (*key, around.loss, explanation.evidence, rival.evidence)) in self._reduced:
                    continue
                self._reduced.add(this)
                joined = self._joined(around, rival, [other], explanation.end.loss)
                if joined is not None:
                    best[key] = joined

    def joined(self, one: Explanation, other: Explanation) -> None:
        """Both together where no set of their effects is known: each may explain other records, and larger
        sets are sought beside the likeliest alone."""
        further = [c for c in other.end.candidates if c.effect not in one.names]
        together = (*one.end.candidates, *further)
        key = tuple(sorted(c.effect for c in together))
        contained = {c.kind.contains for c in together} & set(key)
        if len(key) > self.case.machine.weighing.most_effects or contained or key in best_of_sets(self.found):
            return
        if (this := (*key, one.evidence, other.evidence)) not in self._reduced:
            self._reduced.add(this)
            self._joined(one.end, other, further, one.end.loss)

    def _joined(
        self, around: Descent, rival: Explanation, further: Sequence[Candidate], loss: float
    ) -> Explanation | None:
        """Effects of a rival beside others, from where it ended; None where much more than `loss` is left."""
        at = [rival.end.coordinates_of(rival.names.index(c.effect)) for c in further]
        x, candidates = np.concatenate([around.coordinates, *at]), (*around.candidates, *further)
        followed, d, x = best_following(self.records, around, candidates, [x])
        if followed >= loss + _AS_LIKELY:
            return None
        return self.add(descend(self.records, candidates, d, x, around.start))

    def without(self, explanation: Explanation, k: int) -> Explanation:
        """The best explanation by the same effects but the k-th."""
        end = explanation.end
        rest = tuple(c for j, c in enumerate(end.candidates) if j != k)
        key = tuple(sorted(c.effect for c in rest))
        if rest and (this := (*explanation.names, explanation.evidence, k)) not in self._reduced:
            self._reduced.add(this)
            x = np.concatenate([end.coordinates_of(j) for j in range(len(end.candidates)) if j != k])
            self.add(descend(self.records, rest, end.deviations, x, end.start))
        return max((e for e in self.found if e.key == key), key=lambda e: e.evidence)

    def by_these(self, chosen: Sequence[str], within: Explanation) -> Explanation:
        """The best explanation by these effects alone, `within` itself where it has no others."""
        key = tuple(sorted(chosen))
        if within.key == key:
            return within
        while not any(e.key == key for e in self.found):
            k = next(k for k, name in enumerate(within.names) if name not in chosen)
            within = self.without(within, k)
        return max((e for e in self.found if e.key == key), key=lambda e: e.evidence)

    def acts_on_held_out(self, explanation: Explanation, k: int) -> float:
        """Share of the motion that the k-th effect changes of held-out records, all else as it is; of the
        output that shows most of it."""
        end, held = explanation.end, self.held_out
        rest = [effect for j, effect in enumerate(end.effects) if j != k]
        start = self._beginning(held, end.start)
        pairs = zip(
            held.residuals(end.deviations, end.effects, start),
            held.residuals(end.deviations, rest, start),
            strict=True,
        )
        motion = held.levels.motion.reshape(-1, self.case.noise.size).sum(axis=0)
        changed = sum(np.sum((with_it - without) ** 2, axis=0) for with_it, without in pairs)
        return float(np.sqrt(np.max(changed / motion)))

    def finished(self, explanation: Explanation) -> Explanation:
        """Descended to its end."""
        end = explanation.end
        return self.add(
            descend(
                self.records,
                end.candidates,
                end.deviations,
                end.coordinates,
                end.start,
                iterations=_LAST_ITERATIONS,
                tolerance=_LAST_TOLERANCE,
            )
        )

    def stated(self) -> Explanation:
        """The nominal as stated: only the starts are fitted."""
        end = self.base.end
        stated = np.zeros(end.deviations.size)
        start, e = settled(self.records, stated, (), self._beginning(self.records, end.start))
        loss, prior = loss_at(self.records, e, stated, start)
        return self._explanation(
            replace(
                end,
                deviations=stated,
                start=start,
                left=e,
                weights=self.records.levels.weights(e),
                loss=loss,
                prior=prior,
            )
        )

    def left_by(self, other: Explanation) -> Real:
        """(2, Y) shares that the same effects leave here, descended on from where another search ended."""
        end = other.end
        here = descend(self.records, end.candidates, end.deviations, end.coordinates, end.start)
        return self._explanation(here).shares

    def add(self, end: Descent) -> Explanation:
        """The explanation with what it predicts of the held-out records, their starts fitted (`settled`)."""
        explanation = self._explanation(end)
        self.found.append(explanation)
        return explanation

    def _explanation(self, end: Descent) -> Explanation:
        records, held = self.records, self.held_out
        beginning = self._beginning(held, end.start)
        touching = self._touching and end.non_smooth
        start, e = settled(held, end.deviations, end.effects, beginning, touching=touching)
        left, left_held_out = records.residuals_of(end.left), held.residuals_of(e)
        states = 0.5 * np.sum((start.states / held.state_spread) ** 2, axis=1)
        fitted, begun = records.energies(left), [e.name in self.first_halves for e in records.experiments]
        predicted = np.concatenate([fitted[:, begun], held.energies(left_held_out)], axis=1)
        return Explanation(
            end,
            -np.concatenate([records.losses(end.left), held.losses(e) + states]),
            -end.prior,
            occam(records, end),
            left,
            left_held_out,
            np.array([share_left(fitted), share_left(predicted)]),
        )

    def _beginning(self, held: Records, fitted: Start) -> Start:
        """Starts of records as their first samples say, sensors at the zeros that others have."""
        start = held.at_rest()
        if not start.zeros.size:
            return start
        return start.with_zeros(fitted.zeros, self.case.machine.unknown_start.state_per_zero)


def best_of_sets(found: Iterable[Explanation]) -> dict[tuple[str, ...], Explanation]:
    """The best explanation by each set of effects, the likeliest first."""
    best: dict[tuple[str, ...], Explanation] = {}
    for explanation in sorted(found, key=lambda e: -e.evidence):
        best.setdefault(explanation.key, explanation)
    return best


def _unusual(explanation: Explanation) -> frozenset[str]:
    """Its effects but those that every machine has some of."""
    return frozenset(c.effect for c in explanation.end.candidates if not c.kind.everywhere)


def _spread(points: Sequence[Point]) -> Sequence[Point]:
    """The best and, because beside another effect any size may be right, some of the rest."""
    rest = points[_BESIDE_POINTS:]
    return [*points[:_BESIDE_POINTS], *rest[:: max(1, len(rest) // _BESIDE_POINTS)]]


def _local_minima(points: Sequence[Point]) -> list[Point]:
    """Of a grid of one value, best first; of several values none is sought."""
    if points[0].coordinates.size != 1:
        return []
    line = sorted(points, key=lambda point: float(point.coordinates[0]))
    peaks, _ = find_peaks([-np.inf, *(-point.loss for point in line), -np.inf])
    return sorted([line[k - 1] for k in peaks], key=lambda point: point.loss)


def _point(end: Descent) -> Point:
    return Point(end.loss, end.coordinates, end.deviations, end.start)
