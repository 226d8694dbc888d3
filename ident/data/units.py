"""Units as headers write them: 'Zeit [ms]', 'time (us)', 't_ms', 'angle_rad', 'u in mV'.

Time is converted to seconds; every other signal keeps its unit, which is carried along for display.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import as_typed, shown

# Integers, so that 2 [ms] becomes the very double that 0.002 is: an exact division is rounded once.
_PER_SECOND = {"s": 1, "ms": 1000, "us": 10**6, "ns": 10**9}
_SECONDS_PER = {"min": 60, "h": 3600, "d": 86400}
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

# Of signals: the first of their kind, how many of it one is, and spellings. Counts of each sort stand alone.
_SIGNALS = (
    ("V", 1.0, "V volt volts"),
    ("A", 1.0, "A ampere amperes amp amps"),
    ("N", 1.0, "N newton newtons"),
    ("rad", 1.0, "rad radian radians"),
    ("rad", np.pi / 180, "deg degree degrees"),
    *(
        ("rad", np.pi / 180, "° grad"),
        ("m", 1.0, "m meter metre meters metres"),
        ("m", 0.0254, "inch inches"),
    ),
    ("rad", 2 * np.pi, "rev revs rot rots turn turns rotation rotations revolution revolutions"),
    *(("Nm", 1.0, "Nm N·m N*m"), ("W", 1.0, "W"), ("Hz", 1.0, "Hz"), ("Pa", 1.0, "Pa"), ("%", 1.0, "%")),
    *(("counts", 1.0, "counts count cnts cnt"), ("inc", 1.0, "inc increments increment")),
    *(("steps", 1.0, "steps step"), ("ticks", 1.0, "ticks tick"), ("pulses", 1.0, "pulses pulse imp")),
    ("1", 1.0, "1"),
)
COUNTED = frozenset({"counts", "inc", "steps", "ticks", "pulses", "%"})
"""Kinds of units whose size only the machine knows."""
_SIZES = {word: (kind, size) for kind, size, words in _SIGNALS for word in words.split()}
# Words for them, as instruments write them in a line of units.
SIGNAL_WORDS = {word: words.split()[0] for _, _, words in _SIGNALS[:5] for word in words.split()[1:]}
_PREFIXES = {"n": 1e-9, "u": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_PREFIXED = re.compile(r"([nuμmckM])(V|A|N|Nm|rad|m|W|Hz|Pa)")
_RATE = re.compile(r"(.*?)(/|_|_?per_?)([^\W\d_]+)(?:\^?([23]))?")
_OWN_NAMES = {"rpm": "rev/min", "u/min": "rev/min", "1/min": "rev/min", "rps": "rev/s", "dps": "deg/s"}
# Where no bracket says that it is a unit, a name's last letters must be no other word.
_BARE = re.compile(r"[mukµμM]?(V|A|N|Nm|rad|W|Hz|Pa)|[cmuµμk]?m|deg|rpm|rps|dps|°|%")
_BRACKETED = re.compile(r"\[([^\[\]]*)\]\s*$|\(([^()]*)\)\s*$")
_BRACKETS = re.compile(r"[\[({<【〔]([^\[\](){}<>【】〔〕]*)[\])}>】〕]")
# timeMs is time and Ms, TimeUS is Time and US.
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_WORD = re.compile(r"[^\W\d_]+")
# A number just before a word, or behind it: 0.1 ms, 100us, sec/1000; not that of a word, as in t0 ms.
_FACTOR = re.compile(
    r"(?<![^\W_])(?<![.,])\d[\d.,]*(?:e[+-]?\d+)?\s*[x*·]?\s*([^\W\d_]+)|"
    r"(?<![^\W\d_])([^\W\d_]+)\s*[/x*·^]\s*\d",
    re.IGNORECASE,
)
# Characters: a name says its unit and its role at its ends, and a unit is short ('microseconds per second').
# What is longer is a sentence, a path or a trap; the expressions here take a square of the length.
_LONGEST_NAME, _LONGEST_UNIT = 200, 40
_NAMES_KEPT = 2 * 4096  # as many as two tables have columns
_TIME_WORD = re.compile(
    r"t|ts|time|zeit|uhrzeit|timestamps?|zeitstempel|zeitpunkt|elapsed|clock|stamp|temps|tiempo|tempo|date|datum|"
    r"datetime|время|时间|時間"
)
# A unit without a blank behind a word for time, 'elapsedms', 'tms'; not the plural 'times'.
_LONG_UNITS = "|".join(sorted((unit for unit in TIME_UNITS if len(unit) > 1), key=len, reverse=True))
_GLUED = re.compile(
    rf"(t(?!min|[hdt])|[^\W\d_]*(?:{_TIME_WORD.pattern.removeprefix('t|ts|')}))({_LONG_UNITS}|(?<=\w\w\w\w)[hm])"
)
# The prefix of a second that stands apart: 'm s', 'time_milli', 'milli seconds'.
_APART = re.compile(
    r"(?<![^\W\d_])(milli|micro|nano)(?:[\s_.-]*s(?:ec(?:ond)?s?)?)?(?![^\W\d_])", re.IGNORECASE
)
# Behind the word for time: of minutes or seconds, or a transpose of MATLAB.
_PRIME = re.compile(r"""^[^'"]*[^\W_]['"′″]+$""")
# A factor on what has its unit in brackets: [ns]/1000.
_CHANGED = re.compile(r"[\])}>]\s*[/x*·^]\s*\d|^[\d.,e+-]+\s*[x*·]")
# These, and what stands beside them and says nothing of the unit.
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
_AFTER = re.compile(r"\sin\s+(\S+)\s*$|^\w+\s*/\s*(\w+)\s*$")

