"""The certificate: what was checked about a controller, independently of the optimiser that made it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np

from control_design.analysis.between_grid_points import AllFrequencies, Obstacle, bound_all_frequencies
from control_design.analysis.joint_coverage import JointCoverage, at_level, joint_coverage as calibrate
from control_design.analysis.limited_loop import ERROR_LEFT, LimitedLoop, limited_loops
from control_design.analysis.margins import Margins, ellipse_margins, nominal_margins
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
from control_design.plants.ellipses import Complex, Real
from control_design.plants.frequency_grid import checked_grid, near_the_circle, with_own_grid
from control_design.plants.plant_set import Mode, UncertainPlant, frequency_response, modes_of
from control_design.plants.set_expansion import with_straight_between
from control_design.specification import Specification
from control_design.specification.requirement import Findings, SpecificationItem
from ident.data.finding import Finding, distinct
from ident.data.shown import NOT_STORED, Shown


@dataclass(frozen=True)
class PlantVerdict:
    """Everything checked on one plant.

    closed_loop_modes: oscillatory pairs of the nominal closed loop. mode_changes: what becomes of the lightly
    damped modes of the nominal plant. worst_tracking etc.: largest weighted
    value over the ellipses (<= 1 met, 0 = not asked). bandwidth_rad_s: up to here
    every member has |S| below -3 dB. own_grid_rad_s: range of a user's own frequency grid, None if the
    uncertainty is known everywhere; assumed_linear: between its points the response was assumed on a straight
    line between members. Margins and bandwidth are nan where the loop is not stable. stated: an uncertainty
    was given at all. own_performance: the damping requirement
    looks at a channel of its own, any pair of members allowed. all_frequencies: what was proved between the
    grid points.
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


@dataclass(frozen=True)
class Resonance:
    """A pole pair of the controller that a grid may miss: its mode, and the gain |K| there."""

    mode: Mode
    gain: float


