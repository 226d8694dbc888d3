"""Structured robust synthesis of one loop: the smallest worst case over ellipses, or why there is no design.

`synthesise` searches for one controller of a given order and structure for all plants. It begins at
controllers of the Youla bound, fitted by the structure (`OrderSearch.quick`); where these do not settle it,
it begins at many starts, with the orders below the asked one first, because every controller of order n - 2
is one of order n with a section whose zeros cancel its poles (`_climbed`). For the order "auto"
`_of_lowest_order` chooses the order first. `synthesise_near` begins at one known controller only.

gamma is the weighted worst case on the dense grid: at most 1 where every requirement is met. `_result`
writes what was found as a `SynthesisResult`; without a stable design `what_destabilises` names the pole,
ellipse, guard or resonance on which the nearest controller fails.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from control_design.analysis.certificate import loop_margins
from control_design.analysis.limited_loop import limited_loops, with_safe_limits
from control_design.analysis.stability import closed_loop_poles
from control_design.analysis.worst_case import worst_case
from control_design.controllers.biquads import Cascade, Section
from control_design.controllers.controller import Controller
from control_design.controllers.parts import NotchPart
from control_design.convex.convex_options import YoulaOptions
from control_design.plants.ellipses import Complex, Real, scale_to_minus_one
from control_design.plants.frequency_grid import local_maxima
from control_design.plants.guards import Guard
from control_design.plants.plant_set import UncertainPlant, modes_of
from control_design.specification import Specification, SpecificationError
from control_design.synthesis.order_search import OrderResult, OrderSearch, Progress, TriedController
from control_design.synthesis.problem import Problem
from control_design.synthesis.starts import with_cancelling_section
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import BlockingPoint, Outcome, StartReport, SynthesisResult
from control_design.synthesis.youla_starts import FreeController, FreeControllers, free_controllers

# Share of the worst case from which a weighted maximum blocks the specification, too: a minimax stands on
# several maxima that are equal but for what the search leaves. Chosen.
_STILL_BLOCKING = 0.98
# Weighted worst case above which a loop stands on the edge of stability: its digits mean nothing, as 1 + L is
# the 1e-4 that is left of numbers near one. Chosen.
_MEANINGLESS = 1e4
# Largest damping ratio that is asked of the controller where data are sparse: wider than that is no
# resonance.
_MOST_DAMPING = 0.3
# Ways in which a cancelling section is added to the result of the order below: they differ in its corner.
# Chosen.
_EMBEDDINGS = 3
# Damping ratio of such a section: no resonance, and no two poles far apart. Chosen.
_EMBEDDED_DAMPING = 0.8
# Lowest order of the ladder up to the asked one: one pair of poles.
_LOWEST_ORDER = 2

# The lowest order with tracking, as two states rarely track and damp.
_LOWEST_TRACKING_ORDER = 3
# Worst case over the Youla bound that the order "auto" may leave: the 2 % that the specification's field
# `controller_order` promises.
_WITHIN = 1.02
# Two more states that leave more than this share of gamma end the search for "auto"; also how much of the
# best gamma a lower order may miss. Chosen: less than a per cent is not worth two states.
_GAINS = 0.99
# The order that "auto" tries first: an integrator and two pairs, of which it goes up or down. Chosen.
_FIRST_AUTO_ORDER = 5

# The highest order that "auto" tries: a bound on time. Chosen.
_HIGHEST_AUTO_ORDER = 12
# Frequencies of each plant that are named where an ellipse lies over -1. Chosen: more would not be read.
_MOST_PLACES = 5
# Maxima of one requirement that may block, of each plant: a limit on the list. Chosen.
_MOST_MAXIMA = 10

# What a controller without a weighted worst case fails on: `BlockingPoint.weight`. Pages and files show these
# words.
NOMINAL = "stability of the nominal loop"
ROBUST = "stability over the ellipse"
DELAYED = "stability with the extra delay"
GUARDED = "stability of a sampled response"
DAMPING = "damping of the controller's own poles"


def synthesise(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    guards: Sequence[Guard] = (),
    thorough: bool = True,
    known: Sequence[Controller] = (),
    enough: float = 0.0,
    is_trial: bool = False,
) -> SynthesisResult:
    """Design one controller for all plants: smallest gamma over every ellipse.

    Parameters
    ----------
    plants : sequence of UncertainPlant
        At least one; several loads, operating points or identified models at once.
    specification : Specification
        What is asked, with order and structure of the controller.
    options : SynthesisOptions, optional
        Effort of the search.
    rng : numpy.random.Generator
        The starts are drawn from it; same generator state, same result.
    progress : callable, optional
        Called with (fraction, message).
    guards : sequence of Guard
        Single responses that must be stable as well, whatever the weights say of them.
    thorough : bool
        Search from many starts where those from the Youla bound do not settle it.
    known : sequence of Controller
        Controllers to start from before those of the Youla bound, sampled as the plants; without an effect
        where the order is "auto".
    enough : float
        Worst case gamma up to which many starts are not tried; by default they always are.
    is_trial : bool
        Only whether `options.sufficient_gamma` is reached counts: where it is not, the result is the best of
        the starts as they ended, not improved further.

    Returns
    -------
    SynthesisResult
        The better of both searches. Its outcome says whether the specification is met, and whether anything
        stable was found.

    Raises
    ------
    SpecificationError
        There is no plant, or specification and plants contradict each other (before optimising), or the order
        is "auto" and no Youla bound is known.

    Notes
    -----
    Controllers of the Youla bound, fitted by ones of the asked order, are improved first. They mostly end
    near the bound, or agree: see `OrderSearch.quick`. Otherwise many starts follow. Orders n - 2, n - 4, ...
    are solved first, each with its own generator derived from `rng`, and hand their results upwards.
    """
    options = options or SynthesisOptions()
    specification.check_against(plants)
    asked = specification
    specification = _seen_by_the_data(specification, plants)
    tell = progress or (lambda fraction, message: None)
    problem = Problem(tuple(plants), specification, options, tuple(guards))
    # One draw, of all whole numbers that rng has, whatever the searches draw from generators of their own.
    seed = int(rng.integers(2**63))
    if specification.controller_order == "auto":
        result = _of_lowest_order(problem, seed, tell, thorough=thorough)
        return replace(result, plants=problem.plants, specification=asked)

    # First search: fits of the Youla bound's controllers.
    cascade = problem.cascade()
    if not cascade.parameters:
        order_result = _as_fixed(problem, cascade)
        result = _result(problem, cascade, order_result, (), tell)
        return replace(result, plants=problem.plants, specification=asked)
    first_grids = list(problem.grids)
    fits_rng = np.random.default_rng([seed, 0])
    search = OrderSearch(problem, cascade, fits_rng, part_of(tell, 0, 2))
    omega = problem.grids[0]
    responses = [FreeController(omega, law.response(omega, with_delay=False)) for law in known]
    order_result, settled = search.quick(
        lambda: free_controllers(problem.plants, specification), responses, is_trial=is_trial
    )
    settled = settled or (order_result.best is not None and order_result.best.gamma <= enough)
    reports = list(search.reports)

    # Second search: many starts, from the lowest order upwards.
    if thorough and not settled:
        # What the fits violated may be of no concern to other starts.
        problem.grids[:] = first_grids
        lowest = _LOWEST_TRACKING_ORDER if problem.asks_tracking else _LOWEST_ORDER
        ladder = _ladder(cascade.sections, lowest)
        climbed = _climbed(problem, ladder, seed, order_result.best, part_of(tell, 1, 2), reports)
        if _is_better(climbed.best, order_result.best):
            order_result = climbed
    result = _result(problem, cascade, order_result, tuple(reports), tell)
    return replace(result, plants=problem.plants, specification=asked)


def _is_better(new: TriedController | None, old: TriedController | None) -> bool:
    """Whether a new best controller replaces an old one: by a dense gamma that is not larger.

    Where there is no old one it does, even if it is None.
    """
    if old is None:
        return True
    return new is not None and new.gamma <= old.gamma


@dataclass(frozen=True, eq=False)
class _TriedOrder:
    """What the fits of one order led to: gamma (inf: nothing stable), the result and its search."""

    gamma: float
    result: OrderResult
    search: OrderSearch


def _of_lowest_order(problem: Problem, root: int, tell: Progress, *, thorough: bool) -> SynthesisResult:
    """Design of the lowest order within `_WITHIN` of the Youla bound, as far as fits of its controllers tell.

    root: seed; each order has its own generator. Orders are tried from `_FIRST_AUTO_ORDER` upwards in twos,
    or downwards where that one is enough, each from fits of the bound's controllers and from the result of
    two states fewer; a longer search may reach the bound with one state less. States are added as long as two
    of them gain, or (thorough) while a specification is missed that the bound meets. Where no order reaches
    the bound, the lowest one is taken that is nearly as good as the best that was tried: several plants may
    have bounds that no common controller reaches, and a damping asked of the controller is not part of the
    bound. Raises SpecificationError where no bound is known.
    """
    specification = problem.spec
    tell(0.0, "bound for any order")
    free = free_controllers(problem.plants, specification, YoulaOptions())
    if not free.each:
        raise SpecificationError(
            "controller_order = 'auto' needs the Youla bound, which this plant has not; give a number"
        )
    near_bound = _WITHIN * free.gamma if np.isfinite(free.gamma) else 0.0
    enough = max(near_bound, problem.options.sufficient_gamma)
    reports: list[StartReport] = []
    tried_orders: dict[int, _TriedOrder] = {}

    def gamma(order: int) -> float:
        """Worst case that fits of one order lead to, inf for nothing stable; the order joins those tried."""
        cascade = problem.cascade(order)
        part = part_of(tell, len(tried_orders), _HIGHEST_AUTO_ORDER, f"order {order}: ")
        part(0.0, "fits of the bound")
        order_rng = np.random.default_rng([root, order])
        known_starts: list[Real] = []
        if order - 2 in tried_orders:
            lower_best = tried_orders[order - 2].result.best
            if lower_best is not None:
                lower = replace(cascade, sections=cascade.sections[:-1])
                known_starts = _embedded(problem, lower, lower_best, cascade, order_rng)
        search = OrderSearch(problem, cascade, order_rng, part, known_starts)
        result = search.fits_only(free)
        reports.extend(search.reports)
        reached = np.inf if result.best is None else result.best.gamma
        tried_orders[order] = _TriedOrder(reached, result, search)
        return reached

    def acceptable() -> float:
        """Worst case that the lowest order may have: enough, or within `_GAINS` of the best of those
        tried."""
        best = min(attempt.gamma for attempt in tried_orders.values())
        return max(enough, best / _GAINS)

    # Upwards in twos until it is enough, or two more states gain nothing.
    order = _FIRST_AUTO_ORDER
    while gamma(order) > enough and order + 2 <= _HIGHEST_AUTO_ORDER:
        reached = tried_orders[order].gamma
        met_or_hopeless = reached <= 1.0 or free.gamma > 1.0
        may_end = met_or_hopeless or not thorough
        if may_end and order > _FIRST_AUTO_ORDER and reached > _GAINS * tried_orders[order - 2].gamma:
            break
        order += 2
    if tried_orders[order].gamma > enough:
        limit = acceptable()
        order = min(number for number, attempt in tried_orders.items() if attempt.gamma <= limit)
    # Downwards one by one while that is still acceptable.
    while order > 1 and order - 1 not in tried_orders and gamma(order - 1) <= acceptable():
        order -= 1

    chosen = tried_orders[order]
    result = chosen.result
    search = chosen.search
    if chosen.gamma > enough:
        # Fits with random weights, and other starts, at the order that was chosen.
        search.reports = []
        again, _ = search.quick(lambda: free)
        reports += search.reports
        if again.best is not None and again.best.gamma < chosen.gamma:
            result = again
    if not _meets_beside_gamma(problem, search.cascade, result):
        # Gamma does not see the damping of the nominal loop's modes and the delay margin, which the
        # certificate asks for. An order that meets all may be known, if not as near to the bound.
        meeting = [
            number
            for number, attempt in tried_orders.items()
            if attempt.gamma <= 1.0 and _meets_beside_gamma(problem, attempt.search.cascade, attempt.result)
        ]
        if meeting:
            search = tried_orders[min(meeting)].search
            result = tried_orders[min(meeting)].result
    return _result(problem, search.cascade, result, tuple(reports), tell)


def _meets_beside_gamma(problem: Problem, cascade: Cascade, result: OrderResult) -> bool:
    """Whether a controller meets what the certificate asks for and gamma does not hold.

    That is the damping of the nominal loops' modes, and the delay margin over the ellipses. False without a
    controller, where either is asked.
    """
    return _damps_modes(problem, cascade, result) and _bears_delay(problem, cascade, result)


def _bears_delay(problem: Problem, cascade: Cascade, result: OrderResult) -> bool:
    """Whether the worst delay margin over the ellipses is the one that is asked, as the certificate checks.

    True where none is asked, False without a controller.
    """
    asked_s = problem.spec.delay_margin_s
    if asked_s is None:
        return True
    if result.best is None:
        return False
    controller = problem.controller(cascade, result.best.parameters)

    def response(omega_rad_s: Real) -> Complex:
        """The controller without its delay."""
        return controller.response(omega_rad_s, with_delay=False)

    for plant, data in zip(problem.plants, problem.dense, strict=True):
        worst = worst_case(response, plant, problem.spec, data.ellipses.omega_rad_s)
        # A loop that is not stable has a margin of nan.
        if not loop_margins(controller, plant, worst)[1].delay_s >= asked_s:
            return False
    return True


def _damps_modes(problem: Problem, cascade: Cascade, result: OrderResult) -> bool:
    """Whether the nominal loops' modes in the band are damped as the specification asks, as the certificate
    checks it; True where it does not ask, False without a controller."""
    zeta, band = problem.spec.mode_damping, problem.spec.mode_band_rad_s
    if zeta is None or band is None:
        return True
    if result.best is None:
        return False
    controller = problem.controller(cascade, result.best.parameters)
    for plant in problem.plants:
        for mode in modes_of(closed_loop_poles(controller, plant), plant.dt_s, zeta_below=1.0):
            if band[0] <= mode.omega_rad_s <= band[1] and mode.zeta < zeta:
                return False
    return True


def synthesise_near(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> SynthesisResult:
    """Design one controller from a known one, in the valley that it is in: several times faster.

    Parameters
    ----------
    controller : Controller
        Of any order, e.g. for a specification somewhat different; fitted by one of the asked order, or for
        "auto" of its own. Sampled as the plants (not checked: at another period its response is fitted all
        the same, up to their Nyquist frequency).
    plants : sequence of UncertainPlant
        At least one.
    specification : Specification
        What is asked, with order and structure of the new controller.
    options : SynthesisOptions, optional
        Sizes of grids and rounds of exchange; its numbers of starts do not count.
    rng : numpy.random.Generator
        Not drawn from in the search as it is.
    progress : callable, optional
        Called with (fraction, message).

    Returns
    -------
    SynthesisResult
        Without `plants` and `specification`. Not converged, without a blocking point, where the fit leads to
        nothing stable, as of parts, which are not fitted.

    Raises
    ------
    SpecificationError
        Specification and plants contradict each other.
    """
    if specification.controller_order == "auto":
        specification = specification.model_copy(update={"controller_order": max(controller.order, 1)})
    specification.check_against(plants)
    tell = progress or (lambda fraction, message: None)
    problem = Problem(tuple(plants), _seen_by_the_data(specification, plants), options or SynthesisOptions())
    cascade = problem.cascade()
    if not cascade.parameters:
        return _result(problem, cascade, _as_fixed(problem, cascade), (), tell)
    omega = problem.grids[0]
    known = FreeController(omega, controller.response(omega, with_delay=False))
    # No bound is known: nothing counts as near to it.
    free = FreeControllers((known,), np.inf)
    result = OrderSearch(problem, cascade, rng, tell).fits_only(free)
    return _result(problem, cascade, result, result.reports, tell)


def _as_fixed(problem: Problem, cascade: Cascade) -> OrderResult:
    """Result for a controller of which every parameter is fixed: it is checked, not searched for."""
    x = np.zeros(0)
    gamma = problem.gamma(cascade, x)
    if not np.isfinite(gamma):
        return OrderResult(None, (), (), x)
    return OrderResult(TriedController(x, gamma, gamma), (), (gamma,))


def _result(
    problem: Problem, cascade: Cascade, result: OrderResult, reports: tuple[StartReport, ...], tell: Progress
) -> SynthesisResult:
    """Result of a synthesis for the best controller of a search, or for none.

    Anti-windup gains are chosen so that the nominal loops hold at the limits (`with_safe_limits`). No best,
    or one with a worst case of `_MEANINGLESS` or more, is a result without a controller.
    """
    best = result.best
    if best is None or best.gamma >= _MEANINGLESS:
        nearest = result.nearest if best is None else best.parameters
        return _nothing_stable(problem, cascade, nearest, best, reports)
    tell(1.0, f"gamma {best.gamma:.4g}")
    outcome = Outcome.MET_ON_GRID if best.gamma <= 1.0 else Outcome.NOT_MET
    controller = problem.controller(cascade, best.parameters)
    controller = with_safe_limits(controller, lambda law: limited_loops(law, problem.plants))
    return SynthesisResult(
        outcome=outcome,
        controller=controller,
        gamma=best.gamma,
        blocking=_blocking(problem, cascade, best),
        starts=reports,
        gamma_history=result.history,
        grid_points=sum(grid.size for grid in problem.grids),
    )


def _climbed(
    problem: Problem,
    ladder: Sequence[tuple[Section, ...]],
    root: int,
    fitted: TriedController | None,
    tell: Progress,
    reports: list[StartReport],
) -> OrderResult:
    """Result of the last order of a ladder, each order started from the one before and from its own starts.

    ladder: sections of each order, ascending. root: seed; each order has its own generator. The last order
    starts from the fitted controller, too, if there is one. The descents that were run are added to
    `reports`. Where an order finds nothing stable, the next has its own starts only. An empty ladder gives no
    best.
    """
    result = OrderResult(None, (), ())
    lower: Cascade | None = None
    for number, sections in enumerate(ladder):
        cascade = Cascade(sections, problem.dt_s, problem.scale_rad_s)
        order_rng = np.random.default_rng([root, cascade.order])
        known_starts: list[Real] = []
        if lower is not None and result.best is not None:
            known_starts = _embedded(problem, lower, result.best, cascade, order_rng)
        if number == len(ladder) - 1 and fitted is not None:
            known_starts.append(fitted.parameters)
        part = part_of(tell, number, len(ladder), f"order {cascade.order}: ")
        result = OrderSearch(problem, cascade, order_rng, part, known_starts).run()
        reports += result.reports
        lower = cascade
    return result


def _embedded(
    problem: Problem, lower: Cascade, best: TriedController, higher: Cascade, rng: np.random.Generator
) -> list[Real]:
    """Parameters of the best of a lower order with a section more that cancels itself, in several ways.

    `_EMBEDDINGS` vectors of the higher cascade, whose sections are those of `lower` and one of order two
    more; any other raises ValueError (`with_cancelling_section`).
    """
    # Clear of the bound on the controller's damping by 1 %: a start on it has no room to move.
    asked_damping = problem.spec.controller_damping or 0.0
    damping = max(_EMBEDDED_DAMPING, 1.01 * asked_damping)
    return [
        with_cancelling_section(lower, best.parameters, higher, rng, damping=damping)
        for _ in range(_EMBEDDINGS)
    ]


def _seen_by_the_data(specification: Specification, plants: Sequence[UncertainPlant]) -> Specification:
    """Specification with a least damping of the controller's own poles, where some plant needs one.

    A plant that is known on its own frequencies only needs one: a resonance narrower than their spacing would
    stand between them, unseen. A pair of poles is as wide as 2 zeta of its frequency, so half of the widest
    relative spacing is asked, at most `_MOST_DAMPING`. A damping that was asked already stays, and without
    such a plant the specification is the one given.
    """
    own_grids = [plant.own_grid for plant in plants if plant.own_grid is not None]
    if specification.controller_damping is not None or not own_grids:
        return specification
    spacings = [np.diff(grid) / grid[1:] for grid in own_grids]
    widest_spacing = max(float(np.max(spacing)) for spacing in spacings)
    return specification.model_copy(update={"controller_damping": min(widest_spacing / 2, _MOST_DAMPING)})


def _ladder(sections: tuple[Section, ...], lowest: int) -> list[tuple[Section, ...]]:
    """Section lists from the lowest order (at least `lowest`) to the asked one, one section more each.

    Sections of second order and free notches stand last and are left out from the end; the asked list is
    always among them, also where its order is below `lowest`.
    """
    rungs = [sections]
    while True:
        last = rungs[0][-1]
        is_free_notch = isinstance(last, NotchPart) and last.is_free
        if not (last == "second_order" or is_free_notch):
            break
        shorter = rungs[0][:-1]
        if Cascade(shorter, 1.0, 1.0).order < lowest:
            break
        rungs.insert(0, shorter)
    return rungs


def part_of(tell: Progress, number: int, count: int, head: str = "") -> Progress:
    """Progress of one of several equal parts of a whole.

    Parameters
    ----------
    tell : Progress
        Of the whole.
    number : int
        Of the part, from 0.
    count : int
        Number of parts, not 0.
    head : str
        Stands before every message.

    Returns
    -------
    Progress
        Its fraction, 0 to 1, is of the part.
    """
    return lambda fraction, message: tell((number + fraction) / count, head + message)


def _nothing_stable(
    problem: Problem,
    cascade: Cascade,
    nearest: Real | None,
    edge: TriedController | None,
    reports: tuple[StartReport, ...],
) -> SynthesisResult:
    """Result without a controller, and with what fails where the search came nearest to one.

    nearest: parameters (n,) of that controller, if any. edge: one that is stable with a worst case so large
    that it means nothing; its requirements block where nothing else fails. The controller of the result is
    u = 0, named so, and gamma inf.
    """
    nothing = Controller.proportional(
        0.0,
        problem.dt_s,
        computational_delay_samples=problem.spec.computational_delay_samples,
        name="none: no stable design found",
    )
    points = sum(grid.size for grid in problem.grids)
    blocking = () if nearest is None else what_destabilises(problem, cascade, nearest)
    if not blocking and edge is not None:
        blocking = _blocking(problem, cascade, edge)
    return SynthesisResult(Outcome.NOT_CONVERGED, nothing, float("inf"), blocking, reports, (), points)


def _blocking(problem: Problem, cascade: Cascade, best: TriedController) -> tuple[BlockingPoint, ...]:
    """Local maxima of the weighted worst cases within 2 % of gamma, the largest first.

    best: its `gamma`, finite, and parameters of the cascade count. Points are at the frequencies of
    `Problem.checks`, rad/s.
    """
    points = []
    for _, data in problem.checks(cascade, best.parameters):
        omega = data.ellipses.omega_rad_s
        values = data.weighted(cascade.response(best.parameters, omega))
        for weighting in data.weightings:
            name = weighting.requirement.name
            for at in local_maxima(values[name])[:_MOST_MAXIMA]:
                if values[name][at] >= _STILL_BLOCKING * best.gamma:
                    value = float(values[name][at])
                    points.append(BlockingPoint(data.plant.name, name, float(omega[at]), value))
    return tuple(sorted(points, key=lambda point: -point.value))


def what_destabilises(problem: Problem, cascade: Cascade, parameters: Real) -> tuple[BlockingPoint, ...]:
    """Points at which a controller fails before any weight counts.

    Parameters
    ----------
    problem : Problem
        Its plants, guards and checks.
    cascade : Cascade
        Structure of the controller.
    parameters : ndarray, shape (n,)
        Of the controller; another number of them is a ValueError (`Cascade.split`).

    Returns
    -------
    tuple of BlockingPoint
        The worst first; empty if it does not fail. Unstable nominal loops come first, by their poles
        (frequency of ln(z)/dt, the fastest growing first), then the frequencies at which an ellipse, or the
        ellipse behind the delay of the delay margin, lies deepest over -1. Where there are none: guards, by
        the frequency where each comes nearest to -1; and where there are none: the controller's own least
        damped pair. The infinite pole of an algebraic loop is not named.
    """
    # Unstable poles, as (-modulus, point), and ellipses over -1, as (scale to reach -1, point).
    unstable_poles: list[tuple[float, BlockingPoint]] = []
    poles_of_loops = problem.closed_loop_poles(cascade, parameters)
    for plant, poles in zip(problem.plants, poles_of_loops, strict=True):
        outside = np.abs(poles) >= 1.0
        upper = poles.imag >= 0
        named = outside & upper & np.isfinite(poles)
        for pole in poles[named]:
            frequency = float(np.abs(np.log(pole))) / problem.dt_s
            point = BlockingPoint(plant.name, NOMINAL, frequency, np.inf)
            unstable_poles.append((-float(np.abs(pole)), point))

    if not unstable_poles:
        for number, poles in problem.unstable_when_late(cascade, parameters):
            for pole in poles[(np.abs(poles) >= 1.0) & (poles.imag >= 0) & np.isfinite(poles)]:
                frequency = float(np.abs(np.log(pole))) / problem.dt_s
                point = BlockingPoint(problem.plants[number].name, DELAYED, frequency, np.inf)
                unstable_poles.append((-float(np.abs(pole)), point))

    ellipses_over: list[tuple[float, BlockingPoint]] = []
    for _, data in problem.checks(cascade, parameters):
        omega = data.ellipses.omega_rad_s
        k = cascade.response(parameters, omega)
        delays = [(ROBUST, np.ones(omega.size, dtype=np.complex128))]
        if problem.spec.delay_margin_s is not None:
            delays.append((DELAYED, np.exp(-1j * omega * problem.spec.delay_margin_s)))
        for word, delay in delays:
            # By this factor an ellipse would have to change to just reach -1: up to 1, it covers it.
            scale = scale_to_minus_one(k * data.delay * delay, data.ellipses)
            for at in local_maxima(-scale)[:_MOST_PLACES]:
                if scale[at] <= 1.0:
                    point = BlockingPoint(data.plant.name, word, float(omega[at]), np.inf)
                    ellipses_over.append((float(scale[at]), point))

    unstable_poles.sort(key=lambda entry: entry[0])
    ellipses_over.sort(key=lambda entry: entry[0])
    points = [point for _, point in [*unstable_poles, *ellipses_over]]
    return tuple(points or _guards(problem, cascade, parameters) or _ringing(problem, cascade, parameters))


def _guards(problem: Problem, cascade: Cascade, parameters: Real) -> list[BlockingPoint]:
    """Points at which guards that are not stable come nearest to -1, one for each such guard.

    parameters (n,) of the cascade; frequencies in rad/s, value inf; empty without such a guard.
    """
    points = []
    for guard in problem.guards:
        if problem.guarded(cascade, parameters, [guard]):
            continue
        omega = guard.omega_rad_s
        loop = guard.response * problem.delayed_response(cascade, parameters, omega)
        at = int(np.argmin(np.abs(1.0 + loop)))
        plant_name = problem.plants[guard.plant].name
        points.append(BlockingPoint(plant_name, GUARDED, float(omega[at]), np.inf))
    return points


def _ringing(problem: Problem, cascade: Cascade, parameters: Real) -> list[BlockingPoint]:
    """The controller's own least damped pair, if it has less damping than is asked; else nothing.

    parameters (n,) of the cascade. The value is the damping asked over that of the pair, the frequency the
    pair's corner in the Tustin plane, rad/s. Empty also where no damping is asked.
    """
    asked = problem.spec.controller_damping
    least = cascade.least_damping(parameters)
    if asked is None or not least < asked:
        return []
    _, least_damped = min(cascade.pairs(parameters))
    corner = least_damped * cascade.scale_rad_s
    return [BlockingPoint("controller", DAMPING, corner, asked / least)]
