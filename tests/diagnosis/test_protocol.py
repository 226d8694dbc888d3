"""A machine that is no flexible link goes through the same diagnosis, by the protocol alone."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose, with_effects
from diagnosis.machine.around import Actuator, Body
from diagnosis.machine.machine_protocol import Weighing
from diagnosis.machine.probed import doubtful_columns, doubts_about
from examples import own_plant
from plant import simulate
from tests.diagnosis.synthetic_residuals import RIG, made, white

NOISE_M = 1e-3


def _force(k, n=400):
    return (3.0 + k) * np.random.default_rng([7, k]).choice([-1.0, 1.0], n // 20).repeat(20)


def _integrated(force, acceleration):
    """Position of a carriage by an adaptive integrator, sample by sample: not the solver on trial."""
    state, position = np.zeros(2), []
    for k, f in enumerate(force):
        position.append(state[0])
        t = k * own_plant.DT_S
        run = solve_ivp(
            lambda t, s, f=f: (s[1], acceleration(t, s[0], s[1], f)),
            (t, t + own_plant.DT_S),
            state,
            method="DOP853",
            rtol=1e-9,
            atol=1e-12,
        )
        state = run.y[:, -1]
    return np.array(position)


def _case(acceleration, **changes):
    experiments = []
    for k, role in enumerate(("estimation", "estimation", "held_out")):
        noise = NOISE_M * np.random.default_rng([8, k]).standard_normal(400)
        output = _integrated(_force(k), acceleration) + noise
        experiments.append(PlantExperiment(f"{k}", role, _force(k)[:, None], output[:, None]))
    case = own_plant.case_of(experiments, **changes)
    return replace(case, plant=replace(case.plant, noise=np.array([NOISE_M])))


def test_stiffening_spring_is_found_and_sized():
    found = diagnose(_case(lambda t, x, v, f: (f - 78.0 * x - 4e3 * x**3 - 3.2 * v) / 2.03))
    assert found.combination == ("stiffening",)
    assert found.verdict == "effect"
    assert found.probabilities["stiffening"] > 0.9
    assert sum(found.probabilities.values()) == pytest.approx(1)
    low, high = found.effects[0].intervals["cubic_N_m3"]
    # Half the distance between interval and value more than the interval: one seed, and a mass known to 2 %.
    assert low - (high - low) / 2 < 4e3 < high + (high - low) / 2
    # Held-out residuals at the floor within four standard errors of 400 samples.
    assert found.gap_after < 1 + 4 / np.sqrt(800)
    assert found.gap_before > found.gap_refit > 2
    assert found.gap_closed > 0.95
    assert found.repair[0].to_dict()["name"] == "stiffening"
    assert found.rig.parameters["mass_kg"] == pytest.approx(2.03, rel=0.02)


def test_what_no_listed_effect_describes_is_unknown():
    found = diagnose(_case(lambda t, x, v, f: (f - 80.0 * x - 3.0 * v + 2 * np.sin(25 * t)) / 2.0))
    assert found.verdict == "unknown"
    # It is small beside the motion: the answer asks whether that matters.
    left = found.completeness.most
    assert left < 0.05
    assert any(f"{100 * left:.2g} % of the motion" in d and "model_error=0.05" in d for d in found.doubts)


@pytest.mark.parametrize(
    ("cubic_N_m3", "tone_N", "stated", "verdict"),
    [
        # The simulation can be exact: less than 5 % of the motion is named all the same.
        (150.0, 0.0, None, "effect"),
        (150.0, 0.0, 0.05, "none"),
        pytest.param(0.0, 0.0, None, "none", marks=pytest.mark.slow),
        # Something small is always missing: that must not hide what is large.
        pytest.param(4e3, 0.6, None, "effect", marks=pytest.mark.slow),
        pytest.param(4e3, 0.6, 0.0, "unknown", marks=pytest.mark.slow),
        # A tone alone, small beside what is stated that the simulation may miss.
        pytest.param(0.0, 0.1, 0.05, "none", marks=pytest.mark.slow),
    ],
)
def test_without_a_stated_model_error_the_records_say_whether_there_is_one(
    cubic_N_m3, tone_N, stated, verdict
):
    def acceleration(t, x, v, f):
        return (f - 80.0 * x - 3.0 * v - cubic_N_m3 * x**3 + tone_N * np.sin(25 * t)) / 2.0

    found = diagnose(_case(acceleration, model_error=stated))
    assert (found.verdict, found.combination) == (verdict, ("stiffening",) * (verdict == "effect"))
    assert found.doubts == ()


@pytest.mark.slow
def test_the_example_runs_and_finds_what_it_lacks(capsys, monkeypatch):
    found = own_plant.run(seed=1)
    monkeypatch.setattr(own_plant, "run", lambda: found)
    own_plant.main()
    assert "verdict: effect" in capsys.readouterr().out
    assert set(found.combination) == {"coulomb_friction", "input_offset"}
    by_name = {effect.name: effect.parameters for effect in found.effects}
    # Friction around the simulation, in the records inside it: 1 % is several of the intervals' widths.
    assert by_name["coulomb_friction"]["force"] == pytest.approx(0.8, rel=0.01)
    assert by_name["input_offset"]["offset"] == pytest.approx(-0.5, rel=0.01)


def test_a_simulation_that_runs_away_ends_somewhere_finite():
    def simulation(parameters, effects, inputs):
        with np.errstate(over="ignore", invalid="ignore"):
            return np.exp(1e3 * parameters["k"] * inputs) * np.array([[1.0]]) - np.inf * (len(effects) > 0)

    plant = replace(PLANT, simulation=simulation)
    (candidate, _) = plant.effects[0].candidates()
    for effects in ((), (candidate.effect_at(np.zeros(1)),)):
        assert np.all(np.isfinite(plant.simulator(effects)(GOOD.input) ** 2))


def test_the_flexible_arm_answers_by_the_same_protocol():
    case = made(white(np.random.default_rng(1)))
    voltage = case.experiments[0].voltage_V
    np.testing.assert_array_equal(
        case.machine.simulator(())(case.experiments[0].input), simulate(case.rig, voltage, ()).output
    )
    assert case.machine.description is case.rig
    assert case.machine.weighing == Weighing()
    assert case.machine.tolerances == RIG.tolerances


GOOD = PlantExperiment("a", "estimation", np.ones((30, 1)), np.arange(30.0)[:, None])
PLANT = Plant(
    lambda parameters, effects, inputs: parameters["k"] * inputs,
    {"k": 2.0},
    {"k": 0.1},
    ("y",),
    np.array([0.1]),
    (PlantEffect("offset", (EffectParameter("y", 0.1, 1.0),), signed=True),),
)


BOTH = (GOOD, replace(GOOD, name="b", role="held_out"))


DIFFERENT = (GOOD, replace(GOOD, name="b", role="held_out", output=GOOD.output + 1))


def _with_offset(effects, outputs):
    return outputs + effects.get("offset", {"y": 0.0})["y"]


def _random(parameters, effects, inputs, rng=np.random.default_rng(0)):  # noqa: B008
    return inputs + rng.standard_normal(inputs.shape)


def _random_beside(parameters, effects, inputs, rng=np.random.default_rng(0)):  # noqa: B008
    return parameters["k"] * inputs + (parameters["k"] != 2.0) * rng.standard_normal(inputs.shape)


def _left(parameters, effects, inputs):
    raise SystemExit


def _doubts(simulation, **how):
    return doubts_about(PlantCase("c", replace(PLANT, simulation=simulation, **how), DIFFERENT))


@pytest.mark.parametrize(
    ("simulation", "how", "said"),
    [
        (lambda p, e, u: p["k"] * u, {}, ["offset changes no output"]),
        (lambda p, e, u: _with_offset(e, 2.0 * u), {}, ["k changes no output"]),
        (lambda p, e, u: _with_offset(e, p["k"] * u / (p["k"] < 2.1)), {}, ["diverges with k at 2.21"]),
        (lambda p, e, u: _with_offset(e, u / (p["k"] > 1.9)), {}, ["diverges with k at 1.81"]),
        (
            lambda p, e, u: _with_offset(e, u * (1 if p["k"] < 2.1 else np.nan)),
            {},
            ["diverges with k at 2.21"],
        ),
        (lambda p, e, u: _with_offset(e, round(p["k"], 1) * u), {}, ["not smooth in k"]),
        (lambda p, e, u: _with_offset(e, np.sin(3e4 * p["k"]) * u), {}, ["not smooth in k"]),
        (lambda p, e, u: _with_offset(e, p["k"] * u), {"tolerances": {"k": 10.0}}, []),
        (lambda p, e, u: _with_offset(e, p["k"] ** 3 * u), {}, []),
        (
            lambda p, e, u: _with_offset(e, p["k"] * np.deg2rad(np.cumsum(u, axis=0)) / 2),
            {},
            ["y moves 57.3 times as far as in the simulation: is its column in degrees?"],
        ),
        (
            lambda p, e, u: _with_offset(e, -p["k"] * np.cumsum(u, axis=0) / 2),
            {},
            ["y moves the other way round than in the simulation"],
        ),
        (lambda p, e, u: _with_offset(e, p["k"] * u), {"tolerances": {"k": 1.0}}, []),
    ],
)
def test_what_makes_an_answer_doubtful_is_said(simulation, how, said):
    found = _doubts(simulation, **how)
    assert len(found) == len(said)
    for sentence, words in zip(found, said, strict=True):
        assert words in sentence


def _swings(step_s):
    """A sprung mass, by steps of this length."""
    numerator, denominator, _ = cont2discrete(([60.0], [1.0, 3.0, 60.0]), step_s)
    return lambda u: lfilter(numerator[0], denominator, u, axis=0)


@pytest.mark.parametrize(
    ("simulated", "recorded", "said"),
    [
        (_swings(0.001), _swings(0.01), "where a sample is 10 of its steps: is its step the sampling period"),
        (_swings(0.002), _swings(0.01), "where a sample is 5 of its steps"),
        (_swings(1e-4), _swings(0.01), "where a sample is 100 of its steps"),
        (_swings(0.05), _swings(0.01), "where its step is 5 samples"),
        # With something missing as well.
        (_swings(0.001), lambda u: _swings(0.01)(u) + 0.15 * np.abs(u), "where a sample is 10 of its steps"),
        (_swings(0.01), _swings(0.01), ""),
        (_swings(0.01), lambda u: 57.3 * _swings(0.01)(u), "is its column in degrees"),
        # Less than a factor of five is as well an inertia.
        (_swings(0.005), _swings(0.01), ""),
        (lambda u: 0 * u, _swings(0.01), ""),
    ],
)
def test_a_step_that_is_not_that_of_the_log_is_doubted(simulated, recorded, said):
    u = np.random.default_rng(3).uniform(-1, 1, 60).repeat(15)[:, None]
    u[:150] = 0.0
    record = PlantExperiment("log", "estimation", u, recorded(u))
    plant = replace(PLANT, simulation=lambda p, e, u: simulated(u), dt_s=0.01)
    found = doubtful_columns(SimpleNamespace(plant=plant, estimation=[record], outputs=("y",)))
    assert len(found) == bool(said)
    assert all(said in one for one in found)


@pytest.mark.parametrize(
    ("stated_s", "is_doubted"), [(None, True), (0.01, False), (0.010001, False), (0.001, True)]
)
def test_a_step_that_the_simulation_says_itself_is_not_doubted(stated_s, is_doubted):
    """What it follows badly is then the machine, whatever another step would do."""

    class Stepping:
        dt_s = stated_s

        def __call__(self, parameters, effects, inputs):
            return _swings(0.001)(inputs)

    u = np.random.default_rng(3).uniform(-1, 1, 60).repeat(15)[:, None]
    record = PlantExperiment("log", "estimation", u, _swings(0.01)(u))
    plant = replace(PLANT, simulation=Stepping(), dt_s=0.01)
    found = doubtful_columns(SimpleNamespace(plant=plant, estimation=[record], outputs=("y",)))
    assert bool(found) == is_doubted


@pytest.mark.parametrize(
    "given",
    [lambda y: y[:, 0], lambda y: y[:, 0].tolist(), lambda y: y.tolist(), lambda y: pd.Series(y[:, 0])],
)
def test_one_output_is_a_column_in_whatever_form(given):
    u = np.linspace(-1, 1, 30)
    plant = replace(PLANT, simulation=lambda p, e, u: given(p["k"] * u))
    records = [PlantExperiment(name, role, u, u) for name, role in (("a", "estimation"), ("b", "held_out"))]
    case = PlantCase("c", plant, tuple(records))
    np.testing.assert_array_equal(case.machine.simulator(())(records[0].input), 2.0 * u[:, None])
    assert records[1].output.shape == (30, 1)


def test_exchanged_columns_are_doubted():
    moves = np.cumsum(np.random.default_rng(4).standard_normal((400, 2)), axis=0)
    given = {"untracked": 0, "body": None, "simulation": None}
    plant = SimpleNamespace(replayed=lambda effects: lambda u: np.resize(moves, (len(u), 2)), **given)

    def doubts(measured):
        record = SimpleNamespace(input=moves, output=measured)
        return doubtful_columns(SimpleNamespace(plant=plant, estimation=[record], outputs=("a", "b")))

    assert doubts(0.7 * moves) == ()
    first, second = doubts(moves[:, ::-1])
    assert first.startswith("a of the simulation moves as the column of b does")
    assert second.startswith("b of the simulation moves as the column of a does")


def test_a_validation_record_that_was_fitted_validates_nothing():
    plant = replace(PLANT, simulation=lambda p, e, u: _with_offset(e, p["k"] * u))
    assert doubts_about(PlantCase("c", plant, BOTH)) == (
        "the validation record b is the same as a: add another one",
    )


def test_doubts_are_in_the_answer():
    case = PlantCase("c", replace(PLANT, model_error=0.05), DIFFERENT)
    with pytest.warns(UserWarning, match="offset changes no output"):
        found = diagnose(case)
    assert found.doubts == doubts_about(case) != ()


def test_an_effect_of_ones_own_stands_for_the_listed_one_of_its_name():
    own = PlantEffect("output_offset", (EffectParameter("y", 0.1, 1.0),), signed=True)
    plant = replace(PLANT, effects=(own,))
    equipped = with_effects(plant, "all", [GOOD], dt_s=0.1)
    assert equipped.effects[0] is own
    assert [e.name for e in equipped.effects].count("output_offset") == 1
    assert "output_drift" in {e.name for e in equipped.effects}


def _listed(name, level=1.0, late=1, **how):
    """An integrator, `late` samples behind."""

    def simulation(parameters, effects, inputs):
        return np.concatenate([np.zeros((late, 1)), np.cumsum(inputs, axis=0)[:-late]])

    record = replace(GOOD, input=level * GOOD.input)
    return with_effects(replace(PLANT, simulation=simulation), [name], [record], dt_s=0.1, **how)


def test_only_numerical_failures_of_a_trial_are_taken_for_running_away():
    def failing(error):
        def simulation(parameters, effects, inputs):
            if effects:
                raise error
            return inputs

        return replace(PLANT, simulation=simulation).simulator([PLANT.effects[0].from_search({"y": 0.5}, 1)])

    for error in (ZeroDivisionError(), OverflowError(), FloatingPointError(), np.linalg.LinAlgError()):
        assert np.all(failing(error)(GOOD.input) > 1e9)
    with pytest.raises(ValueError, match=r"with k 2 and offset \{'y': 0.5\} the simulation ended with Key"):
        failing(KeyError("mine"))(GOOD.input)


def _by(simulation):
    return PlantCase("c", replace(PLANT, simulation=simulation), BOTH)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(GOOD, input=np.ones((30, 1, 1))), r"needs input \(T, U\)"),
        (lambda: replace(GOOD, input=np.ones((31, 1))), r"got \(31, 1\) and \(30, 1\)"),
        (lambda: replace(GOOD, role="test"), "role must be"),
        (lambda: replace(GOOD, output=np.full((30, 1), np.nan)), "not finite"),
        (lambda: PlantExperiment("s", "held_out", np.ones((9, 1)), np.ones((9, 1))), "needs at least 20"),
        (lambda: replace(PLANT, noise=np.array([0.0])), "one noise level above zero per output"),
        (lambda: replace(PLANT, tolerances={"m": 0.1}), "tolerance of m, which is no parameter"),
        (lambda: replace(PLANT, tolerances={"k": 0.0}), "must be between 0 and 10"),
        (lambda: replace(PLANT, tolerances={"k": 11.0}), "must be between 0 and 10"),
        (lambda: replace(PLANT, tolerances={"k": "5 %"}), "must be between 0 and 10 .*; got '5 %'"),
        (lambda: replace(PLANT, parameters={"k": "2"}), "parameter k must be a finite number; got '2'"),
        (lambda: replace(PLANT, effects=("offset",)), "effects must be PlantEffect; got 'offset'"),
        (lambda: PlantCase("c", PLANT, (GOOD,) * 501), "case c: 501 records, at most 500; give the longest"),
        (lambda: _doubts(_random_beside), "with the same parameters, not those stated, differ"),
        (lambda: _doubts(_left), "the simulation ended with SystemExit"),
        (lambda: _doubts(lambda p, e, u: u * 1j), "the simulation ended with ValueError: complex outputs"),
        (lambda: PlantCase("c", replace(PLANT, effects=()), BOTH), "lists no effect"),
        (lambda: replace(PLANT, effects=PLANT.effects * 2), "listed twice"),
        (lambda: replace(PLANT, model_error=-1.0), "model_error"),
        (lambda: EffectParameter("y", 2.0, 1.0), "low < high"),
        (lambda: EffectParameter("y", 0.0, 1.0), "above zero on a log scale"),
        (lambda: EffectParameter("y", 1.0, 2.0, (3.0,)), "start 3 is outside 1 to 2"),
        (lambda: PlantEffect("e", ()), "at least one parameter"),
        (lambda: PlantEffect("unknown", PLANT.effects[0].parameters), "an answer of its own"),
        (lambda: PlantEffect("e", PLANT.effects[0].parameters, dependence="wild"), "dependence"),
        (lambda: PlantCase("c", PLANT, (GOOD,)), "no experiment has the role held_out"),
        (lambda: PlantCase("c", PLANT, (GOOD, GOOD)), "given twice"),
        (lambda: PlantCase("c", PLANT, (GOOD, replace(BOTH[1], output=GOOD.input))), "is the sensor dead"),
        (lambda: _by(lambda p, e, u: u[:-1]), r"with k 2 .* must give outputs \(30, 1\); got \(29, 1\)"),
        (lambda: _by(lambda p, e, u: u.T), r"must give outputs \(30, 1\); got \(1, 30\); transpose it"),
        (lambda: _by(lambda p, e, u: u * np.nan), "c, experiment a: .* as stated does not give finite out"),
        (lambda: _by(_random), "a: two simulations as stated differ by up to .*; is something random"),
        (lambda: _by(lambda p, e, u: p["m"] * u), "plant: with k 2 the simulation ended with KeyError: 'm'"),
        (lambda: _by(lambda p, e, u: u * (1 / (p["k"] - 2))), "as stated ended with ZeroDivisionError"),
        (lambda: _listed("none_such"), "no listed effect is called 'none_such'; there are input_delay"),
        (lambda: _listed("coulomb_friction"), "coulomb_friction needs body="),
        (lambda: _listed("spring", body=Body("x")), "no output is called 'x'; there are y"),
        (lambda: _listed("input_delay", actuator=Actuator(1)), "there is no input 1; the records have 1"),
        (lambda: _listed("spring", body=Body("y", force=0), level=0.0), "state largest_force="),
        (lambda: _listed("input_offset", level=0.0), "zero in every record"),
        (lambda: _listed("spring", body=Body(3)), r"column 3 of a simulation that returns \(30, 1\)"),
        (lambda: _listed("spring", body=Body("y"), late=9), "motion follows the stated input later"),
    ],
)
def test_bad_input_is_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
