"""Joint coverage: the ellipse level at which the certified worst case holds for posterior samples.

Ellipses at 95 % per frequency do not hold a whole response with 95 %, and a band that does (simultaneous
coverage) is wider than the worst case needs: a response may leave its ellipses where nothing is at stake.
What is calibrated here is the statement that counts: P(gamma(G) <= gamma of the ellipses) = coverage,
gamma(G) the largest weighted value of one sampled response G. The quantile of gamma(G) over draws is met by
the worst case of ellipses at one level, found by bisection: the worst case grows with the level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np

from control_design.analysis.stability import closed_loop_poles, loop_integrators, winds
from control_design.analysis.worst_case import PlantData, worst_of
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Boolean, Complex, Real, radius_of
from control_design.plants.first_order import FrequencyIntervals
from control_design.plants.frequency_grid import checked_grid
from control_design.plants.guards import Guard, different_responses
from control_design.plants.plant_set import Mode, PlantChannel, UncertainPlant, modes_of
from control_design.plants.set_expansion import FirstOrderUncertainty
from control_design.specification import Specification
from ident.uncertainty import ResponsePosterior

_CHUNK = 250  # draws at a time: bounds the memory
_LARGEST_RADIUS = 8.0  # standard deviations: level 1 - 1e-14

Responses = Callable[[Real], Complex]
Draw = Callable[[np.random.Generator, int], Responses]


@runtime_checkable
class ResponseDraws(Protocol):
    """What an uncertainty of one's own offers to have its joint coverage calibrated."""

    def draw(self, rng: np.random.Generator, draws: int) -> Responses:
        """Function of omega (F,) that gives the same `draws` posterior samples (draws, F) at every call."""


@dataclass(frozen=True)
class JointCoverage:
    """Calibrated level of the ellipses.

    coverage: probability asked for. gamma: its quantile of gamma(G) over the draws, which is the worst case
    of ellipses at `level` (per frequency; near 0 where gamma hardly depends on the plant). given_level,
    gamma_given, coverage_given: the level the plants came with, its worst case and the share of draws within
    that. simultaneous_given: share of draws that stay inside the ellipses of the given level at all grid
    frequencies; simultaneous_level: level at which that share is `coverage`. stable_share: draws whose 1 + K
    G winds as a stable loop's. Sampling error of the coverage: sqrt(coverage (1 - coverage)/draws).
    """

    coverage: float
    draws: int
    gamma: float
    level: float
    given_level: float
    gamma_given: float
    coverage_given: float
    simultaneous_given: float
    simultaneous_level: float
    stable_share: float


def joint_coverage(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    *,
    rng: np.random.Generator,
    coverage: float = 0.95,
    draws: int = 4000,
) -> JointCoverage:
    """Calibrate the per-frequency level so that the worst case holds with probability `coverage`.

    Several plants are drawn independently of one another, and so are the measured and the performance channel
    of one plant; gamma(G) is then the largest over all of them. gamma(G) is taken on a grid of about a
    thousand frequencies, as is the worst case it is compared with.

    Raises ValueError if coverage is outside (0, 1), draws is below 100 or an uncertainty cannot be drawn from
    (a response known on its own frequencies only says nothing about their correlation).
    """
    if not 0 < coverage < 1:
        raise ValueError(f"joint coverage must lie in (0, 1); got {coverage}")
    if draws < 100:
        raise ValueError(f"joint coverage needs at least 100 draws; got {draws}")
    if not plants:
        raise ValueError("joint coverage needs at least one plant")
    loops = [SampledLoop(controller, plant, specification) for plant in plants]
    gammas, stable, distances = zip(*(loop.gamma(rng, draws) for loop in loops), strict=True)
    gamma, outside = np.max(gammas, axis=0), np.max(distances, axis=0)
    # The worst case at a radius is compared in standard deviations, common to all plants.
    wanted = float(np.quantile(gamma, coverage, method="higher"))
    given = [radius_of(loop.plant.level) for loop in loops]
    at_given = max(loop.worst(radius) for loop, radius in zip(loops, given, strict=True))
    low, high = 1e-3, _LARGEST_RADIUS
    for _ in range(60):
        middle = 0.5 * (low + high)
        if max(loop.worst(middle) for loop in loops) < wanted:
            low = middle
        else:
            high = middle
        if high - low < 1e-6 * high:
            break
    return JointCoverage(
        coverage=coverage,
        draws=draws,
        gamma=wanted,
        level=_level(high),
        given_level=max(loop.plant.level for loop in loops),
        gamma_given=at_given,
        coverage_given=float(np.mean(gamma <= at_given)),
        simultaneous_given=float(
            np.mean(np.all([one <= r for one, r in zip(distances, given, strict=True)], axis=0))
        ),
        simultaneous_level=_level(float(np.quantile(outside, coverage))),
        stable_share=float(np.mean(np.all(stable, axis=0))),
    )


