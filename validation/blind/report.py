"""Scores in words and as a picture."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from validation.blind.truth import LISTED
from workflow.tasks.summary import Row, RunSummary, Section

_SLICES = ("all", "exact", "uncertain")
_CPU = "CPU per case [s]"


def cell(numbers: Mapping[str, Any]) -> str:
    """One score in a few characters, with its 95 % interval where it is a share."""
    if not numbers["count"]:
        return "-"
    if "share" in numbers:
        low, high = numbers["interval"]
        return (
            f"{100 * numbers['share']:.0f} % [{100 * low:.0f}, {100 * high:.0f}] "
            f"({numbers['hits']}/{numbers['count']})"
        )
    if "median" in numbers:
        return f"median {numbers['median']:.3g}, 10-90 % {numbers['p10']:.3g}..{numbers['p90']:.3g}"
    return "-" if math.isnan(numbers["value"]) else f"{numbers['value']:.3f}"


def text(document: Mapping[str, Any]) -> str:
    """The whole of scores.json as a page of plain text."""
    settings = document["settings"]
    only = settings.get("only")
    found = document["diagnosis"]
    lines = [
        f"flexlink blind --cases {settings['cases']} --seed {settings['seed']} "
        f"--simulator {settings['simulator']}" + (f" --only {only}" if only else ""),
        f"commitment (salted SHA-256 of the labels, published before the diagnosis): "
        f"{document['commitment']}",
        "",
        scores_text(found).rstrip("\n"),
    ]
    for name, scored in document["baselines"].items():
        lines += ["", f"baseline: {name}", *_table(scored)]
    lines += [f"  {case}: {reason}" for case, reason in document["failed"].items()]
    return "\n".join(lines) + "\n"


def scores_text(found: Mapping[str, Any]) -> str:
    """One set of scores: table, counts, calibration, and every case that is wrong."""
    lines = [f"{found['n_cases']} cases; shares with 95 % Wilson intervals", "", *_table(found)]
    lines += ["", "true cause -> answers (single effects, none, unknown)"]
    lines += _counts(found["confusion"])
    if found["unlisted"]:
        lines += ["", "causes beyond the list -> answers", *_counts(found["unlisted"])]
    if found["several"]:
        lines += ["", "several effects", *(f"  {word}: {n}" for word, n in sorted(found["several"].items()))]
    lines += ["", "probability of the first answer -> how often it was right"]
    lines += [
        f"  {b['low']:.1f}-{b['high']:.1f}: {b['count']} cases, said {b['probability']:.2f}, "
        f"right {b['share']:.2f}"
        for b in found["calibration"]
        if b["count"]
    ]
    lines += ["", "cases whose verdict or set is wrong"]
    lines += [
        f"  {w['case']} ({w['nominal']}, ratio {w['max_ratio']:.3g}): true {w['true']}; said {w['said']} "
        f"with p = {w['probability']:.2f}"
        for w in found["wrong"]
    ]
    return "\n".join(lines) + "\n"


def _table(scored: Mapping[str, Any]) -> list[str]:
    rows = [("", *_SLICES)]
    for name in scored["table"]["all"]:
        cells = [cell(scored["table"][part][name]) for part in _SLICES]
        if any(c != "-" for c in cells):
            rows.append((name, *cells))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(value.ljust(width) for value, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _counts(table: Mapping[str, Mapping[str, int]]) -> list[str]:
    return [
        f"  {row}: " + ", ".join(f"{said} {n}" for said, n in sorted(columns.items(), key=lambda i: -i[1]))
        for row, columns in sorted(table.items())
    ]


def summary(document: Mapping[str, Any], out: Path) -> RunSummary:
    """For the terminal."""
    found = document["diagnosis"]
    sections = []
    for part in _SLICES:
        rows = tuple(
            Row(name, cell(numbers))
            for name, numbers in found["table"][part].items()
            if numbers["count"] and (part == "all" or name != _CPU)
        )
        if rows:
            sections.append(Section(part if part == "all" else f"{part} nominal", rows))
    right = found["table"]["all"]["verdict and set right, every case"]
    return RunSummary(
        title="Blind protocol",
        sections=tuple(sections),
        numbers=document,
        verdict=f"{right['hits']} of {right['count']} cases answered rightly; seal opened and verified; "
        f"details in {out / 'scores.txt'}",
    )


def confusion_figure(scored: Mapping[str, Any]) -> bytes:
    """PNG: true causes against answers, counts in the cells."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    table = scored["confusion"]
    order = ["none", *LISTED, "unknown"]
    rows = [name for name in order if name in table]
    said = {name for columns in table.values() for name in columns}
    columns = [name for name in order if name in said or name in rows] + sorted(said - set(order))
    counts = np.array([[table[r].get(c, 0) for c in columns] for r in rows], dtype=float)
    with mpl.rc_context({"font.family": ["DejaVu Sans"], "font.size": 8.5}):
        figure = Figure(figsize=(2.6 + 0.33 * max(len(columns), 1), 2.2 + 0.27 * max(len(rows), 1)), dpi=140)
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        shown = counts if counts.size else np.zeros((1, 1))
        share = shown / np.maximum(shown.sum(axis=1, keepdims=True), 1)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
        for (i, j), n in np.ndenumerate(shown):
            if n:
                colour = "white" if share[i, j] > 0.6 else "black"
                axes.text(j, i, f"{n:.0f}", ha="center", va="center", color=colour)
        axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
        axes.set_yticks(range(len(rows)), [r.replace("_", " ") for r in rows])
        axes.set_xlabel("first answer")
        axes.set_ylabel("truth")
        axes.set_title("Blind cases with one cause or none: truth against answer", loc="left")
        figure.tight_layout()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
