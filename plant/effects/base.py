"""What an effect is: a small frozen object with physical parameters that changes a machine's description.

A class per effect (`plant.effects.actuator`, `joint`, `link`, `sensor`) states what it is called, where it
acts (`law`), what it may be mistaken for and where a search looks for it (`sought`); `register` puts it on
the list. `Effect.modify` changes a machine, `Effect.candidates` makes the search spaces of a diagnosis,
`RatioEffect` is a stated value that is wrong by a factor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import mul
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, TypeVar, cast

import numpy as np
from pydantic import BaseModel, ConfigDict

from plant.effects.search_space import (
    Axis,
    Candidate,
    Dependence,
    EffectKind,
    EffectParameter,
    Harmonic,
    Scales,
    log_axis,
    searches,
)
from plant.machine import Machine, Real
from plant.rig import NotNegative as NotNegative, Positive as Positive, Rig

Group = Literal["actuator", "joint", "link", "sensor"]
Part = Literal["rig", "voltage", "joint", "sensor"]

# A ratio closer to one than this many tolerances of the value it multiplies is not significant: three
# standard deviations. Doubled, a fault has to be twice as large to be looked for.
_LEAST_TOLERANCES = 3.0
# Nearly all ratios are within so many tolerances: who states a value to 5 % is seldom wrong by a factor of
# ten. Doubled, the prior density of a usual fault halves.
USUAL_TOLERANCES = 30.0
# Distance of a ratio from one, in its logarithm, below which it is not looked for where the value has no
# tolerance: far below what records show.
_LEAST_RATIO = 1e-6
# Starts of a search, distances of a ratio from one in its logarithm: 2 % to a factor of five, each in reach
# of the next.
_RATIO_STARTS = (0.02, 0.1, 0.3, 0.7, 1.6)
# A search below one begins no further from it than at this ratio, however wide the tolerance is.
_LOWEST_FIRST_RATIO = 0.2


class Effect(BaseModel):
    """One deviation of a machine from its nominal rig.

    A subclass has its parameters as fields, SI units in their names, with bounds; its docstring states the
    equation. An instance is frozen; effects commute, because every one changes fields of its own or
    multiplies. Everything else that is known about an effect stands in its class; `@register` lists it.

    id : str. Name in the registry and in configuration files.
    words : str. Its name in a sentence.
    check : str or None. What a mechanic can do to see whether it is there: a command in a sentence.
    group : str
        Where it acts: actuator, joint, link or sensor. The name of its module, unless the class states one.
    neutral : mapping or None. Parameter values at which the effect vanishes exactly, zero for those not
        named; None if there are none within the bounds.
    dependence : str
        How the outputs depend on the parameters: smooth (differentiable), continuous, or non-smooth.
    environment : bool. It comes from outside the machine.
    friction : bool
        It takes energy at the joint: closed loops are also tried without it and with twice its torques.
    multiplies : str or None
        Key of the stated value that its ratio multiplies, whose tolerance may explain it as well.
    law : (part of the machine, name of what is there, how it changes) or None
        Two numbers make another one; a class makes a part of the parameters by name, a `partial` one of their
        values.
    harmonic : str or None
        The torque is a sine of the hub angle or of time: amplitude and phase follow by linear least squares.
    look_alike_of : str or None
        Not an answer of a diagnosis, but what the effect of this id may be mistaken for.
    beside : str or None
        What looks like it, is not on the list, and what would tell them apart: the end of a sentence.
    adds_to : str or None. Key of the stated value that it adds to.
    contains : str or None. Simpler effect that it is with its further parameters at an end of their ranges.
    absolute_angle : bool. It depends on the true hub angle: where an encoder has its zero matters.
    sought : tuple of EffectParameter. Where to look for its parameters, in multiples of the `Scales`; others
        have `candidates` of their own. signed : the first may be negative as well; grows : see `Candidate`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    id: ClassVar[str]
    words: ClassVar[str]
    check: ClassVar[str | None] = None
    group: ClassVar[Group]
    neutral: ClassVar[Mapping[str, float] | None] = MappingProxyType({})
    dependence: ClassVar[Dependence] = "smooth"
    environment: ClassVar[bool] = False
    friction: ClassVar[bool] = False
    multiplies: ClassVar[str | None] = None
    law: ClassVar[tuple[Part, str, Callable[..., Any]] | None] = None
    harmonic: ClassVar[Harmonic | None] = None
    look_alike_of: ClassVar[str | None] = None
    beside: ClassVar[str | None] = None
    adds_to: ClassVar[str | None] = None
    contains: ClassVar[str | None] = None
    absolute_angle: ClassVar[bool] = False
    sought: ClassVar[tuple[EffectParameter, ...]] = ()
    signed: ClassVar[bool] = False
    grows: ClassVar[bool] = True

    def modify(self, machine: Machine) -> Machine:
        """The machine with this effect, by its law, or with its ratio times the value that it multiplies.

        A law names a part of the machine, what stands there, and how it changes; see the class. Raises
        ValueError where the rig refuses the new value.
        """
        part, name, change = self.law or ("rig", str(self.multiplies), mul)
        values = self.parameters()
        if part == "rig":
            new_value = change(machine.rig.value(name), *values.values())
            return replace(machine, rig=machine.rig.perturbed({name: new_value}))
        path = getattr(machine, part)
        present = getattr(path, name)
        new: Any
        if isinstance(change, type):
            new = change(**values)
        elif isinstance(change, partial):
            new = change(tuple(values.values()))
        else:
            new = change(present, *values.values())
        # Of frictions, torques and disturbances a machine has any number, of springs one of each kind.
        is_component = isinstance(change, type | partial)
        if is_component and isinstance(present, tuple):
            new = (*present, new)
        return replace(machine, **{part: replace(path, **{name: new})})

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """Where to look for the effect; none for one that no fit can find.

        scales : Scales
            Magnitudes of rig and records, in which `sought` states its ranges.
        """
        if not cls.sought:
            return ()
        parameters = [parameter.at(scales) for parameter in cls.sought]
        return searches(cls, parameters, signed=cls.signed, grows=cls.grows)

    @classmethod
    def from_search(cls, values: Mapping[str, float], sign: int) -> Self:
        """The effect at the values of the search's axes, by name; sign: which side of a signed size."""
        if not cls.signed:
            return cls(**values)
        size_name = next(iter(cls.model_fields))
        return cls(**{**values, size_name: sign * values[size_name]})

    @property
    def as_listed(self) -> bool:
        """Whether the effect is what is listed by its name, at these parameters."""
        return True

    def simpler(self) -> Effect | None:
        """The effect that this one becomes without its further parameters; None where there is none."""
        return None

    @classmethod
    def look_alike_scale(cls, rig: Rig) -> float:
        """Size of this effect per size of the one it looks like (`look_alike_of`)."""
        return 1.0

    @classmethod
    def in_place_of(cls, other: Candidate, x: Real, rig: Rig) -> Candidate:
        """Search of this effect from where that of the one that it looks like ended.

        other : Candidate
            Search of the effect that this one looks like; its first axis is the size, on a logarithmic scale.
        x : (A,)
            Its coordinates in the end.
        """
        scale = cls.look_alike_scale(rig)
        other_axis = other.axes[0]
        size_name = next(iter(cls.model_fields))
        axis = log_axis(size_name, other_axis.low * scale, other_axis.high * scale, other_axis.step)
        start = float(x[0] + np.log(scale))
        return Candidate(cls, (axis,), ((start,),))

    def parameters(self) -> dict[str, float]:
        """Parameter values by name."""
        return {name: float(getattr(self, name)) for name in type(self).model_fields}

    def to_dict(self) -> dict[str, Any]:
        """{"name": id, parameter: value, ...}, the form `parse_effect` reads."""
        return {"name": type(self).id, **self.parameters()}

    @classmethod
    def _candidate(
        cls,
        axes: Sequence[Axis],
        points: Iterable[Sequence[float]] = (),
        *,
        grows: bool = True,
    ) -> Candidate:
        """A search that starts from these points, given in the units of the axes' parameters."""
        starts = []
        for point in points:
            coordinates = [axis.coordinate(value) for axis, value in zip(axes, point, strict=True)]
            starts.append(tuple(coordinates))
        return Candidate(cls, tuple(axes), tuple(starts), grows=grows)


