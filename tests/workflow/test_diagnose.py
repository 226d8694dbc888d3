"""`flexlink diagnose`: the answer as JSON and page, several cases, failures, resuming."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from diagnosis.fit.residual import pooled_rms
from plant import EFFECTS, Rig, parse_effects, simulate
from plant.effects.joint import GroundSpring
from tests.workflow.command import ROOT, build_nothing
from tests.workflow.diagnosis_examples import FRICTION, KnownAnswer, write_case
from tests.workflow.page_shape import shape_faults
from workflow.config.run_config import SimulatedSource
from workflow.diagnose import command, outputs
from workflow.diagnose.case_files import load_case
from workflow.diagnose.command import diagnose_cases
from workflow.diagnose.outputs import files_of
from workflow.engine.errors import InputError, StageError
from workflow.engine.executor import LocalProcesses, attempt

QUESTIONS = (
    "Size of the model error",
    "Where it lies",
    "Which effect, and how sure",
    "What the effects explain",
    "What remains",
    "What it means for the controller",
    "What was not checked",
)


@pytest.fixture
def undrawn(undrawn, monkeypatch):
    """Nor built: the page of `files` is drawn."""
    build_nothing(monkeypatch)


def made(folder, engine, *, rig=None, controller=False):
    """Files of one case, computed here."""
    files, _ = files_of(
        load_case(folder, rig), {"options": {"controller": controller}}, engine, lambda f, m: None
    )
    return files


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_case(tmp_path_factory.mktemp("case") / "arm", FRICTION)


@pytest.fixture(scope="module")
def files(folder):
    return made(folder, KnownAnswer((FRICTION,)), rig="rig_uncertain.toml", controller=True)


@pytest.fixture(scope="module")
def document(files):
    return json.loads(files["arm.json"])


# One case


def test_json_keeps_its_contract(document, folder):
    keys = "case verdict detail_verdict effects combination ambiguous_with gap_before gap_after noise_floor"
    assert {*keys.split(), "where", "next_experiment"} <= document.keys()
    assert document["case"] == "arm"
    assert document["verdict"] == "effect"
    assert document["combination"] == ["coulomb_friction"]
    assert document["effects"][0]["name"] == "coulomb_friction"
    assert document["effects"][0]["parameters"] == {"torque_Nm": 0.05}
    low, high = document["effects"][0]["intervals"]["torque_Nm"]
    assert low < 0.05 < high
    assert document["probabilities"].keys() == {"none", *EFFECTS, "unknown"}
    assert sum(document["probabilities"].values()) == pytest.approx(1.0, abs=1e-12)
    assert sum(effect["probability"] for effect in document["effects"]) == pytest.approx(1.0, abs=1e-12)
    assert {"subsystem", "bands", "regimes", "experiments", "sensors"} <= document["where"].keys()
    # The gap, computed without any of the diagnosis: held-out record against the simulator.
    case = load_case(folder).case
    (held,) = case.held_out
    residual = (held.output - simulate(case.rig, held.voltage_V).output) / case.noise
    assert document["gap_before"] == pytest.approx(pooled_rms(residual), rel=1e-12)
    by_experiment = document["gap_by_experiment"][held.name]
    assert by_experiment["stated"] == pytest.approx(pooled_rms(residual), rel=1e-12)
    assert document["gap_after"] < 1.2 < document["gap_before"]


def test_repaired_rig_and_effects_are_read_by_their_readers(files, folder, tmp_path):
    path = tmp_path / "arm.rig.toml"
    path.write_bytes(files["arm.rig.toml"])
    assert Rig.from_toml(path) == Rig.from_toml(folder / "rig_uncertain.toml")
    tables = tomllib.loads(files["arm.effects.toml"].decode())["effects"]
    assert parse_effects(tables) == parse_effects([FRICTION])
    # A run configuration takes them as they are.
    record = {"name": "a", "excitation": {"kind": "prbs", "amplitude_V": 1.0, "samples": 100}}
    source = {"kind": "simulated", "rig": str(path), "effects": tables, "records": [record]}
    assert SimulatedSource.model_validate(source).effects == (FRICTION,)


def test_the_proposed_experiment_can_be_run(files, document, folder):
    proposed = document["next_experiment"]
    assert proposed["advice"] == "separate"
    lines = files["arm.next.csv"].decode().splitlines()
    assert lines[0] == "time_s,voltage_V"
    voltage = np.array([float(line.split(",")[1]) for line in lines[1:]])
    np.testing.assert_allclose(voltage, proposed["voltage_V"], rtol=1e-8)
    case = load_case(folder).case
    assert np.max(np.abs(voltage)) <= max(np.max(np.abs(e.voltage_V)) for e in case.experiments) * (1 + 1e-9)


@pytest.mark.slow
def test_the_page_answers_in_order(files, tmp_path, faults_seen):
    html = files["arm.html"].decode()
    (tmp_path / "arm.html").write_text(html)
    assert faults_seen(tmp_path / "arm.html") == []
    places = [html.index(f"<h2>{question}</h2>") for question in QUESTIONS]
    assert places == sorted(places)
    assert "Dry (Coulomb) friction (96 %, 0.05 N m)" in html
    assert "<dt>Complete</dt><dd>97 %<small>what remains is noise</small></dd>" in html
    cells = re.sub("<td[^>]*>", "<td>", html)
    assert "<td>torque</td><td>0.05 N m</td><td>0.049 to 0.051</td>" in cells
    assert "<td>coulomb_friction</td>" not in cells
    assert html.count("<figure>") >= 6
    assert "nan" not in re.sub(
        r"<svg.*?</svg>|<script.*?</script>", "", html, flags=re.DOTALL
    ).lower().replace("nan m", "")


def test_the_first_screen_of_a_diagnosis(files, tmp_path, browser):
    (tmp_path / "arm.html").write_bytes(files["arm.html"])
    assert shape_faults(browser, tmp_path / "arm.html", screens=5, lines=2) == []


@pytest.mark.parametrize(
    ("engine", "words"),
    [
        (KnownAnswer((), "none", "none"), "No model error beyond sensor noise"),
        pytest.param(
            KnownAnswer((), "none", "parametric"), "outside their tolerances", marks=pytest.mark.slow
        ),
        (KnownAnswer((), "unknown", "unknown"), "None of the candidate effects explains the model error"),
        pytest.param(
            KnownAnswer((FRICTION,), "effect", "not_converged"),
            "the fit did not converge",
            marks=pytest.mark.slow,
        ),
        (
            KnownAnswer((FRICTION,), "effect", "ambiguous", ambiguous=("viscous_friction",)),
            "; or instead additional viscous friction (10 %)",
        ),
        pytest.param(
            KnownAnswer((FRICTION, {"name": "tip_payload", "mass_kg": 0.01})),
            "N m) and an additional mass at the tip (96 %, ",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["none", "parametric", "unknown", "not_converged", "ambiguous", "two"],
)
def test_every_verdict_has_its_words(folder, engine, words, undrawn):
    files = made(folder, engine)
    assert words in files["arm.html"].decode()
    answer = json.loads(files["arm.json"])
    assert (answer["verdict"], answer["detail_verdict"]) == (engine.verdict, engine.detail)


def test_what_closes_most_of_the_gap_of_an_unknown_cause_is_written_down(folder, undrawn):
    files = made(folder, KnownAnswer((FRICTION,), "unknown", "unknown"))
    answer = json.loads(files["arm.json"])
    closed = f"{100 * answer['gap_closed']:.4g} %"
    words = re.sub("<[^>]*>", "", files["arm.html"].decode())
    assert f"explains the model error completely; dry (Coulomb) friction explains {closed}" in words
    assert "friction may stand in for the true cause" in words
    assert (answer["verdict"], answer["combination"]) == ("unknown", [])
    assert answer["partial_model"] == ["coulomb_friction"]
    assert answer["gap_after"] < 0.5 * answer["gap_refit"]
    assert "the cause is not known" in files["arm.effects.toml"].decode()
    held = tomllib.loads(files["arm.effects.toml"].decode())["effects"]
    assert held == [FRICTION] == answer["repair"]["effects"]


@pytest.mark.parametrize(
    ("presence", "words", "other"),
    [
        (
            0.3,
            ("Check for dry (Coulomb) friction: raise the voltage", "If none of these is the cause, repeat"),
            "no hypotheses",
        ),
        (0.1, (", the worst record, at half and twice its amplitude",), "Check for dry"),
    ],
)
def test_an_effect_that_is_likely_is_looked_for_before_an_unknown_cause(
    folder, undrawn, presence, words, other
):
    answer = KnownAnswer((FRICTION,), "unknown", "unknown", ambiguous=("coulomb_friction",))

    def likely(case, *, progress=None):
        found = answer(case)
        effects = (
            replace(e, presence=presence) if e.name == "coulomb_friction" else e for e in found.effects
        )
        return replace(found, effects=tuple(effects))

    html = re.sub("<[^>]*>", "", made(folder, likely)["arm.html"].decode())
    assert all(one in html for one in words)
    assert other not in html


def test_a_cause_beyond_the_list_that_can_be_named_is_named(folder, undrawn):
    spring = GroundSpring(stiffness_Nm_rad=0.25)
    files = made(folder, KnownAnswer((), "unknown", "unknown", unlisted=(spring,)))
    html = files["arm.html"].decode()
    assert "explains the model error; it looks like a linear spring from hub to ground" in html
    assert "Best explanation: a linear spring from hub to ground (stiffness 0.25 N m/rad)" in html
    assert "Look at the machine for a linear spring from hub to ground" in html
    assert json.loads(files["arm.json"])["unlisted"] == [{"name": "ground_spring", "stiffness_Nm_rad": 0.25}]


def test_what_was_suspected_is_spoken_of(tmp_path, undrawn):
    folder = write_case(tmp_path / "arm", FRICTION)
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text('suspected = ["backlash", "coulomb_friction"]\n' + text)
    files = made(folder, KnownAnswer((FRICTION,)))
    html = files["arm.html"].decode()
    assert "You asked about backlash in the gear: probability under 0.1 %." in html
    assert "dry (Coulomb) friction: probability 96 % and is part of the answer" in html
    assert json.loads(files["arm.json"])["suspected"] == {"backlash": 0.0, "coulomb_friction": 0.96}


@pytest.mark.parametrize(
    ("engine", "words"),
    [
        (
            KnownAnswer((FRICTION,), ambiguous=("backlash",)),
            ("Put these numbers into your model: arm.rig.toml", "hold the motor shaft", "80 % to 95 %"),
        ),
        (
            KnownAnswer((), "unknown", "unknown"),
            ("Partial answers, each by itself: backlash in the gear explains 62 %",),
        ),
        (
            KnownAnswer((FRICTION,), "unknown", "unknown"),
            ("These numbers bring your model nearer to the records; the cause is unknown: arm.rig.toml",),
        ),
        (KnownAnswer((), "none", "none"), ("No significant model error:", "close to your threshold of 5 %")),
    ],
    ids=["effect", "unknown", "unknown-in-part", "none"],
)
def test_beside_a_model_error_a_hub_angle_is_enough(folder, tmp_path, engine, words, undrawn):
    case = tmp_path / "arm"
    shutil.copytree(folder, case)
    text = (case / "case.toml").read_text()
    (case / "case.toml").write_text('outputs = ["hub_angle_rad"]\nmodel_error = 0.05\n' + text)
    files = made(case, engine, rig="rig_uncertain.toml")
    html = re.sub("<[^>]*>", "", files["arm.html"].decode())
    for one in words:
        assert one in html
    # What is no answer is not said to be significant.
    assert ("significant" in re.findall(r"<th[^>]*>([^<]*)</th>", files["arm.html"].decode())) == (
        engine.verdict == "effect"
    )
    # One meaning of the gap: per cent of the motion, computed here without the diagnosis.
    loaded = load_case(case).case
    (held,) = loaded.held_out
    missed = held.output[:, 0] - simulate(loaded.rig, held.voltage_V).hub_angle_rad
    noise = loaded.rig.sensors.hub_angle_noise_rad
    percent = 100 * np.sqrt(pooled_rms(missed) ** 2 - noise**2) / np.std(held.output[:, 0])
    assert f"Model error before{percent:.3g} % of the motion" in html
    assert "× noise" not in html
    assert re.search(r"of the motion, and moves [^.]*inertia \(hub\) by -2\.60 tolerances", html)
    assert "gravity" not in html.split("Partial answers")[-1].split("Where it lies")[0]
    document = json.loads(files["arm.json"])
    assert document["shares"]["closes"][0] == [["backlash"], 0.62]
    assert [s["sensor"] for s in document["where"]["sensors"]] == ["hub_angle"]
    assert Rig.from_toml(_written(tmp_path / "rig.toml", files["arm.rig.toml"]))


def _written(path, content):
    path.write_bytes(content)
    return path


# Several cases


@pytest.fixture
def cases(tmp_path):
    return [write_case(tmp_path / "cases" / name, FRICTION, seed=k) for k, name in enumerate(("one", "two"))]


@pytest.fixture
def here(monkeypatch):
    """Cases in this process and without pictures: what is tested is what happens around them."""

    class Here(LocalProcesses):
        def run(self, tasks, watch):
            for index, one in enumerate(tasks):
                yield index, attempt(partial(one.run, partial(watch, index)))

    monkeypatch.setattr(command, "workers", lambda jobs, *_: closing(Here(jobs)))
    monkeypatch.setattr(outputs, "case_page", lambda *_, **content: "<html></html>\n")


def everything(out):
    """Bytes of all files but those that name seconds."""
    return {
        path.name: path.read_bytes() for path in out.iterdir() if path.name not in ("timings.json", "lock")
    }


def test_several_cases_make_an_overview(cases, tmp_path, here, faults_seen):
    out = tmp_path / "out"
    found = diagnose_cases(cases, out, controller=False, engine=KnownAnswer((FRICTION,)))
    assert found.exit_code == 0
    assert [document["case"] for document in found.documents] == ["one", "two"]
    overview = (out / "index.html").read_text()
    assert '<a href="one.html">one</a>' in overview
    assert "2 cases: 2 with a named effect" in overview
    assert faults_seen(out / "index.html") == []
    assert found.summary.report_path == str(out / "index.html")


@pytest.mark.slow
def test_a_failing_case_does_not_lose_the_others(cases, tmp_path, here):
    out = tmp_path / "out"
    engine = KnownAnswer((FRICTION,), fails=("one",))
    found = diagnose_cases([*cases, tmp_path / "three"], out, controller=False, engine=engine)
    assert [document["case"] for document in found.documents] == ["two"]
    assert found.exit_code == 1
    assert [line.partition(":")[0] for line in found.complaints()] == ["three", "one"]
    assert all("\n" not in line for line in found.complaints())
    assert not (out / "one.json").exists()
    assert "no such luck" in (out / "index.html").read_text()
    # The missing folder is not there to be continued with; the failed case is tried again.
    again = diagnose_cases(cases, out, controller=False, resume=True, engine=KnownAnswer((FRICTION,)))
    assert again.exit_code == 0
    assert (out / "one.json").exists()
    # Of good cases the answers stand, and what was given wrongly is exit code 2.
    beside = diagnose_cases(
        [*cases, tmp_path / "three"], tmp_path / "new", controller=False, engine=KnownAnswer((FRICTION,))
    )
    assert (beside.exit_code, len(beside.documents)) == (2, 2)


def test_one_case_of_a_rig_is_diagnosed_in_the_process_of_the_command(cases, tmp_path, undrawn):
    processes = []

    def engine(case, **options):
        processes.append(os.getpid())
        return KnownAnswer((FRICTION,))(case, **options)

    found = diagnose_cases(cases[:1], tmp_path / "out", controller=False, engine=engine)
    assert found.exit_code == 0
    assert processes == [os.getpid()]


def test_a_single_case_that_fails_leaves_nothing(cases, tmp_path, here):
    out = tmp_path / "out"
    with pytest.raises(StageError, match="no such luck"):
        diagnose_cases(cases[:1], out, controller=False, engine=KnownAnswer((FRICTION,), fails=("one",)))
    assert not out.exists()


def test_a_fit_that_did_not_converge_is_exit_code_3(cases, tmp_path, here):
    engine = KnownAnswer((FRICTION,), detail="not_converged")
    found = diagnose_cases(cases[:1], tmp_path / "out", controller=False, engine=engine)
    assert found.exit_code == 3
    assert "did not converge" in found.complaints()[0]


@pytest.mark.slow
def test_resuming_does_only_what_is_missing(cases, tmp_path, here):
    out, seen = tmp_path / "out", tmp_path / "seen"
    engine = KnownAnswer((FRICTION,), seen=seen)
    diagnose_cases(cases, out, controller=False, engine=engine)
    first = everything(out)
    assert seen.read_text() == "one\ntwo\n"
    diagnose_cases(cases, out, controller=False, resume=True, engine=engine)
    assert seen.read_text() == "one\ntwo\n"
    # Killed while the second case was written: its JSON file, the last one, is not there.
    (out / "two.json").unlink()
    (out / "index.html").unlink()
    (out / ".two.html.17.part").write_bytes(b"half a pa")
    diagnose_cases(cases, out, controller=False, resume=True, engine=engine)
    assert seen.read_text() == "one\ntwo\ntwo\n"
    assert everything(out) == first
    # A page that somebody edited no longer is what the answer names.
    (out / "one.html").write_text("<html>mine</html>")
    diagnose_cases(cases, out, controller=False, resume=True, engine=engine)
    assert seen.read_text() == "one\ntwo\ntwo\none\n"
    assert everything(out) == first
    # Nor is an answer that was edited itself.
    (out / "two.json").write_text((out / "two.json").read_text().replace("friction", "backlash"))
    diagnose_cases(cases, out, controller=False, resume=True, engine=engine)
    assert seen.read_text() == "one\ntwo\ntwo\none\ntwo\n"
    assert everything(out) == first


@pytest.mark.long
def test_another_code_version_is_done_again(cases, tmp_path, here, monkeypatch):
    out, seen = tmp_path / "out", tmp_path / "seen"
    engine = KnownAnswer((FRICTION,), seen=seen)
    diagnose_cases(cases[:1], out, controller=False, engine=engine)
    monkeypatch.setattr(command, "code_digest", lambda *rooms, **more: "another")
    found = diagnose_cases(cases[:1], out, controller=False, resume=True, engine=engine)
    assert seen.read_text() == "one\none\n"
    assert found.documents[0]["made_from"]["code_sha256"] == "another"


@pytest.mark.slow
def test_other_inputs_are_refused_unless_replaced(cases, tmp_path, here):
    out, engine = tmp_path / "out", KnownAnswer((FRICTION,))
    diagnose_cases(cases, out, controller=False, engine=engine)
    with pytest.raises(InputError, match="--resume or start it afresh with --replace"):
        diagnose_cases(cases, out, controller=False, engine=engine)
    with pytest.raises(InputError, match=r"the diagnosis began: inputs\.two"):
        diagnose_cases(cases[:1], out, controller=False, resume=True, engine=engine)
    with pytest.raises(InputError, match=r"the diagnosis began: inputs\.one"):
        diagnose_cases(cases, out, rig="rig_uncertain.toml", controller=False, resume=True, engine=engine)
    with pytest.raises(InputError, match=r"the diagnosis began: options\.controller"):
        diagnose_cases(cases, out, resume=True, engine=engine)
    (out / "notes.txt").write_text("mine")
    diagnose_cases(cases[:1], out, controller=False, replace=True, engine=engine)
    assert not (out / "two.json").exists()
    assert not (out / "index.html").exists()
    assert (out / "notes.txt").read_text() == "mine"


def test_json_is_all_there_is_on_standard_output(cases, tmp_path, here, flexlink, monkeypatch):
    monkeypatch.setattr(command, "diagnose", KnownAnswer((FRICTION,)))
    answer = flexlink("diagnose", *cases, "--out", tmp_path / "out", "--no-controller", "--json")
    printed = answer.document()
    assert [case["verdict"] for case in printed["cases"]] == ["effect", "effect"]
    assert printed["failed"] == []


# Processes


NAMES = ("random", "csv", "json", "types", "queue", "numpy", "ast", "threading", "tempfile")


def test_no_name_of_the_standard_library_in_the_current_folder_is_taken_for_it(tmp_path):
    """Nor one of numpy: by the processes of a command, and by `python -m flexlink`."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('of the user')")
    begin = (
        "import sys; del sys.path[0]; sys.path.append(sys.argv[1])\n"  # as the script `flexlink` begins
        "from workflow.engine.executor import LocalProcesses\n"
        "from tests.workflow.command import Imported\n"
        f"print(*LocalProcesses(1).run([Imported({NAMES})]))"
    )
    run = partial(subprocess.run, cwd=tmp_path, capture_output=True, text=True, check=False)
    done = run([sys.executable, "-c", begin, str(ROOT)])
    assert done.returncode == 0, done.stderr
    (index, (files, safe)) = ast.literal_eval(done.stdout)
    assert (index, len(files), safe) == (0, len(NAMES), None)
    assert not any(str(tmp_path) in file for file in files)
    (tmp_path / "types.py").unlink()  # Python's own -m ends at it, whatever the package
    version = run([sys.executable, "-m", "flexlink", "--version"])
    assert version.stdout.startswith("flexlink "), version.stderr


