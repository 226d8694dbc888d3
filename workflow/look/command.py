"""`flexlink look`: what a log holds, as a table and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ident.data.finding import FindingKind
from ident.data.foreign_files import as_typed, path_as_typed
from workflow.describe.summary import RunSummary
from workflow.engine import codec, storage
from workflow.look.log_look import LogLook, ResponseLook, look_at, options_typed
from workflow.look.words import look_page, look_sections
from workflow.text.formats import number


def look(
    log: Path,
    *,
    time: str | None = None,
    time_unit: str | None = None,
    decimal: str | None = None,
    out: Path | None = None,
) -> RunSummary:
    """Columns, units, sampling, ranges, clipping and quantisation of one log.

    Parameters
    ----------
    log : Path
    time, time_unit, decimal : str, optional
        How the file is read, where it does not tell.
    out : Path, optional
        Page with the same, as HTML.

    Returns
    -------
    RunSummary
        Its verdict is the command that goes on from here.

    Raises
    ------
    InputError
    """
    storage.refuse_in_the_way([log], [] if out is None else [("--out", out)])
    log_look = look_at(log, time, time_unit, decimal)
    command = _next(log_look, options_typed(time_unit, decimal))
    if out is not None:
        # It loads all that draws, which takes a second.
        from workflow.report.rendering import render_described

        storage.write_text(out, render_described(look_page(log_look, command)).html)
    columns = {
        column.name: {
            "unit": column.unit,
            "refused": column.why,
            "lowest": None if column.values is None else float(column.values.min()),
            "highest": None if column.values is None else float(column.values.max()),
            "clipped_share": column.clipped,
            "step": column.step,
        }
        for column in log_look.columns
    }
    parts = {name: codec.plain(getattr(log_look, name)) for name in ("rows", "layout", "time", "response")}
    return RunSummary(
        title=str(log),
        sections=look_sections(log_look),
        numbers=parts | {"columns": columns},
        verdict=command,
        report_path=None if out is None else str(out),
    )


def _next(log_look: LogLook, options: Sequence[str]) -> str:
    """The command that goes on from here, or what has to be done before.

    options: of `look`, to be given again.
    """
    log = " ".join([path_as_typed(log_look.path), *options])
    if log_look.response is not None:
        return _after_response(log_look.response, path_as_typed(log_look.path))
    if log_look.roles is None:
        return log_look.unclear
    roles = log_look.roles
    used = log_look.taken_as.values()
    why = [column.why for column in log_look.columns if column.name in used and column.values is None]
    if log_look.time and log_look.time.why:
        why.append(log_look.time.why)
    elif log_look.time and log_look.time.option == "split":
        missing = log_look.time.missing
        why.append(f"{log_look.time.gap_place}: {missing} rows are missing, split the file there")
    if why:
        return f"{log_look.path}, {why[0]}"
    doubted = [str(doubt.values["options"]) for doubt in log_look.doubts if "options" in doubt.values]
    # A log made in a loop needs more than one channel's model: `run` tells which way is right.
    if roles.reference or roles.doubts:
        return " ".join(["flexlink run", log, *doubted, "--out runs/arm"])
    named = {"--input": roles.input, "--output": roles.output, "--time": roles.time}
    typed = [f"{option} {as_typed(name)}" for option, name in named.items() if name]
    if not roles.time:
        typed.append("--dt-s SECONDS")
    if log_look.time and log_look.time.option.startswith("--"):
        typed.append(log_look.time.option)
    for doubt in log_look.doubts:
        if doubt.kind is FindingKind.WRAPS and doubt.values["name"] == roles.output:
            period = f"{doubt.values['period']:.17g}"
            typed.append(f"--unwrap {as_typed(f'{roles.output}={period}')}")
    return " ".join(["flexlink identify", log, *typed, *doubted])


def _after_response(response: ResponseLook, path: str) -> str:
    """The command that goes on from a frequency response, or why there is none.

    path: of its file, as typed.
    """
    if response.why:
        return response.why
    design = f"flexlink design {path} --spec SPEC.toml, with [plant] dt_s"
    if response.points == response.frequencies and not response.spread:
        return f"{design} and [uncertainty] multiplicative = 0.1 (or what you know) in SPEC.toml"
    # A controller's step has to tell every frequency: half of its rate is the highest.
    longest_s = number(0.5 / response.high_Hz)
    return f"flexlink identify {path} --dt-s SECONDS, at most {longest_s}; or {design} in SPEC.toml"
