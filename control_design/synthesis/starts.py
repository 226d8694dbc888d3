"""Where the search starts from: random low-gain loops, loops shaped by hand-book rules, and for unstable
plants loops that a search for stability has found.

A start is worth the more the closer it already is to what is asked. The *shaped* starts wish for a loop gain
L where the specification speaks: large and positive real at the peak of a mode that is to be damped (1 + L =
peak over allowed peak, so L points away from -1), falling like an integrator where tracking is asked, small
elsewhere. Poles are drawn at random; the numerator that comes nearest to the wishes is linear least squares.
Many are drawn, few kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from control_design.analysis.worst_case import PlantData
from control_design.controllers.biquads import Cascade, SectionKind, tustin_frequency
from control_design.plants.ellipses import Complex, Real
from control_design.plants.frequency_grid import local_maxima
from control_design.specification.requirement import LoopFunction
from control_design.specification.specification import ModulusMargin
from ident.data.arrays import real_rows

_DECADES_OF_TRACKING = 1.5  # below the crossover, in which the integrator-like loop is wished for
_DRAWN_UNSTABLE, _FOLLOWED = 400, 12  # loops around unstable poles drawn, and led to stability
_HIGHEST = 0.95  # of Nyquist: the Tustin frequency has its pole there


class StartMaker:
    """Draws parameter vectors of one cascade for given plants; all randomness comes from `rng`.

    data: every plant on a lean grid. score: worst case of a parameter vector, inf where a loop is unstable.
    keeps_sign: the gain at low frequency has to be positive (tracking or integrators).
    """

    def __init__(
        self,
        cascade: Cascade,
        data: Sequence[PlantData],
        integrators: int,
        score: Callable[[Real], float],
        rng: np.random.Generator,
        *,
        controller_damping: float | None,
        keeps_sign: bool,
    ) -> None:
        self.cascade, self.data, self.integrators = cascade, data, integrators
        self.score, self.rng = score, rng
        self.least_damping = controller_damping or 0.0
        self.keeps_sign = keeps_sign
        self.tracks = any(np.any(part.sensitivity > 1.0) for part in data)

    # Shaped starts

    def shaped(self, draws: int, most: int) -> list[tuple[Real, float]]:
        """Best `most` different ones of `draws` shaped loops: (parameters, score), the best first."""
        if "notch" in self.cascade.sections or self.integrators >= 2:
            return []
        pool: list[tuple[Real, float]] = []
        for _ in range(draws):
            parameters = self._shaped()
            if parameters is None:
                continue
            gamma = self.score(parameters)
            if not np.isfinite(gamma):
                parameters = with_gain(self.cascade, parameters, 0.4)
                gamma = self.score(parameters)
            if np.isfinite(gamma):
                pool.append((parameters, gamma))
        pool.sort(key=lambda entry: entry[1])
        return self._different(pool, most)

    def _different(self, pool: Sequence[tuple[Real, float]], most: int) -> list[tuple[Real, float]]:
        """Greedy: drop what has nearly the loop gain of something better."""
        kept: list[tuple[Real, float]] = []
        loops: list[Complex] = []
        data = self.data[0]
        for parameters, gamma in pool:
            k = self.cascade.response(parameters, data.ellipses.omega_rad_s) * data.delay
            sensitivity = 1.0 / (1.0 + k * data.ellipses.centre)
            if all(float(np.mean(np.abs(sensitivity - other))) > 0.05 for other in loops):
                kept.append((parameters, gamma))
                loops.append(sensitivity)
            if len(kept) == most:
                break
        return kept

    def _shaped(self) -> Real | None:
        """One draw: wishes, poles, least squares, numerator dealt to sections; None if nothing is wished."""
        parts = [self._wishes(data) for data in self.data]
        omega, wanted, weight = (np.concatenate([part[i] for part in parts]) for i in range(3))
        if not np.any(np.abs(wanted) > 0):
            return None
        p = 1j * tustin_frequency(omega, self.cascade.dt_s) / self.cascade.scale_rad_s
        low, high = self._corner_range()
        denominators: list[Real] = []
        for kind in self.cascade.sections:
            corner = np.exp(self.rng.uniform(np.log(low), np.log(high)))
            damping = max(10 ** self.rng.uniform(-1.0, 0.1), self.least_damping * 1.01)
            if kind == "integrator":
                denominators.append(np.array([1.0, 0.0]))
            elif kind == "first_order":
                denominators.append(np.array([1.0, corner]))
            else:
                denominators.append(np.array([1.0, 2 * damping * corner, corner**2]))
        whole = np.ones(p.size, dtype=np.complex128)
        for denominator in denominators:
            whole = whole * np.polyval(denominator, p)
        n = self.cascade.order
        columns = np.stack([p**power / whole for power in range(n, -1, -1)], axis=1) * weight[:, None]
        size = np.linalg.norm(columns, axis=0)
        solution = np.linalg.lstsq(real_rows(columns) / size, real_rows(wanted * weight), rcond=1e-9)[0]
        return in_sections(self.cascade.sections, solution / size, denominators)

    def _wishes(self, data: PlantData) -> tuple[Real, Complex, Real]:
        """(omega, wanted K, weight), each (n,), for one plant on its lean grid."""
        grid = data.ellipses.omega_rad_s
        usable = grid < _HIGHEST * data.plant.nyquist_rad_s
        plant = data.ellipses.centre * data.delay
        peak = data.open_loop_disturbance
        omega: list[Real] = []
        wanted: list[Complex] = []
        weight: list[Real] = []
        lowest = 0.0
        tracked = np.flatnonzero(data.sensitivity > 1.0)
        if tracked.size:
            crossover = grid[tracked[-1]] * self.rng.uniform(0.7, 2.0)
            lowest = crossover
            use = usable & (grid < crossover) & (grid > crossover * 10**-_DECADES_OF_TRACKING)
            k = crossover / (1j * grid[use]) / plant[use]
            omega, wanted, weight = [grid[use]], [k], [1.0 / np.abs(k)]
        for index in local_maxima(peak):
            if not (usable[index] and peak[index] > 1.0):
                continue
            excess = max(peak[index] * self.rng.uniform(1.0, 2.0) - 1.0, 0.2)
            k = np.array([excess * np.exp(1j * self.rng.normal(0.0, 0.4)) / plant[index]])
            omega.append(grid[index : index + 1])
            wanted.append(k)
            weight.append(10.0 / np.abs(k))
        quiet = usable & (grid > lowest)
        strength = 10 ** self.rng.uniform(-1.5, 0.0)
        omega.append(grid[quiet])
        wanted.append(np.zeros(int(np.sum(quiet)), dtype=np.complex128))
        small_loop = data.of(ModulusMargin) * np.minimum(np.abs(plant), 1e3)
        weight.append(strength * np.maximum(data.largest(LoopFunction.EFFORT), small_loop)[quiet])
        if peak.max(initial=0.0) > 1.0:  # where the mode is to be damped, a large L is no harm
            weight[-1] = weight[-1] / np.maximum(1.0, peak[quiet]) ** 2
        return np.concatenate(omega), np.concatenate(wanted), np.concatenate(weight)

    def _corner_range(self) -> tuple[float, float]:
        """Corners of random poles in p: 0.3 of the lowest frequency spoken of to 3 times the highest."""
        spoken: list[float] = [self.cascade.scale_rad_s]
        for data in self.data:
            spoken += [m.omega_rad_s for m in data.plant.modes[:1]]
            band = data.ellipses.omega_rad_s[data.open_loop_disturbance > 0]
            spoken += [] if band.size == 0 else [float(band[0]), float(band[-1])]
        ceiling = 0.9 * self.data[0].plant.nyquist_rad_s
        high = float(tustin_frequency(np.array([min(max(spoken), ceiling)]), self.cascade.dt_s)[0])
        return 0.3 * min(spoken) / self.cascade.scale_rad_s, 3.0 * high / self.cascade.scale_rad_s

    # Random starts

    def low_gain(self) -> Real:
        """A random low-gain cascade with stable nominal loops: smaller gains, or slower leads, until it is
        stable."""
        crossover = 10 ** self.rng.uniform(-0.7, 0.0)
        parameters = self._random_sections()
        parameters = with_gain(self.cascade, parameters, self._low_gain(parameters))
        for _ in range(12):
            if self.integrators >= 2:
                # Less gain does not stabilise two integrators: a lead around a slower and slower crossover
                # does.
                parameters = self._lead_sections(crossover)
                gain = self._crossover_gain(parameters, crossover * self.cascade.scale_rad_s)
                parameters = with_gain(self.cascade, parameters, gain)
                crossover *= 0.6
            if np.isfinite(self.score(parameters)):
                break
            parameters = with_gain(self.cascade, parameters, 0.5)
        return parameters

    # Starts for plants that are unstable in open loop

    def stabilising(self, radius: Callable[[Real], float], most: int) -> list[Real]:
        """Up to `most` loops led to stability, those with the smallest worst case first.

        radius: largest pole modulus of the nominal loops of a parameter vector. Neither little gain nor much
        of it stabilises an unstable plant: the best of many leads and random sections around the unstable
        poles are taken and the radius is minimised from there, below 1 the share of |1 + L| that the
        ellipses leave (Nelder and Mead's simplex, as the radius has kinks).
        """

        def cost(x: Real) -> float:
            ringing = max(self.least_damping - self.cascade.least_damping(x), 0.0)
            found = radius(x)
            if not found < 1.0 or ringing > 0:
                return min(found, 1e6) + ringing
            left = 1.0
            for data in self.data:
                loop = self.cascade.response(x, data.ellipses.omega_rad_s) * data.delay
                back = np.abs(1.0 + loop * data.ellipses.centre)
                reach = np.abs(loop) * data.ellipses.semi_major
                left = min(left, float(np.min(back / (1.0 + reach / np.maximum(back, 1e-300)))))
            return 1.0 - left

        drawn = [self._around_unstable_poles() for _ in range(_DRAWN_UNSTABLE)]
        drawn = sorted(drawn, key=cost)[:_FOLLOWED]
        found: list[tuple[Real, float]] = []
        for x in drawn:
            # Steps in proportion to the parameters, of which some are logarithms near zero.
            size = np.where(np.abs(x) > 1e-3, 0.2 * np.abs(x), 0.1)
            end = _simplex(cost, np.vstack([x, x + np.diag(size)]), 200 * x.size)
            if np.isfinite(self.score(end)):  # on towards what is asked, over valleys the descent stays in
                around = np.vstack([end, end + np.diag(size)])
                end = _simplex(lambda x: float(np.log(min(self.score(x), 1e6))), around, 60 * x.size)
            found.append((end, self.score(end)))
            if sum(np.isfinite(gamma) for _, gamma in found) >= most:
                break
        found.sort(key=lambda entry: entry[1])
        return [x for x, _ in found[:most]]

    def _around_unstable_poles(self) -> Real:
        """Sections and a gain of either sign whose crossover lies at or above the unstable poles."""
        speeds = [
            float(np.max(np.abs(np.log(data.plant.poles[np.abs(data.plant.poles) > 1.0]))))
            for data in self.data
            if data.plant.unstable_poles
        ]
        nyquist = self.data[0].plant.nyquist_rad_s
        crossover = max(speeds, default=0.0) / self.cascade.dt_s * 10 ** self.rng.uniform(-0.1, 0.9)
        crossover = min(crossover, 0.6 * nyquist)
        kind = self.rng.uniform()
        if self.tracks and "integrator" not in self.cascade.sections and kind < 0.6:
            parameters = self._slow_lag_sections(crossover / self.cascade.scale_rad_s)
        elif "notch" in self.cascade.sections or kind < 0.8:
            parameters = self._lead_sections(crossover / self.cascade.scale_rad_s)
        else:
            parameters = self._random_sections()
        gain = abs(self._crossover_gain(parameters, crossover)) * 10 ** self.rng.uniform(-0.2, 0.5)
        return with_gain(self.cascade, parameters, gain * self.rng.choice([-1.0, 1.0]))

    def _slow_lag_sections(self, crossover: float) -> Real:
        """As `_lead_sections`, the first one with a slow real pole in place of an integrator, which tracking
        without one needs."""
        x, at = self._lead_sections(crossover), 0
        slow = crossover * 10 ** self.rng.uniform(-5.0, -2.0)
        low, high = crossover * 10 ** self.rng.uniform(-1.3, -0.3, 2), crossover * self.rng.uniform(3.0, 10.0)
        for kind in self.cascade.sections:
            if kind == "second_order":
                x[at : at + 3] = np.poly(-low)
                x[at + 3 : at + 5] = np.log([high + slow, high * slow])
                return x
            if kind == "first_order" and "second_order" not in self.cascade.sections:
                x[at : at + 3] = [1.0, low[0], np.log(slow)]
                return x
            at += Cascade((kind,), 1.0, 1.0).parameters
        return x

    def _random_sections(self) -> Real:
        """Sections with corners within a factor 5 of the scale, numerators near their denominators."""
        x: list[float] = []
        for kind in self.cascade.sections:
            corner = 10 ** self.rng.uniform(-0.7, 0.7)
            damping = max(self.rng.uniform(0.3, 1.0), self.least_damping * 1.01)
            jitter = 1.0 + 0.3 * self.rng.standard_normal(3)
            if kind == "integrator":  # proportional part first, slow integral action
                x += [jitter[0], 0.1 * corner * abs(jitter[1])]
            elif kind == "first_order":
                x += [jitter[0], corner * abs(jitter[1]), np.log(corner)]
            elif kind == "notch":
                x += [np.log(2 * damping * corner), np.log(2 * corner), 2 * np.log(corner)]
            else:
                numerator = np.array([1.0, 2 * damping * corner, corner**2]) * jitter
                x += [*numerator, np.log(2 * damping * corner), 2 * np.log(corner)]
        return np.array(x)

    def _lead_sections(self, crossover: float) -> Real:
        """PI far below, one lead (zero at a quarter, poles at four times) around the crossover, the rest near
        one."""
        x: list[float] = []
        lead_left = True
        for kind in self.cascade.sections:
            low, high = 0.25 * crossover, 4.0 * crossover
            jitter = 1.0 + 0.1 * self.rng.standard_normal(3)
            corner = 10 ** self.rng.uniform(-0.3, 0.7)
            if kind == "integrator":
                x += [1.0, 0.05 * crossover * jitter[0]]
            elif kind == "first_order":
                zero = low * jitter[0] if lead_left else corner * jitter[0]
                x += [1.0, zero, np.log(high if lead_left else corner)]
                lead_left = False
            elif kind == "notch":
                x += [np.log(1.8 * corner), np.log(2 * corner), 2 * np.log(corner)]
            elif lead_left:
                x += [0.0, high * jitter[0], high * low * jitter[1], np.log(2 * high), 2 * np.log(high)]
                lead_left = False
            else:
                numerator = np.array([1.0, 2 * corner, corner**2]) * jitter
                x += [*numerator, np.log(2 * corner), 2 * np.log(corner)]
        return np.array(x)

    def _low_gain(self, parameters: Real) -> float:
        """Signed factor that puts the centre's crossover at a random frequency below the scale."""
        crossover = self.cascade.scale_rad_s * 10 ** self.rng.uniform(-1.5, -0.3)
        gain = self._crossover_gain(parameters, crossover)
        if not self.keeps_sign:
            gain *= 1.0 if self.rng.uniform() < 0.5 else -1.0  # pure damping knows no sign
        return gain

    def _crossover_gain(self, parameters: Real, crossover_rad_s: float) -> float:
        """Factor that makes |L| = 1 at the crossover, signed so that arg L(0+) = -i pi/2 (i integrators)."""
        data = self.data[0]
        omega = data.ellipses.omega_rad_s
        loop = self.cascade.response(parameters, omega) * data.ellipses.centre
        size = float(np.abs(loop[int(np.argmin(np.abs(omega - crossover_rad_s)))]))
        return (1.0 if (loop[0] * 1j**self.integrators).real >= 0 else -1.0) / max(size, 1e-12)


def _simplex(cost: Callable[[Real], float], start: Real, evaluations: int) -> Real:
    """Least cost that Nelder and Mead's simplex finds from a simplex (n + 1, n)."""
    from scipy.optimize import minimize  # here: every command would wait for it

    options: Any = {"maxfev": evaluations, "initial_simplex": start, "adaptive": True, "fatol": 1e-4}
    return np.asarray(minimize(cost, start[0], method="Nelder-Mead", options=options).x, dtype=np.float64)


def with_gain(cascade: Cascade, parameters: Real, factor: float) -> Real:
    """The same controller times a factor (unchanged where the first section has no gain of its own)."""
    first = {"integrator": 2, "first_order": 2, "second_order": 3, "notch": 0}[cascade.sections[0]]
    scaled = np.array(parameters)
    scaled[:first] *= factor
    return scaled


def with_cancelling_section(
    lower: Cascade, parameters: Real, higher: Cascade, rng: np.random.Generator, *, damping: float = 0.8
) -> Real:
    """The same controller in a cascade with one section of order two more: its zeros sit on its poles.

    The corner of the new section is drawn within a factor 5 of the scale; it does not change the response.
    damping: of the new pair, at least what is asked of the controller's own poles.
    """
    if higher.sections[:-1] != lower.sections or higher.sections[-1] not in ("second_order", "notch"):
        raise ValueError(f"{higher.sections} is not {lower.sections} with one section of order two more")
    corner = 10 ** rng.uniform(-0.7, 0.7)
    poles = [np.log(2 * damping * corner), 2 * np.log(corner)]
    zeros = [poles[0]] if higher.sections[-1] == "notch" else [1.0, 2 * damping * corner, corner**2]
    return np.concatenate([parameters, zeros, poles])


def in_sections(
    sections: Sequence[SectionKind], numerator: Real, denominators: Sequence[Real]
) -> Real | None:
    """Parameters of numerator/(product of denominators): roots dealt to sections, gain to the first.

    Complex pairs go to second-order sections while there are any; where too many, a pair becomes two real
    zeros of its size. None for a numerator that vanishes.
    """
    large = float(np.max(np.abs(numerator), initial=0.0))
    if not (np.isfinite(large) and large > 0):
        return None
    trimmed = np.trim_zeros(np.where(np.abs(numerator) > 1e-12 * large, numerator, 0.0), "f")
    roots = np.roots(trimmed)
    pairs = [np.real(np.poly([r, np.conj(r)])) for r in roots if r.imag > 0]
    singles = sorted((float(r.real) for r in roots if r.imag == 0), key=abs)
    second = sum(kind == "second_order" for kind in sections)
    while len(pairs) > second:
        size = float(np.sqrt(pairs.pop()[2]))
        singles += [-size, -size]
    numerators: list[Real] = []
    for kind in sections:
        if kind == "second_order" and pairs:
            numerators.append(pairs.pop())
        else:
            count = 2 if kind == "second_order" else 1
            take, singles = singles[:count], singles[count:]
            numerators.append(np.atleast_1d(np.real(np.poly(take))))
    x: list[float] = []
    for number, (kind, top, bottom) in enumerate(zip(sections, numerators, denominators, strict=True)):
        full = np.concatenate([np.zeros(bottom.size - top.size), top]) * (trimmed[0] if number == 0 else 1.0)
        x += full.tolist()
        if kind != "integrator":
            x += np.log(bottom[1:]).tolist()
    return np.array(x)
