"""What a log holds: rows for a terminal, and a page."""

from __future__ import annotations

from collections.abc import Iterator

from markupsafe import Markup

from ident.data.text_tables import Layout
from ident.data.time_grid import LARGEST_JITTER
from workflow.describe.facts import (
    FirstScreen,
    Page,
    PageSection,
    Picture,
    Quantity,
    Row,
    Section,
    Table,
)
from workflow.look.log_look import ColumnLook, LogLook, ResponseLook, TimeLook
from workflow.text.findings.sentences import words as finding_words
from workflow.text.formats import count, number, share as percentage, si, sparkline

# Separators of a text table, as they are called.
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}
# Units of time stamps in full.
_TIME_UNITS = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
    "min": "minutes",
    "h": "hours",
}


def layout_words(layout: Layout) -> str:
    """How a text file is laid out."""
    separator = _SEPARATORS[layout.separator]
    decimal = "comma"
    if layout.decimal == ".":
        decimal = "point"
    names = "no line of names"
    if layout.header:
        names = f"names in line {layout.header}"
    units = ""
    if layout.units:
        units = ", a line of units"
    numbers = f"numbers from line {layout.first}"
    return f"separated by {separator}, decimal {decimal}, {names}{units}, {numbers}"


def sampling_words(time: TimeLook) -> str:
    """Period, unit, jitter and missing rows of a column of time, or why it cannot be used."""
    if time.why:
        return f"not usable: {time.why}"
    runs = ""
    if time.runs:
        how_many = count(len(time.runs), "run")
        first = time.runs[0]
        last = time.runs[-1]
        runs = f"{how_many} ({first} to {last}), each a record of its own; "
    # Five digits: a period that is a little off the nominal one is worth a look.
    period = si(time.period_s, "s", 5)
    if time.period_s < 1:
        period = si(1000 * time.period_s, "ms", 5)
    rate = si(1 / time.period_s, "Hz", 5)
    unit = _TIME_UNITS[time.unit]

    # Stamps that are rounded stray by that alone, which is no jitter of the clock.
    jitter = f"jitter {percentage(time.jitter, 2)} of a step"
    if time.rounded:
        jitter = "stamps rounded to their last digit"
    elif not time.jitter:
        jitter = "no jitter"

    missing = "no row missing"
    if time.missing:
        rows = count(time.missing, "row")
        gap = si(time.gap_s, "s")
        missing = f"{rows} missing, the largest step {gap} at {time.gap_place}"
    elif time.jitter > LARGEST_JITTER:
        missing = "on no uniform grid"

    advice = ""
    if time.option == "split":
        advice = ": split the file there"
    elif time.option:
        advice = f": flexlink run takes that by itself, identify with {time.option}"
    return f"{runs}every {period} ({rate}), read in {unit}; {jitter}; {missing}{advice}"


def response_words(response: ResponseLook) -> str:
    """Size and range of a frequency response, or why it is not understood."""
    if response.why:
        return f"not understood: {response.why}"
    spread = "repeated, so its spread is known"
    if response.spread:
        spread = "with variances"
    elif response.points == response.frequencies:
        spread = "one sweep, so its spread is not known"
    points = count(response.points, "point")
    frequencies = count(response.frequencies, "frequency", "frequencies")
    lowest = number(response.low_Hz, 4)
    highest = si(response.high_Hz, "Hz", 4)
    return f"{points} at {frequencies}, {lowest} to {highest}; {spread}"


def signal_words(column: ColumnLook) -> str:
    """Range, resolution and limits of a column, or why it holds no numbers."""
    if column.values is None:
        return column.why
    low = column.values.min()
    high = column.values.max()
    words = f"{number(low, 4)} to {si(high, column.unit, 4)}"
    if not column.unit:
        words += " (no unit in the name)"
    if low == high:
        words += ", stands still"
    if column.step:
        words += f", steps of {si(column.step, column.unit, 4)}"
    if column.clipped:
        share = percentage(column.clipped, 2)
        words += f", {share} of the samples stand at the limit: saturated or clipped?"
    return words


