"""Joint coverage: the ellipse level at which the certified worst case holds for posterior samples.

Ellipses at 95 % per frequency do not hold a whole response with 95 %, and a band that does (simultaneous
coverage) is wider than the worst case needs: a response may leave its ellipses where nothing is at stake.
What is calibrated here is the statement that counts: P(gamma(G) <= gamma of the ellipses) = coverage,
gamma(G) the largest weighted value of one sampled response G. `SampledLoop` draws responses of one plant and
gives gamma(G); `joint_coverage` takes the quantile over draws and finds by bisection the level of the
ellipses whose worst case meets it, which works as the worst case grows with the level. `unstable_draws`
collects sampled responses that a controller does not stabilise. Assumed: the posterior is right, and its
draws are independent between plants and channels.
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

# Draws that are made together: they bound the memory, 4 MB at a thousand frequencies. Chosen; another number
# draws other responses from one seed.
_CHUNK = 250
# Fewest draws: of a hundred the share that counts at 95 % is known to 2 %.
_FEWEST_DRAWS = 100

# Radius of the ellipses, in standard deviations, between which the calibrated one is sought: from a point to
# a level of 1 - 1e-14, where the levels of doubles end. With a largest one of 4 or 16 no test moves.
_SMALLEST_RADIUS = 1e-3

# The largest of them: 8 standard deviations are a level of 1 - 1e-14.
_LARGEST_RADIUS = 8.0
# Relative accuracy of that radius: far below the sampling error of any number of draws.
_RADIUS_ACCURACY = 1e-6

# Most halvings of the way between: more than a double has digits.
_MOST_HALVINGS = 60
# Largest level: a double below 1 with which the radius is still finite.
_LARGEST_LEVEL = 1 - 1e-15

# Grid of a sampled loop: logarithmic points, and points per mode. A thousand frequencies in all, since every
# draw has them. The worst case that the draws are compared with is taken on the same grid.
_LOG_POINTS = 500

# Points per mode of that grid, some twenty of them within its bandwidth.
_POINTS_PER_MODE = 80
# Damping ratio that the grid takes at least for a mode. Chosen: draws move lighter modes by more than their
# width, so that points as near as that would find none of them.
_LEAST_DAMPING = 1e-3
# Parts into which each step of that grid is cut where the winding of a draw is doubtful. Chosen: a step as
# wide as a turn is then one of a tenth of it.
_PARTS_OF_A_STEP = 10
# Logarithmic points of a guard's grid: fine enough to count the winding of a response whose modes have moved.
# Chosen, twice as many as those of a sampled loop; the grid is stored with each guard.
_GUARD_LOG_POINTS = 1200

# Points per mode of a guard's grid: five times as many, since its modes are not where the grid expects them.
_GUARD_POINTS_PER_MODE = 400

# Ratio of axes below which an ellipse counts as a line, whose short axis says nothing about a distance: the
# response is real there. Chosen: far above rounding (1e-8 of an axis, the root of that of a variance), and
# far below the ratio of axes of a complex response.
_THIN = 1e-6
# Least divisor: keeps quotients finite.
_TINY = 1e-300

Responses = Callable[[Real], Complex]
"""Function of omega (F,), rad/s, that gives the same posterior samples (D, F) at every call."""
Draw = Callable[[np.random.Generator, int], Responses]
"""Function of a generator and a number of draws D that draws such samples."""


@runtime_checkable
class ResponseDraws(Protocol):
    """What an uncertainty of one's own offers to have its joint coverage calibrated."""

    def draw(self, rng: np.random.Generator, draws: int) -> Responses:
        """Function of omega (F,) that gives the same `draws` posterior samples (draws, F) at every call.

        F any number, ascending rad/s. What it raises goes up to who asked for the coverage.
        """


