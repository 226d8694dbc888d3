"""Records: simulated from the rig, or read from log files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ident.data.record import Record, in_one_unit
from workflow.config.run_config import (
    AnyConfig,
    FileRecord,
    FileSource,
    RunConfig,
    Signals,
    record_name,
)
from workflow.engine.errors import InputError, naming
from workflow.tasks.early_refusals import refuse_constant_input

if TYPE_CHECKING:
    from ident.command_timing import CommandTiming
    from workflow.tasks.results import RecordsResult
    from workflow.tasks.stage import StageInput

# Makes the records of a configuration, which complaints call by a name; told how far it is.
Simulated = Callable[[Any, str, Callable[[float, str], None]], list[Record]]

# Samples of all records together: at 4 kB each 80 GB, more memory than most machines have.
MOST_SAMPLES = 20_000_000


def make_records(stage: StageInput, simulate: Simulated | None = None) -> RecordsResult:
    """Records of a run in the order of its configuration, simulated or read.

    Parameters
    ----------
    stage : StageInput
    simulate : callable, optional
        Makes the records of a configuration whose records are not files; default: those of the simulated
        arm with one joint (`simulated_records`).

    Raises
    ------
    InputError
        One line: a file or an excitation that is none, sampling times that differ, or a record to identify
        from whose inputs all stand still.
    """
    # Late: logs are read and refused before what computes is loaded, which takes seconds.
    from ident.command_timing import with_equivalent_command
    from ident.resampling import ratio_of
    from workflow.tasks.results import RecordsResult, RunRecord
    from workflow.tasks.simulated_rig import simulated_records

    source = stage.config.source
    made = list(stage.read)
    entries: Sequence[Any] = source.records
    if not isinstance(source, FileSource):
        make = simulate or simulated_records
        made = make(stage.config, stage.called, partial(stage.progress.update, "records"))
    elif not made:
        made = read_records(source, stage.config.columns)

    # One clock, commands as the amplifier gave them, and as they acted between two rows.
    limit = source.input_limit or np.inf
    timed = [record.limited(limit) for record in with_common_sampling_time(made)]
    timing = command_timing(stage.config, timed)
    if timing is not None:
        timed = with_equivalent_command(timed, timing)
    if isinstance(stage.config, RunConfig) and stage.config.specification.controller_dt_s is not None:
        with naming(f"{stage.called}: specification"):
            ratio_of(timed[0].dt_s, stage.config.specification.controller_dt_s)
    if isinstance(stage.config, RunConfig):
        with naming(f"{stage.called}: specification"):
            stage.config.specification.refuse_sampling(timed[0].dt_s)

    # With what the configuration says of each; its excitation names its kind where it was simulated.
    records = list[RunRecord]()
    for about, record in zip(entries, timed, strict=True):
        of: Any = getattr(about, "excitation", about)
        records.append(RunRecord(record, about.role, about.condition, about.remark, of.kind))
    result = RecordsResult(tuple(records), timing)
    for item in result.of_role("estimation"):
        if not np.ptp(item.record.input, axis=0).any():
            refuse_constant_input(item.record)
    return result


def read_records(source: FileSource, channels: Sequence[Signals]) -> list[Record]:
    """Every log file of a configuration. Raises InputError: one line naming file and place."""
    return [read_record(source, entry, channels) for entry in source.records]


def read_record(source: FileSource, entry: FileRecord, channels: Sequence[Signals]) -> Record:
    """One log file as the configuration describes it. Raises InputError: one line naming file and place."""
    inputs = list(dict.fromkeys(channel.input for channel in channels))
    outputs = list(dict.fromkeys(channel.output for channel in channels))
    references = entry.references if entry.references is not None else source.references
    # A record's own time base replaces the common one: dt_s here must not meet a time column there.
    own_time = entry.time is not None or entry.dt_s is not None
    units = {name: unit for name, unit in source.units.items() if name in (*inputs, *outputs)}
    with naming(str(entry.path)):
        record = Record.from_file(
            entry.path,
            inputs,
            outputs,
            time=entry.time if own_time else source.time,
            dt_s=entry.dt_s if own_time else source.dt_s,
            time_unit=entry.time_unit or (None if own_time else source.time_unit),
            references=list(references),
            name=record_name(entry),
            scale=source.scale,
            offset=source.offset,
            units=units,
            repair=source.repair,
            resample_s=source.resample_s,
            unwrap=source.unwrap,
            decimal=source.decimal,
            run=entry.run,
        )
        if entry.start_sample or entry.stop_sample is not None:
            record = record.slice(entry.start_sample, entry.stop_sample or record.n_samples)
    return record.each(lambda signal: -signal) if entry.mirrored else record


def command_timing(config: AnyConfig, records: Sequence[Record]) -> CommandTiming | None:
    """What the command of a run's records does between two rows; None of simulated records.

    records: all of the configuration, as logged. Several joints: held from row to row unless a period is
    stated, for a law of several inputs is not read off. Raises InputError for a period that the logs
    contradict.
    """
    from ident.command_timing import SAME_PERIOD, rows_per_command_of, timing_of
    from workflow.tasks.identification import made_in_loop

    source = config.source
    if not isinstance(source, FileSource):
        return None
    in_loop = False
    if isinstance(config, RunConfig):
        shaft = config.control_channel
        records = [record.siso(shaft.input, shaft.output) for record in records]
        fitted = [
            record
            for record, entry in zip(records, source.records, strict=True)
            if entry.role == "estimation"
        ]
        in_loop = config.closed_loop_data.stated or made_in_loop(fitted)
    stated_s = source.controller_period_s
    if isinstance(config, RunConfig) and config.closed_loop_data.controlled:
        # A controller that is stated in z is one that runs at the rows at which its command changes.
        rows_s = records[0].dt_s * rows_per_command_of(records)
        if stated_s is not None and stated_s < rows_s * (1 - SAME_PERIOD):
            raise InputError(
                f"controller_period_s = {stated_s:.6g} s: of a controller that ran faster than the rows "
                f"({rows_s:.6g} s) the logs do not show the commands, so its reference does not follow from "
                "them; leave closed_loop_data.controller out"
            )
        stated_s = rows_s if stated_s is None else stated_s
    with naming(""):
        return timing_of(records, in_loop=in_loop, stated_period_s=stated_s, averaged=source.command_averaged)


def with_common_sampling_time(records: Sequence[Record]) -> list[Record]:
    """The records with the first one's sampling time and units, and a command that was logged late earlier.
    Raises InputError where they really differ, or are together longer than the memory of most machines
    allows.

    Clocks of hosts differ by some ten parts in a million, and time stamps are written with a few digits.
    """
    samples = sum(len(record.input) for record in records)
    if samples > MOST_SAMPLES:
        raise InputError(
            f"{records[0].name}: {samples} samples in all, at most {MOST_SAMPLES} are identified together "
            "(4 kB of memory each); take fewer or shorter records, or a longer sampling period"
        )
    with naming(""):
        records = in_one_unit(records)
    first = records[0]
    for other in records[1:]:
        if not other.sampled_like(first):
            # Resampling to a shorter period would invent readings.
            longest_s = max(record.dt_s for record in records)
            raise InputError(
                f"records {first.name!r} and {other.name!r} differ in sampling time "
                f"({first.dt_s:.6g} and {other.dt_s:.6g} s); put all on one grid, --resample-s "
                f"{longest_s:.6g} (resample_s), or identify them in separate runs"
            )
    from ident.friction import with_commands_in_time

    return with_commands_in_time([replace(record, dt_s=first.dt_s) for record in records])
