"""The single-link robot of R. Krauss (SLFR, 2009) as a plant of one's own: hub, motor and two strip modes.

    theta'' + sum_i b_i eta_i'' = gain v - damping theta'
    eta_i'' + 2 zeta_i w_i eta_i' + w_i^2 eta_i = -b_i theta''

in counts, with the feedback v = u - theta of the record. No physical nominal exists (volts per count are not
published), so the stated values are a fit at one amplitude of the swept sine: what the other amplitude shows
beyond it is not linear. Theta alone: the accelerometer's scale is not published either.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from benchmarks.own_plant import SHARE, Real, constants, held_input, lagged, late_value
from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.machine.machine_protocol import Role

# Sampling period of the records.
DT_S = 0.002
# Steps of the simulation a sample.
SUBSTEPS = 1
# A spring that pushes away makes the arm unstable: such a fit has to end somewhere finite.
RUNAWAY_COUNTS = 1e4
COUNTS_PER_RAD = 1024 / (2 * np.pi)
# Mode frequencies and first damping from the free decays with the hub held; the rest only starts the fit.
GUESS = {
    "gain_1_s2": 300.0,
    "damping_1_s": 20.0,
    "first_mode_rad_s": 2 * np.pi * 2.52,
    "first_damping": 0.007,
    "first_share": 0.3,
    "second_mode_rad_s": 2 * np.pi * 17.96,
    "second_damping": 0.01,
    "second_share": 0.2,
}


_P = EffectParameter
EFFECTS = (
    PlantEffect("coulomb_friction", (_P("drive_counts", 0.01, 40.0),), dependence="continuous"),
    PlantEffect(
        "stribeck_friction",
        (_P("static_counts", 0.01, 60.0), SHARE, _P("velocity_counts_s", 1.0, 1000.0)),
        dependence="continuous",
    ),
    PlantEffect("drive_offset", (_P("drive_counts", 0.01, 40.0),), signed=True, dependence="continuous"),
    PlantEffect("angle_offset", (_P("counts", 0.01, 40.0),), signed=True),
    PlantEffect("input_delay", (_P("delay_s", 1e-4, 0.03),)),
    PlantEffect("actuator_lag", (_P("time_constant_s", 1e-4, 0.1),)),
    PlantEffect("actuator_dead_zone", (_P("width_counts", 0.01, 40.0),), dependence="continuous"),
    PlantEffect(
        "actuator_saturation", (_P("limit_counts", 10.0, 200.0),), grows=False, dependence="continuous"
    ),
    PlantEffect("quadratic_friction", (_P("counts_at_10_counts_s", 1e-6, 0.1),), signed=True),
    PlantEffect("hardening_spring", (_P("counts_at_10_counts", 1e-6, 1.0),), signed=True),
)


def simulate(
    parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
) -> Real:
    """Reference (T, 1) -> theta (T, 1), both in counts, from rest."""
    absent = {"actuator_saturation_limit_counts": np.inf, "stribeck_friction_velocity_counts_s": 1.0}
    A, B = held_input(*state_space(parameters), DT_S / SUBSTEPS)
    p = constants(EFFECTS, effects, **absent)
    return np.asarray(_run(np.ascontiguousarray(inputs[:, 0]), A, B[:, 0].copy(), p)[:, None])


def state_space(p: Mapping[str, float]) -> tuple[Real, Real]:
    """A (6, 6) and B (6, 1) of [theta, eta_1, eta_2, and their speeds], drive in counts."""
    b = np.array([p["first_share"], p["second_share"]])
    w = np.array([p["first_mode_rad_s"], p["second_mode_rad_s"]])
    zeta = np.array([p["first_damping"], p["second_damping"]])
    mass = np.eye(3)
    mass[0, 1:] = mass[1:, 0] = b
    inverse = np.linalg.inv(mass)
    stiffness = np.diag([0.0, *w**2])
    damping = np.diag([p["damping_1_s"], *(2 * zeta * w)])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ stiffness, -inverse @ damping]])
    return A, np.concatenate([np.zeros(3), p["gain_1_s2"] * inverse[:, 0]])[:, None]


@njit
def _run(reference: Real, A: Real, B: Real, p: np.record) -> Real:
    """Dry friction as the drive that it takes off, so that the hub truly sticks."""
    T = reference.size
    h = DT_S / SUBSTEPS
    theta = np.zeros(T)
    command = np.zeros(T)
    x = np.zeros(6)
    y = np.zeros(6)
    pull = 0.0
    limit = p.actuator_saturation_limit_counts
    dry = p.coulomb_friction_drive_counts
    static = p.stribeck_friction_static_counts
    coulomb = dry + static * p.stribeck_friction_coulomb_share
    static = dry + static
    quadratic = p.quadratic_friction_counts_at_10_counts_s
    cubic = p.hardening_spring_counts_at_10_counts
    for k in range(T):
        theta[k] = x[0] + p.angle_offset_counts
        command[k] = min(max(reference[k] - theta[k], -limit), limit)
        late = late_value(command, k, p.input_delay_delay_s / DT_S, p.actuator_dead_zone_width_counts)
        for _ in range(SUBSTEPS):
            pull = lagged(pull, late, h, p.actuator_lag_time_constant_s)
            drive = pull + p.drive_offset_drive_counts
            drive = drive - quadratic * x[3] * abs(x[3]) / 100 - cubic * (x[0] / 10) ** 3
            free = B[3] * drive
            for c in range(6):
                free += A[3, c] * x[c]
            level = coulomb + (static - coulomb) * np.exp(-abs(x[3]) / p.stribeck_friction_velocity_counts_s)
            drive -= min(max(free / B[3], -level), level)
            for r in range(6):
                y[r] = B[r] * drive
                for c in range(6):
                    y[r] += A[r, c] * x[c]
            x[:] = y
        if not abs(x[0]) < RUNAWAY_COUNTS:
            theta[k:] = RUNAWAY_COUNTS
            break
    return theta


def record(folder: Path, amplitude: int, repeat: int) -> Real:
    """(T, 2): reference and theta in counts."""
    path = folder / "slfr_krauss_2009" / f"swept_sine_amp{amplitude}_rep{repeat}.csv"
    return np.asarray(np.loadtxt(path, delimiter=",", skiprows=1, usecols=(1, 3)) * COUNTS_PER_RAD)


def linear_fit(data: Real) -> dict[str, float]:
    """Least squares of the linear plant on one record, logarithms of all values free."""
    start = np.log(list(GUESS.values()))

    def residual(logs: Real) -> Real:
        parameters = dict(zip(GUESS, np.exp(np.clip(logs, start - 4, start + 4)), strict=True))
        error = simulate(parameters, {}, data[:, :1])[:, 0] - data[:, 1]
        return np.asarray(np.nan_to_num(error, nan=1e3, posinf=1e3, neginf=-1e3).clip(-1e3, 1e3))

    fit = least_squares(residual, start, x_scale=0.1, max_nfev=80)
    return dict(zip(GUESS, map(float, np.exp(fit.x)), strict=True))


def case(folder: Path, fitted: tuple[int, ...] = (50, 75), judged: tuple[int, ...] = (50, 75)) -> PlantCase:
    """Stated: linear fit of the third repeat at amplitude 50. Fitted: first repeats. Judged: second repeats.

    Noise is the scatter between repeats, of which there are three at each amplitude.
    """
    repeats = {amplitude: [record(folder, amplitude, r) for r in (1, 2, 3)] for amplitude in (50, 75)}
    variances = [np.var([r[:, 1] for r in three], axis=0, ddof=1) for three in repeats.values()]
    noise = float(np.sqrt(np.mean(variances)))
    stated = linear_fit(repeats[50][2])
    plant = Plant(
        simulate,
        stated,
        dict.fromkeys(stated, 0.1),
        ("theta_counts",),
        np.array([noise]),
        EFFECTS,
    )
    roles: tuple[tuple[Role, int, tuple[int, ...]], ...] = (
        ("estimation", 1, fitted),
        ("held_out", 2, judged),
    )
    experiments = [
        PlantExperiment(f"amplitude {a}, repeat {r}", role, *np.split(repeats[a][r - 1], 2, axis=1))
        for role, r, amplitudes in roles
        for a in amplitudes
    ]
    return PlantCase("SLFR, swept sines", plant, tuple(experiments))