@dataclass(frozen=True)
class JointCoverage:
    """Calibrated level of the ellipses.

    Attributes
    ----------
    coverage : float
        Probability asked for.
    draws : int
        Number of sampled responses. Sampling error of the coverage: sqrt(coverage (1 - coverage) / draws).
    gamma : float
        Quantile of gamma(G) over the draws at `coverage`.
    level : float
        Level (per frequency) of the ellipses whose worst case is `gamma`; near 0 where gamma hardly depends
        on the plant.
    given_level, gamma_given, coverage_given : float
        The level the plants came with, its worst case, and the share of draws within that.
    simultaneous_given : float
        Share of draws that stay inside the ellipses of the given level at all grid frequencies.
    simultaneous_level : float
        Level at which that share is `coverage`.
    stable_share : float
        Share of draws whose 1 + K G winds as a stable loop's.
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
    """Per-frequency level of the ellipses with which the worst case holds with probability `coverage`.

    Parameters
    ----------
    controller : Controller
    plants : sequence of UncertainPlant
        They are drawn independently of one another, and so are the measured and the performance channel of
        one plant; gamma(G) is the largest over all of them.
    specification : Specification
        Its weighted requirements make gamma.
    rng : numpy.random.Generator
    coverage : float
        In (0, 1); the usual 0.95.
    draws : int
        Number of sampled responses, at least 100. 4000 know a coverage of 0.95 to 0.003.

    Returns
    -------
    JointCoverage

    Raises
    ------
    ValueError
        Coverage is outside (0, 1), there are too few draws or no plants, sampling times differ or a loop is
        algebraic (`closed_loop_poles`), or an uncertainty cannot be drawn
        from (a response known on its own frequencies only says nothing about their correlation).

    Notes
    -----
    gamma(G) is taken on a grid of about a thousand frequencies, as is the worst case it is compared with.
    Where more draws are unstable than 1 - coverage allows, gamma is inf and the level that at which an
    ellipse reaches -1, at most 1 - 1e-14.
    """
    if not 0 < coverage < 1:
        raise ValueError(f"joint coverage must lie in (0, 1); got {coverage}")
    if draws < _FEWEST_DRAWS:
        raise ValueError(f"joint coverage needs at least {_FEWEST_DRAWS} draws; got {draws}")
    if not plants:
        raise ValueError("joint coverage needs at least one plant")
    loops = [SampledLoop(controller, plant, specification) for plant in plants]
    samples = [loop.gamma(rng, draws) for loop in loops]
    gammas, stables, distances = zip(*samples, strict=True)
    gamma = np.max(gammas, axis=0)
    # A value that was drawn, at or above the quantile, so that the share within it is at least `coverage`.
    wanted = float(np.quantile(gamma, coverage, method="higher"))

    # Radius of the ellipses, in standard deviations and common to all plants, whose worst case is the
    # quantile.
    low = _SMALLEST_RADIUS
    high = _LARGEST_RADIUS
    for _ in range(_MOST_HALVINGS):
        middle = 0.5 * (low + high)
        if max(loop.worst(middle) for loop in loops) < wanted:
            low = middle
        else:
            high = middle
        if high - low < _RADIUS_ACCURACY * high:
            break

    # What the given level is worth.
    given_radii = [radius_of(loop.plant.level) for loop in loops]
    gamma_given = max(loop.worst(radius) for loop, radius in zip(loops, given_radii, strict=True))
    stays_inside = [distance <= radius for distance, radius in zip(distances, given_radii, strict=True)]
    all_stay_inside = np.all(stays_inside, axis=0)
    largest_distance = np.max(distances, axis=0)
    simultaneous_radius = float(np.quantile(largest_distance, coverage))
    return JointCoverage(
        coverage=coverage,
        draws=draws,
        gamma=wanted,
        level=_level(high),
        given_level=max(loop.plant.level for loop in loops),
        gamma_given=gamma_given,
        coverage_given=float(np.mean(gamma <= gamma_given)),
        simultaneous_given=float(np.mean(all_stay_inside)),
        simultaneous_level=_level(simultaneous_radius),
        stable_share=float(np.mean(np.all(stables, axis=0))),
    )


def at_level(plant: UncertainPlant, level: float) -> UncertainPlant:
    """The plant with ellipses of another level, in (0, 1), its performance channel with it.

    ValueError for another level, of `PlantChannel` when the plant's channel is first asked for.
    """
    performance = plant.performance
    if performance is not None:
        performance = replace(performance, level=level)
    return replace(plant, level=level, performance=performance)


class SampledLoop:
    """One plant and controller on one grid of F frequencies, to draw posterior samples for.

    Attributes
    ----------
    plant, controller, specification
        As given.
    draw : Draw
        Draws responses of the measured channel.
    omega_rad_s : (F,) array
        The grid, rad/s.
    data : PlantData
        Plant and weights there.
    unit : Ellipses
        With a radius of one standard deviation.
    loop : (F,) complex array
        The controller without delay.

    Raises
    ------
    ValueError
        The uncertainty cannot be drawn from; sampling times differ or the loop is algebraic
        (`closed_loop_poles`); or the plant is known on its own frequencies only (`PlantChannel.at`).
    """

    def __init__(self, controller: Controller, plant: UncertainPlant, specification: Specification) -> None:
        """Build the grid from the modes of plant, loop and controller, and evaluate everything on it.

        Raises the ValueError that the class names.
        """
        self.plant = plant
        self.controller = controller
        self.specification = specification
        self.draw = drawn(plant.channel)
        poles = closed_loop_poles(controller, plant)
        loop_modes = modes_of(poles, plant.dt_s)
        controller_modes = modes_of(controller.poles, plant.dt_s)
        light: list[Mode] = []
        for mode in (*plant.modes, *loop_modes, *controller_modes):
            if mode.omega_rad_s < plant.nyquist_rad_s:
                light.append(Mode(mode.omega_rad_s, max(abs(mode.zeta), _LEAST_DAMPING)))
        grid = checked_grid(plant, light, _LOG_POINTS, _POINTS_PER_MODE)
        self.omega_rad_s = grid
        self.data = PlantData.build(plant, specification, grid)
        self.unit = self.data.ellipses.scaled(1 / radius_of(plant.level))
        self.loop = controller.response(grid, with_delay=False)
        integrators, unstable = loop_integrators(controller, plant)
        self._winding_of_stable = {"integrators": integrators, "unstable_poles": unstable}

    def worst(self, radius: float) -> float:
        """Largest weighted worst case over ellipses of a radius in standard deviations.

        No unit; inf where an ellipse reaches -1. A radius of zero is refused by `PlantChannel` (level 0:
        ValueError).
        """
        plant = at_level(self.plant, _level(radius))
        data = PlantData.build(plant, self.specification, self.omega_rad_s)
        return float(np.max(worst_of(data.weighted(self.loop))))

    def gamma_of(self, members: Complex, performance: Responses | None) -> Real:
        """Largest weighted value gamma(G) (D,) of responses (D, F) of the measured channel.

        performance: draws of an independent performance channel, which its requirement is about; None: there
        is none, or nothing is asked of it.

        No unit; it is taken on the grid, whether the loop is stable or not. A response with nan gives nan.
        Shapes are not checked: numpy raises where they do not fit.
        """
        data = self.data
        size = np.abs(self.loop)
        # |S| of every draw; a draw on -1 gets a huge finite value.
        return_difference = np.abs(1.0 + members * (self.loop * data.delay))
        sensitivity = 1.0 / np.maximum(return_difference, _TINY)
        largest = np.zeros(members.shape[0])
        for each in data.weightings:
            use = each.magnitude > 0
            if not np.any(use):
                continue
            # Weight times K, and times the independent channel or the member itself, where f has them.
            weight = each.magnitude[use]
            if each.requirement.function.of_controller:
                weight = (each.magnitude * size)[use]
            if each.channel is not None and performance is not None:
                weight = weight * np.abs(performance(self.omega_rad_s[use]))
            elif each.function.of_plant:
                weight = weight * np.abs(members[:, use])
            largest = np.maximum(largest, np.max(weight * sensitivity[:, use], axis=1))
        return np.asarray(largest, dtype=np.float64)

    def distance_of(self, members: Complex) -> Real:
        """Largest distance (D,) of responses (D, F) from the centre, in standard deviations.

        A nan gives nan; from an ellipse of no size it is zero, or
        huge.
        """
        turned = (members - self.unit.centre) * np.conj(self.unit.direction)
        major = np.maximum(self.unit.semi_major, _TINY)
        minor = np.maximum(self.unit.semi_minor, _TINY)
        along_major = turned.real / major
        # An axis of zero length (a frequency where the response is real) says nothing by itself.
        thin = self.unit.semi_minor <= _THIN * self.unit.semi_major
        along_minor = np.where(thin, 0.0, turned.imag / minor)
        return np.asarray(np.max(np.hypot(along_major, along_minor), axis=1), dtype=np.float64)

    def stable_of(self, responses: Responses, members: Complex) -> Boolean:
        """Whether 1 + K G winds as a stable loop's, (D,); members (D, F): the responses on the grid.

        responses gives them at other frequencies. Draws with a wide step are counted again on a ten times
        finer grid. A draw with nan counts as unstable.
        """
        omega = self.omega_rad_s
        stable, has_wide_step = winds(members * (self.loop * self.data.delay), **self._winding_of_stable)
        if np.any(has_wide_step):
            share = np.linspace(0, 1, _PARTS_OF_A_STEP + 1)[:-1]
            fine = (omega[:-1, None] + np.diff(omega)[:, None] * share).ravel()
            fine = np.append(fine, omega[-1])
            loop = self.controller.response(fine)
            wide_members = responses(fine)[has_wide_step]
            stable[has_wide_step], _ = winds(wide_members * loop, **self._winding_of_stable)
        return stable

    def gamma(self, rng: np.random.Generator, draws: int) -> tuple[Real, Boolean, Real]:
        """Values of D posterior samples (a Monte Carlo check), (D,) each.

        Returns
        -------
        gamma : (D,) array
            gamma(G); inf where 1 + K G does not wind as a stable loop's.
        stable : (D,) array of bool
            Whether it does.
        distance : (D,) array
            Largest distance of the measured response from the centre, in standard deviations.

        Notes
        -----
        draws is D; 0 gives empty arrays. The performance channel's draws are used only where a requirement is
        about it, but one that no samples can be drawn from is refused in any case (ValueError of `drawn`).
        """
        has_asked_channel = False
        for each in self.data.weightings:
            if each.channel is not None and np.any(each.magnitude > 0):
                has_asked_channel = True
        draw_performance = None
        if self.plant.performance is not None:
            draw_performance = drawn(self.plant.performance)

        gamma = np.zeros(draws)
        stable = np.zeros(draws, dtype=bool)
        distance = np.zeros(draws)
        for here, count in _chunks(draws):
            responses = self.draw(rng, count)
            members = responses(self.omega_rad_s)
            performance = None
            if draw_performance is not None and has_asked_channel:
                performance = draw_performance(rng, count)
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
    """How many sampled responses are unstable, and some of them as guards for another synthesis.

    Parameters
    ----------
    controller : Controller
    plants : sequence of UncertainPlant
        A draw counts as unstable where the response of any of them is.
    specification : Specification
        For the computational delay and the grid.
    rng : numpy.random.Generator
    draws : int
        Number of samples of every plant.
    most : int
        Guards of each plant at most, different from one another; at least one is given where a draw is
        unstable.

    Returns
    -------
    number : int
        Of unstable draws.
    guards : list of Guard

    Raises
    ------
    ValueError
        An uncertainty cannot be drawn from, or `SampledLoop` refuses the plant. No plants and no draws are no
        error: nothing is unstable then.
    """
    unstable = np.zeros(draws, dtype=bool)
    guards: list[Guard] = []
    for number, plant in enumerate(plants):
        loop = SampledLoop(controller, plant, specification)
        grid = checked_grid(plant, plant.modes, _GUARD_LOG_POINTS, _GUARD_POINTS_PER_MODE)
        unstable_responses: list[Complex] = []
        for here, count in _chunks(draws):
            responses = loop.draw(rng, count)
            stable = loop.stable_of(responses, responses(loop.omega_rad_s))
            unstable[here] |= ~stable
            if not np.all(stable):
                unstable_responses.append(responses(grid)[~stable])
        if unstable_responses:
            together = np.concatenate(unstable_responses)
            for at in different_responses(together, most):
                guards.append(Guard(number, grid, together[at]))
    return int(np.count_nonzero(unstable)), guards


def _chunks(draws: int) -> Iterator[tuple[slice, int]]:
    """Positions, and number, of the draws that are made together, until there are `draws`.

    None for draws of zero or less.
    """
    for start in range(0, draws, _CHUNK):
        count = min(_CHUNK, draws - start)
        yield slice(start, start + count), count


def drawn(channel: PlantChannel) -> Draw:
    """Function that draws posterior samples of a channel; without uncertainty all are the nominal response.

    Raises
    ------
    ValueError
        The uncertainty is neither a posterior nor offers `draw` or `first_order`.
    """
    uncertainty: Any = channel.uncertainty
    if uncertainty is None:
        return partial(_nominal_responses, channel)
    if isinstance(uncertainty, ResponsePosterior):
        return partial(_posterior_responses, uncertainty)
    if isinstance(uncertainty, ResponseDraws):
        return uncertainty.draw
    if isinstance(uncertainty, FirstOrderUncertainty):
        return partial(_linear_responses, uncertainty, channel.dt_s)
    raise ValueError(
        "joint coverage needs posterior samples: the uncertainty must be a ResponsePosterior or "
        f"have a method draw(rng, draws); got {type(uncertainty).__name__}"
    )


def _nominal_responses(channel: PlantChannel, rng: np.random.Generator, draws: int) -> Responses:
    """Function of omega (F,) that gives the nominal response `draws` times, (draws, F); draws no number.

    rng is not used. Nothing is checked.
    """
    return lambda omega: np.broadcast_to(channel.nominal_response(omega), (draws, omega.size))


def _posterior_responses(posterior: ResponsePosterior, rng: np.random.Generator, draws: int) -> Responses:
    """Function of omega (F,) that gives responses (draws, F) of coefficients drawn from the posterior.

    posterior: `sample` gives coefficients (draws, P), `response_of` their responses. Nothing is checked.
    """
    return partial(posterior.response_of, posterior.sample(rng, draws))


def _linear_responses(
    uncertainty: FirstOrderUncertainty, dt_s: float, rng: np.random.Generator, draws: int
) -> Responses:
    """Function of omega (F,) that gives responses (draws, F): Gaussian draws on the uncertainty's generators.

    They are those of the linear model whose ellipses the uncertainty has. The weights (draws, Q) of the Q
    generators are drawn at the first call, which shows Q, and serve all later ones.

    dt_s in seconds. Nothing is checked.
    """
    weights: list[Real] = []

    def at(omega: Real) -> Complex:
        """Responses (draws, F) at omega (F,), rad/s.

        Raises what `first_order` raises.
        """
        points = FrequencyIntervals(omega, np.zeros(omega.size), dt_s)
        centre, generators = uncertainty.first_order(points, 0)
        if not weights:
            weights.append(rng.standard_normal((draws, generators.value.shape[1])))
        return np.asarray(centre.value + weights[0] @ generators.value.T, dtype=np.complex128)

    return at


def _level(radius: float) -> float:
    """Level, the probability of a plane Gaussian inside an ellipse of a radius in standard deviations.

    1 - exp(-radius^2 / 2), at most `_LARGEST_LEVEL`. Not checked: the radius is not negative; nan gives nan.
    """
    return float(min(-np.expm1(-0.5 * radius**2), _LARGEST_LEVEL))
