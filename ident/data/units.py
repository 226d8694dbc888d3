"""Units as headers write them: 'Zeit [ms]', 'time (us)', 't_ms', 'angle_rad', 'u in mV'.

Nobody agrees on how a unit stands in the name of a column, so a name is read by a small grammar: brackets,
what follows 'in', '/' or an underscore, and words that are glued together. `unit_of_time` says the unit of a
column of time, or why it has to be asked for; `TimeColumn` holds what was taken for it and refuses stamps
that no clock or machine has. `written_unit` finds the unit of any other signal, and `size_of` says of what
quantity a unit is and how large. `contradicted_by_loop` compares the numbers of a closed loop with the units
of its columns.

Time is converted to seconds; every other signal keeps its unit, which is carried along for display. What no
rule covers is asked for, never guessed. Functions that ask whether or which take any text, also an empty one,
and raise nothing unless they say so. A number in `shown(text, 60)` is how many characters of it a complaint
quotes; it decides nothing.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import as_typed, shown

# Units of time that divide a second, by how many of them it has. Integers, so that 2 [ms] becomes the very
# double that 0.002 is: an exact division is rounded once.
_PER_SECOND = {"s": 1, "ms": 1000, "us": 10**6, "ns": 10**9}
# Units of time that are seconds, by how many they are.
_SECONDS_PER = {"min": 60, "h": 3600, "d": 86400}
# Spellings of the units of time in lower case, in the languages of logs that were seen.
_SPELLED = {
    "s": "s sec secs second seconds sek sekunde sekunden seconde secondes segundo segundos secondi с сек 秒",
    "ms": "ms msec msecs millis millisec millisecs millisecond milliseconds millisekunde millisekunden "
    "millisecondes milisegundos millisecondi мс 毫秒",
    "us": "us µs μs usec usecs micros microsec microsecs microsecond microseconds mikrosekunde mikrosekunden "
    "microsecondes microsegundos microsecondi мкс 微秒",
    "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds nanosekunde nanosekunden",
    "min": "min mins minute minutes minuten minuto minutos мин",
    "h": "h hr hrs hour hours stunde stunden heure heures hora horas",
    "d": "days tage",
}
TIME_UNITS = {spelling: unit for unit, spellings in _SPELLED.items() for spelling in spellings.split()}
"""The unit of each spelling in lower case; values: s, ms, us, ns, min, h, d."""
KNOWN_TIME_UNITS = tuple(_SPELLED)
"""Units of time as flexlink spells them."""


class UnitSize(NamedTuple):
    """Kind of a unit, and how many of that kind one is: ('rad', 0.01745) of a degree.

    kind: a unit that stands for its quantity, 'rad' of all angles; 'rad/s' and 'rad/s2' of their rates.
    """

    kind: str
    size: float


class _SignalUnit(NamedTuple):
    """A unit of signals: the first one of its kind, how many of that it is, and its spellings."""

    kind: str
    size: float
    spellings: str


# Units of signals that instruments write as words in a line of units, by their first spelling.
_UNITS_WITH_WORDS = (
    _SignalUnit("V", 1.0, "V volt volts"),
    _SignalUnit("A", 1.0, "A ampere amperes amp amps"),
    _SignalUnit("N", 1.0, "N newton newtons"),
    _SignalUnit("rad", 1.0, "rad radian radians"),
    _SignalUnit("rad", np.pi / 180, "deg degree degrees"),
)
# Other units of signals; 0.0254 m are an inch by definition. Counts of each sort stand alone: how large one
# is only the machine knows.
_OTHER_UNITS = (
    _SignalUnit("rad", np.pi / 180, "° grad"),
    _SignalUnit("m", 1.0, "m meter metre meters metres"),
    _SignalUnit("m", 0.0254, "inch inches"),
    _SignalUnit("rad", 2 * np.pi, "rev revs rot rots turn turns rotation rotations revolution revolutions"),
    _SignalUnit("Nm", 1.0, "Nm N·m N*m"),
    _SignalUnit("W", 1.0, "W"),
    _SignalUnit("Hz", 1.0, "Hz"),
    _SignalUnit("Pa", 1.0, "Pa"),
    _SignalUnit("%", 1.0, "%"),
    _SignalUnit("counts", 1.0, "counts count cnts cnt"),
    _SignalUnit("inc", 1.0, "inc increments increment"),
    _SignalUnit("steps", 1.0, "steps step"),
    _SignalUnit("ticks", 1.0, "ticks tick"),
    _SignalUnit("pulses", 1.0, "pulses pulse imp"),
    _SignalUnit("1", 1.0, "1"),
)
COUNTED = frozenset({"counts", "inc", "steps", "ticks", "pulses", "%"})
"""Kinds of units whose size only the machine knows."""
_SIZES = {
    spelling: UnitSize(unit.kind, unit.size)
    for unit in (*_UNITS_WITH_WORDS, *_OTHER_UNITS)
    for spelling in unit.spellings.split()
}
SIGNAL_WORDS = {
    word: unit.spellings.split()[0] for unit in _UNITS_WITH_WORDS for word in unit.spellings.split()[1:]
}
"""The unit of each word for it, as instruments write them in a line of units: 'V' of 'volts'."""
# Prefixes of units of signals as SI has them, and the units that may stand behind one: of deg, rev and counts
# nobody writes thousandths. G and p are left out, as no machine is logged in them.
_PREFIXES = {"n": 1e-9, "u": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_PREFIXED = re.compile(r"([nuμmckM])(V|A|N|Nm|rad|m|W|Hz|Pa)")
# A rate: what changes, the sign of 'per', the unit of time, and its power, as in 'rad/s', 'deg_s', 'm/s^2'.
_RATE = re.compile(r"(.*?)(/|_|_?per_?)([^\W\d_]+)(?:\^?([23]))?")
# Rates with a word of their own.
_RATES_WITH_NAMES = {"rpm": "rev/min", "u/min": "rev/min", "1/min": "rev/min", "rps": "rev/s", "dps": "deg/s"}
# Units at the end of a name where no bracket says that it is one: its last letters must be no other word.
_BARE = re.compile(r"[mukµμM]?(V|A|N|Nm|rad|W|Hz|Pa)|[cmuµμk]?m|deg|rpm|rps|dps|°|%")
# The last brackets of a name; and brackets of any kind in the name of a column of time.
_BRACKETED = re.compile(r"\[([^\[\]]*)\]\s*$|\(([^()]*)\)\s*$")
_BRACKETS = re.compile(r"[\[({<【〔]([^\[\](){}<>【】〔〕]*)[\])}>】〕]")
# What brackets hold that is no unit: a number, as of a vector's part.
_NUMBER_ALONE = re.compile(r"[\d.,:\s-]*")
# Where a word begins inside of another: timeMs is time and Ms, TimeUS is Time and US.
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
# Letters that stand together.
_WORD = re.compile(r"[^\W\d_]+")
# A number just before a word, or behind it: 0.1 ms, 100us, sec/1000; not that of a word, as in t0 ms.
_FACTOR = re.compile(
    r"(?<![^\W_])(?<![.,])\d[\d.,]*(?:e[+-]?\d+)?\s*[x*·]?\s*([^\W\d_]+)|"
    r"(?<![^\W\d_])([^\W\d_]+)\s*[/x*·^]\s*\d",
    re.IGNORECASE,
)
# Characters of a name that are read: a name says its unit and its role at its ends. What is longer is a
# sentence, a path or a trap; the expressions here take a square of the length. Chosen.
_LONGEST_NAME = 200
# Characters of a unit: 'microseconds per second' has 23.
_LONGEST_UNIT = 40
# Names whose answers are remembered: as many as two tables have columns.
_CACHED_NAMES = 2 * 4096
# Words for time.
_TIME_WORD = re.compile(
    r"t|ts|time|zeit|uhrzeit|timestamps?|zeitstempel|zeitpunkt|elapsed|clock|stamp|temps|tiempo|tempo|date|datum|"
    r"datetime|время|时间|時間"
)
# A unit without a blank behind a word for time, 'elapsedms', 'tms'; not the plural 'times'. The longest
# spellings come first.
_LONG_UNITS = "|".join(sorted((unit for unit in TIME_UNITS if len(unit) > 1), key=len, reverse=True))
_GLUED = re.compile(
    rf"(t(?!min|[hdt])|[^\W\d_]*(?:{_TIME_WORD.pattern.removeprefix('t|ts|')}))({_LONG_UNITS}|(?<=\w\w\w\w)[hm])"
)
# The prefix of a second that stands apart: 'm s', 'time_milli', 'milli seconds'; and the unit that it makes.
_APART = re.compile(
    r"(?<![^\W\d_])(milli|micro|nano)(?:[\s_.-]*s(?:ec(?:ond)?s?)?)?(?![^\W\d_])", re.IGNORECASE
)
_UNIT_OF_PREFIX = {"milli": "ms", "micro": "us", "nano": "ns"}
# Signs between the letters of 'm s' and 'm.s.'.
_BETWEEN_LETTERS = re.compile(r"[\s._-]")
# A prime behind the word for time: of minutes or seconds, or a transpose of MATLAB.
_PRIME = re.compile(r"""^[^'"]*[^\W_]['"′″]+$""")
# A factor on what has its unit in brackets: [ns]/1000.
_CHANGED = re.compile(r"[\])}>]\s*[/x*·^]\s*\d|^[\d.,e+-]+\s*[x*·]")
# Words for time, and what stands beside them and says nothing of the unit.
_NO_UNIT = re.compile(
    rf"{_TIME_WORD.pattern}|in|of|to|by|at|on|up|no|nr|id|ch|io|pc|ab|is|since|start|begin|epoch|unix|posix|utc|gmt|ce?s?t|local|rel|abs|"
    r"relative|absolute|from|seit|beginn|log|host|sys|system|boot|trigger|raw|the|a|and|hh|mm|ss|hhmmss|day|today|midnight|"
    r"uptime|now|run|running|total|passed|power|session|test"
)
# Counts of something whose length nobody has said, and units of time that are not known.
_COUNTS = re.compile(
    r"ticks?|counts?|cycles?|samples?|frames?|steps?|jiffies|index|idx|sequence|takte?|zykl(?:en|us)|weeks?|"
    r"months?|years?|picosec\w*|[cdkpf]s"
)
# Letters, at most, of a word that is rather a unit, or its prefix, than a name where it stands behind one for
# time: units of time are abbreviated by one letter or two (m, cs, us).
_SHORT_WORD = 2
# The last word of a name that may be one of time.
_ENDS_WITH_TIME = re.compile(r"\w*(time|timestamp|stamp|zeit|clock)")
# A unit behind 'in', or behind a slash after one word: 'speed in rad/s', 'F/N'.
_AFTER = re.compile(r"\sin\s+(\S+)\s*$|^\w+\s*/\s*(\w+)\s*$")


