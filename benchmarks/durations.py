"""Where the time of the tests goes: by room, and the slowest, of a run of pytest that has ended.

    make test-all && python -m benchmarks.durations
    make test-long && python -m benchmarks.durations --junit build/long.xml --name long_tests

Seconds are CPU seconds of a test, its fixtures and the processes it started, as tests/conftest.py notes
them: other work on the machine changes them little. They are compared within one machine only. Across
machines stands how often the reference computation, which every run of the tests times too, fits into all.
"""

from __future__ import annotations

import collections
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness import Print, main

REFERENCE = "test_reference_computation"


@dataclass(frozen=True)
class Timed:
    """One test that has run."""

    file: str
    name: str
    cpu_s: float
    outcome: str

    @property
    def room(self) -> str:
        """Folder below tests."""
        parts = self.file.split(".")
        return parts[1] if len(parts) > 2 else "(front door)"


def read(junit: Path) -> tuple[str, list[Timed]]:
    """The machine, and tests in the order in which they ended.

    Raises
    ------
    ValueError
        No such file, none of a test run, or one that notes no CPU times.
    """
    try:
        suite = ET.parse(junit).getroot().find("testsuite")
    except (OSError, ET.ParseError) as error:
        raise ValueError(f"{junit}: {error}; `make test` writes one") from None
    cases = [] if suite is None else suite.findall("testcase")
    if suite is None or not cases:
        raise ValueError(f"{junit} holds no tests; `make test` writes one that does")
    found = []
    for case in cases:
        cpu = case.find("properties/property[@name='cpu_s']")
        if cpu is None:
            raise ValueError(f"{junit}: no CPU time of {case.get('name')}; run the tests as `make test` does")
        outcome = next(
            (kind for kind in ("failure", "error", "skipped") if case.find(kind) is not None), "passed"
        )
        found.append(
            Timed(case.get("classname", ""), case.get("name", ""), float(cpu.get("value", "nan")), outcome)
        )
    return suite.get("hostname", "unknown"), found


def by_room(tests: list[Timed]) -> list[str]:
    """A line a room: tests, CPU seconds, share; and the whole."""
    rooms: dict[str, list[Timed]] = collections.defaultdict(list)
    for one in tests:
        rooms[one.room].append(one)
    whole = sum(one.cpu_s for one in tests)
    rows = sorted(((sum(t.cpu_s for t in of), room, len(of)) for room, of in rooms.items()), reverse=True)
    rows.append((whole, "all", len(tests)))
    return ["room                tests     CPU s   share"] + [
        f"{room:<18}{n:>7}{cpu:>10.0f}{100 * cpu / max(whole, 1e-9):>7.0f}%" for cpu, room, n in rows
    ]


def run(out: Print, *, junit: str = "build/tests.xml", against: str = "", most: int = 100) -> None:
    try:
        machine, tests = read(Path(junit))
        before = read(Path(against)) if against else (machine, [])
    except ValueError as error:
        sys.exit(str(error))
    if before[0] != machine:
        sys.exit(f"{against} is of another machine ({before[0]}, not {machine}); run both tests on one")
    kinds = collections.Counter(one.outcome for one in tests)
    out(", ".join(f"{number} {kind}" for kind, number in kinds.most_common()))
    for told, of in (("before", before[1]), ("", tests)):
        for line in by_room(of) if of else ():
            out(f"{told:<8}{line}" if against else line)
    whole = sum(one.cpu_s for one in tests)
    for one in (one for one in tests if one.name == REFERENCE):
        out(f"reference computation: {one.cpu_s:.2f} s, in all tests {whole / one.cpu_s:.0f} times")
    out()
    out(f"the slowest {most}")
    for one in sorted(tests, key=lambda test: -test.cpu_s)[:most]:
        out(f"{one.cpu_s:8.2f}  {one.outcome:<8} {one.file.replace('.', '/')}.py::{one.name}")


if __name__ == "__main__":
    main(run)
