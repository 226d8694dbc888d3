"""Cases, seal, opening: what a blind run promises; a quick stand-in diagnoses where it may."""

import json
import os
import shutil
import stat
import subprocess
import sys
import tomllib
from contextlib import closing

import numpy as np
import pytest

from plant import Rig, parse_effects, simulate
from tests.workflow.command import ROOT
from validation.blind.cases import NOT_TOGETHER, SHARES, schedule
from validation.blind.generate import answer_toml, folder_hash, generate
from validation.blind.protocol import run_blind
from validation.blind.rigs import TOLERANCES, draw_rig, draw_tolerances, rig_toml, stated
from validation.blind.seal import COMMITMENT, close_seal, has_labels, off_disk, open_seal
from validation.blind.truth import LISTED, UNLISTED
from validation.blind.worker import BlindCase, failed
from workflow.engine.errors import InputError
from workflow.engine.executor import LocalProcesses
from workflow.engine.storage import read_json

LABELS = [{"case": "a", "verdict": "none", "size": 0.1}, {"case": "b", "verdict": "effect", "size": 2.0}]


def test_a_seal_opens_to_what_was_put_in(tmp_path):
    digest = close_seal(tmp_path, LABELS)
    assert read_json(tmp_path / COMMITMENT)["sha256"] == digest
    assert open_seal(tmp_path) == LABELS
    mode = (tmp_path / "seal" / "labels.json").stat().st_mode
    assert stat.S_IMODE(mode) == 0o600
    assert stat.S_IMODE((tmp_path / "seal").stat().st_mode) == 0o700


def test_equal_labels_have_unequal_hashes(tmp_path):
    # Without the salt whoever guesses the labels could check the guess against the commitment.
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    assert close_seal(tmp_path / "one", LABELS) != close_seal(tmp_path / "two", LABELS)


@pytest.mark.parametrize("what", ["label", "salt", "order", "commitment"])
def test_tampering_is_noticed(tmp_path, what):
    close_seal(tmp_path, LABELS)
    path = tmp_path / "seal" / "labels.json"
    sealed = json.loads(path.read_text())
    if what == "label":
        sealed["labels"][1]["verdict"] = "none"
    elif what == "salt":
        sealed["salt"] = "0" * 64
    elif what == "order":
        sealed["labels"].reverse()
    path.write_text(json.dumps(sealed))
    if what == "commitment":
        (tmp_path / COMMITMENT).write_text(json.dumps({"sha256": "0" * 64}))
    with pytest.raises(InputError, match="the seal is broken"):
        open_seal(tmp_path)


def test_a_schedule_has_the_shares_and_every_effect():
    plan = schedule(200, np.random.default_rng(1))
    for sort, share in SHARES.items():
        assert abs(sum(s == sort for s, _, _ in plan) - 200 * share) <= 1
    assert {name for sort, _, name in plan if sort == "clear"} == set(LISTED)
    assert {name for sort, _, name in plan if sort == "unlisted"} == set(UNLISTED)
    assert abs(sum(exact for _, exact, _ in plan) - 100) <= 3
    assert all({a, b} <= set(LISTED) for a, b in NOT_TOGETHER)


def test_a_schedule_of_one_sort_has_nothing_else():
    plan = schedule(31, np.random.default_rng(1), "none")
    assert [(sort, name) for sort, _, name in plan] == [("none", "")] * 31
    assert sum(exact for _, exact, _ in plan) == 16
    assert {name for _, _, name in schedule(46, np.random.default_rng(1), "clear")} == set(LISTED)


def test_rigs_are_arms_and_what_is_stated_is_off_by_tolerances():
    rng = np.random.default_rng(2)
    off = []
    for _ in range(30):
        rig = draw_rig(rng)
        assert 0.4 <= rig["link"]["length_m"] <= 1.2
        tolerances = draw_tolerances(rng)
        shown = stated(rig, tolerances, rng)
        read = Rig.model_validate({**tomllib.loads(rig_toml(shown, tolerances))})
        assert set(read.tolerances) == set(TOLERANCES)
        for key, t in tolerances.items():
            section, name = key.split(".")
            off.append((shown[section][name] / rig[section][name] - 1) / t)
        assert shown["link"]["length_m"] == rig["link"]["length_m"]
    assert np.max(np.abs(off)) < 2.01
    # A normal deviate cut at two has a standard deviation of 0.88; 240 draws, four standard errors.
    assert abs(np.std(off) - 0.88) < 0.16


