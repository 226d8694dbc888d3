"""Effects that any machine may have, by name: what they do to an input, an output or the force on a body.

One row of `KINDS` serves every route on which its law applies: a Python simulation, an FMU, a measured
motion, and, of smooth forces, joints of a MuJoCo model. To add one, see CONTRIBUTING.md. Sizes are in the
units of the input (force, offset, ...) and of the output; ranges are multiples of the records' magnitudes, as
in `plant.effects`, where effects of the same name are those of a flexible link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from diagnosis.machine.around import EffectLaw
from diagnosis.machine.body_forces import BodyForces, DryFriction, DryLaw, SmoothLaw, followed
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.plant_effect import PlantEffect
from plant.effects.search_space import EffectParameter
from plant.machine import ABSOLUTE, CUBIC, LINEAR, OFF_AXIS, QUADRATIC, SINE

# Parameter -> value of an effect.
Values = Mapping[str, float]

# Share of the longest record that a delay has at most: what comes later shows in too little of it.
_LATEST = 0.2


@dataclass(frozen=True)
class Magnitudes:
    """What ranges are multiples of, in units of the signals.

    input : largest command. force, position, speed : of the body, largest ones. inertia : of a joint.
    output : largest output about its mean. reading : largest output about zero. dt_s : sampling period.
    duration_s : of the longest record.
    """

    input: float = 1.0
    force: float = 1.0
    position: float = 1.0
    speed: float = 1.0
    inertia: float = 1.0
    output: float = 1.0
    reading: float = 1.0
    dt_s: float = 1.0
    duration_s: float = 1.0

    @property
    def latest(self) -> float:
        """Largest delay, in samples."""
        return _LATEST * self.duration_s / self.dt_s


# Laws of a signal: signal (T,), values, sampling period [s] and the signal before its first row -> (T,).


def _delayed(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A held signal that comes later, as its mean over each sample."""
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
    """A signal with a straight line from zero added."""
    return np.asarray(signal + values["rate_per_s"] * dt_s * np.arange(signal.size))


