"""The fit of the naming model, and the made machines that it learns from."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import naming
from benchmarks.beyond_the_list import LEAST_SHARE, SORTS, joint_torque, made_case
from benchmarks.naming_fit import (
    COEFFICIENTS,
    TABLES,
    TrainingCase,
    TrainingData,
    TrainingSet,
    answered,
    fitted,
    outcome,
    start_model,
    table,
)
from diagnosis.judge.naming_model import NamingModel, fitted_model
from diagnosis.judge.set_features import EFFECT_FEATURES, SET_FEATURES, EffectFeatures

LISTED = ("friction", "lag", "spring")
TRUTH = NamingModel(
    np.array([1.2, 0.4, -1.8]),
    np.array([0.8, 0.4, -0.7, -1.8, 1.2]),
    np.array([-0.3, 1.2]),
)


def drawn_set(rng, names):
    """A set with random features, as a search may leave it."""
    effects = [
        EffectFeatures(
            name,
            bool(rng.random() < 0.9),
            float(rng.uniform(0.0, 0.5)),
            float(rng.choice([0.0, 0.5, 1.0])),
            float(rng.choice([0.0, 0.0, 0.25])),
            tuple(map(float, rng.normal(size=len(EFFECT_FEATURES)))),
        )
        for name in names
    ]
    return TrainingSet(
        float(rng.normal()),
        tuple(map(float, rng.normal(size=len(SET_FEATURES)))),
        (1.0, float(rng.normal())),
        float(rng.choice([0.0, 0.0, 0.5])),
        tuple(sorted(effects, key=lambda effect: -effect.share)),
    )


def drawn_case(rng, model=TRUTH):
    """A case whose truth is drawn with the probabilities of the model."""
    sets = tuple(
        drawn_set(rng, names)
        for names in ((), ("friction",), ("lag",), ("spring",), ("friction", "lag"), ("lag", "spring"))
    )
    is_stated = bool(rng.random() < 0.7)
    weights = model.set_probabilities(sets)
    right = sets[rng.choice(len(sets), p=weights)]
    present = []
    stands_in = False
    for effect in right.effects:
        if rng.random() >= effect.interests:
            continue
        if rng.random() < model.is_genuine(effect):
            present.append(effect.name)
        else:
            stands_in = True
    beside = bool(rng.random() < model.has_unlisted_cause(right.rest_features, is_stated))
    return TrainingCase("drawn", "drawn", LISTED, frozenset(present), is_stated, stands_in or beside, sets)


def all_of(model):
    return np.concatenate([model.of_set, model.of_effect, model.of_rest])


@pytest.mark.slow
def test_the_fit_recovers_the_coefficients_that_drew_the_truth():
    rng = np.random.default_rng(1)
    cases = [drawn_case(rng) for _ in range(1500)]
    # The share of unlisted causes as it was drawn: another one is another truth.
    found = fitted(cases, unlisted_share=None)

    def rms_error(model):
        return np.sqrt(np.mean((all_of(model) - all_of(TRUTH)) ** 2))

    # 1500 cases tell a coefficient to about .12.
    assert rms_error(found) < 0.25 < 0.5 < rms_error(start_model())
    data = TrainingData(cases, unlisted_share=None)
    assert data.loss(found) < data.loss(TRUTH) + 1e-3 < data.loss(start_model())


def test_the_fit_judges_as_the_judge_does():
    # Its arrays and the judge's sums over sets of effects are the same probabilities.
    rng = np.random.default_rng(2)
    cases = [drawn_case(rng) for _ in range(20)]
    data = TrainingData(cases)
    predictions = data.predicted(TRUTH)
    for i, case in enumerate(cases):
        said = answered(case, TRUTH)
        assert sum(said.cause.values()) == pytest.approx(1.0)
        right = sum(said.cause[name] for name in case.right_causes)
        assert predictions.right_cause[i] == pytest.approx(right)
    for (i, name), presence in zip(data.pairs, predictions.presence, strict=True):
        assert presence == pytest.approx(answered(cases[i], TRUTH).presence[name])


def test_kinds_of_machines_count_the_same_however_many_cases_they_have():
    rng = np.random.default_rng(3)
    few, many = ([drawn_case(rng) for _ in range(count)] for count in (5, 20))
    many = [replace(case, route="many") for case in many]
    together = TrainingData([*few, *many]).loss(TRUTH)
    assert together == pytest.approx((TrainingData(few).loss(TRUTH) + TrainingData(many).loss(TRUTH)) / 2)
    with pytest.raises(ValueError, match="no cases to fit to"):
        fitted([])


def test_more_cases_with_unlisted_causes_make_them_no_more_probable():
    rng = np.random.default_rng(4)
    cases = [drawn_case(rng) for _ in range(40)]
    unlisted = [case for case in cases if case.has_unlisted]
    assert 0 < len(unlisted) < len(cases)
    assert TrainingData([*cases, *unlisted]).loss(TRUTH) == pytest.approx(TrainingData(cases).loss(TRUTH))
    as_made = [TrainingData(each, None).loss(TRUTH) for each in (cases, [*cases, *unlisted])]
    assert as_made[0] != pytest.approx(as_made[1])


def test_stored_coefficients_have_the_features_of_the_judge_and_come_back(monkeypatch, tmp_path):
    stored = tomllib.loads(naming.MODEL_FILE.read_text("utf-8"))
    assert {title: tuple(values) for title, values in stored.items()} == TABLES
    assert all(tuple(COEFFICIENTS[title]) == names for title, names in TABLES.items())
    text = naming.model_toml(fitted_model(), "# python -m benchmarks.naming", {"made": 3})
    again = tomllib.loads(text)
    for title, values in stored.items():
        assert again[title] == pytest.approx(values, abs=1e-4)
    assert text.count("\n# ") >= sum(map(len, TABLES.values()))


def test_outcomes_are_counted_against_the_truth():
    rng = np.random.default_rng(4)
    case = drawn_case(rng)
    said = outcome(case, TRUTH)
    wrong = next(name for name in (*LISTED, "none") if name != said.first)
    as_said = replace(
        case, present=frozenset([said.first]) & set(LISTED), has_unlisted=said.first == "unknown"
    )
    other = replace(case, present=frozenset([wrong]) & set(LISTED), has_unlisted=False)
    assert outcome(as_said, TRUTH).is_right
    assert not outcome(other, TRUTH).is_right
    assert outcome(other, TRUTH).cause_loss > outcome(as_said, TRUTH).cause_loss
    assert not outcome(other, TRUTH).is_exact
    lines = table({"all": [outcome(as_said, TRUTH), outcome(other, TRUTH)], "empty": []})
    assert len(lines) == 2
    assert lines[1].split()[:2] == ["all", "2"]
    assert lines[1].split()[4] == "1"


def test_a_killed_run_goes_on_and_lines_of_another_version_are_refused(monkeypatch, tmp_path):
    rng = np.random.default_rng(5)
    drawn = [drawn_case(rng), "left out", drawn_case(rng)]
    asked = []

    def case(number):
        asked.append(number)
        return made_case(1, 0)

    monkeypatch.setattr(naming, "training_case", lambda labelled: drawn[asked[-1]])
    route = naming.Route("drawn", 3, case)
    first = naming.collected(route, tmp_path)
    file = tmp_path / "drawn.jsonl"
    lines = file.read_text("utf-8").splitlines(keepends=True)
    file.write_text("".join(lines[:2]) + lines[2][:40], encoding="utf-8")  # killed while it wrote
    assert naming.collected(route, tmp_path) == first == drawn
    assert asked == [0, 1, 2, 2]

    file.write_text(lines[0].replace(EFFECT_FEATURES[0], "another"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"drawn\.jsonl, line 1: .*other features"):
        naming.collected(route, tmp_path)


@pytest.mark.parametrize("number", range(12))
def test_labels_of_made_machines_are_what_was_put_in(number):
    made = made_case(77, number)
    case = made.case
    weighing = case.machine.weighing
    sort = next(name for name in sorted(SORTS, key=len, reverse=True) if case.name.endswith(name))
    _, effects, has_unlisted = SORTS[sort]
    assert len(made.present) in {effects, max(effects - 1, 1) if effects else 0}
    assert set(made.present) <= set(weighing.listed)
    assert not set(made.unlisted) & set(weighing.listed)
    background = {"background"} if made.route == "joint" and not weighing.stated else set()
    assert bool(set(made.unlisted) - background) == has_unlisted
    known = {*made.present, *made.unlisted} - background
    assert set(made.shares) == known
    assert all(share >= LEAST_SHARE * weighing.model_error for share in made.shares.values())
    # Another call gives the same logs, and the last validates.
    again = made_case(77, number).case
    for log, same in zip(case.experiments, again.experiments, strict=True):
        np.testing.assert_array_equal(log.output, same.output)
    assert [log.role for log in case.experiments][-1] == "held_out"


def test_a_machine_without_a_cause_is_its_simulation_off_by_its_tolerances():
    none = [made for made in (made_case(78, number) for number in range(40)) if "none" in made.case.name]
    assert {made.route for made in none} == {"joint", "arm"}
    for made in none:
        assert made.present == made.unlisted == ()
        assert made.shares == {}
    # A joint: what is left with the best values of its three linear parameters is noise and background.
    joint = next(made for made in none if made.route == "joint")
    plant = joint.case.plant
    for log in joint.case.experiments:
        columns = [
            joint_torque({key: float(key == one) for key in plant.parameters}, {}, log.input)[:, 0]
            for one in plant.parameters
        ]
        regressor = np.column_stack(columns)
        torque = log.output[:, 0]
        values = np.linalg.lstsq(regressor, torque, rcond=None)[0]
        left = np.std(torque - regressor @ values)
        assert left < 1.1 * plant.noise[0] + 0.01 * np.std(torque)
        off = np.log(values / [*plant.parameters.values()]) / [*plant.tolerances.values()]
        assert np.all(np.abs(off) < 2)
