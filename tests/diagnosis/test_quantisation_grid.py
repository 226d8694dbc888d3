"""Rounded outputs: the step is read off the values, cells weigh as their chance, quantisation is named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from diagnosis import Case, diagnose
from diagnosis.machine.quantisation_grid import cell_residual, grid_step
from tests.diagnosis.recorded import recorded_case

NOISE = 1e-3


def _written(values):
    return np.array([float(f"{v:.6g}") for v in values])


def _records(rng, step):
    found = []
    for _ in range(4):
        y = np.cumsum(0.02 * rng.standard_normal(1200)) + NOISE * rng.standard_normal(1200)
        found.append(_written(np.round(y / step) * step if step else y))
    return found


@pytest.mark.parametrize("step", [4e-4, 1e-3, 3.7e-3, 0.02137])
def test_step_of_rounded_records(step):
    # Values of about 1 m written with six digits: 5e-6 over the largest multiple of the step.
    assert grid_step(_records(np.random.default_rng(0), step), NOISE) == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize("reach", [0.6, 1.4, 3.4])
def test_step_of_a_sensor_that_moves_by_a_few_steps_only(reach):
    rng = np.random.default_rng(2)
    step = 0.0707
    records = [np.round(reach * step * np.sin(rng.uniform(0, 7, 800)) / step) * step for _ in range(2)]
    assert np.unique(np.concatenate(records)).size == 2 * round(reach) + 1
    assert grid_step(records, NOISE) == pytest.approx(step, rel=1e-6)


def test_step_of_a_column_with_an_offset():
    # Pixels of a camera: what they are at the rest position is no multiple of the step, and seven digits of
    # them say less of a value near zero than seven digits of it would.
    tip = 0.0643 * np.round(np.cumsum(np.random.default_rng(4).standard_normal(900)) / 4)
    pixels = np.array([float(f"{value:.7g}") for value in (tip - 0.391) / 0.0004054])
    assert grid_step([0.0004054 * pixels + 0.391], NOISE) == pytest.approx(0.0643, rel=1e-5)


def test_no_step_where_there_is_none_or_none_that_matters():
    rng = np.random.default_rng(1)
    assert grid_step(_records(rng, 0.0), NOISE) == 0
    assert grid_step(_records(rng, 2e-4), NOISE) == 0  # 0.06 of the noise
    assert grid_step([np.array([0.0, 0.1, 0.2])], NOISE) == 0
    with pytest.raises(ValueError, match="noise"):
        grid_step([np.zeros(3)], 0.0)


@pytest.mark.parametrize("step", [0.5, 3.0, 8.0])
def test_deviance_of_a_cell_is_its_chance(step):
    e = np.linspace(-6, 6, 25)
    chance = norm.cdf(e + step / 2) - norm.cdf(e - step / 2)
    best = norm.cdf(step / 2) - norm.cdf(-step / 2)
    r = cell_residual(e * NOISE, np.zeros_like(e), step * NOISE, NOISE)
    np.testing.assert_allclose(r**2, -2 * np.log(chance / best), atol=1e-9)
    assert np.array_equal(np.sign(r), np.sign(e))


def test_small_steps_leave_the_plain_residual_and_far_tails_are_finite():
    e = np.linspace(-5, 5, 11)
    np.testing.assert_allclose(cell_residual(e * NOISE, 0 * e, 1e-3 * NOISE, NOISE), e, atol=1e-6)
    # 200 deviations off with a cell of 4: 198 to its nearer edge.
    far = cell_residual(np.array([200 * NOISE]), np.zeros(1), 4 * NOISE, NOISE)
    assert far[0] == pytest.approx(198, rel=1e-3)


def _rounded(case, step):
    experiments = []
    for e in case.experiments:
        output = np.array(e.output)
        output[:, 1] = _written(np.round(output[:, 1] / step) * step)
        experiments.append(replace(e, output=output))
    return Case(case.name, case.rig, tuple(experiments))


@pytest.mark.long
def test_rounded_records_name_quantisation_beside_the_rest(gap_cases):
    step = 2e-3
    found = diagnose(_rounded(recorded_case(gap_cases / "labelled" / "tip_payload"), step))
    assert found.verdict == "effect"
    assert set(found.combination) == {"quantisation", "tip_payload"}
    assert found.effects[0].name == "tip_payload"
    assert found.probabilities["tip_payload"] > 0.9
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    (rounding,) = (e for e in found.effects if e.name == "quantisation")
    low, high = rounding.intervals["step_m"]
    assert low <= step <= high
    assert rounding.presence > 0.99
    # Rounding errors are uniform: step^2/12 beside the noise, on one of two outputs.
    noise = found.case.noise[1]
    assert found.noise_floor == pytest.approx(np.sqrt(1 + (step / noise) ** 2 / 24))
    assert found.gap_after == pytest.approx(found.noise_floor, rel=0.05)
