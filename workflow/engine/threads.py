"""How many threads numerical libraries take: one, here and in the processes begun here.

Matrices here are small, so threads would only wait for one another; and sums that are split otherwise round
otherwise.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

# Variables by which numerical libraries read their number of threads.
_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# A process of ours takes no random.py in the current folder for Python's own; any value does, this is ours.
SAFE_PATH = {"PYTHONSAFEPATH": "flexlink"}


def one_thread() -> None:
    """For this process, before numpy is loaded."""
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))


@contextmanager
def one_thread_each() -> Iterator[None]:
    """For processes begun inside: libraries read the number of threads when they load."""
    ours = dict.fromkeys(_VARIABLES, "1") | ({} if "PYTHONSAFEPATH" in os.environ else SAFE_PATH)
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
