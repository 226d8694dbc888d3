"""Effects of one's own plant: names, parameters with ranges, and where a search starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ClassVar, Literal, get_args

from diagnosis.machine.around import EffectLaw, Place
from plant.effects.base import ratio_candidates
from plant.effects.search_space import (
    Candidate,
    Dependence,
    EffectParameter as EffectParameter,
    Harmonic,
    searches,
)

Tried = Literal["always", "with several outputs", "by name"]


@dataclass(frozen=True)
class Change:
    """An effect with values, as a fit hands it to the simulation.

    id : name of the effect. values : parameter -> value, the size first.
    """

    as_listed: ClassVar[bool] = True

    id: str
    values: Mapping[str, float]

    def parameters(self) -> dict[str, float]:
        """Parameter -> value."""
        return dict(self.values)

    def to_dict(self) -> dict[str, Any]:
        """{"name": id, parameter: value, ...}, as files have it."""
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
    law : EffectLaw. What it does to a simulation that does not know it; default: the simulation is told.
    place : Place or None. Where a law acts around a simulation (`with_effects`).
    multiplies : str or None. Stated value that its only parameter, a ratio, multiplies (`wrong_values`).
    tried : where nobody chose it, "always", "with several outputs" (from one alone it cannot be told from its
        twin at the input), or "by name" only.
    stated : of a number of a model, what the model has; 0: nothing, the effect may be missing. A number that
        is stated may be wrong by a ratio: it needs no parameters.
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    signed: bool = False
    grows: bool = True
    dependence: Dependence = "smooth"
    group: str = ""
    contains: str | None = None
    check: str = ""
    law: EffectLaw = field(default=EffectLaw(), compare=False)
    place: Place | None = None
    multiplies: str | None = None
    tried: Tried = "always"
    stated: float = 0.0
    harmonic: ClassVar[Harmonic | None] = None
    adds_to: ClassVar[str | None] = None
    absolute_angle: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(self.parameters))
        if not self.parameters and not self.stated:
            raise ValueError(f"effect {self.name}: needs at least one parameter")
        if self.name in ("none", "unknown"):
            raise ValueError(f"effect {self.name}: this name is an answer of its own")
        if self.dependence not in get_args(Dependence):
            raise ValueError(
                f"effect {self.name}: dependence must be one of {', '.join(get_args(Dependence))}"
            )

    def at(self, magnitudes: object) -> PlantEffect:
        """The effect with its ranges in numbers: multiples of magnitudes (`EffectParameter.at`)."""
        return replace(self, parameters=tuple(p.at(magnitudes) for p in self.parameters))

    def candidates(self) -> tuple[Candidate, ...]:
        """Search spaces of the effect: one; two of both signs, or of both sides of a ratio.

        Below one a ratio has none where the tolerance of its stated value explains every smaller ratio.
        """
        if self.multiplies:
            # Of a ratio the ends stand for something else: the tolerance of the stated value, and the
            # largest ratio (`wrong_values`).
            ratio = self.parameters[0]
            sides = ratio_candidates(self, tolerance=ratio.low, largest=ratio.high)
            # At its end a ratio wants to go on: the value is not the cause, or nowhere near.
            return tuple(
                replace(side, axes=(replace(side.axes[0], edge="high" if side.grows else "low"),))
                for side in sides
            )
        return searches(self, self.parameters, signed=self.signed, grows=self.grows)

    def from_search(self, values: Mapping[str, float], sign: int) -> Change:
        """The effect at these values, the size (the first parameter) with its sign."""
        size = self.parameters[0].name
        signed = {**values, size: values[size] if self.multiplies else sign * values[size]}
        return Change(self.name, MappingProxyType(signed))

    @property
    def id(self) -> str:
        """Its name, as `plant.effects.search_space.EffectKind` calls it."""
        return self.name


# Largest factor that a stated value is looked for to be wrong by: who is wrong by more has another machine.
_LARGEST_RATIO = 10.0
# Relative tolerance from which on nothing is known of a value, and so it is not wrong.
_KNOWS_NOTHING = 1.0


def wrong_values(tolerances: Mapping[str, float]) -> tuple[PlantEffect, ...]:
    """Effects "wrong_NAME", a ratio, of stated values that may be wrong by several of their tolerances.

    From how many tolerances on a ratio is sought, `ratio_candidates` says (three); the lower end of the
    effect's parameter holds the tolerance. tolerances : name -> relative standard deviation; a value of which
    nothing is known (1 or more) has no such effect.
    """
    return tuple(
        PlantEffect(f"wrong_{key}", (EffectParameter("ratio", tolerance, _LARGEST_RATIO),), multiplies=key)
        for key, tolerance in tolerances.items()
        if tolerance < _KNOWS_NOTHING
    )


def name_with_unit(parameter: EffectParameter, units: Mapping[str, str]) -> str:
    """Name of a parameter with the unit of its quantity behind it, as names of parameters have it.

    Parameters
    ----------
    parameter : EffectParameter
        In numbers (`EffectParameter.at`), so that its quantity is known.
    units : mapping
        Magnitude (force, position, speed, input, output, reading) -> unit as names have it: "N", "m_s". The
        unit of a speed is that of the position over s.

    Returns
    -------
    str
        "coefficient" of force/speed with N and m as "coefficient_Ns_m", "rate_per_s" of input/duration_s as
        "rate_N_s"; the name itself where a unit is not known, or it ends with one already.
    """
    size, *per = parameter.quantity.split("/")
    if parameter.quantity in ("", "dt_s") or not units.get(size):
        return parameter.name
    above = units[size]
    below = ""
    for part in per:
        magnitude, _, exponent = part.partition("^")
        if magnitude == "duration_s":
            below += "_s"
            continue
        # A speed below is a time above.
        if magnitude == "speed":
            above += f"s{exponent}"
        length = units.get("position", "")
        if not length:
            return parameter.name
        below += f"_{length}{exponent}"
    name = f"{parameter.name.removesuffix('_per_s')}_{above}{below}"
    # A rate of a speed is per second squared.
    return name.replace("_s_s", "_s2")
