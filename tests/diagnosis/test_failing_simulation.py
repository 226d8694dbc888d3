"""A simulation that fails with one of its candidates: the diagnosis goes on without that one and says so."""

import warnings

import numpy as np
import pytest

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose
from diagnosis.machine.own_plant import SimulationError
from diagnosis.machine.telling import telling

NOISE = 0.01
TRUE_OFFSET = 0.3
OFFSET = PlantEffect("offset", (EffectParameter("y", 0.01, 1.0),), signed=True)
SKEW = PlantEffect("skew", (EffectParameter("share", 0.01, 1.0),))


def follows(parameters, effects, inputs):
    """y = k u / m and what the effects add."""
    offset = effects.get("offset", {"y": 0.0})["y"]
    share = effects.get("skew", {"share": 0.0})["share"]
    return parameters["k"] * inputs / parameters["m"] + offset + share * inputs**2


def failing_effect(parameters, effects, inputs):
    if "skew" in effects:
        raise KeyError("slope")
    return follows(parameters, effects, inputs)


def failing_from_some_size_on(parameters, effects, inputs):
    if "skew" in effects and effects["skew"]["share"] > 0.05:
        raise ValueError("math domain error")
    return follows(parameters, effects, inputs)


def failing_value(parameters, effects, inputs):
    if parameters["m"] < 0.98:
        raise RuntimeError("the mass matrix is not positive definite")
    return follows(parameters, effects, inputs)


def failing_shape(parameters, effects, inputs):
    found = follows(parameters, effects, inputs)
    return found[:-1] if "skew" in effects else found


def case_of(simulation, effects=(OFFSET, SKEW)):
    """Records whose truth has an offset that the simulation as stated has not."""
    plant = Plant(
        simulation,
        {"k": 2.0, "m": 1.0},
        {"k": 0.05, "m": 0.05},
        ("y",),
        np.array([NOISE]),
        effects=effects,
        model_error=0.02,
    )
    rng = np.random.default_rng(4)
    experiments = []
    for name, role in (("a", "estimation"), ("b", "held_out")):
        u = rng.uniform(-1, 1, (80, 1))
        y = 2.0 * u + TRUE_OFFSET + NOISE * rng.standard_normal((80, 1))
        experiments.append(PlantExperiment(name, role, u, y))
    return PlantCase("case", plant, tuple(experiments))


@pytest.mark.parametrize(
    ("simulation", "left_out", "how"),
    [
        (failing_effect, "skew", "it ended with KeyError: 'slope' (test_failing_simulation.py, line "),
        (failing_from_some_size_on, "skew", "it ended with ValueError: math domain error"),
        (failing_value, "wrong_m", "it ended with RuntimeError: the mass matrix is not positive definite"),
        (failing_shape, "skew", "it must give outputs (80, 1); got (79, 1)"),
    ],
)
def test_the_diagnosis_goes_on_without_the_candidate_and_says_so(simulation, left_out, how):
    with pytest.warns(UserWarning, match=f"{left_out} is left out"):
        found = diagnose(case_of(simulation))
    assert found.combination == ("offset",)
    assert found.repair[0].values["y"] == pytest.approx(TRUE_OFFSET, abs=0.02)
    (said,) = [doubt for doubt in found.doubts if "is left out" in doubt]
    assert said.startswith(f"{left_out} is left out, the simulation fails with it: {how}")
    assert "\n" not in said
    assert left_out in found.case.plant.inactive


def test_a_simulation_that_fails_as_it_is_stated_has_no_answer():
    def broken(parameters, effects, inputs):
        raise KeyError("slope")

    with pytest.raises(ValueError, match="ended with KeyError: 'slope'"):
        case_of(broken)


def test_without_any_other_candidate_the_failure_is_the_answer():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(SimulationError, match="ended with KeyError"):
            diagnose(case_of(failing_effect, (SKEW,)))


@pytest.mark.parametrize(("simulation", "name"), [(failing_effect, "skew"), (failing_shape, "skew")])
def test_what_logs_can_tell_leaves_it_out_too(simulation, name):
    found = telling(case_of(simulation))
    assert set(found.failed) == {name}
    assert set(found.least) == {"k", "m", "offset"}
    assert name not in found.unlooked