# Classes by id, in the order of their registration: effects that a diagnosis may answer.
EFFECTS: dict[str, type[Effect]] = {}
# Classes by id of what is no answer, but what an effect may be mistaken for.
LOOK_ALIKES: dict[str, type[Effect]] = {}

E = TypeVar("E", bound=Effect)


def register(kind: type[E]) -> type[E]:
    """Class decorator: the effect can be configured and diagnosed by its id (look-alikes: only diagnosed).

    Its group is the name of its module, unless it states one.

    Raises TypeError for a ratio without a stated value that it multiplies or a `modify` of its own, and for
    an effect without id or words: the pages need them.
    """
    missing = [name for name in ("id", "words") if not hasattr(kind, name)]
    if missing:
        raise TypeError(f"effect {kind.__name__}: state its {' and '.join(missing)} in the class")
    if kind.modify is Effect.modify and not (kind.law or kind.multiplies):
        raise TypeError(f"{kind.id} neither acts on a value nor multiplies one: it needs its own modify")
    if not hasattr(kind, "group"):
        kind.group = cast(Group, kind.__module__.rpartition(".")[2])
    if kind.look_alike_of:
        LOOK_ALIKES[kind.id] = kind
    else:
        EFFECTS[kind.id] = kind
    return kind


class RatioEffect(Effect):
    """A stated value (`multiplies`) times a ratio."""

    neutral = MappingProxyType({"ratio": 1.0})
    # A search goes from one over this to this: who is wrong by more has another machine. Chosen.
    largest_ratio: ClassVar[float] = 10.0

    ratio: NotNegative

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """Searches above and below one, see `ratio_candidates`."""
        return ratio_candidates(cls, scales.tolerance(cls.multiplies), cls.largest_ratio)


