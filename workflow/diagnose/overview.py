"""The overview page of several cases: a picture, a table with links, and what failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from plant.effects import in_words
from workflow.diagnose.words import FILTERS
from workflow.report.rendering import render_page
from workflow.text.formats import MISSING, listing, number


def overview_page(documents: Sequence[Mapping[str, Any]], failed: Mapping[str, str]) -> str:
    """documents: the JSON answers; failed: case -> reason."""
    cases = [
        {**answer, "name": answer["case"], "answer": short_answer(answer), "closed": closure_words(answer)}
        for answer in documents
    ]
    page = "diagnosis/overview.html.j2"
    return render_page(page, filters=FILTERS.items(), title="Gap diagnosis", cases=cases, failed=failed).html


def short_answer(document: Mapping[str, Any]) -> str:
    """The verdict in a few words."""
    if document["detail_verdict"] == "not_converged":
        return "not converged"
    if document["verdict"] != "effect":
        return "no gap" if document["verdict"] == "none" else "outside the list"
    names = listing([in_words(name) for name in document["combination"]])
    return f"{names} (ambiguous)" if document["detail_verdict"] == "ambiguous" else names


def closure_words(document: Mapping[str, Any]) -> str:
    """Share of the gap closed with its interval; a dash where nothing was added."""
    closed = document["gap_closed"]
    if not document["combination"] or closed is None:
        return MISSING
    low, high = (100 * v if v is not None else float("nan") for v in document["gap_closed_interval"])
    return f"{number(100 * closed, 4)} % ({number(low, 4)} to {number(high, 4)})"
