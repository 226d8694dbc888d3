"""A plant of one's own whose records start anywhere: truth by scipy's integrator."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.integrate import solve_ivp

from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment, diagnose

DT_S, SAMPLES, NOISE_RAD = 0.02, 500, 1e-3


@njit
def _leapfrog(torque, inertia, damping, weight, cubic, angle, speed):
    found, h = np.zeros((torque.size, 1)), DT_S / 8
    slow = h / 2 * damping / inertia
    for k in range(torque.size):
        found[k] = angle
        for _ in range(8):
            angle += h / 2 * speed
            pull = torque[k] - weight * np.sin(angle) - cubic * angle**3
            speed = (speed * (1 - slow) + h * pull / inertia) / (1 + slow)
            angle += h / 2 * speed
    return found


def _pendulum(parameters, effects, inputs, start):
    cubic = effects.get("hardening_spring", {}).get("cubic_Nm_rad3", 0.0)
    return _leapfrog(inputs[:, 0].copy(), *parameters.values(), cubic, *start.values())


def _record(name, role, angle_rad, speed_rad_s, seed):
    rng = np.random.default_rng(seed)
    torque = rng.choice([-0.6, 0.6], SAMPLES // 25).repeat(25)

    def rate(t, x):
        held = torque[min(int(t / DT_S), SAMPLES - 1)]
        # A second harmonic of the weight is what nobody documented: 2 % of it.
        weight = 1.0 * np.sin(x[0]) + 0.02 * np.sin(2 * x[0])
        return [x[1], (held - 0.05 * x[1] - weight - 0.4 * x[0] ** 3) / 0.1]

    times = np.arange(SAMPLES) * DT_S
    span = (0.0, times[-1])
    found = solve_ivp(rate, span, [angle_rad, speed_rad_s], t_eval=times, max_step=DT_S / 4, rtol=1e-8)
    output = found.y[:1].T + NOISE_RAD * rng.standard_normal((SAMPLES, 1))
    return PlantExperiment(name, role, torque[:, None], output)


def test_starts_of_records_are_fitted_and_the_spring_is_found():
    started = ((0.5, 2.0), (-0.4, 0.0), (0.3, -3.0))
    roles = ("estimation", "estimation", "held_out")
    records = tuple(
        _record(f"r{k}", role, *start, k) for k, (role, start) in enumerate(zip(roles, started, strict=True))
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
    found = diagnose(PlantCase("pendulum", plant, records))
    assert found.combination == ("hardening_spring",)
    (spring,) = [e for e in found.effects if e.name == "hardening_spring"]
    low, high = spring.intervals["cubic_Nm_rad3"]
    assert low < 0.4 < high
    assert abs(spring.parameters["cubic_Nm_rad3"] / 0.4 - 1) < 0.15
    assert found.gap_closed > 0.95
