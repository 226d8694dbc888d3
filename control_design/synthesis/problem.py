"""Plants and specification on grids: a lean one for the optimisers, a dense one for their checks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from control_design.analysis.stability import closed_loop_poles
from control_design.analysis.worst_case import PlantData, worst_of
from control_design.controllers.biquads import SOLVER_SLACK, Cascade
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Complex, Ellipses, Real, scale_to_minus_one
from control_design.plants.frequency_grid import frequency_grid, local_maxima, mode_points, plant_grid
from control_design.plants.guards import GUARD_MODULUS, Guard, sorted_by_plant, winds
from control_design.plants.plant_set import Mode, UncertainPlant, modes_of
from control_design.requirement import LoopFunction
from control_design.specification import Specification, performance_modes
from control_design.synthesis.angle_program import NlpPoint, Rows
from control_design.synthesis.synthesis_options import SynthesisOptions

_LIGHT = 0.05  # damping ratio; wider resonances do not fit between the points of a dense grid
_DELAY_COPY_MODULUS = 0.1  # distance from -1 asked of the delayed copies: stability with something to spare


class Problem:
    """What does not depend on the controller's order; the lean grids grow by exchange, the rest is fixed."""

    def __init__(
        self,
        plants: tuple[UncertainPlant, ...],
        specification: Specification,
        options: SynthesisOptions,
        guards: tuple[Guard, ...] = (),
    ) -> None:
        self.plants, self.spec, self.options, self.guards = plants, specification, options, guards
        self._guarded = sorted_by_plant(guards)
        self.dt_s = plants[0].dt_s
        self.scale = options.scale_rad_s or _frequency_scale(plants, specification)
        self._loops = [_Loop(plant, specification.computational_delay_samples) for plant in plants]
        self.grids: list[Real] = []
        self.dense: list[PlantData] = []
        for plant in plants:
            modes = _grid_modes(plant, specification)
            extra = [edge for asked in specification.weighted(plant) for edge in asked.band or ()]
            lean = frequency_grid(
                plant.nyquist_rad_s,
                modes,
                omega_min_rad_s=options.omega_min_rad_s,
                n_log=options.grid_points,
                n_mode=options.mode_points,
                extra=extra,
            )
            dense = frequency_grid(
                plant.nyquist_rad_s,
                modes,
                omega_min_rad_s=options.omega_min_rad_s,
                n_log=int(0.7 * options.dense_points),
                n_mode=int(0.3 * options.dense_points),
                extra=lean,
            )
            if plant.own_grid is not None:
                own = plant.own_grid
                outside = dense[(dense < own[0] * (1 - 1e-9)) | (dense > own[-1] * (1 + 1e-9))]
                dense = np.unique(np.concatenate([own[own > 0], outside]))
            self.grids.append(plant_grid(plant, lean))
            self.dense.append(PlantData.build(plant, specification, dense))

    @property
    def integrators(self) -> int:
        """Integrators of the loop: the controller's and the most of any plant."""
        return max(plant.n_integrators for plant in self.plants) + int(self.spec.integrator)

    @property
    def asks_tracking(self) -> bool:
        return self.spec.bandwidth_rad_s is not None or self.spec.sensitivity_weight is not None

    def lean(self, grids: Sequence[Real] | None = None) -> list[PlantData]:
        """Every plant on its lean grid, as it is now or as given."""
        return [
            PlantData.build(plant, self.spec, grid)
            for plant, grid in zip(self.plants, self.grids if grids is None else grids, strict=True)
        ]

    def rows(self, grids: Sequence[Real] | None = None) -> list[Rows]:
        """Rows of the optimisers on the lean grids, as they are now or as given."""
        rows: list[Rows] = []
        for data in self.lean(grids):
            plant, ellipses, asked = data.plant, data.ellipses, data.sensitivity
            rows.append(self._rows(plant, ellipses, data.delay, data.row_weights(), asked))
            if self.spec.delay_margin_s is not None:
                late = data.delay * np.exp(-1j * ellipses.omega_rad_s * self.spec.delay_margin_s)
                modulus = _modulus(_DELAY_COPY_MODULUS, ellipses)
                # A fractional delay makes the loop complex at Nyquist: its phase there is not tied to zero.
                rows.append(self._rows(plant, ellipses, late, modulus, asked, reaches_nyquist=False))
        for guard in self.guards:
            plant = self.plants[guard.plant]
            points = guard.ellipses((self.grids if grids is None else grids)[guard.plant])
            omega = points.omega_rad_s
            delay = np.exp(-1j * omega * self.dt_s * self.spec.computational_delay_samples)
            asked = self.spec.magnitude(plant, omega, LoopFunction.SENSITIVITY)
            rows.append(self._rows(plant, points, delay, _modulus(GUARD_MODULUS, points), asked))
        return rows

    def gamma(self, cascade: Cascade, parameters: Real, *, eased: bool = False) -> float:
        """Weighted worst case on the dense grids; inf if some nominal loop is unstable, an ellipse
        reaches -1 or the controller rings by itself more than it may. eased: without what is asked of
        disturbances at the input."""
        asked = self.spec.controller_damping
        if asked is not None and not cascade.least_damping(parameters) >= asked * (1 - SOLVER_SLACK):
            return float("inf")  # a start that IPOPT left infeasible
        if not self.usable(cascade, parameters):
            return float("inf")
        worst = 0.0
        for _, data in self.checks(cascade, parameters):
            values = data.weighted(cascade.response(parameters, data.ellipses.omega_rad_s))
            weighted = [each.requirement for each in data.weightings]
            names = [each.name for each in weighted if not (eased and each.function.of_plant)]
            worst = max(worst, float(np.max([np.max(values[name]) for name in names])))
        return worst

    def checks(self, cascade: Cascade, parameters: Real) -> list[tuple[int, PlantData]]:
        """(number of the plant, data) of the dense check of one controller: the dense grids, and points
        around lightly damped poles and zeros of the controller and poles of its loops.

        A controller may hide a resonance between the points of any grid that does not know it, and an
        optimiser finds that out.
        """
        found = list(enumerate(self.dense))
        roots = cascade.roots(parameters)
        for number, (plant, poles) in enumerate(
            zip(self.plants, self.closed_loop_poles(cascade, parameters), strict=True)
        ):
            light = modes_of(np.concatenate([roots, poles]), self.dt_s, zeta_below=_LIGHT)
            if plant.own_grid is not None or not light:
                continue
            points = np.concatenate([_around(mode) for mode in light])
            low, high = self.options.omega_min_rad_s, plant.nyquist_rad_s
            points = np.unique(points[(points > low) & (points < high)])
            if points.size:
                found.append((number, PlantData.build(plant, self.spec, points)))
        return found

    def stable(self, cascade: Cascade, parameters: Real) -> bool:
        """Whether every nominal loop is (poles of the full state space, strictly inside the circle), and
        every guard's."""
        a, b, c, d = cascade.state_space(parameters)
        return all(
            bool(np.all(np.abs(loop.poles(a, b, c, d)) < 1.0)) for loop in self._loops
        ) and self.guarded(cascade, parameters)

    def guarded(self, cascade: Cascade, parameters: Real, guards: Sequence[Guard] | None = None) -> bool:
        """Whether 1 + K G winds as it has to for every guard, or for those given."""
        samples = self.spec.computational_delay_samples
        for number, omega, responses in self._guarded if guards is None else sorted_by_plant(guards):
            plant = self.plants[number]
            k = cascade.response(parameters, omega) * np.exp(-1j * omega * self.dt_s * samples)
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
            controller = self.controller(cascade, parameters)
        except ValueError:
            return False
        return all(
            bool(np.max(np.abs(closed_loop_poles(controller, plant)), initial=0.0) < 1.0)
            for plant in self.plants
        ) and self.guarded(cascade, parameters)

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

    def at(self, cascade: Cascade, parameters: Real, rows: Sequence[Rows], gamma: float) -> NlpPoint:
        """Programme point for given controller parameters: angles along the nearest unwrapped phase of 1 +
        L."""
        angles = []
        for plant in rows:
            loop = cascade.response(parameters, plant.ellipses.omega_rad_s) * plant.delay
            phase = np.unwrap(np.angle(1.0 + plant.ellipses.centre * loop))
            middle = 0.5 * (plant.start_window[0] + plant.start_window[1])
            angles.append(phase - 2 * np.pi * np.round((phase[0] - middle) / (2 * np.pi)))
        return NlpPoint(np.asarray(parameters), 1.0 / min(max(gamma, 1e-3), 1e3), tuple(angles))

    def add_violated(self, cascade: Cascade, parameters: Real, gamma_grid: float, most: int = 12) -> int:
        """Put maxima of the dense check that exceed the grid's gamma on the grids; how many were new."""
        limit = gamma_grid * (1.0 + self.options.exchange_tolerance)
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
        samples = self.spec.computational_delay_samples
        for guard in self.guards:
            omega = guard.omega_rad_s
            k = cascade.response(parameters, omega) * np.exp(-1j * omega * self.dt_s * samples)
            near = GUARD_MODULUS / np.maximum(np.abs(1.0 + guard.response * k), 1e-300)
            added += self._add(guard.plant, omega, near, limit, most)
        return added

    def _add(self, position: int, omega: Real, value: Real, limit: float, most: int) -> int:
        """Put the largest local maxima above the limit on the grid of one plant; how many were new."""
        index = [i for i in local_maxima(value) if value[i] > limit][:most]
        new = np.setdiff1d(omega[index], self.grids[position])
        self.grids[position] = np.union1d(self.grids[position], new)
        return int(new.size)

    def _rows(
        self,
        plant: UncertainPlant,
        ellipses: Ellipses,
        delay: Complex,
        weights: tuple[tuple[LoopFunction, Real], ...],
        sensitivity: Real,
        *,
        reaches_nyquist: bool = True,
    ) -> Rows:
        """Rows scaled by positive factors that keep them of one size where 1 + L grows: integrators and steep
        tracking weights.

        A positive factor on |D_L + N_L| instead of |1 + L| leaves the angles alone; (omega/scale)^i is |D_L|
        of i integrators.
        """
        integrators = plant.n_integrators + int(self.spec.integrator)
        slope = np.minimum(1.0, ellipses.omega_rad_s / self.scale) ** integrators
        scale = np.asarray(np.minimum(slope, 1.0 / np.maximum(sensitivity, 1.0)), dtype=np.float64)
        return Rows(ellipses, delay, weights, scale, self._start_window(plant), reaches_nyquist)

    def _start_window(self, plant: UncertainPlant) -> tuple[float, float]:
        """Range of the first angle: arg(1 + L) of a stable loop starts at -pi (P + i/2), see
        `stability.nyquist_count`.

        The angle of a supporting normal may differ from arg(1 + L) by up to pi/2; windows are narrower than
        pi, so that they cannot take the next branch. With integrators there is more room towards lead: at the
        lowest frequency the loop may have come some way from its limit already.
        """
        integrators = plant.n_integrators + int(self.spec.integrator)
        centre = -np.pi * (plant.unstable_poles + integrators / 2.0)
        return (centre - 1.4, centre + 1.4) if integrators == 0 else (centre - 0.63, centre + 1.87)


