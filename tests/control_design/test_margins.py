"""Margins whose limit is at zero frequency, at Nyquist, touched or narrow; and that units do not matter."""

from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from benchmarks.controllers_by_hand import checked_case, drawn_case
from control_design import Controller, Specification, UncertainPlant, certify
from control_design.plants.stated_uncertainty import StatedDiscs
from control_design.plants.weights import RationalWeight
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from validation.example_plants import ResponseRecord

_DT = 0.01


def _system(zeros: Any, poles: Any, gain: float, dt_s: float = _DT) -> control.StateSpace:
    return control.ss(control.zpk(zeros, poles, gain, dt=dt_s))


def _response(system: control.StateSpace, omega_rad_s: Any) -> Any:
    """At all frequencies at once: python-control takes seconds for these many."""
    z = np.exp(1j * omega_rad_s * system.dt)[:, None, None]
    states = np.linalg.solve(z * np.eye(system.nstates) - system.A, system.B + 0j)
    return (system.C @ states + system.D)[:, 0, 0]


def _certified(system: control.StateSpace, gain: float, *, delay: int = 0, relative: float = 0.0) -> Any:
    discs = RationalWeight(numerator=(relative or 1.0,), denominator=(1.0,))
    plant = UncertainPlant(system, name="plant", uncertainty=StatedDiscs(system, discs) if relative else None)
    controller = Controller.proportional(gain, system.dt, computational_delay_samples=delay)
    spec = Specification(modulus_margin=0.1, computational_delay_samples=delay)
    return certify(controller, [plant], spec, n_dense=1500)


@pytest.mark.parametrize(
    ("system", "gain", "delay", "down", "up"),
    [
        pytest.param(_system([], [1.05], 0.1), 1.0, 0, 0.5, 20.5, id="unstable pole"),
        pytest.param(_system([], [0.5], 0.5), -0.2, 1, 0.0, 5.0, id="negative loop"),
        pytest.param(_system([], [1 + 2e-9], 1e-3), 2.0, 0, 1e-6, 1e3, id="slow unstable pole"),
        pytest.param(_system([0.8], [1.2, 0.5], 0.6), 1.0, 0, 0.1 / 0.12, np.inf, id="with a zero"),
        pytest.param(_system([1.5], [0.5], 0.2), 0.5, 0, 0.0, 10.0, id="non-minimum phase"),
        pytest.param(_system([], [-0.5], 1.0), 0.25, 0, 0.0, 2.0, id="Nyquist"),
    ],
)
def test_gain_limits_at_the_ends_are_those_of_the_closed_loop_poles(system, gain, delay, down, up):
    chain = control.ss(control.tf([1], [1] + [0] * delay, _DT)) if delay else control.ss([], [], [], 1, _DT)
    margins = _certified(system, gain, delay=delay).plants[0].nominal_margins

    def radius(factor: float) -> float:
        return float(np.max(np.abs(control.feedback(gain * factor * system * chain, 1).poles())))

    for found, other in ((margins.gain_down, 0.999), (margins.gain_up, 1.001)):
        if 0 < found < np.inf:
            assert radius(found / other) < 1
            assert radius(found * other) > 1 - 1e-12
    assert margins.gain_down == pytest.approx(down, rel=1e-6)
    if np.isfinite(up):
        assert margins.gain_up == pytest.approx(up, rel=1e-6)


def test_over_discs_the_limit_at_zero_frequency_is_that_of_the_nearest_member():
    """L(0) = -2 (1 +- .1): the gain may fall to 1/(2 .9); at Nyquist -.1/2.05 (1 +- .1)."""
    margins = _certified(_system([], [1.05], 0.1), 1.0, relative=0.1).plants[0].worst_margins
    assert margins.gain_down == pytest.approx(1 / 1.8, rel=1e-5)
    assert margins.gain_down >= 1 / 1.8
    assert margins.gain_up == pytest.approx(20.5 / 1.1, rel=1e-5)
    assert margins.gain_up <= 20.5 / 1.1


def test_a_touch_of_the_unit_circle_is_a_crossing():
    """|L| has a peak of exactly 1: no change of sign, and a phase margin all the same."""
    system = _system([], [0.9 * np.exp(0.5j), 0.9 * np.exp(-0.5j)], 1.0)
    omega = np.linspace(30, 60, 400_001)
    response = _response(system, omega)
    value = response[np.argmax(np.abs(response))]
    peak = abs(value)
    margins = _certified(system, 1 / peak * (1 + 1e-12)).plants[0].nominal_margins
    turn = abs(np.angle(-value))
    assert margins.phase_rad == pytest.approx(turn, rel=1e-3)


