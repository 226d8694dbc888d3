"""What an answer says of what is left: shares of a motion, of validation records and of the worst record."""

import numpy as np
import pytest

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.answer import completeness_of, left_of

NOISE = np.array([0.01, 0.02])
ROWS = 400


def _case(sizes):
    """Two outputs that move by these sizes (RMS about) in records named by their key; the last validates."""
    records = []
    for name, size in sizes.items():
        t = np.arange(ROWS)
        motion = size * np.sqrt(2) * np.column_stack([np.sin(0.1 * t), np.cos(0.1 * t)])
        role = "held_out" if name == list(sizes)[-1] else "estimation"
        records.append(PlantExperiment(name, role, np.ones((ROWS, 1)), motion))
    effect = PlantEffect("gain", (EffectParameter("ratio", 0.1, 1.0),))
    plant = Plant(lambda p, e, u: np.zeros((len(u), 2)), {}, {}, ("a_m", "b_m"), NOISE, (effect,), 0.05, 0.01)
    return PlantCase("made", plant, tuple(records))


def _residuals(case, sizes):
    """Whitened errors of these sizes (output units, one for each output) beside white noise, by record."""
    rng = np.random.default_rng(2)
    wave = np.sqrt(2) * np.sin(0.3 * np.arange(ROWS))[:, None]
    return {
        record.name: rng.standard_normal((ROWS, 2)) + wave * np.array(sizes[record.name]) / NOISE
        for record in case.experiments
    }


def test_the_record_that_is_furthest_off_has_its_own_share():
    """Validation is within the noise; a fast record misses a fifth of the motion of its second output."""
    case = _case({"slow": 1.0, "fast": 5.0, "valid": 1.0})
    found = completeness_of(
        case, 0.2, _residuals(case, {"slow": (0.0, 0.0), "fast": (0.0, 1.0), "valid": (0.0, 0.0)})
    )
    assert found.most == 0.0
    assert found.in_record == "fast"
    assert found.remains_in_record["b_m"] == pytest.approx(0.2, rel=0.02)
    assert found.remains_in_record["a_m"] == 0.0
    assert found.above_elsewhere


def test_where_validation_records_say_it_no_other_record_is_named_against_them():
    case = _case({"a": 1.0, "b": 1.0, "valid": 1.0})
    found = completeness_of(case, 0.0, _residuals(case, {"a": (0.3, 0), "b": (0.1, 0), "valid": (0.2, 0)}))
    assert found.most == pytest.approx(0.2, rel=0.02)
    assert (found.in_record, found.above_elsewhere) == ("a", False)


def test_a_record_at_rest_is_not_the_worst_by_the_motion_that_it_lacks():
    case = _case({"rest": 0.01, "moves": 2.0, "valid": 2.0})
    found = completeness_of(
        case, 0.5, _residuals(case, {"rest": (0.05, 0), "moves": (0.2, 0), "valid": (0.1, 0)})
    )
    assert found.in_record == "moves"


def test_of_an_output_that_hardly_moves_all_is_left_or_nothing():
    case = _case({"a": 1.0, "valid": 1e-9})
    noise_only, error = (_residuals(case, {"a": (0, 0), "valid": (size, 0)}) for size in (0.0, 1.0))
    assert left_of(case, noise_only)[0].tolist() == [0.0, 0.0]
    shares, rms = left_of(case, error)
    assert shares.tolist() == [1.0, 0.0]
    assert rms[0] == pytest.approx(1.0, rel=0.02)
