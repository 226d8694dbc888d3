"""Friction of a shaft that no sensor sees, on a simulated arm of two inertias that this file makes."""

from __future__ import annotations

import numpy as np
import pytest

from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.record import Record
from ident.friction import (
    RemoteFriction,
    remote_friction,
    with_remote_friction,
)

DT_S = 2e-3
MOTOR, STIFFNESS, DAMPING = 1.0, 2000.0, 3.0


def logged(ratio, level, *, sensor, seed, duration_s=8.0):
    """A log of a PD loop that follows a random multisine with its sensor at "load" or "motor"."""
    rng = np.random.default_rng(seed)
    n_inner = 10
    n = round(duration_s / DT_S)
    t = DT_S * np.arange(n)
    reference = np.zeros(n)
    for f_Hz in np.arange(1, 120) / duration_s:
        reference += rng.uniform(0.5, 1) * np.sin(2 * np.pi * f_Hz * t + rng.uniform(0, 2 * np.pi))
    reference *= 0.2 / np.std(reference)
    reference -= reference[0]
    load = ratio * MOTOR
    natural = 4.0
    p = (MOTOR + load) * natural**2
    d = (MOTOR + load) * 1.4 * natural
    q_motor = v_motor = q_load = v_load = slope = before = 0.0
    command, output = np.zeros(n), np.zeros(n)
    h = DT_S / n_inner
    for k in range(n):
        output[k] = q_load if sensor == "load" else q_motor
        error = reference[k] - output[k]
        slope += 0.1 * ((error - before) / DT_S - slope)
        before = error
        command[k] = p * error + d * slope
        for _ in range(n_inner):
            twist = STIFFNESS * (q_motor - q_load) + DAMPING * (v_motor - v_load)
            # A stuck shaft does not turn round within a step.
            v_free = v_motor + h / MOTOR * (command[k] - twist)
            v_motor = np.sign(v_free) * max(abs(v_free) - h * level / MOTOR, 0.0) if level else v_free
            v_load += h / load * twist
            q_motor += h * v_motor
            q_load += h * v_load
    # An encoder of 20 bits.
    output = np.round(output / 6e-6) * 6e-6
    columns = command[:, None], output[:, None]
    return Record(*columns, DT_S, name="log", reference=reference[:, None])


def mode_of(ratio):
    """A model whose only use is its mode: that of the free arm."""
    rate = np.sqrt(STIFFNESS / MOTOR * (1 + 1 / ratio))
    zeta = DAMPING / STIFFNESS * rate / 2
    pole = np.exp(rate * DT_S * (-zeta + 1j * np.sqrt(1 - zeta**2)))
    return GobfModel(Poles(np.zeros(0), np.array([pole])), np.ones(2), DT_S, integrators=1)


@pytest.mark.parametrize("ratio", [0.4, 0.8])
def test_level_and_inertia_of_a_shaft_behind_a_spring_are_told(ratio):
    level = 0.15 * np.std(logged(ratio, 0.0, sensor="load", seed=1).input)
    records = [logged(ratio, level, sensor="load", seed=seed) for seed in (1, 2)]
    remote = remote_friction(records, mode_of(ratio))
    assert abs(remote.level - level) < 2.5 * remote.level_std
    assert remote.is_told
    assert remote.ratio == pytest.approx(ratio, rel=0.25)
    assert 0 < remote.level_std < 0.3 * level


def test_no_friction_is_found_ahead_of_a_sensor_at_the_shaft():
    level = 0.25 * np.std(logged(1.5, 0.0, sensor="motor", seed=1).input)
    records = [logged(1.5, level, sensor="motor", seed=seed) for seed in (1, 2)]
    with pytest.raises(ValueError, match="inverse dynamics find no friction at a shaft behind a spring"):
        remote_friction(records, mode_of(1.5))


def test_a_machine_without_a_mode_is_refused_in_one_line():
    stiff = GobfModel(Poles(np.array([0.9]), np.zeros(0)), np.ones(1), DT_S, integrators=1)
    with pytest.raises(ValueError, match="no light mode lies between"):
        remote_friction([logged(1.5, 0.0, sensor="load", seed=1, duration_s=2.0)], stiff)


def test_ellipses_hold_an_arm_whose_friction_was_mistaken_by_two_deviations_and_not_by_six():
    slow = np.exp(-0.5 * DT_S)
    arm = Poles(np.array([slow]), np.zeros(0))
    sharp = ResponsePosterior(arm.doubled(), np.array([1e-4, 0.0]), 3e-7 * np.eye(2), DT_S, integrators=1)
    omega = np.geomspace(0.5, 50.0, 80)
    gain = sharp.centre(omega)
    # Friction like a damping that takes at most a third of what it leaves of the command.
    like_damping = 1j * omega * gain
    like_damping = like_damping * 0.3 / np.max(np.abs(like_damping))
    remote = RemoteFriction(2.0, 0.2, 1.0, 10.0, 1e-6, omega, like_damping, (1e-9, 1e-9, 1e-9))
    wider, straight = with_remote_friction(sharp, remote, arm, 20.0)
    within = np.abs(like_damping) > 0.15

    def held(posterior, deviations):
        off = gain / (1 + deviations * 0.1 * like_damping)
        return np.mean(posterior.at(omega).contains(off)[within])

    for sign in (-1, 1):
        assert held(wider, 2 * sign) > 0.9
        assert held(straight, 2 * sign) > 0.9
        assert held(sharp, 2 * sign) < 0.1
        assert held(wider, 6 * sign) < 0.1
