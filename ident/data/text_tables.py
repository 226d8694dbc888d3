"""Tables in text files: which line holds the names, what separates the cells, how a number is written.

Nothing is asked of the user: the layout that fits the lines best is taken, and stands in `Layout` for
whoever shows it. What cannot be told, such as decimal commas between commas, is refused.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from ident.data.foreign_files import distinct
from ident.data.time_stamps import is_stamp
from ident.data.units import is_unit

LARGEST_TEXT_BYTES = 2**28
"""Of a text file: cells as text take several times as much memory."""

# Lines that are looked at to find the layout.
_SAMPLE = 400
# Separators with decimal points and commas, plain ones first: of several that fit alike the first is taken.
_KINDS = (
    *((",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), (" ", ","), ("|", ".")),
    *(("|", ","), (",", ",")),
)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_COMMENT = re.compile(r"^\s*(#+|%+|//+)\s*")
_NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class Layout:
    """How a text table is written.

    separator: one of , ; tab | or a blank for any run of blanks. decimal: point or comma. names: of the
    columns, numbered where there is no header line. units: by name, of a line of units. header, first: line
    (from 1) of the names, 0 where there are none, and of the first row.
    """

    separator: str
    decimal: str
    names: tuple[str, ...]
    units: dict[str, str]
    header: int
    first: int


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
    lines = text.split("\n")
    while lines and not lines[-1].strip(" \t,;|"):
        lines.pop()  # blank lines at the very end are no samples
    if not lines:
        raise ValueError(": the file is empty; expected a header line and rows of numbers")
    layout = _layout(lines[:_SAMPLE], len(lines))
    body = lines[layout.first - 1 :]
    if not body:
        raise ValueError(": no rows under the header line; expected numbers")
    rows, width = _rows(body, layout.separator), len(layout.names)
    lengths = set(map(len, rows))
    if max(lengths) > width:
        for k, row in enumerate(rows):
            if any(row[width:]):
                raise ValueError(_ragged(k + layout.first, len(row), layout.header, width, layout.separator))
            del row[width:]
    if min(lengths) < width:
        for row in rows:
            row.extend([""] * (width - len(row)))
    return layout, dict(zip(layout.names, zip(*rows, strict=True), strict=True))


def _layout(lines: Sequence[str], n_lines: int) -> Layout:
    found = [_Fit.of(lines, separator, decimal) for separator, decimal in _KINDS]
    best = max(found, key=lambda fit: fit.score)  # the first of equals
    if not best.share:
        if n_lines == 1:
            raise ValueError(": no rows under the header line; expected numbers")
        raise ValueError(": no table of numbers was found; expected a header line and rows of numbers")
    return best.layout()


@dataclass(frozen=True)
class _Fit:
    """How well a separator and a decimal sign fit: first of all there must be as many names as numbers."""

    separator: str
    decimal: str
    lines: Sequence[str]
    rows: list[list[str]]
    least: int = 0
    most: int = 0
    share: float = 0.0
    first: int = 0

    @classmethod
    def of(cls, lines: Sequence[str], separator: str, decimal: str) -> _Fit:
        rows = _rows(lines, separator)
        filled = [row for row in rows[-100:] if any(_is_value(cell, decimal) for cell in row)]
        if not filled:
            return cls(separator, decimal, lines, rows)
        most = Counter(map(len, filled)).most_common(1)[0][0]
        usual = [row for row in filled if len(row) == most]
        # A separator at the end of each line makes an empty cell of no column.
        least = max(len(row) - _empty_at_end(row) for row in usual)
        numbers = [sum(_is_value(cell, decimal) for cell in row) for row in usual]
        typical = sorted(numbers)[len(numbers) // 2]
        cells = sum(1 for row in usual for cell in row if cell)
        if not typical or (most == 1 and separator != ";"):
            return cls(separator, decimal, lines, rows)
        first = next(
            k
            for k, row in enumerate(rows)
            if len(row) == most and 2 * sum(_is_value(cell, decimal) for cell in row) >= typical
        )
        return cls(separator, decimal, lines, rows, least, most, sum(numbers) / cells, first)

    @property
    def score(self) -> tuple[bool, float, int]:
        above = self._above(self.first)
        matches = not above or any(self._names_at(k) is not None for k in above)
        return bool(self.share) and matches, self.share, self.least

    def _above(self, row: int) -> list[int]:
        """The next lines above that are not blank; of names there may be a faulty row in between."""
        return [k for k in range(row - 1, -1, -1) if any(self.rows[k])][:3]

    def _has_value(self, row: int) -> bool:
        return any(_is_value(cell, self.decimal) for cell in self.rows[row])

    def _names_at(self, row: int) -> list[str] | None:
        """The cells of a line, if they can be the names of the columns."""
        cells = self.rows[row]
        if self.separator == " " and len(cells) > self.most:  # names of several words
            cells = re.split(r"\s{2,}|\t", self.lines[row].strip())
        cells = cells[: len(cells) - _empty_at_end(cells)]
        words = sum(bool(cell) and not _is_value(cell, self.decimal) for cell in cells)
        return cells if self.least <= len(cells) <= self.most and 2 * words > len(cells) else None

    def layout(self) -> Layout:
        above = self._above(self.first)
        header = next((k for k in above if self._names_at(k) is not None), None)
        if header is None:
            named = next((k for k in above if len(self.rows[k]) > 1 and not self._has_value(k)), None)
            if named is not None:
                there, cells = (len(self.rows[k]) - _empty_at_end(self.rows[k]) for k in (named, named + 1))
                raise ValueError(_ragged(named + 2, cells, named + 1, there, self.separator))
            numbered = tuple(f"column {k + 1}" for k in range(self.least))
            return Layout(self.separator, self.decimal, numbered, {}, 0, self.first + 1)
        names, units, below = self._names_at(header) or [], list[str](), header + 1
        over = self._above(header)[:1]
        if over and _are_units(names) and (longer := self._names_at(over[0])) is not None:
            units, names, header = names, longer, over[0]
        while not any(self.rows[below]):
            below += 1
        columns = distinct([name or f"column {k + 1}" for k, name in enumerate(names)])
        known = {name: unit.strip("[]() ") for name, unit in zip(columns, units, strict=False)}
        return Layout(self.separator, self.decimal, tuple(columns), known, header + 1, below + 1)


def _rows(lines: Sequence[str], separator: str) -> list[list[str]]:
    """The cells of every line, without blanks around them; of comment lines without the sign."""
    if separator == " ":
        return [_blanks(_COMMENT.sub("", line)) for line in lines]
    plain = [_COMMENT.sub("", line) if line[:1] in "#%/" else line for line in lines]
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


def _blanks(line: str) -> list[str]:
    if '"' in line:
        return [word.strip('"') for word in re.findall(r'"[^"]*"|\S+', line)] or [""]
    return line.split() or [""]


def _empty_at_end(row: Sequence[str]) -> int:
    return next((k for k, cell in enumerate(reversed(row)) if cell), len(row))


def is_number(cell: str, decimal: str) -> bool:
    """Whether the cell is a number with this decimal sign; blanks around it do no harm."""
    text = cell.strip()
    if decimal == ",":
        if "." in text:
            return False
        text = text.replace(",", ".")
    return _NUMBER.fullmatch(text) is not None


def _is_value(cell: str, decimal: str) -> bool:
    return is_number(cell, decimal) or is_stamp(cell)


def _are_units(cells: Sequence[str]) -> bool:
    known = [bool(re.fullmatch(r"[\[(].*[\])]|-|1|", cell)) or is_unit(cell) for cell in cells]
    return 2 * sum(known) > len(cells)


def _ragged(line: int, cells: int, header: int, names: int, separator: str) -> str:
    there = f"line {header} has {names}" if header else f"{names} are expected"
    commas = cells > names and separator == ","
    hint = "; decimal commas? then separate the columns by semicolons" if commas else ""
    return (
        f", line {line}: {cells} cells where {there}; expected one per column, separated by "
        f"{_WORDS[separator]}, and a decimal point{hint}"
    )


_WORDS = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}
