"""The whole identification on data whose truth is known, and on data it must refuse."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from ident import IdentOptions, identify
from ident.data.finding import FindingKind
from ident.fit.problem import residual_colour
from tests.ident import benchmark_plants as plants
from tests.ident.findings import kinds
from tests.workflow.test_codec import same

OMEGA = np.geomspace(0.1, 600, 400)
MIDDLE = (OMEGA >= 1) & (OMEGA <= 100)


def relative_error(truth, model, omega=OMEGA[MIDDLE]):
    response = truth.response(omega)
    return np.sqrt(np.mean(np.abs(model.frequency_response(omega) / response - 1) ** 2))


@pytest.fixture(scope="module")
def p2_fit():
    truth = plants.p2(0)
    return truth, identify([truth.record])


def test_p1_without_prior_knowledge():
    """No numbers given: two slow real poles and the 15 rad/s mode are found, and the response is right.

    Cramer-Rao bound of the RMS relative error over 1-100 rad/s with 8 unknowns: 0.063. Measured over 50
    seeds: median 0.034, 90th percentile 0.076.
    """
    errors = []
    for seed in range(3):
        truth = plants.p1(seed)
        result = identify([truth.record])
        poles = result.model.poles
        assert (poles.real.size, poles.pairs.size) == (2, 1)
        assert poles.omega_rad_s(0.005)[0] == pytest.approx(15, rel=0.01)
        assert poles.zeta()[0] == pytest.approx(0.015, abs=0.003)
        assert result.noise_std == pytest.approx(truth.noise_std, rel=0.1)  # 4 sd of sqrt(1/2N)
        errors.append(relative_error(truth, result.model))
    assert np.median(errors) < 0.06


@pytest.mark.parametrize("n_modes", plants.P3_MODES)
def test_p3_the_global_optimum_is_found(n_modes):
    """Three and five modes beside 1/(s^2 + 0.3 s): within 2 % of the variance of the noise."""
    for snr_db in (30, 50):
        truth = plants.p3(n_modes, 0, snr_db)
        found = identify([truth.record], IdentOptions(n_real=2, n_pairs=n_modes))
        assert found.rss <= 1.02 * truth.clean.size * truth.noise_std**2


def test_p2_all_modes_are_found_without_being_told(p2_fit):
    truth, result = p2_fit
    poles = result.model.poles
    order = np.argsort(poles.omega_rad_s(0.005))
    np.testing.assert_allclose(poles.omega_rad_s(0.005)[order] / 2 / np.pi, plants.P2_HZ, rtol=0.01)
    np.testing.assert_allclose(poles.zeta()[order], plants.P2_ZETA, atol=0.008)
    np.testing.assert_allclose(np.sort(poles.decay_per_s(0.005)), [0.1, 25], rtol=0.1)
    # sqrt(1/2N) = 1.6 %, four of them.
    assert result.noise_std == pytest.approx(truth.noise_std, rel=0.065)
    assert result.tangent_optimality < 1e-3
    assert relative_error(truth, result.model, np.geomspace(0.3, 190, 100)) < 0.15


def test_p2_order_table_shows_the_choice(p2_fit):
    _, result = p2_fit
    best = min(result.order_table, key=lambda step: step.criterion)
    assert (best.n_real, best.n_pairs) == (2, 3)
    assert any(step.order > best.order for step in result.order_table)
    assert [step.order for step in result.order_table] == sorted(step.order for step in result.order_table)


def test_p2_residuals_and_fit_belong_together(p2_fit):
    truth, result = p2_fit
    (residual,), y = result.residuals, truth.record.output[:, 0]
    assert residual @ residual == pytest.approx(result.rss)
    assert result.fit_percent[0] == pytest.approx(
        100 * (1 - np.linalg.norm(residual) / np.linalg.norm(y - y.mean()))
    )
    assert not result.structure.estimate_initial_state
    np.testing.assert_allclose(y - result.model.simulate(truth.record.input[:, 0]), residual, atol=1e-12)


def test_the_same_data_give_the_same_numbers():
    truth = plants.p1(4)
    options = IdentOptions(n_real=2, n_pairs=1, algorithm="GN_DIRECT_L_RAND")
    assert same(*(identify([truth.record], options) for _ in range(2)))


def test_progress_is_reported():
    seen = []
    options = IdentOptions(n_real=2, n_pairs=1)
    identify([plants.p1(0).record], options, progress=lambda f, m: seen.append((f, m)))
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert all(isinstance(message, str) and message for _, message in seen)


def test_unknown_initial_states_and_offsets_are_taken_care_of():
    """The middle of a record starts from a state nobody knows, on an output with a bias."""
    truth = plants.p2(1, 3000)
    pieces = [truth.record.slice(1000, 2000), truth.record.slice(2000, 3000)]
    pieces = [
        replace(piece, output=piece.output + bias) for piece, bias in zip(pieces, (2.0, -1.0), strict=True)
    ]
    result = identify(pieces, IdentOptions(n_real=2, n_pairs=3))
    assert result.structure.estimate_initial_state
    assert result.structure.estimate_offset
    assert len(result.verdicts) == 2
    # The mode at 2.5 Hz to its precision, and the noise level: nothing of the transients is left in the
    # residual.
    assert np.min(np.abs(result.model.poles.omega_rad_s(0.005) / 2 / np.pi - 2.5)) < 0.01
    assert result.noise_std == pytest.approx(truth.noise_std, rel=0.065)


def test_long_records_are_searched_on_a_part_and_polished_on_all():
    truth = plants.p2(3, 6000)
    whole = identify([truth.record], IdentOptions(n_real=2, n_pairs=3))
    part = identify([truth.record], IdentOptions(n_real=2, n_pairs=3, search_samples=2000))
    assert part.rss == pytest.approx(whole.rss, rel=1e-6)
    assert part.residuals[0].size == 6000


def test_noise_free_data_end_at_rounding_without_spurious_poles():
    truth = plants.p2(0)
    clean = plants.as_record(truth.record.input[:, 0], truth.clean)
    result = identify([clean])
    assert np.sqrt(result.rss) < 1e-6 * np.linalg.norm(truth.clean)
    np.testing.assert_allclose(
        np.sort(result.model.poles.omega_rad_s(0.005)) / 2 / np.pi, plants.P2_HZ, rtol=1e-4
    )


def test_delay_and_feedthrough():
    rng = np.random.default_rng(0)
    u = rng.normal(size=800)
    y = scipy.signal.lfilter([0, 0, 0, 0.5, 0.3], [1, -0.8], u) + 0.01 * rng.normal(size=800)
    result = identify(
        [plants.as_record(u, y)], IdentOptions(n_real=1, n_pairs=0, input_delay_samples=3, feedthrough=True)
    )
    assert result.model.poles.real[0] == pytest.approx(0.8, abs=0.005)
    assert result.model.feedthrough == pytest.approx(0.5, abs=0.002)
    assert result.residuals[0].size == 797
    np.testing.assert_allclose(result.model.simulate(u)[3:], y[3:], atol=0.06)


def test_known_poles_stay_where_they_are():
    truth = plants.p1(0)
    slow = 1 - 1e-6
    result = identify(
        [truth.record], IdentOptions(fixed_poles=((slow, 0.0), (slow, 0.0)), n_real=0, n_pairs=1)
    )
    np.testing.assert_array_equal(result.model.poles.real, [slow, slow])
    assert result.model.poles.omega_rad_s(0.005)[0] == pytest.approx(15, rel=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed_poles": ((1.2, 0.0),)}, "inside the unit circle"),
        ({"fixed_poles": ((0.5, -0.1),)}, "positive imaginary part"),
        ({"omega_min_rad_s": 5.0, "omega_max_rad_s": 4.0}, "omega_min_rad_s must be below"),
        ({"coordinates": "raw", "zeta_min": 0.1}, "need coordinates = 'log'"),
        ({"n_poles": 3}, "n_poles"),
        ({"algorithm": "DIRECT"}, "algorithm"),
        ({"n_real": -1}, "n_real"),
    ],
)
def test_bad_options_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        IdentOptions(**options)


def test_a_constant_signal_is_refused_by_record_column_and_value():
    k = np.arange(100.0)
    with pytest.raises(ValueError, match=r"'test'.*'u'.*2"):
        identify([plants.as_record(np.full(100, 2.0), k)])
    with pytest.raises(ValueError, match=r"'test'.*'y'"):
        identify([plants.as_record(k, np.full(100, 2.0))])


def test_too_few_samples_for_the_order_are_refused():
    rng = np.random.default_rng(0)
    record = plants.as_record(rng.normal(size=12), rng.normal(size=12))
    # Samples, order and unknowns.
    with pytest.raises(ValueError, match=r"'test'\D+12\D+8\D+17"):
        identify([record], IdentOptions(n_real=2, n_pairs=3))


def test_poles_at_a_bound_come_with_advice():
    truth = plants.p1(1)
    result = identify([truth.record], IdentOptions(n_real=2, n_pairs=1, omega_min_rad_s=20.0))
    assert FindingKind.FREQUENCY_BOUND in kinds(result.warnings)
    result = identify([truth.record], IdentOptions(n_real=2, n_pairs=1, zeta_min=0.05))
    assert FindingKind.DAMPING_BOUND in kinds(result.warnings)


def test_an_overdamped_pair_is_named():
    rng = np.random.default_rng(0)
    u = rng.normal(size=1000)
    y = scipy.signal.lfilter([0, 1, 0.4], np.polymul([1, -0.95], [1, -0.6]), u) + 0.05 * rng.normal(size=1000)
    result = identify([plants.as_record(u, y)], IdentOptions(n_real=0, n_pairs=1))
    assert FindingKind.OVERDAMPED_PAIR in kinds(result.warnings)


def test_effective_samples_of_white_and_coloured_noise():
    rng = np.random.default_rng(0)
    white = rng.normal(size=20_000)
    starts = np.array([0, 10_000, 20_000])
    assert residual_colour(white, starts).effective_samples > 0.9 * 20_000
    coloured = scipy.signal.lfilter([1], [1, -0.9], white)
    # AR(1): 1 + 2 sum 0.81^k = (1 + 0.81)/(1 - 0.81) = 9.5.
    worth = residual_colour(coloured, starts).effective_samples
    assert worth == pytest.approx(20_000 / 9.53, rel=0.15)


def test_a_free_decay_is_recognised():
    """Next to no input, a state nobody knows: found by the free responses, although nothing is driven."""
    rng = np.random.default_rng(0)
    k = np.arange(600)
    u = 1e-3 * rng.normal(size=600)
    y = 0.99**k * np.cos(0.2 * k) + 1e-3 * rng.normal(size=600)
    result = identify([plants.as_record(u, y)])
    assert result.structure.estimate_initial_state
    # Standard deviation of the decay rate about 1e-3 times the rate's square root over the amplitude: 1e-5.
    assert np.min(np.abs(result.model.poles.pairs - 0.99 * np.exp(0.2j))) < 1e-4


def test_unrelated_signals_give_no_poles_and_say_so():
    rng = np.random.default_rng(0)
    result = identify([plants.as_record(rng.normal(size=500), rng.normal(size=500))])
    assert result.model.order == 0
    assert FindingKind.NO_POLE in kinds(result.warnings)


def test_a_search_in_mid_record_does_not_change_what_was_asked_for():
    truth = plants.p2(0, 3000)
    u = np.concatenate([np.zeros(3000), truth.record.input[:, 0]])
    y = plants.run(truth.system, u) + truth.noise_std * np.random.default_rng(1).normal(size=6000)
    options = IdentOptions(n_real=2, n_pairs=3, search_samples=2000, estimate_initial_state=False)
    result = identify([plants.as_record(u, y)], options)
    assert not result.structure.estimate_initial_state
    assert np.all(np.diff(result.model.poles.omega_rad_s(0.005)) > 0)
    np.testing.assert_allclose(
        result.model.poles.omega_rad_s(0.005)[:2] / 2 / np.pi, plants.P2_HZ[:2], rtol=0.01
    )
