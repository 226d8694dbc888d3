"""Where the gap between machine and model lies: frequency, regime, time, amplitude, experiment, sensor.

Everything is read from whitened residuals (measured - model) / noise of every experiment, whichever model
made them: as given, with refitted parameters, or repaired. Beside a model error, noise and what a good
model may miss of the motion stand together in the place of the noise.

`where` is of a flexible link, whose sensors and motions have names; `where_in_records` of any machine.
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
from diagnosis.where.findings import BandGap, RegimeFinding, Where, sensors_of
from diagnosis.where.regimes import axes_of_output, motions, regime_axes, regime_findings
from diagnosis.where.where_energy import Energy, band_gaps, experiment_gaps, part_gap, sensor_gaps
from diagnosis.where.where_trends import amplitude_finding, common_findings, drift_findings, linear_correction
from plant.effects import EFFECTS

# Chance of a false finding in each axis: one in a hundred pages of noise. Chosen; doubled, twice as many.
LEVEL = 0.01


def where(
    case: Case,
    residuals: Mapping[str, Real],
    probabilities: Mapping[str, float] | None = None,
    *,
    level: float = LEVEL,
    rng: np.random.Generator | None = None,
) -> Where:
    """Locate the gap between a flexible link and its model.

    Parameters
    ----------
    case : Case
    residuals : experiment -> (T, Y) array
        (measured - model) / noise, standard deviation 1 where the model explains everything; of every
        experiment of the case.
    probabilities : effect id, "none" or "unknown" -> probability, optional
        Of the causes, for the grouping by subsystem.
    level : float
        Chance of a false finding in each axis (frequency, regimes, drift, experiments, sensors) when the
        records hold only noise.
    rng : numpy Generator, optional
        Of the shifts and blocks; without it a fixed sequence, so that the same records give the same page.

    Returns
    -------
    Where

    Raises
    ------
    ValueError
        Missing or misshaped residuals, a level outside (0, 1), an effect that does not exist.
    """
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1; got {level}")
    rng = np.random.default_rng(0) if rng is None else rng
    weighed_case = case
    weighed = residuals
    if case.model_error > 0:
        weighed_case, weighed = over_levels(case, residuals, thresholds_of(case))
    motion = motions(weighed_case, weighed)
    sensors = sensors_of(weighed_case)
    e = {name: np.asarray(weighed[name], dtype=np.float64) for name in motion}
    parts = _by_parts(e, sensors, case.rig.sampling.dt_s, level)
    bands = parts.bands
    if case.model_error > 0:
        # What a model may miss is stated for all frequencies together, not for each of them.
        quiet = [s.sensor for s in parts.sensors if not s.gap.found]
        bands = tuple(_not_found(band) if band.sensor in quiet else band for band in bands)
    return replace(
        parts,
        bands=bands,
        regimes=regime_findings(e, sensors, regime_axes(motion), level, rng),
        drift=drift_findings(weighed_case, e, level),
        common=common_findings(weighed_case, e, level),
        # A missing force is followed to the sensors' noise, whatever a model may miss.
        dependences=dependences(case, residuals, case.dt_s, level) if parts.is_gap else (),
        periodic=periodic_findings(weighed_case, e, level),
        amplitude=amplitude_finding(weighed_case, e, level, rng),
        linear=linear_correction(weighed_case, e),
        subsystem=subsystem_mass(probabilities) if probabilities else {},
    )


def _not_found(band: BandGap) -> BandGap:
    """A band whose gap counts as chance."""
    return replace(band, gap=replace(band.gap, found=False))


def where_in_records(case: CaseOfMachine, residuals: Mapping[str, Real], dt_s: float) -> Where:
    """Locate the gap between any machine and its simulation.

    By sensor, experiment, frequency; by what its outputs and inputs do (direction, size, rate, time in the
    record); and what it depends on. Each axis at the level `LEVEL`.

    Parameters
    ----------
    case : CaseOfMachine
    residuals : experiment -> (T, Y) array
        (measured - model) / noise, of every experiment of the case.
    dt_s : float
        Sampling period [s].

    Raises
    ------
    ValueError
        The sampling period is not positive.
    """
    if not dt_s > 0:
        raise ValueError(f"case {case.name}: state the plant's sampling period (Plant(dt_s=...)) for a page")
    names = case.machine.output_names
    rng = np.random.default_rng(0)
    axes = [axes_of_output(case, residuals, dt_s, k) for k in range(len(names))]
    weighed = residuals
    if case.machine.weighing.model_error > 0:
        _, weighed = over_levels(case, residuals, thresholds_of(case))
    regimes: list[RegimeFinding] = []
    for k, sensor in enumerate(names):
        column = {name: e[:, [k]] for name, e in weighed.items()}
        regimes += regime_findings(column, (sensor,), axes[k], LEVEL / len(names), rng)
    parts = _by_parts(weighed, names, dt_s, LEVEL)
    depends = dependences(case, residuals, dt_s, LEVEL) if parts.is_gap else ()
    return replace(parts, regimes=tuple(regimes), dependences=depends)


def _by_parts(residuals: Mapping[str, Real], sensors: Sequence[str], dt_s: float, level: float) -> Where:
    """The gap as a whole, by sensor, experiment and band; residuals (T, Y) over noise or threshold."""
    whole = Energy.of(residuals.values())
    return Where(
        gap=part_gap(whole, whole, level),
        sensors=sensor_gaps(residuals, sensors, level),
        experiments=experiment_gaps(residuals, level),
        bands=band_gaps(residuals, sensors, dt_s, level),
        level=level,
    )


def motion_of(case: CaseOfMachine) -> Real:
    """(Y,) RMS of the outputs about their means over the held-out records, in the outputs' units."""
    records = case.held_out
    variances = [np.var(record.output, axis=0) for record in records]
    rows = [len(record.output) for record in records]
    return np.sqrt(np.average(variances, axis=0, weights=rows))


def thresholds_of(case: CaseOfMachine) -> Real:
    """(Y,) what a good model leaves of the outputs: the share of the motion that it may miss, and noise."""
    return np.hypot(case.machine.weighing.model_error * motion_of(case), case.noise)


AnyCase = TypeVar("AnyCase", bound=CaseOfMachine)


def over_levels(
    case: AnyCase, residuals: Mapping[str, Real], levels: Real
) -> tuple[AnyCase, dict[str, Real]]:
    """Case and residuals with levels in place of the noise; only the case of a rig states them as its noise.

    Parameters
    ----------
    case : Case or other case of a machine
    residuals : experiment -> (T, Y) array
        Over the case's noise.
    levels : (Y,) array
        In the outputs' units, above zero.
    """
    weighed = {name: e * (case.noise / levels) for name, e in residuals.items()}
    if not isinstance(case, Case):
        return case, weighed
    keys = [f"sensors.{NOISE[output]}" for output in case.outputs]
    return replace(case, rig=case.rig.perturbed(dict(zip(keys, levels, strict=True)))), weighed


def subsystem_mass(probabilities: Mapping[str, float]) -> dict[str, float]:
    """Probabilities added up by where an effect acts: actuator, joint, link, sensor, environment.

    "none" and "unknown" stay on their own. What comes from outside the machine (a periodic disturbance,
    gravity) counts as environment.

    Raises
    ------
    ValueError
        A name is neither an effect of the registry nor none or unknown.
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
