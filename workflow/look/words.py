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

_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}
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
    decimal = "point" if layout.decimal == "." else "comma"
    names = f"names in line {layout.header}" if layout.header else "no line of names"
    units = ", a line of units" if layout.units else ""
    return (
        f"separated by {_SEPARATORS[layout.separator]}, decimal {decimal}, {names}{units}, numbers from line "
        f"{layout.first}"
    )


def sampling_words(time: TimeLook) -> str:
    """Period, unit, jitter and missing rows of a column of time, or why it cannot be used."""
    if time.why:
        return f"not usable: {time.why}"
    runs = ""
    if time.runs:
        runs = (
            f"{count(len(time.runs), 'run')} ({time.runs[0]} to {time.runs[-1]}), each a record of its own; "
        )
    period = si(1000 * time.period_s, "ms", 5) if time.period_s < 1 else si(time.period_s, "s", 5)

    jitter = f"jitter {percentage(time.jitter, 2)} of a step"
    if time.rounded:
        jitter = "stamps rounded to their last digit"
    elif not time.jitter:
        jitter = "no jitter"

    missing = "no row missing"
    if time.missing:
        rows = count(time.missing, "row")
        missing = f"{rows} missing, the largest step {si(time.gap_s, 's')} at {time.gap_place}"
    elif time.jitter > LARGEST_JITTER:
        missing = "on no uniform grid"

    advice = ""
    if time.option == "split":
        advice = ": split the file there"
    elif time.option:
        advice = f": flexlink run takes that by itself, identify with {time.option}"
    return (
        f"{runs}every {period} ({si(1 / time.period_s, 'Hz', 5)}), read in {_TIME_UNITS[time.unit]}; "
        f"{jitter}; {missing}{advice}"
    )


def response_words(response: ResponseLook) -> str:
    """Size and range of a frequency response, or why it is not understood."""
    if response.why:
        return f"not understood: {response.why}"
    spread = "repeated, so its spread is known"
    if response.spread:
        spread = "with variances"
    elif response.points == response.frequencies:
        spread = "one sweep, so its spread is not known"
    frequencies = count(response.frequencies, "frequency", "frequencies")
    return (
        f"{count(response.points, 'point')} at {frequencies}, {number(response.low_Hz, 4)} to "
        f"{si(response.high_Hz, 'Hz', 4)}; {spread}"
    )


def signal_words(column: ColumnLook) -> str:
    """Range, resolution and limits of a column, or why it holds no numbers."""
    if column.values is None:
        return column.why
    low, high = column.values.min(), column.values.max()
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


def was_in_closed_loop(found: LogLook) -> bool:
    """Whether the log has a reference or leaves doubts: all logs of the machine are asked for then."""
    return found.roles is not None and bool(found.roles.reference or found.roles.doubts)


def look_sections(found: LogLook) -> list[Section]:
    """Rows of a terminal."""
    file = [_said("rows", str(found.rows))]
    if found.layout is not None:
        file.append(_said("layout", layout_words(found.layout)))
    title = "frequency response" if found.response else "time"
    taken = [_said(role, name) for role, name in found.taken_as.items()]
    doubts = [_said(str(k), finding_words(doubt)) for k, doubt in enumerate(found.doubts, 1)]
    next_rows: tuple[Row, ...] = ()
    if found.taken_as and was_in_closed_loop(found):
        advice = (
            "give flexlink run all logs of the machine: the last one validates, and one alone may hide a mode"
        )
        next_rows = (_said("logs", advice),)
    sections = [
        Section("file", tuple(file)),
        Section(title, (_time_row(found),)),
        Section("doubts", tuple(doubts)),
        Section("taken as", tuple(taken)),
        Section("signals", tuple(_signal_rows(found))),
        Section("next", next_rows),
    ]
    return [section for section in sections if section.rows]


def _said(name: str, words: str) -> Row:
    return Row("", name, Quantity.words(words))


def _time_row(found: LogLook) -> Row:
    if found.response is not None:
        return _said("points", response_words(found.response))
    if found.time is None:
        return _said(
            "none", "no column looks like time: name it with --time, or state --dt-s in flexlink identify"
        )
    return _said(found.time.name, sampling_words(found.time))


def _signal_rows(found: LogLook) -> Iterator[Row]:
    """Every column in words, and as a curve of bars."""
    for column in found.columns:
        yield _said(column.name, signal_words(column))
        bars = "" if column.values is None else sparkline(column.values.tolist())
        if bars:
            yield _said("", bars)


def look_page(found: LogLook, next_command: str) -> Page:
    """The page of a log. next_command: what to type now, or what has to be done before."""
    if found.response is not None:
        time = f"Frequency response: {response_words(found.response)}"
    elif found.time is None:
        time = "Time: no column looks like it"
    else:
        time = f"Time: {found.time.name}, {sampling_words(found.time)}"
    bullets = [_onward(found, next_command)]
    bullets += [f"Doubt: {finding_words(doubt)}" for doubt in found.doubts]
    bullets.append(time)
    if found.layout is not None:
        bullets.append(f"Layout: {layout_words(found.layout)}")
    if found.taken_as:
        roles = "; ".join(f"{role}: {name}" for role, name in found.taken_as.items())
        bullets.append(f"Taken as {roles}")
    signals = Table(
        ("column", "what it holds"),
        tuple((column.name, signal_words(column)) for column in found.columns),
    )
    first = FirstScreen(
        f"{count(found.rows, 'row')}, {count(len(found.columns), 'signal')}",
        "plain",
        (),
        tuple(bullets),
        Picture("log", "Every column of numbers.", (found,)),
        "file",
        "File",
    )
    sections = (PageSection("signals", "Signals", "Signals", (signals,), open=True),)
    return Page(f"Log {found.path.name}", first, sections)


def _onward(found: LogLook, next_command: str) -> str:
    """The next command as code, behind what has to be known of it."""
    before, _, command = next_command.rpartition("; type: ")
    if before:
        before = f"{before.removeprefix(f'{found.path}: ')}; type "
    as_code = Markup("<code>{}</code>").format(command) if command.startswith("flexlink") else command
    logs = ", with all logs of the machine" if was_in_closed_loop(found) else ""
    return Markup("Next: {}{}{}").format(before, as_code, logs)
