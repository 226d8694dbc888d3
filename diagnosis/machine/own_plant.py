"""One's own plant: a simulation with named parameters, a list of what may be missing, and records.

    def simulate(parameters, effects, inputs):  # {"mass_kg": 2.0}, {"dry_friction": {"force_N": 0.3}}, (T, U)
        return outputs  # (T, Y)

    plant = Plant(simulate, {"mass_kg": 2.0}, {"mass_kg": 0.1}, ("position_m",), np.array([1e-4]),
                  (PlantEffect("dry_friction", (EffectParameter("force_N", 1e-3, 10.0),)),))
    found = diagnose(PlantCase("mine", plant, experiments))

A constant bias or offset is a candidate like any other: list one for every input and output that may have it,
or effects that merely resemble it win.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np

from diagnosis.machine.machine_protocol import (
    KNOWN_START,
    Real,
    RecordedCase,
    RecordOfMachine,
    Role,
    UnknownStart,
    Weighing,
    check_record,
)
from ident.data.arrays import lock
from plant.effects.search_space import Axis, Candidate, Dependence, Harmonic

Simulate = Callable[[Mapping[str, float], Mapping[str, Mapping[str, float]], Real], Real]

_STEPS = {"smooth": 1e-5, "continuous": 1e-3, "non-smooth": 5e-3}
# In noise deviations: beyond any record, and its square is still a number.
_RUNAWAY = 1e12


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect: range, and values a search starts from.

    name : str. With its unit.
    low, high : float
        On a "log" scale both above zero; the size of an effect is positive (see `PlantEffect.signed`).
    starts : tuple of float
        Without any: eight over the range for an effect's size, three for what follows, inside the range.
    """

    name: str
    low: float
    high: float
    starts: tuple[float, ...] = ()
    scale: Literal["log", "linear"] = "log"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"parameter {self.name}: needs low < high; got {self.low} and {self.high}")
        if self.scale == "log" and not self.low > 0:
            raise ValueError(f"parameter {self.name}: low must be above zero on a log scale; got {self.low}")
        outside = [v for v in self.starts if not self.low <= v <= self.high]
        if outside:
            raise ValueError(
                f"parameter {self.name}: start {outside[0]:.6g} is outside {self.low:.6g} to {self.high:.6g}"
            )

    def axis(self, dependence: Dependence) -> Axis:
        return Axis(self.name, self.scale, self.low, self.high, _STEPS[dependence])

    def start_coordinates(self, count: int) -> list[float]:
        axis = self.axis("smooth")
        if self.starts:
            return [axis.coordinate(v) for v in self.starts]
        low, high = axis.box
        return [low + (high - low) * (k + 1) / (count + 1) for k in range(count)]


@dataclass(frozen=True)
class Change:
    """An effect with values, as a fit hands it to the simulation."""

    id: str
    values: Mapping[str, float]

    def parameters(self) -> dict[str, float]:
        return dict(self.values)

    def to_dict(self) -> dict[str, Any]:
        return {"name": self.id, **self.values}


