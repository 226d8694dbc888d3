"""Cases of one's own simulation: an MJCF model, an FMU or a Python file beside logs (docs/simulators.md)."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from diagnosis.answer import Diagnosis, NamedEffect
from diagnosis.machine.around import Actuator, Body, Sensor
from diagnosis.machine.machine_protocol import check_count
from diagnosis.machine.own_plant import Plant, PlantCase
from diagnosis.machine.plant_effect import PlantEffect, name_with_unit
from ident.data.record_files import read_table
from plant.effects.search_space import geometric
from workflow.diagnose.simulator_logs import experiments_of, noise_of, sampling_of
from workflow.diagnose.simulator_models import open_model
from workflow.diagnose.simulator_settings import SimulatorSettings
from workflow.engine import storage
from workflow.engine.errors import InputError, naming
from workflow.engine.run_directory import hash_of
from workflow.text.formats import listing
from workflow.text.names import unit_of

# Starts of a size between stated bounds, in equal ratios, besides the bounds themselves. Chosen: two in every
# decade of the usual three.
_STARTS_IN_BOUNDS = 6


@dataclass(frozen=True, eq=False)
class SimulatorCase:
    """A case with what pages and files need beside it; for a rig see
    `workflow.diagnose.case_files.LoadedCase`.

    case : PlantCase. rig_file : name of the model's file. input_sha256 : of settings, model and logs.
    repaired : diagnosis, folder -> text of the repaired MJCF model to write there; None of other simulators.
    descriptions : of records, none here. inputs : names of the commands. model_error : as stated.
    units : effect -> parameter -> its name with a unit. suspected : none here.
    doubts : sentences on what the logs leave open.
    """

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
    """A case of a simulator's model and logs, which are relative to `folder`.

    Raises InputError: one line naming the file (or `source`, which says where the settings come from) and
    what is wrong.
    """
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
    dt_s = sampling_of(tables, settings)
    name = settings.case or model.stem
    with naming(str(model)):
        opened = open_model(model, tables, settings, dt_s)
    experiments = experiments_of(
        paths, tables, settings, opened.inputs, opened.outputs, tracked=opened.is_tracked
    )
    noise = noise_of(experiments, opened.outputs, settings)
    with naming(str(model)):
        plant = opened.plant(experiments, noise)
        # As simulated, before a case file chooses among its candidates.
        repaired = partial(opened.repaired, plant) if opened.repairs else None
        unknown = [key for key in settings.tolerances if key not in plant.parameters]
        if unknown:
            raise InputError(
                f"{source}: tolerances: no parameter is called {unknown[0]!r}; there are "
                f"{', '.join(plant.parameters)}"
            )
        plant = replace(plant, tolerances={**plant.tolerances, **settings.tolerances})
        plant = _chosen(plant, settings)
        case = PlantCase(name, plant, experiments)
    # Equal settings and files, equal hash: a resumed diagnosis is held to it.
    hashes = [storage.sha256_of_file(path) for path in (model, *paths)]
    return SimulatorCase(
        case,
        model.name,
        hash_of({"settings": settings.model_dump(mode="json"), "files": hashes}),
        repaired,
        inputs=opened.inputs,
        model_error=settings.model_error,
        units={effect.name: _with_units(effect, plant, opened.inputs) for effect in plant.effects},
        doubts=opened.doubts,
    )


def _with_units(effect: PlantEffect, plant: Plant, inputs: Sequence[str]) -> dict[str, str]:
    """Parameter -> its name with its unit, of those whose unit is that of an input or an output.

    inputs : names of the commands, whose units they end with.
    """
    place = effect.place
    outputs = plant.output_names

    def unit(name: str) -> str:
        # As the end of a name: "kg m²/s" is written kgm2_s.
        stated = unit_of(name) or plant.units.get(name, "")
        return stated.replace(" ", "").replace("²", "2").replace("/", "_")

    # The kind of each size (force, position, reading) -> the unit that the model gives it.
    units: dict[str, str] = {}
    # Only MuJoCo's offsets of sensors come here: its other sizes have units.
    if effect.name.endswith(".sensor_offset"):
        units["output"] = unit(effect.name.removesuffix(".sensor_offset"))
    elif isinstance(place, Body):
        motion = int(place.motion)
        # A motion that nobody measures has no name.
        moved = unit(outputs[motion]) if motion < len(outputs) else ""
        # A body's place has the unit of its speed without the seconds.
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


def with_units(diagnosis: Diagnosis, units: Mapping[str, Mapping[str, str]]) -> Diagnosis:
    """A diagnosis with sizes of its effects under names with units; the repair keeps those that the
    simulation takes.

    units : effect -> parameter -> its name with a unit.
    """

    def renamed(effect: NamedEffect) -> NamedEffect:
        names = units.get(effect.name, {})

        def with_names(values: Mapping[str, Any]) -> dict[str, Any]:
            return {names.get(key, key): value for key, value in values.items()}

        return replace(
            effect,
            parameters=with_names(effect.parameters),
            intervals=with_names(effect.intervals),
            remarks=with_names(effect.remarks),
        )

    return replace(diagnosis, effects=tuple(renamed(effect) for effect in diagnosis.effects))


def _chosen(plant: Plant, settings: SimulatorSettings) -> Plant:
    """The plant with the candidates that a case file leaves, each within its bounds; all else is as stated.

    A pattern names an effect or a stated value, which is also called "wrong_NAME"; it is called only so where
    an effect has its name. Raises ValueError, one line: a pattern that matches nothing, bounds of no effect.
    """
    values = plant.value_candidates
    candidates = [*(effect.name for effect in plant.effects), *values]
    called = {name: {name} for name in candidates}
    for name, parameter in values.items():
        called[name].add(f"wrong_{parameter}")
    for key in ("candidates", "exclude"):
        for pattern in getattr(settings, key):
            if not any(fnmatch.filter(names, pattern) for names in called.values()):
                raise ValueError(
                    f"{key}: {pattern!r} matches nothing that shows in the logs; there are "
                    f"{listing(candidates)}"
                )

    def matches(candidate: str, patterns: Sequence[str]) -> bool:
        return any(fnmatch.filter(called[candidate], pattern) for pattern in patterns)

    def taken(candidate: str) -> bool:
        return matches(candidate, settings.candidates) and not matches(candidate, settings.exclude)

    effects = {effect.name: effect for effect in plant.effects if taken(effect.name)}
    for name, (low, high) in settings.bounds.items():
        if name not in effects:
            raise ValueError(
                f"bounds: {name!r} is no effect that is tried; of a stated value give tolerances; there are "
                f"{listing(list(effects))}"
            )
        size, *further = effects[name].parameters
        # Between the bounds: an end of the range is no place to start from.
        starts = tuple(geometric(low, high, _STARTS_IN_BOUNDS + 2)[1:-1])
        bounded = replace(size, low=low, high=high, starts=starts)
        effects[name] = replace(effects[name], parameters=(bounded, *further))

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