def ratio_candidates(kind: EffectKind, tolerance: float, largest: float) -> tuple[Candidate, ...]:
    """Searches of a ratio on both sides of one, from where the stated value's tolerance no longer explains
    it.

    Parameters
    ----------
    kind : EffectKind
        The effect, whose only parameter is named "ratio".
    tolerance : float
        Relative standard deviation of the stated value, 0 where it is exact.
    largest : float
        Ratio where the search ends; one over it on the other side.

    Returns
    -------
    tuple of Candidate
        Above one, then below; the second is missing for a tolerance that explains every smaller ratio.
    """
    least = max(_LEAST_RATIO, _LEAST_TOLERANCES * tolerance)
    starts = np.array(_RATIO_STARTS)
    is_significant = starts > least
    # Where none of them is, a little beyond what the tolerance explains.
    starts = starts[is_significant] if np.any(is_significant) else np.array([1.2 * least])
    usual_ratio = 1 + USUAL_TOLERANCES * tolerance
    usual_above = None
    if tolerance > 0:
        usual_above = (1 + least, usual_ratio)
    axis_above = log_axis("ratio", 1 + least, largest, usual=usual_above)
    starts_above = tuple((float(start),) for start in starts)
    sides = [Candidate(kind, (axis_above,), starts_above)]
    if least < 1:
        below = max(1 - least, _LOWEST_FIRST_RATIO)
        usual_below = None
        if tolerance > 0:
            usual_below = (1 / usual_ratio, below)
        axis_below = log_axis("ratio", 1 / largest, below, usual=usual_below)
        mirrored = np.minimum(-starts, np.log(below))
        starts_below = tuple((float(start),) for start in mirrored)
        sides.append(Candidate(kind, (axis_below,), starts_below, sign=-1, grows=False))
    return tuple(sides)


def alone(present: object, value: float) -> float:
    """The value that an effect brings, whatever is present without it: a law of effects that never add up."""
    return value
