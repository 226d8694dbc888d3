"""Units as headers write them: 'Zeit [ms]', 'time (us)', 't_ms', 'angle_rad', 'u in mV'.

Time is converted to seconds; every other signal keeps its unit, which is carried along for display.
"""

from __future__ import annotations

import re
import shlex
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import shown

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

# Of signals, where no bracket says that it is a unit: a name's last letters must be no other word.
_SIGNAL = re.compile(
    r"[mukµμM]?(V|A|N|Nm|rad|W|Hz|Pa)|[cmuµμk]?m|deg|rpm|(rad|deg|m|mm)(_s|/s|_s2|/s2|/s\^2|/s²)|°|%"
)
# Words for them, as instruments write them in a line of units.
SIGNAL_WORDS = {
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("ampere", "amperes", "amp", "amps"), "A"),
    **dict.fromkeys(("degree", "degrees"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("newton", "newtons"), "N"),
}
_BRACKETED = re.compile(r"\[([^\[\]]*)\]\s*$|\(([^()]*)\)\s*$")
_BRACKETS = re.compile(r"[\[({<【〔]([^\[\](){}<>【】〔〕]*)[\])}>】〕]")
# timeMs is time and Ms, TimeUS is Time and US.
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
_WORD = re.compile(r"[^\W\d_]+")
_GLUED = re.compile(r"(?:t|time|timestamp)((?:[mun]|milli|micro|nano)s(?:ecs?|econds?)?|secs?|seconds?)")
# A number just before a word, or behind it: 0.1 ms, 100us, sec/1000; not that of a word, as in t0 ms.
_FACTOR = re.compile(
    r"(?<![^\W_])(?<![.,])\d[\d.,]*(?:e[+-]?\d+)?\s*[x*·]?\s*([^\W\d_]+)|([^\W\d_]+)\s*[/x*·^]\s*\d",
    re.IGNORECASE,
)
_TIME_WORD = re.compile(
    r"t|ts|time|zeit|uhrzeit|timestamps?|zeitstempel|zeitpunkt|elapsed|clock|stamp|temps|tiempo|tempo|date|datum|"
    r"datetime|время|时间|時間"
)
# What stands beside these and says nothing of the unit.
_NO_UNIT = re.compile(
    r"in|of|to|by|at|on|up|no|nr|id|ch|io|pc|ab|is|since|start|begin|epoch|unix|posix|utc|gmt|ce?s?t|local|rel|abs|"
    r"relative|absolute|from|seit|beginn|log|host|sys|system|boot|trigger|raw|the|a|and|hh|mm|ss|hhmmss|day"
)
# Counts of something whose length nobody has said, and units of time that are not known.
_COUNTS = re.compile(
    r"ticks?|counts?|cycles?|samples?|frames?|steps?|jiffies|index|idx|sequence|takte?|zykl(?:en|us)|weeks?|"
    r"months?|years?|picosec\w*|[cdkpf]s"
)
_AFTER = re.compile(r"\sin\s+(\S+)\s*$|^\w+\s*/\s*(\w+)\s*$")

# Units of one quantity, each in the first of its kind; a rate has them before its stroke.
_SIZES = {
    "rad": ("rad", 1.0), "mrad": ("rad", 1e-3), **dict.fromkeys(("deg", "°", "grad"), ("rad", np.pi / 180)),
    "m": ("m", 1.0), "cm": ("m", 1e-2), "mm": ("m", 1e-3),
}  # fmt: skip
# By how much a signal is larger in another unit.
_TIMES = ((180 / np.pi, "degrees and radians"), (1e3, "mm and m"))
# Where a loop follows best: lowest lines with this share of the reference's power, so many at least.
_SLOW, _FEWEST_LINES = 0.03, 8
# Measured and simulated loops follow there to a factor of 1.1, with a coherence of 0.9 and more.
_FOLLOWS, _COHERENT = 1.3, 0.5

# A log of more samples than this, with steps of at least so many seconds, is rather one in milliseconds.
_MANY_SAMPLES = 1000
_LONG_STEP_S = 0.5  # machines are logged faster than twice a second
# Seconds since 1970 of the years 2001 and 2100: stamps in between, in whatever unit, are dates.
_DATES_S = (978_307_200.0, 4_102_444_800.0)
# No clock counts 3000 years.
_NO_CLOCK_S = 1e11


