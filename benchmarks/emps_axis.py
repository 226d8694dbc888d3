"""EMPS, a ball-screw axis in closed loop, as a plant of one's own for the diagnosis.

A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS, Nonlinear System Identification
Benchmarks, Eindhoven 2019: force = M a + Fv v + Fc sign(v) + offset with M 95.1089 kg, Fv 203.5034 N s/m, Fc
20.3935 N, offset -3.1648 N.

Two simulations. "forces": measured motion in, the force it takes out, as in the report. "loop": the feedback
closed, reference in, force of the motor out; the law of the record is V = 243.45 (160.18 (q_ref - q) -
(q[k] - q[k-2])/(2 dt)), which reproduces its voltage from its positions (tests/diagnosis/test_emps.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numba import njit
from scipy.signal import butter, filtfilt

from benchmarks.own_plant import SHARE, Real, constants, lagged, late_value
from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.machine.machine_protocol import Role

DT_S = 1e-3
FORCE_PER_VOLT_N = 35.15065188
# Gain of the position controller, 1/s.
POSITION_GAIN = 160.18
# Gain of the velocity controller, V s/m.
VELOCITY_GAIN = 243.45
# Largest command of the drive.
LIMIT_V = 10.0
PUBLISHED = {"mass_kg": 95.1089, "viscous_Ns_m": 203.5034, "coulomb_N": 20.3935, "offset_N": -3.1648}
# The reference repeats exactly after this many samples.
PERIOD = 6240
# Records start at this sample, where it moves at constant speed.
FIRST = 200
# Samples that the loop is run before the first one.
_RUN_IN = 400
# Steps of the simulation a sample.
_SUBSTEPS = 4


def effects(loop: bool, refined: bool) -> tuple[PlantEffect, ...]:
    """What the diagnosis of a flexible link lists and a rigid axis can have, and a constant offset.

    Ranges come from the sizes of the record. loop: also what shows only in a simulated loop. refined: also
    shapes of the viscous friction.
    """
    P = EffectParameter
    friction = SHARE, P("velocity_m_s", 1e-3, 0.1)
    listed = [
        PlantEffect("coulomb_friction", (P("force_N", 1e-2, 150.0),), dependence="continuous"),
        PlantEffect("constant_offset", (P("force_N", 1e-2, 100.0),), signed=True, dependence="continuous"),
        PlantEffect("stribeck_friction", (P("static_N", 1e-2, 300.0), *friction), dependence="continuous"),
        PlantEffect("cable_spring", (P("stiffness_N_m", 0.1, 1000.0),), signed=True),
        PlantEffect("hardening_spring", (P("cubic_N_m3", 1.0, 1e5),), signed=True),
        PlantEffect("actuator_gain", (P("relative_error", 1e-3, 0.6),), signed=True),
        PlantEffect("input_delay", (P("delay_s", 1e-5, 8e-3),)),
        PlantEffect("actuator_lag", (P("time_constant_s", 1e-5, 2e-2),)),
        PlantEffect("actuator_dead_zone", (P("width_V", 1e-3, 3.0),), dependence="continuous"),
    ]
    if loop:
        listed += [
            PlantEffect(
                "actuator_saturation", (P("limit_V", 1.0, LIMIT_V),), grows=False, dependence="continuous"
            ),
            PlantEffect("encoder_quantisation", (P("step_m", 1e-7, 1e-4),), dependence="non-smooth"),
        ]
    if refined:
        listed += [
            PlantEffect("viscous_asymmetry", (P("coefficient_Ns_m", 1.0, 1000.0),), signed=True),
            PlantEffect("quadratic_friction", (P("coefficient_Ns2_m2", 1.0, 2e4),), signed=True),
        ]
    return tuple(listed)


_EVERY = effects(loop=True, refined=True)


def simulate(
    parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
) -> Real:
    """Reference position (T, 1) -> motor force (T, 1), after a run-in at the reference's first speed."""
    reference = inputs[:, 0]
    before = reference[0] - (reference[1] - reference[0]) * np.arange(_RUN_IN, 0, -1)
    force = _run(np.concatenate([before, reference]), _constants(parameters, effects))
    return np.asarray(force[_RUN_IN:, None])


