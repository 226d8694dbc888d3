"""What records can tell of a machine before anything is fitted: sizes that show, and what acts alike.

A candidate is a stated value or a listed effect. To first order it changes the outputs by a column, over what
does not show: the stated model error, and the noise of an average over the record.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import Plant, PlantCase, PlantExperiment, SimulationError
from diagnosis.machine.plant_effect import Change, PlantEffect

# Relative change of a stated value that is simulated: small beside what bends, large beside rounding.
_STEP = 0.02
# Records that are simulated, the longest; more take longer.
_RECORDS = 2
# Standard deviations of the mean of the noise that show.
_SHOWS = 3.0
# Columns that leave less than this of another one do the same as it. Chosen: doubled, a third of what a
# candidate does counts as nothing.
_ALIKE = 0.15
# Columns that are taken together for another one at most: of more, one in a page's list says nothing.
_MOST_TOGETHER = 3
# A stated value that would have to be wrong by more (relative) to show is not told.
_FARTHEST = 1.0
# Sizes of a limit that are simulated: of a range of twenty to one, steps of an eighth.
_LIMIT_SIZES = 24
# What is added to squared lengths of columns, of length one, where they are nearly the same.
_REGULAR = 1e-9


@dataclass(frozen=True)
class Alike:
    """Candidates of which the records show what they do together.

    left : of what the first one does where the others make up for it, as a share of it.
    """

    names: tuple[str, ...]
    left: float


@dataclass(frozen=True)
class Telling:
    """What records tell of every candidate.

    least : candidate (`Plant.value_candidates`, and effects) -> smallest size that shows: of a stated value
        relative, of an effect in its unit; of one that does less where it is larger, as a limit, the largest;
        inf where it does nothing.
    hidden : candidates that show at no size that is searched.
    alike : groups.
    unlooked : candidates that a deadline left out.
    failed : candidate with which the simulation fails -> how it does.
    """

    least: Mapping[str, float]
    hidden: tuple[str, ...]
    alike: tuple[Alike, ...]
    unlooked: tuple[str, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Records:
    """Records of a plant that are simulated.

    experiments : the longest ones. stated : their outputs (T, Y) as stated. levels : (Y,) of each, what does
    not show.
    """

    plant: Plant
    experiments: Sequence[PlantExperiment]
    stated: Sequence[Real]
    levels: Sequence[Real]

    @classmethod
    def of(cls, case: PlantCase) -> _Records:
        """The longest estimation records of a case."""
        longest = sorted(case.estimation, key=lambda e: -len(e.output))[:_RECORDS]
        levels = []
        for e in longest:
            model_error = case.model_error * np.std(e.output, axis=0)
            levels.append(np.hypot(model_error, _SHOWS * case.plant.noise / np.sqrt(len(e.output))))
        run = case.plant.simulator(())
        return cls(case.plant, longest, [run(e.input) for e in longest], levels)

    def column(self, plant: Plant, changes: Sequence[Change]) -> Real:
        """(N,) what a plant with changes does in all records and outputs, over what does not show.

        Raises SimulationError where the simulation fails with it.
        """
        run = plant.simulator(changes)
        columns = []
        for e, stated, level in zip(self.experiments, self.stated, self.levels, strict=True):
            columns.append(((run(e.input) - stated) / level).ravel())
        return np.concatenate(columns)

    def shown(self, column: Real) -> float:
        """Largest RMS of an output of a record in a column (N,)."""
        n_outputs = self.plant.noise.size
        ends = np.cumsum([n_outputs * len(e.output) for e in self.experiments])
        largest = 0.0
        for part in np.split(column, ends[:-1]):
            mean_square = np.mean(part.reshape(-1, n_outputs) ** 2, axis=0)
            largest = max(largest, float(np.sqrt(np.max(mean_square))))
        return largest


def telling(case: PlantCase, deadline_s: float = np.inf) -> Telling:
    """What the longest estimation records of a case can tell of every candidate.

    deadline_s : of time.monotonic(); what is left then is not looked at.
    """
    plant = case.plant
    records = _Records.of(case)
    columns = dict[str, Real]()
    least = dict[str, float]()
    largest = dict[str, float]()
    failed = dict[str, str]()

    # To first order: every stated value moved by a small step.
    values = plant.value_candidates
    for name, parameter in values.items():
        if time.monotonic() > deadline_s:
            break
        try:
            column = records.column(plant.scaled({parameter: 1 + _STEP}), ())
        except SimulationError as error:
            failed[name] = error.reason
            continue
        columns[name] = column
        least[name] = _least_size(_STEP, records.shown(column))
        largest[name] = _FARTHEST

    # Every effect at the middle one of its starts.
    for effect in plant.effects:
        if time.monotonic() > deadline_s:
            break
        candidate = effect.candidates()[0]
        middle = candidate.starts[len(candidate.starts) // 2]
        change = candidate.effect_at(np.array(middle))
        try:
            column = records.column(plant, (change,))
        except SimulationError as error:
            failed[effect.name] = error.reason
            continue
        columns[effect.name] = column
        size = effect.parameters[0]
        least[effect.name] = _least_size(abs(change.values[size.name]), records.shown(column))
        largest[effect.name] = size.high

    # A limit shows from some size down, which no slope tells: its range in steps.
    for effect in plant.effects:
        if effect.grows or effect.name not in columns or time.monotonic() > deadline_s:
            continue
        try:
            shown = _shown_limits(effect, records)
        except SimulationError as error:
            failed[effect.name] = error.reason
            del columns[effect.name]
            del least[effect.name]
            continue
        least[effect.name] = max(shown, default=np.inf)
        if shown and not np.any(columns[effect.name]):
            columns[effect.name] = shown[least[effect.name]]

    hidden = tuple(name for name in columns if not least[name] < largest[name])
    shapes = {name: column / np.linalg.norm(column) for name, column in columns.items() if name not in hidden}
    names = [*values, *(effect.name for effect in plant.effects)]
    unlooked = tuple(name for name in names if name not in columns and name not in failed)
    return Telling(least, hidden, _alike(shapes), unlooked, failed)


def _least_size(size: float, shown: float) -> float:
    """Size that just shows, in proportion, where one of this size shows so many times; inf where it never
    does."""
    return size / shown if shown > 0 else np.inf


def _shown_limits(effect: PlantEffect, records: _Records) -> dict[float, Real]:
    """Size -> column (N,) of the sizes of an effect's range that show, further parameters as in its first
    start.

    Raises SimulationError where the simulation fails with one.
    """
    candidate = effect.candidates()[0]
    size = effect.parameters[0].name
    shown = {}
    for coordinate in np.linspace(*candidate.axes[0].box, _LIMIT_SIZES):
        change = candidate.effect_at(np.array([coordinate, *candidate.starts[0][1:]]))
        column = records.column(records.plant, (change,))
        if records.shown(column) > 1:
            shown[abs(change.values[size])] = column
    return shown


def _alike(columns: Mapping[str, Real]) -> tuple[Alike, ...]:
    """Groups of one column (N,), of length one, and few others that together do the same.

    They are added one by one, each time the one that leaves least: not always the fewest that would do. A
    group that holds another one is left out.
    """
    names = list(columns)
    if len(names) < 2:
        return ()
    whole = np.array(list(columns.values()))
    gram = whole @ whole.T
    groups = list[Alike]()
    for j in range(len(names)):
        candidates = [k for k in range(len(names)) if k != j]
        # Beside a group there may be another one without the candidate that did most in it.
        while candidates:
            chosen, left = _replacing(gram, j, candidates)
            if left > _ALIKE:
                break
            candidates.remove(chosen[0])
            group = {names[k] for k in (j, *chosen)}
            if not any(set(known.names) <= group for known in groups):
                groups = [known for known in groups if not group < set(known.names)]
                groups.append(Alike((names[j], *(names[k] for k in chosen)), left))
    return tuple(groups)


def _replacing(gram: Real, j: int, others: Sequence[int]) -> tuple[list[int], float]:
    """Up to `_MOST_TOGETHER` of the others that do what the j-th does, and the share of it that they leave.

    gram : (K, K) products of the columns. Greedy: each next one is that which leaves least beside those
    before it, until little is left.
    """
    chosen = list[int]()
    left = 1.0
    for _ in range(min(_MOST_TOGETHER, len(others))):
        remaining = [k for k in others if k not in chosen]
        left_with = [_left(gram, j, [*chosen, k]) for k in remaining]
        chosen.append(remaining[int(np.argmin(left_with))])
        left = min(left_with)
        if left < _ALIKE:
            break
    return chosen, left


def _left(gram: Real, j: int, chosen: Sequence[int]) -> float:
    """Share of the j-th column that the chosen ones leave by least squares; gram (K, K) of columns of length
    one."""
    inner = gram[np.ix_(chosen, chosen)] + _REGULAR * np.eye(len(chosen))
    explained = float(gram[chosen, j] @ np.linalg.solve(inner, gram[chosen, j]))
    return float(np.sqrt(max(1 - explained, 0.0)))
