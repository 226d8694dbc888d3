"""`flexlink init`: a configuration that runs, drafted from logs, with the evidence beside each line."""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit
from markupsafe import Markup

from ident.data.finding import Finding, distinct
from ident.data.foreign_files import as_typed, path_as_typed
from ident.data.record import Record
from ident.data.record_files import read_table
from ident.data.response_columns import has_response
from ident.data.roles import Roles, is_position, rising
from ident.data.table import Table
from ident.data.time_grid import option_for
from ident.data.wrapping import wraps_at
from workflow.commands.logs import Reading, to_type
from workflow.describe.init import init_sections
from workflow.describe.summary import RunSummary
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.changed_specification import with_typed
from workflow.tasks.early_refusals import (
    fitted_records,
    naming_readings,
    refuse_constant_input,
    refuse_hopeless_logs,
)
from workflow.tasks.records import with_common_sampling_time
from workflow.text.templates import environment

if TYPE_CHECKING:
    from workflow.config.run_config import RunConfig
    from workflow.tasks.draft import Draft
    from workflow.tasks.results import IdentifiedChannel, RunResults

# Share of the gaps between changes that are whole multiples of the usual one in a log that holds its rows:
# one may be missing.
_NEARLY_ALL = 0.99


@dataclass(frozen=True, eq=False)
class Found:
    """What the template of the configuration shows.

    Attributes
    ----------
    command : str
        That drafts it.
    logs : tuple of Path
    file_name : str
        Of the configuration, as one types it.
    stated : Reading
        How the user says that the logs are read.
    read : ReadChannel
    scale, units : mappings
        By column: as stated, with the sign of an input that is turned.
    draft : Draft
    doubts : tuple of Finding
        Of the way in which the logs were read.
    before : Draft or None
        The draft that the logs were identified by, where `draft` is what followed from the model.
    refused : str
        Why no friction is identified at the sensor although it may be there.
    remote : bool
        Friction is identified at a shaft that the sensor does not see.
    typed : frozenset of str
        Keys of the specification that the user stated.
    """

    command: str
    logs: tuple[Path, ...]
    file_name: str
    stated: Reading
    read: ReadChannel
    scale: Mapping[str, float]
    units: Mapping[str, str]
    draft: Draft
    doubts: tuple[Finding, ...]
    before: Draft | None = None
    refused: str = ""
    remote: bool = False
    typed: frozenset[str] = frozenset()


