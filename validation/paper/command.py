"""`flexlink paper`: compute, draw, and write the whole directory or nothing."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from validation.paper.experiments import STAGES, PaperResults, run_experiments
from validation.paper.figures_response import (
    draw_bounds,
    draw_experiment,
    draw_simulation,
    draw_simulation_peers,
)
from validation.paper.figures_search import draw_surface
from validation.paper.figures_time import draw_gobf_run, draw_peer_runs
from validation.paper.findings import findings_of
from validation.paper.page import headlines_of, page_html
from validation.paper.quotes import REPORTED
from validation.paper.settings import PaperSettings
from validation.paper.table import csv_text, rows_of
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress, Silence
from workflow.engine.run_directory import package_versions
from workflow.figures.style import render
from workflow.tasks.summary import Row, RunSummary, Section

PAGE = "paper.html"
TABLE_CSV, TABLE_JSON = "table.csv", "table.json"
# All that this command ever writes, the page last: only these are removed by --replace.
OWN_FILES = (
    *(f"figure-{item.number}.{kind}" for item in REPORTED for kind in ("svg", "png")),
    TABLE_CSV,
    TABLE_JSON,
    PAGE,
)

DRAWERS: Mapping[int, Callable[[PaperResults], Figure]] = {
    1: lambda results: draw_surface(results.surface),
    2: draw_simulation,
    3: draw_simulation_peers,
    4: draw_experiment,
    5: lambda results: draw_gobf_run(results.experiment),
    6: lambda results: draw_peer_runs(results.experiment),
    7: lambda results: draw_bounds(results.bounds, results.experiment.machine.gain_unit),
}


def redraw_paper(
    out: Path,
    settings: PaperSettings | None = None,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Redraw Figs. 1-7 into `out`, new or empty: paper.html, figure-N.svg, table.csv, table.json.

    Nothing is written before everything is computed and drawn; then each file appears whole, the page last.
    With `replace` the files of an earlier call are exchanged, and nothing else is touched. Raises InputError
    when `out` cannot be written or is not empty.
    """
    settings, progress, out = settings or PaperSettings(), progress or Silence(), Path(out)
    check_free(out, replace=replace)
    progress.plan(STAGES)
    results = run_experiments(settings, progress)
    progress.start("page")
    started = time.monotonic()
    pictures = {}
    for number, draw in DRAWERS.items():
        progress.update("page", (number - 1) / len(DRAWERS), f"figure {number}")
        pictures[number] = render(draw(results))
    findings, rows = findings_of(results), rows_of(results)
    headlines = headlines_of(results, findings)
    document = {
        "seed": settings.seed,
        "repeats": settings.repeats,
        "searches": settings.searches,
        "versions": package_versions(),
        "figures": [
            {
                "figure": item.number,
                "title": item.title,
                "agrees": findings.agrees[item.number],
                "found": headline,
            }
            for item, headline in zip(REPORTED, headlines, strict=True)
        ],
        "rows": [asdict(row) for row in rows],
    }
    files = {f"figure-{number}.{picture.kind}": picture.content for number, picture in pictures.items()}
    files[TABLE_CSV] = csv_text(rows).encode("utf-8")
    text = json.dumps(storage.strict_json(document), allow_nan=False, ensure_ascii=False, indent=1)
    files[TABLE_JSON] = f"{text}\n".encode()
    files[PAGE] = page_html(results, pictures, findings, rows).encode("utf-8")
    write_all(out, files)
    progress.finish("page", time.monotonic() - started, taken_up=False)
    return _summary(out, document)


def check_free(out: Path, *, replace: bool) -> None:
    """Refuse what cannot be written or is not empty; with `replace`, what holds no page of ours."""
    if out.exists() and not out.is_dir():
        raise InputError(f"cannot write {out}: it is not a directory")
    held = _held(out)
    strangers = sorted(held - set(OWN_FILES))
    if held and not replace:
        raise InputError(
            f"{out}: not empty (it holds {min(held)!r}); choose another --out, or --replace an earlier page"
        )
    if strangers and PAGE not in held:
        raise InputError(
            f"{out}: no redrawn paper is there (it holds {strangers[0]!r}); choose another --out"
        )
    ancestor = out.absolute()
    while not ancestor.exists():
        ancestor = ancestor.parent
    storage.check_writable(ancestor / "trial")


def _held(out: Path) -> set[str]:
    try:
        names = {entry.name for entry in out.iterdir()} if out.is_dir() else set()
    except OSError as error:
        raise InputError(f"cannot read {out}: {error.strerror or error}") from error
    return {name for name in names if not name.endswith(storage.TEMPORARY_SUFFIX)}


def write_all(out: Path, files: Mapping[str, bytes]) -> None:
    """All files or none: written and flushed in a directory beside `out`, then moved over, the page last."""
    beside = out.absolute().parent
    staging = beside / f".{out.absolute().name}.{os.getpid()}{storage.TEMPORARY_SUFFIX}"
    try:
        beside.mkdir(parents=True, exist_ok=True)
        staging.mkdir()
        try:
            for name, content in files.items():
                storage.write_bytes(staging / name, content)
            if not out.exists():
                os.rename(staging, out)
                return
            # The old page goes first and the new one comes last: no page ever stands over other figures.
            for name in reversed(OWN_FILES):
                (out / name).unlink(missing_ok=True)
            for name in files:
                os.replace(staging / name, out / name)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except OSError as error:
        raise InputError(f"cannot write {out}: {error.strerror or error}") from error


def _summary(out: Path, document: Mapping[str, Any]) -> RunSummary:
    """One line a figure for the terminal; `numbers` holds every row."""
    figures = document["figures"]
    verdicts = {True: "as the paper reports", False: "not as the paper reports"}
    return RunSummary(
        title="Ziaei & Wang 2006, redrawn",
        sections=tuple(
            Section(f"Fig. {item['figure']}", (Row(verdicts[item["agrees"]], item["found"]),))
            for item in figures
        ),
        numbers=document,
        verdict=f"{sum(item['agrees'] for item in figures)} of {len(figures)} figures as the paper reports; "
        f"numbers in {out / TABLE_CSV}",
        report_path=str(out / PAGE),
    )
