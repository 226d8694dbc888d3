"""A plant of one's own whose records start anywhere: truth by scipy's integrator."""

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose
from diagnosis.fit.descent import descend
from diagnosis.fit.records import FittedStart, Records
from diagnosis.search.search import Search
from diagnosis.search.settled import fit_record_starts

DT_S = 0.02
SAMPLES = 500
NOISE_RAD = 1e-3


@njit
def _leapfrog(torque, inertia, damping, weight, cubic, angle, speed):
    """Angle (T, 1) of a pendulum with a hardening spring, from an angle and a speed."""
    angles = np.zeros((torque.size, 1))
    h = DT_S / 8
    slow = h / 2 * damping / inertia
    for k in range(torque.size):
        angles[k] = angle
        for _ in range(8):
            angle += h / 2 * speed
            pull = torque[k] - weight * np.sin(angle) - cubic * angle**3
            speed = (speed * (1 - slow) + h * pull / inertia) / (1 + slow)
            angle += h / 2 * speed
    return angles


def _pendulum(parameters, effects, inputs, start):
    """The simulation that the user brings."""
    cubic = effects.get("hardening_spring", {}).get("cubic_Nm_rad3", 0.0)
    return _leapfrog(inputs[:, 0].copy(), *parameters.values(), cubic, *start.values())


def _record(name, role, angle_rad, speed_rad_s, seed):
    """A record of the truth from a start, with a spring of 0.4 N m/rad^3 and noise."""
    rng = np.random.default_rng(seed)
    torque = rng.choice([-0.6, 0.6], SAMPLES // 25).repeat(25)

    def rate(t, x):
        held = torque[min(int(t / DT_S), SAMPLES - 1)]
        # A second harmonic of the weight is what nobody documented: 2 % of it.
        weight = 1.0 * np.sin(x[0]) + 0.02 * np.sin(2 * x[0])
        return [x[1], (held - 0.05 * x[1] - weight - 0.4 * x[0] ** 3) / 0.1]

    times = np.arange(SAMPLES) * DT_S
    span = (0.0, times[-1])
    solution = solve_ivp(rate, span, [angle_rad, speed_rad_s], t_eval=times, max_step=DT_S / 4, rtol=1e-8)
    output = solution.y[:1].T + NOISE_RAD * rng.standard_normal((SAMPLES, 1))
    return PlantExperiment(name, role, torque[:, None], output)


@pytest.mark.slow
def test_starts_of_records_are_fitted_and_the_spring_is_found():
    starts = ((0.5, 2.0), (-0.4, 0.0), (0.3, -3.0))
    roles = ("estimation", "estimation", "held_out")
    records = tuple(
        _record(f"r{k}", role, *start, k) for k, (role, start) in enumerate(zip(roles, starts, strict=True))
    )
    plant = Plant(
        _pendulum,
        {"inertia_kg_m2": 0.104, "damping_Nms": 0.045, "weight_Nm": 0.98},
        {"inertia_kg_m2": 0.05, "damping_Nms": 0.2, "weight_Nm": 0.03},
        ("angle_rad",),
        np.array([NOISE_RAD]),
        (PlantEffect("hardening_spring", (EffectParameter("cubic_Nm_rad3", 1e-3, 100.0),), signed=True),),
        model_error=0.05,
        start={"angle_rad": 1.0, "speed_rad_s": 5.0},
    )
    answer = diagnose(PlantCase("pendulum", plant, records))
    assert answer.combination == ("hardening_spring",)
    (spring,) = [e for e in answer.effects if e.name == "hardening_spring"]
    low, high = spring.intervals["cubic_Nm_rad3"]
    assert low < 0.4 < high
    assert abs(spring.parameters["cubic_Nm_rad3"] / 0.4 - 1) < 0.15
    assert answer.gap_closed > 0.95


@njit
def _rubbing(dry, angle, speed):
    """The pendulum without a motor; dry friction takes off what it can, so that it truly sticks."""
    angles = np.zeros((SAMPLES, 1))
    h = DT_S / 20
    for k in range(SAMPLES):
        angles[k] = angle
        for _ in range(20):
            free = speed - h * (np.sin(angle) + 0.05 * speed) / 0.1
            speed = np.sign(free) * max(abs(free) - h * dry / 0.1, 0.0)
            angle += h * speed
    return angles


def _held_plant(simulation, effect):
    """A pendulum that starts anywhere, with one listed effect of a size between 1e-3 and 1."""
    return Plant(
        simulation, {"weight_Nm": 1.0}, {}, ("angle_rad",), np.array([NOISE_RAD]),
        (PlantEffect(effect, (EffectParameter("size", 1e-3, 1.0),)),), model_error=0.05,
        start={"angle_rad": 1.0, "speed_rad_s": 5.0},
    )  # fmt: skip


def test_a_start_is_found_where_friction_holds_the_first_guess():
    """At rest the pendulum sticks: no difference quotient there says how it began."""
    plant = _held_plant(
        lambda p, effects, inputs, start: _rubbing(0.03, *start.values())[: len(inputs)], "drag"
    )
    true_starts = np.array([[1.1, 0.3], [-0.6, -4.0]])
    still = np.zeros((SAMPLES, 1))
    records = tuple(
        PlantExperiment(role, role, still, _rubbing(0.03, *state))
        for role, state in zip(("estimation", "held_out"), true_starts, strict=True)
    )
    case = PlantCase("rubs", plant, records)
    fitted = Records(case, case.experiments)
    start, left = fit_record_starts(fitted, np.zeros(0), (), fitted.guessed_start())
    np.testing.assert_allclose(start.states, true_starts, atol=0.01)
    assert np.all(fitted.rms_shares(fitted.residuals_from(left)) < 0.01)


def test_a_set_is_descended_on_from_starts_sought_with_its_effects():
    """Without friction the nominal's starts are far off; with it, no step leads from there."""

    def simulate(parameters, effects, inputs, start):
        return _rubbing(effects.get("dry", {}).get("size", 0.0), *start.values())[: len(inputs)]

    plant = _held_plant(simulate, "dry")
    true_starts = np.array([[1.1, 0.3], [-0.6, -4.0]])
    still = np.zeros((SAMPLES, 1))
    records = tuple(
        PlantExperiment(f"r{k}", role, still, _rubbing(0.1, *true_starts[k % 2]))
        for k, role in enumerate(("estimation", "estimation", "held_out"))
    )
    search = Search(PlantCase("rubs", plant, records), lambda share, words: None)
    dry = search.case.machine.candidates(records)[0]
    held = FittedStart(np.array([[0.05, 0.0], [-0.6, -4.0]]), np.zeros(0))
    stuck = descend(search.records, (dry,), np.zeros(0), np.log([0.1]), held, iterations=3)
    assert abs(stuck.start.states[0, 0] - 1.1) > 0.5
    again = search.restarted(stuck)
    np.testing.assert_allclose(again.start.states, true_starts, atol=0.01)
    assert again.loss < 0.1 * stuck.loss
    # Nothing to gain: the same.
    assert search.restarted(again) is again
