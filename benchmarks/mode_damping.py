"""What damping of the flexible mode costs: the published link at order 6 with W4, a weight on G S.

    OMP_NUM_THREADS=1 python -m benchmarks.mode_damping [--part exact A B] [--ratios ...] [--no-write]

W1 and W3 as published, W4 = 1/(r max|G|) on G S within a factor 1.5 of the mode; r runs. Cost: largest
max(|W1 S|, |W3 K S|), without ellipses and as the worst case over the ellipses of scenarios A and B (from the
certificate's refined grid). Damping: of the nominal closed loop's pole nearest 15 rad/s, and, stricter, the
least of all its poles between 10 and 22.5 rad/s (a controller could put a second, badly damped pole beside
the mode). Loop and poles are evaluated here with python-control, not by the optimiser.

Reference: full-order `hinfsyn` with the same plant and weights, as published: it is not run here, because
it needs slycot, which pip does not install without a Fortran compiler.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import control
import numpy as np

from benchmarks.results_file import RESULTS, ResultsFile
from control_design import Controller, Specification, SynthesisOptions, UncertainPlant, certify, synthesise
from control_design.example_plants import flexible_link, flexible_link_specification

ORDER = 6
PUBLISHED = ((0.015, 0.965), (0.028, 1.137), (0.050, 1.40))  # damping, max(|W1 S|, |W3 K S|)
RATIOS: tuple[float | None, ...] = (None, 0.9, 0.7, 0.5, 0.3, 0.15)
NAMES = {"exact": "no ellipses", "A": "ellipses A", "B": "ellipses B"}
OPTIONS = SynthesisOptions(starts=4)
BAND = (10.0, 22.5)


@dataclass(frozen=True)
class Point:
    """One design: r (None: no W4), cost, damping nearest 15 rad/s, least damping in the band, W4 value."""

    ratio: float | None
    cost: float
    nearest: float
    least: float
    damping_weight: float
    stable: bool


def damping(controller: Controller, plant: UncertainPlant) -> tuple[float, float, bool]:
    """(nearest 15 rad/s, least in the band, stable) of the nominal closed loop, by python-control."""
    loop = control.feedback(plant.nominal, controller.to_control(include_delay=True))
    z = np.asarray(control.ss(loop).poles(), dtype=complex)
    upper = z[np.imag(z) > 1e-9]
    s = np.log(upper) / plant.dt_s
    zeta = -np.real(s) / np.abs(s)
    nearest = float(zeta[np.argmin(np.abs(s - 15j))])
    inside = (np.abs(s) >= BAND[0]) & (np.abs(s) <= BAND[1])
    return nearest, float(np.min(zeta[inside], initial=np.inf)), bool(np.max(np.abs(z)) < 1)


def nominal_cost(controller: Controller, plant: UncertainPlant, specification: Specification) -> float:
    """max(|W1 S|, |W3 K S|) of the nominal loop on 40 000 frequencies, dense around the mode."""
    wide = np.geomspace(1e-4, plant.nyquist_rad_s * (1 - 1e-9), 30_000)
    omega = np.unique(np.concatenate([wide, 15 + 0.01 * np.sinh(np.linspace(-7, 7, 10_001))]))
    omega = omega[(omega > 0) & (omega <= wide[-1])]
    k = np.asarray(control.frequency_response(controller.to_control(include_delay=True), omega).complex)
    g = np.asarray(control.frequency_response(plant.nominal, omega).complex)
    sensitivity = 1 / np.abs(1 + g.reshape(-1) * k.reshape(-1))
    w1 = specification.sensitivity_magnitude(omega, plant.dt_s)
    w3 = specification.effort_magnitude(omega, plant.dt_s)
    return float(np.max(np.maximum(w1, w3 * np.abs(k.reshape(-1))) * sensitivity))


def design(part: str, ratio: float | None, seed: int) -> Point:
    """Synthesise and measure one point."""
    plant = flexible_link("A" if part == "exact" else part)
    if part == "exact":
        plant = UncertainPlant("link without ellipses", plant.nominal)
    specification = flexible_link_specification(ORDER).model_copy(update={"mode_peak_ratio": ratio})
    result = synthesise([plant], specification, OPTIONS, rng=np.random.default_rng(seed))
    certificate = certify(result.controller, [plant], specification)
    if part == "exact":
        cost = nominal_cost(result.controller, plant, specification)
    else:
        undamped = specification.model_copy(update={"mode_peak_ratio": None})
        cost = certify(result.controller, [plant], undamped).gamma
    nearest, least, stable = damping(result.controller, plant)
    verdict = certificate.plants[0]
    return Point(
        ratio, cost, nearest, least, certificate.gamma, stable and verdict.stable and verdict.nyquist.matches
    )


def draw(curves: dict[str, list[Point]]) -> None:
    """Cost over damping as benchmarks/results/mode_damping.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.6), layout="constrained")
    axes.plot(
        *zip(*PUBLISHED, strict=True),
        "ks--",
        label="full-order hinfsyn, no ellipses (published, nearest pole)",
    )
    for (part, points), colour in zip(curves.items(), ("C0", "C1", "C2"), strict=False):
        best = pareto(points)
        axes.plot(
            [p.least for p in best],
            [p.cost for p in best],
            "o-",
            color=colour,
            label=f"order 6, {NAMES[part]}",
        )
    axes.axvline(0.015, color="0.6", linewidth=0.8)
    axes.text(0.0153, axes.get_ylim()[1], "open loop", fontsize=8, color="0.4", va="top", rotation=90)
    axes.set_xscale("log")
    axes.set_xlabel("least damping ratio of closed-loop poles, 10 to 22.5 rad/s [-]")
    axes.set_ylabel("largest max(|W1 S|, |W3 K S|) [-]")
    axes.set_title("Flexible link: what damping of the mode costs")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(RESULTS / "mode_damping.png", dpi=110)
    plt.close(figure)


