"""Effects that any machine may have, by name: what they do to an input, an output or the force on a body.

Sizes are in the units of the input (force, offset, ...) and of the output; ranges are multiples of the
records' magnitudes, as in `plant.effects`, where effects of the same name are those of a flexible link.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from diagnosis.machine.around import Where
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.motion_effects import followed
from diagnosis.machine.plant_effect import EffectParameter, PlantEffect
from plant.effects.search_space import geometric

Values = Mapping[str, float]

_SHARE = EffectParameter("coulomb_share", 0.0, 0.98, (0.5, 0.8), "linear")


@dataclass(frozen=True)
class Sizes:
    """Magnitudes of the records: largest input, force, position, speed, output about its mean, reading of it
    about zero; sampling; longest record."""

    input: float = 1.0
    force: float = 1.0
    position: float = 1.0
    speed: float = 1.0
    output: float = 1.0
    reading: float = 1.0
    dt_s: float = 1.0
    duration_s: float = 1.0


def _log(name: str, unit: float, low: float, high: float, first: float, last: float, count: int) -> Any:
    """A range and starts, in multiples of a magnitude."""
    starts = tuple(geometric(first * unit, min(last * unit, high * unit), count))
    return EffectParameter(name, low * unit, high * unit, starts)


def _delayed(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    late = values["delay_s"] / dt_s
    whole = int(late)
    part = late - whole
    padded = np.concatenate([np.full(whole + 1, before), signal])[: signal.size + 1]
    return np.asarray((1 - part) * padded[1:] + part * padded[:-1])


def _lagged(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A held signal behind 1/(T s + 1), as its mean over each sample."""
    T = values["time_constant_s"]
    decay = np.exp(-dt_s / T)
    state, _ = scipy.signal.lfilter([1 - decay], [1.0, -decay], signal, zi=[decay * before])
    return np.asarray(signal + (np.concatenate([[before], state[:-1]]) - signal) * T / dt_s * (1 - decay))


