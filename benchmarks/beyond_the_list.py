"""Made machines with causes that are on the list of effects, and with causes that are on no list.

Two kinds of machines, in turn. A joint whose torque follows from its measured motion (every even number), and
an arm on a motor with a flexible tip that is simulated, free or behind a position servo (every odd one). Of
each machine there are two to five logs, of which the last validates, with white noise; stated values are
drawn off by their tolerances. Half of the machines state how much of the motion a good model may miss.

What is drawn: no cause, one effect, two effects, an unlisted cause, or an unlisted cause beside one or two
effects, with the probabilities of `SORTS`. An unlisted cause is a law that no effect of the list has: a
friction that grows with the load, a force that depends on the time, presliding, a one-sided stop, ...

A true share is the RMS of what a cause changes of the noise-free outputs, over the RMS of the motion about
its mean, of the output that shows most of it. Cases of which nobody can say what is right are drawn again:

- A cause whose true share is below `LEAST_SHARE` model errors. Below one model error it does not interest,
  and close to it naming it is as right as not naming it.
- Where no model error is stated, everything that no effect explains is an unlisted cause, however small
  (`Weighing.stated`). A joint has a small background that no effect explains: it counts as one where there is
  no larger one. Where no effect of the list is there either, neither "none" nor "unknown" would be wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment

Real = npt.NDArray[np.float64]
Values = Mapping[str, float]
Effects = Mapping[str, Values]

# Sort of a case -> (probability, number of effects of the list, whether a cause on no list is there). More
# than half have an unlisted cause, since telling it from an effect is the hardest; chosen.
SORTS = {
    "none": (0.12, 0, False),
    "single": (0.20, 1, False),
    "pair": (0.12, 2, False),
    "unlisted": (0.20, 0, True),
    "single_beside_unlisted": (0.24, 1, True),
    "pair_beside_unlisted": (0.12, 2, True),
}
# A cause below this many model errors makes a case unlabelled: one, and the fifth by which what a refit of
# the values leaves of a share differs from it. Chosen; with 2.4 only large causes would be learned from.
LEAST_SHARE = 1.2
# Unlisted cause of a joint that has no larger one and states no model error.
BACKGROUND = "background"
# Model errors that are stated, where one is.
MODEL_ERRORS = (0.02, 0.03, 0.05)
# Outputs beyond this have run away (rad, or Nm of joints that have some 10 Nm).
RUN_AWAY = 200.0


@dataclass(frozen=True, eq=False)
class LabelledCase:
    """A case with its truth.

    Attributes
    ----------
    route : str
        Kind of the machine.
    case : CaseOfMachine
    present : tuple of str
        Effects of the list that are there.
    unlisted : tuple of str
        Causes on no list that are there.
    shares : mapping
        Cause -> true share of the motion, where it is known.
    """

    route: str
    case: Any
    present: tuple[str, ...]
    unlisted: tuple[str, ...]
    shares: Mapping[str, float]


def made_case(seed: int, number: int) -> LabelledCase:
    """The number-th made machine of a seed, whatever others are made; drawn again until it has a label."""
    rng = np.random.default_rng([seed, number])
    draw = joint_case if number % 2 == 0 else arm_case
    names = list(SORTS)
    sort = names[rng.choice(len(names), p=[SORTS[name][0] for name in names])]
    while True:
        labelled = _with_label(draw(rng, f"made_{number}_{sort}", *SORTS[sort][1:]))
        if labelled is not None:
            return labelled


def _with_label(drawn: LabelledCase | None) -> LabelledCase | None:
    """The case as it is to be answered; None where nobody can say (the module tells why)."""
    if drawn is None:
        return None
    weighing = drawn.case.machine.weighing
    if any(share < LEAST_SHARE * weighing.model_error for share in drawn.shares.values()):
        return None
    has_background = drawn.route == "joint"
    if has_background and not weighing.stated and not drawn.unlisted:
        if not drawn.present:
            return None
        return replace(drawn, unlisted=(BACKGROUND,))
    return drawn


def _rms(values: Real) -> float:
    """About zero."""
    return float(np.sqrt(np.mean(values**2)))


def _motion_rms(values: Real) -> float:
    """About the mean."""
    return float(np.std(values))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _drawn_off(rng: np.random.Generator, stated: Values, tolerances: Values, part: float) -> dict[str, float]:
    """True values: log-normal about the stated ones, by a part of the tolerances, cut off at twice that."""
    return {
        name: value * float(np.exp(part * tolerances[name] * np.clip(rng.standard_normal(), -2, 2)))
        for name, value in stated.items()
    }


def _stated_model_error(rng: np.random.Generator) -> float | None:
    """One of `MODEL_ERRORS` for half of the machines."""
    if rng.random() < 0.5:
        return float(rng.choice(MODEL_ERRORS))
    return None


def _experiments(inputs: Sequence[Real], outputs: Sequence[Real]) -> tuple[PlantExperiment, ...]:
    """Logs (T, U), (T, Y), of which the last validates."""
    last = len(inputs) - 1
    return tuple(
        PlantExperiment(f"log{k}", "held_out" if k == last else "estimation", log_input, log_output)
        for k, (log_input, log_output) in enumerate(zip(inputs, outputs, strict=True))
    )


# --- A joint whose torque follows from motion ---

# Sampling period of its logs.
JOINT_DT_S = 0.005
# Speed at which dry friction has its sign, rad/s: far below any other of the motion.
SIGN_SPEED_RAD_S = 1e-2
# True shares are drawn between these.
JOINT_SHARES = (0.08, 0.4)
# RMS of what every joint has and no effect explains, over that of the torque: up to this.
MOST_BACKGROUND = 0.01
# Sensor noise over the torque.
JOINT_NOISE = (0.003, 0.02)
# True values are off by this part of their tolerances.
JOINT_OFF = 0.7

JOINT_EFFECTS = (
    PlantEffect("dry_friction", (EffectParameter("torque_Nm", 1e-3, 20.0),), dependence="continuous"),
    PlantEffect(
        "stribeck_friction",
        (
            EffectParameter("static_Nm", 1e-3, 20.0),
            EffectParameter("share", 0.02, 0.98),
            EffectParameter("speed_rad_s", 1e-2, 2.0),
        ),
        dependence="continuous",
    ),
    PlantEffect("offset", (EffectParameter("torque_Nm", 1e-3, 20.0),), signed=True),
    PlantEffect("drift", (EffectParameter("rate_Nm_s", 1e-4, 5.0),), signed=True),
    PlantEffect("spring", (EffectParameter("stiffness_Nm_rad", 1e-3, 50.0),), signed=True),
    PlantEffect("quadratic_friction", (EffectParameter("Nms2", 1e-4, 20.0),), signed=True),
    PlantEffect("gain", (EffectParameter("relative", 1e-3, 0.6),), signed=True),
    PlantEffect("lag", (EffectParameter("time_s", 1e-4, 0.1),)),
)
# Effects that are drawn. A gain is on the list and never drawn: all values off by one factor are the same.
JOINT_DRAWN = (
    "dry_friction",
    "stribeck_friction",
    "offset",
    "drift",
    "spring",
    "quadratic_friction",
    "lag",
)
SIGNED = ("offset", "drift", "spring", "quadratic_friction", "hardening_spring")
# The longest lag that is drawn, s, within the range of the effect.
LONGEST_LAG_S = 0.09
JOINT_UNLISTED = (
    "ripple",
    "load_friction",
    "time",
    "steps_of_angle",
    "one_sided",
    "other_joint",
    "friction_of_angle",
    "presliding",
)


def joint_torque(parameters: Values, effects: Effects, motion: Real) -> Real:
    """(T, 1) torque, Nm, of a joint with inertia, viscous friction, gravity and the effects.

    motion : (T, 3) angle, speed and acceleration.
    """

    def value(effect: str, parameter: str) -> float:
        return effects.get(effect, {}).get(parameter, 0.0)

    angle, speed, acceleration = motion.T
    direction = np.tanh(speed / SIGN_SPEED_RAD_S)
    torque = parameters["inertia"] * acceleration
    torque = torque + parameters["viscous"] * speed + parameters["gravity"] * np.sin(angle)
    torque = torque + value("dry_friction", "torque_Nm") * direction
    if "stribeck_friction" in effects:
        law = effects["stribeck_friction"]
        falling = (1 - law["share"]) * np.exp(-np.abs(speed) / law["speed_rad_s"])
        torque = torque + law["static_Nm"] * (law["share"] + falling) * direction
    torque = torque + value("offset", "torque_Nm")
    torque = torque + value("drift", "rate_Nm_s") * JOINT_DT_S * np.arange(angle.size)
    torque = torque + value("spring", "stiffness_Nm_rad") * angle
    torque = torque + value("quadratic_friction", "Nms2") * speed * np.abs(speed)
    torque = torque * (1 + value("gain", "relative"))
    if "lag" in effects:
        torque = torque + effects["lag"]["time_s"] * np.gradient(torque, JOINT_DT_S)
    return torque[:, None]


def random_motion(
    rng: np.random.Generator, samples: int, band_Hz: tuple[float, float], size_rad: float, waves: int = 6
) -> Real:
    """(T, 3) angle, speed and acceleration of a sum of sines with random frequencies and phases."""
    time_s = JOINT_DT_S * np.arange(samples)
    motion = np.zeros((samples, 3))
    for frequency in 2 * np.pi * rng.uniform(*band_Hz, waves):
        phase = frequency * time_s + rng.uniform(0, 2 * np.pi)
        amplitude = size_rad / waves * rng.uniform(0.5, 1.5)
        motion[:, 0] += amplitude * np.sin(phase)
        motion[:, 1] += amplitude * frequency * np.cos(phase)
        motion[:, 2] -= amplitude * frequency**2 * np.sin(phase)
    return motion


def unlisted_torque(name: str, rng: np.random.Generator) -> Callable[[Real, int], Real]:
    """Motion (T, 3) and number of the log -> torque (T,) of a cause on no list, of any size.

    Its constants are drawn once: they are those of the machine, in all logs.
    """
    cycles = rng.uniform(3, 12)
    phase = rng.uniform(0, 2 * np.pi)
    frequency_rad_s = rng.uniform(0.1, 0.6)
    strength = rng.uniform(0.2, 1.0)
    fastest_Hz = rng.uniform(1.3, 3.0)

    def torque(motion: Real, log: int) -> Real:
        angle, speed, acceleration = motion.T
        direction = np.tanh(speed / SIGN_SPEED_RAD_S)
        time_s = JOINT_DT_S * np.arange(angle.size)
        if name == "ripple":
            return np.asarray(np.sin(cycles * angle + phase))
        if name == "load_friction":
            load = acceleration / max(_motion_rms(acceleration), 1e-9) + 1.5 * np.sin(angle)
            return np.asarray(direction * np.abs(load))
        if name == "time":
            slow = np.sin(frequency_rad_s * time_s + phase + log)
            return np.asarray(slow + strength * np.cos(2.3 * frequency_rad_s * time_s))
        if name == "steps_of_angle":
            return np.asarray(np.sign(np.sin(cycles / 2 * angle + phase)))
        if name == "one_sided":
            return np.maximum(angle - strength * _motion_rms(angle), 0.0)
        if name == "other_joint":
            # Another joint moves by itself, and its acceleration acts here.
            its_rng = np.random.default_rng([log, 7])
            return random_motion(its_rng, angle.size, (0.2, fastest_Hz), 1.0)[:, 2]
        if name == "friction_of_angle":
            return np.asarray(direction * (1 + np.sin(2 * angle + phase)))
        if name == "presliding":
            # Dahl's friction: the torque rises with the angle before the joint slides.
            state = 0.0
            presliding = np.zeros(angle.size)
            for k, step in enumerate(np.diff(angle, prepend=angle[0])):
                state += 40 * strength * step * (1 - state * np.sign(step))
                state = float(np.clip(state, -1, 1))
                presliding[k] = state
            return presliding
        raise ValueError(f"unlisted cause of a joint must be one of {', '.join(JOINT_UNLISTED)}; got {name}")

    return torque


def _unit_effect(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Values of an effect of a joint, the first of which (its size) is one unit."""
    if name == "stribeck_friction":
        return {
            "static_Nm": 1.0,
            "share": float(rng.uniform(0.3, 0.7)),
            "speed_rad_s": float(rng.uniform(0.1, 0.6)),
        }
    if name == "lag":
        return {"time_s": 1e-2}
    (effect,) = [effect for effect in JOINT_EFFECTS if effect.name == name]
    return {effect.parameters[0].name: 1.0}


