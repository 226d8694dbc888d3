"""Which column of a log is time, input, output and reference, where names and units leave no doubt."""

from __future__ import annotations

import re
import shlex
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import shown
from ident.data.table import Table
from ident.data.units import (
    COUNTED,
    TIME_UNITS,
    ends_with_time,
    follows_as_it_stands,
    kind_of,
    per,
    says_time,
    scaled_by,
)

_INPUT = re.compile(
    r"(u|v|input|command|commanded|cmd|drive|voltage|spannung|current|strom|torque|moment|force|pwm|duty)(?![a-z])",
    re.I,
)
_OUTPUT = re.compile(
    r"(y|output|angle|winkel|position|pos|theta|phi|alpha|q|tip|speed|velocity|drehzahl|encoder|enc|counts|hub)"
    r"(?![a-z])",
    re.I,
)
# What the motion should be: the command of a control loop, neither its drive nor what a sensor read.
_WISHED = re.compile(
    r"(^|[^a-z])(ref|reference|setpoint|set_point|set|sp|desired|target|soll[a-z]*|vorgabe|des|demand|goal|"
    r"consigne|consigna|referencia|riferimento)(?![a-z])|给定|设定|目标|参考|目標|"
    r"(^|[^a-z])(cmd|command|commanded)_?(pos|position|angle|theta|q|speed|vel|velocity)(?![a-z])|"
    r"(^|[^a-z])(pos|position|angle|theta|q|speed|vel|velocity)_?(cmd|command|commanded)(?![a-z])",
    re.I,
)
# A column of nothing but this name and a unit is the reference of textbooks.
_TEXTBOOK = re.compile(r"r", re.I)
# The difference of two other columns.
_ERROR = re.compile(r"(^|[^a-z])(e|err|error|fehler|abweichung|regelabweichung|residual)(?![a-z])", re.I)
# Of a PLC's variable, its type: rVoltage, lrAngle.
_PREFIX = re.compile(r"^(l?r|f|n|i|di|ui|w)(?=[A-Z])")
# Units by their kind.
_DRIVEN = frozenset({"V", "A", "N", "Nm"})
_MOVED = frozenset(f"{kind}{rate}" for kind in ("rad", "m", *COUNTED - {"%"}) for rate in ("", "/s", "/s2"))
# Least correlation of the changes of a set point and of what follows it.
_FOLLOWS = 0.5
# Of what changes per time.
_RATE = re.compile(r"/s|_s|rpm|u/min|/min|hz", re.I)
_RATE_NAME = re.compile(r"(^|[^a-z])(speed|velocity|vel|drehzahl|omega|accel\w*|acc|rate|rpm)(?![a-z])", re.I)


@dataclass(frozen=True)
class Roles:
    """Names of the columns; time and reference are None where no column looks like it. doubts: of a column
    that would be the reference, were it in the output's unit."""

    time: str | None
    input: str
    output: str
    reference: str | None = None
    doubts: tuple[Finding, ...] = ()


def roles_of(table: Table, log: str, command: str = "identify", **stated: str | None) -> Roles:
    """The columns of one channel. stated: input, output, time and reference as far as the user named them.
    log, command: what a complaint offers to type. Raises ValueError where a role has no column or several, or
    a reference beside them may mean a closed loop."""
    moving = [name for name in table.names if _is_signal(table, name)]
    time = stated.get("time") or time_of(table)
    rest = [name for name in moving if name not in (time, *stated.values())]
    wished = [name for name in rest if _is_wished(table, name)]
    inputs = _not_in(wished, [name for name in rest if _says(table, name, _DRIVEN, _INPUT)])
    outputs = _not_in(wished, [name for name in rest if _says(table, name, _MOVED, _OUTPUT)])
    outputs = _not_in([name for name in outputs if _ERROR.search(name)], outputs)
    input_, output = stated.get("input") or _only(inputs), stated.get("output") or _only(outputs)
    named = stated.get("input") and stated.get("output")
    wished = (
        [] if named or stated.get("reference") else [name for name in wished if name not in (input_, output)]
    )
    if input_ is not None and output is not None and input_ != output and not wished:
        return Roles(time, input_, output)
    for role, found, unit, word in (("input", inputs, _DRIVEN, _INPUT), ("output", outputs, _MOVED, _OUTPUT)):
        still = [name for name in table.names if name not in moving and _says(table, name, unit, word)]
        still = [name for name in still if not is_time(table, name) and not _is_wished(table, name)]
        if still and not found and not stated.get(role):
            raise ValueError(
                f"{table.path}: '{shown(still[0], 30)}' stands still, so that nothing can be identified from "
                f"this log; leave it out, or name the {role} if it is another column: flexlink {command} "
                f"{log} --{role} NAME"
            )
    listed = shown(", ".join(shown(name, 30) for name in table.names), 90)
    if outputs and not inputs and not stated.get("input") and set(rest) <= {*outputs, *wished}:
        raise ValueError(
            f"{table.path}: no column looks like an input; it has {listed}. A model needs what drives the "
            f"machine (in V, A, N or Nm): record it too, or name it: flexlink {command} {log} --input NAME"
        )
    # Of several that fit, two different ones.
    first = input_ or next((name for name in inputs if name != output), "NAME")
    second = output or next((name for name in [*outputs, *inputs] if name != first), "NAME")
    options = [("--input", first), ("--output", second)]
    reference = stated.get("reference") or _only(wished)
    if not (output or reference) and (pair := _led_and_follower(table, outputs)):
        reference, options[1] = pair[0], ("--output", pair[1])
    options += [("--reference", reference)] if reference else []
    times = [] if time else times_in(table) or rising(table)
    options += [("--time", time or times[0])] if time or times else [("--dt-s", "SECONDS")]
    typed = " ".join(f"{option} {shlex.quote(shown(value, 30))}" for option, value in options)
    raise ValueError(f"{table.path}: which columns? It has {listed}; type: flexlink {command} {log} {typed}")