def _lagged_sensor(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A signal that is straight between samples behind 1/(T s + 1)."""
    T = values["time_constant_s"]
    decay = np.exp(-dt_s / T)
    new = 1 - T / dt_s * (1 - decay)
    taps = [new, (1 - decay) - new]
    return np.asarray(scipy.signal.lfilter(taps, [1.0, -decay], signal, zi=[before * (1 - new)])[0])


def _drifting(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    return np.asarray(signal + values["rate_per_s"] * dt_s * np.arange(signal.size))


def _clipped(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    return np.clip(signal, -values["limit"], values["limit"])


def _scaled(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    return np.asarray((1 + values["relative_error"]) * signal)


def _shifted(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    return np.asarray(signal + values["offset"])


def _with_play(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    return np.asarray(followed(np.ascontiguousarray(signal), 0.5 * values["gap"], before))


def _delays(s: Sizes) -> tuple[EffectParameter, ...]:
    return (_log("delay_s", s.dt_s, 2e-4, min(100.0, 0.2 * s.duration_s / s.dt_s), 0.04, 30.0, 14),)


def _lags(s: Sizes) -> tuple[EffectParameter, ...]:
    return (_log("time_constant_s", s.dt_s, 2e-3, 200.0, 0.02, 40.0, 10),)


def _gains(s: Sizes) -> tuple[EffectParameter, ...]:
    return (EffectParameter("relative_error", 1e-4, 0.95, (0.02, 0.1, 0.3, 0.7)),)


# Effects of the actuator act in this order, then those of the body, then those of the sensor.
KINDS: dict[str, Callable[[str, Sizes], PlantEffect]] = {
    "input_delay": lambda name, s: PlantEffect(
        name,
        _delays(s),
        where="input",
        change=_delayed,
        check="log the input at the actuator beside the command and compare when they step",
        group="actuator",
    ),
    "actuator_gain": lambda name, s: PlantEffect(
        name,
        _gains(s),
        where="input",
        change=_scaled,
        signed=True,
        check="hold two steady commands and measure what the actuator gives",
        group="actuator",
    ),
    "input_offset": lambda name, s: PlantEffect(
        name,
        (_log("offset", s.input, 1e-5, 1.0, 1e-3, 0.3, 8),),
        where="input",
        change=_shifted,
        signed=True,
        check="command zero and measure what the actuator gives; on a force, level the machine",
        group="actuator",
    ),
    "input_drift": lambda name, s: PlantEffect(
        name,
        (_log("rate_per_s", s.input / s.duration_s, 1e-5, 3.0, 1e-3, 1.0, 8),),
        where="input",
        change=_drifting,
        signed=True,
        check="hold a steady command for some minutes and measure what the actuator gives",
        group="actuator",
    ),
    "input_backlash": lambda name, s: PlantEffect(
        name,
        (_log("gap", s.input, 1e-4, 1.5, 1e-3, 1.0, 20),),
        where="input",
        change=_with_play,
        dependence="non-smooth",
        check="command slow ramps up and down: the width between the two ways is the play",
        group="actuator",
    ),
    "actuator_dead_zone": lambda name, s: PlantEffect(
        name,
        (_log("width", s.input, 1e-5, 1.0, 1e-3, 0.5, 12),),
        where="input",
        change=lambda signal, values, dt_s, before: np.asarray(
            np.sign(signal) * np.maximum(np.abs(signal) - values["width"], 0.0)
        ),
        dependence="continuous",
        check="raise the command slowly from zero and note where something begins to follow",
        group="actuator",
    ),
    "actuator_saturation": lambda name, s: PlantEffect(
        name,
        (_log("limit", s.input, 0.05, 1.0, 0.1, 0.99, 24),),
        where="input",
        change=_clipped,
        grows=False,
        dependence="continuous",
        check="command the largest input and measure what arrives",
        group="actuator",
    ),
    "actuator_lag": lambda name, s: PlantEffect(
        name,
        _lags(s),
        where="input",
        change=_lagged,
        check="step the command and look at what the actuator gives: it should step as well",
        group="actuator",
    ),
    "coulomb_friction": lambda name, s: PlantEffect(
        name,
        (_log("force", s.force, 1e-5, 1.0, 3e-4, 0.6, 14),),
        where="body",
        change=lambda v: {"coulomb": v["force"]},
        dependence="continuous",
        check="raise the input slowly from rest and note where motion begins, in both directions",
        group="body",
    ),
    "stribeck_friction": lambda name, s: PlantEffect(
        name,
        (
            _log("static_force", s.force, 1e-5, 2.0, 3e-4, 0.6, 8),
            _SHARE,
            _log("velocity", s.speed, 0.01, 2.0, 0.012, 0.3, 3),
        ),
        where="body",
        change=lambda values: {
            "coulomb": values["coulomb_share"] * values["static_force"],
            "excess": (1 - values["coulomb_share"]) * values["static_force"],
            "stribeck_velocity": values["velocity"],
        },
        dependence="continuous",
        contains="coulomb_friction",
        check="creep at several slow, steady speeds and note the input that each takes",
        group="body",
    ),
    "one_sided_friction": lambda name, s: PlantEffect(
        name,
        (_log("force", s.force, 1e-5, 1.0, 1e-3, 0.6, 8),),
        where="body",
        change=lambda v: {"up" if v["force"] > 0 else "down": abs(v["force"])},
        signed=True,
        dependence="continuous",
        check="raise the input slowly from rest, once in each direction",
        group="body",
    ),
    "friction_behind_play": lambda name, s: PlantEffect(
        name,
        (
            _log("force", s.force, 1e-5, 1.0, 3e-4, 0.6, 8),
            _log("gap", s.position, 1e-5, 2.0, 3e-3, 0.3, 3),
        ),
        where="body",
        change=lambda v: {"coulomb": v["force"], "gap": v["gap"]},
        dependence="continuous",
        contains="coulomb_friction",
        check="move to and fro slowly and note the input: after each turn it rises only beyond the play",
        group="body",
    ),
    "viscous_friction": lambda name, s: PlantEffect(
        name,
        (_log("coefficient", s.force / s.speed, 1e-5, 30.0, 1e-4, 3.0, 8),),
        where="body",
        change=lambda v: {"viscous": v["coefficient"]},
        check="move at several steady speeds and note the input: it should grow in proportion",
        group="body",
    ),
    "viscous_asymmetry": lambda name, s: PlantEffect(
        name,
        (_log("coefficient", s.force / s.speed, 1e-5, 30.0, 1e-4, 3.0, 8),),
        where="body",
        change=lambda v: {"asymmetry": v["coefficient"]},
        signed=True,
        dependence="continuous",
        check="move at the same steady speeds both ways: one way takes more, in proportion to speed",
        group="body",
    ),
    "quadratic_drag": lambda name, s: PlantEffect(
        name,
        (_log("coefficient", s.force / s.speed**2, 1e-5, 30.0, 1e-3, 3.0, 8),),
        where="body",
        change=lambda v: {"drag": v["coefficient"]},
        check="move at several steady speeds: twice the speed should take four times the input",
        group="body",
    ),
    "load_friction": lambda name, s: PlantEffect(
        name,
        (EffectParameter("share", 1e-4, 0.9, (1e-3, 0.01, 0.05, 0.15, 0.3, 0.6)),),
        where="body",
        change=lambda v: {"load": v["share"]},
        dependence="continuous",
        check="move slowly without and with a heavy load and compare what each takes beyond the load",
        group="body",
    ),
    "spring": lambda name, s: PlantEffect(
        name,
        (_log("stiffness", s.force / s.position, 1e-5, 30.0, 1e-4, 3.0, 8),),
        where="body",
        change=lambda v: {"linear": v["stiffness"]},
        check="let the machine go away from zero with the input off: it should stay where it is",
        group="body",
    ),
    "eccentric_mass": lambda name, s: PlantEffect(
        name,
        (
            _log("torque", s.force, 1e-5, 30.0, 1e-3, 3.0, 8),
            EffectParameter("angle_rad", -np.pi, np.pi, (-2.4, -0.8, 0.8, 2.4), "linear"),
        ),
        where="body",
        change=lambda v: {"weight": v["torque"], "turned": v["angle_rad"]},
        check="let the machine hang free in several angles: it should stay where it is",
        group="body",
    ),
    "hardening_spring": lambda name, s: PlantEffect(
        name,
        (_log("cubic", s.force / s.position**3, 1e-7, 1e3, 1e-5, 10.0, 12),),
        where="body",
        change=lambda v: {"cubic": v["cubic"]},
        check="push by hand at small and at large distances and look for cables and hoses",
        group="body",
    ),
    "backlash": lambda name, s: PlantEffect(
        name,
        (_log("gap", s.output, 1e-4, 1.0, 1e-3, 0.5, 20),),
        where="output",
        change=_with_play,
        dependence="non-smooth",
        check="hold the drive and move the load to and fro by hand: the free play is the backlash",
        group="sensor",
    ),
    "output_saturation": lambda name, s: PlantEffect(
        name,
        (_log("limit", s.reading, 0.05, 1.0, 0.3, 0.999, 16),),
        where="output",
        change=_clipped,
        grows=False,
        dependence="continuous",
        check="move slowly through the whole range: the reading should not stop before the machine does",
        group="sensor",
    ),
    "output_lag": lambda name, s: PlantEffect(
        name,
        _lags(s),
        where="output",
        change=_lagged_sensor,
        check="tap against the machine and compare when the sensors answer",
        group="sensor",
    ),
    "output_delay": lambda name, s: PlantEffect(
        name,
        _delays(s),
        where="output",
        change=_delayed,
        check="tap against the machine and compare when the sensors answer",
        group="sensor",
    ),
    "output_gain": lambda name, s: PlantEffect(
        name,
        _gains(s),
        where="output",
        change=_scaled,
        signed=True,
        check="move by a known distance and compare the reading",
        group="sensor",
    ),
    "output_offset": lambda name, s: PlantEffect(
        name,
        (_log("offset", s.output, 1e-6, 3.0, 1e-4, 0.5, 8),),
        where="output",
        change=_shifted,
        signed=True,
        check="go to a known position and compare the reading",
        group="sensor",
    ),
    "output_drift": lambda name, s: PlantEffect(
        name,
        (_log("rate_per_s", s.output / s.duration_s, 1e-6, 3.0, 1e-4, 1.0, 8),),
        where="output",
        change=_drifting,
        signed=True,
        check="log the sensor for some minutes with the machine held",
        group="sensor",
    ),
}

# Where each acts.
WHERE: dict[str, Where] = {name: kind(name, Sizes()).where or "body" for name, kind in KINDS.items()}
