"""What `flexlink excite --closed-loop` plans, and what may be expected of it."""

from __future__ import annotations

from workflow.describe.facts import Section, worded
from workflow.tasks.reference_plan import PlannedReference
from workflow.text.formats import count, number, share, si

# Share of the lines from which on the logs count as telling the loop at all of them; chosen.
_ALL_LINES = 0.99


def reference_sections(found: PlannedReference, input_unit: str, output_unit: str) -> list[Section]:
    """The planned records, and command and motion to expect."""
    plan = found.plan
    step_s = found.dt_s
    records = (
        f"2 levels x {count(plan.realisations, 'realisation')}, {count(plan.periods, 'period')} of "
        f"{si(plan.period_samples * step_s, 's')} behind {si(plan.lead_in_samples * step_s, 's')}, "
        f"{si(plan.duration_s(step_s), 's')} in all"
    )
    lines = f"{found.lines_Hz.size}, {number(found.lines_Hz[0])} to {si(found.lines_Hz[-1], 'Hz')}, odd"
    if found.told <= _ALL_LINES:
        lines += f"; the logs show the loop at {share(found.told, 2)} of them"
    low, high = found.rms[0], found.rms[1]
    rms = f"{number(low)} and {si(high, output_unit)} about {si(found.offset, output_unit)}"
    if found.told:
        expected = [
            worded(
                "command",
                f"peak {number(found.command_peak.max())} of {si(found.largest_command, input_unit)} "
                f"allowed, rms {si(found.command_rms[0].min(), input_unit)}",
            ),
            worded(
                "motion",
                f"peak {number(found.motion_peak.max())} of {si(found.largest_motion, output_unit)} allowed",
            ),
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
