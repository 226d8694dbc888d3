"""Starts of the search for a controller of fixed structure: where a descent to a local minimum begins.

A descent ends in the valley where it began, so the search needs several starts of different kinds, each
already close to what is asked. `StartMaker` draws parameter vectors of one `Cascade` in four ways.

`drawn` serves controllers made of parts (PID, notches, low-pass): corners around the crossover, notches at
the plant's modes, of many draws the best. `shaped` wishes for a loop gain L = G K where the specification
speaks: large and positive real at the peak of a mode that is to be damped (1 + L = peak over allowed peak, so
that L points away from -1), falling like an integrator where tracking is asked, small elsewhere. Poles are
drawn at random, and the numerator that comes nearest to the wishes is linear least squares. `low_gain` draws
all sections at random and lowers the gain until the nominal loops are stable. `stabilising` serves plants
that are unstable in open loop: it draws leads around the unstable poles and minimises the largest closed-loop
pole modulus.

Corners and gains are in the Tustin plane p of the cascade, s over `cascade.scale_rad_s`. The functions at the
end work on parameter vectors: a factor on the gain, one section more that cancels itself, and sections from
one numerator polynomial. All ranges of random draws are choices; what they are worth is said beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from control_design.analysis.worst_case import PlantData
from control_design.controllers.biquads import Cascade, Section, tustin_frequency
from control_design.controllers.parts import LowPassPart, NotchPart, Part, PidPart
from control_design.plants.ellipses import Complex, Real
from control_design.plants.frequency_grid import local_maxima
from control_design.specification.requirement import LoopFunction
from control_design.specification.specification import ModulusMargin
from ident.data.arrays import real_rows

# Shaped starts. Figures below: best worst case of 100 shaped loops, mean of four seeds, where an arm is to be
# damped (1.32 as it stands), and where a link and a hub are to track (15.7 and .70). A descent follows each,
# so a tenth more or less decides nothing. The few figures that are better by more (1.08, 1.09, 12) are of one
# plant and four seeds each, before any descent: no reason to move a value.

# Factor on the gain of a shaped loop that is unstable, once, before it is given up. Halved or doubled: 1.34,
# 1.38.
_RETRY_GAIN = 0.4
# Two shaped loops count as one where their nominal sensitivities differ by less than this on average. It
# changes how many loops there are to start from, not the best one. Chosen.
_SAME_SENSITIVITY = 0.05
# Damping ratio of random pairs of poles, as powers of ten. Half or twice as wide: 1.43, 1.46.
_POLE_DAMPING_DECADES = (-1.0, 0.1)
# Decades below the crossover in which the integrator-like loop is wished for. Halved or doubled: 16.8, 15.2.
_DECADES_OF_TRACKING = 1.5
# Crossover that is wished for, over the highest frequency at which |S| > 1 would violate the weight on S. At
# one value the link's 15.7 is 20.8, over twice the range 12.
_CROSSOVER_RATIOS = (0.7, 2.0)
# How far below the allowed peak a damped mode is wished to stay. Without a range, or over twice of it: 1.35.
_PEAK_RATIOS = (1.0, 2.0)
# Loop gain at a peak that is only just too high: less would not show beside the other wishes. Halved or
# doubled, nothing moves.
_LEAST_EXCESS = 0.2
# Standard deviation, rad, of the phase of the wished loop gain at a peak; 0 would point exactly away from -1.
# Halved or doubled: 1.27, 1.44.
_PHASE_SPREAD_RAD = 0.4
# Weight of the wish at one peak over that at one frequency of tracking, of which there are dozens. Halved or
# doubled: 1.09, 1.40.
_PEAK_WEIGHT = 10.0
# Weight of "small elsewhere", as powers of ten, over the specification's own weight on the loop. Over half or
# twice the range: 1.38, 1.08.
_QUIET_DECADES = (-1.5, 0.0)
# Plant gain above which "small elsewhere" weighs no heavier: an integrator's grows without end. Halved or
# doubled, nothing moves.
_LARGEST_PLANT_GAIN = 1e3
# Of Nyquist, up to which wishes are stated: the Tustin frequency has its pole at Nyquist, and is eight times
# Nyquist itself here. Chosen.
_HIGHEST_WISH = 0.95
# Lowest corner of random poles over the lowest frequency that matters. Halved or doubled: 1.48, 1.09.
_LOWEST_CORNER_RATIO = 0.3
# Highest corner of random poles over the highest frequency that matters. Halved or doubled: 1.45, 1.27.
_HIGHEST_CORNER_RATIO = 3.0
# Share of Nyquist that caps the highest frequency that matters: Tustin's frequency runs to infinity at
# Nyquist, and is four times Nyquist here. Chosen.
_HIGHEST_CORNER_OF_NYQUIST = 0.9

# Random starts. Figures below: median worst case of 25 starts of a hub that tracks (2.5 as it stands), an arm
# that is damped (64), an arm with two integrators (6.7), and one with notches (4.0). All of them are stable.

# Corner of a random section, as powers of ten of the scale: a factor of 5 to either side. Over half or twice
# the range: 2.7 and 78, 3.1 and 43.
_CORNER_DECADES = (-0.7, 0.7)
# Damping ratio of a random section: no resonance, no two poles far apart. Without a range 2.5 and 80.
_SECTION_DAMPING = (0.3, 1.0)
# Standard deviation of a random section's numerator, relative to its denominator. Doubled: 5.1 and 34.
_NUMERATOR_JITTER = 0.3
# Integral gain of a random section over its corner: slow, as a fast one destabilises. Chosen.
_INTEGRAL_SHARE = 0.1
# Crossover of a loop of little gain, as powers of ten of the scale. Over half or twice the range 2.6 and 3.0.
_LOW_CROSSOVER_DECADES = (-1.5, -0.3)
# Crossover of the first lead around two integrators, as powers of ten of the scale. Over half or twice the
# range 6.3 and 6.7.
_LEAD_CROSSOVER_DECADES = (-0.7, 0.0)
# Factor on the crossover of that lead from trial to trial. Halved: 9.2.
_SLOWER_LEAD = 0.6
# Trials of a random start. Nothing moves with 6.
_TRIALS = 12
# Factor on the gain from trial to trial: after twelve it is a 4096th.
_LESS_GAIN = 0.5

# Lead sections. Figures below: medians of the two starts with leads, two integrators (6.7) and notches (4.0).

# Zero of a lead over its crossover. Halved or doubled: 7.8 and 7.9, 5.4 and 2.1.
_LEAD_ZERO = 0.25
# Poles of a lead over its crossover; one pole at 4 and the zero at .25 lift the phase by 62 degrees there.
# Halved or doubled: 4.5 and 3.7, 1.2 and 4.1.
_LEAD_POLES = 4.0
# Corner of sections beside the lead, as powers of ten of the scale. Over half or twice the range 7.9 and 7.2.
_OTHER_CORNER_DECADES = (-0.3, 0.7)
# Standard deviation of the lead's zeros, relative. Halved or doubled: 8.0 and 7.0.
_LEAD_JITTER = 0.1
# Zero of the PI section over the crossover: it costs 3 degrees of phase there. Halved or doubled: 7.4 and
# 8.0, 7.5 and 2.0.
_PI_ZERO = 0.05
# Starts of parts. All are ranges of draws, chosen wide, as the best of many draws is taken. With all of them
# half or twice as wide, the worst cases of four designs (PID, PD and PI with notches, on a hub and on two
# links) move by at most .03 %.

# Crossover of a draw over the highest frequency at which tracking is asked, else over the scale.
_PART_CROSSOVER_DECADES = (-0.7, 0.3)
# Ti, Td and Tf over 1/crossover, as powers of ten: textbook values are 3 to 10, .3 to 2 and .03 to .2.
_TI_DECADES = (0.0, 1.5)
_TD_DECADES = (-0.8, 0.5)
_TF_DECADES = (-1.5, -0.3)
# Frequency of a notch around the mode that it is drawn for, natural logarithm, standard deviation: the
# shifted notch of phase stabilisation is tried as well.
_NOTCH_OFFSET = 0.15
# Share of free notches that are drawn anywhere, not at a mode.
_NOTCH_ANYWHERE = 0.25
# Damping ratio of a notch's poles, and its depth, as powers of ten.
_NOTCH_DAMPING_DECADES = (-0.9, -0.05)
_NOTCH_DEPTH_DECADES = (0.1, 1.5)
# Corner of a low-pass over the crossover, as powers of ten: below three times the crossover its phase is
# missing there.
_LOW_PASS_DECADES = (0.5, 1.5)

# Starts for unstable plants. Halved or doubled, the numbers up to `_UNSTABLE_GAIN_DECADES` move the best
# worst case of three starts by at most 10 %, in either direction, on four plants of the tests; those behind
# it were chosen alike and not varied.

# Loops around the unstable poles that are drawn.
_DRAWN_UNSTABLE = 400
# How many of the drawn loops, those of least cost, are led to stability at most.
_FOLLOWED = 12
# Crossover over the fastest unstable pole, as powers of ten: a loop slower than the pole does not catch it.
_UNSTABLE_CROSSOVER_DECADES = (-0.1, 0.9)
# Highest crossover, of Nyquist: above, the computational delay leaves no phase.
_UNSTABLE_CROSSOVER_OF_NYQUIST = 0.6
# Gain over the one that puts the crossover there, as powers of ten.
_UNSTABLE_GAIN_DECADES = (-0.2, 0.5)
# Where tracking is asked without an integrator: share of draws with a slow lag in its place.
_SLOW_LAG_SHARE = 0.6
# One uniform number in [0, 1) says the kind of a draw: below `_SLOW_LAG_SHARE` a slow lag where there may be
# one, else below this share a lead, else random sections.
_LEAD_SHARE = 0.8
# Pole of the slow lag over the crossover, as powers of ten: its gain at low frequency stands for an
# integrator.
_SLOW_POLE_DECADES = (-5.0, -2.0)
# Zeros of the slow lag over the crossover, as powers of ten: its phase is back at the crossover.
_LAG_ZERO_DECADES = (-1.3, -0.3)
# Fast pole of the slow lag over the crossover: beyond it, where it costs little phase.
_FAST_POLE_RATIOS = (3.0, 10.0)
# Edge of the first simplex: this share of a parameter ..
_SIMPLEX_SHARE = 0.2
# .. or so much, where the parameter, a logarithm, is near zero.
_SIMPLEX_EDGE = 0.1
# Size up to which a parameter is near zero: a fifth of it would hardly move the loop.
_NEAR_ZERO = 1e-3
# Evaluations for each parameter, until the loop is stable: a limit, the simplex may converge before.
_RADIUS_EVALUATIONS = 200
# Evaluations for each parameter, of the worst case from there: a descent goes on.
_WORST_CASE_EVALUATIONS = 60
# Cost in place of one that is infinite or larger, as the simplex needs finite ones: an algebraic loop, or a
# score of inf. No pole modulus that is seen comes near.
_LARGEST_COST = 1e6

# Damping of drawn pairs over what is asked of the controller's own poles: clear of the bound by 1 %, as a
# start on it has no room to move.
_CLEAR_OF_BOUND = 1.01
# No division by zero; far below any response.
_TINY = 1e-300


class _Wishes(NamedTuple):
    """Controller values that are wished for: K (command per error), without the computational delay, and
    the weight of a miss |K - wish|, each (n,), at omega (n,) in rad/s."""

    omega_rad_s: Real
    controller: Complex
    weight: Real


class StartMaker:
    """Draws parameter vectors of one cascade for given plants; all randomness comes from `rng`.

    Parameters
    ----------
    cascade : Cascade
        Kinds of sections, sampling time and scale of the parameter vectors (n,).
    data : sequence of PlantData
        Every plant, at least one, on a lean grid: `ellipses` (omega, centre and semi-axes (F,)), `delay`
        (F,), e^{-j w delay} of the computational delay, and `sensitivity` (F,), the largest weight on S.
    integrators : int
        Integrators of the loop, of controller and plant together.
    score : callable
        Worst case of a parameter vector; inf where a nominal loop is unstable or an ellipse covers -1.
    rng : numpy.random.Generator
    controller_damping : float or None
        Least damping ratio asked of the controller's own pairs of poles.
    keeps_sign : bool
        The gain at low frequency has to be positive (tracking or integrators).

    Notes
    -----
    Nothing is checked: cascade, plants and score belong to one `Problem`, which has checked them.
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
        """Keep the arguments, None of a damping as 0; see whether any weight on S asks for tracking."""
        self.cascade = cascade
        self.data = data
        self.integrators = integrators
        self.score = score
        self.rng = rng
        self.least_damping = controller_damping or 0.0
        self.keeps_sign = keeps_sign
        # A weight above 1 asks |S| < 1, which only feedback gives.
        self.tracks = any(np.any(part.sensitivity > 1.0) for part in data)

    # Shaped starts

    def shaped(self, draws: int, most: int) -> list[tuple[Real, float]]:
        """Shaped loops that are stable and differ, the best first.

        Parameters
        ----------
        draws : int
            Loops that are drawn; each costs about 1 ms.
        most : int
            Loops that are returned at most; at least 1 (not checked).

        Returns
        -------
        list of (parameters (n,), score)
            Empty where no draw is stable or nothing is wished for, and for two integrators or more in the
            loop: least squares does not see stability, and seldom finds the lead that they need. Of parts,
            whose zeros are not free, the draws are those of `drawn`.
        """
        if self.cascade.has_parts:
            return self.drawn(draws, most)
        if self.integrators >= 2:
            return []
        pool: list[tuple[Real, float]] = []
        for _ in range(draws):
            parameters = self._shaped()
            if parameters is None:
                continue
            pool += self._scored(parameters)
        pool.sort(key=lambda entry: entry[1])
        return self._different(pool, most)

    def _scored(self, parameters: Real) -> list[tuple[Real, float]]:
        """Parameters (n,) with their finite score, as they are or at `_RETRY_GAIN` of their gain.

        Empty where the score is finite at neither: a loop is not stable.
        """
        for candidate in (parameters, with_gain(self.cascade, parameters, _RETRY_GAIN)):
            gamma = self.score(candidate)
            if np.isfinite(gamma):
                return [(candidate, gamma)]
        return []

    def _different(self, pool: Sequence[tuple[Real, float]], most: int) -> list[tuple[Real, float]]:
        """At most `most` entries (parameters, score) of a pool sorted by score, without near duplicates.

        An entry is left out whose nominal sensitivity of the first plant is nearly that of a better one: the
        mean over its lean grid of the modulus of their difference counts. An empty pool gives an empty list.
        """
        selected: list[tuple[Real, float]] = []
        sensitivities: list[Complex] = []
        data = self.data[0]
        for parameters, gamma in pool:
            k = self.cascade.response(parameters, data.ellipses.omega_rad_s) * data.delay
            loop = k * data.ellipses.centre
            sensitivity = 1.0 / (1.0 + loop)
            differences = [float(np.mean(np.abs(sensitivity - other))) for other in sensitivities]
            if all(difference > _SAME_SENSITIVITY for difference in differences):
                selected.append((parameters, gamma))
                sensitivities.append(sensitivity)
            if len(selected) == most:
                break
        return selected

    def _shaped(self) -> Real | None:
        """Parameters (n,) of one shaped loop; None where the specification gives no wish.

        Wishes and poles are drawn; the numerator of the whole cascade is the least-squares answer to the
        wishes of all plants together, and its roots are dealt to the sections. Nothing makes it stable.
        None also where a wish is not finite: a plant whose centre vanishes there.
        """
        wishes = [self._wishes(data) for data in self.data]
        omega = np.concatenate([part.omega_rad_s for part in wishes])
        wanted = np.concatenate([part.controller for part in wishes])
        weight = np.concatenate([part.weight for part in wishes])
        if not np.any(np.abs(wanted) > 0):
            return None

        # One denominator for each section, with random corners, evenly distributed on a logarithmic scale.
        low, high = self._corner_range()
        denominators: list[Real] = []
        for kind in self.cascade.sections:
            corner = np.exp(self.rng.uniform(np.log(low), np.log(high)))
            drawn_damping = 10 ** self.rng.uniform(*_POLE_DAMPING_DECADES)
            damping = max(drawn_damping, self.least_damping * _CLEAR_OF_BOUND)
            if kind == "integrator":
                denominators.append(np.array([1.0, 0.0]))
            elif kind == "first_order":
                denominators.append(np.array([1.0, corner]))
            else:
                denominators.append(np.array([1.0, 2 * damping * corner, corner**2]))

        # K = (n_m p^m + .. + n_0) / denominator is linear in the coefficients of the numerator.
        p = 1j * tustin_frequency(omega, self.cascade.dt_s) / self.cascade.scale_rad_s
        denominator_values = np.ones(p.size, dtype=np.complex128)
        for denominator in denominators:
            denominator_values = denominator_values * np.polyval(denominator, p)
        powers = range(self.cascade.order, -1, -1)
        basis = np.stack([p**power / denominator_values for power in powers], axis=1)
        columns = basis * weight[:, None]
        # Columns of one size, so that the cut-off of small singular values means the same for each.
        column_sizes = np.linalg.norm(columns, axis=0)
        scaled_rows = real_rows(columns) / column_sizes
        # Singular values below 1e-9 of the largest would give coefficients that cancel one another. Chosen.
        solution = np.linalg.lstsq(scaled_rows, real_rows(wanted * weight), rcond=1e-9)[0]
        return in_sections(self.cascade.sections, solution / column_sizes, denominators)

    def _wishes(self, data: PlantData) -> _Wishes:
        """What K should be for one plant, at frequencies of its lean grid; one draw.

        A wish for the loop gain L is one for K = L / (G e^{-j w delay}), weighted by 1/|K| so that a relative
        miss counts the same at each; the wish K = 0 elsewhere has weights of its own. Frequencies may come
        twice, with different wishes. G = 0 at a wish gives an infinite one; not guarded, as a plant has its
        zeros beside the grid.
        """
        grid = data.ellipses.omega_rad_s
        usable = grid < _HIGHEST_WISH * data.plant.nyquist_rad_s
        plant = data.ellipses.centre * data.delay
        # Open loop over allowed, (F,): weight on G S times |G| of the centre; 0 where no mode is to be
        # damped.
        peak = data.open_loop_disturbance
        omega: list[Real] = []
        wanted: list[Complex] = []
        weight: list[Real] = []

        # Tracking: L = crossover / (j w), somewhat below the crossover.
        lowest_quiet = 0.0
        tracked = np.flatnonzero(data.sensitivity > 1.0)
        if tracked.size:
            crossover = grid[tracked[-1]] * self.rng.uniform(*_CROSSOVER_RATIOS)
            lowest_quiet = crossover
            below_crossover = grid < crossover
            not_far_below = grid > crossover * 10**-_DECADES_OF_TRACKING
            tracking = usable & below_crossover & not_far_below
            k = crossover / (1j * grid[tracking]) / plant[tracking]
            omega.append(grid[tracking])
            wanted.append(k)
            weight.append(1.0 / np.abs(k))

        # Peaks of modes to be damped: 1 + L = peak over allowed peak, about.
        for index in local_maxima(peak):
            if not (usable[index] and peak[index] > 1.0):
                continue
            excess = max(peak[index] * self.rng.uniform(*_PEAK_RATIOS) - 1.0, _LEAST_EXCESS)
            phase = np.exp(1j * self.rng.normal(0.0, _PHASE_SPREAD_RAD))
            k = np.array([excess * phase / plant[index]])
            omega.append(grid[index : index + 1])
            wanted.append(k)
            weight.append(_PEAK_WEIGHT / np.abs(k))

        # Elsewhere K = 0, weighed by what the specification says of K S and of S = 1 / (1 + L).
        not_tracked = grid > lowest_quiet
        quiet = usable & not_tracked
        strength = 10 ** self.rng.uniform(*_QUIET_DECADES)
        small_loop = data.of(ModulusMargin) * np.minimum(np.abs(plant), _LARGEST_PLANT_GAIN)
        against_controller = np.maximum(data.largest(LoopFunction.EFFORT), small_loop)
        quiet_weight = strength * against_controller[quiet]
        if peak.max(initial=0.0) > 1.0:
            # Where the mode is to be damped, a large L is no harm. Over the peak, a loop gain of the peak's
            # size would cost what a loop gain of one costs beside the mode; over its square, less. Chosen.
            quiet_weight = quiet_weight / np.maximum(1.0, peak[quiet]) ** 2
        omega.append(grid[quiet])
        wanted.append(np.zeros(int(np.sum(quiet)), dtype=np.complex128))
        weight.append(quiet_weight)
        return _Wishes(np.concatenate(omega), np.concatenate(wanted), np.concatenate(weight))

    def _corner_range(self) -> tuple[float, float]:
        """Lowest and highest corner of random poles, in units of the scale.

        They enclose the scale, the first mode of each plant and the bands in which damping is asked, by the
        two ratios above; the highest stays below Nyquist. Nothing can fail: the scale alone is enough.
        """
        relevant: list[float] = [self.cascade.scale_rad_s]
        for data in self.data:
            relevant += [mode.omega_rad_s for mode in data.plant.modes[:1]]
            damped = data.open_loop_disturbance > 0
            band = data.ellipses.omega_rad_s[damped]
            if band.size:
                relevant += [float(band[0]), float(band[-1])]
        ceiling = _HIGHEST_CORNER_OF_NYQUIST * self.data[0].plant.nyquist_rad_s
        highest = min(max(relevant), ceiling)
        # The lowest is so far below Nyquist that warping does not matter to it.
        warped_highest = float(tustin_frequency(np.array([highest]), self.cascade.dt_s)[0])
        low = _LOWEST_CORNER_RATIO * min(relevant) / self.cascade.scale_rad_s
        high = _HIGHEST_CORNER_RATIO * warped_highest / self.cascade.scale_rad_s
        return low, high

    # Parts

    def drawn(self, draws: int, most: int) -> list[tuple[Real, float]]:
        """Stable loops of a cascade of parts that differ, the best first, each at the best of a few gains.

        Parameters
        ----------
        draws : int
            Vectors that are drawn.
        most : int
            Loops that are returned at most; at least 1 (not checked).

        Returns
        -------
        list of (parameters (n,), score)
            Empty where no draw is stable.
        """
        pool: list[tuple[Real, float]] = []
        for _ in range(draws):
            crossover = self._tracked_rad_s() * 10 ** self.rng.uniform(*_PART_CROSSOVER_DECADES)
            parameters = self._parts(crossover / self.cascade.scale_rad_s)
            gain = self._crossover_gain(parameters, crossover)
            # Damping without tracking knows no sign: half of the draws turn it.
            if not self.keeps_sign and self.rng.uniform() >= 0.5:
                gain *= -1.0
            parameters = with_gain(self.cascade, parameters, gain)
            pool += self._scored(parameters)
        pool.sort(key=lambda entry: entry[1])
        return self._different(pool, most)

    def _tracked_rad_s(self) -> float:
        """Highest frequency, rad/s, at which the first plant's weight asks |S| < 1; the scale without any."""
        tracked = self.data[0].ellipses.omega_rad_s[self.data[0].sensitivity > 1.0]
        if not tracked.size:
            return self.cascade.scale_rad_s
        return float(tracked[-1])

    def _parts(self, crossover: float) -> Real:
        """Parameters (n,) of parts around a crossover (units of the scale, positive), with a gain of 1.

        Times and corners are drawn around it, notches at the lightly damped modes of the plants. All are
        within the bounds of the parts.
        """
        modes = [mode.omega_rad_s for data in self.data for mode in data.plant.modes]
        corners = tustin_frequency(np.array(modes), self.cascade.dt_s) / self.cascade.scale_rad_s
        log_crossover = np.log(crossover)
        x: list[float] = []
        for part in self.cascade.sections:
            assert isinstance(part, Part)
            own: list[float] = []
            if isinstance(part, PidPart):
                if part.kp is None:
                    own.append(1.0)
                if part.has_integral and part.ti is None:
                    own.append(np.log(10 ** self.rng.uniform(*_TI_DECADES)) - log_crossover)
                log_tf = np.log(10 ** self.rng.uniform(*_TF_DECADES)) - log_crossover
                if part.tf is not None:
                    log_tf = np.log(part.tf)
                if part.has_derivative and part.tf is None:
                    own.append(log_tf)
                if part.has_derivative and part.td is None:
                    own.append(np.log(10 ** self.rng.uniform(*_TD_DECADES)) - log_crossover - log_tf)
            elif isinstance(part, NotchPart):
                if part.corner is None:
                    at_mode = corners.size > 0 and self.rng.uniform() >= _NOTCH_ANYWHERE
                    middle = np.log(crossover * 10 ** self.rng.uniform(*_LOW_PASS_DECADES))
                    if at_mode:
                        middle = np.log(corners[self.rng.integers(corners.size)])
                    own.append(middle + _NOTCH_OFFSET * self.rng.standard_normal())
                if part.log_damping() is not None:
                    drawn_damping = 10 ** self.rng.uniform(*_NOTCH_DAMPING_DECADES)
                    own.append(np.log(max(drawn_damping, self.least_damping * _CLEAR_OF_BOUND)))
                if part.depth is None:
                    own.append(np.log(10 ** self.rng.uniform(*_NOTCH_DEPTH_DECADES)))
            elif isinstance(part, LowPassPart):
                if part.corner is None:
                    own.append(log_crossover + np.log(10 ** self.rng.uniform(*_LOW_PASS_DECADES)))
                if part.log_damping() is not None:
                    own.append(np.log(max(np.sqrt(0.5), self.least_damping * _CLEAR_OF_BOUND)))
            for value, (low, high) in zip(own, part.bounds(), strict=True):
                x.append(float(np.clip(value, low, high)))
        return np.array(x)

    # Random starts

    def low_gain(self) -> Real:
        """Parameters (n,) of a random cascade of little gain, whose nominal loops are mostly stable.

        Until they are, the gain is halved; with two integrators, which less gain does not stabilise, a lead
        around a slower and slower crossover is drawn. After `_TRIALS` trials the last one is returned as it
        is, stable or not: the descent from it ends at once.
        """
        crossover = 10 ** self.rng.uniform(*_LEAD_CROSSOVER_DECADES)
        parameters = self._random_sections()
        parameters = with_gain(self.cascade, parameters, self._low_gain(parameters))
        for _ in range(_TRIALS):
            if self.integrators >= 2:
                parameters = self._lead_sections(crossover)
                gain = self._crossover_gain(parameters, crossover * self.cascade.scale_rad_s)
                parameters = with_gain(self.cascade, parameters, gain)
                crossover *= _SLOWER_LEAD
            if np.isfinite(self.score(parameters)):
                break
            parameters = with_gain(self.cascade, parameters, _LESS_GAIN)
        return parameters

    # Starts for plants that are unstable in open loop

    def stabilising(self, radius: Callable[[Real], float], most: int) -> list[Real]:
        """Loops of unstable plants that were led to stability, those with the smallest worst case first.

        Parameters
        ----------
        radius : callable
            Largest pole modulus in z of the nominal loops of a parameter vector (n,); inf for an algebraic
            loop.
        most : int
            Parameter vectors that are returned at most, at least 1; no more are led on once so many are
            stable.

        Returns
        -------
        list of ndarray, shape (n,)
            Those that could not be stabilised come last.

        Notes
        -----
        Neither little gain nor much of it stabilises an unstable plant: of many leads and random sections
        around the unstable poles the best are taken, and the radius is minimised from there. Below 1 it is
        replaced by the share of |1 + L| that the ellipses leave. Nelder and Mead's simplex is used, as the
        radius has kinks.
        """

        def cost(x: Real) -> float:
            """What is minimised, at x (n,): the radius plus missing damping; where stable and damped 1 minus
            the smallest share of |1 + L|, at most 1. nan of the radius counts as unstable."""
            ringing = max(self.least_damping - self.cascade.least_damping(x), 0.0)
            pole_radius = radius(x)
            if not pole_radius < 1.0 or ringing > 0:
                return min(pole_radius, _LARGEST_COST) + ringing
            # Smallest |1 + L| at the centre after the ellipse has taken its share; 1 without any loop.
            smallest_share = 1.0
            for data in self.data:
                loop = self.cascade.response(x, data.ellipses.omega_rad_s) * data.delay
                distance = np.abs(1.0 + loop * data.ellipses.centre)
                reach = np.abs(loop) * data.ellipses.semi_major
                share = distance / (1.0 + reach / np.maximum(distance, _TINY))
                smallest_share = min(smallest_share, float(np.min(share)))
            return 1.0 - smallest_share

        def log_worst_case(x: Real) -> float:
            """Logarithm of the score at x (n,), finite also where the loop is unstable."""
            return float(np.log(min(self.score(x), _LARGEST_COST)))

        candidates = [self._around_unstable_poles() for _ in range(_DRAWN_UNSTABLE)]
        followed = sorted(candidates, key=cost)[:_FOLLOWED]
        ends: list[tuple[Real, float]] = []
        for x in followed:
            # Steps in proportion to the parameters, of which some are logarithms near zero.
            size = np.abs(x)
            edge = np.where(size > _NEAR_ZERO, _SIMPLEX_SHARE * size, _SIMPLEX_EDGE)
            around = np.vstack([x, x + np.diag(edge)])
            end = _simplex(cost, around, _RADIUS_EVALUATIONS * x.size)
            if np.isfinite(self.score(end)):
                # On towards what is asked: a simplex steps over valleys that the descent stays in.
                around = np.vstack([end, end + np.diag(edge)])
                end = _simplex(log_worst_case, around, _WORST_CASE_EVALUATIONS * x.size)
            ends.append((end, self.score(end)))
            stable_ends = sum(np.isfinite(gamma) for _, gamma in ends)
            if stable_ends >= most:
                break
        ends.sort(key=lambda entry: entry[1])
        return [x for x, _ in ends[:most]]

    def _around_unstable_poles(self) -> Real:
        """Parameters (n,) of one draw with its crossover near the unstable poles, and a gain of either sign.

        Kinds of draws: a slow lag (only where tracking is asked without an integrator), leads, and random
        sections; parts around that crossover. Only called where some plant is unstable: without an unstable
        pole the crossover would be 0 rad/s.
        """
        fastest_logs = []
        for data in self.data:
            if data.plant.unstable_poles:
                outside = np.abs(data.plant.poles) > 1.0
                speeds = np.abs(np.log(data.plant.poles[outside]))
                fastest_logs.append(float(np.max(speeds)))
        fastest_rad_s = max(fastest_logs, default=0.0) / self.cascade.dt_s
        crossover = fastest_rad_s * 10 ** self.rng.uniform(*_UNSTABLE_CROSSOVER_DECADES)
        crossover = min(crossover, _UNSTABLE_CROSSOVER_OF_NYQUIST * self.data[0].plant.nyquist_rad_s)

        kind = self.rng.uniform()
        has_free_poles = not (self.cascade.has_parts or "integrator" in self.cascade.sections)
        lacks_integrator = self.tracks and has_free_poles
        if lacks_integrator and kind < _SLOW_LAG_SHARE:
            parameters = self._slow_lag_sections(crossover / self.cascade.scale_rad_s)
        elif self.cascade.has_parts:
            parameters = self._parts(crossover / self.cascade.scale_rad_s)
        elif kind < _LEAD_SHARE:
            parameters = self._lead_sections(crossover / self.cascade.scale_rad_s)
        else:
            parameters = self._random_sections()
        size = abs(self._crossover_gain(parameters, crossover))
        gain = size * 10 ** self.rng.uniform(*_UNSTABLE_GAIN_DECADES)
        return with_gain(self.cascade, parameters, gain * self.rng.choice([-1.0, 1.0]))

    def _slow_lag_sections(self, crossover: float) -> Real:
        """Parameters (n,) of lead sections around a crossover, of which one is a slow lag instead.

        Its slow real pole stands in for an integrator, which tracking without one needs. crossover: in units
        of the scale, positive. The lag is the first section of second order, else the first of first order.
        """
        x = self._lead_sections(crossover)
        slow_pole = crossover * 10 ** self.rng.uniform(*_SLOW_POLE_DECADES)
        zeros = crossover * 10 ** self.rng.uniform(*_LAG_ZERO_DECADES, 2)
        fast_pole = crossover * self.rng.uniform(*_FAST_POLE_RATIOS)
        first = 0
        for kind in self.cascade.sections:
            if kind == "second_order":
                x[first : first + 3] = np.poly(-zeros)
                x[first + 3 : first + 5] = np.log([fast_pole + slow_pole, fast_pole * slow_pole])
                return x
            if kind == "first_order" and "second_order" not in self.cascade.sections:
                x[first : first + 3] = [1.0, zeros[0], np.log(slow_pole)]
                return x
            first += Cascade((kind,), 1.0, 1.0).parameters
        return x

    def _random_sections(self) -> Real:
        """Parameters (n,) of sections with corners around the scale and numerators near their denominators.

        Gains are about one. Parameters of a section: numerator coefficients, then logarithms of the
        denominator's, as `biquads` has them. Parts are drawn around a random crossover below the scale.
        """
        if self.cascade.has_parts:
            return self._parts(10 ** self.rng.uniform(*_LOW_CROSSOVER_DECADES))
        x: list[float] = []
        for kind in self.cascade.sections:
            corner = 10 ** self.rng.uniform(*_CORNER_DECADES)
            drawn_damping = self.rng.uniform(*_SECTION_DAMPING)
            damping = max(drawn_damping, self.least_damping * _CLEAR_OF_BOUND)
            jitter = 1.0 + _NUMERATOR_JITTER * self.rng.standard_normal(3)
            if kind == "integrator":
                # Proportional part first, slow integral action.
                x += [jitter[0], _INTEGRAL_SHARE * corner * abs(jitter[1])]
            elif kind == "first_order":
                x += [jitter[0], corner * abs(jitter[1]), np.log(corner)]
            else:
                numerator = np.array([1.0, 2 * damping * corner, corner**2]) * jitter
                x += [*numerator, np.log(2 * damping * corner), 2 * np.log(corner)]
        return np.array(x)

    def _lead_sections(self, crossover: float) -> Real:
        """Parameters (n,) of a lead around a crossover, a PI far below it, and other sections near one.

        crossover: in units of the scale, positive (its logarithm is taken). The first section that can be the
        lead is: zero at `_LEAD_ZERO` of the crossover, poles at `_LEAD_POLES` times it; of second order with
        two poles and one zero. Parts are drawn around the crossover instead.
        """
        if self.cascade.has_parts:
            return self._parts(crossover)
        x: list[float] = []
        lead_is_missing = True
        zero = _LEAD_ZERO * crossover
        pole = _LEAD_POLES * crossover
        for kind in self.cascade.sections:
            jitter = 1.0 + _LEAD_JITTER * self.rng.standard_normal(3)
            corner = 10 ** self.rng.uniform(*_OTHER_CORNER_DECADES)
            if kind == "integrator":
                x += [1.0, _PI_ZERO * crossover * jitter[0]]
            elif kind == "first_order" and lead_is_missing:
                x += [1.0, zero * jitter[0], np.log(pole)]
                lead_is_missing = False
            elif kind == "first_order":
                x += [1.0, corner * jitter[0], np.log(corner)]
            elif lead_is_missing:
                numerator = [0.0, pole * jitter[0], pole * zero * jitter[1]]
                x += [*numerator, np.log(2 * pole), 2 * np.log(pole)]
                lead_is_missing = False
            else:
                numerator_values = np.array([1.0, 2 * corner, corner**2]) * jitter
                x += [*numerator_values, np.log(2 * corner), 2 * np.log(corner)]
        return np.array(x)

    def _low_gain(self, parameters: Real) -> float:
        """Signed factor on parameters (n,) that puts the first plant's crossover at a random frequency below
        the scale; of either sign, evenly, unless the sign is to be kept."""
        crossover = self.cascade.scale_rad_s * 10 ** self.rng.uniform(*_LOW_CROSSOVER_DECADES)
        gain = self._crossover_gain(parameters, crossover)
        # Pure damping knows no sign: half of the draws turn it.
        if not self.keeps_sign and self.rng.uniform() >= 0.5:
            gain *= -1.0
        return gain

    def _crossover_gain(self, parameters: Real, crossover_rad_s: float) -> float:
        """Signed factor that makes |L| = 1 of the first plant's centre at the crossover.

        The sign makes L at the lowest frequency of the grid that of a positive gain times 1 / (j w)^i, with i
        integrators in the loop. The delay is left out: it turns L, and does not change |L|. crossover_rad_s:
        the nearest frequency of the grid is taken, also for one outside of it.
        """
        ellipses = self.data[0].ellipses
        omega = ellipses.omega_rad_s
        loop = self.cascade.response(parameters, omega) * ellipses.centre
        nearest = int(np.argmin(np.abs(omega - crossover_rad_s)))
        size = float(np.abs(loop[nearest]))
        turned_back = (loop[0] * 1j**self.integrators).real
        sign = 1.0 if turned_back >= 0 else -1.0
        # A loop that vanishes at the crossover gets a large gain, 1e12, and is dropped as unstable.
        return sign / max(size, 1e-12)


