"""Kills and interrupts at random moments of `run`, `study` and `diagnose`: what is resumed
ends with the same bytes.

A chain is one command stopped several times at random moments and continued each time, then left to finish.
After a kill (SIGKILL, by turns of the command alone and of all its processes) it is called again with
--resume; after an interrupt (SIGINT and SIGHUP reach all processes of a terminal, SIGTERM the command) as the
line on standard error says. Moments are drawn in CPU seconds of the command and its processes, so that they
fall everywhere however busy the machine is. Checked each time: exit code, the line, how long the end took, no
process left; at the end: the same files with the same bytes as undisturbed, and no others.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, main
from tests.workflow.command import FAST_ARM, ROOT, without_progress
from tests.workflow.diagnosis_examples import FRICTION, write_case
from tests.workflow.study_examples import TWO_POINTS

LONGEST_END_S = 2.0
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# They name times and processes.
_DIFFERS = ("manifest.json", "timings.json", "lock")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass
class Found:
    """What became of the stops of one kind."""

    stops: int = 0
    past_the_end: int = 0
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)


def calls(folder: Path) -> dict[str, list[str]]:
    """The smallest command of each kind that passes all its stages; --out is to be added."""
    (folder / "study.toml").write_text(TWO_POINTS)
    write_case(folder / "case", FRICTION)
    return {
        "run": ["run", "--config", str(FAST_ARM)],
        "study": ["study", "--config", str(folder / "study.toml"), "--jobs", "2"],
        "diagnose": ["diagnose", str(folder / "case")],
    }


class Command:
    """`flexlink` in a session of its own, and the CPU time of all its processes."""

    def __init__(self, arguments: Sequence[str]) -> None:
        # A shell that runs this in the background told it to ignore interrupts, which commands inherit.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "workflow", *arguments],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def cpu_s(self) -> float:
        """Of the living, and of the dead that have been waited for."""
        return sum(sum(map(int, fields[11:15])) for fields in self._session()) / _TICKS_PER_S

    def largest_mib(self) -> float:
        """The most memory that one of the living ever had."""
        peaks = [0.0]
        for fields in self._session():
            with suppress(OSError, IndexError):
                status = Path(f"/proc/{fields[-1]}/status").read_text()
                peaks.append(float(status.partition("VmHWM:")[2].split()[0]) / 1024)
        return max(peaks)

    def _session(self) -> Iterator[list[str]]:
        for entry in Path("/proc").iterdir():
            with suppress(OSError):
                if entry.name.isdigit():
                    # After the name, which may hold blanks: state, parent, group, session, ...
                    fields = (entry / "stat").read_text().rpartition(")")[2].split()
                    if int(fields[3]) == self.process.pid and fields[0] != "Z":
                        yield [*fields, entry.name]

    def left(self, seconds: float) -> int:
        """How many of its processes are there still after at most so long."""
        deadline = time.monotonic() + seconds
        while (count := len(list(self._session()))) and time.monotonic() < deadline:
            time.sleep(0.05)
        return count

    def wait_for_cpu(self, seconds: float) -> bool:
        """Whether it is there still when it has used so much."""
        while self.process.poll() is None and self.cpu_s() < seconds:
            time.sleep(0.02)
        return self.process.poll() is None

    def signal(self, number: int, *, all_of_them: bool) -> None:
        (os.killpg if all_of_them else os.kill)(self.process.pid, number)

    def ended(self, seconds: float = 1800.0) -> tuple[int, str]:
        """Exit code and standard error without lines of progress."""
        try:
            _, error = self.process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            raise
        return self.process.returncode, without_progress(error.decode())


def undisturbed(call: Sequence[str], out: Path) -> tuple[dict[str, bytes], float]:
    """The files, and the CPU seconds it took."""
    command = Command([*call, "--out", str(out)])
    spent = 0.0
    while command.process.poll() is None:
        spent = max(spent, command.cpu_s())
        time.sleep(0.05)
    code, error = command.ended()
    if code != 0:
        raise RuntimeError(f"{call[0]} ended with {code}: {error}")
    return contents(out), spent


def contents(folder: Path) -> dict[str, bytes]:
    """All files but those that name times."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in _DIFFERS
    }


