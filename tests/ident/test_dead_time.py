"""Dead time of plants by scipy: found where it is, with the order behind it, and not where there is none."""

import numpy as np
import pytest
from scipy import signal

from ident import IdentOptions, Record, identify
from ident.data.finding import FindingKind

from .findings import kinds, only

DT = 0.001
# Rates of the poles, 1/s: a motor; a motor with an amplifier; a mode; two modes (a point beyond the joint).
PLANTS = {
    "first": [-38.0],
    "second": [-40.0, -300.0],
    "mode": [complex(-10, 200), complex(-10, -200)],
    "two modes": [complex(-8, 150), complex(-8, -150), complex(-15, 500), complex(-15, -500)],
}
INPUTS = ("prbs", "multisine", "step")


def excitation(kind, n, rng):
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], n // 8 + 1), 8)[:n]
    if kind == "multisine":
        lines = np.zeros(n // 2 + 1, dtype=complex)
        lines[1 : n // 5] = np.exp(2j * np.pi * rng.random(n // 5 - 1))
        u = np.fft.irfft(lines, n)
        return u / u.std()
    return np.where(np.arange(n) < n // 4, 0.0, 1.0)


def measured(plant, delay, kind, seed, *, n=2000, noise=0.02, noise_pole=0.0, rates=None):
    rng = np.random.default_rng(seed)
    rates = PLANTS[plant] if rates is None else rates
    den = np.poly(rates).real
    b, a, _ = signal.cont2discrete(([den[-1]], den), DT)
    u = excitation(kind, n, rng)
    y = signal.lfilter(np.concatenate([np.zeros(delay), b.ravel()]), a, u)
    e = signal.lfilter([np.sqrt(1 - noise_pole**2)], [1, -noise_pole], rng.standard_normal(n))
    y = y + noise * y.std() * e
    return Record(u[:, None], y[:, None], DT, name=f"{plant} {delay}")


@pytest.mark.parametrize(
    ("plant", "delay", "noise_pole"),
    [
        ("first", 3, 0.0),
        pytest.param("mode", 14, 0.8, marks=pytest.mark.slow),
        *[
            pytest.param(*further, marks=pytest.mark.long)
            for further in (
                ("second", 14, 0.0),
                ("mode", 40, 0.0),
                ("first", 40, 0.8),
                ("second", 3, 0.8),
            )
        ],
    ],
)
def test_a_delay_is_found_with_the_order_behind_it(plant, delay, noise_pole):
    """Each plant with each noise, each delay with each noise."""
    found = identify([measured(plant, delay, "prbs", 1, noise_pole=noise_pole)])
    said = only(found.verdicts, FindingKind.DEAD_TIME)
    assert found.model.input_delay_samples == said["delay"] == delay
    assert said["delay_ms"] == pytest.approx(delay)
    assert said["order_without"] > found.model.order
    if not noise_pole:
        assert found.model.order == len(PLANTS[plant])
        truth = np.sort_complex(np.exp(DT * np.array(PLANTS[plant])))
        np.testing.assert_allclose(np.sort_complex(found.model.poles.values), truth, atol=0.04)


@pytest.mark.parametrize(
    ("plant", "kind", "delay"),
    [
        pytest.param("first", "step", 40, marks=pytest.mark.long),
        pytest.param("two modes", "multisine", 40, marks=pytest.mark.long),
        pytest.param("second", "multisine", 14, marks=pytest.mark.long),
        pytest.param("two modes", "step", 14, marks=pytest.mark.long),
    ],
)
def test_a_delay_is_found_with_other_inputs(plant, kind, delay):
    """A response that rises slowly shows its start to a few samples only; which, the interval says."""
    found = identify([measured(plant, delay, kind, 2)])
    said = only(found.verdicts, FindingKind.DEAD_TIME)
    slow = {"first": 0, "second": 3, "two modes": 6}[plant]
    assert abs(said["delay"] - delay) <= slow
    assert said["low"] <= said["delay"] <= said["high"]
    omega = np.array([10.0, 40.0, 100.0])
    den = np.poly(PLANTS[plant]).real
    truth = den[-1] / np.polyval(den, 1j * omega) * np.exp(-1j * omega * DT * (delay + 0.5))
    np.testing.assert_allclose(found.model.frequency_response(omega) / truth, 1, rtol=0, atol=0.06)
    assert found.model.order <= len(PLANTS[plant]) + 1


# Each plant and each input once; every pair of them, six times, is in the long run.
ONCE = [("first", "step", 1), ("second", "prbs", 1), ("mode", "multisine", 1), ("two modes", "prbs", 1)]
MANY = [pytest.param(plant, kind, 6, marks=pytest.mark.long) for plant in PLANTS for kind in INPUTS]


@pytest.mark.parametrize(("plant", "kind", "seeds"), ONCE + MANY)
def test_no_delay_is_found_where_there_is_none(plant, kind, seeds):
    """One in 192 was measured over plants, inputs, two levels and two colours of noise; here 6 each."""
    found = [identify([measured(plant, 0, kind, seed, n=1200)]).model for seed in range(seeds)]
    wrong = sum(model.input_delay_samples > 0 for model in found)
    assert wrong <= (2 if plant == "second" and kind == "step" else 0)


@pytest.mark.slow
def test_a_delay_longer_than_the_long_model_is_found():
    found = identify([measured("first", 700, "prbs", 3, n=2000)])
    assert (found.model.input_delay_samples, found.model.order) == (700, 1)


@pytest.mark.slow
def test_a_fraction_of_a_sample_names_both_neighbours():
    fraction = 0.7
    rng = np.random.default_rng(4)
    n, over = 1500, 20
    u = excitation("prbs", n, rng)
    fine = np.repeat(u, over)
    fine = np.concatenate([np.full(round((13 + fraction) * over), u[0]), fine])[: n * over]
    a = np.exp(-38 * DT / over)
    y = signal.lfilter([0, 1 - a], [1, -a], fine)[::over]
    y = y + 0.01 * y.std() * rng.standard_normal(n)
    found = identify([Record(u[:, None], y[:, None], DT, name="fraction")])
    said = only(found.verdicts, FindingKind.DEAD_TIME)
    assert (said["delay"], said["partial"]) == (13, True)
    assert np.max(found.model.poles.real) == pytest.approx(np.exp(-38 * DT), abs=1e-3)


def test_a_stated_delay_is_kept_and_judged():
    record = measured("first", 14, "prbs", 5)
    for stated in (0, 14):
        found = identify([record], IdentOptions(input_delay_samples=stated))
        assert found.model.input_delay_samples == stated
        assert FindingKind.DEAD_TIME not in kinds(found.verdicts)
        assert FindingKind.DELAY in kinds(found.verdicts)


def test_no_delay_is_sought_in_a_closed_loop():
    record = measured("first", 14, "prbs", 6)
    looped = Record(record.input, record.output, DT, name="loop", reference=record.input)
    assert identify([looped]).model.input_delay_samples == 0


def test_poles_in_place_of_a_direct_term_are_told():
    rng = np.random.default_rng(7)
    u = excitation("prbs", 2000, rng)
    y = signal.lfilter([0.5, 0.1], [1, -0.9], u) + 0.02 * rng.standard_normal(2000)
    record = Record(u[:, None], y[:, None], DT, name="direct")
    assert FindingKind.ANSWERS_AT_ONCE in kinds(identify([record]).warnings)
    with_it = identify([record], IdentOptions(feedthrough=True))
    assert with_it.model.order == 1
    assert FindingKind.ANSWERS_AT_ONCE not in kinds(with_it.warnings)
    plain = identify([measured("first", 0, "prbs", 7)])
    assert FindingKind.ANSWERS_AT_ONCE not in kinds(plain.warnings)


def test_poles_in_place_of_a_delay_are_told():
    found = identify([measured("first", 3, "prbs", 8)], IdentOptions(input_delay_samples=0))
    assert only(found.warnings, FindingKind.DEADBEAT)["delay"] >= 2
