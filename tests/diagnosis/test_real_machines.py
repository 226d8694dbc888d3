"""Measured arms as plants of one's own: what stands whatever the details, and what the records show."""

import numpy as np
import pytest

from benchmarks import serial_link_stage


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
