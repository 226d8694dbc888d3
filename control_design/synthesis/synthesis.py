"""Structured robust synthesis: from controllers of the Youla bound, else from many starts, the orders below
the asked one first; and why a controller is no design at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from control_design.analysis.limited_loop import limited_loops, with_safe_limits
from control_design.controllers.biquads import Cascade, SectionKind
from control_design.controllers.controller import Controller
from control_design.convex.convex_options import YoulaOptions
from control_design.plants.ellipses import Real, scale_to_minus_one
from control_design.plants.frequency_grid import local_maxima
from control_design.plants.guards import Guard
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification, SpecificationError
from control_design.synthesis.order_search import OrderResult, OrderSearch, Progress, TriedController
from control_design.synthesis.problem import Problem
from control_design.synthesis.starts import with_cancelling_section
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import BlockingPoint, Outcome, StartReport, SynthesisResult
from control_design.synthesis.youla_starts import FreeController, FreeControllers, free_controllers

_STILL_BLOCKING = 0.98  # a weighted maximum within 2 % of the worst one blocks the specification too
_MEANINGLESS = 1e4  # a weighted worst case above it is a loop on the edge of stability, whatever its digits
_MOST_DAMPING = 0.3  # asked of the controller where data are sparse: wider than that is no resonance
_EMBEDDINGS = 3  # ways to add a cancelling section to the result of the order below
_LOWEST_ORDER, _LOWEST_TRACKING = 2, 3  # first rung of the ladder; two states rarely track and damp
NOMINAL = "stability of the nominal loop"
ROBUST = "stability over the ellipse"
DELAYED = "stability with the extra delay"
GUARDED = "stability of a sampled response"
DAMPING = "damping of the controller's own poles"

_WITHIN = 1.02  # of the Youla bound: what the order "auto" may leave
_GAINS = 0.99  # two more states that leave more than this of gamma end the search for "auto"
_MIDDLE, _HIGHEST = 5, 12  # orders that "auto" tries: the first, and the last

_PLACES = 5  # named of each plant


def synthesise(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
    guards: Sequence[Guard] = (),
    thorough: bool = True,
) -> SynthesisResult:
    """Design one controller for all plants: smallest gamma over every ellipse.

    plants : at least one; several loads, operating points or identified models at once.
    rng : the starts are drawn from it; same generator state, same result.
    progress : called with (fraction, message).
    guards : single responses that must be stable as well, whatever the weights say of them.

    thorough : search from many starts where those from the Youla bound do not settle it.

    Raises SpecificationError if specification and plants contradict each other (before optimising), and for
    the order "auto" where no bound is known. "auto": see `_of_lowest_order`.

    Controllers of the Youla bound, fitted by ones of the asked order, are improved first. They mostly end
    near the bound, or agree: see `OrderSearch.quick`. Otherwise many starts follow. Every controller of order
    n - 2 is one of order n with a section whose zeros cancel its poles, so these solve the orders n - 2, n -
    4, ... first, each with its own generator derived from `rng`, and hand their results upwards. The better
    of both is returned.
    """
    options = options or SynthesisOptions()
    specification.check_against(plants)
    asked, specification = specification, _seen_by_the_data(specification, plants)
    tell = progress or (lambda fraction, message: None)
    problem = Problem(tuple(plants), specification, options, tuple(guards))
    if specification.controller_order == "auto":
        found = _of_lowest_order(problem, int(rng.integers(2**63)), tell, thorough=thorough)
        return replace(found, plants=problem.plants, specification=asked)
    root = int(rng.integers(2**63))
    cascade = Cascade(specification.sections(), problem.dt_s, problem.scale_rad_s)
    ladder = _ladder(specification.sections(), _LOWEST_TRACKING if problem.asks_tracking else _LOWEST_ORDER)
    reports: list[StartReport] = []
    grids = list(problem.grids)
    search = OrderSearch(problem, cascade, np.random.default_rng([root, 0]), part_of(tell, 0, 2))
    result, settled = search.quick(free_controllers(problem.plants, specification))
    reports += search.reports
    if thorough and not settled:
        problem.grids[:] = grids  # what the fits violated may be of no concern to other starts
        climbed = _climbed(problem, ladder, root, result.best, part_of(tell, 1, 2), reports)
        worse = result.best is None or (climbed.best and climbed.best.gamma <= result.best.gamma)
        result = climbed if worse else result
    found = _told(problem, cascade, result, tuple(reports), tell)
    return replace(found, plants=problem.plants, specification=asked)


def _of_lowest_order(problem: Problem, root: int, tell: Progress, *, thorough: bool) -> SynthesisResult:
    """The lowest order within `_WITHIN` of the Youla bound, as far as fits of the bound's controllers tell.

    Orders are tried from a middle one upwards, or downwards where that is enough, each from these fits and
    from the result of two states fewer: a longer search may reach the bound with one state less. States are
    added as long as two of them gain, or while a specification is missed that the bound meets. Where none
    reaches the bound, the lowest order nearly as good as the best one tried. Several plants may have bounds
    that no common controller reaches; a damping asked of the controller is not part of the bound.
    """
    specification, limit = problem.spec, problem.options.sufficient_gamma
    tell(0.0, "bound for any order")
    free = free_controllers(problem.plants, specification, YoulaOptions())
    if not free.each:
        raise SpecificationError(
            "controller_order = 'auto' needs the Youla bound, which this plant has not; give a number"
        )
    enough = max(_WITHIN * free.gamma if np.isfinite(free.gamma) else 0.0, limit)
    reports = list[StartReport]()
    found: dict[int, tuple[float, OrderResult, OrderSearch]] = {}

    def gamma(order: int) -> float:
        sections = specification.model_copy(update={"controller_order": order}).sections()
        cascade, given = Cascade(sections, problem.dt_s, problem.scale_rad_s), list[Real]()
        part = part_of(tell, len(found), _HIGHEST, f"order {order}: ")
        part(0.0, "fits of the bound")
        own = np.random.default_rng([root, order])
        if order - 2 in found and (lower := found[order - 2][1].best) is not None:
            given = _embedded(problem, replace(cascade, sections=sections[:-1]), lower, cascade, own)
        search = OrderSearch(problem, cascade, own, part, given)
        result = search.fits_only(free)
        reports.extend(search.reports)
        found[order] = np.inf if result.best is None else result.best.gamma, result, search
        return found[order][0]

    def within() -> float:
        return max(enough, min(value for value, *_ in found.values()) / _GAINS)

    order = _MIDDLE
    while gamma(order) > enough and order + 2 <= _HIGHEST:
        met = found[order][0] <= 1.0 or free.gamma > 1.0
        if (met or not thorough) and order > _MIDDLE and found[order][0] > _GAINS * found[order - 2][0]:
            break
        order += 2
    if found[order][0] > enough:
        order = min(number for number, (value, *_) in found.items() if value <= within())
    while order > 1 and order - 1 not in found and gamma(order - 1) <= within():
        order -= 1
    reached, result, search = found[order]
    if reached > enough:
        search.reports = []
        again, _ = search.quick(free)
        reports += search.reports
        if again.best is not None and again.best.gamma < reached:
            result = again
    return _told(problem, search.cascade, result, tuple(reports), tell)


def synthesise_near(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> SynthesisResult:
    """As `synthesise`, from one controller alone: several times faster, and in the valley that it is in.

    controller : of any order, e.g. for a specification somewhat different; fitted by one of the asked order,
    or for "auto" of its own.

    Raises SpecificationError if specification and plants contradict each other.
    """
    if specification.controller_order == "auto":
        specification = specification.model_copy(update={"controller_order": max(controller.order, 1)})
    specification.check_against(plants)
    tell = progress or (lambda fraction, message: None)
    problem = Problem(tuple(plants), _seen_by_the_data(specification, plants), options or SynthesisOptions())
    cascade = Cascade(problem.spec.sections(), problem.dt_s, problem.scale_rad_s)
    omega = problem.grids[0]
    known = FreeController(omega, controller.response(omega, with_delay=False))
    result = OrderSearch(problem, cascade, rng, tell).fits_only(FreeControllers((known,), np.inf))
    return _told(problem, cascade, result, result.reports, tell)


def _told(
    problem: Problem, cascade: Cascade, result: OrderResult, reports: tuple[StartReport, ...], tell: Progress
) -> SynthesisResult:
    best = result.best
    if best is None or best.gamma >= _MEANINGLESS:
        nearest = result.nearest if best is None else best.parameters
        return _nothing_stable(problem, cascade, nearest, best, reports)
    tell(1.0, f"gamma {best.gamma:.4g}")
    return SynthesisResult(
        outcome=Outcome.MET_ON_GRID if best.gamma <= 1.0 else Outcome.NOT_MET,
        controller=with_safe_limits(
            problem.controller(cascade, best.parameters), lambda law: limited_loops(law, problem.plants)
        ),
        gamma=best.gamma,
        blocking=_blocking(problem, cascade, best),
        starts=reports,
        gamma_history=result.history,
        grid_points=sum(grid.size for grid in problem.grids),
    )


def _climbed(
    problem: Problem,
    ladder: Sequence[tuple[SectionKind, ...]],
    root: int,
    fitted: TriedController | None,
    tell: Progress,
    reports: list[StartReport],
) -> OrderResult:
    """Result of the last of the ladder's orders, each started from the one before and of its own; the last
    from the fitted one, too. What was run is added to the reports."""
    result = OrderResult(None, (), ())
    cascade: Cascade | None = None
    for number, sections in enumerate(ladder):
        lower, cascade = cascade, Cascade(sections, problem.dt_s, problem.scale_rad_s)
        own = np.random.default_rng([root, cascade.order])
        given: list[Real] = []
        if lower is not None and result.best is not None:
            given = _embedded(problem, lower, result.best, cascade, own)
        if number == len(ladder) - 1 and fitted is not None:
            given.append(fitted.parameters)
        part = part_of(tell, number, len(ladder), f"order {cascade.order}: ")
        result = OrderSearch(problem, cascade, own, part, given).run()
        reports += result.reports
    return result


def _embedded(
    problem: Problem, lower: Cascade, best: TriedController, higher: Cascade, rng: np.random.Generator
) -> list[Real]:
    """The best of a lower order with a section more that cancels itself, in several ways."""
    damping = max(0.8, 1.01 * (problem.spec.controller_damping or 0.0))
    return [
        with_cancelling_section(lower, best.parameters, higher, rng, damping=damping)
        for _ in range(_EMBEDDINGS)
    ]


def _seen_by_the_data(specification: Specification, plants: Sequence[UncertainPlant]) -> Specification:
    """With a least damping of the controller's own poles where some plant is known on its own frequencies
    only and none is asked: a resonance narrower than their spacing would stand between them, unseen."""
    own = [plant.own_grid for plant in plants if plant.own_grid is not None]
    if specification.controller_damping is not None or not own:
        return specification
    widest = max(float(np.max(np.diff(grid) / grid[1:])) for grid in own)
    return specification.model_copy(update={"controller_damping": min(widest / 2, _MOST_DAMPING)})


def _ladder(sections: tuple[SectionKind, ...], lowest: int) -> list[tuple[SectionKind, ...]]:
    """Section lists from the lowest order (at least `lowest`) to the asked one, one section more each."""
    rungs = [sections]
    while rungs[0][-1] in ("second_order", "notch"):
        shorter = rungs[0][:-1]
        if Cascade(shorter, 1.0, 1.0).order < lowest:
            break
        rungs.insert(0, shorter)
    return rungs


def part_of(tell: Progress, number: int, count: int, head: str = "") -> Progress:
    """Progress of one of `count` equal parts of a whole."""
    return lambda fraction, message: tell((number + fraction) / count, head + message)


def _nothing_stable(
    problem: Problem,
    cascade: Cascade,
    nearest: Real | None,
    edge: TriedController | None,
    reports: tuple[StartReport, ...],
) -> SynthesisResult:
    """No controller, and where the search came nearest to one: which requirement fails there."""
    delay, name = problem.spec.computational_delay_samples, "none: no stable design found"
    nothing = Controller.proportional(0.0, problem.dt_s, computational_delay_samples=delay, name=name)
    points = sum(grid.size for grid in problem.grids)
    blocking = () if nearest is None else what_destabilises(problem, cascade, nearest)
    if not blocking and edge is not None:
        blocking = _blocking(problem, cascade, edge)
    return SynthesisResult(Outcome.NOT_CONVERGED, nothing, float("inf"), blocking, reports, (), points)


def _blocking(problem: Problem, cascade: Cascade, best: TriedController) -> tuple[BlockingPoint, ...]:
    points = []
    for _, data in problem.checks(cascade, best.parameters):
        omega = data.ellipses.omega_rad_s
        values = data.weighted(cascade.response(best.parameters, omega))
        points += [
            BlockingPoint(data.plant.name, name, float(omega[at]), float(values[name][at]))
            for name in (each.requirement.name for each in data.weightings)
            for at in local_maxima(values[name])[:10]
            if values[name][at] >= _STILL_BLOCKING * best.gamma
        ]
    return tuple(sorted(points, key=lambda p: -p.value))


def what_destabilises(problem: Problem, cascade: Cascade, parameters: Real) -> tuple[BlockingPoint, ...]:
    """Points at which a controller fails before any weight counts, the worst first; empty if none does.

    An unstable nominal loop is named by its poles (frequency of ln(z)/dt, the fastest growing first), one
    that is stable by the frequencies at which an ellipse, or the ellipse behind the delay of the delay
    margin, lies deepest over -1; a guard by the frequency where it comes nearest to -1; a controller that
    rings too much by its own least damped pair.
    """
    found: list[tuple[int, float, BlockingPoint]] = []
    for plant, z in zip(problem.plants, problem.closed_loop_poles(cascade, parameters), strict=True):
        for pole in z[(np.abs(z) >= 1.0) & (z.imag >= 0) & np.isfinite(z)]:
            frequency = float(np.abs(np.log(pole))) / problem.dt_s
            found.append((0, -float(np.abs(pole)), BlockingPoint(plant.name, NOMINAL, frequency, np.inf)))
    for _, data in problem.checks(cascade, parameters):
        name, omega = data.plant.name, data.ellipses.omega_rad_s
        k = cascade.response(parameters, omega)
        late = [(ROBUST, np.ones(omega.size, dtype=np.complex128))]
        if problem.spec.delay_margin_s is not None:
            late.append((DELAYED, np.exp(-1j * omega * problem.spec.delay_margin_s)))
        for word, delay in late:
            scale = scale_to_minus_one(k * data.delay * delay, data.ellipses)
            found += [
                (1, float(scale[at]), BlockingPoint(name, word, float(omega[at]), np.inf))
                for at in local_maxima(-scale)[:_PLACES]
                if scale[at] <= 1.0
            ]
    points = [point for *_, point in sorted(found, key=lambda entry: entry[:2])]
    return tuple(points or _guards(problem, cascade, parameters) or _ringing(problem, cascade, parameters))


def _guards(problem: Problem, cascade: Cascade, parameters: Real) -> list[BlockingPoint]:
    points = []
    for guard in problem.guards:
        if not problem.guarded(cascade, parameters, [guard]):
            omega = guard.omega_rad_s
            distance = np.abs(1.0 + guard.response * problem.delayed_response(cascade, parameters, omega))
            at = int(np.argmin(distance))
            points.append(BlockingPoint(problem.plants[guard.plant].name, GUARDED, float(omega[at]), np.inf))
    return points


def _ringing(problem: Problem, cascade: Cascade, parameters: Real) -> list[BlockingPoint]:
    asked = problem.spec.controller_damping
    least = cascade.least_damping(parameters)
    if asked is None or not least < asked:
        return []
    corners = [(parameters[at] - 0.5 * parameters[at + 1], at) for at in cascade.pair_positions]
    corner = float(np.exp(0.5 * parameters[min(corners)[1] + 1])) * cascade.scale_rad_s
    return [BlockingPoint("controller", DAMPING, corner, asked / least)]
