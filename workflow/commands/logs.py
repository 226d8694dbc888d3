"""The logs of one channel, read and refused before anything slow is loaded."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ident.data.record import Record
from ident.data.record_files import read_table
from ident.data.response_columns import has_response
from ident.data.roles import roles_with_reference
from workflow.engine.errors import naming


@dataclass(frozen=True, eq=False)
class Logs:
    """Records as read, of the fit and kept for validation, and all their files."""

    measured: tuple[Record, ...]
    fresh: tuple[Record, ...]
    files: tuple[Path, ...]
    input_limit: float | None


def are_responses(paths: Sequence[Path]) -> bool:
    """Whether the files are frequency responses; one that cannot be read is left to who reads logs."""
    try:
        return all(has_response(read_table(path)) for path in paths)
    except ValueError:
        return False


def read_logs(
    logs: Sequence[Path],
    input_name: str | None = None,
    output_name: str | None = None,
    *,
    validation: Sequence[Path] = (),
    time: str | None = None,
    dt_s: float | None = None,
    time_unit: str | None = None,
    scale: Mapping[str, float] | None = None,
    offset: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    repair: bool = False,
    resample_s: float | None = None,
    unwrap: Mapping[str, float] | None = None,
    decimal: str | None = None,
    reference: str | None = None,
    input_limit: float | None = None,
) -> Logs:
    """One channel of log files; input, output and time that are not named are found where names and units
    leave no doubt.

    scale, offset, units, repair, resample_s, unwrap, decimal: as in `Record.from_file`. time_unit: of the
    time column, where its name does not say it. reference: column of the reference of logs made in closed
    loop, found like the others. input_limit: what the amplifier gives at most; larger commands in the logs
    are taken as that. Raises InputError: one line naming file, column or line.
    """
    if input_name is None or output_name is None or (time is None and dt_s is None):
        with naming(str(logs[0])):
            table, typed = read_table(logs[0]).with_decimal(decimal), shlex.join(map(str, logs))
            roles = roles_with_reference(
                table, typed, "identify", input=input_name, output=output_name, time=time, reference=reference
            )
        input_name, output_name, found = roles.input, roles.output, roles.reference
        if found and all(found in read_table(path).names for path in (*logs[1:], *validation)):
            reference = found
        time = roles.time if time is None and dt_s is None else time

    def read(path: Path) -> Record:
        with naming(str(path)):
            record = Record.from_file(
                path,
                [input_name],
                [output_name],
                time=time,
                dt_s=dt_s,
                time_unit=time_unit,
                scale=scale,
                offset=offset,
                units=units,
                repair=repair,
                resample_s=resample_s,
                unwrap=unwrap,
                decimal=decimal,
                references=[] if reference is None else [reference],
            )
            return record if input_limit is None else record.limited(input_limit)

    return Logs(
        tuple(read(path) for path in logs),
        tuple(read(path) for path in validation),
        (*logs, *validation),
        input_limit,
    )
