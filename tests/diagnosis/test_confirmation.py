"""Held-out records that do not confirm what the estimation records say; made by an independent simulator."""

import numpy as np
import pytest

from diagnosis import diagnose
from tests.diagnosis.recorded import simulated_case
from validation.blind.rigs import draw_rig


def _case(folder, effects, held_out=None, held_out_V=0.7):
    """Small motions to fit, larger ones held out; held_out: effects there, if not the same."""
    records = [
        ("estimation", effects, 8, 0.2),
        ("estimation", effects, 15, 0.2),
        ("held_out", effects if held_out is None else held_out, 20, held_out_V),
    ]
    table = draw_rig(np.random.default_rng(3))
    return simulated_case(folder, table, records, np.random.default_rng(4), samples=700)


def _estimation_gap(found):
    residuals = [found.residuals_before[e.name].ravel() for e in found.case.estimation]
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


# Noise alone makes a pooled RMS of 1 +- 1/sqrt(2 N): 2800 values to fit, 1400 held out; three of them.
_FIT, _HELD_OUT = 3 / np.sqrt(2 * 2800), 3 / np.sqrt(2 * 1400)


@pytest.mark.long
def test_what_only_large_motions_show_is_unknown(tmp_path):
    # Air drag grows with the square of the speed: a tenth of the torque at a third of it.
    found = diagnose(_case(tmp_path, [{"name": "air_drag", "coefficient_Ns2_m3": 0.01}]))
    assert _estimation_gap(found) == pytest.approx(1.0, abs=_FIT)
    assert found.gap_before > 1 + 5 * _HELD_OUT
    assert found.verdict == "unknown"
    assert found.probabilities["unknown"] > 0.9


@pytest.mark.long
def test_they_decide_between_causes_that_small_motions_hardly_show(tmp_path):
    found = diagnose(_case(tmp_path, [{"name": "hardening_spring", "cubic_Nm_rad3": 0.02}]))
    assert _estimation_gap(found) == pytest.approx(1.0, abs=_FIT)
    assert found.gap_before > 1 + 2 * _HELD_OUT
    assert found.combination == ("hardening_spring",)
    assert found.gap_after == pytest.approx(1.0, abs=_HELD_OUT)


def _payload(mass_kg):
    return [{"name": "tip_payload", "mass_kg": mass_kg}]


@pytest.mark.long
def test_a_fluke_of_the_estimation_records_is_no_effect(tmp_path):
    # A payload in the estimation records alone, as a fluke of their noise would look.
    found = diagnose(_case(tmp_path, _payload(1.5e-4), held_out=[], held_out_V=0.4))
    assert found.held_out_decided
    assert found.verdict == "none"
    assert found.probabilities["none"] > 0.9


@pytest.mark.long
def test_the_same_where_the_held_out_records_show_it_too_is_one(tmp_path):
    found = diagnose(_case(tmp_path, _payload(1.5e-4), held_out_V=0.4))
    assert not found.held_out_decided
    assert found.combination == ("tip_payload",)


@pytest.mark.slow
def test_what_only_the_held_out_records_make_likely_is_an_effect(tmp_path):
    found = diagnose(_case(tmp_path, _payload(1.2e-4), held_out_V=0.4))
    assert found.held_out_decided
    assert found.combination == ("tip_payload",)
    assert found.probabilities["tip_payload"] > 0.9
