"""What is believed of stated values before any record."""

import numpy as np
import pytest

from diagnosis.fit.nominal import prior_cost, prior_curvature, prior_slope


@pytest.mark.parametrize("d", [0.0, 0.7, -1.9, 2.4, -3.3])
def test_slope_and_curvature_are_derivatives_of_the_cost(d):
    h = 1e-4
    below, here, above = (prior_cost(np.array([v])) for v in (d - h, d, d + h))
    assert (above - below) / (4 * h) == pytest.approx(prior_slope(np.array([d]))[0], abs=1e-6)
    # Exact for a piecewise parabola; 1e-8 / h^2 of rounding.
    curvature = (above - 2 * here + below) / (2 * h**2)
    assert curvature == pytest.approx(prior_curvature(np.array([d]))[0], abs=1e-5)


def test_it_is_gaussian_within_two_tolerances_and_stricter_beyond():
    inside = np.array([-2.0, -0.4, 1.3, 2.0])
    assert prior_cost(inside) == pytest.approx(float(inside @ inside), abs=0)
    for d in (2.1, 3.0, 5.0):
        assert prior_cost(np.array([d])) > d**2
        assert prior_cost(np.array([-d])) == prior_cost(np.array([d]))
