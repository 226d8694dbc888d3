"""Time and memory over the size of what is given: one command in a process of its own for each size.

Identification: one log of white-noise voltage through a lag and a light mode, order given; then several logs
of one length. Study: points of the fast arm of the tests, order 1, one start on coarse grids, without the
bound over all controllers, so that 500 take minutes. Diagnosis: cases without a gap, of four records of 240
samples, and one of six long records; controllers are not compared. CPU seconds of all its processes, and the
largest memory that one of them ever had. A size of 0 is left out.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import scipy.signal

from benchmarks.harness import Print, main
from tests.workflow.diagnosis_examples import write_case
from tests.workflow.study_examples import TWO_POINTS

DT_S = 0.005
CHEAP_POINTS = TWO_POINTS.replace(
    "[changes]",
    """[changes]
"specification.controller_order" = 1
"synthesis.starts" = 1
"synthesis.dense_points" = 500
"synthesis.grid_points" = 30
"certificate.joint_draws" = 0""",
)


def write_log(path: Path, samples: int, seed: int) -> Path:
    rng = np.random.default_rng(seed)
    voltage = rng.standard_normal(samples)
    mode = np.exp((-0.6 + 11.9j) * DT_S)
    lag = scipy.signal.lfilter([0.0, 0.1], [1.0, -0.9], voltage)
    swing = scipy.signal.lfilter([0.0, 0.01], np.poly([mode, mode.conj()]).real, voltage)
    angle = lag + swing + 0.01 * rng.standard_normal(samples)
    np.savez(path, t_s=DT_S * np.arange(samples), u_V=voltage, y_rad=angle)
    return path


def used_by(*arguments: object) -> tuple[float, float]:
    """CPU seconds and MiB of a command and its processes, seen every tenth of a second: nobody waits for
    those of a fork server."""
    command = [sys.executable, "-m", "workflow", *map(str, arguments), "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    cpu_s = 0.0
    mib = 0.0
    while process.poll() is None:
        processes = list(of_session(process.pid))
        cpu_s = max(cpu_s, sum(seconds for seconds, _ in processes))
        mib = max([mib, *(largest for _, largest in processes)])
        time.sleep(0.1)
    if process.returncode:
        raise RuntimeError(f"{arguments[0]} ended with {process.returncode}")
    return cpu_s, mib


def of_session(leader: int) -> Iterator[tuple[float, float]]:
    """CPU seconds and largest MiB of each process of a session, with those of the dead it waited for."""
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            # After the name, which may hold blanks: state, parent, group, session, ...
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == leader and fields[0] != "Z":
                peak = (entry / "status").read_text().partition("VmHWM:")[2].split()[0]
                yield sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK"), float(peak) / 1024


def told(out: Print, what: str, size: int, used: tuple[float, float]) -> None:
    seconds, mib = used
    out(f"{what:<40}{size:>10}{seconds:>10.1f}{mib:>10.0f}{1e3 * seconds / size:>14.4g}")


def run(
    out: Print,
    *,
    samples: tuple[int, ...] = (10_000, 100_000, 1_000_000, 10_000_000),
    records: tuple[int, ...] = (1, 5, 50),
    record_samples: int = 20_000,
    points: tuple[int, ...] = (2, 20, 100, 500),
    cases: tuple[int, ...] = (1, 10, 100),
    case_samples: tuple[int, ...] = (600, 6_000, 60_000),
) -> None:
    out(f"{'':40}{'size':>10}{'CPU s':>10}{'MiB':>10}{'CPU ms each':>14}")
    roles = ("--input", "u_V", "--output", "y_rad", "--time", "t_s", "--real", 1, "--pairs", 1, "--delay", 0)
    with tempfile.TemporaryDirectory(prefix="flexlink-") as name:
        folder = Path(name)
        if any(samples) or any(records):
            used_by("identify", write_log(folder / "first.npz", 5000, 0), *roles)  # compiles
        for size in filter(None, samples):
            log = write_log(folder / "log.npz", size, 1)
            told(out, "identification, samples of one record", size, used_by("identify", log, *roles))
        logs = [write_log(folder / f"{k}.npz", record_samples, k) for k in range(max(records, default=0))]
        for size in filter(None, records):
            used = used_by("identify", *logs[:size], *roles)
            told(out, f"identification, records of {record_samples}", size, used)
        for size in filter(None, points):
            values = np.linspace(1.0, 1.5, size).round(4).tolist()
            (folder / "study.toml").write_text(CHEAP_POINTS.replace("[1.0, 1.5]", str(values)))
            call = ("study", "--config", folder / "study.toml", "--out", folder / f"study{size}", "--jobs", 1)
            told(out, "study, points", size, used_by(*call))
        places = [write_case(folder / f"case{k}", seed=k) for k in range(max(cases, default=0))]
        for size in filter(None, cases):
            options = ("--out", folder / f"out{size}", "--no-controller", "--jobs", 1)
            told(out, "diagnosis, cases", size, used_by("diagnose", *places[:size], *options))
        for size in filter(None, case_samples):
            place = write_case(folder / f"long{size}", records=6, samples=size)
            options = ("--out", folder / f"outlong{size}", "--no-controller", "--jobs", 1)
            told(out, "diagnosis, samples of each of 6 records", size, used_by("diagnose", place, *options))


if __name__ == "__main__":
    main(run, seeds="0 to 99")
