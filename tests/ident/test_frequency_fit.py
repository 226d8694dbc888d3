"""GOBF models from measured frequency responses: known plants by scipy, derivatives, coverage, bad input."""

from functools import cache

import control
import numpy as np
import pytest

from control_design import UncertainPlant
from ident import IdentOptions, Poles, identify_frf
from ident.data.finding import FindingKind
from ident.data.frf_records import FrfRepeats
from ident.fit.frf_regression import fit_response, prepare_response
from ident.fit.pole_unknowns import free_parameters, set_poles
from ident.fit.refinement import pole_system
from ident.uncertainty import FrequencyUncertainty
from tests.ident.benchmark_plants import DT_S, P2_HZ, P2_ZETA, p2
from tests.ident.findings import only

OMEGA = np.geomspace(0.5, 300, 120)
TRUE_DECAY, TRUE_OMEGA = np.array([0.1, 25.0]), 2 * np.pi * np.array(P2_HZ)


@pytest.fixture(scope="module")
def plant():
    return p2(0)


def measured(response, seed, relative=0.05, absolute=3e-4, turn=None):
    """Response with Gaussian errors of known covariance; turned ellipses three times as long as wide if
    asked."""
    rng = np.random.default_rng(seed)
    size = np.hypot(relative * np.abs(response), absolute * np.abs(response).max())
    axes = np.ones(2) if turn is None else np.array([1.0, 1 / 3])
    angle = np.zeros(response.size) if turn is None else rng.uniform(0, np.pi, response.size)
    rotation = np.exp(1j * angle)
    error = (
        size
        * rotation
        * (axes[0] * rng.standard_normal(response.size) + 1j * axes[1] * rng.standard_normal(response.size))
    )
    matrix = np.stack(
        [np.stack([rotation.real, -rotation.imag], -1), np.stack([rotation.imag, rotation.real], -1)], -2
    )
    covariance = matrix @ (np.diag(axes**2) * size[:, None, None] ** 2) @ matrix.transpose(0, 2, 1)
    return FrequencyUncertainty(OMEGA, response + error, covariance, DT_S)


@pytest.mark.slow
def test_exact_response_gives_the_exact_poles(plant):
    response = plant.response(OMEGA)
    tiny = np.stack([np.eye(2) * (1e-6 * abs(g)) ** 2 for g in response])
    found = identify_frf(FrequencyUncertainty(OMEGA, response, tiny, DT_S), IdentOptions(n_real=2, n_pairs=3))
    poles = found.model.poles
    # Errors of 1e-13 of the response (the reference solves), 1e6 conditioning: 1e-6 of the poles is generous.
    np.testing.assert_allclose(poles.omega_rad_s(DT_S), TRUE_OMEGA, rtol=1e-6)
    np.testing.assert_allclose(poles.zeta(), P2_ZETA, rtol=1e-5)
    np.testing.assert_allclose(poles.decay_per_s(DT_S), TRUE_DECAY, rtol=1e-4)
    np.testing.assert_allclose(found.model.frequency_response(OMEGA), response, rtol=1e-6)


@pytest.fixture(scope="module")
def noisy(plant):
    """Fit whose order the data choose, by whether the ellipses of the data are turned."""
    return cache(lambda turn: identify_frf(measured(plant.response(OMEGA), 1, turn=turn)))


@pytest.mark.slow
@pytest.mark.parametrize("turn", [pytest.param(None, marks=pytest.mark.long), True])
def test_poles_and_order_from_noisy_data(plant, noisy, turn):
    response, found = plant.response(OMEGA), noisy(turn)
    poles = found.model.poles
    assert (poles.real.size, poles.pairs.size) == (2, 3)
    for estimate, truth, deviation in (
        (poles.decay_per_s(DT_S), TRUE_DECAY, found.decay_std_per_s),
        (poles.omega_rad_s(DT_S), TRUE_OMEGA, found.omega_std_rad_s),
        (poles.zeta(), np.array(P2_ZETA), found.zeta_std),
    ):
        # Sixteen numbers in all: 4 standard deviations are exceeded once in a thousand choices of seeds.
        assert np.all(np.abs(estimate - truth) < 4 * deviation)
    assert 0.7 < (found.rss / found.degrees_of_freedom) < 1.3  # of 224: sd 0.094
    said = only(found.verdicts, FindingKind.CHI_SQUARE)
    assert said["expected_low"] < said["chi_square"] < said["expected_high"]
    assert found.posterior.at(OMEGA).contains(response).mean() > 0.8
    assert not found.warnings