# By how much a signal is larger in another unit.
_TIMES = ((180 / np.pi, "degrees and radians"), (1e3, "mm and m"))
# Where a loop follows best: lowest lines with this share of the reference's power, so many at least.
_SLOW, _FEWEST_LINES = 0.03, 8
# Measured and simulated loops follow there to a factor of 1.1, with a coherence of 0.9 and more.
_FOLLOWS, _COHERENT = 1.3, 0.5

# A log of more samples than this, with steps of at least so many seconds, is rather one in milliseconds.
_MANY_SAMPLES = 1000
LONG_STEP_S = 0.5  # machines are logged faster than twice a second
# No machine is logged with shorter steps, nor one whose motion the samples show with longer ones.
_SHORTEST_S, _LONGEST_S = 1e-6, 1.0
# Seconds since 1970 of the years 2001 and 2100: stamps in between, in whatever unit, are dates.
_DATES_S = (978_307_200.0, 4_102_444_800.0)
# No clock counts 3000 years.
_NO_CLOCK_S = 1e11


def unit_of_time(name: str, beside: str = "") -> tuple[str, str]:
    """What a file says of the unit of a time column: the one known unit, or empty; why it has to be asked for
    (units that contradict each other, an unknown word), or empty. beside: what the file gives outside of the
    name, as in a line of units."""
    name, beside = (in_short(unicodedata.normalize("NFKC", text).strip()) for text in (name, beside))
    texts = [beside.strip("[](){}<> "), *_BRACKETS.findall(name)]
    said, strange = dict[str, str](), ""
    for text in (text for text in texts if _WORD.search(text)):
        whole = re.sub(r"[\s._-]", "", text).lower()  # 'm s' is one
        words = ["days"] if whole == "d" else [whole] if whole in TIME_UNITS else _words(text)
        units = [TIME_UNITS[word] for word in words if word in TIME_UNITS]
        odd = [word for word in words if not (word in TIME_UNITS or _NO_UNIT.fullmatch(word))]
        if (odd and (not units or min(map(len, odd)) <= 2)) or (units and re.search(r"\d", text)):
            strange = strange or text
        said |= dict.fromkeys(units, text)
    outside = _BRACKETS.sub(" ", name)
    words = _words(outside)
    units = [TIME_UNITS[word] for word in words if word in TIME_UNITS]
    factors = [word.lower() for found in _FACTOR.findall(outside) for word in found]
    if _PRIME.search(name) or (said and _CHANGED.search(name)) or set(factors) & TIME_UNITS.keys():
        strange = strange or name
    if not strange:
        # After the word for time a short one is rather a unit, or its prefix, than a name: t_m, time_cs.
        behind = words[1:] if any(map(_TIME_WORD.fullmatch, words)) else []
        short = [word for word in behind if len(word) <= 2 and not _NO_UNIT.fullmatch(word)]
        short = [word for word in short if word not in TIME_UNITS and (not units or word in _PREFIXES)]
        counts = [] if units else [word for word in words if _COUNTS.fullmatch(word)]
        strange = "" if said else next(iter((*counts, *short)), "")
    for unit in units:
        said.setdefault(unit, name)
    if strange:
        return "", f"unknown unit '{strange}'"
    if len(said) > 1:
        return "", f"contradicting units {' and '.join(said)}"
    return next(iter(said), ""), ""