def joint_case(
    rng: np.random.Generator, name: str, listed_count: int, has_unlisted: bool
) -> LabelledCase | None:
    """One machine of the first kind; None where its logs are no case (a diagnosis would refuse them)."""
    stated = {
        "inertia": float(rng.uniform(0.05, 2)),
        "viscous": float(rng.uniform(0.05, 1)),
        "gravity": float(rng.uniform(0.5, 8)),
    }
    tolerances = {
        "inertia": float(rng.choice([0.05, 0.1, 0.2])),
        "viscous": float(rng.choice([0.2, 0.5, 2.0])),
        "gravity": float(rng.choice([0.02, 0.05, 0.1])),
    }
    true = _drawn_off(rng, stated, tolerances, JOINT_OFF)

    # Logs of one machine have their own bands and sizes of motion.
    samples = int(rng.integers(800, 2000))
    motions = [
        random_motion(rng, samples, (rng.uniform(0.05, 0.3), rng.uniform(0.5, 1.6)), rng.uniform(0.6, 1.4))
        for _ in range(int(rng.integers(2, 6)))
    ]

    def torques(effects: Effects) -> Real:
        return np.concatenate([joint_torque(true, effects, motion)[:, 0] for motion in motions])

    bare = torques({})
    scale = _motion_rms(bare)

    # Effects of the list, sized by what they change of the bare machine. Dry friction is part of Stribeck's.
    listed = [str(effect) for effect in rng.choice(JOINT_DRAWN, listed_count, replace=False)]
    if "stribeck_friction" in listed and "dry_friction" in listed:
        listed.remove("dry_friction")
    effects: dict[str, dict[str, float]] = {}
    for effect in listed:
        values = _unit_effect(effect, rng)
        size_name = next(iter(values))
        changed = _rms(torques({effect: values}) - bare)
        size = values[size_name] * _log_uniform(rng, *JOINT_SHARES) * scale / changed
        if effect in SIGNED:
            size *= float(rng.choice([-1, 1]))
        if effect == "lag":
            size = min(size, LONGEST_LAG_S)
        effects[effect] = {**values, size_name: size}
    complete = torques(effects)
    shares = {
        effect: _rms(complete - torques({other: effects[other] for other in listed if other != effect}))
        / scale
        for effect in listed
    }

    # A cause on no list.
    unlisted = [str(rng.choice(JOINT_UNLISTED))] if has_unlisted else []
    unlisted_force = [np.zeros(samples) for _ in motions]
    for cause in unlisted:
        law = unlisted_torque(cause, rng)
        parts = [law(motion, log) for log, motion in enumerate(motions)]
        shares[cause] = _log_uniform(rng, *JOINT_SHARES)
        size = shares[cause] * scale / _rms(np.concatenate(parts))
        unlisted_force = [size * part for part in parts]

    background = float(rng.uniform(0, MOST_BACKGROUND)) * scale
    noise = scale * _log_uniform(rng, *JOINT_NOISE)
    plant = Plant(
        joint_torque,
        stated,
        tolerances,
        ("torque_Nm",),
        np.array([noise]),
        JOINT_EFFECTS,
        model_error=_stated_model_error(rng),
        dt_s=JOINT_DT_S,
    )
    outputs = []
    for log, motion in enumerate(motions):
        measured = joint_torque(true, effects, motion)[:, 0] + unlisted_force[log]
        measured = measured + background * np.sin(5 * motion[:, 0] + 0.3 * log)
        outputs.append(measured + noise * rng.standard_normal(samples))
    return _labelled("joint", name, plant, motions, outputs, listed, unlisted, shares)


