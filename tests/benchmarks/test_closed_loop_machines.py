"""The independent machines and their judge: response, energy, sticking, violations, settling."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.closed_loop_machines import logs, machines, simulator
from benchmarks.closed_loop_machines.judge import read_law, settles, violations
from benchmarks.closed_loop_machines.logs import machine
from benchmarks.closed_loop_machines.simulator import Law, Plant, response

NO_FRICTION = np.array([0, 0, 1.0, 0, 0])
OPEN = Law(np.zeros((1, 1)), np.zeros((1, 2)), np.zeros(1), np.array([1.0, 0.0]), np.zeros(1))


def bare(plant: Plant) -> Plant:
    """Without friction, ripple, play, encoder and limit."""
    without = {"ripple": plant.ripple * [0, 1, 1], "springs": plant.springs * [1, 1, 1, 1, 0]}
    return replace(plant, friction=plant.friction * 0 + NO_FRICTION, **without, count=0.0, limit=np.inf)


@pytest.mark.parametrize("kind", ["belt", "link", "screw"])
def test_friction_free_output_is_that_of_the_sampled_response(kind):
    plant = bare(machines.draft(kind, 1, np.random.default_rng([9, 1])).plant)
    u = np.random.default_rng(1).standard_normal(2000)
    a, b, c = plant.sampled()
    x, expected = np.zeros(a.shape[0]), np.zeros(u.size)
    for k in range(u.size):
        expected[k] = (c @ x)[0]
        x = a @ x + b[:, 0] * u[k]
    got = plant.run(OPEN, u, 0.0, np.zeros(u.size))["true"]
    # (omega h)^2 / 24 a step of the fastest mode, omega h < .01: 4e-6 of the phase, and less of the output.
    assert np.std(got - expected) < 4e-6 * np.std(expected)


def test_ratio_in_the_loop_of_an_unstable_arm_is_its_sampled_response():
    """Periodic reference, last period: U and Y of the loop have the ratio G at every line, exactly."""
    one = machines.draft("pendulum", 1, np.random.default_rng([9, 2]))
    plant = bare(one.plant)
    period, lines = 4000, np.arange(1, 300)
    spectrum = np.zeros(period // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * np.random.default_rng(3).random(lines.size)) / lines
    # Small, since sin(q) is not linear: 1e-3 rad leaves 1e-6 / 6 of the torque.
    r = one.q_operating * plant.scale + 1e-3 * plant.scale * np.fft.irfft(spectrum, period) * period / 2
    got = plant.run(one.law, np.tile(r, 12), one.q_operating, np.zeros(12 * period))
    y, u = (np.fft.rfft(got[name][-period:])[lines] for name in ("true", "u"))
    omega = 2 * np.pi * lines / (period * plant.dt_s)
    g = response(*plant.sampled(one.q_operating), omega, plant.dt_s)
    assert max(np.linalg.eigvals(plant.sampled(one.q_operating)[0]).real) > 1
    assert np.max(np.abs(y / u / g - 1)) < 5e-3


def test_sticks_and_slides_as_solved_from_event_to_event():
    """One inertia under a sine of torque just above its friction: it sticks twice a period."""
    level, inertia, dt = 0.03, 2e-3, 1e-3
    friction, rest = np.array([[level, level, 1, 0, 0], NO_FRICTION]), (np.zeros(3), 1.0, 0, 1.0, dt, 0, 0.0)
    plant = Plant(
        np.array([inertia, 1.0]), np.zeros(2), np.zeros(2), np.zeros((0, 5)), friction, *rest, np.inf
    )
    n = 1500
    torque = 0.045 * np.sin(2 * np.pi * 2 * np.arange(n) * dt)
    got = plant.run(OPEN, torque, 0.0, np.zeros(n))
    q, v, expected = 0.0, 0.0, np.zeros(n)
    for k in range(n - 1):  # the torque is constant in a sample: slide to the stop at most once, then stick
        expected[k], left = q, dt
        for _ in range(3):
            if v == 0 and abs(torque[k]) <= level:
                break
            side = np.sign(v) if v else np.sign(torque[k])

            def stop(_t, s, side=side):
                return s[1] * side + (1e-12 if s[1] == 0 else 0)

            stop.terminal, stop.direction = True, -1
            force = (torque[k] - side * level) / inertia
            part = solve_ivp(
                lambda _t, s, a=force: [s[1], a], (0, left), [q, v], events=stop, rtol=1e-10, atol=1e-14
            )
            q, v = part.y[0, -1], 0.0 if part.status == 1 else part.y[1, -1]
            left -= part.t[-1]
            if left <= 0:
                break
    still = np.diff(expected[:-1]) == 0
    assert 0.1 < np.mean(still) < 0.9
    assert np.mean((np.diff(got["true"][:-1]) == 0) == still) > 0.99
    assert np.max(np.abs(got["true"][:-1] - expected[:-1])) < 1e-3 * np.ptp(expected)
    assert got["friction_Nm"] == pytest.approx(level, rel=1e-9)


def test_the_reported_belt_is_seed_0_of_series_1():
    one = machine("belt", 0)
    poles = one.plant.linear()[3]
    mode = poles[np.argmax(poles.imag)]
    assert abs(mode) / 2 / np.pi == pytest.approx(9.353, rel=2e-3)
    assert -mode.real / abs(mode) == pytest.approx(0.0496, abs=2e-3)  # and what the viscous friction adds
    assert one.plant.friction[:, 0].sum() / one.plant.torque_per_u == pytest.approx(0.05)
    run, begin = one.record(0, one.rng(0))
    assert 0.4 < np.std(run["u"][begin:]) < 0.6


def controller_file(folder, gain=1.0):
    """A lead of the reported loop's stiffness as a run stores it."""
    law = machines._pid((1.5 * gain, 0.06 * gain, 0.0), 0.003, 0.0, 1e-3, False, 0.0)
    file = {"A": law.A.tolist(), "B": law.B[:, :1].tolist(), "C": [law.C.tolist()], "D": [[law.D[0]]]}
    file |= {"anti_windup_gain": [[0.0]] * 3, "computational_delay_samples": 0, "input_limit": None}
    (folder / "controller.json").write_text(json.dumps(file))
    return read_law(folder / "controller.json")[0]