def in_short(name: str) -> str:
    """What is read of a name: all but its middle, where it is longer than any name that people read."""
    half = _LONGEST_NAME // 2
    return name if len(name) <= _LONGEST_NAME else f"{name[:half]} {name[-half:]}"


def _words(text: str) -> list[str]:
    """The words of a name in lower case, without digits; a unit that is glued to the word for time is one of
    its own."""
    text = _APART.sub(lambda found: {"milli": "ms", "micro": "us", "nano": "ns"}[found[1].lower()], text)
    found = list[str]()
    for word in _WORD.findall(text.replace("_", " ")):
        known = word.lower() in TIME_UNITS or _GLUED.fullmatch(word.lower())
        for part in [word.lower()] if known else _CAMEL.sub(" ", word).lower().split():
            glued = _GLUED.fullmatch(part)
            found += glued.groups() if glued else [part]
    return found


@lru_cache(_NAMES_KEPT)
def says_time(name: str) -> bool:
    """Whether a name is one of time: 'Zeit', 'timeMs', 'millis', 'us since start'; not 'counts_s'."""
    words = _words(in_short(unicodedata.normalize("NFKC", name)))
    return bool(words) and (
        _TIME_WORD.fullmatch(words[0]) is not None
        or (
            all(word in TIME_UNITS or _NO_UNIT.fullmatch(word) or _COUNTS.fullmatch(word) for word in words)
            and any(word in TIME_UNITS for word in words)
            and not kind_of(written_unit(name)).endswith("/s")
        )
    )


def ends_with_time(name: str) -> bool:
    """Whether a name may be one of time: 'host_time', 'uptimems', 'bagTimestamp', but also 'cycle_time'."""
    words = [word for word in _words(in_short(name)) if word not in TIME_UNITS]
    return bool(words) and re.fullmatch(r"\w*(time|timestamp|stamp|zeit|clock)", words[-1]) is not None


def says_counts(name: str) -> bool:
    """Whether a name speaks of counts, which are whole numbers: 'encoder_counts', 'inc', 'ticks left'."""
    kinds = (_SIZES.get(word, ("", 0.0))[0] for word in _words(in_short(name)))
    return any(kind in COUNTED - {"%"} for kind in kinds)


def begins_with_time_unit(name: str) -> bool:
    """Whether a name begins with a unit of time, 'ms_since_power_on', and says no other unit at its end."""
    words = _words(in_short(name))
    return len(words) > 1 and TIME_UNITS.get(words[0], "") in _PER_SECOND and not written_unit(name)


def stated_time_unit(stated: str) -> str:
    """A unit of time as it is spelled here. Raises ValueError for one that is not known."""
    unit = TIME_UNITS.get(stated.lower(), stated.lower())
    if unit not in KNOWN_TIME_UNITS:
        raise ValueError(f"unknown unit of time '{stated}'; expected {', '.join(KNOWN_TIME_UNITS)}")
    return unit


