"""Each warning on a record made to deserve it; none on records that deserve none."""

import numpy as np
import pytest
import scipy.signal

from ident import IdentOptions, Record, identify
from ident.checks.input_checks import excitation_limit_rad_s
from ident.data.arrays import clipped_share
from ident.data.finding import FindingKind
from tests.ident.benchmark_plants import DT_S, as_record, p1, p2
from tests.ident.findings import kinds, only
from tests.ident.three_mode_arm import random_arm
from workflow.text.findings.sentences import words

NYQUIST = np.pi / DT_S
DRIFTS = {FindingKind.DRIFT, FindingKind.SLOW_POLE_IS_DRIFT}


def warnings_of(record, **options):
    return identify([record], IdentOptions(**options)).warnings


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_clean_records_are_quiet(seed):
    assert warnings_of(p2(seed).record) == ()
    assert warnings_of(p2(seed, 1000, 30).record) == ()
    assert warnings_of(p1(seed).record, integrators=2) == ()
    assert warnings_of(random_arm(np.random.default_rng(seed)).record) == ()


def filtered(u, noise_std=0.01, seed=0):
    """A mode at 30 rad/s, damping 0.05, and a fast pole."""
    w, zeta = 30.0, 0.05
    mode = [1, -2 * np.exp(-zeta * w * DT_S) * np.cos(w * np.sqrt(1 - zeta**2) * DT_S)]
    denominator = np.polymul([*mode, np.exp(-2 * zeta * w * DT_S)], [1, -0.6])
    y = scipy.signal.lfilter([0, 0.02, 0.01], denominator, u)
    return y + noise_std * y.std() * np.random.default_rng(seed).normal(size=u.size)


def binary(n=4000, hold=2, seed=1):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]


# Weak input


def test_an_input_of_low_frequencies_is_named_with_its_limit():
    low_pass = scipy.signal.butter(6, 60.0 / NYQUIST, output="sos")
    u = scipy.signal.sosfilt(low_pass, np.random.default_rng(0).normal(size=6000))
    found = only(warnings_of(as_record(u, filtered(u)), n_real=1, n_pairs=1), FindingKind.WEAK_INPUT)
    assert 50 < found["limit_rad_s"] < 150


def test_a_sum_of_sines_ends_with_its_last_one():
    k = np.arange(4000) * DT_S
    u = sum(np.sin(w * k + w) for w in (3.0, 7.0, 11.0, 17.0, 23.0))
    assert 20 < excitation_limit_rad_s([as_record(u, u)]) < 60
    y = scipy.signal.lfilter([0, 0.1], [1, -0.9], u) + 1e-3 * np.random.default_rng(0).normal(size=4000)
    only(warnings_of(as_record(u, y), n_real=1, n_pairs=0), FindingKind.WEAK_INPUT)
    assert FindingKind.WEAK_INPUT not in kinds(warnings_of(p1(0).record, n_real=2, n_pairs=1))


def test_noise_on_the_measured_input_does_not_hide_that():
    rng = np.random.default_rng(0)
    low_pass = scipy.signal.butter(6, 60.0 / NYQUIST, output="sos")
    u = scipy.signal.sosfilt(low_pass, rng.normal(size=6000))
    measured = u + 0.01 * u.std() * rng.normal(size=u.size)  # 1 %: -40 dB of power, spread up to Nyquist
    only(warnings_of(as_record(measured, filtered(u)), n_real=1, n_pairs=1), FindingKind.WEAK_INPUT)


def test_a_weak_input_that_stands_above_a_small_noise_is_enough():
    """The same roll-off is no fault where the sensor is good enough."""
    u = scipy.signal.lfilter([0.01], [1, -1.8, 0.81], np.random.default_rng(0).normal(size=6000))
    y = filtered(u, noise_std=0.0)
    u_limits = []
    for noise_std in (1e-6, 1.0):
        record = as_record(u, y + noise_std * y.std() * np.random.default_rng(1).normal(size=u.size))
        found = identify([record], IdentOptions(n_real=1, n_pairs=1))
        u_limits.append(excitation_limit_rad_s([record], found.model, found.residuals))
    assert u_limits[0] > 0.9 * NYQUIST
    assert u_limits[1] < 0.6 * NYQUIST