@dataclass(frozen=True, repr=False)
class Certificate(Shown):
    """Verdict on a controller for a set of uncertain plants.

    certified: every nominal closed loop is stable by its poles and by the Nyquist count, no ellipse reaches
    -1, and every item of the specification is met: for all frequencies on plants where
    `PlantVerdict.all_frequencies` is possible, else on the dense grid or the plant's own. gamma: largest
    weighted worst case on the dense grid (<= 1 met). gamma_bound: upper bound of it for all frequencies, or
    None where some plant allows no proof. joint: calibration of the ellipses to posterior samples, where
    specified; the ellipses checked are then those of the calibrated level where it is above the given one.
    limited: the limited controller and its loops, empty without limits, None where nobody looked (by an
    earlier version).
    resonances: pole pairs of the controller with a damping ratio below `LIGHT_CONTROLLER_POLES`. controller,
    uncertain_plants, specification: what it is about; not stored.

    plants: per plant its `worst_margins` and `nominal_margins` (`gain_up`, `gain_down`, `phase_rad`,
    `delay_s`, `modulus`), `bandwidth_rad_s`, `stable`, `pole_radius`; nan where the loop is not stable.
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
        """What the certificate stands or falls with: doubts about the ellipses of its plants."""
        found: list[Finding] = []
        for plant in self.uncertain_plants:
            if (conditions := getattr(plant.uncertainty, "conditions", None)) is not None:
                found += conditions(partial(frequency_response, plant.nominal), plant.level)
        return distinct(found)

    @property
    def nominal_only(self) -> bool:
        """No plant had an uncertainty: the worst case is the nominal plant."""
        return not any(plant.stated for plant in self.plants)


LIGHT_CONTROLLER_POLES = 1e-3
"""Damping ratio; less is narrower than what anybody measures a machine on, and is told."""


_LIMITED_COMMAND = "limited command under a constant error: distance from its end, share of the limit"
_LIMITED_LOOP = "limited loop after a step beyond the limit: distance from its end, share of the step"


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

    The grid is built here from the poles of plants, controller and closed loop and refined where the checks
    are worst; the optimiser's grid plays no part. Between its points the worst cases are bounded
    (`between_grid_points`), for plants whose uncertainty can be evaluated with its derivatives: posteriors of
    coefficients, plants without uncertainty, and uncertainties that offer `first_order`.

    between_own_points: what may be assumed of a response known on its own frequencies only. "linear": at
    fraction x between two neighbours it lies in (1 - x) E_k + x E_{k+1}; the verdict says that this was
    assumed. "nothing": no statement between them, whatever the controller does there.

    joint_coverage: probability with which the weighted worst case shall hold for a whole response; needs rng
    and draws `joint_draws` responses (`joint_coverage.joint_coverage`). None: each frequency by itself.

    A controller with limits is also simulated at them, on the nominal plants (`limited_loop`): constant
    errors and reference steps beyond the limit have to end where they must.

    joint_stable_share: with a joint coverage, share of those responses that must be stable. It is a
    requirement of its own: ellipses propagate parameters to first order, and no level of theirs speaks for
    draws far outside (`joint_synthesis` designs for it).

    Raises ValueError if the plants are none, sampling times or computational delays do not match, or the loop
    is algebraic.
    """
    if not plants:
        raise ValueError("certify needs at least one plant")
    specification.refuse_other_rate(plants)
    if controller.computational_delay_samples != specification.computational_delay_samples:
        raise ValueError(
            f"the controller has {controller.computational_delay_samples} samples of computational delay, "
            f"the specification {specification.computational_delay_samples}"
        )
    joint, asked = None, tuple(plants)
    if joint_coverage is not None:
        if rng is None:
            raise ValueError("joint_coverage needs rng, a numpy.random.Generator to draw responses with")
        joint = calibrate(
            controller, plants, specification, rng=rng, coverage=joint_coverage, draws=joint_draws
        )
        plants = [at_level(plant, max(plant.level, joint.level)) for plant in plants]
    verdicts: list[PlantVerdict] = []
    items: list[SpecificationItem] = []
    for plant in plants:
        verdict, found = _check_plant(controller, plant, specification, n_dense, between_own_points)
        verdicts.append(verdict)
        items += found
    nothing = Findings("controller", {}, None, (np.inf, 0.0), np.inf, (), controller)
    items += [requirement.check(nothing) for requirement in specification.on_controller()]
    if joint is not None:
        name = plants[0].name if len(plants) == 1 else "all plants together"
        caption = f"share of {joint.draws} sampled responses that are stable"
        found_share, enough = joint.stable_share, bool(joint.stable_share >= joint_stable_share)
        share = SpecificationItem(caption, name, joint_stable_share, found_share, "", enough)
        items.append(replace(share, at_least=True, about="sampled responses"))
    # The nominal loops at the controller's limits.
    limited = limited_loops(controller, plants)
    for loop in limited:
        if loop.steps:
            alone = loop is limited[0]
            caption = _LIMITED_COMMAND if alone else _LIMITED_LOOP
            about: Literal["controller", "nominal loop"] = "controller" if alone else "nominal loop"
            found_loop = SpecificationItem(caption, loop.plant, ERROR_LEFT, loop.worst, "", loop.ends)
            items.append(replace(found_loop, about=about))

    robust = all(v.stable and v.nyquist.matches and v.worst_margins.modulus > 0 for v in verdicts)
    proofs = [v.all_frequencies for v in verdicts]
    robust = robust and all(proof.proved or not proof.possible for proof in proofs)
    return Certificate(
        certified=bool(robust and all(item.met for item in items)),
        gamma=max(v.worst_weighted for v in verdicts),
        plants=tuple(verdicts),
        items=tuple(items),
        gamma_bound=max(proof.gamma for proof in proofs) if all(p.possible for p in proofs) else None,
        joint=joint,
        resonances=tuple(
            Resonance(mode, float(np.abs(controller.response(np.array([mode.omega_rad_s]))[0])))
            for mode in modes_of(controller.poles, controller.dt_s, zeta_below=LIGHT_CONTROLLER_POLES)
            if mode.omega_rad_s < np.pi / controller.dt_s
        ),
        limited=limited,
        controller=controller,
        uncertain_plants=asked,
        specification=specification,
    )


def loop_margins(
    controller: Controller, plant: UncertainPlant, worst: WorstCase
) -> tuple[Margins, Margins, float]:
    """Margins of the centres, the smallest over all members of the ellipses, and the bandwidth [rad/s] up to
    which every member has |S| below -3 dB: on the grid of `worst` and, of a plant that is known there,
    between its points. They say nothing of a loop that is not stable."""
    known = plant.own_grid is None
    integrates, _ = loop_integrators(controller, plant)

    def loop_gain(omega: Real) -> Complex:
        return controller.response(omega) * plant.at(omega).centre

    at_zero = None if integrates else float(loop_gain(np.zeros(1))[0].real)
    nominal = nominal_margins(loop_gain, worst.omega_rad_s, refinable=known, at_zero=at_zero)
    distance = worst.values["distance"]
    found = ellipse_margins(
        worst.loop_factor,
        worst.ellipses,
        distance,
        between=(lambda omega: (controller.response(omega), plant.at(omega))) if known else None,
        at_zero=not integrates,
    )
    below = np.flatnonzero(distance < np.sqrt(2.0))
    bandwidth = float(worst.omega_rad_s[below[0] - 1]) if below.size and below[0] > 0 else 0.0
    return nominal, found.worse(nominal), bandwidth


