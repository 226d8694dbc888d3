"""Numbers as people and programs write them in cells of text.

Digits in groups, signs of several kinds, a unit behind the number ('0.005 sec', '30 %').
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from ident.data.units import TIME_UNITS, is_unit

# No alternative can match what another one left over, so that time is linear in the length of a cell. Fortran
# writes 1.0D-03, always with the sign of the exponent.
_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+|[dD][+-]\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE
)
_FORTRAN = re.compile(r"[dD](?=[+-])")
# Digits in groups of three, by a comma or a point as others write decimals, or by what is neither.
_GROUPED_NUMBER = {
    sign: re.compile(
        rf"[+-]?[1-9]\d{{0,2}}([{other}'’ \u00a0\u202f\u2009])\d{{3}}(\1\d{{3}})*({re.escape(sign)}\d*)?"
    )
    for sign, other in ((".", ","), (",", "."))
}
_ONE_GROUP = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
# Minus as typesetters have it (U+2212), an en dash, small and wide hyphens: before a number, or its exponent.
_MINUS_SIGNS = "\u2212\u2013\ufe63\uff0d"
_TYPESET_MINUS = re.compile(rf"(?:(?<![\w)\]])|(?<=\d[eE]))[{_MINUS_SIGNS}](?=[.,]?\d)")
# A number and its unit, as letters behind it.
_QUANTITY = re.compile(r"((?=[(+\-.,\d]).*?[\d.)])(\s*)([^\W\d_]{1,12}|[%°])")
_LONGEST_QUANTITY = 60  # characters; a number of a double has 24


def with_plain_minus(text: str) -> str:
    """The text with '-' wherever another minus sign stands before a number."""
    if not any(sign in text for sign in _MINUS_SIGNS):
        return text
    return _TYPESET_MINUS.sub("-", text)


def _with_leading_sign(text: str) -> str:
    """'-3.25' of '(3.25)' and of '3.25-', as bookkeeping writes what is negative; else the text as it is."""
    if text[:1] == "(" and text[-1:] == ")" and text[1:2].isdigit():
        return f"-{text[1:-1]}"
    if text[-1:] == "-" and text[:1].isdigit():
        return f"-{text[:-1]}"
    return text


def is_bookkept(cell: str, decimal: str) -> bool:
    """Whether the cell is a number whose minus is a pair of brackets, or stands behind it."""
    text = cell.strip()
    return _with_leading_sign(text) != text and is_number(cell, decimal)


def is_number(cell: str, decimal: str) -> bool:
    """Whether the cell is a number with this decimal sign; blanks around it do no harm."""
    text = cell.strip()
    if decimal == ".":
        if _NUMBER.fullmatch(text):  # nearly all cells
            return True
    elif "." not in text and _NUMBER.fullmatch(text.replace(",", ".")):
        return True
    with_sign = _with_leading_sign(text)
    if with_sign != text:
        return is_number(with_sign, decimal)
    return _GROUPED_NUMBER[decimal].fullmatch(text) is not None


def number(cell: str, decimal: str) -> float:
    """The number in a cell for which `is_number` holds; digits in groups of three are one number."""
    text = _with_leading_sign(cell.strip())
    grouped = _GROUPED_NUMBER[decimal].fullmatch(text)
    if grouped:
        text = text.replace(grouped[1], "")
    return float(_FORTRAN.sub("e", text.replace(",", ".")))


def quantity(cell: str, decimal: str) -> tuple[str, str] | None:
    """The number and the unit in a cell like '0.005 sec' or '30 %'; None where it is no such cell.

    A unit of signals that follows at once ('3V') counts only behind a decimal sign: '3A' may be a name.
    """
    if len(cell) > _LONGEST_QUANTITY:
        return None
    text = cell.strip()
    if text[:1] == "(" and text[-1:] == ")":  # (2.5 %) is (2.5) %
        inside = quantity(text[1:-1], decimal)
        return (f"({inside[0]})", inside[1]) if inside and inside[0][:1].isdigit() else None
    found = _QUANTITY.fullmatch(text)
    if found is None or not is_number(found[1], decimal):
        return None
    value, blank, unit = found.groups()
    apart = bool(blank) or unit in "%°" or decimal in value or unit.lower() in TIME_UNITS
    return (value, unit) if apart and is_unit(unit) else None


def without_units(cells: Sequence[str], decimal: str) -> tuple[tuple[str, ...], str] | None:
    """The numbers of a column, and their unit, where every cell that is neither empty nor a plain 'nan' is a
    number with one and the same unit; else None."""
    first = next((cell for cell in cells if cell), "")
    begins = quantity(first, decimal)
    if begins is None:
        return None
    unit = begins[1]
    numbers = list[str]()
    for cell in cells:
        found = quantity(cell, decimal)
        if found is not None and found[1] == unit:
            numbers.append(found[0])
        elif cell.lower() in ("", "nan"):
            numbers.append(cell)
        else:
            return None
    return tuple(numbers), unit


def shows_decimals(cell: str, decimal: str) -> bool:
    """Whether the cell leaves no doubt that this sign separates decimals: '0.5', '1.25', not '1.250'."""
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
        Whether other cells of the table leave no doubt of that sign.

    Returns
    -------
    int or None
        Row, from 0. None where the column itself says which ('1,020.5', '1,020,300', '0,125'), or where
        whole numbers of four digits and more stand beside: these would be grouped, too.
    """
    other = "," if decimal == "." else "."
    rows = [k for k, cell in enumerate(cells) if other in cell]
    if rows:
        return rows[0] if all(_ONE_GROUP.fullmatch(cells[k]) for k in rows) else None
    if proven:
        return None
    rows = [k for k, cell in enumerate(cells) if decimal in cell]
    if not rows or not all(_ONE_GROUP.fullmatch(cells[k]) for k in rows):
        return None
    whole = [cell for cell in cells if cell and decimal not in cell]
    return rows[0] if all(re.fullmatch(r"[+-]?\d{1,3}", cell) for cell in whole) else None
