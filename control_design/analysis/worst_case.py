"""Worst case over the ellipses on a dense grid, refined around its maxima: exact at every grid frequency.

`PlantData` holds one plant and its weights on one grid, and gives the worst case of every requirement for
controller values there (`PlantData.weighted`). `worst_case` evaluates a controller on a grid and adds points
around the largest maxima. `Grids` keeps every plant on two grids for the optimisers: a lean one that grows,
and a dense one for their checks. Assumed: the ellipses hold every plant at each frequency by itself.
Neglected: what lies between grid points (`between_grid_points` bounds that).
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
from control_design.plants.plant_set import Mode, UncertainPlant
from control_design.specification import Specification
from control_design.specification.requirement import LoopFunction, WeightedRequirement

# Local maxima of each requirement that a round refines, the largest ones. Chosen; from 2 to 16 no test of the
# certificate moves.
_PEAKS = 8
# Relative distance in frequency below which a mode of the performance channel is one of the plant's: rounding
# of two state spaces of one machine.
_SAME_MODE = 1e-6
# Frequency around which a controller acts, in bandwidths. Chosen: its roll-off and its notches lie above the
# bandwidth. It scales parameters and starts of the optimisers, and decides nothing.
_BANDWIDTHS = 3.0
# That frequency where neither bandwidth nor mode says it, as a share of Nyquist. Chosen: a period of
# twenty samples, as loops are usually sampled.
_SHARE_OF_NYQUIST = 0.1


@dataclass(frozen=True, eq=False)
class Weighting:
    """A weighted requirement on a grid of F frequencies.

    Attributes
    ----------
    requirement : WeightedRequirement
        Its `function` is one of S, K S, G S, T; its `of_member` that without an independent channel.
    magnitude : (F,) array
        |W|, 0 where nothing is asked.
    channel : (F,) array or None
        Largest |Gp| of an independent channel where asked; None without such a channel.
    """

    requirement: WeightedRequirement
    magnitude: Real
    channel: Real | None

    @cached_property
    def size(self) -> Real:
        """Everything that multiplies the closed-loop function of the member, (F,).

        Inf where a weight is infinite (an integrating one at omega = 0, which grids leave out).
        """
        if self.channel is None:
            return self.magnitude
        return self.magnitude * self.channel

    @property
    def function(self) -> LoopFunction:
        """The closed-loop function of the member: without the factor of an independent channel."""
        return self.requirement.of_member


@dataclass(frozen=True, eq=False)
class PlantData:
    """One plant on one grid of F frequencies, with everything that does not depend on the controller.

    Attributes
    ----------
    plant : UncertainPlant
    ellipses : Ellipses
        Of its response, F of them.
    delay : (F,) complex array
        e^{-j omega dt samples} of the computational delay.
    weightings : tuple of Weighting
        One per weighted requirement.
    """

    plant: UncertainPlant
    ellipses: Ellipses
    delay: Complex
    weightings: tuple[Weighting, ...]

    @classmethod
    def build(cls, plant: UncertainPlant, specification: Specification, omega_rad_s: Real) -> PlantData:
        """Plant and weights of its requirements, evaluated at omega (F,), rad/s.

        Raises
        ------
        ValueError
            The plant is known on its own frequencies only, and omega has another one; or its response is not
            finite at one (`Ellipses`).
        SpecificationError
            A mode's peak is limited and the plant has no mode.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        weightings = []
        for requirement in specification.weighted(plant):
            magnitude = requirement.magnitude(omega, plant.dt_s)
            channel = None
            # Of an independent channel any member may meet any member of the plant: its largest gain counts.
            if requirement.channel is not None:
                channel = np.zeros(omega.size)
                use = magnitude > 0
                if np.any(use):
                    channel[use] = requirement.channel.at(omega[use]).farthest()
            weightings.append(Weighting(requirement, magnitude, channel))
        # The computational delay is kept apart from the controller, so that optimisers see no delay in K.
        delay = np.exp(-1j * omega * plant.dt_s * specification.computational_delay_samples)
        return cls(plant, plant.at(omega), delay, tuple(weightings))

    def _largest_of(self, sizes: Iterable[Real]) -> Real:
        """Largest of several weights (F,) at every frequency, (F,); zeros where there are none.

        sizes: (F,) each, not checked.
        """
        nothing = np.zeros(self.delay.size)
        return np.asarray(np.max([nothing, *sizes], axis=0), dtype=np.float64)

    def largest(self, function: LoopFunction) -> Real:
        """Largest weight (F,) on a closed-loop function of the members; zeros where none is asked.

        Times the largest gain of an independent channel. Inf where a weight is.
        """
        return self._largest_of(each.size for each in self.weightings if each.function is function)

    @property
    def sensitivity(self) -> Real:
        """Largest weight (F,) on S itself: tracking and modulus margin.

        Without independent channels, which S itself has not. Inf where a weight is.
        """
        on_sensitivity = [
            each for each in self.weightings if each.requirement.function is LoopFunction.SENSITIVITY
        ]
        return self._largest_of(each.magnitude for each in on_sensitivity)

    def of(self, kind: type[WeightedRequirement]) -> Real:
        """Weight (F,) of one kind of requirement; zeros where it is not asked.

        Times the largest gain of an independent channel. Nothing is checked.
        """
        return self._largest_of(each.size for each in self.weightings if isinstance(each.requirement, kind))

    @property
    def open_loop_disturbance(self) -> Real:
        """Largest |W Gp| (F,) of the requirements on disturbances without a controller, at the centre.

        No unit: W is 1/(output per input). Zeros where no peak of a mode is limited.
        """
        centre = np.abs(self.ellipses.centre)
        sizes: list[Real] = []
        for each in self.weightings:
            if each.requirement.function is LoopFunction.DISTURBANCE:
                response = centre if each.channel is None else each.channel
                sizes.append(each.magnitude * response)
        return self._largest_of(sizes)

    def row_weights(self) -> tuple[tuple[LoopFunction, Real], ...]:
        """Weights (F,) by function of the members, as rows of the optimisers.

        Those that are asked at every frequency are one row per function, the largest of them; those of a band
        come after, each by itself. Never empty: the modulus margin is always asked.
        """
        rows: list[tuple[LoopFunction, Real]] = []
        everywhere = [each for each in self.weightings if each.requirement.band is None]
        in_a_band = [each for each in self.weightings if each.requirement.band is not None]
        for function in LoopFunction:
            sizes = [each.size for each in everywhere if each.function is function]
            if sizes:
                rows.append((function, np.asarray(np.max(sizes, axis=0), dtype=np.float64)))
        rows += [(each.function, each.size) for each in in_a_band]
        return tuple(rows)

    def weighted(self, k: Complex) -> dict[str, Real]:
        """Worst case over the ellipses of each weighted closed-loop function.

        Parameters
        ----------
        k : (F,) complex array
            Controller values without delay, finite and F of them (not checked: a nan gives inf for S and G S,
            0 for K S and for the distance, nan for T).

        Returns
        -------
        dict of str to (F,) array
            By name of the requirement, and "distance" = dist(-1, K E). Inf where a member of the ellipse puts
            the loop on -1.
        """
        # Without the member as a factor the worst case is that of |S|, 1 over the distance from -1. With it,
        # numerator and denominator move together, and the exact maximum of the quotient is taken.
        loop = k * self.delay
        distance = distance_to_minus_one(loop, self.ellipses)
        largest_sensitivity = quotient(1.0, distance, np.inf)
        values: dict[str, Real] = {}
        for each in self.weightings:
            # An infinite weight (integrator asked of the loop) at an infinite loop gain never occurs: the
            # grid starts above 0.
            weight = each.size
            if each.function.of_controller:
                weight = each.size * np.abs(k)
            use = each.magnitude > 0
            value = np.zeros(loop.size)
            if not each.function.of_plant:
                # 0 * inf, where nothing is asked and the loop may be on -1, is 0.
                with np.errstate(invalid="ignore"):
                    value = np.where(weight > 0, weight * largest_sensitivity, 0.0)
            elif np.any(use):
                largest_gain = largest_disturbance_gain(loop[use], self.ellipses.subset(use))
                value[use] = weight[use] * largest_gain
            values[each.requirement.name] = value
        return values | {"distance": distance}


