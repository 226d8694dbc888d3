"""A disk that is full, a directory that is gone or somebody else's, a clock set back, another current folder:
one line, exit 2, nothing half-written; what can be continued ends with the same bytes."""

import errno
import json
import os
import shutil
from pathlib import Path

import pytest

import workflow.diagnose.command
from tests.workflow.command import FAST_ARM, build_nothing, finish, start_flexlink
from tests.workflow.diagnosis_examples import FRICTION, KnownAnswer, write_case
from tests.workflow.study_examples import TWO_POINTS, write_study
from tests.workflow.test_design_sources import QUICK, WISH, arm, document
from tests.workflow.test_identify_command import COLUMNS, p2_log
from tests.workflow.test_resume import NAMES, Watch, assert_same_run
from workflow.commands.run import run_from_files
from workflow.diagnose.directory import DiagnosisDirectory
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.study.directory import StudyDirectory

ONE_POINT = TWO_POINTS.replace("[1.0, 1.5]", "[1.0]")


class FullDisk:
    """Has no room for a file, the first time that it is written; only: names that this befalls."""

    def __init__(self, monkeypatch, only=None):
        self.refused, self.only, self._fsync = [], only, os.fsync
        monkeypatch.setattr(os, "fsync", self)

    def __call__(self, descriptor):
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        name = path.name[1:].rsplit(".", 2)[0]  # .NAME.PID.part
        chosen = path.suffix == ".part" and (self.only is None or name in self.only)
        if chosen and (path.parent, name) not in self.refused:
            self.refused.append((path.parent, name))
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._fsync(descriptor)


@pytest.fixture
def continued(flexlink):
    """Call until it ends, --resume from the second time on; every failure is one line that names the file."""

    def call(disk, *arguments):
        for again in range(60):
            answer = flexlink(*arguments, *(["--resume"] if again else []))
            if answer.code != 2:
                return answer
            folder, name = disk.refused[-1]
            assert answer.err == f"flexlink: cannot write {folder / name}: No space left on device\n"
            assert not list(folder.glob(".*")), "something half-written is left"
        raise AssertionError("no end")

    return call


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_run_goes_on_after_every_file_for_which_there_was_no_room(
    fast_run, tmp_path, monkeypatch, continued
):
    # Of the pictures, which are written together, the first and the last.
    between = sorted(path.name for path in (fast_run[0] / "figures").iterdir())[1:-1]
    written = {path.name for path in fast_run[0].rglob("*") if path.is_file()}
    disk = FullDisk(monkeypatch, written.difference(between))
    build_nothing(monkeypatch)  # the fixture's run has drawn them
    out = tmp_path / "run"
    assert continued(disk, "run", "--config", FAST_ARM, "--out", out).code == 0
    assert_same_run(fast_run[0], out)
    names = {name for _, name in disk.refused}
    stages = {path.name for path in (out / "stages").iterdir()}
    assert {"config.toml", "manifest.json", "controller.c", "report.html", *stages} <= names


def test_a_run_for_which_there_is_no_room_at_all_leaves_nothing(tmp_path, monkeypatch, refused):
    FullDisk(monkeypatch, ["config.toml"])
    refused("run", "--config", FAST_ARM, "--out", tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_a_study_goes_on(tmp_path, monkeypatch, continued):
    study = write_study(tmp_path, ONE_POINT)
    names = ["study.json", "identify.npz", "design.npz", "table.csv"]
    disk, out = FullDisk(monkeypatch, names), tmp_path / "out"
    assert continued(disk, "study", "--config", study, "--out", out, "--jobs", 1).code == 0
    assert {name for _, name in disk.refused} == {*names}
    assert "certified" in (out / "table.csv").read_text()


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_a_diagnosis_goes_on(tmp_path, monkeypatch, continued):
    monkeypatch.setattr(workflow.diagnose.command, "diagnose", KnownAnswer((FRICTION,)))
    case = write_case(tmp_path / "c", FRICTION)
    names = ["diagnose.json", "c.json", "c.html", "timings.json"]
    disk = FullDisk(monkeypatch, names)
    call = ("diagnose", case, "--out", tmp_path / "out", "--no-controller")
    assert continued(disk, *call).code == 0
    assert {name for _, name in disk.refused} == {*names}
    answer = json.loads((tmp_path / "out/c.json").read_text())
    assert {*answer["files"], "c.json", "diagnose.json", "timings.json", "lock"} == {
        path.name for path in (tmp_path / "out").iterdir()
    }


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "name", [pytest.param("page.html", marks=pytest.mark.long), "model.json"]
)  # the last
def test_files_of_an_identification_are_all_there_or_none(name, tmp_path, monkeypatch, refused):
    log = p2_log(tmp_path / "log.csv", 1)
    out = tmp_path / "out"
    out.mkdir()
    (out / "model.npz").write_text("an earlier one")
    FullDisk(monkeypatch, [name])
    written = ("--report", out / "page.html", "--out", out / "model.npz", "--export", out / "model.json")
    line = refused("identify", log, *COLUMNS, "--real", 2, "--pairs", 3, *written)
    assert line == f"flexlink: cannot write {out / name}: No space left on device\n"
    assert [path.name for path in out.iterdir()] == ["model.npz"]
    assert (out / "model.npz").read_text() == "an earlier one"


