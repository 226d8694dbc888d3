"""What records can tell before a fit: sizes against closed forms, what acts alike, what does nothing."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.machine.telling import telling

NOISE, ERROR, SAMPLES = 1e-3, 0.02, 400


def case(simulate, parameters, effects=(), inputs=None, model_error=ERROR):
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (SAMPLES // 10, 2)).repeat(10, axis=0) if inputs is None else inputs
    records = []
    for role in ("estimation", "held_out"):
        y = simulate(parameters, {}, u)
        records.append(PlantExperiment(role, role, u, y + NOISE * rng.standard_normal(y.shape)))
    noise = np.full(records[0].output.shape[1], NOISE)
    names = tuple(f"y{k}" for k in range(len(noise)))
    listed = tuple(PlantEffect(e, (EffectParameter("size", 1e-4, 10.0),)) for e in effects)
    plant = Plant(
        simulate, parameters, dict.fromkeys(parameters, 0.1), names, noise, listed, model_error, 0.01
    )
    return PlantCase("one", plant, tuple(records))


def lines(parameters, effects, inputs):
    """Two outputs, each a gain times its input, and an offset of the first."""
    offset = effects.get("offset", {}).get("size", 0.0)
    return inputs * [parameters["a"], parameters["b"]] + np.array([offset, 0.0])


@pytest.mark.parametrize("model_error", [0.0, 0.02, 0.3])
def test_the_smallest_size_is_that_of_the_threshold(model_error):
    """Of a gain the share that is the model error, or three deviations of a mean where that is zero."""
    one = case(lines, {"a": 2.0, "b": 0.5}, ("offset",), model_error=model_error)
    (record,) = one.estimation
    level = np.hypot(model_error * np.std(record.output, axis=0), 3 * NOISE / np.sqrt(SAMPLES))
    clean = np.sqrt(np.mean((record.input * [2.0, 0.5]) ** 2, axis=0))
    found = telling(one)
    assert found.least["a"] == pytest.approx(level[0] / clean[0], rel=1e-6)
    assert found.least["b"] == pytest.approx(level[1] / clean[1], rel=1e-6)
    assert found.least["offset"] == pytest.approx(level[0], rel=1e-6)
    assert not found.alike
    assert not found.hidden


def test_what_does_nothing_or_too_little_is_hidden():
    def simulate(parameters, effects, inputs):
        return lines({"a": 2.0, "b": 1.0}, {}, inputs) * (1 + 1e-6 * parameters["faint"])

    found = telling(case(simulate, {"faint": 1.0, "unused": 3.0}, ("nothing",)))
    assert set(found.hidden) == {"faint", "unused", "nothing"}
    assert found.least["unused"] == np.inf
    assert 1 < found.least["faint"] < np.inf


@pytest.mark.parametrize(
    ("formula", "group"),
    [
        (lambda p: p["a"] * p["b"], {"a", "b"}),
        (lambda p: p["a"] / p["b"], {"a", "b"}),
        (lambda p: p["a"] * p["b"] * p["c"], {"a", "b", "c"}),
    ],
)
def test_values_of_which_only_a_product_shows_are_alike(formula, group):
    def simulate(parameters, effects, inputs):
        return inputs[:, :1] * formula(parameters) + parameters["d"] * inputs[:, 1:] ** 2

    found = telling(case(simulate, {"a": 1.2, "b": 2.0, "c": 0.7, "d": 0.5}, ("size",)))
    assert set().union(*(one.names for one in found.alike)) == group
    assert all(one.left < 1e-3 for one in found.alike)


def test_inertia_damping_and_gain_of_a_joint_scale_together():
    mujoco = pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    text = """<mujoco><option timestep="0.002"/><worldbody><body name="rod">
    <joint name="hinge" axis="0 0 1" damping="0.4" armature="0.2"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/></body></worldbody>
    <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data, rows = mujoco.MjData(model), []
    for u in np.random.default_rng(1).uniform(-1, 1, 30).repeat(15):
        rows.append([u, data.qpos[0]])
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 5)
    log = np.array(rows)
    records = [PlantExperiment(r, r, log, log[:, 1:]) for r in ("estimation", "held_out")]
    plant = MujocoArm(mujoco.MjSpec.from_string(text), ("hinge",), 0.01, 2.0).plant(
        records, np.array([1e-4]), model_error=0.02
    )
    found = telling(PlantCase("rod", plant, tuple(records)))
    groups = [{*one.names} for one in found.alike]
    assert {"hinge.armature", "rod.mass"} in groups
    assert any({"motor.gain", "hinge.damping"} <= g and g & {"hinge.armature", "rod.mass"} for g in groups)


def test_a_deadline_says_what_was_not_looked_at():
    found = telling(case(lines, {"a": 2.0, "b": 0.5}, ("offset",)), deadline_s=0.0)
    assert found.unlooked == ("a", "b", "offset")
    assert not found.least


def test_of_a_limit_the_largest_that_shows_is_told():
    """Of a ramp to one, cut off: the energy beyond a limit is (1 - limit)^3 / 3."""
    ramp = np.linspace(0, 1, SAMPLES)[:, None] * [1.0, 1.0]

    def simulate(parameters, effects, inputs):
        return lines(parameters, {}, np.minimum(inputs, effects.get("limit", {"size": 1.0})["size"]))

    one = case(simulate, {"a": 1.0, "b": 1.0}, ("limit",), inputs=ramp)
    limit = PlantEffect("limit", (EffectParameter("size", 0.05, 1.0),), grows=False)
    found = telling(replace(one, plant=replace(one.plant, effects=(limit,))))
    level = np.hypot(ERROR / np.sqrt(12), 3 * NOISE / np.sqrt(SAMPLES))
    assert 0.85 < found.least["limit"] / (1 - (3 * level**2) ** (1 / 3)) <= 1
    assert not found.hidden