def stated(plant, law):
    """The margins that the true loop has, as a certificate would state them."""
    theta = np.geomspace(1e-4, np.pi, 100_000)
    loop = machines.loop_gain(plant, 0.0, law, theta / plant.dt_s)
    one = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1)))
    phase = np.angle(-loop[one])
    low = np.flatnonzero(np.abs(1 + loop) >= np.sqrt(0.5))
    margins = {"modulus": np.min(np.abs(1 + loop)), "phase_rad": np.min(np.abs(phase)), "gain_down": 0.0}
    margins |= {"gain_up": 1.05, "delay_s": np.min(np.mod(phase, 2 * np.pi) / theta[one]) * plant.dt_s}
    bandwidth = theta[np.flatnonzero(np.abs(1 + loop[low]) < np.sqrt(2))[0]] / plant.dt_s
    return {"worst_margins": margins, "bandwidth_rad_s": bandwidth}


@pytest.mark.slow
def test_what_the_true_loop_keeps_is_no_violation_and_what_it_does_not_keep_is(tmp_path):
    one = machine("belt", 0)
    law = controller_file(tmp_path)
    verdict = stated(one.plant, law)
    assert violations(one.plant, 0.0, law, verdict) == []
    for name in ("modulus", "phase_rad", "delay_s"):
        better = verdict["worst_margins"] | {name: 1.05 * verdict["worst_margins"][name]}
        (found,) = violations(one.plant, 0.0, law, verdict | {"worst_margins": better})
        assert found.startswith(name.split("_")[0])
    (found,) = violations(one.plant, 0.0, law, verdict | {"bandwidth_rad_s": 2 * verdict["bandwidth_rad_s"]})
    assert found.startswith("bandwidth")
    far = verdict["worst_margins"] | {"gain_up": 1e3}
    assert violations(one.plant, 0.0, law, verdict | {"worst_margins": far})[0].startswith("gain")
    assert violations(one.plant, 0.0, controller_file(tmp_path, -1.0), verdict)[0].startswith("unstable")


def test_a_loop_that_stands_settles_and_one_that_swings_does_not(tmp_path):
    one = machine("belt", 0)
    truth = {"output_range": [-0.5, 0.5]}
    for gain, settled in ((1.0, True), (40.0, False)):
        law = controller_file(tmp_path, gain)
        runs = [settles(one, truth, one.plant, law, tmp_path, 5.0, k) for k in range(3)]
        assert runs == [settled] * 3


def test_the_truth_shares_no_code_with_what_it_judges():
    for module in (simulator, machines, logs):
        found = re.findall(r"^\s*(?:from|import) (\w+)", Path(module.__file__).read_text(), re.M)
        plain = "__future__ dataclasses gzip json pathlib typing numba numpy scipy benchmarks"
        assert set(found) <= set(plain.split())
