"""Tables in text files: which line holds the names, what separates the cells, how a number is written. The
layout that fits best is taken, and shown; what cannot be told, such as decimal commas between commas, is
refused."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from ident.data.child_reader import LARGEST_TEXT_BYTES
from ident.data.foreign_files import MOST_COLUMNS, distinct
from ident.data.text_numbers import (
    is_number,
    number,
    quantity,
    shows_decimals,
    with_plain_minus,
    without_units,
)
from ident.data.time_stamps import is_stamp
from ident.data.units import is_unit, says_time

# Lines that are looked at to find the layout.
_SAMPLE = 400
# Separators with decimal points and commas, plain ones first: of several that fit alike the first is taken.
_KINDS = (
    *((",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), (" ", ","), ("|", ".")),
    *(("|", ","), (",", ",")),
)
_COMMENT = re.compile(r"^\s*(?:#+|%+|//+|!+|--+(?=\D)|\*+|rem\s)\s*", re.IGNORECASE)
# A statement of the sampling above the rows: Rigol's tInc = 1e-06 and t0 = -0.005 between the names.
_START = re.compile(r"(?:t0|x0|start|x ?org|x ?origin)\b", re.IGNORECASE)
_INCREMENT = re.compile(
    r"(?:tinc|xinc|x ?increment|increment|delta[_ ]?[xt]|hresolution|sampl(?:e|ing) (?:interval|period))\b",
    re.IGNORECASE,
)
# What names hold beyond those of the columns: LabVIEW's comments, Rigol's start and step and their values.
_BEYOND = re.compile(r"comment|start|increment|[+-]?\d+\.?\d*(e[+-]?\d+)?|", re.IGNORECASE)
_UNITS_OF_X = re.compile(r"(?:horizontal|x)[_ ]units?\b|x_dimension\b", re.IGNORECASE)
_UNITS_OF_Y = re.compile(r"(?:vertical|y)[_ ]unit", re.IGNORECASE)
# What a serial monitor puts before each line: '10:15:30.000 -> ', '[2024-03-01 10:15:30.000] '.
_ARRIVED = re.compile(r"\s*(?:\[([^]]{4,40})\]|(\S[^>]{3,40}?)\s*->)(?:\s+|$)")
_LONGEST_ARRIVAL = 120  # characters of a line in which that is looked for
# A number with its name, as plotters of serial ports take it: 'angle:0.01', 'volt = -3.00'. No part matches
# what the next one begins with, so that time is linear in the length of a line.
_LABELLED = re.compile(r"([^\W\d_][^:=,;\t|]*)[:=]\s*([+-]?(?:\.?\d|nan|inf)[^:=,;\t| ]*) *([,;\t|]?)\s*")
_SIGNS = frozenset("#%/!-*rR")
_MOST_FOOTER_LINES = 3  # words under a table: units, a count of rows, the name of the recorder
_NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class Layout:
    """How a text table is written.

    separator: , ; tab | or a blank for any run of blanks. decimal: point or comma. names: of the columns,
    numbered where there is no header line. units: by name, of a line of units. header, first: line (from 1)
    of the names, 0 for none, and of the first row. skipped: lines from there on that are no rows; commented:
    how many of them are commented out. increment: (start, step) of the rows [s], where lines above say so.
    plain: a cell leaves no doubt of the decimal sign; stated: by the user. cut: the last line that was left
    out because the file ends inside of it, footer: the first of those under the table that hold words alone,
    0 for none.
    """

    separator: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    header: int
    first: int
    skipped: tuple[int, ...] = ()
    commented: int = 0
    increment: tuple[float, float] | None = None
    plain: bool = True
    stated: bool = False
    cut: int = 0
    footer: int = 0

    def line(self, row: int) -> int:
        """The line of a row, which is counted from 0."""
        line = self.first + row
        for skipped in self.skipped:
            line += skipped <= line
        return line


def text_of(content: bytes) -> str:
    """The text of a file in UTF-8 or UTF-16 (with its mark), else as Windows writes it (code page 1252).

    Raises ValueError where it is no text.
    """
    if len(content) > LARGEST_TEXT_BYTES:
        raise ValueError(
            f"{len(content) >> 20} MiB of text; expected at most {LARGEST_TEXT_BYTES >> 20}: split the file, "
            "or write npz, parquet or HDF5"
        )
    try:
        if content.startswith((b"\xff\xfe", b"\xfe\xff")):
            text = content.decode("utf-16")
        else:
            try:
                text = content.decode("utf-8-sig")
            except UnicodeDecodeError:
                text = content.decode("cp1252")
    except UnicodeDecodeError as error:
        raise ValueError(f"not a text file (byte {error.start}); expected a table in UTF-8") from None
    if _NO_TEXT.search(text):
        raise ValueError("not a text file (control characters); expected a table in UTF-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_text(text: str) -> tuple[Layout, dict[str, tuple[str, ...]]]:
    """The layout of a table, and its columns as text, equally long. Raises ValueError, with the line first
    where there is one."""
    lines = with_plain_minus(text).split("\n")
    while lines and not lines[-1].strip(" \t,;|"):
        lines.pop()  # blank lines at the very end are no samples
    if not lines:
        raise ValueError(": the file is empty; expected a header line and rows of numbers")
    lines, named = _bare(lines)
    layout = _layout(lines[:_SAMPLE], len(lines))
    if named:
        names = distinct([*named, *layout.names[len(named) if layout.header else 0 :]])[: len(layout.names)]
        header = layout.header or (layout.first if len(named) > 1 else 0)
        layout = replace(layout, names=tuple(names), header=header)

    # Lines that are no rows: comments, and blank ones behind every row; a single one may be a missing sample.
    first = layout.first - 1
    commented = [k for k in range(first, len(lines)) if _is_comment(lines[k])]
    blank = [k for k in range(first, len(lines)) if not lines[k].strip()]
    double = 2 * len(blank) >= len(lines) - first - len(commented) - 2
    skipped = {*commented, *(blank if double else ())}
    body = [line for k, line in enumerate(lines[first:], first) if k not in skipped]
    if not body:
        raise ValueError(": no rows under the header line; expected numbers")
    layout = replace(layout, skipped=tuple(k + 1 for k in sorted(skipped)), commented=len(commented))
    rows = _rows(body, layout.separator)

    # Words under the last row are no reading, and a row in which the file ends is no whole one.
    footer = _footer(rows, layout.decimal)
    if footer:
        layout = replace(layout, footer=layout.line(len(rows) - len(footer)))
        del rows[-len(footer) :]
        if not layout.units:
            layout = replace(layout, units=_units_of(footer[0], layout.names))
    elif not text.endswith("\n") and len(lines) not in skipped and _is_cut(rows, layout.decimal):
        del rows[-1]
        layout = replace(layout, cut=len(lines))

    # Every row has to have a cell for each name.
    width = len(layout.names)
    lengths = set(map(len, rows))
    if max(lengths) > width:
        for k, row in enumerate(rows):
            if any(row[width:]):
                raise ValueError(_ragged(layout.line(k), len(row), layout.header, width, layout.separator))
            del row[width:]
    if min(lengths) < width:
        for row in rows:
            row.extend([""] * (width - len(row)))
    sign = layout.decimal
    proven = any(sign in cell and shows_decimals(cell, sign) for row in rows for cell in row)
    columns = dict(zip(layout.names, zip(*rows, strict=True), strict=True))

    # '0.005 sec' in every row is a column of numbers in seconds.
    units = dict(layout.units)
    for name, cells in columns.items():
        if bare := without_units(cells, layout.decimal):
            columns[name], units[name] = bare
    return replace(layout, plain=proven, units=units), columns


def _footer(rows: Sequence[Sequence[str]], decimal: str) -> list[Sequence[str]]:
    """The last rows, three at most, that hold words and not one number, where four rows stand above."""
    begin = len(rows)
    while (
        begin > 4 and any(rows[begin - 1]) and not any(_is_value(cell, decimal) for cell in rows[begin - 1])
    ):
        begin -= 1
    if len(rows) - begin > _MOST_FOOTER_LINES:
        return []
    return list(rows[begin:])


def _units_of(cells: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Units by name, of a line that holds units alone: empty cells, and columns that it does not reach, have
    none."""
    words = [cell.strip("[](){} ") for cell in cells]
    if len(words) > len(names) or not all(is_unit(word) for word in words if word):
        return {}
    return {name: word for name, word in zip(names, words, strict=False) if word}


