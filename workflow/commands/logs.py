"""The logs of one channel, read and refused before anything slow is loaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import Field

from ident.data.foreign_files import as_typed, path_as_typed
from ident.data.record import Record, in_one_unit
from ident.data.record_files import read_table
from ident.data.roles import Roles, roles_of
from ident.data.table import Table
from workflow.config.log_reading import LogReading
from workflow.engine.errors import naming

# What a command cannot do without, beside logs.
_NEEDED = {"init": ("--out my.toml",), "excite --closed-loop": ("--out experiment",)}


class Reading(LogReading):
    """Columns of one channel and how they are read, as stated; the rest as in `Record.from_file`. doubts: of
    how the columns were found."""

    input_name: str | None = Field(
        None, description="name of the input column; default: as names and units say"
    )
    output_name: str | None = Field(None, description="name of the output column; default: the same")
    reference: str | None = Field(
        None, description="reference column of logs made in closed loop; default: what looks like one"
    )
    time: str | None = Field(None, description="name of the time column; default: what looks like it")
    dt_s: float | None = Field(
        None, gt=0, description="sampling period [s], without a time column; beside it the exact one"
    )
    doubts: tuple[Any, ...] = ()

    def roles(self, table: Table, logs: Sequence[Path], command: str) -> Roles:
        """What is stated, and what names and units of the table tell.

        logs, command: what a complaint offers to type again. Raises ValueError.
        """
        return roles_of(
            table,
            f"{to_type(logs)} {self.typed(command)}".rstrip(),
            command,
            input=self.input_name,
            output=self.output_name,
            time=self.time,
            reference=self.reference,
        )

    def typed(self, command: str) -> str:
        """The options that say how the logs are read, as they were given, but for the columns' roles; and the
        file or directory without which the command would ask for one."""
        words = list[str]()
        for option, word in (("--time-unit", self.time_unit), ("--decimal", self.decimal)):
            if word:
                words.append(f"{option} {word}")
        for option, numbers in (
            ("--scale", self.scale),
            ("--offset", self.offset),
            ("--unwrap", self.unwrap),
        ):
            words += [f"{option} {as_typed(f'{name}={value!r}')}" for name, value in numbers.items()]
        words += [f"--unit {as_typed(f'{name}={unit}')}" for name, unit in self.units.items()]
        for option, number in (
            ("--resample-s", self.resample_s),
            ("--input-limit", self.input_limit),
            ("--dt-s", self.dt_s),
            ("--controller-period", self.controller_period_s),
        ):
            if number is not None:
                words.append(f"{option} {number!r}")
        for option, stated in (("--repair", self.repair), ("--command-averaged", self.command_averaged)):
            if stated:
                words.append(option)
        return " ".join([*words, *_NEEDED.get(command, ())])

    def records(self, tables: Sequence[Table]) -> list[Record]:
        """Of tables that are used together, where input and output are named; each column in one unit. Raises
        InputError naming file, column or line."""
        found = list[Record]()
        for table in tables:
            with naming(str(table.path)):
                record = Record.from_file(
                    table,
                    [str(self.input_name)],
                    [str(self.output_name)],
                    time=self.time,
                    dt_s=self.dt_s,
                    time_unit=self.time_unit,
                    references=[self.reference] if self.reference else [],
                    scale=self.scale,
                    offset=self.offset,
                    units=self.units,
                    repair=self.repair,
                    resample_s=self.resample_s,
                    unwrap=self.unwrap,
                    decimal=self.decimal,
                )
                found.append(replace(record, notes=(*record.notes, *self.doubts)))
        with naming(""):
            found = in_one_unit(found)
            limit = self.input_limit
            return found if limit is None else [record.limited(limit) for record in found]


@dataclass(frozen=True, eq=False)
class Logs:
    """Records as read, of the fit and kept for validation, and all their files."""

    measured: tuple[Record, ...]
    fresh: tuple[Record, ...]
    files: tuple[Path, ...]
    input_limit: float | None
    controller_period_s: float | None = None
    command_averaged: bool = False


def to_type(logs: Sequence[Path]) -> str:
    """Logs in a command that a complaint offers."""
    return " ".join(map(path_as_typed, logs))


def read_logs(logs: Sequence[Path], stated: Reading | None = None, validation: Sequence[Path] = ()) -> Logs:
    """One channel of log files as stated; columns that are not named are found where names and units leave no
    doubt. Raises InputError: one line naming file, column or line."""
    how, tables = stated or Reading(), list[Table]()
    for path in (*logs, *validation):
        with naming(str(path)):
            tables.append(read_table(path).with_decimal(how.decimal))
    if how.input_name is None or how.output_name is None or (how.time is None and how.dt_s is None):
        with naming(str(logs[0])):
            roles = how.roles(tables[0], logs, "identify")
        given: dict[str, Any] = {
            "input_name": roles.input,
            "output_name": roles.output,
            "doubts": roles.doubts,
        }
        if roles.reference and all(roles.reference in table.names for table in tables[1:]):
            given["reference"] = roles.reference
        if how.time is None and how.dt_s is None:
            given["time"] = roles.time
        how = how.model_copy(update=given)
    runs = [table.runs(how.time) for table in tables]
    records = tuple(how.records([run for parts in runs for run in parts]))
    n_measured = sum(map(len, runs[: len(logs)]))
    return Logs(
        records[:n_measured],
        records[n_measured:],
        (*logs, *validation),
        how.input_limit,
        how.controller_period_s,
        how.command_averaged,
    )
