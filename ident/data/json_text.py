"""JSON that somebody wrote, read without losing anything."""

from __future__ import annotations

import json
from typing import Any


def json_value(text: str) -> Any:
    """The value of a JSON text. Raises ValueError: syntax, nesting without end, a name twice in one object
    (one would be lost)."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"'{twice[:80]}' is there twice in one object; expected each name once")
        return found

    try:
        return json.loads(text, object_pairs_hook=once)
    except RecursionError:
        raise ValueError("nested too deeply") from None
