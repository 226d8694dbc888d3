"""Keys and options that had another name once: still read, with a warning that names the new one."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from typing import Any

from workflow.engine.errors import InputError

# Dotted key, by the earlier name of its last part -> that part now. The second are options of the commands.
RENAMED = {
    "yardstick": "achievable_performance",
    "prefilter": "reference_filter",
    "channels.uncertainty.promise": "response",
}
RENAMED_OPTIONS = {"--promise": "--response"}


class RenamedKeyWarning(FutureWarning):
    """A configuration or a command uses an earlier name."""


def current_key(key: str) -> str:
    """The dotted key (`channels[0].uncertainty.promise`) by its names of today."""
    parts = key.split(".")
    for n, part in enumerate(parts):
        path = re.sub(r"\[\d+\]", "", ".".join(parts[: n + 1]))
        if path in RENAMED:
            _warn("key", part, RENAMED[path])
            parts[n] = RENAMED[path]
    return ".".join(parts)


def current_options(arguments: Iterable[str]) -> list[str]:
    """The arguments of a command by the names its options have now."""
    found = []
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name in RENAMED_OPTIONS:
            _warn("option", name, RENAMED_OPTIONS[name])
        found.append(RENAMED_OPTIONS.get(name, name) + equals + value)
    return found


def with_current_keys(document: dict[str, Any], source: str, inside: str = "") -> dict[str, Any]:
    """The document, changed in place. Raises InputError where a key is there under both names."""
    for key in list(document):
        path = inside + key
        if new := RENAMED.get(path):
            if new in document:
                raise InputError(f"{source}: {path} is the earlier name of {new}: give one of them")
            _warn(source, path, new)
            document[new] = document.pop(key)
        elif any(old.startswith(f"{path}.") for old in RENAMED):
            tables = document[key] if isinstance(document[key], list) else [document[key]]
            for table in tables:
                if isinstance(table, dict):
                    with_current_keys(table, source, f"{path}.")
    return document


def _warn(source: str, old: str, new: str) -> None:
    warnings.warn(f"{source}: {old} is now called {new}", RenamedKeyWarning, stacklevel=3)