# --- An arm on a motor with a flexible tip, simulated ---

ARM_DT_S = 0.01
ARM_SAMPLES = 800
# Integration steps within a sample.
ARM_STEPS = 8
# Its servo, V/rad and V s/rad.
SERVO_GAIN_V_RAD = 12.0
SERVO_DAMPING_VS_RAD = 0.8
# Limit of the voltage without saturation: none.
NO_LIMIT_V = 1e3
# Sensor noise over the motion.
ARM_NOISE = (0.001, 0.01)
# True values are off by this part of their tolerances.
ARM_OFF = 0.6
# Size of an unlisted cause, V at the motor.
ARM_UNLISTED_V = (0.12, 0.7)

ARM_EFFECTS = (
    PlantEffect("dry_friction", (EffectParameter("voltage_V", 1e-3, 5.0),), dependence="continuous"),
    PlantEffect("offset", (EffectParameter("voltage_V", 1e-3, 5.0),), signed=True, dependence="continuous"),
    PlantEffect("dead_zone", (EffectParameter("voltage_V", 1e-3, 3.0),), dependence="continuous"),
    PlantEffect(
        "ripple",
        (
            EffectParameter("voltage_V", 1e-3, 3.0),
            EffectParameter("cycles", 1.0, 20.0),
            EffectParameter("phase_rad", 1e-3, 6.28),
        ),
        dependence="continuous",
    ),
    PlantEffect("hardening_spring", (EffectParameter("V_rad3", 1e-4, 10.0),), signed=True),
    PlantEffect("gain", (EffectParameter("relative", 1e-3, 0.6),), signed=True),
    PlantEffect("lag", (EffectParameter("time_s", 1e-4, 0.2),)),
    PlantEffect("drift", (EffectParameter("rate_V_s", 1e-4, 5.0),), signed=True),
    PlantEffect("saturation", (EffectParameter("limit_V", 0.5, 20.0),), grows=False, dependence="continuous"),
    PlantEffect("softness", (EffectParameter("relative", 0.05, 5.0),)),
)
# Effect -> range of its first parameter. Gain and softness are on the list and never drawn: a motor constant
# or a spring off by their tolerances are the same.
ARM_DRAWN = {
    "dry_friction": (0.1, 0.6),
    "offset": (0.05, 0.4),
    "dead_zone": (0.1, 0.5),
    "ripple": (0.1, 0.6),
    "hardening_spring": (0.1, 2.0),
    "lag": (0.01, 0.08),
    "drift": (0.01, 0.1),
    "saturation": (0.8, 2.0),
}
# Unlisted cause of an arm -> its number in `arm_outputs`.
ARM_UNLISTED = {
    "force_of_angle": 1,
    "time": 2,
    "tilt": 3,
    "presliding": 4,
    "soft_saturation": 5,
    "one_sided": 6,
    "load_friction": 7,
}


