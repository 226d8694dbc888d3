"""Many machines at once: those of one cause and size together, sizes that change with their numbers.

Groups and trends, and what terminal and overview say of them.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from plant.effects import in_words
from workflow.describe.diagnosis_rows import explained_words, present_of, short_answer
from workflow.describe.diagnosis_words import (
    key_words,
    names_words,
    probability_words,
    times_noise,
    value_words,
)
from workflow.describe.facts import (
    Block,
    FirstScreen,
    Page,
    PageSection,
    Picture,
    Quantity,
    Remarks,
    Row,
    Section,
    Table,
    file_link,
)
from workflow.text.formats import count, listing, sentence
from workflow.text.names import stated_name

# Chance of one false trend in an overview, or one false gap among sizes, all of them together (Bonferroni).
_FALSE_TREND = 0.01
# Machines that a group names: its words stay within a few lines.
_MOST_NAMED = 12
# Machines of an overview with a line each in its picture: more lines could not be told apart.
_MOST_DRAWN = 20
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
        return names_words(self.effects) if self.effects else self.answer

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> FleetMachine:
        """What an overview keeps of a JSON answer."""
        verdict = document["verdict"]
        decided = verdict != "unknown" and document["detail_verdict"] != "not_converged"
        effects = present_of(document)
        sizes = {}
        for name in effects:
            effect = document["presence"][name]
            for key, value in effect["parameters"].items():
                low, high = effect["intervals"].get(key) or (math.nan, math.nan)
                sizes[name, key] = (value, low, high)
        values = {}
        for key, value in document["repair"]["values"].items():
            values[key] = (value["stated"], value["repaired"])
        return cls(
            document["case"],
            verdict,
            decided,
            tuple(sorted(effects)),
            short_answer(document),
            explained_words(document),
            {key: document[key] for key in _NUMBERS},
            sizes,
            values,
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
        sizes: dict[tuple[str, str], tuple[float, float, float]] = {}
        for key in dict.fromkeys(key for machine in self.machines for key in machine.sizes):
            values = [machine.sizes[key][0] for machine in self.machines if key in machine.sizes]
            median = float(np.median(values))
            sizes[key] = (median, min(values), max(values))
        return sizes


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
    by_cause: dict[str, list[FleetMachine]] = {}
    for machine in machines:
        by_cause.setdefault(machine.cause, []).append(machine)
    # Causes of as many machines stand in the order of their words.
    ordered = sorted(by_cause.items(), key=lambda item: (-len(item[1]), item[0]))
    found_groups = []
    for cause, members in ordered:
        for part, apart in _by_size(members):
            found_groups.append(Group(cause, tuple(part), apart))
    return found_groups


def _by_size(
    members: list[FleetMachine], apart: tuple[str, str] | None = None
) -> list[tuple[list[FleetMachine], tuple[str, str] | None]]:
    """Parts that are farther from each other than any two of one part, by the size with the surest gap.

    Beyond that, sizes spread evenly over the whole range (on a log scale) would seldom leave such a gap: the
    largest of n - 1 spacings exceeds a share g of it with probability (n - 1) (1 - g)^(n - 2) at most.
    """
    n = len(members)
    if n < _LEAST_MACHINES:
        return [(members, apart)]
    best: tuple[float, float, tuple[str, str]] = (_FALSE_TREND, 0.0, ("", ""))
    keys = [key for key in members[0].sizes if all(key in machine.sizes for machine in members)]
    for key in keys:
        sizes = np.sort([machine.sizes[key][0] for machine in members])
        # Sizes of one sign are compared by their ratios.
        x = sizes
        if sizes[0] * sizes[-1] > 0:
            x = np.sign(sizes) * np.log(np.abs(sizes))
        # The widest gap parts the machines; it counts where two or more lie on either side, nearer together.
        k = int(np.argmax(np.diff(x))) + 1
        gap = x[k] - x[k - 1]
        width_below = x[k - 1] - x[0]
        width_above = x[-1] - x[k]
        has_two_on_either_side = 1 < k < n - 1
        if has_two_on_either_side and gap > max(width_below, width_above):
            whole_width = x[-1] - x[0]
            gap_share = gap / whole_width
            # Every size is a trial more.
            chance = len(keys) * (n - 1) * (1 - gap_share) ** (n - 2)
            best = min(best, (float(chance), float(sizes[k]), key))
    chance, first_above, key = best
    if not chance < _FALSE_TREND:
        return [(members, apart)]
    below = [machine for machine in members if machine.sizes[key][0] < first_above]
    above = [machine for machine in members if machine.sizes[key][0] >= first_above]
    return [*_by_size(below, key), *_by_size(above, key)]


def serial_numbers(names: Sequence[str]) -> dict[str, int]:
    """Name -> its number, of the names that differ in numbers alone: that with the most different values, of
    two the last. Empty where there is none."""
    if not names:
        return {}
    # Names of the most frequent form, "arm # of #": others cannot be put in a row with them.
    form_of = {name: re.sub(r"\d+", "#", name) for name in names}
    forms = Counter(form_of[name] for name in names)
    (usual_form, _) = forms.most_common(1)[0]
    numbers = {}
    for name in names:
        if form_of[name] == usual_form:
            numbers[name] = [int(part) for part in re.findall(r"\d+", name)]

    # The place whose numbers differ most; of a date and a serial number the later one.
    columns = list(zip(*numbers.values(), strict=True))
    if not columns:
        return {}
    different = [len(set(column)) for column in columns]
    best = max(range(len(columns)), key=lambda place: (different[place], place))
    if different[best] == 1:
        return {}
    return {name: values[best] for name, values in numbers.items()}


def trends(machines: Sequence[FleetMachine]) -> list[Trend]:
    """Sizes and values that rise or fall with the number in the names, the surest first.

    Kendall's rank test over the machines whose cause is decided; an effect that a machine lacks has the size
    zero there (of a ratio: one). Neglected: that intervals of the sizes differ.
    """
    # Here: it takes its time to load.
    from scipy.stats import kendalltau, theilslopes

    numbers = serial_numbers([machine.name for machine in machines])
    known = [machine for machine in machines if machine.name in numbers and machine.decided]
    series: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for key in dict.fromkeys(key for machine in known for key in machine.sizes):
        # The size that changes nothing.
        without = 0.0
        if key[1] == "ratio":
            without = 1.0
        pairs = []
        for machine in known:
            size = without
            if key in machine.sizes:
                size = machine.sizes[key][0]
            pairs.append((numbers[machine.name], size))
        series[key] = pairs
    for value in dict.fromkeys(value for machine in known for value in machine.values):
        pairs = []
        for machine in known:
            if value in machine.values:
                _, repaired = machine.values[value]
                pairs.append((numbers[machine.name], repaired))
        series["", value] = pairs

    # Each series is a trial: all of them together have one chance of a false trend.
    significant = []
    for (effect, parameter), pairs in series.items():
        at, sizes = np.array(pairs, dtype=np.float64).T
        if len(pairs) < _LEAST_MACHINES or np.ptp(sizes) == 0:
            continue
        tau, p = kendalltau(at, sizes)
        if p * len(series) < _FALSE_TREND:
            slope = float(theilslopes(sizes, at)[0])
            significant.append(Trend(effect, parameter, float(tau), float(p), slope, len(pairs)))
    return sorted(significant, key=lambda trend: trend.p)


def csv_text(machines: Sequence[FleetMachine], failures: Mapping[str, str]) -> str:
    """One row per machine with answer, numbers, sizes with intervals and values; then what failed."""
    numbers = serial_numbers([machine.name for machine in machines])
    rows: list[dict[str, Any]] = []
    for machine in machines:
        row: dict[str, Any] = {
            "case": machine.name,
            "number": numbers.get(machine.name, ""),
            "verdict": machine.verdict,
            "answer": machine.answer,
        }
        row |= machine.numbers
        for (effect, key), (size, low, high) in machine.sizes.items():
            column = f"{effect}.{key}"
            row[column] = size
            row[f"{column}.low"] = low
            row[f"{column}.high"] = high
        for key, (stated, repaired) in machine.values.items():
            row[f"{key} (stated)"] = stated
            row[f"{key} (repaired)"] = repaired
        rows.append(row)
    for case, reason in failures.items():
        rows.append({"case": case, "verdict": "failed", "answer": reason})

    # Columns that every machine has come first, then sizes and values by their names.
    first_columns = ["case", "number", "verdict", "answer", *_NUMBERS]
    all_columns = {name for row in rows for name in row}
    further_columns = sorted(all_columns - set(first_columns))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*first_columns, *further_columns], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def trend_words(trend: Trend) -> str:
    """A trend in one sentence without its full stop."""
    what = key_words(trend.parameter)
    if trend.effect:
        what = f"{in_words(trend.effect)}: {stated_name(trend.parameter)}"
    grows = "falls"
    if trend.tau > 0:
        grows = "grows"
    slope = value_words(trend.parameter, abs(trend.per_number))
    return (
        f"{what} {grows} with the number in the name, by {slope} per number (Kendall's tau {trend.tau:.2f}, "
        f"p = {trend.p:.1g}, {trend.machines} machines)"
    )


def machines_section(machine_groups: Sequence[Group], size_trends: Sequence[Trend]) -> Section:
    """Groups and trends on a terminal."""
    rows = []
    for group in machine_groups:
        words = group.cause
        for (effect, key), (middle, low, high) in group.sizes.items():
            extent = f"{value_words(key, low)} to {value_words(key, high)}"
            size = f"{stated_name(key)} {value_words(key, middle)} ({extent})"
            words += f"; {in_words(effect)}: {size}"
        machines = count(len(group.machines), "machine")
        rows.append(Row("", machines, Quantity.words(words)))
    for trend in size_trends:
        rows.append(Row("", "trend", Quantity.words(trend_words(trend))))
    return Section("machines", tuple(rows))


def overview_page(machines: Sequence[FleetMachine], failed: Mapping[str, str]) -> Page:
    """The page of several cases.

    Args:
        machines: Those with an answer.
        failed: Case without an answer -> why.
    """
    machine_groups = groups(machines)
    bullets = [_group_words(group) for group in machine_groups]
    bullets += [sentence(trend_words(trend)) for trend in trends(machines)]
    sections = []
    causes = causes_table(machine_groups)
    if causes.rows:
        sections.append(PageSection("causes", "Machines of one cause", "Causes", (causes,), open=True))
    if machines:
        picture = Picture(
            "gap_overview",
            "RMS of (measured - model) over the sensor noise, validation records.",
            (machines,),
        )
        blocks: tuple[Block, ...] = (cases_table(machines),)
        # With more machines the lines of the picture could not be told apart.
        if len(machines) <= _MOST_DRAWN:
            blocks = (picture, *blocks)
        sections.append(PageSection("cases", "All cases", "Cases", blocks, open=True))
    if failed:
        reasons = Remarks(tuple(f"{case}: {reason}" for case, reason in failed.items()), "warning")
        sections.append(PageSection("failed", "Cases without an answer", "Failed", (reasons,), open=True))
    outcome = outcome_words(machines, failed)
    first = FirstScreen(outcome, "plain", (), tuple(bullets), short="Outcome")
    return Page("Gap diagnosis", first, tuple(sections))


def outcome_words(machines: Sequence[FleetMachine], failed: Mapping[str, str]) -> str:
    """How many cases have which kind of answer."""
    verdicts = Counter(machine.verdict for machine in machines)
    kinds = [
        (verdicts["effect"], "with a named effect"),
        (verdicts["none"], "without a model error"),
        (verdicts["unknown"], "with none of the candidate effects"),
        (len(failed), "failed"),
    ]
    parts = listing([f"{number} {what}" for number, what in kinds if number])
    cases = count(len(machines) + len(failed), "case")
    return f"{cases}: {parts}"


def _group_words(group: Group) -> str:
    """Machines of one cause, with links to their pages."""
    words = f"{count(len(group.machines), 'machine')}: {group.cause}"
    if group.apart:
        key = group.apart[1]
        _, low, high = group.sizes[group.apart]
        words += f", {stated_name(key)} {value_words(key, low)} to {value_words(key, high)}"
    named = group.machines[:_MOST_NAMED]
    links = [file_link(f"{machine.name}.html", machine.name) for machine in named]
    unnamed = ""
    if len(group.machines) > len(named):
        unnamed = ", …"
    all_links = Markup(", ").join(links)
    return Markup("{} ({}{})").format(words, all_links, unnamed)


def causes_table(machine_groups: Sequence[Group]) -> Table:
    """Sizes of the effects of every group."""
    lines: list[tuple[str, ...]] = []
    for group in machine_groups:
        of_group = (group.cause, str(len(group.machines)))
        for (effect, key), sizes in group.sizes.items():
            values = [value_words(key, size) for size in sizes]
            lines.append((*of_group, in_words(effect), stated_name(key), *values))
            # Cause and number stand beside the first size only.
            of_group = ("", "")
    return Table(
        ("cause", "machines", "effect", "parameter", "median", "smallest", "largest"),
        tuple(lines),
        "A row of everything for each machine: fleet.csv.",
    )


def cases_table(machines: Sequence[FleetMachine]) -> Table:
    """The answer of every case, with a link to its page."""
    lines = []
    for machine in machines:
        file = f"{machine.name}.html"
        cells = (
            machine.name,
            machine.answer,
            probability_words(machine.numbers["probability"]),
            times_noise(machine.numbers["gap_before"]),
            times_noise(machine.numbers["gap_after"]),
            machine.closed,
            file_link(file),
        )
        lines.append(cells)
    head = ("case", "answer", "probability", "error before", "error after", "explained", "page")
    return Table(head, tuple(lines), "Explained: with its 95 % interval.")
