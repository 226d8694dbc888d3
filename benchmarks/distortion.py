"""Noise and nonlinear distortion told from records of a plan: do they have the right size?

The default arm with dry friction of several levels, its encoder and its sensor noise, under a plan of 4
realisations x 2 periods of 50 s at each amplitude (seed k: other phases, lines and noise). 3 and 6 V rms stay
within the amplifier's 24 V; 8 V rms is cut off now and then, and such rare events differ more between few
realisations than any spectrum shows. Truth: simulations without noise and encoder of `truth` other
realisations on the lines of seed 0; their scatter around their mean response is the distortion. Bands of half
a decade from 0.63 rad/s.
Found: median over seeds of distortion over gain, truth above it; noise: median of what the analysis finds in
a mean of 2 periods. Within 2 dB: share of seeds; measurable: bands whose true distortion is no less than half
of their noise, over which the shares of the last line are counted. Held: 95 % interval holds the truth. Even:
share of bands and seeds with significant even distortion, of which friction makes none (level 2.5 %).
"""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np

from benchmarks.harness import Print, main, timed
from benchmarks.without_friction import EDGES_RAD_S, FRICTIONS_NM, with_friction
from ident.data.arrays import RealArray
from ident.data.distortion import BandLevel, Distortion, LineLevels, distortion_of
from ident.data.record import Record
from plant import ExperimentPlan, parse_effects
from plant.simulation import Simulator, quantised
from workflow.config.run_config import SimulatedSource, built_in_config
from workflow.tasks.simulated_rig import INPUT_NAME, OUTPUT_NAMES, rig_of

BANDS = tuple(itertools.pairwise(EDGES_RAD_S.tolist()))
_WITHIN = 10 ** (2 / 20)


def plan_of(rms_V: tuple[float, ...], seed: int, realisations: int = 4, periods: int = 2) -> ExperimentPlan:
    return ExperimentPlan(
        rms_V=rms_V,
        realisations=realisations,
        periods=periods,
        period_samples=10_000,
        lead_in_samples=400,
        from_Hz=0.1,
        to_Hz=99.0,
        phase_draws=10,
        lines_seed=seed,
    )


def records_of(
    source: SimulatedSource, arm: Simulator, plan: ExperimentPlan, rng: np.random.Generator, noisy: bool
) -> list[Record]:
    made = []
    for k, voltage in enumerate(plan.records(arm.dt_s, rng).reshape(-1, plan.n_samples)):
        motion = arm.run(voltage, rng=rng if noisy else None)
        output = quantised(motion.output, source.encoder_step_rad if noisy else 0.0)
        made.append(Record(f"r{k}", voltage[:, None], output, arm.dt_s, (INPUT_NAME,), OUTPUT_NAMES))
    return made


def levels(found: Distortion, of: str) -> list[BandLevel | None]:
    lines: LineLevels = getattr(found, of)
    return [lines.within(*band) for band in BANDS]


def run(
    out: Print, *, seeds: int = 40, truth: int = 200, first: int = 0, rms: tuple[float, ...] = (3.0, 6.0)
) -> None:
    source = built_in_config()[0].source
    assert isinstance(source, SimulatedSource)
    counts = round(2 * np.pi / source.encoder_step_rad)
    reach, cpu = np.zeros((0, 2)), []
    for torque_Nm in FRICTIONS_NM:
        rubbing = with_friction(source, torque_Nm, counts)
        arm = Simulator(rig_of(rubbing), parse_effects(rubbing.effects))
        exact = records_of(rubbing, arm, plan_of(rms, 0, truth, 1), np.random.default_rng(10**6), noisy=False)
        found: list[list[tuple[Distortion, ...]]] = [[], []]
        for k in range(first, first + seeds):
            records = records_of(rubbing, arm, plan_of(rms, k), np.random.default_rng(k), noisy=True)
            for j, name in enumerate(OUTPUT_NAMES):
                result, spent = timed(partial(distortion_of, [r.siso(None, name) for r in records]))
                found[j].append(result)
                cpu.append(spent)
        out(f"\nfriction {torque_Nm:g} N m")
        for j, name in enumerate(OUTPUT_NAMES):
            # One period behind the lead-in: the steady state is stated, not found.
            true = distortion_of([r.siso(None, name) for r in exact], period_samples=10_000)
            for a, rms_V in enumerate(rms):
                size = np.array([b.distortion for b in levels(true[a], "excited") if b is not None])
                mine = [levels(seed[a], "excited") for seed in found[j]]
                value = np.array([[b.distortion for b in bands if b is not None] for bands in mine])
                noise = np.array([[b.noise for b in bands if b is not None] for bands in mine])
                ends = np.array([[b.interval for b in bands if b is not None] for bands in mine])
                held = (ends[..., 0] <= size) & (size <= ends[..., 1])
                near = (value <= _WITHIN * size) & (value >= size / _WITHIN)
                measurable = size >= 0.5 * np.median(noise, axis=0)
                reach = np.vstack([reach, *np.stack([near, held], -1)[:, measurable]])
                even = [b.significant for seed in found[j] for b in levels(seed[a], "even") if b is not None]
                out(f"  {name}, {rms_V:g} V rms; even significant {100 * np.mean(even):.1f} %")
                rows: dict[str, RealArray] = {
                    "true %": 100 * size,
                    "found %": 100 * np.median(value, axis=0),
                    "noise %": 100 * np.median(noise, axis=0),
                    "within 2 dB": 100 * near.mean(axis=0),
                    "held %": 100 * held.mean(axis=0),
                    "measurable": measurable,
                }
                for row, values in rows.items():
                    out(f"    {row:<12}" + " ".join(f"{v:9.3g}" for v in values))
    out(
        f"\nmeasurable (band, seed): {len(reach)}; within 2 dB {100 * reach[:, 0].mean():.1f} %, "
        f"interval holds the truth {100 * reach[:, 1].mean():.1f} %; CPU {np.median(cpu):.2f} s a channel"
    )


if __name__ == "__main__":
    main(run, seeds="{seeds} from {first}, truth 1000000")
