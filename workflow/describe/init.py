"""What was seen in logs while their configuration was written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ident.data.finding import Finding
from ident.data.roles import Roles
from workflow.describe.facts import Quantity, Row, Section
from workflow.text.findings.sentences import words as finding_words
from workflow.text.formats import frequency, hertz, number, si

if TYPE_CHECKING:  # it loads what identifies
    from workflow.tasks.draft import Draft


def init_sections(
    draft: Draft,
    roles: Roles,
    unit_of: Mapping[str, str],
    validation: str,
    doubts: Sequence[Finding],
    *,
    logs: int,
) -> list[Section]:
    """Columns, doubts, what the logs show, and the specification that was written.

    Args:
        draft: What was made of the logs.
        roles: Columns by what they are.
        unit_of: Unit of input and output.
        validation: Name of the log that validates, of several; "" where there is one log.
        doubts: On the way the logs are read.
        logs: Number of records.
    """
    sections = [
        Section("columns", _columns(draft, roles, validation)),
        Section("doubts", tuple(_said(str(k), finding_words(doubt)) for k, doubt in enumerate(doubts, 1))),
        Section("seen", _seen(draft, unit_of[roles.input], logs)),
        Section("specification", _specification(draft, roles, unit_of)),
    ]
    return [section for section in sections if section.rows]


def _said(name: str, words: str) -> Row:
    return Row("", name, Quantity.words(words))


def _columns(draft: Draft, roles: Roles, validation: str) -> tuple[Row, ...]:
    turned = ", its sign turned" if draft.look.turned else ""
    other_motion = "" if draft.position else ", a speed or acceleration"
    if not validation:
        validation = "none: record another log"
        if draft.split_sample:
            validation = "last part of the one log"
    return (
        _said("input", f"{roles.input}{turned}"),
        _said("output", f"{roles.output}{other_motion}"),
        _said("reference", roles.reference or "none"),
        _said("sampling", si(1 / draft.look.records[0].dt_s, "Hz", 5)),
        _said("validation", validation),
    )


def _seen(draft: Draft, input_unit: str, logs: int) -> tuple[Row, ...]:
    rows = [
        _said("response known", known_words(draft)),
        _said("first mode", mode_words(draft, logs)),
        _said("dry friction", friction_words(draft, input_unit)),
    ]
    if draft.unstable_per_s:
        rows.append(_said("unstable pole", f"about {si(draft.unstable_per_s, '1/s')}"))
    return tuple(rows)


def known_words(draft: Draft) -> str:
    """Between which frequencies the logs tell the response."""
    known = draft.look.told_rad_s
    if not known:
        return "nowhere"
    return f"{number(hertz(known[0]))} to {si(hertz(known[1]), 'Hz')}"


def mode_words(draft: Draft, logs: int) -> str:
    """The first mode, or what shows in its place; of one log that it may hide one."""
    look = draft.look
    if look.mode:
        return f"{frequency(look.mode[0], 4)}, damping {number(look.mode[1], 2)}"
    words = "none shows"
    if look.notch:
        words += f", a notch at {frequency(look.notch, 4)}"
    if logs == 1:
        words += ": give further logs, one alone may hide it"
    return words


def friction_words(draft: Draft, input_unit: str) -> str:
    """Dry friction as the input that overcomes it."""
    motion = draft.look.motion
    if motion is None:
        return "not known"
    return f"about {si(motion.friction.value, input_unit, 2)}" if draft.friction else "none shows"


def _specification(draft: Draft, roles: Roles, unit_of: Mapping[str, str]) -> tuple[Row, ...]:
    asked = draft.specification
    bandwidth = frequency(asked["bandwidth_rad_s"])
    if "lowest_bandwidth_rad_s" in asked:
        bandwidth += f", or what can be met, down to {frequency(asked['lowest_bandwidth_rad_s'])}"
    unit = f"{unit_of[roles.input] or 'input'} per {unit_of[roles.output] or 'output'}"
    return (_said("bandwidth", bandwidth), _said("effort", si(asked["effort_limit"], unit)))
