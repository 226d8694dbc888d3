"""Where to look for an effect: coordinates with ranges, usual sizes and starts, made of a rig's magnitudes.

Ranges are wide on purpose: three decades and more, in units that come from the rig and the records (stall
torque, link mass, record length), so that no number belongs to one arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
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


@dataclass(frozen=True)
class Sought:
    """Where to look for a single size, larger where the effect is (unless not `grows`).

    ends: of its range, starts: (first, last, count), both in the `Scales` called unit, or as they are. step:
    see `Axis`.
    """

    ends: tuple[float, float]
    starts: tuple[float, float, int]
    unit: Literal["dt_s", "voltage_V", "torque_Nm", "link_mass_kg"] | None = None
    step: float = 1e-5
    grows: bool = True

    def at(self, parameter: str, scales: Scales) -> tuple[Axis, list[float]]:
        """Axis of the parameter, and values to start from."""
        one = 1.0 if self.unit is None else getattr(scales, self.unit)
        (low, high), (first, last, count) = self.ends, self.starts
        return log_axis(parameter, low * one, high * one, self.step), geometric(
            first * one, last * one, count
        )