def _constants(parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]]) -> np.record:
    limit = {"actuator_saturation_limit_V": LIMIT_V, "stribeck_friction_velocity_m_s": 1.0}
    return constants(_EVERY, effects, parameters, **limit)


@njit
def _run(reference: Real, p: np.record) -> Real:
    """Friction by its implicit step, so that the axis truly sticks; force of the record, (T,)."""
    T = reference.size
    h = DT_S / _SUBSTEPS
    force = np.zeros(T)
    v = (reference[1] - reference[0]) / DT_S
    q = reference[0] - v / POSITION_GAIN
    seen1 = q - v * DT_S
    seen2 = q - 2 * v * DT_S
    pull = 0.0
    limit = p.actuator_saturation_limit_V
    encoder = p.encoder_quantisation_step_m
    dead_zone = p.actuator_dead_zone_width_V * FORCE_PER_VOLT_N
    # Dry friction adds up when two laws of it are tried together.
    coulomb = p.coulomb_friction_force_N + p.stribeck_friction_coulomb_share * p.stribeck_friction_static_N
    static = p.coulomb_friction_force_N + p.stribeck_friction_static_N
    asymmetry = p.viscous_asymmetry_coefficient_Ns_m
    quadratic = p.quadratic_friction_coefficient_Ns2_m2
    for k in range(T):
        seen = q if encoder <= 0.0 else encoder * np.round(q / encoder)
        volts = VELOCITY_GAIN * (POSITION_GAIN * (reference[k] - seen) - (seen - seen2) / (2 * DT_S))
        seen2 = seen1
        seen1 = seen
        volts = min(max(volts, -limit), limit)
        force[k] = FORCE_PER_VOLT_N * volts
        late = (1 + p.actuator_gain_relative_error) * late_value(
            force, k, p.input_delay_delay_s / DT_S, dead_zone
        )
        for _ in range(_SUBSTEPS):
            pull = lagged(pull, late, h, p.actuator_lag_time_constant_s)
            level = coulomb + (static - coulomb) * np.exp(-abs(v) / p.stribeck_friction_velocity_m_s)
            side = p.viscous_Ns_m + (asymmetry if v > 0 else -asymmetry)
            spring = p.cable_spring_stiffness_N_m * q
            cubic = p.hardening_spring_cubic_N_m3 * q**3
            free = pull - p.constant_offset_force_N - spring - cubic - quadratic * v * abs(v)
            free = v + h / p.mass_kg * free
            held = h / p.mass_kg * level
            new = 0.0 if abs(free) <= held else (free - np.sign(free) * held) / (1 + h / p.mass_kg * side)
            q += 0.5 * h * (v + new)
            v = new
    return force


def forces(parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real) -> Real:
    """Measured position, velocity, acceleration (T, 3) -> force (T, 1) that such a motion takes.

    Effects of the actuator are inverted: the force of the record is the one commanded.
    """
    q, v, a = inputs.T
    p = _constants(parameters, effects)
    share = p.stribeck_friction_coulomb_share
    fall = np.exp(-np.abs(v) / p.stribeck_friction_velocity_m_s)
    stribeck = p.stribeck_friction_static_N * (share + (1 - share) * fall)
    force = (
        p.mass_kg * a
        + p.viscous_Ns_m * v
        + (p.coulomb_friction_force_N + stribeck) * np.sign(v)
        + p.constant_offset_force_N
        + p.viscous_asymmetry_coefficient_Ns_m * np.abs(v)
        + p.quadratic_friction_coefficient_Ns2_m2 * v * np.abs(v)
        + p.cable_spring_stiffness_N_m * q
        + p.hardening_spring_cubic_N_m3 * q**3
    )
    t = np.arange(q.size) * DT_S
    force = np.interp(t + p.input_delay_delay_s, t, force)
    force = force + p.actuator_lag_time_constant_s * np.gradient(force, DT_S)
    force = force + p.actuator_dead_zone_width_V * FORCE_PER_VOLT_N * np.sign(force)
    return np.asarray(force[:, None] / (1 + p.actuator_gain_relative_error))


