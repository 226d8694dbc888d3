"""Other units of input, output and time change nothing but the units: no constant here has one."""

from functools import cache

import numpy as np
import pytest
from scipy import signal

from ident import IdentOptions, Record, identify
from ident.basis.options import EmbeddingOptions
from ident.coloured_noise import long_arx_filter
from ident.uncertainty.embedding import tangent

OMEGA = np.geomspace(1, 300, 40)
OPTIONS = {
    "white": IdentOptions(),
    "noise model": IdentOptions(noise="auto"),
    "integrator": IdentOptions(integrators=1),
    "relative degree": IdentOptions(relative_degree="auto"),
    "direct term": IdentOptions(feedthrough=True),
}


def record(input_scale, output_scale, time_scale, delay):
    rng = np.random.default_rng(3)
    n = 1000
    u = np.repeat(rng.choice([-1.0, 1.0], n // 4), 4)
    p = 0.97 * np.exp(0.3j)
    den = np.polymul(np.poly([p, p.conjugate()]).real, [1, -0.9])
    y = signal.lfilter(np.concatenate([np.zeros(delay), [0, 0.05, 0.03]]), den, u)
    y = y + 0.03 * y.std() * signal.lfilter([1], [1, -0.5], rng.standard_normal(n))
    dt = 0.01 * time_scale
    return Record((input_scale * u)[:, None], (output_scale * y)[:, None], dt, name="log")


def answer(name, scales, delay):
    log = record(*scales, delay)
    found = identify([log], OPTIONS[name])
    posterior = tangent([log], found.model, EmbeddingOptions(coloured_noise=name == "noise model"))
    return found, posterior.at(OMEGA / scales[2])


@cache
def plain(name, delay):
    return answer(name, (1.0, 1.0, 1.0), delay)


# Input, output and time together every day; each by itself says which of them it is.
ALL = (1e-6, 1e6, 1e-3)
ONE = [(1e6, 1.0, 1.0), (1.0, 1e-6, 1.0), (1.0, 1.0, 1e6), (1.0, 1.0, 1e-6)]


@pytest.mark.parametrize(
    ("name", "delay", "scales"),
    [
        *((name, 0, ALL) for name in OPTIONS),
        pytest.param("white", 12, ALL, marks=pytest.mark.long),
        *(pytest.param("white", 0, scales, marks=pytest.mark.long) for scales in ONE),
    ],
)
def test_units_change_nothing(name, delay, scales):
    found, ellipses = plain(name, delay)
    there, scaled = answer(name, scales, delay)
    gain = scales[1] / scales[0]
    assert there.model.input_delay_samples == found.model.input_delay_samples
    assert abs(found.model.input_delay_samples - delay) <= 1
    assert [item.kind for item in there.warnings] == [item.kind for item in found.warnings]
    # Rounding of the scaled signals (1e-16), grown by the condition of doubled poles (1e6 squared at most).
    np.testing.assert_allclose(there.model.poles.values, found.model.poles.values, atol=1e-9)
    np.testing.assert_allclose(scaled.centre / gain, ellipses.centre, rtol=1e-6)
    largest = np.abs(ellipses.covariance).max(axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(
        scaled.covariance / gain**2 / largest, ellipses.covariance / largest, atol=1e-5
    )


@pytest.mark.parametrize("scales", [(1e6, 1e-6, 1.0), (1e-6, 1e6, 1.0)])
def test_the_long_model_of_the_noise_has_no_units(scales):
    noises = [long_arx_filter([record(*each, 0)], IdentOptions()) for each in ((1.0, 1.0, 1.0), scales)]
    assert not noises[0].is_white
    np.testing.assert_allclose(noises[1].a_polynomial, noises[0].a_polynomial, rtol=1e-9, atol=1e-9)