class _Confusion(NamedTuple):
    """Two units that are taken for each other: by how much numbers are larger in the first; their names."""

    times: float
    units: str


# Confusions that a loop is compared with: those of one quantity that machines are recorded in.
_CONFUSIONS = (_Confusion(180 / np.pi, "degrees and radians"), _Confusion(1e3, "mm and m"))
# Share of the reference's power in the lowest lines, where a loop follows best: the more, the more of what it
# no longer follows is among them. Doubled or halved, no test of units or records moves.
_SLOW_POWER = 0.03
# Lines that these are at least, so that the coherence means something: of unrelated signals it is 1 / 16 in
# the mean. Doubled or halved, no test of units or records moves.
_FEWEST_LINES = 8
# Factor, either way, within which an output follows its reference as it stands. Measured and simulated loops
# follow to a factor of 1.1 there; units that are confused differ by 57 at least. With 1.15 a slow loop in
# another unit is no longer seen (test_units).
_FOLLOWS_WITHIN = 1.3
# Coherence from which on an output follows at all: that of measured and simulated loops is .9 and more there.
# Halved, no test of units moves; doubled it would be 1, which only computed signals reach.
_COHERENT = 0.5

# Samples beyond which a log with long steps is rather one in milliseconds: a thousand steps of half a second
# are eight minutes, longer than a machine is excited. Doubled or halved, a test of doubted steps fails.
_MANY_SAMPLES = 1000
# Step, s, from which on a log is doubted to be in seconds: machines are logged faster than twice a second.
LONG_STEP_S = 0.5
# Shortest step of a machine's log, s: 1 MHz, which no controller of a motion has.
_SHORTEST_S = 1e-6
# Longest step, s, of a machine whose motion the samples show: at one sample a second a motion of two seconds
# is the fastest that can be seen, slower than any arm. Chosen.
_LONGEST_S = 1.0
# Longest step, s, with the jitter of stamps, 1 % (that of `time_grid.TIME_TOLERANCE`): a log at 1 Hz is to be
# seen as one.
_LONGEST_WITH_JITTER_S = 1.01 * _LONGEST_S
# Shortest step, s, of a log that is proposed in another unit: 10 kHz, as fast as machines are usually logged.
_SHORTEST_USUAL_S = 1e2 * _SHORTEST_S
# Steps, s, below which the unit of a header is doubted: 100 kHz is faster than machines are usually logged.
_DOUBTFUL_S = 10 * _SHORTEST_S
# Shortest step, s, of stamps whose unit nobody states: what makes less than a second in days is rather that,
# as Excel and MATLAB (datenum) count.
_SHORTEST_UNSTATED_S = _LONGEST_WITH_JITTER_S / _SECONDS_PER["d"]
# Seconds from 1970 to 2001: stamps from there up to the year 2100, in whatever unit, are dates.
_FIRST_DATE_S = 978_307_200.0
# Seconds from 1970 to 2100.
_LAST_DATE_S = 4_102_444_800.0
# Longest time of a clock, s: none counts 3000 years (1e11 s are 3169).
_NO_CLOCK_S = 1e11


