"""Windows in which no drift grows: of machines that integrate, each from the state that fits it best."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter

from diagnosis import Body, Case, Plant, PlantCase, PlantExperiment, diagnose, with_effects
from diagnosis.fit.windows import Windows
from tests.diagnosis.machines import rubbing
from tests.diagnosis.test_imperfect import RIG, _experiment
from validation.blind.truth import Background, Before, Truth

DT_S = 0.01
SAMPLES = 900
ROLES = ("estimation", "estimation", "held_out")


def _motor(parameters, effects, inputs):
    """Angle (T, 1) of a motor and speed: what the user brings."""
    T, gain = parameters.values()
    decay = np.exp(-DT_S / T)
    u = inputs[:, 0]
    speed = np.concatenate([[0.0], lfilter([gain * (1 - decay)], [1.0, -decay], u)[:-1]])
    angle = np.concatenate([[0.0], np.cumsum(gain * u[:-1] * DT_S - T * np.diff(speed))])
    return angle[:, None]


def _tank(parameters, effects, inputs):
    """Level (T, 1) of a tank without an outlet."""
    return np.concatenate([[0.0], np.cumsum(inputs[:-1, 0]) * DT_S])[:, None] / parameters["area"]


def _case(simulate, stated, truth, *, hold=30, scale=3.0, names="all", **around):
    """Three records with noise of 2e-4 of the motion, and a plant whose values are known to 5 %."""
    rng = np.random.default_rng(11)
    records = []
    for k, role in enumerate(ROLES):
        u = scale * (0.6 + 0.2 * k) * rng.uniform(-1, 1, SAMPLES // hold).repeat(hold)
        y = truth(u, rng)
        y = y + 2e-4 * np.std(y) * rng.standard_normal(SAMPLES)
        records.append(PlantExperiment(f"record {k}", role, u[:, None], y[:, None]))
    noise = np.array([2e-4 * np.mean([np.std(e.output) for e in records])])
    plant = Plant(simulate, stated, dict.fromkeys(stated, 0.05), ("y",), noise)
    return PlantCase("drifts", with_effects(plant, names, records, dt_s=DT_S, **around), tuple(records))


def _slow(rng, size):
    """A bias that nobody lists: it turns round once or twice in a record."""
    t = np.arange(SAMPLES) / SAMPLES
    return size * np.cos(2 * np.pi * rng.uniform(0.7, 1.6) * t + rng.uniform(0, 2 * np.pi))


def _rubbing_motor(u, rng):
    """Angle (T, 1) of the motor with dry friction of 0.4 V and a slow bias."""

    def rate(x, v, voltage):
        return (10 * voltage - v) / 0.2

    return rubbing(rate, u + _slow(rng, 0.12), DT_S, lambda v: 10 * 0.4 / 0.2)[:, 0]


def _late_tank(u, rng):
    """Level (T, 1) of a tank of area 2, its inflow 4.5 samples late, with a slow bias."""
    fine = np.concatenate([np.zeros(45), (u + _slow(rng, 0.1)).repeat(10)])[: 10 * SAMPLES]
    return cumulative_trapezoid(fine, dx=DT_S / 10, initial=0.0)[::10] / 2.0


@pytest.mark.parametrize(
    ("simulate", "stated", "truth", "motion", "name", "size"),
    [
        pytest.param(
            _motor,
            {"time_s": 0.2, "gain": 10.0},
            _rubbing_motor,
            "y",
            "coulomb_friction",
            0.4,
            marks=pytest.mark.long,
        ),
        pytest.param(_tank, {"area": 2.04}, _late_tank, None, "input_delay", 0.045, marks=pytest.mark.slow),
    ],
)
def test_an_effect_is_sized_in_windows_beside_a_drift_nobody_lists(
    simulate, stated, truth, motion, name, size
):
    answer = diagnose(_case(simulate, stated, truth, body=motion and Body(motion)))
    assert answer.presence(name) > 0.8
    (value,) = next(e for e in answer.effects if e.name == name).parameters.values()
    # 12 and 1 % measured: friction acts along the speed of a run that has drifted.
    assert value == pytest.approx(size, rel=0.25)
    assert answer.completeness.probability > 0.5
    assert answer.shares.horizon_samples
    assert answer.shares.in_windows


def _bar(bias_V):
    """Records of an independent simulator of a flexible link that nothing holds."""
    rng = np.random.default_rng(1)
    records = []
    truth = Truth(RIG.model_dump(exclude={"tolerances"}), (), Background(presliding_rad=1e-4))
    for name, role in zip("abc", ROLES, strict=True):
        voltage = rng.choice([-2.0, 2.0], 60).repeat(20)
        voltage -= np.mean(voltage)
        turns = rng.uniform(0.6, 1.5) * np.arange(voltage.size) / voltage.size
        bias = bias_V * np.sqrt(2) * np.cos(2 * np.pi * turns + rng.uniform(0, 6))
        clean = truth.record(voltage + bias, None, None, Before(0.4))
        output = np.column_stack([clean.hub_angle_rad, clean.tip_m])
        records.append(_experiment(name, role, output, voltage))
    return Case("bar", RIG, tuple(records), 0.05)


@pytest.mark.long
def test_a_drift_alone_makes_no_effect():
    answer = diagnose(_bar(0.1))
    assert answer.verdict == "unknown"
    assert not answer.present


def test_what_a_state_does_is_left_out_but_for_the_first_window():
    case = _case(_motor, {"time_s": 0.2, "gain": 10.0}, _rubbing_motor, names=["input_delay"])
    windows = Windows.of(case)
    # Three time constants at least, and the shorter the more windows.
    assert 3 * 0.2 / DT_S - 1 <= windows.samples <= SAMPLES // 3
    # No window is longer than what states are known to do, of a record of any length.
    for samples in (20, windows.samples + 1, 2 * windows.samples - 1, SAMPLES):
        groups = windows.window_groups(samples)
        assert sum(group.windows * group.length for group in groups) == samples
        assert max(group.length for group in groups) <= len(windows.responses)
        assert windows.to_coefficients(np.ones((samples, 1))).shape == (samples, 1)
    # A free motion from a start is left out of every window but the first.
    t = np.arange(SAMPLES) * DT_S
    free = (1.0 + 2.0 * np.exp(-t / 0.2))[:, None]
    left = windows.to_residuals(windows.to_coefficients(free))
    length = windows.window_groups(SAMPLES)[0].length
    np.testing.assert_allclose(left[:length], free[:length], atol=1e-9)
    assert np.max(np.abs(left[length:])) < 1e-4
    # Left out once, there is nothing more to leave out; and energies are those of the signal.
    moved = np.random.default_rng(0).standard_normal((SAMPLES, 1))
    coefficients = windows.to_coefficients(moved)
    again = windows.to_coefficients(windows.to_residuals(coefficients))
    np.testing.assert_allclose(again, coefficients, atol=1e-9)
    assert np.sum(coefficients**2) <= np.sum(moved**2)
    # Signals of several records at once are changed one by one.
    stacked = np.stack([moved, free])
    np.testing.assert_allclose(windows.to_coefficients(stacked)[1], windows.to_coefficients(free), atol=1e-9)


def test_a_machine_that_forgets_has_no_windows():
    def simulate(parameters, effects, inputs):
        return lfilter([0.1], [1.0, -0.9], inputs[:, 0])[:, None] * parameters["gain"]

    def truth(u, rng):
        return lfilter([0.1], [1.0, -0.9], u)

    assert Windows.of(_case(simulate, {"gain": 1.0}, truth)) is None
