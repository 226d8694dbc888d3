"""Kills and interrupts at random moments of `run`, `study` and `diagnose`: what is resumed
ends with the same bytes.

A chain is one command stopped several times at random moments and continued each time, then left to finish.
After a kill of the command, alone or with all its processes, it is called again with --resume; a kill of one
of its processes it has to get over itself; after an interrupt, of the command or of all processes as a
terminal does it, it is called again as the line on standard error says. Moments are drawn in CPU seconds of
the command and its processes, so that they fall everywhere however busy the machine is. Checked each time:
exit code, the line, how long the end took, no process left; at the end: the same files with the same bytes as
undisturbed, and no others.
"""

from __future__ import annotations

import dataclasses
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.harness import Print, main
from tests.workflow.command import FAST_ARM, ROOT, without_progress
from tests.workflow.diagnosis_examples import FRICTION, write_case
from tests.workflow.study_examples import TWO_POINTS

LONGEST_END_S = 2.0
# Python has not reached our code yet: the signal ends it without a line (docs/limits.md).
_BEFORE_US_S = 0.15
# They name times and processes.
_DIFFERS = ("manifest.json", "timings.json", "lock")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Way(NamedTuple):
    """Of stopping: which signal, and what it reaches: "command", "all" of its processes, or "one" of them."""

    number: signal.Signals
    reach: str

    def __str__(self) -> str:
        return f"{self.number.name}, {self.reach}"


KILLS = tuple(Way(signal.SIGKILL, reach) for reach in ("command", "all", "one"))
INTERRUPTS = tuple(
    Way(number, reach)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    for reach in ("command", "all")
)


class Stop(NamedTuple):
    """A way, after how many CPU seconds, and which one of the processes, from 0 to 1."""

    way: Way
    moment_s: float
    which: float


@dataclass
class Found:
    """What became of the stops of one way."""

    stops: int = 0
    past_the_end: int = 0
    silent: int = 0
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
        # A shell that runs this in the background told it to ignore interrupts, nohup to ignore the end of
        # the terminal; commands inherit that.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
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

    def signal(self, way: Way, which: float) -> None:
        """Send it; to `which`, from 0 to 1, of the other processes where it is for one of them."""
        others = sorted({int(fields[-1]) for fields in self._session()} - {self.process.pid})
        if way.reach == "all":
            os.killpg(self.process.pid, way.number)
        elif way.reach == "command":
            os.kill(self.process.pid, way.number)
        elif others:
            with suppress(ProcessLookupError):
                os.kill(others[int(which * len(others))], way.number)

    def watched(self, every_s: float) -> tuple[float, float]:
        """CPU seconds and the largest MiB seen until the end. Raises RuntimeError where it ends with another
        code than 0."""
        cpu_s, mib = 0.0, 0.0
        while self.process.poll() is None:
            cpu_s, mib = max(cpu_s, self.cpu_s()), max(mib, self.largest_mib())
            time.sleep(every_s)
        code, error = self.ended()
        if code != 0:
            raise RuntimeError(f"{self.process.args[3]} ended with {code}: {error[-300:]}")
        return cpu_s, mib

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
    spent_s, _ = Command([*call, "--out", str(out)]).watched(0.05)
    return contents(out), spent_s


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
    stops: Sequence[Stop],
    found: Mapping[Way, Found],
) -> None:
    """One command stopped so, then finished and compared."""
    first = [*call, "--out", str(out)]
    coming, command = first, Command(first)
    for way, moment_s, which in stops:
        at, here = f"{call[0]} {way} at {moment_s:.2f} s", found[way]
        if not command.wait_for_cpu(command.cpu_s() + moment_s):
            here.past_the_end += 1
            break
        here.stops += 1
        before_s, sent_s = command.cpu_s(), time.monotonic()
        command.signal(way, which)
        if way.reach == "one":
            continue
        after_s = before_s
        while command.process.poll() is None:
            after_s = max(after_s, command.cpu_s())
            time.sleep(0.01)
        here.wall_s.append(time.monotonic() - sent_s)
        here.cpu_s.append(after_s - before_s)
        code, error = command.ended()
        if left := command.left(10.0):
            here.bad.append(f"{at}: {left} processes left")
        if here.cpu_s[-1] > LONGEST_END_S:
            here.bad.append(f"{at}: {here.cpu_s[-1]:.1f} s of CPU until the end")
        if code == 0:  # all was done
            here.past_the_end += 1
            coming = [*first, "--resume"]
        elif way.number == signal.SIGKILL:
            coming = [*first, "--resume"]
        elif code == -way.number and moment_s < _BEFORE_US_S:
            here.silent += 1
        else:
            coming, complaint = _continued(code, error, way.number, first, out)
            if complaint:
                here.bad.append(f"{at}: {complaint}")
        command = Command(coming)
    code, error = command.ended()
    last = found[stops[-1].way]
    told = f"{call[0]} after " + "; ".join(f"{way} at {moment_s:.2f} s" for way, moment_s, _ in stops)
    if code != 0:
        last.bad.append(f"{told}: exit {code}: {error.strip()[-300:]}")
    if left := command.left(10.0):
        last.bad.append(f"{told}: {left} processes left")
    files = contents(out)
    differ = [name for name in sorted(whole.keys() | files.keys()) if whole.get(name) != files.get(name)]
    if differ:
        last.bad.append(
            f"{told}: {len(differ)} files missing, left over or different: {', '.join(differ[:5])}"
        )