def init(
    logs: Sequence[Path],
    out: Path,
    stated: Reading | None = None,
    *,
    replace_file: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Write the configuration of one channel of these logs, once they are identified.

    Parameters
    ----------
    logs : sequence of Path
    out : Path
        The configuration's file.
    stated : Reading, optional
        How the logs are read.
    replace_file : bool
        Write over a file that is there.
    progress : Progress, optional

    Raises
    ------
    InputError
        One line.
    """
    storage.refuse_in_the_way(logs, [("--out", out)])
    if out.is_file() and not replace_file:
        raise InputError(f"{out} exists: take another --out, or --replace to write over it")
    with tempfile.TemporaryDirectory(prefix="flexlink-") as folder:
        config, text, found = decided("init", logs, out, stated, progress, RunDirectory(Path(folder)))
    storage.write_text(out, text)
    look = found.draft.look
    draft = found.draft
    validation = ""
    if len(found.read.records) > 1:
        run = found.read.tables[-1].run
        validation = f"{found.logs[-1].name}, {run}" if run else found.logs[-1].name
    sections = init_sections(
        draft,
        found.read.roles,
        found.read.unit_of,
        validation,
        found.doubts,
        logs=len(found.read.records),
    )
    seen = {
        "roles": codec.plain(found.read.roles),
        "told_rad_s": codec.plain(look.told_rad_s),
        "first_mode": codec.plain(look.mode),
        "notch_rad_s": look.notch,
        "motion": codec.plain(look.motion),
        "turned": look.turned,
        "friction": draft.friction,
        "unstable_per_s": draft.unstable_per_s,
    }
    return RunSummary(
        title=str(out),
        sections=sections,
        numbers={"configuration": config.with_defaults(), "seen": seen},
        verdict=f"flexlink run --config {path_as_typed(out)}",
    )


def decided(
    command: str,
    logs: Sequence[Path],
    file: Path,
    stated: Reading | None,
    progress: Progress | None,
    run: RunDirectory,
    *,
    earlier: RunDirectory | None = None,
    typed: Mapping[str, Any] | None = None,
) -> tuple[RunConfig, str, Found]:
    """The configuration of logs, with a specification that follows from the model they were identified by.

    Parameters
    ----------
    command : str
        What a complaint says to type again.
    logs : sequence of Path
    file : Path
        Where the configuration is to stand; nothing is written there.
    stated : Reading, optional
        How the logs are read.
    progress : Progress, optional
    run : RunDirectory
        The stages up to the uncertain plant are made in this directory; what is there is replaced.
    earlier : RunDirectory, optional
        Whose stages are taken over where they were made from the same.
    typed : mapping of str to value, optional
        Keys of [specification] in place of the drafted ones.

    Returns
    -------
    config : RunConfig
    text : str
        The same as TOML.
    found : Found
        What was seen in the logs.

    Raises
    ------
    InputError
        One line; also where `typed` contradicts what is drafted beside it.
    """
    config, text, found = drafted(command, logs, file, stated, progress)
    from workflow.tasks.draft import informed
    from workflow.tasks.pipeline import identify_only
    from workflow.tasks.results import RunResults

    with naming_readings(found.read.records):
        try:
            identify_only(config, run.path, config_text=text, earlier=earlier, progress=progress)
            _refuse_missed_friction(RunResults(run), found)
        except InputError as refused:
            if not config.control_channel.uncertainty.friction_identified:
                raise
            # The friction may be at a shaft that the sensor does not see; and logs that no model with
            # friction explains still tell the machine as it was recorded.
            why = str(refused).partition(": ")[2].partition(". ")[0]
            for remote in (True, False):
                found = replace(found, refused=why, remote=remote)
                config, text = written(found, file)
                with suppress(InputError):
                    identify_only(config, run.path, config_text=text, earlier=earlier, progress=progress)
                    if _is_described(RunResults(run), config.control_index):
                        break
            else:
                raise
        results = RunResults(run)
        at = config.control_index
        channel = results.identify.channels[at]
        if found.refused and not found.remote:
            found = replace(found, refused=found.refused + _best_linear(channel))
        draft = informed(found.draft, channel, results.uncertainty.channels[at])
    if typed:
        draft = replace(draft, specification=with_typed(draft.specification, typed))
    found = replace(found, draft=draft, before=found.draft, typed=frozenset(typed or ()))
    return (*written(found, file), found)


def _refuse_missed_friction(results: RunResults, found: Found) -> None:
    """Raises InputError, one line, where the draft has friction identified because the motion shows it, and
    the fit misses it."""
    from ident.friction import refuse_missed_friction

    friction = results.identify.friction
    motion = found.draft.look.motion
    if friction is None or motion is None or not found.draft.friction:
        return
    output = found.read.roles.output
    with naming(f"channel {output!r}"):
        refuse_missed_friction(friction, motion.friction.value, output)


def _is_described(results: RunResults, at: int) -> bool:
    """Whether the model of channel number `at` explains a log, and its ellipses are narrow in some band.

    For the model that is taken instead when none with friction explains the logs: it has to pass the least
    fit that those missed.
    """
    from workflow.tasks.first_look import TOLD
    from workflow.tasks.uncertainty import LEAST_FIT_PERCENT

    bands = results.uncertainty.channels[at].bands
    # Semi-axis over |G|; TOLD is for a standard deviation, which is smaller: this asks for more.
    is_narrow = min(band.median_radius_percent for band in bands) <= 100 * TOLD
    return is_narrow and results.identify.channels[at].best_fit_percent >= LEAST_FIT_PERCENT


def _best_linear(channel: IdentifiedChannel) -> str:
    """What the model without friction explains of the logs that made the loop, and its modes: the end of a
    sentence that says why no friction is identified; "" where no free run in the loop was made."""
    values = {} if channel.closed_loop is None else channel.closed_loop.values
    if "least_in_loop_percent" not in values:
        return ""
    modes = []
    for mode in channel.modes:
        if channel.is_mode(mode):
            frequency_Hz = mode.omega_rad_s / (2 * np.pi)
            modes.append(f"{frequency_Hz:.3g}")
    worst_percent = f"{values['least_in_loop_percent']:.0f}"
    best_percent = f"{values['most_in_loop_percent']:.0f}"
    share = worst_percent if worst_percent == best_percent else f"{worst_percent} to {best_percent}"
    modes_in_words = f", with modes at {', '.join(modes)} Hz" if modes else ", without a mode"
    return f"; a linear model explains {share} % in a free run in the loop{modes_in_words}"


def drafted(
    command: str,
    logs: Sequence[Path],
    out: Path,
    stated: Reading | None,
    progress: Progress | None = None,
) -> tuple[RunConfig, str, Found]:
    """The configuration of one channel of these logs, its text, and what was seen; nothing is written.

    Parameters
    ----------
    command : str
        What a complaint says to type again.
    logs : sequence of Path
    out : Path
        Where the configuration is to stand.
    stated : Reading, optional
        How the logs are read.
    progress : Progress, optional

    Raises
    ------
    InputError
        One line.
    """
    stated = stated or Reading()
    read = read_channel(command, logs, stated, progress, drafted=True)
    # A log that is refused does not wait for what looks at it: that takes seconds to load.
    from workflow.tasks.draft import draft_of

    output = read.roles.output
    unit_of = read.unit_of
    with naming_readings(read.records), naming(command):
        draft = draft_of(
            read.records,
            position=is_position(output, unit_of[output]),
            limit=stated.input_limit,
            controller_period_s=stated.controller_period_s,
            command_averaged=stated.command_averaged,
        )
    scale = dict(stated.scale)
    units = dict(stated.units)
    if draft.look.turned:
        name = read.roles.input
        scale[name] = -scale.get(name, 1.0)
        units |= {name: unit_of[name]} if unit_of[name] else {}
    doubts = distinct([doubt for record in read.records for doubt in record.doubts])
    found = Found(command, tuple(logs), path_as_typed(out.name), stated, read, scale, units, draft, doubts)
    return (*written(found, out), found)


def written(found: Found, out: Path) -> tuple[RunConfig, str]:
    """The configuration, to stand at `out`, and its text."""
    from workflow.config.run_config import RunConfig
    from workflow.config.settings import check

    text = configuration(found, _entries(found.read.tables, out, found.draft))
    context = {"base": out.absolute().parent}
    return check(RunConfig, tomllib.loads(text), source=str(out), context=context), text


@dataclass(frozen=True, eq=False)
class ReadChannel:
    """One channel of logs as read.

    Attributes
    ----------
    roles : Roles
        Columns of input, output, reference and time.
    how : Reading
        As stated, with what was found.
    unit_of : dict
        Units of input and output by column, "" where they are not known.
    records : list of Record
    repeats : int
        Rows of the logs that are alike, one after the other; 1 where each is its own.
    tables : list of Table
        Of the records.
    """

    roles: Roles
    how: Reading
    unit_of: dict[str, str]
    records: list[Record]
    repeats: int
    tables: list[Table]


def read_channel(
    command: str,
    logs: Sequence[Path],
    stated: Reading,
    progress: Progress | None = None,
    *,
    drafted: bool = False,
) -> ReadChannel:
    """One channel of logs by the names and units of their columns.

    A reference is among them; the records are repaired, unwrapped and resampled where they need it.

    Parameters
    ----------
    command : str
        What a complaint says to type again.
    logs : sequence of Path
    stated : Reading
        How the user says that the logs are read.
    progress : Progress, optional
        Told a line for each doubt.
    drafted : bool
        A model is drafted from the logs: hopeless ones are refused before that is loaded.

    Raises
    ------
    InputError
        One line that names file, column or line.
    """
    tables = list[Table]()
    for path in logs:
        with naming(str(path)):
            tables.append(read_table(path).with_decimal(stated.decimal))
            if has_response(tables[-1]):
                raise ValueError("a frequency response, no log: flexlink design takes it")
    with naming(str(logs[0])):
        roles = stated.roles(tables[0], logs, command)
        if stated.dt_s is not None and stated.time is None:
            roles = replace(roles, time=None)
        tables = [run for table in tables for run in table.runs(roles.time)]
        if roles.time is None and stated.dt_s is None:
            named = {"input": stated.input_name, "output": stated.output_name, "reference": stated.reference}
            typed = f"flexlink {command} {to_type(logs)} {stated.typed(command)}".rstrip()
            for role, name in named.items():
                if name:
                    typed += f" --{role} {as_typed(name)}"
            # What rises from row to row may be time; without such a column the period has to be stated.
            rising_columns = rising(tables[0])
            way = f"--time {as_typed(rising_columns[0])}" if rising_columns else "--dt-s SECONDS"
            raise ValueError(f"no column looks like time; type: {typed} {way}")

    # What time stamps and angles need so that the next command reads them alike.
    with naming(""):
        options = []
        periods = []
        for table in tables:
            if roles.time:
                # Where cells are missing, stamps count in which the output has a reading.
                measured = roles.output if table.sparse else None
                options.append(option_for(table.stamps(roles.time, measured, stated.time_unit)[0]))
            periods.append(wraps_at(table.columns([roles.output])[roles.output]))
        period = max(periods)
    # Uneven stamps that only resampling can read: its step takes the place of a repair.
    steps = [float(text.split()[1]) for text in options if text.startswith("--resample-s")]
    own_unwrap = {roles.output: float(period)} if period else {}
    how = stated.model_copy(
        update={
            "input_name": roles.input,
            "output_name": roles.output,
            "reference": roles.reference,
            "doubts": roles.doubts,
            "time": roles.time,
            "time_unit": stated.time_unit if roles.time else None,
            "repair": "--repair" in options and not steps,
            "resample_s": max(steps, default=None),
            "unwrap": stated.unwrap or own_unwrap,
        }
    )

    # A logger that is faster than the controller repeats its rows: one of each is taken.
    records = how.records(tables)
    repeats = min(_repeats(record) for record in records)
    if repeats > 1 and not steps:
        own_step_s = float(f"{repeats * records[0].dt_s:.9g}")
        how = how.model_copy(update={"resample_s": own_step_s})
        records = how.records(tables)
    if drafted:
        fitted = fitted_records(records)
        in_loop = all(record.reference is not None for record in fitted)
        with naming_readings(fitted):
            refuse_hopeless_logs(fitted, progress, loop=in_loop)
    for record in records:
        refuse_constant_input(record)
    unit_of = {}
    for name in (roles.input, roles.output):
        # A scaled column is no longer in the unit of its header.
        in_header = "" if name in stated.scale else tables[0].unit(name)
        unit_of[name] = stated.units.get(name, in_header)
    return ReadChannel(
        roles, how, unit_of, with_common_sampling_time(records), repeats if not steps else 1, tables
    )


def _repeats(record: Record) -> int:
    """Rows after which a logger that is faster than the controller writes new ones; 1 where it is not."""
    columns = [record.input, record.output]
    if record.reference is not None:
        columns.append(record.reference)
    changes = np.any(np.diff(np.hstack(columns), axis=0) != 0, axis=1)
    gaps = np.diff(np.flatnonzero(changes))
    usual = int(np.median(gaps)) if gaps.size else 1
    if usual <= 1:
        return 1
    # A value may stay for two or three periods, but for no part of one.
    whole_periods = np.mean(gaps % usual == 0)
    return usual if whole_periods > _NEARLY_ALL else 1


def configuration(found: Found, records: Sequence[Mapping[str, Any]]) -> str:
    """Text of the configuration (TOML). records: keys of each record."""
    filters = (
        ("toml", _toml),
        ("toml_key", lambda name: tomlkit.key(name).as_string()),
        ("three", lambda value: _toml(float(f"{value:.3g}"))),
    )
    template = environment(*filters).get_template("init.toml.j2")
    return Markup(template.render(found=found, records=records)).unescape() + "\n"


def _toml(value: Any) -> str:
    plain = value.item() if isinstance(value, np.generic) else value
    return tomlkit.item(plain).as_string()


def _entries(tables: Sequence[Table], out: Path, draft: Draft) -> list[dict[str, Any]]:
    """Keys of each record. The last log, or run, validates; of one the last part, where it is split."""
    base = out.absolute().parent
    stems = [table.path.stem for table in tables]
    # Relative to the configuration, so that a folder with both can be moved.
    relative = [os.path.relpath(table.path.absolute(), base) for table in tables]
    paths = [Path(path).as_posix() for path in relative]
    if len(tables) == 1 and draft.split_sample is not None:
        first = {"path": paths[0], "name": f"{stems[0]}, first part", "stop_sample": draft.split_sample}
        last = {"path": paths[0], "name": f"{stems[0]}, last part", "start_sample": draft.split_sample}
        return [first, last | {"role": "validation"}]
    alike = len(set(stems)) < len(stems)
    entries = list[dict[str, Any]]()
    for k, (path, stem, table) in enumerate(zip(paths, stems, tables, strict=True)):
        entry: dict[str, Any] = {"path": path}
        if table.run:
            entry["name"] = f"{stem}, {table.run}"
            entry["run"] = paths[:k].count(path)
        elif alike:
            entry["name"] = f"{k + 1}: {stem}"
        if 0 < k == len(paths) - 1:
            entry["role"] = "validation"
        entries.append(entry)
    return entries