def unit_of_time(name: str, beside: str = "") -> tuple[str, str]:
    """The unit of a column of time as a file says it, and what is unclear about it; one of both is empty.

    Any text is taken; of a name without a word both are empty.

    Parameters
    ----------
    name : str
        Of the column.
    beside : str
        What the file says of its unit outside of the name, as in a line of units.

    Returns
    -------
    unit : str
        One of `KNOWN_TIME_UNITS`; empty where none is stated, or it has to be asked for.
    unclear : str
        Why it has to be asked for: units that contradict each other, or an unknown word; else empty.

    Notes
    -----
    Three places are read: what stands beside the name, its brackets, and the words outside of these. A unit
    with a factor (0.1 ms, [ns]/1000) is unknown, too.
    """
    name = in_short(unicodedata.normalize("NFKC", name).strip())
    beside = in_short(unicodedata.normalize("NFKC", beside).strip())
    units_said = list[str]()
    strange = ""

    # Beside the name and in brackets there should be a unit and nothing else.
    for text in (beside.strip("[](){}<> "), *_BRACKETS.findall(name)):
        if not _WORD.search(text):
            continue
        # 'm s' is one unit. A single d is one here only: outside it may be any letter.
        whole = _BETWEEN_LETTERS.sub("", text).lower()
        if whole == "d":
            words = ["days"]
        elif whole in TIME_UNITS:
            words = [whole]
        else:
            words = _words(text)
        units = _time_units_in(words)
        odd_words = [word for word in words if word not in TIME_UNITS and not _NO_UNIT.fullmatch(word)]
        # Beside a known unit a long word may be anything, a short one changes it: [m/s].
        is_odd = bool(odd_words) and (not units or min(map(len, odd_words)) <= _SHORT_WORD)
        has_factor = bool(units) and re.search(r"\d", text) is not None
        if (is_odd or has_factor) and not strange:
            strange = text
        units_said += units

    # Factors outside of brackets change a unit, wherever it stands.
    outside = _BRACKETS.sub(" ", name)
    words = _words(outside)
    units = _time_units_in(words)
    words_with_factor = {word.lower() for pair in _FACTOR.findall(outside) for word in pair}
    is_changed = bool(units_said) and _CHANGED.search(name) is not None
    has_factor = not words_with_factor.isdisjoint(TIME_UNITS)
    if not strange and (_PRIME.search(name) or is_changed or has_factor):
        strange = name

    # Words of the name that may be another unit count where nothing else states one.
    if not strange and not units_said:
        candidates = list[str]()
        if not units:
            candidates += [word for word in words if _COUNTS.fullmatch(word)]
        # After the word for time a short one is rather a unit, or its prefix, than a name: t_m, time_cs.
        if any(map(_TIME_WORD.fullmatch, words)):
            for word in words[1:]:
                is_short = len(word) <= _SHORT_WORD and not _NO_UNIT.fullmatch(word)
                may_be_unit = word not in TIME_UNITS and (not units or word in _PREFIXES)
                if is_short and may_be_unit:
                    candidates.append(word)
        strange = next(iter(candidates), "")

    distinct_units = list(dict.fromkeys([*units_said, *units]))
    if strange:
        return "", f"unknown unit '{strange}'"
    if len(distinct_units) > 1:
        return "", f"contradicting units {' and '.join(distinct_units)}"
    return next(iter(distinct_units), ""), ""


