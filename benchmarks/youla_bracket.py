"""What any controller could reach on the flexible link with ellipses, beside the published bracket.

    OMP_NUM_THREADS=1 python -m benchmarks.youla_bracket [--scenarios A B C] [--fine]

--fine adds a row with a larger basis and grid: how far the default ones are from their limits. No random
numbers.
"""

from __future__ import annotations

from functools import partial

from benchmarks.harness import Print, main, timed
from control_design.convex.youla import BracketProblem, YoulaOptions, youla_bracket
from validation.example_plants import Scenario, flexible_link, flexible_link_specification

PUBLISHED = {"A": (0.912, 0.931, 0.945), "B": (0.916, 1.065, 1.205), "C": (0.916, 1.268, 1.705)}
OURS_BY_ORDER = {
    "A": (0.9369, 0.9308),
    "B": (1.0850, 1.0818),
    "C": (1.3346, 1.2872),
}  # benchmarks.ellipse_link


def run(out: Print, *, scenarios: tuple[Scenario, ...] = ("A", "B", "C"), fine: bool = False) -> None:
    settings = {"default": YoulaOptions(), "hull": YoulaOptions(hull=True)}
    if fine:
        settings["fine"] = YoulaOptions(
            real_poles=50, pairs_per_mode=20, grid_points=400, mode_points=250, dense_points=20_000
        )
    out("Worst case of max(|W1 S|, |W3 K S|): none below 'inscribed', the others are reached.")
    out("reach = published (smaller basis, larger values); excess = our order 5 / 6 over 'ellipse'.")
    out("hull bound = lower bound from convex hulls at every frequency, tighter than the inscribed discs.")
    out(
        "scenario  basis    functions  inscribed (reach)  ellipse (reach)  enclosing (reach)"
        "  hull bound  excess 5 / 6 %  CPU s"
    )
    for scenario in scenarios:
        plant, specification = flexible_link(scenario), flexible_link_specification(5)
        for name, options in settings.items():
            bracket, spent = timed(partial(youla_bracket, plant, specification, options))
            one = bracket.plants[0]
            values = (bracket.inscribed, bracket.ellipse, bracket.enclosing)
            cells = "  ".join(
                f"{value:>9.4f} ({reach:.3f})"
                for value, reach in zip(values, PUBLISHED[scenario], strict=True)
            )
            excess = [100 * bracket.excess(gamma) for gamma in OURS_BY_ORDER[scenario]]
            out(
                f"{scenario:>8}  {name:<7}  {one.functions:>9}  {cells}  "
                f"{'-' if one.hull is None else format(one.hull, '.4f'):>10}"
                f"  {excess[0]:>8.1f} / {excess[1]:.1f}  {spent:>7.1f}"
            )
    if fine:
        out()
        out("The ellipse problem is not convex: its value from five starts between the discs' answers.")
        for scenario in scenarios:
            problem = BracketProblem(flexible_link(scenario), flexible_link_specification(5), YoulaOptions())
            outer, inner = (problem.exchanged(region, None)[2] for region in ("enclosing", "inscribed"))
            starts = ((1 - f) * outer + f * inner for f in (0.0, 0.25, 0.5, 0.75, 1.0))
            values = [problem.exchanged("ellipse", start)[0] for start in starts]
            out(f"{scenario:>8}  " + "  ".join(f"{value:.4f}" for value in values))


if __name__ == "__main__":
    main(run)