@pytest.mark.long
def test_generated_cases_hold_what_their_answers_say(tmp_path):
    # Five cases: one of every sort.
    answers = generate(5, 5, tmp_path, open_cases=True)
    assert [a["case"] for a in answers] == [f"case_{k:04d}" for k in range(1, 6)]
    for answer in answers:
        folder = tmp_path / answer["case"]
        assert tomllib.loads((folder / "answer.toml").read_text())["verdict"] == answer["verdict"]
        assert folder_hash(folder) == answer["sha256"]
        exact = Rig.from_toml(folder / "rig_exact.toml")
        if answer["nominal"] == "exact":
            assert Rig.from_toml(folder / "rig.toml") == exact
        if answer["sort"] == "faint":
            # Tuned to a tenth; a parametric one of four tolerances may reach twice the range.
            assert 0.25 < answer["max_ratio"] < 3.2
        elif answer["sort"] == "clear":
            assert answer["max_ratio"] > 2.6
        if answer["verdict"] == "unknown":
            continue
        effects = parse_effects({"name": e["name"], **e["parameters"]} for e in answer["effects"])
        case = tomllib.loads((folder / "case.toml").read_text())
        for role in ("estimation", "held_out"):
            whitened = []
            for entry in case["experiments"]:
                if entry["role"] != role:
                    continue
                data = np.loadtxt(folder / entry["file"], delimiter=",", skiprows=1)
                assert data.shape == (entry["samples"], 4)
                model = simulate(exact, data[:, 1], effects).output
                whitened.append(((data[:, 2:] - model) / _noise(exact)).ravel())
            rms = np.sqrt(np.mean(np.concatenate(whitened) ** 2))
            # The plant, given rig and effect, explains the records as well as the simulator that made them;
            # where something switches, two correct models may differ by some tenths of the noise.
            names = {e["name"] for e in answer["effects"]}
            switching = {"backlash", "quantisation", "coulomb_friction", "stribeck_friction"}
            slack = 1.25 if names & switching else 1.03
            assert rms < slack * answer["pooled_gap"][f"{role}_gap_after_oracle"]


def _noise(rig):
    return np.array([rig.sensors.hub_angle_noise_rad, rig.sensors.tip_noise_m])


def test_answers_without_effects_are_toml():
    answer = {
        "case": "a", "verdict": "unknown", "severity": "clear", "max_ratio": 3.2, "sort": "unlisted",
        "nominal": "exact", "effects": [], "unlisted": [{"name": "air_drag", "coefficient_Ns2_m3": 0.2}],
        "pooled_gap": {"held_out_gap_before": 2.0}, "experiments": {"01_prbs_low": {"hub_ratio": 1.0}},
    }  # fmt: skip
    assert tomllib.loads(answer_toml(answer))["unlisted"][0]["name"] == "air_drag"


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    """A run of one case whose 'diagnosis' says none with p = 0.7; without effects, whose sizes take most of
    the time that a case takes to be made."""
    out = tmp_path_factory.mktemp("blind") / "run"
    run_blind(1, 8, out, jobs=1, only="none", diagnose=_says_none)
    return out


def _says_none(folder):
    assert not list(folder.rglob("answer*"))
    assert "run" not in folder.parts
    return {
        "case": folder.name,
        "verdict": "none",
        "effects": [{"name": "none", "probability": 0.7}],
        "gap_after": 1.0,
        "cpu_s": 1.0,
        "baselines": {"parameters only": {"case": folder.name, "verdict": "none", "effects": []}},
    }


