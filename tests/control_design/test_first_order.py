"""First-order expansions with remainder hold at every sampled frequency of their intervals."""

import control
import numpy as np
import pytest
from hypothesis import given, strategies as st

from control_design import LoopFunction, PlantChannel, RationalWeight, Specification, UncertainPlant
from control_design.plants.first_order import FirstOrder, FrequencyIntervals, RationalResponse
from control_design.plants.plant_set import frequency_response
from control_design.plants.set_expansion import SetExpansion, own_grid_set, posterior_expansion
from ident import Poles
from ident.uncertainty import ResponsePosterior
from validation.example_plants import LinkUncertainty

from .plants import hub_arm, random_stable

_DT = 0.005
_INSIDE = np.linspace(-1.0, 1.0, 401)


def _intervals(rng: np.random.Generator, count: int = 25) -> FrequencyIntervals:
    centre = np.sort(10 ** rng.uniform(-1, np.log10(0.9 * np.pi / _DT), count))
    return FrequencyIntervals(centre, centre * 10 ** rng.uniform(-4, -1, count), _DT)


def _excess(expansion: FirstOrder, truth: np.ndarray, offsets: np.ndarray) -> float:
    """Largest part of the remainder that is used, from truth (S, F) or (S, F, Q) at offsets (S, F)."""
    extra = (1,) * (truth.ndim - 2)
    x = offsets.reshape(*offsets.shape, *extra)
    rest = np.abs(truth - expansion.value - expansion.slope * x)
    if truth.ndim == 3:
        rest = np.linalg.norm(rest, axis=2)
    # Rounding: the values themselves carry 1e-13 of their size.
    size = np.abs(truth) if truth.ndim == 2 else np.linalg.norm(truth, axis=2)
    return float(np.max(rest / (expansion.remainder + 1e-12 * size + 1e-300)))


def _frequencies(intervals: FrequencyIntervals) -> tuple[np.ndarray, np.ndarray]:
    offsets = _INSIDE[:, None] * intervals.half_width
    return intervals.centre + offsets, offsets


@given(
    radius=st.floats(0.0, 1.2).filter(lambda r: abs(r - 1) > 1e-4),
    angle=st.floats(0.0, np.pi),
    theta=st.floats(0.0, np.pi),
    width=st.floats(1e-4, 0.5),
)
def test_factors_hold_over_their_interval_and_the_distance_is_the_smallest(radius, angle, theta, width):
    root = radius * np.exp(1j * angle)
    intervals = FrequencyIntervals(np.array([theta / _DT]), np.array([width / _DT]), _DT)
    omega, offsets = _frequencies(intervals)
    z = np.exp(1j * omega * _DT)
    assert _excess(intervals.zero(root - 1), z - root, offsets) <= 1
    nearest = intervals.distance_to(complex(root - 1))[0]
    sampled = np.min(np.abs(z - root))
    # 401 samples miss the nearest point by half a step, width/400, at most.
    assert nearest <= sampled * (1 + 1e-9) + 1e-15
    assert nearest >= sampled - width / 390
    assert _excess(intervals.pole(root - 1), 1 / (z - root), offsets) <= 1


def test_remainder_of_a_product_is_of_second_order_and_close_to_the_truth():
    root, intervals = 0.98 * np.exp(0.1j), None
    used = []
    for width in (0.1, 0.05, 0.025):
        intervals = FrequencyIntervals(np.array([20.0]), np.array([width]), _DT)
        omega, offsets = _frequencies(intervals)
        z = np.exp(1j * omega * _DT)
        product = intervals.pole(root - 1).times(intervals.zero(-0.5))
        truth = (z - 0.5) / (z - root)
        assert _excess(product, truth, offsets) <= 1
        assert _excess(product, truth, offsets) >= 0.3
        used.append(product.remainder[0])
    # halving the width quarters the bound
    np.testing.assert_allclose(np.array(used[1:]) / used[:-1], 0.25, rtol=0.05)


