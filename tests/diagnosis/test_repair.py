"""The repair: what makes a simulation predict logs better that it was not fitted to, and what is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose
from diagnosis.answer import completeness_of
from diagnosis.fit.descent import descend
from diagnosis.fit.residual import ResidualModel
from diagnosis.judge.by_prediction import presence_by_prediction
from diagnosis.repair.left_out import fitted_without_each_log
from diagnosis.repair.prediction_error import FEWEST_BLOCKS, PredictionError
from diagnosis.repair.repair import Repairs, _order_of_return
from diagnosis.repair.stability import share_of_repairs
from diagnosis.search.white import WhiteSearch, descend_to_end

DT_S = 0.005
STATED = {"inertia": 0.3, "viscous": 0.5, "gravity": 4.0}
TOLERANCES = {"inertia": 0.1, "viscous": 0.3, "gravity": 0.1}
EFFECTS = (
    PlantEffect("dry_friction", (EffectParameter("torque_Nm", 1e-3, 20.0),), dependence="continuous"),
    PlantEffect("offset", (EffectParameter("torque_Nm", 1e-3, 20.0),), signed=True),
    PlantEffect("spring", (EffectParameter("stiffness_Nm_rad", 1e-3, 50.0),), signed=True),
    PlantEffect("drag", (EffectParameter("Nms2", 1e-4, 20.0),), signed=True),
)


def torque(parameters, effects, motion):
    """Position, speed, acceleration (T, 3) -> torque (T, 1) that a joint under gravity takes."""
    position, speed, acceleration = motion.T
    found = parameters["inertia"] * acceleration + parameters["viscous"] * speed
    found = found + parameters["gravity"] * np.sin(position)
    direction = np.tanh(speed / 1e-2)
    found = found + effects.get("dry_friction", {}).get("torque_Nm", 0.0) * direction
    found = found + effects.get("offset", {}).get("torque_Nm", 0.0)
    found = found + effects.get("spring", {}).get("stiffness_Nm_rad", 0.0) * position
    found = found + effects.get("drag", {}).get("Nms2", 0.0) * speed * np.abs(speed)
    return found[:, None]


def moved(rng, samples=800):
    """(T, 3) position, speed, acceleration: some sines."""
    time_s = np.arange(samples) * DT_S
    motion = np.zeros((samples, 3))
    for omega in 2 * np.pi * rng.uniform(0.15, 1.2, 6):
        phase = omega * time_s + rng.uniform(0, 2 * np.pi)
        size = rng.uniform(0.1, 0.3)
        columns = [np.sin(phase), omega * np.cos(phase), -(omega**2) * np.sin(phase)]
        motion += size * np.column_stack(columns)
    return motion


def joint(true, beyond, seed=1, logs=4, noise=0.01, samples=800, **more):
    """A case whose logs have a torque beyond the model, of position and speed; the last is for validation."""
    rng = np.random.default_rng(seed)
    settings = {"parameters": STATED, "tolerances": TOLERANCES, "effects": EFFECTS, "dt_s": DT_S} | more
    plant = Plant(torque, output_names=("torque_Nm",), noise=np.array([noise]), **settings)
    experiments = []
    for log in range(logs):
        motion = moved(rng, samples)
        measured = torque(STATED | true, {}, motion)[:, 0] + beyond(motion[:, 0], motion[:, 1])
        measured = measured + noise * rng.standard_normal(len(motion))
        role = "estimation" if log < logs - 1 else "held_out"
        experiments.append(PlantExperiment(f"log {log}", role, motion, measured))
    return PlantCase("joint", plant, tuple(experiments))


def unlisted_and_dry(position, speed):
    """Dry friction of 0.4 N m, and a ripple over the position that no candidate has."""
    return 0.4 * np.tanh(speed / 1e-2) + 0.45 * np.sin(9 * position + 1)


@pytest.mark.parametrize("logs", [2, 4], ids=["one log each: blocks", "logs left out in turn"])
def test_beside_an_unlisted_cause_the_repair_has_the_effect_that_helps(logs):
    found = diagnose(joint({}, unlisted_and_dry, logs=logs))
    (friction,) = (effect for effect in found.repair if effect.id == "dry_friction")
    assert friction.values["torque_Nm"] == pytest.approx(0.4, rel=0.15)
    # A good part of the energy is dry friction's.
    assert found.gap_after < 0.9 * found.gap_refit
    assert 0.3 < found.prediction.unexplained < 0.8
    # What explains that much is not denied, and "unknown" is what is left.
    assert found.presence("dry_friction") > 0.2
    assert found.prediction.effects == found.added
    unknown = next(effect for effect in found.effects if effect.name == "unknown")
    assert unknown.explains[0] == pytest.approx(found.prediction.unexplained)
    for effect in found.effects:
        assert not effect.explains[0] > 1
        assert not effect.explains[0] < 0


def test_the_repair_moves_the_values_that_are_wrong_and_few_others():
    """Of eight stated values two are wrong; what the noise of a log follows is no reason to move another."""
    moved_rightly = 0
    moved_needlessly = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        true = np.ones(8)
        true[[2, 5]] = 1.1, 0.85
        names = [f"k{place}" for place in range(8)]

        def simulate(parameters, effects, inputs, names=names):
            bias = effects.get("bias", {}).get("size", 0.0)
            return inputs @ np.array([parameters[name] for name in names])[:, None] + bias

        bias = PlantEffect("bias", (EffectParameter("size", 1e-3, 1.0),))
        tolerances = dict.fromkeys(names, 0.1)
        stated = dict.fromkeys(names, 1.0)
        plant = Plant(simulate, stated, tolerances, ("y",), np.array([0.1]), (bias,), model_error=0.0)
        experiments = []
        for log in range(4):
            inputs = rng.standard_normal((200, 8))
            measured = inputs @ true + 0.1 * rng.standard_normal(200)
            role = "held_out" if log == 3 else "estimation"
            experiments.append(PlantExperiment(f"log {log}", role, inputs, measured))
        search = WhiteSearch(PlantCase("eight", plant, tuple(experiments)), lambda done, what: None)
        search.add(descend_to_end(search.records, (), np.zeros(0), np.zeros(8)))
        search.records.simulations += 1000
        repair = Repairs(search, search.nominal_alone).best(())
        moved_rightly += int(np.sum(repair.moved[[2, 5]]))
        moved_needlessly += int(np.sum(repair.moved)) - int(np.sum(repair.moved[[2, 5]]))
        assert repair.validation.rms < 1.1
    assert moved_rightly == 10
    assert moved_needlessly <= 6


def test_a_model_that_is_right_has_no_effect_added():
    found = diagnose(joint({}, lambda position, speed: 0.0 * position))
    assert found.repair == ()
    assert found.prediction.error == pytest.approx(1.0, abs=0.1)
    assert found.gap_after == pytest.approx(found.gap_before, rel=0.01)


def test_no_set_that_was_tried_predicts_much_better_than_the_repair():
    found = diagnose(joint({"viscous": 0.8}, unlisted_and_dry, seed=3))
    tried = dict(found.prediction.tried)
    assert () in tried
    assert found.prediction.error <= 1.15 * min(tried.values())
    assert found.prediction.error < found.prediction.error_nominal


@pytest.mark.parametrize("seed", [1, 2])
def test_no_repair_predicts_worse_than_the_model_as_it_was(seed):
    """A torque of the position alone, which no candidate follows, in logs of different motions."""
    found = diagnose(joint({}, lambda position, speed: 2.0 * np.sin(17 * position), seed=seed, samples=400))
    assert found.prediction.error <= found.prediction.error_nominal


# One log left out


def linear_model(logs=4, samples=60):
    """A torque that is linear in what is fitted, deviations included, with white noise of known size."""
    rng = np.random.default_rng(5)
    motions = [rng.standard_normal((samples, 3)) for _ in range(logs)]

    def simulate(parameters, effects, motion):
        size = effects.get("spring", {}).get("stiffness_Nm_rad", 0.0)
        return (parameters["gain"] * motion[:, 0] + size * motion[:, 1])[:, None]

    spring = PlantEffect("spring", (EffectParameter("stiffness_Nm_rad", 1e-3, 5.0),))
    plant = Plant(
        simulate, {"gain": 2.0}, {"gain": 1e-3}, ("x_m",), np.array([0.1]), (spring,), model_error=0.0
    )
    experiments = [
        PlantExperiment(
            f"log {k}",
            "estimation",
            motion,
            2.0004 * motion[:, 0] + 1.5 * motion[:, 1] + 0.1 * rng.standard_normal(samples),
        )
        for k, motion in enumerate(motions)
    ]
    validation = replace(experiments[0], name="again", role="held_out")
    return PlantCase("linear", plant, (*experiments, validation))


def ended(case):
    records = ResidualModel(case)
    (candidate,) = [c for c in case.machine.candidates(case.experiments) if c.effect == "spring"]
    start = records.start
    settings = {"iterations": 60, "tolerance": 1e-10}
    return records, descend(records, (candidate,), np.zeros(1), np.log([1.2]), start, **settings)


def test_a_log_left_out_by_one_step_is_a_log_never_fitted():
    """As fits without it end, to second order in what one log of four moves."""
    case = linear_model()
    records, end = ended(case)
    steps = fitted_without_each_log(records, end, np.array([True]))
    assert len(steps) == 4
    for log, without in enumerate(steps):
        others = tuple(e for k, e in enumerate(case.experiments) if k != log)
        _, refitted = ended(replace(case, experiments=others))
        moved_by_log = abs(float(refitted.coordinates[0] - end.coordinates[0]))
        missed = abs(float(refitted.coordinates[0] - without.coordinates[0]))
        assert missed < 0.02 * moved_by_log + 1e-5
        np.testing.assert_allclose(without.deviations, refitted.deviations, atol=2e-3)


def test_values_that_may_not_move_stay_where_a_log_is_left_out():
    records, end = ended(linear_model())
    for without in fitted_without_each_log(records, end, np.array([False])):
        assert without.deviations == end.deviations


def test_of_a_single_log_none_is_left_out():
    case = linear_model(logs=1)
    records, end = ended(case)
    with pytest.raises(ValueError, match="a log can be left out of two or more; got one"):
        fitted_without_each_log(records, end, np.array([True]))


# Errors compared


def test_logs_are_cut_into_as_many_blocks_as_a_standard_error_takes():
    one = PredictionError.of([np.ones((160, 2))])
    assert (one.energy.size, one.rms) == (FEWEST_BLOCKS, 1.0)
    assert PredictionError.of([np.ones((50, 1))] * 40).energy.size == 40
    assert PredictionError.of([np.full((30, 1), np.nan)]).rms > 1e6


def test_what_is_surely_worse_is_not_as_good_however_little():
    rng = np.random.default_rng(7)
    residual = rng.standard_normal((1600, 1))
    best = PredictionError.of([residual])
    # The same error a little larger throughout, and one that is larger here and smaller there.
    assert not PredictionError.of([1.01 * residual]).as_good_as(best)
    changed = residual * np.repeat(rng.choice([0.9, 1.11], 16), 100)[:, None]
    assert PredictionError.of([changed]).as_good_as(PredictionError.of([residual]))
    # What does not interest is no reason for a larger model, within the error's own scatter.
    assert PredictionError.of([1.01 * residual]).as_good_as(best, uninteresting=0.05 * 1600)
    assert not PredictionError.of([1.5 * residual]).as_good_as(best, uninteresting=10 * 1600)


def trial(names, energy):
    error = PredictionError(np.array(energy), np.ones(len(energy)))
    key = tuple(sorted(names))
    return SimpleNamespace(names=names, explanation=SimpleNamespace(sorted_names=key), error=error)


def test_an_effect_with_which_logs_are_surely_predicted_worse_is_refuted():
    blocks = np.linspace(1.0, 2.0, 16)
    trials = [trial((), 2 * blocks), trial(("lag",), 2.2 * blocks), trial(("drag", "lag"), blocks)]
    trials.append(trial(("drag",), blocks + 0.2 * (-1.0) ** np.arange(16)))
    repairs = SimpleNamespace(trials=trials, search=SimpleNamespace(explanations=[]))
    assert Repairs.refutes(repairs, "lag", ("lag",))
    # Better without by chance alone, and a set that nobody fitted.
    assert not Repairs.refutes(repairs, "lag", ("drag", "lag"))
    assert not Repairs.refutes(repairs, "ripple", ("ripple",))


def test_an_effect_belongs_to_the_repair_as_surely_as_no_other_replaces_it():
    blocks = np.linspace(1.0, 2.0, 16)
    uneven = 0.3 * (-1.0) ** np.arange(16)
    shares = share_of_repairs(
        [
            trial((), 10 * blocks),
            trial(("friction",), 4 * blocks),
            trial(("friction", "lag"), blocks + uneven),
            trial(("friction", "delay"), blocks - uneven),
            trial(("friction", "delay", "ripple"), blocks - uneven),
        ]
    )
    assert shares["friction"] == pytest.approx(1.0)
    assert shares["lag"] + shares["delay"] == pytest.approx(1.0)
    assert 0.2 < shares["lag"] < 0.8
    assert shares["ripple"] == 0


def test_the_values_that_did_nothing_go_back_first():
    end = SimpleNamespace(deviations=np.array([2.0, 0.01, -1.0]))
    assert list(_order_of_return(end, np.diag([1.0, 5.0, 1.0]))) == [1, 2, 0]
    # Two that make up for each other are needed by the records only together.
    correlated = np.array([[1.0, 0.999, 0.0], [0.999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    end = SimpleNamespace(deviations=np.array([1.0, -1.0, 0.5]))
    assert _order_of_return(end, correlated)[-1] == 2


# Names


def test_prediction_alone_is_never_surer_than_that_a_cause_is_on_the_list():
    all_of_it = presence_by_prediction(1.0, share=1.0, left=0.0)
    assert 0.5 < all_of_it < 1.0
    # In half of the repairs, half as sure.
    assert presence_by_prediction(0.5, share=1.0, left=0.0) == pytest.approx(all_of_it / 2)


def test_beside_much_that_is_left_prediction_says_little():
    probabilities = [presence_by_prediction(1.0, share=1 - left, left=left) for left in (0.1, 0.5, 0.9, 0.99)]
    assert probabilities == sorted(probabilities, reverse=True)
    assert probabilities[-1] < 0.01


def test_no_more_than_all_of_a_motion_remains():
    """Of an output that hardly moves in validation records a model may miss any multiple."""
    case = joint({}, unlisted_and_dry, logs=2)
    far = {record.name: np.full(record.output.shape, 1e9) for record in case.experiments}
    remains = completeness_of(case, 0.1, far)
    assert remains.most == 1.0
    assert remains.in_units["torque_Nm"] == pytest.approx(1e7)
