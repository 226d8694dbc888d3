"""`flexlink run --from RUN`: what was made from the same is taken over, and nothing else."""

import json
import shutil

import pytest

from tests.workflow.command import FAST_ARM
from tests.workflow.test_resume import Watch, assert_same_run, plain_page, stage_bytes  # noqa: F401
from workflow.commands.run import run_from_files
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.changed_specification import with_typed

PLANT = ["records", "identify", "uncertainty"]


def changed_to(run, out, watch=None, **typed):
    return run_from_files(None, out, earlier_path=run, typed=typed, progress=watch or Watch())


@pytest.mark.slow
def test_a_changed_bandwidth_gives_the_numbers_of_a_fresh_run(fast_run, tmp_path, plain_page):  # noqa: F811
    before = stage_bytes(fast_run[0])
    watch = Watch()
    summary = changed_to(fast_run[0], tmp_path / "again", watch, bandwidth_rad_s=1.2)
    assert watch.taken_up == PLANT
    assert stage_bytes(fast_run[0]) == before
    own = tmp_path / "fast_arm.toml"
    own.write_text(FAST_ARM.read_text().replace("bandwidth_rad_s = 1.5", "bandwidth_rad_s = 1.2"))
    fresh = run_from_files(own, tmp_path / "fresh")
    assert_same_run(tmp_path / "again", tmp_path / "fresh")
    assert summary.numbers == fresh.numbers
    # The new run says where they come from, stands alone, and is the start of the next one.
    stages = RunDirectory.open(tmp_path / "again").manifest()["stages"]
    assert [name for name, entry in stages.items() if entry.get("taken_over_from")] == PLANT
    watch = Watch()
    run_from_files(
        tmp_path / "again" / "config.toml",
        tmp_path / "third",
        earlier_path=tmp_path / "again",
        progress=watch,
    )
    assert watch.made == ["report"]


def test_nothing_changed_leaves_the_page_to_be_drawn(fast_run, tmp_path, plain_page):  # noqa: F811
    watch = Watch()
    summary = changed_to(fast_run[0], tmp_path / "same", watch)
    assert watch.made == ["report"]
    (stages,) = summary.to_document()["taken_over"].values()
    assert stages == watch.taken_up


def test_a_killed_run_is_taken_as_far_as_it_goes(fast_run, tmp_path, plain_page):  # noqa: F811
    killed = tmp_path / "killed"
    shutil.copytree(fast_run[0], killed)
    for stage in ("certify", "closed_loop", "report"):
        for path in (killed / "stages").glob(f"{stage}.*"):
            path.unlink()
    damaged = killed / "stages" / "reference_filter.json"
    damaged.write_text(damaged.read_text().replace(" ", "  ", 1)[:-20])
    watch = Said()
    changed_to(killed, tmp_path / "new", watch)
    missing = (
        f"of {killed}/stages certify, closed_loop are missing and reference_filter is damaged: done again"
    )
    assert watch.notes[0] == missing
    assert watch.made[:2] == ["certify", "reference_filter"]
    assert set(watch.taken_up) == {*PLANT, "design", "achievable_performance"}


class Said(Watch):
    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []

    def note(self, line: str) -> None:
        self.notes.append(line)


def test_what_is_taken_over_is_said_and_why_nothing_is(fast_run, tmp_path, plain_page, monkeypatch):  # noqa: F811
    said = Said()
    changed_to(fast_run[0], tmp_path / "new", said)
    assert said.notes[-1].startswith(f"taken over from {fast_run[0]}, whose inputs are the same: records, ")
    other = tmp_path / "other"
    shutil.copytree(fast_run[0], other)
    manifest = other / "manifest.json"
    document = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(document | {"code_sha256": "0"}))
    # As of another version: no hash agrees.
    monkeypatch.setattr("workflow.tasks.pipeline.code_digest", lambda **_: "1")
    monkeypatch.setattr("workflow.tasks.pipeline._perform", lambda *_, **__: 1 / 0)
    said = Said()
    with pytest.raises(ZeroDivisionError):
        changed_to(other, tmp_path / "newer", said)
    assert said.notes == [f"nothing of {other} is taken over: it was made by another version of flexlink"]