def _check_plant(
    controller: Controller,
    plant: UncertainPlant,
    specification: Specification,
    n_dense: int,
    between_own_points: str,
) -> tuple[PlantVerdict, list[SpecificationItem]]:
    poles = closed_loop_poles(controller, plant)
    radius = float(np.max(np.abs(poles))) if poles.size else 0.0
    loop_modes = modes_of(poles, plant.dt_s, zeta_below=1.0)
    own_modes = modes_of(controller.poles, plant.dt_s)
    near = [m for m in (*plant.modes, *loop_modes, *own_modes) if m.omega_rad_s < plant.nyquist_rad_s]
    light = [Mode(m.omega_rad_s, max(abs(m.zeta), 1e-5)) for m in near if abs(m.zeta) < 0.4]
    # Whatever is narrow: poles and zeros of the loop next to the circle, before and after it is closed.
    zeros = np.asarray(controller.to_control().zeros() if controller.order else [], dtype=np.complex128)
    zeros = zeros[np.isfinite(zeros)]
    roots = np.concatenate([plant.poles, plant.zeros, controller.poles, zeros, poles])
    grid = checked_grid(plant, light, n_dense, 120, roots=roots, extra=near_the_circle(roots, plant.dt_s))
    assumed_linear = plant.own_grid is not None and between_own_points == "linear"
    own_points = with_own_grid(plant, grid)
    seen = with_straight_between(plant) if assumed_linear else plant
    grid = np.union1d(grid, own_points) if assumed_linear else own_points

    worst = worst_case(partial(controller.response, with_delay=False), seen, specification, grid)
    integrators, unstable = loop_integrators(controller, plant)
    # On a plant's own frequencies the count is that of its data; what lies between them is the proof's.
    counted = own_points if assumed_linear else worst.omega_rad_s
    count = nyquist_count(
        lambda omega: controller.response(omega) * seen.at(omega).centre,
        counted,
        integrators=integrators,
        unstable_poles=unstable,
        refinable=plant.own_grid is None,
    )
    nominal, margins, bandwidth = loop_margins(controller, seen, worst)
    at = int(np.argmin(worst.values["distance"]))
    peaks: dict[str, tuple[float, float | None]] = {name: worst.peak(name) for name in worst.names}
    weighted = max(peak for peak, _ in peaks.values())
    stable = bool(radius < 1.0)
    peak_sensitivity = 1.0 / margins.modulus if margins.modulus > 0 else float("inf")
    if not stable:  # |1 + K G| says nothing of a loop that is not stable
        nominal = margins = Margins(*[np.nan] * len(fields(Margins)))
        peaks, bandwidth = dict.fromkeys(peaks, (np.nan, None)), np.nan
    if stable and count.matches and margins.modulus > 0:
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
    verdict = PlantVerdict(
        plant=plant.name,
        stable=stable,
        pole_radius=radius,
        closed_loop_modes=tuple(m for m in loop_modes if m.zeta < 1.0),
        mode_changes=mode_changes(controller, plant),
        nyquist=count,
        nominal_margins=nominal,
        worst_margins=margins,
        worst_margin_omega_rad_s=float(worst.omega_rad_s[at]),
        worst_weighted=weighted if margins.modulus > 0 else float("inf"),
        worst_peak_sensitivity=peak_sensitivity,
        bandwidth_rad_s=bandwidth,
        frequencies=int(worst.omega_rad_s.size),
        own_grid_rad_s=None
        if plant.own_grid is None
        else (float(plant.own_grid[0]), float(plant.own_grid[-1])),
        assumed_linear=assumed_linear,
        stated=plant.uncertainty is not None,
        own_performance=plant.performance is not None,
        all_frequencies=proof,
    )
    found = Findings(
        plant.name,
        peaks,
        proof.bounds if proof.possible and stable else None,
        (margins.modulus, float(worst.omega_rad_s[at]) if stable else None),
        margins.delay_s,
        loop_modes,
        controller,
    )
    items = [requirement.check(found) for requirement in specification.requirements(plant)]
    if plant.uncertainty is None and plant.damped.uncertainty is None:
        items = [replace(item, about="nominal loop") for item in items]
    return verdict, items
