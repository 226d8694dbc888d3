"""Columns of a log in JSON: a list of rows, an object of columns, or a row in each line."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import numpy as np

from ident.data.foreign_files import Unread
from ident.data.json_text import json_value

_KINDS = {bool: "true or false", int: "numbers", float: "numbers", str: "text", list: "lists"}


def json_columns(text: str, *, in_lines: bool) -> dict[str, Any]:
    """Arrays, text or `Unread` by name, nested as log.signals[0].values; what a row lacks is NaN. Raises
    ValueError, beginning with ':' or ', line 3:': no JSON, or a name twice in one object."""
    if in_lines:
        document: Any = [_parsed(line, k) for k, line in enumerate(text.split("\n"), 1) if line.strip()]
    else:
        document = _parsed(text, 0)
    if isinstance(document, list):
        rows = [_leaves("", row) for row in document]
        names = dict.fromkeys(name for row in rows for name in row)
        lists = {name: [row.get(name) for row in rows] for name in names}
    else:
        lists = _lists("", document)
    if not lists:
        raise ValueError(": no columns; expected a list of rows, or an object of lists of numbers")
    return {name: _column(values) for name, values in lists.items()}


def _parsed(text: str, line: int) -> Any:
    """The value of a text: the whole file, or a line of it (from 1)."""

    where = f", line {line}:" if line else ":"
    try:
        return json_value(text)
    except json.JSONDecodeError as error:
        raise ValueError(f", line {line or error.lineno}: not valid JSON: {error.msg}") from None
    except ValueError as error:
        raise ValueError(f"{where} {error}") from None


def _leaves(name: str, value: Any) -> dict[str, Any]:
    """Numbers and words of one row."""
    if isinstance(value, dict):
        parts = [(f"{name}.{key}" if name else key, item) for key, item in value.items()]
    elif isinstance(value, list):
        parts = [(f"{name}[{k}]", item) for k, item in enumerate(value)]
    else:
        return {name or "value": value}
    return {key: leaf for part in parts for key, leaf in _leaves(*part).items()}


def _lists(name: str, value: Any) -> dict[str, list[Any]]:
    """Lists in an object of columns, or of columns by row number, as pandas writes them."""
    if isinstance(value, list):
        return {name or "value": value}
    if not isinstance(value, dict):
        return {}
    if len(value) > 1 and list(value) == [str(k) for k in range(len(value))]:
        return {name or "value": list(value.values())}
    parts = [(f"{name}.{key}" if name else key, item) for key, item in value.items()]
    return {key: found for part in parts for key, found in _lists(*part).items()}


def _column(values: list[Any]) -> Any:
    there = {type(value) for value in values if value is not None}
    if there == {str}:
        return tuple(value or "" for value in values)
    if there == {bool} or there <= {int, float}:  # on and off, or numbers: true is no 1 among numbers
        whole = there == {int} and None not in values and all(abs(value) < 2**63 for value in values)
        return np.array(values, dtype=np.int64) if whole else np.array([_number(value) for value in values])
    if there == {list} and None not in values:
        with contextlib.suppress(ValueError, TypeError, OverflowError):
            rows = np.array(values)
            if rows.ndim == 2 and rows.dtype.kind in "if":
                return rows
    kinds = sorted({_KINDS.get(kind, "objects") for kind in there})
    return Unread(f"{' and '.join(kinds)} in one column; expected numbers")


def _number(value: Any) -> float:
    try:
        return np.nan if value is None else float(value)
    except OverflowError:  # an integer of hundreds of digits
        return np.inf
