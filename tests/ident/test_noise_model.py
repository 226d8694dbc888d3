"""What every noise model promises, asked of each kind; and an embedding with one that is known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from ident.basis.arma_noise import ArmaNoise
from ident.basis.autoregressive_noise import WHITE_NOISE, AutoregressiveNoise
from ident.basis.options import EmbeddingOptions
from ident.uncertainty.embedding import tangent

from .three_mode_arm import OMEGA, random_arm

POLE_PAIR = np.real(np.poly([0.9 * np.exp(0.6j), 0.9 * np.exp(-0.6j)]))
ZERO_PAIR = np.real(np.poly([0.8 * np.exp(1.5j), 0.8 * np.exp(-1.5j)]))
# A new kind of noise gets its contract tested by an entry here.
MODELS = {
    "white": WHITE_NOISE,
    "autoregression, slow": AutoregressiveNoise(np.array([1.0, -0.9])),
    "autoregression, resonance": AutoregressiveNoise(POLE_PAIR),
    "autoregression of order 4": AutoregressiveNoise(np.array([1.0, -0.5, 0.1, -0.3, 0.2])),
    "ARMA white": ArmaNoise(np.ones(1), np.ones(1)),
    "ARMA, drift under sensor noise": ArmaNoise(np.array([1.0, -0.95]), np.array([1.0, -0.6])),
    "ARMA, moving average alone": ArmaNoise(np.ones(1), np.array([1.0, 0.7])),
    "ARMA, resonance and notch": ArmaNoise(POLE_PAIR, ZERO_PAIR),
    "ARMA, reflected": ArmaNoise.spectral_factor(np.array([1.0, -0.9]), np.array([1.0, -2.5])),
}
every_model = pytest.mark.parametrize("noise", MODELS.values(), ids=MODELS.keys())


def dense_covariance(noise, n):
    """Toeplitz covariance (n, n) from a long impulse response of H."""
    impulse = np.zeros(4000)
    impulse[0] = 1.0
    h = noise.coloured(impulse)
    gamma = np.array([h[k:] @ h[: h.size - k] for k in range(n)])
    lags = np.arange(n)
    return gamma[np.abs(lags[:, None] - lags)]


@every_model
def test_whitening_makes_the_noise_white_of_unit_variance_from_the_first_row_on(noise):
    n = noise.n_start + 40
    white = noise.whiten(np.eye(n))
    covariance = white @ dense_covariance(noise, n) @ white.T
    np.testing.assert_allclose(covariance, np.eye(n), atol=1e-8)
    assert not noise.drops_start


@every_model
def test_rows_after_the_start_are_whitened_by_the_filter_alone(noise):
    signals = np.random.default_rng(0).standard_normal((noise.n_start + 30, 2))
    after = noise.whiten(signals)[noise.n_start :]
    np.testing.assert_allclose(after, noise.without_start(signals), rtol=1e-12)


@every_model
def test_autocovariance_is_that_of_the_spectrum_and_of_the_impulse_response(noise):
    lags = 30
    gamma = noise.autocovariance(lags)
    assert gamma.shape == (lags + 1,)
    np.testing.assert_allclose(gamma, dense_covariance(noise, lags + 1)[0], atol=1e-10 * gamma[0])
    # The mean over so many lines is the integral over the circle but for lags of 4096, long forgotten.
    by_quadrature = gamma[0] * np.fft.irfft(noise.relative_spectrum(4096))[: lags + 1]
    np.testing.assert_allclose(by_quadrature, gamma, atol=1e-10 * gamma[0])


@every_model
def test_autocovariance_is_that_of_a_long_record(noise):
    record = noise.coloured(np.random.default_rng(1).standard_normal(200_000))
    gamma = noise.autocovariance(3)
    measured = [np.mean(record[k:] * record[: record.size - k]) for k in range(4)]
    # Standard deviation sqrt(2 sum of gamma_k^2 / T) of each; four of them.
    far = noise.autocovariance(500)
    deviation = np.sqrt(2 * (2 * far @ far - far[0] ** 2) / record.size)
    np.testing.assert_allclose(measured, gamma, atol=4 * deviation)


@every_model
def test_colouring_undoes_filtering(noise):
    signals = np.random.default_rng(2).standard_normal((300, 2))
    np.testing.assert_allclose(noise.coloured(noise.filtered(signals)), signals, atol=1e-9)


@every_model
def test_autoregressive_coefficients_whiten_as_the_model_does(noise):
    record = noise.coloured(np.random.default_rng(3).standard_normal(noise.n_start + 500))
    expanded = AutoregressiveNoise(np.array([1.0, *noise.ar_coefficients]))
    later = noise.filtered(record)[noise.n_start :]
    np.testing.assert_allclose(expanded.filtered(record)[noise.n_start :], later, atol=1e-6)


@every_model
def test_order_and_words_say_whether_it_is_white(noise):
    assert (noise.order == 0) == noise.is_white == (noise.words == "white noise")
    assert str(round(noise.predictable_percent)) in noise.words or noise.is_white
    assert 0 <= noise.predictable_percent < 100


@every_model
def test_white_noise_alone_leaves_signals_as_they_are(noise):
    signals = np.random.default_rng(4).standard_normal(noise.n_start + 50)
    assert np.array_equal(noise.whiten(signals), signals) == noise.is_white


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: AutoregressiveNoise(np.array([2.0, -0.9])),
        lambda: AutoregressiveNoise(np.array([1.0, np.nan])),
        lambda: AutoregressiveNoise(np.ones((1, 1))),
        lambda: AutoregressiveNoise(np.zeros(0)),
        lambda: ArmaNoise(np.array([0.5, -0.9]), np.ones(1)),
        lambda: ArmaNoise(np.ones(1), np.array([1.0, np.inf])),
    ],
)
def test_polynomials_that_are_no_monic_vector_are_refused(wrong):
    with pytest.raises(ValueError, match="_polynomial"):
        wrong()


def test_arma_noise_refuses_what_is_not_stationary_or_cannot_be_whitened():
    outside, on_circle, near_circle = (np.array([1.0, -root]) for root in (1.2, 1.0, 0.999))
    with pytest.raises(ValueError, match=r"a_polynomial.*1\.2"):
        ArmaNoise(outside, np.ones(1))
    with pytest.raises(ValueError, match="c_polynomial"):
        ArmaNoise(np.ones(1), on_circle)
    with pytest.raises(ValueError, match=r"c_polynomial.*\.999"):
        ArmaNoise(np.ones(1), near_circle)


def test_an_embedding_with_a_known_arma_noise_covers_where_white_noise_does_not():
    noise = ArmaNoise(np.array([1.0, -0.95]), np.array([1.0, -0.6]))
    options = EmbeddingOptions(prior_missed_mode=0.0, fir_length=40)
    known_hits = []
    white_hits = []
    for seed in range(6):
        rng = np.random.default_rng([84, seed])
        arm = random_arm(rng, n_samples=1000, snr_db=200.0)
        drift = noise.coloured(rng.standard_normal((1000, 1)))
        size = 0.03 * np.std(arm.record.output) / np.std(drift)
        record = replace(arm.record, output=arm.record.output + size * drift)
        known = tangent([record], arm.model(), options, noise=noise)
        assert known.report.ar_coefficients == noise.ar_coefficients
        known_hits.append(known.at(OMEGA).contains(arm.truth))
        white_hits.append(tangent([record], arm.model(), options).at(OMEGA).contains(arm.truth))
    # 98 and 36 % measured.
    assert np.mean(known_hits) > 0.9
    assert np.mean(white_hits) < 0.6


def test_a_record_too_short_for_a_known_noise_is_refused_by_name():
    arm = random_arm(np.random.default_rng(1), n_samples=300)
    long_memory = ArmaNoise(np.ones(1), np.array([1.0, -0.9]))
    with pytest.raises(ValueError, match=rf"{arm.record.name}.*{long_memory.n_start} rows"):
        tangent([arm.record], arm.model(), noise=long_memory)
