"""Structured robust synthesis: several starts of the angle programme, then exchange of violated
frequencies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from control_design.angle_program import AngleProgram, NlpPoint, Rows
from control_design.biquads import SOLVER_SLACK, Cascade
from control_design.controller import Controller
from control_design.ellipses import Complex, Real
from control_design.frequency_grid import frequency_grid, local_maxima, plant_grid
from control_design.plant_set import Mode, UncertainPlant
from control_design.specification import Specification, performance_modes
from control_design.stability import closed_loop_poles
from control_design.synthesis_result import BlockingPoint, Outcome, StartReport, SynthesisResult
from control_design.worst_case import KINDS, PlantData, worst_of

Progress = Callable[[float, str], None]

_DELAY_COPY_MODULUS = 0.1  # distance from -1 asked of the delayed copies: stability with something to spare
_DAMPING_STEP = 1.5  # W4 rises by at most this factor at a time
_WELL_ABOVE = 1.05
_STILL_BLOCKING = 0.98  # a weighted maximum within 2 % of the worst one blocks the specification too


class SynthesisOptions(BaseModel):
    """How hard to search; the defaults solve an order-5 design in a few seconds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    starts: int = Field(default=10, ge=1, le=100, description="low-gain starts")
    agreeing_starts: int = Field(
        default=4, ge=1, description="stop early when so many starts reach the best value within 0.1 %"
    )
    sufficient_gamma: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="stop as soon as a stable design reaches this gamma; 0 = look for the best",
    )
    exchange_rounds: int = Field(default=4, ge=0, le=20, description="rounds of adding violated frequencies")
    exchange_tolerance: float = Field(
        default=5e-4,
        gt=0,
        lt=0.1,
        description="accepted relative excess of the dense check over the programme",
    )
    grid_points: int = Field(default=110, ge=20, le=2000, description="logarithmic points of the programme")
    mode_points: int = Field(default=60, ge=0, le=1000, description="points spread around the flexible modes")
    dense_points: int = Field(default=8000, ge=500, le=100_000, description="points of the dense check")
    omega_min_rad_s: float = Field(default=1e-4, gt=0, description="lowest frequency of all grids, rad/s")
    iterations: int = Field(default=250, ge=10, le=5000, description="IPOPT iterations per start and round")
    scale_rad_s: float | None = Field(
        default=None,
        gt=0,
        description="frequency scale of controller parameters and starts; none = from the specification",
    )