def in_short(name: str) -> str:
    """What is read of a name: all but its middle, where it is longer than any name that people read.

    Not longer than `_LONGEST_NAME` characters and a blank; an empty name stays empty.
    """
    if len(name) <= _LONGEST_NAME:
        return name
    half = _LONGEST_NAME // 2
    return f"{name[:half]} {name[-half:]}"


def _time_units_in(words: Sequence[str]) -> list[str]:
    """The units of time among words in lower case, in their order, each as `KNOWN_TIME_UNITS` spells it.

    Empty where none is.
    """
    return [TIME_UNITS[word] for word in words if word in TIME_UNITS]


def _words(text: str) -> list[str]:
    """The words of a name in lower case, without digits.

    Capitals begin a word ('timeMs'), and a unit that is glued to the word for time is one of its own
    ('elapsedms'). Empty for text without letters.
    """

    def unit_of_prefix(prefix: re.Match[str]) -> str:
        """The unit of a prefix of the second that stands apart.

        prefix: a match of `_APART`, which holds no other prefixes.
        """
        return _UNIT_OF_PREFIX[prefix[1].lower()]

    words = list[str]()
    for word in _WORD.findall(_APART.sub(unit_of_prefix, text).replace("_", " ")):
        in_lower_case = word.lower()
        if in_lower_case in TIME_UNITS or _GLUED.fullmatch(in_lower_case):
            parts = [in_lower_case]
        else:
            parts = _CAMEL.sub(" ", word).lower().split()
        for part in parts:
            glued = _GLUED.fullmatch(part)
            if glued is None:
                words.append(part)
            else:
                words += glued.groups()
    return words


@lru_cache(_CACHED_NAMES)
def says_time(name: str) -> bool:
    """Whether a name is one of time: 'Zeit', 'timeMs', 'millis', 'us since start'; not 'counts_s'.

    False for a name without letters.
    """
    words = _words(in_short(unicodedata.normalize("NFKC", name)))
    if not words:
        return False
    if _TIME_WORD.fullmatch(words[0]):
        return True
    # Else it has to hold a unit of time, and no word that may name a signal.
    if not any(word in TIME_UNITS for word in words):
        return False
    for word in words:
        if not (word in TIME_UNITS or _NO_UNIT.fullmatch(word) or _COUNTS.fullmatch(word)):
            return False
    return not kind_of(written_unit(name)).endswith("/s")


def ends_with_time(name: str) -> bool:
    """Whether a name may be one of time: 'host_time', 'uptimems', 'bagTimestamp', but also 'cycle_time'.

    False for a name without letters.
    """
    words = [word for word in _words(in_short(name)) if word not in TIME_UNITS]
    return bool(words) and _ENDS_WITH_TIME.fullmatch(words[-1]) is not None


def says_counts(name: str) -> bool:
    """Whether a name speaks of counts, which are whole numbers: 'encoder_counts', 'inc', 'ticks left'.

    Per cent are no counts: they need not be whole.
    """
    sizes = [_SIZES.get(word) for word in _words(in_short(name))]
    kinds = {size.kind for size in sizes if size is not None}
    return not kinds.isdisjoint(COUNTED - {"%"})


