"""The commands that plug into `flexlink` (entry points, pyproject.toml): parse, one call, print.

What they need is imported when they are called: `flexlink --help` reads this file and no more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workflow.cli import Json, Quiet, TimeLimit, print_json


def paper(
    out: Annotated[Path, typer.Option(help="Directory for page, figures and table; new or empty.")],
    seed: Annotated[int, typer.Option(min=0, help="Root of all inputs and noise.")] = 2006,
    replace: Annotated[bool, typer.Option("--replace", help="Exchange an earlier page in --out.")] = False,
    time_limit: TimeLimit = None,
    as_json: Json = False,
) -> None:
    """Redraw the figures of Ziaei & Wang 2006.

    On one page, with what the paper reports beside what we find.
    """
    from validation.paper.command import redraw_paper
    from validation.paper.settings import PaperSettings
    from workflow.console import TerminalProgress, print_summary

    with TerminalProgress() as progress:
        summary = redraw_paper(out, PaperSettings(seed=seed), replace=replace, progress=progress)
    if as_json:
        print_json(summary.to_document())
    else:
        print_summary(summary)


def blind(
    cases: Annotated[int, typer.Option(help="Number of cases.")],
    seed: Annotated[int, typer.Option(help="Root of all rigs, causes, inputs and noise.")],
    out: Annotated[Path, typer.Option(help="Directory of the run, new or empty.")],
    jobs: Annotated[
        int | None,
        typer.Option(help="Processes on this machine [default: one per processor]", show_default=False),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            help="One sort of cases: none, faint, clear, pair or unlisted [default: a mix]; "
            "with --workshop: none, single, pair or unlisted."
        ),
    ] = None,
    workshop: Annotated[
        bool, typer.Option("--workshop", help="Imperfectly known machines and awkward logs.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the run in --out; completed cases are reused.")
    ] = False,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Test the diagnosis on sealed cases of its own.

    Cases from an independent simulator, labels sealed by a salted hash, diagnosis, opening, scores.
    """
    from validation.blind.protocol import run_blind
    from workflow.console import TerminalProgress, print_summary

    with TerminalProgress(quiet=quiet) as progress:
        summary = run_blind(
            cases, seed, out, jobs=jobs, only=only, workshop=workshop, resume=resume, progress=progress
        )
    if as_json:
        print_json(summary.numbers)
    else:
        print_summary(summary)