def _modulus(value: float, ellipses: Ellipses) -> tuple[tuple[LoopFunction, Real], ...]:
    """Nothing but a distance from -1 asked for."""
    return ((LoopFunction.SENSITIVITY, np.full(ellipses.omega_rad_s.size, value)),)


class _Loop:
    """One nominal plant with the computational delay at its input, ready to be closed many times."""

    def __init__(self, plant: UncertainPlant, delay_samples: int) -> None:
        a, b, c, d = (np.asarray(getattr(plant.nominal, m), dtype=np.float64) for m in "ABCD")
        for _ in range(delay_samples):
            n = a.shape[0]
            a = np.block([[a, b], [np.zeros((1, n + 1))]])
            b = np.vstack([np.zeros((n, 1)), np.ones((1, 1))])
            c, d = np.hstack([c, d]), np.zeros((1, 1))
        self._a, self._b, self._c, self._d = a, b, c, float(d[0, 0])

    def poles(self, a: Real, b: Real, c: Real, d: Real) -> Complex:
        """Poles (n,) with this controller; one infinite pole for an algebraic loop."""
        loop = 1.0 + float(d[0, 0]) * self._d
        n = self._a.shape[0]
        if not (abs(loop) > 1e-12 and np.all(np.isfinite(a)) and np.all(np.isfinite(c))):
            return np.array([np.inf + 0j])
        # u = (c x_k - d C x)/loop, e = -(C x + D u)
        u = np.hstack([(-float(d[0, 0]) / loop) * self._c, c / loop])
        e = -self._d * u
        e[:, :n] -= self._c
        closed = np.vstack([self._b @ u, b @ e])
        closed[:n, :n] += self._a
        closed[n:, n:] += a
        if not np.all(np.isfinite(closed)):
            return np.array([np.inf + 0j])
        return np.asarray(np.linalg.eigvals(closed), dtype=np.complex128)


def _around(mode: Mode) -> Real:
    """Points around a pole or zero of either side of the circle."""
    return mode_points(Mode(mode.omega_rad_s, abs(mode.zeta)), 25)


def _frequency_scale(plants: Sequence[UncertainPlant], specification: Specification) -> float:
    """Frequency around which the controller has to act: bandwidth and lowest mode, or a tenth of Nyquist."""
    candidates = [mode.omega_rad_s for plant in plants for mode in plant.modes[:1]]
    if specification.bandwidth_rad_s is not None:
        candidates.append(3.0 * specification.bandwidth_rad_s)
    if not candidates:
        return 0.1 * plants[0].nyquist_rad_s
    return float(np.exp(np.mean(np.log(candidates))))


def _grid_modes(plant: UncertainPlant, specification: Specification) -> tuple[Mode, ...]:
    """Modes that deserve dense points: the plant's, and the performance channel's where damping is asked
    for."""
    modes = list(plant.modes)
    if specification.mode_peak_ratio is not None:
        modes += [
            m
            for m in performance_modes(plant)
            if all(abs(m.omega_rad_s - o.omega_rad_s) > 1e-6 * o.omega_rad_s for o in modes)
        ]
    return tuple(modes)
