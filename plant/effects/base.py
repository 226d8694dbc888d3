"""What an effect is: a small frozen object with physical parameters that changes a machine's description."""

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

# A ratio closer to one than this many tolerances of the value it multiplies is not significant; nearly all
# are within so many tolerances: who states a value to 5 % is seldom wrong by a factor of ten.
_LEAST_TOLERANCES, USUAL_TOLERANCES = 3.0, 30.0


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
        """The machine with this effect, by its law or times the ratio."""
        part, name, how = self.law or ("rig", str(self.multiplies), mul)
        values = self.parameters()
        if part == "rig":
            size = how(machine.rig.value(name), *values.values())
            return replace(machine, rig=machine.rig.perturbed({name: size}))
        whole = getattr(machine, part)
        there = getattr(whole, name)
        if isinstance(how, type | partial):
            own = how(**values) if isinstance(how, type) else how(tuple(values.values()))
            found = (*there, own) if isinstance(there, tuple) else own
        else:
            found = how(there, *values.values())
        return replace(machine, **{part: replace(whole, **{name: found})})

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        """Where to look for the effect; none for one that no fit can find."""
        if not cls.sought:
            return ()
        return searches(cls, [p.at(scales) for p in cls.sought], signed=cls.signed, grows=cls.grows)

    @classmethod
    def from_search(cls, values: Mapping[str, float], sign: int) -> Self:
        """The effect at the values of the search's axes; sign: which side of a signed size."""
        size = next(iter(cls.model_fields))
        return cls(**{**values, size: sign * values[size]} if cls.signed else values)

    @property
    def as_listed(self) -> bool:
        """Whether it is what is listed by its name, at these parameters."""
        return True

    def simpler(self) -> Effect | None:
        """The effect that this one becomes without its further parameters."""
        return None

    @classmethod
    def look_alike_scale(cls, rig: Rig) -> float:
        """Size of this effect per size of the one it looks like (`look_alike_of`)."""
        return 1.0

    @classmethod
    def in_place_of(cls, other: Candidate, x: Real, rig: Rig) -> Candidate:
        """Search of this effect from where the one that it looks like ended, at the coordinates x (A,)."""
        scale, axis = cls.look_alike_scale(rig), other.axes[0]
        size = log_axis(next(iter(cls.model_fields)), axis.low * scale, axis.high * scale, axis.step)
        return Candidate(cls, (size,), ((float(x[0] + np.log(scale)),),))

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
        starts = tuple(
            tuple(axis.coordinate(v) for axis, v in zip(axes, point, strict=True)) for point in points
        )
        return Candidate(cls, tuple(axes), starts, grows=grows)


EFFECTS: dict[str, type[Effect]] = {}
LOOK_ALIKES: dict[str, type[Effect]] = {}

E = TypeVar("E", bound=Effect)


def register(kind: type[E]) -> type[E]:
    """Class decorator: the effect can be configured and diagnosed by its id (look-alikes: only diagnosed).

    Its group is the name of its module, unless it states one.

    Raises TypeError for a ratio without a stated value that it multiplies or a `modify` of its own, and for
    an effect without id or words: the pages need them.
    """
    if missing := [name for name in ("id", "words") if not hasattr(kind, name)]:
        raise TypeError(f"effect {kind.__name__}: state its {' and '.join(missing)} in the class")
    if kind.modify is Effect.modify and not (kind.law or kind.multiplies):
        raise TypeError(f"{kind.id} neither acts on a value nor multiplies one: it needs its own modify")
    if not hasattr(kind, "group"):
        kind.group = cast(Group, kind.__module__.rpartition(".")[2])
    (LOOK_ALIKES if kind.look_alike_of else EFFECTS)[kind.id] = kind
    return kind


class RatioEffect(Effect):
    """A stated value (`multiplies`) times a ratio."""

    neutral = MappingProxyType({"ratio": 1.0})
    largest_ratio: ClassVar[float] = 10.0

    ratio: NotNegative

    @classmethod
    def candidates(cls, scales: Scales) -> tuple[Candidate, ...]:
        return ratio_candidates(cls, scales.tolerance(cls.multiplies), cls.largest_ratio)


def ratio_candidates(kind: EffectKind, tolerance: float, largest: float) -> tuple[Candidate, ...]:
    """Both sides of one, from where the tolerance of the stated value no longer explains the ratio."""
    least = max(1e-6, _LEAST_TOLERANCES * tolerance)
    points = np.array([0.02, 0.1, 0.3, 0.7, 1.6])
    points = points[points > least] if np.any(points > least) else np.array([1.2 * least])
    usual = 1 + USUAL_TOLERANCES * tolerance
    above = log_axis("ratio", 1 + least, largest, usual=(1 + least, usual) if tolerance > 0 else None)
    sides = [Candidate(kind, (above,), tuple((float(p),) for p in points))]
    below = max(1 - least, 0.2) if least < 1 else 0.0
    if below > 0:
        axis = log_axis("ratio", 1 / largest, below, usual=(1 / usual, below) if tolerance > 0 else None)
        starts = tuple((float(v),) for v in np.minimum(-points, np.log(below)))
        sides.append(Candidate(kind, (axis,), starts, sign=-1, grows=False))
    return tuple(sides)


def alone(there: object, own: float) -> float:
    """Of a value that the effect brings: whatever there is without it."""
    return own
