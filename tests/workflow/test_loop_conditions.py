"""Conditions of the closed-loop check: what is changed is what is said to be, and nothing else."""

from dataclasses import replace

import control
import numpy as np
import pytest

from workflow.config.run_config import ClosedLoopOptions
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.loop_conditions import ConditionBench
from workflow.tasks.pipeline import config_of
from workflow.tasks.results import RunResults
from workflow.tasks.sampled_plant import realise
from workflow.tasks.simulated_rig import rig_of


@pytest.fixture(scope="module")
def bench(fast_run) -> ConditionBench:
    """The fast arm with its controller: viscous friction only, so the loop is linear but for noise."""
    run = RunDirectory.open(fast_run[0])
    config, results = config_of(run), RunResults(run)
    return ConditionBench(
        results.design.synthesis.controller, results.uncertainty.channels[0].posterior, config.source,
        config.closed_loop, rig_of(config.source), np.where(np.arange(600) >= 30, 0.2, 0.0), 0,
        np.random.default_rng(1),
    )  # fmt: skip


def test_prediction_is_the_feedback_of_model_and_controller(bench):
    """python-control's closed loop of the posterior mean; the command stays within its limit."""
    model = realise(bench.posterior, bench.posterior.mean)
    loop = control.feedback(bench.controller.to_control(include_delay=True) * model, 1)
    expected = control.forced_response(loop, inputs=bench.reference).outputs
    found = bench.predict(bench.reference)
    assert not found.limited.any()
    np.testing.assert_allclose(found.measured, expected, atol=1e-9)


def test_push_is_predicted_by_the_free_arm_and_the_sensitivity(bench):
    """The arm is linear here, so prediction and achievement agree to noise (1 mrad) and the model's error."""
    push = bench.push()
    away = push.achieved - push.predicted
    assert np.sqrt(np.mean(away**2)) < 0.03 * push.size
    assert not push.reference.any()


def test_slew_uses_its_share_of_the_voltage(bench):
    slew = bench.slew()
    peak = np.max(np.abs(slew.predicted_command))
    limit = bench.controller.input_limit
    assert peak == pytest.approx(0.6 * limit, rel=1e-6) or slew.size == pytest.approx(20 * bench.step)
    assert slew.reference[-1] == pytest.approx(slew.size)


def test_payloads_are_shares_of_the_rated_one(bench):
    """Without any payload a tenth of the link's mass is taken for rated: 0.109 kg of aluminium."""
    words = [found.words for found in bench.payloads()]
    assert words == ["0 g at the tip", "10.9 g at the tip", "21.8 g at the tip"]
    options = ClosedLoopOptions(effects=({"name": "tip_payload", "mass_kg": 0.05},))
    rated = replace(bench, options=options)
    assert [found.words for found in rated.payloads()][2] == "100 g at the tip"


def test_heavier_payload_moves_the_arm_away_from_the_prediction(bench):
    differences = [found.rms_difference_percent for found in bench.payloads()]
    assert differences[0] < differences[1] < differences[2]


def test_friction_conditions_need_friction(bench):
    bare = replace(bench, source=bench.source.model_copy(update={"effects": ()}))
    assert bare.frictions() == []
    assert [found.name for found in bench.frictions()] == ["no friction", "double friction"]


def test_limit_is_kept_and_told_only_with_anti_windup(bench):
    aware, unaware = bench.overdriven()
    limit = bench.controller.input_limit
    assert np.max(np.abs(aware.achieved_command)) <= limit
    assert aware.limited_fraction > 0
    assert unaware.limited_fraction == 0
    assert np.max(np.abs(unaware.achieved_command)) > 1.5 * limit
    no_limit = replace(bench, controller=replace(bench.controller, input_limit=None))
    assert no_limit.overdriven() == []


def test_row_measures_in_percent_of_the_move(bench):
    late = bench.late()
    away = late.achieved - late.predicted
    assert late.largest_difference_percent == pytest.approx(100 * np.max(np.abs(away)) / 0.2)
    assert late.words == "5 ms more delay"


def test_coarse_converters_are_told_with_their_units(bench):
    """24 V in 128 steps either side of zero; without an encoder 0.4 % of the move of 0.2 rad."""
    assert bench.coarse().words == "command in steps of 0.188 V, measurement of 0.0008 rad"
