"""Scatter between conditions: coverage of the next one, the coefficient form frequency by frequency."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal
from scipy.stats import chi2, f

from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.record import Record
from ident.uncertainty.conditions import combine_posteriors, record_posteriors
from ident.uncertainty.embedding import EmbeddingOptions

DT = 0.01
OMEGA = np.geomspace(1.0, 300.0, 25)
POLES = Poles([0.9], [0.9 * np.exp(0.4j)])
SPREAD = np.array([0.2, 0.3, 0.1])


def condition(rng, noise=0.02):
    """A plant drawn from the random-effects model, and its estimate."""
    true = np.array([1.0, -0.5, 0.8]) + SPREAD * rng.standard_normal(3)
    estimate = true + noise * rng.standard_normal(3)
    return true, ResponsePosterior(POLES, estimate, noise * np.eye(3), DT)


@pytest.mark.parametrize(("level", "expected"), [(0.95, 0.95), (None, 0.79)])
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
        records.append(Record(f"g{gain}", u[:, None], y[:, None], DT, ("u",), ("y",)))
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


def test_what_cannot_be_combined_is_refused():
    rng = np.random.default_rng(4)
    one = condition(rng)[1]
    other = ResponsePosterior(Poles([0.8, 0.7, 0.1]), one.mean, one.covariance_factor, DT)
    with pytest.raises(ValueError, match="at least two"):
        combine_posteriors([one])
    with pytest.raises(ValueError, match="differ in poles"):
        combine_posteriors([one, other])
    with pytest.raises(ValueError, match="at least four"):
        combine_posteriors([one, one, one], small_sample_level=0.95)
