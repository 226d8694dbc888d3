"""Ellipses that promise the response without dry friction, on the default arm: do they hold it?

    OMP_NUM_THREADS=1 python -m benchmarks.without_friction [--seeds 40] [--counts 16384] [--first 0]

Records, sensor noise, encoder and settings of `workflow/data/default_arm.toml` with dry friction of several
levels. Truth: the linear arm (stated viscous friction added), voltage held between samples, delayed by one.
Inside: share of (seed, frequency) with the true response inside its 95 % ellipse, frequencies 30 a decade.
Error: median over seeds and frequencies of |centre - truth| over |truth|; radius: the same of the ellipse's
larger semi-axis; ratio: radius over error. Level: median of |level - truth| over truth and the share of seeds
whose 95 % interval holds the true level. CPU: friction and both channels' poles and ellipses.
"""

from __future__ import annotations

import itertools
import time

import numpy as np

from benchmarks.harness import Print, main
from ident import Record, identify
from ident.data.arrays import ComplexArray, RealArray
from ident.friction import fit_friction, other_output_without_friction, without_friction
from plant.modal import linear_arm
from workflow.config.run_config import SimulatedSource, built_in_config
from workflow.tasks.simulated_rig import rig_of, simulate_record

FRICTIONS_NM = (0.0, 0.005, 0.02, 0.1)
EDGES_RAD_S = 0.63 * 10 ** (0.5 * np.arange(7))
OMEGA_RAD_S = np.geomspace(0.63, 627.0, 91)
BANDS = [(low <= OMEGA_RAD_S) & (high > OMEGA_RAD_S) for low, high in itertools.pairwise(EDGES_RAD_S)]


def with_friction(source: SimulatedSource, torque_Nm: float, counts: int) -> SimulatedSource:
    """The arm with dry friction of this size and an encoder of so many counts a turn."""
    kept = tuple(effect for effect in source.effects if effect["name"] != "coulomb_friction")
    friction = ({"name": "coulomb_friction", "torque_Nm": torque_Nm},) if torque_Nm else ()
    return source.model_copy(
        update={"effects": (*friction, *kept), "encoder_step_rad": 2 * np.pi / counts if counts else 0.0}
    )


def estimation_records(source: SimulatedSource, seed: int) -> list[Record]:
    """Of all its experiments that are to be identified from."""
    return [simulate_record(source, entry, seed) for entry in source.records if entry.role == "estimation"]


def true_responses(source: SimulatedSource, omega_rad_s: RealArray) -> ComplexArray:
    """Responses (F, 2) from the voltage, held and a sample late, to hub and tip, without dry friction."""
    rig = rig_of(source)
    added = sum(float(str(e["coefficient_Nms"])) for e in source.effects if e["name"] == "viscous_friction")
    hub = rig.hub.model_copy(update={"viscous_friction_Nms": rig.hub.viscous_friction_Nms + added})
    arm, dt_s = linear_arm(rig.model_copy(update={"hub": hub})), rig.sampling.dt_s
    # Modes in parallel behind a hold: every pole s becomes (exp(s dt) - 1) / s / (z - exp(s dt)).
    s, vectors = np.linalg.eig(arm.A)
    shares = (arm.C @ vectors) * np.linalg.solve(vectors, arm.B[:, :1])[:, 0]
    held = np.where(np.abs(s) < 1e-9, dt_s, np.expm1(s * dt_s) / np.where(np.abs(s) < 1e-9, 1.0, s))
    z = np.exp(1j * omega_rad_s * dt_s)
    return np.asarray((held / (z[:, None] - np.exp(s * dt_s))) @ shares.T / z[:, None])


def per_band(values: RealArray) -> list[float]:
    """Median over the bands of half a decade of values (seeds, F)."""
    return [float(np.median(values[:, band])) for band in BANDS]


def run(out: Print, *, seeds: int = 40, counts: int = 16384, first: int = 0) -> None:
    config, _ = built_in_config()
    hub, tip = config.channels
    assert isinstance(config.source, SimulatedSource)
    out(f"encoder {counts} counts a turn; bands from 0.63 rad/s, half a decade each")
    for torque_Nm in FRICTIONS_NM:
        source = with_friction(config.source, torque_Nm, counts)
        motor = rig_of(source).motor
        truth = true_responses(source, OMEGA_RAD_S).T
        found = np.zeros((3, seeds, 2, OMEGA_RAD_S.size))
        levels, cpu = [], []
        for k in range(seeds):
            records = estimation_records(source, first + k)
            begin = time.process_time()
            at_hub, at_tip = ([r.siso(c.input, c.output) for r in records] for c in (hub, tip))
            friction = fit_friction(at_hub, hub.identification)
            models = [
                identify([friction.taken_off(record) for record in at], channel.identification).model
                for at, channel in ((at_hub, hub), (at_tip, tip))
            ]
            posteriors = (
                without_friction(at_hub, friction, models[0], hub.embedding).response,
                other_output_without_friction(at_tip, friction, models[1], tip.embedding).response,
            )
            cpu.append(time.process_time() - begin)
            to_Nm = motor.torque_per_volt_Nm_V
            levels.append((friction.level * to_Nm, friction.level_std * to_Nm))
            for j, posterior in enumerate(posteriors):
                ellipses = posterior.at(OMEGA_RAD_S)
                size = np.abs(truth[j])
                found[0, k, j] = ellipses.contains(truth[j])
                found[1, k, j] = np.abs(ellipses.centre - truth[j]) / size
                found[2, k, j] = ellipses.ellipse().semi_major / size
        level, std = np.array(levels).T
        held = np.mean(np.abs(level - torque_Nm) <= 1.96 * std)
        off = f"error {100 * np.median(np.abs(level / torque_Nm - 1)):.2f} %, " if torque_Nm else ""
        out(
            f"\nfriction {torque_Nm:g} N m: level {off}inside its 95 % interval {100 * held:.0f} %; "
            f"CPU {np.median(cpu):.1f} s, at most {max(cpu):.1f} s"
        )
        for j, name in enumerate(("hub", "tip")):
            inside, error, radius = found[:, :, j]
            rows = {
                "inside %": [100 * float(np.mean(inside[:, band])) for band in BANDS],
                "error %": [100 * value for value in per_band(error)],
                "radius %": [100 * value for value in per_band(radius)],
                "ratio": [r / e for r, e in zip(per_band(radius), per_band(error), strict=True)],
            }
            for row, values in rows.items():
                out(f"  {name}  {row:<9}" + " ".join(f"{value:8.3g}" for value in values))


if __name__ == "__main__":
    main(run, seeds="{seeds} from {first}")