def test_simulated_experiments_are_all_there_or_none(tmp_path, monkeypatch, refused):
    FullDisk(monkeypatch, ["02_fresh_b_prbs_b_.csv"])
    line = refused("simulate", "--config", FAST_ARM, "--out", tmp_path / "new")
    assert "b_.csv: No space left on device" in line
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_files_of_a_design_are_all_there_or_none(tmp_path, monkeypatch, refused):
    (tmp_path / "wish.toml").write_text(WISH + QUICK)
    (tmp_path / "arm.json").write_text(json.dumps(document(arm())))
    (tmp_path / "out").mkdir()
    FullDisk(monkeypatch, ["controller.h"])
    line = refused(
        "design", tmp_path / "arm.json", "--spec", tmp_path / "wish.toml", "--out", tmp_path / "out"
    )
    assert "controller.h: No space left on device" in line
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_page_for_which_there_is_no_room_leaves_the_one_before(
    fast_run, tmp_path, monkeypatch, flexlink, refused
):
    out = tmp_path / "run"
    shutil.copytree(fast_run[0], out)
    before = (out / "report.html").read_bytes()
    names = ["overview.svg", "report.html", "manifest.json"]
    FullDisk(monkeypatch, names)
    for name in names:
        assert f"{name}: No space left on device" in refused("report", out)
        assert name == "manifest.json" or (out / "report.html").read_bytes() == before
    assert flexlink("report", out).code == 0


class Gone(Progress):
    """Somebody deletes the directory when this stage begins."""

    def __init__(self, out, stage):
        self._out, self._stage = out, stage

    def start(self, stage):
        if stage == self._stage:
            shutil.rmtree(self._out)


def test_a_directory_that_vanishes(tmp_path):
    out = tmp_path / "run"
    with pytest.raises(InputError, match=r"uncertainty\.npz: No such file|stage \w+ is not there"):
        run_from_files(FAST_ARM, out, progress=Gone(out, "uncertainty"))
    assert not out.exists()


@pytest.mark.parametrize(
    ("kind", "call"),
    [
        (RunDirectory, ("run", "--config", FAST_ARM)),
        (StudyDirectory, ("study", "--config", "study.toml")),
        (DiagnosisDirectory, ("diagnose", "case")),
    ],
)
@pytest.mark.parametrize("how", [(), ("--resume",), ("--replace",)])
def test_a_second_command_writes_nothing(kind, call, how, tmp_path, monkeypatch, refused):
    """From before it is begun: two configurations would be mixed."""
    monkeypatch.chdir(tmp_path)
    write_study(tmp_path, ONE_POINT)
    write_case(tmp_path / "case", FRICTION)
    with kind(tmp_path / "out").writing():
        line = refused(*call, "--out", "out", *how)
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["lock"]
    assert line == f"flexlink: out: another process is writing this {kind.what}\n"


@pytest.mark.parametrize("seconds", [0.0, 4e9])
def test_a_clock_set_back_or_ahead_makes_nothing_again(seconds, fast_run, tmp_path):
    """What is finished is known by its content."""
    out = tmp_path / "run"
    shutil.copytree(fast_run[0], out)
    for path in out.rglob("*"):
        os.utime(path, (seconds, seconds))
    manifest = json.loads((out / "manifest.json").read_text())
    for stage in manifest["stages"].values():
        stage["finished"] = "2096-01-01T00:00:00+00:00"
    (out / "manifest.json").write_text(json.dumps(manifest))
    watch = Watch()
    run_from_files(FAST_ARM, out, resume=True, progress=watch)
    assert watch.taken_up == NAMES


def test_from_another_folder(fast_run, tmp_path, monkeypatch, flexlink, refused):
    shutil.copytree(fast_run[0], tmp_path / "a/out")
    shutil.copyfile(FAST_ARM, tmp_path / "a/arm.toml")
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "b")
    call = ("run", "--config", "arm.toml", "--out", "out", "--resume")
    assert refused(*call) == "flexlink: cannot read arm.toml: no such file or directory\n"
    assert "out: no run is there" in refused("run", "--out", "out", "--resume")
    assert list((tmp_path / "b").iterdir()) == []
    for again in (("--config", "../a/arm.toml"), ()):
        assert flexlink("run", *again, "--out", "../a/out", "--resume").code == 0
        assert_same_run(fast_run[0], tmp_path / "a/out")


def test_files_are_found_again_from_another_folder(tmp_path, monkeypatch):
    """Logs of a configuration are named from its own folder, whatever folder it is called from."""
    from tests.workflow.test_cli import good_table, write_case as write_own
    from workflow.config.run_config import load_config

    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    own = write_own(tmp_path / "a", good_table())
    monkeypatch.chdir(tmp_path / "a")
    here = load_config(Path(own.name))[0]
    monkeypatch.chdir(tmp_path / "b")
    assert load_config(Path("../a") / own.name)[0].to_document() == here.to_document()


@pytest.mark.parametrize("how", [pytest.param((), marks=pytest.mark.long), ("--json",)])
def test_an_output_that_takes_nothing_is_one_line(how, tmp_path):
    (tmp_path / "log.csv").write_text("t_s,u,y\n" + "".join(f"{k},{k % 3},{k % 5}\n" for k in range(40)))
    with open("/dev/full", "wb") as full:
        process = start_flexlink("look", tmp_path / "log.csv", *how, stdout=full)
        assert finish(process, 2) == "flexlink: cannot write the output: No space left on device\n"
