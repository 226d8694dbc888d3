"""The page of `flexlink excite`: what is planned, and what may be expected of it."""

from __future__ import annotations

import numpy as np

from ident.data.arrays import RealArray
from workflow.describe.facts import (
    FirstScreen,
    Page,
    PageSection,
    Picture,
    Quantity,
    Row,
    Table,
    Text,
)
from workflow.excite.experiment import PlannedExperiment
from workflow.text.formats import count, number, percent, sentence, si

# Digits of the ends of a band: lines are a small step apart.
_BAND_DIGITS = 4


def experiment_page(found: PlannedExperiment) -> Page:
    """The whole page of a planned experiment: numbers against their limits, uncertainty, files."""
    return Page("Planned experiment", _first_screen(found), (_expected_uncertainty(found), _files(found)))


def _first_screen(found: PlannedExperiment) -> FirstScreen:
    plan = found.plan
    dt_s = found.limits.dt_s
    duration = si(found.duration_s, "s")
    period = si(plan.period_samples * dt_s, "s")
    lead_in = si(plan.lead_in_samples * dt_s, "s")
    band = f"{number(found.lines_Hz[0], _BAND_DIGITS)} to {number(found.lines_Hz[-1], _BAND_DIGITS)} Hz"
    bullets = [
        "Start every record at rest and play the whole file. Log time and measured angle from the first "
        "sample on: the lead-in belongs to the record",
        "Give all logs to flexlink identify together. It finds the periods and separates noise from "
        "nonlinear distortion",
    ]
    if plan.realisations < 2:
        bullets.append("One realisation: distortion shows at the detection lines only")
    if plan.periods < 2:
        bullets.append("One period: noise and distortion cannot be distinguished")
    amplitudes = count(len(plan.rms_V), "amplitude")
    realisations = count(plan.realisations, "realisation")
    bullets += [
        f"{amplitudes} x {realisations} of random phases. Each record has {count(plan.periods, 'period')} of "
        f"{period} after a lead-in of {lead_in} of the same signal",
        f"{count(found.lines_Hz.size, 'line')} from {band}, the same in every record: odd ones, with "
        f"{found.detection_Hz.size} of them left out at random as detection lines",
    ]
    return FirstScreen(
        headline=f"{count(plan.n_records, 'record')}, {duration} in all",
        state="plain",
        rows=_numbers(found),
        bullets=tuple(sentence(bullet) for bullet in bullets),
        picture=Picture(
            "excitation",
            "Voltage of one record with the limit; the lines, each of the same amplitude; and what may be "
            "expected of the response.",
            (found,),
        ),
        anchor="plan",
        short="Plan",
    )


def _numbers(found: PlannedExperiment) -> tuple[Row, ...]:
    """Duration, voltage, motion and uncertainty of the plan, beside what is allowed."""
    plan = found.plan
    limits = found.limits
    records = f"{si(found.duration_s, 's')} of {si(limits.duration_s, 's')} allowed"
    highest_voltage = Quantity.of(max(record.peak_V for record in found.records), "V")

    # The motion is predicted where the rig or the gain is known.
    angles = [record.peak_angle_deg for record in found.records if record.peak_angle_deg is not None]
    turns = Quantity.of(max(angles, default=None), "degrees", missing="not predicted")
    about_turns = "give --rig or --gain"
    if angles:
        predicted_from = "if the speed follows the voltage" if limits.rig is None else "linear arm of the rig"
        about_turns = f"{predicted_from}, from rest"
        if limits.angle_deg is not None:
            about_turns = f"{number(limits.angle_deg)} allowed; {about_turns}"

    largest_rms_V = max(plan.rms_V)
    smallest_radius = found.radii[plan.rms_V.index(largest_rms_V)]
    radius = Quantity.of(smallest_radius, "rad/V")
    about_radius = f"at {si(largest_rms_V, 'V')} rms"
    shares = _shares_percent(found, smallest_radius)
    if shares is not None:
        radius = Quantity(percent(_median(shares)), _median(shares), "%")
        about_radius = f"of the gain, median; {about_radius}"
    return (
        Row("", "records", Quantity(f"{plan.n_records}", plan.n_records), records),
        Row("", "highest voltage", highest_voltage, f"{si(limits.peak_V, 'V')} allowed"),
        Row("", "hub turns by at most", turns, about_turns),
        Row("", "95 % radius of the response", radius, about_radius),
    )


def _shares_percent(found: PlannedExperiment, radius: float) -> RealArray | None:
    """A radius as a share of the gain at each line, percent, sorted; None where the gain is not known."""
    return None if found.gain is None else np.sort(100 * radius / found.gain)


def _median(values: RealArray) -> float:
    """The middle one of sorted values; of an even number the upper of the two."""
    return float(values[values.size // 2])


def _expected_uncertainty(found: PlannedExperiment) -> PageSection:
    """The radius of the response by amplitude, and the formula it comes from."""
    limits = found.limits
    rows = []
    for rms_V, radius in zip(found.plan.rms_V, found.radii, strict=True):
        shares = _shares_percent(found, radius)
        median = None if shares is None else _median(shares)
        largest = None if shares is None else float(shares[-1])
        rows.append((number(rms_V), number(radius), number(median), number(largest)))
    head = (
        "amplitude [V rms]",
        "95 % radius of the response at a line [rad/V]",
        "of the gain, median [%]",
        "of the gain, largest [%]",
    )
    source = ""
    if limits.noise_std_rad is None:
        source = " (assumed: an encoder of 12 bits; --noise-std states yours)"
        if limits.rig is not None and limits.rig.sensors.hub_angle_noise_rad:
            source = " (that of the rig)"
    formula = (
        f"Radius from white sensor noise of {si(found.noise_std_rad, 'rad')} alone{source}: "
        "r = sqrt(-ln(0.05) v), v = 2 H s²/(N M P rms²). There are H lines, N samples a period, M "
        "realisations and P periods. Nonlinear distortion widens it; a model that joins the lines narrows it."
    )
    blocks = (Table(head, tuple(rows)), Text(formula))
    return PageSection("excitation", "Expected uncertainty", "Uncertainty", blocks, open=True)


def _files(found: PlannedExperiment) -> PageSection:
    """The files to play, one a record."""
    rows = tuple(
        (
            record.file,
            number(record.rms_V),
            record.realisation,
            number(record.peak_V),
            number(record.crest_factor),
            number(record.peak_angle_deg),
        )
        for record in found.records
    )
    head = (
        "file",
        "amplitude [V rms]",
        "realisation",
        "peak [V]",
        "crest factor",
        "expected peak angle [degrees]",
    )
    about = (
        f"Columns time_s and voltage_V; phases and lines from seed {found.seed}. The same in numbers: "
        "plan.json."
    )
    return PageSection("files", "Files", "Files", (Table(head, rows), Text(about)))
