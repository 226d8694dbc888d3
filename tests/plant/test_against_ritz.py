"""The simulation against an arm written down and integrated independently (see ritz.py)."""

from __future__ import annotations

import numpy as np
import pytest

from plant import Rig, paper_link, parse_effect, parse_effects, simulate
from plant.effects import LOOK_ALIKES
from tests.plant.ritz import RitzArm


def _rig() -> Rig:
    return paper_link().perturbed({"payload.mass_kg": 0.05, "hub.inertia_kg_m2": 0.02})


# Long held samples keep the number of solver restarts small; the stepper subdivides them all the same.
DT_S = 0.04
VOLTAGE = np.array([0, 3, 3, -4, 2, -1, 5, 5, -2, 0, 0, 1], dtype=float)

SMOOTH = {
    "nominal": ({}, []),
    "torque_ripple": (
        {"ripple": (0.08, 15.0, 0.4)},
        [{"name": "torque_ripple", "amplitude_Nm": 0.08, "cycles_per_rev": 15.0, "phase_rad": 0.4}],
    ),
    "hardening_spring": ({"cubic": 3.0}, [{"name": "hardening_spring", "cubic_Nm_rad3": 3.0}]),
    "gravity": ({"gravity": 2.5}, [{"name": "gravity", "acceleration_m_s2": 2.5}]),
    "joint_compliance": (
        {"joint": (30.0, 0.02)},
        [{"name": "joint_compliance", "stiffness_Nm_rad": 30.0, "damping_Nms": 0.02}],
    ),
    "base_compliance": (
        {"base": (60.0, 0.1, 0.15)},
        [{"name": "base_compliance", "stiffness_Nm_rad": 60.0, "damping_Nms": 0.1, "inertia_kg_m2": 0.15}],
    ),
    "periodic_disturbance": (
        {"disturbance": (0.2, 3.3, 1.1)},
        [{"name": "periodic_disturbance", "amplitude_Nm": 0.2, "frequency_Hz": 3.3, "phase_rad": 1.1}],
    ),
    "actuator_lag": ({"voltage_lag": 0.03}, [{"name": "actuator_lag", "time_constant_s": 0.03}]),
    "sensor_lag": ({"sensor_lag": 0.02}, [{"name": "sensor_lag", "time_constant_s": 0.02}]),
}


def _compare(options, effects, delay=0.0, **inputs):
    """Largest error over the outputs, relative to the RMS of each."""
    rig = _rig()
    expected = RitzArm(rig, **options).records(VOLTAGE, DT_S, delay, **inputs)
    if inputs:
        inputs = {"hub_torque_Nm": inputs["hub_torque"], "tip_force_N": inputs["tip_force"]}
    # 16 modes: here the truncation of the modal model, not the integration, must not decide.
    got = simulate(rig, VOLTAGE, effects, dt_s=DT_S, n_modes=16, **inputs)
    measured = np.column_stack([got.hub_angle_rad, got.tip_true_m, got.tip_m])
    return np.max(np.abs(measured - expected) / np.sqrt(np.mean(expected**2, axis=0)))


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_effects_agree_with_an_independent_arm_to_a_millionth(name):
    options, effects = SMOOTH[name]
    assert _compare(options, parse_effects(effects)) < 1e-6


def test_a_drag_that_no_configuration_has_agrees_with_an_independent_arm():
    drag = LOOK_ALIKES["quadratic_drag"](coefficient_Nms2=0.2)
    assert _compare({"drag": 0.2}, (drag,)) < 1e-6


def test_effects_together_agree_with_an_independent_arm():
    options = {key: value for o, _ in SMOOTH.values() for key, value in o.items()}
    effects = [effect for _, e in SMOOTH.values() for effect in e] + [
        {"name": "input_delay", "delay_s": 0.0537}
    ]
    assert _compare(options, parse_effects(effects), delay=0.0537) < 1e-6


