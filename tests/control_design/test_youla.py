"""Youla bracket: interpolation theory gives the answer of small problems exactly."""

import control
import numpy as np
import pytest

from control_design import RationalWeight, Specification, UncertainPlant, YoulaOptions, youla_bracket
from control_design.convex.youla_basis import coprime_factors
from control_design.plants.stated_uncertainty import StatedDiscs
from validation.example_plants import flexible_link, flexible_link_specification

from .plants import RelativeDisc, hub_arm

_DT_S = 0.1
_SMALL = YoulaOptions(real_poles=16, grid_points=120, dense_points=2000, omega_min_rad_s=1e-3)
_WEIGHT = RationalWeight(numerator=(0.4, 0.8), denominator=(1.0, 0.02))


def _spec(**changes):
    return Specification(
        **{"sensitivity_weight": _WEIGHT, "modulus_margin": 0.01, "computational_delay_samples": 0, **changes}
    )


def _plant(numerator, denominator, **more):
    return UncertainPlant(control.ss(control.tf(numerator, denominator, _DT_S)), name="small", **more)


@pytest.mark.parametrize("integrators", [1, 2])
def test_coprime_factors_are_stable_and_satisfy_bezout(integrators):
    plant = hub_arm(integrators=integrators)
    f = coprime_factors(plant)
    z = np.exp(1j * np.linspace(0.01, 3.1, 40))
    n, m, x, y = (np.array([system(value) for value in z]) for system in (f.N, f.M, f.X, f.Y))
    np.testing.assert_allclose(n * x + m * y, 1.0, atol=1e-8)
    np.testing.assert_allclose(n / m, [plant(value) for value in z], rtol=1e-6)
    for system in (f.N, f.X):
        assert np.max(np.abs(system.poles())) < 1


def test_one_unstable_zero_gives_the_weight_at_the_zero():
    # S = 1 at the zero, nothing else binds (the plant is biproper): the optimum is |W1(zero)|.
    zero = 1.2
    s = 2 / _DT_S * (zero - 1) / (zero + 1)
    truth = abs(_WEIGHT.at(np.array([s + 0j]))[0])
    bracket = youla_bracket([_plant([1.0, -zero], [1.0, -0.5])] * 2, _spec(), _SMALL)
    assert len(bracket.plants) == 2
    # The optimal S is reached by a Q of order two in the limit; 0.3 % is left to the basis.
    assert truth * (1 - 1e-4) <= bracket.inscribed <= truth * 1.003
    assert bracket.enclosing == pytest.approx(bracket.inscribed, rel=1e-3)  # no uncertainty: all agree
    assert bracket.ellipse == pytest.approx(bracket.inscribed, rel=1e-3)


def test_zero_and_sample_of_delay_give_the_pick_value():
    # S = 1 at z0 and at infinity. gamma is feasible if the 2 x 2 Pick matrix in 1/z is positive
    # semi-definite.
    zero = 1.1
    s = 2 / _DT_S * np.array([(zero - 1) / (zero + 1), 1.0])
    plant = _plant([1.0, -zero], np.poly([0.5, 0.2]))
    spec = _spec(sensitivity_weight=RationalWeight(numerator=(0.3, 0.5), denominator=(1.0, 0.02)))
    w = np.real(spec.sensitivity_weight.at(s + 0j))
    low, high = float(np.max(w)), 10.0
    for _ in range(60):
        mid = 0.5 * (low + high)
        off = mid**2 - w[0] * w[1]
        pick = np.array([[(mid**2 - w[0] ** 2) / (1 - zero**-2), off], [off, mid**2 - w[1] ** 2]])
        low, high = (low, mid) if np.min(np.linalg.eigvalsh(pick)) >= 0 else (mid, high)
    assert high > 1.01 * np.max(w)  # both points matter
    bracket = youla_bracket(plant, spec, _SMALL)
    assert high * (1 - 1e-4) <= bracket.inscribed <= high * 1.003


def test_effort_to_stabilise_an_unstable_plant():
    # min max|K S| for b/(z - a), a > 1, is (a^2 - 1)/b: constant gain that mirrors the pole, K S is then
    # all-pass.
    a, b = 1.3, 0.7
    spec = Specification(effort_limit=1.0, modulus_margin=0.01, computational_delay_samples=0)
    bracket = youla_bracket(_plant([b], [1.0, -a]), spec, _SMALL)
    assert bracket.inscribed == pytest.approx((a**2 - 1) / b, rel=2e-3)
    assert bracket.ellipse == pytest.approx((a**2 - 1) / b, rel=2e-3)


