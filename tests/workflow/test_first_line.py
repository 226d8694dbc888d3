"""Hopeless logs and broken files end in one line before anything slow is loaded; doubts are said as early."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from ident import Record
from tests.workflow.command import ROOT
from workflow.engine.progress import Progress
from workflow.tasks.early_refusals import refuse_hopeless_logs

N = 1500
# What takes seconds to load: computes, draws.
SLOW = ("numba", "scipy.signal", "scipy.optimize", "control", "casadi", "matplotlib")
CALLS = """\
import contextlib, io, json, sys
from workflow.cli import main
told = []
for arguments in json.loads(sys.argv[1]):
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = main(arguments)
    told.append((code, said.getvalue(), [name for name in json.loads(sys.argv[2]) if name in sys.modules]))
print(json.dumps(told))
"""
CONFIGURATION = """\
[source]
kind = "files"
time = "time_s"
records = [{ path = "log.csv" }]
[[channels]]
input = "drive_V"
output = "angle_rad"
[specification]
bandwidth_rad_s = 5.0
"""


def told_by_each(calls):
    """Exit code, standard error and slow modules after each of some calls in one process of its own."""
    given = [json.dumps([[str(part) for part in call] for call in calls]), json.dumps(SLOW)]
    done = subprocess.run(
        [sys.executable, "-c", CALLS, *given],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def held(seed):
    return np.repeat(np.random.default_rng(seed).standard_normal(N // 5), 5)


def test_no_command_loads_what_identifies_for_a_log_that_shows_noise(tmp_path):
    noise = np.random.default_rng(1).standard_normal(N)
    table = np.column_stack([0.01 * np.arange(N), held(0), noise])
    log = tmp_path / "log.csv"
    np.savetxt(log, table, "%.9g", delimiter=",", header="time_s,drive_V,angle_rad", comments="")
    (tmp_path / "my.toml").write_text(CONFIGURATION)
    calls = [
        ("run", log, "--out", tmp_path / "run"),
        ("init", log, "--out", tmp_path / "init.toml"),
        ("identify", log, "--out", tmp_path / "model.npz"),
        ("run", "--config", tmp_path / "my.toml", "--out", tmp_path / "run"),
    ]
    for call, (code, said, slow) in zip(calls, told_by_each(calls), strict=True):
        assert (code, said.count("\n"), slow) == (2, 1, []), (call, said)
        assert f"{log}: output column 'angle_rad' does not answer to the input column 'drive_V'" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log.csv", "my.toml"]


def test_certify_loads_nothing_slow_for_a_broken_file(tmp_path):
    plant = {"A": [[0.9]], "B": [0.1], "C": [1.0], "D": 0.0, "dt_s": 0.01}
    law = {"A": [[0.5]], "B": [1.0], "C": [0.2], "D": [1.0], "dt_s": 0.01}
    roots = {"zeros": [], "poles": [0.9], "gain": 0.1, "dt_s": 0.01}
    texts = {
        "cut": (json.dumps(law)[:30], "not valid JSON"),
        "nan": (json.dumps(law | {"A": [[float("nan")]]}), "A has a value that is not finite"),
        "wide": (json.dumps(law | {"A": [[0.5, 0.1]]}), "A is 1x2, expected 1x1"),
        "other": (json.dumps(law | {"dt_s": 0.02}), "sampled every 0.02 s, expected 0.01 s"),
        "empty": ("", "not valid JSON"),
        "model": ('{"format": "flexlink GOBF model"}', "holds a model, expected a controller"),
        "list": ("[1, 2]", "expected a JSON object, found list"),
        "absent": (None, "no such file or directory"),
    }
    (tmp_path / "spec.toml").write_text("[specification]\nbandwidth_rad_s = 2.0\n")
    (tmp_path / "binary.json").write_bytes(bytes(range(256)))
    (tmp_path / "folder.json").mkdir()
    words = {name: said for name, (_, said) in texts.items()}
    words |= {"binary": "not UTF-8 text", "folder": "Is a directory"}
    for name, (text, _) in texts.items():
        if text is not None:
            (tmp_path / f"{name}.json").write_text(text)
    calls = []
    for form, of in (("matrices", plant), ("roots", roots)):
        (tmp_path / f"{form}.json").write_text(json.dumps(of))
        calls += [
            ("certify", tmp_path / f"{form}.json", "--spec", tmp_path / "spec.toml", "--controller",
             tmp_path / f"{name}.json")
            for name in words
        ]  # fmt: skip
    for call, said, (code, line, slow) in zip(calls, [*words.values()] * 2, told_by_each(calls), strict=True):
        assert (code, line.count("\n"), slow) == (2, 1, []), (call, line)
        assert said in line
        assert str(call[-1]) in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r, u, y: (r, u, 180 / np.pi * y), "about 57.3 times it, as between degrees and radians"),
        (lambda r, u, y: (1e3 * r, u, y), "about 0.001 times it, as between mm and m"),
        (lambda r, u, y: (r, np.sign(u), y), "in 100 % of the samples the command 'u' stands at -1 or 1"),
        (lambda r, u, y: (r, u, np.clip(np.round(y), -2, 2)), "the output 'y' takes 5 values only"),
    ],
)
def test_what_may_be_meant_is_said_and_goes_on(tmp_path, change, words):
    class Listener(Progress):
        lines = ()

        def note(self, line):
            self.lines = (*self.lines, line)

    reference = np.repeat(held(0)[::5][: N // 30], 30)
    position = np.zeros(N)
    for k in range(1, N):
        position[k] = position[k - 1] + 0.2 * (reference[k - 1] - position[k - 1])
    signals = change(reference, reference - position + 1e-3 * held(2), position)
    path = tmp_path / "log.csv"
    table = np.column_stack([0.01 * np.arange(N), *signals])
    np.savetxt(path, table, "%.9g", delimiter=",", header="t_s,r,u,y", comments="")
    record = Record.from_file(path, ["u"], ["y"], time="t_s", references=["r"])
    listener = Listener()
    refuse_hopeless_logs([record], listener)
    (line,) = listener.lines
    assert line.startswith("doubt: ")
    assert words in line