def _continued(code: int, error: str, number: int, first: Sequence[str], out: Path) -> tuple[list[str], str]:
    """What the user is told to call, and what is wrong with what was said."""
    if code != 128 + number or error.count("\n") != 1:
        return [*first, "--resume"], f"exit {code}: {error.strip()[-2000:]!r}"
    if not out.exists() and error == "flexlink: interrupted\n":
        return list(first), ""
    wanted = f"flexlink: interrupted; {shlex.join(['flexlink', *first, '--resume'])} continues\n"
    return [*first, "--resume"], "" if error == wanted else f"said {error.strip()!r}"


def random_stops(
    rng: np.random.Generator, ways: Sequence[Way], begin: int, count: int, whole_s: float
) -> list[Stop]:
    """The ways by turns from this one on; moments up to half of what the whole takes, so that a chain gets
    on."""
    return [
        Stop(ways[(begin + k) % len(ways)], float(rng.uniform(0, 0.5 * whole_s)), float(rng.random()))
        for k in range(count)
    ]


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
        for name, (files, cpu_s) in whole.items():
            out(f"{name}: {len(files)} files compared, {cpu_s:.1f} s of CPU undisturbed")
        out(f"{'':28}{'':>8}{'before':>8}{'after':>7}{'went':>7}{'until it has ended: CPU s':>28}   wall s")
        heads = f"{'stopped':>8}{'a word':>8}{'all':>7}{'wrong':>7}{'largest':>28}"
        out(f"{'':28}{heads}   median, largest, above {LONGEST_END_S:g}")
        total = Found()
        for ways, wanted in ((KILLS, kills), (INTERRUPTS, interrupts)):
            if not wanted:
                continue
            for (name, call), count in zip(known.items(), _shares(wanted, len(known)), strict=True):
                able = [way for way in ways if way.reach != "one" or name != "run"]  # which has but itself
                place = folder / f"{name}-{able[0].number.name}"
                for way, found in stopped(out, call, place, whole[name], able, count, stops, seed).items():
                    told(out, f"{name}, {way}", found)
                    for each in dataclasses.fields(Found):
                        setattr(total, each.name, getattr(total, each.name) + getattr(found, each.name))
        told(out, "all", total)


def told(out: Print, what: str, found: Found) -> None:
    counts = f"{found.stops:8d}{found.silent:8d}{found.past_the_end:7d}{len(found.bad):7d}"
    wall = found.wall_s
    late = sum(seconds > LONGEST_END_S for seconds in wall)
    times = f"{max(found.cpu_s):28.2f}   {np.median(wall):.2f}, {max(wall):.2f}, {late}" if wall else ""
    out(f"{what:<28}{counts}{times}")


def _shares(total: int, parts: int) -> list[int]:
    return [total * (k + 1) // parts - total * k // parts for k in range(parts)]


def stopped(
    out: Print,
    call: Sequence[str],
    place: Path,
    whole: tuple[dict[str, bytes], float],
    ways: Sequence[Way],
    count: int,
    longest: int,
    seed: int,
) -> dict[Way, Found]:
    """Chains until so many stops were made; what went wrong is told after each."""
    found = {way: Found() for way in ways}
    files, cpu_s = whole
    for number in range(10 * count):
        made = sum(one.stops for one in found.values())
        if made >= count:
            break
        rng = np.random.default_rng([seed, number, len(ways)])
        stops = random_stops(rng, ways, made, min(longest, count - made), cpu_s)
        told_before = {way: len(one.bad) for way, one in found.items()}
        chain(call, place.with_name(f"{place.name}-{number}"), files, stops, found)
        for way, one in found.items():
            for line in one.bad[told_before[way] :]:
                out(line)
    return found


if __name__ == "__main__":
    main(run)
