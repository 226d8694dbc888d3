"""Friction and springs on a body inside a simulation that knows neither: force in, motion out.

Wanted is u = command - F(x(u), v(u)) over a record, where a simulation gives x(u) and nothing else. With its
response to a short pulse of force the equation is solved sample by sample, dry friction exactly (a body
sticks, slips, turns round inside a sample), then simulated with that force; where the simulation is not
linear, what it says is the start of the next round (Newton's method over a waveform, with one linear
response for all times).

Neglected: dry friction acts as its mean over each sample, and the speed between samples is linear. Of smooth
forces (springs, viscous friction) mean and moment over a sample are exact to fourth order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
from numba import njit
from scipy.signal import lfilter

from diagnosis.machine.machine_protocol import Real

_ROUNDS = 12
# Of the change that the effects make: what rounds may still move, or may where they no longer get closer (an
# integrator with a step of its own has noise).
_CONVERGED, _SETTLED = 1e-5, 0.01
# The same where a round costs no simulation: fits go on for a quarter longer where it is ten times as much.
_FORETOLD = 1e-6
# Share of the response to a pulse that, in its own sample, shows an input that acts before its row.
_AT_ONCE = 0.02
_FORGOTTEN = 1e-7
# Orders of filters that a response may be of: the first that has all of it to the first share, else the best
# to the second (rounds for the swing of a pendulum need no more). Samples that they are fitted to.
_ORDERS, _EXACT, _CLOSE = (2, 3, 4, 5), 1e-9, 1e-4
_FITTED = 100


class NotFollowedError(ValueError, ArithmeticError):
    """No force can be put around a simulation: wrong as stated, in a fit a trial that ran away."""


@dataclass(frozen=True)
class BodyForces:
    """Forces on a body against its motion, SI or whatever units force and motion have.

    Dry friction of size coulomb + excess exp(-|v| / stribeck_velocity), with `up` more while v > 0 and `down`
    more while v < 0, at rest up to coulomb + excess; viscous v; linear x + cubic x^3, x from zero.
    """

    coulomb: float = 0.0
    excess: float = 0.0
    stribeck_velocity: float = 1.0
    up: float = 0.0
    down: float = 0.0
    viscous: float = 0.0
    linear: float = 0.0
    cubic: float = 0.0

    def overcome(self, x: Real, v: Real) -> Real:
        """Force (T,) that a known motion takes against them."""
        level = self.coulomb + self.excess * np.exp(-np.abs(v) / self.stribeck_velocity)
        dry = np.where(v > 0, level + self.up, np.where(v < 0, -level - self.down, 0.0))
        return np.asarray(dry + self.viscous * v + self.linear * x + self.cubic * x**3)

    @property
    def smooth(self) -> bool:
        """Whether there are some that change little within a sample."""
        return self.viscous != 0 or self.linear != 0 or self.cubic != 0

    def within_samples(self, x: Real, v: Real, acting: Real, response: PulseResponse) -> Real:
        """What smooth forces (T,), held over each sample, lack by the trapezoidal rule. acting: all.

        Means need the slopes at both ends of a sample (Euler and Maclaurin). That they push early or late in
        it moves a body as a force of minus a twelfth of their second difference does.
        """
        dt, ahead = response.dt_s, response.ahead
        exact = x
        if response.of_speed:
            # Speed bends within samples, but for its kinks where the held force jumps.
            kink = 0.5 * (3 * response.speed[ahead] - response.speed[ahead + 1])
            bent = np.zeros(x.size)
            bent[1:-1] = np.diff(v, 2) - kink * np.diff(acting)[1 - ahead : x.size - 1 - ahead]
            exact = x.copy()
            exact[1:] -= np.cumsum(bent[1:] + bent[:-1]) * dt / 24
        pull, by_rule = (self.linear * y + self.cubic * y * y * y for y in (exact, x))
        slope = (self.linear + 3 * self.cubic * exact * exact) * v
        lacks = dt / 12 * np.diff(slope) + 0.5 * (by_rule - pull)[1:] + 0.5 * (by_rule - pull)[:-1]
        lacks += self.viscous * (0.5 * (v[1:] + v[:-1]) - np.diff(exact) / dt)
        steps = np.diff(pull + self.viscous * v)
        lacks[1:-1] += (steps[2:] - steps[:-2]) / 24
        found = np.zeros(x.size)
        found[1 - ahead : x.size - ahead] = lacks
        return found


@dataclass(frozen=True, eq=False)
class PulseResponse:
    """Position and speed (L,) after a unit force over one sample; `ahead` samples before speed shows it.

    corrections : (2,) what a force in this sample and the one before adds to central differences of position.
    recursion : poles (P,), and (M,) of position and of speed, as of a filter; without poles, the responses.
    """

    position: Real
    speed: Real
    corrections: Real
    ahead: int
    dt_s: float
    of_speed: bool
    recursion: tuple[Real, Real, Real]

    @classmethod
    def of(cls, motion: Real, dt_s: float, *, of_speed: bool) -> PulseResponse:
        """motion (T,): change of the motion per force, the pulse in its second sample.

        Raises NotFollowedError if the force does not move the body at once, or the motion is no number.
        """
        h = motion[1:]
        at_once = abs(h[0]) > _AT_ONCE * abs(h[1])
        corrections = np.zeros(2)
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
        return cls(position, speed, corrections, ahead, dt_s, of_speed, _recursion(position, speed, ahead))

    @property
    def coarse(self) -> bool:
        """Whether an oscillation has fewer than six samples per period: it turns back by the second."""
        k, few = self.ahead, self.speed.size < self.ahead + 3
        return bool(
            few or (self.speed[k + 1] < 0 if self.of_speed else self.position[k + 2] < self.position[k])
        )

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


def _recursion(position: Real, speed: Real, ahead: int) -> tuple[Real, Real, Real]:
    """The cheapest filter with these responses (L,), from the first that counts on."""
    responses = np.stack([position / np.max(np.abs(position)), speed / np.max(np.abs(speed))])
    responses[:, :ahead] = 0.0
    L, closest, found = speed.size, _CLOSE, (np.zeros(0), *responses)
    pulse = np.zeros(L)
    pulse[0] = 1.0
    for order in _ORDERS:
        # Speeds by differences are none of the filter in the first samples, nor in the last.
        first = 2 * order + 4
        if 2 * first > L:
            break
        rows = np.unique(np.linspace(first, L - 2, _FITTED).astype(int))
        before = np.concatenate([h[rows[:, None] - np.arange(1, order + 1)] for h in responses])
        poles = np.linalg.lstsq(before, responses[:, rows].ravel(), rcond=None)[0]
        own = np.concatenate([[1.0], -poles])
        heads = lfilter(own, [1.0], responses[:, :first])
        missed = np.max(
            [np.abs(lfilter(b, own, pulse) - h)[:-1] for b, h in zip(heads, responses, strict=True)]
        )
        if missed < closest:
            closest, found = missed, (poles, *heads)
        if missed < _EXACT:
            break
    return found[0], found[1] * np.max(np.abs(position)), found[2] * np.max(np.abs(speed))


def with_forces(
    simulate: Callable[[Real], tuple[Real, Real]],
    free: tuple[Real, Real],
    command: Real,
    response: PulseResponse,
    forces: BodyForces,
    alone: Callable[[Real], Real] | None = None,
) -> tuple[Real, float]:
    """Outputs (T, Y) with the forces acting, and what the last round still moved, over what they change.

    simulate : force (T,) -> outputs (T, Y), motion (T,). command : force (T,) without the forces; free : what
    it gives. alone : outputs of a motion, where there are no others.
    """
    held, extra = np.zeros(command.size), np.zeros(command.size)
    sizes, k = astuple(forces), int(response.of_speed)
    outputs, now = free
    seen, before, error = response.motion(now, command), np.inf, np.inf
    for _ in range(_ROUNDS):
        if not np.all(np.isfinite(now)):
            return outputs, np.inf
        base, unsettled = held, 0.0
        for _ in range(_ROUNDS):
            held, x, v = _solve(*seen, base, extra, *response.recursion, response.ahead, *sizes)
            if not forces.smooth:
                break
            with np.errstate(over="ignore", invalid="ignore"):
                last, extra = extra, forces.within_samples(x, v, command + held, response)
                unsettled = _rms(extra - last) / max(_rms(held), 1e-300)
            if not unsettled > _FORETOLD:
                break
        if not np.isfinite(unsettled):
            return outputs, np.inf
        if alone is not None and before < np.inf and error / before * error < _FORETOLD:
            # As much closer again, what the next simulation would say is known.
            return alone((x, v)[k]), error / before * error
        before = error
        outputs, now = simulate(command + held)
        seen = response.motion(now, command + held)
        error = unsettled + _rms(seen[k] - (x, v)[k]) / max(_rms(now - free[1]), 1e-300)
        if error < (_FORETOLD if alone else _CONVERGED) or 0.5 * before < error < _SETTLED:
            break
    return outputs, error


def _rms(x: Real) -> float:
    return float(np.sqrt(x @ x / x.size))


@njit(cache=True, fastmath={"reassoc", "contract"})
def _solve(
    position: Real,
    speed: Real,
    held: Real,
    extra: Real,
    poles: Real,
    hx: Real,
    hv: Real,
    ahead: int,
    coulomb: float,
    excess: float,
    falls: float,
    up: float,
    down: float,
    viscous: float,
    linear: float,
    cubic: float,
) -> tuple[Real, Real, Real]:
    """Forces (T,), positions and speeds (T,) with them, from those under the forces `held`."""
    T = position.size
    f, x, v = held.copy(), position.copy(), speed.copy()
    change, moved_x, moved_v = np.zeros(T), np.zeros(T), np.zeros(T)
    gx, gv = hx[ahead], hv[ahead]
    for k in range(T - ahead):
        n = k + ahead
        dx, dv = 0.0, 0.0
        for j in range(max(0, n - hv.size + 1), k):
            dx += hx[n - j] * change[j]
            dv += hv[n - j] * change[j]
        for i in range(min(poles.size, n)):
            dx += poles[i] * moved_x[n - 1 - i]
            dv += poles[i] * moved_v[n - 1 - i]
        ax, av = position[n] + dx - gx * held[k], speed[n] + dv - gv * held[k]
        x0, v0 = (x[n - 1], v[n - 1]) if n > 0 else (ax, av)
        end, dry, x1 = v0, 0.0, x0
        for _ in range(3 if excess > 0 or cubic > 0 else 1):
            # Smooth forces by the trapezoidal rule, the cubic one by its tangent at the end.
            stiffness = linear + 3 * cubic * x1 * x1
            divisor = 1 + 0.5 * (viscous * gv + stiffness * gx)
            smooth = extra[k] - 0.5 * (viscous * (v0 + av) + linear * x0 + stiffness * ax)
            smooth += cubic * (x1**3 - 0.5 * x0**3)
            a, g = av + gv * smooth / divisor, gv / divisor
            level = coulomb + excess * np.exp(-0.5 * (abs(v0) + abs(end)) / falls)
            end, dry = _dry(v0, a, g, level + up, level + down, excess + coulomb - level)
            f[k] = (smooth + dry) / divisor
            x1 = ax + gx * f[k]
        x[n], v[n] = x1, end
        change[k] = f[k] - held[k]
        moved_x[n], moved_v[n] = dx + gx * change[k], dv + gv * change[k]
    return f, x, v


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
