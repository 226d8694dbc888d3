"""Ctrl-C, SIGTERM and SIGHUP that no library can swallow: remembered when they come, asked about before a
result is kept."""

from __future__ import annotations

import signal
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_came: int | None = None


def watch() -> None:
    """Remember an interrupt besides raising KeyboardInterrupt; what is ignored (nohup) stays so."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _remember)


def ignore() -> None:
    """From here on nothing is to be interrupted."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def check() -> None:
    """Raises KeyboardInterrupt if one came and went under in compiled code that calls back into Python: what
    such a library returns then is a solution of nothing."""
    if _came is not None:
        raise KeyboardInterrupt


def came() -> bool:
    """Whether an interrupt has come."""
    return _came is not None


def exit_code() -> int:
    """128 + the signal, as shells expect: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
    return 128 + (_came or signal.SIGINT)


def _remember(number: int, frame: FrameType | None) -> None:
    global _came
    _came = number
    raise KeyboardInterrupt