@pytest.mark.slow
def test_a_run_leaves_scores_and_a_verified_seal(finished_run):
    document = json.loads((finished_run / "scores.json").read_text())
    assert document["diagnosis"]["n_cases"] == 1
    assert document["commitment"] == read_json(finished_run / COMMITMENT)["sha256"]
    assert set(document["baselines"]) == {"parameters only"}
    assert "commitment" in (finished_run / "scores.txt").read_text()
    assert (finished_run / "confusion.png").is_file()
    assert set(read_json(finished_run / "predictions.json")) == {"case_0001"}


@pytest.mark.slow
def test_a_finished_run_resumes_without_a_diagnosis_and_only_as_itself(finished_run):
    def never(folder):
        raise AssertionError("everything is there")

    before = (finished_run / "scores.json").read_bytes()
    run_blind(1, 8, finished_run, only="none", resume=True, diagnose=never)
    assert (finished_run / "scores.json").read_bytes() == before
    with pytest.raises(InputError, match="seed \\(was 8, now 9\\)"):
        run_blind(1, 9, finished_run, only="none", resume=True, diagnose=never)
    with pytest.raises(InputError, match="--resume continues it"):
        run_blind(1, 8, finished_run, only="none", diagnose=never)


def test_no_label_is_in_a_file_while_cases_are_diagnosed(tmp_path):
    close_seal(tmp_path, LABELS)
    with off_disk(tmp_path):
        written = "".join(path.read_text() for path in tmp_path.rglob("*.json"))
        assert not has_labels(tmp_path)
        assert "verdict" not in written
    assert open_seal(tmp_path) == LABELS


@pytest.mark.slow
def test_a_run_killed_while_it_diagnosed_draws_its_labels_again(finished_run, tmp_path):
    """What such a run leaves: the salt alone, and a case without its prediction."""
    out = tmp_path / "run"
    shutil.copytree(finished_run, out)
    sealed = json.loads((out / "seal" / "labels.json").read_text())
    (out / "seal" / "labels.json").write_text(json.dumps({"salt": sealed["salt"]}))
    (out / "predictions" / "case_0001.json").unlink()
    run_blind(1, 8, out, resume=True, jobs=1, only="none", diagnose=_says_none)
    assert (out / "scores.json").read_bytes() == (finished_run / "scores.json").read_bytes()
    assert json.loads((out / "seal" / "labels.json").read_text()) == sealed


@pytest.mark.slow
def test_records_exchanged_after_sealing_are_noticed(finished_run):
    path = finished_run / "cases" / "case_0001" / "rig.toml"
    before = path.read_bytes()
    path.write_bytes(before + b"# changed\n")
    try:
        with pytest.raises(InputError, match="records of case_0001"):
            run_blind(1, 8, finished_run, only="none", resume=True, diagnose=_says_none)
    finally:
        path.write_bytes(before)


def test_bad_requests_are_one_line(tmp_path):
    with pytest.raises(InputError, match="--cases must be at least 1"):
        run_blind(0, 1, tmp_path / "a")
    with pytest.raises(InputError, match="--only must be one of none, faint, clear, pair, unlisted"):
        run_blind(1, 1, tmp_path / "a", only="difficult")
    with pytest.raises(InputError, match="no blind run to resume"):
        run_blind(1, 1, tmp_path / "a", resume=True)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(InputError, match="holds 'file'"):
        run_blind(1, 1, tmp_path / "full")
    assert not (tmp_path / "a").exists()


