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

# Jitter, as a share of a step, that counts as none: stamps of a few digits as doubles stray by less.
_EXACT = 1e-6


@dataclass(frozen=True, eq=False)
class TimeLook:
    """How a time column is sampled.

    Where time starts again in a log, the numbers are those of the most uneven part.

    Attributes
    ----------
    name, unit : str
        Of the column; the unit as `TimeColumn.unit`.
    period_s : float
        The usual step.
    jitter : float
        Largest distance of a step from a whole number of periods, as a share; 0 where it is the stamps'
        rounding.
    rounded : bool
        The stamps stray by their rounding alone.
    missing : int
        Rows that larger steps lack, where the jitter leaves no doubt of them.
    gap_s : float
        The largest step.
    gap_place : str
        After which row it is.
    option : str
        What reads the log all the same, as `option_for`.
    why : str
        Why the column holds no time stamps; "" where it does.
    runs : tuple of str
        Names of the parts in which time starts again.
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
    """One signal of a log.

    Attributes
    ----------
    name, unit : str
    values : (T,) array or None
        Its numbers; None where `why` says why there are none.
    why : str
    clipped : float
        Share of samples that stand at an extreme.
    step : float
        Of its quantisation grid, 0 where there is none.
    """

    name: str
    unit: str
    values: RealArray | None
    why: str = ""
    clipped: float = 0.0
    step: float = 0.0


@dataclass(frozen=True)
class ResponseLook:
    """A frequency response in place of a log.

    Attributes
    ----------
    points, frequencies : int
        Rows, and different frequencies among them.
    low_Hz, high_Hz : float
        Lowest and highest frequency.
    spread : bool
        The file has variances.
    why : str
        Why the file is not understood; "" where it is.
    """

    points: int = 0
    frequencies: int = 0
    low_Hz: float = 0.0
    high_Hz: float = 0.0
    spread: bool = False
    why: str = ""


@dataclass(frozen=True, eq=False)
class LogLook:
    """What a log holds.

    Attributes
    ----------
    path : Path
    rows : int
        Of its longest column.
    layout : Layout or None
        Of a text file.
    time : TimeLook or None
        None without a time column.
    columns : tuple of ColumnLook
        All but time.
    roles : Roles or None
        The channel that names and units of the columns tell.
    unclear : str
        What to type where they do not.
    response : ResponseLook or None
        Of a file that is no log but a frequency response.
    doubts : tuple of Finding
        What `flexlink identify` says of the way in which the log is read.
    """

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
    typed = {"--time-unit": time_unit, "--decimal": decimal}
    return [f"{option} {value}" for option, value in typed.items() if value]


def look_at(
    path: Path, time: str | None = None, time_unit: str | None = None, decimal: str | None = None
) -> LogLook:
    """What a log holds, before anything is identified from it.

    Parameters
    ----------
    path : Path
        Of a log, or of a frequency response.
    time : str, optional
        Name of the time column; None: by the names of the columns.
    time_unit, decimal : str, optional
        Unit of its stamps, and decimal sign of a text file, where they are stated.

    Raises
    ------
    InputError
        One line: no such file, another format, damaged, no such column.
    """
    with naming(str(path)):
        table = read_table(path).with_decimal(decimal)
        if time is not None and time not in table.names:
            table.columns([time])
    response = None if time is not None else _response(table)
    times = times_in(table) if response is None else []
    time = time or (times[0] if times else None)
    roles = None
    unclear = ""
    try:
        log = " ".join([path_as_typed(path), *options_typed(time_unit, decimal)])
        roles = roles_of(table, log, "identify", time=time) if response is None else None
    except ValueError as error:
        unclear = str(error)
    columns = tuple(_column(table, name) for name in table.names if name != time)
    long = [values for values in table.raw.values() if isinstance(values, tuple) or np.ndim(values)]
    rows = max(map(len, long), default=0)

    # Time: where it starts again in a log, the most uneven part is described.
    about = None
    doubts = list[Finding]()
    runs = table.runs(time)
    if time is not None:
        # Of a table with rows of their own the stamps of the output's; where it is not known, of those with
        # the most.
        moved = roles.output if roles else None
        busiest = max(
            (name for name in table.clocks if name != time),
            key=lambda name: table.clocks[name].size,
            default=None,
        )
        rows_of = (moved or busiest) if table.sparse else None
        looks = [_time(run, time, time_unit, rows_of, moved) for run in runs]
        about, doubts = max(looks, key=lambda look: (look[0].why, look[0].option, look[0].jitter))
        about = replace(about, runs=tuple(run.run for run in runs if run.run))

    # Doubts about each signal, in the role that it has.
    for column in columns if response is None else ():
        if column.values is not None:
            inputs: list[str] = []
            outputs = [column.name]
            if roles and column.name == roles.input:
                inputs = [column.name]
                # An input's rows are read at those of the output where columns have rows of their own.
                outputs = [roles.output] if table.sparse else []
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
    """What a table holds that is a frequency response; None for a log."""
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
    """How a time column is sampled, and what is doubtful of it.

    rows_of: the column whose rows count in a table whose columns have rows of their own; moved: the output,
    None where it is not known.
    """
    try:
        stamps, column = table.stamps(name, rows_of, unit)
        steps = np.diff(stamps)
        period = float(np.median(steps))
        output = None
        # Cells that hold no number are said of their own column.
        with suppress(ValueError):
            output = table.columns([name, moved], rows_of)[moved] if moved else None
        if output is not None:
            refuse_step(str(table.path), period, output[:, None], column)
    except ValueError as error:
        return TimeLook(name, why=str(error).removeprefix(str(table.path)).lstrip(":, ")), []
    counts = np.maximum(np.rint(steps / period), 1)
    jitter = jitter_of(stamps)
    rounded = jitter > _EXACT and only_rounded(stamps)
    row = int(np.argmax(steps))
    look = TimeLook(
        name,
        unit=column.unit,
        period_s=float((stamps[-1] - stamps[0]) / steps.size) if rounded else period,
        jitter=0.0 if rounded or jitter <= _EXACT else jitter,
        rounded=rounded,
        missing=int(np.sum(counts - 1)) if jitter <= LARGEST_JITTER else 0,
        gap_s=float(steps[row]),
        gap_place=table.place(row + 1),
        option=option_for(stamps),
    )
    doubts = [column.doubt(period)] if column.doubtful else []
    if column.wraps:
        doubts.append(column.timer(str(table.path)))
    # Of uneven stamps the look says what they are itself.
    if not look.option:
        doubts += clock_doubts(stamps, str(table.path))
    return look, doubts


def _column(table: Table, name: str) -> ColumnLook:
    """One column as a signal, with what keeps it from being one."""
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
