"""One stage of the Quanser 2-DOF serial flexible link as a plant of one's own: its manufacturer's model.

State [theta, alpha, d theta/dt, d alpha/dt], tip angle theta + alpha, input current; stages are uncoupled.
The loop is closed as in the record: i = K (x_ref - x), speeds from a first-order filter of 150 rad/s (see
`law_error`), current limited to 0.94 A. The reference repeats after 10 s: one pass to fit, one to judge; the
scatter between them is the noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numba import njit
from scipy.signal import lfilter

from benchmarks.own_plant import SHARE, Real, constants, held_input, lagged, late_value
from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment

# Sampling period of the records.
DT_S = 0.002
# Samples after which the reference repeats.
PERIOD = 5000
# Steps of the simulation a sample.
SUBSTEPS = 2
# Largest current of the drive.
LIMIT_A = 0.94
# Corner of the controller's filter.
FILTER_RAD_S = 150.0
# First stage, second stage, and relative tolerance: the manufacturer states none, so what a data sheet is
# usually good for.
_STATED = {
    "hub_inertia_kg_m2": (0.0635, 0.00302, 0.1),
    "load_inertia_kg_m2": (0.1704, 0.00644, 0.1),
    "spring_Nm_rad": (39.96, 6.858, 0.1),
    "hub_damping_Nms": (4.0, 1.5, 0.3),
    "link_damping_Nms": (1e-3, 0.0856, 0.3),
    "torque_constant_Nm_A": (8.925, 0.8701, 0.05),
}
MANUFACTURER = {stage: {name: row[stage - 1] for name, row in _STATED.items()} for stage in (1, 2)}
TOLERANCES = {name: tolerance for name, (_, _, tolerance) in _STATED.items()}

_P = EffectParameter
EFFECTS = (
    PlantEffect("coulomb_friction", (_P("current_A", 1e-4, 0.5),), dependence="continuous"),
    PlantEffect(
        "stribeck_friction",
        (_P("static_A", 1e-4, 0.8), SHARE, _P("velocity_rad_s", 1e-3, 1.0)),
        dependence="continuous",
    ),
    PlantEffect("current_offset", (_P("current_A", 1e-4, 0.5),), signed=True, dependence="continuous"),
    PlantEffect("strain_offset", (_P("angle_rad", 1e-6, 0.02),), signed=True),
    PlantEffect("strain_gain", (_P("relative_error", 1e-3, 0.8),), signed=True),
    PlantEffect("input_delay", (_P("delay_s", 1e-4, 0.03),)),
    PlantEffect("actuator_lag", (_P("time_constant_s", 1e-4, 0.1),)),
    PlantEffect("actuator_dead_zone", (_P("width_A", 1e-4, 0.5),), dependence="continuous"),
    # Beyond what the tolerances of the stated values explain.
    PlantEffect("load_inertia", (_P("relative_increase", 0.3, 9.0),)),
    PlantEffect("link_softness", (_P("relative_increase", 0.3, 9.0),)),
    PlantEffect("other_stage", (_P("share", 1e-3, 10.0),), signed=True),
    PlantEffect("hardening_spring", (_P("cubic_A_rad3", 1e-3, 100.0),), signed=True),
)


def simulation(gains: Real):
    """The stage under feedback gains (4,): reference, other stage, start (T, 3) -> theta, alpha (T, 2)."""

    def simulate(
        parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
    ) -> Real:
        p = constants(EFFECTS, effects, stribeck_friction_velocity_rad_s=1.0)
        moved = dict(parameters)
        moved["load_inertia_kg_m2"] *= 1 + p.load_inertia_relative_increase
        moved["spring_Nm_rad"] /= 1 + p.link_softness_relative_increase
        A, B = held_input(*state_space(moved), DT_S / SUBSTEPS)
        return np.asarray(_run(np.ascontiguousarray(inputs), A, B, gains, p))

    return simulate


def state_space(p: Mapping[str, float]) -> tuple[Real, Real]:
    """A (4, 4), B (4, 2) for current and an angular acceleration of the load from outside."""
    hub = p["hub_inertia_kg_m2"]
    load = p["load_inertia_kg_m2"]
    spring = p["spring_Nm_rad"]
    link = p["link_damping_Nms"]
    inverse_inertias = 1 / hub + 1 / load
    friction = p["hub_damping_Nms"] / hub
    drive = p["torque_constant_Nm_A"] / hub
    A = np.array(
        [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            [0, spring / hub, -friction, link / hub],
            [0, -spring * inverse_inertias, friction, -link * inverse_inertias],
        ]
    )
    return A, np.array([[0, 0], [0, 0], [drive, 0], [-drive, 1.0]])


@njit
def _run(inputs: Real, A: Real, B: Real, gains: Real, p: np.record) -> Real:
    """Dry friction as the current that it takes off, so that the joint truly sticks; (T, 2)."""
    T = len(inputs)
    h = DT_S / SUBSTEPS
    out = np.zeros((T, 3))
    command = np.zeros(T)
    x = np.zeros(4)
    y = np.zeros(4)
    x[0] = inputs[0, 2]
    keep = np.exp(-FILTER_RAD_S * DT_S)
    last0 = x[0]
    last1 = p.strain_offset_angle_rad
    speed0 = 0.0
    speed1 = 0.0
    pull = gains[0] * (inputs[0, 0] - x[0])
    dry = p.coulomb_friction_current_A
    static = p.stribeck_friction_static_A
    coulomb = dry + static * p.stribeck_friction_coulomb_share
    static = dry + static
    for k in range(T):
        reference = inputs[k, 0]
        outside = p.other_stage_share * inputs[k, 1]
        theta = x[0]
        alpha = (1 + p.strain_gain_relative_error) * x[1] + p.strain_offset_angle_rad
        out[k, 0] = theta
        out[k, 1] = alpha
        speed0 = keep * speed0 + (1 - keep) * (theta - last0) / DT_S
        speed1 = keep * speed1 + (1 - keep) * (alpha - last1) / DT_S
        last0 = theta
        last1 = alpha
        i = gains[0] * (reference - theta) - gains[1] * alpha - gains[2] * speed0 - gains[3] * speed1
        command[k] = out[k, 2] = min(max(i, -LIMIT_A), LIMIT_A)
        late = late_value(command, k, p.input_delay_delay_s / DT_S, p.actuator_dead_zone_width_A)
        for _ in range(SUBSTEPS):
            pull = lagged(pull, late, h, p.actuator_lag_time_constant_s)
            drive = pull + p.current_offset_current_A - p.hardening_spring_cubic_A_rad3 * x[0] ** 3
            free = A[2, 0] * x[0] + A[2, 1] * x[1] + A[2, 2] * x[2] + A[2, 3] * x[3] + B[2, 0] * drive
            free += B[2, 1] * outside
            level = coulomb + (static - coulomb) * np.exp(-abs(x[2]) / p.stribeck_friction_velocity_rad_s)
            taken = min(max(free / B[2, 0], -level), level)
            for r in range(4):
                y[r] = B[r, 0] * (drive - taken) + B[r, 1] * outside
                for c in range(4):
                    y[r] += A[r, c] * x[c]
            x[:] = y
    return out


def logged(folder: Path, stage: int) -> Real:
    """(5, T): commanded current, (not used), reference, theta and alpha of a stage."""
    data = np.loadtxt(folder / "quanser_2dsfl" / "lqr_run.csv", delimiter=",", skiprows=1)
    return data[:, 5 * stage - 4 : 5 * stage + 1].T


def manufacturers_gains(folder: Path, stage: int) -> Real:
    """(4,) of the feedback that the record was made with."""
    path = folder / "quanser_2dsfl" / f"nominal_stage{stage}_K.csv"
    return np.loadtxt(path, delimiter=",", skiprows=1)


def law_error(folder: Path, stage: int, filter_rad_s: float) -> float:
    """RMS [A] of the logged command minus the law with the manufacturer's gains, after the first second."""
    command, _, reference, theta, alpha = logged(folder, stage)
    keep = np.exp(-filter_rad_s * DT_S)
    speeds = [lfilter([1 - keep, keep - 1], [DT_S, -keep * DT_S], x - x[0]) for x in (theta, alpha)]
    law = manufacturers_gains(folder, stage) @ np.array([reference - theta, -alpha, -speeds[0], -speeds[1]])
    return float(np.sqrt(np.mean((command - law)[500:] ** 2)))


