"""CPU seconds of `flexlink run` by stage: where the time of a run goes.

    OMP_NUM_THREADS=1 python -m benchmarks.run_profile [--machines DIR] [--only KIND KIND] [--rounds 3]

Kinds: the default arm (`flexlink run`), the logs of two machines of DIR (`flexlink run LOG...`), and the
second of them again with another bandwidth (`flexlink run --from RUN --bandwidth 9`). Every kind runs once to
fill the cache of compiled code, then `rounds` times in a process of its own; of the times of a stage, and of
the total, the medians are told. `imports` is loading the program, `rest` what is between and after stages:
reading the command, the first look at logs, what is said at the end. Times are user and system seconds of the
process and its children, and are comparable on one machine, equally busy, only.
"""

from __future__ import annotations

import contextlib
import io
import json
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import Print, main

# The bandwidth that the resumed run asks for, rad/s: below what the machine's own run reaches.
_BANDWIDTH_RAD_S = 9


def cpu_s() -> float:
    """User and system seconds of this process, and of its children that ended, so far."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def profile_of(words: list[str]) -> dict[str, float]:
    """CPU seconds by stage of one command in this process, which must be fresh; "exit" is its exit code.

    A stage that was taken over takes no time of its own and is not told; one that was made twice, for a draft
    of the configuration first, is told with both times.
    """
    import workflow.__main__
    import workflow.cli
    import workflow.commands.run
    import workflow.report.pages
    import workflow.tasks.pipeline
    from workflow.engine.run_directory import RunDirectory
    from workflow.tasks import pipeline

    times_s = {"imports": cpu_s()}
    perform = pipeline._perform
    record_stage = RunDirectory.record_stage

    def timed(stage, *given, **named):  # type: ignore[no-untyped-def]
        begun_s = cpu_s()
        made: list[str] = []

        def noted(run, name, seconds, input_hash):  # type: ignore[no-untyped-def]
            made.append(name)
            record_stage(run, name, seconds, input_hash)

        RunDirectory.record_stage = noted  # type: ignore[method-assign]
        perform(stage, *given, **named)
        if made:
            times_s[stage.name] = times_s.get(stage.name, 0.0) + cpu_s() - begun_s

    pipeline._perform = timed
    sys.argv = ["flexlink", *words]
    with contextlib.redirect_stdout(io.StringIO()):
        code = workflow.__main__.main()
    total_s = cpu_s()
    return {**times_s, "rest": total_s - sum(times_s.values()), "total": total_s, "exit": float(code)}


def measured(words: list[str], rounds: int) -> dict[str, float]:
    """Median CPU seconds by stage of a command over so many fresh processes, after one that is not counted.

    Raises CalledProcessError where a process fails other than by the exit code of flexlink.
    """
    child = "import json, sys; from benchmarks.run_profile import profile_of as p; "
    child += "print(json.dumps(p(sys.argv[1:])))"
    profiles: list[dict[str, float]] = []
    for _ in range(rounds + 1):
        command = [sys.executable, "-c", child, *words]
        ended = subprocess.run(command, capture_output=True, text=True, check=True)
        profiles.append(json.loads(ended.stdout.splitlines()[-1]))
    return {name: statistics.median(each[name] for each in profiles[1:]) for name in profiles[-1]}


def run(
    out: Print,
    *,
    machines: str = "../shared/machines",
    only: tuple[str, ...] = ("default", "rigid_axis", "turntable", "from"),
    rounds: int = 3,
) -> None:
    """A table: a line a stage, a column a kind."""
    with tempfile.TemporaryDirectory() as scratch:
        logs = {}
        for name in ("rigid_axis", "turntable"):
            logs[name] = [str(path.absolute()) for path in sorted(Path(machines, name).glob("run*.csv"))]
        first = str(Path(scratch, "turntable"))
        kinds = {
            "default": ["run"],
            "rigid_axis": ["run", *logs["rigid_axis"]],
            "turntable": ["run", *logs["turntable"]],
            "from": ["run", "--from", first, "--bandwidth", str(_BANDWIDTH_RAD_S)],
        }
        columns: dict[str, dict[str, float]] = {}
        for kind in only:
            if kind == "from" and not Path(first).is_dir():
                measured([*kinds["turntable"], "--out", first], 0)
            columns[kind] = measured([*kinds[kind], "--out", str(Path(scratch, kind)), "--replace"], rounds)

        # Stages in their order, as the longest of the columns has them.
        names = max(columns.values(), key=len)
        out("CPU s".ljust(24) + "".join(kind.rjust(12) for kind in columns))
        for name in names:
            cells = [f"{column[name]:.2f}" if name in column else "-" for column in columns.values()]
            if name == "exit":
                cells = [f"{column[name]:.0f}" for column in columns.values()]
            out(name.ljust(24) + "".join(cell.rjust(12) for cell in cells))


if __name__ == "__main__":
    main(run, seeds="none")
