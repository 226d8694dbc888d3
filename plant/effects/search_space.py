"""Where to look for an effect: coordinates with ranges, usual sizes and starts, made of a rig's magnitudes.

Ranges are wide on purpose: three decades and more, in units that come from the rig and the records (stall
torque, link mass, record length), so that no number belongs to one arm.

An effect's class states `EffectParameter`s in multiples of `Scales`; `searches` makes `Candidate`s of them,
one for each sign. A candidate has an `Axis` per parameter, whose coordinate is the parameter or its
logarithm, and the prior density over it.
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

# Share of all cases in which a size lies in its usual range, where one is stated. Beyond it is one case in
# ten: a size there then needs the more evidence, the wider the range is.
_USUAL_SHARE = 0.9
# Within this share of its end a value has gone to the edge of its range: a descent stops a little before it.
_EDGE_SHARE = 0.01
# Searches of a size start from so many points over its range, about one in every half decade of the usual
# four.
_SIZE_STARTS = 8
# Searches of a further parameter start at a quarter, at half and at three quarters of its range. Both chosen.
_FURTHER_STARTS = 3


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
        if self.edge == "low":
            return value < (1 + _EDGE_SHARE) * self.low
        if self.edge == "high":
            return value > (1 - _EDGE_SHARE) * self.high
        return False

    def coordinate(self, value: float) -> float:
        """Coordinate of a value in the parameter's unit: its logarithm on a "log" axis, else itself."""
        if self.scale == "log":
            return float(np.log(value))
        return float(value)

    def value(self, coordinate: float) -> float:
        """Value of a coordinate in the parameter's unit; an angle is turned back into its range."""
        if self.scale == "angle":
            return float(self.low + np.mod(coordinate - self.low, 2 * np.pi))
        if self.scale == "log":
            return float(np.exp(coordinate))
        return float(coordinate)

    @property
    def box(self) -> tuple[float, float]:
        """Bounds of the coordinate; an angle has none."""
        if self.scale == "angle":
            return -np.inf, np.inf
        return self.coordinate(self.low), self.coordinate(self.high)

    def log_density(self, coordinate: float) -> float:
        """Logarithm of the prior density of the coordinate, which is taken to be inside the box.

        The density is flat; with a usual range it has two levels, `_USUAL_SHARE` of the whole inside.
        """
        if self.scale == "angle":
            return float(-np.log(2 * np.pi))
        low, high = self.box
        flat = float(-np.log(high - low))
        if self.usual is None:
            return flat
        begin, end = np.clip([self.coordinate(value) for value in self.usual], low, high)
        width_inside = end - begin
        width_outside = high - low - width_inside
        # A usual range that is empty, or the whole, says nothing.
        if not min(width_inside, width_outside) > 0:
            return flat
        density = (1 - _USUAL_SHARE) / width_outside
        if begin <= coordinate <= end:
            density = _USUAL_SHARE / width_inside
        return float(np.log(density))


def log_axis(
    parameter: str, low: float, high: float, step: float = 1e-5, usual: tuple[float, float] | None = None
) -> Axis:
    """Axis of a positive parameter whose coordinate is its logarithm; step in the coordinate."""
    return Axis(parameter, "log", low, high, step, usual=usual)


# Axis of a phase over a whole turn. Outputs are smooth in it, and a step of 1e-4 rad is far above rounding.
PHASE = Axis("phase_rad", "angle", 0.0, 2 * np.pi, 1e-4)


def geometric(low: float, high: float, count: int) -> list[float]:
    """Numbers from low to high, both included, each the same multiple of the one before."""
    return [float(value) for value in np.geomspace(low, high, count)]