@pytest.mark.parametrize("seed", range(6))
def test_state_spaces_by_zeros_and_poles_are_python_controls_response(seed):
    rng = np.random.default_rng(seed)
    system = random_stable(rng, 5, _DT)
    if seed % 2:
        system = control.ss(system.A, system.B, system.C, [[0.3]], _DT)
    form = RationalResponse.from_state_space(system, 0)
    omega = np.geomspace(0.01, np.pi / _DT, 200)
    expected = control.frequency_response(system, omega).complex.reshape(-1)
    np.testing.assert_allclose(form.at(omega), expected, rtol=1e-9, atol=1e-12 * np.max(np.abs(expected)))
    intervals = _intervals(rng)
    at, offsets = _frequencies(intervals)
    truth = np.array([frequency_response(system, row) for row in at])
    assert _excess(form.expand(intervals), truth, offsets) <= 1


def test_relative_degree_and_integrators_are_exact():
    # Two delays behind a lag: relative degree 3, no finite zeros.
    system = control.ss(control.tf([0.5], [1, -0.7, 0, 0], _DT))
    form = RationalResponse.from_state_space(system, 0)
    assert form.zeros_minus_1.size == 0
    omega = np.geomspace(0.1, np.pi / _DT, 50)
    np.testing.assert_allclose(
        form.at(omega), 0.5 / ((np.exp(1j * omega * _DT) - 0.7) * np.exp(2j * omega * _DT))
    )
    for count in (1, 2):
        arm = hub_arm(integrators=count)
        form = RationalResponse.from_state_space(arm, count)
        assert form.integrators == count
        np.testing.assert_allclose(form.at(omega), frequency_response(arm, omega), rtol=1e-8)
        down_to_zero = FrequencyIntervals(np.array([0.005]), np.array([0.005]), _DT)
        cleared = form.expand(down_to_zero, count)
        at = np.linspace(1e-4, 0.01, 100)
        factor = (2j * np.sin(at * _DT / 2) * np.exp(0.5j * at * _DT)) ** count
        truth = frequency_response(arm, at) * factor
        assert _excess(cleared, truth[:, None], (at - 0.005)[:, None]) <= 1


def test_cleared_integrators_are_powers_of_z_minus_one():
    intervals = _intervals(np.random.default_rng(1))
    omega, offsets = _frequencies(intervals)
    for count in (-2, -1, 0, 1, 2):
        truth = (np.exp(1j * omega * _DT) - 1) ** count
        assert _excess(intervals.cleared(count), truth, offsets) <= 1


@pytest.mark.parametrize("integrators", [0, 1])
def test_weights_as_rational_functions_are_those_of_the_specification(integrators):
    omega = np.geomspace(1e-3, np.pi / _DT, 300)
    specifications = [
        Specification(bandwidth_rad_s=3.0, effort_limit=5.0),
        Specification(bandwidth_rad_s=3.0, integrator=True, effort_limit=5.0, effort_rolloff_rad_s=40.0),
        Specification(
            sensitivity_weight=RationalWeight(numerator=(1 / 1.7, 1.6), denominator=(1.0, 0.0016)),
            effort_weight=RationalWeight(numerator=(1 / 40, 1.0), denominator=(6 / 1500, 6.0)),
        ),
        # a zero of the weight at 2/dt, which s = (2/dt) (z - 1)/(z + 1) sends to infinity
        Specification(sensitivity_weight=RationalWeight(numerator=(-0.5, 200.0), denominator=(1.0, 0.1))),
    ]
    plant = UncertainPlant(control.ss(1.0 if integrators else 0.5, 1, 1, 0, _DT), name="any")
    for specification in specifications:
        weight = specification.tracking_weight(plant)
        tracking = RationalResponse.from_weight(weight, _DT)
        total = np.maximum(np.abs(tracking.at(omega)), specification.modulus_margin)
        np.testing.assert_allclose(
            total, specification.magnitude(plant, omega, LoopFunction.SENSITIVITY), rtol=1e-9
        )
        limit = specification.limit_weight()
        if limit is not None:
            effort = RationalResponse.from_weight(limit, _DT)
            wanted = specification.magnitude(plant, omega, LoopFunction.EFFORT)
            np.testing.assert_allclose(np.abs(effort.at(omega)), wanted, rtol=1e-9)
    assert Specification().tracking_weight() is None
    assert Specification().limit_weight() is None


def _posterior(rng: np.random.Generator, integrators: int = 1) -> ResponsePosterior:
    poles = Poles(np.array([0.9, 0.0]), np.array([0.99 * np.exp(0.08j), 0.99 * np.exp(0.08j)]))
    size = poles.order + 1 + 12
    return ResponsePosterior(
        poles=poles, mean=rng.standard_normal(size), covariance_factor=0.1 * rng.standard_normal((size, 8)),
        dt_s=_DT, fir_length=12, has_feedthrough=True, integrators=integrators, input_delay_samples=2,
    )  # fmt: skip