def _simplex(cost: Callable[[Real], float], start: Real, evaluations: int) -> Real:
    """Parameters (n,) of the least cost that Nelder and Mead's simplex finds from a simplex (n + 1, n).

    evaluations: of the cost, at most. The cost has to be finite or inf; that of nan is not defined.
    """
    from scipy.optimize import minimize  # here: every command would wait for it

    # Costs are of the order of one; differences of 1e-4 decide nothing.
    options: Any = {"maxfev": evaluations, "initial_simplex": start, "adaptive": True, "fatol": 1e-4}
    result = minimize(cost, start[0], method="Nelder-Mead", options=options)
    return np.asarray(result.x, dtype=np.float64)


def with_gain(cascade: Cascade, parameters: Real, factor: float) -> Real:
    """Parameters (n,) of the controller times a factor.

    Parameters
    ----------
    cascade : Cascade
    parameters : ndarray, shape (n,)
        The first section's numerator carries the gain, of parts Kp.
    factor : float
        Of either sign.

    Returns
    -------
    ndarray, shape (n,)
        A copy; unchanged where Kp is fixed. The length is not checked; a cascade without sections is an
        IndexError.
    """
    first = cascade.sections[0]
    if isinstance(first, Part):
        has_gain = isinstance(first, PidPart) and first.kp is None
        numerator_size = int(has_gain)
    else:
        numerator_size = {"integrator": 2, "first_order": 2, "second_order": 3}[first]
    scaled = np.array(parameters)
    scaled[:numerator_size] *= factor
    return scaled