def _bare(lines: list[str]) -> tuple[list[str], list[str]]:
    """Lines of a serial port as a table has them, and the names of their first columns.

    Without 'angle:' before each number; the stamp that a monitor puts before each line is a cell of its own.
    """
    sample = [_arrival(line) for line in lines[:_SAMPLE]]
    arrived = 2 * sum(is_stamp(stamp) for stamp, _ in sample) > len(sample)
    stamps = list[str]()
    if arrived:
        parts = [_arrival(line) for line in lines]
        stamps = [stamp for stamp, _ in parts]
        lines = [line for _, line in parts]

    # Most lines of the sample have to be numbers with the same names.
    samples = [tuple(name for name, _, _ in _labelled(line)) for line in lines[:_SAMPLE]]
    ((labels, times),) = Counter(samples).most_common(1)
    names = list(labels) if 2 * times > len(samples) else []
    if names:
        usual_separator = " " if len(names) > 1 else ";"
        bare = list[str]()
        for line in lines:
            numbers = _labelled(line)
            if tuple(name for name, _, _ in numbers) == labels:
                line = "".join(value + (separator or usual_separator) for _, value, separator in numbers)
            # Another line stays as it is: whoever takes the column is told.
            bare.append(line)
        lines = bare

    if arrived:
        sign = next((sign for sign in ";\t,|" if sign in lines[len(lines) // 2].strip()), " ")
        lines = [
            f'"{stamp}"{sign}{line}' if stamp else line for stamp, line in zip(stamps, lines, strict=True)
        ]
        names = ["time", *names]
    return lines, names


def _arrival(line: str) -> tuple[str, str]:
    """The stamp that a serial monitor puts before a line, or empty, and the line without it."""
    head = _ARRIVED.match(line[:_LONGEST_ARRIVAL])
    return (head[1] or head[2], line[head.end() :]) if head else ("", line)


def _labelled(line: str) -> list[tuple[str, str, str]]:
    """Name, number and separator of each number in a line that holds nothing else; empty for another line."""
    numbers = list[tuple[str, str, str]]()
    at = len(line) - len(line.lstrip())
    while at < len(line):
        found = _LABELLED.match(line, at)
        if found is None:
            return []
        numbers.append((found[1].rstrip(), found[2], found[3]))
        at = found.end()
    return numbers


def _is_cut(rows: Sequence[Sequence[str]], decimal: str) -> bool:
    """Whether the last of four rows and more ends too early: with fewer cells than all others, or in a number
    of fewer digits (behind the decimal sign, where there is one)."""
    widths = [len(row) - _empty_at_end(row) for row in rows]
    if len(rows) < 4 or not widths[-1] or widths[-1] < min(widths[:-1]):
        return len(rows) > 3
    cells = [row[widths[-1] - 1].lstrip("+-") for row in rows if len(row) >= widths[-1]]
    parts = [cell.partition(decimal) for cell in cells]
    digits = [len(part[2] if any(part[2] for part in parts) else part[0]) for part in parts]
    known = len(cells) > 3 and all(is_number(cell, decimal) for cell in cells[:-1])
    return known and (digits[-1] < min(digits[:-1]) or not is_number(cells[-1], decimal))


def _layout(lines: Sequence[str], n_lines: int) -> Layout:
    """The layout of the separator and the decimal sign that fit best; the first of equals."""
    rows = {separator: _rows(lines, separator) for separator in dict.fromkeys(kind[0] for kind in _KINDS)}
    known: dict[str, dict[str, bool]] = {
        ".": {},
        ",": {},
    }  # of cells, by decimal sign: whether they are values
    fits = [
        _Fit.of(lines, rows[separator], separator, decimal, known[decimal]) for separator, decimal in _KINDS
    ]
    best = max(fits, key=lambda fit: fit.score)
    if not best.share:
        if n_lines == 1:
            raise ValueError(": no rows under the header line; expected numbers")
        raise ValueError(": no table of numbers was found; expected a header line and rows of numbers")
    return best.layout()


@dataclass(frozen=True)
class _Fit:
    """How well a separator and a decimal sign fit: first of all there must be as many names as numbers.

    first: of the lines that look like a row; start: of those that begin the table, a row that is followed by
    another one, with no word where the others hold numbers.
    """

    separator: str
    decimal: str
    lines: Sequence[str]
    rows: list[list[str]]
    least: int = 0
    most: int = 0
    share: float = 0.0
    first: int = 0
    start: int = 0

    @classmethod
    def of(
        cls,
        lines: Sequence[str],
        rows: list[list[str]],
        separator: str,
        decimal: str,
        known: dict[str, bool],
    ) -> _Fit:
        """The fit of lines whose cells are `rows`; known: whether a cell is a value, as far as looked at."""
        none = cls(separator, decimal, lines, rows)
        live = [k for k, row in enumerate(rows) if any(row) and not _is_comment(lines[k])]
        widest = max(live, key=lambda k: len(rows[k]), default=0)
        if len(rows[widest]) > MOST_COLUMNS:
            what = f"{len(rows[widest])} cells; expected at most {MOST_COLUMNS} columns, a row per sample"
            raise ValueError(f", line {widest + 1}: {what}")
        # Which cells of a line are values; each text is looked at once.
        for cell in {cell for k in live for cell in rows[k]} - known.keys():
            known[cell] = bool(cell) and _is_value(cell, decimal)
        values = {k: [known[cell] for cell in rows[k]] for k in live}

        # The usual width of a row is that of the last lines that hold values.
        filled = [k for k in live[-100:] if any(values[k])]
        if not filled:
            return none
        most = Counter(len(rows[k]) for k in filled).most_common(1)[0][0]
        usual = [k for k in filled if len(rows[k]) == most]
        # A separator at the end of each line makes an empty cell of no column.
        least = max(len(rows[k]) - _empty_at_end(rows[k]) for k in usual)
        numbers = [sum(values[k]) for k in usual]
        typical = sorted(numbers)[len(numbers) // 2]
        present = [sum(map(bool, column)) for column in zip(*(rows[k] for k in usual), strict=True)]
        valued = [sum(column) for column in zip(*(values[k] for k in usual), strict=True)]
        if not typical or (most == 1 and separator != ";"):
            return none
        if separator == " " and all("\t" in lines[k].strip() for k in live[-100:]):
            return none  # blanks are then inside of cells

        # A row is as wide as the usual one, and holds half as many values at least.
        looks = {k for k in live if len(rows[k]) == most and 2 * sum(values[k]) >= typical}
        first = next(k for k in live if k in looks)
        numeric = [column for column in range(most) if 2 * valued[column] > present[column]]

        def fits(k: int) -> bool:
            return k in looks and all(values[k][column] or not rows[k][column] for column in numeric)

        start = first
        for k, after in zip(live, [*live[1:], live[-1]], strict=True):
            if fits(k) and fits(after):
                start = k
                break
        return cls(separator, decimal, lines, rows, least, most, sum(numbers) / sum(present), first, start)

    @property
    def score(self) -> tuple[bool, float, int]:
        above = self._above(self.start)
        header = self._header()
        # A line above the rows that is neither names nor 'XInc:,5e-3' belongs to another separator. Comments
        # are sentences: they need not fit.
        matches = header is not None or all(
            self.rows[k][0].endswith(":") or _is_comment(self.lines[k]) for k in above
        )
        if header is not None and _is_comment(self.lines[header]):
            # Words of a comment are no names where a line of the table stands below them.
            matches = all(k <= header or _is_comment(self.lines[k]) for k in above)
        return bool(self.share) and matches, self.share, self.least

    def _above(self, row: int) -> list[int]:
        """The next three lines above that are not blank, and comments between them that are no rows; of names
        there may be a faulty row in between."""
        found, lines = list[int](), 0
        for k in range(row - 1, -1, -1):
            comment = _is_comment(self.lines[k])
            if any(self.rows[k]) and not (comment and self._has_value(k)):
                found.append(k)
                lines += not comment
            if lines == 3:
                break
        return found

    def _has_value(self, row: int) -> bool:
        return any(_is_value(cell, self.decimal) for cell in self.rows[row])

    def _names_at(self, row: int, numbered: bool = False) -> list[str] | None:
        """The cells of a line, if they can be the names of the columns; numbered: channels 1, 2, ... too.

        There has to be a cell for each column of numbers: of a comment, too, which may separate its names
        otherwise than the rows their numbers, as numpy.savetxt(header="t [s], u [V]") does.
        """
        cells = self.rows[row]
        if self.separator == " " and len(cells) > self.most:  # names of several words
            cells = re.split(r"\s{2,}|\t", self._without_sign(row))
        if _is_comment(self.lines[row]) and not self.least <= len(cells) <= self.most:
            ways = ([cell.strip() for cell in self._without_sign(row).split(sign)] for sign in ",;\t|")
            cells = next((way for way in ways if len(way) == self.least), cells)
        cells = cells[: len(cells) - _empty_at_end(cells)]
        if all(_BEYOND.fullmatch(cell) for cell in cells[self.most :]):
            cells = cells[: self.most]
        if _is_key(cells):
            return None
        # A number is no name, whatever its decimal sign.
        words = sum(bool(cell) and not any(_is_value(cell, sign) for sign in ".,") for cell in cells)
        if numbered and cells and all(re.fullmatch(r"\d{1,3}", cell) for cell in cells[1:]):
            words = len(cells)
        return cells if self.least <= len(cells) <= self.most and 2 * words > len(cells) else None

    def _without_sign(self, row: int) -> str:
        """A line without the sign of a comment."""
        return _COMMENT.sub("", self.lines[row]).strip()

    def _header(self) -> int | None:
        """The line of the names: the nearest; a comment only where it says time, or no other line will do."""
        found = [k for k in self._above(self.start) if self._names_at(k) is not None]
        live = [k for k in found if not _is_comment(self.lines[k])]
        if not live or not found:
            return found[0] if found else None
        for k in found:
            if k == live[0] or self._has_value(live[0]) or any(map(says_time, self._names_at(k) or [])):
                return k
        return live[0]

    def layout(self) -> Layout:
        above, header = self._above(self.start), self._header()
        if header is None:
            # Words above the rows that are too few or too many; a comment may be any sentence.
            candidates = (k for k in above if len(self.rows[k]) > 1 and not _is_comment(self.lines[k]))
            named = next((k for k in candidates if not (_is_key(self.rows[k]) or self._has_value(k))), None)
            if named is not None and named + 1 < len(self.rows):
                there, cells = (len(self.rows[k]) - _empty_at_end(self.rows[k]) for k in (named, named + 1))
                raise ValueError(_ragged(named + 2, cells, named + 1, there, self.separator))
            numbered = tuple(f"column {k + 1}" for k in range(self.least))
            stated = any(map(_is_key, self.rows[: self.start]))
            sampling = self._increment(self.start, [], []) if stated else None
            first = self.start if stated else self.first
            return Layout(self.separator, self.decimal, numbered, {}, 0, first + 1, increment=sampling)
        if channels := self._channels():
            every = distinct([name for name, _ in channels])
            own = {name: unit for name, (_, unit) in zip(every, channels, strict=True) if unit}
            return Layout(self.separator, self.decimal, tuple(every), own, header + 1, self.start + 1)
        names, units, below = self._names_at(header) or [], list[str](), header + 1
        over = self._above(header)[:1]
        longer = self._names_at(over[0], numbered=True) if over else None
        if longer is not None and self._are_units(names):
            units, names, header = names, longer, over[0]
        elif over and len(self.rows[over[0]]) >= len(names) and self._are_units(self.rows[over[0]]):
            # Of some loggers they stand above the names; columns without a unit have an empty cell.
            units = self.rows[over[0]]
        elif below < self.first and any(self.rows[below]) and self._are_units(self.rows[below]):
            # Cells at its end are empty: those columns have no unit.
            units, below = self.rows[below], below + 1
        while not any(self.rows[below]) and below + 1 < len(self.rows):
            below += 1
        columns = distinct([name or f"column {k + 1}" for k, name in enumerate(names)])
        pairs = zip(columns, units, strict=False)
        known = {name: unit.strip("[](){} ") for name, unit in pairs if not _is_value(unit, self.decimal)}
        known = {name: unit for name, unit in known.items() if unit not in ("", "-", "1")}
        beside = {columns[k]: unit for k, unit in self._units_above(header).items() if k < len(columns)}
        sampling = self._increment(header, columns, units)
        separator, decimal = self.separator, self.decimal
        return Layout(
            separator, decimal, tuple(columns), beside | known, header + 1, below + 1, increment=sampling
        )

    def _channels(self) -> list[tuple[str, str]] | None:
        """Names and units of the columns where each channel has a time and a value, and lines above say of
        each what it is: 'Name, drive, Name, hub', as scopes of a PLC do."""
        above = [row[: self.most] for row in self.rows[: self.start] if len(row) >= self.most]
        told = {row[0].lower(): row[1::2] for row in above if row[0] and set(row[::2]) == {row[0]}}
        keys = {
            found[1]: told[found[0]][0]
            for key in told
            if (found := re.fullmatch(r"sampl.*[\[(](\w+)[\])]", key))
        }
        unit, every = next(iter(keys.items()), ("", ""))
        names = told.get("name", [])
        # In a table of two columns any line is of two cells.
        if self.most % 2 or not all(names) or not names or (self.most == 2 and not unit):
            return None
        with suppress(ValueError):
            first, second, step = (
                number(cell, self.decimal)
                for cell in (self.rows[self.start][0], self.rows[self.start + 1][0], every)
            )
            unit = unit if abs(second - first - step) < 0.01 * step else ""
        units = [text.strip("[](){} ") for text in told.get("unit", [""] * len(names))]
        return [
            column for name, own in zip(names, units, strict=True) for column in (("time", unit), (name, own))
        ]

    def _are_units(self, cells: Sequence[str]) -> bool:
        """Whether most words of a line are units; numbers are no words (Rigol's start and step)."""
        words = [cell for cell in cells if cell and not (cell != "1" and _is_value(cell, self.decimal))]
        known = [
            bool(re.fullmatch(r"[\[(].*[\])]|-|1|sequence", cell, re.I)) or is_unit(cell) for cell in words
        ]
        return bool(words) and 2 * sum(known) > len(words)

    def _units_above(self, header: int) -> dict[int, str]:
        """Units that lines above the names state with a word before them, by column."""
        found = dict[int, str]()
        for row in self.rows[:header]:
            if _UNITS_OF_X.match(row[0]) and len(row) > 1:
                found[0] = "s" if row[1].lower() == "time" else row[1]
            elif _UNITS_OF_Y.match(row[0]):
                found |= {k: unit for k, unit in enumerate(row) if k and is_unit(unit)}
        return found

    def _increment(
        self, header: int, names: Sequence[str], units: Sequence[str]
    ) -> tuple[float, float] | None:
        """Start and step of the rows [s], as oscilloscopes state them beside or above the names."""
        told = list(zip(names, units, strict=False))
        told += zip(self.rows[header], self.rows[min(header + 1, len(self.rows) - 1)], strict=False)
        told += [(name, value) for name, _, value in (cell.partition("=") for cell in names) if value]
        told += [(row[0], row[1]) for row in self.rows[:header] if len(row) > 1]
        values = [(name.strip(), value.strip()) for name, value in told if is_number(value, self.decimal)]

        def of(pattern: re.Pattern[str]) -> float | None:
            return next((number(value, self.decimal) for name, value in values if pattern.match(name)), None)

        step, start = of(_INCREMENT), of(_START)
        return (start or 0.0, step) if step is not None and step > 0 else None


def _is_key(cells: Sequence[str]) -> bool:
    """Whether a line of a preamble states something of a name: 'XInc:,5e-3'."""
    return bool(cells) and cells[0].endswith(":") and not all(cell.endswith(":") for cell in cells)


def _is_comment(line: str) -> bool:
    return line.lstrip()[:1] in _SIGNS and _COMMENT.match(line) is not None


def _rows(lines: Sequence[str], separator: str) -> list[list[str]]:
    """The cells of every line, without blanks around them; of comment lines without the sign."""
    if separator == " ":
        words = [re.findall(r'"[^"]*"|\S+', _COMMENT.sub("", line)) for line in lines]
        return [[word.strip('"') for word in row] or [""] for row in words]
    plain = [_COMMENT.sub("", line) if _is_comment(line) else line for line in lines]
    if not any('"' in line for line in plain):
        return [[cell.strip() for cell in line.split(separator)] for line in plain]
    try:
        reader = csv.reader(plain, delimiter=separator, skipinitialspace=True)
        rows = [[cell.strip() for cell in row] or [""] for row in reader]
    except csv.Error as error:
        raise ValueError(f", line {reader.line_num}: {error}") from None
    if len(rows) != len(plain):
        raise ValueError(": a quotation mark is not closed; expected one line per row")
    return rows


def _empty_at_end(row: Sequence[str]) -> int:
    return next((k for k, cell in enumerate(reversed(row)) if cell), len(row))


def _is_value(cell: str, decimal: str) -> bool:
    """Whether a cell holds a number, a number with its unit, a date or a clock time."""
    return is_number(cell, decimal) or is_stamp(cell) or quantity(cell, decimal) is not None


def _ragged(line: int, cells: int, header: int, names: int, separator: str) -> str:
    there = f"line {header} has {names}" if header else f"{names} are expected"
    commas = cells > names and separator == ","
    hint = "; decimal commas? then separate the columns by semicolons" if commas else ""
    return (
        f", line {line}: {cells} cells where {there}; expected one per column, separated by "
        f"{_WORDS[separator]}, and a decimal point{hint}"
    )


_WORDS = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}
