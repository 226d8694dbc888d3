from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from plant import EFFECTS, SampledArm, linear_arm, paper_link, parse_effect, parse_effects, prbs, simulate
from tests.plant.test_effects import EXAMPLES

RIG = paper_link()
DT = RIG.sampling.dt_s
RNG = np.random.default_rng(11)
VOLTAGE = prbs(8, 3, 2.0, 400, np.random.default_rng(11))
TORQUE, FORCE = 0.1 * RNG.normal(size=400), 0.2 * RNG.normal(size=400)


def _linear(inputs, dt=DT):
    arm = linear_arm(RIG)
    system = cont2discrete((arm.A, arm.B, arm.C, np.zeros((2, 3))), dt)
    return dlsim(system, inputs)[1]


def test_without_effects_it_is_the_sampled_linear_arm():
    got = simulate(RIG, VOLTAGE, hub_torque_Nm=TORQUE, tip_force_N=FORCE)
    expected = _linear(np.column_stack([VOLTAGE, TORQUE, FORCE]))
    np.testing.assert_allclose(got.output, expected, atol=1e-11)
    np.testing.assert_array_equal(got.hub_angle_rad, got.hub_angle_true_rad)
    np.testing.assert_array_equal(got.time_s, np.arange(400) * DT)
    np.testing.assert_array_equal(got.voltage_V, VOLTAGE)


@pytest.mark.parametrize("twentieths", [3, 20, 27, 40, 59])
def test_a_delay_of_any_fraction_shifts_the_held_voltage(twentieths):
    # The same at twenty times the rate, where this delay is a whole number of samples.
    fine = np.repeat(VOLTAGE, 20)
    late = np.concatenate([np.zeros(twentieths), fine])[: fine.size]
    expected = _linear(np.column_stack([late, 0 * late, 0 * late]), DT / 20)[::20]
    delay = parse_effect({"name": "input_delay", "delay_s": twentieths * DT / 20})
    np.testing.assert_allclose(simulate(RIG, VOLTAGE, [delay]).output, expected, atol=1e-11)


@pytest.mark.parametrize("name", [None, *EFFECTS])
def test_stepping_gives_the_record(name):
    effects = [] if name is None else [parse_effect({"name": name, **EXAMPLES[name]})]
    record = simulate(
        RIG, VOLTAGE, effects, rng=np.random.default_rng(5), hub_torque_Nm=TORQUE, tip_force_N=FORCE
    )
    arm = SampledArm(RIG, effects, np.random.default_rng(5))
    measured, true = [], []
    for voltage, torque, force in zip(VOLTAGE, TORQUE, FORCE, strict=True):
        measured.append(arm.measure())
        true.append(arm.true_output)
        arm.advance(voltage, torque, force)
    # The same stepper; only the sums of the output rows are taken in another order.
    np.testing.assert_allclose(np.array(measured), record.output, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        np.array(true), np.column_stack([record.hub_angle_true_rad, record.tip_true_m]), rtol=0, atol=1e-12
    )


def test_everything_at_once_steps_like_the_record_and_resets():
    effects = parse_effects([{"name": name, **EXAMPLES[name]} for name in EFFECTS])
    record = simulate(RIG, VOLTAGE, effects).output
    arm = SampledArm(RIG, effects)
    for _ in range(2):
        measured = []
        for voltage in VOLTAGE:
            measured.append(arm.measure())
            arm.advance(voltage)
        # Rounding at a tie of the quantiser would show as one step of 5 mm.
        np.testing.assert_allclose(np.array(measured), record, rtol=0, atol=1e-9)
        arm.reset()


def test_noise_is_the_rigs_and_asking_twice_gives_the_same_sample():
    rng = np.random.default_rng(2)
    record = simulate(RIG, np.zeros(20000), rng=rng)
    # Standard error of a standard deviation from N samples: 1 / sqrt(2 N) = 0.5 %; four of them.
    assert np.std(record.hub_angle_rad) == pytest.approx(RIG.sensors.hub_angle_noise_rad, rel=0.02)
    assert np.std(record.tip_m) == pytest.approx(RIG.sensors.tip_noise_m, rel=0.02)
    assert np.all(record.hub_angle_true_rad == 0)
    arm = SampledArm(RIG, rng=np.random.default_rng(2))
    first = arm.measure()
    first[:] = 7.0  # a copy: it cannot reach into the arm
    np.testing.assert_array_equal(arm.measure(), [record.hub_angle_rad[0], record.tip_m[0]])
    arm.advance(0.0)
    arm.advance(0.0)  # nobody looked at sample 1; sample 2 is the record's all the same
    np.testing.assert_allclose(arm.measure(), record.output[2], rtol=0, atol=1e-15)


