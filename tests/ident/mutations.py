"""Damage done to files, the same for the same seed, and what became of it."""

import contextlib
import gzip
import io
import os
import re
import signal
import struct
import zipfile
from collections.abc import Callable, Iterator, Sequence
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


HUGE = (b"1e308", b"-1e308", b"9" * 400, b"1e999", b"18446744073709551616", b"4.9e-324", b"0x7f", b"1_000")
DOUBLES = tuple(struct.pack("<d", x) for x in (1e308, -1e308, np.nan, np.inf, 1e-320, 2.0**63))


def _numbers_replaced(
    content: bytes, rng: np.random.Generator, words: Sequence[bytes], share: float
) -> bytes:
    """Of a text its numbers, else eight bytes in a row."""
    if b"\x00" not in content[:4000]:
        pick = iter(rng.integers(len(words), size=content.count(b"\n") * 40 + 4000))
        lose = iter(rng.random(content.count(b"\n") * 40 + 4000))
        return re.sub(
            rb"\d+\.?\d*", lambda m: words[next(pick, 0)] if next(lose, 1) < share else m[0], content
        )
    data = bytearray(content)
    for _ in range(max(1, int(share * len(data) / 64))):
        at = int(rng.integers(max(1, len(data) - 8)))
        data[at : at + 8] = DOUBLES[int(rng.integers(len(DOUBLES)))]
    return bytes(data)


def _zipped(content: bytes, rng: np.random.Generator) -> bytes:
    for _ in range(int(rng.integers(1, 4))):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(str(rng.choice(["a.csv", "t_s.npy", "xl/workbook.xml", "../../a"])), content)
        content = stream.getvalue()
    return content


Damage = Callable[[np.random.Generator, bytes, bytes], bytes]
# Of a file, with the bytes of another one at hand.
DAMAGE: dict[str, Damage] = {
    "cut": lambda rng, one, other: one[: int(rng.integers(len(one) + 1))],
    "bytes changed": lambda rng, one, other: mutated(one, rng),
    "spliced": lambda rng, one, other: (
        one[: int(rng.integers(len(one)))] + other[int(rng.integers(len(other))) :]
    ),
    "of another kind": lambda rng, one, other: other,
    "in a zip": lambda rng, one, other: _zipped(one, rng),
    "packed again": lambda rng, one, other: gzip.compress(gzip.compress(one)),
    "empty": lambda rng, one, other: bytes(int(rng.integers(3))),
    "zeros": lambda rng, one, other: one[: int(rng.integers(len(one)))] + bytes(int(rng.integers(1, 5000))),
    "huge numbers": lambda rng, one, other: _numbers_replaced(one, rng, HUGE, float(rng.choice([0.01, 0.5]))),
    "a flood of NaN": lambda rng, one, other: _numbers_replaced(one, rng, (b"nan", b"NaN", b""), 0.9),
    "many times": lambda rng, one, other: one * int(rng.integers(2, 200)),
    "as UTF-16": lambda rng, one, other: b"\xff\xfe" + one.decode("latin-1").encode("utf-16-le")[: len(one)],
}