@dataclass(frozen=True)
class PlantEffect:
    """Something the plant may have and its simulation lacks unless told.

    name : str
    parameters : tuple of EffectParameter
        The first is the size: the larger, the more the outputs change (the smaller, if not `grows`, as with a
        stiffness or a limit). Below its lower end the effect must be next to nothing.
    signed : bool. The size may be negative as well: both sides are searched, as one effect.
    grows : bool
    dependence : "smooth", "continuous" or "non-smooth". How outputs depend on the parameters: differentiable;
        continuous (dry friction); neither (backlash, rounding), which takes grids in place of slopes.
    group : str. Where it acts (actuator, joint, sensor, ...); only shown.
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    signed: bool = False
    grows: bool = True
    dependence: Dependence = "smooth"
    group: str = ""
    # Which of its own parameters an effect multiplies nobody said.
    multiplies: ClassVar[str | None] = None
    harmonic: ClassVar[Harmonic | None] = None
    adds_to: ClassVar[str | None] = None
    contains: ClassVar[str | None] = None
    absolute_angle: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(self.parameters))
        if not self.parameters:
            raise ValueError(f"effect {self.name}: needs at least one parameter")
        if self.name in ("none", "unknown"):
            raise ValueError(f"effect {self.name}: this name is an answer of its own")
        if self.dependence not in _STEPS:
            raise ValueError(f"effect {self.name}: dependence must be one of {', '.join(_STEPS)}")

    def candidates(self) -> tuple[Candidate, ...]:
        axes = tuple(p.axis(self.dependence) for p in self.parameters)
        counts = [8, *[3] * (len(axes) - 1)]
        values = [p.start_coordinates(n) for p, n in zip(self.parameters, counts, strict=True)]
        starts = tuple(product(*values))
        signs = (1, -1) if self.signed else (1,)
        return tuple(Candidate(self, axes, starts, sign, self.grows) for sign in signs)

    def from_search(self, values: Mapping[str, float], sign: int) -> Change:
        """The effect at these values, the size (the first parameter) with its sign."""
        size = self.parameters[0].name
        signed = {**values, size: sign * values[size]}
        return Change(self.name, MappingProxyType(signed))

    @property
    def id(self) -> str:
        return self.name


@dataclass(frozen=True, eq=False)
class Plant:
    """A simulation of one's own with what is known about its parameters and outputs.

    simulation : (parameters, effects, inputs (T, U)) -> outputs (T, Y)
        `parameters` has every stated parameter, `effects` name -> parameter -> value of those to include.
        It must be a function of its arguments alone.
    parameters : name -> stated value
    tolerances : name -> relative standard deviation of the nominal parameter
        Parameters without one are exact. A value fitted to these same records is no knowledge beside them:
        give it a tolerance of 1 or more.
    output_names : (Y,)
    noise : (Y,). Noise standard deviations, from repeats of an experiment where there are any.
    effects : tuple of PlantEffect
    model_error : float. Share of the motion (RMS of an output about its mean) that the simulation may miss
        even with the right effects. No simulation of a real machine reaches its noise; with zero here what is
        left over makes the answer "unknown".
    """

    simulation: Simulate
    parameters: Mapping[str, float]
    tolerances: Mapping[str, float]
    output_names: tuple[str, ...]
    noise: Real
    effects: tuple[PlantEffect, ...]
    model_error: float = 0.0

    def __post_init__(self) -> None:
        lock(self, "noise")
        object.__setattr__(self, "effects", tuple(self.effects))
        object.__setattr__(self, "output_names", tuple(self.output_names))
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        object.__setattr__(self, "tolerances", MappingProxyType(dict(self.tolerances)))
        count = len(self.output_names)
        if self.noise.shape != (count,) or not np.all(self.noise > 0):
            raise ValueError(
                f"plant: needs one noise level above zero per output ({count}); got {self.noise}"
            )
        if not self.model_error >= 0:
            raise ValueError(f"plant: model_error must not be negative; got {self.model_error}")
        for key, tolerance in self.tolerances.items():
            if key not in self.parameters:
                raise ValueError(f"plant: tolerance of {key}, which is no parameter of it")
            if not 0 < tolerance <= 10:
                raise ValueError(f"plant: tolerance of {key} must be between 0 and 10; got {tolerance}")
        names = [effect.name for effect in self.effects]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"plant: effect {name} is listed twice")
        if not names:
            raise ValueError("plant: lists no effect that may be missing")

    @cached_property
    def weighing(self) -> Weighing:
        names = tuple(effect.name for effect in self.effects)
        return Weighing(names, float(self.model_error))

    @property
    def description(self) -> Plant:
        return self

    def scaled(self, factors: Mapping[str, float]) -> Plant:
        """The same plant with these parameters multiplied."""
        moved = {key: value * factors.get(key, 1.0) for key, value in self.parameters.items()}
        return replace(self, parameters=moved)

    @property
    def unknown_start(self) -> UnknownStart:
        """None: a simulation of one's own starts as it says."""
        return replace(KNOWN_START, zero_outputs=np.zeros((0, self.noise.size)))

    def torque_response(self, samples: int) -> None:
        return None

    def simulator(self, effects: Sequence[Change]) -> Callable[..., Real]:
        """Inputs (T, U) -> outputs (T, Y); where a trial of a fit runs away, a large finite number."""
        given = {effect.id: effect.values for effect in effects}
        far = _RUNAWAY * self.noise

        def outputs(inputs: Real, *_start: Real) -> Real:
            found = np.asarray(self.simulation(self.parameters, given, inputs))
            return np.clip(np.where(np.isnan(found), far, found), -far, far)

        return outputs

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        return tuple(candidate for effect in self.effects for candidate in effect.candidates())


@dataclass(frozen=True, eq=False)
class PlantExperiment:
    """One record of a plant: input (T, U), output (T, Y) as measured; held-out records fit no parameter."""

    name: str
    role: Role
    input: Real
    output: Real

    def __post_init__(self) -> None:
        lock(self, "input", "output")
        check_record(self)


@dataclass(frozen=True, eq=False)
class PlantCase(RecordedCase[PlantExperiment]):
    """A plant as its makers know it, and what it did.

    Raises ValueError if a role has no experiment, a name comes twice, an output is constant (a dead sensor),
    or the simulation does not give finite outputs of the measured shape for the first experiment.
    """

    name: str
    plant: Plant
    experiments: tuple[PlantExperiment, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        for e in self.experiments:
            check_record(e, self.plant.output_names)
        first = self.experiments[0]
        found = np.asarray(self.plant.simulation(self.plant.parameters, {}, first.input))
        if found.shape != first.output.shape or not np.all(np.isfinite(found)):
            raise ValueError(
                f"case {self.name}: the simulation must give finite outputs {first.output.shape} for "
                f"experiment {first.name}; got {found.shape}"
            )

    @property
    def machine(self) -> Plant:
        return self.plant

    @property
    def steps(self) -> Real:
        """(Y,) zeros: quantisation is an effect of one's own plant like any other."""
        return np.zeros(len(self.plant.output_names))