class EffectKind(Protocol):
    """What a search asks of an effect; a class of `plant.effects` or an effect of one's own plant answers."""

    @property
    def id(self) -> str:
        """Name of the effect in the registry and in files."""

    @property
    def dependence(self) -> Dependence:
        """How outputs depend on the parameters."""

    @property
    def multiplies(self) -> str | None:
        """Key of the stated value that a ratio multiplies, or None."""

    @property
    def harmonic(self) -> Harmonic | None:
        """What the torque is a sine of, or None."""

    @property
    def adds_to(self) -> str | None:
        """Key of the stated value that it adds to, or None."""

    @property
    def contains(self) -> str | None:
        """Id of a simpler effect that this one may become, or None."""

    @property
    def absolute_angle(self) -> bool:
        """Whether the zero of the hub angle matters."""

    def from_search(self, values: Mapping[str, float], sign: int) -> Any:
        """The effect at the values of the axes; it has `parameters()`."""


@dataclass(frozen=True)
class Candidate:
    """One effect (or one side of it: a ratio above or below 1) as a search space.

    kind : EffectKind
        The effect's class: its id and how outputs depend on it.
    axes : tuple of Axis
        The first one is the size; larger coordinates mean a larger effect if `grows`, smaller ones otherwise.
    starts : (S, A) tuple of coordinates
        Points that searches start from.
    sign : +1 or -1. Side of a signed size (ratio - 1, drift).
    """

    kind: EffectKind
    axes: tuple[Axis, ...]
    starts: tuple[tuple[float, ...], ...]
    sign: int = 1
    grows: bool = True

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.kind.id

    @property
    def dependence(self) -> Dependence:
        """How the outputs depend on the effect's parameters."""
        return self.kind.dependence

    def effect_at(self, x: Real) -> Any:
        """The effect at the coordinates x (A,)."""
        values = {}
        for axis, coordinate in zip(self.axes, x, strict=True):
            values[axis.parameter] = axis.value(coordinate)
        return self.kind.from_search(values, self.sign)

    def parameters(self, x: Real) -> dict[str, float]:
        """Parameter values of the effect at the coordinates x (A,)."""
        return dict(self.effect_at(x).parameters())

    def at_edge(self, x: Real) -> bool:
        """Whether a coordinate of x (A,) is where the effect cannot be told from others any more."""
        pairs = zip(self.axes, x, strict=True)
        return any(axis.at_edge(coordinate) for axis, coordinate in pairs)

    @cached_property
    def box(self) -> tuple[Real, Real]:
        """Bounds (A,), (A,) of the coordinates."""
        low, high = zip(*(axis.box for axis in self.axes), strict=True)
        return np.array(low), np.array(high)

    def log_density(self, x: Real) -> float:
        """Logarithm of the prior density of the coordinates x (A,); parameters are independent."""
        pairs = zip(self.axes, x, strict=True)
        return sum(axis.log_density(coordinate) for axis, coordinate in pairs)

    def from_size(self, smallest: float) -> Candidate:
        """This candidate with its size no smaller than this coordinate of its first axis.

        A small remainder of the range is left, so that a search has something to search in.
        """
        axis = self.axes[0]
        value = axis.value(smallest)
        if self.grows:
            highest_low = 0.99 * axis.high + 0.01 * axis.low
            axis = replace(axis, low=min(max(value, axis.low), highest_low))
        else:
            lowest_high = 1.01 * axis.low
            axis = replace(axis, high=max(min(value, axis.high), lowest_high))
        return replace(self, axes=(axis, *self.axes[1:]))


