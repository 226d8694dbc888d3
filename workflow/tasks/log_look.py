"""What a log holds, before anything is identified from it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from diagnosis.machine.quantisation_grid import grid_step
from ident.data.arrays import RealArray, clipped_share
from ident.data.finding import Finding, distinct
from ident.data.foreign_files import path_as_typed
from ident.data.record import reading_notes
from ident.data.record_files import read_table
from ident.data.response_columns import has_response, read_response
from ident.data.roles import Roles, roles_of, times_in
from ident.data.table import Table
from ident.data.text_tables import Layout
from ident.data.time_grid import LARGEST_JITTER, clock_doubts, jitter_of, only_rounded, option_for
from ident.data.units import contradicted_by_loop, refuse_step
from workflow.engine.errors import naming

_EXACT = 1e-6  # of a step: stamps of a few digits as doubles stray by less


@dataclass(frozen=True, eq=False)
class TimeLook:
    """How a time column is sampled.

    unit: of the column, as `TimeColumn.unit`. period_s: the usual step. jitter: largest distance of a step
    from a whole number of them, as a share, 0 where it is the rounding of the stamps. missing: rows that
    larger steps lack, where jitter leaves no doubt of them; gap_s: the largest step; gap_place: after which
    row. option: as `option_for`. why: why the stamps are none. runs: names of the first and the last part in
    which time starts again; the other numbers are of the most uneven one.
    """

    name: str
    unit: str = ""
    period_s: float = 0.0
    jitter: float = 0.0
    rounded: bool = False
    missing: int = 0
    gap_s: float = 0.0
    gap_place: str = ""
    option: str = ""
    why: str = ""
    runs: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ColumnLook:
    """One signal: its numbers (T,), or why there are none. clipped: share of samples that stand at an
    extreme; step: of its quantisation grid, 0 where there is none."""

    name: str
    unit: str
    values: RealArray | None
    why: str = ""
    clipped: float = 0.0
    step: float = 0.0


@dataclass(frozen=True)
class ResponseLook:
    """A frequency response: so many points at so many frequencies between two of them, or why it is not
    understood. spread: it has variances."""

    points: int = 0
    frequencies: int = 0
    low_Hz: float = 0.0
    high_Hz: float = 0.0
    spread: bool = False
    why: str = ""


@dataclass(frozen=True, eq=False)
class LogLook:
    """A log: layout of a text file, time, signals; roles: the channel that its names and units tell, if they
    do, else `unclear` says what to type. response: what it is where it is no log but a frequency response.
    doubts: what identify says of the way the log is read."""

    path: Path
    rows: int
    layout: Layout | None
    time: TimeLook | None
    columns: tuple[ColumnLook, ...]
    roles: Roles | None
    unclear: str
    response: ResponseLook | None = None
    doubts: tuple[Finding, ...] = ()

    @property
    def taken_as(self) -> dict[str, str]:
        """Role -> column, as far as names and units tell."""
        if self.roles is None:
            return {}
        of = {"command": self.roles.input, **asdict(self.roles)}
        return {role: of[role] for role in ("command", "output", "reference", "time") if of[role]}


def options_typed(time_unit: str | None, decimal: str | None) -> list[str]:
    """The options, as they were given, without which the next command would read the log otherwise."""
    given = {"--time-unit": time_unit, "--decimal": decimal}
    return [f"{option} {value}" for option, value in given.items() if value]


def look_at(
    path: Path, time: str | None = None, time_unit: str | None = None, decimal: str | None = None
) -> LogLook:
    """Raises InputError: no such file, another format, damaged, no such column."""
    with naming(str(path)):
        table = read_table(path).with_decimal(decimal)
        if time is not None and time not in table.names:
            table.columns([time])
    response = None if time is not None else _response(table)
    times = times_in(table) if response is None else []
    time = time or (times[0] if times else None)
    roles, unclear = None, ""
    try:
        log = " ".join([path_as_typed(path), *options_typed(time_unit, decimal)])
        roles = roles_of(table, log, "identify", time=time) if response is None else None
    except ValueError as error:
        unclear = str(error)
    columns = tuple(_column(table, name) for name in table.names if name != time)
    long = [values for values in table.raw.values() if isinstance(values, tuple) or np.ndim(values)]
    rows = max(map(len, long), default=0)
    about, doubts, runs = None, list[Finding](), table.runs(time)
    if time is not None:
        # Of a table with rows of their own the stamps of the output's; where it is not known, of those with
        # the most.
        moved = roles.output if roles else None
        own = max((n for n in table.clocks if n != time), key=lambda n: table.clocks[n].size, default=None)
        looks = [_time(run, time, time_unit, (moved or own) if table.sparse else None, moved) for run in runs]
        about, doubts = max(looks, key=lambda one: (one[0].why, one[0].option, one[0].jitter))
        about = replace(about, runs=tuple(run.run for run in runs if run.run))
    for column in columns if response is None else ():
        if column.values is not None:
            inputs, outputs = (
                ([column.name], []) if roles and column.name == roles.input else ([], [column.name])
            )
            if table.sparse and inputs and roles is not None:
                outputs = [roles.output]
            for run in runs:
                values = {name: run.columns([name])[name] for name in (*inputs, *outputs)}
                doubts += reading_notes(run, values, inputs, outputs)
    doubts += _of_the_loop(runs[0], roles) if roles else ()
    return LogLook(path, rows, table.layout, about, columns, roles, unclear, response, distinct(doubts))


def _of_the_loop(table: Table, roles: Roles) -> tuple[Finding, ...]:
    """What reference, output and command say of their units."""
    names = roles.reference or "", roles.output, roles.input
    if not roles.reference or any(_column(table, name).values is None for name in names):
        return roles.doubts
    reference, output, command = table.columns(names, roles.output if table.sparse else None).values()
    return contradicted_by_loop(reference, output, command, names, [table.unit(n) for n in names], {})


def _response(table: Table) -> ResponseLook | None:
    if not has_response(table):
        return None
    try:
        omega, _ = read_response(table)
    except ValueError as error:
        return ResponseLook(why=str(error).removeprefix(str(table.path)).lstrip(":, "))
    different = np.unique(omega) / (2 * np.pi)
    spread = {"variance_real", "variance_imag"} <= set(table.names)
    return ResponseLook(omega.size, different.size, float(different[0]), float(different[-1]), spread)


def _time(
    table: Table, name: str, unit: str | None, rows_of: str | None, moved: str | None
) -> tuple[TimeLook, list[Finding]]:
    """rows_of: the column whose rows count in a table whose columns have rows of their own; moved: the
    output."""
    try:
        stamps, column = table.stamps(name, rows_of, unit)
        steps = np.diff(stamps)
        period = float(np.median(steps))
        output = None
        with suppress(ValueError):  # cells that hold no number are said of their own column
            output = table.columns([name, moved], rows_of)[moved] if moved else None
        if output is not None:
            refuse_step(str(table.path), period, output[:, None], column)
    except ValueError as error:
        return TimeLook(name, why=str(error).removeprefix(str(table.path)).lstrip(":, ")), []
    counts = np.maximum(np.rint(steps / period), 1)
    jitter = jitter_of(stamps)
    rounded = jitter > _EXACT and only_rounded(stamps)
    row = int(np.argmax(steps))
    found = TimeLook(
        name,
        column.unit,
        float((stamps[-1] - stamps[0]) / steps.size) if rounded else period,
        0.0 if rounded or jitter <= _EXACT else jitter,
        rounded,
        int(np.sum(counts - 1)) if jitter <= LARGEST_JITTER else 0,
        float(steps[row]),
        table.place(row + 1),
        option_for(stamps),
    )
    doubts = [column.doubt(period)] if column.doubtful else []
    if column.wraps:
        doubts.append(column.timer(str(table.path)))
    # Of uneven stamps the look says what they are itself.
    return found, [*doubts, *(clock_doubts(stamps, str(table.path)) if not found.option else ())]


def _column(table: Table, name: str) -> ColumnLook:
    try:
        values = table.columns([name])[name]
    except ValueError as error:
        return ColumnLook(
            name, table.unit(name), None, str(error).removeprefix(str(table.path)).lstrip(":, ")
        )
    if not values.size:
        return ColumnLook(name, table.unit(name), None, "empty")
    # Of a signal that takes a few levels by design the grid says nothing.
    levels = np.unique(values).size
    step = grid_step([values], np.finfo(np.float64).tiny) if levels > 10 else 0.0
    return ColumnLook(name, table.unit(name), values, "", clipped_share(values), step)