def worst_of(values: dict[str, Real]) -> Real:
    """Largest weighted value per frequency, (F,), of what `PlantData.weighted` gives.

    No unit. Without a weighted requirement numpy raises ValueError; the modulus margin is always asked.
    """
    weighted = [value for name, value in values.items() if name != "distance"]
    return np.asarray(np.max(weighted, axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class WorstCase:
    """Weighted worst cases of one plant and controller on an adaptively refined grid.

    Attributes
    ----------
    omega_rad_s : (F,) array
        Ascending, rad/s.
    ellipses : Ellipses
        Of the plant there.
    loop_factor : (F,) complex array
        The controller with its delay: what multiplies a member of the ellipse.
    values : dict of str to (F,) array
        As of `PlantData.weighted`.
    """

    omega_rad_s: Real
    ellipses: Ellipses
    loop_factor: Complex
    values: dict[str, Real]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the weighted requirements.

        At least the modulus margin's, in the order of `Specification.weighted`.
        """
        return tuple(name for name in self.values if name != "distance")

    def joined(self, other: WorstCase) -> WorstCase:
        """Both on one ascending grid; `other` has other frequencies and the requirements of this one.

        KeyError where `other` lacks a requirement, ValueError where both have a frequency.
        """
        arrays = [self.loop_factor, *self.values.values()]
        other_arrays = [other.loop_factor, *(other.values[name] for name in self.values)]
        omega, (factor, *values) = joined(self.omega_rad_s, arrays, other.omega_rad_s, other_arrays)
        ellipses = self.ellipses.joined(other.ellipses)
        return WorstCase(omega, ellipses, factor, dict(zip(self.values, values, strict=True)))

    def peak(self, kind: str) -> tuple[float, float]:
        """Largest value of one requirement, and its frequency, rad/s.

        KeyError for a requirement that is not asked; nan where a value is nan.
        """
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
    """Worst cases on a grid that is refined around their largest local maxima.

    Parameters
    ----------
    response : callable
        Controller without delay (N,) at frequencies (N,), rad/s.
    plant : UncertainPlant
        One that is known on its own frequencies only is not refined.
    specification : Specification
    start : (F,) array
        First grid, ascending, rad/s, on the plant's own frequencies where it has such.
    rounds : int
        Three make neighbours of a maximum 125 times nearer to each other; 0 leaves the grid. Each puts nine
        points between the neighbours of the eight largest local maxima of every requirement: two neighbours
        are then a fifth as far apart.

    Returns
    -------
    WorstCase

    Raises
    ------
    ValueError
        What `PlantData.build` refuses.
    """

    def evaluated(omega: Real) -> WorstCase:
        """Worst cases at frequencies (N,), rad/s.

        Raises what `PlantData.build` raises.
        """
        data = PlantData.build(plant, specification, omega)
        k = response(omega)
        return WorstCase(omega, data.ellipses, k * data.delay, data.weighted(k))

    worst = evaluated(np.asarray(start, dtype=np.float64))
    if plant.own_grid is not None:
        return worst
    for _ in range(rounds):
        # Requirements that ask for nothing anywhere have no maximum.
        asked_values = [worst.values[name] for name in worst.names if np.any(worst.values[name] > 0)]
        new = around_maxima(worst.omega_rad_s, asked_values, _PEAKS)
        if not new.size:
            break
        worst = worst.joined(evaluated(new))
    return worst


class Grids:
    """Every plant on its lean grid (F,), which grows by exchange, and on its dense one, which is fixed.

    Parameters
    ----------
    plants : sequence of UncertainPlant
    specification : Specification
    options : GridOptions
        Numbers of points.

    Raises
    ------
    ValueError
        What `programme_grid` and `PlantData.build` refuse, among it a peak of a mode that a plant has not.

    Attributes
    ----------
    grids : list of (F,) arrays
        The lean grids, rad/s; optimisers put others in their place.
    dense : list of PlantData
        The dense grids, with the points of the first lean ones.
    """

    def __init__(
        self, plants: Sequence[UncertainPlant], specification: Specification, options: GridOptions
    ) -> None:
        """Put every plant on its two grids, and its dense data with them.

        Raises the ValueError that the class names.
        """
        self.plants = tuple(plants)
        self.spec = specification
        self.grids: list[Real] = []
        self.dense: list[PlantData] = []
        for plant in plants:
            # The plant's modes, and the performance channel's where damping is asked for.
            modes = list(plant.modes)
            if specification.mode_peak_ratio is not None:
                modes += [mode for mode in plant.damped.modes if not _is_among(mode, plant.modes)]
            edges: list[float] = []
            for asked in specification.weighted(plant):
                edges += asked.band or ()
            # Edges of bands are grid points, because a weight jumps there.
            lean = programme_grid(plant, modes, options, edges)
            self.grids.append(lean)
            dense = programme_grid(plant, modes, options, lean, dense=True)
            self.dense.append(PlantData.build(plant, specification, dense))

    def lean(self, grids: Sequence[Real] | None = None) -> list[PlantData]:
        """Every plant on its lean grid, as it is now or as given, rad/s.

        ValueError for another number of grids than plants, and what `PlantData.build` refuses.
        """
        used = self.grids if grids is None else grids
        pairs = zip(self.plants, used, strict=True)
        return [PlantData.build(plant, self.spec, grid) for plant, grid in pairs]

    @property
    def scale_rad_s(self) -> float:
        """Frequency around which the controller has to act, rad/s.

        Geometric mean of three times the bandwidth (of `bandwidth_rad_s` only, no weight counts) and the
        first and lowest mode of each plant; without any of them a tenth of the first plant's Nyquist
        frequency. IndexError without plants and bandwidth.
        """
        candidates = [mode.omega_rad_s for plant in self.plants for mode in plant.modes[:1]]
        if self.spec.bandwidth_rad_s is not None:
            candidates.append(_BANDWIDTHS * self.spec.bandwidth_rad_s)
        if not candidates:
            return _SHARE_OF_NYQUIST * self.plants[0].nyquist_rad_s
        return float(np.exp(np.mean(np.log(candidates))))


def _is_among(mode: Mode, modes: Sequence[Mode]) -> bool:
    """Whether one of the modes has the mode's frequency, but for `_SAME_MODE`.

    Frequencies in rad/s; damping is not compared. False for no modes.
    """
    for other in modes:
        difference = abs(mode.omega_rad_s - other.omega_rad_s)
        if not difference > _SAME_MODE * other.omega_rad_s:
            return True
    return False
