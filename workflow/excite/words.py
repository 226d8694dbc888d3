"""What `flexlink excite --closed-loop` plans, and what may be expected of it."""

from __future__ import annotations

from workflow.describe.facts import Section, worded
from workflow.excite.reference_plan import PlannedReference
from workflow.text.formats import count, number, share, si

# Share of the lines from which on the logs count as telling the loop at all of them; chosen.
_ALL_LINES = 0.99


def reference_sections(found: PlannedReference, input_unit: str, output_unit: str) -> list[Section]:
    """The planned records, and command and motion to expect."""
    plan = found.plan
    step_s = found.dt_s
    realisations = count(plan.realisations, "realisation")
    periods = count(plan.periods, "period")
    period = si(plan.period_samples * step_s, "s")
    lead_in = si(plan.lead_in_samples * step_s, "s")
    duration = si(plan.duration_s(step_s), "s")
    records = f"2 levels x {realisations}, {periods} of {period} behind {lead_in}, {duration} in all"
    lines = f"{found.lines_Hz.size}, {number(found.lines_Hz[0])} to {si(found.lines_Hz[-1], 'Hz')}, odd"
    if found.told <= _ALL_LINES:
        lines += f"; the logs show the loop at {share(found.told, 2)} of them"
    low, high = found.rms[0], found.rms[1]
    rms = f"{number(low)} and {si(high, output_unit)} about {si(found.offset, output_unit)}"
    if found.told:
        peak = number(found.command_peak.max())
        allowed = si(found.largest_command, input_unit)
        # The lower level is the one that friction may hide.
        least_rms = si(found.command_rms[0].min(), input_unit)
        motion_peak = number(found.motion_peak.max())
        motion_allowed = si(found.largest_motion, output_unit)
        expected = [
            worded("command", f"peak {peak} of {allowed} allowed, rms {least_rms}"),
            worded("motion", f"peak {motion_peak} of {motion_allowed} allowed"),
        ]
    else:
        expected = [
            worded("command", "not known: no reference is recorded; start with the lower level"),
        ]
    friction = "none shows"
    if found.friction:
        friction = si(found.friction, input_unit, 2)
        if not found.above_friction:
            friction += ": too near the command; allow more, or a narrower band"
    return [
        Section("reference", (worded("records", records), worded("lines", lines), worded("rms", rms))),
        Section("to expect", (*expected, worded("dry friction", friction))),
    ]
