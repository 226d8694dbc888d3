"""P2 (three modes): do 95 % ellipses hold the truth 95 % of the time, poles and order from the same data?

Plants, inputs and noise: `benchmarks.p2_plants`; every run has its own input and noise, and its own plant
where the case says so. Poles and order by identify([record]) with default options.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.harness import Print, main, reading, timed
from benchmarks.p2_plants import Setting, draw
from ident import GobfModel, IdentOptions, identify
from ident.basis.functions import regressor
from ident.basis.options import EmbeddingOptions
from ident.basis.posterior import ResponsePosterior
from ident.uncertainty.embedding import tangent
from tests.ident.benchmark_plants import DT_S, Truth
from validation.paper.classical import classical

OMEGA = np.geomspace(0.3, 300.0, 150)
BANDS = ((0.3, 1), (1, 5), (5, 13), (13, 19), (19, 55), (55, 85), (66, 72), (85, 150), (150, 190), (190, 301))
LEVEL = 0.95
RADIUS_REACH = {(13, 19): 1.5, (19, 55): 2.2, (66, 72): 5.0, (190, 301): 32.0}


@dataclass(frozen=True)
class Case:
    """One row of the study. coverage: (least, largest) share per band in %, None: no requirement."""

    title: str
    setting: Setting
    coverage: tuple[float, float] | None = None
    overall: float | None = None
    worst: float | None = None
    is_main: bool = False
    reported_only: bool = False
    coloured_noise: bool = False


# Titles of the cases.
FIXED = "fixed plant, N = {}, {} dB"
# Of a plant with five modes.
FIVE = "five modes (also 48 and 75 Hz), N = {}, {} dB"
# Of plants that are drawn.
RANDOM = "random plants, N = {}, {} dB"
CASES = {
    "main": Case(FIXED.format(2000, 35), Setting(), (92, 98), worst=88, is_main=True),
    "random": Case(RANDOM.format(2000, 35), Setting(random_plant=True), (91, 99)),
    "random-1000": Case(RANDOM.format(1000, 30), Setting(1000, 30.0, random_plant=True), (87, 100)),
    "fixed-1000": Case(FIXED.format(1000, 30), Setting(1000, 30.0), (87, 100)),
    "fixed-1000-40": Case(FIXED.format(1000, 40), Setting(1000, 40.0), reported_only=True),
    "fixed-4000-40": Case(FIXED.format(4000, 40), Setting(4000, 40.0), reported_only=True),
    "five": Case(FIVE.format(2000, 35), Setting(n_modes=5), reported_only=True),
    "five-4000-40": Case(FIVE.format(4000, 40), Setting(4000, 40.0, n_modes=5), reported_only=True),
    "initial-state": Case(
        FIXED.format(2000, 35) + ", record cut out of a longer run", Setting(from_rest=False), overall=93
    ),
    "ar1": Case(
        FIXED.format(2000, 35) + ", AR(1) noise with pole 0.9 (coloured_noise on)",
        Setting(noise_pole=0.9),
        overall=90,
        coloured_noise=True,
    ),
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """One set of ellipses against the truth, all (F,); joint: everything inside the simultaneous bands."""

    inside: np.ndarray
    major: np.ndarray  # over |G|
    mean: np.ndarray  # over |G|
    ratios: np.ndarray  # (3, F): mean radius, radius along the error, semi-major axis, each over the error
    cpu_s: float = np.nan
    joint: bool = False
    joint_radius2: float = np.nan


@dataclass(frozen=True, eq=False)
class RunOutcome:
    """Everything of one seed."""

    pairs: int
    cpu_identify_s: float
    by_method: dict[str, Outcome]


def covariance_alone(run: Truth, model: GobfModel) -> ResponsePosterior:
    """Least squares on the poles as if they were known: s2 (Phi^T Phi)^-1 and nothing else."""
    columns = regressor(model.poles, run.record.input[:, 0])
    q, r = np.linalg.qr(np.column_stack([columns, np.ones(columns.shape[0])]))
    inner = q.T @ run.record.output[:, 0]
    residual = run.record.output[:, 0] - q @ inner
    s = np.sqrt(residual @ residual / (residual.size - inner.size))
    inverse = np.linalg.inv(r)
    order = model.poles.order
    return ResponsePosterior(model.poles, (inverse @ inner)[:order], s * inverse[:order], DT_S)


def judge(
    posterior: ResponsePosterior, truth: np.ndarray, cpu_s: float = np.nan, seed: int | None = None
) -> Outcome:
    """Ellipses of a posterior; with a seed also its simultaneous bands."""
    ellipses = posterior.at(OMEGA, LEVEL)
    axes = ellipses.ellipse()
    distance = ellipses.normalised_distance(truth)
    error = np.abs(truth - ellipses.centre)
    size = np.abs(truth)
    mean = np.sqrt(axes.semi_major * axes.semi_minor)
    ratios = np.stack([mean / error, 1 / distance, axes.semi_major / error])
    outcome = Outcome(distance <= 1, axes.semi_major / size, mean / size, ratios, cpu_s)
    if seed is None:
        return outcome
    level = posterior.joint_level(OMEGA, LEVEL, np.random.default_rng(seed), n_draws=1000)
    everywhere = bool(np.all(posterior.at(OMEGA, level).contains(truth)))
    return replace(outcome, joint=everywhere, joint_radius2=float(-2 * np.log1p(-level)))


def one_run(name: str, seed: int) -> RunOutcome:
    """Draw, identify, embed, judge; everything from one seed."""
    case = CASES[name]
    run = draw(case.setting, np.random.default_rng(seed))
    truth = run.response(OMEGA)
    model, cpu_identify_s = timed(lambda: identify([run.record]).model)
    options = EmbeddingOptions(coloured_noise=case.coloured_noise)
    posterior, cpu_s = timed(lambda: tangent([run.record], model, options))
    by_method = {"tangent": judge(posterior, truth, cpu_s, seed)}
    if case.coverage is not None:
        without_missed_mode = options.model_copy(update={"prior_missed_mode": 0.0})
        other, cpu_s = timed(lambda: tangent([run.record], model, without_missed_mode))
        by_method["no missed mode"] = judge(other, truth, cpu_s, seed)
    if case.is_main:
        low = identify([run.record], IdentOptions(n_real=2, n_pairs=1)).model
        by_method["classical, n = 4"] = judge(classical([run.record], low), truth)
        by_method["covariance, n = 4"] = judge(covariance_alone(run, low), truth)
    return RunOutcome(model.poles.pairs.size, cpu_identify_s, by_method)


def per_band(values: np.ndarray, statistic: Callable[[np.ndarray], float]) -> list[float]:
    """(runs, F) -> one number per band."""
    return [statistic(values[:, (low <= OMEGA) & (high > OMEGA)]) for low, high in BANDS]


def row(label: str, values: Sequence[float], tail: str = "") -> str:
    return f"    {label:<22}" + "".join(f"{value:8.1f}" for value in values) + f"   {tail}"


def verdict(ok: bool) -> str:
    return "met" if ok else "NOT MET"


def at_least(value: float, limit: float | None) -> str:
    """What is asked of a number, in brackets, where something is."""
    return "" if limit is None else f" (reach >= {limit:g}: {verdict(value >= limit)})"


def report(out: Print, case: Case, runs: Sequence[RunOutcome]) -> None:
    pairs = np.bincount([run.pairs for run in runs])
    counted = ", ".join(f"{k} x {count}" for k, count in enumerate(pairs) if count)
    out()
    out(f"{case.title}: {len(runs)} runs; order: {counted}")
    out(
        "    " + " " * 22 + "".join(f"{f'{low:g}-{min(high, 300):g}':>8}" for low, high in BANDS) + "   rad/s"
    )
    for method in runs[0].by_method:
        outcomes = [run.by_method[method] for run in runs]
        inside = np.array([item.inside for item in outcomes])
        coverage = per_band(100 * inside, np.mean)
        is_tangent = method == "tangent"
        bounds = case.coverage
        tail = ""
        if is_tangent and bounds is not None:
            ok = all(bounds[0] <= value <= bounds[1] for value in coverage)
            tail = f"reach {bounds[0]:g}-{bounds[1]:g} in every band: {verdict(ok)}"
        out(f"  {method}")
        out(row("coverage", coverage, tail))
        radii = per_band(100 * np.array([item.major for item in outcomes]), np.median)
        if case.is_main and is_tangent:
            wanted = [RADIUS_REACH.get(band) for band in BANDS]
            ok = all(limit is None or r <= limit for limit, r in zip(wanted, radii, strict=True))
            out(row("radius", radii, f"reach below: {verdict(ok)}"))
            out("    " + f"{'  at most':<22}" + "".join(f"{'' if w is None else w:>8}" for w in wanted))
        else:
            out(row("radius", radii))
        out(row("mean radius", per_band(100 * np.array([item.mean for item in outcomes]), np.median)))
        overall = 100 * float(inside.mean())
        worst = 100 * float(inside.mean(axis=0).min())
        ratios = np.median(np.array([item.ratios for item in outcomes]), axis=(0, 2))
        asked = (
            f" (reach 1.8-2.4: {verdict(bool(1.8 <= ratios[0] <= 2.4))})"
            if case.is_main and is_tangent
            else ""
        )
        out(
            f"    overall {overall:.1f}{at_least(overall, case.overall if is_tangent else None)}"
            f"; worst {worst:.1f}{at_least(worst, case.worst if is_tangent else None)}; "
            f"ratio {ratios[0]:.2f}{asked}"
            f", along the error {ratios[1]:.2f}, semi-major {ratios[2]:.2f}"
        )
        text = f"    all inside {100 * inside.all(axis=1).mean():.0f}"
        if method in ("tangent", "no missed mode"):
            text += (
                f"; simultaneous bands {100 * np.mean([item.joint for item in outcomes]):.0f}"
                f" (squared radius {np.median([item.joint_radius2 for item in outcomes]):.1f})"
                f"; cpu {1e3 * np.median([run.cpu_identify_s for run in runs]):.0f}"
                f" + {1e3 * np.median([item.cpu_s for item in outcomes]):.0f} ms"
            )
        out(text)


def run(
    out: Print,
    *,
    cases: tuple[str, ...] = tuple(CASES),
    seeds: int = 200,
    first_seed: int = 0,
    processes: int = 2,
) -> None:
    unknown = sorted(set(cases) - set(CASES))
    if unknown:
        sys.exit(f"unknown cases {', '.join(unknown)}; choose from {', '.join(CASES)}")
    # Processes started afresh: forking after the numerical libraries have started their threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max(1, min(2, processes)), mp_context=context) as pool:
        out(reading("coverage_p2"))
        for name in cases:
            # Cases without a number to reach get half the seeds.
            count = max(1, seeds // 2) if CASES[name].reported_only else seeds
            some = range(first_seed, first_seed + count)
            report(out, CASES[name], list(pool.map(one_run, [name] * count, some, chunksize=5)))


if __name__ == "__main__":
    main(run)
