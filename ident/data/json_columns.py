"""Columns of a log in JSON: a list of rows, an object of columns, or a row in each line.

Nobody says which of these a file is, nor how deep its signals lie. `json_columns` finds every list in the
document and takes each for a column, or for rows. `columns_in` takes rows apart: what lies in objects becomes
columns name.key, what lies in lists of one length columns name[0], name[1], ..., until numbers or text are
left. What is no column of one kind stays as `Unread`, with the reason.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ident.data.foreign_files import MOST_COLUMNS, Unread
from ident.data.json_text import json_value

# Names may be missing in rows: so many cells for each value that is there, beside `_FEW_CELLS`, are made. In
# a table that has more each row has names of its own. Chosen: signals at a fiftieth of the fastest rate are
# still rows of one log.
_MOST_CELLS_A_VALUE = 50
# Cells that are made in any case: they take about a tenth of a second.
_FEW_CELLS = 1_000_000
# Integers up to this size, exclusive, are kept as integers of 64 bits, which end there; larger ones as
# doubles.
_END_OF_INTEGERS = 2**63
# Words for the kinds of values in complaints; null has none.
_KIND_WORDS = {bool: "true or false", int: "numbers", float: "numbers", str: "text", list: "lists"}


def json_columns(text: str, *, in_lines: bool) -> dict[str, Any]:
    """The columns of a log in JSON, nested ones as log.signals[0].values.

    Parameters
    ----------
    text : str
        All of a file.
    in_lines : bool
        Each line that is not blank is a row (JSON lines).

    Returns
    -------
    dict
        By name an array (T,) of numbers or truth values, a tuple of T texts, or `Unread`. What a row lacks
        is NaN, or an empty text.

    Raises
    ------
    ValueError
        No JSON, a name twice in one object, or no columns; the message begins with ':' or ', line 3:'.
    """
    if in_lines:
        document: Any = [_parsed(line, k) for k, line in enumerate(text.split("\n"), 1) if line.strip()]
    else:
        document = _parsed(text, 0)
    lists = {"": document} if isinstance(document, list) else _lists("", document)
    if not any(lists.values()):
        raise ValueError(": no columns; expected a list of rows, or an object of lists of numbers")
    columns = dict[str, Any]()
    for name, cells in lists.items():
        columns |= columns_in(name, cells)
    return columns


def columns_in(name: str, cells: Sequence[Any]) -> dict[str, Any]:
    """The columns that lie in the cells of one column, by name.

    Parameters
    ----------
    name : str
        Of the column; empty for rows without a name.
    cells : sequence
        A value of JSON for each row; None where a row lacks it.

    Returns
    -------
    dict
        As of `json_columns`: of objects name.key, of lists of one length name[0], name[1], ...; `Unread`
        where lengths differ.

    Raises
    ------
    ValueError
        More names than a table has columns, or names that hardly any row has.
    """
    values = [cell for cell in cells if cell is not None]
    parts = dict[str, list[Any]]()
    if values and all(isinstance(value, dict) for value in values):
        keys = dict.fromkeys(key for value in values for key in value)
        # Rows times names are cells, also where each row has a name of its own: that is no table.
        n_filled = sum(map(len, values))
        n_cells = len(keys) * len(cells)
        if len(keys) > MOST_COLUMNS or n_cells > _MOST_CELLS_A_VALUE * n_filled + _FEW_CELLS:
            raise ValueError(
                f": {len(keys)} names in {len(cells)} objects of {n_filled} values; expected at most "
                f"{MOST_COLUMNS} columns, and the same names in each row"
            )
        for key in keys:
            part_name = f"{name}.{key}" if name else key
            parts[part_name] = [(cell or {}).get(key) for cell in cells]
    elif values and all(isinstance(value, list) for value in values):
        lengths = [len(value) for value in values]
        shortest = min(lengths)
        longest = max(lengths)
        if shortest < longest or longest == 0:
            why = f"lists of {shortest} to {longest} entries; expected one length"
            return {name or "value": Unread(why)}
        for k in range(longest):
            parts[f"{name}[{k}]"] = [cell and cell[k] for cell in cells]
    else:
        return {name or "value": _column(cells)}

    columns = dict[str, Any]()
    for part_name, part_cells in parts.items():
        columns |= columns_in(part_name, part_cells)
    return columns


def _parsed(text: str, line: int) -> Any:
    """The value of a text: the whole file (line 0), or a line of it (from 1).

    Raises ValueError, beginning with the line where it is known.
    """
    try:
        return json_value(text)
    except json.JSONDecodeError as error:
        raise ValueError(f", line {line or error.lineno}: not valid JSON: {error.msg}") from None
    except ValueError as error:
        place = f", line {line}:" if line else ":"
        raise ValueError(f"{place} {error}") from None


def _lists(name: str, value: Any) -> dict[str, list[Any]]:
    """Lists by name in an object of columns, each with a cell for every row; empty for another value.

    An object may hold a column by the numbers of its rows, '0', '1', ..., as pandas writes them. A matrix of
    C lists of T numbers, C < T, is turned into T rows. Empty for a number or text, which the caller refuses
    as no columns.
    """
    if isinstance(value, list):
        widths = {len(row) if isinstance(row, list) else 0 for row in value}
        lies_on_its_side = len(widths) == 1 and max(widths) > len(value)
        rows = list(map(list, zip(*value, strict=True))) if lies_on_its_side else value
        return {name or "value": rows}
    if not isinstance(value, dict):
        return {}
    row_numbers = [str(k) for k in range(len(value))]
    if len(value) > 1 and list(value) == row_numbers:
        return {name or "value": list(value.values())}
    lists = dict[str, list[Any]]()
    for key, item in value.items():
        lists |= _lists(f"{name}.{key}" if name else key, item)
    return lists


def _column(values: Sequence[Any]) -> Any:
    """The column of values of one kind: an array (T,), or a tuple of T texts; else `Unread`.

    None becomes NaN, or an empty text. An integer of hundreds of digits becomes infinite. No values, or
    nothing but None: an array of NaN.
    """
    kinds = {type(value) for value in values if value is not None}
    if kinds == {str}:
        return tuple(value or "" for value in values)
    # On and off, or numbers: true is no 1 among numbers.
    if kinds == {bool} or kinds <= {int, float}:
        is_whole = kinds == {int} and None not in values
        fits = is_whole and all(abs(value) < _END_OF_INTEGERS for value in values)
        with suppress(OverflowError):
            return np.array(values, dtype=np.int64 if fits else np.float64)
        # Python refuses to make a double of an integer that is too large, but not of its digits.
        return np.array([np.nan if value is None else float(str(value)) for value in values])
    words = sorted({_KIND_WORDS.get(kind, "objects") for kind in kinds})
    return Unread(f"{' and '.join(words)} in one column; expected numbers")