def chain(
    call: Sequence[str],
    out: Path,
    whole: dict[str, bytes],
    stops: Sequence[tuple[int, float]],
    found: Found,
) -> None:
    """One command stopped by these signals at these CPU seconds, then finished and compared."""
    first = [*call, "--out", str(out)]
    coming = first
    for number, moment_s in stops:
        at = f"{shlex.join(call[:1])} {signal.Signals(number).name} at {moment_s:.2f} s"
        command = Command(coming)
        if not command.wait_for_cpu(moment_s):
            found.past_the_end += 1
            command.ended()
            break
        found.stops += 1
        before_s, sent_s = command.cpu_s(), time.monotonic()
        everybody = number in (signal.SIGINT, signal.SIGHUP) or (
            number == signal.SIGKILL and found.stops % 2 == 0
        )
        command.signal(number, all_of_them=everybody)
        after_s = before_s
        while command.process.poll() is None:
            after_s = max(after_s, command.cpu_s())
            time.sleep(0.01)
        found.wall_s.append(time.monotonic() - sent_s)
        found.cpu_s.append(after_s - before_s)
        code, error = command.ended()
        if code == 0:  # all was done
            found.past_the_end += 1
        if left := command.left(10.0):
            found.bad.append(f"{at}: {left} processes left")
        if number == signal.SIGKILL or code == 0:
            coming = [*first, "--resume"]
            continue
        coming, complaint = _continued(code, error, number, first, out)
        if complaint:
            found.bad.append(f"{at}: {complaint}")
        if found.cpu_s[-1] > LONGEST_END_S:
            found.bad.append(f"{at}: {found.cpu_s[-1]:.1f} s of CPU until the end")
    code, error = Command(coming).ended()
    if code != 0:
        found.bad.append(f"{call[0]} resumed after {stops}: exit {code}: {error.strip()[-300:]}")
    files = contents(out)
    for name in sorted(whole.keys() | files.keys()):
        if whole.get(name) != files.get(name):
            what = "missing" if name not in files else "left over" if name not in whole else "differs"
            found.bad.append(f"{call[0]} resumed after {stops}: {name} {what}")


def _continued(code: int, error: str, number: int, first: Sequence[str], out: Path) -> tuple[list[str], str]:
    """What the user is told to call, and what is wrong with what was said."""
    if code != 128 + number or error.count("\n") != 1:
        return [*first, "--resume"], f"exit {code}: {error.strip()[-400:]!r}"
    if not out.exists() and error == "flexlink: interrupted\n":
        return list(first), ""
    wanted = f"flexlink: interrupted; {shlex.join(['flexlink', *first, '--resume'])} continues\n"
    return [*first, "--resume"], "" if error == wanted else f"said {error.strip()!r}"


def random_stops(
    rng: np.random.Generator, kinds: Sequence[int], count: int, whole_s: float
) -> list[tuple[int, float]]:
    """Random signals; moments up to half of what the whole takes, so that a chain gets on."""
    return [(int(rng.choice(kinds)), float(rng.uniform(0, 0.5 * whole_s))) for _ in range(count)]


def run(
    out: Print,
    *,
    kills: int = 100,
    interrupts: int = 100,
    stops: int = 8,
    seed: int = 0,
    commands: tuple[str, ...] = ("run", "study", "diagnose"),
) -> None:
    with tempfile.TemporaryDirectory(prefix="flexlink-") as name:
        folder = Path(name)
        known = {name: call for name, call in calls(folder).items() if name in commands}
        whole = {name: undisturbed(call, folder / f"{name}-whole") for name, call in known.items()}
        out(
            f"{'':22}{'stopped':>8}{'too late':>10}{'went wrong':>12}"
            "   seconds until the end: largest wall, largest CPU, median wall"
        )
        bad: list[str] = []
        for what, kinds, wanted in (
            ("killed", [signal.SIGKILL], kills),
            ("interrupted", list(_INTERRUPTS), interrupts),
        ):
            each = _shares(wanted, len(known))
            for (name, call), count in zip(known.items(), each, strict=True):
                found = _stopped(call, folder / f"{name}-{what}", whole[name], kinds, count, stops, seed)
                times = (
                    ""
                    if not found.wall_s
                    else (
                        f"{max(found.wall_s):10.2f} {max(found.cpu_s):10.2f} {np.median(found.wall_s):10.2f}"
                    )
                )
                counts = f"{found.stops:8d}{found.past_the_end:10d}{len(found.bad):12d}"
                out(f"{name:<9} {what:<12}{counts}   {times}")
                bad += found.bad
        for line in bad:
            out(line)


def _shares(total: int, parts: int) -> list[int]:
    return [total * (k + 1) // parts - total * k // parts for k in range(parts)]


def _stopped(
    call: Sequence[str],
    place: Path,
    whole: tuple[dict[str, bytes], float],
    kinds: Sequence[int],
    count: int,
    longest: int,
    seed: int,
) -> Found:
    """Chains until so many stops were made."""
    found, number = Found(), 0
    while found.stops < count and number < 10 * count:
        rng = np.random.default_rng([seed, number, len(kinds)])
        files, cpu_s = whole
        stops = random_stops(rng, kinds, min(longest, count - found.stops), cpu_s)
        chain(call, place.with_name(f"{place.name}-{number}"), files, stops, found)
        number += 1
    return found


if __name__ == "__main__":
    main(run)