def test_gain_margin_bound_of_relative_discs():
    # Discs of relative radius r around an unstable b/(z - a): stabilisable only for r |T| < 1, and min max|T|
    # = a.
    a = 1.25
    for radius, possible in ((0.7 / a, True), (1.1 / a, False)):
        system = control.ss(control.tf([1.0], [1.0, -a], _DT_S))
        quantile = np.sqrt(-2 * np.log(0.05))
        plant = UncertainPlant(system, name="discs", uncertainty=RelativeDisc(system, radius / quantile, 1e9))
        spec = Specification(effort_limit=1e3, modulus_margin=0.01, computational_delay_samples=0)
        bracket = youla_bracket(plant, spec, _SMALL)
        assert np.isfinite(bracket.enclosing) == possible, radius


def test_integrating_plant_with_delay_is_ordered_and_finite():
    plant = hub_arm()
    arm = UncertainPlant(plant, name="hub", uncertainty=RelativeDisc(plant, 0.02, 30.0))
    spec = Specification(bandwidth_rad_s=3.0, effort_limit=20.0, modulus_margin=0.4)
    bracket = youla_bracket(arm, spec, _SMALL.model_copy(update={"real_poles": 10, "grid_points": 80}))
    assert bracket.inscribed <= bracket.ellipse <= bracket.enclosing < 2.0
    # Isotropic discs: the three regions are the same.
    assert bracket.enclosing == pytest.approx(bracket.inscribed, rel=2e-3)


@pytest.mark.parametrize(
    ("numerator", "denominator", "dt_s", "asked", "reached"),
    [
        pytest.param([8.0], [1, 1, -30], 0.01, (6.0, 0.4), 0.5756, id="pendulum"),
        pytest.param([-2000.0], [1, 60, -900, -54000], 0.002, (20.0, 0.3), 0.4889, id="levitation"),
        pytest.param(
            [8100.0], np.polymul([1, 0, -9], [1, 1.2, 900]), 0.01, (2.0, 0.2), 0.2713, id="resonance"
        ),
    ],
)
def test_the_bound_of_an_unstable_plant_is_at_most_what_a_low_order_reaches(
    numerator, denominator, dt_s, asked, reached
):
    """reached: gamma of a synthesis, orders 3 to 6. Zeros of sampling at z = -1 and directions of Q that the
    rows hardly see had put the bound 2 to 16 % above it."""
    system = control.c2d(control.ss(control.tf(numerator, denominator)), dt_s, "zoh")
    discs = StatedDiscs(
        system, RationalWeight(numerator=(0.1 if reached > 0.5 else 0.05,), denominator=(1.0,))
    )
    spec = Specification(bandwidth_rad_s=asked[0], modulus_margin=asked[1])
    options = YoulaOptions(grid_points=120, dense_points=2000)
    found = youla_bracket(UncertainPlant(system, name="unstable", uncertainty=discs), spec, options)
    assert 0.9 * reached < found.floor <= 1.001 * reached


@pytest.mark.slow
def test_link_bracket_encloses_published_values_and_our_order_5():
    bracket = youla_bracket(flexible_link("B"), flexible_link_specification(5), YoulaOptions())
    # Published with a smaller basis: 0.916 / 1.065 / 1.205. A larger basis can only be lower.
    assert 0.985 * 0.916 < bracket.inscribed < 0.916
    assert 0.985 * 1.065 < bracket.ellipse < 1.065
    assert 0.985 * 1.205 < bracket.enclosing < 1.205
    assert 1.02 < 1.0851 / bracket.ellipse < 1.035


def test_damping_weight_raises_the_bracket():
    plant = flexible_link("A")
    plain = flexible_link_specification(5)
    options = YoulaOptions(real_poles=16, pairs_per_mode=5, grid_points=100, dense_points=2000)
    damped = plain.model_copy(update={"mode_peak_ratio": 0.3, "mode_band_rad_s": (10.0, 22.0)})
    without, with_damping = youla_bracket(plant, plain, options), youla_bracket(plant, damped, options)
    assert with_damping.inscribed > 1.02 * without.inscribed  # by the centre alone
    assert with_damping.inscribed <= with_damping.ellipse <= with_damping.enclosing
