"""Second-order expansions hold at every sampled frequency; those of coefficients that cancel are tight."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from control_design.plants import second_order
from control_design.plants.first_order import FrequencyIntervals
from control_design.plants.second_order import SecondOrder
from control_design.plants.set_expansion import posterior_expansion
from ident import Poles
from ident.uncertainty import ResponsePosterior

_DT = 0.005
_INSIDE = np.linspace(-1.0, 1.0, 401)


def _used(expansion: SecondOrder, truth: np.ndarray, offsets: np.ndarray) -> float:
    """Largest part of the remainder that truth (S,) at offsets (S,) from the middle of one interval uses."""
    polynomial = expansion.value + expansion.slope * offsets + expansion.curvature * offsets**2 / 2
    # Rounding: the values themselves carry 1e-13 of their size.
    allowed = expansion.remainder[0] + 1e-12 * np.abs(truth) + 1e-300
    return float(np.max(np.abs(truth - polynomial) / allowed))


def _interval(centre: float, half_width: float) -> tuple[FrequencyIntervals, np.ndarray, np.ndarray]:
    """One interval, z (S,) at frequencies in it, and their offsets from its middle in rad/s."""
    offsets = _INSIDE * half_width
    z = np.exp(1j * (centre + offsets) * _DT)
    return FrequencyIntervals(np.array([centre]), np.array([half_width]), _DT), z, offsets


@given(
    radius=st.floats(0.0, 1.2).filter(lambda r: abs(r - 1) > 1e-4),
    angle=st.floats(0.0, np.pi),
    theta=st.floats(0.0, np.pi),
    width=st.floats(1e-4, 0.5),
    samples=st.integers(-150, 3),
)
def test_factors_and_their_products_hold_over_their_interval(radius, angle, theta, width, samples):
    root = complex(radius * np.exp(1j * angle))
    interval, z, offsets = _interval(theta / _DT, width / _DT)
    pole = second_order.pole(interval, root - 1)
    zero = second_order.linear(interval, 0.3 - 2j, 1j)
    shift = second_order.shift(interval, samples)
    linear = 0.3 - 2j + 1j * (z - 1)
    assert _used(pole, 1 / (z - root), offsets) <= 1
    assert _used(zero, linear, offsets) <= 1
    assert _used(shift, z**samples, offsets) <= 1
    assert _used(pole.times(zero), linear / (z - root), offsets) <= 1
    assert _used(shift.times(pole) + zero.scaled(3j), z**samples / (z - root) + 3j * linear, offsets) <= 1


def test_remainder_of_a_product_is_of_third_order_and_close_to_the_truth():
    root = complex(0.98 * np.exp(0.1j))
    remainders = []
    for width in (0.1, 0.05, 0.025):
        interval, z, offsets = _interval(20.0, width)
        product = second_order.pole(interval, root - 1).times(second_order.linear(interval, 0.5, 1.0))
        assert 0.3 <= _used(product, (z - 0.5) / (z - root), offsets) <= 1
        remainders.append(product.remainder[0])
    # Halving the width leaves an eighth of the bound.
    np.testing.assert_allclose(np.array(remainders[1:]) / remainders[:-1], 0.125, rtol=0.05)


@pytest.mark.parametrize("size", [1.0, 1e6])
def test_coefficients_that_nearly_cancel_leave_the_remainder_of_what_is_left(size):
    # z^-1 (1 - z^-1)^4 times a size, as centre and as the one generator. The second derivatives of the lags,
    # added up by their sizes, are 53 times that of the sum.
    interval, z, offsets = _interval(centre=100.0, half_width=0.1)
    difference = size * np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    posterior = ResponsePosterior(
        poles=Poles(np.zeros(0), np.zeros(0, complex)), mean=difference,
        covariance_factor=difference[:, None], dt_s=_DT, fir_length=5, has_feedthrough=False,
    )  # fmt: skip
    truth = size * (z - 1) ** 4 / z**5
    for expansion in posterior_expansion(posterior, interval, 0):
        value, slope = expansion.value.reshape(1), expansion.slope.reshape(1)
        rest = np.max(np.abs(truth - value - slope * offsets))
        assert rest <= expansion.remainder[0] <= 1.2 * rest
