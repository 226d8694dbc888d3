"""What may be missing in the model: every effect of the registry with coordinates, ranges and starts.

A range is wide on purpose: three decades and more, in units that come from the rig and the records (stall
torque, link mass, record length), so that no number here belongs to one arm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from diagnosis.machine.machine_protocol import Dependence, Real
from plant.effects import EFFECTS

if TYPE_CHECKING:
    from diagnosis.machine.case import Case

Scale = Literal["log", "linear", "angle"]

# A parametric effect smaller than this many tolerances of the parameter it multiplies is no finding.
_TOLERANCES = 3.0
# The same for friction that is added to a stated value: that may be stated too large by as many.
_VISCOUS_TOLERANCES = 2.0
# Nearly all parametric effects are no larger than this many tolerances: who states a value to 5 % is seldom
# wrong by a factor of ten. Of an exact value nothing of that kind is known.
_USUAL_TOLERANCES, _USUAL_SHARE = 30.0, 0.9


@dataclass(frozen=True)
class Axis:
    """One coordinate of a search: parameter, scale, range, and a step for difference quotients.

    `low` and `high` are in the parameter's unit; the coordinate is its logarithm on a "log" axis. Its prior
    is flat over the range; with `usual` (low, high) nine tenths of it lie there. edge: at the lower end the
    records no longer show what makes the effect this one (a period never completed).
    """

    parameter: str
    scale: Scale
    low: float
    high: float
    step: float
    edge: bool = False
    usual: tuple[float, float] | None = None

    def at_edge(self, coordinate: float) -> bool:
        """Whether the effect has turned into something else that happens to look like it (see `edge`)."""
        return self.edge and self.value(coordinate) < 1.01 * self.low

    def coordinate(self, value: float) -> float:
        return float(np.log(value)) if self.scale == "log" else float(value)

    def value(self, coordinate: float) -> float:
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


@dataclass(frozen=True)
class Candidate:
    """One effect (or one side of it: a ratio above or below 1) as a search space.

    Attributes
    ----------
    effect : str
        Registry id.
    axes : tuple of Axis
        The first one is the size; larger coordinates mean a larger effect if `grows`, smaller ones otherwise.
    starts : (S, A) tuple of coordinates
    sign : +1 or -1
        Of a signed size (ratio - 1, drift).
    """

    effect: str
    axes: tuple[Axis, ...]
    starts: tuple[tuple[float, ...], ...]
    sign: int = 1
    grows: bool = True

    @property
    def label(self) -> str:
        return self.effect if self.sign > 0 else f"{self.effect} (below)"

    def parameters(self, x: Real) -> dict[str, float]:
        """Parameter values of the effect at the coordinates x (A,)."""
        values = {axis.parameter: axis.value(v) for axis, v in zip(self.axes, x, strict=True)}
        if self.effect == "stribeck_friction":
            values["coulomb_torque_Nm"] *= values["static_torque_Nm"]
        elif self.effect == "sensor_drift":
            values["rate_m_s"] *= self.sign
        elif "phase_rad" in values:
            values["phase_rad"] = float(np.mod(values["phase_rad"], 2 * np.pi))
        return values

    def at_edge(self, x: Real) -> bool:
        """Whether a coordinate of x (A,) is where the effect cannot be told from others any more."""
        return any(axis.at_edge(v) for axis, v in zip(self.axes, x, strict=True))

    @property
    def dependence(self) -> Dependence:
        """How the outputs depend on the effect's parameters."""
        return EFFECTS[self.effect].dependence

    def effect_at(self, x: Real) -> Any:
        """The effect of the machine's own kind (here: of `plant.effects`) at the coordinates x (A,)."""
        return EFFECTS[self.effect](**self.parameters(x))

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

    voltage_V: float
    torque_Nm: float
    angle_rad: float
    swing_rad: float
    speed_rad_s: float
    duration_s: float
    dt_s: float
    link_mass_kg: float
    hub_inertia_kg_m2: float
    link_stiffness_Nm_rad: float
    damping_Nms: float
    viscous_spread_Nms: float
    tip_noise_m: float

    @classmethod
    def of(cls, case: Case) -> Scales:
        rig = case.rig
        voltage = max(float(np.max(np.abs(e.voltage_V))) for e in case.experiments)
        link = rig.link
        return cls(
            voltage_V=voltage,
            torque_Nm=rig.motor.torque_per_volt_Nm_V * voltage,
            angle_rad=max(float(np.max(np.abs(e.output[:, 0]))) for e in case.experiments),
            swing_rad=max(float(np.ptp(e.output[:, 0])) for e in case.experiments),
            speed_rad_s=max(_speed(e.output[:, 0]) for e in case.experiments) / rig.sampling.dt_s,
            duration_s=max(e.voltage_V.size for e in case.experiments) * rig.sampling.dt_s,
            dt_s=rig.sampling.dt_s,
            link_mass_kg=link.mass_per_length_kg_m * link.length_m,
            hub_inertia_kg_m2=rig.hub.inertia_kg_m2,
            link_stiffness_Nm_rad=3 * link.bending_stiffness_Nm2 / link.length_m,
            damping_Nms=rig.hub.viscous_friction_Nms + rig.motor.back_emf_damping_Nms,
            viscous_spread_Nms=rig.tolerances.get("hub.viscous_friction_Nms", 0.0)
            * rig.hub.viscous_friction_Nms,
            tip_noise_m=rig.sensors.tip_noise_m,
        )


