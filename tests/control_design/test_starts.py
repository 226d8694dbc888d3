"""Shaped starts, descent and cancelling sections on small plants built with python-control."""

import control
import numpy as np
import pytest

from control_design import LoopFunction, Specification, SynthesisOptions, UncertainPlant, certify, synthesise
from control_design.controllers.biquads import Cascade
from control_design.controllers.parts import NotchPart, PidPart
from control_design.plants.ellipses import distance_to_minus_one, largest_disturbance_gain
from control_design.specification.structure import LowPass, Notch
from control_design.synthesis.descent import MinimaxDescent
from control_design.synthesis.problem import Problem
from control_design.synthesis.rows import LoopRows
from control_design.synthesis.starts import StartMaker, with_cancelling_section
from validation.example_plants import flexible_link, flexible_link_specification

from .plants import RelativeDisc

_DT_S = 0.01


def reaction_arm() -> control.StateSpace:
    """Torque to acceleration with a direct term and modes at 5.8 and 12.7 Hz, damping 0.005."""
    total = control.tf([0.4], [1])
    for hertz, share in ((5.8, 0.012), (12.7, 0.02)):
        w = 2 * np.pi * hertz
        total = total + control.tf([share, 0, 0], [1, 2 * 0.005 * w, w**2])
    return control.c2d(control.ss(total), _DT_S, "tustin")


def _plant(relative_std: float = 0.02) -> UncertainPlant:
    return UncertainPlant(
        reaction_arm(), name="reaction arm", uncertainty=RelativeDisc(reaction_arm(), relative_std, 200.0)
    )


def _damping(order: int, ratio: float = 0.3) -> Specification:
    return Specification(
        controller_order=order, modulus_margin=0.4, effort_limit=2.0, effort_rolloff_rad_s=90.0,
        mode_peak_ratio=ratio, mode_band_rad_s=(25.0, 110.0),
    )  # fmt: skip


def _search(specification: Specification) -> tuple[Problem, Cascade, MinimaxDescent]:
    problem = Problem((_plant(),), specification, SynthesisOptions())
    cascade = problem.cascade()
    descent = MinimaxDescent(
        cascade,
        problem.rows(),
        lambda x: problem.stable(cascade, x),
        controller_damping=specification.controller_damping,
    )
    return problem, cascade, descent


def _starts(problem: Problem, cascade: Cascade, descent: MinimaxDescent, seed: int) -> StartMaker:
    return StartMaker(
        cascade,
        problem.lean(),
        0,
        descent.value,
        np.random.default_rng(seed),
        controller_damping=problem.spec.controller_damping,
        keeps_sign=False,
    )


def test_shaped_starts_damp_already_where_random_ones_do_not():
    problem, cascade, descent = _search(_damping(4))
    maker = _starts(problem, cascade, descent, 1)
    shaped = maker.shaped(100, 3)
    assert [score for _, score in shaped] == sorted(score for _, score in shaped)
    # Peak over allowed peak is 1/0.3 without control.
    assert shaped[0][1] < 0.5 / 0.3
    assert descent.value(maker.low_gain()) > 1.0 / 0.3


def test_descent_never_loses_and_stays_stable():
    problem, cascade, descent = _search(_damping(4))
    for start, score in _starts(problem, cascade, descent, 2).shaped(60, 3):
        end, gamma, _ = descent.run(start, 25)
        assert gamma <= score
        assert problem.stable(cascade, end)


def test_descent_sees_the_exact_worst_case_of_the_ellipses():
    """40 boundary points and a parabola against the exact geometry: far below a per cent."""
    problem, cascade, descent = _search(_damping(4))
    (parameters, score), *_ = _starts(problem, cascade, descent, 3).shaped(60, 1)
    data = problem.lean()[0]
    k = cascade.response(parameters, data.ellipses.omega_rad_s)
    distance = distance_to_minus_one(k * data.delay, data.ellipses)
    exact = np.maximum(
        data.largest(LoopFunction.SENSITIVITY) / distance,
        np.maximum(
            data.largest(LoopFunction.EFFORT) * np.abs(k) / distance,
            data.largest(LoopFunction.DISTURBANCE) * largest_disturbance_gain(k * data.delay, data.ellipses),
        ),
    )
    assert score == pytest.approx(np.max(exact), rel=1e-3)


