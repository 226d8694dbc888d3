"""JSON that somebody wrote, read without losing anything."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

MOST_LEVELS = 40
"""Of nesting: what looks at a value level by level, or prints it, would meet Python's own limit."""


def json_value(text: str) -> Any:
    """The value of a JSON text. Raises ValueError: syntax, more than `MOST_LEVELS` levels, a name twice in
    one object (one would be lost)."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
            raise ValueError(f"'{twice[:80]}' is there twice in one object; expected each name once")
        return found

    too_deep = f"nested deeper than {MOST_LEVELS} levels"
    try:
        value = json.loads(text, object_pairs_hook=once)
    except RecursionError:
        raise ValueError(too_deep) from None
    level = [value] if isinstance(value, (dict, list)) else []
    for _ in range(MOST_LEVELS + 1):
        inner = (item.values() if isinstance(item, dict) else item for item in level)
        level = [part for parts in inner for part in parts if isinstance(part, (dict, list))]
        if not level:
            return value
    raise ValueError(too_deep)
