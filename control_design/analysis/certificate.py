"""The certificate: what was checked about a controller, independently of the optimiser that made it.

`certify` checks one controller against plants and specification. For every plant (`_check_plant`) it builds a
dense grid of its own, computes closed-loop poles, worst cases over the ellipses, the Nyquist count and
margins (`loop_margins`), bounds everything between the grid points, and lets each requirement decide. What
holds for whole responses (joint coverage) and what happens at the controller's limits come on top. A
`Certificate` holds the numbers, so that they can be shown and stored. Assumed: every plant lies in the
ellipses, with as many unstable poles as its nominal model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Literal, NamedTuple

import numpy as np

from control_design.analysis.between_grid_points import AllFrequencies, Obstacle, bound_all_frequencies
from control_design.analysis.joint_coverage import JointCoverage, at_level, joint_coverage as calibrate
from control_design.analysis.limited_loop import ERROR_LEFT, LimitedLoop, limited_loops
from control_design.analysis.margins import Crossovers, Margins, ellipse_margins, nominal_loop
from control_design.analysis.stability import (
    ModeChange,
    NyquistCount,
    closed_loop_poles,
    loop_integrators,
    mode_changes,
    nyquist_count,
)
from control_design.analysis.worst_case import WorstCase, worst_case
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Complex, Ellipses, Real
from control_design.plants.frequency_grid import checked_grid, near_the_circle, with_own_grid
from control_design.plants.plant_set import Mode, UncertainPlant, frequency_response, modes_of
from control_design.plants.set_expansion import with_straight_between
from control_design.specification import Specification
from control_design.specification.requirement import Findings, SpecificationItem
from ident.data.finding import Finding, distinct
from ident.data.keywords import clear_constructor
from ident.data.shown import NOT_STORED, Shown

# Damping ratio of a controller's pole pair below which the certificate lists it: narrower than what anybody
# measures a machine on. Chosen; it decides nothing.
LIGHT_CONTROLLER_POLES = 1e-3

# Damping ratio below which modes of plant, controller and loop get grid points of their own: above it a
# logarithmic grid shows the resonance, which is at most 1 / (2 zeta) = 1.25 high.
_LIGHT_MODE = 0.4
# Damping ratio that the grid takes at least for a mode, so that its points do not fall onto one another.
# Chosen: the maxima of narrower ones are found by refinement.
_LEAST_DAMPING = 1e-5
# Grid points around each of these modes, some thirty of them within its bandwidth, before the maxima are
# refined. Chosen.
_POINTS_PER_MODE = 120
# Distance of the loop from -1 at which |S| is -3 dB, its value at the bandwidth.
_DISTANCE_AT_BANDWIDTH = np.sqrt(2.0)

# Captions of the two items about a controller's limits.
_LIMITED_COMMAND = "limited command under a constant error: distance from its end, share of the limit"
_LIMITED_LOOP = "limited loop after a step beyond the limit: distance from its end, share of the step"


@dataclass(frozen=True)
class PlantVerdict:
    """Everything checked on one plant.

    Attributes
    ----------
    plant : str
        Its name.
    stable : bool
        All nominal closed-loop poles lie inside the unit circle.
    pole_radius : float
        Largest modulus of these poles.
    closed_loop_modes : tuple of Mode
        Oscillatory pole pairs of the nominal closed loop.
    mode_changes : tuple of ModeChange
        What becomes of the lightly damped modes of the nominal plant.
    nyquist : NyquistCount
        Half turns of 1 + K c, c the centre of the ellipses.
    nominal_margins, worst_margins : Margins
        Of the centre, and the smallest over all members of the ellipses; nan where the loop is not stable.
    worst_margin_omega_rad_s : float
        Where the loop comes nearest to -1.
    worst_weighted : float
        Largest weighted value over the ellipses (at most 1: met); inf where the loop is not stable or an
        ellipse reaches -1.
    worst_peak_sensitivity : float
        Largest |S| over the ellipses.
    bandwidth_rad_s : float
        Up to here every member has |S| below -3 dB; nan where the loop is not stable.
    frequencies : int
        Points of the dense grid.
    own_grid_rad_s : tuple of float or None
        Range of a user's own frequency grid; None if the uncertainty is known everywhere.
    assumed_linear : bool
        Between the points of that grid the response was assumed on a straight line between members.
    stated : bool
        An uncertainty was given at all.
    own_performance : bool
        The damping requirement looks at a channel of its own, any pair of members allowed.
    all_frequencies : AllFrequencies
        What was proved between the grid points.
    crossovers : Crossovers or None
        Every gain and phase crossover of the centre; none where the loop is not stable, None in a file of an
        earlier version.
    """

    plant: str
    stable: bool
    pole_radius: float
    closed_loop_modes: tuple[Mode, ...]
    mode_changes: tuple[ModeChange, ...]
    nyquist: NyquistCount
    nominal_margins: Margins
    worst_margins: Margins
    worst_margin_omega_rad_s: float
    worst_weighted: float
    worst_peak_sensitivity: float
    bandwidth_rad_s: float
    frequencies: int
    own_grid_rad_s: tuple[float, float] | None
    assumed_linear: bool
    stated: bool
    own_performance: bool
    all_frequencies: AllFrequencies
    crossovers: Crossovers | None = field(default=None, metadata={"since": 10})


@dataclass(frozen=True)
class Resonance:
    """A pole pair of the controller that a grid may miss: its mode, and the gain |K| there."""

    mode: Mode
    gain: float


@clear_constructor
@dataclass(frozen=True, repr=False)
class Certificate(Shown):
    """Verdict on a controller for a set of uncertain plants.

    Attributes
    ----------
    certified : bool
        Every nominal closed loop is stable by its poles and by the Nyquist count, no ellipse reaches -1, and
        every item of the specification is met: for all frequencies on plants where
        `PlantVerdict.all_frequencies` is possible, else on the dense grid or the plant's own.
    gamma : float
        Largest weighted worst case on the dense grid, no unit (at most 1: met); inf where a loop is not
        stable or an ellipse reaches -1.
    plants : tuple of PlantVerdict
        One per plant: its `worst_margins` and `nominal_margins` (`gain_up`, `gain_down`, `phase_rad`,
        `delay_s`, `modulus`), `bandwidth_rad_s`, `stable`, `pole_radius`; margins and bandwidth are nan where
        the loop is not stable.
    items : tuple of SpecificationItem
        Each requirement on each plant, then those on the controller, on sampled responses and at the limits:
        `required`, `achieved`, `met`.
    gamma_bound : float or None
        Upper bound of gamma for all frequencies; inf where it was not proved, None where some plant allows no
        proof.
    joint : JointCoverage or None
        Calibration of the ellipses to posterior samples, where it was asked for; the ellipses checked are
        then those of the calibrated level where it is above the given one.
    resonances : tuple of Resonance
        Pole pairs of the controller with a damping ratio below `LIGHT_CONTROLLER_POLES`.
    limited : tuple of LimitedLoop or None
        The limited controller and its loops; empty without limits, None where nobody looked (a file of an
        earlier version).
    controller, uncertain_plants, specification
        What it is about, as given to `certify`; not stored, so None or empty in one that was read from a
        file.

    Notes
    -----
    Nothing is checked here: `certify` makes it.

    Examples
    --------
    >>> law = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> certificate = flexlink.certify(law, example_plant(), example_specification())
    >>> certificate.certified, round(certificate.plants[0].worst_margins.modulus, 2)
    (True, 0.72)
    """

    table_in_notebook = True

    certified: bool
    gamma: float
    plants: tuple[PlantVerdict, ...]
    items: tuple[SpecificationItem, ...]
    gamma_bound: float | None = None
    joint: JointCoverage | None = None
    resonances: tuple[Resonance, ...] = ()
    limited: tuple[LimitedLoop, ...] | None = field(default=None, metadata={"since": 10})
    controller: Controller | None = field(default=None, compare=False, metadata=NOT_STORED)
    uncertain_plants: tuple[UncertainPlant, ...] = field(default=(), compare=False, metadata=NOT_STORED)
    specification: Specification | None = field(default=None, compare=False, metadata=NOT_STORED)

    @cached_property
    def warnings(self) -> tuple[Finding, ...]:
        """Doubts about the ellipses of its plants, each once: what the certificate stands or falls with.

        Asked of uncertainties that have a method `conditions(response, level)`, with the plant's nominal
        response and its level; others bring none, and a certificate that was read from a file has none.
        """
        findings: list[Finding] = []
        for plant in self.uncertain_plants:
            conditions = getattr(plant.uncertainty, "conditions", None)
            if conditions is not None:
                findings += conditions(partial(frequency_response, plant.nominal), plant.level)
        return distinct(findings)

    @property
    def nominal_only(self) -> bool:
        """Whether no plant had an uncertainty: the worst case is the nominal plant.

        True without plants.
        """
        return not any(plant.stated for plant in self.plants)


def certify(
    controller: Controller,
    plants: Sequence[UncertainPlant],
    specification: Specification,
    *,
    n_dense: int = 6000,
    between_own_points: Literal["nothing", "linear"] = "linear",
    joint_coverage: float | None = None,
    rng: np.random.Generator | None = None,
    joint_draws: int = 4000,
    joint_stable_share: float = 0.999,
) -> Certificate:
    """Check a controller from any source against plants and specification.

    Parameters
    ----------
    controller : Controller
        One error, one command. With limits it is also simulated at them, on the nominal plants
        (`limited_loop`): constant errors and reference steps beyond the limit have to end where they must.
    plants : sequence of UncertainPlant
        Each a nominal model with ellipses of its response.
    specification : Specification
        What the loop has to do for every member.
    n_dense : int
        Logarithmic points of the dense grid, at least two (not checked); those around modes and roots come on
        top. 6000 over some seven decades are 0.3 % from one to the next.
    between_own_points : {"linear", "nothing"}
        What may be assumed of a response known on its own frequencies only. "linear": at fraction x between
        two neighbours it lies in (1 - x) E_k + x E_{k+1}; the verdict says that this was assumed. "nothing":
        no statement between them, whatever the controller does there.
    joint_coverage : float, optional
        Probability with which the weighted worst case shall hold for a whole response
        (`joint_coverage.joint_coverage`). None: each frequency by itself.
    rng : numpy.random.Generator, optional
        Draws the responses that a joint coverage needs.
    joint_draws : int
        Number of these responses: 4000 leave a sampling error of 0.003 at a coverage of 0.95.
    joint_stable_share : float
        Chosen: 4 of 4000 may be unstable. With a joint coverage, share of those responses that must be
        stable. It is a requirement of its own: ellipses propagate parameters to first order, and no level of
        theirs speaks for draws far outside (`joint_synthesis` designs for it).

    Returns
    -------
    Certificate

    Raises
    ------
    ValueError
        The plants are none, sampling times or computational delays do not match, the loop is algebraic, or a
        joint coverage comes without rng. Also what `joint_coverage` refuses (a coverage outside (0, 1), fewer
        than 100 draws, an uncertainty that cannot be drawn from).
    SpecificationError
        `controller_dt_s` is not the plants' step, or a mode's peak is limited and a plant has no mode.

    Notes
    -----
    The grid is built here from the poles of plants, controller and closed loop and refined where the checks
    are worst; the optimiser's grid plays no part. Between its points the worst cases are bounded
    (`between_grid_points`), for plants whose uncertainty can be evaluated with its derivatives: posteriors of
    coefficients, plants without uncertainty, and uncertainties that offer `first_order`.
    """
    if not plants:
        raise ValueError("certify needs at least one plant")
    specification.refuse_other_rate(plants)
    if controller.computational_delay_samples != specification.computational_delay_samples:
        raise ValueError(
            f"the controller has {controller.computational_delay_samples} samples of computational delay, "
            f"the specification {specification.computational_delay_samples}"
        )

    # Ellipses of the calibrated level, where that is above the given one.
    asked_plants = tuple(plants)
    joint = None
    if joint_coverage is not None:
        if rng is None:
            raise ValueError("joint_coverage needs rng, a numpy.random.Generator to draw responses with")
        joint = calibrate(
            controller, plants, specification, rng=rng, coverage=joint_coverage, draws=joint_draws
        )
        # A lower level would check smaller ellipses than the user asked for.
        plants = [at_level(plant, max(plant.level, joint.level)) for plant in plants]

    # Requirements on the loops, then on the controller alone, of which nothing about a loop is known.
    verdicts: list[PlantVerdict] = []
    items: list[SpecificationItem] = []
    for plant in plants:
        verdict, plant_items = _check_plant(controller, plant, specification, n_dense, between_own_points)
        verdicts.append(verdict)
        items += plant_items
    no_loop = Findings(
        plant="controller",
        peaks={},
        bounds=None,
        modulus=(np.inf, 0.0),
        delay_s=np.inf,
        modes=(),
        controller=controller,
    )
    items += [requirement.check(no_loop) for requirement in specification.on_controller()]

    # Stability of the sampled responses.
    if joint is not None:
        items.append(
            SpecificationItem(
                requirement=f"share of {joint.draws} sampled responses that are stable",
                plant=plants[0].name if len(plants) == 1 else "all plants together",
                required=joint_stable_share,
                achieved=joint.stable_share,
                unit="",
                met=bool(joint.stable_share >= joint_stable_share),
                at_least=True,
                about="sampled responses",
            )
        )

    # The controller alone and the nominal loops at the limits.
    limited = limited_loops(controller, plants)
    for number, loop in enumerate(limited):
        if not loop.steps:
            continue
        is_controller = number == 0
        items.append(
            SpecificationItem(
                requirement=_LIMITED_COMMAND if is_controller else _LIMITED_LOOP,
                plant=loop.plant,
                required=ERROR_LEFT,
                achieved=loop.worst,
                unit="",
                met=loop.ends,
                about="controller" if is_controller else "nominal loop",
            )
        )

    # The verdict: robust stability of every plant, proved where a proof is possible, and every item.
    is_robust = True
    for verdict in verdicts:
        is_stable = verdict.stable and verdict.nyquist.matches and verdict.worst_margins.modulus > 0
        proof = verdict.all_frequencies
        is_unproved = proof.possible and not proof.proved
        is_robust = is_robust and is_stable and not is_unproved
    gamma_bound = None
    if all(verdict.all_frequencies.possible for verdict in verdicts):
        gamma_bound = max(verdict.all_frequencies.gamma for verdict in verdicts)

    # Resonances of the controller that are narrower than anybody's measurement of the machine.
    resonances: list[Resonance] = []
    light_modes = modes_of(controller.poles, controller.dt_s, zeta_below=LIGHT_CONTROLLER_POLES)
    for mode in light_modes:
        if mode.omega_rad_s < np.pi / controller.dt_s:
            response = controller.response(np.array([mode.omega_rad_s]))
            resonances.append(Resonance(mode, float(np.abs(response[0]))))
    return Certificate(
        certified=bool(is_robust and all(item.met for item in items)),
        gamma=max(verdict.worst_weighted for verdict in verdicts),
        plants=tuple(verdicts),
        items=tuple(items),
        gamma_bound=gamma_bound,
        joint=joint,
        resonances=tuple(resonances),
        limited=limited,
        controller=controller,
        uncertain_plants=asked_plants,
        specification=specification,
    )


class LoopMargins(NamedTuple):
    """Margins of one uncertain loop.

    nominal: of the centres. worst: smallest over all members of the ellipses; both with gains as factors,
    phase in rad, delay in s. bandwidth_rad_s: up to here every member has |S| below -3 dB, rad/s. crossovers:
    all of the centres.
    """

    nominal: Margins
    worst: Margins
    bandwidth_rad_s: float
    crossovers: Crossovers


def loop_margins(controller: Controller, plant: UncertainPlant, worst: WorstCase) -> LoopMargins:
    """Margins of the centres and over the ellipses, and the bandwidth.

    Parameters
    ----------
    controller : Controller
        One error, one command, with its delay.
    plant : UncertainPlant
    worst : WorstCase
        Its grid (F,), ellipses and `values["distance"]` (F,) from -1, of this controller and plant (not
        checked). Of a plant that is known between the points of the grid the
        margins hold there, too.

    Returns
    -------
    LoopMargins
        They say nothing of a loop that is not stable (not checked). The bandwidth is 0 also where |S| is
        below -3 dB at every point of the grid, which by Bode's integral is a loop whose grid misses most of
        it.
    """
    is_known_between = plant.own_grid is None
    integrators, _ = loop_integrators(controller, plant)

    def loop_gain(omega: Real) -> Complex:
        """Loop gain K c (N,) of the centres at frequencies (N,), rad/s.

        Raises what `UncertainPlant.at` raises.
        """
        return controller.response(omega) * plant.at(omega).centre

    def factor_and_ellipses(omega: Real) -> tuple[Complex, Ellipses]:
        """Controller with its delay (N,), and the ellipses, at frequencies (N,), rad/s.

        Raises what `UncertainPlant.at` raises.
        """
        return controller.response(omega), plant.at(omega)

    # A loop that integrates is infinite at zero frequency, and no gain moves a pole through z = 1.
    at_zero = None
    if not integrators:
        at_zero = float(loop_gain(np.zeros(1))[0].real)
    nominal, crossovers = nominal_loop(
        loop_gain, worst.omega_rad_s, refinable=is_known_between, at_zero=at_zero
    )
    distance = worst.values["distance"]
    over_ellipses = ellipse_margins(
        worst.loop_factor,
        worst.ellipses,
        distance,
        between=factor_and_ellipses if is_known_between else None,
        at_zero=not integrators,
    )

    # The last grid point before a member's |S| exceeds -3 dB; 0 where it does from the first one on.
    exceeds = np.flatnonzero(distance < _DISTANCE_AT_BANDWIDTH)
    bandwidth_rad_s = 0.0
    if exceeds.size and exceeds[0] > 0:
        bandwidth_rad_s = float(worst.omega_rad_s[exceeds[0] - 1])
    return LoopMargins(nominal, over_ellipses.worse(nominal), bandwidth_rad_s, crossovers)


def _check_plant(
    controller: Controller,
    plant: UncertainPlant,
    specification: Specification,
    n_dense: int,
    between_own_points: str,
) -> tuple[PlantVerdict, list[SpecificationItem]]:
    """Verdict on one plant, and its requirements with what was found; arguments as of `certify`.

    Raises ValueError where sampling times differ or the loop is algebraic (`closed_loop_poles`),
    SpecificationError where a mode's peak is limited and the plant has no mode. A loop that is not stable is
    no error: margins nan, worst_weighted inf.
    """
    poles = closed_loop_poles(controller, plant)
    radius = float(np.max(np.abs(poles), initial=0.0))
    is_stable = bool(radius < 1.0)

    # Modes that get grid points of their own: those of plant, loop and controller. Of the loop every pair
    # that swings (zeta below 1) is wanted, for the verdict.
    loop_modes = modes_of(poles, plant.dt_s, zeta_below=1.0)
    controller_modes = modes_of(controller.poles, plant.dt_s)
    light: list[Mode] = []
    for mode in (*plant.modes, *loop_modes, *controller_modes):
        if mode.omega_rad_s < plant.nyquist_rad_s and abs(mode.zeta) < _LIGHT_MODE:
            light.append(Mode(mode.omega_rad_s, max(abs(mode.zeta), _LEAST_DAMPING)))

    # Whatever else is narrow: poles and zeros of the loop next to the circle, before and after it is closed.
    zeros = np.zeros(0, dtype=np.complex128)
    if controller.order:
        zeros = np.asarray(controller.to_control().zeros(), dtype=np.complex128)
    zeros = zeros[np.isfinite(zeros)]
    roots = np.concatenate([plant.poles, plant.zeros, controller.poles, zeros, poles])
    narrow = near_the_circle(roots, plant.dt_s)
    grid = checked_grid(plant, light, n_dense, _POINTS_PER_MODE, roots=roots, extra=narrow)

    # A plant known on its own frequencies only is checked there, and between them where that is assumed.
    assumed_linear = plant.own_grid is not None and between_own_points == "linear"
    own_points = with_own_grid(plant, grid)
    seen_plant = plant
    checked = own_points
    if assumed_linear:
        seen_plant = with_straight_between(plant)
        checked = np.union1d(grid, own_points)
    own_grid_rad_s = None
    if plant.own_grid is not None:
        own_grid_rad_s = (float(plant.own_grid[0]), float(plant.own_grid[-1]))

    # Worst cases, winding and margins.
    law = partial(controller.response, with_delay=False)
    worst = worst_case(law, seen_plant, specification, checked)
    integrators, unstable = loop_integrators(controller, plant)
    count = nyquist_count(
        lambda omega: controller.response(omega) * seen_plant.at(omega).centre,
        # On a plant's own frequencies the count is that of its data; what lies between them is the proof's.
        own_points if assumed_linear else worst.omega_rad_s,
        integrators=integrators,
        unstable_poles=unstable,
        refinable=plant.own_grid is None,
    )
    margins = loop_margins(controller, seen_plant, worst)
    reaches_minus_one = not margins.worst.modulus > 0
    nearest_rad_s = float(worst.omega_rad_s[np.argmin(worst.values["distance"])])
    # Largest value of each requirement, and where.
    peaks: dict[str, tuple[float, float | None]] = {name: worst.peak(name) for name in worst.names}
    worst_weighted = float("inf")
    worst_peak_sensitivity = float("inf")
    if not reaches_minus_one:
        worst_peak_sensitivity = 1.0 / margins.worst.modulus
        if is_stable:
            worst_weighted = max(value for value, _ in peaks.values())

    # Between the grid points, for a loop that is robustly stable on them.
    if is_stable and count.matches and not reaches_minus_one:
        proof = bound_all_frequencies(
            controller,
            plant,
            specification,
            worst,
            modes=tuple(light),
            between_own_points=between_own_points,
        )
    else:
        proof = AllFrequencies.ended_by(Obstacle.NOT_STABLE)

    # |1 + K G| says nothing of a loop that is not stable.
    if not is_stable:
        no_margins = Margins(*[np.nan] * len(fields(Margins)))
        margins = LoopMargins(no_margins, no_margins, np.nan, Crossovers((), ()))
        peaks = dict.fromkeys(peaks, (np.nan, None))
    verdict = PlantVerdict(
        plant=plant.name,
        stable=is_stable,
        pole_radius=radius,
        closed_loop_modes=tuple(mode for mode in loop_modes if mode.zeta < 1.0),
        mode_changes=mode_changes(controller, plant),
        nyquist=count,
        nominal_margins=margins.nominal,
        worst_margins=margins.worst,
        worst_margin_omega_rad_s=nearest_rad_s,
        worst_weighted=worst_weighted,
        worst_peak_sensitivity=worst_peak_sensitivity,
        bandwidth_rad_s=margins.bandwidth_rad_s,
        frequencies=int(worst.omega_rad_s.size),
        own_grid_rad_s=own_grid_rad_s,
        assumed_linear=assumed_linear,
        stated=plant.uncertainty is not None,
        own_performance=plant.performance is not None,
        all_frequencies=proof,
        crossovers=margins.crossovers,
    )

    # Let every requirement decide.
    findings = Findings(
        plant=plant.name,
        peaks=peaks,
        bounds=proof.bounds if proof.possible and is_stable else None,
        modulus=(margins.worst.modulus, nearest_rad_s if is_stable else None),
        delay_s=margins.worst.delay_s,
        modes=loop_modes,
        controller=controller,
    )
    items = [requirement.check(findings) for requirement in specification.requirements(plant)]
    # Without any uncertainty nothing is a worst case.
    if plant.uncertainty is None and plant.damped.uncertainty is None:
        items = [replace(item, about="nominal loop") for item in items]
    return verdict, items
