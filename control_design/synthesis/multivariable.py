"""Synthesis of one controller for plants with several inputs and outputs: fixed order and structure.

A start is a reduced H-infinity controller (`riccati_starts`), or a stable static gain with modal blocks that
are spread over frequency and do nothing yet. It is taken down to a local minimum of the worst case
(`MatrixDescent`), with the frequencies that a dense check finds violated added as it goes. Nothing is random.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from control_design.analysis.limited_loop import limited_joints, with_safe_limits
from control_design.analysis.stability import NominalLoop
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Real
from control_design.plants.frequency_grid import frequency_grid, local_maxima, lowest_rad_s
from control_design.plants.multivariable import MultivariablePlant, tustin_s
from control_design.plants.plant_set import Mode, matrix_response, modes_of
from control_design.plants.scaled_bound import largest_channel, scaled_bound
from control_design.specification.multivariable import MultivariableSpecification
from control_design.specification.specification import SpecificationError
from control_design.synthesis.modal_controller import ModalForm
from control_design.synthesis.multivariable_descent import MatrixDescent, StackedRows, stacked_rows
from control_design.synthesis.riccati_starts import central_controller, reduced, weighted_plant
from control_design.synthesis.synthesis import part_of
from control_design.synthesis.synthesis_options import MultivariableOptions
from control_design.synthesis.synthesis_result import BlockingPoint, Outcome
from ident.data.shown import Shown

_LIGHT = 0.3  # poles of loop and controller damped less have frequencies of their own in every check
_AROUND = np.array([-3, -1.5, -0.7, -0.3, 0, 0.3, 0.7, 1.5, 3])  # in half-widths of such a pole
_EXCESS = 5e-4  # accepted of the dense check over the programme
_AT = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1)  # of the scale: where a static gain inverts the plant
_SAME = 1e-3  # relative difference of worst cases below which two static gains count as one
_SCALINGS = (0.03, 0.1, 0.3, 1.0)  # what the ball puts in, over the references
_SPREAD = 0.1, 30.0, 0.7  # of blocks that do nothing yet: corners over the scale, damping ratio
_MOST = 15  # violated frequencies added in a round


@dataclass(frozen=True, repr=False)
class MultivariableResult(Shown):
    """gamma: largest worst case over plants, requirements and the dense grid (at most 1: met). worst: by
    name of the requirement. blocking: where gamma is reached, worst first. steps of the descents in all.
    Certify with `certify_multivariable` before use."""

    outcome: Outcome
    controller: Controller
    gamma: float
    worst: dict[str, float]
    blocking: tuple[BlockingPoint, ...]
    steps: int


def synthesise_multivariable(
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    options: MultivariableOptions | None = None,
    *,
    progress: Callable[[float, str], None] | None = None,
) -> MultivariableResult:
    """One controller u = -K y of fixed order and structure with the smallest worst case over the plants'
    uncertainty; all plants (operating points) share dt, U and Y.

    The worst case is the largest singular value of each weighted function by itself, over every ball and
    block of the plants, at every frequency of a grid: `scaled_bound`. A local minimum is found, the best of
    `options.starts`, the same every time. Neglected: scheduling over operating points; one controller serves
    all.

    Raises SpecificationError if the plants do not fit one another or the structure, or no static gain of the
    structure stabilises them.
    """
    options = options or MultivariableOptions()
    listed = (plants,) if isinstance(plants, MultivariablePlant) else tuple(plants)
    programme = Programme(listed, specification, options)
    tell = progress or (lambda fraction, message: None)
    gamma, best = np.inf, np.zeros(0)
    starts = programme.starts()[: options.starts]
    for number, start in enumerate(starts):
        x, reached = programme.improved(start, part_of(tell, number, len(starts)))
        if reached < gamma or not best.size:
            gamma, best = reached, x
        if gamma <= options.sufficient_gamma:
            break
    tell(1.0, "synthesis")
    return programme.result(gamma, best)


class Programme:
    """Plants and specification on a lean grid to begin with and on a dense one."""

    def __init__(
        self,
        plants: tuple[MultivariablePlant, ...],
        specification: MultivariableSpecification,
        options: MultivariableOptions,
    ) -> None:
        first = plants[0]
        for plant in plants[1:]:
            if (plant.inputs, plant.outputs, plant.dt_s) != (first.inputs, first.outputs, first.dt_s):
                raise SpecificationError(
                    f"plants {first.name!r} and {plant.name!r} differ in dt, inputs or outputs"
                )
        self.plants, self.spec, self.options, self.dt_s = plants, specification, options, first.dt_s
        self.pattern = specification.pattern(first.inputs, first.outputs)
        self.names = tuple(specification.weights(first.inputs, first.outputs))
        corners = [
            abs(root)
            for _, weights in specification.weights(first.inputs, first.outputs).values()
            for weight in weights
            if weight is not None
            for root in np.roots(weight.denominator)
            if root
        ]
        slow = 0.1 * min(corners, default=np.inf)
        self.lowest_rad_s = min(slow, *(lowest_rad_s(self.dt_s, plant.poles) for plant in plants))
        delay = specification.computational_delay_samples
        self.loops = [NominalLoop(plant, delay) for plant in plants]
        self.lean = [self._grid(plant, options.grid_points, options.mode_points) for plant in plants]
        dense = [self._grid(plant, options.dense_points, 5 * options.mode_points) for plant in plants]
        self.dense = stacked_rows(plants, specification, dense)
        self.scale_rad_s = self._scale()
        self.steps = 0
        # Refuses an order that no form has.
        self.form = self._form(specification.controller_order)

    def _grid(self, plant: MultivariablePlant, points: int, around: int) -> Real:
        if plant.own_grid is not None:
            return plant.own_grid[plant.own_grid < np.pi / self.dt_s]
        modes = [*plant.modes, *modes_of(plant.zeros, self.dt_s)]
        modes = [
            Mode(m.omega_rad_s, max(abs(m.zeta), 1e-4)) for m in modes if m.omega_rad_s < np.pi / self.dt_s
        ]
        low, top = self.lowest_rad_s, 0.9999 * np.pi / self.dt_s
        return frequency_grid(top, modes, omega_min_rad_s=low, n_log=points, n_mode=around * len(modes))

    def _scale(self) -> float:
        """Around which frequency the controller has to act: the geometric mean of the bandwidths, or where
        the tracking weights fall to one."""
        found = [joint.bandwidth_rad_s for joint in self.spec.joints if joint.bandwidth_rad_s is not None]
        omega = np.geomspace(1e-5, 0.99, 400) * np.pi / self.dt_s
        for joint in self.spec.joints:
            weight = joint.sensitivity_weight
            if weight is not None and np.any(above := np.abs(weight.at(tustin_s(omega, self.dt_s))) > 1.0):
                found.append(float(omega[above][-1]))
        return float(np.exp(np.mean(np.log(found)))) if found else 0.1 * float(np.pi / self.dt_s)

    def _form(self, order: int) -> ModalForm:
        """Parameters of a controller with so many states."""
        integrates = np.array([joint.integrator for joint in self.spec.joints[: self.plants[0].outputs]])
        return ModalForm(
            self.pattern, order, integrates, 2 * self.scale_rad_s, 2 * self.lowest_rad_s, self.dt_s,
            self.spec.controller_damping,
        )  # fmt: skip

    def starts(self) -> list[Real]:
        """Parameters to begin with, those of the lowest worst case first: static gains with blocks that do
        nothing yet, and reduced H-infinity controllers of the first plant: not for a structure, nor where
        channels have errors of their own, which `weighted_plant` neglects."""
        found: list[tuple[float, Real]] = []
        if self.pattern.all() and not any(each.input_error or each.output_error for each in self.plants):
            plant, slowest = self.plants[0], self.lowest_rad_s
            with suppress(np.linalg.LinAlgError):  # a pole at z = -1, or a problem that rounding spoils
                plain = weighted_plant(replace(plant, ball=None), self.spec, 1.0, self.scale_rad_s, slowest)
                for scaling in _SCALINGS:
                    P = weighted_plant(plant, self.spec, scaling, self.scale_rad_s, slowest)
                    if (K := central_controller(P)) is not None and K[0].shape[0] >= self.form.order:
                        K = reduced(K, plain, self.form.order, self.lowest_rad_s, 2 / self.dt_s)
                        found += [(self.worst(x), x) for x in (self.form.realised(*K),) if x is not None]
        found = [each for each in found if np.isfinite(each[0])]
        with suppress(*([SpecificationError] if found else [])):
            found += [(self.worst(x), x) for _, x in self.static()]
        return [x for _, x in sorted(found, key=lambda each: each[0])]

    def static(self) -> list[tuple[float, Real]]:
        """Worst cases and parameters of static gains, best first: the real part of a pseudo-inverse of the
        plant at a frequency around the scale, with the best factor that is stable."""
        form, blocks = self.form, self.form.spread(*_SPREAD)
        descent = MatrixDescent(form, stacked_rows(self.plants, self.spec, self.lean), self.loops)
        found: list[tuple[float, Real]] = []
        for omega in self.scale_rad_s * np.array(_AT):
            G = matrix_response(self.plants[0].nominal, np.array([omega]))[0]
            for lag in (0.0, 0.25, 0.5):  # in half turns: plants that integrate are turned by a half of one
                D = np.where(self.pattern, np.linalg.pinv(G * np.exp(1j * np.pi * lag)).real, 0.0)
                D = D / (np.linalg.norm(G @ D, 2) or 1.0)
                best: tuple[float, Real] | None = None
                for gain in 2.0 ** np.arange(4.0, -14.0, -1.0):
                    x = form.join(*blocks, gain * D, 0.1 * omega * gain * D[:, form.integrates])
                    bound = descent.bound(x, None)
                    if bound is None and best is None:
                        continue
                    gamma = np.inf if bound is None else float(np.max(bound.gamma))
                    if best is not None and gamma > best[0]:
                        break
                    best = gamma, x
                found += [best] if best is not None else []
        if not found:
            raise SpecificationError(
                "no static gain of this structure stabilises the plant robustly; allow more entries of K "
                "(structure), or close a stabilising loop first and design around it"
            )
        found.sort(key=lambda each: each[0])
        before = [0.0, *(gamma for gamma, _ in found)]  # one gain may be found at several frequencies
        return [each for each, last in zip(found, before, strict=False) if each[0] > (1 + _SAME) * last]

    def improved(
        self, x: Real, tell: Callable[[float, str], None] = lambda fraction, message: None
    ) -> tuple[Real, float]:
        """Descents in rounds, with violated frequencies added: best parameters and their worst case on the
        dense grid."""
        grids = list(self.lean)
        best, least = x, self.worst(x)
        for number in range(self.options.rounds):
            tell(
                number / self.options.rounds,
                f"worst case {least:.3g}" if np.isfinite(least) else "looking for robust stability",
            )
            grids = [np.union1d(grid, light) for grid, light in zip(grids, self._light(x), strict=True)]
            descent = MatrixDescent(self.form, stacked_rows(self.plants, self.spec, grids), self.loops)
            end, reached, steps = descent.run(x, self.options.steps)
            self.steps += steps
            if not np.isfinite(reached):
                break
            checked = self.check(end)
            worst = max(float(np.max(value)) for _, value in checked)
            gain = least / worst - 1.0 if np.isfinite(least) else np.inf
            if worst < least:
                best, least = end, worst
            if np.isfinite(worst):
                x = end  # else once more from the same point, with the frequencies that were missing
            done = worst <= reached * (1 + _EXCESS) and (steps < self.options.steps or gain < _EXCESS / 2)
            if done or least <= self.options.sufficient_gamma:
                break
            limit = reached * (1 + 0.5 * _EXCESS)
            for i, (omega, value) in enumerate(checked):
                violated = omega[[k for k in local_maxima(value) if value[k] > limit][:_MOST]]
                grids[i] = np.union1d(grids[i], violated)
                if not np.isfinite(worst):
                    self.lean[i] = np.union1d(self.lean[i], violated)
        return best, least

    def worst(self, x: Real) -> float:
        """Worst case on the dense grid; inf for an unstable nominal loop."""
        a, b, c, d = self.form.discrete(x)
        if not all(np.all(np.abs(loop.poles(a, b, c, d)) < 1.0) for loop in self.loops):
            return float("inf")
        return max(float(np.max(value)) for _, value in self.check(x))

    def check(self, x: Real) -> list[tuple[Real, Real]]:
        """Of every plant: frequencies (F,) of the dense check and of light poles, worst case (F,) there."""
        light = self._light(x)
        found = [(self.dense, self._gamma(x, self.dense))]
        if any(each.size for each in light):
            more = stacked_rows(self.plants, self.spec, light)
            found.append((more, self._gamma(x, more)))
        checked = []
        for number in range(len(self.plants)):
            omega = np.concatenate([stack.omega_rad_s[stack.plant == number] for stack, _ in found])
            gamma = np.concatenate([value[stack.plant == number] for stack, value in found])
            unique, inverse = np.unique(omega, return_inverse=True)
            worst = np.zeros(unique.size)
            np.maximum.at(worst, inverse, gamma)
            checked.append((unique, worst))
        return checked

    def _gamma(self, x: Real, stack: StackedRows) -> Real:
        return scaled_bound(stack.rows, self.form.response(x[None], stack.s)[0], accuracy=1e-6).gamma

    def _light(self, x: Real) -> list[Real]:
        """Frequencies around lightly damped poles of every loop and of the controller."""
        abcd = self.form.discrete(x)
        own = np.linalg.eigvals(abcd[0])
        found = []
        for plant, loop in zip(self.plants, self.loops, strict=True):
            modes = modes_of(np.concatenate([own, loop.poles(*abcd)]), self.dt_s, zeta_below=_LIGHT)
            points = [m.omega_rad_s * (1 + max(abs(m.zeta), 1e-5) * _AROUND) for m in modes]
            omega = np.unique(np.concatenate([np.zeros(0), *points]))
            inside = (omega > 0) & (omega < 0.9999 * np.pi / self.dt_s) & (plant.own_grid is None)
            found.append(omega[inside])
        return found

    def result(self, gamma: float, x: Real) -> MultivariableResult:
        """The controller and what is known of it."""
        stack, K = self.dense, self.form.response(x[None], self.dense.s)[0]
        found = scaled_bound(stack.rows, K, accuracy=1e-6)
        value, joint = found.gamma, largest_channel(stack.rows, K, found.right)
        worst, blocking = {}, []
        for which, name in enumerate(self.names):
            rows = np.flatnonzero(stack.requirement == which)
            if rows.size:
                at = rows[np.argmax(value[rows])]
                worst[name] = float(value[at])
                plant = self.plants[int(stack.plant[at])].name
                omega = float(stack.omega_rad_s[at])
                blocking.append(BlockingPoint(plant, name, omega, float(value[at]), int(joint[at])))
        limits, rates = self.spec.limits(self.form.inputs)
        a, b, c, d = self.form.discrete(x)
        controller = Controller(
            a, b, c, d, self.dt_s,
            computational_delay_samples=self.spec.computational_delay_samples,
            input_limit=None if not any(limits) else limits, rate_limit=None if not any(rates) else rates,
        )  # fmt: skip
        controller = with_safe_limits(
            controller, lambda law: [limited_joints(law, plant) for plant in self.plants]
        )
        outcome = Outcome.NOT_CONVERGED if not np.isfinite(gamma) else Outcome.NOT_MET
        outcome = Outcome.MET_ON_GRID if gamma <= 1.0 else outcome
        blocking.sort(key=lambda point: -point.value)
        return MultivariableResult(outcome, controller, gamma, worst, tuple(blocking), self.steps)
