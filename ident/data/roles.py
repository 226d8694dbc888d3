"""Which column of a log is time, input, output and reference, where names and units leave no doubt.

Each column is judged by its unit, else by the last word of its name that speaks of a drive or a motion, else
by the letter that it begins with (`_role_by_name`). `roles_of` puts these together: columns that nothing
drives, set points, and in a closed loop the one column that is left for the role that is missing. Where names
tell no set point apart, the numbers of two columns with nearly one name may (`_loop_of_twins`, by Granger's
test in `ident.data.causality`).

What remains in doubt is asked for: every complaint ends with a command that works as it is typed (`_ask`). It
proposes columns by weaker signs, as whether a command moves them; these decide nothing by themselves.

Of a `Table` matter here `names`, the cells by name (`raw`: text or arrays), `unit(name)` ('' for none) and
`columns(names)`: finite numbers (T,) by name, or ValueError. Every name that functions take is a column of
the table; another one ends in KeyError where its cells are asked for. A number in `shown(text, 30)` is how
many characters of a name a complaint quotes, so that it stays within 300 characters with its command; it
decides nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple, NoReturn

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

# Words of what drives a machine, and of what shows its motion. What a name speaks of is its last such word:
# the current position is a position.
_DRIVES = (
    "input|commanded|command|cmd|drive|voltage|volts?|spannung|current|strom|torque|moment|force|pwm|duty|dac|"
    "effort|throttle|action"
)
_MOVES = (
    "angle|winkel|position|pos|theta|phi|alpha|tip|speed|velocity|vel|drehzahl|e?rpm|omega|encoder|enc|pv|hub|"
    "displacement|deflection|distance|travel|weg|observation"
)
# Group 1 is a word of a drive, group 2 one of a motion.
_WORD = re.compile(rf"(?<![a-z])(?:({_DRIVES})|({_MOVES}))(?![a-z])", re.I)
# Letters that textbooks use, where a name has none of these words: an input, an output, or v, which is a
# voltage or a speed.
_SYMBOL = re.compile(
    r"(?:.*[/.])?(?:(?P<input>u)|(?P<output>y|q|output|counts)|(?P<either>v))(?![a-z])", re.I
)
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
# What drives the machine, as a sensor read it.
_MEASURED = re.compile(r"(^|[^a-z])(meas|measured|act|actual|ist|fb|feedback|sensed?)(?![a-z])", re.I)
# Kinds of units (`units.kind_of`) of what drives, and of what moves.
_DRIVEN_KINDS = frozenset({"V", "A", "N", "Nm"})
_MOVED_KINDS = frozenset(
    f"{kind}{rate}" for kind in ("rad", "m", *COUNTED - {"%"}) for rate in ("", "/s", "/s2")
)
# Where a word begins inside of another: posRef, SetAngle.
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
# Letters in which names of a reference and its output differ behind what they share: y and yr, qg and qm, x1
# and xr. These need one letter; two leave room for a sensor's number behind it (y1 and yr1). Three would take
# words: ref, set, cmd, act. Two columns that are called by whole words are asked about. Chosen; doubled or
# halved, no test of units moves.
_TWIN_LETTERS = 2
# Columns that are compared with each other at most: the number of pairs grows with their square, and a pair
# takes up to twelve least-squares fits of the whole log. More are asked about. Halved, no test of units
# moves.
_MOST_TWINS = 12
# Signs of a rate in a unit, and words for one in a name.
_RATE = re.compile(r"/s|_s|rpm|u/min|/min|hz", re.I)
_RATE_NAME = re.compile(
    r"(^|[^a-z])(speed|velocity|vel|drehzahl|omega|accel\w*|acc|rate|e?rpm)(?![a-z])", re.I
)


@dataclass(frozen=True)
class Roles:
    """Names of the columns of one channel.

    Attributes
    ----------
    time : str or None
        None where no column looks like it.
    input, output : str
        What drives the machine, and what it does.
    reference : str or None
        What the output should be; None where no column looks like it.
    doubts : tuple of Finding
        On a column that would be the reference, were it in the output's unit, or did it not stand still.
    """

    time: str | None
    input: str
    output: str
    reference: str | None = None
    doubts: tuple[Finding, ...] = ()


def roles_of(table: Table, log: str, command: str = "identify", **stated: str | None) -> Roles:
    """The columns of one channel: time, input, output, and the reference, if there is one.

    Parameters
    ----------
    table : Table
        The log: named columns of numbers or text, with their units.
    log, command : str
        What a complaint offers to type: 'flexlink COMMAND LOG ...'; log as a shell takes it, with the options
        that were given and are no roles.
    stated : str or None
        input, output, time and reference, as far as the user named them. Taken as they are: a name that is no
        column is not refused here, but by `Table.columns`. Other keys only keep their column from a role.

    Returns
    -------
    Roles
        What the user stated, and for the other roles the one column that its unit or name leaves no doubt of.

    Raises
    ------
    ValueError
        A role has no column or several: the message names them, and ends with a command that works. Cells
        that hold no numbers are not refused here; their column is judged by its name alone.

    Notes
    -----
    The reference is what is wished for the output, in its unit. In a closed loop the one column that is left
    is the role that is missing.
    """
    # What each free column is by itself. Columns that stand still are none.
    moving = [name for name in table.names if _is_signal(table, name)]
    time = stated.get("time") or time_of(table)
    taken = {time, *stated.values()}
    free = [name for name in moving if name not in taken]
    role = {name: _role_by_name(table, name) for name in free}
    role |= _roles_of_v(role)
    beside = {name for name in free if _BESIDE.search(in_short(name))}

    # What the motion should be, by its name, else by its twin and the numbers of both.
    drives = [name for name in free if role[name] == "input"]
    wished = list[str]()
    for name in free:
        is_driven = kind_of(table.unit(name)) in _DRIVEN_KINDS
        if _is_wished(table, name) and not is_driven:
            wished.append(name)
    # A command that is called a set point, too, is the input where there is no other one.
    has_other_input = bool(stated.get("input") or set(drives) - set(wished))
    if not has_other_input:
        wished = [name for name in wished if name not in drives]
    loop = None
    if not wished and not stated.get("reference"):
        loop = _loop_of_twins(table, free, role, beside, stated)
    if loop is not None:
        wished = [loop.reference]
        drives = [loop.command]
        role[loop.output] = "output"
    inputs = _not_in(beside, [name for name in drives if name not in wished])

    # What moves; in counts that nothing names only where nothing else does.
    unwished = [name for name in free if name not in wished]
    moves = [name for name in unwished if role[name] == "output"]
    if not moves:
        moves = [name for name in unwished if role[name] == "counted"]
    outputs = [loop.output] if loop is not None else _not_in(beside, moves)

    # Of a position and a speed the output is the one that something is wished for.
    wished_quantities = {_quantity(table, name) for name in wished}
    wished_outputs = [name for name in outputs if _quantity(table, name) in wished_quantities]
    input_ = stated.get("input") or _only(inputs)
    output = stated.get("output") or _only(wished_outputs) or _only(outputs)

    # In a loop one column that is left takes the role that is missing.
    known = {*drives, *moves, *wished, *beside}
    left = list[str]()
    for name in free:
        if name in known or _is_text(table.raw[name]) or _holds(table, name, counts_rows):
            continue
        left.append(name)
    in_loop = bool(wished or stated.get("reference"))
    if in_loop and len(left) == 1 and kind_of(table.unit(left[0])) in ("", *COUNTED):
        if input_ is None and not inputs:
            input_ = left[0]
        if output is None and not outputs and input_ != left[0]:
            output = left[0]
    if input_ is None or output is None or input_ == output:
        named = stated | {"input": input_, "output": output, "time": time}
        _ask(table, f"flexlink {command} {log}", named, inputs, outputs, wished, left)

    roles = Roles(time, input_, output, stated.get("reference"))
    if roles.reference:
        return roles
    if not wished:
        return replace(roles, doubts=tuple(_still_references(table, roles, stated)))
    return _with_reference(table, roles, wished, f"flexlink {command} {log} {_typed(stated)}".rstrip())


def _still_references(table: Table, roles: Roles, stated: Mapping[str, str | None]) -> list[Finding]:
    """Findings REFERENCE_STILL, on columns that a name calls a set point of the output's kind, and that stand
    still: they are no signal, and the loop that they tell of is not opened by them.

    Set points of another quantity, as of a current, and columns that the user stated are passed over.
    """
    findings = []
    for name in table.names:
        if name in (roles.time, roles.input, roles.output, *stated.values()) or is_time(table, name):
            continue
        if (
            _is_signal(table, name)
            or not _is_wished(table, name)
            or kind_of(table.unit(name)) in _DRIVEN_KINDS
        ):
            continue
        if _quantity(table, name) != _quantity(table, roles.output):
            continue
        value = float(table.columns([name])[name][0])
        findings.append(finding(FindingKind.REFERENCE_STILL, name=name, value=value, record=""))
    return findings


def _with_reference(table: Table, roles: Roles, wished: Sequence[str], typed: str) -> Roles:
    """The roles with their reference: what is wished for the output, in its unit, else of its quantity.

    roles: with input and output (names of columns), reference None. wished: columns that may be it; typed:
    the command so far. Where the only one is in another unit, the roles come without it and with a doubt;
    where it is a speed to a position, or the other way, without either. Raises ValueError for several that
    fit.
    """
    output_unit = table.unit(roles.output)
    candidates = [name for name in wished if name not in (roles.input, roles.output)]
    fitting = [name for name in candidates if table.unit(name) in ("", output_unit) or not output_unit]
    # A position and a speed may both have a set point.
    output_quantity = _quantity(table, roles.output)
    alike = [name for name in fitting if _quantity(table, name) == output_quantity]
    if alike and len(fitting) > 1:
        fitting = alike
    if len(fitting) > 1:
        listed = shown(" and ".join(shown(name, 30) for name in fitting), 90)
        raise ValueError(
            f"{table.path}: {listed} may be the reference of '{shown(roles.output, 30)}'; type: {typed} "
            f"{_typed({'reference': fitting[0]})}"
        )
    only_candidate = _only(candidates)
    if fitting or only_candidate is None:
        return replace(roles, reference=_only(fitting))
    unit = table.unit(only_candidate)
    if is_position(only_candidate, unit) != is_position(roles.output, output_unit):
        return roles

    # The only one is in another unit: its numbers have to be scaled; or its header is wrong, where they agree
    # as they stand.
    is_same = False
    with suppress(ValueError):  # no numbers: whoever uses the column complains of it
        is_same = follows_as_it_stands(*table.columns([only_candidate, roles.output]).values())
    factor = per(unit, output_unit)
    if is_same:
        mended = f"--unit {as_typed(f'{only_candidate}={output_unit}')}"
    elif factor:
        mended = scaled_by(only_candidate, factor)
    else:
        mended = f"--scale {as_typed(f'{only_candidate}=FACTOR')}"
    doubt = finding(
        FindingKind.UNIT_OF_REFERENCE,
        name=only_candidate,
        unit=unit,
        output=roles.output,
        of=output_unit,
        options=f"--reference {as_typed(only_candidate)} {mended}",
        same=is_same,
    )
    return replace(roles, doubts=(doubt,))


class _Loop(NamedTuple):
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
    """The closed loop of two columns with nearly one name, where the numbers leave no doubt; else None.

    'y' and 'yr', 'x1_mm' and 'xr_mm', 'qm' and 'qg': a command moves the one and not the other, which it
    follows. Two positions that a command moves are two measured ones. None, too, where there are several
    such loops, or more columns than `_MOST_TWINS`.

    free: columns without a role; role: of each by its name, as of `_role_by_name`; beside: columns that
    neither drive nor move; stated: by the user. Columns that hold no numbers, or too few, make no loop and
    are not refused. Twelve motions are 66 pairs.
    """
    signals = list[str]()
    for name in free:
        # What increases is rather time, or a row's number.
        if name in beside or _is_text(table.raw[name]) or _increases(table, name):
            continue
        signals.append(name)
    named_inputs = [name for name in signals if role[name] == "input"]
    motions = [name for name in (*signals, stated.get("output")) if name and role.get(name) != "input"]
    if len(motions) > _MOST_TWINS:
        return None
    loops = list[_Loop]()
    for number, first in enumerate(motions):
        for second in motions[number + 1 :]:
            if not _are_twins(table, first, second):
                continue
            # The command is stated, or the one that a name says, or the one column beside the twins.
            command = stated.get("input") or _only(named_inputs)
            if command is None and not named_inputs:
                command = _only([name for name in motions if name not in (first, second)])
            if command is None:
                continue
            for loop in (_Loop(first, second, command), _Loop(second, first, command)):
                may_be_output = stated.get("output") in (None, loop.output)
                if may_be_output and _is_loop(table, loop):
                    loops.append(loop)
    return loops[0] if len(loops) == 1 else None


def _are_twins(table: Table, first: str, second: str) -> bool:
    """Whether two names have one unit and one beginning, and differ in `_TWIN_LETTERS` behind it at most.

    Letters and digits alone are compared, capitals as small letters, the unit in the name left out. False
    without a common beginning, and where both endings are digits (x1 and x2); x1 and x12 are twins, as one
    ending is empty: `_is_loop` then asks the numbers. Two equal names are twins.
    """
    if table.unit(first) != table.unit(second):
        return False
    unit = table.unit(first).replace("/", "_")
    bare = [in_short(name).removesuffix(unit) for name in (first, second)]
    stems = [re.sub(r"[\W_]+", "", name).lower() for name in bare]
    n_shared = 0
    for first_letter, second_letter in zip(*stems, strict=False):
        if first_letter != second_letter:
            break
        n_shared += 1
    endings = [stem[n_shared:] for stem in stems]
    # x1 and x2, channel 1 and channel 2 are numbered, not paired: both endings are digits.
    if n_shared == 0 or all(ending.isdigit() for ending in endings):
        return False
    return max(map(len, endings)) <= _TWIN_LETTERS


def _is_loop(table: Table, loop: _Loop) -> bool:
    """Whether the numbers of three columns are those of a closed loop; not where one has other cells.

    False, too, for columns that `Table.columns` refuses.
    """
    with suppress(ValueError):  # no numbers: whoever uses the column complains of it
        return is_loop(*table.columns([loop.reference, loop.output, loop.command]).values())
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
    """Raise ValueError: a role has no column or several. The message ends with a command to type.

    typed: the command so far; known: by role (input, output, reference, time) its column, None where it is
    asked for; inputs, outputs, wished: columns that may be input, output and reference, each perhaps empty;
    left: columns of no role. Reads cells to propose columns; those that hold no numbers are passed over.
    """
    # A column that would be it, but stands still.
    for role, candidates in (("input", inputs), ("output", outputs)):
        if candidates or known[role]:
            continue
        for name in table.names:
            stands_still = not is_time(table, name) and not _is_signal(table, name)
            if stands_still and _role_by_name(table, name) == role and not _is_wished(table, name):
                raise ValueError(
                    f"{table.path}: '{shown(name, 30)}' stands still, so that nothing can be identified from "
                    f"this log; leave it out, or name the {role} if it is another column: {typed} --{role} "
                    "NAME"
                )

    # No column that may be the input: outputs alone make no model.
    listed = shown(", ".join(shown(name, 30) for name in table.names), 90)
    reference = known.get("reference") or next(iter(wished), None)
    pair = None
    if not known["output"] and not reference:
        pair = _led_and_follower(table, outputs)
    # Without an output two columns have to be left over, or one wished for: one drives, the other moves.
    nothing_left = not left if outputs else len(left) < 2 and not wished
    if nothing_left and not inputs and not known["input"]:
        named = _typed({"input": pair.leading, "output": pair.following}) if pair else "--input NAME"
        raise ValueError(
            f"{table.path}: no column looks like an input; it has {listed}. A model needs what drives the "
            f"machine (in V, A, N or Nm): record it too, or name it: {typed} {named}"
        )

    # Input: of several that fit the one that is sent before the one that a sensor read.
    likely_inputs = [name for name in inputs if not _MEASURED.search(in_short(name))]
    # A supply's voltage, or the current of another axis, does not move the output.
    if known["output"] or len(outputs) == 1:
        moved = known["output"] or outputs[0]
        moving = [name for name in [*likely_inputs, *inputs] if _is_moved(table, moved, name)]
        likely_inputs = moving or likely_inputs
    only_left = left if len(left) == 1 and (inputs or outputs) else []
    command = known["input"]
    if command is None:
        candidates = [*likely_inputs, *inputs, *only_left]
        command = next((name for name in candidates if name != known["output"]), "NAME")

    # Output and reference. A column that the command moves was measured: it is no reference of the other one.
    if pair and command in table.names and _is_moved(table, pair.leading, command):
        pair = None
    output = pair.following if pair else known["output"]
    if not output:
        candidates = [*outputs, *only_left, *inputs[::-1]]
        output = next((name for name in candidates if name != command), "NAME")
    if pair:
        reference = pair.leading
    elif wished and not known.get("reference") and output in table.names:
        output_quantity = _quantity(table, output)
        of_output = [name for name in wished if _quantity(table, name) == output_quantity]
        reference = next(iter(of_output), reference)

    # The command in full, with time or a sampling time.
    times = times_in(table) or rising(table)
    options = {
        "input": command,
        "output": output,
        "reference": reference,
        "time": known["time"] or next(iter(times), None),
    }
    if not options["time"] and "--dt-s " not in typed:
        options["dt-s"] = "SECONDS"
    questions = list[str]()
    for role, candidates in (("input", inputs), ("output", outputs)):
        if known[role]:
            continue
        comma = ", " if candidates else ""
        names = shown(" or ".join(shown(name, 20) for name in candidates), 60)
        questions.append(f"which is the {role}{comma}{names}")
    asked = " and ".join(questions) or "which are input and output"
    raise ValueError(f"{table.path}: {asked}? It has {listed}; type: {typed} {_typed(options)}")


def _typed(options: Mapping[str, str | None]) -> str:
    """Options with their values as they are typed, names in full; those without a value are left out.

    Empty for no options. Names of options are not checked.
    """
    return " ".join(f"--{option} {as_typed(value)}" for option, value in options.items() if value)


def _not_in(excluded: set[str], names: list[str]) -> list[str]:
    """Names that are not among the excluded ones; all of them where none is left.

    In their order; empty for no names.
    """
    return [name for name in names if name not in excluded] or names


def _only(names: Sequence[str]) -> str | None:
    """The name, where there is just one; else None. None, too, for no name."""
    return names[0] if len(names) == 1 else None


class _Pair(NamedTuple):
    """Two columns of which one leads and the other follows, as a reference and its output do."""

    leading: str
    following: str


def _led_and_follower(table: Table, names: list[str]) -> _Pair | None:
    """The pair that two columns in one unit are, by their names or as one follows the other's changes.

    The column leads whose name is the only one to speak of a drive. None where neither names nor numbers
    tell, or there are not two columns.
    """
    if len(names) != 2 or table.unit(names[0]) != table.unit(names[1]):
        return None
    first, second = names
    drives = [any(word[1] for word in _WORD.finditer(in_short(name))) for name in names]
    if drives[0] != drives[1]:
        return _Pair(first, second) if drives[0] else _Pair(second, first)
    with suppress(ValueError):  # no numbers: whoever uses the column complains of it
        first_leads = leads(*table.columns(names).values())
        if first_leads is not None:
            return _Pair(first, second) if first_leads else _Pair(second, first)
    return None


def _is_moved(table: Table, name: str, command: str) -> bool:
    """Whether a command moves a column, as far as their numbers tell; not where one has other cells.

    Ones with too few samples to tell are not moved (`is_moved_by`).
    """
    with suppress(ValueError):
        return is_moved_by(*table.columns([name, command]).values())
    return False


def is_time(table: Table, name: str) -> bool:
    """Whether a column looks like time: dates, a unit of time, or its name.

    KeyError for a name that is no column.
    """
    if table.is_clock(name) or says_time(name):
        return True
    unit = TIME_UNITS.get(table.unit(name).lower(), "")
    if not unit:
        return False
    # A suffix is no unit for certain: pos_min is a minimum.
    is_suffix = unit in ("min", "h") and name.lower().endswith(f"_{unit}")
    return not is_suffix


def times_in(table: Table) -> list[str]:
    """The columns that look like time; of several those that increase, if there are any.

    Where none looks like it, those that may be called so ('cycle_time') and increase. Empty where none does;
    cells without numbers do not increase.
    """
    times = [name for name in table.names if is_time(table, name)]
    if not times:
        candidates = [name for name in table.names if ends_with_time(name) or begins_with_time_unit(name)]
        times = [name for name in candidates if _increases(table, name)]
    if len(times) < 2:
        return times
    increasing = [name for name in times if _increases(table, name)]
    return increasing or times


def rising(table: Table) -> list[str]:
    """The first column, if it increases by no whole numbers, as a row's number does: it may be time.

    The list has one name or none; no columns, or a first one that holds no numbers: empty.
    """
    first = list(table.names[:1])
    if first and _increases(table, first[0]):
        numbers = table.columns(first)[first[0]]
        if np.any(numbers % 1 != 0):
            return first
    return []


def time_of(table: Table) -> str | None:
    """The one column that looks like time; None where there is none, or several."""
    return _only(times_in(table))


def _holds(table: Table, name: str, what: Callable[[RealArray], object], otherwise: bool = False) -> bool:
    """Whether something holds of the numbers (T,) of a column; `otherwise` where a cell is no number.

    what: takes the numbers (T,), and its answer is taken as true or false. Of a column without rows numpy may
    raise ValueError, which counts as a cell that is no number.
    """
    with suppress(ValueError):
        return bool(what(table.columns([name])[name]))
    return otherwise


def _is_text(values: object) -> bool:
    """Whether a column, as a `Table` has it in `raw`, holds words alone, or nothing that is read.

    Not checked beyond that: a column that is text in half of its cells is none.
    """
    if isinstance(values, tuple):
        return not any(is_number(cell, sign) for cell in values for sign in ".,")
    return isinstance(values, Unread) or np.asarray(values).dtype.kind in "USO"


def _increases(table: Table, name: str) -> bool:
    """Whether each number of a column is larger than the one before.

    False where a cell is no number; a column of one row does.
    """
    return _holds(table, name, lambda values: np.all(np.diff(values) > 0))


def _is_signal(table: Table, name: str) -> bool:
    """Whether a column is no time and does not stand still.

    One without numbers is not left out for another one in silence: who takes it is told what is wrong.
    """
    if is_time(table, name):
        return False
    return _holds(table, name, lambda values: np.ptp(values) > 0, otherwise=True)


def is_position(name: str, unit: str) -> bool:
    """Whether an output is a position by its unit, else by its name; not its speed or acceleration.

    unit: '' where none is known, then the name decides; a unit that is not known counts as a position unless
    it looks like a rate. True without either.
    """
    if unit:
        return "/" not in kind_of(unit) and _RATE.search(unit) is None
    return _RATE_NAME.search(in_short(name)) is None


class _Quantity(NamedTuple):
    """What a column measures, as far as two columns are compared."""

    unit: str
    is_position: bool


def _quantity(table: Table, name: str) -> _Quantity:
    """The unit of a column, which may be empty, and whether it is a position.

    The unit counts as it is written: columns in deg and in rad differ.
    """
    unit = table.unit(name)
    return _Quantity(unit, is_position(name, unit))


def _is_wished(table: Table, name: str) -> bool:
    """Whether a name says what the motion should be: 'posRef', 'Sollwinkel', 'r_deg'.

    False for an empty name.
    """
    short = in_short(name)
    words_apart = _CAMEL.sub("_", short)
    if _WISHED.search(words_apart):
        return True
    # A single r, but for the unit behind it, as textbooks call it.
    bare = short.removesuffix(table.unit(name).replace("/", "_"))
    while bare and not bare[-1].isalnum():
        bare = bare[:-1]
    return bare.lower() == "r"


def _role_by_name(table: Table, name: str) -> str:
    """What a column is: 'input', 'output', 'v' (a voltage or a speed), 'counted', or empty for no sign of
    either.

    Its unit says it, where there is one, else the last word of its name that speaks of either, else the
    letter that it begins with. A unit of counts leaves it to the name, else 'counted'.
    """
    unit = table.unit(name)
    kind = kind_of(unit)
    if unit and kind not in COUNTED:
        if kind in _DRIVEN_KINDS:
            return "input"
        return "output" if kind in _MOVED_KINDS else ""
    words = list(_WORD.finditer(_CAMEL.sub("_", in_short(name))))
    if words:
        last_word = words[-1]
        return "input" if last_word[1] else "output"
    symbol = None if unit else _SYMBOL.match(in_short(name))
    if symbol:
        if symbol["either"]:
            return "v"
        return "input" if symbol["input"] else "output"
    # Per cent of what a drive can do; counts may be of either.
    if kind == "%":
        return "input"
    return "counted" if unit else ""


def _roles_of_v(role: Mapping[str, str]) -> dict[str, str]:
    """What columns called v are, by name; role: of every column.

    They are voltages unless another column is the input; then speeds, unless another one is the output. Other
    columns are left out; empty where none is called so.
    """
    ambiguous = [name for name, kind in role.items() if kind == "v"]
    kinds = set(role.values())
    if "input" not in kinds:
        return dict.fromkeys(ambiguous, "input")
    if "output" not in kinds:
        return dict.fromkeys(ambiguous, "output")
    return dict.fromkeys(ambiguous, "")
