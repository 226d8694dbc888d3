"""Dotted keys (`closed_loop.effects[0].mass_kg`) into configuration documents."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any

_NAME = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)((?:\[\d+\])*)")

Path = tuple[str | int, ...]


def parse_key(key: str) -> Path:
    """Names and list indices of a dotted key. Raises ValueError saying how one is written."""
    parts: list[str | int] = []
    for piece in key.split("."):
        match = _NAME.fullmatch(piece)
        if match is None:
            raise ValueError(
                f"not a dotted key: {key!r}; expected for example 'specification.bandwidth_rad_s' or "
                "'closed_loop.effects[0].mass_kg'"
            )
        parts.append(match.group(1))
        parts += [int(index) for index in re.findall(r"\d+", match.group(2))]
    return tuple(parts)


def last_name(key: str) -> str:
    """The last name in a dotted key, without an index."""
    return next(part for part in reversed(parse_key(key)) if isinstance(part, str))


def with_values(document: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of the document with the dotted keys set.

    A table that is absent is made; whether its keys are known is for the configuration's own check to say.
    Raises ValueError where a key goes through something that is no table, or an index is beyond the list.
    """
    changed = copy.deepcopy(dict(document))
    for key, value in values.items():
        path, where = parse_key(key), ""
        here: Any = changed
        for part, last in zip(path, [*[False] * (len(path) - 1), True], strict=True):
            if isinstance(part, int):
                if not isinstance(here, list):
                    raise ValueError(f"{key}: {where} is no list")
                if part >= len(here):
                    raise ValueError(f"{key}: {where} has {len(here)} entries, counted from 0")
            elif not isinstance(here, dict):
                raise ValueError(f"{key}: {where} is no table")
            elif here.get(part) is None:
                here[part] = {}
            if last:
                here[part] = copy.deepcopy(value)
            here = here[part]
            where = f"{where}[{part}]" if isinstance(part, int) else f"{where}.{part}".removeprefix(".")
    return changed
