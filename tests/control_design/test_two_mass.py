"""Two masses and a spring: the published design's peaks, python-control, and our designs' coefficients."""

from __future__ import annotations

import control
import numpy as np
import pytest

from benchmarks.two_mass import CHAIT, DC_GAIN, HIGH_GAIN, Design, dense_peaks, optimised, peaks

_ORDER_3 = Design(np.array([0.08, 0.205118, 0.019744]), np.array([1.0, 1.700326, 1.524231, 0.617015]))


def test_published_qft_design_has_its_published_peaks():
    s_peak, t_peak = dense_peaks(CHAIT)
    assert s_peak == pytest.approx(2.191, abs=6e-4)
    assert t_peak == pytest.approx(1.618, abs=6e-4)
    assert CHAIT.dc_gain == pytest.approx(DC_GAIN)
    assert CHAIT.high_gain == pytest.approx(HIGH_GAIN)


@pytest.mark.parametrize("k", [0.5, 1.0, 2.0])
def test_peaks_agree_with_python_control(k):
    omega = np.geomspace(1e-2, 30, 5000)
    plant = control.tf([k], np.polymul([1, 0, 0], [1, 0, 2 * k]))
    loop = plant * control.tf(_ORDER_3.numerator, _ORDER_3.denominator)
    closed = control.feedback(1, loop), control.feedback(loop, 1)
    s_peak, t_peak = (float(np.max(np.abs(np.asarray(part(1j * omega))))) for part in closed)
    ours = dense_peaks(_ORDER_3, np.array([k]))
    assert ours == pytest.approx((s_peak, t_peak), rel=1e-4)


def test_unstable_loop_has_no_peak():
    wrong = Design(-CHAIT.numerator, CHAIT.denominator)
    assert dense_peaks(wrong) == (np.inf, np.inf)
    value = peaks(wrong.numerator[None], wrong.denominator[None], np.array([1.0]), np.array([1.0]))
    assert value[0][0, 0] == np.inf


def test_order_3_design_meets_its_figure():
    assert max(dense_peaks(_ORDER_3)) <= 1.62
    assert _ORDER_3.dc_gain >= DC_GAIN * (1 - 1e-4)  # six printed digits
    assert _ORDER_3.high_gain <= HIGH_GAIN


def test_order_2_search_reaches_its_figure():
    design = optimised(2, 2)
    assert max(dense_peaks(design)) <= 1.79
    assert design.dc_gain >= DC_GAIN * (1 - 1e-9)
    assert design.high_gain <= HIGH_GAIN * (1 + 1e-9)
