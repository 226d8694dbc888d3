"""Which code made a result: a digest of our own source files, so that resuming never mixes two versions."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

# Packages that the numbers of a run come from.
_ROOMS = ("plant", "ident", "control_design", "workflow")
# They draw what is stored; numbers do not pass through them.
_ONLY_DRAWING = ("workflow/figures", "workflow/report", "workflow/text")


@cache
def code_digest(*more: str, drawing: bool = False) -> str:
    """SHA-256 over the code that makes a result.

    Parameters
    ----------
    *more : str
        Packages beside those of a run.
    drawing : bool
        Also over what only draws: a page is made of that, too.

    Returns
    -------
    str
        Hexadecimal; read once in a process.
    """
    root = Path(__file__).resolve().parents[2]
    paths = [path for room in (*_ROOMS, *more) for path in sorted((root / room).rglob("*.py"))]
    if drawing:
        paths += sorted(path for path in (root / "workflow/templates").rglob("*") if path.is_file())
    digest = hashlib.sha256()
    for path in paths:
        name = path.relative_to(root).as_posix()
        if drawing or not name.startswith(_ONLY_DRAWING):
            digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
