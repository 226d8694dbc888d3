from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from ident import IdentOptions, band_limited, identify
from ident.data.signal_filter import increments
from tests.ident.benchmark_plants import as_record


def test_band_removes_drift_and_keeps_the_model():
    rng = np.random.default_rng(0)
    u = rng.normal(size=4000)
    y = scipy.signal.lfilter([0, 0.1, 0.05], [1, -1.6, 0.8], u) + 0.01 * rng.normal(size=4000)
    drift = np.cumsum(np.cumsum(rng.normal(size=4000))) * 1e-3
    options = IdentOptions(n_real=0, n_pairs=1, estimate_initial_state=False)
    plain = identify([as_record(u, y + drift)], options)
    banded = identify([band_limited(as_record(u, y + drift), 20.0, 500.0, skip_s=1.0)], options)
    # The true pole: roots of z^2 - 1.6 z + 0.8.
    assert banded.model.poles.pairs[0] == pytest.approx(0.8 + 0.4j, abs=1e-3)
    assert abs(plain.model.poles.pairs[0] - (0.8 + 0.4j)) > 0.01
    np.testing.assert_allclose(
        banded.model.coefficients, identify([as_record(u, y)], options).model.coefficients, rtol=0.02
    )


@pytest.mark.parametrize(("low", "high"), [(20.0, None), (None, 20.0), (5.0, 50.0)])
def test_gain_is_one_inside_and_small_outside(low, high):
    k = np.arange(4000) * 0.005
    for omega in (1.0, 15.0, 300.0):
        record = as_record(np.sin(omega * k), np.sin(omega * k))
        gain = np.std(band_limited(record, low, high, skip_s=10).input) / np.std(record.input)
        inside = (low is None or omega > low) and (high is None or omega < high)
        assert (gain > 0.8) == inside  # 1/sqrt(1 + 0.75^4) = 0.87 at 15 of 20 rad/s


@pytest.mark.parametrize(
    ("band", "message"),
    [
        ({}, "lower or an upper"),
        ({"low_rad_s": 30.0, "high_rad_s": 20.0}, "30.0 to 20.0"),
        ({"high_rad_s": 700.0}, r"628\.319.*700"),
        ({"low_rad_s": -1.0}, r"628\.319.*-1"),
        ({"low_rad_s": 1.0, "skip_s": 100.0}, "skip_s = 100.* 100 samples"),
    ],
)
def test_bad_bands_are_refused(band, message):
    with pytest.raises(ValueError, match=message):
        band_limited(as_record(np.arange(100.0), np.arange(100.0)), **band)


def test_increments_are_differences_of_every_signal():
    y = np.arange(6.0)[:, None] ** 2
    u = np.array([0, 1, 0, 1, 1, 0.0])[:, None]
    record = replace(as_record(u[:, 0], y[:, 0], dt_s=0.1), reference=2 * u, reference_names=("r",))
    found = increments(record)
    np.testing.assert_array_equal(found.output[:, 0], [1, 3, 5, 7, 9])
    np.testing.assert_array_equal(found.input[:, 0], [1, -1, 1, 0, -1])
    np.testing.assert_array_equal(found.reference, 2 * found.input)
    with pytest.raises(ValueError, match="two samples"):
        increments(record.slice(0, 1))