@pytest.mark.parametrize(
    "fields",
    [
        {"controller_order": 5, "integrator": False},
        {"controller_order": 5, "integrator": True},
        {
            "integrator": True,
            "structure": "pid",
            "notches": (Notch(), Notch(width_hz=0.3)),
            "low_pass": LowPass(),
        },
    ],
)
def test_slope_and_curvature_of_the_descent_agree_with_finite_differences(fields):
    """Long ellipses, so that the moving worst member counts; away from the kinks where it jumps."""
    problem = Problem((flexible_link("B"),), flexible_link_specification(5), SynthesisOptions())
    specification = problem.spec.model_copy(update=fields | {"mode_peak_ratio": 0.5})
    problem = Problem(problem.plants, specification, SynthesisOptions())
    cascade = problem.cascade()
    boundary = LoopRows(cascade, problem.rows())
    rng = np.random.default_rng(0)
    x = 0.3 * rng.standard_normal(cascade.parameters)
    multipliers = rng.random(boundary.rows(x).size)
    bends = []
    for h in (2e-6, 1e-6):
        ends = [[multipliers @ boundary.slopes(x + sign * h * e) for sign in (1, -1)] for e in np.eye(x.size)]
        bends.append(np.stack([(up - down) / (2 * h) for up, down in ends]))
    values = [[multipliers @ boundary.rows(x + sign * 1e-6 * e) for sign in (1, -1)] for e in np.eye(x.size)]
    slope = multipliers @ boundary.slopes(x)
    np.testing.assert_allclose(-np.diff(values)[:, 0] / 2e-6, slope, atol=1e-5 * np.abs(slope).max())
    exact = boundary.curvature(x, multipliers)
    np.testing.assert_allclose(exact, exact.T, atol=1e-9 * np.abs(exact).max())
    # Error of the difference itself: truncation and rounding, seen in the two steps.
    doubt = 4 * np.abs(bends[0] - bends[1]).max() + 1e-5 * np.abs(exact).max()
    np.testing.assert_allclose(bends[1], exact, atol=doubt)


def test_a_cancelling_section_does_not_change_the_controller():
    rng = np.random.default_rng(5)
    notch = NotchPart(None, None, None, None, 0.2)
    lag = PidPart("pd", None, None, None, None, 0.2)
    for kind, first in (("second_order", "first_order"), (notch, lag)):
        lower = Cascade((first, kind), _DT_S, 40.0)
        higher = Cascade((*lower.sections, kind), _DT_S, 40.0)
        x = rng.normal(size=lower.parameters)
        longer = with_cancelling_section(lower, x, higher, rng)
        omega = np.geomspace(0.1, 300, 50)
        np.testing.assert_allclose(higher.response(longer, omega), lower.response(x, omega), rtol=1e-12)
    with pytest.raises(ValueError, match="section of order two more"):
        with_cancelling_section(lower, x, lower, rng)


@pytest.mark.long
def test_active_damping_agrees_between_seeds_and_gains_with_order():
    """Orders 2 and 4 from two seeds with a short search; both beat doing nothing (1/0.3) by far."""
    gammas: dict[int, list[float]] = {2: [], 4: []}
    quick = SynthesisOptions(starts=3, exchange_rounds=0, dense_points=800, grid_points=60, mode_points=40)
    for seed in (1, 2):
        for order, values in gammas.items():
            result = synthesise([_plant()], _damping(order), quick, rng=np.random.default_rng(seed))
            values.append(result.gamma)
        assert gammas[4][-1] <= gammas[2][-1] * (1 + 1e-9)
    for values in gammas.values():
        assert max(values) < 1.0
        # The full search agrees better; a short one left up to 2.7 % between seeds.
        assert max(values) / min(values) < 1.05
    certificate = certify(result.controller, [_plant()], _damping(4))
    assert certificate.certified
    # By python-control: the nominal peak is pressed to 0.3 of the open loop's, times gamma.
    plant, controller = reaction_arm(), result.controller.to_control(include_delay=True)
    omega = 2 * np.pi * np.linspace(4.0, 17.0, 4000)
    closed, opened = (
        np.max(np.abs(control.frequency_response(system, omega).complex))
        for system in (control.feedback(plant, controller), plant)
    )
    assert closed <= 0.3 * result.gamma * opened * 1.01