@pytest.mark.slow
def test_posterior_widens_when_the_covariances_are_too_small():
    response_of, *_ = lag_and_mode()
    options = IdentOptions(n_real=1, n_pairs=1)
    honest = measured(response_of(OMEGA), 1)
    right = identify_frf(honest, options)
    bold = FrequencyUncertainty(OMEGA, honest.centre, honest.covariance / 16, DT_S)
    wide = identify_frf(bold, options)
    assert (wide.rss / wide.degrees_of_freedom) == pytest.approx(
        16 * (right.rss / right.degrees_of_freedom), rel=1e-3
    )
    said = only(wide.verdicts, FindingKind.CHI_SQUARE)
    assert said["chi_square"] > said["expected_high"]
    ratio = wide.posterior.at(OMEGA).enclosing_radius() / right.posterior.at(OMEGA).enclosing_radius()
    # Both rest on the same scatter; the honest one is not narrowed below its covariances.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_integrator_delay_and_direct_term_are_known_factors():
    response_of, _, (mode_rad_s,), _ = lag_and_mode()
    inner = response_of(OMEGA) + 0.05
    z = np.exp(1j * OMEGA * DT_S)
    response = inner * z / (z - 1) * z**-3
    relative = np.stack([np.eye(2) * (0.01 * abs(g)) ** 2 for g in response])
    rng = np.random.default_rng(3)
    noisy = response + 0.01 * np.abs(response) * (rng.standard_normal(120) + 1j * rng.standard_normal(120))
    options = IdentOptions(n_real=1, n_pairs=1, integrators=1, feedthrough=True, input_delay_samples=3)
    found = identify_frf(FrequencyUncertainty(OMEGA, noisy, relative, DT_S), options)
    assert found.model.poles.omega_rad_s(DT_S) == pytest.approx([mode_rad_s], rel=2e-3)
    assert found.model.poles.real[0] == 0.0
    assert found.posterior.integrators == 1
    assert found.posterior.input_delay_samples == 3
    error = np.abs(found.model.frequency_response(OMEGA) / response - 1)
    assert np.median(error) < 0.01
    assert found.posterior.at(OMEGA).contains(response).mean() > 0.8


def test_directions_are_the_derivative_of_the_refitted_response(plant):
    response = measured(plant.response(OMEGA), 4)
    data = prepare_response(response, integrators=0, delay_samples=0, feedthrough=True)
    poles = Poles.from_continuous(
        decay_per_s=[0.3, 20.0], omega_rad_s=[15.0, 70.0], zeta=[0.03, 0.1], dt_s=DT_S
    )
    here = data.linearise(*poles.writable())
    gradient = -2 * pole_system(here, poles)[1]
    x = free_parameters(*poles.writable(), 0, 0)
    for i in range(x.size):
        ends = []
        for sign in (1, -1):
            moved = x.copy()
            step = 1e-5 * x[i]
            moved[i] += sign * step
            real, pairs = poles.writable()
            set_poles(moved, real, pairs, 0, 0)
            ends.append(fit_response(data, Poles(real, pairs)).rss)
        numeric = (ends[0] - ends[1]) / (2 * step)
        # Central differences: rounding 1e-16 J / step and step^2 J''' are both near 1e-10 of J here.
        assert gradient[i] == pytest.approx(numeric, rel=1e-5, abs=1e-8 * here.rss / x[i])


def test_response_at_zero_and_nyquist_counts_once(plant):
    omega = np.concatenate([[0.0], OMEGA, [np.pi / DT_S]])
    response = plant.response(omega)
    covariance = np.stack([np.eye(2) * (0.02 * abs(g)) ** 2 for g in response])
    covariance[0, 1, 1] = covariance[-1, 1, 1] = 0.0
    measured = FrequencyUncertainty(omega, response, covariance, DT_S)
    data = prepare_response(measured, integrators=0, delay_samples=0, feedthrough=False)
    assert data.n_samples == 2 * omega.size - 2


@pytest.mark.slow
def test_control_design_takes_model_and_posterior(noisy):
    found = noisy(True)
    uncertain = UncertainPlant(found.model.to_control(), name="from a response", uncertainty=found.posterior)
    np.testing.assert_allclose(
        uncertain.at(OMEGA).centre, found.posterior.centre(OMEGA), rtol=1e-9, atol=1e-15
    )


def test_a_refusal_names_the_option_or_counts_the_frequencies(plant):
    response = plant.response(OMEGA)
    good = measured(response, 6)
    exact = FrequencyUncertainty(OMEGA, response, np.zeros((OMEGA.size, 2, 2)), DT_S)
    with pytest.raises(ValueError, match="known"):
        identify_frf(exact)
    with pytest.raises(ValueError, match="offset"):
        identify_frf(good, IdentOptions(estimate_offset=True))
    with pytest.raises(ValueError, match="relative_degree = 2"):
        identify_frf(good, IdentOptions(relative_degree=2))
    few = FrequencyUncertainty(OMEGA[:6], good.centre[:6], good.covariance[:6], DT_S)
    with pytest.raises(ValueError, match=r"6\D+8\D+"):
        identify_frf(few, IdentOptions(n_real=2, n_pairs=3))


