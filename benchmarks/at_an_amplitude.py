"""Ellipses that promise the response at an amplitude: do they hold it?

The default arm's hub and tip with dry friction of several levels. Records: random-phase multisines of odd
lines without a random quarter, 0.2 to 95 Hz, a period of 5 s recorded twice from rest, two realisations at
2 V rms and two at 6 V. Truth: best linear approximation, the mean over fresh realisations of the same lines
in steady state, without noise. What their number leaves open (row "truth", a standard error) is added to the
ellipses' covariance; "alone": without. It is the same for all seeds, so in a band of few lines (three from
6.3 to 20 rad/s) it moves the shares of all of them at once. The amplitude is the records' pooled rms, 4.47 V.
Bands of half a decade from 0.63 rad/s, at the excited lines; error, radius and ratio as in
`benchmarks.without_friction`.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pandas as pd

from benchmarks.harness import Print, main
from benchmarks.without_friction import behind_friction, judged, tell_bands, with_friction
from ident import Record
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import ComplexArray, RealArray
from ident.friction import at_amplitude, equivalent_friction
from plant import parse_effects, simulate
from plant.excitation import multisine, multisine_lines
from plant.simulation import quantised
from workflow.config.run_config import SimulatedSource, built_in_config
from workflow.tasks.simulated_rig import OUTPUT_NAMES, rig_of

PERIOD, DT_S, PHASE_DRAWS = 1000, 0.005, 20
RECORDED_V = (2.0, 2.0, 6.0, 6.0)
POOLED_V = float(np.sqrt(np.mean(np.square(RECORDED_V))))
LINES = multisine_lines(PERIOD, DT_S, (0.2, 95.0), "odd_random", np.random.default_rng(99))
OMEGA_RAD_S = 2 * np.pi * LINES / (PERIOD * DT_S)


def voltage(rms_V: float, rng: np.random.Generator) -> RealArray:
    return multisine(LINES, PERIOD, rms_V, rng, periods=2, draws=PHASE_DRAWS)


def truth(source: SimulatedSource, rms_V: float, realisations: int) -> tuple[ComplexArray, RealArray]:
    """Best linear approximation (2, F) and its standard error."""
    rig, effects = rig_of(source), parse_effects(source.effects)
    rng = np.random.default_rng([7, round(1000 * rms_V)])
    ratios = np.empty((realisations, 2, LINES.size), dtype=np.complex128)
    for ratio in ratios:
        u = voltage(rms_V, rng)
        # The hub turns on by a constant in every period: differences are periodic.
        moved = np.fft.rfft(np.diff(simulate(rig, u, effects).output, axis=0)[-PERIOD:], axis=0)[LINES]
        ratio[:] = moved.T / np.fft.rfft(u[-PERIOD:])[LINES] / (1 - np.exp(-1j * OMEGA_RAD_S * DT_S))
    return ratios.mean(axis=0), ratios.std(axis=0) / np.sqrt(realisations)


def recorded(source: SimulatedSource, seed: int) -> list[Record]:
    rig, effects = rig_of(source), parse_effects(source.effects)
    rng, records = np.random.default_rng([8, seed]), []
    for k, rms_V in enumerate(RECORDED_V):
        u = voltage(rms_V, rng)
        y = quantised(simulate(rig, u, effects, rng=rng).output, source.encoder_step_rad)
        records.append(Record(f"record {k}", u[:, None], y, DT_S, ("voltage_V",), OUTPUT_NAMES))
    return records


def judged_beside(posterior: ResponsePosterior, true: ComplexArray, error: RealArray) -> pd.DataFrame:
    """As `judged`, with the standard error (F,) of the truth in the ellipses; alone: inside without it."""
    ellipses = posterior.at(OMEGA_RAD_S)
    covariance = ellipses.covariance + 0.5 * error[:, None, None] ** 2 * np.eye(2)
    found = judged(ellipses, true).assign(alone=ellipses.contains(true), truth=error / np.abs(true))
    return found.assign(inside=replace(ellipses, covariance=covariance).contains(true))


def run(
    out: Print,
    *,
    seeds: int = 40,
    counts: int = 16384,
    frictions: tuple[float, ...] = (0.005, 0.02, 0.1),
    realisations: int = 2000,
) -> None:
    config, _ = built_in_config()
    out(f"encoder {counts} counts a turn; bands from 0.63 rad/s, half a decade each")
    for torque_Nm in frictions:
        assert isinstance(config.source, SimulatedSource)
        source = with_friction(config.source, torque_Nm, counts)
        centre, error = truth(source, POOLED_V, realisations)
        found: dict[str, list[pd.DataFrame]] = defaultdict(list)
        cpu = []
        for seed in range(seeds):
            records = recorded(source, seed)
            begin = time.process_time()
            at_hub = [record.siso(config.channels[0].input, config.channels[0].output) for record in records]
            friction, arms = behind_friction(records, config.channels)
            rng = np.random.default_rng(seed)
            equivalent = equivalent_friction(friction, at_hub, rng)
            for k, arm in enumerate(arms):
                posterior, _ = at_amplitude(arm, equivalent, rng)
                found[("hub", "tip")[k]].append(judged_beside(posterior, centre[k], error[k]))
            cpu.append(time.process_time() - begin)
        out(f"\nfriction {torque_Nm:g} N m; CPU {np.median(cpu):.1f} s, at most {max(cpu):.1f} s")
        for arm, rows in found.items():
            tell_bands(out, arm, rows, ("inside", "alone", "error", "radius", "truth"))


if __name__ == "__main__":
    main(run)
