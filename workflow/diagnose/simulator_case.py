"""Cases of one's own simulation: an MJCF model, an FMU or a Python file beside logs (docs/simulators.md)."""

from __future__ import annotations

import fnmatch
import json
import re
import runpy
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from diagnosis.answer import Diagnosis, NamedEffect
from diagnosis.machine.around import Actuator, Body, Sensor
from diagnosis.machine.listed_effects import KINDS as LISTED
from diagnosis.machine.machine_protocol import Real, check_count
from diagnosis.machine.own_plant import OF_TRIAL, Plant, PlantCase, PlantExperiment, place_of
from diagnosis.machine.plant_effect import PlantEffect, name_with_unit
from diagnosis.machine.with_effects import with_effects
from ident.data.record import Record
from ident.data.record_files import read_table
from ident.data.roles import time_of
from ident.data.table import Table
from ident.data.time_grid import TimeGrid, sampling_time
from ident.data.units import COUNTED, LONG_STEP_S, per, size_of, written_unit
from plant.effects.search_space import geometric
from workflow.diagnose.case_settings import Column
from workflow.diagnose.simulator_settings import KINDS, SimulatorSettings
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import hash_of
from workflow.text.formats import listing
from workflow.text.names import unit_of

# Of one log the last part judges what the first part fitted.
_FITTED = 2 / 3
# Of an FMU's or a Python file's value where nothing else is stated.
_TOLERANCE = 0.05
# Units of what moves, and of what drives it.
_Moves = Literal["position", "speed"]
_MOTIONS: Mapping[str, _Moves] = {"m": "position", "rad": "position", "m/s": "speed", "rad/s": "speed"}
_DRIVES = ("N", "N m", "V", "A")
# Steps of the model that one sample may be: factors between units of time are a thousand and more, and logs
# are taken at one to twenty steps; and the samples that one step may be.
_MOST_STEPS, _MOST_SAMPLES = 500, 100
_UNITS_OF_TIME = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
# What positions are logged in beside the unit of the model.
_OTHERS = {"rad": ("degrees", np.pi / 180), "m": ("millimetres", 1e-3)}
# Third differences of white noise have twenty times its variance; no motion is left in them.
_THIRD = 20.0


@dataclass(frozen=True, eq=False)
class SimulatorCase:
    """See `workflow.diagnose.case_files.LoadedCase`. repaired: diagnosis, folder -> MJCF to write there, None
    of other simulators. inputs: names of the commands. model_error: as stated.
    units: effect -> its parameters with units. doubts: sentences on what the logs leave open."""

    case: PlantCase
    rig_file: str
    input_sha256: str
    repaired: Callable[[Diagnosis, Path], str] | None
    descriptions: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[str, ...] = ()
    model_error: float = 0.0
    units: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    suspected: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def load_simulator_case(settings: SimulatorSettings, folder: Path, source: str) -> SimulatorCase:
    """Model and logs relative to `folder`. Raises InputError: one line naming the file and what is wrong."""
    model = folder / settings.model
    if not model.is_file():
        raise InputError(f"{source}: no such model file: {model}")
    with naming(source):
        check_count(len(settings.logs), "log")
    paths = [folder / name for name in settings.logs]
    tables = []
    for path in paths:
        with naming(str(path)):
            tables.append(read_table(path))
    dt_s = _sampling(tables, settings)
    name = settings.case or model.stem
    with naming(str(model)):
        open_simulator = _SIMULATORS[next(kind for kind in KINDS if getattr(settings, kind))]
        inputs, outputs, finish = open_simulator(model, tables, settings, dt_s)
    experiments = _experiments(paths, tables, settings, inputs, outputs, tracked=settings.mjcf is not None)
    noise = _noise(experiments, outputs, settings)
    with naming(str(model)):
        plant, repaired, doubts = finish(experiments, noise)
        unknown = [key for key in settings.tolerances if key not in plant.parameters]
        if unknown:
            raise InputError(
                f"{source}: tolerances: no parameter is called {unknown[0]!r}; there are "
                f"{', '.join(plant.parameters)}"
            )
        plant = replace(plant, tolerances={**plant.tolerances, **settings.tolerances})
        plant = _chosen(plant, settings)
        case = PlantCase(name, plant, experiments)
    hashes = [storage.sha256_of_file(path) for path in (model, *paths)]
    return SimulatorCase(
        case,
        model.name,
        hash_of({"settings": settings.model_dump(mode="json"), "files": hashes}),
        repaired,
        inputs=tuple(inputs),
        model_error=settings.model_error,
        units={effect.name: _with_units(effect, plant, inputs) for effect in plant.effects},
        doubts=doubts,
    )


