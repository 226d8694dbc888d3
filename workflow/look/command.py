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
    # A page never replaces the log that it is of.
    written = []
    if out is not None:
        written.append(("--out", out))
    storage.refuse_in_the_way([log], written)
    log_look = look_at(log, time, time_unit, decimal)
    command = _next(log_look, options_typed(time_unit, decimal))
    if out is not None:
        # It loads all that draws, which takes a second.
        from workflow.report.rendering import render_described

        page = render_described(look_page(log_look, command))
        storage.write_text(out, page.html)

    # The answer for programs; a column without numbers has no range, and says why.
    columns = {}
    for column in log_look.columns:
        lowest = None
        highest = None
        if column.values is not None:
            lowest = float(column.values.min())
            highest = float(column.values.max())
        columns[column.name] = {
            "unit": column.unit,
            "refused": column.why,
            "lowest": lowest,
            "highest": highest,
            "clipped_share": column.clipped,
            "step": column.step,
        }
    numbers = {
        "rows": codec.plain(log_look.rows),
        "layout": codec.plain(log_look.layout),
        "time": codec.plain(log_look.time),
        "response": codec.plain(log_look.response),
        "columns": columns,
    }
    report_path = None
    if out is not None:
        report_path = str(out)
    return RunSummary(
        title=str(log),
        sections=look_sections(log_look),
        numbers=numbers,
        verdict=command,
        report_path=report_path,
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

    # What has to be done to the file before any command reads it.
    roles = log_look.roles
    time = log_look.time
    used = log_look.taken_as.values()
    why = [column.why for column in log_look.columns if column.name in used and column.values is None]
    if time and time.why:
        why.append(time.why)
    elif time and time.option == "split":
        why.append(f"{time.gap_place}: {time.missing} rows are missing, split the file there")
    if why:
        return f"{log_look.path}, {why[0]}"
    doubted = [str(doubt.values["options"]) for doubt in log_look.doubts if "options" in doubt.values]
    # A log made in a loop needs more than one channel's model: `run` tells which way is right.
    if roles.reference or roles.doubts:
        return " ".join(["flexlink run", log, *doubted, "--out runs/arm"])

    # One channel: every column by its name, and an option for each doubt that has one.
    named = {"--input": roles.input, "--output": roles.output, "--time": roles.time}
    typed = [f"{option} {as_typed(name)}" for option, name in named.items() if name]
    if not roles.time:
        typed.append("--dt-s SECONDS")
    if time and time.option.startswith("--"):
        typed.append(time.option)
    for doubt in log_look.doubts:
        if doubt.kind is FindingKind.WRAPS and doubt.values["name"] == roles.output:
            # Every digit: a turn that is a little off would add up.
            period = f"{doubt.values['period']:.17g}"
            column_and_period = as_typed(f"{roles.output}={period}")
            typed.append(f"--unwrap {column_and_period}")
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
