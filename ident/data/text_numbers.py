"""Numbers as people and programs write them in cells of text.

A cell may have a decimal point or a decimal comma, digits in groups of three, a minus sign of several kinds,
and a unit behind the number ('0.005 sec', '30 %'). `is_number` says whether it is a number with a given
decimal sign, `number` which one; `quantity` and `without_units` take a unit off. Whether '1.500' is one and a
half or fifteen hundred no cell says by itself: `doubtful_groups` looks at the whole column. `decimal` is '.'
or ',' everywhere; another sign is not refused here and ends in KeyError or in a cell that is no number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from ident.data.units import TIME_UNITS, is_unit

# A plain number, with a point. No alternative can match what another one left over, so that time is linear in
# the length of a cell. Fortran writes 1.0D-03, always with the sign of the exponent.
_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+|[dD][+-]\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE
)
_FORTRAN_EXPONENT = re.compile(r"[dD](?=[+-])")
# Digits in groups of three, by decimal sign: between them stands what others write decimals with, or what is
# neither.
_GROUPED_NUMBER = {
    sign: re.compile(
        rf"[+-]?[1-9]\d{{0,2}}([{other}'’ \u00a0\u202f\u2009])\d{{3}}(\1\d{{3}})*({re.escape(sign)}\d*)?"
    )
    for sign, other in ((".", ","), (",", "."))
}
# One sign with three digits behind it: a group of thousands, or three decimals.
_ONE_GROUP = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
# A whole number below a thousand, which is written alike with groups and without.
_BELOW_THOUSAND = re.compile(r"[+-]?\d{1,3}")
# Minus as typesetters have it (U+2212), an en dash, small and wide hyphens: before a number, or its exponent.
_MINUS_SIGNS = "\u2212\u2013\ufe63\uff0d"
_TYPESET_MINUS = re.compile(rf"(?:(?<![\w)\]])|(?<=\d[eE]))[{_MINUS_SIGNS}](?=[.,]?\d)")
# A number and its unit, as letters behind it.
_QUANTITY = re.compile(r"((?=[(+\-.,\d]).*?[\d.)])(\s*)([^\W\d_]{1,12}|[%°])")
# Characters of a number with its unit: a number of a double has 24, a unit here 12 at most. Longer cells are
# text; the expression above takes a square of the length.
_LONGEST_QUANTITY = 60


def with_plain_minus(text: str) -> str:
    """The text with '-' wherever another minus sign stands before a number; between words it stays."""
    # Most texts have none, which is faster to see.
    if not any(sign in text for sign in _MINUS_SIGNS):
        return text
    return _TYPESET_MINUS.sub("-", text)


def _with_leading_sign(text: str) -> str:
    """'-3.25' of '(3.25)' and of '3.25-', as bookkeeping writes what is negative; else the text as it is.

    Whether it is a number is not asked; an empty text stays.
    """
    if text[:1] == "(" and text[-1:] == ")" and text[1:2].isdigit():
        return f"-{text[1:-1]}"
    if text[-1:] == "-" and text[:1].isdigit():
        return f"-{text[:-1]}"
    return text


def is_bookkept(cell: str, decimal: str) -> bool:
    """Whether the cell is a number whose minus is a pair of brackets, or stands behind it.

    False for an empty cell.
    """
    text = cell.strip()
    return _with_leading_sign(text) != text and is_number(cell, decimal)


def is_number(cell: str, decimal: str) -> bool:
    """Whether the cell is a number with this decimal sign; blanks around it do no harm.

    Parameters
    ----------
    cell : str
        Any text.
    decimal : str
        Point or comma.

    Returns
    -------
    bool
        True, too, for 'nan' and 'inf'; False for an empty cell.
    """
    text = cell.strip()
    if decimal == ".":
        # Nearly all cells end here.
        if _NUMBER.fullmatch(text):
            return True
    elif "." not in text and _NUMBER.fullmatch(text.replace(",", ".")):
        return True
    with_sign = _with_leading_sign(text)
    if with_sign != text:
        return is_number(with_sign, decimal)
    return _GROUPED_NUMBER[decimal].fullmatch(text) is not None


def number(cell: str, decimal: str) -> float:
    """The number in a cell for which `is_number` holds; digits in groups of three are one number.

    'nan' and 'inf' give these. Raises ValueError, of `float`, where the cell is none; of one that is a number
    with the other decimal sign alone a number comes out all the same: ask `is_number` first.
    """
    text = _with_leading_sign(cell.strip())
    grouped = _GROUPED_NUMBER[decimal].fullmatch(text)
    if grouped:
        text = text.replace(grouped[1], "")
    with_point = text.replace(",", ".")
    return float(_FORTRAN_EXPONENT.sub("e", with_point))


def quantity(cell: str, decimal: str) -> tuple[str, str] | None:
    """The number and the unit in a cell like '0.005 sec' or '30 %', as text; None for another cell.

    Parameters
    ----------
    cell : str
        Any text.
    decimal : str
        Point or comma.

    Notes
    -----
    A unit of signals that follows at once ('3V') counts only behind a decimal sign: '3A' may be a name. None
    for an empty cell, a unit that `is_unit` does not know, and more than `_LONGEST_QUANTITY` characters.
    """
    if len(cell) > _LONGEST_QUANTITY:
        return None
    text = cell.strip()
    # (2.5 %) is (2.5) %.
    if text[:1] == "(" and text[-1:] == ")":
        inside = quantity(text[1:-1], decimal)
        if inside is None or not inside[0][:1].isdigit():
            return None
        return f"({inside[0]})", inside[1]
    parts = _QUANTITY.fullmatch(text)
    if parts is None or not is_number(parts[1], decimal):
        return None
    value, blank, unit = parts.groups()
    is_set_apart = bool(blank) or unit in "%°"
    if not is_set_apart and decimal not in value and unit.lower() not in TIME_UNITS:
        return None
    return (value, unit) if is_unit(unit) else None


def without_units(cells: Sequence[str], decimal: str) -> tuple[tuple[str, ...], str] | None:
    """The numbers of a column as text, and their unit, where every cell has one and the same; else None.

    Parameters
    ----------
    cells : sequence of str
        The column.
    decimal : str
        Point or comma.

    Returns
    -------
    tuple or None
        A tuple of as many numbers, and the unit. Cells that are empty or a plain 'nan' stay as they are. None
        for a column without a filled cell.
    """
    first_filled = next((cell for cell in cells if cell), "")
    first_quantity = quantity(first_filled, decimal)
    if first_quantity is None:
        return None
    _, unit = first_quantity
    numbers = list[str]()
    for cell in cells:
        cell_quantity = quantity(cell, decimal)
        if cell_quantity is not None and cell_quantity[1] == unit:
            numbers.append(cell_quantity[0])
        elif cell.lower() in ("", "nan"):
            numbers.append(cell)
        else:
            return None
    return tuple(numbers), unit


def shows_decimals(cell: str, decimal: str) -> bool:
    """Whether the cell leaves no doubt that this sign separates decimals: '0.5', '1.25', not '1.250'.

    False for a cell that is no number.
    """
    return decimal in cell and is_number(cell, decimal) and not _ONE_GROUP.fullmatch(cell)


def doubtful_groups(cells: Sequence[str], decimal: str, *, proven: bool) -> int | None:
    """The first row of a column whose commas, or points, may be decimal or separate groups of three digits.

    Parameters
    ----------
    cells
        The column as text.
    decimal
        The decimal sign that the table was found to have.
    proven
        Whether other cells of the table leave no doubt of that sign: then only the other sign is looked at.

    Returns
    -------
    int or None
        Row, from 0. None where the column itself says which ('1,020.5', '1,020,300', '0,125'), or where
        whole numbers of four digits and more stand beside: these would be grouped, too. None, too, where a
        cell with such a sign is no number: whoever takes the column refuses it.
    """
    # The other sign may separate groups, or it is the decimal sign after all.
    other_sign = "," if decimal == "." else "."
    rows = [k for k, cell in enumerate(cells) if other_sign in cell]
    if rows:
        all_may_be_groups = all(_ONE_GROUP.fullmatch(cells[k]) for k in rows)
        return rows[0] if all_may_be_groups else None
    if proven:
        return None

    # The decimal sign itself may separate groups, where each has three digits behind it.
    rows = [k for k, cell in enumerate(cells) if decimal in cell]
    if not rows or not all(_ONE_GROUP.fullmatch(cells[k]) for k in rows):
        return None
    whole_numbers = [cell for cell in cells if cell and decimal not in cell]
    all_below_thousand = all(_BELOW_THOUSAND.fullmatch(cell) for cell in whole_numbers)
    return rows[0] if all_below_thousand else None
