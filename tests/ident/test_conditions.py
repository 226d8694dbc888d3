"""Scatter between conditions: coverage of the next one, the coefficient form frequency by frequency."""

import numpy as np
import pytest
from scipy import signal
from scipy.stats import chi2, f

from ident import GobfModel, Poles, Record
from ident.basis.options import EmbeddingOptions
from ident.basis.posterior import ResponsePosterior
from ident.uncertainty.conditions import combine_posteriors, record_posteriors, repeat_posteriors

DT = 0.01
OMEGA = np.geomspace(1.0, 300.0, 25)
POLES = Poles([0.9], [0.9 * np.exp(0.4j)])
SPREAD = np.array([0.2, 0.3, 0.1])


def condition(rng, noise=0.02):
    """A plant drawn from the random-effects model, and its estimate."""
    true = np.array([1.0, -0.5, 0.8]) + SPREAD * rng.standard_normal(3)
    estimate = true + noise * rng.standard_normal(3)
    return true, ResponsePosterior(POLES, estimate, noise * np.eye(3), DT)


@pytest.mark.parametrize(
    ("level", "expected"), [(0.95, 0.95), pytest.param(None, 0.79, marks=pytest.mark.long)]
)
def test_next_condition_is_covered_at_the_small_sample_level(level, expected):
    hits = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        posteriors = [condition(rng)[1] for _ in range(6)]
        truth = condition(rng)[1].centre(OMEGA)
        combined = combine_posteriors(posteriors, small_sample_level=level)
        hits.append(combined.at(OMEGA).contains(truth).mean())
    # One run counts about three independent frequencies: sd sqrt(0.05 x 0.95 / 1200) = 0.6 %, 4 of those.
    # Without the level the exact value is P(2 (K-1)/(K-2) F(2, K-2) < chi2) = 0.79 for K = 6.
    assert np.mean(hits) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(("level", "widening"), [(None, 1.0), (0.9, 3 * f.ppf(0.9, 2, 2) / chi2.ppf(0.9, 2))])
def test_coefficient_form_is_that_of_every_frequency(level, widening):
    rng = np.random.default_rng(1)
    posteriors = [condition(rng)[1] for _ in range(4)]
    combined = combine_posteriors(posteriors, small_sample_level=level).at(OMEGA)
    each = [posterior.at(OMEGA) for posterior in posteriors]
    centres = np.array([one.centre for one in each])
    np.testing.assert_allclose(combined.centre, centres.mean(axis=0), rtol=1e-12)
    between = np.array([np.cov(g.real, g.imag) for g in centres.T])
    within = np.mean([one.covariance for one in each], axis=0)
    expected = 1.25 * widening * between + within / 4
    np.testing.assert_allclose(combined.covariance, expected, rtol=1e-9, atol=1e-14)


def records_of_two_plants(rng, n=600):
    records = []
    for gain in (0.9, 1.0, 1.1, 1.2):
        u = rng.standard_normal(n)
        y = gain * signal.lfilter([0.0, 0.3], [1.0, -0.9], u) + 0.01 * rng.standard_normal(n)
        records.append(Record(u[:, None], y[:, None], DT, name=f"g{gain}"))
    return records


def test_records_of_different_gain_give_an_ellipse_of_that_gain_spread():
    records = records_of_two_plants(np.random.default_rng(2))
    model = GobfModel(Poles([0.9]), np.zeros(1), DT)
    posteriors = record_posteriors(records, model, EmbeddingOptions(fir_length=20))
    assert {p.fir_length for p in posteriors} == {20}
    combined = combine_posteriors(posteriors).at(OMEGA)
    ideal = 0.3 / (np.exp(1j * OMEGA * DT) - 0.9)
    # Sample sd of the gains 0.129, times sqrt(1 + 1/4) and 2.448.
    np.testing.assert_allclose(combined.ellipse().semi_major / np.abs(ideal), 0.353, rtol=0.05)
    np.testing.assert_allclose(combined.centre / ideal, 1.05, atol=0.02)
    unequal = record_posteriors([records[0], records[1].slice(0, 120)], model)
    assert unequal[0].fir_length == unequal[1].fir_length < 150
    assert combine_posteriors(posteriors).report.method == "tangent embedding, 4 conditions"


def swept_repeats(rng):
    """Three sweeps of one plant; the noise is ten times as large in the second half, where the sweep is
    fast, and every sweep is distorted in the same way."""
    time = np.arange(1200)
    u = np.sin(np.pi * 0.4 / 1200 * time**2 / 2)
    distorted = 0.3 * np.abs(u) * np.cos(0.05 * time)
    level = np.where(time < 600, 0.02, 0.2)
    return [
        Record(
            u[:, None],
            (signal.lfilter([0.0, 0.3], [1.0, -0.9], u) + distorted + level * rng.standard_normal(1200))[
                :, None
            ],
            DT,
            name=f"{k}",
        )
        for k in range(3)
    ]


@pytest.mark.slow
def test_other_repeats_predict_the_scatter_where_noise_changes_and_distortion_repeats():
    model, options = GobfModel(Poles([0.9]), np.zeros(1), DT), EmbeddingOptions(fir_length=5)
    slow, fast = (OMEGA > 10) & (OMEGA < 40), (OMEGA > 80) & (OMEGA < 120)
    centres, own, others = [], [], []
    for seed in range(24):
        records = swept_repeats(np.random.default_rng(seed))
        for kept, posteriors in (
            (own, record_posteriors(records, model, options)),
            (others, repeat_posteriors([records], model, options)[0]),
        ):
            estimates = [posterior.at(OMEGA) for posterior in posteriors]
            kept += [np.trace(estimate.covariance, axis1=1, axis2=2) for estimate in estimates]
        centres += [estimate.centre for estimate in estimates]
    # The scatter over 72 independent sweeps is known to 10 %. The weights of the estimate are those of the
    # posterior, whose average over sizes of the kernel makes them up to a fifth too large here.
    predicted, plain = (np.mean(kept, axis=0) / np.var(centres, axis=0) for kept in (others, own))
    for band in (slow, fast):
        assert 0.85 < np.sqrt(predicted[band].mean()) < 1.4
    # Residuals of one record, taken for stationary noise.
    assert np.sqrt(plain[slow].mean()) > 2.5


def test_two_repeats_keep_the_noise_of_their_own_residuals():
    records = swept_repeats(np.random.default_rng(5))[:2]
    model, options = GobfModel(Poles([0.9]), np.zeros(1), DT), EmbeddingOptions(fir_length=5)
    (pair,) = repeat_posteriors([records], model, options)
    for one, other in zip(pair, record_posteriors(records, model, options), strict=True):
        np.testing.assert_array_equal(one.covariance_factor, other.covariance_factor)


def test_what_cannot_be_combined_is_refused():
    rng = np.random.default_rng(4)
    one = condition(rng)[1]
    other = ResponsePosterior(Poles([0.8, 0.7, 0.1]), one.mean, one.covariance_factor, DT)
    with pytest.raises(ValueError, match=r"two.* 1$"):
        combine_posteriors([one])
    with pytest.raises(ValueError, match="poles"):
        combine_posteriors([one, other])
    with pytest.raises(ValueError, match=r"four.* 3$"):
        combine_posteriors([one, one, one], small_sample_level=0.95)
