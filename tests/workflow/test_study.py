"""The tuning study on processes of this machine."""

import csv
import os
import shutil
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.workflow.command import FAST_ARM, finish, kill, start_flexlink, wait_until
from tests.workflow.page_shape import shape_faults
from tests.workflow.study_examples import PLAIN, SMALL_STUDY, assert_same_study, point_bytes, write_study
from workflow.config.run_config import load_config
from workflow.engine import codec
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.study.directory import StudyDirectory
from workflow.study.settings import load_study
from workflow.study.work import run_study
from workflow.tasks.pipeline import config_of
from workflow.tasks.results import RunResults


def rows_of(out: Path) -> list[dict[str, str]]:
    with open(out / "table.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def test_every_point_has_a_row_in_the_order_of_the_axes(small_study):
    out, summary = small_study
    rows = rows_of(out)
    assert [row["number"] for row in rows] == ["1", "2", "3", "4", "5", "6"]
    assert [float(row["specification.bandwidth_rad_s"]) for row in rows] == [1, 1, 1.5, 1.5, 1e5, 1e5]
    effects = [row["closed_loop.effects"] for row in rows[:2]]
    assert effects == ["[]", "[{name = tip_payload, mass_kg = 0.02}]"]
    assert summary.certified
    assert [point["state"] for point in summary.numbers["points"]] == [row["state"] for row in rows]


def test_impossible_points_are_results_with_their_reason(small_study):
    for row in rows_of(small_study[0])[4:]:
        assert row["state"] == "impossible"
        assert "bandwidth_rad_s = 1e+05 rad/s lies beyond the Nyquist frequency" in row["why"]
        assert row["worst_gamma"] == row["modulus_margin"] == ""


def test_numbers_are_those_of_the_certificate(small_study):
    out, _ = small_study
    for row in rows_of(out)[:4]:
        run = RunDirectory.open(out / "points" / row["name"])
        results = RunResults(run)
        assert (row["state"] == "certified") == results.certify.certified
        verdict = results.certify.certificate.plants[0]
        assert float(row["modulus_margin"]) == verdict.worst_margins.modulus
        assert float(row["bandwidth_rad_s"]) == verdict.bandwidth_rad_s
        achieved = results.closed_loop.check.achieved
        assert float(row["peak_command"]) == max(one.peak_command for one in achieved)


@pytest.mark.slow
def test_a_point_is_what_flexlink_run_makes_of_its_configuration(small_study, tmp_path):
    # Independent of the study: the ordinary pipeline, from the records on, on the point's own TOML, in a
    # process as fresh as the study's own (this one has other compiled variants of the kernels in memory).
    out, _ = small_study
    point = out / "points" / rows_of(out)[3]["name"]
    process = start_flexlink("run", "--config", point / "config.toml", "--out", tmp_path / "run")
    _, error = process.communicate()
    assert process.returncode in (0, 3), error.decode()
    for path in (point / "stages").iterdir():
        assert (tmp_path / "run" / "stages" / path.name).read_bytes() == path.read_bytes(), path.name


def test_points_open_with_the_usual_tools(small_study, tmp_path, flexlink):
    out, _ = small_study
    point = tmp_path / "point"
    shutil.copytree(out / "points" / rows_of(out)[0]["name"], point)
    config, _ = load_config(point / "config.toml")
    assert config == config_of(RunDirectory.open(point))
    answer = flexlink("report", point, "--json")
    assert answer.code == 0, answer.err
    assert (point / "report.html").is_file()
    for row in rows_of(out):
        by_number = out / "points" / row["number"]
        assert by_number.exists() == (row["state"] != "failed"), row
        assert by_number.resolve().name == row["name"]
    again, other = (RunDirectory.open(path).config_document() for path in (out / "points" / "1", point))
    assert again == other


def test_points_of_one_design_share_controller_and_plant(small_study):
    out, _ = small_study
    first, second = (out / "points" / row["name"] / "stages" for row in rows_of(out)[:2])
    for name in ("uncertainty.npz", "design.npz", "certify.json"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    assert (first / "closed_loop.npz").read_bytes() != (second / "closed_loop.npz").read_bytes()
    assert len(list((out / "plants").iterdir())) == 1


def test_resuming_computes_only_what_is_missing(small_study, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(small_study[0], out)
    names = [row["name"] for row in rows_of(out)]
    shutil.rmtree(out / "points" / names[1])
    (out / "points" / names[2] / "stages" / "certify.json").unlink()
    for name in ("table.csv", "table.json", "study.html"):
        (out / name).unlink()
    kept = {n: (out / "points" / n / "stages/design.npz").stat().st_mtime_ns for n in (names[0], names[3])}
    run_study(load_study(write_study(tmp_path)), out, resume=True, jobs=1)
    assert_same_study(small_study[0], out)
    for name, before in kept.items():
        assert (out / "points" / name / "stages/design.npz").stat().st_mtime_ns == before


class Watch(Progress):
    """Remembers what was said."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.planned: list[str] = []

    def plan(self, stages):
        self.planned = [name for name, _ in stages]

    def update(self, stage, fraction, message=""):
        assert 0 <= fraction <= 1
        self.messages.append(message)


def test_a_finished_study_is_taken_up_and_can_be_extended(small_study, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(small_study[0], out)
    before = point_bytes(out)
    more = SMALL_STUDY.replace("1e5", "1e5, 2e5")
    watch = Watch()
    run_study(load_study(write_study(tmp_path, more)), out, resume=True, jobs=1, progress=watch)
    assert len(rows_of(out)) == 8
    assert watch.planned == ["plant", "points", "page"]
    assert watch.messages[-1].startswith("8 of 8, ")
    after = point_bytes(out)
    assert {name: after[name] for name in before} == before


def test_page_and_picture_are_there(small_study, faults_seen):
    out, _ = small_study
    page = (out / "study.html").read_text()
    assert faults_seen(out / "study.html") == []
    assert "small" in page
    assert "(impossible): bandwidth_rad_s = 1e+05" in page
    assert "<figure>" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert (out / "pareto.svg").is_file()


def test_the_first_screen_of_a_study(small_study, browser):
    assert shape_faults(browser, small_study[0] / "study.html", screens=3) == []


def test_a_run_directory_is_a_base_and_other_ellipses_are_made_once(fast_run, tmp_path):
    text = f"""
[study]
base = "{fast_run[0]}"
[changes]
"closed_loop.conditions" = false
[[axes]]
key = "channels[0].uncertainty.level"
values = [0.6, 0.95]
[[axes]]
key = "closed_loop.draws"
values = [1, 2]
"""
    out = tmp_path / "out"
    run_study(load_study(write_study(tmp_path, text)), out, jobs=2)
    rows = rows_of(out)
    assert len(list((out / "plants").iterdir())) == 2
    gammas = [float(row["worst_gamma"]) for row in rows]
    assert gammas[0] == gammas[1]
    assert gammas[2] == gammas[3]
    radii = []
    for row in rows:
        found = RunResults(RunDirectory(out / "points" / row["name"])).uncertainty
        radii.append([band.median_radius_percent for band in found.channels[0].bands])
    np.testing.assert_array_equal(radii[0], radii[1])
    # chi-square of two degrees of freedom: the squared radius is -2 log(1 - level).
    np.testing.assert_allclose(np.array(radii[2]) / radii[0], np.sqrt(np.log(0.05) / np.log(0.4)), rtol=1e-6)
    # The base's own level and specification: the run again.
    own = RunDirectory(out / "points" / rows[2]["name"])
    for name in ("identify.npz", "uncertainty.npz"):
        assert (own.path / "stages" / name).read_bytes() == (fast_run[0] / "stages" / name).read_bytes()
    assert codec.plain(RunResults(own).design) == codec.plain(RunResults(RunDirectory(fast_run[0])).design)


@pytest.mark.long
def test_contradictions_between_axes_are_points_without_a_run(tmp_path):
    text = (
        PLAIN
        + """
[[axes]]
key = "specification.effort_rolloff_rad_s"
values = [60.0]
[[axes]]
key = "specification.effort_limit"
values = [60.0, 1e-6]
[[axes]]
key = "specification.controller_order"
values = [4]
[[axes]]
key = "specification.structure"
values = ["biquads", "pid"]
"""
    )
    out = tmp_path / "out"
    summary = run_study(load_study(write_study(tmp_path, text)), out, jobs=2)
    states = [point["state"] for point in summary.numbers["points"]]
    # The order is stated, and a PID has its own; a limit of nothing cannot be met.
    assert states[1] == states[3] == "impossible"
    assert states[2] in ("impossible", "not certified")
    assert "leave controller_order out" in summary.numbers["points"][1]["why"]


@pytest.mark.slow
def test_points_that_fail_are_named_and_the_others_stand(flexlink, tmp_path):
    text = (
        PLAIN
        + """
[[axes]]
key = "channels[0].uncertainty.fir_length"
values = [40, 690]
"""
    )
    # 700 samples do not carry a response of 690 coefficients.
    answer = flexlink(
        "study", "--config", write_study(tmp_path, text), "--out", tmp_path / "out", "--jobs", 1
    )
    assert answer.code == 1
    assert answer.err.count("\n") == 1
    assert "1 of 2 points failed" in answer.err
    assert "point 2: " in answer.err
    rows = rows_of(tmp_path / "out")
    assert [row["state"] for row in rows] == ["certified", "failed"]
    assert "fir_length" in rows[1]["why"]


@pytest.mark.long
def test_a_base_that_cannot_be_identified_is_refused(refused, tmp_path):
    study = write_study(
        tmp_path, SMALL_STUDY.replace("[changes]", '[changes]\n"channels[0].uncertainty.fir_length" = 690')
    )
    line = refused("study", "--config", study, "--out", tmp_path / "out", "--jobs", 1)
    assert "the base cannot be identified" in line
    assert not (tmp_path / "out").exists()


def children_of(pid: int) -> list[int]:
    """Child processes, from the system's own books."""
    try:
        return [
            int(w) for one in Path(f"/proc/{pid}/task").glob("*/children") for w in one.read_text().split()
        ]
    except OSError:
        return []


def workers_of(pid: int) -> list[int]:
    """Processes forked off the one that has loaded the libraries."""
    return [worker for child in children_of(pid) for worker in children_of(child)]


@pytest.mark.slow
def test_killed_study_resumes_with_identical_numbers_and_leaves_no_process(small_study, tmp_path):
    out = tmp_path / "out"
    study = write_study(tmp_path)
    process = start_flexlink("study", "--config", study, "--out", out, "--jobs", 2)
    wait_until(lambda: list(out.glob("points/*/stages/closed_loop.*")), process)
    workers: list[int] = []
    # One that ended may be just being replaced.
    wait_until(lambda: workers.extend(workers_of(process.pid)) or workers, process)
    kill(process)
    assert not (out / "study.html").exists()
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{pid}/statm").exists() for pid in workers):
        assert time.monotonic() < deadline, "a worker outlived the study"
        time.sleep(0.05)
    run_study(load_study(study), out, resume=True, jobs=2)
    assert_same_study(small_study[0], out)


@pytest.mark.long
def test_killed_worker_is_replaced(small_study, tmp_path):
    out = tmp_path / "out"
    process = start_flexlink("study", "--config", write_study(tmp_path), "--out", out, "--jobs", 2)
    wait_until(lambda: list(out.glob("plants/*/manifest.json")), process)
    wait_until(lambda: len(workers_of(process.pid)) >= 2, process)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    finish(process)
    assert_same_study(small_study[0], out)


# -- what is refused, each with one line
# --------------------------------------------------------------------------------------


BANDWIDTH, VALUES = "specification.bandwidth_rad_s", "values = [1.0, 1.5, 1e5]"
PARETO = "[[pareto]]\nx = 'speed'\ny = 'modulus_margin'\n[study]"


@pytest.mark.parametrize(
    ("was", "now", "expected"),
    [
        ("draws", "drawz", "changes: unknown key closed_loop.drawz (did you mean draws?)"),
        ('"closed_loop.draws" = 2', '"closed_loop.draws" = 0', "closed_loop.draws"),
        ("bandwidth", "bandwith", "values[0]: unknown key specification.bandwith_rad_s (did you mean bandwi"),
        ("1.0, 1.5, 1e5", "1.0, -1.5", f"axes[0].values[1]: {BANDWIDTH}"),
        ("1.0, 1.5, 1e5", "1.0, true", f"axes[0].values[1]: {BANDWIDTH}: input should be a valid number"),
        ("1.0, 1.5, 1e5", "1.0, 1.0", "axes[0]: the value 1.0 is listed twice"),
        (VALUES, "from = 1.0", "axes[0]: a range needs from and to"),
        (VALUES, "from = 1.0\nto = 2.0", "a grid over a range needs points"),
        (VALUES, "from = 2.0\nto = 1.0", "from below to"),
        (VALUES, "", "axes[0]: give values, or from and to"),
        (VALUES, "values = []", "axes[0]: values is empty"),
        (SMALL_STUDY, FAST_ARM.read_text(), "a configuration of a run; name it in a study file: [study] "),
        ('key = "closed_loop.effects"', 'key = "closed loop"', "not a dotted key"),
        ("tip_payload", "tip_paylod", "axes[1].values[1]: closed_loop.effects[0]"),
        ('label = "effects"', 'label = "asked"', "two axes have the same label 'asked'"),
        ('title = "small"', 'titel = "small"', "unknown key study.titel (did you mean title?)"),
        (str(FAST_ARM), "nowhere.toml", "study.base: no such file or run directory"),
        ("[study]", PARETO, "pareto[0].x: no column 'speed'"),
        (
            "[study]",
            "[search]\nmethod = 'optuna'\n[study]",
            "unknown key search (a study computes its whole gr",
        ),
        (
            "closed_loop.draws",
            "yardstick.compute",
            "unknown key yardstick (it is called achievable_performance ",
        ),
        (BANDWIDTH, "specification.kp", "specification.kp (it is called fixed.kp today)"),
    ],
)
def test_bad_studies_are_refused(refused, tmp_path, was, now, expected):
    assert was in SMALL_STUDY
    path = write_study(tmp_path, SMALL_STUDY.replace(was, now))
    line = refused("study", "--config", path, "--out", tmp_path / "out")
    assert expected in line
    assert "study.toml" in line
    assert not (tmp_path / "out").exists()


def test_places_that_are_taken_are_refused(refused, small_study, tmp_path):
    study = write_study(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("")
    line = refused("study", "--config", study, "--out", tmp_path / "other")
    assert "not empty (it holds 'thesis.tex')" in line
    line = refused("study", "--config", study, "--out", small_study[0])
    assert "an earlier study is there" in line
    assert "--resume" in line
    for option in ("--resume", "--replace"):
        line = refused("study", "--config", study, "--out", tmp_path / "other", option)
        assert "no study is there" in line
    assert (tmp_path / "other" / "thesis.tex").is_file()
    assert "it is a study: open its study.html, or name a point" in refused("report", small_study[0])
    line = refused("study", "--config", study, "--out", small_study[0], "--resume", "--replace")
    assert "--resume and --replace contradict each other" in line


def test_replacing_a_study_deletes_what_was_its_own_and_nothing_else(tmp_path):
    base = SimpleNamespace(config=load_config(FAST_ARM)[0], inputs={}, digests={}, run=None)
    first = StudyDirectory(tmp_path / "out").begin_study(text="first", base=base, resume=False)
    (first.points_path / "old").mkdir()
    (first.path / "table.csv").write_text("old")
    (first.path / "notes.txt").write_text("mine")
    other = SimpleNamespace(**{**vars(base), "digests": {"records": "other"}})
    with pytest.raises(InputError, match=r"began: stages_taken_over.records .was absent.*--replace"):
        first.begin_study(text="second", base=other, resume=True)
    refusal = pytest.raises(InputError, match="another process is writing this study")
    with first.locked(), refusal, first.writing(replace=True):
        first.begin_study(text="second", base=other, resume=False, replace=True)
    assert (first.points_path / "old").is_dir()
    second = first.begin_study(text="second", base=other, resume=False, replace=True)
    held = {path.name for path in second.path.iterdir()}
    assert held == {"study.toml", "study.json", "plants", "points", "lock", "notes.txt"}
    assert not any(second.points_path.iterdir())
    assert (second.path / "study.toml").read_text() == "second"


def test_a_study_is_not_replaced_by_one_that_starts_from_a_run_in_it(tmp_path):
    base = SimpleNamespace(config=load_config(FAST_ARM)[0], inputs={}, digests={}, run=None)
    first = StudyDirectory(tmp_path / "out").begin_study(text="first", base=base, resume=False)
    own = SimpleNamespace(**{**vars(base), "run": RunDirectory(first.points_path / "best")})
    with pytest.raises(InputError, match="--replace would delete the base"):
        first.begin_study(text="second", base=own, resume=False, replace=True)
    assert (first.path / "study.json").is_file()


def test_resuming_with_another_base_is_refused(refused, small_study, tmp_path):
    study = write_study(tmp_path, SMALL_STUDY.replace('"closed_loop.draws" = 2', '"closed_loop.draws" = 3'))
    line = refused("study", "--config", study, "--out", small_study[0], "--resume")
    assert "closed_loop.draws (was 2, now 3)" in line


def test_jobs_and_scheduler_are_checked(refused, tmp_path):
    study = write_study(tmp_path)
    assert "'--jobs'" in refused("study", "--config", study, "--out", tmp_path / "o", "--jobs", 0)
    line = refused(
        "study", "--config", study, "--out", tmp_path / "o", "--jobs", 2, "--scheduler", "tcp://127.0.0.1:9"
    )
    assert "contradict" in line


@pytest.mark.slow
def test_nothing_certified_is_exit_code_3(flexlink, tmp_path):
    path = write_study(tmp_path, SMALL_STUDY.replace("1.0, 1.5, 1e5", "1e5"))
    answer = flexlink("study", "--config", path, "--out", tmp_path / "out", "--jobs", 1, "--json")
    assert len(answer.document(3)["numbers"]["points"]) == 2
    assert "no point is certified" in answer.err
    assert (tmp_path / "out" / "study.html").is_file()