@pytest.mark.parametrize("integrators", [0, 2])
def test_posterior_expansion_holds_and_has_its_covariance(integrators):
    rng = np.random.default_rng(4)
    posterior = _posterior(rng, integrators)
    intervals = _intervals(rng)
    centre, generators = posterior_expansion(posterior, intervals, 0)
    expansion = SetExpansion(centre, (generators.scaled(2.0),))
    record = posterior.at(intervals.centre)
    np.testing.assert_allclose(expansion.centre.value, record.centre, rtol=1e-10)
    # covariance (F, 2, 2) of size |G|^2; entries near zero carry the rounding of the largest
    scale = 4 * np.trace(record.covariance, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(expansion.gram() / scale, 4 * record.covariance / scale, atol=1e-10)
    omega, offsets = _frequencies(intervals)
    rows = np.array([posterior.frequency_rows(row) for row in omega])
    assert _excess(expansion.centre, rows @ posterior.mean, offsets) <= 1
    assert _excess(expansion.groups[0], 2.0 * rows @ posterior.covariance_factor, offsets) <= 1


@pytest.mark.parametrize("scenario", ["A", "C", pytest.param("B", marks=pytest.mark.long)])
def test_link_generators_have_the_links_covariance_and_hold(scenario):
    rng = np.random.default_rng(5)
    intervals = _intervals(rng)
    link = LinkUncertainty(scenario)
    centre, generators = link.first_order(intervals, 0)
    record = link.at(intervals.centre, 0.95)
    rows = np.stack([generators.value.real, generators.value.imag], axis=1)
    scale = np.trace(record.covariance, axis1=1, axis2=2)[:, None, None]
    # the differences of `at` carry 1e-11 / 1e-5 of rounding
    np.testing.assert_allclose(rows @ np.swapaxes(rows, 1, 2) / scale, record.covariance / scale, atol=2e-8)
    omega, offsets = _frequencies(intervals)
    none = np.zeros(intervals.centre.size)
    samples = [link.first_order(FrequencyIntervals(row, none, _DT), 0) for row in omega]
    assert _excess(centre, np.array([c.value for c, _ in samples]), offsets) <= 1
    assert _excess(generators, np.array([g.value for _, g in samples]), offsets) <= 1


def test_own_grid_with_the_straight_line_assumption_is_the_sum_of_neighbours():
    own = np.linspace(5.0, 50.0, 10)
    covariance = np.array([[[1.0, 0.2], [0.2, 0.5]]]) * (own[:, None, None] / 50) ** 2
    arm = hub_arm()
    values = {"omega_rad_s": own, "centre": frequency_response(arm, own), "covariance": covariance}
    record = type("Record", (), {**values, "level": 0.95})()
    channel = PlantChannel(arm, record)
    nominal = RationalResponse.from_state_space(arm, 1)
    left, right = channel.at(own[2:3]), channel.at(own[3:4])
    for share in (0.0, 0.3, 1.0):
        omega = own[2:3] + share * (own[3] - own[2])
        middle = 0.5 * (own[2:3] + own[3:4])
        intervals = FrequencyIntervals(middle, 0.5 * (own[3:4] - own[2:3]), _DT)
        expansion = own_grid_set(channel, nominal, intervals, 0)
        x = omega - middle
        centre = expansion.centre.value + expansion.centre.slope * x
        np.testing.assert_allclose(centre, (1 - share) * left.centre + share * right.centre)
        for angle in (0.1, 1.3, 2.9):
            u = np.exp(1j * angle)
            support = sum(
                np.linalg.norm(np.real(np.conj(u) * (group.value + group.slope * x[:, None])))
                for group in expansion.groups
            )
            f = np.linspace(0, 2 * np.pi, 20001)
            reach = [
                np.max(np.real(np.conj(u) * (e.points(np.cos(f), np.sin(f)) - e.centre)))
                for e in (left, right)
            ]
            # 20001 boundary points miss the extreme by (pi/20000)^2/2
            assert support == pytest.approx((1 - share) * reach[0] + share * reach[1], rel=1e-6)
