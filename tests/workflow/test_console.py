"""What a terminal is told of a computation that takes long, and when."""

import json
import os
import re
import subprocess
import sys
import threading
import time

import numba
import pytest

from tests.workflow.command import ROOT
from workflow import console
from workflow.describe.facts import Quantity, Row, Section
from workflow.describe.summary import RunSummary


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes when it is told to."""
    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    return now


def test_the_first_word_comes_at_once(capfd):
    with console.TerminalProgress() as told:
        told.update("reading", 0.0)
        time.sleep(console.FIRST_LINE_S + 0.2)
    assert re.fullmatch(r"flexlink: \d s: reading\n", capfd.readouterr().err)
    for quiet in (True, False):  # what is refused at once is one line
        with console.TerminalProgress(quiet=quiet):
            time.sleep(console.FIRST_LINE_S + 0.2)
    assert capfd.readouterr().err == ""


def test_nothing_is_told_after_the_end(monkeypatch):
    begun, said = threading.Event(), []

    def say(told, line):
        begun.set()
        time.sleep(0.3)
        said.append(line)

    monkeypatch.setattr(console.TerminalProgress, "_say", say)
    with console.TerminalProgress() as told:
        told.update("reading", 0.0)
        assert begun.wait(60.0)
    assert len(said) == 1
    assert not told._teller.is_alive()


@pytest.mark.parametrize("errors", ["2>/dev/full", "2> >(true)"])
def test_no_computation_ends_because_nobody_can_be_told(errors, tmp_path):
    program = """import time
from workflow.__main__ import usable_streams
usable_streams()
from workflow.console import FIRST_LINE_S, TerminalProgress
with TerminalProgress() as told:
    told.update("reading", 0.0)
    time.sleep(FIRST_LINE_S + 0.2)
    told.note("something")