@dataclass(frozen=True)
class TimeColumn:
    """What the time stamps of a log were taken for: unit, one of `KNOWN_TIME_UNITS`; in_header: that in the
    column's name, or empty; stated: by the user, which counts more. doubtful: called seconds, and look like
    integer milliseconds, or called by a smaller unit and look like seconds. wraps_at, wraps: the period of a
    timer that starts again, in its unit, and how often it does; 0 for none."""

    name: str
    unit: str
    in_header: str
    stated: bool = False
    doubtful: bool = False
    wraps_at: float = field(default=0.0, metadata={"since": 2})
    wraps: int = field(default=0, metadata={"since": 2})

    def timer(self, record: str) -> Finding:
        """What there is to say of stamps that start again and were read as going on."""
        return finding(
            FindingKind.TIMER_WRAPS, record=record, name=self.name, period=self.wraps_at, count=self.wraps
        )

    def doubt(self, dt_s: float) -> Finding:
        """What there is to say of a doubtful column with steps of dt_s."""
        # Machines are logged faster than twice a second: steps of 4 are milliseconds, of 4000 microseconds.
        unit = next((unit for unit in ("ms", "us") if dt_s < LONG_STEP_S * _PER_SECOND[unit]), "ns")
        options = f"--time-unit {unit if self.unit == 's' else 's'}"
        return finding(
            FindingKind.TIME_UNIT, name=self.name, in_header=self.in_header, dt_s=dt_s, options=options
        )

    @classmethod
    def of(cls, name: str, stated: str | None = None, beside: str = "") -> TimeColumn:
        """stated: by the user; beside: by the file, outside of the name. Raises ValueError (one line) for a
        unit that is not known, or where the file contradicts itself, unless it is stated."""
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

    def refuse_stamps(self, stamps: RealArray) -> None:
        """Raise ValueError where stamps are no time of any clock, dates of this century in another unit than
        the one taken, or have steps that are too short for a machine."""
        if self.stated or not stamps.size:
            return
        first, taken = float(stamps[0]), f"its unit is said to be {self.in_header}"
        taken = taken if self.in_header else "no unit is stated"
        if first > 0 and float(self.seconds(np.array(first))) > _NO_CLOCK_S:
            since = {unit: first / size for unit, size in _PER_SECOND.items() if unit != self.unit}
            dates = [unit for unit, seconds in since.items() if _DATES_S[0] <= seconds <= _DATES_S[1]]
            looks = [f"{unit} since 1970: state --time-unit {unit}" for unit in dates]
            looks += ["another unit: state it with --time-unit, or give --dt-s SECONDS instead of --time"]
            raise ValueError(
                f"time column '{shown(self.name, 60)}' begins with {first:.6g}, {taken}; this looks "
                f"like {looks[0]}"
            )
        written = float(np.median(np.diff(stamps))) if stamps.size > 2 else 0.0
        step_s = float(self.seconds(np.array(written)))
        # Where nobody says seconds, what makes less than a second in days is rather that: Excel, datenum.
        if 0 < step_s < (_SHORTEST_S if self.in_header else 1.01 * _LONGEST_S / _SECONDS_PER["d"]):
            likely = [
                f"--time-unit {unit} (a step of {written * size:.4g} s)"
                for unit, size in (_SECONDS_PER | {"s": 1}).items()
                if unit != self.unit and 1e2 * _SHORTEST_S <= written * size <= 1.01 * _LONGEST_S
            ]
            raise ValueError(
                f"time column '{shown(self.name, 60)}' has steps of {step_s:.4g} s, {taken}: no machine is "
                f"logged that fast; state {' or '.join(likely[::-1]) or 'the right --time-unit'}, or "
                f"--time-unit {self.unit} if it is right"
            )

    def seconds(self, stamps: RealArray) -> RealArray:
        """The stamps in seconds."""
        if self.unit in _SECONDS_PER:
            return np.asarray(stamps * _SECONDS_PER[self.unit], dtype=np.float64)
        return np.asarray(stamps / _PER_SECOND[self.unit], dtype=np.float64)

    def doubtful_for(self, stamps: RealArray) -> bool:
        """Whether these increasing stamps, taken as seconds without anybody saying so, look like integers of
        a smaller unit: steps of half a second and more in a long log, or nothing but integers. Of a smaller
        unit in the header: whether they are sampled faster than 100 kHz, and as seconds like machines are."""
        if self.stated or stamps.size < 3:
            return False
        step = (stamps[-1] - stamps[0]) / (stamps.size - 1)
        if self.unit != "s":
            return bool(self.seconds(step) < 10 * _SHORTEST_S and 1e2 * _SHORTEST_S <= step <= _LONGEST_S)
        integers = bool(np.all(stamps == np.round(stamps)) and stamps[-1] > 1)
        return integers or bool(step >= LONG_STEP_S and stamps.size > _MANY_SAMPLES)


