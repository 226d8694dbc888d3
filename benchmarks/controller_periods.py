"""Logs that are slower than the controller that made them: are certified margins true on the machine?

    python -m benchmarks.controller_periods [--series 1] [--kinds belt,wheel] [--ways stated] [--keep DIR]

Machines of five kinds and their controllers come from the simulator of `benchmarks.closed_loop_machines`,
which shares no code with the product. A drive controls at its period and logs every 2nd, 4th or 5th row:

- stated 1, stated 2: `--controller-period` is given;
- found: every row is logged, nothing is typed;
- unknown: rows are left out, nothing is typed;
- averaged: the log holds the mean of the commands since the row before, nothing is typed;
- later: the position of a row was read half a step after its command, nothing is typed.

Violates (`benchmarks.closed_loop_machines.judge`): the loop of the certified controller, at its own rate,
with the true friction-free response is unstable, or has a margin or bandwidth that is worse by 1 % or more.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.closed_loop_machines.judge import read_law, violations
from benchmarks.closed_loop_machines.logs import Machine, machine
from benchmarks.closed_loop_machines.simulator import Array, Plant
from benchmarks.harness import Print, flexlink, main

KINDS = ("belt", "joint", "wheel", "slow", "fast")
WAYS = ("stated 1", "stated 2", "found", "unknown", "averaged", "later")
# A trace has so many rows for each period of the first mode; slower ones do not show the mode to anybody.
_ROWS_A_PERIOD = 12
_LONGEST_S = 900


@dataclass(frozen=True, eq=False)
class AtRate:
    """The friction-free plant as a controller sees it that runs every `rows` steps of the machine's own."""

    plant: Plant
    rows: int
    delay: int  # of the controller, in its own samples

    @property
    def dt_s(self) -> float:
        return self.plant.dt_s * self.rows

    def sampled(self, q_operating: float = 0.0) -> tuple[Array, Array, Array]:
        """A, B, C at the controller's samples, its command held in between."""
        a_step, b_step, c = self.plant.sampled(q_operating)
        a = np.eye(len(a_step))
        b = np.zeros_like(b_step)
        for _ in range(self.rows):
            a = a_step @ a
            b = a_step @ b + b_step
        for _ in range(self.delay):
            n = len(a)
            a = np.block([[a, b], [np.zeros((1, n + 1))]])
            b = np.eye(n + 1)[:, n:]
            c = np.append(c, [[0.0]], 1)
        return a, b, c


@dataclass(frozen=True, eq=False)
class Case:
    """One machine, how its drive logs, and what its user says."""

    machine: Machine
    way: str
    rows: int

    @property
    def name(self) -> str:
        return f"{self.machine.name} ({self.way}, every {self.rows}. row)"


def cases(series: int, kinds: Sequence[str], ways: Sequence[str]) -> list[Case]:
    """One machine for each kind and way: the first seed that is logged often enough to show its mode."""
    chosen = []
    for kind in kinds:
        for way in ways:
            number = WAYS.index(way)
            rng = np.random.default_rng([series, KINDS.index(kind), number])
            rows = 1 if way == "found" else int(rng.choice([2, 4, 5]))
            seed = 6 * 10 * number  # seeds that record the reference: mod 6 below 4
            while True:
                drawn = machine(kind, seed, 1000 + series)
                if drawn.kept and drawn.plant.dt_s * rows * drawn.draft.mode_hz * _ROWS_A_PERIOD < 1:
                    break
                seed += 1
            chosen.append(Case(drawn, way, rows))
    return chosen


