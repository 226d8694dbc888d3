"""P1 with its structure known (relative degree 2, integrators), and the tests that the data put to it.

    OMP_NUM_THREADS=1 python -m benchmarks.known_structure_p1 [--seeds 50]

First the models: ours with the structure tested and kept, beside ours and the peers without it and the peer
that can be told of the integrators (output error on the summed input). Then the variant with friction,
s (s + 0.3) in place of s^2 and the input held 4 samples, where a wrong second integrator loses the mode. Then
what the tests said. Measures and Cramer-Rao bounds: `benchmarks.p1_measures`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.harness import Print, main
from benchmarks.identification_p1 import PEERS, REACH_HEADER, Fit, ours, quantile, reach_line
from benchmarks.p1_measures import FRICTION, HEADER, PLAIN, Score, Variant, bounds, row, score
from ident import IdentOptions, Record, identify
from ident.basis.structure import filter_input
from tests.ident.benchmark_plants import DT_S, Truth
from validation.comparators.comparators import oe

KNOWN = "GOBF, known: rel. degree 2, {} integr."


@dataclass(frozen=True, eq=False)
class Summed:
    """A model of the summed input, as a model of the input."""

    model: Any
    integrators: int

    def frequency_response(self, omega_rad_s: np.ndarray) -> np.ndarray:
        sums = 1 / (1 - np.exp(-1j * omega_rad_s * DT_S)) ** self.integrators
        return np.asarray(self.model.frequency_response(omega_rad_s) * sums)

    def simulate(self, u: np.ndarray) -> np.ndarray:
        return np.asarray(self.model.simulate(filter_input(u, self.integrators, 0)))


def summed_oe(integrators: int) -> Fit:
    """Output error with the integrators taken out: four coefficients in B, four less the integrators in F."""

    def fit(record: Record) -> tuple[Summed, np.ndarray]:
        summed = replace(record, input=filter_input(record.input[:, 0], integrators, 0)[:, None])
        model = oe(summed, 4, 4 - integrators, arx_start=False)
        return Summed(model, integrators), model.poles

    return fit


def methods(integrators: int) -> dict[str, Fit]:
    """Ours with and without the structure, and the peers."""
    kept = ("OE 4/4 (Steiglitz-McBride start)", "ARMAX 4/4/4 (and from output error)", "ARX 4/4")
    kept += ("subspace, order 4, horizon 10", "subspace, order 4, horizon 150")
    orders = {"n_real": 2 - integrators, "n_pairs": 1}
    return {
        KNOWN.format(integrators): ours(IdentOptions(relative_degree=2, integrators=integrators)),
        "    the same, order given, too": ours(
            IdentOptions(relative_degree=2, integrators=integrators, **orders)
        ),
        "GOBF, relative degree 2 alone": ours(IdentOptions(relative_degree=2)),
        "GOBF, integrators alone": ours(IdentOptions(integrators=integrators)),
        "GOBF, nothing known": ours(IdentOptions()),
        f"OE 4/{4 - integrators} on the input summed {integrators} x": summed_oe(integrators),
        **{name: PEERS[name] for name in kept},
    }


def compared(out: Print, variant: Variant, truths: Sequence[Truth], integrators: int) -> list[Score]:
    """Table of one variant; the scores of our fit with the structure known."""
    out(f"P1, {variant.name}")
    for line in HEADER.splitlines():
        out(line)
    scores = {name: score(fit, variant, truths) for name, fit in methods(integrators).items()}
    for name, items in scores.items():
        out(row(name, items))
    if variant is FRICTION:
        wrong = ours(IdentOptions(relative_degree=2, integrators=2, n_real=0, n_pairs=1))
        out(row("GOBF, known wrongly: two integrators", score(wrong, variant, truths)))
    for bound in bounds(variant):
        for line in bound.rows():
            out(line)
    out()
    return scores[KNOWN.format(integrators)]


def refusals(variant: Variant, truths: Sequence[Truth], **settings: Any) -> dict[str, int]:
    """How many records refuse each prior of these settings."""
    counts: dict[str, int] = {}
    for truth in truths:
        for test in identify([truth.record], IdentOptions(**settings)).prior_tests:
            counts[test.prior] = counts.get(test.prior, 0) + test.refused
    return counts


def run(out: Print, *, seeds: int = 50) -> None:
    plain = [PLAIN.truth(seed) for seed in range(seeds)]
    friction = [FRICTION.truth(seed) for seed in range(seeds)]
    out("Published for the best peer, output error: 0.89 / 2.1, NRMSE 0.011. The bounds hold for unbiased")
    out("fits; one that keeps all poles inside the unit circle knows more and can lie below them.")
    out()
    best = compared(out, PLAIN, plain, 2)
    compared(out, FRICTION, friction, 1)
    out(REACH_HEADER)
    error = quantile(best, "whole", 0.5), quantile(best, "whole", 0.9)
    out(
        reach_line(
            "known: RMS relative error 0.1-600 rad/s, median / 90th",
            "0.013 / 0.025",
            f"{error[0]:.4f} / {error[1]:.4f}",
            error[0] <= 0.013 and error[1] <= 0.025,
        )
    )
    nrmse = quantile(best, "nrmse", 0.5)
    out(reach_line("known: validation NRMSE, median", "0.005", f"{nrmse:.4f}", nrmse <= 0.005))
    most = int(0.05 * seeds)
    both = {"integrators", "relative_degree"}
    orders = {"n_real": 0, "n_pairs": 1}
    trials: list[tuple[Variant, list[Truth], dict[str, int], set[str]]] = [
        (PLAIN, plain, {"integrators": 2, "relative_degree": 2}, both),
        (PLAIN, plain, {"integrators": 2, "relative_degree": 3}, {"integrators"}),
        (FRICTION, friction, {"integrators": 1, "relative_degree": 2}, both),
        (FRICTION, friction, {"integrators": 2}, set()),
        (FRICTION, friction, {"integrators": 2} | orders, set()),
    ]
    for variant, truths, settings, true in trials:
        asked = ", ".join(f"{key} {value}" for key, value in settings.items())
        out(f"{variant.name}, asked: {asked}")
        for prior, count in refusals(variant, truths, **settings).items():
            holds = prior.split()[0] in true
            out(
                reach_line(
                    f"    {prior} ({'true' if holds else 'wrong'}) refused",
                    f"<= {most}/{seeds}" if holds else f"{seeds}/{seeds}",
                    f"{count}/{seeds}",
                    count <= most if holds else count == seeds,
                )
            )


if __name__ == "__main__":
    main(run)