def was_in_closed_loop(log_look: LogLook) -> bool:
    """Whether the log has a reference or leaves doubts: all logs of the machine are asked for then."""
    return log_look.roles is not None and bool(log_look.roles.reference or log_look.roles.doubts)


def look_sections(log_look: LogLook) -> list[Section]:
    """Rows of a terminal."""
    file = [_said("rows", str(log_look.rows))]
    if log_look.layout is not None:
        file.append(_said("layout", layout_words(log_look.layout)))
    title = "time"
    if log_look.response:
        title = "frequency response"
    taken = [_said(role, name) for role, name in log_look.taken_as.items()]
    doubts = [_said(str(k), finding_words(doubt)) for k, doubt in enumerate(log_look.doubts, 1)]
    next_rows: tuple[Row, ...] = ()
    if log_look.taken_as and was_in_closed_loop(log_look):
        advice = (
            "give flexlink run all logs of the machine: the last one validates, and one alone may hide a mode"
        )
        next_rows = (_said("logs", advice),)
    sections = [
        Section("file", tuple(file)),
        Section(title, (_time_row(log_look),)),
        Section("doubts", tuple(doubts)),
        Section("taken as", tuple(taken)),
        Section("signals", tuple(_signal_rows(log_look))),
        Section("next", next_rows),
    ]
    return [section for section in sections if section.rows]


def _said(name: str, words: str) -> Row:
    return Row("", name, Quantity.words(words))


def _time_row(log_look: LogLook) -> Row:
    if log_look.response is not None:
        return _said("points", response_words(log_look.response))
    if log_look.time is None:
        return _said(
            "none", "no column looks like time: name it with --time, or state --dt-s in flexlink identify"
        )
    return _said(log_look.time.name, sampling_words(log_look.time))


def _signal_rows(log_look: LogLook) -> Iterator[Row]:
    """Every column in words, and as a curve of bars."""
    for column in log_look.columns:
        yield _said(column.name, signal_words(column))
        if column.values is None:
            continue
        # A column that stands still has no curve.
        bars = sparkline(column.values.tolist())
        if bars:
            yield _said("", bars)


def look_page(log_look: LogLook, next_command: str) -> Page:
    """The page of a log. next_command: what to type now, or what has to be done before."""
    if log_look.response is not None:
        time = f"Frequency response: {response_words(log_look.response)}"
    elif log_look.time is None:
        time = "Time: no column looks like it"
    else:
        time = f"Time: {log_look.time.name}, {sampling_words(log_look.time)}"
    bullets = [_onward(log_look, next_command)]
    bullets += [f"Doubt: {finding_words(doubt)}" for doubt in log_look.doubts]
    bullets.append(time)
    if log_look.layout is not None:
        bullets.append(f"Layout: {layout_words(log_look.layout)}")
    if log_look.taken_as:
        roles = "; ".join(f"{role}: {name}" for role, name in log_look.taken_as.items())
        bullets.append(f"Taken as {roles}")
    rows = [(column.name, signal_words(column)) for column in log_look.columns]
    signals = Table(("column", "what it holds"), tuple(rows))
    how_many_rows = count(log_look.rows, "row")
    how_many_signals = count(len(log_look.columns), "signal")
    headline = f"{how_many_rows}, {how_many_signals}"
    picture = Picture("log", "Every column of numbers.", (log_look,))
    first = FirstScreen(headline, "plain", (), tuple(bullets), picture, "file", "File")
    section = PageSection("signals", "Signals", "Signals", (signals,), open=True)
    return Page(f"Log {log_look.path.name}", first, (section,))


def _onward(log_look: LogLook, next_command: str) -> str:
    """The next command as code, behind what has to be known of it."""
    before, _, command = next_command.rpartition("; type: ")
    if before:
        before = f"{before.removeprefix(f'{log_look.path}: ')}; type "
    # Where there is no command it is what has to be done before.
    as_code = command
    if command.startswith("flexlink"):
        as_code = Markup("<code>{}</code>").format(command)
    logs = ""
    if was_in_closed_loop(log_look):
        logs = ", with all logs of the machine"
    return Markup("Next: {}{}{}").format(before, as_code, logs)