def test_a_narrow_resonance_of_the_controller_is_seen_between_measured_points():
    """|z| = 1 - 2e-7 between two frequencies of a measured response: not one of them shows it."""
    own = np.linspace(2.0, np.pi / _DT, 60)
    system = _system([], [0.9], 0.05)
    response = np.ravel(control.frequency_response(system, own).complex)
    measured = ResponseRecord(own, response, 1e-8 * np.ones((60, 1, 1)) * np.eye(2), 0.95)
    plant = UncertainPlant(system, name="measured", uncertainty=measured)
    pole = (1 - 2e-7) * np.exp(1j * _DT * 0.5 * (own[20] + own[21]))
    spec = Specification(modulus_margin=0.3, computational_delay_samples=0)
    peaks = []
    for sign in (1.0, -1.0):
        k = _system([0.5, 0.5], [pole, np.conj(pole)], sign * 1e-3)
        controller = Controller(k.A, k.B, k.C, k.D, _DT, computational_delay_samples=0)
        on_points = certify(controller, [plant], spec, between_own_points="nothing").plants[0]
        between = certify(controller, [plant], spec).plants[0]
        assert on_points.worst_peak_sensitivity < 1.2
        assert between.assumed_linear
        dense = own[20] + (own[21] - own[20]) * np.linspace(0, 1, 200_001)
        loop = _response(k, dense) * _response(system, dense)
        peaks.append((between.worst_peak_sensitivity, float(np.max(1 / np.abs(1 + loop)))))
    assert all(found >= true * (1 - 1e-3) for found, true in peaks)
    assert max(found for found, _ in peaks) > 3


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000))
def test_no_number_of_a_certificate_promises_more_than_eigenvalues_and_members_keep(seed):
    rng = np.random.default_rng(seed)
    case = drawn_case(rng)
    false, *_ = checked_case(case, rng)
    assert not false, case


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(
    st.sampled_from([1e-6, 1e-3, 1e3, 1e6]),
    st.sampled_from([1e-6, 1e-3, 1e3, 1e6]),
    st.sampled_from([1e-6, 1.0, 1e6]),
)
def test_units_of_time_input_and_output_do_not_matter(time, input_unit, output_unit):
    def certificate(t: float, u: float, y: float) -> Any:
        base = _system([0.2], [0.995, 0.97 * np.exp(0.3j), 0.97 * np.exp(-0.3j)], 0.002, _DT * t)
        system = control.ss(base.A, base.B / u, base.C * y, 0, _DT * t)
        discs = RationalWeight(numerator=(0.1,), denominator=(1.0,))
        plant = UncertainPlant(system, name="plant", uncertainty=StatedDiscs(system, discs))
        k = _system([0.99], [1.0], 1.2 * u / y, _DT * t)
        spec = Specification(
            modulus_margin=0.3, bandwidth_rad_s=0.2 / t, effort_limit=5.0 * u / y, integrator=True,
            delay_margin_s=0.01 * t, computational_delay_samples=1,
        )  # fmt: skip
        controller = Controller(k.A, k.B, k.C, k.D, _DT * t, computational_delay_samples=1)
        return certify(controller, [plant], spec, n_dense=1000)

    one, other = certificate(1.0, 1.0, 1.0), certificate(time, input_unit, output_unit)
    assert one.certified == other.certified
    assert other.gamma == pytest.approx(one.gamma, rel=1e-9)
    assert other.gamma_bound == pytest.approx(one.gamma_bound, rel=1e-6)
    a, b = one.plants[0], other.plants[0]
    for kind in ("nominal_margins", "worst_margins"):
        for name, power in (
            ("gain_up", 0),
            ("gain_down", 0),
            ("phase_rad", 0),
            ("delay_s", 1),
            ("modulus", 0),
        ):
            wanted = getattr(getattr(a, kind), name) * time**power
            assert getattr(getattr(b, kind), name) == pytest.approx(wanted, rel=1e-7), (kind, name)
    assert b.bandwidth_rad_s == pytest.approx(a.bandwidth_rad_s / time, rel=1e-6)


def test_units_do_not_matter_to_a_design():
    options = SynthesisOptions(starts=2, grid_points=60, mode_points=30, dense_points=1000, exchange_rounds=1)

    def gamma(t: float, g: float) -> float:
        base = _system([0.2], [0.995, 0.97 * np.exp(0.3j), 0.97 * np.exp(-0.3j)], 0.002, _DT * t)
        system = control.ss(base.A, base.B * g, base.C, 0, _DT * t)
        discs = RationalWeight(numerator=(0.1,), denominator=(1.0,))
        spec = Specification(
            modulus_margin=0.4, bandwidth_rad_s=0.5 / t, effort_limit=5.0 / g, integrator=True,
            controller_order=3,
        )  # fmt: skip
        plant = UncertainPlant(system, name="plant", uncertainty=StatedDiscs(system, discs))
        return synthesise([plant], spec, options, rng=np.random.default_rng(3)).gamma

    in_other_units = [gamma(1e6, 1e-6), gamma(1e-6, 1e6)]
    np.testing.assert_allclose(in_other_units, gamma(1.0, 1.0), rtol=1e-5)
