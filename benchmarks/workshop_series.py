"""The sealed series of workshop cases of our own, counted together: each was diagnosed once, with the code of
its day (`flexlink blind --workshop`, first line of every file)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from benchmarks.harness import RESULTS, Print, main

# One line of a score table: what, and how many of how many; the baselines below it have tables of their own.
WHOLE = "verdict and set right, every case"
ROW = re.compile(r"^(\S.*?)\s{2,}\d+ % \[\d+, \d+\] \((\d+)/(\d+)\)", re.MULTILINE)
END = "baseline:"
# What machines without an effect were called, name and count each.
NONE, CALLED = re.compile(r"^  none: (.+)$", re.MULTILINE), re.compile(r"(\w+) (\d+)")
NAMED = "no effect, but one named"
# Series that are counted apart too: the latest.
RECENT = 4


def run(out: Print) -> None:
    texts = {
        path.stem.rpartition("_")[2]: path.read_text(encoding="utf-8").split(END)[0]
        for path in sorted(RESULTS.glob("blind_workshop_*.txt"))
    }
    whole = [
        f"{seed}: {some}/{of}"
        for seed, text in texts.items()
        for what, some, of in ROW.findall(text)
        if what == WHOLE
    ]
    out(f"{len(texts)} series, {WHOLE.partition(',')[0]}: {', '.join(whole)}")
    counted(out, "", list(texts.values()))
    counted(out, f"last {RECENT}: ", list(texts.values())[-RECENT:])


def counted(out: Print, before: str, texts: Sequence[str]) -> None:
    right, asked = Counter[str](), Counter[str]()
    for text in texts:
        for name, count in CALLED.findall("".join(NONE.findall(text))):
            right[NAMED] += int(count) if name not in ("none", "unknown") else 0
            asked[NAMED] += int(count)
        for what, some, of in ROW.findall(text):
            right[what] += int(some)
            asked[what] += int(of)
    for what, of in asked.items():
        out(f"{before + what:<44}{right[what]:>4}/{of:<4}{100 * right[what] / of:4.0f} %")


if __name__ == "__main__":
    main(run)
