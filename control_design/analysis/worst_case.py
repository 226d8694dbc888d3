"""Worst case over the ellipses on a dense grid, refined around its maxima. Exact at every grid frequency.

Plants and specification stand on two grids: a lean one for the optimisers, a dense one for their checks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from control_design.plants.ellipses import (
    Complex,
    Ellipses,
    Real,
    distance_to_minus_one,
    largest_disturbance_gain,
    quotient,
)
from control_design.plants.frequency_grid import GridOptions, around_maxima, joined, programme_grid
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.specification.requirement import LoopFunction, WeightedRequirement

_PEAKS = 8  # local maxima that a round refines


@dataclass(frozen=True, eq=False)
class Weighting:
    """A weighted requirement on a grid: own (F,) its |W|, 0 = not asked; channel (F,) the largest |Gp| of an
    independent channel where asked, or None."""

    requirement: WeightedRequirement
    own: Real
    channel: Real | None

    @cached_property
    def size(self) -> Real:
        """Everything that multiplies the closed-loop function of the member, (F,)."""
        return self.own if self.channel is None else self.own * self.channel

    @property
    def function(self) -> LoopFunction:
        """The closed-loop function of the member."""
        return self.requirement.of_member


@dataclass(frozen=True, eq=False)
class PlantData:
    """One plant on one grid with everything that does not depend on the controller; delay (F,) = e^{-j omega
    (dt samples)}."""

    plant: UncertainPlant
    ellipses: Ellipses
    delay: Complex
    weightings: tuple[Weighting, ...]

    @classmethod
    def build(cls, plant: UncertainPlant, specification: Specification, omega_rad_s: Real) -> PlantData:
        """Evaluate plant and weights at omega (F,)."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        weightings = []
        for requirement in specification.weighted(plant):
            own, channel = requirement.magnitude(omega, plant.dt_s), None
            if requirement.channel is not None:
                channel, use = np.zeros(omega.size), own > 0
                if np.any(use):
                    channel[use] = requirement.channel.at(omega[use]).farthest()
            weightings.append(Weighting(requirement, own, channel))
        delay = np.exp(-1j * omega * plant.dt_s * specification.computational_delay_samples)
        return cls(plant, plant.at(omega), delay, tuple(weightings))

    def _most(self, sizes: Iterable[Real]) -> Real:
        return np.asarray(np.max([np.zeros(self.delay.size), *sizes], axis=0), dtype=np.float64)

    def largest(self, function: LoopFunction) -> Real:
        """Largest weight (F,) on a closed-loop function of the members; zeros where none is asked."""
        return self._most(each.size for each in self.weightings if each.function is function)

    @property
    def sensitivity(self) -> Real:
        """Largest weight (F,) on S itself: tracking and modulus margin."""
        itself = LoopFunction.SENSITIVITY
        return self._most(each.own for each in self.weightings if each.requirement.function is itself)

    def of(self, kind: type[WeightedRequirement]) -> Real:
        """Weight (F,) of one kind of requirement; zeros where it is not asked."""
        return self._most(each.size for each in self.weightings if isinstance(each.requirement, kind))

    @property
    def open_loop_disturbance(self) -> Real:
        """Largest |W Gp| (F,) of the requirements on disturbances without a controller, at the centre."""
        asked = [w for w in self.weightings if w.requirement.function is LoopFunction.DISTURBANCE]
        centre = np.abs(self.ellipses.centre)
        return self._most(w.own * (centre if w.channel is None else w.channel) for w in asked)

    def row_weights(self) -> tuple[tuple[LoopFunction, Real], ...]:
        """Weights (F,) by function of the members, as rows of the optimisers: all that are asked at every
        frequency together, those of a band by themselves."""
        rows: list[tuple[LoopFunction, Real]] = []
        whole = [w for w in self.weightings if w.requirement.band is None]
        for function in LoopFunction:
            everywhere = [w.size for w in whole if w.function is function]
            if everywhere:
                rows.append((function, np.asarray(np.max(everywhere, axis=0), dtype=np.float64)))
        return (*rows, *((w.function, w.size) for w in self.weightings if w not in whole))

    def weighted(self, k: Complex) -> dict[str, Real]:
        """Worst case over the ellipses of each weighted closed-loop function for controller values k (F,)
        without delay.

        By name of the requirement, and "distance" = dist(-1, K E); inf where a member of the ellipse puts the
        loop on -1.
        """
        loop = k * self.delay
        distance = distance_to_minus_one(loop, self.ellipses)
        inverse = quotient(1.0, distance, np.inf)
        values: dict[str, Real] = {}
        for each in self.weightings:
            # An infinite weight (integrator asked of the loop) at an infinite loop gain never occurs: the
            # grid starts above 0.
            weight = each.size * np.abs(k) if each.function.of_controller else each.size
            value, use = np.zeros(loop.size), each.own > 0
            if each.function.of_plant and np.any(use):
                value[use] = weight[use] * largest_disturbance_gain(loop[use], self.ellipses.subset(use))
            elif not each.function.of_plant:
                with np.errstate(invalid="ignore"):  # 0 * inf: no requirement there
                    value = np.where(weight > 0, weight * inverse, 0.0)
            values[each.requirement.name] = value
        return values | {"distance": distance}


