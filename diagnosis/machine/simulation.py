"""What a simulation answers, whatever runs it: a Python file, an FMU, a MuJoCo model.

A `Plant` is made of one with what is known about its outputs (`plant_with_all`). The force that a measured
motion takes is a simulation as well: inputs of position and speed, an output of force (`MeasuredBody`). A rig
is a machine with typed effects of its own (`diagnosis.machine.flexible_arm`), whose forces follow the same
laws (`plant.force_laws`).
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from diagnosis.machine.around import Actuator, Body, Sensor
from diagnosis.machine.listed_effects import KINDS
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.own_plant import OF_TRIAL, Plant, PlantExperiment, is_number, place_of
from diagnosis.machine.plant_effect import PlantEffect
from diagnosis.machine.with_effects import with_effects

# Relative standard deviation of a value whose tolerance nobody states: a data sheet's usual one.
USUAL_TOLERANCE = 0.05
# What a Python file must define.
_DEFINED = ("simulate", "PARAMETERS", "INPUTS", "OUTPUTS")
# What a file calls the step of its simulation, as far as it is a number of seconds.
_STEP_NAMES = ("DT_S", "dt_s", "DT", "dt", "TS", "Ts", "STEP_S", "step_s")
# Of a value in an error line, so that the line stays one.
_SHOWN_CHARACTERS = 60


@runtime_checkable
class Simulation(Protocol):
    """A simulation with what it says about itself."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """Name -> stated value."""

    @property
    def tolerances(self) -> Mapping[str, float]:
        """Parameter -> relative standard deviation, of those for which it is stated."""

    @property
    def effects(self) -> tuple[PlantEffect, ...]:
        """Effects that the simulation knows and does not have unless told."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """(U,) names of the inputs, held over each sample."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """(Y,) names of the outputs."""

    @property
    def units(self) -> Mapping[str, str]:
        """Output -> unit, of outputs whose names do not end with it."""

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        """Outputs (T, Y) without noise under inputs (T, U).

        parameters has a value for every name; effects has name -> parameter -> value of those that act.
        """


@dataclass(frozen=True, eq=False)
class PythonFile:
    """A Python file that defines simulate, PARAMETERS, INPUTS and OUTPUTS; TOLERANCES and EFFECTS if it
    likes.

    simulate : (parameters, effects, inputs (T, U)) -> outputs (T, Y).
    dt_s : the step that the file names (DT_S, dt, ...), whether of a sample or of a part of it; None: none.
    """

    simulate: Any
    parameters: Mapping[str, float]
    tolerances: Mapping[str, float]
    effects: tuple[PlantEffect, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt_s: float | None = None

    @classmethod
    def read(cls, path: Path) -> PythonFile:
        """What a file defines; the file is run, with what it imports from beside it.

        Raises
        ------
        ValueError
            One line: the file ends with an error, lacks a name, or a name holds something else than its kind.
        """
        folder = str(path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)
        try:
            defined = runpy.run_path(str(path))
        except (Exception, SystemExit) as error:
            words = " ".join(str(error).split())
            at = place_of(error, str(path))
            raise ValueError(f"ended with {type(error).__name__}: {words}{at}") from error
        missing = [key for key in _DEFINED if key not in defined]
        if missing:
            raise ValueError(
                f"does not define {missing[0]}; expected simulate, PARAMETERS, INPUTS and OUTPUTS"
            )
        if not callable(defined["simulate"]):
            raise ValueError(
                "simulate must be a function of (parameters, effects, inputs); "
                f"got {_in_short(defined['simulate'])}"
            )
        effects = defined.get("EFFECTS", ())
        if not isinstance(effects, list | tuple) or not all(isinstance(e, PlantEffect) for e in effects):
            raise ValueError(f"EFFECTS must be a list of PlantEffect; got {_in_short(effects)}")
        return cls(
            defined["simulate"],
            _numbers_by_name("PARAMETERS", defined["PARAMETERS"]),
            _numbers_by_name("TOLERANCES", defined.get("TOLERANCES", {})),
            tuple(effects),
            _names("INPUTS", defined["INPUTS"]),
            _names("OUTPUTS", defined["OUTPUTS"]),
            _named_step(defined),
        )

    @property
    def units(self) -> Mapping[str, str]:
        """None: names of inputs and outputs end with their units."""
        return {}

    def __call__(
        self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        """Outputs as the file's function gives them; `Plant` checks their shape and says where it fails."""
        return self.simulate(parameters, effects, inputs)  # type: ignore[no-any-return]


