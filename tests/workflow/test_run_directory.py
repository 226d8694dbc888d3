"""What a run directory refuses, remembers and takes up again."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from workflow.engine.errors import InputError
from workflow.engine.randomness import stage_rng
from workflow.engine.run_directory import RunDirectory, default_directory, hash_of
from workflow.engine.store import first_difference

CONFIG = {"run": {"name": "a", "seed": 1}, "channels": [{"input": "u", "output": "y"}]}


def begin(path, config=CONFIG, **how):
    return RunDirectory(path).begin_run(config_text="# text\n", config=config, seed=1, **{"inputs": {}} | how)


def test_begin_writes_config_and_manifest(tmp_path):
    run = begin(tmp_path / "run", inputs={"log.csv": "00ff"})
    manifest = json.loads(run.manifest_path.read_text())
    assert (run.path / "config.toml").read_text() == "# text\n"
    assert run.config_document() == CONFIG
    assert manifest["seed"] == 1
    assert manifest["inputs"] == {"log.csv": "00ff"}
    assert manifest["status"] == "running"
    assert manifest["config_sha256"] == hash_of(CONFIG)
    assert "numpy" in manifest["versions"]


def test_non_empty_directory_is_refused_without_resume(tmp_path):
    begin(tmp_path / "run")
    with pytest.raises(InputError, match=r"not empty.*--resume"):
        begin(tmp_path / "run")


def test_no_run_is_offered_where_there_is_none(tmp_path):
    (tmp_path / "01_prbs.csv").write_text("t,u\n")
    with pytest.raises(InputError, match=r"not empty \(it holds '01_prbs\.csv'\); choose another --out$"):
        RunDirectory(tmp_path).refuse_unless_free()


def test_a_place_that_takes_no_files_is_refused_before_the_work():
    with pytest.raises(InputError, match=r"cannot write /proc/run: [^/]*$"):
        RunDirectory(Path("/proc/run")).refuse_unless_free()


@pytest.mark.parametrize("how", [{"resume": True}, {"replace": True}])
def test_somebody_elses_directory_is_never_touched(tmp_path, how):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"no run is there.*thesis\.txt"):
        begin(tmp_path, **how)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.txt"]


def test_replace_keeps_what_is_not_ours(tmp_path):
    run = begin(tmp_path / "run")
    run.save_stage("records", Found(1.0, ""), "hash")
    (run.path / "my notes.txt").write_text("mine")
    run = begin(tmp_path / "run", replace=True)
    assert run.stage_file("records") is None
    assert (run.path / "my notes.txt").read_text() == "mine"


def test_changed_input_file_is_refused_naming_the_file(tmp_path):
    begin(tmp_path / "run", inputs={"log.csv": "00"})
    with pytest.raises(InputError, match=r"changed since the run began: inputs\.log\.csv"):
        begin(tmp_path / "run", inputs={"log.csv": "01"}, resume=True)


def test_directory_killed_before_its_manifest_is_begun_afresh(tmp_path):
    run = begin(tmp_path / "run")
    run.manifest_path.unlink()
    again = begin(tmp_path / "run", config={"run": {"name": "b"}}, resume=True)
    assert again.config_document()["run"]["name"] == "b"


def test_open_refuses_what_is_no_run(tmp_path):
    with pytest.raises(InputError, match="no such run directory"):
        RunDirectory.open(tmp_path / "absent")
    with pytest.raises(InputError, match=r"manifest\.json is missing"):
        RunDirectory.open(tmp_path)


@dataclass(frozen=True, eq=False)
class Found:
    gain: float
    text: str
    trace: npt.NDArray[np.float64] | None = None


@pytest.mark.parametrize("trace", [None, np.arange(3.0)], ids=["json", "npz"])
def test_stage_round_trip_and_hash(tmp_path, trace):
    run = begin(tmp_path / "run")
    path = run.save_stage("design", Found(float("inf"), "θ <b>", trace), "abc")
    assert path.suffix == (".json" if trace is None else ".npz")
    back = run.load_stage("design", Found)
    assert (back.gain, back.text) == (float("inf"), "θ <b>")
    np.testing.assert_array_equal(back.trace, trace)
    assert run.is_done("design", "abc")
    assert not run.is_done("design", "abd")
    assert not run.is_done("other", "abc")


def test_stage_that_changes_its_kind_leaves_one_file(tmp_path):
    run = begin(tmp_path / "run")
    run.save_stage("design", Found(1.0, "", np.zeros(2)), "1")
    run.save_stage("design", Found(1.0, ""), "2")
    assert [entry.name for entry in run.stages_path.iterdir()] == ["design.json"]


def test_damaged_stage_counts_as_not_done(tmp_path):
    run = begin(tmp_path / "run")
    path = run.save_stage("identify", Found(1.0, "", np.zeros(200)), "1")
    path.write_bytes(path.read_bytes()[:100])
    assert not run.is_done("identify", "1")


def test_lock_clears_what_a_killed_writer_left(tmp_path):
    run = begin(tmp_path / "run")
    (run.stages_path / ".records.npz.123.part").write_bytes(b"half")
    with run.locked():
        assert list(run.stages_path.iterdir()) == []


def test_default_directory_is_free(tmp_path):
    first = default_directory("arm", tmp_path)
    first.mkdir()
    assert default_directory("arm", tmp_path) != first


def test_first_difference_names_list_entries_and_types():
    assert first_difference({"a": [1, 2]}, {"a": [1, 3]}) == "a[1] (was 2, now 3)"
    assert first_difference({"a": 1}, {"a": 1, "b": 2}) == "b (was absent, now 2)"
    assert first_difference({"a": float("nan")}, {"a": float("nan")}) is None
    assert first_difference({"a": 1}, {"a": True}) == "a (was 1, now True)"


def test_streams_depend_on_seed_and_names_only():
    draw = stage_rng(1, "records", "prbs").standard_normal(4)
    stage_rng(1, "identify").standard_normal(100)
    np.testing.assert_array_equal(stage_rng(1, "records", "prbs").standard_normal(4), draw)
    for other in ((2, "records", "prbs"), (1, "recordsprbs"), (1, "prbs", "records")):
        assert not np.array_equal(stage_rng(*other).standard_normal(4), draw)
