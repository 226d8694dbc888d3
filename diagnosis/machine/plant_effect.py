"""Effects of one's own plant: names, parameters with ranges, and where a search starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np

from diagnosis.machine.around import Acts, Where
from plant.effects.base import ratio_candidates
from plant.effects.search_space import Axis, Candidate, Dependence, Harmonic

_STEPS = {"smooth": 1e-5, "continuous": 1e-3, "non-smooth": 5e-3}


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

    as_listed: ClassVar[bool] = True

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
    contains : str or None. Simpler effect that it is with its further parameters at an end of their ranges.
    check : str. What to do to see whether it is there: a command in a sentence; "" says nothing.
    acts : Acts or None
        What it does to a simulation that does not know it (`with_effects`); None: the simulation is told.
    where, change : of a listed effect, what `Acts` says of it before it has a place.
    multiplies : str or None. Stated value that its only parameter, a ratio, multiplies (`wrong_value`).
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    signed: bool = False
    grows: bool = True
    dependence: Dependence = "smooth"
    group: str = ""
    contains: str | None = None
    acts: Acts | None = None
    check: str = ""
    where: Where | None = None
    change: Callable[..., Any] = dict
    multiplies: str | None = None
    harmonic: ClassVar[Harmonic | None] = None
    adds_to: ClassVar[str | None] = None
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
        if self.multiplies:
            # At its end a ratio wants to go on: the value is not the cause, or nowhere near.
            return tuple(
                replace(side, axes=(replace(side.axes[0], edge="high" if side.grows else "low"),))
                for side in ratio_candidates(self, self.parameters[0].low, self.parameters[0].high)
            )
        axes = tuple(p.axis(self.dependence) for p in self.parameters)
        counts = [8, *[3] * (len(axes) - 1)]
        values = [p.start_coordinates(n) for p, n in zip(self.parameters, counts, strict=True)]
        signs = (1, -1) if self.signed else (1,)
        return tuple(Candidate(self, axes, tuple(product(*values)), sign, self.grows) for sign in signs)

    def from_search(self, values: Mapping[str, float], sign: int) -> Change:
        """The effect at these values, the size (the first parameter) with its sign."""
        size = self.parameters[0].name
        signed = {**values, size: values[size] if self.multiplies else sign * values[size]}
        return Change(self.name, MappingProxyType(signed))

    @property
    def id(self) -> str:
        return self.name


# A stated value may be wrong by this factor.
_LARGEST_RATIO = 10.0
# From this tolerance on (1: nothing is known) no value is wrong.
_KNOWS_NOTHING = 1.0


def wrong_values(tolerances: Mapping[str, float]) -> tuple[PlantEffect, ...]:
    """Stated values that may be wrong by several of their tolerances: findings, no matter of tolerances."""
    return tuple(
        PlantEffect(f"wrong_{key}", (EffectParameter("ratio", tolerance, _LARGEST_RATIO),), multiplies=key)
        for key, tolerance in tolerances.items()
        if tolerance < _KNOWS_NOTHING
    )
