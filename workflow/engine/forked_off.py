"""Loaded by the process that workers are forked off, and by no other.

An interrupt while a worker is begun leaves half of its task in the pipe, and a traceback for nobody.
"""

from __future__ import annotations

import os
import sys
from types import TracebackType

from workflow.engine.threads import SAFE_PATH


def _tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if kind.__name__ not in ("EOFError", "UnpicklingError"):
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _tell
# What a user's simulation starts is the user's.
if SAFE_PATH.items() <= os.environ.items():
    del os.environ["PYTHONSAFEPATH"]