@njit(cache=True)
def arm_outputs(  # type: ignore[no-untyped-def]
    command,
    has_servo,
    inertia,
    viscous,
    motor,
    tip_inertia,
    tip_stiffness,
    tip_damping,
    dry_friction,
    offset,
    dead_zone,
    ripple,
    ripple_cycles,
    ripple_phase,
    hardening,
    gain,
    lag_s,
    drift,
    limit,
    unlisted,
    size,
    constant,
):
    """(T, 2) hub angle and angle of the tip beside it, rad, by the symplectic Euler method.

    J a = K (u + effects in V) - b v + k w + c w' - friction,  M (a + w'') = -k w - c w'  with hub speed v and
    deflection w. `unlisted` is a number of `ARM_UNLISTED` or 0, of a size in V and with a constant of its
    own. Dry friction holds the hub where it could stop it within a step.
    """
    outputs = np.zeros((command.size, 2))
    angle = 0.0
    speed = 0.0
    deflection = 0.0
    deflection_speed = 0.0
    pull = 0.0  # of the motor behind its lag, V
    presliding = 0.0
    step_s = ARM_DT_S / ARM_STEPS
    for i in range(command.size):
        outputs[i, 0] = angle
        outputs[i, 1] = deflection
        time_s = i * ARM_DT_S

        # The voltage of the sample.
        voltage = command[i]
        if has_servo:
            voltage = SERVO_GAIN_V_RAD * (command[i] - angle) - SERVO_DAMPING_VS_RAD * speed
        voltage = (1 + gain) * voltage
        voltage = np.sign(voltage) * max(abs(voltage) - dead_zone, 0.0)
        voltage = min(max(voltage, -limit), limit)
        if unlisted == 5:
            voltage = voltage / (1 + size * abs(voltage))

        for _ in range(ARM_STEPS):
            pull += min(step_s / lag_s, 1.0) * (voltage - pull) if lag_s > 0 else voltage - pull
            at_motor = pull + offset + drift * time_s
            at_motor += ripple * np.sin(ripple_cycles * angle + ripple_phase) - hardening * angle**3
            if unlisted == 1:
                at_motor += size * np.sin(2.3 * angle + constant) * (1.0 if speed > 0 else 0.4)
            elif unlisted == 2:
                at_motor += size * (np.sin(2 * constant + 0.7 * time_s) + 0.5 * np.cos(1.9 * time_s))
            elif unlisted == 3:
                at_motor -= size * np.sin(0.8 * angle)
            elif unlisted == 4:
                presliding += step_s * (speed - abs(speed) * presliding / 0.03)
                at_motor -= size * presliding / 0.03
            elif unlisted == 6:
                at_motor -= 2 * size * max(angle - 0.3 * constant, 0.0)
            torque = motor * at_motor - viscous * speed
            torque += tip_stiffness * deflection + tip_damping * deflection_speed

            friction = motor * dry_friction
            if unlisted == 7:
                friction += motor * size * (0.3 + 5 * abs(deflection))
            free = speed + step_s / inertia * torque
            stopped = step_s / inertia * friction
            new_speed = 0.0
            if abs(free) > stopped:
                new_speed = free - np.sign(free) * stopped
            acceleration = (new_speed - speed) / step_s

            speed = new_speed
            angle += step_s * speed
            tip_torque = -tip_stiffness * deflection - tip_damping * deflection_speed
            deflection_speed += step_s * (tip_torque / tip_inertia - acceleration)
            deflection += step_s * deflection_speed
    return outputs


