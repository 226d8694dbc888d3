"""Every command of README and docs/commands.md as written; your own model from your own table."""

import csv
import glob
import json
import re
import shlex
import shutil
import subprocess
import textwrap
import tomllib
from pathlib import Path

import numpy as np
import pytest

from ident.data.finding import FindingKind
from plant import linear_arm, paper_link
from tests.golden import margins
from tests.workflow.command import FAST_ARM, ROOT
from workflow.config.run_config import built_in_config, load_config
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.exports import read_model
from workflow.tasks.results import RunResults
from workflow.tasks.simulated_rig import rig_of

README, COMMANDS_PAGE, MAKEFILE = (
    (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/commands.md", "Makefile")
)


def commands_of(page: str, program: str) -> list[list[str]]:
    found = re.findall(rf"^    {program} ((?:.*\\\n)*.*)$", page, re.MULTILINE)
    return [shlex.split(text.replace("\\\n", " ")) for text in found]


COMMANDS = commands_of(COMMANDS_PAGE, "flexlink")
# First mode of the arm behind the logs with its hub free, from the physical model alone.
TRUE_HZ = sorted(abs(pole) / (2 * np.pi) for pole in linear_arm(paper_link()).poles() if pole.imag > 10)[0]


def test_the_readme_has_the_commands_that_are_tested():
    names = [command[0] for command in COMMANDS]
    first = ["simulate", "look", "init", "identify", "excite"]
    assert names == [*first, "run", "run", "certify", "tune", "study", "diagnose", "check", "blind", "paper"]
    of_readme = commands_of(README, r"\.venv/bin/flexlink")
    assert [command[0] for command in of_readme] == ["simulate", "run", "diagnose", "paper"]
    assert all(command in COMMANDS for command in of_readme)


def test_what_logs_can_tell_of_the_model_of_the_page(call):
    pytest.importorskip("mujoco")
    numbers = call("check")["numbers"]
    # One direction of gravity hardly shows in these logs; a small dry friction of the elbow does.
    assert "gravity.y" in numbers["hidden"]
    assert 0.01 < numbers["least"]["elbow.frictionloss"] < 0.2
    assert any({"forearm.mass", "forearm.payload"} <= set(group["names"]) for group in numbers["alike"])


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 100
    assert max(map(len, README.splitlines())) <= 120


@pytest.mark.skipif(
    not (ROOT / ".git").exists() or shutil.which("git") is None, reason="no repository, or no git"
)
def test_what_the_commands_of_the_readme_leave_is_not_taken_for_source():
    left = re.findall(r"--(?:out|report|export) ([\w./]+)", README + COMMANDS_PAGE)
    assert {"hub.html", "voltages", "runs/mine"} <= set(left)
    for name in left:
        inside = name if Path(name).suffix else f"{name}/file"
        asked = subprocess.run(["git", "check-ignore", "-q", inside], cwd=ROOT, check=False)
        assert asked.returncode == 0, name


def said(words: str) -> bool:
    return re.search(words, " ".join(COMMANDS_PAGE.split())) is not None


def modes_of(document) -> list[float]:
    return [mode["frequency_Hz"] for mode in document["numbers"]["modes"] if mode["is_mode"]]


@pytest.fixture
def call(examples_alone, flexlink):
    """Run the command of this name as the README has it, and return what `--json` prints."""

    def run(name: str):
        (command,) = [one for one in COMMANDS if one[0] == name]
        words = [found for word in command for found in (sorted(glob.glob(word)) or [word])]
        return flexlink(*words, "--json").document()

    return run


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_commands_of_the_readme_give_the_right_answer(call):
    assert len(call("simulate")["files"]) == 10
    identified = call("identify")
    found = modes_of(identified)
    assert abs(found[0] / TRUE_HZ - 1) < 3e-3
    assert identified["numbers"]["warnings"] == []
    assert len(found) == 2
    assert read_model(Path("hub.mat")).model.output_name == "hub_angle_rad"
    assert Path("hub.html").is_file()
    drafted = call("init")
    assert load_config(Path("my.toml"))[0].control_channel.output == "hub_angle_rad", drafted
    call("excite")
    planned = [np.loadtxt(path, delimiter=",", skiprows=1) for path in sorted(glob.glob("voltages/*.csv"))]
    assert len(planned) == 8
    assert max(np.max(np.abs(table[:, 1])) for table in planned) <= 24
    (snippet,) = re.findall(r"^    from pathlib import Path\n(?:    .*\n)+", COMMANDS_PAGE, re.MULTILINE)
    # On a smaller arm: the example itself is run by the tutorial of the engineer.
    assert snippet.count("examples/own_log.toml") == 1
    names: dict = {}
    exec(textwrap.dedent(snippet).replace("examples/own_log.toml", str(FAST_ARM)), names)
    assert names["summary"].certified
    assert Path("runs/mine_again/controller.c").is_file()


def test_tutorials_run_what_the_readme_runs():
    """`tests/test_docs.py` runs the tutorials and reads what they leave."""
    engineer, student = (
        (ROOT / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
        for name in ("engineer", "student")
    )
    for words in COMMANDS:
        if words[0] == "run":
            assert f"flexlink {shlex.join(words)}\n" in engineer
        if words[0] == "diagnose":
            assert f"flexlink {shlex.join(words[: words.index('--out')])} --out answer\n" in student


def assert_verdict_of_the_run(printed: str) -> None:
    """What README says that `flexlink run` prints; how long friction takes may hang on last digits."""
    line = re.findall(r"^    (.*)\n    report: runs/mine/report.html$", README, re.MULTILINE)[0]
    words, *range_s = re.fullmatch(r"(.* with dry friction in )([\d.]+) to ([\d.]+) s\)", line).groups()
    found = re.search(re.escape(words) + r"([\d.]+) to ([\d.]+) s\)", printed)
    assert found, printed[-500:]
    for time_s, told_s in zip(found.groups(), range_s, strict=True):
        assert float(time_s) == pytest.approx(float(told_s), rel=0.1)


def assert_hidden_cause_is_found(path: Path) -> None:
    """The answer to `flexlink diagnose examples/gap_case` is right, and the one of README."""
    answer = json.loads(path.read_text(encoding="utf-8"))
    machine = tomllib.loads((ROOT / "examples" / "gap_case" / "machine.toml").read_text(encoding="utf-8"))
    (truth,) = machine["source"]["effects"]
    assert answer["combination"] == [truth["name"]]
    low, high = answer["effects"][0]["intervals"]["torque_Nm"]
    # One case: the truth lies in an interval twice as wide.
    assert abs(truth["torque_Nm"] - (low + high) / 2) < high - low
    assert answer["gap_after"] < 1.05 < answer["gap_refit"]
    torque_Nm = answer["effects"][0]["parameters"]["torque_Nm"]
    assert f"torque {torque_Nm:.5f} N m (95 %: {low:.4g} to {high:.4g})" in README


@pytest.mark.slow
@pytest.mark.usefixtures("examples_alone")
def test_make_run_gives_the_numbers_of_the_readme(flexlink):
    (words,) = re.findall(r"^run:.*\n\t\$\(BIN\)/flexlink (.*)$", MAKEFILE, re.MULTILINE)
    answer = flexlink(*words.replace("$(OUT)", "runs/default").split(), "--json").document()
    assert answer["certified"]
    off = margins.moved("default_arm", margins.of_run(Path("runs/default")))
    assert not off, f"measured against golden: {off}; if meant, rerun python -m tests.golden.margins"
    assert Path("runs/default/figures/overview.svg").is_file()
    # The level of the configuration, and no warning that the binary input is clipped.
    results, rig = RunResults(RunDirectory.open(Path("runs/default"))), rig_of(built_in_config()[0].source)
    torque_Nm = results.identify.friction.level * rig.motor.torque_per_volt_Nm_V
    assert torque_Nm == pytest.approx(0.02, rel=0.03)
    for found, spread in zip(results.identify.channels, results.uncertainty.channels, strict=True):
        assert not [w for w in found.identification.warnings if w.kind is FindingKind.CLIPPED]
        assert spread.intervals is not None
        assert spread.bands[0].median_radius_percent < 0.1
    (command,) = re.findall(r"`flexlink (report runs/default .*?)`", COMMANDS_PAGE)
    assert flexlink(*command.split()).code == 0
    assert Path("runs/default/figures/overview.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.long
def test_the_study_of_the_readme(call, flexlink):
    points = call("study")["numbers"]["points"]
    certified = [point for point in points if point["state"] == "certified"]
    assert len(certified) == len(points) == 12
    assert said("12 points, 12 certified")
    with open("runs/study/table.csv", newline="") as stream:
        assert len(list(csv.DictReader(stream))) == len(points)
    (command,) = re.findall(r"`flexlink (report runs/study/.*?)`", COMMANDS_PAGE)
    assert "certified" in flexlink(*command.split()).out


@pytest.mark.long
def test_the_blind_cases_of_the_readme(call):
    call("blind")
    scores = json.loads(Path("runs/blind/scores.json").read_text(encoding="utf-8"))
    right = scores["diagnosis"]["table"]["all"]["verdict and set right, every case"]
    assert said(f"verdict and set right in {right['hits']:.0f} of {right['count']}")
    assert scores["failed"] == {}
    assert set(scores["baselines"]) == {"parameters only", "residual correlation"}
    predicted = [json.loads(path.read_text()) for path in Path("runs/blind/predictions").glob("*.json")]
    assert len(predicted) == right["count"]
    for one in predicted:
        assert sum(effect["probability"] for effect in one["effects"]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.long
def test_the_paper_of_the_readme(call):
    call("paper")
    with open("runs/paper/table.csv", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["quantity"].startswith("mode found, ")]
    found = {(row["figure"], row["quantity"].partition(", ")[2]): int(row["value"]) for row in rows}
    of = int(rows[0]["unit"].split()[1])
    assert found["2", "GOBF"] == found["4", "GOBF"] == of
    assert all(found["3", name] < of / 2 for name in ("ARX", "ARMAX", "OE"))
    assert all(found["3", f"{name} (better start)"] == of for name in ("ARMAX", "OE"))
    assert len(list(Path("runs/paper").glob("figure-*.svg"))) == 7


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
    ("name", "written"),
    [
        ("german.csv", german),
        *(
            pytest.param(*one, marks=pytest.mark.long)  # readers: tests/ident/test_forty_logs.py
            for one in (("clocked.csv", clocked), ("units.txt", units_below))
        ),
    ],
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


EXAMPLE = Path(__file__).parents[2] / "examples" / "gap_case"


def test_its_logs_are_those_of_its_machine(flexlink, tmp_path):
    answer = flexlink("simulate", "--config", EXAMPLE / "machine.toml", "--out", tmp_path / "logs")
    assert answer.code == 0, answer.err
    shipped = sorted((EXAMPLE / "logs").iterdir())
    assert [path.name for path in shipped] == sorted(p.name for p in (tmp_path / "logs").glob("*.csv"))
    for path in shipped:
        made = np.loadtxt(tmp_path / "logs" / path.name, delimiter=",", skiprows=1)
        # Nine digits are written.
        np.testing.assert_allclose(np.loadtxt(path, delimiter=",", skiprows=1), made, rtol=1e-7, atol=1e-9)
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*") if path.is_file()) < 300_000
