"""The contract every registered effect keeps. An effect without an entry in EXAMPLES fails here."""

import time

import numpy as np
import pytest

from plant import EFFECTS, Effect, paper_link, parse_effect, parse_effects, prbs, simulate
from plant.effects.base import LOOK_ALIKES, RatioEffect, register
from plant.effects.joint import CoulombFriction
from plant.machine import Machine
from plant.simulation import Simulator, Start

RIG = paper_link()
VOLTAGE = prbs(7, 6, 3.0, 300, np.random.default_rng(4))

# A size that shows in the outputs, and whether it shows at the hub too.
EXAMPLES: dict[str, dict[str, float]] = {
    "coulomb_friction": {"torque_Nm": 0.1},
    "stribeck_friction": {
        "static_torque_Nm": 0.15,
        "coulomb_torque_Nm": 0.1,
        "stribeck_velocity_rad_s": 0.05,
    },
    "viscous_friction": {"coefficient_Nms": 0.05},
    "backlash": {"gap_rad": 0.02},
    "actuator_saturation": {"limit_V": 2.2},
    "actuator_dead_zone": {"width_V": 0.3},
    "actuator_lag": {"time_constant_s": 0.02},
    "input_delay": {"delay_s": 0.0123},
    "actuator_gain": {"ratio": 0.9},
    "torque_ripple": {"amplitude_Nm": 0.1, "cycles_per_rev": 11.0, "phase_rad": 0.5},
    "joint_compliance": {"stiffness_Nm_rad": 20.0, "damping_Nms": 0.02},
    "tip_payload": {"mass_kg": 0.02},
    "link_stiffness": {"ratio": 0.85},
    "structural_damping": {"ratio": 2.0},
    "hardening_spring": {"cubic_Nm_rad3": 5.0},
    "gravity": {"acceleration_m_s2": 0.5},
    "sensor_lag": {"time_constant_s": 0.02},
    "sensor_gain": {"ratio": 1.1},
    "sensor_drift": {"rate_m_s": 0.01},
    "quantisation": {"step_m": 0.005},
    "periodic_disturbance": {"amplitude_Nm": 0.1, "frequency_Hz": 1.7, "phase_rad": 0.2},
    "base_compliance": {"stiffness_Nm_rad": 100.0, "damping_Nms": 0.2, "inertia_kg_m2": 0.2},
    "hub_inertia": {"ratio": 1.2},
}


def _output(*effects: Effect) -> np.ndarray:
    return simulate(RIG, VOLTAGE, effects).output


def _example(name: str) -> Effect:
    return parse_effect({"name": name, **EXAMPLES[name]})


@pytest.fixture(scope="module")
def nominal() -> np.ndarray:
    return _output()


def test_every_effect_of_the_rig_description_is_registered():
    assert set(EFFECTS) == set(EXAMPLES)


