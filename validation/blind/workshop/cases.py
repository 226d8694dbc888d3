"""One workshop case: machine, experiments, major effects sized against the background, records, answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from validation.blind.inputs import Planned
from validation.blind.rigs import Rig, rounded
from validation.blind.sizes import Sizable, Table
from validation.blind.truth import Background, Clean, Real, Truth

from .machine import SENSORS, Sensor, Workshop, draw_workshop
from .nominal import Log, Nominal
from .plans import Controller, Run, plan_workshop
from .sizes import LEAST_TOLERANCES, listed, of_size, partners, tolerances_away, unlisted

Sort = Literal["none", "single", "pair", "unlisted"]
SHARES: dict[Sort, float] = {"none": 0.25, "single": 0.4, "pair": 0.2, "unlisted": 0.15}
MODEL_ERROR = 0.05
_BACKGROUND = (0.02, 0.035)  # of the motion, root mean square, held out, after a refit
_MAJOR = (3.5, 8.0)  # over the background
_LEAST_REALISED = 2.0
_CLOSE_ENOUGH = 0.12  # in the logarithm of a wanted size
_WIDEST_RAD = 2.6  # hub angle from the start of a record
_MOST_SUBSTEPS = 160
_TRIES = 40


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


def schedule(n_cases: int, rng: np.random.Generator) -> list[tuple[Sort, Sensor, bool]]:
    """(sort, sensor, wholly in closed loop?) of every case, mixed within each sort."""
    remainders = {sort: share * n_cases % 1 for sort, share in SHARES.items()}
    sorts = [sort for sort, share in SHARES.items() for _ in range(int(share * n_cases + 1e-9))]
    sorts += sorted(remainders, key=lambda sort: -remainders[sort])[: n_cases - len(sorts)]
    combinations: list[tuple[Sensor, bool]] = [(sensor, loop) for sensor in SENSORS for loop in (False, True)]
    begin = int(rng.integers(len(combinations)))
    plan = [(sort, *combinations[(begin + k) % len(combinations)]) for k, sort in enumerate(sorts)]
    return [plan[i] for i in rng.permutation(n_cases)]


def make_case(sort: Sort, sensor: Sensor, closed: bool, first: str, rng: np.random.Generator) -> WorkshopCase:
    """Draw machines and sizes until background and major effects are as wanted; first: an effect to try first.

    Raises ValueError if thirty draws do not suffice.
    """
    for attempt in range(_TRIES):
        pool = unlisted(sensor) if sort == "unlisted" else listed(sensor)
        names = [] if sort == "none" else [first if attempt < 3 and first in pool else str(rng.choice(pool))]
        if sort == "pair":
            names.append(str(rng.choice(partners(names[0], sensor))))
        try:
            case = _attempt(sort, sensor, closed, names, rng)
        except ValueError as error:
            if "every bound" not in str(error):
                raise
            continue
        if case is not None:
            return case
    raise ValueError(f"no machine found on which {first or sort} has the wanted size")


def _attempt(
    sort: Sort, sensor: Sensor, closed: bool, names: list[str], rng: np.random.Generator
) -> WorkshopCase | None:
    machine = draw_workshop(sensor, rng)
    quiet = Background(
        hub_offset_rad=machine.background.hub_offset_rad,
        encoder_step_rad=machine.background.encoder_step_rad,
    )
    runs, controller = plan_workshop(
        Truth(machine.stated, (), quiet), closed, tuple(names), machine.rows, rng
    )
    sizer = _Sizer(machine, runs, quiet)
    scale = _sized(
        lambda size: sizer.share(machine.scaled(size)), 1.0, float(rng.uniform(*_BACKGROUND)), 1e3, 1e-3
    )
    if scale is None:
        return None
    machine = replace(machine, background=machine.scaled(scale))
    sizer = _Sizer(machine, runs, quiet)
    left = sizer.gap((), machine.background)
    effects: list[Table] = []
    designed: dict[str, float] = {}
    for name in names:
        wanted = float(np.exp(rng.uniform(*np.log(_MAJOR))))
        entry = _major(name, machine, sizer, left, wanted, rng)
        if entry is None:
            return None
        effects.append(entry[0])
        designed[name] = rounded(entry[1])
    return _recorded(sort, machine, closed, controller, runs, effects, designed, left, sizer, rng)


def _major(
    name: str, machine: Workshop, sizer: _Sizer, left: Real, wanted: float, rng: np.random.Generator
) -> tuple[Table, float] | None:
    """The effect whose gap is `wanted` times what the background leaves, at least five tolerances large."""
    open_size = of_size(name, machine.true, sizer.voltages(), rng)
    parametric = tolerances_away(open_size.at(open_size.first), machine.true, machine.tolerances) is not None

    def over(size: float) -> float:
        gap = sizer.gap((open_size.at(size),), None, refit=not parametric)
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
    low, high = np.log(smallest), np.log(largest)
    at, tried = float(np.log(min(first, largest))), list[tuple[float, float]]()
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
            tried.append((at, miss))
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            slope = -(tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0])
        step = np.clip(miss / np.clip(slope, 0.3, 3.0), -1.5, 2.0)
        at = at + float(step)
        if not low < at < high:
            # An end that was not tried yet is worth a look; between two that were, the middle is.
            end = np.log(largest) if miss > 0 else np.log(smallest)
            at = float(end if end in (low, high) else 0.5 * (low + high))
    return None


class _Sizer:
    """Runs of the true machine and what the nominal one, refitted, leaves of them."""

    def __init__(self, machine: Workshop, runs: tuple[Run, ...], quiet: Background) -> None:
        self.machine, self.runs, self.quiet = machine, runs, quiet

    def voltages(self) -> tuple[Planned, ...]:
        """The plans with the voltages they lead to, for the scales of effects."""
        truth = Truth(self.machine.true, (), self.quiet)
        return tuple(
            replace(
                run.plan,
                voltage_V=self.record(truth, run).voltage_V[run.before.rows_before :],
                feedback=None,
            )
            for run in self.runs
        )

    def record(self, truth: Truth, run: Run, hub_noise: Real | None = None) -> Clean:
        """Raises ValueError where the hub turns farther than any workshop would let it."""
        clean = truth.record(run.plan.voltage_V, run.plan.feedback, hub_noise, run.before)
        if np.max(np.abs(clean.hub_angle_rad - run.before.start_angle_rad)) > _WIDEST_RAD:
            raise ValueError("the hub turns too far: it leaves every bound")
        return clean

    def output(self, clean: Clean, rows_before: int) -> Real:
        """(T, n) as sensors without noise, encoder zero or resolution see it."""
        columns = [clean.hub_angle_rad]
        if self.machine.sensor == "tip":
            tip = np.clip(clean.tip_m, -clean.clip_m, clean.clip_m)
            columns.append(clean.step_m * np.rint(tip / clean.step_m) if clean.step_m > 0 else tip)
        elif self.machine.sensor == "acc":
            columns.append(clean.tip_acceleration_m_s2)
        return np.column_stack(columns)[rows_before:]

    def logs(self, truth: Truth) -> list[Log]:
        if truth.substeps > _MOST_SUBSTEPS:
            raise ValueError("a machine this stiff is beyond every bound")
        found = []
        for run in self.runs:
            clean = self.record(truth, run)
            output = self.output(clean, run.before.rows_before)
            found.append(Log(clean.voltage_V, output, run.plan.role == "held_out"))
        return found

    def nominal(self, logs: list[Log]) -> Nominal:
        sensors = self.machine.stated["sensors"]
        noise = np.array(list(sensors.values()))[: logs[0].output.shape[1]]
        return Nominal(self.machine.tolerances, logs, self.machine.sensor == "acc", noise)

    def gap(
        self, effects: tuple[Table, ...], background: Background | None, *, refit: bool = True
    ) -> Real:
        """Root mean square (n,) of the held-out residuals of records with these effects, no noise."""
        logs = self.logs(Truth(self.machine.true, effects, background or self.quiet))
        nominal = self.nominal(logs)
        if refit:
            residuals = nominal.refit(self.machine.true).residuals
        else:
            residuals = nominal.residuals(self.machine.true, np.zeros(len(self.machine.tolerances)))
        return rms([r for r, log in zip(residuals, logs, strict=True) if log.held_out])

    def share(self, background: Background) -> float:
        """What a refit leaves over the motion on the held-out records, over all outputs."""
        logs = self.logs(Truth(self.machine.true, (), background))
        residuals = self.nominal(logs).refit(self.machine.true).residuals
        held = [k for k, log in enumerate(logs) if log.held_out]
        left = rms([residuals[k] for k in held])
        motion = rms([logs[k].output - logs[k].output.mean(axis=0) for k in held])
        return float(np.sqrt(np.mean((left / motion) ** 2)))


def rms(parts: list[Real]) -> Real:
    """(n,) over all samples of the records (T, n)."""
    return np.asarray(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)))


def _recorded(
    sort: Sort,
    machine: Workshop,
    closed: bool,
    controller: Controller,
    runs: tuple[Run, ...],
    effects: list[Table],
    designed: dict[str, float],
    left: Real,
    sizer: _Sizer,
    rng: np.random.Generator,
) -> WorkshopCase | None:
    truth = Truth(machine.true, effects, machine.background)
    oracle = Truth(machine.true, effects, sizer.quiet)
    samples, clean_logs, noisy_logs, oracle_logs = [], [], [], []
    around, dt = machine.background, truth.dt_s
    for run in runs:
        before = run.before.rows_before
        rows = run.plan.voltage_V.size
        hub_noise, tip_noise = machine.noise.draw(rows, dt, rng)
        clean = sizer.record(truth, run, hub_noise)
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
            tip = np.clip(sampled(clean.tip_m) + tip_noise, -clean.clip_m, clean.clip_m)
            if clean.step_m > 0:
                tip = clean.step_m * np.rint(tip / clean.step_m)
            quantities["tip_m"] = tip[before:]
        elif machine.sensor == "acc":
            felt = sampled(clean.tip_acceleration_m_s2) + tip_noise
            quantities["tip_acceleration_m_s2"] = felt[before:]
        if run.plan.feedback:
            quantities["reference_rad"] = run.plan.feedback.reference_rad[before:]
        lost = []
        if rng.random() < 0.12:
            count = int(rng.integers(1, 4))
            lost = sorted(int(k) for k in rng.choice(np.arange(20, rows - before - 20), count, replace=False))
        samples.append(Sample(run, quantities, lost))
        held = run.plan.role == "held_out"
        clean_logs.append(Log(clean.voltage_V, sizer.output(clean, before), held))
        measured = np.column_stack([quantities[k] for k in _outputs(machine)])
        noisy_logs.append(Log(clean.voltage_V, measured, held))
        # The true machine but for its imperfections, driven by the voltage as logged.
        same = oracle.record(clean.voltage_V, None, None, run.before)
        oracle_logs.append(sizer.output(same, before))
    sizes = _sizes(machine, sizer, clean_logs, noisy_logs, oracle_logs, effects)
    realised = sizes["major_over_background_realised"]
    if effects and not realised >= _LEAST_REALISED:
        return None
    answer = _answer(sort, machine, closed, controller, effects, designed, sizes, left)
    answer["records"] = {
        s.run.plan.name: {
            "role": s.run.plan.role,
            "start_angle_rad": s.run.before.start_angle_rad,
            "lost_rows": s.lost_rows,
        }
        for s in samples
    }
    return WorkshopCase(machine, closed, tuple(samples), answer)


def _outputs(machine: Workshop) -> list[str]:
    return ["hub_angle_rad"] + ([machine.sensor_key] if machine.sensor_key else [])


def _sizes(
    machine: Workshop,
    sizer: _Sizer,
    clean: list[Log],
    noisy: list[Log],
    oracle: list[Real],
    effects: list[Table],
) -> dict[str, Any]:
    """Gaps of the nominal machine (stated, true and refitted values) and of the true effects, see the answer."""
    stated = np.array(list(machine.stated["sensors"].values()))
    none = np.zeros(len(machine.tolerances))
    outputs = _outputs(machine)

    def held(parts: list[Real]) -> list[Real]:
        return [part for part, log in zip(parts, clean, strict=True) if log.held_out]

    pure = sizer.nominal(clean)
    background = pure.linear_refit(
        machine.true, [log.output - same for log, same in zip(clean, oracle, strict=True)]
    )
    refit = pure.refit(machine.true).residuals
    true_values = pure.residuals(machine.true, none)
    parametric = [tolerances_away(e, machine.true, machine.tolerances) is not None for e in effects]
    before = true_values if any(parametric) else refit
    noise = sizer.nominal(noisy)
    gaps = {
        "nominal": noise.residuals(machine.stated, none),
        "true_values": noise.residuals(machine.true, none),
        "refit": noise.refit(machine.true).residuals,
        "after_oracle": noise.linear_refit(
            machine.true, [log.output - same for log, same in zip(noisy, oracle, strict=True)]
        ),
    }
    gaps["before"] = gaps["true_values" if any(parametric) else "refit"]
    pooled = {}
    for role in ("estimation", "held_out"):
        for name, parts in gaps.items():
            mine = [p for p, log in zip(parts, clean, strict=True) if log.held_out == (role == "held_out")]
            pooled[f"{role}_gap_{name}"] = rounded(float(np.sqrt(np.mean((rms(mine) / stated) ** 2))))
    left, motion = rms(held(background)), rms([log.output - log.output.mean(axis=0) for log in clean if log.held_out])
    table = {}
    for k, key in enumerate(outputs):
        def major(parts: list[Real], k: int = k) -> float:
            return rounded(float(np.sqrt(max(rms(held(parts))[k] ** 2 - left[k] ** 2, 0.0)))) if effects else 0.0

        table[key] = {
            "motion_rms": rounded(float(motion[k])),
            "noise_stated": float(stated[k]),
            "background_rms": rounded(float(left[k])),
            "background_share_of_motion": rounded(float(left[k] / motion[k])),
            "major_rms_after_refit": major(refit),
            "major_rms_true_values": major(true_values),
        }
    named = "major_rms_true_values" if before is true_values else "major_rms_after_refit"
    realised = max(v[named] / v["background_rms"] for v in table.values())
    return {
        "rms_held_out": table,
        "pooled_gap": pooled,
        "major_over_background_realised": rounded(realised, 3),
    }


def _answer(
    sort: Sort,
    machine: Workshop,
    closed: bool,
    controller: Controller,
    effects: list[Table],
    designed: dict[str, float],
    sizes: dict[str, Any],
    left: Real,
) -> dict[str, Any]:
    """As the answer files of the labelled cases."""
    hidden = sort == "unlisted"
    b, noise = machine.background, machine.noise
    entries = []
    for effect in effects if not hidden else ():
        entry: dict[str, Any] = {
            "name": effect["name"],
            "parameters": {k: v for k, v in effect.items() if k != "name"},
        }
        away = tolerances_away(effect, machine.true, machine.tolerances)
        entries.append(entry if away is None else {**entry, "tolerances_away": away})
    true_over_stated = _relative(machine.true, machine.stated, machine.tolerances)
    worst = max(abs(d) / machine.tolerances[key] for key, d in true_over_stated.items())
    answer: dict[str, Any] = {
        "verdict": "none" if sort == "none" else "unknown" if hidden else "effect",
        "severity": "none" if sort == "none" else "clear",
        "effects": entries,
        "unlisted": effects if hidden else [],
        "sensor": machine.sensor,
        "closed_loop": closed,
        "controller": controller,
        "nominal": "uncertain",
        "model_error": MODEL_ERROR,
        "oracle_gap_after_major": sizes["pooled_gap"]["held_out_gap_after_oracle"],
        "nominal_worst_tolerances": rounded(worst, 3),
    }
    if effects:
        answer["major_over_background_realised"] = sizes["major_over_background_realised"]
        answer["major_over_background"] = (
            {"unlisted": next(iter(designed.values()))} if hidden else designed
        )
    answer["background"] = {
        "dry_friction_Nm": b.dry_friction_Nm,
        "presliding_rad": b.presliding_rad,
        "cogging_Nm": b.cogging_Nm,
        "cogging_per_rev": b.cogging_per_rev,
        "cogging_phase_rad": b.cogging_phase_rad,
        "amplifier_lag_s": b.amplifier_lag_s,
        "tilt_m_s2": b.tilt_m_s2,
        "tilt_angle_rad": b.tilt_angle_rad,
        "transport_delay_s": machine.true["sampling"]["transport_delay_s"],
        "encoder_counts_per_turn": machine.counts,
        "hub_noise_true_over_stated": rounded(noise.hub / machine.stated["sensors"]["hub_angle_noise_rad"]),
        "hub_offset_rad": b.hub_offset_rad,
        "time_stamp_jitter": noise.jitter,
    }
    if machine.sensor != "none":
        answer["background"] |= {
            "tip_noise_true_over_stated": rounded(noise.tip / list(machine.stated["sensors"].values())[-1]),
            "tip_noise_ar1": noise.correlation,
            "hum_over_tip_noise": noise.hum,
            "hum_Hz": noise.hum_Hz,
        }
    answer["true_minus_nominal_relative"] = true_over_stated
    answer["rms_held_out"] = {
        key: {**numbers, "background_rms_predicted": rounded(float(left[k]))}
        for k, (key, numbers) in enumerate(sizes["rms_held_out"].items())
    }
    answer["pooled_gap"] = sizes["pooled_gap"]
    answer["true_rig"] = machine.true
    return answer


def _relative(true: Rig, stated: Rig, keys: dict[str, float]) -> dict[str, float]:
    found = {}
    for key in keys:
        section, name = key.split(".")
        found[key] = rounded(true[section][name] / stated[section][name] - 1)
    return found
