"""A run killed with SIGKILL at any point resumes and ends with the numbers of a run that was left alone."""

import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from control_design.controllers.controller import Controller
from tests.workflow.command import FAST_ARM, ROOT, finish, start_flexlink, wait_until
from workflow.commands.run import run_from_files
from workflow.config.run_config import load_config
from workflow.console import TerminalProgress
from workflow.engine import interrupts, storage
from workflow.engine.errors import CommandInterruptedError, InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.figures.description import new_picture
from workflow.figures.matplotlib_figure import saved
from workflow.report import pages
from workflow.report.pages import REPORT
from workflow.tasks.exports import write_controller
from workflow.tasks.records import make_records
from workflow.tasks.results import ClosedLoopResult, RunResults
from workflow.tasks.stage import StageInput
from workflow.tasks.stages import STAGES

NAMES = [*(stage.name for stage in STAGES), REPORT.name]


def stage_bytes(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((run / "stages").iterdir())}


def assert_same_run(left: Path, right: Path) -> None:
    """Equal bytes, stage by stage, but for the hash of the page: the page names times."""
    first, second = stage_bytes(left), stage_bytes(right)
    assert first.keys() == second.keys()
    for name in first.keys() - {"report.json"}:
        assert first[name] == second[name], f"{name} differs"


# SIGTERM comes while a command loads, SIGALRM at its time limit.
@pytest.mark.slow
def test_interrupted_run_ends_at_once_and_says_how_to_go_on(tmp_path):
    out = tmp_path / "run"
    process = start_flexlink("run", "--config", FAST_ARM, "--out", out)
    wait_until((out / "stages/uncertainty.npz").exists, process)
    process.send_signal(signal.SIGINT)
    sent_s = time.monotonic()
    said = finish(process, 128 + signal.SIGINT)
    assert time.monotonic() - sent_s < 5.0  # two seconds on a machine that is not shared
    assert said.strip().endswith(f"flexlink run --config {FAST_ARM} --out {out} --resume continues")


_CLEANING_UP = """
import os, signal, sys, time
from workflow.engine import interrupts

class Left:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            pass

interrupts.watch()
try:
    Left()
    time.sleep(20)
except KeyboardInterrupt:
    sys.exit(interrupts.exit_code())
"""


def test_an_interrupt_while_python_cleans_up_does_not_go_under():
    """There Python prints the exception and goes on."""
    ended = subprocess.run([sys.executable, "-c", _CLEANING_UP], cwd=ROOT, capture_output=True, check=False)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGTERM, b"")


_WHILE_LOADING = """
import signal, sys
from workflow.__main__ import main
from workflow.engine import interrupts

watch = interrupts.watch

def interrupted(**how):
    interrupts.watch = watch
    watch(**how)
    signal.raise_signal(signal.SIGTERM)

interrupts.watch = interrupted
sys.exit(main())
"""


def test_an_interrupt_while_the_command_loads_says_how_to_go_on(fast_run):
    called = ("run", "--out", str(fast_run[0]), "--resume")
    command = [sys.executable, "-c", _WHILE_LOADING, *called]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = f"flexlink: interrupted; flexlink {' '.join(called)} continues\n"
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGTERM, said)


def test_an_interrupt_that_a_library_makes_something_else_of_is_one(fast_run, tmp_path, monkeypatch):
    def swallowed(*_):
        monkeypatch.setattr(interrupts, "_came", signal.SIGTERM)
        raise ValueError("invalid matrix")

    out = tmp_path / "run"
    shutil.copytree(fast_run[0], out)
    (out / "report.html").unlink()
    monkeypatch.setattr(pages, "write_report", swallowed)
    with pytest.raises(CommandInterruptedError):
        run_from_files(FAST_ARM, out, resume=True)
    assert RunDirectory.open(out).manifest()["status"] == "interrupted"


def test_an_interrupt_that_went_under_while_libraries_were_loaded_ends_the_first_stage(monkeypatch):
    monkeypatch.setattr(interrupts, "_came", signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), TerminalProgress(quiet=True) as progress:
        progress.start("records")


def test_no_picture_that_an_interrupt_went_under_in_is_kept(monkeypatch):
    monkeypatch.setattr(interrupts, "_came", signal.SIGTERM)
    picture, _ = new_picture(1.0)
    with pytest.raises(KeyboardInterrupt):
        saved(picture, ("png",))


def test_a_time_limit_ends_a_run_like_an_interrupt(tmp_path, flexlink, monkeypatch):
    monkeypatch.setattr(interrupts, "_came", None)
    monkeypatch.setattr(
        "workflow.tasks.pipeline._perform", lambda *_, **__: signal.raise_signal(signal.SIGALRM)
    )
    called = ("run", "--config", FAST_ARM, "--out", tmp_path / "run", "--time-limit", "600")
    again = f"flexlink {' '.join(map(str, called))} --resume continues"
    answer = flexlink(*called)
    assert (answer.code, answer.out) == (128 + signal.SIGALRM, "")
    assert answer.err == f"flexlink: the time limit is reached; {again}\n"