@pytest.mark.parametrize("name", EFFECTS)
class TestContract:
    def test_it_says_what_it_is(self, name):
        kind = EFFECTS[name]
        assert kind.id == name
        assert kind.group in ("actuator", "joint", "link", "sensor")
        assert kind.__doc__
        assert kind.words
        for field, info in kind.model_fields.items():
            assert info.description, f"{name}.{field} has no description"

    def test_it_is_frozen_and_its_table_reads_back(self, name):
        effect = _example(name)
        assert parse_effect(effect.to_dict()) == effect
        assert effect.parameters() == EXAMPLES[name]
        with pytest.raises(ValueError, match="frozen"):
            setattr(effect, next(iter(EXAMPLES[name])), 1.0)

    def test_it_changes_the_outputs(self, name, nominal):
        change = np.sqrt(np.mean((_output(_example(name)) - nominal) ** 2, axis=0))
        assert change[1] > 5e-4
        assert change[0] == 0 if EFFECTS[name].group == "sensor" else change[0] > 5e-4

    def test_the_machine_knows_whether_it_is_linear(self, name):
        effect = _example(name)
        once, twice = (simulate(RIG, factor * VOLTAGE, [effect]).output for factor in (1, 2))
        scales = bool(np.allclose(twice, 2 * once, rtol=0, atol=1e-9))
        assert effect.modify(Machine(RIG)).linear == scales

    def test_it_vanishes_at_its_neutral_value(self, name, nominal):
        neutral = EFFECTS[name].neutral
        if neutral is None:
            assert name in ("joint_compliance", "base_compliance", "backlash")
            return
        sizes = dict.fromkeys(EXAMPLES[name], 0.0) | neutral
        np.testing.assert_allclose(
            _output(parse_effect({"name": name, **sizes})), nominal, rtol=0, atol=1e-12
        )

    def test_the_outputs_depend_on_every_parameter_as_claimed(self, name):
        kind, base = EFFECTS[name], EXAMPLES[name]
        if kind.dependence == "non-smooth":
            assert name in ("backlash", "quantisation")
            return
        reference = _output(_example(name))
        for parameter, value in base.items():

            def change(relative, parameter=parameter, value=value):
                changed = {**base, parameter: value * (1 + relative)}
                return _output(parse_effect({"name": name, **changed})) - reference

            step = change(1e-4)
            if kind.dependence == "smooth":
                # A derivative exists: a step and its half agree but for the curvature, 1e-4 of the step or
                # so.
                error = np.max(np.abs(2 * change(0.5e-4) - step))
                assert error < 0.02 * np.max(np.abs(step)) + 1e-12, parameter
            else:
                # Continuous: the change shrinks with the step (a kink may bend it), and stays in proportion.
                small = np.max(np.abs(change(1e-6)))
                assert small < 0.2 * np.max(np.abs(step)) + 1e-9, parameter
                assert np.max(np.abs(step)) < 1e-2, parameter

    def test_bad_parameters_are_refused_in_one_line(self, name):
        for parameter in EXAMPLES[name]:
            for bad in (np.nan, np.inf, "1", None):
                with pytest.raises(ValueError) as caught:
                    parse_effect({"name": name, **EXAMPLES[name], parameter: bad})
                assert str(caught.value).startswith(f"effect {name}: {parameter}: expected")
                assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("effect", "tolerance"),
    [
        ({"name": "joint_compliance", "stiffness_Nm_rad": 1e6, "damping_Nms": 1.0}, 2e-5),
        (
            {"name": "base_compliance", "stiffness_Nm_rad": 1e7, "damping_Nms": 10.0, "inertia_kg_m2": 0.1},
            2e-6,
        ),
    ],
    ids=lambda value: value["name"] if isinstance(value, dict) else "",
)
def test_stiff_springs_are_rigid(effect, tolerance, nominal):
    # A spring k turns by torque / k: about 2 N m over k here.
    np.testing.assert_allclose(_output(parse_effect(effect)), nominal, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", LOOK_ALIKES)
def test_what_looks_like_an_effect_is_read_as_well(name):
    kind = LOOK_ALIKES[name]
    effect = kind(**dict.fromkeys(kind.model_fields, 0.5))
    assert parse_effect(effect.to_dict()) == effect


def test_effects_commute():
    effects = [_example(name) for name in EFFECTS if name != "backlash"]
    forward, backward = _output(*effects), _output(*reversed(effects))
    np.testing.assert_allclose(forward, backward, rtol=0, atol=1e-9)


def test_voltage_effects_act_in_the_stated_order():
    gain, zone, limit = 1.7, 0.4, 2.5
    entries = [
        {"name": "actuator_saturation", "limit_V": limit},
        {"name": "actuator_dead_zone", "width_V": zone},
        {"name": "actuator_gain", "ratio": gain},
    ]
    voltage = np.linspace(-4, 4, 81)
    amplified = gain * voltage
    expected = np.clip(np.sign(amplified) * np.maximum(np.abs(amplified) - zone, 0), -limit, limit)
    got = simulate(RIG, voltage, parse_effects(entries)).output
    np.testing.assert_allclose(got, simulate(RIG, expected).output, rtol=0, atol=1e-13)


def test_sensor_effects_act_in_the_stated_order():
    entries = [
        {"name": "quantisation", "step_m": 0.003},
        {"name": "sensor_drift", "rate_m_s": 0.02},
        {"name": "sensor_gain", "ratio": 1.3},
    ]
    bare = simulate(RIG, VOLTAGE, rng=np.random.default_rng(1))
    got = simulate(RIG, VOLTAGE, parse_effects(entries), rng=np.random.default_rng(1))
    noise = bare.tip_m - bare.tip_true_m
    analogue = 1.3 * bare.tip_true_m + 0.02 * bare.time_s + noise
    np.testing.assert_allclose(got.tip_m, 0.003 * np.round(analogue / 0.003), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(got.hub_angle_rad, bare.hub_angle_rad)
    np.testing.assert_array_equal(got.tip_true_m, bare.tip_true_m)


def test_a_parametric_effect_is_the_rig_with_that_parameter():
    changed = {
        "tip_payload": RIG.perturbed({"payload.mass_kg": 0.02}),
        "link_stiffness": RIG.scaled({"link.youngs_modulus_Pa": 0.85}),
        "structural_damping": RIG.scaled({"link.kelvin_voigt_s": 2.0}),
        "hub_inertia": RIG.scaled({"hub.inertia_kg_m2": 1.2}),
        "viscous_friction": RIG.perturbed({"hub.viscous_friction_Nms": RIG.hub.viscous_friction_Nms + 0.05}),
    }
    for name, rig in changed.items():
        np.testing.assert_allclose(_output(_example(name)), simulate(rig, VOLTAGE).output, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ({"name": "gravitation", "g": 1.0}, "gravitation.*input_delay, "),
        ({"torque_Nm": 1.0}, "name.*input_delay, "),
        ({"name": ["a"]}, r"\['a'\]"),
        ("coulomb_friction", "name.*coulomb_friction"),
        ({"name": "coulomb_friction"}, "coulomb_friction.*torque_Nm"),
        (
            {"name": "coulomb_friction", "torque_Nm": 1.0, "level": 2.0},
            "coulomb_friction.*level.*torque_Nm",
        ),
        (
            {
                "name": "stribeck_friction",
                "static_torque_Nm": 0.1,
                "coulomb_torque_Nm": 0.2,
                "stribeck_velocity_rad_s": 0.1,
            },
            r"stribeck_friction.*static_torque_Nm.*coulomb_torque_Nm.*0\.1.*0\.2",
        ),
    ],
)
def test_entries_that_are_no_effect_are_refused(entry, complaint):
    with pytest.raises(ValueError, match=complaint) as caught:
        parse_effect(entry)
    assert "\n" not in str(caught.value)


def test_the_same_effect_twice_is_refused():
    effect = CoulombFriction(torque_Nm=0.1)
    with pytest.raises(ValueError, match="coulomb_friction"):
        simulate(RIG, VOLTAGE, [effect, effect])
    with pytest.raises(ValueError, match="coulomb_friction"):
        simulate(RIG, VOLTAGE, ["coulomb_friction"])


def test_a_ratio_that_multiplies_nothing_is_refused_when_it_is_registered():
    with pytest.raises(TypeError, match="nothing"):

        @register
        class Nothing(RatioEffect):
            id, words = "nothing", "nothing"

    assert "nothing" not in EFFECTS


def test_backlash_at_rest_costs_no_more_than_backlash_in_motion():
    """Contacts at rest must not be followed in the smallest steps (a hundred times as many)."""
    rig = paper_link()
    moving = prbs(8, 6, 2.0, 1200)
    pushed_once = np.zeros(1200)
    pushed_once[10:40], pushed_once[40:70] = 2.0, -2.0
    effect = parse_effect({"name": "backlash", "gap_rad": 0.01})
    simulate(rig, moving[:20], (effect,))

    def seconds(voltage):
        times = []
        for _ in range(3):
            start = time.process_time()
            simulate(rig, voltage, (effect,))
            times.append(time.process_time() - start)
        return min(times)

    assert seconds(pushed_once) < 5 * seconds(moving)


def test_gravity_in_another_direction_is_the_same_from_another_angle():
    along = {"name": "gravity", "acceleration_m_s2": 2.0}
    turned = Simulator(RIG, [parse_effect({**along, "direction_rad": 0.7})]).run(VOLTAGE, start=Start(0.3))
    straight = Simulator(RIG, [parse_effect(along)]).run(VOLTAGE, start=Start(0.3 - 0.7))
    np.testing.assert_allclose(turned.hub_angle_rad, straight.hub_angle_rad + 0.7, rtol=0, atol=1e-9)
    np.testing.assert_allclose(turned.tip_deflection_m, straight.tip_deflection_m, rtol=0, atol=1e-9)
    still = Simulator(RIG, ()).run(VOLTAGE, start=Start(0.3))
    assert np.max(np.abs(turned.hub_angle_rad - still.hub_angle_rad)) > 0.03