def lag_and_mode():
    """Response, decay, frequency and damping of a lag beside a mode of 40 rad/s: less to search than P2."""
    mode = control.tf([0.2 * 40.0**2], [1.0, 2 * 0.02 * 40.0, 40.0**2])
    system = control.sample_system(control.ss(control.tf([1.0], [0.25, 1.0]) + mode), DT_S)
    return lambda omega: np.asarray(system(np.exp(1j * omega * DT_S))), (4.0,), (40.0,), (0.02,)


@pytest.mark.long
@pytest.mark.parametrize(("plant_of", "independent", "runs"), [("lag and mode", 5, 6), ("P2", 15, 34)])
def test_ellipses_cover_and_pole_deviations_are_right_over_many_seeds(plant, plant_of, independent, runs):
    """independent: frequencies of one seed, nearly as many as the model has numbers (6 and 16)."""
    grid = np.geomspace(0.5, 300, 200)
    response_of, *parts = (
        lag_and_mode() if plant_of == "lag and mode" else (plant.response, TRUE_DECAY, TRUE_OMEGA, P2_ZETA)
    )
    truth, response, true = response_of(grid), response_of(OMEGA), np.concatenate(parts)
    numbers = len(parts[0]), len(parts[1])
    hits, scores, right = [], [], 0
    for seed in range(runs):
        found = identify_frf(measured(response, 1000 + seed))
        poles = found.model.poles
        hits.append(found.posterior.at(grid).contains(truth))
        if (poles.real.size, poles.pairs.size) != numbers:
            continue
        right += 1
        estimate = np.concatenate([poles.decay_per_s(DT_S), poles.omega_rad_s(DT_S), poles.zeta()])
        deviation = np.concatenate([found.decay_std_per_s, found.omega_std_rad_s, found.zeta_std])
        scores.append((estimate - true) / deviation)
    assert right >= runs - 1
    covered = np.array(hits)
    # Responses of one seed are smooth; 2.5 sd of the mean.
    assert covered.mean() == pytest.approx(0.95, abs=2.5 * np.sqrt(0.95 * 0.05 / independent / runs))
    assert covered.mean(axis=0).min() > 0.95 - 3.5 * np.sqrt(0.95 * 0.05 / runs)
    # The sampling error of a standard deviation is 1 / sqrt(2 n); 3 of those.
    np.testing.assert_allclose(np.std(scores, axis=0), 1.0, atol=3 / np.sqrt(2 * right))


def two_lags(slow_per_s=6.0, fast_per_s=150.0):
    """Response of a motor as a bench measures it, in continuous time: gain 1.2 and two lags."""
    return lambda omega: 1.2 / ((1j * omega / slow_per_s + 1) * (1j * omega / fast_per_s + 1))


def stated(response, omega, relative, dt_s):
    """Exact values, their relative standard deviation as somebody states it."""
    values = response(omega)
    covariance = (relative * np.abs(values))[:, None, None] ** 2 * np.eye(2)
    return FrequencyUncertainty(omega, values, covariance, dt_s)


BENCH_DT_S = 0.002


@cache
def fitted_bench(lags=(6.0, 150.0), band=(2.0, 400.0), n=90, relative=0.008):
    """Fit of two lags, 1/s, in a band, rad/s; order and direct term from the data."""
    omega = np.geomspace(*band, n)
    return identify_frf(stated(two_lags(*lags), omega, relative, BENCH_DT_S))


# PI controller 4 (z - .975) / (z - 1) of these lags: the loop stays .85 away from -1.
BENCH_LAW = control.tf([4.0, -3.9], [1.0, -1.0], BENCH_DT_S)


