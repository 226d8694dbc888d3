"""Loaded by the process that workers are forked off, and by no other.

An interrupt while a worker is begun leaves half of its task in the pipe, and a traceback for nobody.
"""

from __future__ import annotations

import sys
from types import TracebackType


def _tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if kind.__name__ not in ("EOFError", "UnpicklingError"):
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _tell
