"""`flexlink look`: what a log holds, as a table and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ident.data.finding import FindingKind
from ident.data.foreign_files import as_typed, path_as_typed
from workflow.describe.look import look_page, look_sections
from workflow.describe.summary import RunSummary
from workflow.engine import codec, storage
from workflow.tasks.log_look import LogLook, ResponseLook, look_at, options_typed
from workflow.text.formats import number


def look(
    log: Path,
    *,
    time: str | None = None,
    time_unit: str | None = None,
    decimal: str | None = None,
    out: Path | None = None,
) -> RunSummary:
    """Columns, units, sampling, ranges, clipping and quantisation of one log; out: the same as a page.

    Raises InputError.
    """
    storage.refuse_in_the_way([log], [] if out is None else [("--out", out)])
    found = look_at(log, time, time_unit, decimal)
    command = _next(found, options_typed(time_unit, decimal))
    if out is not None:
        from workflow.report.rendering import render_described  # loads all that draws: a second

        storage.write_text(out, render_described(look_page(found, command)).html)
    columns = {
        column.name: {
            "unit": column.unit,
            "refused": column.why,
            "lowest": None if column.values is None else float(column.values.min()),
            "highest": None if column.values is None else float(column.values.max()),
            "clipped_share": column.clipped,
            "step": column.step,
        }
        for column in found.columns
    }
    parts = {name: codec.plain(getattr(found, name)) for name in ("rows", "layout", "time", "response")}
    return RunSummary(
        title=str(log),
        sections=look_sections(found),
        numbers=parts | {"columns": columns},
        verdict=command,
        report_path=None if out is None else str(out),
    )


def _next(found: LogLook, options: Sequence[str]) -> str:
    """The command that goes on from here, or what has to be done before.

    options: of `look`, to be given again.
    """
    log = " ".join([path_as_typed(found.path), *options])
    if found.response is not None:
        return _after_response(found.response, path_as_typed(found.path))
    if found.roles is None:
        return found.unclear
    roles = found.roles
    used = found.taken_as.values()
    why = [column.why for column in found.columns if column.name in used and column.values is None]
    if found.time and found.time.why:
        why.append(found.time.why)
    elif found.time and found.time.option == "split":
        why.append(f"{found.time.gap_place}: {found.time.missing} rows are missing, split the file there")
    if why:
        return f"{found.path}, {why[0]}"
    doubted = [str(doubt.values["options"]) for doubt in found.doubts if "options" in doubt.values]
    if roles.reference or roles.doubts:  # made in closed loop
        return " ".join(["flexlink run", log, *doubted, "--out runs/arm"])
    named = {"--input": roles.input, "--output": roles.output, "--time": roles.time}
    typed = [f"{option} {as_typed(name)}" for option, name in named.items() if name]
    if not roles.time:
        typed.append("--dt-s SECONDS")
    if found.time and found.time.option.startswith("--"):
        typed.append(found.time.option)
    for doubt in found.doubts:
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