def write(case: Case, folder: Path) -> list[Path]:
    """Logs of the case as its drive writes them, the last one for validation."""
    folder.mkdir(parents=True, exist_ok=True)
    time, reference, command, output = case.machine.draft.columns
    limit = case.machine.plant.limit
    rows = case.rows
    paths = []
    for log in range(len(case.machine.classes)):
        got, begin = case.machine.record(log, case.machine.rng(log))
        u = np.clip(got["u"], -limit, limit)
        digits = max(4 - int(np.floor(np.log10(np.std(u)))), 2)
        if case.way == "averaged":
            u = np.convolve(u, np.full(rows, 1 / rows))[: u.size]
        y = got["y"]
        if case.way == "later":
            y = np.append(y[rows // 2 :], np.full(rows // 2, y[-1]))
        at = np.arange(begin, u.size - rows, rows)
        clock = (at - begin) * case.machine.plant.dt_s
        table = {
            time: [f"{t * 1e3:.6g}" for t in clock] if time == "t_ms" else [f"{t:.6f}" for t in clock],
            reference: [f"{value:.6f}" for value in got["r"][at]],
            command: [f"{value:.{digits}f}" for value in u[at]],
            output: [f"{value:.6f}" for value in y[at]],
        }
        lines = [",".join(table), *map(",".join, zip(*table.values(), strict=True))]
        paths.append(folder / f"run{log + 1}.csv")
        paths[-1].write_text("\n".join(lines) + "\n")
    return paths


def judged(case: Case, folder: Path) -> dict[str, Any]:
    """What came out of `flexlink run`, and what its certificate says falsely."""
    from workflow.engine.run_directory import RunDirectory
    from workflow.tasks.results import RunResults

    logs = write(case, folder / "logs")
    stated = []
    if case.way.startswith("stated"):
        stated = ["--controller-period", f"{case.machine.plant.dt_s:.9g}"]
    words = "--out", str(folder / "run"), "--replace", "--json"
    code, text, lines = flexlink("run", *map(str, logs), *stated, *words, longest_s=_LONGEST_S)
    answer = json.loads(text) if text.lstrip().startswith("{") else {}
    row = {"code": code, "line": str(answer.get("verdict") or lines[-1]), "false": [], "timing": ""}
    row["certified"] = code == 0 and bool(answer.get("certified"))
    run = RunDirectory(folder / "run")
    if run.stage_file("records") is not None:
        timing = RunResults(run).records.timing
        row["timing"] = "" if timing is None else timing.source.value
    if row["certified"]:
        law, delay = read_law(folder / "run" / "controller.json")
        dt_s = float(json.loads((folder / "run" / "controller.json").read_text())["dt_s"])
        seen = AtRate(case.machine.plant, round(dt_s / case.machine.plant.dt_s), delay)
        certificate = json.loads((folder / "run" / "stages" / "certify.json").read_text())["result"]
        verdict = certificate["certificate"]["plants"][0]
        row["false"] = violations(seen, case.machine.draft.q_operating, law, verdict)  # type: ignore[arg-type]
        row["bandwidth_rad_s"] = verdict["bandwidth_rad_s"]
    return row


def run(
    out: Print,
    *,
    series: int = 1,
    kinds: str = ",".join(KINDS),
    ways: str = ",".join(WAYS),
    jobs: int = 2,
    keep: str = "",
) -> None:
    """A line a machine, and the counts."""
    every = cases(series, kinds.split(","), ways.split(","))
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(jobs) as pool:
        work = [Path(keep or scratch).absolute() / case.name.replace(" ", "_") for case in every]
        rows = []
        for case, row in zip(every, pool.map(judged, every, work), strict=True):
            rows.append(row)
            outcome = f"certified to {row['bandwidth_rad_s']:.3g} rad/s" if row["certified"] else row["line"]
            wrong = "".join(f"; VIOLATED {line}" for line in row["false"])
            out(f"{case.name}: {row['timing'] or 'no records'}, {outcome}{wrong}")
    certified = sum(row["certified"] for row in rows)
    out(f"{len(rows)} machines: {certified} certified, {sum(bool(row['false']) for row in rows)} violated")


if __name__ == "__main__":
    main(run, seeds="series {series}")
