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

from benchmarks.own_plant import SHARE, Real, given, lagged, late_value
from diagnosis import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.machine.machine_protocol import Role

DT_S = 1e-3
FORCE_PER_VOLT_N = 35.15065188
POSITION_GAIN, VELOCITY_GAIN, LIMIT_V = 160.18, 243.45, 10.0
PUBLISHED = {"mass_kg": 95.1089, "viscous_Ns_m": 203.5034, "coulomb_N": 20.3935, "offset_N": -3.1648}
# The reference repeats exactly after this many samples; records start where it moves at constant speed.
PERIOD, FIRST = 6240, 200
_RUN_IN, _SUBSTEPS = 400, 4


def effects(loop: bool, refined: bool) -> tuple[PlantEffect, ...]:
    """What the diagnosis of a flexible link lists and a rigid axis can have, and a constant offset.

    Ranges come from the sizes of the record. loop: also what shows only in a simulated loop. refined: also
    shapes of the viscous friction.
    """
    P = EffectParameter
    friction = SHARE, P("velocity_m_s", 1e-3, 0.1)
    found = [
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
        found += [
            PlantEffect(
                "actuator_saturation", (P("limit_V", 1.0, LIMIT_V),), grows=False, dependence="continuous"
            ),
            PlantEffect("encoder_quantisation", (P("step_m", 1e-7, 1e-4),), dependence="non-smooth"),
        ]
    if refined:
        found += [
            PlantEffect("viscous_asymmetry", (P("coefficient_Ns_m", 1.0, 1000.0),), signed=True),
            PlantEffect("quadratic_friction", (P("coefficient_Ns2_m2", 1.0, 2e4),), signed=True),
        ]
    return tuple(found)


def simulate(
    parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real
) -> Real:
    """Reference position (T, 1) -> motor force (T, 1), after a run-in at the reference's first speed."""
    value = given(effects)
    # Dry friction adds up when two laws of it are tried together.
    coulomb = value("coulomb_friction", "force_N")
    stribeck = value("stribeck_friction", "static_N")
    reference = inputs[:, 0]
    before = reference[0] - (reference[1] - reference[0]) * np.arange(_RUN_IN, 0, -1)
    force = _run(
        np.concatenate([before, reference]),
        parameters["mass_kg"],
        parameters["viscous_Ns_m"],
        coulomb + value("stribeck_friction", "coulomb_share") * stribeck,
        coulomb + stribeck,
        value("stribeck_friction", "velocity_m_s", 1.0),
        value("constant_offset", "force_N"),
        value("viscous_asymmetry", "coefficient_Ns_m"),
        value("quadratic_friction", "coefficient_Ns2_m2"),
        value("cable_spring", "stiffness_N_m"),
        value("hardening_spring", "cubic_N_m3"),
        1 + value("actuator_gain", "relative_error"),
        value("input_delay", "delay_s"),
        value("actuator_lag", "time_constant_s"),
        value("actuator_dead_zone", "width_V"),
        value("actuator_saturation", "limit_V", LIMIT_V),
        value("encoder_quantisation", "step_m"),
    )
    return np.asarray(force[_RUN_IN:, None])


@njit
def _run(
    reference: Real,
    mass: float,
    viscous: float,
    coulomb: float,
    static: float,
    stribeck_velocity: float,
    offset: float,
    asymmetry: float,
    quadratic: float,
    spring: float,
    cubic: float,
    gain: float,
    delay: float,
    lag: float,
    dead_zone: float,
    limit: float,
    encoder: float,
) -> Real:
    """Friction by its implicit step, so that the axis truly sticks; force of the record, (T,)."""
    T = reference.size
    h = DT_S / _SUBSTEPS
    force = np.zeros(T)
    v = (reference[1] - reference[0]) / DT_S
    q = reference[0] - v / POSITION_GAIN
    seen1 = q - v * DT_S
    seen2 = q - 2 * v * DT_S
    pull = 0.0
    for k in range(T):
        seen = q if encoder <= 0.0 else encoder * np.round(q / encoder)
        volts = VELOCITY_GAIN * (POSITION_GAIN * (reference[k] - seen) - (seen - seen2) / (2 * DT_S))
        seen2, seen1 = seen1, seen
        volts = min(max(volts, -limit), limit)
        force[k] = FORCE_PER_VOLT_N * volts
        late = gain * late_value(force, k, delay / DT_S, dead_zone * FORCE_PER_VOLT_N)
        for _ in range(_SUBSTEPS):
            pull = lagged(pull, late, h, lag)
            level = coulomb + (static - coulomb) * np.exp(-abs(v) / stribeck_velocity)
            side = viscous + (asymmetry if v > 0 else -asymmetry)
            free = v + h / mass * (pull - offset - spring * q - cubic * q**3 - quadratic * v * abs(v))
            held = h / mass * level
            new = 0.0 if abs(free) <= held else (free - np.sign(free) * held) / (1 + h / mass * side)
            q += 0.5 * h * (v + new)
            v = new
    return force


def forces(parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]], inputs: Real) -> Real:
    """Measured position, velocity, acceleration (T, 3) -> force (T, 1) that such a motion takes.

    Effects of the actuator are inverted: the force of the record is the one commanded.
    """
    q, v, a = inputs.T
    value = given(effects)
    share, speed = (
        value("stribeck_friction", "coulomb_share"),
        value("stribeck_friction", "velocity_m_s", 1.0),
    )
    stribeck = value("stribeck_friction", "static_N") * (share + (1 - share) * np.exp(-np.abs(v) / speed))
    force = (
        parameters["mass_kg"] * a
        + parameters["viscous_Ns_m"] * v
        + (value("coulomb_friction", "force_N") + stribeck) * np.sign(v)
        + value("constant_offset", "force_N")
        + value("viscous_asymmetry", "coefficient_Ns_m") * np.abs(v)
        + value("quadratic_friction", "coefficient_Ns2_m2") * v * np.abs(v)
        + value("cable_spring", "stiffness_N_m") * q
        + value("hardening_spring", "cubic_N_m3") * q**3
    )
    t = np.arange(q.size) * DT_S
    force = np.interp(t + value("input_delay", "delay_s"), t, force)
    force = force + value("actuator_lag", "time_constant_s") * np.gradient(force, DT_S)
    force = force + value("actuator_dead_zone", "width_V") * FORCE_PER_VOLT_N * np.sign(force)
    return np.asarray(force[:, None] / (1 + value("actuator_gain", "relative_error")))


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
        fitted, judged = runs[::2], runs[1::2]
    else:
        fitted, judged = _strokes(data, (2900, 4000), (5900, 7140)), _strokes(data, (900, 2900), (4000, 5900))
    stated = viscous_refit([data[piece] for piece in fitted])
    columns = [1, 2, 3] if simulated == "forces" else [0]
    # Measured motion brings noise of its own to the forces it is said to take.
    rest = data[:, 4] - forces(stated, {}, data[:, 1:4])[:, 0] if simulated == "forces" else data[:, 4]
    noise = scatter(rest)
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