def _with_units(effect: PlantEffect, plant: Plant, inputs: Sequence[str]) -> dict[str, str]:
    """Parameter -> its name with its unit, of those whose unit is that of an input or an output.

    inputs : names of the commands, whose units they end with.
    """
    place = effect.place
    outputs = plant.output_names

    def unit(name: str) -> str:
        found = unit_of(name) or plant.units.get(name, "")
        return found.replace(" ", "").replace("²", "2").replace("/", "_")

    units: dict[str, str] = {}
    if effect.name.endswith(".sensor_offset"):  # of MuJoCo, whose other sizes have units
        units["output"] = unit(effect.name.removesuffix(".sensor_offset"))
    elif isinstance(place, Body):
        motion = int(place.motion)
        # A motion that nobody measures has no name.
        moved = unit(outputs[motion]) if motion < len(outputs) else ""
        position = moved.removesuffix("_s") if place.motion_is == "speed" else moved
        units["force"] = unit(inputs[place.force or 0])
        units["position"] = position
        units["speed"] = f"{position}_s" if position else ""
    elif isinstance(place, Sensor):
        units["output"] = units["reading"] = unit(outputs[int(place.column)])
    elif isinstance(place, Actuator) and place.drive is None:
        units["input"] = unit(inputs[int(place.column)])
    names = {parameter.name: name_with_unit(parameter, units) for parameter in effect.parameters}
    return {name: with_unit for name, with_unit in names.items() if with_unit != name}


def with_units(found: Diagnosis, units: Mapping[str, Mapping[str, str]]) -> Diagnosis:
    """Sizes of the effects under names with units; the repair keeps the names that the simulation takes."""

    def named(effect: NamedEffect) -> NamedEffect:
        of = units.get(effect.name, {})

        def said(values: Mapping[str, Any]) -> dict[str, Any]:
            return {of.get(key, key): value for key, value in values.items()}

        return replace(
            effect,
            parameters=said(effect.parameters),
            intervals=said(effect.intervals),
            remarks=said(effect.remarks),
        )

    return replace(found, effects=tuple(map(named, found.effects)))


def _chosen(plant: Plant, settings: SimulatorSettings) -> Plant:
    """With the candidates that a case file leaves, each within its bounds; all else is as stated.

    A pattern names an effect or a stated value, which is also called "wrong_NAME"; it is called only so where
    an effect has its name.
    """
    values = plant.value_candidates
    there = [*(effect.name for effect in plant.effects), *values]
    called = {name: {name} for name in there}
    for name, parameter in values.items():
        called[name].add(f"wrong_{parameter}")
    for key in ("candidates", "exclude"):
        for pattern in getattr(settings, key):
            if not any(fnmatch.filter(names, pattern) for names in called.values()):
                raise ValueError(
                    f"{key}: {pattern!r} matches nothing that shows in the logs; there are {listing(there)}"
                )

    def taken(candidate: str) -> bool:
        def within(patterns: Sequence[str]) -> bool:
            return any(fnmatch.filter(called[candidate], pattern) for pattern in patterns)

        return within(settings.candidates) and not within(settings.exclude)

    effects = {effect.name: effect for effect in plant.effects if taken(effect.name)}
    for name, (low, high) in settings.bounds.items():
        if name not in effects:
            raise ValueError(
                f"bounds: {name!r} is no effect that is tried; of a stated value give tolerances; there are "
                f"{listing(list(effects))}"
            )
        size, *rest = effects[name].parameters
        bounded = replace(size, low=low, high=high, starts=tuple(geometric(low, high, 8)[1:-1]))
        effects[name] = replace(effects[name], parameters=(bounded, *rest))

    # What is left out is listed under the names that a diagnosis gives it.
    allowed_by = "the case file to allow it (candidates, exclude)"
    left_out = {effect.name: allowed_by for effect in plant.effects if not taken(effect.name)}
    left_out |= {f"wrong_{key}": allowed_by for name, key in values.items() if not taken(name)}
    return replace(
        plant,
        effects=tuple(effects.values()),
        tolerances={key: plant.tolerances[key] for name, key in values.items() if taken(name)},
        inactive={**plant.inactive, **left_out},
    )


