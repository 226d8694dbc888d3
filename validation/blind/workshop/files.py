"""Workshop cases as folders: a user's own columns and units, jittering stamps, missing rows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tomlkit

from validation.blind.rigs import rig_toml, rounded
from validation.blind.workshop.answer import MODEL_ERROR
from validation.blind.workshop.cases import WorkshopCase
from workflow.engine.storage import write_text

# One degree in radians.
_DEGREE = float(np.pi / 180)
# Standard gravity, m/s^2.
_G = 9.80665
# Quantity -> (column, scale) that users write.
_COLUMNS: Mapping[str, tuple[tuple[str, float], ...]] = {
    "time_s": (("time_s", 1.0), ("Zeit_ms", 1e-3), ("stamp_us", 1e-6), ("time_ms", 1e-3), ("t", 1.0)),
    "voltage_V": (("voltage_V", 1.0), ("u_mV", 1e-3), ("U_motor [V]", 1.0), ("amp_V", 1.0), ("u_mV", -1e-3)),
    "hub_angle_rad": (("phi_deg", _DEGREE), ("q1_mrad", 1e-3), ("hub_rad", 1.0), ("enc [deg]", _DEGREE)),
    "tip_m": (
        ("tip_mm", 1e-3),
        ("y_tip_m", 1.0),
        ("y_tip_m", -1.0),
        ("laser [mm]", 1e-3),
        ("camera_cm", 1e-2),
    ),
    "tip_acceleration_m_s2": (("acc_mg", _G / 1e3), ("acc_g", _G), ("a_tip", 1.0), ("acc_mg", -_G / 1e3)),
    "reference_rad": (("ref_deg", _DEGREE), ("soll [deg]", _DEGREE), ("w", 1.0), ("setpoint_rad", 1.0)),
}
# Columns whose zero is somewhere.
_SHIFTED = ("laser [mm]", "camera_cm")
# Digits of a value in a file.
_SIGNIFICANT = 7


def write_workshop_case(case: WorkshopCase, folder: Path, rng: np.random.Generator) -> None:
    """rig.toml, case.toml and experiments/*.csv; the answer is not among them."""
    (folder / "experiments").mkdir(parents=True, exist_ok=True)
    machine = case.machine
    quantities = {name: None for sample in case.samples for name in sample.quantities}
    columns = {name: _column(name, case, rng) for name in rng.permutation(list(quantities)).tolist()}
    for sample in case.samples:
        order = [name for name in columns if name in sample.quantities]
        table = {}
        for name in order:
            column, scale, offset = columns[name]
            values = (np.round(sample.quantities[name], _DIGITS.get(name, 12)) - offset) / scale
            shown = np.rint(values) if column == "counts" else values
            table[column] = [f"{value:.{_SIGNIFICANT}g}" for value in shown.tolist()]
        frame = pd.DataFrame(table).drop(index=sample.lost_rows)
        write_text(folder / "experiments" / f"{sample.run.plan.name}.csv", frame.to_csv(index=False))
    shown_rig = rig_toml(machine.stated, machine.tolerances)
    write_text(
        folder / "rig.toml", shown_rig.replace("\n\n[sampling]", '\nnoise_is = "data sheet"\n\n[sampling]')
    )
    document: dict[str, Any] = {
        "case": folder.name,
        "model_error": MODEL_ERROR,
        "outputs": machine.outputs,
        "columns": {
            name: {"column": column, "scale": scale, "offset": offset}
            for name, (column, scale, offset) in columns.items()
        },
        "experiments": [
            {
                "file": f"experiments/{s.run.plan.name}.csv",
                "kind": s.run.plan.kind,
                "role": s.run.plan.role,
                "samples": s.quantities["time_s"].size - len(s.lost_rows),
                "closed_loop": s.run.plan.feedback is not None,
                "description": s.run.plan.description,
            }
            for s in case.samples
        ],
    }
    write_text(folder / "case.toml", tomlkit.dumps(document))


# What a log keeps of a time stamp and of a voltage.
_DIGITS = {"time_s": 7, "voltage_V": 4}


def _column(name: str, case: WorkshopCase, rng: np.random.Generator) -> tuple[str, float, float]:
    """(column, scale, offset) of a quantity."""
    if name == "hub_angle_rad" and rng.random() < 0.2:
        return "counts", case.machine.background.encoder_step_rad, 0.0
    if name == "voltage_V" and rng.random() < 0.2:
        largest = max(float(np.max(np.abs(s.quantities[name]))) for s in case.samples)
        return "duty_pct", rounded(largest / 80), 0.0
    if name == "tip_m" and rng.random() < 0.2:
        return "tip_px", rounded(rng.uniform(3e-4, 5e-4)), round(rng.uniform(-0.4, 0.4), 3)
    choices = _COLUMNS[name]
    column, scale = choices[int(rng.integers(len(choices)))]
    return column, scale, round(rng.uniform(-0.4, 0.4), 3) if column in _SHIFTED else 0.0