def standing(folder: Path, stage: int) -> Real:
    """Mean commanded current [A] of every 0.3 s in which the joint stands within 0.1 mrad, (W,)."""
    command, _, _, theta, _ = logged(folder, stage)
    command, theta = (np.lib.stride_tricks.sliding_window_view(x, 150)[::150] for x in (command, theta))
    still = np.ptp(theta, axis=1) < 1e-4
    return np.asarray(command.mean(axis=1)[still])


def case(folder: Path, stage: int) -> PlantCase:
    """First pass to fit, second to judge.

    "other_stage" acts on the load: for stage 1 the spring torque of stage 2, for stage 2 the angular
    acceleration of what it stands on (second differences of 30 ms of the measured tip angle).
    """
    command, _, reference, theta, alpha = logged(folder, stage)
    _, _, _, other_theta, other_alpha = logged(folder, 3 - stage)
    if stage == 1:
        spring = MANUFACTURER[2]["spring_Nm_rad"] / MANUFACTURER[1]["load_inertia_kg_m2"]
        outside = spring * other_alpha
    else:
        tip = other_theta + other_alpha
        n = 15
        padded = np.pad(tip, n, mode="edge")
        outside = -(padded[2 * n :] - 2 * tip + padded[: -2 * n]) / (n * DT_S) ** 2
    inputs = np.column_stack([reference, outside, theta])
    output = np.column_stack([theta, alpha, command])
    first = slice(0, PERIOD)
    second = slice(PERIOD, 2 * PERIOD)
    noise = np.sqrt(np.mean((output[first] - output[second]) ** 2, axis=0) / 2)
    plant = Plant(
        simulation(manufacturers_gains(folder, stage)),
        MANUFACTURER[stage],
        TOLERANCES,
        ("theta_rad", "alpha_rad", "command_A"),
        noise,
        EFFECTS,
    )
    return PlantCase(
        f"Quanser serial flexible link, stage {stage}",
        plant,
        (
            PlantExperiment("0 to 10 s", "estimation", inputs[first], output[first]),
            PlantExperiment("10 to 20 s", "held_out", inputs[second], output[second]),
        ),
    )
