"""P3 (three and five modes beside 1/(s^2 + 0.3 s), N = 2000): global optima, and the time of a whole fit.

Global optimum: mean square residual within 2 % of the variance of the noise. Once with the numbers of poles
given, once chosen from the data; then also the numbers of pairs that were chosen (at 30 dB the highest modes
are below the noise). Validation: |y - yhat|/|y - mean y| on a fresh noise-free sequence (seed 77) from rest.
CPU time after a warm-up fit.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.harness import Print, main, timed
from ident import IdentOptions, identify
from tests.ident.benchmark_plants import P3_MODES, max_length_sequence, p3, run as simulated


def run(out: Print, *, seeds: int = 8) -> None:
    fresh = max_length_sequence(77, 2000)
    for title, given in (("numbers of poles given", True), ("order from data", False)):
        out(f"{title:<24}  residual/noise  global   validation    CPU ms")
        out(f"{'modes, SNR':<24}  largest         optima   median    median    most   pairs")
        out(f"{'reach':<24}  <= 1.02         all                         100")
        total = 0
        for n_modes in P3_MODES:
            options = IdentOptions(n_real=2, n_pairs=n_modes) if given else IdentOptions()
            for snr_db in (30, 50):
                truths = [p3(n_modes, seed, snr_db) for seed in range(seeds)]
                identify([truths[0].record], options)
                ratios, errors, cpu, pairs = [], [], [], []
                y = simulated(truths[0].system, fresh)
                for truth in truths:
                    result, seconds = timed(partial(identify, [truth.record], options))
                    cpu.append(1e3 * seconds)
                    ratios.append(result.rss / (truth.clean.size * truth.noise_std**2))
                    error = y - result.model.simulate(fresh)
                    errors.append(float(np.linalg.norm(error) / np.linalg.norm(y - y.mean())))
                    pairs.append(result.model.poles.pairs.size)
                hits = int(np.sum(np.array(ratios) <= 1.02))
                total += hits
                name = f"{n_modes} modes, {snr_db} dB"
                out(
                    f"{name:<24}  {max(ratios):>7.4f}         {hits}/{seeds}    "
                    f"{np.median(errors):>8.5f}  {np.median(cpu):>6.1f}  {max(cpu):>6.1f}   "
                    f"{min(pairs)}-{max(pairs)}"
                )
        out(f"{'all':<24}                  {total}/{4 * seeds}")
        out()


if __name__ == "__main__":
    main(run)
