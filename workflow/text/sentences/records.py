"""How a log was read, what the files of a controller take, and why logs carry no model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ident.data.finding import Value
from workflow.text.formats import count, number, si
from workflow.text.options import option, setting_in_uncertainty

if TYPE_CHECKING:
    from ident.data.record import Record

# Units of a time column by their symbol, as a sentence says them.
_UNITS_OF_TIME = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
    "min": "minutes",
    "h": "hours",
}


def signals(
    outputs: Sequence[str],
    inputs: Sequence[str],
    units: Mapping[str, str],
    scale: Mapping[str, float],
    offset: Mapping[str, float],
) -> str:
    """Columns and units of a controller's error and command, in one line.

    Args:
        outputs: Names of columns.
        inputs: Names of columns.
        units: By column, "" where it is not known.
        scale: By column: quantity = scale * column + offset.
        offset: By column.
    """

    def column_words(name: str, is_command: bool) -> str:
        factor = scale.get(name, 1.0)
        add = offset.get(name, 0.0)
        if factor == 1 and not add:
            return f"{name} [{units[name]}]" if units[name] else name
        law = f"{units[name] or 'quantity'} = {number(factor, 6)} * column"
        if add:
            law += f" + {number(add, 6)}"
        # Whoever plays the command has to undo what the column adds.
        if add and is_command:
            law += f"; add {number(-add / factor, 6)} to it"
        return f"{name} as logged ({law})"

    errors = ", ".join(column_words(name, False) for name in outputs)
    commands = ", ".join(column_words(name, True) for name in inputs)
    return f"error: reference - measurement of {errors}; command: {commands}"


def signal(name: str, units: Sequence[str]) -> str:
    """A signal with its unit: "'voltage_V' in V", "'u' (no unit given)"."""
    return f"'{name}' in {units[0]}" if units and units[0] else f"'{name}' (no unit given)"


def time_base(record: Record) -> str:
    """How time was read: "time column 'Zeit [ms]': milliseconds, sampled every 2 ms, 8 s"."""
    words = ""
    column = record.time_column
    if column is not None:
        words = f"time column '{column.name}': {_UNITS_OF_TIME[column.unit]}"
        if column.stated:
            words += " as given"
            if column.in_header and column.in_header != column.unit:
                words += f" (its name says {column.in_header})"
        elif not column.in_header:
            words += " (no unit given)"
        words += ", "
    step = si(1000 * record.dt_s, "ms", 4) if record.dt_s < 1 else si(record.dt_s, "s", 4)
    return f"{words}sampled every {step}, {si(record.n_samples * record.dt_s, 's')}"


def cut_off(records: Sequence[Record], limit: float | None, unit: str) -> str:
    """How many samples of the command were beyond the amplifier's limit and clipped to it; "" for none."""
    cut = [record for record in records if record.cut]
    if not cut:
        return ""
    samples = sum(record.cut for record in cut)
    by_record = ", ".join(f"{record.name} ({record.cut})" for record in cut)
    return (
        f"{count(samples, 'sample')} of the command exceeded the amplifier's {si(limit, unit)} and "
        f"{'was' if samples == 1 else 'were'} clipped to it: {by_record}"
    )


def rate_part(from_rad_s: float | None, to_rad_s: float | None) -> str:
    """Part of a set: between which frequencies an axis changes from a rate into an inertia; None: open."""
    if from_rad_s is None:
        return f"slow rate below {si(to_rad_s, 'rad/s', 2)}"
    if to_rad_s is None:
        return f"slow rate above {si(from_rad_s, 'rad/s', 2)}"
    return f"slow rate from {number(from_rad_s, 2)} to {si(to_rad_s, 'rad/s', 2)}"


def loop_refused(finding: Mapping[str, Value], controlled: bool) -> str:
    """Why logs made in a loop carry no model.

    Args:
        finding: Values of the finding of the direct way.
        controlled: Whether a controller was stated.
    """
    reference = "without recorded reference"
    if "explained_percent" in finding:
        reference = f"whose reference explains {finding['explained_percent']:.2g} % of the input"
    words = (
        f"a loop {reference} fed back noise that moves the response by {finding['times']:.2g} radii of its "
        "ellipses"
    )
    if controlled:
        words += ", and the controller explains too little of the input"
    words += "; record with a reference (flexlink excite --closed-loop LOG...)"
    if not controlled:
        words += ", state closed_loop_data.controller"
    direct = option(None, "closed_loop_data.method", "'direct'")
    return f"{words}, or take the input as it is ({direct})"


def unexplained_logs(output: str, why: str, *, friction_known: bool) -> str:
    """Why no model of a loop's logs is given.

    Args:
        output: Name of the column.
        why: What the model misses.
        friction_known: Friction was identified with it, or the output is no position.
    """
    record = "Record"
    if not friction_known:
        setting = setting_in_uncertainty("response", '"without friction"')
        record = (
            f"In a loop dry friction is a common cause: if '{output}' is the position of the driven shaft, "
            f"identify friction with it ({setting}). Otherwise record"
        )
    return (
        f"no model of '{output}' explains these logs: {why}. {record} others (flexlink excite --closed-loop "
        "LOG...), or check what changes between the logs: load, filter, time stamps"
    )
