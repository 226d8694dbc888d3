"""Where to look for an effect: coordinates with ranges, usual sizes and starts, made of a rig's magnitudes.

Ranges are wide on purpose: three decades and more, in units that come from the rig and the records (stall
torque, link mass, record length), so that no number belongs to one arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from operator import attrgetter
from typing import Any, Literal, Protocol

import numpy as np

from plant.machine import Real
from plant.rig import Rig

Scale = Literal["log", "linear", "angle"]
Dependence = Literal["smooth", "continuous", "non-smooth"]
Harmonic = Literal["hub_angle", "time"]

# Share of all cases in which a size lies in its usual range, where one is stated.
_USUAL_SHARE = 0.9


@dataclass(frozen=True)
class Axis:
    """One coordinate of a search: parameter, scale, range, and a step for difference quotients.

    `low` and `high` are in the parameter's unit; the coordinate is its logarithm on a "log" axis. Its prior
    is flat over the range; with `usual` (low, high) nine tenths of it lie there. edge: at this end records no
    longer show what makes the effect this one (a period never completed, a value that wants to go on).
    """

    parameter: str
    scale: Scale
    low: float
    high: float
    step: float
    edge: Literal["", "low", "high"] = ""
    usual: tuple[float, float] | None = None

    def at_edge(self, coordinate: float) -> bool:
        """Whether the effect has turned into something else that happens to look like it (see `edge`)."""
        value = self.value(coordinate)
        return {"": False, "low": value < 1.01 * self.low, "high": value > 0.99 * self.high}[self.edge]

    def coordinate(self, value: float) -> float:
        return float(np.log(value)) if self.scale == "log" else float(value)

    def value(self, coordinate: float) -> float:
        if self.scale == "angle":
            return float(self.low + np.mod(coordinate - self.low, 2 * np.pi))
        return float(np.exp(coordinate)) if self.scale == "log" else float(coordinate)

    @property
    def box(self) -> tuple[float, float]:
        """Bounds of the coordinate; an angle has none."""
        if self.scale == "angle":
            return -np.inf, np.inf
        return self.coordinate(self.low), self.coordinate(self.high)

    def log_density(self, coordinate: float) -> float:
        """log of the prior density of the coordinate, inside the box."""
        if self.scale == "angle":
            return float(-np.log(2 * np.pi))
        low, high = self.box
        if self.usual is None:
            return float(-np.log(high - low))
        begin, end = np.clip([self.coordinate(v) for v in self.usual], low, high)
        within, beyond = end - begin, high - low - (end - begin)
        if not min(within, beyond) > 0:
            return float(-np.log(high - low))
        inside = begin <= coordinate <= end
        return float(np.log(_USUAL_SHARE / within if inside else (1 - _USUAL_SHARE) / beyond))


def log_axis(
    parameter: str, low: float, high: float, step: float = 1e-5, usual: tuple[float, float] | None = None
) -> Axis:
    return Axis(parameter, "log", low, high, step, usual=usual)


PHASE = Axis("phase_rad", "angle", 0.0, 2 * np.pi, 1e-4)


def geometric(low: float, high: float, count: int) -> list[float]:
    return [float(v) for v in np.geomspace(low, high, count)]


class EffectKind(Protocol):
    """What a search asks of an effect; a class of `plant.effects` or an effect of one's own plant answers."""

    @property
    def id(self) -> str: ...

    @property
    def dependence(self) -> Dependence: ...

    @property
    def multiplies(self) -> str | None: ...

    @property
    def harmonic(self) -> Harmonic | None: ...

    @property
    def adds_to(self) -> str | None: ...

    @property
    def contains(self) -> str | None: ...

    @property
    def absolute_angle(self) -> bool: ...

    def from_search(self, values: Mapping[str, float], sign: int) -> Any:
        """The effect at the values of the axes; it has `parameters()`."""


@dataclass(frozen=True)
class Candidate:
    """One effect (or one side of it: a ratio above or below 1) as a search space.

    kind : EffectKind
    axes : tuple of Axis
        The first one is the size; larger coordinates mean a larger effect if `grows`, smaller ones otherwise.
    starts : (S, A) tuple of coordinates
    sign : +1 or -1. Of a signed size (ratio - 1, drift).
    """

    kind: EffectKind
    axes: tuple[Axis, ...]
    starts: tuple[tuple[float, ...], ...]
    sign: int = 1
    grows: bool = True

    @property
    def effect(self) -> str:
        return self.kind.id

    @property
    def dependence(self) -> Dependence:
        """How the outputs depend on the effect's parameters."""
        return self.kind.dependence

    def effect_at(self, x: Real) -> Any:
        """The effect at the coordinates x (A,)."""
        values = {axis.parameter: axis.value(v) for axis, v in zip(self.axes, x, strict=True)}
        return self.kind.from_search(values, self.sign)

    def parameters(self, x: Real) -> dict[str, float]:
        """Parameter values of the effect at the coordinates x (A,)."""
        return dict(self.effect_at(x).parameters())

    def at_edge(self, x: Real) -> bool:
        """Whether a coordinate of x (A,) is where the effect cannot be told from others any more."""
        return any(axis.at_edge(v) for axis, v in zip(self.axes, x, strict=True))

    @cached_property
    def box(self) -> tuple[Real, Real]:
        """Bounds (A,), (A,) of the coordinates."""
        low, high = zip(*(axis.box for axis in self.axes), strict=True)
        return np.array(low), np.array(high)

    def log_density(self, x: Real) -> float:
        """log of the prior density of the coordinates x (A,)."""
        return sum(axis.log_density(v) for axis, v in zip(self.axes, x, strict=True))

    def from_size(self, smallest: float) -> Candidate:
        """The same candidate with its size no smaller than this coordinate of its first axis."""
        axis = self.axes[0]
        value = axis.value(smallest)
        if self.grows:
            axis = replace(axis, low=min(max(value, axis.low), 0.99 * axis.high + 0.01 * axis.low))
        else:
            axis = replace(axis, high=max(min(value, axis.high), 1.01 * axis.low))
        return replace(self, axes=(axis, *self.axes[1:]))


