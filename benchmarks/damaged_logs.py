"""5 040 damaged logs of all formats, by `look` and `identify` as a user calls them: each is read, or refused
in one line of at most 300 characters that names the file, within 60 s; no internal error, no crash.

The damage is done by the loops of the tests: cut, bytes changed, two files spliced, another format under the
name, zip archives in each other, zeros, numbers of any size, NaN. What computes is cut off where it begins.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from benchmarks.harness import Print, main
from tests.ident.mutations import DAMAGE
from tests.workflow.test_nothing_breaks_it import cut_computations_off, damaged_logs


def run(out: Print, *, each: int = 420, binary: float = 0.4) -> None:
    out(f"{'damage':<20}{'tried':>7}{'refused':>9}{'wrong':>7}   longest line   slowest refusal, CPU s")
    tried = wrong = 0
    with tempfile.TemporaryDirectory(prefix="flexlink-") as folder, pytest.MonkeyPatch.context() as patch:
        cut_computations_off(patch)
        for damage in DAMAGE:
            found = damaged_logs(damage, Path(folder), each, binary=binary)
            counts = f"{found.tried:7d}{found.refused:9d}{len(found.wrong):7d}"
            out(f"{damage:<20}{counts}{found.longest:15d}{found.slowest_s:25.2f}")
            for line in found.wrong:
                out(f"    {line}")
            tried, wrong = tried + found.tried, wrong + len(found.wrong)
    out(f"{'all':<20}{tried:7d}{'':9}{wrong:7d}")


if __name__ == "__main__":
    main(run, seeds="of the tests")
