"""Which column of a log is time, input, output and reference, where names and units leave no doubt."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import Unread, shown
from ident.data.table import Table
from ident.data.text_tables import is_number
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
from ident.data.wrapping import counts_rows

# What a name speaks of is its last such word: the current position is a position.
_DRIVES = (
    "input|commanded|command|cmd|drive|voltage|volts?|spannung|current|strom|torque|moment|force|pwm|duty|dac|"
    "effort|throttle|action"
)
_MOVES = (
    "angle|winkel|position|pos|theta|phi|alpha|tip|speed|velocity|vel|drehzahl|encoder|enc|pv|hub|observation"
)
_WORD = re.compile(rf"(?<![a-z])(?:({_DRIVES})|({_MOVES}))(?![a-z])", re.I)
_SYMBOL = re.compile(r"(?:.*[/.])?(?:([uv])|(y|q|output|counts))(?![a-z])", re.I)
# What the motion should be: the command of a control loop, neither its drive nor what a sensor read.
_WISHED = re.compile(
    rf"(^|[^a-z])(ref|reference|setpoint|set_point|set|sp|desired|target|soll[a-z]*|vorgabe|des|demand|goal|"
    rf"consigne|consigna|referencia|riferimento)(?![a-z])|给定|设定|目标|参考|目標|"
    rf"(^|[^a-z])(cmd|command|commanded)_?({_MOVES}|q)(?![a-z])|"
    rf"(^|[^a-z])({_MOVES}|q)_?(cmd|command|commanded)(?![a-z])",
    re.I,
)
# What neither drives nor shows the machine: computed of other columns, of another quantity, a number of rows.
_BESIDE = re.compile(
    r"(^|[^a-z])(e|err|error|fehler|abweichung|regelabweichung|residual|est|estimate|estimated|hat|obs|observer|"
    r"filt|filtered|predicted|sim|temp|temperature?|status|mode|flags?|id|seq|index|idx|counter)(?![a-z])",
    re.I,
)
# Of what drives the machine, as a sensor read it.
_MEASURED = re.compile(r"(^|[^a-z])(meas|measured|act|actual|ist|fb|feedback|sensed?)(?![a-z])", re.I)
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
    """The columns of one channel, and the reference: what is wished for the output, in its unit. In a closed
    loop the one column that is left is the role that is missing. stated: input, output, time and reference as
    far as the user named them. log, command: what a complaint offers to type. Raises ValueError where a role
    has no column or several: it names them."""
    moving = [name for name in table.names if _is_signal(table, name)]
    time = stated.get("time") or time_of(table)
    rest = [name for name in moving if name not in (time, *stated.values())]
    said = {name: _said(table, name) for name in rest}
    drives = [name for name in rest if said[name] == "input"]
    wished = [name for name in rest if _is_wished(table, name) and kind_of(table.unit(name)) not in _DRIVEN]
    if not (stated.get("input") or set(drives) - set(wished)):
        wished = [name for name in wished if name not in drives]
    beside = [name for name in rest if _BESIDE.search(name)]
    inputs = _not_in(beside, [name for name in drives if name not in wished])
    moves = [name for name in rest if said[name] == "output" and name not in wished]
    moves = moves or [name for name in rest if said[name] == "counted" and name not in wished]
    outputs = _not_in(beside, moves)
    # Of a position and a speed the one that something is wished for.
    like = {table.unit(name) for name in wished} - {""}
    output = stated.get("output") or _only([name for name in outputs if table.unit(name) in like])
    input_, output = stated.get("input") or _only(inputs), output or _only(outputs)
    left = [name for name in rest if name not in (*drives, *moves, *wished, *beside)]
    left = [name for name in left if not (_is_text(table.raw[name]) or _holds(table, name, counts_rows))]
    loop = wished or stated.get("reference")
    if loop and len(left) == 1 and kind_of(table.unit(left[0])) in ("", *COUNTED):
        input_ = input_ or (None if inputs else left[0])
        output = output or (None if outputs or input_ == left[0] else left[0])
    if input_ is None or output is None or input_ == output:
        named = stated | {"input": input_, "output": output, "time": time}
        _ask(table, f"flexlink {command} {log}", named, inputs, outputs, wished, left)
    roles = Roles(time, input_, output, stated.get("reference"))
    if roles.reference or not wished:
        return roles
    units = {"", table.unit(roles.output)}
    fitting = [
        name
        for name in wished
        if name not in (roles.input, roles.output)
        and (table.unit(name) in units or not table.unit(roles.output))
    ]
    if len(fitting) > 1:
        listed = shown(" and ".join(shown(name, 30) for name in fitting), 90)
        typed = _typed({**stated, "reference": fitting[0]})
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


def _ask(
    table: Table,
    typed: str,
    found: Mapping[str, str | None],
    inputs: list[str],
    outputs: list[str],
    wished: list[str],
    left: list[str],
) -> NoReturn:
    """The complaint that a role has no column or several. typed: the command so far; found: what is known."""
    for role, candidates in (("input", inputs), ("output", outputs)):
        still = [name for name in table.names if not (is_time(table, name) or _is_signal(table, name))]
        still = [name for name in still if _said(table, name) == role and not _is_wished(table, name)]
        if still and not candidates and not found[role]:
            raise ValueError(
                f"{table.path}: '{shown(still[0], 30)}' stands still, so that nothing can be identified from "
                f"this log; leave it out, or name the {role} if it is another column: {typed} --{role} NAME"
            )
    listed = shown(", ".join(shown(name, 30) for name in table.names), 90)
    reference = found.get("reference") or next(iter(wished), None)
    pair = None if found["output"] or reference else _led_and_follower(table, outputs)
    alone = not left if outputs else len(left) < 2 and not wished
    if alone and not inputs and not found["input"]:
        named = _typed({"input": pair[0], "output": pair[1]}) if pair else "--input NAME"
        raise ValueError(
            f"{table.path}: no column looks like an input; it has {listed}. A model needs what drives the "
            f"machine (in V, A, N or Nm): record it too, or name it: {typed} {named}"
        )
    # Of several that fit the one that is sent before the one that a sensor read, and two different ones.
    sent = [name for name in inputs if not _MEASURED.search(name)]
    one = left if len(left) == 1 and (inputs or outputs) else []
    first = found["input"] or next(
        (name for name in [*sent, *inputs, *one] if name != found["output"]), "NAME"
    )
    second = pair[1] if pair else found["output"]
    second = second or next((name for name in [*outputs, *one, *inputs[::-1]] if name != first), "NAME")
    times = times_in(table) or rising(table)
    options = {
        "input": first,
        "output": second,
        "reference": pair[0] if pair else reference,
        "time": found["time"] or next(iter(times), None),
    }
    options["dt-s"] = None if options["time"] else "SECONDS"
    several = {"input": inputs, "output": outputs}
    which = [
        f"which is the {role}" + (", " if names else "") + shown(" or ".join(shown(n, 20) for n in names), 60)
        for role, names in several.items()
        if not found[role]
    ]
    asked = " and ".join(which) or "which are input and output"
    raise ValueError(f"{table.path}: {asked}? It has {listed}; type: {typed} {_typed(options)}")


def _typed(options: Mapping[str, str | None]) -> str:
    return " ".join(f"--{role} {shlex.quote(shown(name, 30))}" for role, name in options.items() if name)


def _not_in(others: list[str], names: list[str]) -> list[str]:
    """Those that are none of the others; all where none is left."""
    return [name for name in names if name not in others] or names


def _only(names: list[str]) -> str | None:
    return names[0] if len(names) == 1 else None


def _led_and_follower(table: Table, names: list[str]) -> tuple[str, str] | None:
    """Of two columns in one unit the one that leads, by its name or as the other follows its changes, and the
    other; None where they tell neither."""
    if len(names) != 2 or table.unit(names[0]) != table.unit(names[1]):
        return None
    called = [name for name in names if any(found[1] for found in _WORD.finditer(name))]
    if len(called) == 1:
        return called[0], names[1 - names.index(called[0])]
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


def _holds(table: Table, name: str, what: Callable[[RealArray], object], otherwise: bool = False) -> bool:
    """Whether something holds of the numbers of a column; otherwise: of one that has none."""
    with suppress(ValueError):
        return bool(what(table.columns([name])[name]))
    return otherwise


def _is_text(values: object) -> bool:
    """Whether a column holds words alone, or nothing that is read."""
    if isinstance(values, tuple):
        return not any(is_number(cell, sign) for cell in values for sign in ".,")
    return isinstance(values, Unread) or np.asarray(values).dtype.kind in "USO"


def _increases(table: Table, name: str) -> bool:
    return _holds(table, name, lambda values: np.all(np.diff(values) > 0))


def _is_signal(table: Table, name: str) -> bool:
    # One without numbers is not left out for another one in silence: who takes it is told what is wrong.
    return not is_time(table, name) and _holds(table, name, lambda values: np.ptp(values) > 0, otherwise=True)


def is_position(name: str, unit: str) -> bool:
    """Whether an output is a position by its unit, else by its name; not its speed or acceleration."""
    if unit:
        return "/" not in kind_of(unit) and _RATE.search(unit) is None
    return _RATE_NAME.search(name) is None


def _is_wished(table: Table, name: str) -> bool:
    bare = re.sub(r"[\W_]*$", "", name.removesuffix(table.unit(name).replace("/", "_")))
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)  # posRef, SetAngle
    return _WISHED.search(apart) is not None or bare.lower() == "r"


def _said(table: Table, name: str) -> str:
    """What a column is, 'input', 'output' or empty: its unit says it, where there is one, else its name; a
    unit of counts leaves it to the name, else 'counted'."""
    unit = table.unit(name)
    kind = kind_of(unit)
    if unit and kind not in COUNTED:
        return "input" if kind in _DRIVEN else "output" if kind in _MOVED else ""
    words = list(_WORD.finditer(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)))
    symbol = None if unit else _SYMBOL.match(name)
    if found := symbol or (words[-1] if words else None):
        return "input" if found[1] else "output"
    return "input" if kind == "%" else "counted" if unit else ""
