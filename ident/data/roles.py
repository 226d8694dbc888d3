"""Which column of a log is time, input, output and reference, where names and units leave no doubt."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from ident.data.arrays import RealArray
from ident.data.causality import is_loop, is_moved_by, leads
from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import Unread, as_typed, shown
from ident.data.table import Table
from ident.data.text_numbers import is_number
from ident.data.units import (
    COUNTED,
    TIME_UNITS,
    begins_with_time_unit,
    ends_with_time,
    follows_as_it_stands,
    in_short,
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
    "angle|winkel|position|pos|theta|phi|alpha|tip|speed|velocity|vel|drehzahl|e?rpm|omega|encoder|enc|pv|hub|"
    "displacement|deflection|distance|travel|weg|observation"
)
_WORD = re.compile(rf"(?<![a-z])(?:({_DRIVES})|({_MOVES}))(?![a-z])", re.I)
# Letters that textbooks use, where a name has none of these words: v is a voltage, or a speed.
_SYMBOL = re.compile(r"(?:.*[/.])?(?:(u)|(y|q|output|counts)|(v))(?![a-z])", re.I)
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
# Letters in which names of a reference and its output differ behind what they share: y and yr, qg and qm.
_TWIN_LETTERS = 2
_MOST_TWINS = 12  # columns that are compared with each other: their number is squared
# Of what changes per time.
_RATE = re.compile(r"/s|_s|rpm|u/min|/min|hz", re.I)
_RATE_NAME = re.compile(
    r"(^|[^a-z])(speed|velocity|vel|drehzahl|omega|accel\w*|acc|rate|e?rpm)(?![a-z])", re.I
)


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
    """The columns of one channel, and the reference: what is wished for the output, in its unit.

    In a closed loop the one column that is left is the role that is missing.

    Parameters
    ----------
    table
        The log.
    log, command
        What a complaint offers to type: 'flexlink COMMAND LOG ...'; log as a shell takes it, with the options
        that were given and are no roles.
    stated
        input, output, time and reference, as far as the user named them.

    Raises
    ------
    ValueError
        A role has no column or several: the message names them, and ends with a command that works.
    """
    moving = [name for name in table.names if _is_signal(table, name)]
    time = stated.get("time") or time_of(table)
    taken = {time, *stated.values()}
    free = [name for name in moving if name not in taken]
    role = {name: _role_by_name(table, name) for name in free}
    role |= _roles_of_v(role)
    beside = {name for name in free if _BESIDE.search(in_short(name))}

    # What the motion should be, by its name, else by its twin and the numbers of both.
    drives = [name for name in free if role[name] == "input"]
    wished = [name for name in free if _is_wished(table, name) and kind_of(table.unit(name)) not in _DRIVEN]
    if not (stated.get("input") or set(drives) - set(wished)):
        wished = [name for name in wished if name not in drives]
    loop = None if wished or stated.get("reference") else _loop_of_twins(table, free, role, beside, stated)
    if loop is not None:
        wished = [loop.reference]
        drives = [loop.command]
        role[loop.output] = "output"
    inputs = _not_in(beside, [name for name in drives if name not in wished])

    # Of a position and a speed the one that something is wished for.
    moves = [name for name in free if role[name] == "output" and name not in wished]
    moves = moves or [name for name in free if role[name] == "counted" and name not in wished]
    outputs = [loop.output] if loop is not None else _not_in(beside, moves)
    like = {_quantity(table, name) for name in wished}
    input_ = stated.get("input") or _only(inputs)
    output = stated.get("output") or _only([name for name in outputs if _quantity(table, name) in like])
    output = output or _only(outputs)

    # In a loop one column that is left takes the role that is missing.
    known = {*drives, *moves, *wished, *beside}
    left = [name for name in free if name not in known]
    left = [name for name in left if not (_is_text(table.raw[name]) or _holds(table, name, counts_rows))]
    in_loop = bool(wished or stated.get("reference"))
    if in_loop and len(left) == 1 and kind_of(table.unit(left[0])) in ("", *COUNTED):
        input_ = input_ or (None if inputs else left[0])
        output = output or (None if outputs or input_ == left[0] else left[0])
    if input_ is None or output is None or input_ == output:
        named = stated | {"input": input_, "output": output, "time": time}
        _ask(table, f"flexlink {command} {log}", named, inputs, outputs, wished, left)

    roles = Roles(time, input_, output, stated.get("reference"))
    if roles.reference or not wished:
        return roles
    return _with_reference(table, roles, wished, f"flexlink {command} {log} {_typed(stated)}".rstrip())


def _with_reference(table: Table, roles: Roles, wished: Sequence[str], typed: str) -> Roles:
    """The roles with the reference: of what is wished what is in the output's unit, else of its quantity; a
    doubt where the only one is in another unit. typed: the command so far. Raises ValueError for several."""
    output_unit = table.unit(roles.output)
    candidates = [name for name in wished if name not in (roles.input, roles.output)]
    fitting = [name for name in candidates if table.unit(name) in ("", output_unit) or not output_unit]
    # A position and a speed may both have a set point.
    alike = [name for name in fitting if _quantity(table, name) == _quantity(table, roles.output)]
    if alike and len(fitting) > 1:
        fitting = alike
    if len(fitting) > 1:
        listed = shown(" and ".join(shown(name, 30) for name in fitting), 90)
        raise ValueError(
            f"{table.path}: {listed} may be the reference of '{shown(roles.output, 30)}'; type: {typed} "
            f"{_typed({'reference': fitting[0]})}"
        )
    other = _only(candidates)
    unit = table.unit(other or "")
    if fitting or other is None or is_position(other, unit) != is_position(roles.output, output_unit):
        return replace(roles, reference=_only(fitting))

    factor = per(unit, output_unit)
    same = False
    with suppress(ValueError):  # cells that hold no number are somebody else's to say
        same = follows_as_it_stands(*table.columns([other, roles.output]).values())
    scaled = scaled_by(other, factor) if factor else f"--scale {as_typed(f'{other}=FACTOR')}"
    header = f"--unit {as_typed(f'{other}={output_unit}')}"
    options = f"--reference {as_typed(other)} {header if same else scaled}"
    told = {"name": other, "unit": unit, "output": roles.output, "of": output_unit, "options": options}
    return replace(roles, doubts=(finding(FindingKind.UNIT_OF_REFERENCE, **told, same=same),))


@dataclass(frozen=True)
class _Loop:
    """Columns of a closed loop, as their numbers tell them."""

    reference: str
    output: str
    command: str


def _loop_of_twins(
    table: Table,
    free: Sequence[str],
    role: Mapping[str, str],
    beside: set[str],
    stated: Mapping[str, str | None],
) -> _Loop | None:
    """The loop of two columns whose names differ behind their first letters alone ('y' and 'yr', 'x1_mm' and
    'xr_mm', 'qm' and 'qg') where the numbers leave no doubt: a command moves the one and not the other, which
    it follows. Two positions that a command moves are two measured ones. role: by name, as by
    `_role_by_name`; beside: columns that are neither. None where there is no such loop, or several."""
    signals = [name for name in free if name not in beside and not _is_text(table.raw[name])]
    signals = [name for name in signals if not _increases(table, name)]  # rather time, or a row's number
    named_inputs = [name for name in signals if role[name] == "input"]
    motions = [name for name in (*signals, stated.get("output")) if name and role.get(name) != "input"]
    if len(motions) > _MOST_TWINS:
        return None
    loops = list[_Loop]()
    for number, first in enumerate(motions):
        for second in motions[number + 1 :]:
            if not _are_twins(table, first, second):
                continue
            others = [name for name in motions if name not in (first, second)]
            command = stated.get("input") or _only(named_inputs) or (None if named_inputs else _only(others))
            if command is None:
                continue
            for reference, output in ((first, second), (second, first)):
                if stated.get("output") in (None, output) and _is_loop(table, reference, output, command):
                    loops.append(_Loop(reference, output, command))
    return loops[0] if len(loops) == 1 else None


def _are_twins(table: Table, first: str, second: str) -> bool:
    """Whether two names have one unit and one beginning, and differ in two letters behind it at most."""
    if table.unit(first) != table.unit(second):
        return False
    unit = table.unit(first).replace("/", "_")
    bare = [in_short(name).removesuffix(unit) for name in (first, second)]
    stems = [re.sub(r"[\W_]+", "", name).lower() for name in bare]
    shared = 0
    for one, other in zip(*stems, strict=False):
        if one != other:
            break
        shared += 1
    rests = [stem[shared:] for stem in stems]
    # x1 and x2, channel 1 and channel 2 are numbered, not paired.
    numbered = all(rest.isdigit() for rest in rests)
    return shared > 0 and not numbered and max(map(len, rests)) <= _TWIN_LETTERS


def _is_loop(table: Table, reference: str, output: str, command: str) -> bool:
    """Whether the numbers of three columns are those of a closed loop."""
    with suppress(ValueError):  # cells that hold no number are somebody else's to say
        return is_loop(*table.columns([reference, output, command]).values())
    return False


def _ask(
    table: Table,
    typed: str,
    known: Mapping[str, str | None],
    inputs: list[str],
    outputs: list[str],
    wished: list[str],
    left: list[str],
) -> NoReturn:
    """The complaint that a role has no column or several.

    typed: the command so far; known: the columns of roles that are; left: columns of no role.
    """
    for role, candidates in (("input", inputs), ("output", outputs)):
        still = [name for name in table.names if not (is_time(table, name) or _is_signal(table, name))]
        still = [name for name in still if _role_by_name(table, name) == role and not _is_wished(table, name)]
        if still and not candidates and not known[role]:
            raise ValueError(
                f"{table.path}: '{shown(still[0], 30)}' stands still, so that nothing can be identified from "
                f"this log; leave it out, or name the {role} if it is another column: {typed} --{role} NAME"
            )
    listed = shown(", ".join(shown(name, 30) for name in table.names), 90)
    reference = known.get("reference") or next(iter(wished), None)
    pair = None if known["output"] or reference else _led_and_follower(table, outputs)
    alone = not left if outputs else len(left) < 2 and not wished
    if alone and not inputs and not known["input"]:
        named = _typed({"input": pair[0], "output": pair[1]}) if pair else "--input NAME"
        raise ValueError(
            f"{table.path}: no column looks like an input; it has {listed}. A model needs what drives the "
            f"machine (in V, A, N or Nm): record it too, or name it: {typed} {named}"
        )
    # Of several that fit the one that is sent before the one that a sensor read, and two different ones.
    sent = [name for name in inputs if not _MEASURED.search(in_short(name))]
    # A supply's voltage, or the current of another axis, does not move the output.
    if known["output"] or len(outputs) == 1:
        moved = known["output"] or outputs[0]
        sent = [name for name in [*sent, *inputs] if _is_moved(table, moved, name)] or sent
    only_left = left if len(left) == 1 and (inputs or outputs) else []
    command = known["input"] or next(
        (name for name in [*sent, *inputs, *only_left] if name != known["output"]), "NAME"
    )
    # A column that the command moves was measured: it is no reference of the other one.
    if pair and command in table.names and _is_moved(table, pair[0], command):
        pair = None
    output = pair[1] if pair else known["output"]
    others = [name for name in [*outputs, *only_left, *inputs[::-1]] if name != command]
    output = output or next(iter(others), "NAME")
    if not pair and not known.get("reference") and output in table.names:
        of_output = [name for name in wished if _quantity(table, name) == _quantity(table, output)]
        reference = next(iter(of_output), reference)
    times = times_in(table) or rising(table)
    options = {
        "input": command,
        "output": output,
        "reference": pair[0] if pair else reference,
        "time": known["time"] or next(iter(times), None),
    }
    options["dt-s"] = None if options["time"] or "--dt-s " in typed else "SECONDS"
    several = {"input": inputs, "output": outputs}
    which = [
        f"which is the {role}" + (", " if names else "") + shown(" or ".join(shown(n, 20) for n in names), 60)
        for role, names in several.items()
        if not known[role]
    ]
    asked = " and ".join(which) or "which are input and output"
    raise ValueError(f"{table.path}: {asked}? It has {listed}; type: {typed} {_typed(options)}")


def _typed(options: Mapping[str, str | None]) -> str:
    """Options as they are typed, names in full."""
    return " ".join(f"--{role} {as_typed(name)}" for role, name in options.items() if name)


def _not_in(others: set[str], names: list[str]) -> list[str]:
    """Those that are none of the others; all where none is left."""
    return [name for name in names if name not in others] or names


def _only(names: Sequence[str]) -> str | None:
    return names[0] if len(names) == 1 else None


def _led_and_follower(table: Table, names: list[str]) -> tuple[str, str] | None:
    """Of two columns in one unit the one that leads, by its name or as the other follows its changes, and the
    other; None where they tell neither."""
    if len(names) != 2 or table.unit(names[0]) != table.unit(names[1]):
        return None
    called = [name for name in names if any(found[1] for found in _WORD.finditer(in_short(name)))]
    if len(called) == 1:
        return called[0], names[1 - names.index(called[0])]
    with suppress(ValueError):
        first_leads = leads(*table.columns(names).values())
        if first_leads is not None:
            return (names[0], names[1]) if first_leads else (names[1], names[0])
    return None


def _is_moved(table: Table, name: str, command: str) -> bool:
    """Whether a command moves a column, as far as their numbers tell."""
    with suppress(ValueError):
        return is_moved_by(*table.columns([name, command]).values())
    return False


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
    if not found:
        maybe = [name for name in table.names if ends_with_time(name) or begins_with_time_unit(name)]
        found = [name for name in maybe if _increases(table, name)]
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
    return _RATE_NAME.search(in_short(name)) is None


def _quantity(table: Table, name: str) -> tuple[str, bool]:
    """The unit of a column, and whether it is a position."""
    unit = table.unit(name)
    return unit, is_position(name, unit)


def _is_wished(table: Table, name: str) -> bool:
    short = in_short(name)
    bare = short.removesuffix(table.unit(name).replace("/", "_"))
    while bare and not bare[-1].isalnum():
        bare = bare[:-1]
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", short)  # posRef, SetAngle
    return _WISHED.search(apart) is not None or bare.lower() == "r"


def _role_by_name(table: Table, name: str) -> str:
    """What a column is: 'input', 'output', 'v' (a voltage or a speed), 'counted', or empty.

    Its unit says it, where there is one, else the last word of its name that speaks of either, else the
    letter that it begins with. A unit of counts leaves it to the name, else 'counted'.
    """
    unit = table.unit(name)
    kind = kind_of(unit)
    if unit and kind not in COUNTED:
        if kind in _DRIVEN:
            return "input"
        return "output" if kind in _MOVED else ""
    words = list(_WORD.finditer(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", in_short(name))))
    if words:
        return "input" if words[-1][1] else "output"
    symbol = None if unit else _SYMBOL.match(in_short(name))
    if symbol:
        if symbol[3]:
            return "v"
        return "input" if symbol[1] else "output"
    if kind == "%":
        return "input"
    return "counted" if unit else ""


def _roles_of_v(role: Mapping[str, str]) -> dict[str, str]:
    """What columns called v are.

    They are voltages unless another column is the input; then speeds, unless another one is the output.
    """
    ambiguous = [name for name, kind in role.items() if kind == "v"]
    kinds = set(role.values())
    if "input" not in kinds:
        return dict.fromkeys(ambiguous, "input")
    return dict.fromkeys(ambiguous, "" if "output" in kinds else "output")
