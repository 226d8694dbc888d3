"""Friction that is mostly at the load: is its level inside its interval, whatever the noise?

    python -m benchmarks.friction_at_the_load [--seeds N] [--kind wheel] [--machine SEED]

One machine of `benchmarks.closed_loop_machines` (two inertias on a spring, four fifths of the friction beyond
it for wheel 2), whose first log is recorded with fresh sensor noise and a fresh reference for each seed. A
line a seed: CPU seconds of the fit, level and its standard deviation beside the true Coulomb friction of both
inertias, dead time, first mode. Held: the level within two standard deviations.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.closed_loop_machines.logs import machine
from benchmarks.harness import Print, main
from ident.basis.options import IdentOptions
from ident.data.record import Record
from ident.friction import fit_friction


def run(out: Print, *, seeds: int = 5, first: int = 0, kind: str = "wheel", machine_seed: int = 2) -> None:
    """A line a seed of the noise."""
    made = machine(kind, machine_seed)
    true = float(made.plant.friction[:, 0].sum() / made.plant.torque_per_u)
    held = 0
    for seed in range(first, first + seeds):
        signals, begin = made.record(0, np.random.default_rng([seed, 85]))
        record = Record(
            signals["u"][begin:, None],
            signals["y"][begin:, None],
            made.plant.dt_s,
            name="log",
            reference=signals["r"][begin:, None],
        )
        begun = time.process_time()
        fit = fit_friction([record], IdentOptions())
        seconds = time.process_time() - begun
        inside = abs(fit.level - true) <= 2 * fit.level_std
        held += int(inside)
        modes_Hz = np.sort(fit.model.poles.omega_rad_s(fit.model.dt_s)) / (2 * np.pi)
        delay = fit.arm.structure.input_delay_samples
        out(
            f"{kind} {machine_seed}, noise {seed}: {seconds:.1f} s, level {fit.level:.5g} ± "
            f"{fit.level_std:.2g} (true {true:.5g}; {'held' if inside else 'NOT HELD'}), at the load "
            f"{fit.beyond / fit.level:.2f}, delay {delay} (true {made.plant.delay}), "
            f"modes {np.round(modes_Hz, 2).tolist()} Hz"
        )
    out(f"{held} of {seeds} held")


if __name__ == "__main__":
    main(run, seeds="{seeds} from {first}")
