"""Which code made a result: a digest of our own source files, so that resuming never mixes two versions."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

_ROOMS = ("plant", "ident", "control_design", "workflow")
# They draw what is stored; numbers do not pass through them.
_ONLY_DRAWING = ("workflow/figures", "workflow/report", "workflow/text")


@cache
def code_digest(*, drawing: bool = False) -> str:
    """SHA-256 over the rooms' Python files, paths and contents (with `drawing` also what only draws)."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for room in _ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if drawing or not name.startswith(_ONLY_DRAWING):
                digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    if drawing:
        templates = root / "workflow" / "templates"
        for path in sorted(path for path in templates.rglob("*") if path.is_file()):
            name = path.relative_to(templates).as_posix()
            digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