@dataclass(frozen=True)
class Arm:
    """A simulation of the arm, with an unlisted cause or (by default) without.

    Attributes
    ----------
    has_servo : bool
        The command is an angle, not a voltage.
    unlisted : int
        Number of `ARM_UNLISTED`, 0: none.
    size_V, constant : float
        Of the unlisted cause.
    """

    has_servo: bool
    unlisted: int = 0
    size_V: float = 0.0
    constant: float = 0.0

    def __call__(self, parameters: Values, effects: Effects, command: Real) -> Real:
        """(T, 2) outputs for a command (T, 1)."""

        def value(effect: str, parameter: str, without: float = 0.0) -> float:
            return effects.get(effect, {}).get(parameter, without)

        return np.asarray(
            arm_outputs(
                command[:, 0],
                self.has_servo,
                parameters["inertia"],
                parameters["viscous"],
                parameters["motor"],
                parameters["tip"],
                parameters["spring"] / (1 + value("softness", "relative")),
                1e-3 * parameters["spring"] ** 0.5,
                value("dry_friction", "voltage_V"),
                value("offset", "voltage_V"),
                value("dead_zone", "voltage_V"),
                value("ripple", "voltage_V"),
                value("ripple", "cycles", 1.0),
                value("ripple", "phase_rad"),
                value("hardening_spring", "V_rad3"),
                value("gain", "relative"),
                value("lag", "time_s"),
                value("drift", "rate_V_s"),
                value("saturation", "limit_V", NO_LIMIT_V),
                self.unlisted,
                self.size_V,
                self.constant,
            )
        )


