"""Interrupts (signals, the end of a time limit) that compiled code swallows."""

from __future__ import annotations

import io
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Raise KeyboardInterrupt at the end if an interrupt came while the code inside ran.

    CasADi asks Python for signals while it iterates and turns the exception of the handler into an ordinary
    end of the solver ("User_Requested_Stop", or a failed evaluation). The handler is therefore watched, not
    the status; what CasADi prints about the exception that it swallowed is not for the user. Python runs
    handlers in the main thread only: elsewhere there is nothing to do.
    """
    before: dict[int, Any] = {number: signal.getsignal(number) for number in _SIGNALS}
    before = {number: handler for number, handler in before.items() if callable(handler)}
    if threading.current_thread() is not threading.main_thread() or not before:
        yield
        return
    seen, stderr = False, sys.stderr

    def watch(number: int, frame: FrameType | None) -> None:
        nonlocal seen
        seen = True
        sys.stderr = io.StringIO()
        before[number](number, frame)

    try:
        for number in before:
            signal.signal(number, watch)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.stderr = stderr
        if seen:
            raise KeyboardInterrupt
