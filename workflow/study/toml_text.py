"""A configuration document as TOML, so that a point of a study can be run by itself."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any


def toml_text(document: Mapping[str, Any]) -> str:
    """Top-level tables as [sections], everything below inline; None is left out, as a default is.

    Raises TypeError for values TOML has no word for.
    """
    plain = [f"{_key(key)} = {_value(item)}" for key, item in document.items() if _is_plain(item)]
    blocks = ["\n".join(plain)] if plain else []
    for key, item in document.items():
        if isinstance(item, Mapping):
            rows = [f"{_key(name)} = {_value(inner)}" for name, inner in item.items() if inner is not None]
            blocks.append("\n".join([f"[{_key(key)}]", *rows]))
        elif _is_tables(item):
            for table in item:
                rows = [f"{_key(name)} = {_value(v)}" for name, v in table.items() if v is not None]
                blocks.append("\n".join([f"[[{_key(key)}]]", *rows]))
    return "\n\n".join(blocks) + "\n"


def _is_tables(item: Any) -> bool:
    return isinstance(item, (list, tuple)) and bool(item) and all(isinstance(one, Mapping) for one in item)


def _is_plain(item: Any) -> bool:
    return item is not None and not isinstance(item, Mapping) and not _is_tables(item)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _string(name)


def _string(text: str) -> str:
    # JSON's escapes are TOML's, but for the pairs it makes of characters beyond 16 bits, and for DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
        text = repr(value)
        return text if any(letter in text for letter in ".e") else f"{text}.0"
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items() if item is not None)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    raise TypeError(f"no TOML for {type(value).__name__}")
