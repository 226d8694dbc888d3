"""One workshop case: machine, experiments, major effects sized against the background, records, answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from validation.blind.cases import sorts_of
from validation.blind.rigs import rounded
from validation.blind.sizes import Table
from validation.blind.truth import Background, OutOfBoundsError, Real, Truth
from validation.blind.workshop.answer import Sort, answer_of
from validation.blind.workshop.bench import Bench, measured_sizes
from validation.blind.workshop.machine import SENSORS, Sensor, Workshop, draw_workshop
from validation.blind.workshop.nominal import Log
from validation.blind.workshop.plans import Controller, Run, plan_workshop
from validation.blind.workshop.sizes import (
    LEAST_TOLERANCES,
    listed,
    of_size,
    partners,
    tolerances_away,
    unlisted,
)

# Shares of a set of cases.
SHARES: dict[Sort, float] = {"none": 0.25, "single": 0.4, "pair": 0.2, "unlisted": 0.15}
# Rms of what the background leaves after a refit, held out, over the motion.
_BACKGROUND = (0.02, 0.035)
# Gap of an effect over that of the background, as its size is chosen.
_MAJOR = (3.5, 8.0)
# And as it comes out.
_REALISED = (2.0, 16.0)
# Distance from a wanted size, in its logarithm, that is close enough.
_CLOSE_ENOUGH = 0.12
# Draws until a case is given up.
_TRIES = 40
# How often a record lacks some rows.
_SHARE_WITH_LOST_ROWS = 0.12


@dataclass(frozen=True, eq=False)
class Sample:
    """A run as it was logged, without the rows before it: quantities (T,) by name, and what was lost."""

    run: Run
    quantities: dict[str, Real]
    lost_rows: list[int]


@dataclass(frozen=True, eq=False)
class WorkshopCase:
    """What is shown (stated rig, samples) and what is not (answer)."""

    machine: Workshop
    closed_loop: bool
    samples: tuple[Sample, ...]
    answer: dict[str, Any]


@dataclass(frozen=True)
class WorkshopPlan:
    """closed_loop: wholly. first_effect: tried before others, empty without one."""

    sort: Sort
    sensor: Sensor
    closed_loop: bool
    first_effect: str


def workshop_schedule(n_cases: int, rng: np.random.Generator, only: Sort | None = None) -> list[WorkshopPlan]:
    """Plans with the shares of the sorts; sensors and loops in turn, every effect before one comes twice."""
    sorts = sorts_of(SHARES, n_cases, only, slack=1e-9)
    places: list[tuple[Sensor, bool]] = [(sensor, loop) for sensor in SENSORS for loop in (False, True)]
    begin = int(rng.integers(len(places)))
    decks: dict[Sort, list[str]] = {}
    plans = []
    for k, sort in enumerate(sorts):
        sensor, closed = places[(begin + k) % len(places)]
        plans.append(
            WorkshopPlan(sort, sensor, closed, _dealt(decks.setdefault(sort, []), sort, sensor, rng))
        )
    return [plans[i] for i in rng.permutation(n_cases)]


def _dealt(deck: list[str], sort: Sort, sensor: Sensor, rng: np.random.Generator) -> str:
    """Next effect of a deck that these sensors can show; a deck without one is filled up."""
    if sort == "none":
        return ""
    pool, every = (
        (unlisted(sensor), unlisted("tip")) if sort == "unlisted" else (listed(sensor), listed("tip"))
    )
    if not set(deck) & set(pool):
        deck += rng.permutation(every).tolist()
    name = next(name for name in deck if name in pool)
    deck.remove(name)
    return name


def make_case(plan: WorkshopPlan, rng: np.random.Generator) -> WorkshopCase:
    """Draw machines and sizes until background and major effects are as wanted.

    Raises ValueError if forty draws do not suffice.
    """
    sort = plan.sort
    sensor = plan.sensor
    first = plan.first_effect
    for attempt in range(_TRIES):
        pool = unlisted(sensor) if sort == "unlisted" else listed(sensor)
        names = [] if sort == "none" else [first if attempt < 3 and first in pool else str(rng.choice(pool))]
        if sort == "pair":
            names.append(str(rng.choice(partners(names[0], sensor))))
        try:
            case = _attempt(sort, sensor, plan.closed_loop, names, rng)
        except OutOfBoundsError:
            continue
        if case is not None:
            return case
    raise ValueError(f"no machine found on which {first or sort} has the wanted size")


def _attempt(
    sort: Sort, sensor: Sensor, closed: bool, names: list[str], rng: np.random.Generator
) -> WorkshopCase | None:
    """A case with one draw of the machine; None where background or an effect cannot have its size."""
    machine = draw_workshop(sensor, rng)
    quiet = Background(
        hub_offset_rad=machine.background.hub_offset_rad,
        encoder_step_rad=machine.background.encoder_step_rad,
    )
    runs, controller = plan_workshop(
        Truth(machine.stated, (), quiet), closed, tuple(names), machine.rows, rng
    )
    bench = Bench(machine, runs, quiet)
    scale = _sized(
        lambda size: bench.share(machine.scaled(size)), 1.0, float(rng.uniform(*_BACKGROUND)), 1e3, 1e-3
    )
    if scale is None:
        return None
    machine = replace(machine, background=machine.scaled(scale))
    bench = Bench(machine, runs, quiet)
    left = bench.gap((), machine.background)
    effects: list[Table] = []
    designed: dict[str, float] = {}
    for name in names:
        wanted = float(np.exp(rng.uniform(*np.log(_MAJOR))))
        entry = _major(name, machine, bench, left, wanted, rng)
        if entry is None:
            return None
        effects.append(entry[0])
        designed[name] = rounded(entry[1])
    return _recorded(sort, machine, closed, controller, runs, effects, designed, left, bench, rng)


def _major(
    name: str, machine: Workshop, bench: Bench, left: Real, wanted: float, rng: np.random.Generator
) -> tuple[Table, float] | None:
    """The effect whose gap is `wanted` times what the background leaves, at least five tolerances large."""
    open_size = of_size(name, machine.true, bench.voltages(), rng)
    parametric = tolerances_away(open_size.at(open_size.first), machine.true, machine.tolerances) is not None

    def over(size: float) -> float:
        gap = bench.gap((open_size.at(size),), None, refit=not parametric)
        return float(np.max(gap / left))

    size = _sized(over, open_size.first, wanted, open_size.largest, open_size.first * 1e-3)
    if size is None:
        return None
    if parametric:
        for _ in range(40):
            away = tolerances_away(open_size.at(size), machine.true, machine.tolerances)
            if away is None or away >= LEAST_TOLERANCES:
                break
            size *= 1.15
        if size > open_size.largest:
            return None
    ratio = over(size)
    return (open_size.at(size), ratio) if ratio <= 2.0 * _MAJOR[1] else None


def _sized(
    measure: Callable[[float], float], first: float, wanted: float, largest: float, smallest: float
) -> float | None:
    """Size at which a growing measure is as wanted: secant in logarithms, kept between what is known."""
    low = np.log(smallest)
    high = np.log(largest)
    at = float(np.log(min(first, largest)))
    measured = list[tuple[float, float]]()
    for _ in range(9):
        try:
            value = measure(float(np.exp(at)))
        except ValueError:
            value = float("inf")
        miss = float(np.log(wanted) - np.log(max(value, 1e-9)))
        if abs(miss) < _CLOSE_ENOUGH:
            return float(np.exp(at))
        low, high = (at, high) if miss > 0 else (low, at)
        if high - low < 1e-3:
            return None
        slope = 1.0
        if np.isfinite(miss):
            measured.append((at, miss))
        if len(measured) > 1 and measured[-1][0] != measured[-2][0]:
            slope = -(measured[-1][1] - measured[-2][1]) / (measured[-1][0] - measured[-2][0])
        step = np.clip(miss / np.clip(slope, 0.3, 3.0), -1.5, 2.0)
        at = at + float(step)
        if not low < at < high:
            # An end that was not measured yet is worth a look; between two that were, the middle is.
            end = np.log(largest) if miss > 0 else np.log(smallest)
            at = float(end if end in (low, high) else 0.5 * (low + high))
    return None


def _recorded(
    sort: Sort,
    machine: Workshop,
    closed: bool,
    controller: Controller,
    runs: tuple[Run, ...],
    effects: list[Table],
    designed: dict[str, float],
    left: Real,
    bench: Bench,
    rng: np.random.Generator,
) -> WorkshopCase | None:
    """The case with its records as sensors and clock give them; None where its gap came out too small or too
    large."""
    truth = Truth(machine.true, effects, machine.background)
    oracle = Truth(machine.true, effects, bench.quiet)
    samples = []
    clean_logs = []
    noisy_logs = []
    oracle_logs = []
    around = machine.background
    dt = truth.dt_s
    for run in runs:
        before = run.before.rows_before
        rows = run.plan.voltage_V.size
        hub_noise, tip_noise = machine.noise.draw(rows, dt, rng)
        clean = bench.record(truth, run, hub_noise)
        late = np.zeros(rows)
        if machine.noise.jitter:
            late = 0.01 * dt * rng.standard_normal(rows)

        def sampled(value: Real, late: Real = late) -> Real:
            """At the instants of the time stamps: a hundredth of a period off, where a slope is enough."""
            return np.asarray(value + late * np.gradient(value, dt))

        hub = sampled(clean.hub_angle_rad) + around.hub_offset_rad + hub_noise
        hub = around.encoder_step_rad * np.rint(hub / around.encoder_step_rad)
        quantities = {
            "time_s": np.arange(rows - before) * dt + (late - late.min())[before:],
            "voltage_V": clean.voltage_V[before:],
            "hub_angle_rad": hub[before:],
        }
        if machine.sensor == "tip":
            quantities["tip_m"] = clean.sensed_tip(sampled(clean.tip_m) + tip_noise)[before:]
        elif machine.sensor == "acc":
            felt = sampled(clean.tip_acceleration_m_s2) + tip_noise
            quantities["tip_acceleration_m_s2"] = felt[before:]
        if run.plan.feedback:
            quantities["reference_rad"] = run.plan.feedback.reference_rad[before:]
        lost = _lost_rows(quantities["voltage_V"], rng)
        samples.append(Sample(run, quantities, lost))
        held = run.plan.role == "held_out"
        clean_logs.append(Log(clean.voltage_V, bench.output(clean, before), held))
        measured = np.column_stack([quantities[k] for k in machine.outputs])
        noisy_logs.append(Log(clean.voltage_V, measured, held))
        # The true machine but for its imperfections, driven by the voltage as logged.
        same = oracle.record(clean.voltage_V, None, None, run.before)
        oracle_logs.append(bench.output(same, before))
    sizes = measured_sizes(bench, clean_logs, noisy_logs, oracle_logs, effects)
    realised = sizes["major_over_background_realised"]
    if effects and not _REALISED[0] <= realised <= _REALISED[1]:
        return None
    answer = answer_of(sort, machine, closed, controller, effects, designed, sizes, left)
    answer["records"] = {
        s.run.plan.name: {
            "role": s.run.plan.role,
            "start_angle_rad": s.run.before.start_angle_rad,
            "lost_rows": s.lost_rows,
        }
        for s in samples
    }
    return WorkshopCase(machine, closed, tuple(samples), answer)


def _lost_rows(voltage_V: Real, rng: np.random.Generator) -> list[int]:
    """Seldom some rows, none of them with a jump of the voltage that nobody could know of."""
    if rng.random() >= _SHARE_WITH_LOST_ROWS:
        return []
    steps = np.abs(np.diff(voltage_V)) < 0.1 * np.std(voltage_V)
    calm = 1 + np.flatnonzero(steps[:-1] & steps[1:])
    is_inside = (calm >= 20) & (calm < voltage_V.size - 20)
    calm = calm[is_inside]
    count = min(int(rng.integers(1, 4)), calm.size)
    return sorted(rng.choice(calm, count, replace=False).tolist())
