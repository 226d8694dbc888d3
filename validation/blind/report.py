"""Scores in words and as a picture."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from validation.blind.truth import LISTED
from workflow.tasks.summary import Row, RunSummary, Section
from workflow.text.templates import environment

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
    return _by_template(document["diagnosis"], document)


def scores_text(found: Mapping[str, Any]) -> str:
    """One set of scores: table, counts, calibration, and every case that is wrong."""
    return _by_template(found, None)


def _by_template(found: Mapping[str, Any], document: Mapping[str, Any] | None) -> str:
    template = environment(package="validation").get_template("blind_scores.txt.j2")
    made = template.render(found=found, document=document, table=_table)
    return Markup(made).unescape().strip("\n") + "\n"


def _table(scored: Mapping[str, Any]) -> str:
    """Rows of the accuracy table by slices, in columns."""
    rows = [("", *_SLICES)]
    for name in scored["table"]["all"]:
        cells = [cell(scored["table"][part][name]) for part in _SLICES]
        if any(c != "-" for c in cells):
            rows.append((name, *cells))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(value.ljust(width) for value, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


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