@dataclass(frozen=True)
class UnitEvidence:
    """What a file says of the unit of a time column. unit: the one known unit, or empty; unclear: why it has
    to be asked for (units that contradict each other, an unknown word), or empty."""

    unit: str = ""
    unclear: str = ""

    @classmethod
    def of(cls, name: str, beside: str = "") -> UnitEvidence:
        """beside: the unit that the file gives outside of the name, as in a line of units."""
        name, beside = (unicodedata.normalize("NFKC", text).strip() for text in (name, beside))
        texts = [beside.strip("[](){}<> "), *_BRACKETS.findall(name)]
        said, strange = dict[str, str](), ""
        for text in (text for text in texts if _WORD.search(text)):
            words = [word.lower() for word in _words(text)]
            units = ["d"] if words == ["d"] else [TIME_UNITS[word] for word in words if word in TIME_UNITS]
            known = units or all(_TIME_WORD.fullmatch(word) or _NO_UNIT.fullmatch(word) for word in words)
            if not known or (units and re.search(r"\d", text)):
                strange = strange or text
            said |= dict.fromkeys(units, text)
        outside = _BRACKETS.sub(" ", name)
        words = [word.lower() for word in _words(outside)]
        if any(word.lower() in TIME_UNITS for found in _FACTOR.findall(outside) for word in found):
            strange = strange or outside.strip()
        units = [TIME_UNITS[word] for word in words if word in TIME_UNITS]
        if not units and not said and not strange:
            # After the word for time a short one is rather a unit than a name: t_m, time_cs.
            strange = next(
                (
                    word
                    for k, word in enumerate(words)
                    if _COUNTS.fullmatch(word)
                    or (k and len(word) <= 2 and not (_TIME_WORD.fullmatch(word) or _NO_UNIT.fullmatch(word)))
                ),
                "",
            )
        for unit in units:
            said.setdefault(unit, name)
        if strange:
            return cls(unclear=f"unknown unit '{strange}'")
        if len(said) > 1:
            return cls(unclear=f"contradicting units {' and '.join(said)}")
        return cls(next(iter(said), ""))


def _words(text: str) -> list[str]:
    """The words of a name, without digits; a unit that is glued to the word for time is one of its own."""
    found = []
    for part in _CAMEL.split(text):
        for word in _WORD.findall(part.replace("_", " ")):
            glued = _GLUED.fullmatch(word.lower())
            found += ["t", glued[1]] if glued else [word]
    return found


def says_time(name: str) -> bool:
    """Whether a name is one of time: 'Zeit', '__time', 'timeMs', 'millis', 'us since start'."""
    words = [word.lower() for word in _words(unicodedata.normalize("NFKC", name))]
    return bool(words) and (
        _TIME_WORD.fullmatch(words[0]) is not None
        or (
            all(word in TIME_UNITS or _NO_UNIT.fullmatch(word) or _COUNTS.fullmatch(word) for word in words)
            and any(word in TIME_UNITS for word in words)
        )
    )


def ends_with_time(name: str) -> bool:
    """Whether a name may be one of time: 'host_time', 'rosbagTimestamp', but also 'cycle_time'."""
    words = [word.lower() for word in _words(name)]
    return bool(words) and re.fullmatch(r"time|timestamp|stamp|zeit|clock", words[-1]) is not None


