"""Many machines at once: those of one cause and size together, sizes that change with their numbers."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from plant.effects import in_words
from workflow.diagnose.words import closure_words, short_answer
from workflow.text.formats import listing

# Chance of one false trend in an overview, or one false gap among sizes, all of them together (Bonferroni).
_FALSE_TREND = 0.01
# With fewer machines no order of them is as unlikely as that.
_LEAST_MACHINES = 6
_NUMBERS = ("probability", "gap_before", "gap_refit", "gap_after", "noise_floor")


@dataclass(frozen=True, eq=False)
class FleetMachine:
    """What an overview keeps of an answer: numbers (`_NUMBERS`), sizes of the effects that are present, with
    95 % intervals, under (effect, parameter), and stated and repaired values by name."""

    name: str
    verdict: str
    decided: bool
    effects: tuple[str, ...]
    answer: str
    closed: str
    numbers: Mapping[str, float]
    sizes: Mapping[tuple[str, str], tuple[float, float, float]]
    values: Mapping[str, tuple[float, float]]

    @property
    def cause(self) -> str:
        """The effects, without how sure they are; where none is named, the answer."""
        return listing([in_words(name) for name in self.effects]) if self.effects else self.answer

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> FleetMachine:
        """Of a JSON answer."""
        present = {
            name: effect
            for name, effect in document["presence"].items()
            if name in document["combination"] or effect["probability"] >= 0.5
        }
        unknown = (float("nan"), float("nan"))
        return cls(
            document["case"],
            document["verdict"],
            document["verdict"] != "unknown" and document["detail_verdict"] != "not_converged",
            tuple(sorted(present)),
            short_answer(document),
            closure_words(document),
            {key: document[key] for key in _NUMBERS},
            {
                (name, key): (value, *(effect["intervals"].get(key) or unknown))
                for name, effect in present.items()
                for key, value in effect["parameters"].items()
            },
            {key: (one["stated"], one["repaired"]) for key, one in document["repair"]["values"].items()},
        )


@dataclass(frozen=True, eq=False)
class Group:
    """Machines of one cause. sizes: (effect, parameter) -> median, smallest, largest. apart: the size that
    sets them apart from others of this cause."""

    cause: str
    machines: tuple[FleetMachine, ...]
    apart: tuple[str, str] | None = None

    @property
    def sizes(self) -> dict[tuple[str, str], tuple[float, float, float]]:
        found: dict[tuple[str, str], tuple[float, float, float]] = {}
        for key in dict.fromkeys(key for one in self.machines for key in one.sizes):
            values = [one.sizes[key][0] for one in self.machines if key in one.sizes]
            found[key] = float(np.median(values)), min(values), max(values)
        return found


@dataclass(frozen=True)
class Trend:
    """A size or value that changes with the number in the names: Kendall's tau, its p value, Theil-Sen slope.

    effect : "" of a stated value that was re-estimated.
    """

    effect: str
    parameter: str
    tau: float
    p: float
    per_number: float
    machines: int


def groups(machines: Iterable[FleetMachine]) -> list[Group]:
    """By cause, the most frequent first, and by size where there is a gap."""
    found: dict[str, list[FleetMachine]] = {}
    for one in machines:
        found.setdefault(one.cause, []).append(one)
    ordered = sorted(found.items(), key=lambda item: (-len(item[1]), item[0]))
    return [
        Group(cause, tuple(part), apart) for cause, members in ordered for part, apart in _by_size(members)
    ]


def _by_size(
    members: list[FleetMachine], apart: tuple[str, str] | None = None
) -> list[tuple[list[FleetMachine], tuple[str, str] | None]]:
    """Parts that are farther from each other than any two of one part, by the size with the surest gap.

    Beyond that, sizes spread evenly over the whole range (on a log scale) would seldom leave such a gap: the
    largest of n - 1 spacings exceeds a share g of it with probability (n - 1) (1 - g)^(n - 2) at most.
    """
    n = len(members)
    best: tuple[float, float, tuple[str, str]] = (_FALSE_TREND, 0.0, ("", ""))
    keys = [key for key in members[0].sizes if all(key in one.sizes for one in members)]
    for key in keys if n >= _LEAST_MACHINES else ():
        sizes = np.sort([one.sizes[key][0] for one in members])
        x = np.sign(sizes) * np.log(np.abs(sizes)) if np.min(sizes) * np.max(sizes) > 0 else sizes
        k = int(np.argmax(np.diff(x))) + 1
        gap = x[k] - x[k - 1]
        if 1 < k < n - 1 and gap > max(x[k - 1] - x[0], x[-1] - x[k]):
            chance = len(keys) * (n - 1) * (1 - gap / (x[-1] - x[0])) ** (n - 2)
            best = min(best, (float(chance), float(sizes[k]), key))
    chance, first, key = best
    if not chance < _FALSE_TREND:
        return [(members, apart)]
    parts = [[one for one in members if (one.sizes[key][0] >= first) == large] for large in (False, True)]
    return [found for part in parts for found in _by_size(part, key)]


def serial_numbers(names: Sequence[str]) -> dict[str, int]:
    """Name -> its number, of the names that differ in numbers alone: that with the most different values, of
    two the last. Empty where there is none."""
    pattern = Counter(re.sub(r"\d+", "#", name) for name in names).most_common(1)
    alike = [name for name in names if pattern and re.sub(r"\d+", "#", name) == pattern[0][0]]
    numbers = {name: [int(part) for part in re.findall(r"\d+", name)] for name in alike}
    columns = list(zip(*numbers.values(), strict=True))
    if not columns:
        return {}
    best = max(range(len(columns)), key=lambda k: (len(set(columns[k])), k))
    return {name: values[best] for name, values in numbers.items()} if len(set(columns[best])) > 1 else {}


def trends(machines: Sequence[FleetMachine]) -> list[Trend]:
    """Sizes and values that rise or fall with the number in the names, the surest first.

    Kendall's rank test over the machines whose cause is decided; an effect that a machine lacks has the size
    zero there (of a ratio: one). Neglected: that intervals of the sizes differ.
    """
    from scipy.stats import kendalltau, theilslopes  # here: it takes its time to load

    numbers = serial_numbers([one.name for one in machines])
    known = [one for one in machines if one.name in numbers and one.decided]
    series: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for key in dict.fromkeys(key for one in known for key in one.sizes):
        without = (1.0 if key[1] == "ratio" else 0.0,)
        series[key] = [(numbers[one.name], one.sizes.get(key, without)[0]) for one in known]
    for value in dict.fromkeys(value for one in known for value in one.values):
        series["", value] = [
            (numbers[one.name], one.values[value][1]) for one in known if value in one.values
        ]
    found = []
    for (effect, parameter), pairs in series.items():
        at, size = np.array(pairs, dtype=np.float64).T
        if len(pairs) < _LEAST_MACHINES or np.ptp(size) == 0:
            continue
        tau, p = kendalltau(at, size)
        if p * len(series) < _FALSE_TREND:
            slope = float(theilslopes(size, at)[0])
            found.append(Trend(effect, parameter, float(tau), float(p), slope, len(pairs)))
    return sorted(found, key=lambda one: one.p)


def csv_text(machines: Sequence[FleetMachine], failures: Mapping[str, str]) -> str:
    """One row per machine with answer, numbers, sizes with intervals and values; then what failed."""
    numbers = serial_numbers([one.name for one in machines])
    rows: list[dict[str, Any]] = []
    for one in machines:
        row: dict[str, Any] = {
            "case": one.name,
            "number": numbers.get(one.name, ""),
            "verdict": one.verdict,
            "answer": one.answer,
        }
        row |= one.numbers
        for (effect, key), size in one.sizes.items():
            ends = ("", ".low", ".high")
            row |= {f"{effect}.{key}{end}": value for end, value in zip(ends, size, strict=True)}
        for key, (stated, repaired) in one.values.items():
            row |= {f"{key} (stated)": stated, f"{key} (repaired)": repaired}
        rows.append(row)
    rows += [{"case": case, "verdict": "failed", "answer": reason} for case, reason in failures.items()]
    text = io.StringIO()
    first = ["case", "number", "verdict", "answer", *_NUMBERS]
    names = dict.fromkeys([*first, *sorted({name for row in rows for name in row} - set(first))])
    writer = csv.DictWriter(text, list(names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
