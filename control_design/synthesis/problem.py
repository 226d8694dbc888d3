"""What a controller of any order is judged by: stable loops, rows of the optimisers, dense check."""

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

_LIGHT = 0.05  # damping ratio; wider resonances do not fit between the points of a dense grid
_PER_DECADE = 10  # of points below the grids, where nothing but slow real poles and zeros is
_DELAY_COPY_MODULUS = 0.1  # distance from -1 asked of the delayed copies: stability with something to spare


class Problem(Grids):
    """What does not depend on the controller's order; the lean grids grow by exchange, the rest is fixed."""

    def __init__(
        self,
        plants: tuple[UncertainPlant, ...],
        specification: Specification,
        options: SynthesisOptions,
        guards: tuple[Guard, ...] = (),
    ) -> None:
        super().__init__(plants, specification, options)
        self.options, self.guards = options, guards
        self._guarded = sorted_by_plant(guards)
        self.dt_s = plants[0].dt_s
        self._loops = [NominalLoop(plant, specification.computational_delay_samples) for plant in plants]

    @property
    def integrators(self) -> int:
        """Integrators of the loop: the controller's and the most of any plant."""
        return max(plant.n_integrators for plant in self.plants) + int(self.spec.integrator)

    @property
    def asks_tracking(self) -> bool:
        return self.spec.bandwidth_rad_s is not None or self.spec.sensitivity_weight is not None

    def rows(self, grids: Sequence[Real] | None = None) -> list[Rows]:
        """Rows of the optimisers on the lean grids, as they are now or as given."""
        rows: list[Rows] = []
        for data in self.lean(grids):
            ellipses = data.ellipses
            rows.append(Rows(ellipses, data.delay, data.row_weights()))
            if self.spec.delay_margin_s is not None:
                late = data.delay * np.exp(-1j * ellipses.omega_rad_s * self.spec.delay_margin_s)
                rows.append(Rows(ellipses, late, _modulus(_DELAY_COPY_MODULUS, ellipses)))
        for guard in self.guards:
            points = guard.ellipses((self.grids if grids is None else grids)[guard.plant])
            rows.append(Rows(points, self.delay(points.omega_rad_s), _modulus(GUARD_MODULUS, points)))
        return rows

    def gamma(self, cascade: Cascade, parameters: Real) -> float:
        """Weighted worst case on the dense grids; inf if some nominal loop is unstable, an ellipse
        reaches -1 or the controller rings by itself more than it may."""
        asked = self.spec.controller_damping
        if asked is not None and not cascade.least_damping(parameters) >= asked * (1 - SOLVER_SLACK):
            return float("inf")
        if not self.usable(cascade, parameters):
            return float("inf")
        worst = 0.0
        for _, data in self.checks(cascade, parameters):
            values = data.weighted(cascade.response(parameters, data.ellipses.omega_rad_s))
            names = [each.requirement.name for each in data.weightings]
            worst = max(worst, float(np.max([np.max(values[name]) for name in names])))
        return worst

    def checks(self, cascade: Cascade, parameters: Real) -> list[tuple[int, PlantData]]:
        """(number of the plant, data) of the dense check of one controller: the dense grids, and points
        around lightly damped poles and zeros of the controller and poles of its loops, and below the grids
        where one of them is slower.

        A controller may hide a resonance between the points of any grid that does not know it, or a step
        below them, and an optimiser finds that out.
        """
        found = list(enumerate(self.dense))
        roots = cascade.roots(parameters)
        for number, (plant, poles) in enumerate(
            zip(self.plants, self.closed_loop_poles(cascade, parameters), strict=True)
        ):
            own = np.concatenate([roots, poles])
            light = modes_of(own, self.dt_s, zeta_below=_LIGHT)
            low = self.options.omega_min_rad_s or lowest_rad_s(plant.dt_s, plant.poles)
            begin = min(low, self.options.omega_min_rad_s or lowest_rad_s(plant.dt_s, own))
            if plant.own_grid is not None or not (light or begin < low):
                continue
            below = np.geomspace(
                begin, low, int(np.ceil(_PER_DECADE * np.log10(low / begin))), endpoint=False
            )
            # A pole or zero of either side of the circle.
            modes = (Mode(mode.omega_rad_s, abs(mode.zeta)) for mode in light)
            points = np.unique(np.concatenate([below, *(mode_points(mode, 25) for mode in modes)]))
            points = points[(points >= begin) & (points < plant.nyquist_rad_s)]
            if points.size:
                found.append((number, PlantData.build(plant, self.spec, points)))
        return found

    def stable(self, cascade: Cascade, parameters: Real) -> bool:
        """Whether every nominal loop is (poles of the full state space, strictly inside the circle), and
        every guard's."""
        poles = self.closed_loop_poles(cascade, parameters)
        return all(np.all(np.abs(each) < 1.0) for each in poles) and self.guarded(cascade, parameters)

    def delay(self, omega_rad_s: Real) -> Complex:
        """The computational delay at omega (F,)."""
        samples = self.spec.computational_delay_samples
        return np.asarray(np.exp(-1j * omega_rad_s * self.dt_s * samples), dtype=np.complex128)

    def delayed_response(self, cascade: Cascade, parameters: Real, omega_rad_s: Real) -> Complex:
        """K with its delay at omega (F,)."""
        return cascade.response(parameters, omega_rad_s) * self.delay(omega_rad_s)

    def guarded(self, cascade: Cascade, parameters: Real, guards: Sequence[Guard] | None = None) -> bool:
        """Whether 1 + K G winds as it has to for every guard, or for those given."""
        for number, omega, responses in self._guarded if guards is None else sorted_by_plant(guards):
            plant = self.plants[number]
            k = self.delayed_response(cascade, parameters, omega)
            stable, wide = winds(
                responses * k,
                integrators=plant.n_integrators + int(self.spec.integrator),
                unstable_poles=plant.unstable_poles,
            )
            if not np.all(stable & ~wide):  # a wide step is a pole next to the circle, on either side
                return False
        return True

    def closed_loop_poles(self, cascade: Cascade, parameters: Real) -> list[Complex]:
        """Poles (n,) of every nominal loop; one infinite pole for an algebraic loop."""
        a, b, c, d = cascade.state_space(parameters)
        return [loop.poles(a, b, c, d) for loop in self._loops]

    def usable(self, cascade: Cascade, parameters: Real) -> bool:
        """Whether it can be built and every nominal loop and guard is stable; false also where no anti-windup
        gain exists, which a numerically degenerate controller shows."""
        try:
            self.controller(cascade, parameters)
        except ValueError:
            return False
        return self.stable(cascade, parameters)

    def controller(self, cascade: Cascade, parameters: Real) -> Controller:
        """The controller of a parameter vector."""
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

    def add_violated(self, cascade: Cascade, parameters: Real, gamma_grid: float, most: int = 12) -> int:
        """Put maxima of the dense check that exceed the grid's gamma on the grids; how many were new."""
        limit = gamma_grid * (1.0 + EXCHANGE_TOLERANCE)
        added = 0
        for position, data in self.checks(cascade, parameters):
            omega = data.ellipses.omega_rad_s
            k = cascade.response(parameters, omega)
            worst = worst_of(data.weighted(k))
            covered = ~np.isfinite(worst)
            if np.any(covered):  # those deepest over -1 first
                depth = 2.0 - np.minimum(scale_to_minus_one(k * data.delay, data.ellipses)[covered], 1.0)
                worst[covered] = depth * 2.0 * np.max(worst[~covered], initial=limit)
            added += self._add(position, omega, worst, limit, most)
        for guard in self.guards:
            omega = guard.omega_rad_s
            k = self.delayed_response(cascade, parameters, omega)
            near = GUARD_MODULUS / np.maximum(np.abs(1.0 + guard.response * k), 1e-300)
            added += self._add(guard.plant, omega, near, limit, most)
        return added

    def _add(self, position: int, omega: Real, value: Real, limit: float, most: int) -> int:
        """Put the largest local maxima above the limit on the grid of one plant; how many were new."""
        before, after = self.grids[position], with_violations(self.grids[position], omega, value, limit, most)
        self.grids[position] = after
        return after.size - before.size


def _modulus(value: float, ellipses: Ellipses) -> tuple[tuple[LoopFunction, Real], ...]:
    """Nothing but a distance from -1 asked for."""
    return ((LoopFunction.SENSITIVITY, np.full(ellipses.omega_rad_s.size, value)),)
