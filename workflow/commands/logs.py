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
    """Columns of one channel and how they are read, as stated; see `Record.from_file`.

    doubts: of how the columns were found.
    """

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
        """Records of tables that are used together, each column in one unit.

        Input and output have to be named. Raises InputError naming file, column or line.
        """
        records = list[Record]()
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
                records.append(replace(record, notes=(*record.notes, *self.doubts)))
        with naming(""):
            records = in_one_unit(records)
            limit = self.input_limit
            return records if limit is None else [record.limited(limit) for record in records]


@dataclass(frozen=True, eq=False)
class Logs:
    """Records as read.

    Attributes
    ----------
    measured, fresh : tuples of Record
        Of the fit, and kept for validation.
    files : tuple of Path
        All their files.
    input_limit : float or None
        Of the amplifier, as stated.
    controller_period_s : float or None
        Of the controller that made the logs, as stated [s].
    command_averaged : bool
        The drive logs the mean of its commands over each row.
    """

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
    """One channel of log files.

    Columns that are not named are found where names and units leave no doubt.

    Parameters
    ----------
    logs, validation : sequences of Path
        Of the fit, and kept for validation.
    stated : Reading, optional
        How they are read.

    Raises
    ------
    InputError
        One line naming file, column or line.
    """
    how = stated or Reading()
    tables = list[Table]()
    for path in (*logs, *validation):
        with naming(str(path)):
            tables.append(read_table(path).with_decimal(how.decimal))
    if how.input_name is None or how.output_name is None or (how.time is None and how.dt_s is None):
        with naming(str(logs[0])):
            roles = how.roles(tables[0], logs, "identify")
        found_columns: dict[str, Any] = {
            "input_name": roles.input,
            "output_name": roles.output,
            "doubts": roles.doubts,
        }
        if roles.reference and all(roles.reference in table.names for table in tables[1:]):
            found_columns["reference"] = roles.reference
        if how.time is None and how.dt_s is None:
            found_columns["time"] = roles.time
        how = how.model_copy(update=found_columns)
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