_ATTEMPTS = {
    "open": "open(place / 'seal' / 'labels.json')",
    "os.open": "os.open(place / 'seal' / 'labels.json', os.O_RDONLY)",
    "bytes": "open(os.fsencode(place / 'seal' / 'labels.json'))",
    "list": "os.listdir(place / 'seal')",
    "rename": "os.rename(place / 'seal', away)",
    "chdir": "os.chdir(place)",
    "read_text": "(place / 'commitment.json').read_text()",
    "mkdir": "os.mkdir(place / 'own')",
    "utime": "os.utime(place / 'seal')",
    "rmdir": "os.rmdir(place / 'seal')",
    "copytree": "shutil.copytree(place, away)",
    "sqlite": "sqlite3.connect(place / 'seal' / 'labels.json')",
    "getxattr": "os.getxattr(place / 'seal' / 'labels.json', 'user.any')",
    "old symbolic link": "open(place.parent / 'symbolic')",
    "new symbolic link": "os.symlink(place / 'seal' / 'labels.json', away)",
    "old hard link": "open(place.parent / 'hard')",
    "new hard link": "os.link(place / 'seal' / 'labels.json', away)",
    "dir_fd": "os.open('labels.json', os.O_RDONLY, dir_fd=os.open(place / 'seal', os.O_RDONLY))",
    "dir_fd of a parent": "os.open(f'{place.name}/seal/labels.json', 0, dir_fd=os.open(place.parent, 0))",
    "dir_fd of the root": "os.open(str(place)[1:], 0, dir_fd=os.open('/proc/self/root', 0))",
    "dir_fd beside": "os.open(f'../{place.name}/seal/labels.json', 0, dir_fd=os.open(beside, 0))",
    "system": "os.system('true')",
    "subprocess": "subprocess.run(['true'])",
    "fork": "os.fork()",
    "exec": "os.execv('/bin/true', ['true'])",
    "posix_spawn": "os.posix_spawn('/bin/true', ['true'], {})",
    "spawn": "multiprocessing.get_context('spawn').Process(target=print).start()",
    "fork server": "multiprocessing.get_context('forkserver').Process(target=print).start()",
    "forked": "multiprocessing.get_context('fork').Process(target=print).start()",
    "pool": "concurrent.futures.ProcessPoolExecutor(1).submit(print).result()",
    "socket": "socket.socket(socket.AF_UNIX).connect(str(place.parent / 'server'))",
    "loopback": "socket.create_connection(('127.0.0.1', 9))",
    "memory of the parent": "open(f'/proc/{os.getppid()}/mem', 'rb')",
    "interpreter": "interpreters.create()",
}
_TRIED = """
import concurrent.futures, multiprocessing, os, pathlib, shutil, socket, sqlite3, subprocess, sys, tempfile
try:
    import _xxsubinterpreters as interpreters
except ImportError:
    import _interpreters as interpreters
from validation.blind.worker import keep_out

place, away, beside = map(pathlib.Path, sys.argv[1:4])
if __name__ == "__main__":
    keep_out(place)
    for attempt in sys.argv[4:]:
        try:
            done = eval(attempt)
        except (PermissionError, RuntimeError) as error:  # the latter of an interpreter that is not made
            print("refused", error)
        else:
            print("DONE", attempt, done)
    # Compilers keep what they compiled by way of an unnamed file.
    tempfile.TemporaryFile(dir=beside).close()
    beside.joinpath("own.txt").write_text("what is not below the directory stays open")
    assert os.listdir(beside) == ["own.txt"]
"""


@pytest.mark.slow
def test_the_diagnosing_process_cannot_reach_the_labels(tmp_path):
    """Nor start anything that could; each attempt is one that the head of the worker's module names."""
    place = tmp_path / "run"
    place.mkdir()
    close_seal(place, LABELS)
    (tmp_path / "symbolic").symlink_to(place / "seal" / "labels.json")
    (tmp_path / "hard").hardlink_to(place / "seal" / "labels.json")
    (tmp_path / "beside").mkdir()
    program = tmp_path / "tried.py"
    program.write_text(_TRIED)
    places = [place, tmp_path / "away", tmp_path / "beside"]
    done = subprocess.run(
        [sys.executable, program, *places, *_ATTEMPTS.values()],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    refused = [line.startswith("refused") for line in done.stdout.splitlines()]
    assert dict(zip(_ATTEMPTS, refused, strict=True)) == dict.fromkeys(_ATTEMPTS, True), done.stdout
    assert not (tmp_path / "away").exists()


def test_a_diagnosis_that_fails_counts_as_a_wrong_answer(tmp_path):
    folder = tmp_path / "case_0001"
    folder.mkdir()
    (folder / "case.toml").write_text("case = 3\n")
    with closing(LocalProcesses(1)) as processes:
        ((_, failure),) = processes.run([BlindCase(folder, tmp_path / "sealed")])
    document = failed("case_0001", failure.reason)
    assert document["verdict"] == "failed"
    assert "case.toml" in document["reason"]