def at_level(plant: UncertainPlant, level: float) -> UncertainPlant:
    """The plant with ellipses of another level, its performance channel with it."""
    performance = plant.performance and replace(plant.performance, level=level)
    return replace(plant, level=level, performance=performance)


class SampledLoop:
    """One plant and controller on one grid, to draw posterior samples for.

    Raises ValueError if an uncertainty cannot be drawn from.
    """

    def __init__(self, controller: Controller, plant: UncertainPlant, specification: Specification) -> None:
        self.plant, self.controller, self.specification = plant, controller, specification
        self.draw = drawn(plant.channel)
        poles = closed_loop_poles(controller, plant)
        modes = (*plant.modes, *modes_of(poles, plant.dt_s), *modes_of(controller.poles, plant.dt_s))
        light = [
            Mode(m.omega_rad_s, max(abs(m.zeta), 1e-3)) for m in modes if m.omega_rad_s < plant.nyquist_rad_s
        ]
        grid = checked_grid(plant, light, 500, 80)
        self.omega_rad_s, self.data = grid, PlantData.build(plant, specification, grid)
        self.unit = self.data.ellipses.scaled(1 / radius_of(plant.level))
        self.loop = controller.response(grid, with_delay=False)
        integrators, unstable = loop_integrators(controller, plant)
        self._required = {"integrators": integrators, "unstable_poles": unstable}

    def worst(self, radius: float) -> float:
        """Largest weighted worst case over ellipses of a radius in standard deviations."""
        data = PlantData.build(at_level(self.plant, _level(radius)), self.specification, self.omega_rad_s)
        return float(np.max(worst_of(data.weighted(self.loop))))

    def gamma_of(self, members: Complex, performance: Responses | None) -> Real:
        """Largest weighted value (D,) of responses (D, F) of the measured channel, and of the performance
        channel's draws."""
        data, size = self.data, np.abs(self.loop)
        inverse = 1.0 / np.maximum(np.abs(1.0 + members * (self.loop * data.delay)), 1e-300)
        largest = np.zeros(members.shape[0])
        for each in data.weightings:
            use = each.own > 0
            if not np.any(use):
                continue
            weight = (each.own * size if each.requirement.function.of_controller else each.own)[use]
            if each.channel is not None and performance is not None:
                weight = weight * np.abs(performance(self.omega_rad_s[use]))
            elif each.function.of_plant:
                weight = weight * np.abs(members[:, use])
            largest = np.maximum(largest, np.max(weight * inverse[:, use], axis=1))
        return np.asarray(largest, dtype=np.float64)

    def distance_of(self, members: Complex) -> Real:
        """Largest normalised distance (D,) from the centre."""
        turned = (members - self.unit.centre) * np.conj(self.unit.direction)
        major, minor = np.maximum(self.unit.semi_major, 1e-300), np.maximum(self.unit.semi_minor, 1e-300)
        # An axis of zero length (a frequency where the response is real) says nothing by itself.
        thin = self.unit.semi_minor <= 1e-6 * self.unit.semi_major
        second = np.where(thin, 0.0, turned.imag / minor)
        return np.asarray(np.max(np.hypot(turned.real / major, second), axis=1), dtype=np.float64)

    def stable_of(self, responses: Responses, members: Complex) -> Boolean:
        """Whether 1 + K G winds as it must, (D,); on a ten times finer grid where a step is wide."""
        omega = self.omega_rad_s
        stable, wide = winds(members * (self.loop * self.data.delay), **self._required)
        if np.any(wide):
            share = np.linspace(0, 1, 11)[:-1]
            fine = np.append((omega[:-1, None] + np.diff(omega)[:, None] * share).ravel(), omega[-1])
            loop = self.controller.response(fine)
            stable[wide], _ = winds(responses(fine)[wide] * loop, **self._required)
        return stable

    def gamma(self, rng: np.random.Generator, draws: int) -> tuple[Real, Boolean, Real]:
        """Of posterior samples (a Monte Carlo check), (D,) each: gamma(G) (inf where 1 + K G does not wind as
        a stable loop's), stable, and the largest normalised distance of the measured response from the
        centre, in standard deviations."""
        other = None if self.plant.performance is None else drawn(self.plant.performance)
        asked = any(each.channel is not None and np.any(each.own > 0) for each in self.data.weightings)
        gamma, stable, distance = np.zeros(draws), np.zeros(draws, dtype=bool), np.zeros(draws)
        for here, count in _chunks(draws):
            responses = self.draw(rng, count)
            members = responses(self.omega_rad_s)
            performance = other(rng, count) if other is not None and asked else None
            stable[here] = self.stable_of(responses, members)
            gamma[here] = np.where(stable[here], self.gamma_of(members, performance), np.inf)
            distance[here] = self.distance_of(members)
        return gamma, stable, distance