# A simulator is opened in two steps: it names the inputs and outputs that the logs are read for, and makes
# its plant (and what writes a repaired model, and doubts) of what was read.
_Repairs = Callable[[Diagnosis, Path], str] | None
_Finish = Callable[[Sequence[PlantExperiment], Real], tuple[Plant, _Repairs, tuple[str, ...]]]
_Simulator = Callable[
    [Path, Sequence[Table], SimulatorSettings, float], tuple[tuple[str, ...], tuple[str, ...], _Finish]
]


def _needs(package: str) -> None:
    if find_spec(package) is None:
        raise ValueError(f"needs the package {package}: {sys.executable} -m pip install {package}")


def _mjcf(model: Path, tables: Sequence[Table], settings: SimulatorSettings, dt_s: float) -> Any:
    _needs("mujoco")
    from diagnosis.machine.mujoco_model import names, read
    from diagnosis.machine.mujoco_plant import MujocoArm

    _refuse_other_unit(tables, settings, dt_s, float(read(str(model)).option.timestep))
    there = names(str(model))
    kinds: dict[str, list[str]] = {}
    for kind, several in there.items():
        for name in several:
            kinds.setdefault(name, []).append(kind)
    stated = {column.column for column in settings.columns.values()}
    bare = [_bare(name) for name in tables[0].names if name not in stated]
    for name in [*settings.columns, *(name for name in tables[0].names if name not in stated), *bare]:
        if len(kinds.get(name, ())) > 1:
            several = [f'"{kind} {name}" = ...' for kind in kinds[name]]
            raise ValueError(
                f"{name} is the name of {' and '.join(kinds[name])}: say which is which, "
                f"columns = {{{', '.join(several)}}}"
            )

    def label(kind: str, name: str) -> str:
        return f"{kind} {name}" if len(kinds.get(name, ())) > 1 else name

    measured = {label(kind, name): (kind, name) for kind in ("sensor", "joint") for name in there[kind]}
    columns = {name: _column(name, tables[0], settings).column for name in measured}
    labels = tuple(name for name, column in columns.items() if column in tables[0].names)
    dead = [
        name for name in labels if all(np.ptp(t.columns([columns[name]])[columns[name]]) == 0 for t in tables)
    ]
    doubts = []
    if dead and len(dead) < len(labels):
        doubts.append(f"columns that never change are left out: {', '.join(columns[n] for n in dead)}")
        warnings.warn(doubts[0], stacklevel=2)
        labels = tuple(name for name in labels if name not in dead)
    if not labels:
        raise ValueError(
            f"no column of {tables[0].path.name} is named after a joint or sensor: "
            f"{_which_column([*columns], tables[0], settings)}"
        )
    # A joint beside a sensor of its name is known to the plant by its label, any other by its own name.
    outputs = tuple(
        one if kind == "joint" and "sensor" in kinds[name] else name
        for one in labels
        for kind, name in [measured[one]]
    )
    arm = MujocoArm.from_file(str(model), outputs=outputs, dt_s=dt_s)
    commands = tuple(label("actuator", name) for name in arm.inputs)
    unknown = [name for name in settings.columns if name not in (*commands, *measured, "time_s")]
    if unknown:
        raise ValueError(
            f"columns: no actuator, sensor or joint is called {unknown[0]!r}; there are "
            f"{', '.join((*commands, *measured))}"
        )
    absent = [name for name in settings.columns if name in measured and name not in (*labels, *dead)]
    if absent:
        raise ValueError(f"columns: {tables[0].path} has no column {columns[absent[0]]!r} ({absent[0]})")
    for name in commands:
        both = [one for one in labels if columns[one] == _column(name, tables[0], settings).column]
        if both:
            raise ValueError(
                f"column {columns[both[0]]!r} is both {name} and {both[0]}: say which of the two"
            )

    known = {*arm.measured_joints, *dead}
    if loose := [one for one in there["joint"] if one not in known and one.partition(" ")[0] not in known]:
        doubts.append(f"no column measures {listing(loose)}: simulated from where the model rests")

    def finish(experiments: Sequence[PlantExperiment], noise: Real) -> Any:
        largest = np.max([np.max(np.abs(e.input), axis=0) for e in experiments], axis=0)
        asked = []
        for name, one, size in zip((*commands, *labels), (*arm.inputs, *outputs), largest, strict=True):
            (reach, unit), column = arm.reaches.get(one, (np.inf, "")), _column(name, tables[0], settings)
            other, scale = _OTHERS.get(unit, ("", 1.0))
            # Of a unit that is stated, and of what is not so far off, nobody need be asked.
            known = column.scale is not None or tables[0].unit(column.column)
            if size > 3 * reach > 3 * scale * size and not known:
                said = f"up to {size:.3g}, the model {reach:.3g} {unit}"
                asked.append(
                    (column.column, other, said, f'{{column = "{column.column}", scale = {scale:.6g}}}')
                )
        for first, other, said, scaled in asked[:1]:
            raise InputError(
                f"{tables[0].path}: {listing([one[0] for one in asked])} in {other} ({first} {said})? Say of "
                f"each, in a case file: columns = {{{json.dumps(first)} = {scaled}}} (1: in the model's unit)"
            )
        stated = settings.tracking_rad_s
        tracking = arm.tracking(experiments) if stated is None else stated
        # A pattern for all of a place ("elbow.*") is no name.
        named = [one for one in settings.candidates if one.rpartition(".")[2] != "*" and "." in one]
        plant = replace(arm, tracking_rad_s=tracking).plant(
            experiments, noise, model_error=settings.model_error, named=named
        )

        def repaired(found: Diagnosis, folder: Path) -> str:
            return arm.repaired(plant, found.rig, found.repair, found.case.held_out, folder)

        return plant, repaired, tuple(doubts)

    return commands, labels, finish