def refuse_step(label: str, dt_s: float, output: RealArray, column: TimeColumn | None = None) -> None:
    """Raise ValueError for a sampling time that no machine has: too short, or too long while the samples of
    an output (T, Y) show its motion. column: where the time stamps come from; None: dt_s was given."""
    if column is not None and column.stated:
        return
    # Of samples that have nothing to do with each other the steps have twice the variance.
    steps = np.mean(np.diff(output, axis=0) ** 2, axis=0) if dt_s > _LONGEST_S else np.inf
    moves = bool(np.any(steps < np.var(output, axis=0)))
    if dt_s >= _SHORTEST_S and not moves:
        return
    if column is None:
        rate = f"; of a rate of {dt_s:g} Hz it is {1 / dt_s:.6g}" if moves else ""
        what = f"dt_s = {dt_s:g} is in seconds, and no machine is logged that {'slowly' if moves else 'fast'}"
        raise ValueError(f"{label}: {what}{rate}; expected {_SHORTEST_S:g} to {_LONGEST_S:g} s")
    unit = next((unit for unit in ("ms", "us", "ns") if dt_s < LONG_STEP_S * _PER_SECOND[unit]), "ns")
    said = f"its unit is said to be {column.in_header}" if column.in_header else "no unit is stated"
    raise ValueError(
        f"{label}: time column '{shown(column.name, 60)}' has steps of {dt_s:.4g} s, {said}: no machine that "
        f"moves is logged that slowly; state --time-unit {unit}, or --time-unit {column.unit} if it is right"
    )


@lru_cache(_NAMES_KEPT)
def size_of(unit: str) -> tuple[str, float] | None:
    """Of what a unit is, 'rad' or 'rad/s', and how many of that one is: ('rad/s', 0.1047) of rpm. None where
    it is not known."""
    if len(unit) > _LONGEST_UNIT:
        return None
    text = "".join(unicodedata.normalize("NFKC", unit).split())
    text = _OWN_NAMES.get(text.lower(), text)
    if text.lower() in TIME_UNITS:
        own = TIME_UNITS[text.lower()]
        return "s", 1 / _PER_SECOND[own] if own in _PER_SECOND else _SECONDS_PER[own]
    if found := _SIZES.get(text) or _SIZES.get(text.lower() if len(text) > 2 else ""):
        return found
    if prefixed := _PREFIXED.fullmatch(text):
        kind, size = _SIZES[prefixed[2]]
        return kind, size * _PREFIXES[prefixed[1]]
    rate = _RATE.fullmatch(text)
    over, under = (size_of(rate[1] or "1"), size_of(rate[3])) if rate else (None, None)
    if rate is None or over is None or under is None or under[0] != "s":
        return None
    # Behind an underscore only a second is sure: angle_deg_min is the least, ticks_ms counts milliseconds.
    if rate[2] == "_" and under[1] != 1 and not (over == _SIZES["rev"] and under[1] == _SECONDS_PER["min"]):
        return None
    return f"{over[0]}/s{rate[4] or ''}", over[1] / under[1] ** int(rate[4] or 1)


def kind_of(unit: str) -> str:
    """Of what a unit is, as of `size_of`; empty where it is not known."""
    return (size_of(unit) or ("",))[0]


def per(unit: str, other: str) -> float | None:
    """How many of the other unit one is: 57.3 of rad and deg; None where they are not of one quantity."""
    one, like = size_of(unit), size_of(other)
    return one[1] / like[1] if one and like and one[0] == like[0] else None


def followed_times(reference: RealArray, output: RealArray) -> float | None:
    """How many times its reference (T,) an output (T,) is, where a loop follows best; None: it does not."""
    window = np.hanning(output.size)
    r, y = (np.fft.rfft((signal - signal.mean()) * window)[1:] for signal in (reference, output))
    power = np.cumsum(np.abs(r) ** 2)
    if r.size < _FEWEST_LINES or not power[-1] > 0:
        return None
    slow = slice(max(_FEWEST_LINES, int(np.searchsorted(power, _SLOW * power[-1])) + 1))
    own, both, answer = (np.vdot(a[slow], b[slow]).real for a, b in ((r, r), (r, y), (y, y)))
    if both <= 0 or both**2 < _COHERENT * own * answer:
        return None
    return float(both / own)


