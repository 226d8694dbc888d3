"""Logs beside one's own simulation: columns, units and sampling, as records of the names that the model
has."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diagnosis.machine.machine_protocol import Real, Role
from diagnosis.machine.own_plant import PlantExperiment
from ident.data.record import Record
from ident.data.roles import time_of
from ident.data.table import Table
from ident.data.time_grid import TimeGrid, sampling_time
from ident.data.units import COUNTED, LONG_STEP_S, per, size_of, written_unit
from workflow.diagnose.case_settings import Column
from workflow.diagnose.simulator_settings import KINDS, SimulatorSettings
from workflow.engine.errors import InputError, naming
from workflow.text.formats import listing

# Of one log the last third judges what the first part fitted: the usual share of validation data.
_FITTED = 2 / 3
# Steps of the model that one sample may be: factors between units of time are a thousand and more, and logs
# are taken at one to twenty steps.
_MOST_STEPS = 500
# Samples that one step of the model may be, for the same reason.
_MOST_SAMPLES = 100
# Seconds of a unit of time -> the unit.
_UNITS_OF_TIME = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
# Largest over smallest sampling period of logs that count as one grid: clocks differ by far less.
_ONE_GRID = 1.001
# Third differences of white noise have 1 + 9 + 9 + 1 times its variance; no motion is left in them.
_THIRD_DIFFERENCES = 20.0
# Standard deviations in a median absolute deviation of normal noise.
_PER_MEDIAN = 1.4826
# Share of an output's range that its noise has at least: a simulated log without noise is rounded somewhere.
_LEAST_NOISE = 1e-6


def bare(column: str) -> str:
    """A header without its unit: "elbow [deg]" and "elbow_deg" as "elbow"."""
    unit = written_unit(column)
    spelled = re.sub(r"\s*[\[(][^\[()\]]*[\])]\s*$", "", column)
    return spelled.removesuffix(f"_{unit.replace('/', '_')}") if unit else column


def column_of(name: str, table: Table, settings: SimulatorSettings) -> Column:
    """Where a quantity of the model stands: as stated, under its own name, or under that with a unit
    behind."""
    if name in settings.columns or name in table.names:
        return settings.columns.get(name, Column(column=name))
    alike = [column for column in table.names if bare(column) == name]
    return Column(column=alike[0] if len(alike) == 1 else name)


def which_column(names: Sequence[str], table: Table, settings: SimulatorSettings) -> str:
    """What to write where quantities of the model have no column: the end of a message."""
    kind = next(kind for kind in KINDS if getattr(settings, kind))
    columns = ", ".join(f'{name if name.isidentifier() else json.dumps(name)} = "COLUMN"' for name in names)
    return (
        f"in a case file (.toml) with {kind} = ... and log = [...] write "
        f"columns = {{{columns}}}; the log has {table.listed()}"
    )


def sampling_of(tables: Sequence[Table], settings: SimulatorSettings) -> float:
    """Sampling period [s], the same in all logs; as stated where rows are resampled.

    Raises InputError, one line: no time, or periods that differ.
    """
    if settings.resample_s is not None:
        return settings.resample_s
    periods_s = []
    for table in tables:
        with naming(str(table.path)):
            name, unit = _time(table, settings)
            if name is None and settings.dt_s is None:
                raise InputError(
                    f"{table.path}: no column looks like time; state its period (--dt-s, dt_s = ...) or "
                    'the column: columns = {time_s = "..."}'
                )
            if name is None:
                periods_s.append(sampling_time(table, None, None, settings.dt_s))
                continue
            stamps = table.seconds(name, table.columns([name])[name], unit)[0]
            if settings.repair:
                periods_s.append(TimeGrid.of(table, name, stamps).dt_s)
            else:
                periods_s.append(sampling_time(table, stamps, name, None))
    if max(periods_s) > _ONE_GRID * min(periods_s):
        longest_s = max(periods_s)
        raise InputError(
            f"{tables[0].path}: logs are sampled every {min(periods_s):.6g} to {longest_s:.6g} s; put all on "
            f"one grid: --resample-s {longest_s:.6g} (resample_s)"
        )
    return periods_s[0]


def refuse_other_unit(
    tables: Sequence[Table], settings: SimulatorSettings, dt_s: float, step_s: float | None
) -> None:
    """Raises InputError where time is in another unit than read, or counts samples.

    It is where a sample is no plausible number of the model's steps (step_s; None: unknown), or where time is
    whole numbers whose unit nobody states.
    """

    def fits(seconds: float) -> bool:
        return step_s is None or 1 / _MOST_SAMPLES < seconds / step_s < _MOST_STEPS

    for table in tables:
        name, unit = _time(table, settings)
        if name is None or unit is not None or table.is_clock(name):
            continue
        stamps = table.columns([name])[name]
        seconds, column = table.seconds(name, stamps, unit)
        steps = max(len(stamps) - 1, 1)
        step_as_read_s = float(np.ptp(seconds)) / steps
        step_as_written = float(np.ptp(stamps)) / steps
        if fits(step_as_read_s) and not column.doubtful:
            continue
        likely = [
            unit_s
            for unit_s in _UNITS_OF_TIME
            if step_as_written * unit_s < LONG_STEP_S and fits(step_as_written * unit_s)
        ]
        # Where no unit fits, milliseconds are the one that loggers write most often.
        scale = likely[0] if likely else 1e-3
        unit_words = _UNITS_OF_TIME[scale]
        of_model = ""
        if step_s:
            of_model = f", {step_as_read_s / step_s:.4g} steps of the model ({step_s:g} s)"
        raise InputError(
            f"{table.path}: {name!r} steps by {step_as_read_s:.4g} s{of_model}: is it in {unit_words}? Say "
            f'columns = {{time_s = {{column = "{name}", scale = {scale:g}}}}} in a case file (1: in s). If '
            "it counts samples, take it out: --dt-s (dt_s)"
        )
    if not fits(dt_s) and (settings.resample_s or settings.dt_s):
        raise InputError(
            f"a sample every {dt_s:g} s is {dt_s / (step_s or 1):.4g} steps of the model ({step_s:g} s): "
            "state --dt-s or --resample-s (dt_s, resample_s) in seconds"
        )


def experiments_of(
    paths: Sequence[Path],
    tables: Sequence[Table],
    settings: SimulatorSettings,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    tracked: bool,
) -> tuple[PlantExperiment, ...]:
    """Records of the logs: the last one for validation, of a single log its last third.

    inputs, outputs : names in the model. tracked : what was measured follows the commands in the inputs, for
    a simulation that is held near it. Raises InputError, one line with the file.
    """
    experiments = []
    for k, (path, table) in enumerate(zip(paths, tables, strict=True)):
        with naming(str(path)):
            whole = _signals(table, (*inputs, *outputs, *settings.beside), len(inputs), settings)
        n_model = len(inputs) + len(outputs)
        y = whole[:, len(inputs) : n_model]
        u = whole[:, :n_model] if tracked else whole[:, : len(inputs)]
        beside = dict(zip(settings.beside, whole[:, n_model:].T, strict=True))
        is_only_one = [other.stem for other in paths].count(path.stem) == 1
        name = path.stem if is_only_one else f"{path.stem} {k + 1}"
        if len(paths) > 1:
            role: Role = "held_out" if k == len(paths) - 1 else "estimation"
            with naming(str(path)):
                experiments.append(PlantExperiment(name, role, u, y, beside=beside))
            continue

        cut = int(_FITTED * len(y))
        with naming(f"{path}: of a single log the last third validates; give more of it, or a second --log"):
            begins = {key: signal[:cut] for key, signal in beside.items()}
            ends = {key: signal[cut:] for key, signal in beside.items()}
            first = PlantExperiment(f"{name} (first part)", "estimation", u[:cut], y[:cut], beside=begins)
            last = PlantExperiment(
                f"{name} (last part)", "held_out", u[cut:], y[cut:], first_row=cut, beside=ends
            )
        experiments += [first, last]
    return tuple(experiments)


def noise_of(
    experiments: Sequence[PlantExperiment], outputs: Sequence[str], settings: SimulatorSettings
) -> Real:
    """(Y,) noise standard deviations: as stated, else what no motion explains.

    That is from third differences, at least a step of the readings. Raises InputError for noise of an output
    that is not there.
    """
    unknown = [name for name in settings.noise if name not in outputs]
    if unknown:
        raise InputError(f"noise: no output is called {unknown[0]!r}; there are {', '.join(outputs)}")
    levels = []
    for k, name in enumerate(outputs):
        stated = settings.noise.get(name)
        if stated:
            levels.append(stated)
            continue
        # Third differences of a smooth motion are small, those of noise are not; the median leaves out jumps.
        signals = [experiment.output[:, k] for experiment in experiments]
        third = np.concatenate([np.diff(signal, 3) for signal in signals])
        rough = _PER_MEDIAN * float(np.median(np.abs(third))) / np.sqrt(_THIRD_DIFFERENCES)
        # A quantised reading has a uniform error of one step, of 1 / sqrt(12) of it, however still it lies.
        steps = np.abs(np.concatenate([np.diff(signal) for signal in signals]))
        step = float(np.min(steps[steps > 0], initial=np.inf))
        quantised = step / np.sqrt(12) if np.isfinite(step) else 0.0
        least = _LEAST_NOISE * max(float(np.ptp(signal)) for signal in signals)
        levels.append(max(rough, quantised, least))
    return np.array(levels)


def _time(table: Table, settings: SimulatorSettings) -> tuple[str | None, str | None]:
    """Column of the time, None where none looks like it; and its unit where a scale states it, else None."""
    stated = settings.columns.get("time_s")
    if stated is None:
        return ("time_s" if "time_s" in table.names else time_of(table)), None
    if stated.scale is None:
        return stated.column, None
    if stated.scale not in _UNITS_OF_TIME:
        raise ValueError(f"columns: time_s: scale is {stated.scale:g}; expected 1, 1e-3, 1e-6 or 1e-9")
    return stated.column, _UNITS_OF_TIME[stated.scale]


def _scale(name: str, column: Column, table: Table, settings: SimulatorSettings) -> float:
    """Factor that makes of a column the quantity in the model, which is in SI units unless its name says
    another.

    Raises ValueError, one line, for a unit that does not become it.
    """
    if column.scale is not None:
        return column.scale
    unit = table.unit(column.column)
    unit_in_model = "" if settings.mjcf else written_unit(name)
    if not unit or unit == unit_in_model:
        return 1.0
    factor = None
    if unit_in_model:
        factor = per(unit, unit_in_model)
    else:
        kind, size = size_of(unit) or ("", 1.0)
        # A count has no SI unit.
        if kind and kind.split("/")[0] not in COUNTED:
            factor = size
    if factor is None:
        raise ValueError(
            f"column {column.column!r} is in {unit}: state what makes it {unit_in_model or 'SI units'}, "
            f'columns = {{"{name}" = {{column = "{column.column}", scale = ...}}}}'
        )
    return factor


def _signals(table: Table, names: Sequence[str], n_commands: int, settings: SimulatorSettings) -> Real:
    """(T, N) quantities of the model in its units on the log's grid; the first ones are commands, which are
    held from row to row where rows are put on another grid."""
    columns = [column_of(name, table, settings) for name in names]
    absent = []
    for name, column in zip(names, columns, strict=True):
        if column.column not in table.names:
            absent.append(name)
    if absent:
        raise ValueError(f"no column for {listing(absent)}: {which_column(absent, table, settings)}")
    # A column may be several quantities, and a record has it once.
    command_columns = [column.column for column in columns[:n_commands]]
    output_columns = [column.column for column in columns[n_commands:]]
    commands = list(dict.fromkeys(command_columns))
    measured = [name for name in dict.fromkeys(output_columns) if name not in commands]
    time, unit = _time(table, settings)
    record = Record.from_file(
        table,
        commands,
        measured,
        time=time,
        time_unit=unit,
        dt_s=settings.dt_s if time is None else None,
        repair=settings.repair,
        resample_s=settings.resample_s,
        unwrap={column.column: column.unwrap for column in columns if column.unwrap is not None},
    )
    read = dict(zip(record.input_names, record.input.T, strict=True))
    read |= dict(zip(record.output_names, record.output.T, strict=True))
    signals = []
    for name, column in zip(names, columns, strict=True):
        scale = _scale(name, column, table, settings)
        signals.append(read[column.column] * scale + column.offset)
    return np.column_stack(signals)
