"""Keys that had another name once: still read, with a warning that names the new one."""

from __future__ import annotations

import warnings
from typing import Any

from workflow.engine.errors import InputError

# Old dotted key -> last name now; of tables in a list every one is meant.
RENAMED = {
    "yardstick": "achievable_performance",
    "prefilter": "reference_filter",
}


class RenamedKeyWarning(FutureWarning):
    """A configuration uses an earlier name of a key."""


def current_key(key: str) -> str:
    """The dotted key by its names of today."""
    for old, new in RENAMED.items():
        if key == old or key.startswith(f"{old}."):
            today = ".".join([*old.split(".")[:-1], new])
            _warn("key", old, today)
            return today + key[len(old) :]
    return key


def with_current_keys(document: dict[str, Any], source: str) -> dict[str, Any]:
    """The document, changed in place. Raises InputError where a key is there under both names."""
    for old, new in RENAMED.items():
        *path, last = old.split(".")
        tables: list[Any] = [document]
        for name in path:
            below = [table.get(name) for table in tables if isinstance(table, dict)]
            tables = [one for found in below for one in (found if isinstance(found, list) else [found])]
        for table in tables:
            if isinstance(table, dict) and last in table:
                if new in table:
                    raise InputError(f"{source}: {old} is the earlier name of {new}: give one of them")
                _warn(source, old, ".".join([*path, new]))
                table[new] = table.pop(last)
    return document


def _warn(source: str, old: str, new: str) -> None:
    warnings.warn(f"{source}: {old} is now called {new}", RenamedKeyWarning, stacklevel=2)
