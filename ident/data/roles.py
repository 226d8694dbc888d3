"""Which column of a log is time, input and output, where names and units leave no doubt."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass

import numpy as np

from ident.data.foreign_files import shown
from ident.data.table import Table
from ident.data.units import TIME_UNITS, ends_with_time, says_time

_INPUT = re.compile(
    r"(u|v|input|command|cmd|drive|voltage|spannung|current|strom|torque|moment|force|pwm|duty)(?![a-z])",
    re.I,
)
_OUTPUT = re.compile(
    r"(y|output|angle|winkel|position|pos|theta|phi|alpha|q|tip|speed|velocity|drehzahl|encoder|counts|hub)"
    r"(?![a-z])",
    re.I,
)
# What the motion should be: the command of a control loop, neither its drive nor what a sensor read.
_WISHED = re.compile(
    r"(^|[^a-z])(ref|reference|setpoint|set_point|desired|target|soll|sollwert|des)(?![a-z])", re.I
)
# Of a PLC's variable, its type: rVoltage, lrAngle.
_PREFIX = re.compile(r"^(l?r|f|n|i|di|ui|w)(?=[A-Z])")
_DRIVEN = re.compile(r"[mkµμ]?(V|A|N|Nm)")
_MOVED = re.compile(r"[mµμ]?(rad|deg|m)((/|_)s2?|/s\^2|/s²)?|°|grad|[cm]m|rpm|u/min|counts?|ticks?", re.I)


@dataclass(frozen=True)
class Roles:
    """Names of the columns; time is None where no column looks like it."""

    time: str | None
    input: str
    output: str


def roles_of(table: Table, log: str, **stated: str | None) -> Roles:
    """The columns of one channel. stated: input, output, time and reference as far as the user named them.

    Raises ValueError where a role has no column or several, or where a reference beside them may mean a
    closed loop: it lists all columns, and says what to type.
    """
    moving = [name for name in table.names if _is_signal(table, name)]
    time = stated.get("time") or time_of(table)
    rest = [name for name in moving if name not in (time, *stated.values())]
    wished = [name for name in rest if _WISHED.search(name)]
    inputs = _not_in(wished, [name for name in rest if _says(table, name, _DRIVEN, _INPUT)])
    outputs = _not_in(wished, [name for name in rest if _says(table, name, _MOVED, _OUTPUT)])
    input_, output = stated.get("input") or _only(inputs), stated.get("output") or _only(outputs)
    named = stated.get("input") and stated.get("output")
    wished = (
        [] if named or stated.get("reference") else [name for name in wished if name not in (input_, output)]
    )
    if input_ is not None and output is not None and input_ != output and not wished:
        return Roles(time, input_, output)
    listed = shown(", ".join(shown(name, 30) for name in table.names), 90)
    if outputs and not inputs and not stated.get("input") and set(rest) <= {*outputs, *wished}:
        raise ValueError(
            f"{table.path}: no column looks like an input; it has {listed}. A model needs what drives the "
            f"machine (in V, A, N or Nm): record it too, or name it: flexlink identify {log} --input NAME"
        )
    # Of several that fit, two different ones.
    first = input_ or next((name for name in inputs if name != output), "NAME")
    second = output or next((name for name in [*outputs, *inputs] if name != first), "NAME")
    options = [("--input", first), ("--output", second)]
    reference = stated.get("reference") or _only(wished)
    options += [("--reference", reference)] if reference else []
    times = [] if time else times_in(table)
    options += [("--time", time or times[0])] if time or times else [("--dt-s", "SECONDS")]
    command = " ".join(f"{option} {shlex.quote(shown(value, 30))}" for option, value in options)
    raise ValueError(f"{table.path}: which columns? It has {listed}; type: flexlink identify {log} {command}")


def _not_in(wished: list[str], names: list[str]) -> list[str]:
    """Those that are no reference; all where none is left, as what drives the arm may be called one."""
    return [name for name in names if name not in wished] or names


def _only(names: list[str]) -> str | None:
    return names[0] if len(names) == 1 else None


def is_time(table: Table, name: str) -> bool:
    """Whether a column looks like time: dates, a unit of time, or its name."""
    if table.is_clock(name) or says_time(name):
        return True
    unit = TIME_UNITS.get(table.unit(name).lower(), "")
    # A suffix is no unit for certain: pos_min is a minimum.
    return bool(unit) and (unit not in ("min", "h") or not name.lower().endswith(f"_{unit}"))


def times_in(table: Table) -> list[str]:
    """The columns that look like time; of several those that increase."""
    found = [name for name in table.names if is_time(table, name)]
    found = found or [name for name in table.names if ends_with_time(name) and _increases(table, name)]
    return found if len(found) < 2 else [name for name in found if _increases(table, name)] or found


def time_of(table: Table) -> str | None:
    """The one column that looks like time, if there is one."""
    return _only(times_in(table))


def _increases(table: Table, name: str) -> bool:
    try:
        return bool(np.all(np.diff(table.columns([name])[name]) > 0))
    except ValueError:
        return False


def _is_signal(table: Table, name: str) -> bool:
    if is_time(table, name):
        return False
    try:
        return bool(np.ptp(table.columns([name])[name]) > 0)
    except ValueError:
        return True  # not left out for another one in silence: who takes it is told what is wrong with it


def _says(table: Table, name: str, unit: re.Pattern[str], word: re.Pattern[str]) -> bool:
    """What the unit says, where there is one; else what the name does."""
    stated = table.unit(name)
    if stated:
        return unit.fullmatch(stated) is not None
    # Of a topic, /cmd/voltage, and of a PLC's variable, PLC_PRG.rVoltage, the last word counts too.
    last = re.split(r"[/.]", name)[-1]
    return any(word.match(part) for part in (name, last, _PREFIX.sub("", last)))