def roles_with_reference(table: Table, log: str, command: str, **stated: str | None) -> Roles:
    """As `roles_of`, a reference column found as well: what is wished for the output, in its unit.

    Raises ValueError as there, and where several columns may be the reference: it names them.
    """
    if stated.get("reference"):
        return replace(roles_of(table, log, command, **stated), reference=stated["reference"])
    moving = [name for name in table.names if _is_signal(table, name) and name not in stated.values()]
    wished = [name for name in moving if _is_wished(table, name) and kind_of(table.unit(name)) not in _DRIVEN]
    drives = [name for name in moving if _says(table, name, _DRIVEN, _INPUT)]
    if not (stated.get("input") or set(drives) - set(wished)):
        wished = [name for name in wished if name not in drives]
    output = stated.get("output")
    if output is None and wished:
        # Of a position and a speed the one that something is wished for.
        like = {table.unit(name) for name in wished} - {""}
        moved = [name for name in moving if name not in wished and _says(table, name, _MOVED, _OUTPUT)]
        moved = _not_in([name for name in moved if _ERROR.search(name)], moved)
        output = _only([name for name in moved if table.unit(name) in like]) or _only(moved)
    roles = roles_of(
        table, log, command, **{**stated, "output": output, "reference": wished[0] if wished else None}
    )
    units = {"", table.unit(roles.output)}
    fitting = [
        name
        for name in wished
        if name not in (roles.input, roles.output)
        and (table.unit(name) in units or not table.unit(roles.output))
    ]
    if len(fitting) > 1:
        listed = shown(" and ".join(shown(name, 30) for name in fitting), 90)
        named = [("--" + role, name) for role, name in stated.items() if name] + [("--reference", fitting[0])]
        typed = " ".join(f"{option} {shlex.quote(shown(name, 30))}" for option, name in named)
        raise ValueError(
            f"{table.path}: {listed} may be the reference of '{shown(roles.output, 30)}'; type: flexlink "
            f"{command} {log} {typed}"
        )
    other = _only([name for name in wished if name not in (roles.input, roles.output)])
    unit, of = table.unit(other or ""), table.unit(roles.output)
    if fitting or other is None or is_position(other, unit) != is_position(roles.output, of):
        return replace(roles, reference=_only(fitting))
    factor, same = per(unit, of), False
    with suppress(ValueError):  # cells that hold no number are somebody else's to say
        same = follows_as_it_stands(*table.columns([other, roles.output]).values())
    scaled = scaled_by(other, factor) if factor else f"--scale {shlex.quote(f'{other}=FACTOR')}"
    header = f"--unit {shlex.quote(f'{other}={of}')}"
    options = f"--reference {shlex.quote(other)} {header if same else scaled}"
    told = {"name": other, "unit": unit, "output": roles.output, "of": of, "options": options}
    return replace(roles, doubts=(finding(FindingKind.UNIT_OF_REFERENCE, **told, same=same),))


def _not_in(wished: list[str], names: list[str]) -> list[str]:
    """Those that are no reference; all where none is left, as what drives the arm may be called one."""
    return [name for name in names if name not in wished] or names


def _only(names: list[str]) -> str | None:
    return names[0] if len(names) == 1 else None


def _led_and_follower(table: Table, names: list[str]) -> tuple[str, str] | None:
    """Of two columns the one that comes first and the one that follows it, in the same unit and by their
    changes; None where they tell neither."""
    if len(names) != 2 or table.unit(names[0]) != table.unit(names[1]):
        return None
    with suppress(ValueError):
        first, second = (
            np.diff(column) - np.mean(np.diff(column)) for column in table.columns(names).values()
        )
        size = np.linalg.norm(first) * np.linalg.norm(second)
        # By numpy: what needs no scipy is refused before that is loaded. No end meets a start.
        spectra = [np.fft.rfft(one, 2 * first.size) for one in (first, second)]
        alike = np.fft.irfft(spectra[0].conj() * spectra[1]) / max(size, np.finfo(float).tiny)
        late = int(np.argmax(alike))
        late -= 2 * first.size * (late > first.size)
        if late and np.max(alike) > _FOLLOWS:
            return (names[0], names[1]) if late > 0 else (names[1], names[0])
    return None


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


def rising(table: Table) -> list[str]:
    """The first column if it increases by no whole numbers, as a row's number does: it may be time."""
    return [
        name
        for name in table.names[:1]
        if _increases(table, name) and np.any(table.columns([name])[name] % 1 != 0)
    ]


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


def is_position(name: str, unit: str) -> bool:
    """Whether an output is a position by its unit, else by its name; not its speed or acceleration."""
    if unit:
        return "/" not in kind_of(unit) and _RATE.search(unit) is None
    return _RATE_NAME.search(name) is None


def _is_wished(table: Table, name: str) -> bool:
    bare = re.sub(r"[\W_]*$", "", name.removesuffix(table.unit(name).replace("/", "_")))
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)  # posRef, SetAngle
    return _WISHED.search(apart) is not None or _TEXTBOOK.fullmatch(bare) is not None


def _says(table: Table, name: str, kinds: frozenset[str], word: re.Pattern[str]) -> bool:
    """What the unit says, where there is one; else what the name does."""
    stated = table.unit(name)
    if stated:
        return kind_of(stated) in kinds
    # Of a topic, /cmd/voltage, and of a PLC's variable, PLC_PRG.rVoltage, the last word counts too.
    last = re.split(r"[/.]", name)[-1]
    return any(word.match(part) for part in (name, last, _PREFIX.sub("", last)))