def test_the_plants_own_roll_off_is_not_blamed_on_the_input():
    u = np.random.default_rng(0).normal(size=4000)
    y = scipy.signal.lfilter([0, 1e-4], np.polymul([1, -0.99], [1, -0.98]), u)
    record = as_record(u, y + 0.1 * y.std() * np.random.default_rng(1).normal(size=u.size))
    assert FindingKind.WEAK_INPUT not in kinds(warnings_of(record, n_real=2, n_pairs=0))


# Saturation


def saturated(signal, share=0.9):
    limit = np.quantile(np.abs(signal), share)
    return np.clip(signal, -limit, limit)


def test_clipped_output_and_saturated_input_are_named():
    u = np.repeat(np.random.default_rng(0).normal(size=1000), 4)
    y = filtered(u)
    for record, signal, name in (
        (as_record(u, saturated(y)), "output", "y"),
        (as_record(saturated(u), y), "input", "u"),
    ):
        found = only(warnings_of(record, n_real=1, n_pairs=1), FindingKind.CLIPPED)
        assert (found["signal"], found["name"]) == (signal, name)


def test_a_full_scale_converter_is_clipping():
    y = filtered(binary())
    counts = np.clip(np.round(600 * y / y.std() + 512), 0, 1023)  # ten bits
    assert clipped_share(counts) > 0.05
    one_sided = np.clip(np.sin(0.01 * np.arange(5000)), -0.9, 2)
    assert clipped_share(one_sided) == pytest.approx(0.144, abs=0.01)


@pytest.mark.parametrize(
    "signal",
    [
        binary(),
        binary() + 1e-3 * np.random.default_rng(0).normal(size=4000),  # measured
        np.round(500 * (binary() + 2e-3 * np.random.default_rng(0).normal(size=4000))),  # in counts
        scipy.signal.lfilter([0.5], [1, -0.5], binary(hold=40)).round(6),  # through an amplifier
        np.round(50 * np.sin(0.01 * np.arange(5000))),  # slow sine in encoder steps
        np.round(20 * scipy.signal.chirp(np.linspace(0, 20, 5000), 0.1, 20, 8.0)),
        np.concatenate([np.zeros(900), np.round(100 * (1 - np.cos(np.linspace(0, 6, 2000)))), np.zeros(900)]),
        np.random.default_rng(0).integers(-3, 4, 4000).astype(float),  # seven levels by design
        np.random.default_rng(0).normal(size=5000),
    ],
    ids=["binary", "measured", "counts", "amplifier", "sine", "chirp", "rest", "levels", "noise"],
)
def test_what_is_no_clipping(signal):
    assert clipped_share(signal) == 0


def test_a_machine_that_sticks_where_it_turns_is_not_clipped():
    angle = np.concatenate([np.linspace(0, 100, 1500), np.full(60, 100.0), np.linspace(100, -90, 2500)])
    assert clipped_share(np.round(angle)) == 0


# Short records


def test_a_slow_pole_and_a_short_record():
    rng = np.random.default_rng(0)
    u = rng.normal(size=1000)
    y = scipy.signal.lfilter([0, 1.0], [1, -0.9999], u)  # 50 s in 5 s of record
    y += 0.3 * y.std() * rng.normal(size=u.size)
    found = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=0))
    (warning,) = found.warnings
    assert warning.kind in (FindingKind.UNKNOWN_TIME_CONSTANT, FindingKind.SLOW_BOUND)


