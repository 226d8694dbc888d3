"""Measured arms as plants of one's own: what stands whatever the details, and what the records show."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import ruler_robot, serial_link_stage
from diagnosis import diagnose


def test_the_joints_of_the_serial_link_stand_under_currents_of_both_signs(flexlink_data):
    for stage in (1, 2):
        current = serial_link_stage.standing(flexlink_data, stage)
        assert current.min() < -0.02
        assert current.max() > 0.05


@pytest.mark.parametrize("stage", [1, 2])
def test_stage_model_is_the_manufacturers(flexlink_data, stage):
    A, B = serial_link_stage.state_space(serial_link_stage.MANUFACTURER[stage])
    folder = flexlink_data / "quanser_2dsfl"
    stated = np.loadtxt(folder / f"nominal_stage{stage}_A.csv", delimiter=",", skiprows=1)
    # The constants are printed to three or four digits; the link damping of stage 1 is none.
    np.testing.assert_allclose(A[2:, :3], stated[2:, :3], rtol=2e-3)
    np.testing.assert_allclose(A[2:, 3], stated[2:, 3], rtol=2e-3, atol=0.03)
    drive = np.loadtxt(folder / f"nominal_stage{stage}_B.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(B[:, 0], drive, rtol=2e-3)


@pytest.mark.slow
def test_the_offset_of_the_ruler_robot_found_at_one_amplitude_holds_at_the_other(flexlink_data):
    found = diagnose(ruler_robot.case(flexlink_data, (50,), (75,)))
    assert found.combination == ("drive_offset",)
    assert found.shares is not None
    # Friction beside it closes more, though less than what interests.
    assert ("coulomb_friction", "drive_offset") in dict(found.shares.closes)
    # An amplitude no fit has seen: half of the explainable energy is gone at least.
    assert found.gap_closed > 0.5