def worst_of(values: dict[str, Real]) -> Real:
    """Largest weighted value per frequency, (F,)."""
    weighted = [value for name, value in values.items() if name != "distance"]
    return np.asarray(np.max(weighted, axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class WorstCase:
    """Weighted worst cases on an adaptively refined grid: omega (F,), values as `PlantData.weighted`, k
    (F,)."""

    omega_rad_s: Real
    ellipses: Ellipses
    loop_factor: Complex
    values: dict[str, Real]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weighted requirements."""
        return tuple(name for name in self.values if name != "distance")

    def joined(self, other: WorstCase) -> WorstCase:
        """This and another, at other frequencies."""
        own, new = ([one.loop_factor, *(one.values[name] for name in self.values)] for one in (self, other))
        omega, (factor, *values) = joined(self.omega_rad_s, own, other.omega_rad_s, new)
        ellipses = self.ellipses.joined(other.ellipses)
        return WorstCase(omega, ellipses, factor, dict(zip(self.values, values, strict=True)))

    def peak(self, kind: str) -> tuple[float, float]:
        """(largest value, its frequency) of one kind."""
        index = int(np.argmax(self.values[kind]))
        return float(self.values[kind][index]), float(self.omega_rad_s[index])


def worst_case(
    response: Callable[[Real], Complex],
    plant: UncertainPlant,
    specification: Specification,
    start: Real,
    *,
    rounds: int = 3,
) -> WorstCase:
    """Evaluate on `start` (F,) and refine around the largest local maxima of every kind.

    response: controller without delay. Each round makes the grid ten times finer between the neighbours of
    the eight largest local maxima; plants known on their own grid only are not refined.
    """

    def found_at(omega: Real) -> WorstCase:
        data, k = PlantData.build(plant, specification, omega), response(omega)
        return WorstCase(omega, data.ellipses, k * data.delay, data.weighted(k))

    found = found_at(np.asarray(start, dtype=np.float64))
    for _ in range(rounds if plant.own_grid is None else 0):
        sizes = [value for name, value in found.values.items() if name != "distance" and np.any(value > 0)]
        new = around_maxima(found.omega_rad_s, sizes, _PEAKS)
        if not new.size:
            break
        found = found.joined(found_at(new))
    return found


class Grids:
    """Every plant on its lean grid (F,), which grows by exchange, and on its dense one, which is fixed."""

    def __init__(
        self, plants: Sequence[UncertainPlant], specification: Specification, options: GridOptions
    ) -> None:
        self.plants, self.spec = tuple(plants), specification
        self.grids: list[Real] = []
        self.dense: list[PlantData] = []
        for plant in plants:
            # The plant's, and the performance channel's where damping is asked for.
            modes = list(plant.modes)
            if specification.mode_peak_ratio is not None:
                modes += [
                    mode
                    for mode in plant.damped.modes
                    if all(abs(mode.omega_rad_s - o.omega_rad_s) > 1e-6 * o.omega_rad_s for o in modes)
                ]
            edges = [edge for asked in specification.weighted(plant) for edge in asked.band or ()]
            lean = programme_grid(plant, modes, options, edges)
            self.grids.append(lean)
            dense = programme_grid(plant, modes, options, lean, dense=True)
            self.dense.append(PlantData.build(plant, specification, dense))

    def lean(self, grids: Sequence[Real] | None = None) -> list[PlantData]:
        """Every plant on its lean grid, as it is now or as given."""
        return [
            PlantData.build(plant, self.spec, grid)
            for plant, grid in zip(self.plants, self.grids if grids is None else grids, strict=True)
        ]

    @property
    def scale_rad_s(self) -> float:
        """Frequency around which the controller has to act: bandwidth and lowest mode, or a tenth of
        Nyquist."""
        candidates = [mode.omega_rad_s for plant in self.plants for mode in plant.modes[:1]]
        if self.spec.bandwidth_rad_s is not None:
            candidates.append(3.0 * self.spec.bandwidth_rad_s)
        if not candidates:
            return 0.1 * self.plants[0].nyquist_rad_s
        return float(np.exp(np.mean(np.log(candidates))))
