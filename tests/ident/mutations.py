"""Damage done to files, the same for the same seed."""

from __future__ import annotations

import numpy as np


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with one to three of: a bit turned, bytes replaced, cut off, taken out, doubled, zeroed."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        at, n = int(rng.integers(len(data) or 1)), int(rng.integers(1, 32))
        match int(rng.integers(6)):
            case 0 if data:
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                data[at : at + n] = rng.bytes(n)
            case 2:
                del data[at:]
            case 3:
                del data[at : at + n]
            case 4:
                data[at:at] = data[at : at + n]
            case _:
                data[at : at + n] = bytes(n)
    return bytes(data)
