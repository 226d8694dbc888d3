"""P1 (one mode at 15 rad/s, double integrator, 30 dB, N = 1000), nothing known: our fit beside its peers.

    OMP_NUM_THREADS=1 python -m benchmarks.identification_p1 [--seeds 50]

OE, ARMAX, ARX and subspace of order 4 (OE and ARMAX with more starts than is usual, too). Measures and
Cramer-Rao bounds: `benchmarks.p1_measures`. Process CPU time per fit after one warm-up fit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.harness import Print, main
from benchmarks.p1_measures import HEADER, PLAIN, Model, Score, bounds, row, score
from ident import IdentOptions, Record, identify
from validation.comparators.comparators import armax, arx, oe
from validation.comparators.subspace import moesp

Fit = Callable[[Record], tuple[Model, np.ndarray]]
OURS = "GOBF, order from data"


def ours(options: IdentOptions) -> Fit:
    """Fit of GOBF with these settings."""

    def fit(record: Record) -> tuple[Model, np.ndarray]:
        model = identify([record], options).model
        return model, model.poles.values

    return fit


def peer(method: Callable[[Record], Model]) -> Fit:
    """Fit of a method whose model has `poles`."""

    def fit(record: Record) -> tuple[Model, np.ndarray]:
        model = method(record)
        return model, model.poles  # type: ignore[attr-defined]

    return fit


PEERS: dict[str, Fit] = {
    "OE 4/4 (Steiglitz-McBride start)": peer(lambda record: oe(record, 4, 4, arx_start=False)),
    "OE 4/4 (and from ARX)": peer(lambda record: oe(record, 4, 4)),
    "ARMAX 4/4/4 (usual starts)": peer(lambda record: armax(record, 4, 4, 4, output_error_start=False)),
    "ARMAX 4/4/4 (and from output error)": peer(lambda record: armax(record, 4, 4, 4)),
    "ARX 4/4": peer(lambda record: arx(record, 4, 4)),
    "subspace, order 4, horizon 10": peer(lambda record: moesp(record, 4)),
    "subspace, order 4, horizon 150": peer(lambda record: moesp(record, 4, horizon=150)),
}


def quantile(scores: list[Score], key: str, level: float) -> float:
    return float(np.quantile([getattr(item, key) for item in scores], level))


def reach_line(what: str, reach: str, measured: str, met: bool) -> str:
    """One line of a table reach / measured."""
    return f"{what:<58} {reach:<18} {measured:<18} {'yes' if met else 'NO'}"


REACH_HEADER = f"{'what':<58} {'reach':<18} {'measured':<18} met"


def run(out: Print, *, seeds: int = 50) -> None:
    truths = [PLAIN.truth(seed) for seed in range(seeds)]
    out("P1, nothing known")
    for line in HEADER.splitlines():
        out(line)
    methods = {
        OURS: ours(IdentOptions()),
        "GOBF, 2 real + 1 pair": ours(IdentOptions(n_real=2, n_pairs=1)),
    }
    scores = {}
    for name, fit in (methods | PEERS).items():
        scores[name] = score(fit, PLAIN, truths)
        out(row(name, scores[name]))
    for line in bounds(PLAIN)[0].rows():
        out(line)
    out()
    out(REACH_HEADER)
    best = scores[OURS]
    found = sum(item.mode_found for item in best)
    out(reach_line("mode found", f"{seeds}/{seeds}", f"{found}/{seeds}", found == seeds))
    error = quantile(best, "middle", 0.5), quantile(best, "middle", 0.9)
    out(
        reach_line(
            "RMS relative error 1-100 rad/s, median / 90th",
            "0.042 / 0.09",
            f"{error[0]:.3f} / {error[1]:.3f}",
            error[0] <= 0.042 and error[1] <= 0.09,
        )
    )
    nrmse = quantile(best, "nrmse", 0.5)
    out(reach_line("validation NRMSE, median", "0.006", f"{nrmse:.4f}", nrmse <= 0.006))
    out()
    out("Published for the best peer, output error: 0.049 / 0.120, NRMSE 0.011; ARX, ARMAX and subspace")
    usual = ("ARX 4/4", "ARMAX 4/4/4 (usual starts)", "subspace, order 4, horizon 10")
    counts = ", ".join(str(sum(item.mode_found for item in scores[name])) for name in usual)
    out(f"at usual settings: no mode. Mode found here by ARX, ARMAX, subspace: {counts} of {seeds}.")


if __name__ == "__main__":
    main(run)
