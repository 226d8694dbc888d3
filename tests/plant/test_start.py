"""Records that do not start at rest at zero, the transport delay, and the accelerometer."""

import numpy as np
import pytest
from scipy.linalg import expm

from plant import paper_link, parse_effect, simulate
from plant.machine import Machine
from plant.modal import default_n_modes, equations_of_motion
from plant.simulation import Simulator, Start

N_MODES = 3


@pytest.fixture
def voltage_V() -> np.ndarray:
    return np.random.default_rng(3).choice([-1.0, 1.0], 30).repeat(10)


def test_a_swinging_start_follows_the_matrix_exponential() -> None:
    rig = paper_link()
    start = Start(0.7, -0.4, np.array([0.01, -0.002]), np.array([0.1, 0.05]))
    record = Simulator(rig, n_modes=N_MODES).run(np.zeros(50), start=start)
    equations = equations_of_motion(Machine(rig), N_MODES)
    x = np.array([0.7, 0.01, -0.002, 0.0, -0.4, 0.1, 0.05, 0.0])
    step = expm(equations.state_matrix() * rig.sampling.dt_s)
    tip = equations.position_row(equations.tip)
    for k in range(50):
        assert record.hub_angle_rad[k] == pytest.approx(x[0], abs=1e-12)
        assert record.tip_m[k] == pytest.approx(tip @ x, abs=1e-12)
        x = step @ x


@pytest.mark.parametrize("mode", [0, 1])
def test_behind_a_soft_joint_a_mode_is_one_that_link_and_root_swing_in_together(mode: int) -> None:
    """With the hub held by its inertia the tip swings at one frequency: y[k+1] + y[k-1] = 2 cos(w) y[k]."""
    held = {"hub.inertia_kg_m2": 1e9, "link.kelvin_voigt_s": 1e-12}
    joint = parse_effect({"name": "joint_compliance", "stiffness_Nm_rad": 30.0, "damping_Nms": 0.0})
    simulator = Simulator(paper_link().perturbed(held), [joint], n_modes=N_MODES, dt_s=2e-3)
    shape = np.eye(2)[mode]
    for start in (Start(deflections=0.01 * shape, rates=np.zeros(2)), Start(0, 0, np.zeros(2), shape)):
        y = simulator.run(np.zeros(400), start=start).tip_true_m
        both = y[2:] + y[:-2]
        cosine = (both @ y[1:-1]) / (y[1:-1] @ y[1:-1]) / 2
        assert np.max(np.abs(both - 2 * cosine * y[1:-1])) < 1e-6 * np.max(np.abs(y))
    rigid = Simulator(paper_link().perturbed(held), n_modes=N_MODES).run(np.zeros(2), start=start).tip_true_m
    assert np.sign(rigid[1] - rigid[0]) == np.sign(y[1] - y[0])


def test_dry_friction_holds_where_it_starts() -> None:
    friction = parse_effect({"name": "coulomb_friction", "torque_Nm": 0.1})
    record = Simulator(paper_link(), [friction]).run(np.zeros(100), start=Start(hub_angle_rad=1.3))
    assert np.allclose(record.hub_angle_rad, 1.3, atol=1e-9)


def test_a_later_start_finds_disturbances_and_drift_where_they_are() -> None:
    rig, first = paper_link(), 137
    begun_s = first * rig.sampling.dt_s
    at = {"name": "periodic_disturbance", "amplitude_Nm": 0.2, "frequency_Hz": 1.7}
    drift = parse_effect({"name": "sensor_drift", "rate_m_s": 0.03})
    still = np.zeros(80)
    phases = [0.4, 0.4 + 2 * np.pi * 1.7 * begun_s]
    started, later = (
        Simulator(rig, [parse_effect(at | {"phase_rad": phase % (2 * np.pi)}), drift]).run(still, start=start)
        for phase, start in zip(phases, (Start(time_s=begun_s), Start()), strict=True)
    )
    np.testing.assert_allclose(started.hub_angle_rad, later.hub_angle_rad, atol=1e-12)
    np.testing.assert_allclose(started.tip_m, later.tip_m + 0.03 * begun_s, atol=1e-12)
    assert np.ptp(started.hub_angle_rad) > 1e-3