def _clipped(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A signal between two limits of one size."""
    return np.clip(signal, -values["limit"], values["limit"])


def _scaled(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A signal times one and a relative error."""
    return np.asarray((1 + values["relative_error"]) * signal)


def _shifted(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A signal with a constant added."""
    return np.asarray(signal + values["offset"])


def _with_play(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """What follows a signal with a play."""
    return np.asarray(followed(np.ascontiguousarray(signal), 0.5 * values["gap"], before))


def _dead(signal: Real, values: Values, dt_s: float, before: float) -> Real:
    """A signal less a zone about zero in which nothing follows."""
    return np.asarray(np.sign(signal) * np.maximum(np.abs(signal) - values["width"], 0.0))


def _falling(values: Values) -> BodyForces:
    """Dry friction of which a share is left at speed."""
    share = values["coulomb_share"]
    level = values["static_force"]
    dry = DryFriction(coulomb=share * level, excess=(1 - share) * level, stribeck_velocity=values["velocity"])
    return BodyForces(dry)


def _one_way(values: Values) -> BodyForces:
    """Dry friction against motion up, or of a negative size against motion down."""
    force = values["force"]
    return BodyForces(DryFriction(up=force) if force > 0 else DryFriction(down=-force))


def _sized(
    name: str, low: float, high: float, first: float, last: float, count: int, unit: str, most: str = ""
) -> EffectParameter:
    """A parameter from low to high with `count` starts from first to last in equal ratios.

    All are multiples of the unit, a magnitude or several ("force/speed"); most : magnitude that high does not
    go beyond.
    """
    return EffectParameter(name, low, high, unit=unit, spread=(first, last, count), most=most)


# Ranges go from what no record shows to what stops a machine; starts are so close that a descent from one
# reaches the next: a factor of two and less where outputs jump or level off, of three to five elsewhere.
_DELAY = _sized("delay_s", 2e-4, 100.0, 0.04, 30.0, 14, "dt_s", most="latest")
_LAG = _sized("time_constant_s", 2e-3, 200.0, 0.02, 40.0, 10, "dt_s")
_GAIN = EffectParameter("relative_error", 1e-4, 0.95, (0.02, 0.1, 0.3, 0.7))
_SHARE = EffectParameter("coulomb_share", 0.0, 0.98, (0.5, 0.8), "linear")
_VISCOUS = _sized("coefficient", 1e-5, 30.0, 1e-4, 3.0, 8, "force/speed")
# Amplitude that every wave number is tried with, a sixth of the largest force. Chosen on a few generated rods
# that no command keeps: a third of it found fewer.
_RIPPLE = _sized("amplitude", 1e-5, 1.0, 0.15, 0.15, 1, "force")
# Of an angle in radians a wave number is cycles per turn. From a sixth of a period to the largest position
# on, since less is a spring. Starts are a quarter of a period apart there, up to forty radians: more take
# longer.
_WAVES = EffectParameter(
    "wave_number", 1.0, 200.0, tuple(1.6 * k for k in range(1, 25)), "linear", unit="/position"
)
_ANGLE = EffectParameter("angle_rad", -np.pi, np.pi, (-2.4, -0.8, 0.8, 2.4), "linear")

_actuator = partial(PlantEffect, group="actuator")
_body = partial(PlantEffect, group="body")
_sensor = partial(PlantEffect, group="sensor")

# Effects of the actuator act in this order, then those of the body, then those of the sensor. By name only: a
# play of a force is rare, and one before friction; a mass off its axis needs an angle; friction one way looks
# like an offset beside friction both ways, and so does one in proportion to speed or load.
KINDS: dict[str, PlantEffect] = {
    kind.name: kind
    for kind in (
        _actuator(
            "input_delay",
            (_DELAY,),
            law=EffectLaw("input", _delayed),
            check="log the input at the actuator beside the command and compare when they step",
        ),
        _actuator(
            "actuator_gain",
            (_GAIN,),
            law=EffectLaw("input", _scaled),
            signed=True,
            check="hold two steady commands and measure what the actuator gives",
        ),
        _actuator(
            "input_offset",
            (_sized("offset", 1e-5, 1.0, 1e-3, 0.3, 8, "input"),),
            law=EffectLaw("input", _shifted),
            signed=True,
            check="command zero and measure what the actuator gives; on a force, level the machine",
        ),
        _actuator(
            "input_drift",
            (_sized("rate_per_s", 1e-5, 3.0, 1e-3, 1.0, 8, "input/duration_s"),),
            law=EffectLaw("input", _drifting),
            signed=True,
            check="hold a steady command for some minutes and measure what the actuator gives",
        ),
        _actuator(
            "input_backlash",
            (_sized("gap", 1e-4, 1.5, 1e-3, 1.0, 20, "input"),),
            law=EffectLaw("input", _with_play),
            dependence="non-smooth",
            tried="by name",
            check="command slow ramps up and down: the width between the two ways is the play",
        ),
        _actuator(
            "actuator_dead_zone",
            (_sized("width", 1e-5, 1.0, 1e-3, 0.5, 12, "input"),),
            law=EffectLaw("input", _dead),
            dependence="continuous",
            check="raise the command slowly from zero and note where something begins to follow",
        ),
        _actuator(
            "actuator_saturation",
            (_sized("limit", 0.05, 1.0, 0.1, 0.99, 24, "input"),),
            law=EffectLaw("input", _clipped),
            grows=False,
            dependence="continuous",
            check="command the largest input and measure what arrives",
        ),
        _actuator(
            "actuator_lag",
            (_LAG,),
            law=EffectLaw("input", _lagged),
            check="step the command and look at what the actuator gives: it should step as well",
        ),
        _body(
            "coulomb_friction",
            (_sized("force", 1e-5, 1.0, 3e-4, 0.6, 14, "force"),),
            law=EffectLaw("body", DryLaw({"coulomb": "force"})),
            dependence="continuous",
            check="raise the input slowly from rest and note where motion begins, in both directions",
        ),
        _body(
            "stribeck_friction",
            (
                _sized("static_force", 1e-5, 2.0, 3e-4, 0.6, 8, "force"),
                _SHARE,
                _sized("velocity", 0.01, 2.0, 0.012, 0.3, 3, "speed"),
            ),
            law=EffectLaw("body", _falling),
            dependence="continuous",
            contains="coulomb_friction",
            check="creep at several slow, steady speeds and note the input that each takes",
        ),
        _body(
            "one_sided_friction",
            (_sized("force", 1e-5, 1.0, 1e-3, 0.6, 8, "force"),),
            law=EffectLaw("body", _one_way),
            signed=True,
            dependence="continuous",
            tried="by name",
            check="raise the input slowly from rest, once in each direction",
        ),
        _body(
            "friction_behind_play",
            (
                _sized("force", 1e-5, 1.0, 3e-4, 0.6, 8, "force"),
                _sized("gap", 1e-5, 2.0, 3e-3, 0.3, 3, "position"),
            ),
            law=EffectLaw("body", DryLaw({"coulomb": "force", "gap": "gap"})),
            dependence="continuous",
            contains="coulomb_friction",
            tried="by name",
            check="move to and fro slowly and note the input: after each turn it rises only beyond the play",
        ),
        _body(
            "viscous_friction",
            (_VISCOUS,),
            law=EffectLaw("body", SmoothLaw(LINEAR, "speed", ("coefficient",))),
            check="move at several steady speeds and note the input: it should grow in proportion",
        ),
        _body(
            "viscous_asymmetry",
            (_VISCOUS,),
            law=EffectLaw("body", SmoothLaw(ABSOLUTE, "speed", ("coefficient",))),
            signed=True,
            dependence="continuous",
            tried="by name",
            check="move at the same steady speeds both ways: one way takes more, in proportion to speed",
        ),
        _body(
            "quadratic_drag",
            (_sized("coefficient", 1e-5, 30.0, 1e-3, 3.0, 8, "force/speed^2"),),
            law=EffectLaw("body", SmoothLaw(QUADRATIC, "speed", ("coefficient",))),
            tried="by name",
            check="move at several steady speeds: twice the speed should take four times the input",
        ),
        _body(
            "load_friction",
            (EffectParameter("share", 1e-4, 0.9, (1e-3, 0.01, 0.05, 0.15, 0.3, 0.6)),),
            law=EffectLaw("body", DryLaw({"load": "share"})),
            dependence="continuous",
            tried="by name",
            check="move slowly without and with a heavy load and compare what each takes beyond the load",
        ),
        _body(
            "spring",
            (_sized("stiffness", 1e-5, 30.0, 1e-4, 3.0, 8, "force/position"),),
            law=EffectLaw("body", SmoothLaw(LINEAR, "position", ("stiffness",))),
            check="let the machine go away from zero with the input off: it should stay where it is",
        ),
        _body(
            "eccentric_mass",
            (
                _sized("torque", 1e-5, 30.0, 1e-3, 3.0, 8, "force"),
                _ANGLE,
            ),
            law=EffectLaw("body", SmoothLaw(OFF_AXIS, "position", ("torque", "angle_rad"))),
            tried="by name",
            check="let the machine hang free in several angles: it should stay where it is",
        ),
        _body(
            "hardening_spring",
            (_sized("cubic", 1e-7, 1e3, 1e-5, 10.0, 12, "force/position^3"),),
            law=EffectLaw("body", SmoothLaw(CUBIC, "position", ("cubic",))),
            check="push by hand at small and at large distances and look for cables and hoses",
        ),
        _body(
            "cogging",
            (
                _RIPPLE,
                _WAVES,
                replace(_ANGLE, name="phase_rad", scale="angle"),
            ),
            law=EffectLaw("body", SmoothLaw(SINE, "position", ("amplitude", "wave_number", "phase_rad"))),
            tried="by name",
            check="turn the axis slowly by hand with the drive off and feel for places where it sticks",
        ),
        _sensor(
            "backlash",
            (_sized("gap", 1e-4, 1.0, 1e-3, 0.5, 20, "output"),),
            law=EffectLaw("output", _with_play),
            dependence="non-smooth",
            check="hold the drive and move the load to and fro by hand: the free play is the backlash",
        ),
        _sensor(
            "output_saturation",
            (_sized("limit", 0.05, 1.0, 0.3, 0.999, 16, "reading"),),
            law=EffectLaw("output", _clipped),
            grows=False,
            dependence="continuous",
            tried="by name",
            check="move slowly through the whole range: the reading should not stop before the machine does",
        ),
        _sensor(
            "output_lag",
            (_LAG,),
            law=EffectLaw("output", _lagged_sensor),
            tried="with several outputs",
            check="tap against the machine and compare when the sensors answer",
        ),
        _sensor(
            "output_delay",
            (_DELAY,),
            law=EffectLaw("output", _delayed),
            tried="with several outputs",
            check="tap against the machine and compare when the sensors answer",
        ),
        _sensor(
            "output_gain",
            (_GAIN,),
            law=EffectLaw("output", _scaled),
            signed=True,
            tried="with several outputs",
            check="move by a known distance and compare the reading",
        ),
        _sensor(
            "output_offset",
            (_sized("offset", 1e-6, 3.0, 1e-4, 0.5, 8, "output"),),
            law=EffectLaw("output", _shifted),
            signed=True,
            check="go to a known position and compare the reading",
        ),
        _sensor(
            "output_drift",
            (_sized("rate_per_s", 1e-6, 3.0, 1e-4, 1.0, 8, "output/duration_s"),),
            law=EffectLaw("output", _drifting),
            signed=True,
            check="log the sensor for some minutes with the machine held",
        ),
    )
}
