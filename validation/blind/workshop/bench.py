"""Runs of a workshop's true machine, and what its nominal one leaves of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from validation.blind.inputs import Planned
from validation.blind.rigs import rounded
from validation.blind.sizes import Table
from validation.blind.truth import Background, Clean, OutOfBoundsError, Real, Truth
from validation.blind.workshop.machine import Workshop
from validation.blind.workshop.nominal import Log, Nominal
from validation.blind.workshop.plans import Run
from validation.blind.workshop.sizes import tolerances_away

# Largest hub angle from the start of a record.
_WIDEST_RAD = 2.6
# Substeps of a sample at most: a stiffer machine takes too long, and another one is drawn.
_MOST_SUBSTEPS = 160


class Bench:
    """Runs of the true machine and what the nominal one, refitted, leaves of them."""

    def __init__(self, machine: Workshop, runs: tuple[Run, ...], quiet: Background) -> None:
        self.machine = machine
        self.runs = runs
        self.quiet = quiet

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
        """Raises OutOfBoundsError where the hub turns farther than any workshop would let it."""
        clean = truth.record(run.plan.voltage_V, run.plan.feedback, hub_noise, run.before)
        if np.max(np.abs(clean.hub_angle_rad - run.before.start_angle_rad)) > _WIDEST_RAD:
            raise OutOfBoundsError("the hub turns too far: it leaves every bound")
        return clean

    def output(self, clean: Clean, rows_before: int) -> Real:
        """(T, n) as sensors without noise, encoder zero or resolution see it."""
        columns = [clean.hub_angle_rad]
        if self.machine.sensor == "tip":
            columns.append(clean.sensed_tip(clean.tip_m))
        elif self.machine.sensor == "acc":
            columns.append(clean.tip_acceleration_m_s2)
        return np.column_stack(columns)[rows_before:]

    def logs(self, truth: Truth) -> list[Log]:
        """Records of a machine as the fit sees them. Raises OutOfBoundsError for one that is too stiff."""
        if truth.substeps > _MOST_SUBSTEPS:
            raise OutOfBoundsError("a machine this stiff is beyond every bound")
        logs = []
        for run in self.runs:
            clean = self.record(truth, run)
            output = self.output(clean, run.before.rows_before)
            logs.append(Log(clean.voltage_V, output, run.plan.role == "held_out"))
        return logs

    def nominal(self, logs: list[Log]) -> Nominal:
        sensors = self.machine.stated["sensors"]
        noise = np.array(list(sensors.values()))[: logs[0].output.shape[1]]
        return Nominal(self.machine.tolerances, logs, self.machine.sensor == "acc", noise)

    def gap(self, effects: tuple[Table, ...], background: Background | None, *, refit: bool = True) -> Real:
        """Root mean square (n,) of the held-out residuals of records with these effects, no noise."""
        logs = self.logs(Truth(self.machine.true, effects, background or self.quiet))
        nominal = self.nominal(logs)
        if refit:
            residuals = nominal.refit(self.machine.true)
        else:
            residuals = nominal.residuals(self.machine.true, np.zeros(len(self.machine.tolerances)))
        return rms([r for r, log in zip(residuals, logs, strict=True) if log.held_out])

    def share(self, background: Background) -> float:
        """What a refit leaves over the motion on the held-out records, over all outputs."""
        logs = self.logs(Truth(self.machine.true, (), background))
        residuals = self.nominal(logs).refit(self.machine.true)
        held = [k for k, log in enumerate(logs) if log.held_out]
        left = rms([residuals[k] for k in held])
        motion = rms([logs[k].output - logs[k].output.mean(axis=0) for k in held])
        return float(np.sqrt(np.mean((left / motion) ** 2)))


def rms(parts: list[Real]) -> Real:
    """(n,) over all samples of the records (T, n)."""
    return np.asarray(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)))


def measured_sizes(
    bench: Bench,
    clean: list[Log],
    noisy: list[Log],
    oracle: list[Real],
    effects: list[Table],
) -> dict[str, Any]:
    """Gaps of the nominal machine (stated, true and refitted values) and of the true effects."""
    machine = bench.machine
    stated = np.array(list(machine.stated["sensors"].values()))
    none = np.zeros(len(machine.tolerances))

    def held(parts: list[Real]) -> list[Real]:
        return [part for part, log in zip(parts, clean, strict=True) if log.held_out]

    pure = bench.nominal(clean)
    background = pure.linear_refit(
        machine.true, [log.output - same for log, same in zip(clean, oracle, strict=True)]
    )
    refit = pure.refit(machine.true)
    true_values = pure.residuals(machine.true, none)
    parametric = [tolerances_away(e, machine.true, machine.tolerances) is not None for e in effects]
    before = true_values if any(parametric) else refit
    noise = bench.nominal(noisy)
    gaps = {
        "nominal": noise.residuals(machine.stated, none),
        "true_values": noise.residuals(machine.true, none),
        "refit": noise.refit(machine.true),
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
    left = rms(held(background))
    motion = rms([log.output - log.output.mean(axis=0) for log in clean if log.held_out])

    def beyond(parts: list[Real]) -> Real:
        return np.sqrt(np.maximum(rms(held(parts)) ** 2 - left**2, 0.0)) * bool(effects)

    sizes = {
        "motion_rms": motion,
        "noise_stated": stated,
        "background_rms": left,
        "background_share_of_motion": left / motion,
        "major_rms_after_refit": beyond(refit),
        "major_rms_true_values": beyond(true_values),
    }
    table = {
        key: {name: rounded(float(values[k])) for name, values in sizes.items()}
        for k, key in enumerate(machine.outputs)
    }
    named = "major_rms_true_values" if before is true_values else "major_rms_after_refit"
    realised = max(v[named] / v["background_rms"] for v in table.values())
    return {
        "rms_held_out": table,
        "pooled_gap": pooled,
        "major_over_background_realised": rounded(realised, 3),
    }
