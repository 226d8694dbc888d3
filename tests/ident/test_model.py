import control
import numpy as np
import pytest
from hypothesis import given, strategies as st

from ident import GobfModel, Poles, basis_response

MODEL = GobfModel(
    poles=Poles([0.5, 0.98], [0.97 * np.exp(0.3j)]), coefficients=[0.3, -0.2, 0.5, 0.1], dt_s=0.01,
    feedthrough=0.4, integrators=2, input_delay_samples=3, input_name="voltage", output_name="angle",
)  # fmt: skip
OMEGA = np.geomspace(0.1, 300, 50)


def test_control_model_has_the_same_response():
    system = MODEL.to_control()
    assert system.dt == MODEL.dt_s
    assert system.nstates == 4 + 2 + 3
    expected = system(np.exp(1j * OMEGA * MODEL.dt_s))
    # control inverts (z I - A) with two poles at z = 1: 1e-3 from them squared costs 1e6 roundings.
    np.testing.assert_allclose(MODEL.frequency_response(OMEGA), expected, rtol=1e-9)


def test_simulation_agrees_with_control():
    u = np.random.default_rng(0).normal(size=200)
    expected = control.forced_response(MODEL.to_control(), inputs=u).outputs
    np.testing.assert_allclose(MODEL.simulate(u), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_model_without_poles_is_a_gain():
    model = GobfModel(Poles(), [], 0.01, feedthrough=2.0)
    np.testing.assert_array_equal(model.simulate(np.array([1.0, 2.0])), [2.0, 4.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coefficients": [1.0]}, "one coefficient per basis function"),
        ({"coefficients": [1.0, np.nan, 0, 0]}, "finite"),
        ({"dt_s": 0.0}, "dt_s"),
        ({"dt_s": np.nan}, "dt_s"),
        ({"feedthrough": np.inf}, "finite"),
        ({"integrators": -1}, "negative"),
    ],
)
def test_bad_models_are_refused(change, message):
    arguments = {"poles": MODEL.poles, "coefficients": MODEL.coefficients, "dt_s": 0.01} | change
    with pytest.raises(ValueError, match=message):
        GobfModel(**arguments)


def test_frequencies_must_make_sense():
    with pytest.raises(ValueError, match="pi/dt"):
        MODEL.frequency_response(np.array([400.0]))
    with pytest.raises(ValueError, match="pi/dt"):
        MODEL.frequency_response(np.array([np.nan]))
    with pytest.raises(ValueError, match="omega = 0"):
        MODEL.frequency_response(np.array([0.0]))


def test_zeros_are_where_the_response_vanishes_and_all_of_them_are_found():
    poles = Poles.from_continuous(decay_per_s=[3.0], omega_rad_s=[15.0, 70.0], zeta=[0.01, 0.2], dt_s=0.005)
    model = GobfModel(poles, [0.1, -0.2, 0.3, 0.05, -0.01], 0.005)
    zeros = model.zeros()
    # Numerator of sum_i c_i L_i by partial fractions, an independent way: order 5, strictly proper.
    values = poles.values
    unit = np.exp(2j * np.pi * np.arange(16) / 16)
    response = (basis_response(poles, unit) @ model.coefficients) * np.prod(unit[:, None] - values, axis=1)
    numerator = np.fft.fft(response)[:5] / 16  # coefficients of z^0 .. z^4
    expected = np.roots(numerator[::-1].real)
    np.testing.assert_allclose(np.sort_complex(zeros), np.sort_complex(expected), rtol=1e-7)
    assert (
        GobfModel(poles, np.zeros(5), 0.005, feedthrough=2.0).zeros().size == 5
    )  # those of all poles cancel
    assert GobfModel(Poles(), [], 0.005, feedthrough=2.0).zeros().size == 0


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