def arm_case(
    rng: np.random.Generator, name: str, listed_count: int, has_unlisted: bool
) -> LabelledCase | None:
    """One machine of the second kind; None where it runs away or its logs are no case."""
    has_servo = bool(rng.integers(2))
    stated = {
        "inertia": 0.06 * float(rng.uniform(0.5, 2)),
        "viscous": 0.3 * float(rng.uniform(0.5, 2)),
        "motor": 0.5 * float(rng.uniform(0.7, 1.5)),
        "tip": 0.03,
        "spring": 6.0 * float(rng.uniform(0.7, 1.5)),
    }
    tolerances = {
        "inertia": 0.1,
        "viscous": 0.3,
        "motor": float(rng.choice([0.03, 0.1])),
        "tip": 0.1,
        "spring": 0.1,
    }
    true = _drawn_off(rng, stated, tolerances, ARM_OFF)

    # Effects of the list.
    listed = [str(effect) for effect in rng.choice(list(ARM_DRAWN), listed_count, replace=False)]
    effects: dict[str, dict[str, float]] = {}
    for effect in listed:
        (kind,) = [kind for kind in ARM_EFFECTS if kind.name == effect]
        size = _log_uniform(rng, *ARM_DRAWN[effect])
        if effect in SIGNED:
            size *= float(rng.choice([-1, 1]))
        effects[effect] = {kind.parameters[0].name: size}
        if effect == "ripple":
            effects[effect]["cycles"] = float(rng.uniform(2, 8))
            effects[effect]["phase_rad"] = float(rng.uniform(0, 6))

    # A cause on no list.
    unlisted = [str(rng.choice(list(ARM_UNLISTED)))] if has_unlisted else []
    known = Arm(has_servo)
    machine = known
    for cause in unlisted:
        size = _log_uniform(rng, *ARM_UNLISTED_V)
        if cause == "soft_saturation":
            size /= 2
        machine = Arm(has_servo, ARM_UNLISTED[cause], size, float(rng.uniform(0.2, 2.0)))

    # Steps of 15 samples; a servo is commanded an angle, which is smaller than a voltage.
    commands = []
    for _ in range(int(rng.integers(2, 6))):
        steps = np.repeat(rng.choice([-1.0, 1.0, 0.0, 0.5], ARM_SAMPLES // 15 + 1), 15)[:ARM_SAMPLES]
        commands.append((steps * rng.uniform(1.5, 3.0) * (0.4 if has_servo else 1.0))[:, None])

    def outputs_of(simulation: Arm, its_effects: Effects) -> list[Real]:
        return [simulation(true, its_effects, command) for command in commands]

    motion = np.std(np.concatenate(outputs_of(known, {})), axis=0)
    complete = outputs_of(machine, effects)
    if not np.max(np.abs(complete)) < RUN_AWAY:
        return None

    def share_without(simulation: Arm, its_effects: Effects) -> float:
        change = np.concatenate(complete) - np.concatenate(outputs_of(simulation, its_effects))
        return float(np.max(np.sqrt(np.mean(change**2, axis=0)) / motion))

    shares = {cause: share_without(known, effects) for cause in unlisted}
    for effect in listed:
        other_effects = {other: effects[other] for other in listed if other != effect}
        shares[effect] = share_without(machine, other_effects)

    noise = motion * [_log_uniform(rng, *ARM_NOISE) for _ in range(2)]
    plant = Plant(
        known,
        stated,
        tolerances,
        ("hub_rad", "tip_rad"),
        noise,
        ARM_EFFECTS,
        model_error=_stated_model_error(rng),
        dt_s=ARM_DT_S,
    )
    outputs = [output + noise * rng.standard_normal(output.shape) for output in complete]
    return _labelled("arm", name, plant, commands, outputs, listed, unlisted, shares)


def _labelled(
    route: str,
    name: str,
    plant: Plant,
    inputs: Sequence[Real],
    outputs: Sequence[Real],
    listed: Sequence[str],
    unlisted: Sequence[str],
    shares: Mapping[str, float],
) -> LabelledCase | None:
    """The case with its truth; None where its logs are no case, such as those of an arm that never moves."""
    try:
        case = PlantCase(name, plant, _experiments(inputs, outputs))
    except ValueError:
        return None
    return LabelledCase(route, case, tuple(listed), tuple(unlisted), dict(shares))


def made_cases(seed: int, count: int) -> Iterator[LabelledCase]:
    """The first `count` made machines of a seed."""
    for number in range(count):
        yield made_case(seed, number)
