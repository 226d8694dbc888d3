"""The sealed series of workshop cases of our own, counted together: each was diagnosed once, with the code of
its day (`flexlink blind --workshop`). The last ones are whole files, the earlier ones lines of one table."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

from benchmarks.harness import RESULTS, Print, main

Counts = dict[str, tuple[int, int]]
"""By what is counted: right, and asked."""

# One line of a score table: what, and how many of how many; the baselines below it have tables of their own.
WHOLE = "verdict and set right, every case"
ROW = re.compile(r"^(\S.*?)\s{2,}\d+ % \[\d+, \d+\] \((\d+)/(\d+)\)", re.MULTILINE)
END = "baseline:"
# What machines without an effect were called, name and count each; pairs called so stand further down.
NONE, CALLED = re.compile(r"^  none: (.+)$", re.MULTILINE), re.compile(r"(\w+) (\d+)")
NAMED = "no effect, but one named"
# Series that are counted apart too: the latest.
RECENT = 4


def run(out: Print) -> None:
    series = all_series()
    whole = ", ".join("{}: {}/{}".format(seed, *score[WHOLE]) for seed, score in series.items())
    out(f"{len(series)} series, {WHOLE.partition(',')[0]}: {whole}")
    for before, some in (("", series), (f"last {RECENT}: ", dict(list(series.items())[-RECENT:]))):
        for what, (right, asked) in together(some.values()).items():
            out(f"{before + what:<44}{right:>4}/{asked:<4}{100 * right / asked:4.0f} %")


def all_series() -> dict[str, Counts]:
    """Counts of every series by its seed, the earliest first."""
    earlier = (RESULTS / "workshop_series_earlier.txt").read_text(encoding="utf-8").splitlines()
    names = [line[4:] for line in earlier if line.startswith("#   ")]
    rows = {}
    for seed, _commit, _date, *cells in (line.split() for line in earlier if not line.startswith("#")):
        pairs = (tuple(map(int, cell.split("/"))) for cell in cells)
        rows[seed] = {name: (right, asked) for name, (right, asked) in zip(names, pairs, strict=True)}
    for path in sorted(RESULTS.glob("blind_workshop_*.txt")):
        rows[path.stem.rpartition("_")[2]] = counts(path.read_text(encoding="utf-8").partition(END)[0])
    return rows


def counts(text: str) -> Counts:
    """What one results file of `flexlink blind` counts."""
    called = [(name, int(count)) for name, count in CALLED.findall("".join(NONE.findall(text)[:1]))]
    named = sum(count for name, count in called if name not in ("none", "unknown"))
    rows = {what: (int(right), int(asked)) for what, right, asked in ROW.findall(text)}
    return {NAMED: (named, sum(count for _, count in called))} | rows


def together(series: Iterable[Counts]) -> Counts:
    """The sums over several series."""
    right = Counter[str]()
    asked = Counter[str]()
    for found in series:
        for what, (some, of) in found.items():
            right[what] += some
            asked[what] += of
    return {what: (right[what], of) for what, of in asked.items()}


if __name__ == "__main__":
    main(run)
