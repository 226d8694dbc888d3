"""Dates and clock times as logs write them, in seconds since the first of them.

ISO 8601 ('2024-03-01T12:00:00.25Z', with a blank for the T and slashes for the dashes as well), '01.03.2024
12:00:00,250', '3/1/2024 1:02:03.5 PM', and '12:00:00.250' without a day, which may pass midnight; '01:02.5'
is minutes and seconds, and of '12:30' alone nobody knows (`may_be_minutes`). Dates with a named month
('01-Mar-2024 10:00:00', 'Fri Mar 1 10:00:00 2024'), '20240301T100000', and what has passed in days ('0 days
00:00:00.005' of pandas, 'PT0.005S') are put into these forms first (`_in_usual_form`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from itertools import accumulate, pairwise

import numpy as np

from ident.data.arrays import RealArray
from ident.data.foreign_files import shown

_DAY = r"(?:(\d{4})([-/])(\d\d?)\2(\d\d?)|(\d\d?)([./])(\d\d?)\6(\d{4}))"
_CLOCK = r"(\d{1,7}):(\d\d)(?::(\d\d))?(?:[.,](\d{1,9}))?\s*([AaPp][Mm])?"
_ZONE = r"(?:Z|UTC|GMT|([+-])(\d\d):?(\d\d))"
_STAMP = re.compile(rf"(?:{_DAY}(?:T|,?\s+|_|-|$))?(?:{_CLOCK})?\s*{_ZONE}?")
_MAY_BE_OTHERWISE = re.compile(r"\d.*[A-Za-z]|[A-Za-z].*\d|:\d\d:\d\d:|\.\d\d?\.|\d{8}[ _-]\d{6}")
_LONGEST_STAMP = 60  # characters
# English and German months by their first letters.
_MONTHS = {
    "jan": 1,
    "feb": 2,
    "mar": 3,
    "mär": 3,
    "mrz": 3,
    "apr": 4,
    "may": 5,
    "mai": 5,
    "jun": 6,
    "jul": 7,
    "aug": 8,
    "sep": 9,
    "oct": 10,
    "okt": 10,
    "nov": 11,
    "dec": 12,
    "dez": 12,
}
_MONTH = r"(?P<month>[A-Za-zä]{3})[a-zä]*\.?"
_WEEKDAY = r"(?:(?:Mon|Tue|Wed|Thu|Fri|Sat|Sun|Mo|Di|Mi|Do|Fr|Sa|So)[a-z]*\.?,?\s+)?"
_NAMED_MONTH = (
    # 01-Mar-2024 10:00:00; Mar 1, 2024 10:00:00; Fri Mar 1 10:00:00 2024.
    re.compile(
        rf"{_WEEKDAY}(?P<day>\d\d?)(?:\.|st|nd|rd|th)?[-/ ]\s*{_MONTH}[-/, ]+(?P<year>\d{{4}})(?P<clock>.*)"
    ),
    re.compile(rf"{_WEEKDAY}{_MONTH}\s+(?P<day>\d\d?)(?:st|nd|rd|th)?,?\s+(?P<year>\d{{4}})(?P<clock>\D.*|)"),
    re.compile(rf"{_WEEKDAY}{_MONTH}\s+(?P<day>\d\d?)\s+(?P<clock>\d\d?:\S+)\s+(?P<year>\d{{4}})"),
)
_BASIC = re.compile(r"(\d{4})(\d\d)(\d\d)[T _-](\d\d)(\d\d)(\d\d)(.*)")
_DAYS_AND_CLOCK = re.compile(
    r"(?P<days>\d{1,5})\s*(?:days?|d|tage?),?\s*(?:\+?(?P<hours>\d{1,2}):(?P<rest>\d\d:\d\d.*))?",
    re.IGNORECASE,
)
_ISO_DURATION = re.compile(
    r"P(?:(?P<days>\d{1,5})D)?T(?:(?P<hours>\d{1,4})H)?(?:(?P<minutes>\d\d?)M)?(?P<seconds>\d\d?)"
    r"(?P<fraction>[.,]\d+)?S"
)
_YEAR_OF_TWO_DIGITS = re.compile(r"(\d\d?\.\d\d?\.)(\d\d)(?=[\s,]|$)")
_FRACTION_BEHIND_COLON = re.compile(r"(:\d\d:\d\d):(\d{3,9})")
_DAY_NS = 86_400 * 10**9  # a clock time begins again
_MINUTES_NS = 3600 * 10**9  # minutes and seconds begin again


def is_stamp(cell: str) -> bool:
    """Whether the text has the form of a date, a clock time, or both."""
    if len(cell) > 2 * _LONGEST_STAMP:
        return False
    begins = cell.lstrip()
    marked = any(sign in cell for sign in ":./") or "-" in cell[1:]
    return (marked or begins[:1] == "P" or begins[8:9] in ("T", " ", "_")) and _matched(cell) is not None


def seconds_since_first(cells: Sequence[str]) -> RealArray:
    """(T,) seconds. Raises ValueError naming the row (from 0) as `IndexError.args` would: (message, row)."""
    matches = []
    for row, cell in enumerate(cells):
        found = _matched(cell)
        if found is None:
            raise StampError(f"is '{shown(cell)}'; expected a date or time like '{shown(cells[0])}'", row)
        matches.append(found)
    minutes = _are_minutes(matches)
    month_first = _month_first(matches)
    days: dict[str, int] = {}
    nanoseconds = []
    for row, found in enumerate(matches):
        try:
            nanoseconds.append(_nanoseconds(found, month_first, days, minutes))
        except ValueError as error:
            raise StampError(f"is '{shown(cells[row])}', no possible date or time ({error})", row) from None
    if not any(found[1] or found[5] for found in matches):
        around = _MINUTES_NS if minutes else _DAY_NS
        turns = accumulate((a - b > around // 2 for a, b in pairwise(nanoseconds)), initial=0)
        nanoseconds = [now + around * turn for now, turn in zip(nanoseconds, turns, strict=True)]
    # The difference in whole nanoseconds first: doubles hold dates to a fraction of a microsecond only.
    return np.array([now - nanoseconds[0] for now in nanoseconds], dtype=np.float64) / 1e9


def may_be_minutes(cells: Sequence[str]) -> bool:
    """Whether stamps are like '12:30', hours and minutes or minutes and seconds, and none tells which;
    `seconds_since_first` takes hours."""
    matches = [found for cell in cells if (found := _matched(cell)) is not None]
    return bool(matches) and all(map(_has_two_parts, matches)) and not _are_minutes(matches)


def _has_two_parts(found: re.Match[str]) -> bool:
    return bool(found[9] and not (found[11] or found[13] or found[1] or found[5]))


def _are_minutes(matches: Sequence[re.Match[str]]) -> bool:
    """Whether clock times of two parts are minutes and seconds: only seconds have a fraction, and no day has
    more than 24 hours."""
    return all(map(_has_two_parts, matches)) and any(found[12] or int(found[9]) > 23 for found in matches)


class StampError(ValueError):
    """A cell that is no time stamp; `row` counts from 0."""

    def __init__(self, message: str, row: int) -> None:
        super().__init__(message)
        self.row = row


def _matched(cell: str) -> re.Match[str] | None:
    """The parts of a date, a clock time or both, in the groups of `_STAMP`; None where it is none."""
    text = cell.strip()
    if not 3 < len(text) < _LONGEST_STAMP:
        return None
    found = _STAMP.fullmatch(text)
    if found is None and _MAY_BE_OTHERWISE.search(text):
        found = _STAMP.fullmatch(_in_usual_form(text))
    return found if found is not None and (found[1] or found[5] or found[9]) else None


def _in_usual_form(text: str) -> str:
    """A stamp with a named month, in basic ISO 8601 or in days, as ISO 8601 or a clock time has it; another
    text as it is."""
    for form in _NAMED_MONTH:
        named = form.fullmatch(text)
        month = _MONTHS.get(named["month"].lower(), 0) if named else 0
        if named and month:
            return (
                f"{named['year']}-{month:02d}-{named['day'].zfill(2)} {named['clock'].strip(' ,_T-')}".strip()
            )
    if basic := _BASIC.fullmatch(text):
        return f"{basic[1]}-{basic[2]}-{basic[3]} {basic[4]}:{basic[5]}:{basic[6]}{basic[7]}"
    if passed := _DAYS_AND_CLOCK.fullmatch(text):
        hours = 24 * int(passed["days"]) + int(passed["hours"] or 0)
        return f"{hours}:{passed['rest'] or '00:00'}"
    if passed := _ISO_DURATION.fullmatch(text):
        hours = 24 * int(passed["days"] or 0) + int(passed["hours"] or 0)
        minutes = (passed["minutes"] or "0").zfill(2)
        return f"{hours}:{minutes}:{passed['seconds'].zfill(2)}{passed['fraction'] or ''}"
    return _FRACTION_BEHIND_COLON.sub(r"\1.\2", _YEAR_OF_TWO_DIGITS.sub(r"\g<1>20\2", text))


def _month_first(matches: Sequence[re.Match[str]]) -> bool:
    """Whether 3/1/2024 is a day in March. Raises ValueError where a log does not tell and it matters."""
    dates = {(int(found[5]), int(found[7])) for found in matches if found[6] == "/"}
    if any(first > 12 for first, _ in dates):
        return False
    if len(dates) > 1 and not any(second > 12 for _, second in dates):
        raise StampError("may be day/month or month/day; expected dates as 2024-03-01", 0)
    return True


def _nanoseconds(found: re.Match[str], month_first: bool, days: dict[str, int], minutes: bool) -> int:
    hour, minute, second = (int(found[k] or 0) for k in (9, 10, 11))
    if minutes:
        hour, minute, second = hour // 60, hour % 60, minute
    elif found[12] and not found[11]:
        raise ValueError("hours, minutes and seconds")
    if found[13]:
        if not 1 <= hour <= 12:
            raise ValueError("12-hour clock")
        hour = hour % 12 + (12 if found[13].lower() == "pm" else 0)
    # What passed since the start, without a day, may be more than one.
    if (hour > 23 and (found[1] or found[5])) or minute > 59 or second > 60:
        raise ValueError("hours to 23, minutes and seconds to 59")
    zone = int(f"{found[14]}1") * (60 * int(found[15]) + int(found[16])) if found[14] else 0
    whole = 3600 * hour + 60 * (minute - zone) + second
    day = found[0][: found.start(9)] if found[9] else found[0]
    if day not in days:
        days[day] = _ordinal(found, month_first)
    return days[day] * _DAY_NS + whole * 10**9 + int((found[12] or "").ljust(9, "0"))


def _ordinal(found: re.Match[str], month_first: bool) -> int:
    if found[1]:
        return date(int(found[1]), int(found[3]), int(found[4])).toordinal()
    if not found[5]:
        return 0
    month, day = (int(found[k]) for k in ((5, 7) if found[6] == "/" and month_first else (7, 5)))
    return date(int(found[8]), month, day).toordinal()
