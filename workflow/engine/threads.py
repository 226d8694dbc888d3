"""How many threads numerical libraries take: one, here and in the processes begun here.

Matrices here are small, so threads would only wait for one another; and sums that are split otherwise round
otherwise.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def one_thread() -> None:
    """For this process, before numpy is loaded."""
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))


@contextmanager
def one_thread_each() -> Iterator[None]:
    """For processes begun inside: libraries read the number of threads when they load."""
    before = {name: os.environ.get(name) for name in _VARIABLES}
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
