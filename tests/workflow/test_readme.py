"""Every command of the README as written; and a model of one's own from one's own table with one command."""

from __future__ import annotations

import glob
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from plant import linear_arm
from plant.presets import paper_link
from tests.workflow.command import ROOT
from workflow.tasks.model_files import read_model

README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [
    shlex.split(text.replace("\\\n", " "))
    for text in re.findall(r"^    \.venv/bin/flexlink ((?:.*\\\n)*.*)$", README, re.MULTILINE)
]
# These take from a minute to hours: that they are accepted as written, and begin, is what is tested here.
ONLY_BEGUN = ("study", "blind", "paper")
# First mode of the arm behind the logs with its hub free, from the physical model alone.
TRUE_HZ = sorted(abs(pole) / (2 * np.pi) for pole in linear_arm(paper_link()).poles() if pole.imag > 10)[0]


def test_the_readme_has_the_commands_that_are_tested():
    names = [command[0] for command in COMMANDS]
    assert names == ["simulate", "identify", "excite", "run", "study", "diagnose", "blind", "paper"]


@pytest.fixture
def clean(tmp_path, monkeypatch):
    """A directory with the examples and nothing else."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("logs_of_mine"))
    shutil.rmtree(tmp_path / "examples" / "logs", ignore_errors=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def modes_of(document) -> list[float]:
    return [mode["frequency_Hz"] for mode in document["numbers"]["modes"] if mode["is_mode"]]


@pytest.mark.slow
def test_commands_of_the_readme_give_the_right_answer(clean, flexlink):
    def call(name):
        (command,) = [one for one in COMMANDS if one[0] == name]
        return flexlink(
            *(found for word in command for found in (sorted(glob.glob(word)) or [word])), "--json"
        )

    assert len(call("simulate").document()["files"]) == 10
    found = modes_of(call("identify").document())
    assert abs(found[0] / TRUE_HZ - 1) < 0.03
    assert len(found) == 2
    assert read_model(Path("hub.mat")).model.output_name == "hub_angle_rad"
    assert Path("hub.html").is_file()
    call("excite").document()
    planned = [np.loadtxt(path, delimiter=",", skiprows=1) for path in sorted(glob.glob("voltages/*.csv"))]
    assert len(planned) == 8
    assert max(np.max(np.abs(table[:, 1])) for table in planned) <= 24
    assert call("run").document()["certified"]
    assert Path("runs/mine/controller.c").is_file()
    (answer,) = call("diagnose").document()["cases"]
    machine = tomllib.loads(Path("examples/gap_case/machine.toml").read_text(encoding="utf-8"))
    (truth,) = machine["source"]["effects"]
    assert answer["combination"] == [truth["name"]]
    low, high = answer["effects"][0]["intervals"]["torque_Nm"]
    # One case: the truth lies in an interval twice as wide.
    assert abs(truth["torque_Nm"] - (low + high) / 2) < high - low
    assert answer["gap_after"] < 1.05 < answer["gap_refit"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ONLY_BEGUN)
def test_long_commands_of_the_readme_are_accepted_and_begin(name, clean):
    (command,) = [one for one in COMMANDS if one[0] == name]
    out, said = Path(command[command.index("--out") + 1]), clean / "said.txt"
    with said.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, "-c", "import sys; from workflow.cli import main; sys.exit(main())", *command],
            stdout=stream,
            stderr=stream,
            env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(clean)},
            start_new_session=True,
        )
    try:
        deadline = time.monotonic() + 120
        while not out.is_dir() and name != "paper" and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.2)
        time.sleep(8.0)
        assert process.poll() is None, said.read_text(encoding="utf-8")
    finally:
        os.killpg(process.pid, signal.SIGKILL)  # how commands end when asked to: test_cli.py, test_resume.py
        process.wait()


def voltage_and_motion() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], voltage [V] and angle [rad] of a mode at 3.2 Hz, damping ratio 0.05, and noise."""
    rng = np.random.default_rng(8)
    t = 0.01 * np.arange(3000)
    u = 6.0 * np.sign(np.sin(0.7 * t**1.5) + 0.3)
    y, rate, angle = np.zeros(t.size), 0.0, 0.0
    omega = 2 * np.pi * 3.2
    for k in range(t.size):
        y[k] = angle
        for _ in range(10):
            rate += 1e-3 * (omega**2 * (0.05 * u[k] - angle) - 0.1 * omega * rate)
            angle += 1e-3 * rate
    return t, u, y + 1e-3 * rng.standard_normal(t.size)


def german(t, u, y) -> bytes:
    rows = [f"{1e3 * a:.0f};{b:.2f};{c:.6f}".replace(".", ",") for a, b, c in zip(t, u, y, strict=True)]
    return "\r\n".join(["Logger 3000;v1.2;", "Zeit [ms];Spannung [V];Winkel [rad]", *rows, ""]).encode(
        "cp1252"
    )


def clocked(t, u, y) -> bytes:
    rows = [
        f"2024-03-01 12:{int(a // 60):02d}:{a % 60:06.3f},{b:.2f},{np.rad2deg(c):.5f}"
        for a, b, c in zip(t, u, y, strict=True)
    ]
    return "\n".join(["timestamp,motor_V,hub_deg", *rows]).encode()


def units_below(t, u, y) -> bytes:
    rows = [f"{a:.3f}\t{b:.2f}\t{c:.6f}" for a, b, c in zip(t, u, y, strict=True)]
    return "\n".join(["t\tdrive\tencoder", "s\tV\trad", *rows]).encode()


@pytest.mark.parametrize(
    ("name", "written"), [("german.csv", german), ("clocked.csv", clocked), ("units.txt", units_below)]
)
def test_one_command_from_ones_own_table_to_ones_own_model(name, written, tmp_path, monkeypatch, flexlink):
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(written(*voltage_and_motion()))
    answer = flexlink("identify", name, "--out", "model.npz", "--export", "model.json", "--json").document()
    found = modes_of(answer)
    assert len(found) == 1
    assert abs(found[0] / 3.2 - 1) < 0.01
    model = read_model(Path("model.json")).model
    static = abs(model.frequency_response(np.array([0.1]))[0])
    assert abs(static / (0.05 * (180 / np.pi if name == "clocked.csv" else 1.0)) - 1) < 0.02
    assert Path("model.npz").is_file()
