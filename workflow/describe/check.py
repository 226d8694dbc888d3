"""What logs of a simulation can tell, before anything is fitted to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from diagnosis.machine.telling import Telling
from workflow.describe.diagnosis_page import role_words
from workflow.describe.diagnosis_words import output_unit, parameter_words, probability_words, value_words
from workflow.describe.facts import Quantity, Row, Section
from workflow.text.formats import count, listing, share as percentage, si

# Candidates of every list; the JSON answer has all.
_MOST_LISTED = 20
# An output that moves by less than so many times its noise is doubtful. Chosen: a twentieth of noise is what
# a good log has.
LEAST_MOTION = 20.0
# A least size from here on says that the candidate does nothing: it is inf then, and no size of a machine, in
# whatever unit, comes near this.
NOTHING_SHOWS = 1e9


@dataclass(frozen=True)
class LogSeen:
    """One log.

    Attributes:
        name: Of the log.
        role: "estimation" or "held_out".
        samples: Rows.
        outputs: (name, RMS of the motion, standard deviation of the noise) in the output's unit.
        limited: Command that may be cut off -> share of the time at the ends of its range; 1: it never moves.
    """

    name: str
    role: str
    samples: int
    outputs: tuple[tuple[str, float, float], ...]
    limited: Mapping[str, float]


@dataclass(frozen=True)
class Candidates:
    """How the sizes of the candidates are said.

    Attributes:
        sizes: Effect -> name of its size, with the unit.
        values: Stated value -> (it, its name with the unit, "" where it has none).
        limits: Effects that do less where they are larger.
        untried: Candidate -> what it needs to be tried.
    """

    sizes: Mapping[str, str]
    values: Mapping[str, tuple[float, str]]
    limits: Sequence[str]
    untried: Mapping[str, str]

    def size_words(self, name: str, size: float) -> str:
        """A size of a candidate with its unit; of a stated value as a share of it."""
        if name in self.sizes:
            return parameter_words(self.sizes[name], size)
        value, with_unit = self.values[name]
        return f"{percentage(size, 2)} of {value_words(with_unit, value)}"


def check_sections(
    logs: Sequence[LogSeen],
    dt_s: float,
    units: Mapping[str, str],
    doubts: Sequence[str],
    telling: Telling,
    candidates: Candidates,
    advice: Sequence[str],
    *,
    groups_left_out: int,
) -> list[Section]:
    """What the logs hold, what shows in them, what acts alike, what the next record would have to do.

    Args:
        logs: In their order.
        dt_s: Sampling period.
        units: Output -> unit, of those whose name states none.
        doubts: Sentences on what makes the logs doubtful.
        telling: What they tell; the smallest sizes first.
        candidates: How sizes are said.
        advice: On the next record, in sentences.
        groups_left_out: Groups that look alike and are not in `telling`.
    """
    shows = [name for name in telling.least if name not in telling.hidden]
    sizes = []
    for name in shows[:_MOST_LISTED]:
        or_less = " or less" if name in candidates.limits else ""
        sizes.append(_said(name, candidates.size_words(name, telling.least[name]) + or_less))
    sections = [
        *(_log_section(log, dt_s, units) for log in logs),
        Section("doubtful", _numbered(doubts)),
        Section("smallest size that shows", (*sizes, *_more(len(shows) - _MOST_LISTED, len(shows)))),
        Section("does not show", tuple(_hidden_rows(telling, candidates))),
        Section("look alike, if present", tuple(_alike_rows(telling, groups_left_out))),
        Section("next record", _numbered(advice)),
    ]
    return [section for section in sections if section.rows]


def _said(name: str, words: str) -> Row:
    return Row("", name, Quantity.words(words))


def _numbered(sentences: Iterable[str]) -> tuple[Row, ...]:
    """Sentences, one after the other."""
    return tuple(_said("then" if k else "first", words) for k, words in enumerate(sentences))


def _more(left_out: int, candidates: int) -> Iterator[Row]:
    """A row that says how long a list is whose end is left out."""
    if left_out > 0:
        yield _said("more", f"{count(candidates, 'candidate')} in the JSON answer")


def _log_section(log: LogSeen, dt_s: float, units: Mapping[str, str]) -> Section:
    rows = [_said("samples", f"{log.samples} every {si(1000 * dt_s, 'ms', 4)}, {role_words(log.role)}")]
    for name, motion, noise in log.outputs:
        unit = output_unit(name, units)
        little = ": little of it is motion" if motion < LEAST_MOTION * noise else ""
        rows.append(_said(name, f"motion {si(motion, unit, 3)} (RMS), noise {si(noise, unit, 2)}{little}"))
    for name, share in log.limited.items():
        words = (
            f"at the ends of its range for {percentage(share, 2)} of the time: is it cut off? Then log what "
            "the actuator gives"
        )
        rows.append(_said(name, "never changes" if share == 1 else words))
    return Section(log.name, tuple(rows))


def _hidden_rows(telling: Telling, candidates: Candidates) -> Iterator[Row]:
    """Candidates that the logs do not show, whatever the reason.

    Hidden ones show at no size of their range: from `least` on they would, inf where they do nothing. Others
    were not tried, make the simulation fail, or were left out by a deadline.
    """
    for name in telling.hidden[:_MOST_LISTED]:
        least = telling.least[name]
        words = "does nothing in these records"
        if least < NOTHING_SHOWS:
            words = f"only from {candidates.size_words(name, least)} on"
        yield _said(name, words)
    yield from _more(len(telling.hidden) - _MOST_LISTED, len(telling.hidden))
    by_need = sorted(candidates.untried.items(), key=lambda item: item[1])
    for needs, items in groupby(by_need, key=lambda item: item[1]):
        yield _said("not tried", f"{listing(name for name, _ in items)}: needs {needs}")
    for name, how in telling.failed.items():
        yield _said(name, f"left out, the simulation fails with it: it {how}")
    if telling.unlooked:
        yield _said("not looked at", listing(telling.unlooked))


def _alike_rows(telling: Telling, groups_left_out: int) -> Iterator[Row]:
    """Candidates that others make up for."""
    for group in telling.alike:
        first, *other_names = group.names
        reproduce = "together reproduce" if len(other_names) > 1 else "reproduces"
        part = probability_words(1 - group.left)
        yield _said(first, f"{listing(other_names)} {reproduce} {part} of its effect")
    if groups_left_out > 0:
        yield _said("more", f"{count(groups_left_out, 'group')} in the JSON answer")