def _fmu(model: Path, tables: Sequence[Table], settings: SimulatorSettings, dt_s: float) -> Any:
    _needs("fmpy")
    from diagnosis.machine.fmu_plant import Fmu

    fmu = Fmu(model, dt_s)
    _refuse_other_unit(tables, settings, dt_s, fmu.step_s)
    finish = _with_all(fmu, fmu.parameters, {}, fmu.effects, fmu.inputs, fmu.outputs, settings, dt_s)
    return fmu.inputs, fmu.outputs, finish


def _python(model: Path, tables: Sequence[Table], settings: SimulatorSettings, dt_s: float) -> Any:
    sys.path += {str(model.resolve().parent)} - {*sys.path}  # for what it imports from beside it
    try:
        there = runpy.run_path(str(model))
    except (Exception, SystemExit) as error:
        at = place_of(error, str(model))
        raise ValueError(f"ended with {type(error).__name__}: {error}{at}") from error
    missing = [key for key in ("simulate", "PARAMETERS", "INPUTS", "OUTPUTS") if key not in there]
    if missing:
        raise ValueError(f"does not define {missing[0]}; expected simulate, PARAMETERS, INPUTS and OUTPUTS")
    # One name without a comma behind it is no tuple.
    inputs, outputs = (
        (names,) if isinstance(names, str) else tuple(names) for names in (there["INPUTS"], there["OUTPUTS"])
    )
    tolerances, effects = there.get("TOLERANCES", {}), tuple(there.get("EFFECTS", ()))
    for key, values in (("PARAMETERS", there["PARAMETERS"]), ("TOLERANCES", tolerances)):
        if not isinstance(values, Mapping):
            raise ValueError(f'{key} must be name -> number, as {{"mass_kg": 1.2}}; got {values!r}')
    simulate, parameters = there["simulate"], there["PARAMETERS"]
    _refuse_other_unit(tables, settings, dt_s, None)
    finish = _with_all(simulate, parameters, tolerances, effects, inputs, outputs, settings, dt_s)
    return inputs, outputs, finish


