"""Held-out records that do not confirm what the estimation records say; made by an independent simulator."""

from __future__ import annotations

import numpy as np
import pytest

from diagnosis import Case, Experiment, diagnose
from plant import Rig, prbs
from workflow.blind.rigs import draw_rig, rig_toml
from workflow.blind.truth import Truth


def _case(folder, effects):
    """Small motions to fit, large ones held out."""
    table = draw_rig(np.random.default_rng(3))
    file = folder / "rig.toml"
    file.write_text(rig_toml(table), encoding="utf-8")
    rng = np.random.default_rng(4)
    experiments = []
    for k, (role, amplitude_V, hold) in enumerate(
        [("estimation", 0.2, 8), ("estimation", 0.2, 15), ("held_out", 0.7, 20)]
    ):
        machine = Truth(table, effects)
        voltage = prbs(7, hold, amplitude_V, 700, rng)
        measured = machine.record(voltage).measured(rng.standard_normal((700, 2)) * machine.noise)
        experiments.append(Experiment(f"{k}", role, voltage, measured, "prbs"))
    return Case("small-and-large", Rig.from_toml(file), tuple(experiments))


def _estimation_gap(found):
    residuals = [found.residuals_before[e.name].ravel() for e in found.case.estimation]
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


# Noise alone makes a pooled RMS of 1 +- 1/sqrt(2 N): 2800 values to fit, 1400 held out; three of them.
_FIT, _HELD_OUT = 3 / np.sqrt(2 * 2800), 3 / np.sqrt(2 * 1400)


def test_what_only_large_motions_show_is_unknown(tmp_path):
    # Air drag grows with the square of the speed: a tenth of the torque at a third of it.
    found = diagnose(_case(tmp_path, [{"name": "air_drag", "coefficient_Ns2_m3": 0.01}]))
    assert _estimation_gap(found) == pytest.approx(1.0, abs=_FIT)
    assert found.gap_before > 1 + 5 * _HELD_OUT
    assert found.verdict == "unknown"
    assert found.probabilities["unknown"] > 0.9


def test_they_decide_between_causes_that_small_motions_hardly_show(tmp_path):
    found = diagnose(_case(tmp_path, [{"name": "hardening_spring", "cubic_Nm_rad3": 0.02}]))
    assert _estimation_gap(found) == pytest.approx(1.0, abs=_FIT)
    assert found.gap_before > 1 + 2 * _HELD_OUT
    assert found.combination == ("hardening_spring",)
    assert found.gap_after == pytest.approx(1.0, abs=_HELD_OUT)


def test_records_that_confirm_that_nothing_is_missing_change_nothing(tmp_path):
    found = diagnose(_case(tmp_path, []))
    assert found.verdict == "none"
    assert found.probabilities["none"] > 0.9
