"""Response posterior: formula, covariance, simulation, joint level, storage."""

import numpy as np
import pytest
from scipy import signal

from ident import GobfModel, Poles
from ident.uncertainty import EmbeddingReport, ResponsePosterior

DT = 0.02
POLES = Poles([0.9], [0.8 + 0.5j])
OMEGA = np.geomspace(0.01, 150.0, 40)


def posterior(seed=0, integrators=1, delay=2, direct=True, taps=4):
    rng = np.random.default_rng(seed)
    size = POLES.order + direct + taps
    return ResponsePosterior(
        poles=POLES, mean=rng.standard_normal(size), covariance_factor=0.05 * rng.standard_normal((size, 6)),
        dt_s=DT, fir_length=taps, has_feedthrough=direct, integrators=integrators, input_delay_samples=delay,
        report=EmbeddingReport("test", 0.1, 1.0, 0.9, 0.5, 2.0, 100, 3, (0.5, -0.1)),
    )  # fmt: skip


def transfer_function(p, coefficients):
    """The same response multiplied out into polynomials, from the GOBF model's own python-control export."""
    n = p.poles.order
    model = GobfModel(p.poles, coefficients[:n], DT, feedthrough=coefficients[n])
    taps = coefficients[n + 1 :]
    z = np.exp(1j * OMEGA * DT)
    core = model.to_control()(z) + sum(h * z ** -(k + 1) for k, h in enumerate(taps))
    return core * (z / (z - 1)) ** p.integrators * z**-p.input_delay_samples


def test_centre_is_the_stated_formula():
    p = posterior()
    np.testing.assert_allclose(p.centre(OMEGA), transfer_function(p, p.mean), rtol=1e-9)
    np.testing.assert_allclose(p.at(OMEGA).centre, p.centre(OMEGA), rtol=1e-14)


def test_covariance_is_that_of_sampled_responses():
    p = posterior(1)
    draws = p.sample(np.random.default_rng(2), 20_000)
    responses = p.response_of(draws, OMEGA)
    deviation = responses - responses.mean(axis=0)
    pair = np.stack([deviation.real, deviation.imag])
    sampled = np.einsum("anf,bnf->fab", pair, pair) / len(draws)
    covariance = p.at(OMEGA).covariance
    scale = np.einsum("faa->f", covariance)[:, None, None]
    # Sampling error of a covariance entry is at most sqrt(2 / 20000) = 1 % of the trace; 4 of those.
    np.testing.assert_allclose(sampled / scale, covariance / scale, atol=0.04)


@pytest.mark.parametrize(("integrators", "delay", "direct"), [(0, 0, True), (1, 3, False), (2, 1, True)])
def test_simulation_from_rest_has_the_impulse_response_of_the_centre(integrators, delay, direct):
    p = posterior(3, integrators, delay, direct)
    u = np.random.default_rng(4).standard_normal(200)
    feedthrough, how = (
        p.mean[3] if direct else 0.0,
        {"integrators": integrators, "input_delay_samples": delay},
    )
    model = GobfModel(POLES, p.mean[:3], DT, feedthrough, **how)
    filtered = np.concatenate([np.zeros(delay), u])[:200]
    for _ in range(integrators):
        filtered = signal.lfilter([1.0], [1.0, -1.0], filtered)
    expected = model.simulate(u) + signal.lfilter(np.concatenate([[0.0], p.mean[-4:]]), [1.0], filtered)
    np.testing.assert_allclose(p.simulate(u), expected, atol=1e-9 * np.abs(expected).max())
    with pytest.raises(ValueError, match="coefficients"):
        p.simulate(u, np.zeros(2))


def test_integrator_is_accurate_close_to_zero_frequency():
    p = posterior(10, integrators=2, delay=0)
    omega = 1e-7
    core = ResponsePosterior(POLES, p.mean, p.covariance_factor, DT, 4, True).centre(np.array([omega]))[0]
    # z / (z - 1) = 1 / (j w dt) (1 + j w dt / 2 + ...)
    assert p.centre(np.array([omega]))[0] * (1j * omega * DT) ** 2 == pytest.approx(core, rel=1e-8)
    with pytest.raises(ValueError, match="no value at omega = 0"):
        p.at(np.array([0.0]))
    with pytest.raises(ValueError, match="omega"):
        p.at(np.array([200.0]))


def test_bad_shapes_are_refused():
    with pytest.raises(ValueError, match=r"need mean \(3,\)"):
        ResponsePosterior(POLES, np.zeros(4), np.zeros((4, 1)), DT)
    with pytest.raises(ValueError, match="finite"):
        ResponsePosterior(POLES, np.full(3, np.nan), np.zeros((3, 1)), DT)
    with pytest.raises(ValueError, match="dt_s"):
        ResponsePosterior(POLES, np.zeros(3), np.zeros((3, 1)), 0.0)