def test_outside_torque_and_tip_force_agree_with_an_independent_arm():
    rng = np.random.default_rng(3)
    inputs = {"hub_torque": rng.normal(size=VOLTAGE.size), "tip_force": 0.5 * rng.normal(size=VOLTAGE.size)}
    assert _compare({}, (), **inputs) < 1e-6


class ElasticSlider:
    """Dry friction as a spring whose stretch is clipped: the law as it is stated, in small steps."""

    def __init__(self, arm, static, coulomb, velocity):
        self.arm, self.static, self.excess, self.velocity = arm, static, static - coulomb, velocity
        self.stiffness, self.stretch, self.angle = static / 1e-5, 0.0, 0.0

    def __call__(self, coordinates, speeds):
        angle, speed = self.arm.shaft @ coordinates, self.arm.shaft @ speeds
        level = self.static - self.excess * -np.expm1(-abs(speed) / self.velocity)
        limit = level / self.stiffness
        self.stretch = np.clip(self.stretch + angle - self.angle, -limit, limit)
        self.angle = angle
        return -self.arm.shaft * self.stiffness * self.stretch


class Contact:
    """Backlash with a damped contact spring that only pushes."""

    def __init__(self, arm, gap, inertia):
        self.arm, self.gap = arm, gap
        self.stiffness = 0.21 * inertia * (2 * np.pi * 180) ** 2
        self.damping = 0.8 * np.sqrt(0.3 * inertia * self.stiffness)

    def __call__(self, coordinates, speeds):
        angle, speed = self.arm.backlash @ coordinates, self.arm.backlash @ speeds
        side = np.sign(angle)
        depth = abs(angle) - self.gap / 2
        push = max(self.stiffness * depth + self.damping * side * speed, 0.0) if depth > 0 else 0.0
        return -self.arm.backlash * side * push


REVERSALS = np.array([2, 2, -2, -2, -2, 0.5, 0.5, 3, -1, 0, 0, 0], dtype=float)


@pytest.mark.parametrize(
    "effect",
    [
        {"name": "coulomb_friction", "torque_Nm": 0.3},
        {
            "name": "stribeck_friction",
            "static_torque_Nm": 0.45,
            "coulomb_torque_Nm": 0.25,
            "stribeck_velocity_rad_s": 0.08,
        },
    ],
    ids=lambda e: e["name"],
)
def test_dry_friction_follows_the_stated_law(effect):
    rig = _rig()
    arm = RitzArm(rig, n=7)
    static = effect.get("static_torque_Nm", effect.get("torque_Nm"))
    slider = ElasticSlider(
        arm, static, effect.get("coulomb_torque_Nm", static), effect.get("stribeck_velocity_rad_s", 1)
    )
    expected = arm.fine_records(REVERSALS, DT_S, 1e-5, slider)
    got = simulate(rig, REVERSALS, [parse_effect(effect)], dt_s=DT_S, n_modes=8).output
    # The comparison is the coarse one: the held force lags by half of its 10 us step, which is worth
    # 1e-5 s * 3 rad/s = 3e-5 rad of path at the most.
    np.testing.assert_allclose(got, expected, atol=3e-5)
    without = simulate(rig, REVERSALS, dt_s=DT_S, n_modes=8).output
    assert np.max(np.abs(without - expected)) > 0.03


def test_backlash_follows_the_stated_law():
    rig = _rig()
    arm = RitzArm(rig, n=7, backlash=True)
    expected = arm.fine_records(REVERSALS, DT_S, 1e-5, Contact(arm, 0.05, rig.hub.inertia_kg_m2))
    got = simulate(
        rig, REVERSALS, [parse_effect({"name": "backlash", "gap_rad": 0.05})], dt_s=DT_S, n_modes=8
    ).output
    # Bounces amplify the half step by which the comparison's contact force lags (contact damping is 0.4 of
    # critical).
    np.testing.assert_allclose(got, expected, atol=2e-4)
    without = simulate(rig, REVERSALS, dt_s=DT_S, n_modes=8).output
    assert np.max(np.abs(without - expected)) > 0.01
