"""The simulation against an arm written down and integrated independently (see ritz.py)."""

import numpy as np
import pytest

from plant import Rig, paper_link, parse_effects, simulate
from plant.effects import LOOK_ALIKES
from tests.plant.ritz import RitzArm


def _rig() -> Rig:
    return paper_link().perturbed({"payload.mass_kg": 0.05, "hub.inertia_kg_m2": 0.02})


# Long held samples keep the number of solver restarts small; the stepper subdivides them all the same.
DT_S = 0.04
VOLTAGE = np.array([0, 3, 3, -4, 2, -1], dtype=float)
# Drag bends where the arm turns round: a motion several times as large leaves its error a smaller share.
LONGER = np.array([0, 3, 3, -4, 2, -1, 5, 5, -2, 0, 0, 1], dtype=float)

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


def _compare(options, effects, delay=0.0, voltage=VOLTAGE, **inputs):
    """Largest error over the outputs, relative to the RMS of each."""
    rig = _rig()
    expected = RitzArm(rig, **options).records(voltage, DT_S, delay, **inputs)
    if inputs:
        inputs = {"hub_torque_Nm": inputs["hub_torque"], "tip_force_N": inputs["tip_force"]}
    # 16 modes: here the truncation of the modal model, not the integration, must not decide.
    got = simulate(rig, voltage, effects, dt_s=DT_S, n_modes=16, **inputs)
    measured = np.column_stack([got.hub_angle_rad, got.tip_true_m, got.tip_m])
    return np.max(np.abs(measured - expected) / np.sqrt(np.mean(expected**2, axis=0)))


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_effects_agree_with_an_independent_arm_to_a_millionth(name):
    options, effects = SMOOTH[name]
    assert _compare(options, parse_effects(effects)) < 1e-6


@pytest.mark.slow
def test_a_drag_that_no_configuration_has_agrees_with_an_independent_arm():
    drag = LOOK_ALIKES["quadratic_drag"](coefficient_Nms2=0.2)
    assert _compare({"drag": 0.2}, (drag,), voltage=LONGER) < 1e-6


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