def with_cancelling_section(
    lower: Cascade, parameters: Real, higher: Cascade, rng: np.random.Generator, *, damping: float = 0.8
) -> Real:
    """Parameters of an unchanged controller in a cascade with one section of order two more.

    Parameters
    ----------
    lower : Cascade
        Of the controller.
    parameters : ndarray, shape (n,)
        Of the controller.
    higher : Cascade
        The sections of `lower`, and one of kind "second_order" or a free notch at the end.
    rng : numpy.random.Generator
        Draws the corner of the new section, within a factor 5 of the scale.
    damping : float
        Damping ratio of the new pair of poles, positive (not checked): at least what is asked of the
        controller's own poles. The default has no resonance and no pole far apart from the other. Chosen.

    Returns
    -------
    ndarray, shape (n + 3,) for a notch, else (n + 5,)
        The zeros of the new section sit on its poles, so the response does not change; a descent can pull
        them apart.

    Raises
    ------
    ValueError
        `higher` is not `lower` with one such section more.
    """
    added = higher.sections[-1]
    is_free_notch = isinstance(added, NotchPart) and added.is_free
    if higher.sections[:-1] != lower.sections or not (added == "second_order" or is_free_notch):
        raise ValueError(f"{higher.sections} is not {lower.sections} with one section of order two more")
    corner = 10 ** rng.uniform(*_CORNER_DECADES)
    if is_free_notch:
        # Logarithms of corner, damping ratio and depth, which is 1.
        return np.concatenate([parameters, [np.log(corner), np.log(damping), 0.0]])
    poles = [np.log(2 * damping * corner), 2 * np.log(corner)]
    zeros = [1.0, 2 * damping * corner, corner**2]
    return np.concatenate([parameters, zeros, poles])


