"""The sealed series of workshop cases of our own, counted together: each was diagnosed once, with the code of
its day (`flexlink blind --workshop`, first line of every file)."""

from __future__ import annotations

import re
from collections import Counter

from benchmarks.harness import RESULTS, Print, main

# One line of a score table: what, and how many of how many; the baselines below it have tables of their own.
WHOLE = "verdict and set right, every case"
ROW = re.compile(r"^(\S.*?)\s{2,}\d+ % \[\d+, \d+\] \((\d+)/(\d+)\)", re.MULTILINE)
END = "baseline:"
# What machines without an effect were called, name and count each.
NONE, CALLED = re.compile(r"^  none: (.+)$", re.MULTILINE), re.compile(r"(\w+) (\d+)")
NAMED = "no effect, but one named"


def run(out: Print) -> None:
    right, asked, series = Counter[str](), Counter[str](), []
    for path in sorted(RESULTS.glob("blind_workshop_*.txt")):
        text = path.read_text(encoding="utf-8").split(END)[0]
        for name, count in CALLED.findall("".join(NONE.findall(text))):
            right[NAMED] += int(count) if name not in ("none", "unknown") else 0
            asked[NAMED] += int(count)
        for what, some, of in ROW.findall(text):
            right[what] += int(some)
            asked[what] += int(of)
            if what == WHOLE:
                series.append(f"{path.stem.rpartition('_')[2]}: {some}/{of}")
    out(f"{len(series)} series, {WHOLE.partition(',')[0]}: {', '.join(series)}")
    for what, of in asked.items():
        out(f"{what:<36}{right[what]:>4}/{of:<4}{100 * right[what] / of:4.0f} %")


if __name__ == "__main__":
    main(run)