def begins_with_time_unit(name: str) -> bool:
    """Whether a name begins with a unit of time, 'ms_since_power_on', and says no other unit at its end.

    False for a name of one word, and for minutes, hours and days.
    """
    words = _words(in_short(name))
    if len(words) < 2 or written_unit(name):
        return False
    return TIME_UNITS.get(words[0], "") in _PER_SECOND


def stated_time_unit(stated: str) -> str:
    """A unit of time that the user states, as `KNOWN_TIME_UNITS` spells it.

    Raises ValueError for one that is not known.
    """
    unit = TIME_UNITS.get(stated.lower(), stated.lower())
    if unit not in KNOWN_TIME_UNITS:
        raise ValueError(f"unknown unit of time '{stated}'; expected {', '.join(KNOWN_TIME_UNITS)}")
    return unit


def _unit_of_step(step_s: float) -> str:
    """The unit in which a step that was taken as seconds would be one of a machine: ms, us, or else ns.

    Machines are logged faster than twice a second: steps of 4 are milliseconds, of 4000 microseconds. step_s:
    positive; not checked. Steps below half a second give ms as well, which no caller asks for.
    """
    for unit in ("ms", "us"):
        if step_s < LONG_STEP_S * _PER_SECOND[unit]:
            return unit
    return "ns"


@dataclass(frozen=True)
class TimeColumn:
    """What the time stamps of a log were taken for.

    Attributes
    ----------
    name : str
        Of the column.
    unit : str
        Taken for the stamps, one of `KNOWN_TIME_UNITS`.
    in_header : str
        The unit that the file states, or empty.
    stated : bool
        The user stated the unit, which counts more.
    doubtful : bool
        Called seconds, and look like integer milliseconds; or called by a smaller unit, and look like
        seconds.
    wraps_at : float
        Period of a timer that starts again, in its unit; 0 for none.
    wraps : int
        How often it starts again.
    """

    name: str
    unit: str
    in_header: str
    stated: bool = False
    doubtful: bool = False
    wraps_at: float = field(default=0.0, metadata={"since": 2})
    wraps: int = field(default=0, metadata={"since": 2})

    def timer(self, record: str) -> Finding:
        """The finding on stamps of a record (by its label) that start again and were read as going on.

        period in the column's unit; to be asked for only where `wraps_at` is not 0.
        """
        return finding(
            FindingKind.TIMER_WRAPS, record=record, name=self.name, period=self.wraps_at, count=self.wraps
        )

    def doubt(self, dt_s: float) -> Finding:
        """The finding on a doubtful column with steps of dt_s seconds; it names the option that mends it.

        dt_s: the step as it was taken; not checked. Whether the column is doubtful is for the caller to see.
        """
        unit = _unit_of_step(dt_s) if self.unit == "s" else "s"
        return finding(
            FindingKind.TIME_UNIT,
            name=self.name,
            in_header=self.in_header,
            dt_s=dt_s,
            options=f"--time-unit {unit}",
        )

    @classmethod
    def of(cls, name: str, stated: str | None = None, beside: str = "") -> TimeColumn:
        """The column of time of a name: in the unit that the user states, else the file, else in seconds.

        Parameters
        ----------
        name : str
            Of the column.
        stated : str, optional
            Unit that the user states.
        beside : str
            What the file says of the unit outside of the name.

        Raises
        ------
        ValueError
            The stated unit is not known; or the file contradicts itself or has an unknown one, and none is
            stated.
        """
        known, unclear = unit_of_time(name, beside)
        if stated is not None:
            return cls(name, stated_time_unit(stated), known, stated=True)
        if unclear:
            raise ValueError(
                f"time column '{shown(name, 60)}': {shown(unclear, 60)}; expected "
                f"{', '.join(KNOWN_TIME_UNITS)}: state it with --time-unit (time_unit), or give --dt-s "
                "SECONDS instead of --time"
            )
        return cls(name, known or "s", known)

    @property
    def unit_in_words(self) -> str:
        """What the file says of the unit, as complaints have it; also where it says none."""
        return f"its unit is said to be {self.in_header}" if self.in_header else "no unit is stated"

    def refuse_stamps(self, stamps: RealArray) -> None:
        """Raise ValueError where stamps (T,), in the unit taken, are no time of any clock or machine.

        They are dates of this century in another unit, later than any clock counts, or have steps that are
        too short: below `_SHORTEST_S`, or `_SHORTEST_UNSTATED_S` where no unit is stated. Only the first
        stamp and the median step are looked at; fewer than three stamps have no usual step, and none at all
        pass, as do NaN and steps that are not positive (`Table.increasing` refuses those). The message
        proposes units that fit. Nothing is refused where the user stated the unit.
        """
        if self.stated or not stamps.size:
            return
        first = float(stamps[0])
        if first > 0 and float(self.seconds(np.array(first))) > _NO_CLOCK_S:
            looks_like = "another unit: state it with --time-unit, or give --dt-s SECONDS instead of --time"
            for unit, per_second in _PER_SECOND.items():
                if unit != self.unit and _FIRST_DATE_S <= first / per_second <= _LAST_DATE_S:
                    looks_like = f"{unit} since 1970: state --time-unit {unit}"
                    break
            raise ValueError(
                f"time column '{shown(self.name, 60)}' begins with {first:.6g}, {self.unit_in_words}; this "
                f"looks like {looks_like}"
            )

        written_step = 0.0
        if stamps.size > 2:
            written_step = float(np.median(np.diff(stamps)))
        step_s = float(self.seconds(np.array(written_step)))
        shortest_s = _SHORTEST_S if self.in_header else _SHORTEST_UNSTATED_S
        if not 0 < step_s < shortest_s:
            return
        # Units in which it would be a step of a machine: seconds, and then days, which programs count in.
        proposals = list[str]()
        for unit in ("s", "d", "h", "min"):
            proposed_s = written_step * _SECONDS_PER.get(unit, 1)
            if unit != self.unit and _SHORTEST_USUAL_S <= proposed_s <= _LONGEST_WITH_JITTER_S:
                proposals.append(f"--time-unit {unit} (a step of {proposed_s:.4g} s)")
        raise ValueError(
            f"time column '{shown(self.name, 60)}' has steps of {step_s:.4g} s, {self.unit_in_words}: no "
            f"machine is logged that fast; state {' or '.join(proposals) or 'the right --time-unit'}, or "
            f"--time-unit {self.unit} if it is right"
        )

    def seconds(self, stamps: RealArray) -> RealArray:
        """Stamps (T,), in the unit taken, in seconds.

        Nothing is checked: NaN stays NaN; KeyError for a unit that is none of `KNOWN_TIME_UNITS`.
        """
        if self.unit in _SECONDS_PER:
            return np.asarray(stamps * _SECONDS_PER[self.unit], dtype=np.float64)
        return np.asarray(stamps / _PER_SECOND[self.unit], dtype=np.float64)

    def doubtful_for(self, stamps: RealArray) -> bool:
        """Whether increasing stamps (T,) look like those of another unit than the one taken.

        Taken as seconds without anybody saying so they look like integers of a smaller unit: nothing but
        integers, or steps of half a second and more in a long log. In a smaller unit by the header they are
        sampled faster than 100 kHz, and as seconds like machines are. False where the user stated the unit,
        or with fewer than three stamps.
        """
        # Two stamps have one step, of which nobody knows whether it is usual.
        if self.stated or stamps.size < 3:
            return False
        step = (stamps[-1] - stamps[0]) / (stamps.size - 1)
        if self.unit != "s":
            is_fast = self.seconds(step) < _DOUBTFUL_S
            usual_as_seconds = _SHORTEST_USUAL_S <= step <= _LONGEST_S
            return bool(is_fast and usual_as_seconds)
        # Three integers 0, 0, 1 are no count; beyond 1 whole seconds are rather milliseconds.
        if np.all(stamps == np.round(stamps)) and stamps[-1] > 1:
            return True
        return bool(step >= LONG_STEP_S and stamps.size > _MANY_SAMPLES)


