"""Ctrl-C, SIGTERM, SIGHUP and the end of a time limit, that no library can swallow: remembered when they
come, asked about before a result is kept."""

from __future__ import annotations

import signal
import sys
from types import FrameType

# What ends a command from outside.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_came: int | None = None


def watch(*, later: bool = False) -> None:
    """Remember an interrupt besides raising KeyboardInterrupt, or with `later` leave that to `check`; what is
    ignored (nohup) stays so."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _keep if later else _remember)
    sys.unraisablehook = _again


def limit(seconds: float | None) -> None:
    """Interrupt when so much time has passed, if any is given; only in the main thread."""
    if seconds is not None:
        signal.signal(signal.SIGALRM, _remember)
        signal.setitimer(signal.ITIMER_REAL, seconds)


def no_limit() -> None:
    """End the limit of this command; an alarm of anybody else's stays."""
    if signal.getsignal(signal.SIGALRM) is _remember:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


def ignore() -> None:
    """From here on nothing is to be interrupted."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def check() -> None:
    """Raises KeyboardInterrupt if one came while commands were loaded, or went under in compiled code that
    calls back into Python: what such a library returns then is a solution of nothing."""
    if _came is not None:
        raise KeyboardInterrupt


def came() -> bool:
    """Whether an interrupt has come."""
    return _came is not None


def exit_code() -> int:
    """128 + the signal, as shells expect: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP, 142 an alarm."""
    return 128 + (_came or signal.SIGINT)


def words() -> str:
    """What has ended the command."""
    return "the time limit is reached" if _came == signal.SIGALRM else "interrupted"


def _keep(number: int, frame: FrameType | None) -> None:
    global _came
    _came = _came or number


def _remember(number: int, frame: FrameType | None) -> None:
    _keep(number, frame)
    raise KeyboardInterrupt


# Seconds until an interrupt comes again: after the callback has returned, before anybody notices.
_AGAIN_S = 0.02


def _again(event: sys.UnraisableHookArgs) -> None:
    """An interrupt that came while Python was cleaning up or in a callback of a library, where it goes under
    with two lines on standard error, comes again a moment later."""
    if not issubclass(event.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(event)
    elif _came is not None:
        signal.signal(signal.SIGALRM, _remember)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