def test_another_sampling_period_is_taken():
    slow = simulate(RIG, [1.0, -1.0, 0.5, 0.0], dt_s=0.02)
    fast = simulate(RIG, np.repeat([1.0, -1.0, 0.5, 0.0], 4))
    np.testing.assert_allclose(slow.output, fast.output[::4], atol=1e-12)
    np.testing.assert_allclose(slow.time_s, [0, 0.02, 0.04, 0.06])
    assert SampledArm(RIG, dt_s=0.02).dt_s == 0.02


def test_a_trajectory_is_checked_and_read_only():
    record = simulate(RIG, VOLTAGE)
    with pytest.raises(ValueError, match="read-only"):
        record.tip_m[0] = 1.0
    with pytest.raises(ValueError, match="tip_m"):
        replace(record, tip_m=record.tip_m[:-1])


@pytest.mark.parametrize("name", [n for n in EFFECTS if EFFECTS[n].dependence != "non-smooth"])
def test_a_ten_times_finer_step_gives_the_same_record(name):
    voltage = prbs(8, 4, 2.0, 1200, np.random.default_rng(0))
    effect = parse_effect({"name": name, **EXAMPLES[name]})
    coarse, fine = (simulate(RIG, voltage, [effect], substep_s=h).output for h in (6.25e-4, 6.25e-5))
    error = np.sqrt(np.mean((coarse - fine) ** 2, axis=0) / np.mean(fine**2, axis=0))
    # Measured 6e-8 for dry friction, 1e-10 for smooth forces, nothing where the steps are exact.
    assert np.all(error < (1e-6 if EFFECTS[name].dependence == "continuous" else 1e-9))


@pytest.mark.parametrize("twentieths", [7, 13])
@pytest.mark.parametrize(
    "name",
    ["coulomb_friction", "stribeck_friction", "torque_ripple", "hardening_spring", "gravity", "backlash"],
)
def test_a_late_sample_as_one_step_gives_the_same_record(name, twentieths):
    # The voltage changes inside that step; with the fine steps, at the end of one.
    delay = {"name": "input_delay", "delay_s": twentieths * DT / 20}
    effects = parse_effects([delay, {"name": name, **EXAMPLES[name]}])
    voltage = prbs(8, 4, 2.0, 1200, np.random.default_rng(0))
    whole, fine = (simulate(RIG, voltage, effects, substep_s=h).output for h in (DT, DT / 80))
    error = np.sqrt(np.mean((whole - fine) ** 2, axis=0) / np.mean(fine**2, axis=0))
    # Measured 2e-4 for Stribeck friction, whose fall a step this long hardly follows, 7e-6 for contacts in a
    # gap, 1e-7 for the others.
    assert np.all(error < {"stribeck_friction": 1e-3, "backlash": 2e-5}.get(name, 1e-6))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"voltage_V": [0.0, np.nan]}, r"voltage_V.*\bnan\b.*\b1\b"),
        ({"voltage_V": [0.0, np.inf]}, r"voltage_V.*\binf\b.*\b1\b"),
        ({"voltage_V": []}, r"voltage_V.*\(0,\)"),
        ({"voltage_V": [[0.0, 1.0]]}, r"voltage_V.*\(1, 2\)"),
        ({"voltage_V": ["a"]}, "voltage_V"),
        ({"dt_s": 0.0}, r"dt_s.*0\.0"),
        ({"dt_s": -0.005}, r"dt_s.*-0\.005"),
        ({"dt_s": np.nan}, "dt_s.*nan"),
        ({"hub_torque_Nm": [1.0]}, r"hub_torque_Nm.*\(2,\).*\(1,\)"),
        ({"tip_force_N": [1.0, np.nan]}, r"tip_force_N.*\bnan\b.*\b1\b"),
        ({"n_modes": 0}, r"n_modes.*\b1\b.*\b0\b"),
        ({"substep_s": 0.0}, r"substep_s.*0\.0"),
    ],
)
def test_bad_input_is_refused_in_one_line_with_its_name_and_value(arguments, complaint):
    with pytest.raises(ValueError, match=complaint) as caught:
        simulate(RIG, **{"voltage_V": [0.0, 1.0], **arguments})
    assert "\n" not in str(caught.value)


def test_a_sampled_arm_refuses_bad_input():
    with pytest.raises(ValueError, match="dt_s"):
        SampledArm(RIG, dt_s=0.0)
    with pytest.raises(ValueError, match="nan V"):
        SampledArm(RIG).advance(np.nan)
    with pytest.raises(ValueError, match="inf N m"):
        SampledArm(RIG).advance(0.0, np.inf)


def test_a_sensor_that_there_is_not_is_named():
    with pytest.raises(ValueError, match=r"no sensor is called 'elbow'.*hub_angle_rad"):
        SampledArm(RIG).measured(["hub_angle_rad", "elbow"], VOLTAGE)