def test_what_cannot_be_a_start_is_refused_in_one_line(refused, fast_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = fast_run[0]
    log = tmp_path / "log.csv"
    log.write_text("t_s,u_V,y_rad\n0,0,0\n0.01,1,0\n0.02,0,1\n")
    (tmp_path / "empty").mkdir()
    assert "empty: not a run directory" in refused("run", "--from", "empty")
    assert "absent: no such run directory" in refused("run", "--from", "absent")
    words = refused("run", log, "--from", run)
    assert "it was made from no file, not from log.csv: no stage can be taken over; leave --from out" in words
    assert "which stays as it is; choose another --out" in refused("run", "--from", run, "--out", run)
    assert "give one of the two" in refused("run", "--from", run, "--out", "new", "--resume")
    assert "--bandwidth: input should be greater than 0" in refused(
        "run", "--from", run, "--bandwidth", "-1", "--out", "new"
    )
    assert "'some' is not a valid float, nor none" in refused("run", "--from", run, "--effort-limit", "some")
    both = "--from", run, "--out", "new", "--resume", "--bandwidth", "3"
    assert "give one of the two" in refused("run", *both)
    assert "--bandwidth: write it into" in refused("run", "--config", FAST_ARM, "--bandwidth", "2")
    assert "needs a larger bandwidth_rad_s" in refused(
        "run", "--from", run, "--lowest-bandwidth", "50", "--out", "new"
    )
    older = tmp_path / "older"
    shutil.copytree(run, older)
    manifest = older / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"layout": 9}))
    assert "written by another version of flexlink" in refused("run", "--from", older, "--out", "new")
    assert not (tmp_path / "new").exists()
    assert not (tmp_path / "runs").exists()


def test_a_design_for_a_run_has_its_page(flexlink, refused, fast_run, tmp_path, undrawn):
    asked = tmp_path / "asked.toml"
    asked.write_text("bandwidth_rad_s = 1.0\neffort_limit = 60.0\ncontroller_order = 2\n")
    page = tmp_path / "design.html"
    answer = flexlink("design", fast_run[0], "--spec", asked, "--report", page)
    assert answer.code == 0, answer
    assert f"report: {page}" in answer.out
    text = page.read_text()
    assert "Certified, but the closed loop was not simulated" in text
    assert "Identification" in text
    # The page is about the design, and names no files of the run as its own.
    assert "<h1>design.html: a design for the run " in text
    assert "python-control" not in text
    assert "Beside this page" not in text
    slower = tmp_path / "slower.toml"
    slower.write_text(asked.read_text() + "controller_dt_s = 0.02\n")
    words = refused("design", fast_run[0], "--spec", slower)
    assert f"{slower}: specification: controller_dt_s = 0.02 s, but plant" in words
    model = fast_run[0] / "model.json"
    words = refused("design", model, "--spec", asked, "--report", page)
    assert "a page shows one run's records and model: give one run directory" in words


def test_a_typed_value_is_hard_and_leaves_the_rest_as_it_was():
    drafted = {"bandwidth_rad_s": 32.0, "lowest_bandwidth_rad_s": 1.0, "effort_limit": 2.2}
    drafted |= {"highest_effort_limit": 8.8, "modulus_margin": 0.5}
    assert with_typed(drafted, {}) == drafted
    typed = with_typed(drafted, {"effort_limit": 3.0})
    assert typed == {key: typed[key] for key in drafted if key != "highest_effort_limit"}
    assert (typed["effort_limit"], typed["lowest_bandwidth_rad_s"]) == (3.0, 1.0)
    # None leaves a key out, what it might give way to, and what shapes it.
    shaped = {**drafted, "effort_rolloff_rad_s": 100.0}
    free = with_typed(shaped, {"effort_limit": None})
    assert free == {key: shaped[key] for key in shaped if "effort" not in key}
    # A limit that is typed beside it stays one.
    both = {"effort_limit": 3.0, "highest_effort_limit": 4.0}
    assert with_typed(drafted, both) == drafted | both
    assert with_typed(drafted, {"highest_effort_limit": 4.0}) == drafted | {"highest_effort_limit": 4.0}