@dataclass(frozen=True)
class Scales:
    """Magnitudes of a rig and its records that ranges are made of.

    rig : Rig
    voltage_V, angle_rad, speed_rad_s : float. Largest ones of the records.
    swing_rad : float. Range of the hub angle.
    duration_s : float. Of the longest record.
    any_direction : bool. Gravity may have any direction: an output tells where the hub angle is zero.
    """

    rig: Rig
    voltage_V: float
    angle_rad: float
    swing_rad: float
    speed_rad_s: float
    duration_s: float
    any_direction: bool = False

    @property
    def dt_s(self) -> float:
        """Sampling period, s."""
        return self.rig.sampling.dt_s

    @property
    def torque_Nm(self) -> float:
        """Stall torque at the largest voltage of the records."""
        return self.rig.motor.torque_per_volt_Nm_V * self.voltage_V

    @property
    def link_mass_kg(self) -> float:
        """Mass of the link without its payload, kg."""
        return self.rig.link.mass_per_length_kg_m * self.rig.link.length_m

    @property
    def link_stiffness_Nm_rad(self) -> float:
        """Torque at the clamp per angle to the tip, 3 E I / L, under a force at the tip, N m/rad."""
        return 3 * self.rig.link.bending_stiffness_Nm2 / self.rig.link.length_m

    def tolerance(self, key: str | None) -> float:
        """Relative standard deviation of a stated value, 0 where it is exact."""
        return 0.0 if key is None else self.rig.tolerances.get(key, 0.0)


# Steps of difference quotients in a coordinate, where a parameter states none: dry friction creeps and
# backlash jumps, so that a small step would measure only how switching instants are rounded.
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
    quantity : str. The unit of a parameter that `at` has put in numbers, for words: "force/speed^2".
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
    quantity: str = ""

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
        """This parameter in units of its own: its unit becomes a number.

        magnitudes : object
            With an attribute for every name in the unit, and for `most`; of the listed effects a `Scales`.
        """
        numerator, *denominators = self.unit.split("/")
        unit = attrgetter(numerator)(magnitudes) if numerator else 1.0
        for factor in denominators:
            name, _, power = factor.partition("^")
            unit = unit / attrgetter(name)(magnitudes) ** int(power or 1)
        high = self.high
        if self.most:
            high = min(high, getattr(magnitudes, self.most))
        return replace(self, high=high, unit="", most="", quantity=self.unit).times(unit)

    def times(self, magnitude: float) -> EffectParameter:
        """This parameter with its range and starts multiplied by a magnitude; a spread becomes starts."""
        high = magnitude * self.high
        starts = tuple(magnitude * start for start in self.starts)
        if self.spread is not None:
            first, last, count = self.spread
            starts = tuple(geometric(magnitude * first, min(magnitude * last, high), count))
        return replace(self, low=magnitude * self.low, high=high, starts=starts, spread=None)

    def axis(self, dependence: Dependence) -> Axis:
        """Axis of the search; without a stated step it has that of the effect's dependence."""
        step = _STEPS[dependence] if self.step is None else self.step
        return Axis(self.name, self.scale, self.low, self.high, step)

    def start_coordinates(self, count: int) -> list[float]:
        """Coordinates that searches start from: of the stated values, or `count` evenly inside the range."""
        axis = self.axis("smooth")
        if self.starts:
            return [axis.coordinate(start) for start in self.starts]
        low, high = axis.box
        return [low + (high - low) * (k + 1) / (count + 1) for k in range(count)]


def searches(
    kind: EffectKind, parameters: Sequence[EffectParameter], *, signed: bool = False, grows: bool = True
) -> tuple[Candidate, ...]:
    """Searches of an effect from every combination of its parameters' starts, a signed one on both sides.

    Parameters
    ----------
    kind : EffectKind
        The effect.
    parameters : sequence of EffectParameter
        In units of their own (`EffectParameter.at`), the size first.
    signed : bool
        The size may be negative as well.
    grows : bool
        A larger size is a larger effect.

    Returns
    -------
    tuple of Candidate
        One, or one for each sign.
    """
    axes = tuple(parameter.axis(kind.dependence) for parameter in parameters)
    counts = [_SIZE_STARTS] + [_FURTHER_STARTS] * (len(axes) - 1)
    coordinates = [
        parameter.start_coordinates(count) for parameter, count in zip(parameters, counts, strict=True)
    ]
    starts = tuple(product(*coordinates))
    signs = (1, -1) if signed else (1,)
    return tuple(Candidate(kind, axes, starts, sign, grows) for sign in signs)