def _named_step(defined: Mapping[str, Any]) -> float | None:
    """The first number that a file calls a step, in seconds; None where it has none."""
    for name in _STEP_NAMES:
        value = defined.get(name)
        if isinstance(value, float | int) and not isinstance(value, bool) and value > 0:
            return float(value)
    return None


def _names(key: str, names: object) -> tuple[str, ...]:
    """Names as a tuple: one name without a comma behind it is a string. Raises ValueError, one line."""
    if isinstance(names, str):
        return (names,)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f'{key} must be names of columns, as ["torque_Nm"]; got {_in_short(names)}')
    return tuple(names)


def _numbers_by_name(key: str, values: object) -> Mapping[str, float]:
    """Values that are name -> number. Raises ValueError, one line."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise ValueError(f'{key} must be name -> number, as {{"mass_kg": 1.2}}; got {_in_short(values)}')
    for name, value in values.items():
        if isinstance(value, bool) or not is_number(value):
            raise ValueError(f"{key}: {name} must be a number; got {_in_short(value)}")
    return values


def _in_short(value: object) -> str:
    """A value as Python writes it, on one line, cut where it is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]} ..."


def plant_with_all(
    simulation: Simulation,
    experiments: Sequence[PlantExperiment],
    noise: Real,
    *,
    dt_s: float,
    model_error: float | None,
    motion: tuple[str, Literal["position", "speed"]] | None = None,
    motion_is_sure: bool = True,
) -> Plant:
    """A simulation with the listed effects around every input and output, and around its body.

    Parameters
    ----------
    simulation : Simulation
    experiments : sequence of PlantExperiment
        Records, whose magnitudes give the ranges.
    noise : (Y,)
        Noise standard deviations of the outputs.
    dt_s : float
        Sampling period.
    model_error : float or None
        As of `Plant`.
    motion : (output, kind) or None
        Output that is the motion of the body which the first input pushes, and what it is.
    motion_is_sure : bool
        Otherwise it is a guess: where no force can be put around it, effects of the body stay untried.

    Returns
    -------
    Plant
        Effects of inputs and outputs other than the first have the name of that in front.

    Raises
    ------
    ValueError
        As `with_effects`.
    """
    tolerances = {name: simulation.tolerances.get(name, USUAL_TOLERANCE) for name in simulation.parameters}
    bare = Plant(
        simulation,
        simulation.parameters,
        tolerances,
        tuple(simulation.outputs),
        noise,
        simulation.effects,
        model_error,
        dt_s,
        units=simulation.units,
        input_names=tuple(simulation.inputs),
    )
    first_actuator = Actuator(at_rest_before=False)
    body = None if motion is None else Body(*motion)
    try:
        plant = with_effects(bare, "all", experiments, dt_s=dt_s, actuator=first_actuator, body=body)
    except ValueError as error:
        if motion_is_sure or body is None:
            raise ValueError(str(error).removesuffix(OF_TRIAL)) from error
        plant = with_effects(bare, "all", experiments, dt_s=dt_s, actuator=first_actuator)

    # The same effects as there are at the first input and the first output.
    listed = [KINDS[effect.name] for effect in plant.effects if effect.name in KINDS]
    of_actuator = [kind.name for kind in listed if kind.law.where == "input"]
    of_sensor = [kind.name for kind in listed if kind.law.where == "output"]
    for column, name in enumerate(simulation.inputs[1:], start=1):
        actuator = Actuator(column, at_rest_before=False)
        plant = with_effects(plant, of_actuator, experiments, dt_s=dt_s, actuator=actuator, prefix=f"{name}_")
    for name in simulation.outputs[1:]:
        plant = with_effects(plant, of_sensor, experiments, dt_s=dt_s, sensor=Sensor(name), prefix=f"{name}_")
    return plant