@pytest.fixture
def plain_page(monkeypatch):
    """Resuming is about numbers: an empty page saves the seconds that drawing takes."""

    def write(results, config, progress=None, also=()):
        storage.write_text(results.run.report_path, "<html></html>\n")
        return results.run.report_path

    monkeypatch.setattr(pages, "write_report", write)


class Watch(Progress):
    """Remembers which stages were taken up."""

    def __init__(self) -> None:
        self.taken_up: list[str] = []
        self.made: list[str] = []

    def finish(self, stage: str, seconds: float, *, taken_up: bool) -> None:
        (self.taken_up if taken_up else self.made).append(stage)


def test_missing_page_is_drawn_again(fast_run, tmp_path, plain_page):
    out = tmp_path / "run"
    shutil.copytree(fast_run[0], out)
    (out / "report.html").unlink()
    watch = Watch()
    run_from_files(FAST_ARM, out, resume=True, progress=watch)
    assert watch.made == ["report"]
    assert (out / "report.html").is_file()


def test_resume_without_config_uses_the_one_in_the_directory(fast_run):
    assert run_from_files(None, fast_run[0], resume=True).numbers == fast_run[1].numbers


def test_c_code_stays_as_it_was_asked_for(fast_run, tmp_path):
    """Numbers and names of the C code are kept with the run, each until another one is stated."""
    out = tmp_path / "run"
    shutil.copytree(fast_run[0], out)

    def written(**stated: str) -> str:
        run_from_files(None, out, resume=True, c_code=stated)
        return (out / "controller.h").read_text()

    asked = written(number="float", prefix="hub")
    assert "float hub_step(" in asked
    assert written() == asked
    assert "double hub_step(" in written(number="double")
    assert "double arm_step(" in written(prefix="arm")
    assert (written(prefix="controller"), written()) == 2 * ((fast_run[0] / "controller.h").read_text(),)
    manifest = out / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"double"', '"half"'))
    with pytest.raises(InputError, match=r"manifest\.json: number must be 'double' or 'float'; got 'half'"):
        written()


def test_a_run_leaves_its_controller(fast_run, tmp_path):
    run, _ = fast_run
    law = Controller.from_json((run / "controller.json").read_text())
    stored = RunResults(RunDirectory.open(run)).design.synthesis.controller
    np.testing.assert_array_equal(law.A, stored.A)
    assert "controller_step" in (run / "controller.h").read_text()
    assert "NOT CERTIFIED" not in (run / "controller.c").read_text()
    for path in write_controller(tmp_path, law, None, certified=False):
        assert b"NOT CERTIFIED" in path.read_bytes(), path.name


def test_changed_stage_file_makes_the_later_stages_again(fast_run, tmp_path, plain_page):
    out = tmp_path / "run"
    shutil.copytree(fast_run[0], out)
    run = RunDirectory(out)
    found = RunResults(run).closed_loop.check
    # Same input hash, other content: only what comes after it may change.
    hash_before = str(storage.read_npz(run.stage_file("closed_loop"))["_input_hash"])
    changed = replace(found, disturbance=np.zeros(1))
    run.save_stage("closed_loop", ClosedLoopResult(check=changed), hash_before)
    watch = Watch()
    run_from_files(FAST_ARM, out, resume=True, progress=watch)
    assert watch.made == ["report"]


def test_changed_config_is_refused_and_nothing_is_touched(fast_run, tmp_path):
    changed = tmp_path / "fast_arm.toml"
    changed.write_text(FAST_ARM.read_text().replace("bandwidth_rad_s = 1.5", "bandwidth_rad_s = 1.6"))
    before = stage_bytes(fast_run[0])
    with pytest.raises(InputError, match=r"specification\.bandwidth_rad_s \(was 1\.5, now 1\.6\)"):
        run_from_files(changed, fast_run[0], resume=True)
    assert stage_bytes(fast_run[0]) == before


def test_reformatted_config_is_not_a_changed_one(fast_run, tmp_path):
    same = tmp_path / "other_name.toml"
    same.write_text("# a comment more\n" + FAST_ARM.read_text().replace("= 1.5", "=  1.50"))
    assert run_from_files(same, fast_run[0], resume=True).numbers == fast_run[1].numbers


def test_two_runs_give_the_same_bytes_and_another_seed_does_not(fast_run, tmp_path, plain_page):
    (tmp_path / "again.toml").write_text(text := FAST_ARM.read_text())
    (tmp_path / "other.toml").write_text(text.replace("seed = 7", "seed = 8"))
    run_from_files(tmp_path / "again.toml", tmp_path / "again")
    assert_same_run(fast_run[0], tmp_path / "again")
    run = RunResults(RunDirectory(fast_run[0]))
    for name, same in (("again", True), ("other", False)):
        config, _ = load_config(tmp_path / f"{name}.toml")
        found = make_records(StageInput(config, run, Progress())).records
        assert np.array_equal(found[0].record.output, run.records.records[0].record.output) == same
