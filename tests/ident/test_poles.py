import numpy as np
import pytest
from hypothesis import given, strategies as st

from ident.basis.poles import Poles


@given(
    omega=st.floats(0.01, 500),
    zeta=st.floats(1e-4, 0.97),
    decay=st.floats(1e-3, 200),
    dt_s=st.floats(1e-4, 5e-3),
)
def test_continuous_and_discrete_poles_correspond(omega, zeta, decay, dt_s):
    poles = Poles.from_continuous(decay_per_s=[decay], omega_rad_s=[omega], zeta=[zeta], dt_s=dt_s)
    # |p| is stored to 1e-16 next to 1, so a decay of 1e-8 per sample is known to 1e-8 of itself.
    np.testing.assert_allclose(poles.omega_rad_s(dt_s), omega, rtol=1e-6)
    np.testing.assert_allclose(
        poles.zeta() * poles.omega_rad_s(dt_s), zeta * omega, rtol=1e-6, atol=1e-15 / dt_s
    )
    np.testing.assert_allclose(poles.decay_per_s(dt_s), decay, rtol=1e-6)


def test_values_are_all_poles_with_their_conjugates():
    poles = Poles([0.5, -0.2, 0.0], [0.9 * np.exp(0.3j), 0.7j])
    np.testing.assert_array_equal(np.sort_complex(poles.values), np.sort_complex(poles.values.conj()))
    assert poles.values.size == poles.order == 7


def test_doubled_keeps_neighbours_together():
    doubled = Poles([0.5, 0.9], [0.9j]).doubled()
    np.testing.assert_array_equal(doubled.real, [0.5, 0.5, 0.9, 0.9])
    np.testing.assert_array_equal(doubled.pairs, [0.9j, 0.9j])


@pytest.mark.parametrize(
    ("real", "pairs", "message"),
    [
        ([1.0], [], "inside the unit circle"),
        ([np.nan], [], "inside the unit circle"),
        ([], [1.0j], "inside the unit circle"),
        ([], [complex(np.nan, 0.1)], "inside the unit circle"),
        ([], [0.5 - 0.1j], "positive imaginary part"),
        ([], [0.5 + 0j], "positive imaginary part"),
        ([[0.5]], [], "1-d"),
    ],
)
def test_bad_poles_are_refused(real, pairs, message):
    with pytest.raises(ValueError, match=message):
        Poles(real, pairs)


def test_poles_cannot_be_changed():
    poles = Poles([0.5])
    with pytest.raises(ValueError, match="read-only"):
        poles.real[0] = 2.0
