"""Scores in words and as a picture."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from validation.blind.truth import LISTED
from workflow.describe.facts import Quantity, Row, Section
from workflow.describe.summary import RunSummary
from workflow.figures.matplotlib_figure import house_style, new_figure
from workflow.text.templates import environment

# Columns of the table: cases by what is known of the nominal machine.
_SLICES = ("all", "exact", "uncertain")
# A row that is shown once.
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


def text(found: Mapping[str, Any], document: Mapping[str, Any] | None = None) -> str:
    """One set of scores in plain text: table, counts, calibration, and every case that is wrong.

    document: the whole of scores.json, whose other parts are then told as well.
    """
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
    """Scores as the terminal shows them; document: all of scores.json, out: where the details are."""
    scored = document["diagnosis"]
    sections = []
    for part in _SLICES:
        rows = tuple(
            Row("", name, Quantity.words(cell(numbers)))
            for name, numbers in scored["table"][part].items()
            if numbers["count"] and (part == "all" or name != _CPU)
        )
        if rows:
            sections.append(Section(part if part == "all" else f"{part} nominal", tuple(rows)))
    right = scored["table"]["all"]["verdict and set right, every case"]
    return RunSummary(
        title="Blind protocol",
        sections=tuple(sections),
        numbers=document,
        verdict=f"{right['hits']} of {right['count']} cases answered rightly; seal opened and verified; "
        f"details in {out / 'scores.txt'}",
    )


def confusion_figure(scored: Mapping[str, Any]) -> bytes:
    """PNG: true causes against answers, counts in the cells."""
    table = pd.DataFrame.from_dict(scored["confusion"], orient="index").fillna(0)
    order = ["none", *LISTED, "unknown"]
    rows = [name for name in order if name in table.index]
    columns = [name for name in order if name in table.columns or name in rows]
    columns += sorted(set(table.columns) - set(order))
    counts = table.reindex(index=rows or ["none"], columns=columns or ["none"], fill_value=0).to_numpy()
    with house_style():
        figure = new_figure(2.2 + 0.27 * counts.shape[0], 2.6 + 0.33 * counts.shape[1])
        axes = figure.add_subplot()
        share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
        axes.grid(visible=False)
        for (i, j), n in np.ndenumerate(counts):
            if n:
                colour = "white" if share[i, j] > 0.6 else "black"
                axes.text(j, i, f"{n:.0f}", ha="center", va="center", color=colour)
        axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
        axes.set_yticks(range(len(tuple(rows))), [r.replace("_", " ") for r in rows])
        axes.set_xlabel("first answer")
        axes.set_ylabel("truth")
        axes.set_title("Blind cases with one cause or none: truth against answer")
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=140, metadata={"Software": None})
    return buffer.getvalue()
