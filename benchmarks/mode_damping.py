"""What damping of the flexible mode costs: the published link at order 6 with W4, a weight on G S.

W1 and W3 as published, W4 = 1/(r max|G|) on G S within a factor 1.5 of the mode; r runs. Cost: largest
max(|W1 S|, |W3 K S|), without ellipses and as the worst case over the ellipses of scenarios A and B (from the
certificate's refined grid). Damping: of the nominal closed loop's pole nearest 15 rad/s, and, stricter, the
least of all its poles between 10 and 22.5 rad/s (a controller could put a second, badly damped pole beside
the mode). Loop and poles are evaluated here with python-control, not by the optimiser.

"damped" parts ask in addition for a damping ratio of at least 0.3 of the controller's own poles. Over wide
ellipses W4 alone is met more cheaply with a lightly damped pole pair of the controller beside the mode, which
then rings in its stead: |G S| is small, a pole in the band is not damped. Youla: values with W4 of
`youla_bracket`, none below the first, the second reached by some controller of any order (W4 enters it by the
largest |G| of the ellipse, on the safe side, so fixed orders may lie below it).

Reference: full-order `hinfsyn` with the same plant and weights, as published: it is not run here, because
it needs slycot, which pip does not install without a Fortran compiler.
"""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pandas as pd

from benchmarks.harness import Print, main, reading
from control_design import (
    Controller,
    LoopFunction,
    Specification,
    SynthesisOptions,
    UncertainPlant,
    certify,
    synthesise,
    youla_bracket,
)
from validation.example_plants import flexible_link, flexible_link_specification

ORDER = 6
PUBLISHED = ((0.015, 0.965), (0.028, 1.137), (0.050, 1.40))  # damping, max(|W1 S|, |W3 K S|)
RATIOS = (0.9, 0.7, 0.5, 0.3, 0.15)
NAMES = {
    "exact": "no ellipses",
    "A": "ellipses A",
    "B": "ellipses B",
    "A-damped": "ellipses A, controller damped",
    "B-damped": "ellipses B, controller damped",
}
CONTROLLER_DAMPING = 0.3
OPTIONS = SynthesisOptions(starts=2)
BAND = (10.0, 22.5)


# One design as a line; r "none": no W4.
LINE = (
    "{part:9s}  {r:4s}  {cost:6.4f}  {gamma:6.4f}  {nearest:7.4f}  {least:6.4f}  {where:8.2f}  "
    "{own:10.4f}  {floor:10.4f}  {reachable:9.4f}  {stable!s:>6}"
)


def damping(controller: Controller, plant: UncertainPlant) -> tuple[float, float, float, bool]:
    """(nearest 15 rad/s, least in the band, its frequency, stable) of the nominal closed loop, by
    python-control."""
    loop = control.feedback(plant.nominal, controller.to_control(include_delay=True))
    z = np.asarray(control.ss(loop).poles(), dtype=complex)
    upper = z[np.imag(z) > 1e-9]
    s = np.log(upper) / plant.dt_s
    zeta = -np.real(s) / np.abs(s)
    nearest = float(zeta[np.argmin(np.abs(s - 15j))])
    inside = (np.abs(s) >= BAND[0]) & (np.abs(s) <= BAND[1])
    at = int(np.argmin(np.where(inside, zeta, np.inf)))
    return nearest, float(zeta[at]), float(np.abs(s[at])), bool(np.max(np.abs(z)) < 1)


def own_damping(controller: Controller) -> float:
    """Least damping ratio of the controller's pole pairs between 5 and 45 rad/s; 1 without any."""
    s = np.log(controller.poles[np.imag(controller.poles) > 1e-9]) / controller.dt_s
    near = s[(np.abs(s) > 5) & (np.abs(s) < 45)]
    return float(np.min(-np.real(near) / np.abs(near), initial=1.0))


def nominal_cost(controller: Controller, plant: UncertainPlant, specification: Specification) -> float:
    """max(|W1 S|, |W3 K S|) of the nominal loop on 40 000 frequencies, dense around the mode."""
    wide = np.geomspace(1e-4, plant.nyquist_rad_s * (1 - 1e-9), 30_000)
    omega = np.unique(np.concatenate([wide, 15 + 0.01 * np.sinh(np.linspace(-7, 7, 10_001))]))
    omega = omega[(omega > 0) & (omega <= wide[-1])]
    k = np.asarray(control.frequency_response(controller.to_control(include_delay=True), omega).complex)
    g = np.asarray(control.frequency_response(plant.nominal, omega).complex)
    sensitivity = 1 / np.abs(1 + g.reshape(-1) * k.reshape(-1))
    w1 = specification.magnitude(plant, omega, LoopFunction.SENSITIVITY)
    w3 = specification.magnitude(plant, omega, LoopFunction.EFFORT)
    return float(np.max(np.maximum(w1, w3 * np.abs(k.reshape(-1))) * sensitivity))


