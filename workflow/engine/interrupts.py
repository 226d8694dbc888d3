"""Ctrl-C that no library can swallow: remembered when it comes, asked about before a result is kept."""

from __future__ import annotations

import signal
from types import FrameType

_came = False


def watch() -> None:
    """Remember an interrupt from the keyboard besides raising KeyboardInterrupt, once per process."""
    signal.signal(signal.SIGINT, _remember)


def check() -> None:
    """Raises KeyboardInterrupt if one came and went under in compiled code that calls back into Python: what
    such a library returns then is a solution of nothing."""
    if _came:
        raise KeyboardInterrupt


def _remember(number: int, frame: FrameType | None) -> None:
    global _came
    _came = True
    signal.default_int_handler(number, frame)