def unstable_draws(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    *,
    rng: np.random.Generator,
    draws: int,
    most: int,
) -> tuple[int, list[Guard]]:
    """How many of `draws` sampled responses (of every plant) are unstable, and up to `most` different ones
    of each plant, as guards for another synthesis.

    Raises ValueError if an uncertainty cannot be drawn from.
    """
    unstable = np.zeros(draws, dtype=bool)
    guards: list[Guard] = []
    for number, plant in enumerate(plants):
        loop = SampledLoop(controller, plant, specification)
        # Fine enough to count the winding of a response whose modes have moved.
        grid, found = checked_grid(plant, plant.modes, 1200, 400), list[Complex]()
        for here, count in _chunks(draws):
            responses = loop.draw(rng, count)
            bad = ~loop.stable_of(responses, responses(loop.omega_rad_s))
            unstable[here] |= bad
            if np.any(bad):
                found.append(responses(grid)[bad])
        if found:
            together = np.concatenate(found)
            guards += [Guard(number, grid, together[at]) for at in different_responses(together, most)]
    return int(np.count_nonzero(unstable)), guards


def _chunks(draws: int) -> Iterator[tuple[slice, int]]:
    """Positions and number of the draws made together."""
    for start in range(0, draws, _CHUNK):
        count = min(_CHUNK, draws - start)
        yield slice(start, start + count), count


def drawn(channel: PlantChannel) -> Draw:
    """How posterior samples of a channel are drawn; ValueError where they cannot be."""
    uncertainty: Any = channel.uncertainty
    if uncertainty is None:
        return lambda rng, draws: (
            lambda omega: np.broadcast_to(channel.nominal_response(omega), (draws, omega.size))
        )
    if isinstance(uncertainty, ResponsePosterior):
        return lambda rng, draws: partial(uncertainty.response_of, uncertainty.sample(rng, draws))
    if isinstance(uncertainty, ResponseDraws):
        return uncertainty.draw
    if isinstance(uncertainty, FirstOrderUncertainty):
        return partial(_linear_responses, uncertainty, channel.dt_s)
    raise ValueError(
        "joint coverage needs posterior samples: the uncertainty must be a ResponsePosterior or "
        f"have a method draw(rng, draws); got {type(uncertainty).__name__}"
    )


def _linear_responses(
    uncertainty: FirstOrderUncertainty, dt_s: float, rng: np.random.Generator, draws: int
) -> Responses:
    """Gaussian draws on the generators of an uncertainty: the linear model whose ellipses they are."""
    kept: list[Real] = []

    def at(omega: Real) -> Complex:
        centre, generators = uncertainty.first_order(FrequencyIntervals(omega, np.zeros(omega.size), dt_s), 0)
        if not kept:
            kept.append(rng.standard_normal((draws, generators.value.shape[1])))
        return np.asarray(centre.value + kept[0] @ generators.value.T, dtype=np.complex128)

    return at


def _level(radius: float) -> float:
    return float(min(-np.expm1(-0.5 * radius**2), 1 - 1e-15))