def _speed(angle_rad: Real, samples: int = 10) -> float:
    """Largest mean speed over so many samples, per sample."""
    return float(np.max(np.abs(angle_rad[samples:] - angle_rad[:-samples]))) / samples


def without_fall(candidate: Candidate, x: Real, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """Coulomb friction in place of Stribeck's, halfway between its levels; None for every other effect."""
    if candidate.effect != "stribeck_friction":
        return None
    for simple in listed:
        if simple.effect == "coulomb_friction" and [a.parameter for a in simple.axes] == ["torque_Nm"]:
            levels = candidate.parameters(x)
            torque = 0.5 * (levels["static_torque_Nm"] + levels["coulomb_torque_Nm"])
            return simple, np.clip([simple.axes[0].coordinate(torque)], *simple.box)
    return None


def candidates(case: Case) -> tuple[Candidate, ...]:
    """Every effect of the registry but quantisation (see `diagnosis.machine.quantisation_grid`); signed ones
    twice.
    """
    s = Scales.of(case)
    tau, k, J = s.torque_Nm, s.link_stiffness_Nm_rad, s.hub_inertia_kg_m2
    least_viscous = _VISCOUS_TOLERANCES * s.viscous_spread_Nms
    usual_viscous = (least_viscous, _USUAL_TOLERANCES * s.viscous_spread_Nms)
    found = [
        _grid(
            "coulomb_friction", [_log("torque_Nm", 1e-5 * tau, tau, 1e-3)], [_geom(3e-4 * tau, 0.6 * tau, 14)]
        ),
        _grid(
            "stribeck_friction",
            [
                _log("static_torque_Nm", 1e-5 * tau, 2 * tau, 2e-3),
                Axis("coulomb_torque_Nm", "linear", 0.0, 0.98, 2e-3),  # share of the static level
                # A fall over less than a hundredth of the largest speed is over before it shows: dry friction
                # of the Coulomb kind by another name.
                _log("stribeck_velocity_rad_s", 0.01 * s.speed_rad_s, 2.0 * s.speed_rad_s, 2e-3),
            ],
            [
                _geom(3e-4 * tau, 0.6 * tau, 8),
                [0.5, 0.8],
                _geom(0.012 * s.speed_rad_s, 0.3 * s.speed_rad_s, 3),
            ],
        ),
        _grid(
            "viscous_friction",
            [
                _log(
                    "coefficient_Nms",
                    max(1e-5 * s.damping_Nms, least_viscous),
                    30 * s.damping_Nms,
                    usual=usual_viscous if least_viscous > 0 else None,
                )
            ],
            [_geom(max(1e-4 * s.damping_Nms, 1.2 * least_viscous), 3 * s.damping_Nms, 8)],
        ),
        _grid(
            "actuator_saturation",
            [_log("limit_V", 0.05 * s.voltage_V, s.voltage_V, 1e-4)],
            [_geom(0.1 * s.voltage_V, 0.99 * s.voltage_V, 24)],
            grows=False,
        ),
        _grid(
            "actuator_dead_zone",
            [_log("width_V", 1e-5 * s.voltage_V, s.voltage_V, 1e-4)],
            [_geom(1e-3 * s.voltage_V, 0.5 * s.voltage_V, 12)],
        ),
        _grid(
            "actuator_lag",
            [_log("time_constant_s", 2e-4 * s.dt_s, 200 * s.dt_s)],
            [_geom(0.02 * s.dt_s, 40 * s.dt_s, 10)],
        ),
        _grid(
            "input_delay",
            [_log("delay_s", 2e-4 * s.dt_s, 100 * s.dt_s)],
            [_geom(0.04 * s.dt_s, 30 * s.dt_s, 14)],
        ),
        _grid(
            "tip_payload",
            [_log("mass_kg", 1e-6 * s.link_mass_kg, 5 * s.link_mass_kg)],
            [_geom(1e-4 * s.link_mass_kg, 1.5 * s.link_mass_kg, 14)],
        ),
        _grid(
            "torque_ripple",
            [
                _log("amplitude_Nm", 1e-6 * tau, tau),
                # Less than a quarter of a period looks like a spring or a constant torque.
                Axis(
                    "cycles_per_rev",
                    "linear",
                    float(np.clip(0.5 * np.pi / s.swing_rad, 1.0, 20.0)),
                    80.0,
                    1e-4,
                    edge=True,
                ),
                _PHASE,
            ],
            [],
        ),
        _grid(
            "periodic_disturbance",
            [
                _log("amplitude_Nm", 1e-6 * tau, tau),
                Axis("frequency_Hz", "linear", 0.3 / s.duration_s, 0.5 / s.dt_s, 1e-5, edge=True),
                _PHASE,
            ],
            [],
        ),
        _grid(
            "joint_compliance",
            [_log("stiffness_Nm_rad", 0.05 * k, 1e4 * k), _log("damping_Nms", 1e-6 * k, 100 * k)],
            [_geom(0.2 * k, 1e3 * k, 12), [3e-4, 3e-3, 2e-2]],
            grows=False,
            # Damping in proportion to the stiffness: time constants, not torques.
            link=lambda p: {**p, "damping_Nms": p["damping_Nms"] * p["stiffness_Nm_rad"]},
        ),
        _grid(
            "base_compliance",
            [
                _log("stiffness_Nm_rad", 1e-3 * k, 1e5 * k),
                _log("damping_Nms", 1e-6 * k, 10 * k),
                _log("inertia_kg_m2", 0.02 * J, 300 * J),
            ],
            [_geom(1.0, 40.0, 14), [0.02, 0.15], [0.5, 2.0, 8.0, 30.0]],
            grows=False,
            link=lambda p: _base(p, J),
        ),
        _grid("backlash", [_log("gap_rad", 1e-5, 0.5, 5e-3)], [_geom(3e-4, 0.2, 30)]),
        _grid("gravity", [_log("acceleration_m_s2", 1e-4, 20.0)], [_geom(1e-3, 10.0, 12)]),
        _grid(
            "hardening_spring",
            [_log("cubic_Nm_rad3", 1e-7 * tau / s.angle_rad**3, 1e3 * tau / s.angle_rad**3)],
            [_geom(1e-5 * tau / s.angle_rad**3, 10 * tau / s.angle_rad**3, 12)],
        ),
        _grid(
            "sensor_lag",
            [_log("time_constant_s", 2e-4 * s.dt_s, 200 * s.dt_s)],
            [_geom(0.02 * s.dt_s, 40 * s.dt_s, 10)],
        ),
    ]
    for sign in (1, -1):
        rate = s.tip_noise_m / s.duration_s
        found.append(
            _grid(
                "sensor_drift",
                [_log("rate_m_s", 1e-3 * rate, 1e4 * rate)],
                [_geom(0.1 * rate, 100 * rate, 6)],
                sign=sign,
            )
        )
    found += [side for effect in _RATIOS for side in _ratio(effect, case)]
    return tuple(found)


def in_place_of(key: str, factor: float, listed: Sequence[Candidate]) -> tuple[Candidate, Real] | None:
    """The effect that multiplies a stated value by this factor, or by the nearest one worth a name."""
    sign = 1 if factor > 1 else -1
    for candidate in listed:
        ratio = [a.parameter for a in candidate.axes] == ["ratio"] and candidate.sign == sign
        if ratio and _RATIOS.get(candidate.effect) == key:
            return candidate, np.clip([np.log(factor)], *candidate.box)
    return None


_PHASE = Axis("phase_rad", "angle", 0.0, 2 * np.pi, 1e-4)
# Effects that multiply a parameter, with the tolerance that may explain them as well.
_RATIOS: Mapping[str, str | None] = {
    "actuator_gain": "motor.torque_constant_Nm_A",
    "hub_inertia": "hub.inertia_kg_m2",
    "link_stiffness": "link.youngs_modulus_Pa",
    "structural_damping": "link.kelvin_voigt_s",
    "sensor_gain": None,
}


def _ratio(effect: str, case: Case) -> list[Candidate]:
    key = _RATIOS[effect]
    tolerance = 0.0 if key is None else case.rig.tolerances.get(key, 0.0)
    least = max(1e-6, _TOLERANCES * tolerance)
    largest = 50.0 if effect == "structural_damping" else 10.0
    points = np.array([0.02, 0.1, 0.3, 0.7, 1.6])
    points = points[points > least] if np.any(points > least) else np.array([1.2 * least])
    usual = 1 + _USUAL_TOLERANCES * tolerance
    above = _log("ratio", 1 + least, largest, usual=(1 + least, usual) if tolerance > 0 else None)
    sides = [Candidate(effect, (above,), tuple((float(p),) for p in points))]
    below = max(1 - least, 0.2) if least < 1 else 0.0
    if below > 0:
        axis = _log("ratio", 1 / largest, below, usual=(1 / usual, below) if tolerance > 0 else None)
        sides.append(
            Candidate(
                effect,
                (axis,),
                tuple((float(v),) for v in np.minimum(-points, np.log(below))),
                sign=-1,
                grows=False,
            )
        )
    return sides


def _log(
    parameter: str,
    low: float,
    high: float,
    step: float = 1e-5,
    usual: tuple[float, float] | None = None,
) -> Axis:
    return Axis(parameter, "log", low, high, step, usual=usual)


def _geom(low: float, high: float, count: int) -> list[float]:
    return [float(v) for v in np.geomspace(low, high, count)]


def _base(point: Mapping[str, float], J: float) -> dict[str, float]:
    """Stiffness as a frequency in Hz, damping as a ratio, inertia in hub inertias -> SI."""
    inertia = point["inertia_kg_m2"] * J
    omega = 2 * np.pi * point["stiffness_Nm_rad"]
    return {
        "stiffness_Nm_rad": omega**2 * inertia,
        "damping_Nms": 2 * point["damping_Nms"] * omega * inertia,
        "inertia_kg_m2": inertia,
    }


def _grid(
    effect: str,
    axes: Sequence[Axis],
    values: Sequence[Sequence[float]],
    *,
    sign: int = 1,
    grows: bool = True,
    link: Callable[[Mapping[str, float]], dict[str, float]] | None = None,
) -> Candidate:
    """Candidate whose starts are all combinations of the values, in the parameters' units after `link`."""
    starts = []
    for point in product(*values) if values else ():
        named = dict(zip((axis.parameter for axis in axes), point, strict=True))
        named = link(named) if link else named
        starts.append(tuple(axis.coordinate(named[axis.parameter]) for axis in axes))
    return Candidate(effect, tuple(axes), tuple(starts), sign, grows)
