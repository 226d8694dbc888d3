"""P1 (one mode at 15 rad/s, double integrator, 30 dB, N = 1000): our fit beside OE, ARMAX and ARX in one run.

    OMP_NUM_THREADS=1 python -m benchmarks.identification_p1 [--seeds 50]

Response error: RMS of |Ghat - G| / |G| over those of 400 log-spaced frequencies 0.1-600 rad/s that lie in
1-100 rad/s. NRMSE: |y - yhat| / |y - mean y| on a fresh noise-free sequence from rest. Mode found: a pole
pair, however damped, with natural frequency within a factor 2 of 15 rad/s. CPU time per fit after one
warm-up fit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident import GobfModel, IdentOptions, Record, identify
from ident.comparators import PolynomialModel, armax, arx, oe
from tests.ident.benchmark_plants import DT_S, Truth, max_length_sequence, p1, run

Model = GobfModel | PolynomialModel
GRID = np.geomspace(0.1, 600, 400)
OMEGA = GRID[(GRID >= 1) & (GRID <= 100)]
MODE_RAD_S = 15.0


def ours(record: Record) -> Model:
    return identify([record]).model


def ours_fourth_order(record: Record) -> Model:
    return identify([record], IdentOptions(n_real=2, n_pairs=1)).model


METHODS: dict[str, Callable[[Record], Model]] = {
    "GOBF, no prior, order from data": ours,
    "GOBF, no prior, 2 real + 1 pair": ours_fourth_order,
    "OE 4/4 (Steiglitz-McBride start)": lambda record: oe(record, 4, 4, arx_start=False),
    "OE 4/4 (both starts)": lambda record: oe(record, 4, 4),
    "ARMAX 4/4/4 (usual starts)": lambda record: armax(record, 4, 4, 4, output_error_start=False),
    "ARMAX 4/4/4 (+ output-error start)": lambda record: armax(record, 4, 4, 4),
    "ARX 4/4": lambda record: arx(record, 4, 4),
}


@dataclass(frozen=True)
class Score:
    """One fit of one seed."""

    response_error: float
    nrmse: float
    mode_found: bool
    cpu_s: float


def poles_of(model: Model) -> np.ndarray:
    """Upper half plane poles of either kind of model."""
    return model.poles.pairs if isinstance(model, GobfModel) else model.poles[model.poles.imag > 0]


def score(fit: Callable[[Record], Model], truth: Truth, response: np.ndarray, u: np.ndarray) -> Score:
    """Fit the record of `truth` and compare with its response and its clean output for the input u."""
    begin = time.process_time()
    model = fit(truth.record)
    cpu_s = time.process_time() - begin
    y = run(truth.system, u)
    natural = np.abs(np.log(poles_of(model))) / DT_S
    return Score(
        float(np.sqrt(np.mean(np.abs(model.frequency_response(OMEGA) / response - 1) ** 2))),
        float(np.linalg.norm(y - model.simulate(u)) / np.linalg.norm(y - y.mean())),
        bool(np.any((natural >= MODE_RAD_S / 2) & (natural <= MODE_RAD_S * 2))),
        cpu_s,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=50, help="noise seeds 0 .. SEEDS - 1")
    seeds = parser.parse_args().seeds
    truths = [p1(seed) for seed in range(seeds)]
    response, fresh = truths[0].response(OMEGA), max_length_sequence(77, 1000)
    print(f"{'':<36}  response error   validation NRMSE    mode     CPU ms")
    print(f"{'method':<36}  median    90th    median    90th    found    median")
    for name, fit in METHODS.items():
        fit(truths[0].record)
        scores = [score(fit, truth, response, fresh) for truth in truths]
        error = np.quantile([item.response_error for item in scores], [0.5, 0.9])
        nrmse = np.quantile([item.nrmse for item in scores], [0.5, 0.9])
        found = sum(item.mode_found for item in scores)
        cpu_ms = 1e3 * np.median([item.cpu_s for item in scores])
        print(
            f"{name:<36}  {error[0]:>6.3f}  {error[1]:>6.3f}    {nrmse[0]:>6.4f}  {nrmse[1]:>6.4f}   "
            f"{found:>3}/{seeds}  {cpu_ms:>8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
