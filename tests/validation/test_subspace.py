"""PO-MOESP on data whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from tests.ident.benchmark_plants import DT_S, as_record, p1
from validation.comparators.subspace import moesp

OMEGA = np.geomspace(1, 600, 100)


def test_noise_free_data_give_the_plant():
    rng = np.random.default_rng(0)
    u = rng.normal(size=400)
    b, a = [0.0, 0.5, 0.3, -0.1], np.poly([0.9, 0.8 * np.exp(0.7j), 0.8 * np.exp(-0.7j)]).real
    model = moesp(as_record(u, scipy.signal.lfilter(b, a, u)), 3)
    response = scipy.signal.freqz(b, a, OMEGA * DT_S)[1]
    np.testing.assert_allclose(model.frequency_response(OMEGA), response, rtol=1e-8)
    np.testing.assert_allclose(np.sort_complex(model.poles), np.sort_complex(np.roots(a)), atol=1e-9)
    fresh = rng.normal(size=300)
    np.testing.assert_allclose(model.simulate(fresh), scipy.signal.lfilter(b, a, fresh), atol=1e-8)


def test_the_slow_mode_of_p1_needs_a_long_horizon():
    """The mode's period is 84 samples: ten samples do not show it under noise, 150 do."""
    truth = p1(0)
    natural = [np.abs(np.log(moesp(truth.record, 4, horizon=h).poles)) / DT_S for h in (10, 150)]
    assert np.all(np.abs(natural[0] - 15) > 5)
    assert np.min(np.abs(natural[1] - 15)) < 0.1


@pytest.mark.parametrize(("order", "horizon"), [(4, 4), (0, 10), (2, 80)])
def test_settings_that_cannot_work_are_refused(order, horizon):
    u = np.random.default_rng(0).normal(size=300)
    with pytest.raises(ValueError, match="horizon"):
        moesp(as_record(u, u), order, horizon=horizon)
