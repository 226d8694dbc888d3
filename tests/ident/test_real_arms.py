"""Measured arms: what the identification gets out of them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from ident.basis import free_response
from ident.identify import identify
from ident.options import IdentOptions
from ident.prefilter import band_limited
from ident.record import Record


def percent(y, residual):
    return 100 * (1 - np.linalg.norm(residual) / np.linalg.norm(y - y.mean()))


@pytest.fixture(scope="module")
def robot_arm(flexlink_data):
    path = flexlink_data / "daisy_robot_arm" / "robot_arm.csv"
    return Record.from_csv(path, ["u_reaction_torque"], ["y_acceleration"], dt_s=1.0)


# Second half predicted with its own initial state, and run through from rest over both halves. Measured
# 96.44/96.90/ 97.12/97.46 and 94.2/94.9/94.6/94.5. The second half is the mirrored first half, so this is
# no independent validation.
@pytest.mark.parametrize(("n_pairs", "reach"), [(2, 96.4), (3, 96.8), (4, 97.0), (5, 97.3)])
def test_robot_arm_fitted_on_the_first_half_predicts_the_second(robot_arm, n_pairs, reach):
    half = robot_arm.slice(512, 1024)
    model = identify(
        [robot_arm.slice(0, 512)], IdentOptions(n_real=0, n_pairs=n_pairs, feedthrough=True)
    ).model
    y = half.output[:, 0]
    residual = y - model.simulate(half.input[:, 0])
    free = free_response(model.poles, 512)
    residual = residual - free @ np.linalg.lstsq(free, residual, rcond=None)[0]
    assert percent(y, residual) >= reach
    through = robot_arm.output[:, 0] - model.simulate(robot_arm.input[:, 0])
    assert percent(y, through[512:]) >= 94


def test_robot_arm_needs_the_direct_term(robot_arm):
    half = robot_arm.slice(0, 512)
    fits = [
        identify([half], IdentOptions(n_real=0, n_pairs=2, feedthrough=direct)).fit_percent[0]
        for direct in (True, False)
    ]
    assert fits[0] > 97
    assert fits[1] < fits[0] - 1


@pytest.fixture(scope="module")
def sweeps(flexlink_data):
    folder = flexlink_data / "slfr_krauss_2009"
    return [
        Record.from_csv(
            folder / f"swept_sine_amp{amplitude}_rep{repeat}.csv",
            ["v_drive_counts"],
            ["theta_rad", "accel_counts"],
            time="t_s",
            references=["u_ref_rad"],
        )
        for amplitude in (50, 75)
        for repeat in (1, 2, 3)
    ]


def empirical_response(sweeps, output):
    """Cross spectra with the reference over cross spectra with the reference, all six sweeps: 0.05 Hz
    apart."""
    over, under = 0, 0
    for record in sweeps:
        r = record.reference[:, 0]
        setting = {"fs": 500, "nperseg": 10000, "window": "boxcar"}
        frequency, cross = scipy.signal.csd(r, record.siso("v_drive_counts", output).output[:, 0], **setting)
        over = over + cross
        under = under + scipy.signal.csd(r, record.input[:, 0], **setting)[1]
    return frequency, over / under


def banded(sweeps, output, low_hz, high_hz):
    return [
        band_limited(
            record.siso("v_drive_counts", output), 2 * np.pi * low_hz, 2 * np.pi * high_hz, skip_s=0.5
        )
        for record in sweeps
    ]


@pytest.mark.parametrize(
    ("output", "low_hz", "error_in_bands"),
    # Measured: theta 0.05, 0.05, 0.06; accel 0.07, 0.10, 0.05. Friction makes the low bands depend on
    # amplitude.
    [("theta_rad", 4.0, {(3.2, 8): 0.08, (8, 16): 0.08, (16, 17.3): 0.1}),
     ("accel_counts", 1.5, {(2.3, 8): 0.12, (8, 16): 0.15, (17.3, 18.5): 0.1})],
)  # fmt: skip
def test_krauss_arm_has_its_two_modes_in_both_channels(sweeps, output, low_hz, error_in_bands):
    options = IdentOptions(n_real=2, n_pairs=2, estimate_initial_state=False)
    model = identify(banded(sweeps, output, low_hz, 30.0), options).model
    hertz = np.sort(model.poles.omega_rad_s(0.002)) / 2 / np.pi
    # The hub turns, held only by the motor: the first mode is pulled up from its clamped 2.5 Hz and damped.
    assert 2.7 < hertz[0] < 3.3
    assert hertz[1] == pytest.approx(17.9, abs=0.2)
    frequency, response = empirical_response(sweeps, output)
    for (low, high), limit in error_in_bands.items():
        here = (frequency > low) & (frequency < high)
        error = np.abs(model.frequency_response(2 * np.pi * frequency[here]) / response[here] - 1)
        assert np.median(error) < limit


def test_krauss_arm_warns_of_the_band_that_was_not_excited(sweeps):
    options = IdentOptions(n_real=2, n_pairs=1, estimate_initial_state=False)
    result = identify([sweeps[0].siso("v_drive_counts", "accel_counts")], options)
    assert any("not exciting above" in warning for warning in result.warnings)


def test_emps_time_stamps_jitter_within_the_tolerance(flexlink_data):
    record = Record.from_csv(flexlink_data / "emps" / "emps_train.csv", ["force_N"], ["q_meas_m"], time="t_s")
    assert record.dt_s == pytest.approx(1e-3, rel=1e-6)
    assert record.n_samples == 24841
