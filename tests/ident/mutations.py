"""Damage done to files, the same for the same seed, and what became of it."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

LONGEST_LINE = 300
LONGEST_WAIT_S = 60.0


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


@dataclass
class Tally:
    """What became of spoilt files of one kind; refusals by length and by CPU time, children's too."""

    tried: int = 0
    refused: int = 0
    longest: int = 0
    slowest_s: float = 0.0
    wrong: list[str] = field(default_factory=list)


def tally(attempt: Callable[[np.random.Generator], str | None], count: int, *seed: int) -> Tally:
    """attempt: spoils a file and has it read. It returns the refusal, without the name of the folder, or None
    where the file was taken; whatever it raises went wrong."""
    found = Tally()
    for number in range(count):
        began_s = sum(os.times()[:4])
        found.tried += 1
        try:
            with _at_most(LONGEST_WAIT_S):
                line = attempt(np.random.default_rng([*seed, number]))
            if line is None:
                continue
            assert line.count("\n") == 0, f"several lines: {line[:400]!r}"
            assert len(line) <= LONGEST_LINE, f"{len(line)} characters: {line[:400]!r}"
        except Exception as error:
            found.wrong.append(f"seed {[*seed, number]}: {type(error).__name__}: {str(error)[:400]}")
            continue
        found.refused += 1
        found.longest = max(found.longest, len(line))
        found.slowest_s = max(found.slowest_s, sum(os.times()[:4]) - began_s)
    return found


@contextlib.contextmanager
def _at_most(seconds: float) -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"no answer within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