_SIMULATORS: Mapping[str, _Simulator] = {"mjcf": _mjcf, "fmu": _fmu, "python": _python}


def _with_all(
    simulation: Callable[..., Real],
    parameters: Mapping[str, float],
    tolerances: Mapping[str, float],
    effects: tuple[Any, ...],
    inputs: Sequence[str],
    outputs: Sequence[str],
    settings: SimulatorSettings,
    dt_s: float,
) -> _Finish:
    """A simulation with the listed effects around inputs and outputs, and around its body where stated."""

    def finish(experiments: Sequence[PlantExperiment], noise: Real) -> tuple[Plant, None, tuple[str, ...]]:
        plant = Plant(
            simulation,
            parameters,
            {name: tolerances.get(name, _TOLERANCE) for name in parameters},
            tuple(outputs),
            noise,
            effects,
            settings.model_error,
            dt_s,
            units=getattr(simulation, "units", {}),
            input_names=tuple(inputs),
        )
        around = partial(with_effects, experiments=experiments, dt_s=dt_s)
        motion, motion_is = (outputs[0], settings.motion) if settings.motion else _motion(inputs, outputs)
        body = Body(motion, motion_is) if motion else None
        try:
            plant = around(plant, "all", actuator=Actuator(at_rest_before=False), body=body)
        except ValueError as error:
            # A motion that was only guessed may be none: its effects then stay untried, and the page says so.
            if settings.motion or motion is None:
                raise ValueError(str(error).removesuffix(OF_TRIAL)) from error
            plant = around(plant, "all", actuator=Actuator(at_rest_before=False))
        there = [LISTED[effect.name] for effect in plant.effects if effect.name in LISTED]
        of_actuator = [kind.name for kind in there if kind.law.where == "input"]
        of_sensor = [kind.name for kind in there if kind.law.where == "output"]
        for column, name in enumerate(inputs[1:], start=1):
            actuator = Actuator(column, at_rest_before=False)
            plant = around(plant, of_actuator, actuator=actuator, prefix=f"{name}_")
        for name in outputs[1:]:
            plant = around(plant, of_sensor, sensor=Sensor(name), prefix=f"{name}_")
        return plant, None, ()

    return finish


def _motion(inputs: Sequence[str], outputs: Sequence[str]) -> tuple[str | None, _Moves]:
    """The output that is the motion of a body, by its unit: the only one that is a position or a speed, where
    the first input is what drives a body."""
    kinds = {name: _MOTIONS[unit] for name in outputs if (unit := unit_of(name)) in _MOTIONS}
    if len(kinds) != 1 or unit_of(inputs[0]) not in _DRIVES:
        return None, "position"
    return next(iter(kinds.items()))


def _bare(column: str) -> str:
    """A header without its unit: "elbow [deg]" and "elbow_deg" as "elbow"."""
    unit = written_unit(column)
    spelled = re.sub(r"\s*[\[(][^\[()\]]*[\])]\s*$", "", column)
    return spelled.removesuffix(f"_{unit.replace('/', '_')}") if unit else column


def _column(name: str, table: Table, settings: SimulatorSettings) -> Column:
    """Where a quantity of the model stands: as said, under its own name, or under that with a unit behind."""
    if name in settings.columns or name in table.names:
        return settings.columns.get(name, Column(column=name))
    alike = [column for column in table.names if _bare(column) == name]
    return Column(column=alike[0] if len(alike) == 1 else name)


def _scale(name: str, column: Column, table: Table, settings: SimulatorSettings) -> float:
    """What makes of a column the quantity in the model, which is in SI units unless its name says another."""
    unit, own = table.unit(column.column), "" if settings.mjcf else written_unit(name)
    if column.scale is not None or not unit or unit == own:
        return 1.0 if column.scale is None else column.scale
    kind, size = size_of(unit) or ("", 1.0)
    factor = per(unit, own) if own else size if kind and kind.split("/")[0] not in COUNTED else None
    if factor is None:
        raise ValueError(
            f"column {column.column!r} is in {unit}: state what makes it {own or 'SI units'}, "
            f'columns = {{"{name}" = {{column = "{column.column}", scale = ...}}}}'
        )
    return factor


