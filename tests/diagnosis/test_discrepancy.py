"""What is left over: white noise leaves nothing, a little in one band is seen, energies add up."""

import numpy as np
import pytest
import scipy.signal
from scipy.integrate import quad
from scipy.stats import chi2

from diagnosis.fit.discrepancy import _log_factor, discrepancy

SEGMENTS = [1400, 1001, 1200]


def _noise(rng):
    return rng.standard_normal(2 * sum(SEGMENTS))


def test_white_noise_leaves_nothing():
    generators = map(np.random.default_rng, range(60))
    gains = np.array([discrepancy(_noise(rng), SEGMENTS).log_gain for rng in generators])
    # A Bayes factor above 20 against the truth comes in fewer than 1 of 20 cases, whatever the alternatives.
    assert np.mean(gains > np.log(20)) <= 0.05
    assert np.median(gains) < 0


@pytest.mark.parametrize("output", [0, 1])
def test_a_quarter_of_the_noise_in_one_octave_is_plain(output):
    rng = np.random.default_rng(1)
    e = _noise(rng).reshape(-1, 2)
    b, a = scipy.signal.butter(4, [0.035, 0.058], "bandpass")
    added = scipy.signal.lfilter(b, a, rng.standard_normal(e.shape[0] + 500))[500:]
    added *= 0.25 / np.std(added)
    plain = discrepancy(e.ravel(), SEGMENTS)
    e[:, output] += added
    found = discrepancy(e.ravel(), SEGMENTS)
    # Of all samples this is 3 % more energy: 1.9 standard deviations of 7202 squares.
    assert np.mean(e**2) < 1 + 3 * np.sqrt(2 / e.size)
    assert found.log_gain > 10 > plain.log_gain
    assert found.size == pytest.approx(0.25 / np.sqrt(2), rel=0.3)


def test_size_of_white_energy_is_its_rms():
    rng = np.random.default_rng(2)
    found = discrepancy(3.0 * _noise(rng), SEGMENTS)
    # Energies of all lines add up to the sum of squares: sqrt(9 - 1), to the scatter of 7202 squares.
    assert found.size == pytest.approx(np.sqrt(8), rel=4 * np.sqrt(2 / 7202))


@pytest.mark.parametrize(("n", "ratio"), [(40.0, 1.0), (40.0, 3.0), (900.0, 1.4), (900.0, 20.0)])
def test_factor_of_a_band_is_the_integral_over_its_size(n, ratio):
    S = n * ratio
    low, high = np.log(2.5 * np.sqrt(2 / n)), np.log(1e4)

    peak = np.log(max(ratio - 1, np.exp(low)))
    top = chi2.logpdf(S / (1 + np.exp(peak)), n) - chi2.logpdf(S, n)

    def density(log_s):
        scale = 1 + np.exp(log_s)
        return np.exp(chi2.logpdf(S / scale, n) - np.log(scale) - chi2.logpdf(S, n) - top) / (high - low)

    integral, _ = quad(density, low, high, points=[peak], limit=400)
    # Grid of 1500 points: the ends count whole cells.
    assert _log_factor(n, S) == pytest.approx(top + np.log(integral), abs=0.02)


def test_some_and_any_differ_by_the_case_of_nothing():
    found = discrepancy(_noise(np.random.default_rng(5)), SEGMENTS)
    nothing = 18 * np.log(1 - 0.15)
    some = np.log((np.exp(found.log_gain) - np.exp(nothing)) / (1 - np.exp(nothing)))
    assert found.log_gain_some == pytest.approx(some, abs=1e-9)


def test_wrong_length_is_refused():
    with pytest.raises(ValueError, match="segments"):
        discrepancy(np.zeros(10), [6])
