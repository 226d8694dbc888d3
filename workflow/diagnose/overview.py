"""The overview page of several cases: a picture, a table with links, and what failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from workflow.diagnose.words import effect_words, probability_words, times_noise
from workflow.figures.gap_overview import CaseGap, draw_case_gaps
from workflow.figures.style import render
from workflow.report.formats import count, listing, number
from workflow.report.page import Block, Plot, Section, Table, maybe
from workflow.report.rendering import page


def overview_page(documents: Sequence[Mapping[str, Any]], failed: Mapping[str, str]) -> str:
    """documents: the JSON answers; failed: case -> reason."""
    sections = []
    if documents:
        gaps = [
            CaseGap(d["case"], short_answer(d), d["gap_before"], d["gap_after"], d["noise_floor"])
            for d in documents
        ]
        pictures = {"gaps": render(draw_case_gaps(gaps))}
        blocks: list[Block] = [
            Plot(
                "gaps", "Root mean square of (measured - model) over the sensor noise, held-out experiments."
            ),
            Table(
                ("case", "answer", "probability", "gap before", "gap after", "closed", "page"),
                tuple(_row(d) for d in documents),
                "Closed: share of the explainable gap with its 95 % interval.",
            ),
        ]
        sections.append(Section("cases", "All cases", "Cases", tuple(blocks)))
    else:
        pictures = {}
    if failed:
        words = tuple(f"{case}: {reason}" for case, reason in failed.items())
        sections.append(Section("failed", "Cases without an answer", "Failed", maybe(words, "warning")))
    return page(
        "diagnosis_overview.html.j2",
        title="Gap diagnosis",
        sections=sections,
        pictures=pictures,
        headline=_headline(documents, failed),
        links=[(d["case"], f"{d['case']}.html", short_answer(d)) for d in documents],
    )


def short_answer(document: Mapping[str, Any]) -> str:
    """The verdict in a few words."""
    if document["detail_verdict"] == "not_converged":
        return "not converged"
    if document["verdict"] != "effect":
        return "no gap" if document["verdict"] == "none" else "outside the list"
    names = listing([effect_words(name) for name in document["combination"]])
    return f"{names} (ambiguous)" if document["detail_verdict"] == "ambiguous" else names


def closure_words(document: Mapping[str, Any]) -> str:
    """Share of the gap closed with its interval; a dash where nothing was added."""
    closed = document["gap_closed"]
    if not document["combination"] or closed is None:
        return "–"
    low, high = (100 * v if v is not None else float("nan") for v in document["gap_closed_interval"])
    return f"{number(100 * closed, 4)} % ({number(low, 4)} to {number(high, 4)})"


def _row(document: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        document["case"],
        short_answer(document),
        probability_words(document["probability"]),
        times_noise(document["gap_before"]),
        times_noise(document["gap_after"]),
        closure_words(document),
        f"{document['case']}.html",
    )


def _headline(documents: Sequence[Mapping[str, Any]], failed: Mapping[str, str]) -> str:
    verdicts = [d["verdict"] for d in documents]
    parts = [
        f"{n} {words}"
        for n, words in (
            (verdicts.count("effect"), "with a named effect"),
            (verdicts.count("none"), "without a gap"),
            (verdicts.count("unknown"), "outside the list"),
            (len(failed), "failed"),
        )
        if n
    ]
    return f"{count(len(documents) + len(failed), 'case')}: {listing(parts)}"