def in_sections(sections: Sequence[Section], numerator: Real, denominators: Sequence[Real]) -> Real | None:
    """Parameters of a cascade with a given numerator over the product of given denominators.

    Parameters
    ----------
    sections : sequence of Section
        No part, whose numerator is not free (not checked).
    numerator : ndarray, shape (order + 1,)
        Coefficients in p, highest power first.
    denominators : sequence of ndarray
        Of each section, (2,) or (3,), in p, highest power first, monic; the others positive but for an
        integrator's 0, since their logarithms are the parameters. One for each section, else ValueError.

    Returns
    -------
    ndarray, shape (n,), or None
        Roots of the numerator are dealt to the sections; the first one takes the gain. None for a numerator
        that vanishes or is not finite.

    Notes
    -----
    Complex pairs go to second-order sections while there are any. Where there are too many pairs, one becomes
    two real zeros of its size, which changes the controller: an approximation that only starts make use of.
    """
    largest = float(np.max(np.abs(numerator), initial=0.0))
    if not (np.isfinite(largest) and largest > 0):
        return None
    # Coefficients that are rounding, below 1e-12 of the largest, would become roots far outside.
    is_significant = np.abs(numerator) > 1e-12 * largest
    significant = np.where(is_significant, numerator, 0.0)
    trimmed = np.trim_zeros(significant, "f")
    gain = trimmed[0]

    roots = np.roots(trimmed)
    upper_roots = [root for root in roots if root.imag > 0]
    pairs = [np.real(np.poly([root, np.conj(root)])) for root in upper_roots]
    real_zeros = sorted((float(root.real) for root in roots if root.imag == 0), key=abs)
    second_order_sections = sum(kind == "second_order" for kind in sections)
    while len(pairs) > second_order_sections:
        size = float(np.sqrt(pairs.pop()[2]))
        real_zeros += [-size, -size]

    # Each section takes what it has room for; real zeros in ascending size, so that neighbours share one.
    numerators: list[Real] = []
    for kind in sections:
        if kind == "second_order" and pairs:
            numerators.append(pairs.pop())
        else:
            room = 2 if kind == "second_order" else 1
            section_zeros = real_zeros[:room]
            real_zeros = real_zeros[room:]
            numerators.append(np.atleast_1d(np.real(np.poly(section_zeros))))

    x: list[float] = []
    for number, (kind, top, bottom) in enumerate(zip(sections, numerators, denominators, strict=True)):
        # Fewer zeros than poles are leading zeros of the numerator.
        coefficients = np.concatenate([np.zeros(bottom.size - top.size), top])
        if number == 0:
            coefficients = coefficients * gain
        x += coefficients.tolist()
        if kind != "integrator":
            x += np.log(bottom[1:]).tolist()
    return np.array(x)