def test_a_slow_pole_that_the_noise_leaves_alone_is_no_doubt():
    rng = np.random.default_rng(0)
    u = rng.normal(size=1000)
    y = scipy.signal.lfilter([0, 1.0], [1, -0.9995], u) + 1e-4 * rng.normal(size=u.size)
    assert warnings_of(as_record(u, y), n_real=1, n_pairs=0) == ()


def test_a_damping_nobody_can_tell_is_named():
    """One pair more than the machine has: it sits on the noise."""
    warnings = warnings_of(p2(1).record, n_real=2, n_pairs=5)
    about_pairs = {FindingKind.UNKNOWN_DAMPING, FindingKind.DAMPING_BOUND, FindingKind.FREQUENCY_BOUND}
    about_pairs |= {FindingKind.DAMPED_PAIR, FindingKind.SLOW_PAIR}
    assert sum(warning.kind in about_pairs for warning in warnings) >= 2
    assert FindingKind.UNKNOWN_DAMPING not in kinds(warnings_of(p2(1).record, n_real=2, n_pairs=3))


def test_few_samples_for_the_unknowns():
    found = only(warnings_of(p2(0, 80).record, n_real=2, n_pairs=1), FindingKind.FEW_SAMPLES)
    assert found["n_samples"] == 80


# Trend and offset


@pytest.mark.parametrize("n_real", [0, 1, 2])
def test_a_trend_of_the_output_is_named(n_real):
    """Whether a slow pole has taken it up or it is left in the residual."""
    y = filtered(binary())
    trend = np.linspace(0, 2.0 * y.std(), y.size)
    warnings = warnings_of(as_record(binary(), y + trend), n_real=n_real, n_pairs=1)
    found = only(warnings, FindingKind.SLOW_POLE_IS_DRIFT if n_real else FindingKind.DRIFT)
    if not n_real:
        assert found["drift"] == pytest.approx(trend[-1], rel=0.2)


def test_a_walk_of_an_integrating_machine_is_no_trend():
    for record in (p1(0).record, p1(1).record):
        assert not DRIFTS & kinds(warnings_of(record))


def test_a_slow_disturbance_is_no_trend_and_neither_is_an_offset():
    y = filtered(binary())
    wave = 0.3 * y.std() * np.sin(np.arange(y.size) * 2 * np.pi / 500)
    assert not DRIFTS & kinds(warnings_of(as_record(binary(), y + wave), n_real=1, n_pairs=1))
    assert warnings_of(as_record(binary(), y + 7.0), n_real=1, n_pairs=1) == ()


def test_an_operating_point_far_from_zero_is_named():
    u = 50.0 + binary()
    y = 3.0 + filtered(binary())
    options = {"n_real": 1, "n_pairs": 1, "estimate_initial_state": False}
    found = only(warnings_of(as_record(u, y), **options), FindingKind.FAR_FROM_ZERO)
    assert found["mean"] == pytest.approx(50.0, abs=0.1)
    # With unknown initial states the constant is theirs, and nothing is wrong.
    found = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=1))
    assert found.structure.estimate_initial_state
    assert found.warnings == ()
    assert found.model.poles.omega_rad_s(DT_S)[0] == pytest.approx(30.0, rel=0.01)


def test_warnings_name_the_file(tmp_path):
    path = tmp_path / "log 7.csv"
    y = saturated(filtered(binary()))
    np.savetxt(path, np.column_stack([binary(), y]), delimiter=",", header="u,y", comments="")
    record = Record.from_file(path, ["u"], ["y"], dt_s=DT_S)
    assert only(warnings_of(record, n_real=1, n_pairs=1), FindingKind.CLIPPED)["record"] == str(path)


def test_a_slow_pole_beside_an_integrator_asks_for_no_further_one():
    rng = np.random.default_rng(0)
    u = rng.normal(size=3000)
    y = np.cumsum(np.cumsum(u))
    found = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=0, integrators=1))
    (slow,) = [it for it in found.warnings if it.kind is FindingKind.SLOW_BOUND]
    assert slow.values["integrators"] == 1
    assert "no more than the 1 given" in words(slow)