def pareto(points: list[Point]) -> list[Point]:
    """Points that no other one beats in both cost and least damping, by damping."""
    kept = [p for p in points if not any(q.cost < p.cost and q.least > p.least for q in points)]
    return sorted(kept, key=lambda p: p.least)


def main() -> None:
    """Run the parts asked for, print, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", nargs="+", choices=list(NAMES), default=list(NAMES))
    parser.add_argument("--ratios", type=float, nargs="+", default=None)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-write", action="store_true")
    arguments = parser.parse_args()
    ratios = RATIOS if arguments.ratios is None else (None, *arguments.ratios)
    curves: dict[str, list[Point]] = {}
    with ResultsFile("mode_damping", seeds=str(arguments.seed), write=not arguments.no_write) as out:
        out("cost = largest max(|W1 S|, |W3 K S|) (over the ellipses); gamma = with |W4 G S| as well")
        out("part   r     cost    gamma   damping nearest 15 rad/s  least in 10..22.5 rad/s  stable")
        for part in arguments.part:
            curves[part] = []
            for ratio in ratios:
                point = design(part, ratio, arguments.seed)
                curves[part].append(point)
                name = "none" if ratio is None else f"{ratio:.2f}"
                out(
                    f"{part:5s}  {name:4s}  {point.cost:6.4f}  {point.damping_weight:6.4f}  "
                    f"{point.nearest:24.4f}  {point.least:23.4f}  {point.stable!s:>6}"
                )
        if "exact" in curves:
            out()
            out("no ellipses, against full-order hinfsyn:")
            out("damping  hinfsyn cost (reach)  our least cost with that damping or more (measured)  reached")
            for wanted, reach in PUBLISHED:
                costs = [p.cost for p in curves["exact"] if p.stable and min(p.least, p.nearest) >= wanted]
                cost = min(costs, default=np.inf)
                out(f"{wanted:7.3f}  {reach:20.3f}  {cost:52.4f}  {cost <= reach!s:>7}")
    if not arguments.no_write:
        draw(curves)


if __name__ == "__main__":
    main()
