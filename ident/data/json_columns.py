"""Columns of a log in JSON: a list of rows, an object of columns, or a row in each line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ident.data.foreign_files import MOST_COLUMNS, Unread
from ident.data.json_text import json_value

# Names may be missing in rows: so many empty cells for a value, beside some, are looked at, not more.
_MOST_CELLS_A_VALUE, _FEW_CELLS = 50, 1_000_000
_KINDS = {bool: "true or false", int: "numbers", float: "numbers", str: "text", list: "lists"}


def json_columns(text: str, *, in_lines: bool) -> dict[str, Any]:
    """Arrays, text or `Unread` by name, nested as log.signals[0].values; what a row lacks is NaN. Raises
    ValueError, beginning with ':' or ', line 3:': no JSON, or a name twice in one object."""
    if in_lines:
        document: Any = [_parsed(line, k) for k, line in enumerate(text.split("\n"), 1) if line.strip()]
    else:
        document = _parsed(text, 0)
    lists = {"": document} if isinstance(document, list) else _lists("", document)
    if not any(lists.values()):
        raise ValueError(": no columns; expected a list of rows, or an object of lists of numbers")
    return {key: column for name, cells in lists.items() for key, column in columns_in(name, cells).items()}


def columns_in(name: str, cells: Sequence[Any]) -> dict[str, Any]:
    """The columns in the cells of one: what lies in objects is called name.key, in lists of one length
    name[0], name[1], ...; `Unread` where lengths differ."""
    there = [cell for cell in cells if cell is not None]
    parts: dict[str, list[Any]]
    if there and all(isinstance(cell, dict) for cell in there):
        keys = dict.fromkeys(key for cell in there for key in cell)
        # Rows times names are cells, also where each row has a name of its own: that is no table.
        filled = sum(map(len, there))
        if len(keys) > MOST_COLUMNS or len(keys) * len(cells) > _MOST_CELLS_A_VALUE * filled + _FEW_CELLS:
            raise ValueError(
                f": {len(keys)} names in {len(cells)} objects of {filled} values; expected at most "
                f"{MOST_COLUMNS} columns, and the same names in each row"
            )
        parts = {f"{name}.{key}" if name else key: [(cell or {}).get(key) for cell in cells] for key in keys}
    elif there and all(isinstance(cell, list) for cell in there):
        lengths = [len(cell) for cell in there]
        least, most = min(lengths), max(lengths)
        if least < most or not most:
            return {name or "value": Unread(f"lists of {least} to {most} entries; expected one length")}
        parts = {f"{name}[{k}]": [cell and cell[k] for cell in cells] for k in range(most)}
    else:
        return {name or "value": _column(cells)}
    return {key: column for part, inner in parts.items() for key, column in columns_in(part, inner).items()}


def _parsed(text: str, line: int) -> Any:
    """The value of a text: the whole file, or a line of it (from 1)."""
    try:
        return json_value(text)
    except json.JSONDecodeError as error:
        raise ValueError(f", line {line or error.lineno}: not valid JSON: {error.msg}") from None
    except ValueError as error:
        raise ValueError(f"{f', line {line}:' if line else ':'} {error}") from None


def _lists(name: str, value: Any) -> dict[str, list[Any]]:
    """Lists in an object of columns, or of columns by row number, as pandas writes them; a matrix (C, T) as
    T rows."""
    if isinstance(value, list):
        lying = {len(row) if isinstance(row, list) else 0 for row in value}
        turned = len(lying) == 1 and max(lying) > len(value)
        return {name or "value": list(map(list, zip(*value, strict=True))) if turned else value}
    if not isinstance(value, dict):
        return {}
    if len(value) > 1 and list(value) == [str(k) for k in range(len(value))]:
        return {name or "value": list(value.values())}
    parts = [(f"{name}.{key}" if name else key, item) for key, item in value.items()]
    return {key: found for part in parts for key, found in _lists(*part).items()}


def _column(values: Sequence[Any]) -> Any:
    there = {type(value) for value in values if value is not None}
    if there == {str}:
        return tuple(value or "" for value in values)
    if there == {bool} or there <= {int, float}:  # on and off, or numbers: true is no 1 among numbers
        whole = there == {int} and None not in values and all(abs(value) < 2**63 for value in values)
        with suppress(OverflowError):
            return np.array(values, dtype=np.int64 if whole else np.float64)
        # An integer of hundreds of digits is infinite.
        return np.array([np.nan if value is None else float(str(value)) for value in values])
    kinds = sorted({_KINDS.get(kind, "objects") for kind in there})
    return Unread(f"{' and '.join(kinds)} in one column; expected numbers")