def synthesise(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> SynthesisResult:
    """Design one controller for all plants: smallest gamma over every ellipse.

    Parameters
    ----------
    plants : at least one; several loads, operating points or identified models at once.
    rng : the starts are drawn from it; same generator state, same result.
    progress : called with (fraction, message).

    Raises
    ------
    SpecificationError
        If specification and plants contradict each other (before optimising).

    Notes
    -----
    Design: W1 and W3 (and W4 with an independent performance channel) in angle form, W4 of the measured
    output itself in S-lemma form, from the best starts of the programme without W4. After the starts the
    dense check adds its violated local maxima and the programme is solved again from the best point; a point
    is accepted only if all nominal loops are stable and gamma is not worse.
    """
    options = options or SynthesisOptions()
    specification.check_against(plants)
    return _Search(
        tuple(plants), specification, options, rng, progress or (lambda fraction, message: None)
    ).run()


@dataclass(frozen=True, eq=False)
class _Candidate:
    point: NlpPoint
    gamma: float


class _Search:
    """State of one synthesis: grids, dense data, best candidate."""

    def __init__(
        self,
        plants: tuple[UncertainPlant, ...],
        specification: Specification,
        options: SynthesisOptions,
        rng: np.random.Generator,
        progress: Progress,
    ) -> None:
        self.plants, self.spec, self.options, self.rng, self.progress = (
            plants,
            specification,
            options,
            rng,
            progress,
        )
        self.scale = options.scale_rad_s or _frequency_scale(plants, specification)
        self.cascade = Cascade(specification.sections(), plants[0].dt_s, self.scale)
        self.grids: list[Real] = []
        self.dense: list[PlantData] = []
        for plant in plants:
            modes = _grid_modes(plant, specification)
            extra = () if (band := specification.mode_band(plant)) is None else band
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

    def run(self) -> SynthesisResult:
        first = self._program(with_damping=False)
        reports: list[StartReport] = []
        found: list[_Candidate] = []
        needs_second = self._s_lemma_needed()
        share = 0.5 if needs_second else 0.7
        first_kinds = KINDS[:3] if needs_second else KINDS
        for number in range(self.options.starts):
            self.progress(
                share * number / self.options.starts, f"start {number + 1} of {self.options.starts}"
            )
            point = first.solve(self._start(first.plants))
            gamma = self.gamma(point.parameters, kinds=first_kinds)
            reports.append(
                StartReport(
                    number + 1,
                    point.status,
                    point.iterations,
                    1.0 / point.g,
                    gamma if np.isfinite(gamma) else None,
                )
            )
            if np.isfinite(gamma):
                found.append(_Candidate(point, gamma))
            best = min((c.gamma for c in found), default=np.inf)
            if sum(c.gamma <= best * 1.001 for c in found) >= self.options.agreeing_starts:
                break
            if best <= self.options.sufficient_gamma:
                break
        found.sort(key=lambda c: c.gamma)
        if needs_second and found:
            found = self._with_damping(_distinct(found, 2), share)
        if not found:
            return self._nothing_stable(tuple(reports))
        return self._exchange(found[0], tuple(reports))

    def _with_damping(self, candidates: Sequence[_Candidate], share: float) -> list[_Candidate]:
        """Add the S-lemma rows to solutions without them (cold starts rarely converge on elongated ellipses).

        First in one jump; where that stays well above the gamma without W4, also along a path on which W4
        rises from where the solution meets it already. Neither way wins always: on the published link the
        path wins in scenario A, the jump in B.
        """
        program = self._program(with_damping=True)
        found: list[_Candidate] = []
        for number, candidate in enumerate(candidates):
            self.progress(
                share + 0.2 * number / len(candidates), f"damping of the mode {number + 1}/{len(candidates)}"
            )
            start = candidate.point
            excess = max(1.0, self.gamma(start.parameters) / candidate.gamma)
            found.append(self._follow(program, start, [1.0]))
            if excess > _DAMPING_STEP and found[-1].gamma > _WELL_ABOVE * candidate.gamma:
                steps = int(np.ceil(np.log(excess) / np.log(_DAMPING_STEP)))
                path = excess ** -(1.0 - np.arange(1, steps + 1) / steps)
                found.append(self._follow(program, start, path.tolist()))
        return sorted((c for c in found if np.isfinite(c.gamma)), key=lambda c: c.gamma)

    def _follow(self, program: AngleProgram, start: NlpPoint, path: Sequence[float]) -> _Candidate:
        """Solve along scalings of W4, keeping a point only where it gains."""
        point = start
        for damping in path:
            gamma = self._gamma_with_damping(point.parameters, damping)
            trial = program.solve(self._at(point.parameters, program.plants, gamma), damping=damping)
            if self._gamma_with_damping(trial.parameters, damping) < gamma:
                point = trial
        return _Candidate(point, self.gamma(point.parameters))

    def _gamma_with_damping(self, parameters: Real, damping: float) -> float:
        return max(self.gamma(parameters, kinds=KINDS[:3]), damping * self.gamma(parameters, kinds=KINDS[3:]))

    def _exchange(self, best: _Candidate, reports: tuple[StartReport, ...]) -> SynthesisResult:
        history = [best.gamma]
        current = best
        for number in range(self.options.exchange_rounds):
            done = 0.7 + 0.3 * number / max(1, self.options.exchange_rounds)
            self.progress(done, f"exchange {number + 1}: gamma {best.gamma:.4g}")
            added = self._add_violated(current)
            unfinished = current.point.status == "Maximum_Iterations_Exceeded"
            if best.gamma <= self.options.sufficient_gamma or (added == 0 and not unfinished):
                break
            program = self._program(with_damping=True)
            start = self._at(best.point.parameters, program.plants, best.gamma)
            point = program.solve(start)
            gamma = self.gamma(point.parameters)
            current = _Candidate(point, gamma)
            if gamma < best.gamma:
                best = current
            history.append(best.gamma)
            if not np.isfinite(gamma):
                break
        self.progress(1.0, f"gamma {best.gamma:.4g}")
        outcome = Outcome.MET_ON_GRID if best.gamma <= 1.0 else Outcome.NOT_MET
        return SynthesisResult(
            outcome=outcome,
            controller=self._controller(best.point.parameters),
            gamma=best.gamma,
            blocking=self._blocking(best),
            starts=reports,
            gamma_history=tuple(history),
            grid_points=sum(grid.size for grid in self.grids),
        )

    def _nothing_stable(self, reports: tuple[StartReport, ...]) -> SynthesisResult:
        zero = np.zeros((1, 1))
        nothing = Controller(
            np.zeros((0, 0)),
            np.zeros((0, 1)),
            np.zeros((1, 0)),
            zero,
            self.cascade.dt_s,
            computational_delay_samples=self.spec.computational_delay_samples,
            name="none: no stable design found",
        )
        return SynthesisResult(
            Outcome.NOT_CONVERGED,
            nothing,
            float("inf"),
            (),
            reports,
            (),
            sum(grid.size for grid in self.grids),
        )

    def _controller(self, parameters: Real) -> Controller:
        a, b, c, d = self.cascade.state_space(parameters)
        return Controller(
            a,
            b,
            c,
            d,
            self.cascade.dt_s,
            computational_delay_samples=self.spec.computational_delay_samples,
            input_limit=self.spec.input_limit,
            rate_limit=self.spec.rate_limit,
        )

    def gamma(self, parameters: Real, *, kinds: Sequence[str] = KINDS) -> float:
        """Weighted worst case on the dense grids; inf if some nominal loop is unstable, an ellipse reaches -1 or
        the controller rings by itself more than it may."""
        asked = self.spec.controller_damping
        if asked is not None and not self.cascade.least_damping(parameters) >= asked * (1 - SOLVER_SLACK):
            return float("inf")  # a start that IPOPT left infeasible
        try:
            controller = self._controller(parameters)
        except ValueError:
            return float("inf")  # no anti-windup gain: numerically degenerate
        if any(
            not np.max(np.abs(closed_loop_poles(controller, plant)), initial=0.0) < 1.0
            for plant in self.plants
        ):
            return float("inf")
        worst = 0.0
        for data in self.dense:
            values = data.weighted(self.cascade.response(parameters, data.ellipses.omega_rad_s))
            worst = max(worst, float(np.max([np.max(values[kind]) for kind in kinds])))
        return worst

    def _blocking(self, best: _Candidate) -> tuple[BlockingPoint, ...]:
        points = []
        for data in self.dense:
            values = data.weighted(self.cascade.response(best.point.parameters, data.ellipses.omega_rad_s))
            for kind in KINDS:
                for index in local_maxima(values[kind])[:10]:
                    value = float(values[kind][index])
                    if value >= _STILL_BLOCKING * best.gamma:
                        points.append(
                            BlockingPoint(
                                data.plant.name, kind, float(data.ellipses.omega_rad_s[index]), value
                            )
                        )
        return tuple(sorted(points, key=lambda p: -p.value))

    def _add_violated(self, candidate: _Candidate, most: int = 12) -> int:
        """Put local maxima of the dense check that exceed the programme's gamma on the grids; how many were
        new."""
        limit = (1.0 / candidate.point.g) * (1.0 + self.options.exchange_tolerance)
        added = 0
        for position, data in enumerate(self.dense):
            omega = data.ellipses.omega_rad_s
            values = data.weighted(self.cascade.response(candidate.point.parameters, omega))
            worst = worst_of(values)
            index = [i for i in local_maxima(worst) if worst[i] > limit][:most]
            new = np.setdiff1d(omega[index], self.grids[position])
            self.grids[position] = np.union1d(self.grids[position], new)
            added += new.size
        return added

    def _s_lemma_needed(self) -> bool:
        return any(data.gp_max is None and bool(np.any(data.w4 > 0)) for data in self.dense)

    def _program(self, *, with_damping: bool) -> AngleProgram:
        rows: list[Rows] = []
        for plant, grid in zip(self.plants, self.grids, strict=True):
            data = PlantData.build(plant, self.spec, grid)
            rows.append(self._rows(data, data.delay, with_damping=with_damping))
            if self.spec.delay_margin_s is not None:
                late = data.delay * np.exp(-1j * grid * self.spec.delay_margin_s)
                rows.append(self._delay_copy(data, late))
        return AngleProgram(
            self.cascade,
            rows,
            controller_damping=self.spec.controller_damping,
            max_iterations=self.options.iterations,
        )

    def _rows(self, data: PlantData, delay: Complex, *, with_damping: bool) -> Rows:
        omega = data.ellipses.omega_rad_s
        keep_w4 = with_damping or data.gp_max is not None
        return Rows(
            ellipses=data.ellipses,
            delay=delay,
            w1=np.maximum(data.w1, data.modulus),
            w3=data.w3,
            w4=data.w4 if keep_w4 else np.zeros(omega.size),
            gp_max=data.gp_max,
            row_scale=self._row_scale(data),
            start_window=self._start_window(data.plant),
            reaches_nyquist=True,
        )

    def _delay_copy(self, data: PlantData, delay: Complex) -> Rows:
        zero = np.zeros(data.ellipses.omega_rad_s.size)
        return Rows(
            ellipses=data.ellipses,
            delay=delay,
            w1=zero + _DELAY_COPY_MODULUS,
            w3=zero,
            w4=zero,
            gp_max=None,
            row_scale=self._row_scale(data),
            start_window=self._start_window(data.plant),
            # A fractional delay makes the loop complex at Nyquist: its phase there is not tied to zero.
            reaches_nyquist=False,
        )

    def _row_scale(self, data: PlantData) -> Real:
        """Positive factors that keep rows of one size where 1 + L grows: integrators and steep tracking
        weights.

        A positive factor on |D_L + N_L| instead of |1 + L| leaves the angles alone; (omega/scale)^i is |D_L|
        of i integrators.
        """
        integrators = data.plant.n_integrators + int(self.spec.integrator)
        slope = np.minimum(1.0, data.ellipses.omega_rad_s / self.scale) ** integrators
        return np.asarray(np.minimum(slope, 1.0 / np.maximum(data.w1, 1.0)), dtype=np.float64)

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

    def _at(self, parameters: Real, rows: Sequence[Rows], gamma: float) -> NlpPoint:
        """Programme point for given controller parameters: angles along the nearest unwrapped phase of 1 +
        L."""
        angles = []
        for plant in rows:
            loop = self.cascade.response(parameters, plant.ellipses.omega_rad_s) * plant.delay
            phase = np.unwrap(np.angle(1.0 + plant.ellipses.centre * loop))
            middle = 0.5 * (plant.start_window[0] + plant.start_window[1])
            angles.append(phase - 2 * np.pi * np.round((phase[0] - middle) / (2 * np.pi)))
        return NlpPoint(np.asarray(parameters), 1.0 / min(max(gamma, 1e-3), 1e3), tuple(angles))

    def _start(self, rows: Sequence[Rows]) -> NlpPoint:
        """A random low-gain cascade with stable nominal loops: smaller gains, or slower leads, until it is
        stable."""
        integrators = max(plant.n_integrators for plant in self.plants) + int(self.spec.integrator)
        first = {"integrator": 2, "first_order": 2, "second_order": 3}[self.cascade.sections[0]]
        crossover = 10 ** self.rng.uniform(-0.7, 0.0)
        parameters = self._random_sections()
        parameters[:first] *= self._low_gain(parameters)
        gamma = float("inf")
        for _ in range(12):
            if integrators >= 2:
                # Less gain does not stabilise two integrators: a lead around a slower and slower crossover
                # does.
                parameters = self._lead_sections(crossover)
                parameters[:first] *= self._crossover_gain(parameters, crossover * self.scale)
                crossover *= 0.6
            gamma = self.gamma(parameters, kinds=KINDS[:3])
            if np.isfinite(gamma):
                break
            parameters[:first] *= 0.5
        return self._at(parameters, rows, gamma)

    def _random_sections(self) -> Real:
        """Sections with corners within a factor 5 of the scale, numerators near their denominators."""
        x: list[float] = []
        for kind in self.cascade.sections:
            corner = 10 ** self.rng.uniform(-0.7, 0.7)
            damping = self.rng.uniform(0.3, 1.0)
            jitter = 1.0 + 0.3 * self.rng.standard_normal(3)
            if kind == "integrator":
                x += [
                    jitter[0],
                    0.1 * corner * abs(jitter[1]),
                ]  # proportional part first, slow integral action
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
        crossover = self.scale * 10 ** self.rng.uniform(-1.5, -0.3)
        gain = self._crossover_gain(parameters, crossover)
        asked = self.spec.bandwidth_rad_s is not None or self.spec.sensitivity_weight is not None
        if not asked and self.dense[0].plant.n_integrators + int(self.spec.integrator) == 0:
            gain *= 1.0 if self.rng.uniform() < 0.5 else -1.0  # pure damping knows no sign
        return gain

    def _crossover_gain(self, parameters: Real, crossover_rad_s: float) -> float:
        """Factor that makes |L| = 1 at the crossover, signed so that arg L(0+) = -i pi/2 (see
        `_start_window`)."""
        data = self.dense[0]
        omega = data.ellipses.omega_rad_s
        loop = self.cascade.response(parameters, omega) * data.ellipses.centre
        size = float(np.abs(loop[int(np.argmin(np.abs(omega - crossover_rad_s)))]))
        order = data.plant.n_integrators + int(self.spec.integrator)
        sign = 1.0 if (loop[0] * 1j**order).real >= 0 else -1.0
        return sign / max(size, 1e-12)


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


def _distinct(candidates: Sequence[_Candidate], most: int) -> list[_Candidate]:
    """Best candidates that differ in gamma by more than 0.2 %: the same optimum twice teaches nothing."""
    kept: list[_Candidate] = []
    for candidate in candidates:
        if all(abs(candidate.gamma / other.gamma - 1) > 2e-3 for other in kept):
            kept.append(candidate)
        if len(kept) == most:
            break
    return kept
