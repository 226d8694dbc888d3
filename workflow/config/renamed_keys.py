"""Keys that had another name once: still read, with a warning that names the new one."""

from __future__ import annotations

import warnings
from typing import Any

from workflow.engine.errors import InputError

# Tables at the top: earlier name -> name now.
RENAMED = {"yardstick": "achievable_performance", "prefilter": "reference_filter"}


class RenamedKeyWarning(FutureWarning):
    """A configuration uses an earlier name of a key."""


def current_key(key: str) -> str:
    """The dotted key by its names of today."""
    first, *rest = key.split(".")
    if first in RENAMED:
        _warn("key", first)
    return ".".join([RENAMED.get(first, first), *rest])


def with_current_keys(document: dict[str, Any], source: str) -> dict[str, Any]:
    """The document, changed in place. Raises InputError where a key is there under both names."""
    for old, new in RENAMED.items():
        if old in document:
            if new in document:
                raise InputError(f"{source}: {old} is the earlier name of {new}: give one of them")
            _warn(source, old)
            document[new] = document.pop(old)
    return document


def _warn(source: str, old: str) -> None:
    warnings.warn(f"{source}: {old} is now called {RENAMED[old]}", RenamedKeyWarning, stacklevel=2)