def _time(table: Table, settings: SimulatorSettings) -> tuple[str | None, str | None]:
    """Column of the time, and its unit where a scale states it."""
    stated = settings.columns.get("time_s")
    if stated is not None:
        if stated.scale is not None and stated.scale not in _UNITS_OF_TIME:
            raise ValueError(f"columns: time_s: scale is {stated.scale:g}; expected 1, 1e-3, 1e-6 or 1e-9")
        return stated.column, _UNITS_OF_TIME[stated.scale] if stated.scale is not None else None
    return ("time_s" if "time_s" in table.names else time_of(table)), None


def _sampling(tables: Sequence[Table], settings: SimulatorSettings) -> float:
    """The same in all logs."""
    if settings.resample_s is not None:
        return settings.resample_s
    found = []
    for table in tables:
        with naming(str(table.path)):
            name, unit = _time(table, settings)
            if name is None and settings.dt_s is None:
                raise InputError(
                    f"{table.path}: no column looks like time; state its period (--dt-s, dt_s = ...) or "
                    'the column: columns = {time_s = "..."}'
                )
            if name is None:
                found.append(sampling_time(table, None, None, settings.dt_s))
                continue
            stamps = table.seconds(name, table.columns([name])[name], unit)[0]
            if settings.repair:
                found.append(TimeGrid.of(table, name, stamps).dt_s)
            else:
                found.append(sampling_time(table, stamps, name, None))
    if max(found) > 1.001 * min(found):
        raise InputError(
            f"{tables[0].path}: logs are sampled every {min(found):.6g} to {max(found):.6g} s; put all on "
            f"one grid: --resample-s {max(found):.6g} (resample_s)"
        )
    return found[0]


def _refuse_other_unit(
    tables: Sequence[Table], settings: SimulatorSettings, dt_s: float, step_s: float | None
) -> None:
    """Raises InputError where a sample is no plausible number of the model's steps (step_s; None: unknown),
    or time is whole numbers whose unit nobody states: it is in another one, or counts samples."""

    def fits(seconds: float) -> bool:
        return step_s is None or 1 / _MOST_SAMPLES < seconds / step_s < _MOST_STEPS

    for table in tables:
        name, unit = _time(table, settings)
        if name is None or unit is not None or table.is_clock(name):
            continue
        stamps = table.columns([name])[name]
        seconds, column = table.seconds(name, stamps, unit)
        step, written = (float(np.ptp(one)) / max(len(stamps) - 1, 1) for one in (seconds, stamps))
        if fits(step) and not column.doubtful:
            continue
        likely = [per for per in _UNITS_OF_TIME if written * per < LONG_STEP_S and fits(written * per)]
        per = (likely or [1e-3])[0]
        of_model = f", {step / step_s:.4g} steps of the model ({step_s:g} s)" if step_s else ""
        raise InputError(
            f"{table.path}: {name!r} steps by {step:.4g} s{of_model}: is it in {_UNITS_OF_TIME[per]}? Say "
            f'columns = {{time_s = {{column = "{name}", scale = {per:g}}}}} in a case file (1: in s). If it '
            "counts samples, take it out: --dt-s (dt_s)"
        )
    if not fits(dt_s) and (settings.resample_s or settings.dt_s):
        raise InputError(
            f"a sample every {dt_s:g} s is {dt_s / (step_s or 1):.4g} steps of the model ({step_s:g} s): "
            "state --dt-s or --resample-s (dt_s, resample_s) in seconds"
        )


def _which_column(names: Sequence[str], table: Table, settings: SimulatorSettings) -> str:
    """What to write where quantities of the model have no column."""
    kind = next(kind for kind in KINDS if getattr(settings, kind))
    columns = ", ".join(f'{name if name.isidentifier() else json.dumps(name)} = "COLUMN"' for name in names)
    return (
        f"in a case file (.toml) with {kind} = ... and log = [...] write "
        f"columns = {{{columns}}}; the log has {table.listed()}"
    )


