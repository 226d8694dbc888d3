"""Exact geometry of the ellipses against sampling of their boundary and against numpy's eigenvalues."""

import numpy as np
import pytest
from scipy.stats import chi2

from control_design.plants.ellipses import (
    Ellipses,
    distance_to_minus_one,
    farthest_distance,
    largest_disturbance_gain,
    nearest_distance,
)

_ANGLES = np.linspace(0, 2 * np.pi, 4001)


def _random(rng: np.random.Generator, n: int) -> Ellipses:
    major = 10 ** rng.uniform(-2, 0.5, n)
    minor = major * 10 ** rng.uniform(-4, 0, n)
    centre = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    return Ellipses(np.arange(n) + 1.0, centre, major, minor, np.exp(1j * rng.uniform(0, 2 * np.pi, n)))


def _boundary(e: Ellipses) -> np.ndarray:
    return np.array([e.points(np.cos(f), np.sin(f)) for f in _ANGLES])


def test_nearest_and_farthest_distance_agree_with_the_sampled_boundary():
    rng = np.random.default_rng(1)
    e = _random(rng, 500)
    point = 2 * (rng.standard_normal(500) + 1j * rng.standard_normal(500))
    turned = (point - e.centre) * np.conj(e.direction)
    boundary = np.abs(_boundary(e) - point)
    near = nearest_distance(turned, e.semi_major, e.semi_minor)
    far = farthest_distance(turned, e.semi_major, e.semi_minor)
    inside = (turned.real / e.semi_major) ** 2 + (turned.imag / e.semi_minor) ** 2 <= 1
    # Boundary step h = 2 pi a/4000: the sampled distance is off by at most h (first order at thin ends).
    step = 2 * np.pi * e.semi_major / 4000
    assert np.all(near[inside] == 0)
    assert np.all(near[~inside] <= boundary.min(axis=0)[~inside] + 1e-12)
    assert np.all(near[~inside] >= (boundary.min(axis=0) - step)[~inside])
    assert np.all(far >= boundary.max(axis=0) - 1e-12)
    assert np.all(far <= boundary.max(axis=0) + step)


def test_degenerate_ellipses_are_points_and_segments():
    point = np.array([3 + 4j, 2 + 1j, 0.5 + 1j, 0j])
    a, b = np.array([0.0, 1.0, 1.0, 1.0]), np.zeros(4)
    np.testing.assert_allclose(nearest_distance(point, a, b), [5, np.sqrt(2), 1, 0], rtol=1e-12)
    np.testing.assert_allclose(
        farthest_distance(point, a, b), [5, np.hypot(3, 1), np.hypot(1.5, 1), 1], rtol=1e-12
    )
    circle = np.array([2.0])
    np.testing.assert_allclose(nearest_distance(np.array([3 + 4j]), circle, circle), [3], rtol=1e-12)
    np.testing.assert_allclose(farthest_distance(np.array([3 + 4j]), circle, circle), [7], rtol=1e-12)


def test_ellipse_of_a_covariance_is_the_set_of_the_chi_square_quantile():
    rng = np.random.default_rng(2)
    root = rng.standard_normal((50, 2, 2))
    covariance = root @ root.transpose(0, 2, 1)
    e = Ellipses.from_covariance(np.arange(50) + 1.0, np.zeros(50, complex), covariance, 0.9)
    values = np.linalg.eigvalsh(covariance) * chi2.ppf(0.9, 2)
    np.testing.assert_allclose(e.semi_minor, np.sqrt(values[:, 0]), rtol=1e-7)
    np.testing.assert_allclose(e.semi_major, np.sqrt(values[:, 1]), rtol=1e-12)
    for f in (0.3, 1.0, 4.0):
        v = e.points(np.cos(f), np.sin(f))
        v = np.stack([v.real, v.imag], axis=-1)
        form = np.einsum("fi,fij,fj->f", v, np.linalg.inv(covariance), v)
        np.testing.assert_allclose(form, chi2.ppf(0.9, 2), rtol=1e-6)


@pytest.mark.parametrize(
    "covariance", [[[1, 2], [2, 1]], [[1, 0.5], [-0.5, 1]], [[np.nan, 0], [0, 1]], [[-1, 0], [0, -1]]]
)
def test_a_covariance_that_is_none_is_refused_with_its_frequency(covariance):
    both = np.array([np.eye(2), covariance])
    with pytest.raises(ValueError, match=r"at 7 rad/s is not symmetric positive semi-definite"):
        Ellipses.from_covariance(np.array([1.0, 7.0]), np.zeros(2, complex), both, 0.95)


def test_distance_of_the_loop_and_worst_gain_agree_with_sampling_members():
    rng = np.random.default_rng(3)
    e = _random(rng, 400)
    k = rng.standard_normal(400) + 1j * rng.standard_normal(400)
    k *= 10 ** rng.uniform(-2, 1, 400)
    members = _boundary(e)
    distance = distance_to_minus_one(k, e)
    sampled = np.abs(1 + members * k).min(axis=0)
    clear = distance > 0.02 * np.abs(k) * e.semi_major
    assert clear.sum() > 100
    # Second-order error of the sampled minimum: (h |k| a)^2 / (2 distance) with h = 2 pi/4000.
    step = 2 * np.pi / 4000 * np.abs(k) * e.semi_major
    slack = step**2 / (2 * distance + 1e-30) + step**2 / (e.semi_minor * np.abs(k)) + 1e-9
    assert np.all(distance[clear] <= sampled[clear] + 1e-12)
    assert np.all(distance[clear] >= (sampled - slack)[clear])
    gain = largest_disturbance_gain(k, e)
    ratio = np.abs(members / (1 + members * k)).max(axis=0)
    assert np.all(gain[clear] >= ratio[clear] * (1 - 1e-9))
    # First order in the step is the cautious bound of how much a sample can miss.
    reach = (3 * step)[clear] / distance[clear]
    assert np.all(gain[clear] <= ratio[clear] * (1 + reach) + reach / np.abs(k)[clear])
    assert np.all(np.isinf(gain[distance == 0]))
