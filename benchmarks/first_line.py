"""How long a user waits for the line that names what is wrong with hopeless input.

Logs that no model can come out of, logs that hardly are what was meant, and broken files of a controller and
a plant. Each is made here and given to the commands as processes of their own. Told for each: CPU seconds
(user and system, of the whole process; of a doubt until its line, after which the process is ended), exit
code and line. A case counts where the line has the words that name its cause, within `most_s`. Good logs are
given to the same commands: none of them may be refused before it is searched.

    OMP_NUM_THREADS=1 python -m benchmarks.first_line
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, main

DT_S = 0.002
# Samples of a log: 8 s.
N = 4000
# Wall clock and CPU: then a case is ended and lost.
LONGEST_S = 120
# CPU: whoever is not refused by then has gone on to search.
SEARCHED_S = 4

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Case:
    """Columns of a log by name, and words of the expected line; doubted: the command goes on after it."""

    columns: Columns
    words: str
    doubted: bool = False


@dataclass(frozen=True)
class Told:
    """What a process said and took."""

    code: int | None  # None: ended by us after its doubt
    cpu_s: float
    line: str


def simulated(seed: int, *, closed: bool = True, limit: float = 10.0, relay: bool = False) -> Columns:
    """A motor with viscous friction and a mode at 12 Hz, read at the sample; in a PD loop or open."""
    rng = np.random.default_rng(seed)
    wanted = np.repeat(rng.standard_normal(N // 40), 40)
    substeps = 10
    step_s = DT_S / substeps
    mode_rad_s = 2 * np.pi * 12
    position = speed = bend = bend_speed = last = 0.0
    command = np.zeros(N)
    measured = np.zeros(N)
    for k in range(N):
        measured[k] = np.round((position + bend) * 65536 / (2 * np.pi)) * 2 * np.pi / 65536
        wish = 2 * wanted[k]
        if closed:
            wish = 20 * (wanted[k] - measured[k]) - 0.4 * (measured[k] - last) / DT_S
            last = measured[k]
        if relay:
            wish = limit * np.sign(wanted[k] - measured[k])
        command[k] = np.clip(wish, -limit, limit)
        for _ in range(substeps):
            force = 50 * command[k]
            bend_force = 0.3 * force - mode_rad_s**2 * bend - 0.04 * mode_rad_s * bend_speed
            position += step_s * speed
            speed += step_s * (force - 5 * speed)
            bend += step_s * bend_speed
            bend_speed += step_s * bend_force
    log = {"time_s": np.arange(N) * DT_S}
    if closed:
        log["reference_rad"] = wanted
    return log | {"voltage_V": command, "position_rad": measured}


def hopeless(seed: int) -> dict[str, Case]:
    """Logs by name."""
    rng = np.random.default_rng(seed)
    loop = simulated(seed)
    opened = simulated(seed, closed=False)
    other = simulated(seed + 1)
    relay = simulated(seed, relay=True, limit=2.0)
    position = loop["position_rad"]
    command = loop["voltage_V"]
    noise = rng.standard_normal(N)
    late = np.where(np.arange(N) < N - 20, 0.0, 3.0)
    at_end = np.where(np.arange(N) % 200 == 100, 1.5 - 0.01 * rng.random(N), 1.57)
    plain = {name.split("_")[0]: column for name, column in loop.items()}
    return {
        "position stands still": Case(loop | {"position_rad": 0 * position + 0.3}, "still|is constant"),
        "all zeros": Case({**loop, "voltage_V": 0 * command, "position_rad": 0 * position}, "still|constant"),
        "sensor noise only, loop": Case(loop | {"position_rad": 1e-4 * noise}, "does not answer"),
        "sensor noise only, open": Case(opened | {"position_rad": 1e-4 * noise}, "does not answer"),
        "position of another machine": Case(
            loop | {"position_rad": other["position_rad"]}, "does not answer"
        ),
        "50 samples": Case({name: column[:50] for name, column in loop.items()}, "50 samples are too few"),
        "command is constant": Case(opened | {"voltage_V": 0 * command + 5}, "stands still|is constant"),
        "command always at its limit": Case(loop | {"voltage_V": 0 * command + 10}, "still|is constant"),
        "command bangs, narrow": Case(
            loop | {"voltage_V": 10 * np.sign(np.sin(2 * np.pi * 5 * loop["time_s"] + 0.1))}, "limit cycle"
        ),
        "command bangs, broad": Case(relay, "stands at -2 or 2, the ends of its range", doubted=True),
        "a step at the end": Case(opened | {"voltage_V": late}, "too late to show an answer"),
        "reference in degrees": Case(
            plain | {"reference": 57.29577951 * plain["reference"]}, "degrees and radians", doubted=True
        ),
        "output in degrees": Case(plain | {"position": 57.29577951 * position}, "degrees and", doubted=True),
        "reference in mm": Case(plain | {"reference": 1e3 * plain["reference"]}, "mm and m", doubted=True),
        "output in mm": Case(plain | {"position": 1e3 * position}, "mm and m", doubted=True),
        "output is the command": Case(loop | {"position_rad": 0.5 * command}, "'voltage_V' again"),
        "output is the reference": Case(
            loop | {"position_rad": loop["reference_rad"]}, "'reference_rad' again"
        ),
        "output mostly NaN": Case(
            loop | {"position_rad": np.where(np.arange(N) % 10 == 0, position, np.nan)}, "position_rad.*nan"
        ),
        "infinite output": Case(
            loop | {"position_rad": np.where(np.arange(N) == 77, np.inf, position)}, "position_rad.*inf"
        ),
        "infinite command": Case(
            loop | {"voltage_V": np.where(np.arange(N) == 77, -np.inf, command)}, "voltage_V.*inf"
        ),
        "time stands still": Case(loop | {"time_s": 0 * position + 4}, "time_s"),
        "time goes backwards": Case(loop | {"time_s": -loop["time_s"]}, "time_s"),
        "sensor at its end": Case(loop | {"position_rad": at_end}, "in all but 20 of"),
        "two values of the output": Case(
            loop | {"position_rad": 0.5 * (position > 0)}, "takes two values only"
        ),
        "five values of the output": Case(
            loop | {"position_rad": np.clip(np.round(2 * position), -2, 2)}, "takes 5 values only",
            doubted=True,
        ),
        "motion lost beside 1e9": Case(
            loop | {"position_rad": np.round(1e9 + 1e-3 * position)}, "stands still|is constant|two values"
        ),
    }  # fmt: skip


CONFIGURATION = """\
[source]
kind = "files"
time = "{time}"
{reference}
records = [{{ path = "log.csv" }}]
[[channels]]
input = "{command}"
output = "{output}"
[specification]
bandwidth_rad_s = 20.0
"""


def arguments_by_command(folder: Path, columns: Mapping[str, np.ndarray]) -> dict[str, list[str]]:
    """What is called on a log, by what it is called here; the files are written."""
    log = folder / "log.csv"
    table = np.column_stack(list(columns.values()))
    np.savetxt(log, table, "%.12g", delimiter=",", header=",".join(columns), comments="")
    time, *reference, command, output = columns
    named = f'references = ["{reference[0]}"]' if reference else ""
    config = folder / "config.toml"
    text = CONFIGURATION.format(time=time, reference=named, command=command, output=output)
    config.write_text(text, encoding="utf-8")
    return {
        "run": ["run", str(log), "--out", str(folder / "run")],
        "init": ["init", str(log), "--out", str(folder / "init.toml")],
        "identify": ["identify", str(log)],
        "config": ["run", "--config", str(config), "--out", str(folder / "config")],
    }


def told_by(
    arguments: list[str], words: str = "", *, doubted: bool = False, longest_cpu_s: int = LONGEST_S
) -> Told:
    """The line with which a process ends; doubted: the line with these words, after which it is ended."""
    process = subprocess.Popen(
        [sys.executable, "-m", "flexlink", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (longest_cpu_s, longest_cpu_s)),
    )
    timer = threading.Timer(LONGEST_S, process.kill)
    timer.start()
    assert process.stderr is not None
    line = ""
    is_told = False
    for printed in process.stderr:
        line = printed.strip() or line
        is_told = doubted and re.search(words, line) is not None
        if is_told:
            process.kill()
            break
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    timer.cancel()
    process.stderr.close()
    code = None if is_told else process.returncode
    return Told(code, usage.ru_utime + usage.ru_stime, line.removeprefix("flexlink: "))


def controllers(folder: Path) -> dict[str, tuple[list[str], str]]:
    """What `certify` is given, by name: plant and controller, and words of the line."""
    plant = {"A": [[1.9, -0.905], [1, 0]], "B": [0.01, 0], "C": [1, 0.9], "D": 0, "dt_s": 0.01}
    law = {"A": [[0.5]], "B": [1.0], "C": [0.2], "D": [1.0], "dt_s": 0.01}
    texts = {
        "plant.json": json.dumps(plant),
        "law.json": json.dumps(law),
        "cut.json": json.dumps(law)[:25],
        "nan.json": json.dumps(law | {"A": [[float("nan")]]}),
        "infinite.json": json.dumps(law | {"D": [float("inf")]}),
        "wide.json": json.dumps(law | {"A": [[0.5, 0.1]]}),
        "other_shapes.json": json.dumps(law | {"B": [1.0, 2.0]}),
        "words.json": json.dumps(law | {"A": "none"}),
        "slow.json": json.dumps(law | {"dt_s": 0.02}),
        "no_period.json": json.dumps({name: law[name] for name in "ABCD"}),
        "negative.json": json.dumps(law | {"dt_s": -0.01}),
        "nothing.json": json.dumps({}),
        "list.json": "[1, 2, 3]",
        "empty.json": "",
        "gains.txt": "1.0 0.5\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "binary.json").write_bytes(bytes(range(256)) * 16)
    (folder / "binary.mat").write_bytes(bytes(range(256)) * 16)
    (folder / "binary.npz").write_bytes(bytes(range(256)) * 16)
    (folder / "folder.json").mkdir()
    (folder / "specification.toml").write_text("[specification]\nbandwidth_rad_s = 2.0\n", encoding="utf-8")
    words = {
        "cut.json": "not valid JSON",
        "nan.json": "finite|NaN",
        "infinite.json": "finite|Infinity",
        "wide.json": "A is 1x2, expected 1x1",
        "other_shapes.json": "B is 2, expected 1x1",
        "words.json": "A must be a matrix of real numbers",
        "slow.json": "sampled every 0.02 s, expected 0.01 s",
        "no_period.json": "no dt_s",
        "negative.json": "dt_s must be one positive number",
        "nothing.json": "no A in it",
        "list.json": "list.json",
        "empty.json": "not valid JSON",
        "gains.txt": "the ending is not one of",
        "binary.json": "not UTF-8",
        "binary.mat": "binary.mat",
        "binary.npz": "binary.npz",
        "folder.json": "directory",
        "missing.json": "no such file",
    }

    def given(plant: str, controller: str) -> list[str]:
        spec = ["--spec", str(folder / "specification.toml")]
        return ["certify", str(folder / plant), *spec, "--controller", str(folder / controller)]

    of_controllers = {
        f"controller {name}": (given("plant.json", name), expected) for name, expected in words.items()
    }
    as_plants = {name: expected for name, expected in words.items() if name not in ("slow.json", "gains.txt")}
    return of_controllers | {
        f"plant {name}": (given(name, "law.json"), expected) for name, expected in as_plants.items()
    }


def run(out: Print, *, seed: int = 0, most_s: float = 2.0, good: int = 3) -> None:
    """good: logs of each of the two ways that must not be refused before they are searched."""
    counted: list[tuple[bool, float]] = []

    def judge(name: str, command: str, call: Callable[[], Told], words: str, code: int | None) -> None:
        answer = call()
        right = answer.code == code and re.search(words, answer.line, re.IGNORECASE) is not None
        counted.append((right and answer.cpu_s <= most_s, answer.cpu_s))
        ended = "goes on" if answer.code is None else f"exit {answer.code}"
        mark = "  " if counted[-1][0] else "!!"
        line = re.sub(r"\S*/(?=[\w.]+)", "", answer.line)
        out(f"{mark} {name:28} {command:9} {answer.cpu_s:5.2f} s  {ended:8} {line}")

    with tempfile.TemporaryDirectory() as place:
        for number, (name, case) in enumerate(hopeless(seed).items()):
            folder = Path(place) / f"case_{number}"
            folder.mkdir()
            for command, arguments in arguments_by_command(folder, case.columns).items():
                code = None if case.doubted else 2
                judge(
                    name,
                    command,
                    lambda arguments=arguments, case=case: told_by(
                        arguments, case.words, doubted=case.doubted
                    ),
                    case.words,
                    code,
                )
        files = Path(place) / "certify"
        files.mkdir()
        for name, (arguments, words) in controllers(files).items():
            judge(name, "certify", lambda arguments=arguments: told_by(arguments), words, 2)
        times = [cpu_s for _, cpu_s in counted]
        n_right = sum(right for right, _ in counted)
        out()
        out(
            f"{n_right} of {len(counted)} named with the right exit code within {most_s:g} CPU s; median "
            f"{np.median(times):.2f}, longest {max(times):.2f}"
        )
        refused = 0
        for number in range(good):
            for closed in (True, False):
                folder = Path(place) / f"good_{number}_{closed}"
                folder.mkdir()
                columns = simulated(seed + 10 + number, closed=closed)
                for command, arguments in arguments_by_command(folder, columns).items():
                    answer = told_by(arguments, longest_cpu_s=SEARCHED_S)
                    refused += answer.code == 2
                    if answer.code == 2:
                        out(f"!! good log {number}, closed = {closed}, {command}: {answer.line}")
        out(f"{refused} of {8 * good} commands refuse good logs")


if __name__ == "__main__":
    main(run)