def design(part: str, ratio: float | None, seed: int) -> dict[str, Any]:
    """Synthesise and measure one point: cost, gamma with W4, damping nearest 15 rad/s, least damping in the
    band, frequency of that pole, least damping of the controller's own poles, Youla values with W4."""
    scenario, _, damped = part.partition("-")
    plant = flexible_link("A" if part == "exact" else scenario)
    if part == "exact":
        plant = UncertainPlant("link without ellipses", plant.nominal)
    specification = flexible_link_specification(ORDER).model_copy(
        update={"mode_peak_ratio": ratio, "controller_damping": CONTROLLER_DAMPING if damped else None}
    )
    result = synthesise([plant], specification, OPTIONS, rng=np.random.default_rng(seed))
    certificate = certify(result.controller, [plant], specification)
    if part == "exact":
        cost = nominal_cost(result.controller, plant, specification)
    else:
        undamped = specification.model_copy(update={"mode_peak_ratio": None})
        cost = certify(result.controller, [plant], undamped).gamma
    nearest, least, where, stable = damping(result.controller, plant)
    verdict = certificate.plants[0]
    bracket = youla_bracket(plant, specification)
    return {
        "part": part,
        "r": "none" if ratio is None else f"{ratio:.2f}",
        "cost": cost,
        "gamma": certificate.gamma,
        "nearest": nearest,
        "least": least,
        "where": where,
        "own": own_damping(result.controller),
        "floor": bracket.inscribed,
        "reachable": bracket.ellipse,
        "stable": stable and verdict.stable and verdict.nyquist.matches,
    }


def summarise(out: Print, curves: dict[str, pd.DataFrame]) -> None:
    """Least cost of a damping over all parts, whose pole is the least damped one, distance from Youla."""
    out("least cost max(|W1 S|, |W3 K S|) of order 6 with at least the damping (nearest and least pole)")
    names = "  ".join(f"{zeta:>7.3f}" for zeta, _ in PUBLISHED)
    out(f"{'damping':30s}  {names}")
    out(f"{'hinfsyn, full order (reach)':30s}  " + "  ".join(f"{cost:7.3f}" for _, cost in PUBLISHED))
    for part, points in curves.items():
        damped = points[["least", "nearest"]].min(axis=1).where(points.stable)
        costs = [points.cost[damped >= zeta].min() for zeta, _ in PUBLISHED]
        told = "  ".join(f"{cost:7.4f}" if np.isfinite(cost) else "      -" for cost in costs)
        out(f"{NAMES[part]:30s}  {told}")
    out()
    out("gamma with W4 against the Youla values (none goes below the first, the second is reached),")
    out("and the least damped pole pair of the controller itself where it is best damped:")
    for part, points in curves.items():
        weighted = points[points.r != "none"]
        floor, over = (100 * (weighted.gamma / weighted[key] - 1).max() for key in ("floor", "reachable"))
        out(f"{NAMES[part]:30s}  at most {floor:5.1f} % and {over:5.1f} % above;  {weighted.own.max():.3f}")
    out()
    out(reading("mode_damping", damping=CONTROLLER_DAMPING))


def measure(out: Print, part: str, ratios: tuple[float, ...], seed: int) -> pd.DataFrame:
    """Table of one part."""
    out(f"{NAMES[part]}: cost = largest max(|W1 S|, |W3 K S|); gamma = with |W4 G S| as well")
    out("damping of closed-loop poles: nearest 15 rad/s, least in 10..22.5 rad/s and its frequency;")
    out("least of the controller's own poles within 5..45 rad/s; Youla values of gamma")
    out(
        "part       r     cost    gamma   nearest   least  at rad/s  controller  none under  reachable"
        "  stable"
    )
    points = []
    for ratio in (None, *ratios):
        points.append(design(part, ratio, seed))
        out(LINE.format(**points[-1]))
    out()
    return pd.DataFrame(points)


def run(
    out: Print, *, parts: tuple[str, ...] = tuple(NAMES), ratios: tuple[float, ...] = RATIOS, seed: int = 1
) -> None:
    """Every part, then all compared."""
    summarise(out, {part: measure(out, part, ratios, seed) for part in parts})


if __name__ == "__main__":
    main(run)