def follows_as_it_stands(reference: RealArray, output: RealArray) -> bool:
    """Whether an output (T,) follows its reference (T,) in numbers of one unit."""
    return 1 / _FOLLOWS < (followed_times(reference, output) or 0.0) < _FOLLOWS


def contradicted_by_loop(
    reference: RealArray,
    output: RealArray,
    command: RealArray,
    names: Sequence[str],
    units: Sequence[str],
    scale: Mapping[str, float],
) -> tuple[Finding, ...]:
    """The finding on an output (T,) that follows its reference (T,) but for the factor between two units, or
    on a command (T,) that follows it in the output's place though its unit is of another quantity.
    names, units: of reference, output and command; scale: as stated, by name."""
    followed = followed_times(reference, output) or 0.0
    if (
        "" != kind_of(units[0]) != kind_of(units[2]) != ""
        and not 1 / _FOLLOWS < followed < _FOLLOWS and follows_as_it_stands(reference, command)
    ):  # fmt: skip
        return (
            finding(
                FindingKind.EXCHANGED, reference=names[0], output=names[1], name=names[2],
                options=" ".join(map(as_typed, [
                    "--input", names[1], "--output", names[2], "--reference", names[0],
                    "--unit", f"{names[1]}={units[2]}", "--unit", f"{names[2]}={units[1]}",
                ])),
            ),
        )  # fmt: skip
    larger = followed > 1  # the output
    found = [(times if larger else 1 / times, like) for times, like in _TIMES]
    found = [(times, like) for times, like in found if 1 / _FOLLOWS < followed / times < _FOLLOWS]
    # The reference is in the wrong unit where the output's header says that of its numbers, or each its own.
    small = (size_of(units[1]) or ("", 1.0))[1] < 1
    wrong = int(larger != small and not (all(units) and units[0] != units[1]))
    return tuple(
        finding(
            FindingKind.UNIT_OF_LOOP, reference=names[0], output=names[1], times=times, like=like,
            options=scaled_by(
                names[wrong], times ** (1 - 2 * wrong) * scale.get(names[wrong], 1.0), units[1] * wrong
            ),
        )
        for times, like in found
    )  # fmt: skip


def scaled_by(name: str, factor: float, unit: str = "") -> str:
    """The options that take a column times a factor, in a unit."""
    said = {"--scale": f"{factor:.10g}", "--unit": unit}
    return " ".join(f"{option} {as_typed(f'{name}={value}')}" for option, value in said.items() if value)


@lru_cache(_NAMES_KEPT)
def written_unit(name: str) -> str:
    """The unit in a column's name, as written, or empty. Brackets at the end hold a unit whatever they say
    but a number; after 'in', '/' and an underscore only known units count."""
    name = unicodedata.normalize("NFKC", name)[-_LONGEST_NAME:]
    found = _BRACKETED.search(name)
    if found:
        text = (found[1] if found[1] is not None else found[2]).strip()
        return "" if re.fullmatch(r"[\d.,:\s-]*", text) else text
    starts = (0, *(found.end() for found in re.finditer("_", name)))
    unit = next((name[k:] for k in starts if is_unit(name[k:]) and (k or "/s" in kind_of(name))), "")
    if unit:
        return re.sub(r"^(?=/)", "1", re.sub(r"_?per_?|_", "/", unit))
    found = _AFTER.search(name)
    unit = (found[1] or found[2]) if found else ""
    return unit if is_unit(unit) else ""


@lru_cache(_NAMES_KEPT)
def is_unit(text: str) -> bool:
    """Whether the word is a unit that headers use: of time, or of a signal."""
    if len(text) > _LONGEST_UNIT:
        return False
    known = text.lower() in TIME_UNITS or text.lower() in SIGNAL_WORDS or _BARE.fullmatch(text) is not None
    return known or "/s" in kind_of(text)
