"""What a controller does at its limits: simulated, from rest, without noise and without friction.

Two questions. A constant error that asks for more than the limit: does the command reach the limit and stay
there (`limited_controller`)? A reference step that meets the limit: does the loop end where it has to
(`limited_loop`, `limited_joints`)? On a stable plant that is at the reference, or, where the reference cannot
be reached, with the command at its limit. `with_safe_limits` looks for an anti-windup gain with which both
do. Nothing is said of unstable plants, of other plants in the set and of disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from control_design.analysis.closed_loop import LinearMachine, simulate, simulate_joints
from control_design.analysis.stability import NominalLoop
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Real
from control_design.plants.multivariable import MultivariablePlant
from control_design.plants.plant_set import UncertainPlant, delayed

# Share of the step and of the limit in which the limited loop has to end: the usual band of a settling time.
ERROR_LEFT = 0.02

# Samples of the longest simulation: 200 s at 1 kHz, and 0.1 s of computation for ten states.
_LONGEST = 200_000
# Samples of the shortest one, in which deadbeat loops are seen at rest. Chosen: its last tenth is 40 samples.
_SHORTEST = 400
# Share to which the slowest mode of a loop that counts as settled has decayed: a twentieth of `ERROR_LEFT`.
_DECAY = 1e-3
# Lengths tried, in settling times of the linear loop: a limited loop moves slower. One that is not there
# after the second does not settle. Chosen.
_LONGER = (4, 16)
# Share of a simulation, its end, in which the loop has to be at rest. Chosen: long enough to see a slow limit
# cycle, as the simulation is at least four settling times.
_TAIL = 0.1
# Constant errors, in errors with which the command just reaches its limit in the time simulated. Chosen: half
# more than needed, then by decades, since wind-up grows with the error.
_ERRORS = (1.5, 15.0, 150.0)
# Reference steps, in steps with which the linear command's peak just reaches the limit. Larger ones are those
# of nobody who chose the limit for the machine. Chosen.
_STEPS = (1.5, 4.0)
# Command at rest after the largest step that has to be followed, as a share of the limit; also the share of
# its way after which a step counts as risen. Chosen for the first (a command at its limit would leave nothing
# to regulate with), the usual 90 % for the second.
_REACHABLE = 0.9
# Command at rest, as a share of the limit, above which the time that the plant takes by itself counts, too.
# Chosen: below it as much command is left for speeding the plant up as for holding it.
_CLOSE = 0.5
# Command that a step asks for which cannot be followed, as a share of the limit. Chosen.
_UNREACHABLE = 1.5
# Modulus of a pole beyond which it is unstable, and not an integrator that rounding moved
# (`count_integrators` takes poles as close for one).
_UNSTABLE = 1.0 + 1e-6
# Factors on the reference gain of `anti_windup_gain`, tried in this order: from half a decade to almost two.
# Chosen: larger ones come near to no gain, which is tried last.
_SLOWER = (4.0, 16.0, 64.0)


class LimitedObstacle(Enum):
    """Why nothing is said of a limited loop."""

    LOOP_UNSTABLE = "the nominal loop is not stable"
    PLANT_UNSTABLE = "the nominal plant is not stable: no controller follows every step with a limit"
    TOO_SLOW = "the nominal loop takes too long to settle"
    ALGEBRAIC = "the plant answers in the same sample"
    ENDS_UNKNOWN = "the command does not say what it ends at"


@dataclass(frozen=True)
class LimitedLoop:
    """A loop with limits, simulated on the nominal plant.

    Attributes
    ----------
    plant : str
        Its name, or "controller" for the controller alone under constant errors.
    steps : tuple of float
        Sizes of the reference steps (constant errors), in the unit of the error.
    error_left : tuple of float
        Per step, the largest distance from where the loop has to end in the last tenth of the simulation: of
        the output as a share of the step, of the command as a share of its limit; the larger one.
    obstacle : LimitedObstacle or None
        Why nothing is said.
    """

    plant: str
    steps: tuple[float, ...] = ()
    error_left: tuple[float, ...] = ()
    obstacle: LimitedObstacle | None = None

    @property
    def worst(self) -> float:
        """Largest error left, 0 where no step was simulated.

        No unit; inf where a run diverged.
        """
        return max(self.error_left, default=0.0)

    @property
    def ends(self) -> bool:
        """Whether every step ends where it has to; true where nothing is said.

        False where an error left is nan.
        """
        return bool(self.worst <= ERROR_LEFT)


def limited_controller(controller: Controller) -> LimitedLoop:
    """The controller of one loop by itself under constant errors beyond its limits.

    Parameters
    ----------
    controller : Controller
        With one error and one command (not checked: `simulate` fails with others), and a limit; without any
        limit no errors are simulated.

    Returns
    -------
    LimitedLoop
        Of the plant "controller". The command has to end at what the linear controller ends at, clipped: with
        an integrator at the limit. Where only its rate is limited and it integrates, at the largest rate. An
        obstacle instead of steps: the command ends nowhere or at zero, the controller is unstable, or it
        takes more than 200 000 samples.
    """
    name = "controller"
    ends_unknown = LimitedLoop(name, obstacle=LimitedObstacle.ENDS_UNKNOWN)
    law = _alone(controller)
    if np.any(np.abs(law.poles) > _UNSTABLE):
        return ends_unknown

    # How long to simulate: until the slowest decay of the controller, limited or not, is seen to end. A pole
    # too slow to be seen decay acts as an integrator for as long as is simulated.
    poles_at_limit = np.linalg.eigvals(law.A - _gain(law) @ law.C)
    moduli = np.abs(np.concatenate([law.poles, poles_at_limit]))
    # That is a pole which has decayed to `_DECAY` after a quarter of the longest simulation.
    slowest_seen = np.exp(np.log(_DECAY) * _LONGER[0] / _LONGEST)
    slowest = float(np.max(moduli, initial=0.0, where=moduli < slowest_seen))
    samples = _LONGER[0] * (_samples_to_settle(slowest) or _SHORTEST)

    # What the linear controller asks for under an error of one: a machine that never moves leaves it there.
    linear = replace(law, input_limit=None, rate_limit=None)
    import control  # here, because it brings a plotting library with it

    silent = LinearMachine(control.ss([[0.0]], [[0.0]], [[1.0]], [[0.0]], law.dt_s))
    asked = simulate(linear, silent, np.ones(samples)).command
    at_end = float(asked[-1])
    tail = _tail_of(samples)
    change_in_tail = abs(asked[-1] - asked[tail][0])
    integrates = bool(change_in_tail > ERROR_LEFT * abs(at_end))
    has_one_sign = bool(np.all(np.sign(asked[tail]) == np.sign(at_end)))
    # A differentiator ends at zero.
    ends_at_zero = not abs(at_end) > _DECAY * float(np.max(np.abs(asked)))
    if not has_one_sign or ends_at_zero:
        return ends_unknown

    # Errors that ask for more than the limit at the end, and where the command has to end then.
    limit = float(law.limits("input_limit")[0])
    largest_change = float(law.limits("rate_limit")[0]) * law.dt_s
    sizes: list[float] = []
    left: list[float] = []
    if np.isfinite(limit):
        ramp = 0
        if np.isfinite(largest_change):
            ramp = int(np.ceil(limit / largest_change))
        if samples + ramp > _LONGEST:
            return LimitedLoop(name, obstacle=LimitedObstacle.TOO_SLOW)
        for factor in _ERRORS:
            size = factor * limit / abs(at_end)
            command = simulate(law, silent, np.full(samples + ramp, size)).command
            off = command[tail] / limit - np.sign(at_end)
            sizes.append(size)
            left.append(float(np.max(np.abs(off))))
    elif integrates:
        # Only the rate is limited: the command has to grow at the largest rate.
        last_change = float(np.diff(asked)[-1])
        for factor in _ERRORS:
            size = factor * largest_change / abs(last_change)
            command = simulate(law, silent, np.full(samples, size)).command
            off = np.diff(command)[tail] / largest_change - np.sign(last_change)
            sizes.append(size)
            left.append(float(np.max(np.abs(off))))
    return LimitedLoop(name, tuple(sizes), tuple(left))


def limited_loop(controller: Controller, plant: UncertainPlant) -> LimitedLoop:
    """Reference steps that meet the limits, on the nominal plant.

    Parameters
    ----------
    controller : Controller
        With one error and one command, and a limit; without any limit no steps are simulated.
    plant : UncertainPlant
        Its nominal model, with the controller's computational delay.

    Returns
    -------
    LimitedLoop
        Steps at which the command reaches its limit and which the plant can follow, and one that it cannot
        follow where the plant does not integrate. An obstacle instead of steps where plant or loop is
        unstable, the plant answers in the same sample, or the loop settles too slowly to be simulated.

    Raises
    ------
    ValueError
        Sampling times differ (`simulate`), or the controller has more than one error or command (numpy).
    """
    law = _alone(controller)
    system = delayed(plant.nominal, controller.computational_delay_samples)
    if np.any(np.asarray(system.D) != 0):
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.ALGEBRAIC)
    poles = NominalLoop(plant, controller.computational_delay_samples).poles(law.A, law.B, law.C, law.D)
    radius = float(np.max(np.abs(poles), initial=0.0))
    if not radius < 1.0:
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.LOOP_UNSTABLE)
    if plant.unstable_poles:
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.PLANT_UNSTABLE)
    samples = _samples_to_settle(radius)
    if samples is None:
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.TOO_SLOW)
    machine = LinearMachine(system)

    # The linear loop after a step of one: what it asks for, and where it ends.
    linear_law = replace(law, input_limit=None, rate_limit=None)
    linear = simulate(linear_law, machine, np.ones(samples))
    peak = float(np.max(np.abs(linear.command)))
    largest_output = float(np.max(np.abs(linear.measured)))
    if not peak or not largest_output:
        return LimitedLoop(plant.name)
    limit = float(law.limits("input_limit")[0])
    rate = float(law.limits("rate_limit")[0])
    command_at_end = 0.0
    if not plant.n_integrators:
        command_at_end = float(linear.command[-1])
    # Largest step that the plant can follow with its limit.
    largest = np.inf
    if command_at_end:
        largest = limit / abs(command_at_end)

    # Steps at which the limit counts, up to those that cannot be followed.
    sizes: list[float] = []
    if np.isfinite(limit):
        sizes += [min(factor * limit / peak, _REACHABLE * largest) for factor in _STEPS]
        sizes = [size for size in dict.fromkeys(sizes) if size * peak > limit]
        if np.isfinite(largest):
            sizes.append(_UNREACHABLE * largest)
    if np.isfinite(rate):
        # The way to the peak at the largest rate takes as long as the linear loop's rise.
        has_risen = np.abs(linear.measured) >= _REACHABLE * abs(linear.measured[-1])
        rise_samples = int(np.argmax(has_risen)) or 1
        to_rate = rate * law.dt_s * rise_samples / peak
        sizes.append(min(to_rate, _REACHABLE * largest))

    # Next to its limit the command moves the plant no faster than the plant moves by itself.
    slowest_pole = float(np.max(np.abs(plant.poles), initial=0.0))
    by_itself = _samples_to_settle(slowest_pole)
    if by_itself is None:
        sizes = [size for size in sizes if size < _CLOSE * largest]

    # Simulate each, longer where it has not ended, and see how far it is from its end.
    left: list[float] = []
    for size in sizes:
        followed = min(size, largest)
        output_at_end = followed * float(linear.measured[-1])
        command_unit = limit if np.isfinite(limit) else size * peak
        needed = samples
        if not size < _CLOSE * largest:
            needed = max(samples, by_itself or 0)
        worst = np.inf
        for longer in _LONGER:
            steps = min(longer * needed, _LONGEST)
            run = simulate(law, machine, np.full(steps, size))
            tail = _tail_of(steps)
            off_output = np.max(np.abs(run.measured[tail] - output_at_end)) / (size * largest_output)
            off_command = np.max(np.abs(run.command[tail] - followed * command_at_end)) / command_unit
            # A run that is not finite has not ended.
            worst = float(np.nan_to_num(max(off_output, off_command), nan=np.inf))
            if worst <= ERROR_LEFT or steps == _LONGEST:
                break
        left.append(worst)
    return LimitedLoop(plant.name, tuple(sizes), tuple(left))


def limited_joints(controller: Controller, plant: MultivariablePlant) -> LimitedLoop:
    """A step of each reference by itself that meets a limit, on the nominal plant.

    Parameters
    ----------
    controller : Controller
        Of any number of errors and commands, with a limit on one of them.
    plant : MultivariablePlant
        Its nominal model, with the controller's computational delay.

    Returns
    -------
    LimitedLoop
        Steps that the plant can follow, one reference after the other; `limited_loop` has steps beyond, too.
        Without limits no steps; an obstacle as of `limited_loop`.

    Raises
    ------
    ValueError
        Sampling times or numbers of errors and commands do not match (`simulate_joints`).
    """
    if not controller.limited_commands.any():
        return LimitedLoop(plant.name)
    law = _alone(controller)
    system = delayed(plant.nominal, controller.computational_delay_samples)
    if np.any(np.asarray(system.D) != 0):
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.ALGEBRAIC)
    poles = NominalLoop(plant, controller.computational_delay_samples).poles(law.A, law.B, law.C, law.D)
    radius = float(np.max(np.abs(poles), initial=0.0))
    if not radius < 1.0:
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.LOOP_UNSTABLE)
    if np.any(np.abs(plant.poles) > _UNSTABLE):
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.PLANT_UNSTABLE)
    samples = _samples_to_settle(radius)
    if samples is None:
        return LimitedLoop(plant.name, obstacle=LimitedObstacle.TOO_SLOW)
    machine = LinearMachine(system)
    linear_law = replace(law, input_limit=None, rate_limit=None)
    limits = law.limits("input_limit")
    changes = law.limits("rate_limit") * law.dt_s

    sizes: list[float] = []
    left: list[float] = []
    for channel in range(plant.outputs):
        # The linear loop after a step of one of this reference: peaks (U,) of its commands, and its rise.
        direction = np.zeros(plant.outputs)
        direction[channel] = 1.0
        linear_reference = np.tile(direction, (samples, 1))
        linear_output, linear_command = simulate_joints(linear_law, machine, linear_reference)
        peak = np.max(np.abs(linear_command), axis=0)
        largest_output = float(np.max(np.abs(linear_output)))
        followed = linear_output[:, channel]
        has_risen = np.abs(followed) >= _REACHABLE * abs(followed[-1])
        rise_samples = int(np.argmax(has_risen)) or 1

        # Steps at which the first command meets its limit, or its largest rate during the rise.
        with np.errstate(divide="ignore"):
            to_limit = float(np.min(limits / peak))
            to_rate = float(np.min(changes * rise_samples / peak))
            largest = float(np.min(limits / np.abs(linear_command[-1])))
        reached: list[float] = []
        if np.isfinite(to_limit):
            reached += [factor * to_limit for factor in _STEPS]
        if np.isfinite(to_rate):
            reached.append(to_rate)
        # Each size once, none beyond what can be followed.
        followed_steps = dict.fromkeys(min(step, _REACHABLE * largest) for step in reached)
        for size in followed_steps:
            command_unit = np.where(np.isfinite(limits), limits, size * np.max(peak))
            output_unit = size * largest_output
            worst = np.inf
            for longer in _LONGER:
                steps = min(longer * samples, _LONGEST)
                output, command = simulate_joints(law, machine, np.tile(size * direction, (steps, 1)))
                tail = _tail_of(steps)
                off_output = np.max(np.abs(output[tail] - size * linear_output[-1])) / output_unit
                off_command = np.max(np.abs(command[tail] - size * linear_command[-1]) / command_unit)
                worst = float(np.nan_to_num(max(off_output, off_command), nan=np.inf))
                if worst <= ERROR_LEFT or steps == _LONGEST:
                    break
            sizes.append(size)
            left.append(worst)
    return LimitedLoop(plant.name, tuple(sizes), tuple(left))


def limited_loops(controller: Controller, plants: Sequence[UncertainPlant]) -> tuple[LimitedLoop, ...]:
    """The controller alone under constant errors, then the loop with every plant; none without limits.

    What cannot be simulated is an obstacle in its `LimitedLoop`; ValueError where sampling times differ.
    """
    if not controller.limited_commands.any():
        return ()
    loops = [limited_controller(controller)]
    for plant in plants:
        loops.append(limited_loop(controller, plant))
    return tuple(loops)


def with_safe_limits(
    controller: Controller, check: Callable[[Controller], Iterable[LimitedLoop]]
) -> Controller:
    """The controller with the first anti-windup gain whose limited loops end where they have to.

    Parameters
    ----------
    controller : Controller
        With or without limits.
    check : callable
        Its limited loops, as those of `limited_loops`, of which `ends` is read; none of them is a yes. What
        it raises goes up.

    Returns
    -------
    Controller
        With its own gain, else a slower one, else none where the controller is stable by itself. With its own
        gain where none of them does: the certificate then says so.
    """
    if all(loop.ends for loop in check(controller)):
        return controller
    gains = [controller.gain_for_limits(factor) for factor in _SLOWER]
    if np.all(np.abs(controller.poles) < 1.0):
        gains.append(np.zeros_like(gains[0]))
    for gain in gains:
        slower = replace(controller, anti_windup_gain=gain)
        if all(loop.ends for loop in check(slower)):
            return slower
    return controller


def _alone(controller: Controller) -> Controller:
    """The controller without what the simulated plant has (the delay), or friction would need.

    Limits, matrices and anti-windup gain stay. Nothing is checked.
    """
    return replace(controller, computational_delay_samples=0, feedforward=None)


def _gain(controller: Controller) -> Real:
    """Anti-windup gain (n, U) of a controller: what the limited part of its commands does to its states.

    A `Controller` computes it where none is given; the assertion tells the type checker.
    """
    assert controller.anti_windup_gain is not None
    return controller.anti_windup_gain


def _tail_of(samples: int) -> slice:
    """Positions of the last tenth of a simulation of so many samples, where the loop has to be at rest.

    At least one sample. Not checked: samples > 0.
    """
    return slice(-max(1, int(_TAIL * samples)), None)


def _samples_to_settle(radius: float) -> int | None:
    """Samples until a mode of this pole radius has decayed to `_DECAY`; None if too many to simulate.

    radius: modulus of the slowest pole, no unit. At least `_SHORTEST` samples, also for a nan, which callers
    do not have; too many are those of which four settling times exceed `_LONGEST`.
    """
    if radius >= 1.0:
        return None
    samples = _SHORTEST
    if radius > 0.0:
        samples = max(_SHORTEST, int(np.ceil(np.log(_DECAY) / np.log(radius))))
    if _LONGER[0] * samples > _LONGEST:
        return None
    return samples