def refuse_step(label: str, dt_s: float, output: RealArray, column: TimeColumn | None = None) -> None:
    """Raise ValueError for a sampling time that no machine has.

    Parameters
    ----------
    label : str
        Of the record, with which the message begins.
    dt_s : float
        Sampling time, s; that it is positive and finite is for the caller to check.
    output : ndarray, shape (T, Y)
        Outputs of the record: a long step is refused only where their samples show a motion; one sample shows
        none.
    column : TimeColumn, optional
        Where the time stamps come from; None: the user gave dt_s. Nothing is refused where it is stated.

    Raises
    ------
    ValueError
        The step is below `_SHORTEST_S`, or above `_LONGEST_S` while the samples of an output follow each
        other. The message proposes what was meant.

    Notes
    -----
    Steps of samples that have nothing to do with each other have twice the variance of the samples; of a
    motion that they show the steps have less than once.
    """
    if column is not None and column.stated:
        return
    moves = False
    if dt_s > _LONGEST_S:
        mean_squared_step = np.mean(np.diff(output, axis=0) ** 2, axis=0)
        moves = bool(np.any(mean_squared_step < np.var(output, axis=0)))
    if dt_s >= _SHORTEST_S and not moves:
        return
    if column is None:
        rate = f"; of a rate of {dt_s:g} Hz it is {1 / dt_s:.6g}" if moves else ""
        what = f"dt_s = {dt_s:g} is in seconds, and no machine is logged that {'slowly' if moves else 'fast'}"
        raise ValueError(f"{label}: {what}{rate}; expected {_SHORTEST_S:g} to {_LONGEST_S:g} s")
    raise ValueError(
        f"{label}: time column '{shown(column.name, 60)}' has steps of {dt_s:.4g} s, {column.unit_in_words}: "
        f"no machine that moves is logged that slowly; state --time-unit {_unit_of_step(dt_s)}, or "
        f"--time-unit {column.unit} if it is right"
    )


