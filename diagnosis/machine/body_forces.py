"""Forces on a moving body that a simulation lacks, by law: the same for every route.

An effect on a body is a row of `diagnosis.machine.listed_effects`, whose law makes `BodyForces` of the
effect's parameters. A simulation around which they act (`diagnosis.machine.motion_effects`), a measured
motion (`BodyForces.overcome`) and a MuJoCo model (`diagnosis.machine.mujoco_simulation`) all read these.

Dry friction has fields of its own, since a body that sticks is solved for and not stepped through. Everything
else is a smooth force, a law of `plant.force_laws` with its parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numba import njit

from diagnosis.machine.machine_protocol import Real
from plant.force_laws import force_of_law, slope_of_law, steepest_slope
from plant.machine import LINEAR, SINE

# Columns of the table (K, 5) of K smooth forces that compiled functions read: the label of the law,
_LAW = 0
# whether it depends on the speed (1) or on the position (0),
_OF_SPEED = 1
# the first of its parameters,
_PARAMETER = 2
# and how many columns there are.
_COLUMNS = 5
# A law with fewer parameters than three leaves the last ones zero.
_PARAMETERS = 3
# Laws that a single linear equation solves over a part of a sample.
_SOLVED_AT_ONCE = (LINEAR,)
# Share of half a play from which on a body rubs behind it: at its end, but for rounding.
_AT_END_OF_PLAY = 1 - 1e-9


class DryFriction(NamedTuple):
    """Dry friction against the motion, in whatever unit of force the simulation has.

    Its level is coulomb + excess exp(-|v| / stribeck_velocity), `up` more while v > 0 and `down` more while
    v < 0; at rest up to coulomb + excess is held. load times the commanded force is friction as well. All of
    it rubs behind a play of `gap`: only where the body has gone through it.
    """

    coulomb: float = 0.0
    excess: float = 0.0
    stribeck_velocity: float = 1.0
    up: float = 0.0
    down: float = 0.0
    load: float = 0.0
    gap: float = 0.0


class SmoothForce(NamedTuple):
    """A force that is a smooth function of the body's position or speed.

    law : label in `plant.machine`. of : what it depends on. parameters : one to three of its p0, p1, p2.
    """

    law: int
    of: Literal["position", "speed"]
    parameters: tuple[float, ...]

    def steepest(self, largest: float) -> float:
        """Largest slope (force per position or speed) over positions or speeds up to `largest`."""
        p0, p1, _ = self._three_parameters
        return steepest_slope(self.law, p0, p1, largest)

    @property
    def row(self) -> tuple[float, ...]:
        """Its row (5,) of the table that compiled functions read."""
        of_speed = 1.0 if self.of == "speed" else 0.0
        return (float(self.law), of_speed, *self._three_parameters)

    @property
    def wave_number(self) -> float:
        """Radians of the force per unit of position: 0 of a law without a period."""
        if self.law == SINE and self.of == "position":
            return abs(self._three_parameters[1])
        return 0.0

    @property
    def is_linear(self) -> bool:
        """Whether one linear equation solves for it over a part of a sample."""
        return self.law in _SOLVED_AT_ONCE

    @property
    def _three_parameters(self) -> tuple[float, ...]:
        missing = _PARAMETERS - len(self.parameters)
        return (*self.parameters, *[0.0] * missing)


@dataclass(frozen=True)
class BodyForces:
    """The forces of several effects on one body."""

    dry: DryFriction = field(default_factory=DryFriction)
    smooth: tuple[SmoothForce, ...] = ()

    def __add__(self, other: BodyForces) -> BodyForces:
        """Both. Levels of dry friction add up; of two that fall with speed the second says over which."""
        dry = DryFriction(*np.add(self.dry, other.dry).tolist())
        falling = other.dry if other.dry.excess != 0 else self.dry
        dry = dry._replace(stribeck_velocity=falling.stribeck_velocity)
        return BodyForces(dry, (*self.smooth, *other.smooth))

    @cached_property
    def table(self) -> Real:
        """(K, 5) the smooth forces, as compiled functions read them."""
        return np.array([force.row for force in self.smooth]).reshape(-1, _COLUMNS)

    @property
    def rounds(self) -> int:
        """Times that the force over a part of a sample is solved for: a second one where it is not linear."""
        falls = self.dry.excess > 0
        bends = any(not force.is_linear for force in self.smooth)
        return 2 if falls or bends else 1

    def overcome(self, position: Real, speed: Real, force_without: Real) -> Real:
        """Force that a known motion takes because of these forces.

        Parameters
        ----------
        position, speed : (T,)
            The motion.
        force_without : (T,)
            Force that it takes without these.

        Returns
        -------
        (T,) what is added to `force_without`. Nothing is held at rest: there friction may be anything up to
        its level.
        """
        speed = np.ascontiguousarray(speed)
        position = np.ascontiguousarray(position)
        dry = _friction_along(self.dry, speed)
        if self.dry.gap > 0:
            half = 0.5 * self.dry.gap
            follower = followed(position, half, float(position[0]))
            rubs = speed * (position - follower) >= _AT_END_OF_PLAY * half * np.abs(speed)
            dry = np.where(rubs, dry, 0.0)
        smooth = _smooth_along(self.table, position, speed)
        whole = force_without + dry - smooth
        # The commanded force is the whole one: more of it is lost where it drives than where it brakes.
        return np.asarray(whole / (1 - self.dry.load * np.sign(speed) * np.sign(whole)) - force_without)


@dataclass(frozen=True)
class DryLaw:
    """The law of an effect that is dry friction. levels : field of `DryFriction` -> parameter of the
    effect."""

    levels: Mapping[str, str]

    def __call__(self, values: Mapping[str, float]) -> BodyForces:
        return BodyForces(DryFriction(**{field: float(values[name]) for field, name in self.levels.items()}))


@dataclass(frozen=True)
class SmoothLaw:
    """The law of an effect that is a smooth force.

    law : label in `plant.machine`. of : "position" or "speed". parameters : names of the effect's parameters
    that are p0, p1, p2 of the law.
    """

    law: int
    of: Literal["position", "speed"]
    parameters: tuple[str, ...]

    def __call__(self, values: Mapping[str, float]) -> BodyForces:
        sizes = tuple(float(values[name]) for name in self.parameters)
        return BodyForces(smooth=(SmoothForce(self.law, self.of, sizes),))


@njit(cache=True)
def friction_level(dry: DryFriction, speed: float) -> float:
    """Level of dry friction at a speed, without load and play; at rest the most that is held either way."""
    level = dry.coulomb + dry.excess * np.exp(-abs(speed) / dry.stribeck_velocity)
    if speed > 0:
        level += dry.up
    elif speed < 0:
        level += dry.down
    return float(level)


@njit(cache=True)
def _friction_along(dry: DryFriction, speed: Real) -> Real:
    """(T,) dry friction against a motion of these speeds (T,), with their sign; nothing at rest."""
    friction = np.zeros(speed.size)
    for k in range(speed.size):
        if speed[k] != 0:
            friction[k] = np.sign(speed[k]) * friction_level(dry, speed[k])
    return friction


@njit(cache=True)
def smooth_force(table: Real, position: float, speed: float) -> float:
    """Force along positive motion, at one position and speed, of the smooth forces in a table (K, 5)."""
    total = 0.0
    for k in range(table.shape[0]):
        law = int(table[k, _LAW])
        p0 = table[k, _PARAMETER]
        p1 = table[k, _PARAMETER + 1]
        p2 = table[k, _PARAMETER + 2]
        y = speed if table[k, _OF_SPEED] == 1.0 else position
        total += force_of_law(law, p0, p1, p2, y)
    return total


@njit(cache=True)
def _smooth_along(table: Real, position: Real, speed: Real) -> Real:
    """(T,) force along positive motion of a table (K, 5), at positions (T,) and speeds (T,)."""
    force = np.empty(position.size)
    for k in range(position.size):
        force[k] = smooth_force(table, position[k], speed[k])
    return force


@njit(cache=True)
def followed(signal: Real, half_gap: float, start: float) -> Real:
    """(T,) what follows a signal (T,) at a distance of up to half a gap, from `start` on."""
    follower = np.empty_like(signal)
    for k in range(signal.size):
        start = min(max(start, signal[k] - half_gap), signal[k] + half_gap)
        follower[k] = start
    return follower


@njit(cache=True)
def force_over_part(
    free_position: float,
    free_speed: float,
    start_position: float,
    start_speed: float,
    position_per_force: float,
    speed_per_force: float,
    command: float,
    follower: float,
    dry: DryFriction,
    table: Real,
    rounds: int,
) -> tuple[float, float, float]:
    """Mean force of all body forces over a sample or a part of one, and where it leaves the body.

    Smooth forces act by the trapezoidal rule: of a position by the tangent at the end of the part, of a speed
    by the line through zero and its value at the mean speed. Dry friction is solved for beside them.

    Parameters
    ----------
    free_position, free_speed
        At the end of the part without the forces.
    start_position, start_speed
        At its start.
    position_per_force, speed_per_force
        What a unit force over the part adds at its end.
    command
        Commanded force, of which a share may be friction.
    follower
        Where that stands which rubs behind the play.
    dry, table (K, 5), rounds
        Of `BodyForces`.

    Returns
    -------
    (mean force, position at the end, speed at the end).
    """
    coulomb, excess, fall_speed, up, down, load, gap = dry
    coulomb += load * abs(command)
    rubs_up = _share_beyond_play(start_position, free_position, follower, 0.5 * gap)
    rubs_down = _share_beyond_play(-start_position, -free_position, -follower, 0.5 * gap)

    force = 0.0
    position = start_position
    speed = start_speed
    level = coulomb
    for _ in range(rounds):
        # Smooth forces, linear in the force that is asked for: about the end of the round before.
        mean_speed = 0.5 * (start_speed + speed)
        damping = 0.0
        stiffness = 0.0
        at_both_ends = 0.0
        for k in range(table.shape[0]):
            law = int(table[k, _LAW])
            p0 = table[k, _PARAMETER]
            p1 = table[k, _PARAMETER + 1]
            p2 = table[k, _PARAMETER + 2]
            if table[k, _OF_SPEED] == 1.0:
                if mean_speed == 0.0:
                    damping -= slope_of_law(law, p0, p1, p2, 0.0)
                else:
                    damping -= force_of_law(law, p0, p1, p2, mean_speed) / mean_speed
            else:
                slope = slope_of_law(law, p0, p1, p2, position)
                stiffness -= slope
                at_both_ends += force_of_law(law, p0, p1, p2, start_position)
                at_both_ends += force_of_law(law, p0, p1, p2, position) + slope * (free_position - position)
        divisor = 1 + 0.5 * (damping * speed_per_force + stiffness * position_per_force)
        smooth = 0.5 * (at_both_ends - damping * (start_speed + free_speed))

        # Dry friction beside them: the level of a fall is that of the speeds at both ends.
        speed_without = free_speed + speed_per_force * smooth / divisor
        if excess > 0:
            level = coulomb + excess * np.exp(-0.5 * (abs(start_speed) + abs(speed)) / fall_speed)
        more_at_rest = (excess + coulomb - level) * max(rubs_up, rubs_down)
        speed, rubbing = _with_dry_friction(
            start_speed,
            speed_without,
            speed_per_force / divisor,
            (level + up) * rubs_up,
            (level + down) * rubs_down,
            more_at_rest,
        )
        force = (smooth + rubbing) / divisor
        position = free_position + position_per_force * force
    return force, position, speed


@njit(cache=True)
def _share_beyond_play(start: float, end: float, follower: float, half_gap: float) -> float:
    """Share (0 to 1) of the way from start to end on which a body has taken along what rubs, upwards."""
    if half_gap <= 0.0:
        return 1.0
    if end <= start:
        return 1.0 if start >= follower + half_gap else 0.0
    return min(max((end - follower - half_gap) / (end - start), 0.0), 1.0)


@njit(cache=True)
def _with_dry_friction(
    start_speed: float,
    free_speed: float,
    speed_per_force: float,
    level_up: float,
    level_down: float,
    more_at_rest: float,
) -> tuple[float, float]:
    """Speed at the end of a part of a sample, and mean dry friction in it.

    free_speed is that at the end without friction; level_up and level_down are the levels against motion up
    and down, of which a body at rest is held by more_at_rest in addition.
    """
    if start_speed < 0:
        speed, friction = _slowed(
            -start_speed, -free_speed, speed_per_force, level_down, level_up, more_at_rest
        )
        return -speed, -friction
    if start_speed > 0:
        return _slowed(start_speed, free_speed, speed_per_force, level_up, level_down, more_at_rest)
    if free_speed > speed_per_force * (level_up + more_at_rest):
        return free_speed - speed_per_force * level_up, -level_up
    if free_speed < -speed_per_force * (level_down + more_at_rest):
        return free_speed + speed_per_force * level_down, level_down
    return 0.0, -free_speed / speed_per_force


@njit(cache=True)
def _slowed(
    start_speed: float,
    free_speed: float,
    speed_per_force: float,
    level: float,
    level_back: float,
    more_at_rest: float,
) -> tuple[float, float]:
    """Speed at the end and mean dry friction of a body that moves upwards at the start.

    It slides on, or comes to rest and is held, or turns round within the part, from where the level of the
    other direction (level_back) acts.
    """
    sliding_speed = free_speed - speed_per_force * level
    if sliding_speed >= 0:
        return sliding_speed, -level
    speed_by_others = free_speed - start_speed
    if speed_by_others >= -speed_per_force * (level_back + more_at_rest):
        return 0.0, -free_speed / speed_per_force
    share_before_turn = start_speed / (speed_per_force * level - speed_by_others)
    share_after_turn = 1 - share_before_turn
    speed = share_after_turn * (speed_by_others + speed_per_force * level_back)
    return speed, share_after_turn * level_back - share_before_turn * level