print("ended")
"""
    (tmp_path / "program.py").write_text(program)
    shell = ["bash", "-c", f"{sys.executable} {tmp_path}/program.py {errors}"]
    done = subprocess.run(
        shell, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (0, b"ended\n")


def test_time_left_follows_the_speed_of_the_machine(clock):
    told = console.TerminalProgress(quiet=True)
    told.plan([("first", 20.0), ("second", 80.0)])
    clock[0] = 1.0
    told.update("first", 0.05)
    assert told._ahead() == ""  # too little is done to say anything
    clock[0] = 60.0  # three times slower than expected
    told.update("first", 1.0)
    assert told._ahead() == f" (20 %, about {80 * (60 + 10) / (20 + 10):.0f} s left)"
    clock[0] += 50.0  # nothing is reported: that much less is left, until nobody knows
    assert told._ahead() == f" (20 %, about {80 * (60 + 10) / (20 + 10) - 50:.0f} s left)"
    clock[0] += 150.0
    assert told._ahead() == " (20 %)"
    told.finish("first", 60.0, taken_up=False)
    clock[0] = 260.0
    told.update("second", 0.9)
    assert float(told._ahead().split("about ")[1].split()[0]) == pytest.approx(8 * 270 / 102, abs=0.5)
    told.finish("second", 0.0, taken_up=True)
    assert told._ahead() == " (100 %, about 0 s left)"
    told.plan([("page", 20.0)])
    assert told._ahead().startswith(" (50 %")  # what an earlier plan did counts in the whole


def test_compiling_is_told_once_and_is_no_sign_of_slowness(capfd):

    @numba.njit
    def double(x):
        return 2 * x

    with console.TerminalProgress() as told:
        told.plan([("all", 100.0)])
        double(1)
        double(1.0)
    double(1j)  # nobody is told any more
    err = [line for line in capfd.readouterr().err.splitlines() if " s: " not in line]
    assert err == [f"flexlink: compiling, once after installing (about {console.COMPILING_S:.0f} s in all)"]
    assert 0 < told._compiled_s < 20
    # 30 s of which all were spent compiling, nearly nothing done: not 1000 s, but what was expected.
    told._compiled_s, told._began_s = 30.0, time.monotonic() - 30.5
    told.update("all", 0.03)
    assert 60 < float(told._ahead().split("about ")[1].split()[0]) < 100


@pytest.mark.parametrize(("asked", "width"), [(None, 120), ("90", 90)])
def test_tables_in_a_pipe_are_as_wide_as_asked(asked, width, capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    if asked is not None:
        monkeypatch.setenv("COLUMNS", asked)
    modes = Row("", "modes", Quantity.words("7.6 Hz " * 40))
    console.print_summary(RunSummary("arm", [Section("model", (modes,))]))
    assert max(map(len, capsys.readouterr().out.splitlines())) == width


PRINTS_A_TABLE = "voltage_V,hub_angle_rad\n" + "".join(f"{k % 3},{k * k}\n" for k in range(40))
STREAMS = {
    "ascii": ({"PYTHONIOENCODING": "ascii"}, ""),
    "latin-1": ({"PYTHONIOENCODING": "latin-1"}, ""),
    "C locale": ({"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, ""),
    "stdout closed": ({}, ">&-"),
    "both closed": ({}, ">&- 2>&-"),
    "all closed": ({}, "<&- >&- 2>&-"),
    "reader leaves": ({}, "| head -0"),
}


# Text and JSON in every encoding that differs between them; of closed streams each once.
@pytest.mark.parametrize("width", [30, 40, 71])
def test_a_narrow_terminal_has_whole_numbers_and_long_lines(width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    values = {"bandwidth": "at least 5.74 rad/s (smallest at 9.35 Hz)", "draws": "20", "": "3.468 to 3.775 %"}
    rows = tuple(Row("", name, Quantity.words(value)) for name, value in values.items())
    sections = (Section("closed loop", rows), Section("", ()))
    console.print_summary(RunSummary("an arm with a title that is long", sections, {}, True, "certified", ""))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert lines[1 + (width == 30)] == "closed loop"
    assert "  draws: 20" in lines  # what fits stands on one line
    for number in ("5.74", "9.35", "3.468", "3.775"):
        assert any(re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.])", line) for line in lines)
    # As few lines as hold the words: a column of one letter would have many.
    assert sum(map(len, lines)) / len(lines) > width / 4


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        *((kind, "") for kind in ("C locale", "both closed", "reader leaves")),
        ("ascii", "--json"),
        *(
            pytest.param(*further, marks=pytest.mark.long)
            for further in (
                *((kind, "--json") for kind in ("C locale", "reader leaves")),
                *((kind, "") for kind in ("ascii", "latin-1", "stdout closed", "all closed")),
            )
        ),
    ],
)
def test_any_kind_of_output_will_do(kind, more, tmp_path):
    (tmp_path / "l°g.csv").write_text(PRINTS_A_TABLE)
    set_, streams = STREAMS[kind]
    # Drawing is slow: a page where a file's own characters meet the locale.
    page = f"--out {tmp_path}/page.html" if "C" in kind and not more else ""
    command = f"{sys.executable} -m workflow look {tmp_path}/*.csv {more} {page} {streams}"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(shell, cwd=ROOT, env={**os.environ, **set_}, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"rror" not in done.stderr
    assert not page or (tmp_path / "page.html").read_text().endswith("</html>\n")
    if not streams:
        text = done.stdout.decode("latin-1" if kind == "latin-1" else "ascii")
        assert json.loads(text) if more else "_" in text and "hub_angle_rad" in text


@pytest.mark.parametrize("how", ["-h", "--version", "look -h", "gone"])
def test_a_reader_that_has_left_changes_no_exit_code(how):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "workflow", *how.split()]
    done = subprocess.run(command, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr.count(b"\n")) == ((2, 1) if how == "gone" else (0, 0)), done.stderr


def test_too_little_memory_is_said_before_anything_is_loaded(tmp_path):
    command = f"ulimit -v 150000; exec {sys.executable} -m workflow look x.csv"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith(b"flexlink: ulimit -v leaves 146 MiB of memory, flexlink needs")
    assert done.stderr.count(b"\n") == 1
