"""Ellipses that promise the response without dry friction, on the default arm: do they hold it?

Records, sensor noise, encoder and settings of `workflow/data/default_arm.toml` with dry friction of several
levels. Truth: the linear arm (stated viscous friction added), voltage held between samples, delayed by one.
Inside: share of (seed, frequency) with the true response inside its 95 % ellipse, frequencies 30 a decade.
Error: median over seeds and frequencies of |centre - truth| over |truth|; radius: the same of the ellipse's
larger semi-axis; ratio: radius over error. Level: median of |level - truth| over truth and the share of seeds
whose 95 % interval holds the true level. CPU: friction and both channels' poles and ellipses.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd

from benchmarks.harness import Print, main, timed
from ident import Record, identify
from ident.data.arrays import ComplexArray, RealArray
from ident.friction import FrictionFit, fit_friction, other_output_without_friction, without_friction
from ident.friction.posterior import BehindFriction
from ident.uncertainty import FrequencyUncertainty
from plant.modal import linear_arm
from workflow.config.run_config import Channel, SimulatedSource, built_in_config
from workflow.tasks.simulated_rig import rig_of, simulate_record

FRICTIONS_NM = (0.0, 0.005, 0.02, 0.1)
EDGES_RAD_S = 0.63 * 10 ** (0.5 * np.arange(7))
OMEGA_RAD_S = np.geomspace(0.63, 627.0, 91)


def with_friction(source: SimulatedSource, torque_Nm: float, counts: int) -> SimulatedSource:
    """The arm with dry friction of this size and an encoder of so many counts a turn."""
    other_effects = tuple(effect for effect in source.effects if effect["name"] != "coulomb_friction")
    friction = ({"name": "coulomb_friction", "torque_Nm": torque_Nm},) if torque_Nm else ()
    return source.model_copy(
        update={
            "effects": (*friction, *other_effects),
            "encoder_step_rad": 2 * np.pi / counts if counts else 0.0,
        }
    )


def estimation_records(source: SimulatedSource, seed: int) -> list[Record]:
    """Records of all experiments of a source that are to be identified from."""
    return [simulate_record(source, entry, seed) for entry in source.records if entry.role == "estimation"]


def true_responses(source: SimulatedSource, omega_rad_s: RealArray) -> ComplexArray:
    """Responses (F, 2) from the voltage, held and a sample late, to hub and tip, without dry friction."""
    rig = rig_of(source)
    added = sum(float(str(e["coefficient_Nms"])) for e in source.effects if e["name"] == "viscous_friction")
    hub = rig.hub.model_copy(update={"viscous_friction_Nms": rig.hub.viscous_friction_Nms + added})
    arm = linear_arm(rig.model_copy(update={"hub": hub}))
    dt_s = rig.sampling.dt_s
    # Modes in parallel behind a hold: every pole s becomes (exp(s dt) - 1) / s / (z - exp(s dt)).
    s, vectors = np.linalg.eig(arm.A)
    shares = (arm.C @ vectors) * np.linalg.solve(vectors, arm.B[:, :1])[:, 0]
    held = np.where(np.abs(s) < 1e-9, dt_s, np.expm1(s * dt_s) / np.where(np.abs(s) < 1e-9, 1.0, s))
    z = np.exp(1j * omega_rad_s * dt_s)
    return np.asarray((held / (z[:, None] - np.exp(s * dt_s))) @ shares.T / z[:, None])


def behind_friction(
    records: Sequence[Record], channels: Sequence[Channel]
) -> tuple[FrictionFit, tuple[BehindFriction, BehindFriction]]:
    """The friction found at the hub, and hub and tip without it; channels: of hub and tip."""
    hub, tip = channels
    at_hub, at_tip = ([r.siso(c.input, c.output) for r in records] for c in channels)
    friction = fit_friction(at_hub, hub.identification)
    models = [
        identify([friction.taken_off(record) for record in at], channel.identification).model
        for at, channel in ((at_hub, hub), (at_tip, tip))
    ]
    return friction, (
        without_friction(at_hub, friction, models[0], hub.embedding),
        other_output_without_friction(at_tip, friction, models[1], tip.embedding),
    )


def judged(ellipses: FrequencyUncertainty, true: ComplexArray) -> pd.DataFrame:
    """Row by row of frequencies: band, truth (F,) inside, error and larger semi-axis over |truth|."""
    size = np.abs(true)
    return pd.DataFrame(
        {
            "band": np.digitize(ellipses.omega_rad_s, EDGES_RAD_S),
            "inside": ellipses.contains(true),
            "error": np.abs(ellipses.centre - true) / size,
            "radius": ellipses.ellipse().semi_major / size,
        }
    )


def tell_bands(
    out: Print, name: str, found: Sequence[pd.DataFrame], rows: Sequence[str] = ("inside", "error", "radius")
) -> None:
    """Per cent in every band: shares of what is true or false, medians of what is a size; then the ratio."""
    bands = pd.concat(found).groupby("band")
    table = {row: bands[row].mean() if found[0][row].dtype == bool else bands[row].median() for row in rows}
    cells = {f"{row} %": 100 * values for row, values in table.items()}
    for row, values in (cells | {"ratio": table["radius"] / table["error"]}).items():
        out(f"  {name}  {row:<9}" + " ".join(f"{value:8.3g}" for value in values))


def run(out: Print, *, seeds: int = 40, counts: int = 16384, first: int = 0) -> None:
    config, _ = built_in_config()
    assert isinstance(config.source, SimulatedSource)
    out(f"encoder {counts} counts a turn; bands from 0.63 rad/s, half a decade each")
    for torque_Nm in FRICTIONS_NM:
        source = with_friction(config.source, torque_Nm, counts)
        to_Nm = rig_of(source).motor.torque_per_volt_Nm_V
        truth = true_responses(source, OMEGA_RAD_S).T
        by_output: dict[str, list[pd.DataFrame]] = {"hub": [], "tip": []}
        levels = []
        cpu = []
        for seed in range(first, first + seeds):
            records = estimation_records(source, seed)
            (friction, arms), spent = timed(partial(behind_friction, records, config.channels))
            cpu.append(spent)
            levels.append((friction.level * to_Nm, friction.level_std * to_Nm))
            for rows, arm, true in zip(by_output.values(), arms, truth, strict=True):
                rows.append(judged(arm.response.at(OMEGA_RAD_S), true))
        level, std = np.array(levels).T
        held = np.mean(np.abs(level - torque_Nm) <= 1.96 * std)
        off = f"error {100 * np.median(np.abs(level / torque_Nm - 1)):.2f} %, " if torque_Nm else ""
        out(
            f"\nfriction {torque_Nm:g} N m: level {off}inside its 95 % interval {100 * held:.0f} %; "
            f"CPU {np.median(cpu):.1f} s, at most {max(cpu):.1f} s"
        )
        for name, rows in by_output.items():
            tell_bands(out, name, rows)


if __name__ == "__main__":
    main(run, seeds="{seeds} from {first}")