@pytest.mark.parametrize(
    ("lags", "band", "n", "relative"),
    [
        ((6.0, 150.0), (2.0, 400.0), 90, 0.008),
        pytest.param((6.0, 150.0), (2.0, 400.0), 90, 0.0004, marks=pytest.mark.long),
        pytest.param((3.0, 200.0), (2.0, 400.0), 90, 0.008, marks=pytest.mark.long),
        pytest.param((6.0, 150.0), (2.0, 600.0), 90, 0.008, marks=pytest.mark.long),
        pytest.param((6.0, 150.0), (20.0, 400.0), 40, 0.008, marks=pytest.mark.long),
        pytest.param((6.0, 150.0), (2.0, 400.0), 12, 0.008, marks=pytest.mark.long),
        pytest.param((6.0, 1e6), (2.0, 400.0), 40, 0.008, marks=pytest.mark.long),
    ],
    ids=["one sweep", "precise", "other lags", "further", "no slow points", "few points", "one lag"],
)
def test_no_loop_hangs_on_a_pole_that_no_data_shows(lags, band, n, relative):
    response = two_lags(*lags)
    omega = np.geomspace(*band, n)
    found = fitted_bench(lags, band, n, relative)
    loop = found.model.to_control() * BENCH_LAW
    assert np.all(np.abs(control.feedback(loop, 1).poles()) < 1)
    # The fitted loop is as far from -1 as the measured one: 2 % of it, as its coarsest points are apart.
    fine = np.geomspace(band[0], np.pi / BENCH_DT_S, 4000)
    nearest = np.abs(1 + loop(np.exp(1j * fine * BENCH_DT_S))).min()
    measured_nearest = np.abs(1 + response(omega) * BENCH_LAW(np.exp(1j * omega * BENCH_DT_S))).min()
    assert nearest == pytest.approx(measured_nearest, rel=0.02)


@pytest.mark.long
def test_a_noisy_repeated_sweep_has_no_pole_above_it():
    rng = np.random.default_rng(0)
    omega = np.repeat(np.geomspace(2.0, 400.0, 60), 6)
    noise = 1 + 0.003 * (rng.standard_normal(omega.size) + 1j * rng.standard_normal(omega.size))
    found = identify_frf(FrfRepeats(omega, two_lags()(omega) * noise).mean(BENCH_DT_S))
    assert found.model.poles.pairs.size == 0
    assert np.all(found.model.poles.real > 0)
    loop = found.model.to_control() * BENCH_LAW
    assert np.all(np.abs(control.feedback(loop, 1).poles()) < 1)


def held_mode(omega_rad_s, zeta, dt_s):
    """Discrete response of a lag and a light mode behind a zero-order hold."""
    mode = control.tf([0.05 * omega_rad_s**2], [1.0, 2 * zeta * omega_rad_s, omega_rad_s**2])
    system = control.sample_system(control.ss(control.tf([1.0], [0.1, 1.0]) + mode), dt_s)
    return lambda omega: np.asarray(system(np.exp(1j * omega * dt_s)))


@pytest.mark.parametrize(
    ("mode_rad_s", "points"),
    [pytest.param(460.0, 30, marks=pytest.mark.slow), (61.0, 25)],
    ids=["above the last", "between two"],
)
def test_a_mode_whose_flanks_are_measured_is_kept(mode_rad_s, points):
    """Above the last frequency, or between two that are many of its widths apart."""
    zeta = 0.004
    omega = np.geomspace(1.0, 400.0, points)
    assert np.abs(omega - mode_rad_s).min() > 5 * zeta * mode_rad_s
    response = stated(held_mode(mode_rad_s, zeta, BENCH_DT_S), omega, 0.001, BENCH_DT_S)
    found = identify_frf(response, IdentOptions(n_real=1, n_pairs=1))
    modes = found.model.poles.omega_rad_s(BENCH_DT_S)
    nearest = int(np.argmin(np.abs(modes - mode_rad_s)))
    assert modes[nearest] == pytest.approx(mode_rad_s, rel=1e-3)
    assert found.model.poles.zeta()[nearest] == pytest.approx(zeta, rel=0.2)


@pytest.mark.slow
def test_a_stated_direct_term_is_kept_whatever_the_poles_do():
    response = stated(two_lags(), np.geomspace(2.0, 400.0, 60), 0.008, BENCH_DT_S)
    assert identify_frf(response, IdentOptions(feedthrough=False)).model.feedthrough == 0.0
    free = fitted_bench()
    said = only(free.verdicts, FindingKind.RESPONSE_AT_ONCE)
    assert said["direct_term"] == free.model.feedthrough != 0.0


@pytest.mark.slow
def test_what_the_model_assumes_outside_the_table_is_said():
    said = only(fitted_bench().verdicts, FindingKind.ASSUMED_OUTSIDE)
    assert (said["low_rad_s"], said["high_rad_s"]) == pytest.approx((2.0, 400.0))
    assert said["largest_below"] == pytest.approx(1.2, rel=0.01)
    assert said["gain_at_high"] == pytest.approx(abs(two_lags()(400.0)), rel=0.02)
    # Two lags fall on and on: nothing above the table is larger than its last point.
    assert said["largest_above"] == said["gain_at_high"] > said["gain_at_nyquist"]
