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
def test_the_first_stage_of_the_serial_link_feels_the_other(flexlink_data):
    found = diagnose(serial_link_stage.case(flexlink_data, 1))
    # Present, and something else is missing besides.
    assert found.presence("other_stage") > 0.8
    assert found.completeness.probability < 0.1
    assert found.completeness.remains["alpha_rad"] > 0.2
    assert found.shares is not None
    assert found.shares.closes
    assert all((closed > 0.6) == ("other_stage" in names) for names, closed in found.shares.closes)
    assert "other_stage" in found.combination
    assert found.gap_closed > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("fitted", [(50, 75), (50,)])
def test_friction_of_the_ruler_robot_is_present_at_both_amplitudes(flexlink_data, fitted):
    found = diagnose(ruler_robot.case(flexlink_data, fitted, (50, 75)))
    # Measured .86 and .74; what it explains lies within half as much noise again as is stated.
    assert found.presence("coulomb_friction") > 0.5
    assert found.presence("drive_offset") > 0.5


@pytest.mark.slow
def test_the_offset_of_the_ruler_robot_found_at_one_amplitude_holds_at_the_other(flexlink_data):
    found = diagnose(ruler_robot.case(flexlink_data, (50,), (75,)))
    assert found.combination == ("drive_offset",)
    assert found.shares is not None
    # Friction beside it closes more, though less than what interests.
    assert ("coulomb_friction", "drive_offset") in dict(found.shares.closes)
    # An amplitude no fit has seen: half of the explainable energy is gone at least.
    assert found.gap_closed > 0.5
