"""Tables in text files: which line holds the names, what separates the cells, how a number is written.

Loggers, instruments and spreadsheets write tables in many ways, and no file says which. `read_text` tries
every usual separator with decimal points and with decimal commas on the first lines (`_Fit.of`), takes what
makes most cells numbers under as many names (`_Fit.score`), and looks for names and units around the first
row (`_Fit.layout`). Then it cuts all lines into cells and leaves out what is no row: comments, words under
the table, a row in which the file ends. The `Layout` says what was found, so that it can be shown.

What cannot be told, such as decimal commas between commas, is refused. Every step takes a time that is linear
in the length of the text: no regular expression here can match one text in two ways. A majority, here and
below, is more than half: what most lines or cells are is what the table is.
"""

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

# Lines from the beginning of the file that are looked at to find the layout: preambles of recorders have up
# to some hundred. Doubled or halved, no test of text logs moves.
_SAMPLE_LINES = 400
# Lines from the end of these that say how wide a row is and which columns hold numbers: there the preamble is
# over. Doubled or halved, no test of text logs moves.
_USUAL_LINES = 100
# Separators and decimal signs that are tried. Of several that fit alike the first is taken, so plain ones
# come first; comma and comma are last, as such a table cannot be told from one of integers.
_DIALECTS = (
    (",", "."),
    (";", "."),
    (";", ","),
    ("\t", "."),
    ("\t", ","),
    (" ", "."),
    (" ", ","),
    ("|", "."),
    ("|", ","),
    (",", ","),
)
# Words for the separators in complaints.
_SEPARATOR_WORDS = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks", "|": "bars"}
# Signs with which a line of comment begins, and the characters with which such signs begin (a faster test).
_COMMENT = re.compile(r"^\s*(?:#+|%+|//+|!+|--+(?=\D)|\*+|rem\s)\s*", re.IGNORECASE)
_COMMENT_BEGINNINGS = frozenset("#%/!-*rR")
# Statements of the sampling above the rows: Rigol's tInc = 1e-06 and t0 = -0.005 between the names.
_START = re.compile(r"(?:t0|x0|start|x ?org|x ?origin)\b", re.IGNORECASE)
_INCREMENT = re.compile(
    r"(?:tinc|xinc|x ?increment|increment|delta[_ ]?[xt]|hresolution|sampl(?:e|ing) (?:interval|period))\b",
    re.IGNORECASE,
)
# What a line of names may hold behind those of the columns: LabVIEW's comments, Rigol's start and step and
# their values.
_BEHIND_NAMES = re.compile(r"comment|start|increment|[+-]?\d+\.?\d*(e[+-]?\d+)?|", re.IGNORECASE)
# Lines above the names that state the units of the first column, and of the others.
_UNITS_OF_X = re.compile(r"(?:horizontal|x)[_ ]units?\b|x_dimension\b", re.IGNORECASE)
_UNITS_OF_Y = re.compile(r"(?:vertical|y)[_ ]unit", re.IGNORECASE)
# The step of the rows as the scope of a PLC states it for each channel: 'Sample time [ms]'.
_STEP_OF_CHANNEL = re.compile(r"sampl.*[\[(](\w+)[\])]")
# Difference of the first two stamps from a stated step, as a share of it, up to which they agree: stamps are
# written with few digits, and another unit would be a factor of 1000.
_SAME_STEP = 0.01
# A cell that is a unit by its form: in brackets, '-' and '1' for none, Rigol's word for counted rows.
_UNIT_BY_FORM = re.compile(r"[\[(].*[\])]|-|1|sequence", re.IGNORECASE)
# Signs around a unit that are no part of it.
_AROUND_UNITS = "[](){} "
# What a serial monitor puts before each line: '10:15:30.000 -> ', '[2024-03-01 10:15:30.000] '. Of 4 to 40
# characters: '1:02' has four, a date and a time with their signs 40 at most.
_ARRIVED = re.compile(r"\s*(?:\[([^]]{4,40})\]|(\S[^>]{3,40}?)\s*->)(?:\s+|$)")
# Characters of a line in which that is looked for: three times the longest, for blanks around it.
_LONGEST_ARRIVAL = 120
# A number with its name, as plotters of serial ports take it: 'angle:0.01', 'volt = -3.00'. No part matches
# what the next one begins with, so that time is linear in the length of a line.
_LABELLED = re.compile(r"([^\W\d_][^:=,;\t|]*)[:=]\s*([+-]?(?:\.?\d|nan|inf)[^:=,;\t| ]*) *([,;\t|]?)\s*")
# Lines of words under a table that are left out: units, a count of rows, the name of the recorder. More are
# no footer, and are complained of. Doubled, no test moves; with one, two lines of words are refused.
_MOST_FOOTER_LINES = 3
# Rows that stand above a footer, or besides one in which the file ends, before either is told from a row:
# fewer do not say what a row looks like. Doubled or halved, no test of footers moves.
_FEWEST_ROWS = 4
# Lines above the first row in which the names are looked for: names, units, and a faulty row or an empty
# statement between. Chosen: neither with six nor with one does a test of text logs move.
_LINES_ABOVE = 3
# Control characters that no text has.
_NO_TEXT = re.compile(r"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class Layout:
    """How a text table is written.

    Attributes
    ----------
    separator : str
        Comma, semicolon, tab or bar; a blank for any run of blanks.
    decimal : str
        Point or comma.
    names : tuple of str
        Of the columns, numbered where there is no line of names.
    units : dict
        Units by name, as a line of units or lines above the names state them.
    header : int
        Line (from 1) of the names, 0 for none.
    first : int
        Line (from 1) of the first row.
    skipped : tuple of int
        Lines from there on that are no rows, in order.
    commented : int
        How many of them are commented out.
    increment : tuple of float, or None
        Start and step of the rows in seconds, where lines above state them.
    plain : bool
        Some cell of the table leaves no doubt of the decimal sign, as '0.5' does and '1.500' does not.
    stated : bool
        The user stated the decimal sign.
    cut : int
        The last line, where it was left out because the file ends inside of it; else 0.
    footer : int
        First of the lines under the table that hold words alone; 0 for none.
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
        """The line of the file (from 1) of a row, which is counted from 0.

        A row beyond the table is not refused: the lines go on.
        """
        line = self.first + row
        for skipped in self.skipped:
            if skipped <= line:
                line += 1
        return line


def text_of(content: bytes) -> str:
    """The text of a file, its lines ended by line feeds alone.

    Parameters
    ----------
    content : bytes
        UTF-8 or UTF-16 (with its mark), else as Windows writes it (code page 1252).

    Returns
    -------
    str
        Without the mark; empty for an empty file.

    Raises
    ------
    ValueError
        It is no text, or larger than `LARGEST_TEXT_BYTES`.
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
    """The layout of a table, and its columns as text.

    Parameters
    ----------
    text : str
        All of a file, lines ended by line feeds (`text_of`).

    Returns
    -------
    layout : Layout
        How the table is written, and what was left out of it.
    columns : dict
        The cells of each column by name, a tuple of one string per row, all equally long; a missing cell is
        an empty string. Units that stand in every cell are taken off.

    Raises
    ------
    ValueError
        No table of numbers, more cells than names, a quotation mark that is not closed, or too many columns.
        The message begins with ':' or with the line, as ', line 3:'.
    """
    lines = with_plain_minus(text).split("\n")
    # Blank lines at the very end are no samples.
    while lines and not lines[-1].strip(" \t,;|"):
        lines.pop()
    if not lines:
        raise ValueError(": the file is empty; expected a header line and rows of numbers")
    lines, serial_names = _without_labels(lines)
    layout = _layout(lines[:_SAMPLE_LINES], len(lines))

    # Names that stand before the numbers of each line count more than those of a line above, if there is one.
    if serial_names:
        first_other = len(serial_names) if layout.header else 0
        names = distinct([*serial_names, *layout.names[first_other:]])
        header = layout.header
        if not header and len(serial_names) > 1:
            header = layout.first
        layout = replace(layout, names=tuple(names[: len(layout.names)]), header=header)

    # Lines that are no rows: comments, and blank ones behind every row; a single one may be a missing sample.
    first = layout.first - 1
    commented = [k for k in range(first, len(lines)) if _is_comment(lines[k])]
    blank = [k for k in range(first, len(lines)) if not lines[k].strip()]
    n_others = len(lines) - first - len(commented)
    skipped = set(commented)
    # Where half of the lines are blank, the line ends were written twice; but for two, as the last row, or
    # one in the middle, may lack its blank line.
    if 2 * len(blank) >= n_others - 2:
        skipped.update(blank)
    numbered_lines = enumerate(lines[first:], first)
    body = [line for k, line in numbered_lines if k not in skipped]
    if not body:
        raise ValueError(": no rows under the header line; expected numbers")
    skipped_lines = tuple(k + 1 for k in sorted(skipped))
    layout = replace(layout, skipped=skipped_lines, commented=len(commented))
    rows = _rows(body, layout.separator)

    # Words under the last row are no reading, and a row in which the file ends is no whole one.
    footer = _footer(rows, layout.decimal)
    ends_inside_row = not text.endswith("\n") and len(lines) not in skipped
    if footer:
        layout = replace(layout, footer=layout.line(len(rows) - len(footer)))
        del rows[-len(footer) :]
        if not layout.units:
            layout = replace(layout, units=_units_of(footer[0], layout.names))
    elif ends_inside_row and _is_cut(rows, layout.decimal):
        del rows[-1]
        layout = replace(layout, cut=len(lines))

    # Every row has to have a cell for each name: empty ones are added, and taken off at the end.
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
    # Nearly all cells end at the first test, which is fast.
    sign_is_plain = any(sign in cell and shows_decimals(cell, sign) for row in rows for cell in row)
    columns = dict(zip(layout.names, zip(*rows, strict=True), strict=True))

    # '0.005 sec' in every row is a column of numbers in seconds.
    units = dict(layout.units)
    for name, cells in columns.items():
        bare = without_units(cells, layout.decimal)
        if bare is not None:
            columns[name], units[name] = bare
    return replace(layout, plain=sign_is_plain, units=units), columns


def _footer(rows: Sequence[Sequence[str]], decimal: str) -> list[Sequence[str]]:
    """The last rows that hold words and not one value, where enough rows stand above; else none.

    rows: the cells of each, no or several; decimal: '.' or ','. Empty, too, where there are more of them than
    a footer has: the caller then complains of words in a column of numbers.
    """
    begin = len(rows)
    while begin > _FEWEST_ROWS:
        cells = rows[begin - 1]
        if not any(cells) or any(_is_value(cell, decimal) for cell in cells):
            break
        begin -= 1
    if len(rows) - begin > _MOST_FOOTER_LINES:
        return []
    return list(rows[begin:])


def _units_of(cells: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Units by name, where every cell of a line that is not empty is a unit; else empty.

    cells: of the line, which may end before the names do. Empty cells, and columns that the line does not
    reach, have no unit. Empty, too, for no cells and for more cells than names.
    """
    words = [cell.strip(_AROUND_UNITS) for cell in cells]
    if len(words) > len(names):
        return {}
    if not all(is_unit(word) for word in words if word):
        return {}
    return {name: word for name, word in zip(names, words, strict=False) if word}


def _without_labels(lines: list[str]) -> tuple[list[str], list[str]]:
    """Lines of a serial port as a table has them, and the names of their first columns.

    'angle:0.01' becomes 0.01 in a column named angle; the stamp that a monitor puts before each line becomes
    the first cell, named time. Lines without either come back as they are, without names. Lines that differ
    from most are not refused here: they stay as they are, and are complained of when their column is taken.
    lines: at least one (ValueError else).
    """
    # Most lines of the sample have to begin with a stamp.
    sample = [_arrival(line) for line in lines[:_SAMPLE_LINES]]
    n_stamped = sum(is_stamp(stamp) for stamp, _ in sample)
    has_stamps = 2 * n_stamped > len(sample)
    stamps = list[str]()
    if has_stamps:
        parts = [_arrival(line) for line in lines]
        stamps = [stamp for stamp, _ in parts]
        lines = [line for _, line in parts]

    # Most lines of the sample have to be numbers with the same names.
    names_of_lines = Counter[tuple[str, ...]]()
    for line in lines[:_SAMPLE_LINES]:
        numbers = _labelled(line)
        names_of_lines[tuple(name for name, _, _ in numbers)] += 1
    ((labels, n_alike),) = names_of_lines.most_common(1)
    names = list[str]()
    if 2 * n_alike > len(sample):
        names = list(labels)
    if names:
        usual_separator = " " if len(names) > 1 else ";"
        bare = list[str]()
        for line in lines:
            numbers = _labelled(line)
            names_of_line = tuple(name for name, _, _ in numbers)
            if names_of_line == labels:
                line = "".join(f"{value}{separator or usual_separator}" for _, value, separator in numbers)
            # Another line stays as it is: whoever takes the column is told.
            bare.append(line)
        lines = bare

    # The stamp is set apart by the separator of a line in the middle, in quotes as it may hold that itself.
    if has_stamps:
        middle_line = lines[len(lines) // 2].strip()
        separator = next((sign for sign in ";\t,|" if sign in middle_line), " ")
        stamped = list[str]()
        for stamp, line in zip(stamps, lines, strict=True):
            stamped.append(f'"{stamp}"{separator}{line}' if stamp else line)
        lines = stamped
        names = ["time", *names]
    return lines, names


def _arrival(line: str) -> tuple[str, str]:
    """The text that a serial monitor may have put before a line, or empty, and the line without it.

    Whether the text is a time is for the caller to ask (`is_stamp`).
    """
    head = _ARRIVED.match(line[:_LONGEST_ARRIVAL])
    if head is None:
        return "", line
    return head[1] or head[2], line[head.end() :]


def _labelled(line: str) -> list[tuple[str, str, str]]:
    """Name, number and separator (or empty) of each number with a name in a line; empty where the line holds
    anything else.

    A blank line holds none. Name, number and separator are text; a number is taken by its form, also nan.
    """
    numbers = list[tuple[str, str, str]]()
    position = len(line) - len(line.lstrip())
    while position < len(line):
        labelled = _LABELLED.match(line, position)
        if labelled is None:
            return []
        name, value, separator = labelled.groups()
        numbers.append((name.rstrip(), value, separator))
        position = labelled.end()
    return numbers


def _is_cut(rows: Sequence[Sequence[str]], decimal: str) -> bool:
    """Whether the last of some rows ends too early, so that the file ends inside of it.

    It has fewer cells than any other row, or its last number has fewer digits than any other of that column
    (behind the decimal sign, where some have one there). False with fewer than `_FEWEST_ROWS` rows, and where
    another cell of that column is no number. Digits, not sizes, are compared: 1.25 behind 1.250 is cut, as
    loggers write a fixed number of decimals.
    """
    if len(rows) < _FEWEST_ROWS:
        return False
    widths = [len(row) - _empty_at_end(row) for row in rows]
    last_width = widths[-1]
    if last_width == 0 or last_width < min(widths[:-1]):
        return True
    cells = [row[last_width - 1].lstrip("+-") for row in rows if len(row) >= last_width]
    if len(cells) < _FEWEST_ROWS or not all(is_number(cell, decimal) for cell in cells[:-1]):
        return False
    if not is_number(cells[-1], decimal):
        return True
    parts = [cell.partition(decimal) for cell in cells]
    has_decimals = any(decimals for _, _, decimals in parts)
    n_digits = [len(decimals if has_decimals else whole) for whole, _, decimals in parts]
    return n_digits[-1] < min(n_digits[:-1])


def _layout(lines: Sequence[str], n_lines: int) -> Layout:
    """The layout of the separator and the decimal sign that fit best; the first of equals.

    lines: the first ones of the file, at least one; n_lines: how many it has. Raises ValueError where none of
    them makes numbers, or a line has too many cells.
    """
    separators = dict.fromkeys(separator for separator, _ in _DIALECTS)
    rows = {separator: _rows(lines, separator) for separator in separators}
    # Whether a cell is a value, by decimal sign: each text is looked at once, whatever separates it.
    value_of_cell: dict[str, dict[str, bool]] = {".": {}, ",": {}}
    fits = [
        _Fit.of(lines, rows[separator], separator, decimal, value_of_cell[decimal])
        for separator, decimal in _DIALECTS
    ]
    best = max(fits, key=lambda fit: fit.score)
    if not best.value_share:
        if n_lines == 1:
            raise ValueError(": no rows under the header line; expected numbers")
        raise ValueError(": no table of numbers was found; expected a header line and rows of numbers")
    return best.layout()


@dataclass(frozen=True)
class _Fit:
    """One separator with one decimal sign, and how well the first lines of a file fit to them.

    Attributes
    ----------
    separator, decimal : str
        What is tried, as in `Layout`.
    lines : sequence of str
        The first lines of the file; lines and rows are counted from 0 here.
    rows : list of list of str
        The cells of each line between these separators.
    n_columns : int
        Cells of a usual row without empty ones at its end, which a separator at the end of each line makes.
    n_cells : int
        Cells of a usual row, with those.
    value_share : float
        Share of the cells of usual rows that hold a value; 0 where this separator makes no table.
    first_alike : int
        First line that looks like a row.
    first_row : int
        First line of those that begins the table: it is followed by another row, and has no word where the
        others hold numbers.
    """

    separator: str
    decimal: str
    lines: Sequence[str]
    rows: list[list[str]]
    n_columns: int = 0
    n_cells: int = 0
    value_share: float = 0.0
    first_alike: int = 0
    first_row: int = 0

    @classmethod
    def of(
        cls,
        lines: Sequence[str],
        rows: list[list[str]],
        separator: str,
        decimal: str,
        value_of_cell: dict[str, bool],
    ) -> _Fit:
        """The fit of a separator and a decimal sign to the first lines of a file.

        rows: the cells of each line; value_of_cell: whether a text is a value with this decimal sign, as far
        as looked at, which is added to. Raises ValueError where a line has more than `MOST_COLUMNS` cells.
        """
        no_table = cls(separator, decimal, lines, rows)
        filled_lines = [k for k, row in enumerate(rows) if any(row) and not _is_comment(lines[k])]
        widest = max(filled_lines, key=lambda k: len(rows[k]), default=0)
        if len(rows[widest]) > MOST_COLUMNS:
            what = f"{len(rows[widest])} cells; expected at most {MOST_COLUMNS} columns, a row per sample"
            raise ValueError(f", line {widest + 1}: {what}")

        # Which cells of a line are values; each text is looked at once.
        texts = {cell for k in filled_lines for cell in rows[k]}
        for text in texts - value_of_cell.keys():
            value_of_cell[text] = bool(text) and _is_value(text, decimal)
        is_value = {k: [value_of_cell[cell] for cell in rows[k]] for k in filled_lines}

        # The usual width of a row is that of the last lines that hold values.
        last_lines = filled_lines[-_USUAL_LINES:]
        valued_lines = [k for k in last_lines if any(is_value[k])]
        if not valued_lines:
            return no_table
        ((n_cells, _),) = Counter(len(rows[k]) for k in valued_lines).most_common(1)
        usual_lines = [k for k in valued_lines if len(rows[k]) == n_cells]
        # A separator at the end of each line makes an empty cell of no column.
        n_columns = max(len(rows[k]) - _empty_at_end(rows[k]) for k in usual_lines)
        values_of_lines = sorted(sum(is_value[k]) for k in usual_lines)
        usual_values = values_of_lines[len(values_of_lines) // 2]
        if usual_values == 0:
            return no_table
        # Any file has one cell a line between separators that it does not have: one column is of semicolons.
        if n_cells == 1 and separator != ";":
            return no_table
        # Where tabs are in each line, blanks are inside of cells.
        if separator == " " and all("\t" in lines[k].strip() for k in last_lines):
            return no_table

        # A row is as wide as the usual one, and holds half as many values at least.
        as_wide = [k for k in filled_lines if len(rows[k]) == n_cells]
        alike = {k for k in as_wide if 2 * sum(is_value[k]) >= usual_values}
        first_alike = next(k for k in filled_lines if k in alike)
        # Columns of numbers are those in which more than half of the cells that are filled are values.
        cells_of_columns = zip(*(rows[k] for k in usual_lines), strict=True)
        filled_cells = [sum(map(bool, cells)) for cells in cells_of_columns]
        flags_of_columns = zip(*(is_value[k] for k in usual_lines), strict=True)
        value_cells = [sum(flags) for flags in flags_of_columns]
        numeric = [j for j in range(n_cells) if 2 * value_cells[j] > filled_cells[j]]

        def is_row(k: int) -> bool:
            """Whether a line looks like a row and has no word in a column of numbers.

            k: from 0; a line that is blank or a comment is none.
            """
            return k in alike and all(is_value[k][j] or not rows[k][j] for j in numeric)

        first_row = first_alike
        next_lines = [*filled_lines[1:], filled_lines[-1]]
        for k, next_line in zip(filled_lines, next_lines, strict=True):
            if is_row(k) and is_row(next_line):
                first_row = k
                break
        return cls(
            separator,
            decimal,
            lines,
            rows,
            n_columns=n_columns,
            n_cells=n_cells,
            value_share=sum(values_of_lines) / sum(filled_cells),
            first_alike=first_alike,
            first_row=first_row,
        )

    @property
    def score(self) -> tuple[bool, float, int]:
        """How well it fits, larger is better: whether there are as many names as numbers, then the share of
        values among the cells, then the number of columns.

        Nothing is raised: where the separator makes no table it is (False, 0, 0).
        """
        above = self._above(self.first_row)
        header = self._header()
        if header is None:
            # A line above the rows that is neither names nor 'XInc:,5e-3' belongs to another separator.
            # Comments are sentences: they need not fit.
            matches = all(self.rows[k][0].endswith(":") or _is_comment(self.lines[k]) for k in above)
        elif _is_comment(self.lines[header]):
            # Words of a comment are no names where a line of the table stands below them.
            matches = all(k <= header or _is_comment(self.lines[k]) for k in above)
        else:
            matches = True
        return bool(self.value_share) and matches, self.value_share, self.n_columns

    def _above(self, row: int) -> list[int]:
        """Lines above a row in which its names may stand, the nearest first.

        The next `_LINES_ABOVE` that are not blank, and comments between them that are no rows. Empty for the
        first line. row and the lines are counted from 0.
        """
        above = list[int]()
        n_lines = 0
        for k in range(row - 1, -1, -1):
            comment = _is_comment(self.lines[k])
            if any(self.rows[k]) and not (comment and self._has_value(k)):
                above.append(k)
                if not comment:
                    n_lines += 1
            if n_lines == _LINES_ABOVE:
                break
        return above

    def _has_value(self, row: int) -> bool:
        """Whether a cell of a line is a number, with or without its unit, or a stamp.

        row: a line from 0 (IndexError beyond the sample).
        """
        return any(_is_value(cell, self.decimal) for cell in self.rows[row])

    def _names_at(self, row: int, numbered: bool = False) -> list[str] | None:
        """The cells of a line, if they can be the names of the columns; else None.

        There has to be a cell for each column of numbers, and most have to be words. numbered: names may be
        the numbers of channels, too. A comment may separate its names otherwise than the rows their numbers,
        as numpy.savetxt(header="t [s], u [V]") does. row: a line from 0. A line that has no cell, or fewer
        than there are columns, gives None.
        """
        cells = self.rows[row]
        if self.separator == " " and len(cells) > self.n_cells:
            # Names of several words are two blanks apart, or a tab.
            cells = re.split(r"\s{2,}|\t", self._without_sign(row))
        if _is_comment(self.lines[row]) and not self.n_columns <= len(cells) <= self.n_cells:
            for sign in ",;\t|":
                parts = [part.strip() for part in self._without_sign(row).split(sign)]
                if len(parts) == self.n_columns:
                    cells = parts
                    break
        cells = cells[: len(cells) - _empty_at_end(cells)]
        if all(_BEHIND_NAMES.fullmatch(cell) for cell in cells[self.n_cells :]):
            cells = cells[: self.n_cells]
        if _is_statement(cells) or not self.n_columns <= len(cells) <= self.n_cells:
            return None

        # A number is no name, whatever its decimal sign.
        n_words = 0
        for cell in cells:
            is_numeric = any(_is_value(cell, sign) for sign in ".,")
            if cell and not is_numeric:
                n_words += 1
        # Numbers of channels have three digits at most; the first column is time and may be called anything.
        if numbered and cells and all(re.fullmatch(r"\d{1,3}", cell) for cell in cells[1:]):
            n_words = len(cells)
        return cells if 2 * n_words > len(cells) else None

    def _without_sign(self, row: int) -> str:
        """A line without the sign of a comment.

        A line that is no comment comes back without blanks around it.
        """
        return _COMMENT.sub("", self.lines[row]).strip()

    def _header(self) -> int | None:
        """The line of the names; None where no line above can be it.

        The nearest that is no comment; but a comment nearer to the rows that says time, or any comment where
        that line holds a value, as a faulty row does. Lines are counted from 0.
        """
        candidates = [k for k in self._above(self.first_row) if self._names_at(k) is not None]
        plain_lines = [k for k in candidates if not _is_comment(self.lines[k])]
        if not candidates:
            return None
        if not plain_lines:
            return candidates[0]
        nearest = plain_lines[0]
        if self._has_value(nearest):
            return candidates[0]
        for comment in candidates[: candidates.index(nearest)]:
            if any(map(says_time, self._names_at(comment) or [])):
                return comment
        return nearest

    def layout(self) -> Layout:
        """The layout of the table, with the names, units, and start and step that stand around its first row.

        Raises ValueError where the words above the rows are too few or too many to be names.
        """
        header = self._header()
        if header is None:
            return self._layout_without_names()
        channels = self._channels()
        if channels:
            names = distinct([name for name, _ in channels])
            units = {name: unit for name, (_, unit) in zip(names, channels, strict=True) if unit}
            return Layout(
                self.separator, self.decimal, tuple(names), units, header + 1, first=self.first_row + 1
            )

        # A line of units stands below the names or above them; what was taken for names may be the units.
        header_cells = self._names_at(header) or []
        unit_cells = list[str]()
        below = header + 1
        over = next(iter(self._above(header)), None)
        names_over = None if over is None else self._names_at(over, numbered=True)
        if over is not None and names_over is not None and self._are_units(header_cells):
            unit_cells = header_cells
            header_cells = names_over
            header = over
        elif (
            over is not None
            and len(self.rows[over]) >= len(header_cells)
            and self._are_units(self.rows[over])
        ):
            # Of some loggers they stand above the names; columns without a unit have an empty cell.
            unit_cells = self.rows[over]
        elif below < self.first_alike and any(self.rows[below]) and self._are_units(self.rows[below]):
            # Cells at its end are empty: those columns have no unit.
            unit_cells = self.rows[below]
            below += 1
        while not any(self.rows[below]) and below + 1 < len(self.rows):
            below += 1

        # Units of that line count more than those of lines further above; numbers there are start and step.
        columns = distinct([name or f"column {k + 1}" for k, name in enumerate(header_cells)])
        units = dict[str, str]()
        for k, unit in self._units_above(header).items():
            if k < len(columns):
                units[columns[k]] = unit
        for name, cell in zip(columns, unit_cells, strict=False):
            unit = cell.strip(_AROUND_UNITS)
            if unit not in ("", "-", "1") and not _is_value(cell, self.decimal):
                units[name] = unit
        return Layout(
            self.separator,
            self.decimal,
            tuple(columns),
            units,
            header + 1,
            first=below + 1,
            increment=self._increment(header, columns, unit_cells),
        )

    def _layout_without_names(self) -> Layout:
        """The layout of a table without a line of names: its columns are numbered.

        Raises ValueError where words stand above the rows that are too few or too many for names. 'column 1',
        'column 2', ...; rows begin at the first line that looks like one.
        """
        for k in self._above(self.first_row):
            cells = self.rows[k]
            # A comment may be any sentence, and so may a single cell.
            if len(cells) < 2 or _is_comment(self.lines[k]):
                continue
            if _is_statement(cells) or self._has_value(k):
                continue
            next_cells = self.rows[k + 1]
            n_names = len(cells) - _empty_at_end(cells)
            n_next = len(next_cells) - _empty_at_end(next_cells)
            raise ValueError(_ragged(k + 2, n_next, k + 1, n_names, self.separator))
        names = tuple(f"column {k + 1}" for k in range(self.n_columns))
        first = self.first_alike
        increment = None
        # In a preamble of statements, 'Points:,80', a line may look like a row; it may say start and step.
        if any(map(_is_statement, self.rows[: self.first_row])):
            first = self.first_row
            increment = self._increment(self.first_row, [], [])
        return Layout(self.separator, self.decimal, names, {}, header=0, first=first + 1, increment=increment)

    def _channels(self) -> list[tuple[str, str]] | None:
        """Names and units of the columns where each channel has a time and a value, as scopes of a PLC write.

        Lines above the rows then state something of each channel: 'Name, drive, Name, hub'. None for another
        table. The unit of the times is that of a stated step with which the first two stamps agree, else
        empty. Fewer lines, cells that are no numbers, or no stated step are not refused: the unit is then
        empty.
        """
        # A table of an odd number of cells has no pairs.
        if self.n_cells % 2:
            return None
        # What is stated of each channel, by the word before it in lower case.
        stated = dict[str, list[str]]()
        for row in self.rows[: self.first_row]:
            cells = row[: self.n_cells]
            if len(cells) == self.n_cells and cells[0] and set(cells[::2]) == {cells[0]}:
                stated[cells[0].lower()] = cells[1::2]
        names = stated.get("name", [])
        steps = dict[str, str]()
        for word, values in stated.items():
            step_word = _STEP_OF_CHANNEL.fullmatch(word)
            if step_word is not None:
                steps[step_word[1]] = values[0]
        time_unit, step_cell = next(iter(steps.items()), ("", ""))
        # In a table of two columns any line is of two cells.
        if not names or not all(names) or (self.n_cells == 2 and not time_unit):
            return None

        # The step may be that of the controller, and stamps be counted otherwise. Without a second row, or
        # where one of the cells is no number, nothing is said against it.
        stamp_cells = [row[0] for row in self.rows[self.first_row : self.first_row + 2]]
        with suppress(ValueError):
            first, second = (number(cell, self.decimal) for cell in stamp_cells)
            step = number(step_cell, self.decimal)
            if not abs(second - first - step) < _SAME_STEP * step:
                time_unit = ""
        no_units = [""] * len(names)
        units = [text.strip(_AROUND_UNITS) for text in stated.get("unit", no_units)]
        columns = list[tuple[str, str]]()
        for name, unit in zip(names, units, strict=True):
            columns += [("time", time_unit), (name, unit)]
        return columns

    def _are_units(self, cells: Sequence[str]) -> bool:
        """Whether most words of a line are units; numbers are no words (Rigol's start and step).

        False for a line without a word.
        """
        n_words = 0
        n_units = 0
        for cell in cells:
            # A '1' is the unit of what has none.
            is_numeric = cell != "1" and _is_value(cell, self.decimal)
            if not cell or is_numeric:
                continue
            n_words += 1
            if _UNIT_BY_FORM.fullmatch(cell) or is_unit(cell):
                n_units += 1
        return 2 * n_units > n_words

    def _units_above(self, header: int) -> dict[int, str]:
        """Units that lines above the names state behind a word for them, by column (from 0).

        header: line of the names, from 0. Empty where no line says one; a unit of the first column is taken
        as it is written, others only where they are known.
        """
        units = dict[int, str]()
        for row in self.rows[:header]:
            if _UNITS_OF_X.match(row[0]) and len(row) > 1:
                units[0] = "s" if row[1].lower() == "time" else row[1]
            elif _UNITS_OF_Y.match(row[0]):
                for k, unit in enumerate(row):
                    if k > 0 and is_unit(unit):
                        units[k] = unit
        return units

    def _increment(
        self, header: int, names: Sequence[str], units: Sequence[str]
    ) -> tuple[float, float] | None:
        """Start and step of the rows in seconds, as oscilloscopes state them; None where no step is stated.

        header: line of the names; names: of the columns; units: the cells of the line of units. What is said
        beside the names counts more than what is said above them. A start that is not stated is 0; a step
        that is zero or negative is none.
        """
        # Words and what may be their numbers, in the order in which they count.
        pairs = list(zip(names, units, strict=False))
        row_below = self.rows[min(header + 1, len(self.rows) - 1)]
        pairs += zip(self.rows[header], row_below, strict=False)
        for name in names:
            word, _, value = name.partition("=")
            if value:
                pairs.append((word, value))
        pairs += [(row[0], row[1]) for row in self.rows[:header] if len(row) > 1]
        numbers = list[tuple[str, str]]()
        for word, value in pairs:
            if is_number(value, self.decimal):
                numbers.append((word.strip(), value.strip()))

        def first_of(pattern: re.Pattern[str]) -> float | None:
            """The number behind the first word that the pattern matches. None without such a word."""
            for word, value in numbers:
                if pattern.match(word):
                    return number(value, self.decimal)
            return None

        step = first_of(_INCREMENT)
        start = first_of(_START)
        if step is None or not step > 0:
            return None
        return start or 0.0, step


def _is_statement(cells: Sequence[str]) -> bool:
    """Whether a line of a preamble states something of a word: 'XInc:,5e-3'.

    Where every cell ends with a colon, they may be names. False for no cells.
    """
    if not cells or not cells[0].endswith(":"):
        return False
    return not all(cell.endswith(":") for cell in cells)


def _is_comment(line: str) -> bool:
    """Whether a line begins with a sign of a comment. False for an empty line."""
    return line.lstrip()[:1] in _COMMENT_BEGINNINGS and _COMMENT.match(line) is not None


def _rows(lines: Sequence[str], separator: str) -> list[list[str]]:
    """The cells of every line, without blanks around them; of comment lines without the sign.

    Cells in quotation marks may hold the separator. An empty line is one empty cell. Raises ValueError where
    a quotation mark is not closed. separator: one of `_DIALECTS`, a blank for any run of them. No lines: no
    rows.
    """
    if separator == " ":
        words = [re.findall(r'"[^"]*"|\S+', _COMMENT.sub("", line)) for line in lines]
        return [[word.strip('"') for word in row] or [""] for row in words]
    plain = [_COMMENT.sub("", line) if _is_comment(line) else line for line in lines]
    # Without quotation marks, as most tables are, splitting is several times faster than the reader of csv.
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
    """How many cells at the end of a row are empty. All of them where none is filled; 0 for no cells."""
    return next((k for k, cell in enumerate(reversed(row)) if cell), len(row))


def _is_value(cell: str, decimal: str) -> bool:
    """Whether a cell holds a number, a number with its unit, a date or a clock time.

    decimal: '.' or ','. False for an empty cell.
    """
    return is_number(cell, decimal) or is_stamp(cell) or quantity(cell, decimal) is not None


def _ragged(line: int, n_cells: int, header: int, n_names: int, separator: str) -> str:
    """The complaint that a line has more or fewer cells than there are names, beginning with ', line 3:'.

    line: of the row; header: of the names, 0 for none; both from 1. Cells and names are counted, n_cells and
    n_names. KeyError for a separator that is none of `_DIALECTS`.
    """
    names = f"line {header} has {n_names}" if header else f"{n_names} are expected"
    hint = ""
    if n_cells > n_names and separator == ",":
        hint = "; decimal commas? then separate the columns by semicolons"
    return (
        f", line {line}: {n_cells} cells where {names}; expected one per column, separated by "
        f"{_SEPARATOR_WORDS[separator]}, and a decimal point{hint}"
    )