def record(folder: Path) -> Real:
    """(T, 5): reference [m], measured position, velocity, acceleration, force [N].

    Derivatives as in the report: 4th-order Butterworth filter of 100 Hz run both ways, central differences.
    """
    table = np.loadtxt(folder / "emps" / "emps_train.csv", delimiter=",", skiprows=1)
    q = filtfilt(*butter(4, 100.0, fs=1 / DT_S), table[:, 2])
    v = np.gradient(q, DT_S)
    return np.column_stack([table[:, 1], q, v, np.gradient(v, DT_S), table[:, 4]])


def viscous_refit(pieces: Sequence[Real]) -> dict[str, float]:
    """Mass and viscous friction by least squares on the force, as someone would have who knows no other."""
    data = np.concatenate(pieces)
    mass, viscous = np.linalg.lstsq(data[:, [3, 2]], data[:, 4], rcond=None)[0]
    return {"mass_kg": float(mass), "viscous_Ns_m": float(viscous)}


def passes(data: Real) -> list[slice]:
    """The four runs through the same motion; the last one lacks 319 samples."""
    starts = [FIRST + k * PERIOD for k in range(4)]
    return [slice(start, min(start + PERIOD, len(data))) for start in starts]


def scatter(data: Real) -> float:
    """Standard deviation between passes of the same motion, of a series (T,): noise without any model."""
    whole = [data[piece] for piece in passes(data)[:3]]
    return float(np.sqrt(np.mean(np.var(whole, axis=0, ddof=1))))


def case(
    folder: Path,
    held_out: Literal["passes", "fast"],
    simulated: Literal["forces", "loop"] = "forces",
    *,
    refined: bool = False,
) -> PlantCase:
    """The record as a case.

    held_out : "passes", first and third pass to fit, the others (the same motion again) to judge;
        "fast", strokes up to 0.083 m/s to fit, those up to 0.125 m/s, a motion no fit has seen, to judge.
    simulated : "forces", measured motion in, force out; "loop", reference in, force of the closed loop out.
    refined : shapes of viscous friction (by direction, by speed) are listed as well.
    """
    data = record(folder)
    if held_out == "passes":
        runs = passes(data)
        fitted = runs[::2]
        judged = runs[1::2]
    else:
        fitted = _strokes(data, (2900, 4000), (5900, 7140))
        judged = _strokes(data, (900, 2900), (4000, 5900))
    stated = viscous_refit([data[piece] for piece in fitted])
    columns = [1, 2, 3] if simulated == "forces" else [0]
    # Measured motion brings noise of its own to the forces it is said to take.
    unexplained = data[:, 4] - forces(stated, {}, data[:, 1:4])[:, 0] if simulated == "forces" else data[:, 4]
    noise = scatter(unexplained)
    plant = Plant(
        forces if simulated == "forces" else simulate,
        stated,
        # A refit of the same records knows nothing beside them.
        {"mass_kg": 1.0, "viscous_Ns_m": 3.0},
        ("force_N",),
        np.array([noise]),
        effects(simulated == "loop", refined),
    )

    def experiment(role: Role, piece: slice) -> PlantExperiment:
        label = f"{piece.start * DT_S:.1f} to {piece.stop * DT_S:.1f} s"
        return PlantExperiment(label, role, data[piece][:, columns], data[piece, 4:])

    experiments = [experiment("estimation", piece) for piece in fitted]
    experiments += [experiment("held_out", piece) for piece in judged]
    return PlantCase(f"EMPS, {simulated}, {held_out} held out", plant, tuple(experiments))


def _strokes(data: Real, *parts: tuple[int, int]) -> list[slice]:
    """Parts of every pass, as samples from the first reference on."""
    whole = [slice(k * PERIOD + first, k * PERIOD + last) for k in range(4) for first, last in parts]
    return [piece for piece in whole if piece.stop <= len(data)]
