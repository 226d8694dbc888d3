"""Recorded gaps of an independent finite-element rig: the cause is named, its size found, the gap closed."""

from __future__ import annotations

import numpy as np
import pytest

from diagnosis import ResidualModel, pooled_rms, probabilities, search
from tests.diagnosis.recorded import answer, recorded_case


def _diagnosed(gap_cases, name, rig):
    folder = gap_cases / "labelled" / name
    case = recorded_case(folder, rig)
    found = search(case)
    total, _ = probabilities(found.hypotheses)
    return case, found, total, answer(folder)


def _held_out(case, hypothesis):
    fit = hypothesis.fit
    return pooled_rms(ResidualModel(case).of(fit.deviations, fit.effects, case.held_out))


@pytest.mark.parametrize(
    ("name", "rig"),
    [
        ("tip_payload", "rig.toml"),
        pytest.param("input_delay", "rig_uncertain.toml", marks=pytest.mark.slow),
        pytest.param("gravity", "rig_uncertain.toml", marks=pytest.mark.slow),
        pytest.param("link_stiffness", "rig_uncertain.toml", marks=pytest.mark.slow),
        pytest.param("backlash", "rig_uncertain.toml", marks=pytest.mark.slow),
    ],
)
def test_one_effect_is_named_sized_and_closes_the_gap(gap_cases, name, rig):
    case, found, total, truth = _diagnosed(gap_cases, name, rig)
    assert found.best.names == (name,)
    assert total[name] > 0.8
    (expected,) = truth["effects"]
    (candidate,), (x,) = found.best.fit.candidates, found.best.fit.coordinates
    for key, value in expected["parameters"].items():
        # 2 % and 3 % are what is asked with exact and uncertain nominals, median and 90th percentile apart.
        assert candidate.parameters(x)[key] == pytest.approx(value, rel=0.03), key
    # Within three standard errors of what the true effect leaves: 2600 samples of two outputs.
    oracle = truth["pooled_gap"]["held_out_gap_after_oracle"]
    assert _held_out(case, found.best) <= oracle + 3 / np.sqrt(2 * 5200)


@pytest.mark.parametrize("rig", ["rig.toml", pytest.param("rig_uncertain.toml", marks=pytest.mark.slow)])
def test_no_effect_is_no_alarm(gap_cases, rig):
    _, found, total, _ = _diagnosed(gap_cases, "none", rig)
    assert found.best.names == ()
    assert max(total, key=total.__getitem__) == "none"


@pytest.mark.slow
def test_an_effect_outside_the_list_is_unknown(gap_cases):
    _, _, total, _ = _diagnosed(gap_cases, "unlisted_effect", "rig.toml")
    assert total["unknown"] > 0.9


@pytest.mark.slow
def test_two_effects_are_told_apart(gap_cases):
    case, found, total, truth = _diagnosed(
        gap_cases, "coulomb_friction_and_tip_payload", "rig_uncertain.toml"
    )
    assert set(found.best.names) == {"coulomb_friction", "tip_payload"}
    assert total["coulomb_friction"] + total["tip_payload"] > 0.9
    oracle = truth["pooled_gap"]["held_out_gap_after_oracle"]
    assert _held_out(case, found.best) <= oracle + 3 / np.sqrt(2 * 5200)
