"""Recorded gaps of an independent finite-element rig: the cause is named, its size found, the gap closed."""

from __future__ import annotations

import numpy as np
import pytest

from diagnosis import diagnose
from tests.diagnosis.recorded import answer, recorded_case

# Of four estimation records, where all of them take half a minute: what is sought is found without these.
SPARE = ("01_", "03_")


def _diagnosed(gap_cases, name, rig, without=()):
    folder = gap_cases / "labelled" / name
    return diagnose(recorded_case(folder, rig, without)), answer(folder)


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
    found, truth = _diagnosed(gap_cases, name, rig, SPARE if name == "backlash" else ())
    assert found.verdict == "effect"
    assert found.combination == (name,)
    assert found.effects[0].name == name
    assert found.probabilities[name] > 0.8
    (expected,) = truth["effects"]
    for key, value in expected["parameters"].items():
        # 2 % and 3 % are what is asked with exact and uncertain nominals, median and 90th percentile apart.
        assert found.effects[0].parameters[key] == pytest.approx(value, rel=0.03), key
        low, high = found.effects[0].intervals[key]
        assert low <= found.effects[0].parameters[key] <= high
    # Within three standard errors of what the true effect leaves: 2600 samples of two outputs.
    oracle = truth["pooled_gap"]["held_out_gap_after_oracle"]
    assert found.gap_after <= oracle + 3 / np.sqrt(2 * 5200)
    assert found.gap_before > 2 * found.gap_after
    # Stiffness out of tolerance can also be had by stated values moved far: nothing is left to close then.
    if found.gap_refit > 1.1 * found.gap_after:
        low, high = found.gap_closed_interval
        assert 0.9 < low <= found.gap_closed <= high <= 1.05
    else:
        assert name == "link_stiffness"


@pytest.mark.parametrize("rig", ["rig.toml", pytest.param("rig_uncertain.toml", marks=pytest.mark.slow)])
def test_no_effect_is_no_alarm(gap_cases, rig):
    found, _ = _diagnosed(gap_cases, "none", rig)
    assert (found.verdict, found.detail_verdict, found.combination) == ("none", "none", ())
    assert found.effects[0].name == "none"
    assert np.isnan(found.gap_closed)


@pytest.mark.slow
def test_an_effect_outside_the_list_is_unknown(gap_cases):
    found, _ = _diagnosed(gap_cases, "unlisted_effect", "rig.toml")
    assert found.verdict == found.effects[0].name == "unknown"
    assert found.probabilities["unknown"] > 0.9
    assert found.combination == ()


@pytest.mark.slow
def test_two_effects_are_told_apart(gap_cases):
    found, truth = _diagnosed(gap_cases, "coulomb_friction_and_tip_payload", "rig_uncertain.toml", SPARE)
    assert set(found.combination) == {"coulomb_friction", "tip_payload"}
    assert {found.effects[0].name, found.effects[1].name} == set(found.combination)
    assert min(entry.presence for entry in found.effects[:2]) > 0.9
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    oracle = truth["pooled_gap"]["held_out_gap_after_oracle"]
    assert found.gap_after <= oracle + 3 / np.sqrt(2 * 5200)
