"""Friction and springs on a body inside a simulation that knows neither: force in, motion out.

Wanted is u = command - F(x(u), v(u)) over a record, where a simulation gives x(u) and nothing else. From its
response to a short pulse of force follows a continuous linear system; beside it the equation is solved in
parts of a sample, dry friction exactly (a body sticks, slips, turns round inside a part), then simulated with
the mean of that force over each sample; where the simulation is not linear, what it says beside the linear
system is the start of the next round (Newton's method over a waveform, with one linear system for all times).
A response that is not one of a few poles is used as it is, sample by sample.

Neglected: what is simulated beside the linear system is a cubic between samples. Outputs other than the
body's own feel mean and moment of a force over each sample, no more. Without poles: friction acts as its mean
over each sample, and smooth forces (springs, viscous friction) by the trapezoidal rule.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numba import njit

from diagnosis.machine.machine_protocol import Real

_ROUNDS = 12  # what needs more does not settle: a round that halves the rest leaves 2^-12
# Of the change that the effects make: what rounds may still move, or may where they no longer get closer (an
# integrator with a step of its own has noise).
_CONVERGED, _SETTLED = 1e-5, 0.01
# The same where a round costs no simulation: fits go on for a quarter longer where it is ten times as much.
_FORETOLD = 1e-6
# Share of the response to a pulse that, in its own sample, shows an input that acts before its row.
_AT_ONCE = 0.02
_FORGOTTEN = 1e-7  # of the largest response: the rest adds less than a sensor of 20 bits sees
# Condition of the eigenvectors up to which a logarithm made with them is good to nine digits.
_LOSES_LITTLE = 1e6
# Orders of filters that a response may be of: the first that has all of it to the first share, else the best
# to the second (what it misses, rounds add). Samples that they are fitted to.
_ORDERS, _EXACT, _CLOSE = (2, 3, 4, 5, 6), 1e-9, 0.03
_FITTED = 100  # rows, sixteen times the poles of the largest order
# Imaginary part of a real pole; largest pole; radians of a swing in a part of a sample, and the largest
# power of two of parts.
_REAL, _UNSTABLE, _TURNED, _MOST_PARTS = 1e-9, 1.1, 0.1, 4
# Of a half play, at its end.
_NEARLY = 1 - 1e-9
# What no filter of a response of one comes to; far below what overflows.
_GROWS = 1e100


class NotFollowedError(ValueError, ArithmeticError):
    """No force can be put around a simulation: wrong as stated, in a fit a trial that ran away."""


class BodyForces(NamedTuple):
    """Forces on a body against its motion, SI or whatever units force and motion have.

    Dry friction of size coulomb + excess exp(-|v| / stribeck_velocity), with `up` more while v > 0 and `down`
    more while v < 0, at rest up to coulomb + excess; load times the force that is commanded, as dry friction.
    All of that rubs behind a play of `gap`: where the body has gone through it. viscous v + asymmetry |v|
    + drag v |v|; linear x + cubic x^3, x from zero; weight (sin(x + turned) - sin(turned)), x an angle.
    """

    coulomb: float = 0.0
    excess: float = 0.0
    stribeck_velocity: float = 1.0
    up: float = 0.0
    down: float = 0.0
    viscous: float = 0.0
    linear: float = 0.0
    cubic: float = 0.0
    asymmetry: float = 0.0
    drag: float = 0.0
    load: float = 0.0
    gap: float = 0.0
    weight: float = 0.0
    turned: float = 0.0

    def overcome(self, x: Real, v: Real, rest: Real) -> Real:
        """Force (T,) that a known motion takes against them, and a rest (T,) without them."""
        level = self.coulomb + self.excess * np.exp(-np.abs(v) / self.stribeck_velocity)
        dry = np.where(v > 0, level + self.up, np.where(v < 0, -level - self.down, 0.0))
        if self.gap > 0:
            behind = followed(np.ascontiguousarray(x), 0.5 * self.gap, float(x[0]))
            dry = np.where(v * (x - behind) >= _NEARLY * 0.5 * self.gap * np.abs(v), dry, 0.0)
        unbalanced = self.weight * (np.sin(x + self.turned) - np.sin(self.turned))
        smooth = (self.viscous + self.drag * np.abs(v)) * v + self.asymmetry * np.abs(v)
        whole = rest + dry + smooth + self.linear * x + self.cubic * x**3 + unbalanced
        # The commanded force is the whole one: more of it is lost where it drives than where it brakes.
        return np.asarray(whole / (1 - self.load * np.sign(v) * np.sign(whole)) - rest)

    @property
    def smooth(self) -> bool:
        """Whether there are some that change little within a sample."""
        return any((self.viscous, self.linear, self.cubic, self.asymmetry, self.drag, self.weight))


def _logarithm(matrix: Real) -> Real:
    """Real part of the principal logarithm: by eigenvectors, ten times as fast, where that loses no more than
    a few digits."""
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
        """head (ahead + n,): of the filter from force to what is simulated; None without poles."""
        n, numerator = poles.size, head[ahead:]
        if n == 0:
            return None
        held = np.zeros((n + 1, n + 1))
        held[:n, 0], held[:n, n], held[n, n] = poles, numerator, 1.0
        held[: n - 1, 1:n] = np.eye(n - 1)
        rates = _logarithm(held)
        own, command = rates[:n, :n], rates[:n, n]
        at_once, later = command[0], own[0] @ command
        early = 0.0 if of_speed or abs(at_once) > abs(later) else at_once / later
        force = scipy.linalg.expm(-early * own) @ command
        # Position of a speed is one more state.
        N = n + of_speed
        generator, rows = np.zeros((N + 2, N + 2)), np.zeros((2, N))
        generator[:n, :n], generator[:n, N], generator[:n, N + 1] = own, command, force
        if of_speed:
            generator[n, 0] = dt_s
            rows[0, n], rows[1, 0] = 1.0, 1.0
        else:
            rows[0, 0], rows[1, :n] = 1.0, own[0] / dt_s
        return cls(generator, rows, early, poles, numerator, ahead, dt_s, of_speed)

    @cached_property
    def turns(self) -> tuple[float, float, float]:
        """Radians that it swings by in a sample; position and speed after a unit force over one."""
        step = scipy.linalg.expm(self.generator)
        swing = float(np.max(np.abs(np.angle(np.linalg.eigvals(step[:-2, :-2])))))
        moved = self.rows @ step[:-2, -1]
        return swing, float(moved[0]), float(moved[1])

    def parts(self, forces: BodyForces, largest: float) -> int:
        """Of a sample, enough for the trapezoidal rule beside motion up to `largest`; powers of two, so that
        small changes of parameters seldom change them."""
        if not forces.smooth:
            return 1
        swing, gx, gv = self.turns
        stiffness = abs(forces.linear) + 3 * abs(forces.cubic) * largest**2 + abs(forces.weight)
        turned = np.hypot(swing, np.sqrt(2 * abs(gx) * stiffness))
        finer = max(turned, (abs(forces.viscous) + abs(forces.asymmetry)) * abs(gv), _TURNED) / _TURNED
        return int(2 ** min(np.ceil(np.log2(finer)), _MOST_PARTS))

    def answer(
        self, simulated: Real, force: Real, command: Real, forces: BodyForces
    ) -> tuple[Real, Real, Real]:
        """Held forces (T,) as good as those that act, the motion (T,) with these, and what a simulation of
        the former has in its place; simulated (T,): under the force (T,) of the round before."""
        head, own = (
            np.concatenate([np.zeros(self.ahead), self.numerator]),
            np.concatenate([[1.0], -self.poles]),
        )
        beyond = np.asarray(simulated - scipy.signal.lfilter(head, own, force))
        travel = np.cumsum(simulated) * self.dt_s if self.of_speed else simulated
        parts = self.parts(forces, float(np.max(np.abs(travel))))
        if parts not in self._steps:
            step = scipy.linalg.expm(self.generator / parts)
            of_states, of_command, of_force = step[:-2, :-2], step[:-2, -2], step[:-2, -1]
            self._steps[parts] = (of_states.copy(), of_command.copy(), of_force.copy())
        of_states, of_command, of_force = self._steps[parts]
        # Slopes of fourth order, to go through parts of samples along cubics.
        slopes = np.gradient(beyond)
        slopes[2:-2] = (8 * (beyond[3:-1] - beyond[1:-3]) - beyond[4:] + beyond[:-4]) / 12
        held, moment, x, v = _through(
            beyond,
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
            forces,
        )
        # What comes early or late in a sample moves the body as a pair of forces around it does.
        moment += self.early * held
        held[1:] += 0.5 * moment[:-1]
        held[:-1] -= 0.5 * moment[1:]
        return held, v if self.of_speed else x, beyond + scipy.signal.lfilter(head, own, command + held)


@dataclass(frozen=True, eq=False)
class PulseResponse:
    """Position and speed (L,) after a unit force over one sample; `ahead` samples before speed shows it.

    corrections : (2,) what a force in this sample and the one before adds to central differences of position.
    linear : the same as of a linear body, where it is one.
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

        Raises NotFollowedError if the force does not move the body at once, or the motion is no number.
        """
        h = motion[1:]
        at_once, corrections = abs(h[0]) > _AT_ONCE * abs(h[1]), np.zeros(2)
        if of_speed:
            speed, position = h, np.cumsum(h) * dt_s
            position = position - 0.5 * dt_s * h
        else:
            speed, position = np.gradient(h, dt_s), h
            speed[0] = 0.5 * h[1] / dt_s
            if not at_once:
                speed[0], speed[1] = 0.0, (-3 * h[1] + 4 * h[2] - h[3]) / (2 * dt_s)
                corrections = np.array([0.5 * h[1] / dt_s, 0.5 * h[2] / dt_s - speed[1]])
        ahead = 0 if at_once else 1
        largest = np.max(np.abs(speed[:20]))
        if not (np.all(np.isfinite(motion)) and abs(speed[ahead]) > 0.1 * largest):
            raise NotFollowedError(
                "friction and springs need a force that moves the body at once; the simulated motion follows "
                "the stated input later, or its steps are too coarse for a pulse of one sample"
            )
        kept = np.abs(speed) > _FORGOTTEN * largest
        kept |= np.abs(position) > _FORGOTTEN * np.max(np.abs(position))
        last = int(np.flatnonzero(kept)[-1]) + 1
        position, speed = position[:last], speed[:last]
        linear = LinearBody.of(
            *_filter(speed if of_speed else position, ahead), ahead, dt_s, of_speed=of_speed
        )
        return cls(position, speed, corrections, ahead, dt_s, of_speed, linear)

    @property
    def doubt(self) -> str:
        """Why smooth forces act less exactly, "" where they do not."""
        k, few = self.ahead, self.speed.size < self.ahead + 3
        # An oscillation has fewer than six samples per period.
        if few or (self.speed[k + 1] < 0 if self.of_speed else self.position[k + 2] < self.position[k]):
            return "turns back within two samples"
        return "" if self.linear else f"is not one of {_ORDERS[-1]} poles or fewer"

    def answer(
        self, simulated: Real, force: Real, command: Real, forces: BodyForces
    ) -> tuple[Real, Real, Real]:
        """The same as `LinearBody.answer`, the motion being that of a simulation under held forces."""
        seen = self.motion(simulated, force)
        held, x, v = _solve(*seen, force - command, command, self.position, self.speed, self.ahead, forces)
        motion = v if self.of_speed else x
        return held, motion, motion

    def motion(self, simulated: Real, force: Real) -> tuple[Real, Real]:
        """Position and speed (T,) of what was simulated (T,) under a force (T,)."""
        if self.of_speed:
            steps = 0.5 * self.dt_s * (simulated[1:] + simulated[:-1])
            return np.concatenate([[0.0], np.cumsum(steps)]), simulated
        speed = np.gradient(simulated, self.dt_s)
        now, before = self.corrections
        speed[1:-1] -= now * force[1:-1] + before * force[:-2]
        speed[0] -= 2 * now * force[0]
        speed[-1] = speed[-2]
        return simulated, speed


def _filter(response: Real, ahead: int) -> tuple[Real, Real]:
    """Poles (P,) and numerator (M,) of the filter of lowest order with this response (L,), from the first
    sample that counts on, and a continuous equivalent; without poles, the response."""
    largest = np.max(np.abs(response))
    h = response / largest
    h[:ahead] = 0.0
    L, pulse = h.size, np.zeros(h.size)
    pulse[0] = 1.0
    closest, found = _CLOSE, (np.zeros(0), h)
    # As close to small beginnings as to what they become.
    counts = 1 / np.maximum(np.maximum.accumulate(np.abs(h)), 1e-6)
    for order in _ORDERS:
        first = 2 * order + 4
        if 2 * first > L:
            break
        rows = np.unique(np.linspace(first, L - 2, _FITTED).astype(int))
        before = h[rows[:, None] - np.arange(1, order + 1)]
        poles = np.linalg.lstsq(before * counts[rows, None], h[rows] * counts[rows], rcond=None)[0]
        own = np.concatenate([[1.0], -poles])
        roots = np.roots(own)
        if np.max(np.abs(roots)) > _UNSTABLE or np.any((roots.real <= 0) & (np.abs(roots.imag) < _REAL)):
            continue
        rows = np.concatenate([np.arange(ahead, first), rows])
        alone = scipy.signal.lfilter([1.0], own, pulse)
        if not np.max(np.abs(alone)) < _GROWS:
            continue  # faster than any response that ends at one
        delayed = np.column_stack(
            [np.concatenate([np.zeros(j), alone[: L - j]]) for j in range(ahead, ahead + order)]
        )
        head = np.linalg.lstsq(delayed[rows] * counts[rows, None], h[rows] * counts[rows], rcond=None)[0]
        # What it lacks at the very end is what a response lacks that has been cut there.
        missed = np.max((np.abs(delayed @ head - h) * counts)[ahead:-1])
        if missed < closest:
            closest, found = missed, (poles, np.concatenate([np.zeros(ahead), head]))
        if closest < _EXACT:
            break
    return found[0], found[1] * largest


def with_forces(
    simulate: Callable[[Real], tuple[Real, Real]],
    free: tuple[Real, Real],
    command: Real,
    response: PulseResponse,
    forces: BodyForces,
    placed: Callable[[Real, Real], Real],
    *,
    alone: bool,
) -> tuple[Real, float]:
    """Outputs (T, Y) with the forces acting, and what the last round still moved, over what they change.

    simulate : force (T,) -> outputs (T, Y), motion (T,). command : force (T,) without the forces; free : what
    it gives. placed : outputs with another motion in them; alone : whether there are no others.
    """
    body, held = response.linear or response, np.zeros(command.size)
    outputs, now = free
    before, error = np.inf, np.inf
    for _ in range(_ROUNDS):
        if not np.all(np.isfinite(now)):
            return outputs, np.inf
        held, motion, expected = body.answer(now, command + held, command, forces)
        if not np.all(np.isfinite(motion)):
            return outputs, np.inf
        if alone and before < np.inf and error / before * error < _FORETOLD:
            # As much closer again, what the next simulation would say is known.
            return placed(outputs, motion), error / before * error
        before = error
        outputs, now = simulate(command + held)
        error = _rms(now - expected) / max(_rms(motion - free[1]), 1e-300)
        if error < (_FORETOLD if alone else _CONVERGED) or 0.5 * before < error < _SETTLED:
            break
    return placed(outputs, now + motion - expected), error


def _rms(x: Real) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # of a trial that runs away
        return float(np.sqrt(x @ x / x.size))


@njit(cache=True, fastmath={"reassoc", "contract"})
def _solve(
    position: Real,
    speed: Real,
    held: Real,
    command: Real,
    hx: Real,
    hv: Real,
    ahead: int,
    forces: BodyForces,
) -> tuple[Real, Real, Real]:
    """Forces (T,), positions and speeds (T,) with them, from those under the forces `held`."""
    T = position.size
    f, x, v = held.copy(), position.copy(), speed.copy()
    change = np.zeros(T)
    gx, gv, at, half = hx[ahead], hv[ahead], 0.0, 0.5 * forces.gap
    for k in range(T - ahead):
        n = k + ahead
        dx, dv = 0.0, 0.0
        for j in range(max(0, n - hv.size + 1), k):
            dx += hx[n - j] * change[j]
            dv += hv[n - j] * change[j]
        ax, av = position[n] + dx - gx * held[k], speed[n] + dv - gv * held[k]
        x0, v0 = (x[n - 1], v[n - 1]) if n > 0 else (ax, av)
        at = x0 if k == 0 else at
        f[k], x[n], v[n] = _acted(ax, av, x0, v0, gx, gv, command[k], at, forces)
        at = min(max(at, x[n] - half), x[n] + half)
        change[k] = f[k] - held[k]
    return f, x, v


@njit(cache=True)
def _acted(
    ax: float,
    av: float,
    x0: float,
    v0: float,
    gx: float,
    gv: float,
    command: float,
    at: float,
    forces: BodyForces,
) -> tuple[float, float, float]:
    """Mean force over a sample or a part of one, position and speed at its end.

    ax, av : there without the forces; x0, v0 : at its start; gx, gv : what a unit force adds; at : where what
    rubs behind the play stands.
    """
    coulomb, excess, falls, up, down, viscous, linear, cubic, asymmetry, drag, load, gap, weight, turned = (
        forces
    )
    coulomb += load * abs(command)
    rubs_up, rubs_down = _beyond(x0, ax, at, 0.5 * gap), _beyond(-x0, -ax, -at, 0.5 * gap)
    f, x1, end, level = 0.0, x0, v0, coulomb
    for _ in range(2 if excess > 0 or cubic > 0 or asymmetry != 0 or drag > 0 or weight != 0 else 1):
        # Smooth forces by the trapezoidal rule, those not linear by their tangents at the end.
        stiffness = linear + 3 * cubic * x1 * x1 + weight * np.cos(x1 + turned)
        middle = 0.5 * (v0 + end)
        slope = viscous + asymmetry * np.sign(middle) + drag * abs(middle)
        divisor = 1 + 0.5 * (slope * gv + stiffness * gx)
        smooth = -0.5 * (slope * (v0 + av) + linear * x0 + stiffness * ax)
        smooth += cubic * (x1**3 - 0.5 * x0**3)
        if weight != 0:
            sines = np.sin(x0 + turned) + np.sin(x1 + turned) - 2 * np.sin(turned)
            smooth -= 0.5 * weight * (sines - np.cos(x1 + turned) * x1)
        a, g = av + gv * smooth / divisor, gv / divisor
        if excess > 0:
            level = coulomb + excess * np.exp(-0.5 * (abs(v0) + abs(end)) / falls)
        held = (excess + coulomb - level) * max(rubs_up, rubs_down)
        end, dry = _dry(v0, a, g, (level + up) * rubs_up, (level + down) * rubs_down, held)
        f = (smooth + dry) / divisor
        x1 = ax + gx * f
    return f, x1, end


@njit(cache=True)
def _beyond(x0: float, ax: float, at: float, half: float) -> float:
    """Share of the way from x0 to ax on which a body has taken what rubs along, upwards."""
    if half <= 0.0:
        return 1.0
    if ax <= x0:
        return 1.0 if x0 >= at + half else 0.0
    return min(max((ax - at - half) / (ax - x0), 0.0), 1.0)


@njit(cache=True)
def followed(signal: Real, half: float, at: float) -> Real:
    """(T,) what follows a signal (T,) at a distance of `half`, from the middle."""
    found = np.empty_like(signal)
    for k in range(signal.size):
        at = min(max(at, signal[k] - half), signal[k] + half)
        found[k] = at
    return found


@njit(cache=True)
def _dry(v0: float, a: float, g: float, up: float, down: float, at_rest: float) -> tuple[float, float]:
    """Speed at the end of a sample and mean dry friction in it.

    v0: speed at its start. a: at its end without friction; g: per force. up, down: levels against motion up
    and down; at_rest: how much more is held at rest.
    """
    if v0 < 0:
        end, f = _slowed(-v0, -a, g, down, up, at_rest)
        return -end, -f
    if v0 > 0:
        return _slowed(v0, a, g, up, down, at_rest)
    if a > g * (up + at_rest):
        return a - g * up, -up
    if a < -g * (down + at_rest):
        return a + g * down, down
    return 0.0, -a / g


@njit(cache=True)
def _slowed(v0: float, a: float, g: float, up: float, down: float, at_rest: float) -> tuple[float, float]:
    end = a - g * up
    if end >= 0:
        return end, -up
    pulled = a - v0
    if pulled >= -g * (down + at_rest):
        return 0.0, -a / g
    share = v0 / (g * up - pulled)
    return (1 - share) * (pulled + g * down), (1 - share) * down - share * up


@njit(cache=True, fastmath={"reassoc", "contract"})
def _through(
    beyond: Real,
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
    forces: BodyForces,
) -> tuple[Real, Real, Real, Real]:
    """Means and moments of the forces in every sample (T,), positions and speeds (T,); beyond, slopes (T,):
    position or speed beside the response to forces, and by how much it changes per sample."""
    T, N = command.size, pushed.size
    mean, moment, x, v = np.zeros(T), np.zeros(T), np.zeros(T), np.zeros(T)
    state, moved = np.zeros(N), np.zeros(N)
    of_x, of_v = rows[0], rows[1]
    gx, gv = 0.0, 0.0
    for i in range(N):
        gx += of_x[i] * pushed[i]
        gv += of_v[i] * pushed[i]
    travelled, half = 0.0, 0.5 * forces.gap
    x0, v0 = (0.0, beyond[0]) if of_speed else (beyond[0], slopes[0] / dt_s)
    at = x0
    if ahead == 1:
        x[0], v[0] = x0, v0
    for k in range(T - ahead):
        # A cubic from sample to sample; before the first nothing is known to move.
        n = k + ahead
        start, end_value = beyond[max(n - 1, 0)], beyond[n]
        rise, last = (slopes[n - 1], slopes[n]) if n > 0 else (0.0, 0.0)
        bend = 3 * (end_value - start) - 2 * rise - last
        twist = rise + last - 2 * (end_value - start)
        for part in range(parts):
            t = (part + 1) / parts
            value = start + t * (rise + t * (bend + t * twist))
            if of_speed:
                way = t * (start + t * (rise / 2 + t * (bend / 3 + t * twist / 4)))
                ax, av = travelled + dt_s * way, value
            else:
                ax, av = value, (rise + t * (2 * bend + 3 * t * twist)) / dt_s
            for i in range(N):
                moved[i] = commanded[i] * command[k]
                for j in range(N):
                    moved[i] += step[i, j] * state[j]
                ax += of_x[i] * moved[i]
                av += of_v[i] * moved[i]
            f, x1, end = _acted(ax, av, x0, v0, gx, gv, command[k], at, forces)
            at = min(max(at, x1 - half), x1 + half)
            for i in range(N):
                state[i] = moved[i] + pushed[i] * f
            mean[k] += f / parts
            moment[k] += f * ((part + 0.5) / parts - 0.5) / parts
            x0, v0 = x1, end
        if of_speed and n > 0:
            travelled += dt_s * (start + rise / 2 + bend / 3 + twist / 4)
        x[n], v[n] = x0, v0
    return mean, moment, x, v