@pytest.mark.long
def test_a_process_that_dies_is_that_cases_failure(cases, tmp_path):
    out = tmp_path / "out"
    engine = KnownAnswer((FRICTION,), dies=("one",))
    found = diagnose_cases(cases, out, jobs=2, controller=False, engine=engine)
    assert found.exit_code == 1
    assert [document["case"] for document in found.documents] == ["two"]
    assert "died" in found.failures[0][1].reason


@pytest.mark.long
def test_a_recorded_case_from_files_to_files(gap_cases, tmp_path, flexlink):
    """The labelled case with a payload: named, sized, closed, and its files for whoever comes next."""
    truth = tomllib.loads((gap_cases / "labelled/tip_payload/answer.toml").read_text())
    out = tmp_path / "out"
    answer = flexlink("diagnose", gap_cases / "labelled/tip_payload", "--out", out, "--jobs", 1, "--json")
    (found,) = answer.document()["cases"]
    assert found["verdict"] == "effect"
    assert found["combination"] == ["tip_payload"]
    (expected,) = truth["effects"]
    assert found["effects"][0]["parameters"]["mass_kg"] == pytest.approx(
        expected["parameters"]["mass_kg"], rel=0.03
    )
    assert found["gap_before"] == pytest.approx(truth["pooled_gap"]["held_out_gap_before"], rel=0.05)
    # Three standard errors of the RMS of 2600 samples of two outputs.
    oracle = truth["pooled_gap"]["held_out_gap_after_oracle"]
    assert found["gap_after"] <= oracle + 3 / np.sqrt(2 * 5200)
    assert "an additional mass at the tip" in (out / "tip_payload.html").read_text()
    Rig.from_toml(out / "tip_payload.rig.toml")
    first, second, third, fourth = found["controller"]["runs"]
    # A redesign on the repaired rig meets the machine it was made for; payloads are linear.
    assert fourth["cost_s"] == pytest.approx(third["cost_s"], rel=0.01)
    assert all(run["settles"] for run in (first, second, third, fourth))


def test_a_folder_without_a_case_names_the_file_that_may_be_meant(tmp_path, flexlink):
    """As the example of the simulators has one."""
    (tmp_path / "arm.toml").write_text('mjcf = "arm.xml"')
    error = flexlink("diagnose", tmp_path, "--out", tmp_path / "found").err
    assert f"is it {tmp_path / 'arm.toml'}?" in error