def test_a_voltage_held_before_the_first_row_acts_through_delay_and_lag(voltage_V: np.ndarray) -> None:
    rig = paper_link().perturbed({"sampling.transport_delay_s": 0.013})
    effects = [parse_effect({"name": "actuator_lag", "time_constant_s": 0.05})]
    ahead = 2000
    whole = simulate(rig, np.concatenate([np.full(ahead, 2.0), voltage_V]), effects)
    at = whole.hub_angle_rad[ahead], (whole.hub_angle_rad[ahead] - whole.hub_angle_rad[ahead - 1])
    # At constant voltage the arm turns at constant speed with the link hardly bent.
    start = Start(at[0], at[1] / rig.sampling.dt_s, voltage_V=2.0)
    record = Simulator(rig, effects).run(voltage_V, start=start)
    assert np.allclose(record.hub_angle_rad, whole.hub_angle_rad[ahead:], atol=1e-6)


def test_the_transport_delay_is_an_input_delay(voltage_V: np.ndarray) -> None:
    late = simulate(paper_link().perturbed({"sampling.transport_delay_s": 0.007}), voltage_V)
    delayed = simulate(paper_link(), voltage_V, [parse_effect({"name": "input_delay", "delay_s": 0.007})])
    assert np.array_equal(late.output, delayed.output)


def test_the_accelerometer_reads_the_second_derivative_of_the_tip(voltage_V: np.ndarray) -> None:
    rig, fine = paper_link(), 50
    start = Start(0.2, 0.5, np.array([0.01]), np.array([0.2]))
    record = Simulator(rig, accelerometer=True).run(voltage_V, start=start)
    arguments = {"dt_s": rig.sampling.dt_s / fine, "n_modes": default_n_modes(rig)}
    tip_m = Simulator(rig, **arguments).run(voltage_V.repeat(fine), start=start).tip_m
    second = np.diff(tip_m, 2) / arguments["dt_s"] ** 2
    # Right before the voltage of a row: 1.5 fine steps, seen through the sensor's delay of 0.11 ms.
    at = np.arange(1, voltage_V.size) * fine - 2
    error = record.tip_acceleration_m_s2[1:] - second[at]
    assert np.sqrt(np.mean(error**2)) < 0.05 * np.std(second)
    still = Simulator(rig, accelerometer=True).run(voltage_V, start=start, rng=np.random.default_rng(1))
    assert np.array_equal(still.tip_acceleration_m_s2, record.tip_acceleration_m_s2)  # stated as noise-free


def test_deflections_and_rates_come_in_pairs() -> None:
    with pytest.raises(ValueError, match="2, 0"):
        Simulator(paper_link()).run(np.zeros(5), start=Start(deflections=np.zeros(2)))


def test_speed_and_deflection_are_what_angle_and_tip_say(voltage_V: np.ndarray) -> None:
    rig = paper_link()
    start = Start(0.3, 1.0, np.array([0.01, -0.002]), np.array([0.1, 0.4]))
    effects = [parse_effect({"name": "sensor_gain", "ratio": 1.3})]
    found = Simulator(rig, effects, dt_s=1e-4).run(voltage_V, start=start)
    middle = (found.hub_angle_rad[2:] - found.hub_angle_rad[:-2]) / 2e-4
    np.testing.assert_allclose(found.hub_speed_rad_s[1:-1], middle, atol=2e-3 * np.ptp(middle))
    lever = rig.hub.radius_m + rig.link.length_m
    bent = found.tip_true_m - lever * found.hub_angle_true_rad
    np.testing.assert_allclose(found.tip_deflection_m, 1.3 * bent, atol=1e-12)
    levels = {"sensors.hub_speed_noise_rad_s": 0.02, "sensors.tip_deflection_noise_m": 1e-3}
    voltage = np.tile(voltage_V, 20)
    noisy = Simulator(rig.perturbed(levels), effects).run(voltage, rng=np.random.default_rng(2))
    clean = Simulator(rig, effects).run(voltage)
    for name, level in zip(("hub_speed_rad_s", "tip_deflection_m"), levels.values(), strict=True):
        spread = np.std(getattr(noisy, name) - getattr(clean, name))
        assert spread == pytest.approx(level, rel=4 / np.sqrt(2 * len(noisy.time_s)))