@dataclass(frozen=True)
class TimeColumn:
    """What the time stamps of a log were taken for: unit, one of `KNOWN_TIME_UNITS`; in_header: that in the
    column's name, or empty; stated: by the user, which counts more. doubtful: called seconds, and look like
    integer milliseconds."""

    name: str
    unit: str
    in_header: str
    stated: bool = False
    doubtful: bool = False

    def doubt(self, dt_s: float) -> Finding:
        """What there is to say of a doubtful column with steps of dt_s."""
        # Machines are logged faster than twice a second: steps of 4 are milliseconds, of 4000 microseconds.
        unit = next((unit for unit in ("ms", "us") if dt_s < _LONG_STEP_S * _PER_SECOND[unit]), "ns")
        options = f"--time-unit {unit}"
        return finding(
            FindingKind.TIME_UNIT, name=self.name, in_header=self.in_header, dt_s=dt_s, options=options
        )

    @classmethod
    def of(cls, name: str, stated: str | None = None, beside: str = "") -> TimeColumn:
        """stated: by the user; beside: by the file, outside of the name. Raises ValueError (one line) for a
        unit that is not known, or where the file contradicts itself, unless it is stated."""
        evidence = UnitEvidence.of(name, beside)
        if stated is not None:
            unit = TIME_UNITS.get(stated.lower(), stated.lower())
            if unit not in KNOWN_TIME_UNITS:
                raise ValueError(f"unknown unit of time '{stated}'; expected {', '.join(KNOWN_TIME_UNITS)}")
            return cls(name, unit, evidence.unit, stated=True)
        if evidence.unclear:
            raise ValueError(
                f"time column '{shown(name, 60)}': {shown(evidence.unclear, 60)}; expected "
                f"{', '.join(KNOWN_TIME_UNITS)}: state it with --time-unit (time_unit), or give --dt-s "
                "SECONDS instead of --time"
            )
        return cls(name, evidence.unit or "s", evidence.unit)

    def refuse_dates(self, first: float) -> None:
        """Raise ValueError where stamps that begin with this number are dates of this century in another unit
        than the one taken, or no time of any clock."""
        others = [
            unit
            for unit in ("s", "ms", "us", "ns")
            if _DATES_S[0] <= first / _PER_SECOND[unit] <= _DATES_S[1] and unit != self.unit
        ]
        if not self.stated and first > 0 and float(self.seconds(np.array(first))) > _NO_CLOCK_S:
            taken = "no unit is stated" if not self.in_header else f"its unit is said to be {self.unit}"
            looks = (
                f"{others[0]} since 1970: state --time-unit {others[0]}"
                if others
                else ("another unit: state it with --time-unit, or give --dt-s SECONDS instead of --time")
            )
            raise ValueError(
                f"time column '{shown(self.name, 60)}' begins with {first:.6g}, {taken}; this looks "
                f"like {looks}"
            )

    def seconds(self, stamps: RealArray) -> RealArray:
        """The stamps in seconds."""
        if self.unit in _SECONDS_PER:
            return np.asarray(stamps * _SECONDS_PER[self.unit], dtype=np.float64)
        return np.asarray(stamps / _PER_SECOND[self.unit], dtype=np.float64)

    def doubtful_for(self, stamps: RealArray) -> bool:
        """Whether these increasing stamps, taken as seconds without anybody saying so, look like integers of
        a smaller unit: steps of half a second and more in a long log, or nothing but integers."""
        if self.stated or self.unit != "s" or stamps.size < 3:
            return False
        step = (stamps[-1] - stamps[0]) / (stamps.size - 1)
        integers = bool(np.all(stamps == np.round(stamps)) and stamps[-1] > 1)
        return integers or bool(step >= _LONG_STEP_S and stamps.size > _MANY_SAMPLES)


def per(unit: str, other: str) -> float | None:
    """How many of the other unit one is: 57.3 of rad and deg; None where they are not of one quantity."""
    (first, *rate), (second, *same) = unit.split("/"), other.split("/")
    (kind, size), (like, one) = _SIZES.get(first, ("", 0.0)), _SIZES.get(second, (" ", 1.0))
    return size / one if (kind, rate) == (like, same) else None


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
    followed = followed_times(reference, output)
    return followed is not None and 1 / _FOLLOWS < followed < _FOLLOWS


def contradicted_by_loop(
    reference: RealArray,
    output: RealArray,
    names: tuple[str, str],
    units: tuple[str, str],
    scale: Mapping[str, float],
) -> tuple[Finding, ...]:
    """The finding on an output (T,) that follows its reference (T,) but for the factor between two units.
    names, units: of reference and output; scale: as stated, by name."""
    followed = followed_times(reference, output)
    if followed is None:
        return ()
    larger = followed > 1  # the output
    found = [(times if larger else 1 / times, like) for times, like in _TIMES]
    found = [(times, like) for times, like in found if 1 / _FOLLOWS < followed / times < _FOLLOWS]
    # The reference is in the wrong unit where the output's header says that of its numbers, or each its own.
    small = _SIZES.get(units[1].split("/")[0], ("", 1.0))[1] < 1
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
    return " ".join(f"{option} {shlex.quote(f'{name}={value}')}" for option, value in said.items() if value)


def written_unit(name: str) -> str:
    """The unit in a column's name, as written, or empty. Brackets at the end hold a unit whatever they say
    but a number; after 'in', '/' and an underscore only known units count."""
    name = unicodedata.normalize("NFKC", name)
    found = _BRACKETED.search(name)
    if found:
        text = (found[1] if found[1] is not None else found[2]).strip()
        return "" if re.fullmatch(r"[\d.,:\s-]*", text) else text
    suffixes = (name[found.end() :] for found in re.finditer("_", name))
    unit = next((text for text in suffixes if is_unit(text)), "")
    if unit:
        return unit.replace("_", "/")
    found = _AFTER.search(name)
    unit = (found[1] or found[2]) if found else ""
    return unit if is_unit(unit) else ""


def is_unit(text: str) -> bool:
    """Whether the word is a unit that headers use: of time, or of a signal."""
    return text.lower() in TIME_UNITS or text.lower() in SIGNAL_WORDS or _SIGNAL.fullmatch(text) is not None
