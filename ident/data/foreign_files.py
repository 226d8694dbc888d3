"""What holds for every file that somebody else wrote: how large it may be, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

LARGEST_BYTES = 2**30
"""Of a file, and of what it unpacks to: some hundred channels at 1 kHz for twenty minutes as doubles."""


@dataclass(frozen=True)
class Unread:
    """A named thing in a file that is no array of numbers: what it is, and what to do."""

    why: str


def shown(value: object, longest: int = 80) -> str:
    """How a value from a file is quoted: on one line, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    text = " ".join(text[: 4 * longest].split())
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= longest else text[: longest - 3] + "..."


def content_of(file: Path) -> bytes:
    """The bytes of a file. Raises ValueError where there are more than `LARGEST_BYTES`, OSError as `open`."""
    size = file.stat().st_size
    if size > LARGEST_BYTES:
        raise ValueError(f"{size / 2**20:.0f} MiB; expected at most {LARGEST_BYTES >> 20}: split the file")
    return file.read_bytes()


def as_numbers(values: Any) -> np.ndarray[Any, np.dtype[Any]]:
    """An array as it is, if it holds real numbers or instants. Raises ValueError saying what it holds."""
    if isinstance(values, Unread):
        raise ValueError(f"holds {values.why}")
    array = np.asarray(values)
    if array.dtype.kind not in "fiubMm":
        what = "text" if array.dtype.kind in "USO" else f"{array.dtype}"
        raise ValueError(f"holds {shown(what)}; expected real numbers")
    return array
