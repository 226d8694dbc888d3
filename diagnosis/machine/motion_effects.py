"""Forces on a body inside a simulation that does not know them: force in, motion out.

Wanted is u = command + F(x(u), v(u)) over a record, where F are the `BodyForces` and a simulation gives x(u)
and nothing else. From its response to a short pulse of force follows a continuous linear system; beside it
the equation is solved in parts of a sample, dry friction exactly (a body sticks, slips, turns round inside a
part), then simulated with the mean of that force over each sample; where the simulation is not linear, what
it says beside the linear system is the start of the next round (Newton's method over a waveform, with one
linear system for all times). A response that is not one of a few poles is used as it is, sample by sample.

Neglected: what is simulated beside the linear system is a cubic between samples. Outputs other than the
body's own feel mean and moment of a force over each sample, no more. Without poles: friction acts as its mean
over each sample, and smooth forces (springs, viscous friction) by the trapezoidal rule.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy
from numba import njit

from diagnosis.machine.body_forces import BodyForces, DryFriction, force_over_part
from diagnosis.machine.machine_protocol import Real

# Rounds of a simulation: what needs more does not settle, since one that halves the error leaves 2^-12 of it.
_ROUNDS = 12
# A round that moves the motion by less than this share of what the forces change is the last. Chosen: far
# below what records show; ten times as much would be one simulation fewer.
_CONVERGED = 1e-5
# The same where rounds no longer get closer: an integrator with a step of its own has noise.
_SETTLED = 0.01
# The same where a round costs no simulation: with ten times as much, fits go on for a quarter longer.
_FORETOLD = 1e-6
# Share of the response to a pulse that, in its own sample, shows an input that acts before its row.
_AT_ONCE = 0.02
# Share of the largest response below which it has died out: less adds no more than a sensor of 20 bits sees.
_FORGOTTEN = 1e-7
# Samples after a pulse whose largest speed is that of the response: later a resonance may have grown.
_EARLY_SAMPLES = 20
# Share of that speed which the body must have at once, or no force is put around it.
_MOVES_AT_ONCE = 0.1
# Condition of the eigenvectors up to which a logarithm made with them is good to nine digits.
_LOSES_LITTLE = 1e6
# Orders of filters that a response may be of.
_ORDERS = (2, 3, 4, 5, 6)
# The first of them that leaves less than this share of the response is it.
_EXACT = 1e-9
# Else the best of them, up to this share: what it misses, rounds add.
_CLOSE = 0.03
# Samples that a filter is fitted to, sixteen times the poles of the largest order.
_FITTED = 100
# Share of the largest response that counts as much as what is smaller, when a filter is fitted.
_SMALLEST = 1e-6
# Imaginary part below which a pole is real.
_REAL = 1e-9
# Largest size of a pole: a body that falls over grows, but by less than this in a sample.
_UNSTABLE = 1.1
# Size that no filter of a response of at most one comes to; far below what overflows.
_GROWS = 1e100
# Radians of a swing, or of a force with a period, in a part of a sample: the trapezoidal rule is then off by
# a thousandth.
_SWING_RAD = 0.1
# Parts of a sample are powers of two up to this: smaller ones take longer and no record is sampled so
# coarsely.
_LARGEST_POWER = 4


class NotFollowedError(ValueError, ArithmeticError):
    """No force can be put around a simulation: wrong as stated, in a fit a trial that ran away."""


def _logarithm(matrix: Real) -> Real:
    """Real part (N, N) of the principal logarithm of a matrix (N, N).

    By eigenvectors, ten times as fast, where that loses no more than a few digits.
    """
    values, vectors = np.linalg.eig(matrix)
    if np.min(np.abs(values)) > 0 and np.linalg.cond(vectors) < _LOSES_LITTLE:
        return np.asarray(np.real(vectors * np.log(values.astype(np.complex128)) @ np.linalg.inv(vectors)))
    with warnings.catch_warnings():
        # It warns from a thousand roundings on, next to a double pole.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.real(scipy.linalg.logm(matrix)))


@dataclass(frozen=True, eq=False)
class LinearBody:
    """Continuous equivalent of a simulated response to held forces, to go through parts of a sample.

    generator : (N + 2, N + 2) of states, command and force, per sample: a force inside the simulation acts
        when it acts, a command as `early` (samples) as the steps of an integrator have it.
    rows : (2, N) position and speed of states.
    poles, numerator : (n,) each, the filter from force to what is simulated, position or speed.
    ahead : samples before a force shows. dt_s : sampling period. of_speed : a speed is simulated.
    """

    generator: Real
    rows: Real
    early: float
    poles: Real
    numerator: Real
    ahead: int
    dt_s: float
    of_speed: bool
    _steps: dict[int, tuple[Real, Real, Real]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, poles: Real, head: Real, ahead: int, dt_s: float, *, of_speed: bool) -> LinearBody | None:
        """The body whose filter from force to what is simulated has these poles (n,), and the numerator
        head (ahead + n,) of which the first `ahead` are zero; None without poles."""
        n = poles.size
        if n == 0:
            return None
        numerator = head[ahead:]
        # One sample of the filter and of the input that it holds; its logarithm is the continuous system.
        held = np.zeros((n + 1, n + 1))
        held[:n, 0] = poles
        held[:n, n] = numerator
        held[n, n] = 1.0
        held[: n - 1, 1:n] = np.eye(n - 1)
        rates = _logarithm(held)
        dynamics = rates[:n, :n]
        command = rates[:n, n]

        # A position that an input moves at once has an input that acts early; a force inside does not.
        at_once = command[0]
        later = dynamics[0] @ command
        acts_early = not of_speed and abs(at_once) <= abs(later)
        early = at_once / later if acts_early else 0.0
        force = scipy.linalg.expm(-early * dynamics) @ command

        # The position that belongs to a speed is one more state.
        n_states = n + 1 if of_speed else n
        generator = np.zeros((n_states + 2, n_states + 2))
        generator[:n, :n] = dynamics
        generator[:n, n_states] = command
        generator[:n, n_states + 1] = force
        rows = np.zeros((2, n_states))
        if of_speed:
            generator[n, 0] = dt_s
            rows[0, n] = 1.0
            rows[1, 0] = 1.0
        else:
            rows[0, 0] = 1.0
            rows[1, :n] = dynamics[0] / dt_s
        return cls(generator, rows, early, poles, numerator, ahead, dt_s, of_speed)

    @cached_property
    def turns(self) -> tuple[float, float, float]:
        """Radians that it swings by in a sample; position and speed after a unit force over one."""
        step = scipy.linalg.expm(self.generator)
        swing_rad = float(np.max(np.abs(np.angle(np.linalg.eigvals(step[:-2, :-2])))))
        position, speed = self.rows @ step[:-2, -1]
        return swing_rad, float(position), float(speed)

    def parts(self, forces: BodyForces, travel: Real) -> int:
        """Parts of a sample that are enough for the trapezoidal rule along a position (T,).

        A power of two, so that small changes of parameters seldom change it.
        """
        if not forces.smooth:
            return 1
        swing_rad, position_per_force, speed_per_force = self.turns
        largest = float(np.max(np.abs(travel)))
        stiffness = 0.0
        damping = 0.0
        wave_number = 0.0
        for force in forces.smooth:
            wave_number = max(wave_number, force.wave_number)
            if force.of == "position":
                stiffness += force.steepest(largest)
            else:
                damping += force.steepest(0.0)
        stiffer_swing_rad = np.hypot(swing_rad, np.sqrt(2 * abs(position_per_force) * stiffness))
        phase_rad = wave_number * float(np.max(np.abs(np.diff(travel)), initial=0.0))
        needed = max(
            stiffer_swing_rad / _SWING_RAD,
            damping * abs(speed_per_force) / _SWING_RAD,
            phase_rad / _SWING_RAD,
            1.0,
        )
        return int(2 ** min(np.ceil(np.log2(needed)), _LARGEST_POWER))

    def answer(
        self, simulated: Real, force: Real, command: Real, forces: BodyForces
    ) -> tuple[Real, Real, Real]:
        """Forces as they act beside a simulated motion.

        Parameters
        ----------
        simulated : (T,)
            Motion under the force of the round before.
        force : (T,)
            That force, command and body forces.
        command : (T,)
            The commanded force alone.
        forces : BodyForces

        Returns
        -------
        (T,) held forces as good as those that act, (T,) the motion with them, and (T,) what a simulation of
        the held forces has in its place.
        """
        head = np.concatenate([np.zeros(self.ahead), self.numerator])
        denominator = np.concatenate([[1.0], -self.poles])
        beside = np.asarray(simulated - scipy.signal.lfilter(head, denominator, force))
        travel = np.cumsum(simulated) * self.dt_s if self.of_speed else simulated
        parts = self.parts(forces, travel)
        if parts not in self._steps:
            step = scipy.linalg.expm(self.generator / parts)
            self._steps[parts] = (step[:-2, :-2].copy(), step[:-2, -2].copy(), step[:-2, -1].copy())
        of_states, of_command, of_force = self._steps[parts]

        # Slopes of fourth order, to go through parts of samples along cubics.
        slopes = np.gradient(beside)
        slopes[2:-2] = (8 * (beside[3:-1] - beside[1:-3]) - beside[4:] + beside[:-4]) / 12
        held, moment, position, speed = _through(
            beside,
            slopes,
            command,
            of_states,
            of_command,
            of_force,
            self.rows,
            parts,
            self.ahead,
            self.of_speed,
            self.dt_s,
            forces.dry,
            forces.table,
            forces.rounds,
        )
        # What comes early or late in a sample moves the body as a pair of forces around it does.
        moment += self.early * held
        held[1:] += 0.5 * moment[:-1]
        held[:-1] -= 0.5 * moment[1:]
        expected = beside + scipy.signal.lfilter(head, denominator, command + held)
        return held, speed if self.of_speed else position, expected


@dataclass(frozen=True, eq=False)
class PulseResponse:
    """Position and speed (L,) after a unit force over one sample; `ahead` samples before speed shows it.

    corrections : (2,) what a force in this sample and the one before adds to central differences of position.
    linear : the linear body with this response, where it is that of one.
    """

    position: Real
    speed: Real
    corrections: Real
    ahead: int
    dt_s: float
    of_speed: bool
    linear: LinearBody | None

    @classmethod
    def of(cls, motion: Real, dt_s: float, *, of_speed: bool) -> PulseResponse:
        """motion (T,): change of the motion per force, the pulse in its second sample.

        A caller turns its sign so that it begins above zero.

        Raises NotFollowedError if the force does not move the body at once, or the motion is no number.
        """
        h = motion[1:]
        at_once = abs(h[0]) > _AT_ONCE * abs(h[1])
        corrections = np.zeros(2)
        if of_speed:
            speed = h
            # The force begins with its sample: half of the first change belongs to the position there.
            position = np.cumsum(h) * dt_s - 0.5 * dt_s * h
        else:
            position = h
            speed = np.gradient(h, dt_s)
            speed[0] = 0.5 * h[1] / dt_s
            if not at_once:
                # Central differences see the pulse a sample too early; a one-sided one does not.
                speed[0] = 0.0
                speed[1] = (-3 * h[1] + 4 * h[2] - h[3]) / (2 * dt_s)
                corrections = np.array([0.5 * h[1] / dt_s, 0.5 * h[2] / dt_s - speed[1]])
        ahead = 0 if at_once else 1
        largest = np.max(np.abs(speed[:_EARLY_SAMPLES]))
        if not (np.all(np.isfinite(motion)) and abs(speed[ahead]) > _MOVES_AT_ONCE * largest):
            raise NotFollowedError(
                "friction and springs need a force that moves the body at once; the simulated motion follows "
                "the stated input later, or its steps are too coarse for a pulse of one sample"
            )
        is_remembered = np.abs(speed) > _FORGOTTEN * largest
        is_remembered |= np.abs(position) > _FORGOTTEN * np.max(np.abs(position))
        length = int(np.flatnonzero(is_remembered)[-1]) + 1
        position = position[:length]
        speed = speed[:length]
        poles, head = _filter(speed if of_speed else position, ahead)
        linear = LinearBody.of(poles, head, ahead, dt_s, of_speed=of_speed)
        return cls(position, speed, corrections, ahead, dt_s, of_speed, linear)

    @property
    def doubt(self) -> str:
        """Why smooth forces act less exactly, "" where they do not."""
        k = self.ahead
        if self.speed.size < k + 3:
            return "turns back within two samples"
        # An oscillation has fewer than six samples per period.
        turns_back = self.speed[k + 1] < 0 if self.of_speed else self.position[k + 2] < self.position[k]
        if turns_back:
            return "turns back within two samples"
        return "" if self.linear else f"is not one of {_ORDERS[-1]} poles or fewer"

    def answer(
        self, simulated: Real, force: Real, command: Real, forces: BodyForces
    ) -> tuple[Real, Real, Real]:
        """Forces as they act beside a simulated motion, held over each sample; as of `LinearBody.answer`."""
        position, speed = self.motion(simulated, force)
        held, position, speed = _solve(
            position,
            speed,
            force - command,
            command,
            self.position,
            self.speed,
            self.ahead,
            forces.dry,
            forces.table,
            forces.rounds,
        )
        motion = speed if self.of_speed else position
        return held, motion, motion

    def motion(self, simulated: Real, force: Real) -> tuple[Real, Real]:
        """Position and speed (T,) of what was simulated (T,) under a force (T,)."""
        if self.of_speed:
            steps = 0.5 * self.dt_s * (simulated[1:] + simulated[:-1])
            return np.concatenate([[0.0], np.cumsum(steps)]), simulated
        speed = np.gradient(simulated, self.dt_s)
        by_this_sample, by_sample_before = self.corrections
        speed[1:-1] -= by_this_sample * force[1:-1] + by_sample_before * force[:-2]
        speed[0] -= 2 * by_this_sample * force[0]
        speed[-1] = speed[-2]
        return simulated, speed


def _filter(response: Real, ahead: int) -> tuple[Real, Real]:
    """Filter of lowest order with a response (L,) from its sample `ahead` on that has a continuous
    equivalent.

    Returns its poles (P,) and numerator (ahead + P,); where there is none, no poles and the response.
    """
    largest = np.max(np.abs(response))
    h = response / largest
    h[:ahead] = 0.0
    length = h.size
    pulse = np.zeros(length)
    pulse[0] = 1.0
    least_missed = _CLOSE
    poles = np.zeros(0)
    numerator = h
    # As close to small beginnings as to what they become.
    weights = 1 / np.maximum(np.maximum.accumulate(np.abs(h)), _SMALLEST)
    for order in _ORDERS:
        first = 2 * order + 4
        if 2 * first > length:
            break
        # Poles: each value follows from those before it.
        rows = np.unique(np.linspace(first, length - 2, _FITTED).astype(int))
        before = h[rows[:, None] - np.arange(1, order + 1)]
        trial_poles = np.linalg.lstsq(before * weights[rows, None], h[rows] * weights[rows], rcond=None)[0]
        denominator = np.concatenate([[1.0], -trial_poles])
        roots = np.roots(denominator)
        has_no_logarithm = (roots.real <= 0) & (np.abs(roots.imag) < _REAL)
        if np.max(np.abs(roots)) > _UNSTABLE or np.any(has_no_logarithm):
            continue

        # Numerator: responses of the poles alone, each a sample later than the one before.
        rows = np.concatenate([np.arange(ahead, first), rows])
        all_pole = scipy.signal.lfilter([1.0], denominator, pulse)
        if not np.max(np.abs(all_pole)) < _GROWS:
            continue  # faster than any response that ends at one
        delays = range(ahead, ahead + order)
        delayed = np.column_stack([np.concatenate([np.zeros(j), all_pole[: length - j]]) for j in delays])
        head = np.linalg.lstsq(delayed[rows] * weights[rows, None], h[rows] * weights[rows], rcond=None)[0]

        # What it lacks at the very end is what a response lacks that has been cut there.
        missed = np.max((np.abs(delayed @ head - h) * weights)[ahead:-1])
        if missed < least_missed:
            least_missed = missed
            poles = trial_poles
            numerator = np.concatenate([np.zeros(ahead), head])
        if least_missed < _EXACT:
            break
    return poles, numerator * largest


def with_forces(
    simulate: Callable[[Real], tuple[Real, Real]],
    free: tuple[Real, Real],
    command: Real,
    response: PulseResponse,
    forces: BodyForces,
    placed: Callable[[Real, Real], Real],
    *,
    is_only_output: bool,
) -> tuple[Real, float]:
    """Outputs of a simulation with forces on its body.

    Parameters
    ----------
    simulate : force (T,) -> outputs (T, Y), motion (T,)
    free : outputs (T, Y), motion (T,)
        Under the command alone.
    command : (T,)
        Force without the body forces.
    response : PulseResponse
        Of the motion.
    forces : BodyForces
    placed : outputs (T, Y), motion (T,) -> outputs (T, Y)
        With another motion in them.
    is_only_output : bool
        The motion is the only output.

    Returns
    -------
    Outputs (T, Y), and what the last round still moved over what the forces change; inf where the motion is
    no number.
    """
    body = response.linear or response
    held = np.zeros(command.size)
    outputs, simulated = free
    error_before = np.inf
    error = np.inf
    for _ in range(_ROUNDS):
        if not np.all(np.isfinite(simulated)):
            return outputs, np.inf
        held, motion, expected = body.answer(simulated, command + held, command, forces)
        if not np.all(np.isfinite(motion)):
            return outputs, np.inf
        if is_only_output and error_before < np.inf and error / error_before * error < _FORETOLD:
            # As much closer again, what the next simulation would say is known.
            return placed(outputs, motion), error / error_before * error
        error_before = error
        outputs, simulated = simulate(command + held)
        error = _rms(simulated - expected) / max(_rms(motion - free[1]), np.finfo(float).tiny)
        enough = _FORETOLD if is_only_output else _CONVERGED
        gets_no_closer = 0.5 * error_before < error < _SETTLED
        if error < enough or gets_no_closer:
            break
    return placed(outputs, simulated + motion - expected), error


def _rms(x: Real) -> float:
    """Root mean square of (T,); inf of a trial that runs away."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(x @ x / x.size))