@lru_cache(_CACHED_NAMES)
def size_of(unit: str) -> UnitSize | None:
    """Kind and size of a unit as written: ('rad/s', 0.1047) of 'rpm'; None where it is not known.

    Prefixes of SI, rates with 'per', a slash or an underscore, and squares and cubes of seconds are
    understood. Not known are an empty text, more than `_LONGEST_UNIT` characters, and products of units.
    """
    if len(unit) > _LONGEST_UNIT:
        return None
    text = "".join(unicodedata.normalize("NFKC", unit).split())
    text = _RATES_WITH_NAMES.get(text.lower(), text)

    # A unit of time, a unit of signals, or one of these with a prefix.
    time_unit = TIME_UNITS.get(text.lower())
    if time_unit is not None:
        if time_unit in _PER_SECOND:
            return UnitSize("s", 1 / _PER_SECOND[time_unit])
        return UnitSize("s", _SECONDS_PER[time_unit])
    known = _SIZES.get(text)
    # Words, of three letters and more, may be written in capitals; one or two letters may not: m and M
    # differ.
    if known is None and len(text) > 2:
        known = _SIZES.get(text.lower())
    if known is not None:
        return known
    prefixed = _PREFIXED.fullmatch(text)
    if prefixed:
        without_prefix = _SIZES[prefixed[2]]
        return UnitSize(without_prefix.kind, without_prefix.size * _PREFIXES[prefixed[1]])

    # A rate: a known unit per unit of time.
    rate = _RATE.fullmatch(text)
    if rate is None:
        return None
    over = size_of(rate[1] or "1")
    under = size_of(rate[3])
    if over is None or under is None or under.kind != "s":
        return None
    # Behind an underscore only a second is sure: angle_deg_min is the least, ticks_ms counts milliseconds.
    is_rev_min = over == _SIZES["rev"] and under.size == _SECONDS_PER["min"]
    if rate[2] == "_" and under.size != 1 and not is_rev_min:
        return None
    power_text = rate[4] or ""
    power = int(power_text) if power_text else 1
    return UnitSize(f"{over.kind}/s{power_text}", over.size / under.size**power)


def kind_of(unit: str) -> str:
    """The kind of a unit, 'rad' of degrees (see `UnitSize`); empty where it is not known.

    Of an empty unit, too.
    """
    size = size_of(unit)
    return "" if size is None else size.kind


def per(unit: str, other: str) -> float | None:
    """How many of the other unit one is: 57.3 of rad and deg; None where they are not of one quantity.

    None, too, where a unit is not known; two counts of one sort are 1.
    """
    unit_size = size_of(unit)
    other_size = size_of(other)
    if unit_size is None or other_size is None or unit_size.kind != other_size.kind:
        return None
    return unit_size.size / other_size.size


def followed_times(reference: RealArray, output: RealArray) -> float | None:
    """How many times its reference an output is, where a loop follows best; None where it does not follow.

    Parameters
    ----------
    reference, output : ndarray, shape (T,)
        Of a closed loop, in any units, equally long and finite; not checked. A NaN in the reference gives
        None, one in the output NaN.

    Returns
    -------
    float or None
        None, too, for signals with fewer than `_FEWEST_LINES` lines (16 samples) and for a reference that
        stands still.

    Notes
    -----
    With R and Y the spectra at the lowest lines, which hold `_SLOW_POWER` of the power of the reference, the
    factor is Re sum R* Y / sum |R|^2, the least-squares gain without a phase. It counts where the coherence
    (Re sum R* Y)^2 / (sum |R|^2 sum |Y|^2) is `_COHERENT` at least.
    """
    # Without a window the ends of a slow signal would leak into all lines. The mean is left out.
    window = np.hanning(output.size)
    reference_lines = np.fft.rfft((reference - reference.mean()) * window)[1:]
    output_lines = np.fft.rfft((output - output.mean()) * window)[1:]
    power_up_to = np.cumsum(np.abs(reference_lines) ** 2)
    if reference_lines.size < _FEWEST_LINES or not power_up_to[-1] > 0:
        return None
    n_lines = int(np.searchsorted(power_up_to, _SLOW_POWER * power_up_to[-1])) + 1
    slow = slice(max(_FEWEST_LINES, n_lines))
    slow_reference = reference_lines[slow]
    slow_output = output_lines[slow]
    reference_power = np.vdot(slow_reference, slow_reference).real
    cross_power = np.vdot(slow_reference, slow_output).real
    output_power = np.vdot(slow_output, slow_output).real
    if cross_power <= 0 or cross_power**2 < _COHERENT * reference_power * output_power:
        return None
    return float(cross_power / reference_power)


def follows_as_it_stands(reference: RealArray, output: RealArray) -> bool:
    """Whether an output (T,) follows its reference (T,) in numbers of one unit.

    True within `_FOLLOWS_WITHIN`; False where it does not follow at all (see `followed_times`).
    """
    return _is_about_one(followed_times(reference, output) or 0.0)


def _is_about_one(times: float) -> bool:
    """Whether a factor between an output and its reference is that of a loop in one unit.

    False for zero, negative numbers and NaN.
    """
    return 1 / _FOLLOWS_WITHIN < times < _FOLLOWS_WITHIN


