"""Parts of a diagnosis that can be checked against the simulator: linear machine, controller check, words."""

import numpy as np
import pytest

from diagnosis.machine.case import Case, Experiment
from plant import EFFECTS, parse_effects, simulate
from plant.effects import in_words
from tests.workflow.diagnosis_examples import small_rig
from workflow.describe import diagnosis_words as told
from workflow.describe.diagnosis_rows import short_answer
from workflow.tasks.controller_check import check_controller, sampled_linear_machine
from workflow.text.names import name_words, unit_of

LINEAR = {
    "nothing": [],
    "whole delay": [{"name": "input_delay", "delay_s": 0.01}],
    "broken delay": [{"name": "input_delay", "delay_s": 0.0137}],
    "lag, gain, delay": [
        {"name": "actuator_lag", "time_constant_s": 0.01},
        {"name": "actuator_gain", "ratio": 1.2},
        {"name": "input_delay", "delay_s": 0.003},
    ],
    "compliant joint, payload": [
        {"name": "joint_compliance", "stiffness_Nm_rad": 50.0, "damping_Nms": 0.05},
        {"name": "tip_payload", "mass_kg": 0.02},
    ],
    "compliant base": [
        {"name": "base_compliance", "stiffness_Nm_rad": 80.0, "damping_Nms": 0.05, "inertia_kg_m2": 0.05}
    ],
}


@pytest.mark.parametrize("what", LINEAR)
def test_the_linear_machine_is_the_simulated_one(what):
    rig, effects = small_rig(), parse_effects(LINEAR[what])
    voltage = np.sign(np.random.default_rng(3).standard_normal(300))
    expected = simulate(rig, voltage, effects).output
    machine = sampled_linear_machine(rig, effects)
    state, found = np.zeros(machine.nstates), []
    for value in voltage:
        found.append(machine.C @ state)
        state = machine.A @ state + machine.B[:, 0] * value
    # Both are exact; rounding grows with the steps: 300 steps of 1e-16 of signals of size one.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


def _case(*effects):
    rig, experiments = small_rig(), []
    for k, role in enumerate(("estimation", "held_out")):
        rng = np.random.default_rng(k)
        voltage = 3.0 * np.sign(rng.standard_normal(40).repeat(8))
        output = simulate(rig, voltage, parse_effects(effects), rng=rng).output
        experiments.append(Experiment(f"{k}", role, voltage, output))
    return Case("arm", rig, tuple(experiments))


def test_a_machine_that_is_its_model_meets_the_prediction():
    case = _case()
    check = check_controller(case, case.rig, ())
    first, second, third, fourth = check.runs
    assert all(run.settles for run in check.runs)
    for predicted, achieved in ((first, second), (third, fourth)):
        # The same linear machine by two routes; S is measured at lines a twentieth of its peak's
        # frequency apart.
        np.testing.assert_allclose(achieved.tip_m, predicted.tip_m, atol=1e-8)
        assert achieved.cost_s == pytest.approx(predicted.cost_s, rel=1e-6)
        assert achieved.modulus_margin == pytest.approx(predicted.modulus_margin, rel=0.02)
    # Same rig, same specification, same seed.
    assert third.cost_s == first.cost_s


def test_a_delay_costs_margin_that_only_the_repaired_design_predicts():
    case = _case()
    late = parse_effects([{"name": "input_delay", "delay_s": 0.03}])
    check = check_controller(case, case.rig, late)
    promised, kept, _, _ = check.runs
    assert kept.modulus_margin < promised.modulus_margin - 0.02
    third, fourth = check.runs[2:]
    assert fourth.modulus_margin == pytest.approx(third.modulus_margin, rel=0.02)
    assert fourth.cost_s == pytest.approx(third.cost_s, rel=1e-6)


def test_every_effect_has_words_and_every_parameter_its_unit():
    for name, effect in EFFECTS.items():
        assert in_words(name) != name.replace("_", " "), name
        for parameter in effect.model_fields:
            assert unit_of(parameter) or parameter in ("ratio", "cycles_per_rev"), parameter
    assert unit_of("stiffness_Nm_rad") == "N m/rad"
    assert unit_of("hub.inertia_kg_m2") == "kg m²"
    assert told.parameter_words("delay_s", 0.012, (0.011, 0.013)) == "delay 0.012 s (95 %: 0.011 to 0.013)"
    assert told.parameter_words("ratio", 1.25, None) == "ratio 1.25"
    assert told.key_words("link.youngs_modulus_Pa") == "Young's modulus (link)"
    assert told.key_words("hub.inertia_kg_m2") == "inertia (hub)"


def test_no_probability_is_called_certain():
    assert told.probability_words(1.0) == "over 99.9 %"
    assert told.probability_words(0.0) == "under 0.1 %"
    assert told.probability_words(0.954) == "95.4 %"
    assert told.probability_words(0.996) == "99.6 %"


@pytest.mark.parametrize(
    ("verdict", "needs", "said"),
    [
        ("unknown", ("more time", "more time"), "no answer: nothing was tried"),
        ("unknown", ("more time", ""), "none of the candidate effects"),
        ("none", ("more time", "more time"), "no model error"),
    ],
)
def test_an_answer_of_which_nothing_was_tried_names_none_of_the_candidates(verdict, needs, said):
    presence = {f"effect_{k}": {"probability": 0.1, "needs": need} for k, need in enumerate(needs)}
    document = {"detail_verdict": verdict, "verdict": verdict, "combination": [], "presence": presence}
    assert short_answer(document) == said


@pytest.mark.parametrize(
    ("complete", "said"),
    [
        (0.745, "no significant model error"),
        (0.009, "no candidate effect, but more remains than the threshold"),
    ],
)
def test_no_model_error_is_significant_only_where_that_is_all(complete, said):
    document = {
        "detail_verdict": "none", "verdict": "none", "combination": [], "presence": {}, "shares": {},
        "completeness": {"probability": complete},
    }  # fmt: skip
    assert short_answer(document) == said


@pytest.mark.parametrize(
    ("name", "words", "unit"),
    [
        ("rate_per_s", "rate", "1/s"),
        ("rate_V_s", "rate", "V/s"),
        ("cubic_N_m3", "cubic", "N/m³"),
        ("gap", "gap", ""),
    ],
)
def test_a_name_is_words_and_a_unit(name, words, unit):
    assert (name_words(name), unit_of(name)) == (words, unit)
