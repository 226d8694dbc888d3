"""Interrupts (signals, the end of a time limit) that compiled code swallows, and processes that see none."""

from __future__ import annotations

import io
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
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


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Interrupts come through only at the end; processes begun inside do not see them."""
    resource_tracker.ensure_running()  # its own start would let them through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_to_parent() -> None:
    """In a worker process: the parent alone answers to the keyboard."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