def contradicted_by_loop(
    reference: RealArray,
    output: RealArray,
    command: RealArray,
    names: Sequence[str],
    units: Sequence[str],
    scale: Mapping[str, float],
) -> tuple[Finding, ...]:
    """Findings on columns of a closed loop whose numbers contradict their units.

    Parameters
    ----------
    reference, output, command : ndarray, shape (T,)
        Signals of the loop, equally long and finite; not checked. Short ones, or a reference that stands
        still, contradict nothing.
    names, units : sequence of str
        Of reference, output and command, three each (ValueError else); a unit may be empty.
    scale : mapping of str to float
        Factors that the user stated, by name of a column.

    Returns
    -------
    tuple of Finding
        Empty where nothing is contradicted. EXCHANGED, OPPOSITE where the output moves against its
        reference, or UNIT_OF_LOOP for each of `_CONFUSIONS` that fits;
        the value `options` is what to type, `times` how many times the output is its reference.

    Notes
    -----
    The output follows the reference but for the factor between two units; or a command follows it in the
    output's place, though its unit is of another quantity.
    """
    reference_name, output_name, command_name = names
    reference_unit, output_unit, command_unit = units
    followed = followed_times(reference, output) or 0.0

    # Command and output exchanged: only what differs in its quantity can be told.
    reference_kind = kind_of(reference_unit)
    command_kind = kind_of(command_unit)
    kinds_differ = reference_kind != "" and command_kind != "" and reference_kind != command_kind
    if kinds_differ and not _is_about_one(followed) and follows_as_it_stands(reference, command):
        exchanged = {
            "--input": output_name,
            "--output": command_name,
            "--reference": reference_name,
        }
        words = [word for option in exchanged.items() for word in option]
        words += ["--unit", f"{output_name}={command_unit}"]
        words += ["--unit", f"{command_name}={output_unit}"]
        options = " ".join(map(as_typed, words))
        return (
            finding(
                FindingKind.EXCHANGED,
                reference=reference_name,
                output=output_name,
                name=command_name,
                options=options,
            ),
        )

    # A loop that follows makes its output move with the reference.
    if followed_times(reference, -output) is not None:
        options = scaled_by(output_name, -scale.get(output_name, 1.0), output_unit)
        return (finding(FindingKind.OPPOSITE, reference=reference_name, output=output_name, options=options),)

    # The reference is in the wrong unit where the output's header says that of its numbers, or each its own;
    # else the output is.
    output_is_larger = followed > 1
    output_size = size_of(output_unit)
    unit_is_small = output_size is not None and output_size.size < 1
    units_differ = all(units) and reference_unit != output_unit
    output_is_wrong = output_is_larger != unit_is_small and not units_differ
    findings = list[Finding]()
    for confusion in _CONFUSIONS:
        times = confusion.times if output_is_larger else 1 / confusion.times
        if not _is_about_one(followed / times):
            continue
        if output_is_wrong:
            factor = times**-1 * scale.get(output_name, 1.0)
            options = scaled_by(output_name, factor, output_unit)
        else:
            factor = times * scale.get(reference_name, 1.0)
            options = scaled_by(reference_name, factor)
        findings.append(
            finding(
                FindingKind.UNIT_OF_LOOP,
                reference=reference_name,
                output=output_name,
                times=times,
                like=confusion.units,
                options=options,
            )
        )
    return tuple(findings)


def scaled_by(name: str, factor: float, unit: str = "") -> str:
    """The options that take a column times a factor, and in a unit where one is given, as they are typed.

    factor: ten digits of it are written; not checked.
    """
    options = f"--scale {as_typed(f'{name}={factor:.10g}')}"
    if unit:
        options += f" --unit {as_typed(f'{name}={unit}')}"
    return options


@lru_cache(_CACHED_NAMES)
def written_unit(name: str) -> str:
    """The unit in a column's name, as written; empty where there is none.

    Brackets at the end hold a unit whatever they say but a number; after 'in', '/' and an underscore only
    known units count. What stands behind underscores comes with a slash: 'm/s2' of 'acc_m_s2'. Of a long name
    the last `_LONGEST_NAME` characters are read.
    """
    name = unicodedata.normalize("NFKC", name)[-_LONGEST_NAME:]
    bracketed = _BRACKETED.search(name)
    if bracketed:
        square, round_ = bracketed.groups()
        text = (round_ if square is None else square).strip()
        return "" if _NUMBER_ALONE.fullmatch(text) else text

    # Behind each underscore, the first one first: of 'acc_m_s2' that is 'm_s2'. A whole name is a unit only
    # where it is a rate, as 'rad_s': 'm' and 'V' are names, too.
    underscores = [underscore.end() for underscore in re.finditer("_", name)]
    for begin in (0, *underscores):
        unit = name[begin:]
        if is_unit(unit) and (begin > 0 or "/s" in kind_of(unit)):
            with_slashes = re.sub(r"_?per_?|_", "/", unit)
            return f"1{with_slashes}" if with_slashes.startswith("/") else with_slashes
    after = _AFTER.search(name)
    if after is None:
        return ""
    unit = after[1] or after[2]
    return unit if is_unit(unit) else ""


@lru_cache(_CACHED_NAMES)
def is_unit(text: str) -> bool:
    """Whether the word is a unit that headers use: of time, or of a signal.

    False for an empty text, or more than `_LONGEST_UNIT` characters.
    """
    if len(text) > _LONGEST_UNIT:
        return False
    in_lower_case = text.lower()
    if in_lower_case in TIME_UNITS or in_lower_case in SIGNAL_WORDS:
        return True
    return _BARE.fullmatch(text) is not None or "/s" in kind_of(text)
