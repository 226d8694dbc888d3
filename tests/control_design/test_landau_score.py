"""Landau's score on loops whose items can be worked out by hand; the search's fast margins against the
score's."""

import control
import numpy as np
import pytest

from benchmarks.landau_score import ITEMS, LOADS, TS_S, Law, all_values, margins, points, score, values
from benchmarks.landau_transmission import batch_margins, law_of

_NEAR = np.array(
    [0.4768552, -1.317387, 1.1759111, -0.3086128, -0.0343734, -0.5180146]
)  # S(4), R(2): close to full score
_GOOD = np.array(
    [0.4489833, -1.4248885, 1.7199994, -0.9737049, 0.2525514, -0.6146152]
)  # S(5), R(1): full score


def test_deadbeat_integrator_by_hand():
    # A = 1, B = q^-1, R = 1 - q^-1, S = T = 1: closed loop 1, y one sample late, disturbance gone after one
    # sample. S = 1 - z^-1: |S| = 2 sin(w/2) exceeds 1 from a sixth of 20 Hz on, largest 2. |L| = 1 there with
    # phase -120 degrees: delay margin one sample. K S = 1.
    v = values(Law(np.array([1.0, -1.0]), np.array([1.0]), np.array([1.0])), ((1.0,), (0.0, 1.0)))
    assert v["rise_s"] == pytest.approx(0.0 - 0.15)
    assert v["peak"] == pytest.approx(1.0)
    assert v["rejection_s"] == pytest.approx(0.0)
    assert v["integrator"] == 1.0
    assert v["attenuation_Hz"] == pytest.approx(3.34)  # first grid point above 20/6 Hz
    assert v["sensitivity_dB"] == pytest.approx(20 * np.log10(2), rel=1e-6)
    assert v["delay_margin_s"] == pytest.approx(TS_S, rel=1e-9)
    assert v["effort_dB"] == pytest.approx(0.0, abs=1e-9)


def test_open_loop_by_hand():
    # No feedback: S = 1 everywhere, no crossover, a disturbance stays for ever, no integrator.
    v = values(Law(np.array([1.0]), np.array([0.0]), np.array([1.0])), ((1.0,), (0.0, 1.0)))
    assert v["rejection_s"] == pytest.approx(99 * TS_S)
    assert v["integrator"] == 0.0
    assert v["delay_margin_s"] == np.inf
    assert v["attenuation_Hz"] == 10.0
    assert v["effort_dB"] == -np.inf
    got = {item: points(item, v[item]) for item in ITEMS}
    assert got == {item: 0.0 if item in ("rejection_s", "integrator") else 100.0 for item in ITEMS}


def test_points_are_linear_between_their_ends():
    assert points("rise_s", 1.5) == pytest.approx(50.0)
    assert points("peak", 1.15) == pytest.approx(50.0)
    assert points("rejection_s", 1.3) == pytest.approx(50.0)
    assert points("attenuation_Hz", 0.15) == pytest.approx(50.0)
    assert points("sensitivity_dB", 9.0) == pytest.approx(50.0)
    assert points("delay_margin_s", 0.6 * TS_S) == pytest.approx(50.0)
    assert points("effort_dB", 15.0) == pytest.approx(50.0)


def test_unstable_load_scores_nothing():
    assert score(Law(np.array([1.0, -1.0]), np.array([50.0]), np.array([50.0]))) == 0.0


def test_items_of_a_good_law_agree_with_python_control():
    law = law_of(_GOOD, 5)
    assert score(law) == pytest.approx(100.0)
    found = all_values(law)
    omega = np.geomspace(0.02, np.pi / TS_S, 4000)
    for name, (a, b) in LOADS.items():
        size = 5
        plant = control.tf(np.pad(b, (0, size - len(b))), np.pad(a, (0, size - len(a))), TS_S)
        k = control.tf(law.S, np.pad(law.R, (0, law.S.size - law.R.size)), TS_S)
        loop = plant * k
        closed = control.feedback(1, loop)
        peak = 20 * np.log10(np.max(np.abs(control.frequency_response(closed, omega).complex)))
        assert found[name]["sensitivity_dB"] == pytest.approx(peak, abs=0.01)
        y = control.step_response(
            control.minreal(plant * control.tf([law.T[0], 0, 0], law.R, TS_S) * closed, verbose=False),
            T=TS_S * np.arange(100),
        ).outputs
        # minreal cancels to 1e-8; the double poles it leaves cost a few digits.
        assert found[name]["peak"] == pytest.approx(np.max(y), abs=1e-3)
        _, phase_margin, _, _, crossing, _ = control.stability_margins(loop)
        assert found[name]["delay_margin_s"] <= np.radians(phase_margin) / crossing + 1e-4


@pytest.mark.parametrize("s_length", [4, 5])
def test_fast_margins_agree_with_the_score(s_length):
    rng = np.random.default_rng(2)
    base = _NEAR if s_length == 4 else _GOOD
    many = base * (1 + 0.0003 * rng.standard_normal((6, 6)))
    for row, fast in zip(many, batch_margins(many, s_length), strict=True):
        exact = margins(law_of(row, s_length))
        slow = [exact[item] for item in ITEMS if item != "integrator"]
        for item, f, s in zip([i for i in ITEMS if i != "integrator"], fast, slow, strict=True):
            # Grids: 0.025 Hz against 0.01 Hz. Rejection is interpolated and asked at 0.098, so that it may be
            # late by a swing that the score passes over.
            if item == "rejection_s":
                assert -0.5 < f <= s + 1e-9
                continue
            tolerance = {"rise_s": 2 * TS_S, "attenuation_Hz": 0.06}.get(item, 0.01)
            assert f == pytest.approx(s, abs=tolerance), item
