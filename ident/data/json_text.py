"""JSON that somebody wrote, read without losing anything.

Python's reader keeps the last of two values with one name, and takes a text that is nested so deeply that
whatever looks at it later meets Python's limit of recursion. `json_value` refuses both.
"""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

# Levels of nesting: what looks at a value level by level, or prints it, calls itself once or a few times for
# each, and Python allows a thousand calls within each other. Chosen with room for both.
MOST_LEVELS = 40
# Characters of a name that a complaint shows: a line's worth.
_LONGEST_SHOWN = 80


def json_value(text: str) -> Any:
    """The value of a JSON text: dict, list, str, int, float, bool or None.

    Parameters
    ----------
    text : str
        One JSON value.

    Raises
    ------
    ValueError
        Wrong syntax (`json.JSONDecodeError`), more than `MOST_LEVELS` levels, or a name twice in one object,
        one of whose values would be lost.
    """

    def with_names_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """The object of these names and values; raises ValueError for a name that is there twice."""
        entries = dict(pairs)
        if len(entries) < len(pairs):
            ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
            shown = name[:_LONGEST_SHOWN]
            raise ValueError(f"'{shown}' is there twice in one object; expected each name once")
        return entries

    too_deep = f"nested deeper than {MOST_LEVELS} levels"
    try:
        value = json.loads(text, object_pairs_hook=with_names_once)
    except RecursionError:
        raise ValueError(too_deep) from None

    # Level by level, without recursion: what is left to look into after so many levels is too deep.
    containers = [value] if isinstance(value, (dict, list)) else []
    for _ in range(MOST_LEVELS + 1):
        inner_containers = list[Any]()
        for container in containers:
            items = container.values() if isinstance(container, dict) else container
            inner_containers += [item for item in items if isinstance(item, (dict, list))]
        containers = inner_containers
        if not containers:
            return value
    raise ValueError(too_deep)
