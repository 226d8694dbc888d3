"""One random stream per stage, so that resuming or reordering stages never shifts another stage's numbers."""

from __future__ import annotations

import hashlib

import numpy as np


def stage_rng(seed: int, *names: str) -> np.random.Generator:
    """Generator keyed by the run's seed and the names (stage, channel, record ...).

    The names enter as the eight 32-bit words of their SHA-256: the order of asking does not matter.
    """
    words = np.frombuffer(hashlib.sha256("\0".join(names).encode("utf-8")).digest(), dtype="<u4")
    return np.random.default_rng(np.random.SeedSequence([seed, *(int(word) for word in words)]))
