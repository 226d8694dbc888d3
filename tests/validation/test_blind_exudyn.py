"""A third simulator, of other authors, as a check on the blind protocol's own (with the extra `blind`)."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from tests.validation.test_blind_truth import RIG
from validation.blind.exudyn_truth import SUPPORTED, ExudynTruth
from validation.blind.protocol import run_blind
from validation.blind.truth import LISTED, Feedback, Truth
from workflow.engine.errors import InputError

THERE = importlib.util.find_spec("exudyn") is not None
needs_exudyn = pytest.mark.skipif(not THERE, reason="the extra 'blind' is not installed")


@pytest.mark.skipif(THERE, reason="the extra 'blind' is installed")
def test_without_the_extra_one_line_says_what_to_install(tmp_path):
    with pytest.raises(InputError, match=r"pip install 'flexlink\[blind\]'"):
        run_blind(1, 1, tmp_path / "run", simulator="exudyn")
    assert not (tmp_path / "run").exists()


def test_what_exudyn_cannot_make_is_refused():
    with pytest.raises(ValueError, match="not in Exudyn's truth: backlash"):
        ExudynTruth(RIG, [{"name": "backlash", "gap_rad": 0.01}])
    assert len(set(SUPPORTED) & set(LISTED)) == 22


@needs_exudyn
@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        [],
        [{"name": "coulomb_friction", "torque_Nm": 0.02}],
        [{"name": "actuator_lag", "time_constant_s": 0.008}],
        [{"name": "joint_compliance", "stiffness_Nm_rad": 60.0, "damping_Nms": 0.08}],
        [{"name": "base_compliance", "stiffness_Nm_rad": 120.0, "damping_Nms": 0.5, "inertia_kg_m2": 0.05}],
        [{"name": "torque_ripple", "amplitude_Nm": 0.05, "cycles_per_rev": 12.0, "phase_rad": 0.7}],
        [{"name": "gravity", "acceleration_m_s2": 0.5}, {"name": "sensor_lag", "time_constant_s": 0.004}],
        [{"name": "cogging", "relative_amplitude": 0.2, "cycles_per_rev": 12.0, "phase_rad": 0.3}],
    ],
    ids=lambda effects: "+".join(e["name"] for e in effects) or "none",
)
def test_two_formulations_agree_to_a_hundredth_of_the_noise(effects):
    bits = np.random.default_rng(11).integers(0, 2, 300)
    voltage = np.where(np.repeat(bits, 5)[:300] == 1, 1.2, -1.2)
    nothing = np.zeros((300, 2))
    a, b = (kind(RIG, effects).record(voltage).measured(nothing) for kind in (Truth, ExudynTruth))
    # Measured: at most 0.004 (16 steps a sample, second order).
    assert np.all(np.sqrt(np.mean((a - b) ** 2, axis=0)) < 0.01 * 1e-3)


@needs_exudyn
@pytest.mark.slow
def test_a_loop_closed_around_exudyn_replays():
    reference = np.clip((np.arange(200) - 30) / 100, 0, 1) * 0.3
    slew = ExudynTruth(RIG).record(np.zeros(200), Feedback(reference, 3.0, 0.2, 0.7))
    replayed = Truth(RIG).record(slew.voltage_V)
    np.testing.assert_allclose(slew.hub_angle_rad, replayed.hub_angle_rad, rtol=0, atol=2e-5)