def _signals(table: Table, names: Sequence[str], held: int, settings: SimulatorSettings) -> Real:
    """(T, N) in the model's units on the log's grid; the first ones (held) are commands."""
    columns = [_column(name, table, settings) for name in names]
    absent = [name for name, one in zip(names, columns, strict=True) if one.column not in table.names]
    if absent:
        raise ValueError(f"no column for {listing(absent)}: {_which_column(absent, table, settings)}")
    commands = list(dict.fromkeys(column.column for column in columns[:held]))
    time, unit = _time(table, settings)
    record = Record.from_file(
        table,
        commands,
        list(dict.fromkeys(column.column for column in columns[held:] if column.column not in commands)),
        time=time,
        time_unit=unit,
        dt_s=settings.dt_s if time is None else None,
        repair=settings.repair,
        resample_s=settings.resample_s,
        unwrap={column.column: column.unwrap for column in columns if column.unwrap is not None},
    )
    read = dict(zip(record.input_names, record.input.T, strict=True))
    read |= dict(zip(record.output_names, record.output.T, strict=True))
    found = [
        read[column.column] * _scale(name, column, table, settings) + column.offset
        for name, column in zip(names, columns, strict=True)
    ]
    return np.column_stack(found)


def _experiments(
    paths: Sequence[Path],
    tables: Sequence[Table],
    settings: SimulatorSettings,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    tracked: bool,
) -> tuple[PlantExperiment, ...]:
    """Commands (with what was measured behind them where the simulation tracks it) and outputs."""
    found = []
    for k, (path, table) in enumerate(zip(paths, tables, strict=True)):
        with naming(str(path)):
            whole = _signals(table, (*inputs, *outputs, *settings.beside), len(inputs), settings)
        used = len(inputs) + len(outputs)
        y = whole[:, len(inputs) : used]
        u = whole[:, :used] if tracked else whole[:, : len(inputs)]
        beside = dict(zip(settings.beside, whole[:, used:].T, strict=True))
        name = path.stem if [p.stem for p in paths].count(path.stem) == 1 else f"{path.stem} {k + 1}"
        if len(paths) > 1:
            role: Literal["estimation", "held_out"] = "held_out" if k == len(paths) - 1 else "estimation"
            with naming(str(path)):
                found.append(PlantExperiment(name, role, u, y, beside=beside))
            continue
        cut = int(_FITTED * len(y))
        with naming(f"{path}: of a single log the last third validates; give more of it, or a second --log"):
            begins = {key: signal[:cut] for key, signal in beside.items()}
            ends = {key: signal[cut:] for key, signal in beside.items()}
            first, last = f"{name} (first part)", f"{name} (last part)"
            found.append(PlantExperiment(first, "estimation", u[:cut], y[:cut], beside=begins))
            found.append(PlantExperiment(last, "held_out", u[cut:], y[cut:], first_row=cut, beside=ends))
    return tuple(found)


def _noise(
    experiments: Sequence[PlantExperiment], outputs: Sequence[str], settings: SimulatorSettings
) -> Real:
    """As stated, else what no motion explains: from third differences, at least a step of the readings."""
    unknown = [name for name in settings.noise if name not in outputs]
    if unknown:
        raise InputError(f"noise: no output is called {unknown[0]!r}; there are {', '.join(outputs)}")
    found = []
    for k, name in enumerate(outputs):
        y = np.concatenate([np.diff(e.output[:, k], 3) for e in experiments])
        steps = np.abs(np.concatenate([np.diff(e.output[:, k]) for e in experiments]))
        step = float(np.min(steps[steps > 0], initial=np.inf))
        rough = 1.4826 * float(np.median(np.abs(y))) / np.sqrt(_THIRD)
        least = 1e-6 * max(float(np.ptp(e.output[:, k])) for e in experiments)
        quantised = step / np.sqrt(12) if np.isfinite(step) else 0.0
        found.append(settings.noise.get(name) or max(rough, quantised, least))
    return np.array(found)