@dataclass(frozen=True)
class Scales:
    """Magnitudes of a rig and its records that ranges are made of."""

    rig: Rig
    voltage_V: float
    angle_rad: float
    swing_rad: float
    speed_rad_s: float
    duration_s: float
    # Of gravity, where an output tells where the hub angle is zero.
    any_direction: bool = False

    @property
    def dt_s(self) -> float:
        return self.rig.sampling.dt_s

    @property
    def torque_Nm(self) -> float:
        """Stall torque at the largest voltage of the records."""
        return self.rig.motor.torque_per_volt_Nm_V * self.voltage_V

    @property
    def link_mass_kg(self) -> float:
        return self.rig.link.mass_per_length_kg_m * self.rig.link.length_m

    @property
    def link_stiffness_Nm_rad(self) -> float:
        return 3 * self.rig.link.bending_stiffness_Nm2 / self.rig.link.length_m

    def tolerance(self, key: str | None) -> float:
        """Relative standard deviation of a stated value, 0 where it is exact."""
        return 0.0 if key is None else self.rig.tolerances.get(key, 0.0)


# Steps of difference quotients, where a parameter states none: dry friction creeps and backlash jumps.
_STEPS: Mapping[Dependence, float] = {"smooth": 1e-5, "continuous": 1e-3, "non-smooth": 5e-3}


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect: range, and values a search starts from.

    name : str. With its unit.
    low, high : float
        On a "log" scale both above zero; the size of an effect is positive, also of a signed one.
    starts : tuple of float
        Without any: eight over the range for an effect's size, three for what follows, inside the range.
    unit : str
        Magnitude of machine and records that all of these are multiples of (`at`): a name, or a name over
        others ("force/speed^2"); "": none is.
    spread : (first, last, count) or None. In place of starts: so many from first to last, in equal ratios.
    most : str. Name of a magnitude that `high` does not go beyond, a multiple of the unit as well.
    step : float or None. See `Axis`; None: by how outputs depend on the effect.
    """

    name: str
    low: float
    high: float
    starts: tuple[float, ...] = ()
    scale: Scale = "log"
    unit: str = ""
    spread: tuple[float, float, int] | None = None
    most: str = ""
    step: float | None = None

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

    def at(self, magnitudes: object) -> EffectParameter:
        """In units of its own: magnitudes has an attribute for every name."""
        above, *below = self.unit.split("/")
        one = attrgetter(above)(magnitudes) if above else 1.0
        for name, _, power in (part.partition("^") for part in below):
            one = one / attrgetter(name)(magnitudes) ** int(power or 1)
        most = min(self.high, getattr(magnitudes, self.most)) if self.most else self.high
        return replace(self, high=most, unit="", most="").times(one)

    def times(self, one: float) -> EffectParameter:
        """In multiples of a magnitude."""
        high, starts = one * self.high, tuple(one * v for v in self.starts)
        if self.spread is not None:
            first, last, count = self.spread
            starts = tuple(geometric(one * first, min(one * last, high), count))
        return replace(self, low=one * self.low, high=high, starts=starts, spread=None)

    def axis(self, dependence: Dependence) -> Axis:
        step = _STEPS[dependence] if self.step is None else self.step
        return Axis(self.name, self.scale, self.low, self.high, step)

    def start_coordinates(self, count: int) -> list[float]:
        axis = self.axis("smooth")
        if self.starts:
            return [axis.coordinate(v) for v in self.starts]
        low, high = axis.box
        return [low + (high - low) * (k + 1) / (count + 1) for k in range(count)]


def searches(
    kind: EffectKind, parameters: Sequence[EffectParameter], *, signed: bool = False, grows: bool = True
) -> tuple[Candidate, ...]:
    """Searches of an effect from every combination of its parameters' starts, a signed one on both sides."""
    axes = tuple(p.axis(kind.dependence) for p in parameters)
    counts = [8, *[3] * (len(axes) - 1)]
    values = [p.start_coordinates(n) for p, n in zip(parameters, counts, strict=True)]
    signs = (1, -1) if signed else (1,)
    return tuple(Candidate(kind, axes, tuple(product(*values)), sign, grows) for sign in signs)
