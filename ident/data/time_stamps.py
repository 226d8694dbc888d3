"""Dates and clock times as logs write them, in seconds since the first of them.

Known forms are ISO 8601 ('2024-03-01T12:00:00.25Z', with a blank for the T and slashes for the dashes as
well), '01.03.2024 12:00:00,250', '3/1/2024 1:02:03.5 PM', and '12:00:00.250' without a day, which may pass
midnight; '01:02.5' is minutes and seconds, and of '12:30' alone nobody knows (`may_be_minutes`). Dates with a
named month ('01-Mar-2024 10:00:00', 'Fri Mar 1 10:00:00 2024'), '20240301T100000', and what has passed in
days ('0 days 00:00:00.005' of pandas, 'PT0.005S') are put into these forms first (`_in_usual_form`).

`seconds_since_first` reads all cells of a column as one kind of stamp and counts whole nanoseconds
(`_nanoseconds`), so that no digit of a date is lost. Zones are offsets from UTC; leap seconds are neglected.
A match below is always one of `_STAMP`, whose groups are the parts of a stamp, None where a part is not
there.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from itertools import pairwise

import numpy as np

from ident.data.arrays import RealArray
from ident.data.foreign_files import shown

# Parts of a stamp, each a named group. A day begins with its year, or ends with it and has two numbers before
# it, of which only the whole log tells which is the month.
_DAY = (
    r"(?:(?P<year_first>\d{4})(?P<dash>[-/])(?P<month>\d\d?)(?P=dash)(?P<day>\d\d?)|"
    r"(?P<one>\d\d?)(?P<dot>[./])(?P<two>\d\d?)(?P=dot)(?P<year_last>\d{4}))"
)
# Hours may be those since the start, so that they have up to seven digits.
_CLOCK = (
    r"(?P<hour>\d{1,7}):(?P<minute>\d\d)(?::(?P<second>\d\d))?(?:[.,](?P<fraction>\d{1,9}))?"
    r"\s*(?P<half>[AaPp][Mm])?"
)
_ZONE = r"(?:Z|UTC|GMT|(?P<zone_sign>[+-])(?P<zone_hours>\d\d):?(?P<zone_minutes>\d\d))"
_STAMP = re.compile(rf"(?:{_DAY}(?:T|,?\s+|_|-|$))?(?:{_CLOCK})?\s*{_ZONE}?")
# What a text has that may be a stamp in one of the rarer forms: a quick test for the many that are none.
_MAY_BE_OTHERWISE = re.compile(r"\d.*[A-Za-z]|[A-Za-z].*\d|:\d\d:\d\d:|\.\d\d?\.|\d{8}[ _-]\d{6}")
# Characters of a stamp, exclusive: the longest form in words, with day of the week, month and zone, has about
# 45. Longer cells are text, and take no time here.
_LONGEST_STAMP = 60
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
# ISO 8601 without signs between the parts: 20240301T100000.
_BASIC = re.compile(r"(\d{4})(\d\d)(\d\d)[T _-](\d\d)(\d\d)(\d\d)(.*)")
# Days that passed, with a clock time behind them or not: '0 days 00:00:00.005', '3 Tage'.
_DAYS_AND_CLOCK = re.compile(
    r"(?P<days>\d{1,5})\s*(?:days?|d|tage?),?\s*(?:\+?(?P<hours>\d{1,2}):(?P<below_hours>\d\d:\d\d.*))?",
    re.IGNORECASE,
)
# What passed in ISO 8601: 'P1DT2H3M4.5S'.
_ISO_DURATION = re.compile(
    r"P(?:(?P<days>\d{1,5})D)?T(?:(?P<hours>\d{1,4})H)?(?:(?P<minutes>\d\d?)M)?(?P<seconds>\d\d?)"
    r"(?P<fraction>[.,]\d+)?S"
)
# '01.03.24' of this century, and '10:00:00:250' with a colon before the fraction.
_YEAR_OF_TWO_DIGITS = re.compile(r"(\d\d?\.\d\d?\.)(\d\d)(?=[\s,]|$)")
_FRACTION_BEHIND_COLON = re.compile(r"(:\d\d:\d\d):(\d{3,9})")
# Nanoseconds after which a clock time without a day begins again.
_DAY_NS = 86_400 * 10**9
# Nanoseconds after which minutes and seconds without an hour begin again.
_HOUR_NS = 3600 * 10**9
# Digits of a fraction of a second, filled up with zeros: nanoseconds.
_FRACTION_DIGITS = 9


class StampError(ValueError):
    """A cell that is no time stamp.

    Attributes
    ----------
    row : int
        Of the cell in its column, from 0.
    """

    def __init__(self, message: str, row: int) -> None:
        """The complaint, which goes on after 'column NAME', on a row. row: from 0."""
        super().__init__(message)
        self.row = row


def is_stamp(cell: str) -> bool:
    """Whether the text has the form of a date, a clock time, or both; they need not be possible ones.

    False for an empty cell. Twice `_LONGEST_STAMP` leaves as many blanks as letters.
    """
    # Blanks around it may make it longer, but not without end.
    if len(cell) > 2 * _LONGEST_STAMP:
        return False
    # Most cells are numbers or words, which a look at a few characters tells.
    has_sign = ":" in cell or "." in cell or "/" in cell or "-" in cell[1:]
    if not has_sign:
        text = cell.lstrip()
        # '20240301T100000': the sign stands behind eight digits.
        may_be_basic = text[8:9] in ("T", " ", "_")
        if text[:1] != "P" and not may_be_basic:
            return False
    return _matched(cell) is not None


def seconds_since_first(cells: Sequence[str]) -> RealArray:
    """Seconds (T,) of stamps since the first of them.

    Parameters
    ----------
    cells : sequence of str
        T stamps; an empty cell is none, and refused. No cells give an empty array.

    Returns
    -------
    ndarray, shape (T,)
        0 first; negative where a stamp with a day is earlier.

    Raises
    ------
    StampError
        A cell is no possible stamp, or the log does not tell whether the day or the month comes first.

    Notes
    -----
    Clock times without a day go on after midnight where they fall by more than half a day, and minutes and
    seconds where they fall by more than half an hour. Differences are taken in whole nanoseconds: doubles
    hold dates to a fraction of a microsecond only.
    """
    matches = list[re.Match[str]]()
    for row, cell in enumerate(cells):
        match = _matched(cell)
        if match is None:
            raise StampError(f"is '{shown(cell)}'; expected a date or time like '{shown(cells[0])}'", row)
        matches.append(match)

    # What a cell by itself does not tell, all of them together may.
    are_minutes = _are_minutes(matches)
    month_first = _month_first(matches)
    ordinals: dict[str, int] = {}
    nanoseconds = list[int]()
    for row, match in enumerate(matches):
        try:
            nanoseconds.append(_nanoseconds(match, month_first, ordinals, are_minutes))
        except ValueError as error:
            raise StampError(f"is '{shown(cells[row])}', no possible date or time ({error})", row) from None

    if not any(map(_has_day, matches)):
        period_ns = _HOUR_NS if are_minutes else _DAY_NS
        passed_ns = 0
        going_on = nanoseconds[:1]
        for before, now in pairwise(nanoseconds):
            if before - now > period_ns // 2:
                passed_ns += period_ns
            going_on.append(now + passed_ns)
        nanoseconds = going_on
    # Whole nanoseconds, of which a second has 1e9.
    return np.array([now - nanoseconds[0] for now in nanoseconds], dtype=np.float64) / 1e9


def may_be_minutes(cells: Sequence[str]) -> bool:
    """Whether stamps are like '12:30', hours and minutes or minutes and seconds, and none tells which.

    `seconds_since_first` takes hours. Cells that are no stamps are passed over. False without any stamp.
    """
    matches = [match for match in map(_matched, cells) if match is not None]
    return bool(matches) and all(map(_has_two_parts, matches)) and not _are_minutes(matches)


def _number(part: str | None) -> int:
    """The number that a part of a stamp is; 0 for a part that is not there.

    ValueError for text that is no number, which no group of `_STAMP` holds.
    """
    return 0 if part is None else int(part)


def _has_day(match: re.Match[str]) -> bool:
    """Whether a stamp has a day. A zone or an empty match has none."""
    return match["year_first"] is not None or match["year_last"] is not None


def _has_two_parts(match: re.Match[str]) -> bool:
    """Whether a stamp is two numbers with a colon between, perhaps with a fraction, and nothing else.

    False for a day alone.
    """
    if match["hour"] is None or match["second"] is not None:
        return False
    return match["half"] is None and not _has_day(match)


def _are_minutes(matches: Sequence[re.Match[str]]) -> bool:
    """Whether clock times of two parts are minutes and seconds.

    Only seconds have a fraction, and no day has more than 24 hours. False for no stamps.
    """
    if not all(map(_has_two_parts, matches)):
        return False
    return any(match["fraction"] is not None or int(match["hour"]) > 23 for match in matches)


def _matched(cell: str) -> re.Match[str] | None:
    """The parts of a date, a clock time or both, in the groups of `_STAMP`; None where it is none.

    None, too, for an empty cell; whether the numbers are possible ones is not asked.
    """
    text = cell.strip()
    # The shortest stamps, '1:02', have four characters.
    if not 3 < len(text) < _LONGEST_STAMP:
        return None
    match = _STAMP.fullmatch(text)
    if match is None and _MAY_BE_OTHERWISE.search(text):
        match = _STAMP.fullmatch(_in_usual_form(text))
    # A zone alone, or nothing at all, fits as well.
    if match is None or not (_has_day(match) or match["hour"] is not None):
        return None
    return match


def _in_usual_form(text: str) -> str:
    """A stamp in one of the rarer forms, as ISO 8601 or a clock time has it; another text as it is.

    Whether day and hour are possible ones is not asked: `_nanoseconds` refuses them. A year of two digits is
    of this century.
    """
    for form in _NAMED_MONTH:
        named = form.fullmatch(text)
        if named is None:
            continue
        month = _MONTHS.get(named["month"].lower())
        if month is not None:
            day = named["day"].zfill(2)
            clock = named["clock"].strip(" ,_T-")
            return f"{named['year']}-{month:02d}-{day} {clock}".strip()
    basic = _BASIC.fullmatch(text)
    if basic is not None:
        year, month_digits, day, hour, minute, second, fraction = basic.groups()
        return f"{year}-{month_digits}-{day} {hour}:{minute}:{second}{fraction}"
    passed = _DAYS_AND_CLOCK.fullmatch(text)
    if passed is not None:
        hours = 24 * int(passed["days"]) + _number(passed["hours"])
        return f"{hours}:{passed['below_hours'] or '00:00'}"
    passed = _ISO_DURATION.fullmatch(text)
    if passed is not None:
        hours = 24 * _number(passed["days"]) + _number(passed["hours"])
        minutes = (passed["minutes"] or "0").zfill(2)
        seconds = passed["seconds"].zfill(2)
        return f"{hours}:{minutes}:{seconds}{passed['fraction'] or ''}"
    with_century = _YEAR_OF_TWO_DIGITS.sub(r"\g<1>20\2", text)
    return _FRACTION_BEHIND_COLON.sub(r"\1.\2", with_century)


def _month_first(matches: Sequence[re.Match[str]]) -> bool:
    """Whether 3/1/2024 is a day in March, in a log with these stamps.

    A number above 12 is a day. Raises StampError where no stamp tells and it matters; a single date takes the
    same time from stamp to stamp either way. Without dates between slashes: True, which then matters to none.
    """
    dates = {(int(match["one"]), int(match["two"])) for match in matches if match["dot"] == "/"}
    if any(first > 12 for first, _ in dates):
        return False
    if len(dates) > 1 and not any(second > 12 for _, second in dates):
        raise StampError("may be day/month or month/day; expected dates as 2024-03-01", 0)
    return True


def _nanoseconds(match: re.Match[str], month_first: bool, ordinals: dict[str, int], are_minutes: bool) -> int:
    """Nanoseconds of a stamp in UTC: since the day 1 of `date.toordinal`, without a day since midnight.

    ordinals: day numbers by the text of the day, which is added to; a log has few days and many stamps.
    month_first, are_minutes: what the whole log tells (`_month_first`, `_are_minutes`). Raises ValueError for
    what is no possible date or time.
    """
    hour = _number(match["hour"])
    minute = _number(match["minute"])
    second = _number(match["second"])
    if are_minutes:
        second = minute
        minute = hour % 60
        hour = hour // 60
    elif match["fraction"] and not match["second"]:
        raise ValueError("hours, minutes and seconds")
    if match["half"]:
        if not 1 <= hour <= 12:
            raise ValueError("12-hour clock")
        hour = hour % 12
        if match["half"].lower() == "pm":
            hour += 12
    # What passed since the start, without a day, may be more than one. A leap second is the 60th.
    if (hour > 23 and _has_day(match)) or minute > 59 or second > 60:
        raise ValueError("hours to 23, minutes and seconds to 59")

    zone_minutes = 0
    if match["zone_sign"]:
        zone_minutes = 60 * int(match["zone_hours"]) + int(match["zone_minutes"])
        if match["zone_sign"] == "-":
            zone_minutes = -zone_minutes
    seconds = 3600 * hour + 60 * (minute - zone_minutes) + second
    day = match[0] if match["hour"] is None else match[0][: match.start("hour")]
    if day not in ordinals:
        ordinals[day] = _ordinal(match, month_first)
    fraction_ns = int((match["fraction"] or "").ljust(_FRACTION_DIGITS, "0"))
    return ordinals[day] * _DAY_NS + seconds * 10**9 + fraction_ns


def _ordinal(match: re.Match[str], month_first: bool) -> int:
    """Number of a stamp's day, as of `date.toordinal`; 0 without a day. Raises ValueError for no day.

    Between points the day comes first, between slashes as the log says.
    """
    if match["year_first"] is not None:
        return date(int(match["year_first"]), int(match["month"]), int(match["day"])).toordinal()
    if match["year_last"] is None:
        return 0
    if match["dot"] == "/" and month_first:
        month, day = match["one"], match["two"]
    else:
        month, day = match["two"], match["one"]
    return date(int(match["year_last"]), int(month), int(day)).toordinal()
