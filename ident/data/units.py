"""Units as headers write them: 'Zeit [ms]', 'time (us)', 't_ms', 'angle_rad', 'u in mV'.

Time is converted to seconds; every other signal keeps its unit, which is carried along for display.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding

# Units per second, or seconds per unit. Both are integers, so that 2 [ms] becomes the very double that 0.002
# is: division by an exact number is rounded once.
_PER_SECOND = {"s": 1, "ms": 1000, "us": 10**6, "ns": 10**9}
_SECONDS_PER = {"min": 60, "h": 3600}
_SPELLED = {
    "s": "s sec secs second seconds sek sekunde sekunden",
    "ms": "ms msec millisecond milliseconds millisekunden",
    "us": "us µs μs usec microsecond microseconds mikrosekunden",
    "ns": "ns nsec nanosecond nanoseconds nanosekunden",
    "min": "min minute minutes minuten",
    "h": "h hr hour hours stunden",
}
TIME_UNITS = {spelling: unit for unit, spellings in _SPELLED.items() for spelling in spellings.split()}
"""The unit of each spelling in lower case; values: s, ms, us, ns, min, h."""
KNOWN_TIME_UNITS = tuple(_SPELLED)

# Of signals, where no bracket says that it is a unit: a name's last letters must be no other word.
_SIGNAL = re.compile(
    r"[mukµμM]?(V|A|N|Nm|rad|W|Hz|Pa)|[cmuµμk]?m|deg|rpm|(rad|deg|m|mm)(_s|/s|_s2|/s2|/s\^2|/s²)|°|%"
)
_BRACKETED = re.compile(r"\[([^\[\]]*)\]\s*$|\(([^()]*)\)\s*$")
_AFTER = re.compile(r"\sin\s+(\S+)\s*$|^\w+\s*/\s*(\w+)\s*$")

# A log of more samples than this, with steps of at least so many seconds, is rather one in milliseconds.
_MANY_SAMPLES = 1000
_LONG_STEP_S = 0.5


@dataclass(frozen=True)
class TimeColumn:
    """What the time stamps of a log were taken for.

    name : str. The column.
    unit : str. One of `KNOWN_TIME_UNITS`.
    in_header : str. The unit in the column's name, empty if there is none.
    stated : bool. Whether the user stated the unit (which counts more than the header).
    doubtful : bool. The stamps are called seconds and look like integer milliseconds.
    """

    name: str
    unit: str
    in_header: str
    stated: bool = False
    doubtful: bool = False

    def doubt(self, dt_s: float) -> Finding:
        """What there is to say of a doubtful column with steps of dt_s."""
        return finding(FindingKind.TIME_UNIT, name=self.name, in_header=self.in_header, dt_s=dt_s)

    @classmethod
    def of(cls, name: str, stated: str | None = None, beside: str = "") -> TimeColumn:
        """stated: by the user; beside: by the file, outside of the name. Raises ValueError (one line) for a
        unit that nobody knows."""
        if stated is not None:
            if stated.lower() not in TIME_UNITS:
                raise ValueError(f"unknown unit of time '{stated}'; expected {', '.join(KNOWN_TIME_UNITS)}")
            unit = TIME_UNITS[stated.lower()]
            return cls(name, unit, TIME_UNITS.get(written_unit(name).lower(), ""), stated=True)
        # 'time ms', or just 'ms': no unit in the name of any other signal, but of time it is.
        last = re.split(r"[\s_./]", name.strip())[-1]
        written = beside or written_unit(name) or (last if last.lower() in TIME_UNITS else "")
        known = TIME_UNITS.get(written.lower(), "")
        if written and not known and (beside or _BRACKETED.search(name)):
            raise ValueError(
                f"time column '{name}': unknown unit '{written}'; expected {', '.join(KNOWN_TIME_UNITS)}, "
                "or state it with --time-unit (time_unit)"
            )
        return cls(name, known or "s", known)

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


def written_unit(name: str) -> str:
    """The unit in a column's name, as written there; empty if there is none.

    Brackets at the end hold a unit whatever they say (a number is an index); after 'in', '/' and an
    underscore only known units count, for other words stand there as well.
    """
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
    return text.lower() in TIME_UNITS or _SIGNAL.fullmatch(text) is not None
