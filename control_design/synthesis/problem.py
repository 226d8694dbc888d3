"""What a controller of any order is judged by: stable loops, rows of the optimisers, dense check.

A `Problem` is made once for each synthesis of one loop. Its plants stand on two grids: a lean one
(`grids`), on which descents see the worst case (`rows`) and which grows by exchange (`add_violated`), and a
dense one, on which the worst case gamma counts (`gamma`, `checks`). Controllers are a `Cascade` with a
parameter vector x (n,).

Stability is asked of every nominal loop by its poles, and of guards, single sampled responses, by how often
1 + G K winds around 0 (`stable`, `guarded`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from control_design.analysis.stability import NominalLoop, winds
from control_design.analysis.worst_case import Grids, PlantData, worst_of
from control_design.controllers.biquads import SOLVER_SLACK, Cascade
from control_design.controllers.controller import Controller
from control_design.convex.minimax import EXCHANGE_TOLERANCE
from control_design.plants.ellipses import Complex, Ellipses, Real, scale_to_minus_one
from control_design.plants.frequency_grid import lowest_rad_s, mode_points, with_violations
from control_design.plants.guards import GUARD_MODULUS, Guard, sorted_by_plant
from control_design.plants.plant_set import Mode, UncertainPlant, modes_of
from control_design.specification import Specification
from control_design.specification.requirement import LoopFunction
from control_design.synthesis.rows import Rows
from control_design.synthesis.synthesis_options import SynthesisOptions

# Damping ratio below which a pole or zero gets points of its own in the dense check; wider resonances do not
# fit between the points of a dense grid: a width of 2 zeta, 10 %, holds dozens of its thousands of points.
_LIGHT = 0.05
# Points around such a pole or zero, spaced like sinh out to twenty half-widths: six lie within one
# half-width, so a peak between two of them is missed by a per cent.
_POINTS_OF_MODE = 25
# Points a decade below the grids, where nothing but slow real poles and zeros is, whose responses change over
# a decade. Chosen.
_PER_DECADE = 10
# Distance from -1 asked of copies behind the delay margin: stability with something to spare. Chosen.
_DELAY_COPY_MODULUS = 0.1
# Delays up to the stated margin at which a loop is kept stable, evenly spaced. At the whole delay alone eight
# of thirteen random loops were unstable at a shorter one, at three delays seven, at six one; doubled, a
# descent takes nearly twice as long.
_DELAYS = 6
# Violated frequencies that one controller puts on the grid of one plant in one check: every one makes each
# later step dearer. Chosen.
_MOST_ADDED = 12
# No division by zero where 1 + G K vanishes.
_TINY = 1e-300


def _whole_samples(delay_s: float | None, dt_s: float) -> list[int]:
    """`_DELAYS` delays up to the stated one in whole samples, each once, without none; empty for None."""
    if delay_s is None:
        return []
    # A delay that is stated as so many samples is so many, whatever rounding makes of the ratio.
    most = int(np.floor(delay_s / dt_s * (1 + 1e-9)))
    return sorted({round(most * share) for share in np.linspace(0, 1, _DELAYS + 1)} - {0})


class Problem(Grids):
    """Plants, specification and grids of one synthesis, for controllers of any order.

    Parameters
    ----------
    plants : tuple of UncertainPlant
        At least one; all of one sampling time (an IndexError without any; times are not compared here:
        `Specification.check_against` has).
    specification : Specification
        What is asked of the loop: weights, delay margin, controller damping; and limits and delay of the
        controller.
    options : SynthesisOptions
        Sizes of the grids.
    guards : tuple of Guard
        Responses (F,) of a plant, with its number and their own frequencies, that have to be stable beside
        its ellipses.

    Notes
    -----
    The lean grids `grids`, one array (F,) in rad/s for each plant, grow by exchange; the rest is fixed. Also
    from `Grids`: `dense`, the `PlantData` of every plant on its dense grid, and `scale_rad_s`.
    """

    def __init__(
        self,
        plants: tuple[UncertainPlant, ...],
        specification: Specification,
        options: SynthesisOptions,
        guards: tuple[Guard, ...] = (),
    ) -> None:
        """Build grids and nominal loops, the computational delay at the input of each plant; what `Grids` and
        `NominalLoop` refuse goes up."""
        super().__init__(plants, specification, options)
        self.options = options
        self.guards = guards
        self._guards_by_plant = sorted_by_plant(guards)
        self.dt_s = plants[0].dt_s
        self._loops = [NominalLoop(plant, specification.computational_delay_samples) for plant in plants]
        self._delayed_loops = [
            (number, NominalLoop(plant, specification.computational_delay_samples + late))
            for late in _whole_samples(specification.delay_margin_s, self.dt_s)
            for number, plant in enumerate(plants)
        ]

    @property
    def integrators(self) -> int:
        """Integrators of the loop: the controller's and the most of any plant."""
        most_of_plants = max(plant.n_integrators for plant in self.plants)
        return most_of_plants + int(self.spec.integrator)

    def cascade(self, order: int | None = None) -> Cascade:
        """Structure of the controller that is asked for, or of another order of it; SpecificationError for an
        order "auto" without a number."""
        spec = self.spec
        if order is not None:
            spec = spec.model_copy(update={"controller_order": order})
        return spec.cascade(self.dt_s, self.scale_rad_s)

    @property
    def asks_tracking(self) -> bool:
        """Whether the specification weighs S at low frequency, by a bandwidth or a weight of its own."""
        return self.spec.asks_tracking

    # What the optimisers see

    def rows(self, grids: Sequence[Real] | None = None) -> list[Rows]:
        """Rows of the optimisers.

        Parameters
        ----------
        grids : sequence of ndarray, shape (F,), optional
            Of each plant, rad/s; by default the lean grids as they are now. A plant that is known on its own
            frequencies only refuses others (ValueError).

        Returns
        -------
        list of Rows
            For each plant, for its copies behind delays up to the margin where one is asked, and for each
            guard.
        """
        rows: list[Rows] = []
        for data in self.lean(grids):
            ellipses = data.ellipses
            rows.append(Rows(ellipses, data.delay, data.row_weights()))
            if self.spec.delay_margin_s is not None:
                for late_s in self.spec.delay_margin_s * np.arange(1, _DELAYS + 1) / _DELAYS:
                    late = data.delay * np.exp(-1j * ellipses.omega_rad_s * late_s)
                    rows.append(Rows(ellipses, late, _modulus(_DELAY_COPY_MODULUS, ellipses)))
        grids_of_plants = self.grids if grids is None else grids
        for guard in self.guards:
            points = guard.ellipses(grids_of_plants[guard.plant])
            rows.append(Rows(points, self.delay(points.omega_rad_s), _modulus(GUARD_MODULUS, points)))
        return rows

    def add_violated(
        self, cascade: Cascade, parameters: Real, gamma_grid: float, most: int = _MOST_ADDED
    ) -> int:
        """Put frequencies on the lean grids at which the dense check exceeds the lean grids' worst case.

        Parameters
        ----------
        cascade : Cascade
        parameters : ndarray, shape (n,)
            Of the controller that is checked; it need not be stable.
        gamma_grid : float
            Its worst case on the lean grids, finite: with inf nothing exceeds it and nothing is added.
        most : int
            Local maxima that are added at most, of each check and each guard.

        Returns
        -------
        int
            Frequencies that were new.
        """
        limit = gamma_grid * (1.0 + EXCHANGE_TOLERANCE)
        added = 0
        for position, data in self.checks(cascade, parameters):
            omega = data.ellipses.omega_rad_s
            k = cascade.response(parameters, omega)
            worst = worst_of(data.weighted(k))
            covered = ~np.isfinite(worst)
            if np.any(covered):
                # Ellipses over -1 have no worst case: a value above all others, the deepest the largest. An
                # ellipse that just reaches -1 (scale 1) has depth 1, one whose centre lies on it (0) has 2;
                # so values are two to four times the largest finite one.
                scale = scale_to_minus_one(k * data.delay, data.ellipses)[covered]
                depth = 2.0 - np.minimum(scale, 1.0)
                largest_finite = np.max(worst[~covered], initial=limit)
                worst[covered] = depth * 2.0 * largest_finite
            added += self._add(position, omega, worst, limit, most)
        for guard in self.guards:
            omega = guard.omega_rad_s
            k = self.delayed_response(cascade, parameters, omega)
            distance = np.abs(1.0 + guard.response * k)
            near = GUARD_MODULUS / np.maximum(distance, _TINY)
            added += self._add(guard.plant, omega, near, limit, most)
        return added

    def _add(self, position: int, omega: Real, value: Real, limit: float, most: int) -> int:
        """Put the largest local maxima of value (F,) above the limit on the lean grid of one plant.

        Returns how many were new. position: number of the plant; omega (F,), rad/s, ascending; at most `most`
        maxima. Nothing is added where no value exceeds the limit.
        """
        before = self.grids[position]
        after = with_violations(before, omega, value, limit, most)
        self.grids[position] = after
        return after.size - before.size

    # The dense check

    def gamma(self, cascade: Cascade, parameters: Real) -> float:
        """Weighted worst case of a controller on the dense grids.

        Parameters
        ----------
        cascade : Cascade
        parameters : ndarray, shape (n,)

        Returns
        -------
        float
            inf if some nominal loop or guard is unstable, an ellipse reaches -1, no anti-windup gain exists,
            or the controller rings by itself more than it may. Raises ValueError for another number of
            parameters.
        """
        asked = self.spec.controller_damping
        if asked is not None and not cascade.least_damping(parameters) >= asked * (1 - SOLVER_SLACK):
            return float("inf")
        if not self.usable(cascade, parameters):
            return float("inf")
        worst = 0.0
        for _, data in self.checks(cascade, parameters):
            values = data.weighted(cascade.response(parameters, data.ellipses.omega_rad_s))
            maxima = [np.max(values[each.requirement.name]) for each in data.weightings]
            worst = max(worst, float(np.max(maxima)))
        return worst

    def checks(self, cascade: Cascade, parameters: Real) -> list[tuple[int, PlantData]]:
        """Frequencies at which one controller is checked.

        Parameters
        ----------
        cascade : Cascade
        parameters : ndarray, shape (n,)

        Returns
        -------
        list of (int, PlantData)
            Number of the plant, and its ellipses and weights on a grid: the dense grids first; then, for
            plants that need them, points around lightly damped poles and zeros of the controller and poles
            of its loops, and below the grid where one of them is slower. A plant that is known on its own
            frequencies only has its dense grid alone.

        Notes
        -----
        A controller may hide a resonance between the points of any grid that does not know it, or a step
        below them, and an optimiser finds that out.
        """
        checks = list(enumerate(self.dense))
        roots = cascade.roots(parameters)
        poles_of_loops = self.closed_loop_poles(cascade, parameters)
        for number, (plant, poles) in enumerate(zip(self.plants, poles_of_loops, strict=True)):
            controller_and_loop = np.concatenate([roots, poles])
            light = modes_of(controller_and_loop, self.dt_s, zeta_below=_LIGHT)
            asked_lowest = self.options.omega_min_rad_s
            grid_begins = asked_lowest or lowest_rad_s(plant.dt_s, plant.poles)
            slowest = asked_lowest or lowest_rad_s(plant.dt_s, controller_and_loop)
            begin = min(grid_begins, slowest)
            needs_points = bool(light) or begin < grid_begins
            if plant.own_grid is not None or not needs_points:
                continue
            count_below = int(np.ceil(_PER_DECADE * np.log10(grid_begins / begin)))
            below = np.geomspace(begin, grid_begins, count_below, endpoint=False)
            # A pole or zero of either side of the circle.
            modes = [Mode(mode.omega_rad_s, abs(mode.zeta)) for mode in light]
            around = [mode_points(mode, _POINTS_OF_MODE) for mode in modes]
            points = np.unique(np.concatenate([below, *around]))
            not_slower = points >= begin
            below_nyquist = points < plant.nyquist_rad_s
            points = points[not_slower & below_nyquist]
            if points.size:
                checks.append((number, PlantData.build(plant, self.spec, points)))
        return checks

    # Stability

    def usable(self, cascade: Cascade, parameters: Real) -> bool:
        """Whether the controller (parameters (n,)) can be built and every nominal loop and guard is stable.

        False also where no anti-windup gain exists, which a numerically degenerate controller shows.
        """
        try:
            self.controller(cascade, parameters)
        except ValueError:
            return False
        return self.stable(cascade, parameters)

    def stable(self, cascade: Cascade, parameters: Real) -> bool:
        """Whether every nominal loop, as it is and behind the delay of the delay margin, and every guard is
        stable under parameters (n,).

        Poles of the full state space have to lie strictly inside the circle; an algebraic loop is unstable.
        """
        poles_of_loops = self.closed_loop_poles(cascade, parameters)
        loops_are_stable = all(np.all(np.abs(poles) < 1.0) for poles in poles_of_loops)
        if not loops_are_stable or self.unstable_when_late(cascade, parameters):
            return False
        return self.guarded(cascade, parameters)

    def unstable_when_late(self, cascade: Cascade, parameters: Real) -> list[tuple[int, Complex]]:
        """Plants, by number, and poles (m,) of their nominal loops that a delay within the stated margin
        makes unstable; empty without one.

        Notes
        -----
        A copy of a plant behind a delay only keeps away from -1: a loop that encircles it there does so, too.
        Delays up to the margin are tried, in whole samples.
        """
        a, b, c, d = cascade.state_space(parameters)
        found = []
        for number, loop in self._delayed_loops:
            poles = loop.poles(a, b, c, d)
            if not np.all(np.abs(poles) < 1.0):
                found.append((number, poles))
        return found

    def guarded(self, cascade: Cascade, parameters: Real, guards: Sequence[Guard] | None = None) -> bool:
        """Whether guards are stable.

        Parameters
        ----------
        cascade : Cascade
        parameters : ndarray, shape (n,)
        guards : sequence of Guard, optional
            By default those of the problem; without any the answer is True.

        Returns
        -------
        bool
            1 + K G winds as often as the integrators and unstable poles of the plant ask, for every guard.
        """
        guards_by_plant = self._guards_by_plant if guards is None else sorted_by_plant(guards)
        for number, omega, responses in guards_by_plant:
            plant = self.plants[number]
            k = self.delayed_response(cascade, parameters, omega)
            stable, wide = winds(
                responses * k,
                integrators=plant.n_integrators + int(self.spec.integrator),
                unstable_poles=plant.unstable_poles,
            )
            # A wide step is a pole next to the circle, on either side.
            if not np.all(stable & ~wide):
                return False
        return True

    def closed_loop_poles(self, cascade: Cascade, parameters: Real) -> list[Complex]:
        """Poles (m,) in z of every nominal loop under parameters (n,), m states of plant, delay and
        controller.

        One infinite pole for an algebraic loop.
        """
        a, b, c, d = cascade.state_space(parameters)
        return [loop.poles(a, b, c, d) for loop in self._loops]

    # The controller

    def controller(self, cascade: Cascade, parameters: Real) -> Controller:
        """Controller of a parameter vector (n,), with the delay and limits of the specification.

        Raises
        ------
        ValueError
            No anti-windup gain exists.
        """
        a, b, c, d = cascade.state_space(parameters)
        return Controller(
            a,
            b,
            c,
            d,
            self.dt_s,
            computational_delay_samples=self.spec.computational_delay_samples,
            input_limit=self.spec.input_limit,
            rate_limit=self.spec.rate_limit,
        )

    def delay(self, omega_rad_s: Real) -> Complex:
        """Computational delay e^{-j omega T n} (F,) at omega (F,), rad/s, of n samples of T, as the
        specification states them."""
        samples = self.spec.computational_delay_samples
        return np.asarray(np.exp(-1j * omega_rad_s * self.dt_s * samples), dtype=np.complex128)

    def delayed_response(self, cascade: Cascade, parameters: Real, omega_rad_s: Real) -> Complex:
        """K of parameters (n,) with its computational delay (F,) at omega (F,), rad/s, up to Nyquist."""
        return cascade.response(parameters, omega_rad_s) * self.delay(omega_rad_s)


def _modulus(value: float, ellipses: Ellipses) -> tuple[tuple[LoopFunction, Real], ...]:
    """Weights of `Rows` that ask for nothing but a distance of at least `value` from -1: |S| <= 1 / value.

    One weight on S, of `value` > 0 at each of the F frequencies of the ellipses.
    """
    return ((LoopFunction.SENSITIVITY, np.full(ellipses.omega_rad_s.size, value)),)