@njit(cache=True, fastmath={"reassoc", "contract"})
def _solve(
    position: Real,
    speed: Real,
    held: Real,
    command: Real,
    position_response: Real,
    speed_response: Real,
    ahead: int,
    dry: DryFriction,
    table: Real,
    rounds: int,
) -> tuple[Real, Real, Real]:
    """Body forces, positions and speeds (T,) with them, sample by sample.

    position, speed : (T,) under the forces `held` (T,) beside the command (T,). position_response,
    speed_response : (L,) to a unit force, shown `ahead` samples later. dry, table, rounds : of `BodyForces`.
    """
    samples = position.size
    force = held.copy()
    x = position.copy()
    v = speed.copy()
    change = np.zeros(samples)
    position_per_force = position_response[ahead]
    speed_per_force = speed_response[ahead]
    half_gap = 0.5 * dry.gap
    follower = 0.0
    for k in range(samples - ahead):
        n = k + ahead
        # What the forces of earlier samples, otherwise than held, change here.
        dx = 0.0
        dv = 0.0
        for j in range(max(0, n - speed_response.size + 1), k):
            dx += position_response[n - j] * change[j]
            dv += speed_response[n - j] * change[j]
        free_position = position[n] + dx - position_per_force * held[k]
        free_speed = speed[n] + dv - speed_per_force * held[k]
        if n > 0:
            start_position = x[n - 1]
            start_speed = v[n - 1]
        else:
            start_position = free_position
            start_speed = free_speed
        if k == 0:
            follower = start_position
        force[k], x[n], v[n] = force_over_part(
            free_position,
            free_speed,
            start_position,
            start_speed,
            position_per_force,
            speed_per_force,
            command[k],
            follower,
            dry,
            table,
            rounds,
        )
        follower = min(max(follower, x[n] - half_gap), x[n] + half_gap)
        change[k] = force[k] - held[k]
    return force, x, v


