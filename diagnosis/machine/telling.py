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
from diagnosis.machine.own_plant import Plant, PlantCase, SimulationError

# Of a stated value, the relative change that is simulated; records that are simulated, the longest.
_STEP, _RECORDS = 0.02, 2
# Standard deviations of the mean of the noise that show.
_SHOWS = 3.0
# Columns that leave less than this of another one do the same as it; at most so many of them.
_ALIKE, _MOST = 0.15, 3
# A stated value that would have to be wrong by more to show is not told.
_FARTHEST = 1.0


@dataclass(frozen=True)
class Alike:
    """Candidates of which the records show what they do together.

    left : of what the first one does where the others make up for it, as a share of it.
    """

    names: tuple[str, ...]
    left: float


@dataclass(frozen=True)
class Telling:
    """least : candidate (`Plant.value_candidates`, and effects) -> smallest size that shows: of a stated
    value relative, of an effect in its unit;
    of one that does less where it is larger, as a limit, the largest; inf where it does nothing.
    hidden : candidates that show at no size that is searched. alike : groups.
    unlooked : candidates that a deadline left out. failed : candidate with which the simulation fails -> how
    it does.
    """

    least: Mapping[str, float]
    hidden: tuple[str, ...]
    alike: tuple[Alike, ...]
    unlooked: tuple[str, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)


def telling(case: PlantCase, deadline_s: float = np.inf) -> Telling:
    """What the longest estimation records of a case can tell of every candidate.

    deadline_s : of time.monotonic(); what is left then is not looked at.
    """
    plant = case.plant
    records = sorted(case.estimation, key=lambda e: -len(e.output))[:_RECORDS]
    levels = [
        np.hypot(case.model_error * np.std(e.output, axis=0), _SHOWS * plant.noise / np.sqrt(len(e.output)))
        for e in records
    ]
    stated = _outputs(plant, (), records)
    columns = dict[str, Real]()
    sizes = dict[str, float]()
    largest = dict[str, float]()
    failed = dict[str, str]()

    # To first order: every stated value moved by a small step.
    values = plant.value_candidates
    for name, parameter in values.items():
        if time.monotonic() > deadline_s:
            break
        try:
            moved = _outputs(plant.scaled({parameter: 1 + _STEP}), (), records)
        except SimulationError as error:
            failed[name] = error.reason
            continue
        columns[name] = _over(moved, stated, levels)
        sizes[name] = _STEP
        largest[name] = _FARTHEST

    # Every effect at the middle one of its starts.
    for effect in plant.effects:
        if time.monotonic() > deadline_s:
            break
        candidate = effect.candidates()[0]
        change = candidate.effect_at(np.array(candidate.starts[len(candidate.starts) // 2]))
        try:
            moved = _outputs(plant, (change,), records)
        except SimulationError as error:
            failed[effect.name] = error.reason
            continue
        columns[effect.name] = _over(moved, stated, levels)
        sizes[effect.name] = abs(change.values[effect.parameters[0].name])
        largest[effect.name] = effect.parameters[0].high
    samples = [len(e.output) for e in records]
    shows = {name: _shown(column, samples) for name, column in columns.items()}
    least = {name: sizes[name] / shows[name] if shows[name] > 0 else np.inf for name in columns}

    # A limit shows from some size down, which no slope tells: its range in steps.
    for effect in plant.effects:
        if effect.grows or effect.name not in columns or time.monotonic() > deadline_s:
            continue
        candidate = effect.candidates()[0]
        # Of a range of twenty to one, steps of an eighth.
        grid = [np.array([x, *candidate.starts[0][1:]]) for x in np.linspace(*candidate.axes[0].box, 24)]
        changes = [candidate.effect_at(x) for x in grid]
        try:
            done = [_over(_outputs(plant, (change,), records), stated, levels) for change in changes]
        except SimulationError as error:
            failed[effect.name] = error.reason
            del columns[effect.name], least[effect.name]
            continue
        first = effect.parameters[0].name
        seen = {abs(c.values[first]): d for c, d in zip(changes, done, strict=True) if _shown(d, samples) > 1}
        least[effect.name] = max(seen, default=np.inf)
        if seen and not np.any(columns[effect.name]):
            columns[effect.name] = seen[least[effect.name]]

    hidden = tuple(name for name in columns if not least[name] < largest[name])
    told = {name: c / np.linalg.norm(c) for name, c in columns.items() if name not in hidden}
    names = [*values, *(effect.name for effect in plant.effects)]
    unlooked = tuple(name for name in names if name not in columns and name not in failed)
    return Telling(least, hidden, _alike(told), unlooked, failed)


def _outputs(plant: Plant, changes: Sequence[object], records: Sequence[object]) -> list[Real]:
    run = plant.simulator(changes)  # type: ignore[arg-type]
    return [run(e.input) for e in records]  # type: ignore[attr-defined]


def _over(moved: Sequence[Real], stated: Sequence[Real], levels: Sequence[Real]) -> Real:
    return np.concatenate(
        [((m - s) / level).ravel() for m, s, level in zip(moved, stated, levels, strict=True)]
    )


def _shown(column: Real, samples: Sequence[int]) -> float:
    """Largest RMS of an output of a record, over what does not show."""
    outputs = len(column) // sum(samples)
    parts = np.split(column, outputs * np.cumsum(samples)[:-1])
    return float(max(np.sqrt(np.max(np.mean(p.reshape(-1, outputs) ** 2, axis=0))) for p in parts))


def _alike(columns: Mapping[str, Real]) -> tuple[Alike, ...]:
    """Of every column few others that together do the same.

    They are added one by one, each time the one that leaves least: not always the fewest there are.
    """
    names, found = list(columns), list[Alike]()
    if len(names) < 2:
        return ()
    whole = np.array(list(columns.values()))
    gram = whole @ whole.T
    for j in range(len(names)):
        others = [k for k in range(len(names)) if k != j]
        # Beside a group there may be another one without the candidate that did most in it.
        while others:
            chosen, left = _replacing(gram, j, others)
            if left > _ALIKE:
                break
            others.remove(chosen[0])
            group = {names[k] for k in (j, *chosen)}
            if not any({*one.names} <= group for one in found):
                found = [one for one in found if not group < {*one.names}]
                found.append(Alike((names[j], *(names[k] for k in chosen)), left))
    return tuple(found)


def _replacing(gram: Real, j: int, others: Sequence[int]) -> tuple[list[int], float]:
    """Up to `_MOST` of the others that do what the j-th does, and what they leave of it.

    Greedy: each next one is that which leaves least beside those before it, until little is left.
    """
    chosen, left = list[int](), 1.0
    for _ in range(min(_MOST, len(others))):
        rest = [k for k in others if k not in chosen]
        trials = [_left(gram, j, [*chosen, k]) for k in rest]
        chosen.append(rest[int(np.argmin(trials))])
        left = min(trials)
        if left < _ALIKE:
            break
    return chosen, left


def _left(gram: Real, j: int, chosen: Sequence[int]) -> float:
    """Of the j-th column of length one where the chosen ones make up for it."""
    inner = gram[np.ix_(chosen, chosen)] + 1e-9 * np.eye(len(chosen))
    return float(np.sqrt(max(1 - float(gram[chosen, j] @ np.linalg.solve(inner, gram[chosen, j])), 0.0)))
