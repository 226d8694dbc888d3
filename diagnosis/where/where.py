"""Where the gap between machine and model lies: frequency, regime, time, amplitude, experiment, sensor.

Everything is read from whitened residuals (measured - model) / noise of every experiment, whichever model
made them: as given, with refitted parameters, or repaired. Beside a model error, noise and what a good
model may miss of the motion stand together in the place of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from diagnosis.machine.case import Case
from diagnosis.machine.flexible_arm import NOISE
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.where.dependence import dependences
from diagnosis.where.distortion import periodic_findings
from diagnosis.where.findings import Where, sensors_of
from diagnosis.where.regimes import axes_of_output, motions, regime_axes, regime_findings
from diagnosis.where.where_energy import Energy, band_gaps, experiment_gaps, part_gap, sensor_gaps
from diagnosis.where.where_trends import amplitude_finding, common_findings, drift_findings, linear_correction
from plant.effects import EFFECTS

LEVEL = 0.01  # one false finding an axis in a hundred pages of noise


def where(
    case: Case,
    residuals: Mapping[str, Real],
    probabilities: Mapping[str, float] | None = None,
    *,
    level: float = LEVEL,
    rng: np.random.Generator | None = None,
) -> Where:
    """Locate the gap.

    residuals : experiment name -> (T, Y). (measured - model) / noise, standard deviation 1 where the model
        explains everything; every experiment of the case.
    probabilities : effect id, "none" or "unknown" -> probability, optional
        Of the causes, for the grouping by subsystem.
    level : Chance of a false finding in each axis (frequency, regimes, drift, experiments, sensors) when the
        records hold only noise.
    rng : Of the shifts and blocks; without it a fixed sequence, so that the same records give the same page.

    Raises ValueError: missing or misshaped residuals, a level outside (0, 1), an effect that does not exist.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1; got {level}")
    rng = np.random.default_rng(0) if rng is None else rng
    given_case, given = case, residuals
    if case.model_error > 0:
        case, residuals = over_levels(case, residuals, thresholds_of(case))
    moved, sensors = motions(case, residuals), sensors_of(case)
    e = {name: np.asarray(residuals[name], dtype=np.float64) for name in moved}
    found = _by_parts(e, sensors, case.rig.sampling.dt_s, level)
    bands = found.bands
    if case.model_error > 0:
        # What a model may miss is stated for all frequencies together, not for each of them.
        quiet = [s.sensor for s in found.sensors if not s.gap.found]
        bands = tuple(replace(b, gap=replace(b.gap, found=False)) if b.sensor in quiet else b for b in bands)
    return replace(
        found,
        bands=bands,
        regimes=regime_findings(e, sensors, regime_axes(moved), level, rng),
        drift=drift_findings(case, e, level),
        common=common_findings(case, e, level),
        dependences=dependences(given_case, given, case.dt_s, level) if found.is_gap else (),
        periodic=periodic_findings(case, e, level),
        amplitude=amplitude_finding(case, e, level, rng),
        linear=linear_correction(case, e),
        subsystem=subsystem_mass(probabilities) if probabilities else {},
    )


def where_in_records(case: CaseOfMachine, residuals: Mapping[str, Real], dt_s: float) -> Where:
    """Of any machine: by sensor, experiment, frequency, and by what its outputs and inputs do (direction,
    size, rate, time in the record), and what it depends on; arguments as of `where`. Raises ValueError
    without a sampling period."""
    if not dt_s > 0:
        raise ValueError(f"case {case.name}: state the plant's sampling period (Plant(dt_s=...)) for a page")
    names, rng = case.machine.output_names, np.random.default_rng(0)
    axes = [axes_of_output(case, residuals, dt_s, k) for k in range(len(names))]
    given = residuals
    if case.machine.weighing.model_error > 0:
        _, residuals = over_levels(case, residuals, thresholds_of(case))
    regimes = [
        finding
        for k, (sensor, own) in enumerate(zip(names, axes, strict=True))
        for finding in regime_findings(
            {name: e[:, [k]] for name, e in residuals.items()}, (sensor,), own, LEVEL / len(names), rng
        )
    ]
    found = _by_parts(residuals, names, dt_s, LEVEL)
    depends = dependences(case, given, dt_s, LEVEL) if found.is_gap else ()
    return replace(found, regimes=tuple(regimes), dependences=depends)


def _by_parts(residuals: Mapping[str, Real], sensors: Sequence[str], dt_s: float, level: float) -> Where:
    whole = Energy.of(residuals.values())
    return Where(
        gap=part_gap(whole, whole, level),
        sensors=sensor_gaps(residuals, sensors, level),
        experiments=experiment_gaps(residuals, level),
        bands=band_gaps(residuals, sensors, dt_s, level),
        level=level,
    )


def motion_of(case: CaseOfMachine) -> Real:
    """(Y,) RMS of the outputs about their means over the held-out records."""
    held = case.held_out
    return np.sqrt(
        np.average([np.var(e.output, axis=0) for e in held], axis=0, weights=[len(e.output) for e in held])
    )


def thresholds_of(case: CaseOfMachine) -> Real:
    """(Y,) what a good model leaves of the outputs: the share of the motion that it may miss, and noise."""
    return np.hypot(case.machine.weighing.model_error * motion_of(case), case.noise)


AnyCase = TypeVar("AnyCase", bound=CaseOfMachine)


def over_levels(
    case: AnyCase, residuals: Mapping[str, Real], levels: Real
) -> tuple[AnyCase, dict[str, Real]]:
    """Case (only of a rig) and residuals with levels (Y,), in the outputs' units, in place of the noise."""
    weighed = {name: e * (case.noise / levels) for name, e in residuals.items()}
    if not isinstance(case, Case):
        return case, weighed
    keys = [f"sensors.{NOISE[output]}" for output in case.outputs]
    return replace(case, rig=case.rig.perturbed(dict(zip(keys, levels, strict=True)))), weighed


def subsystem_mass(probabilities: Mapping[str, float]) -> dict[str, float]:
    """Probabilities added up by where an effect acts: actuator, joint, link, sensor, environment.

    "none" and "unknown" stay on their own. What comes from outside the machine (a periodic disturbance,
    gravity) counts as environment.

    Raises ValueError if a name is neither an effect of the registry nor none or unknown.
    """
    mass = dict.fromkeys(("none", "actuator", "joint", "link", "sensor", "environment", "unknown"), 0.0)
    for name, value in probabilities.items():
        if name in ("none", "unknown"):
            mass[name] += float(value)
        elif name in EFFECTS:
            effect = EFFECTS[name]
            place = "environment" if effect.environment else effect.group
            mass[place] = mass.get(place, 0.0) + float(value)
        else:
            raise ValueError(f"{name}: no such effect; known: {', '.join(EFFECTS)}, none, unknown")
    return mass
