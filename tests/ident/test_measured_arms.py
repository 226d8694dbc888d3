"""Measured arms: what identification gets out of them, and its ellipses against measured repeats."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from ident import IdentOptions, Record, band_limited, identify, identify_frf
from ident.basis.functions import free_response
from ident.basis.options import EmbeddingOptions
from ident.checks.distortion_findings import distortion_findings
from ident.checks.validation import fit_on_fresh_data, repeat_scatter
from ident.closed_loop import two_stage
from ident.data.finding import FindingKind
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.frf_records import FrfRepeats
from ident.data.repeats import repeats_of
from ident.uncertainty.conditions import combine_posteriors, record_posteriors
from tests.ident.findings import only

HZ = 2 * np.pi


def percent(y, residual):
    return 100 * (1 - np.linalg.norm(residual) / np.linalg.norm(y - y.mean()))


@pytest.fixture(scope="module")
def robot_arm(flexlink_data):
    path = flexlink_data / "daisy_robot_arm" / "robot_arm.csv"
    return Record.from_file(path, ["u_reaction_torque"], ["y_acceleration"], dt_s=1.0)


def robot_arm_options(n_pairs):
    """Pairs and a direct term; the record starts in mid-sweep. Three starts miss the best order 10."""
    return IdentOptions(n_real=0, n_pairs=n_pairs, feedthrough=True, estimate_initial_state=True, starts=8)


# Second half predicted with its own initial state, and run through from rest over both halves. Measured
# 96.444/96.900/97.124/97.458 and 94.16/94.88/94.59/94.47. The second half is the
# mirrored first half, so this is no independent validation.
@pytest.mark.parametrize(("n_pairs", "reach"), [(2, 96.4), (3, 96.89), (4, 97.1), (5, 97.4)])
def test_robot_arm_fitted_on_the_first_half_predicts_the_second(robot_arm, n_pairs, reach):
    half = robot_arm.slice(512, 1024)
    model = identify([robot_arm.slice(0, 512)], robot_arm_options(n_pairs)).model
    y = half.output[:, 0]
    residual = y - model.simulate(half.input[:, 0])
    free = free_response(model.poles, 512)
    residual = residual - free @ np.linalg.lstsq(free, residual, rcond=None)[0]
    assert percent(y, residual) >= reach
    through = robot_arm.output[:, 0] - model.simulate(robot_arm.input[:, 0])
    assert percent(y, through[512:]) >= 94


# One sweep goes down and one up within the first half: nothing is repeated between them. Measured 96.0/95.1
# and 97.0/95.3. With four pairs from the sweep up 97.6, where one pair is split in two (J .000952), and 95.2
# at the minimum to which adding pairs one by one leads (J .001010).
@pytest.mark.parametrize(("n_pairs", "least"), [(2, (94.5, 94.5)), (3, (94.5, 94.5)), (4, (95.8, 97.4))])
def test_robot_arm_fitted_on_the_sweep_down_predicts_the_sweep_up_and_back(robot_arm, n_pairs, least):
    down, up = robot_arm.slice(0, 256), robot_arm.slice(256, 512)
    for part, fresh, reach in ((down, up, least[0]), (up, down, least[1])):
        model = identify([part], robot_arm_options(n_pairs)).model
        assert fit_on_fresh_data(model, fresh).fit_percent > reach


def test_robot_arm_known_at_every_second_line_is_known_between_them(robot_arm):
    u, y = (np.fft.rfft(signal[:, 0])[1:] for signal in (robot_arm.input, robot_arm.output))
    omega = 2 * np.pi * np.arange(1, u.size + 1) / robot_arm.n_samples
    odd = np.abs(u[::2])
    excited = 2 * np.flatnonzero(odd > 0.05 * odd.max())  # odd harmonics only
    used, left = excited[::2], excited[1::2]
    covariance = (1e-6 / np.abs(u[used]) ** 2)[:, None, None] * np.eye(2)
    frf = FrequencyUncertainty(omega[used], y[used] / u[used], covariance, 1.0)
    model = identify_frf(frf, IdentOptions(n_real=0, n_pairs=2, feedthrough=True)).model
    error = y[left] - model.frequency_response(omega[left]) * u[left]
    # Lines 0.0245 rad/sample apart, modes of half width 0.002 and 0.004. Measured 95.4 %.
    assert 100 * (1 - np.linalg.norm(error) / np.linalg.norm(y[left])) > 94.5


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
        Record.from_file(
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


def channel(sweeps, output):
    return [record.siso("v_drive_counts", output) for record in sweeps]


def banded(sweeps, output, low_hz, high_hz):
    return [
        band_limited(record, 2 * np.pi * low_hz, 2 * np.pi * high_hz, skip_s=0.5)
        for record in channel(sweeps, output)
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("output", "low_hz", "error_in_bands"),
    # Measured: theta 0.05, 0.05, 0.06; accel 0.07, 0.10, 0.05. Friction makes the low bands depend on
    # amplitude.
    [pytest.param("theta_rad", 4.0, {(3.2, 8): 0.08, (8, 16): 0.08, (16, 17.3): 0.1}, marks=pytest.mark.long),
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
    assert any(warning.kind is FindingKind.WEAK_INPUT for warning in result.warnings)


def test_krauss_arm_says_that_its_second_mode_falls_with_amplitude(sweeps):
    records = channel(sweeps, "accel_counts")
    told = only(distortion_findings(records, (), repeats_of(records)), FindingKind.AMPLITUDE_EFFECT)
    # Fitted sweep by sweep: 18.07, 18.02 and 18.03 Hz at 50 counts, 17.92, 17.93 and 17.94 Hz at 75,
    # -0.61 %; 12.5 % apart around the mode, 13 times their scatter.
    assert told["shift_percent"] == pytest.approx(-0.61, abs=0.15)
    assert told["most_from_Hz"] < 17.98 < told["most_to_Hz"]
    assert 10 < told["percent"] < 25
    assert told["percent"] > 3 * told["chance_percent"]


def test_emps_time_stamps_jitter_within_the_tolerance(flexlink_data):
    record = Record.from_file(
        flexlink_data / "emps" / "emps_train.csv", ["force_N"], ["q_meas_m"], time="t_s"
    )
    assert record.dt_s == pytest.approx(1e-3, rel=1e-6)
    assert record.n_samples == 24841


# Weighting of the pole search per channel: the hub angle falls by 80 from 1 to 18 Hz, so its 17.9 Hz mode
# needs it.
CHANNELS = {
    "theta_rad": {"integrators": 1, "low": 5.0, "filter_order": 2},
    "accel_counts": {"integrators": 0, "low": 2.0, "filter_order": 1},
}


@pytest.mark.parametrize(
    "output",
    [pytest.param("theta_rad", marks=pytest.mark.long), pytest.param("accel_counts", marks=pytest.mark.slow)],
)
def test_single_link_bounds_hold_the_record_left_out(sweeps, output):
    setting = CHANNELS[output]
    band = {"omega_min_rad_s": 4.0, "omega_max_rad_s": 260.0, "integrators": setting["integrators"]}
    # Orders are given: a search on a tenth of the rows finds the same poles.
    options = IdentOptions(
        **band, feedthrough=True, n_real=1, n_pairs=2, estimate_initial_state=False, search_samples=6000
    )
    bounds = EmbeddingOptions(fir_length=60, coloured_noise=True, max_ar_order=20)
    records = channel(sweeps, output)
    stage = two_stage([band_limited(r, 0.8 * HZ, 30 * HZ) for r in records], options)
    # Behind a noise model; without one it explains 94 %.
    assert min(stage.fit_percent) > 85

    def mean(group):
        signals = {
            key: np.mean([getattr(one, key) for one in group], axis=0)
            for key in ("input", "output", "reference")
        }
        return replace(group[0], **signals)

    means = [mean(records[:3]), mean(records[3:])]
    weighted = [
        band_limited(r, setting["low"] * HZ, 30 * HZ, filter_order=setting["filter_order"]) for r in means
    ]
    model = identify(weighted, options).model
    # Published clamped mode at 17.96 Hz; the hub channel sees it through a few encoder counts only.
    assert np.any(np.abs(model.poles.omega_rad_s(model.dt_s) / HZ - 17.9) < 0.4)
    posteriors = record_posteriors(stage.records, model, bounds)
    omega = HZ * np.geomspace(1, 25, 150)
    estimates = [p.at(omega) for p in posteriors]
    inside = [
        combine_posteriors([p for j, p in enumerate(posteriors) if j != left], small_sample_level=0.95)
        .at(omega)
        .contains(estimates[left].centre)
        .mean()
        for left in range(6)
    ]
    # 0.96-0.99 measured; the six records are two clusters, so 0.95 is not exact.
    assert np.mean(inside) > 0.92
    low, middle, mode = repeat_scatter(
        [estimates[:3], estimates[3:]], [(HZ, 4 * HZ), (4 * HZ, 16 * HZ), (17.3 * HZ, 18.6 * HZ)]
    )
    # The noise bounds of one record agree with the measured scatter of repeats within a factor of two ...
    assert 0.3 < low.ratio < 2.0
    assert 0.5 < middle.ratio < 2.0
    # ... but not with the difference between amplitudes at the second mode, which is why conditions are
    # combined.
    assert mode.between_ratio > 3


@pytest.mark.long
def test_robot_arm_fits_its_mirrored_half(robot_arm):
    halves = [robot_arm.slice(0, 512), robot_arm.slice(512, 1024)]
    result = identify(halves[:1], IdentOptions(n_real=0, n_pairs=2, feedthrough=True))
    # ARX needs order 8 for 94.9 % here; 96.4 % measured with order 4.
    assert fit_on_fresh_data(result.model, halves[1]).fit_percent > 95.5
    posteriors = record_posteriors(halves, result.model, EmbeddingOptions(coloured_noise=True))
    assert fit_on_fresh_data(posteriors[0], halves[1]).fit_percent > 97
    omega = np.geomspace(0.05, 1.4, 80)
    row = repeat_scatter([[p.at(omega) for p in posteriors]], [(0.05, 1.5)])[0]
    assert 0.5 < row.ratio < 2.0


@pytest.mark.slow
def test_ellipses_of_a_published_frequency_response(flexlink_data):
    plant = kyoto_plant(flexlink_data)
    first, second = plant.labels[0], plant.labels[2]
    frf = plant.only(first).mean(0.002, outlier_threshold=6.0)
    assert frf.omega_rad_s.size == 100
    assert np.median(frf.enclosing_radius() / np.abs(frf.centre)) < 0.1
    # The runs of one date predict single runs of the other between 3 and 200 rad/s: 0.98-0.94 measured (0.95
    # promised if days are alike; below, friction changes from day to day; above, its own outliers count).
    region = plant.only(first).mean(0.002, outlier_threshold=6.0, of="next run")
    omega = region.omega_rad_s
    middle = (omega > 3) & (omega < 200)
    points = plant.only(second)
    runs = np.array([points.response[points.omega_rad_s == w] for w in omega]).T
    inside = np.array([region.contains(run) for run in runs])
    assert inside[:, middle].mean() == pytest.approx(0.95, abs=0.05)


@pytest.fixture(scope="module")
def kyoto_means(flexlink_data):
    """Mean response up to 200 rad/s of the runs of one date, for two dates."""
    plant = kyoto_plant(flexlink_data)
    return [
        plant.only(date).band(0, 200).mean(0.002, outlier_threshold=6.0)
        for date in (plant.labels[0], plant.labels[2])
    ]


@pytest.fixture(scope="module")
def kyoto_models(kyoto_means):
    """Fits of both dates, their orders chosen by the data."""
    return [identify_frf(frf, IdentOptions(integrators=1)) for frf in kyoto_means]


@pytest.mark.slow
def test_order_and_modes_of_a_published_frequency_response(kyoto_means, kyoto_models):
    means, models = kyoto_means, [result.model for result in kyoto_models]
    for model in models:
        # Motor pole and two modes beside the integrator, on both dates.
        assert np.any(np.abs(model.poles.decay_per_s(0.002) - 56) < 3)
        np.testing.assert_allclose(model.poles.omega_rad_s(0.002), [28.7, 164.6], rtol=0.01)
        np.testing.assert_allclose(model.poles.zeta(), [0.264, 0.036], rtol=0.15)
    # A model of one date is off by 1.5 % on the other: the difference between the days.
    for model, frf in zip(models, reversed(means), strict=True):
        error = np.abs(model.frequency_response(frf.omega_rad_s) / frf.centre - 1)
        assert np.median(error) < 0.025
    # The published structure (four poles, an integrator among them here) does not explain the covariances.
    four = identify_frf(means[0], IdentOptions(integrators=1, n_real=1, n_pairs=1))
    assert (four.rss / four.degrees_of_freedom) > 5


@pytest.mark.long
def test_numbers_that_are_given_are_fitted_as_well_as_the_same_numbers_chosen(kyoto_means, kyoto_models):
    """Grown to given numbers without a test in between, it once ended at four times the chi-square."""
    given = identify_frf(kyoto_means[1], IdentOptions(integrators=1, n_real=2, n_pairs=2))
    chosen = kyoto_models[1]
    assert chosen.model.poles.order == given.model.poles.order + 1
    assert given.rss < 2 * chosen.rss


@pytest.mark.long
def test_numbers_that_are_given_reach_the_same_numbers_chosen_in_a_wide_band(flexlink_data):
    plant = kyoto_plant(flexlink_data)
    wide = plant.only(plant.labels[0]).band(0, 600).mean(0.002, outlier_threshold=6.0)
    chosen = identify_frf(wide, IdentOptions(integrators=1))
    n_real, n_pairs = chosen.model.poles.real.size - 1, chosen.model.poles.pairs.size
    given = identify_frf(wide, IdentOptions(integrators=1, n_real=n_real, n_pairs=n_pairs))
    assert given.rss <= chosen.rss * (1 + 1e-6)


def kyoto_plant(folder):
    """Motor to angle, from the closed loop with a proportional gain of 1.65, point by point."""
    path = folder / "quanser_rfl_frf" / "frf_repeats.csv"
    return FrfRepeats.from_csv(path, label="date").open_loop(1.0, 1.65)
