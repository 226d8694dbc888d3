"""Which signal is a set point and which was measured, by the numbers of simulated loops alone."""

import numpy as np
import pytest

from ident.data.causality import is_loop, is_moved_by, leads

N, DT_S = 1200, 0.005
RNG = np.random.default_rng(11)
REFERENCES = {
    "steps": RNG.uniform(-10, 10, N // 100).repeat(100),
    "a square wave": 10 * np.sign(np.sin(2 * np.pi * 0.5 * DT_S * np.arange(N))),
    "ramps": np.interp(np.arange(N), np.arange(0, N + 1, 100), RNG.uniform(-5, 5, 13)),
    "a binary sequence": 5 * RNG.choice([-1.0, 1.0], N // 10).repeat(10),
}


def closed_loop(reference, noise):
    """A motor with viscous friction under proportional control: command and measured position."""
    position = speed = 0.0
    commands, readings = [], []
    for wished in reference:
        readings.append(position + noise * RNG.standard_normal())
        commands.append(float(np.clip(2 * (wished - readings[-1]) - 0.1 * speed, -24, 24)))
        speed += DT_S * (30 * commands[-1] - 5 * speed)
        position += DT_S * speed
    return np.array(commands), np.array(readings)


def two_masses(command, noise):
    """Motor and load with a spring between them, in open loop."""
    motor = motor_speed = load = load_speed = 0.0
    motors, loads = [], []
    for volts in command:
        motors.append(motor + 1e-3 * RNG.standard_normal())
        loads.append(load + noise * RNG.standard_normal())
        spring = 400 * (motor - load) + 2 * (motor_speed - load_speed)
        motor_speed += DT_S * (30 * volts - 5 * motor_speed - 0.2 * spring)
        load_speed += DT_S * (spring - load_speed)
        motor += DT_S * motor_speed
        load += DT_S * load_speed
    return np.array(motors), np.array(loads)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("kind", REFERENCES)
def test_a_set_point_is_told_from_the_output_that_follows_it(kind, noise):
    reference = REFERENCES[kind]
    command, output = closed_loop(reference, noise)
    assert is_loop(reference, output, command)
    assert not is_loop(output, reference, command)
    assert is_moved_by(output, command)
    assert not is_moved_by(reference, command)


@pytest.mark.parametrize("noise", [1e-3, 0.05, 0.5])
@pytest.mark.parametrize("kind", REFERENCES)
def test_two_measured_positions_in_open_loop_are_no_loop(kind, noise):
    command = REFERENCES[kind]
    motor, load = two_masses(command, noise)
    assert not is_loop(motor, load, command)
    assert not is_loop(load, motor, command)
    assert is_moved_by(motor, command)


def test_a_few_samples_tell_nothing():
    command, output = closed_loop(REFERENCES["steps"][90:120], 0.0)
    assert not is_moved_by(output, command)
    assert not is_loop(REFERENCES["steps"][90:120], output, command)


def test_the_leader_of_two_is_the_one_that_changes_first():
    wave = np.cumsum(RNG.standard_normal(500))
    assert leads(wave[5:], wave[:-5]) is True
    assert leads(wave[:-5], wave[5:]) is False
    assert leads(wave, wave) is None