@njit(cache=True, fastmath={"reassoc", "contract"})
def _through(
    beside: Real,
    slopes: Real,
    command: Real,
    step: Real,
    commanded: Real,
    pushed: Real,
    rows: Real,
    parts: int,
    ahead: int,
    of_speed: bool,
    dt_s: float,
    dry: DryFriction,
    table: Real,
    rounds: int,
) -> tuple[Real, Real, Real, Real]:
    """Means and moments of the body forces in every sample (T,), positions and speeds (T,) with them.

    beside, slopes : (T,) position or speed beside the response to forces, and by how much it changes per
    sample. command : (T,). step (N, N), commanded (N,), pushed (N,) : what states, command and force make of
    the states over a part of a sample. rows : (2, N) of `LinearBody`. dry, table, rounds : of `BodyForces`.
    """
    samples = command.size
    n_states = pushed.size
    mean = np.zeros(samples)
    moment = np.zeros(samples)
    x = np.zeros(samples)
    v = np.zeros(samples)
    state = np.zeros(n_states)
    moved = np.zeros(n_states)
    position_row = rows[0]
    speed_row = rows[1]
    position_per_force = 0.0
    speed_per_force = 0.0
    for i in range(n_states):
        position_per_force += position_row[i] * pushed[i]
        speed_per_force += speed_row[i] * pushed[i]
    travelled = 0.0
    half_gap = 0.5 * dry.gap
    if of_speed:
        last_position = 0.0
        last_speed = beside[0]
    else:
        last_position = beside[0]
        last_speed = slopes[0] / dt_s
    follower = last_position
    if ahead == 1:
        x[0] = last_position
        v[0] = last_speed
    for k in range(samples - ahead):
        # A cubic from sample to sample; before the first nothing is known to move.
        n = k + ahead
        start = beside[max(n - 1, 0)]
        end = beside[n]
        rise = 0.0
        end_rise = 0.0
        if n > 0:
            rise = slopes[n - 1]
            end_rise = slopes[n]
        bend = 3 * (end - start) - 2 * rise - end_rise
        twist = rise + end_rise - 2 * (end - start)
        for part in range(parts):
            t = (part + 1) / parts
            value = start + t * (rise + t * (bend + t * twist))
            if of_speed:
                way = t * (start + t * (rise / 2 + t * (bend / 3 + t * twist / 4)))
                free_position = travelled + dt_s * way
                free_speed = value
            else:
                free_position = value
                free_speed = (rise + t * (2 * bend + 3 * t * twist)) / dt_s
            for i in range(n_states):
                moved[i] = commanded[i] * command[k]
                for j in range(n_states):
                    moved[i] += step[i, j] * state[j]
                free_position += position_row[i] * moved[i]
                free_speed += speed_row[i] * moved[i]
            force, position, speed = force_over_part(
                free_position,
                free_speed,
                last_position,
                last_speed,
                position_per_force,
                speed_per_force,
                command[k],
                follower,
                dry,
                table,
                rounds,
            )
            follower = min(max(follower, position - half_gap), position + half_gap)
            for i in range(n_states):
                state[i] = moved[i] + pushed[i] * force
            mean[k] += force / parts
            moment[k] += force * ((part + 0.5) / parts - 0.5) / parts
            last_position = position
            last_speed = speed
        if of_speed and n > 0:
            travelled += dt_s * (start + rise / 2 + bend / 3 + twist / 4)
        x[n] = last_position
        v[n] = last_speed
    return mean, moment, x, v
