"""Runs for several joints: the simulated arm, its logs, and what cannot be used."""

import json
import re
from pathlib import Path

import control
import numpy as np
import pandas as pd
import pytest
import scipy.io

from control_design.analysis.closed_loop import simulate_joints
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import matrix_response
from plant import multisine, multisine_lines, two_link_arm
from tests.workflow.command import FAST_ARM
from workflow.cli import main
from workflow.engine.run_directory import RunDirectory
from workflow.joints import JointsResults
from workflow.joints.machine import machine_at
from workflow.joints.stages import _judged
from workflow.kinds import load_any

_JOINTS = """
[[joints]]
input = "shoulder_V"
output = "shoulder_rad"
bandwidth_rad_s = 3.0
effort_limit = 100.0
input_limit = 24.0

[[joints]]
input = "elbow_V"
output = "elbow_rad"
bandwidth_rad_s = 5.0
effort_limit = 100.0
input_limit = 24.0
"""
_REST = """
[identification]
n_real = 3
n_pairs = 2

[design]
controller_order = 4
"""
_SOURCE = """
[run]
name = "two"

[source]
kind = "two_joint_arm"
samples = 3000
points = [{ name = "bent", elbow_rad = 1.6 }]
"""


def _written(folder: Path, text: str, name: str = "arm.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def _run(config: Path) -> int:
    return main(["run", "--config", str(config), "--out", str(config.parent / "run"), "--quiet"])


@pytest.fixture(scope="module")
def run_of_the_arm(made_once) -> Path:
    def make(out: Path) -> None:
        config = _written(out.parent, _SOURCE + _JOINTS + _REST)
        assert main(["run", "--config", str(config), "--out", str(out), "--quiet"]) == 0

    return made_once("joints", make)[0]


def test_a_run_ends_with_a_certified_controller_and_a_page(run_of_the_arm):
    law = Controller.from_json((run_of_the_arm / "controller.json").read_text())
    assert law.D.shape == (2, 2)
    assert law.input_limit == (24.0, 24.0)
    assert "controller_step" in (run_of_the_arm / "controller.c").read_text()
    mat = scipy.io.loadmat(run_of_the_arm / "controller.mat")
    np.testing.assert_array_equal(mat["A"], law.A)
    np.testing.assert_array_equal(mat["input_limit"], [[24.0, 24.0]])
    page = (run_of_the_arm / "report.html").read_text()
    assert "Certified: every requirement is met" in page
    assert "anything between the operating points" in page.lower()
    for picture in ("joint-steps", "joint-requirements", "matrix-response", "mode-shapes", "records"):
        assert (run_of_the_arm / "figures" / f"{picture}.svg").is_file()
    assert json.loads((run_of_the_arm / "manifest.json").read_text())["status"] == "complete"


def _check_the_ball(run: Path):
    """It holds the response of small motions, linearised by automatic differentiation, not identified."""
    (point,) = JointsResults(RunDirectory.open(run)).identify.points
    a, b = two_link_arm(0.05).linear(1.6)
    true = control.c2d(control.ss(a, b, np.eye(2, len(a)), np.zeros((2, 2))), point.model.dt_s)
    assert np.mean(point.shown.distance(matrix_response(true, point.shown.omega_rad_s)) <= 1) > 0.9
    return point, a


@pytest.mark.long
def test_logs_of_a_closed_loop_give_a_certified_controller(run_of_the_arm, tmp_path, capsys):
    law = Controller.from_json((run_of_the_arm / "controller.json").read_text())
    config = load_any(run_of_the_arm / "config.toml")[0]
    rng = np.random.default_rng(5)
    machine = machine_at(config.source, config.source.points[0], rng, coulomb_Nm=(0.0, 0.0))
    lines = multisine_lines(3000, law.dt_s, (0.2, 60.0))
    r = np.column_stack([multisine(lines, 3000, 0.01, rng) for _ in range(2)])
    y, u = simulate_joints(law, machine, r)
    names = ["shoulder_V", "elbow_V", "shoulder_rad", "elbow_rad", "shoulder_set", "elbow_set"]
    table = pd.DataFrame(np.column_stack([u, y, r]), columns=names)
    table.insert(0, "time_s", np.arange(3000) * law.dt_s)
    table.to_csv(tmp_path / "loop.csv", index=False)
    asked = _from_log(
        tmp_path, tmp_path / "loop.csv", 'time = "time_s"\nreferences = ["shoulder_set", "elbow_set"]'
    )
    assert main(["run", "--config", str(asked), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    assert "two-stage identification" in (tmp_path / "run" / "report.html").read_text()
    _check_the_ball(tmp_path / "run")


def test_the_ball_holds_the_response_of_small_motions(run_of_the_arm):
    point, a = _check_the_ball(run_of_the_arm)
    modes = sorted(omega for omega, zeta, _ in point.modes if zeta < 0.3)
    poles = np.linalg.eigvals(a)
    light = np.sort(np.abs(poles[(poles.imag > 0) & (-poles.real < 0.3 * np.abs(poles))]))
    np.testing.assert_allclose(modes, light, rtol=0.01)


def test_a_report_and_a_resumed_run_say_the_same(run_of_the_arm, capsys):
    page = (run_of_the_arm / "report.html").read_bytes()
    assert main(["report", str(run_of_the_arm), "--quiet", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["certified"]
    assert document["numbers"]["design"]["gamma"] <= 1
    assert (run_of_the_arm / "report.html").read_bytes() == page
    assert main(["run", "--resume", "--out", str(run_of_the_arm), "--quiet"]) == 0
    assert (run_of_the_arm / "report.html").read_bytes() == page


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    config = _written(folder, _SOURCE + _JOINTS)
    assert main(["simulate", "--config", str(config), "--out", str(folder / "csv")]) == 0
    return next((folder / "csv").glob("*.csv"))


def _from_log(folder: Path, log: Path, source: str = 'time = "time_s"') -> Path:
    head = f'[source]\nkind = "files"\n{source}\nrecords = [{{ path = "{log}", condition = "bent" }}]\n'
    return _written(folder, head + _JOINTS + _REST)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_logs_give_the_same_model_as_the_arm(logs, run_of_the_arm, tmp_path, capsys):
    """Records that are kept back change nothing, and say which of them is not of this arm."""
    config = _written(tmp_path, _SOURCE.replace('"two"', '"two"\nseed = 7') + _JOINTS)
    assert main(["simulate", "--config", str(config), "--out", str(tmp_path / "csv")]) == 0
    capsys.readouterr()
    log = next((tmp_path / "csv").glob("*.csv"))
    table = pd.read_csv(log)
    table.assign(elbow_V=-table["elbow_V"]).to_csv(tmp_path / "wrong.csv", index=False)
    config = _from_log(tmp_path, logs)
    fresh = [
        f'{{ path = "{p}", condition = "bent", role = "validation" }}' for p in (log, tmp_path / "wrong.csv")
    ]
    config.write_text(config.read_text().replace('"bent" }]', '"bent" }, ' + ", ".join(fresh) + "]"))
    assert main(["run", "--config", str(config), "--out", str(tmp_path / "run"), "--quiet", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["numbers"]
    (point,) = JointsResults(RunDirectory(tmp_path / "run")).identify.points
    kept, wrong = ([fit.fit_percent for fit in fits] for fits in point.fresh)
    np.testing.assert_allclose(kept, point.fit_percent[0], atol=3)
    assert wrong[1] < 0 < wrong[0] < kept[0] - 10
    assert "wrong, elbow_rad" in json.dumps([each.values for each in point.warnings])
    assert main(["report", str(run_of_the_arm), "--quiet", "--json"]) == 0
    own = json.loads(capsys.readouterr().out)["numbers"]
    assert found["points"][0]["radius"] == pytest.approx(own["points"][0]["radius"], rel=1e-3)
    assert found["design"]["gamma"] == pytest.approx(own["design"]["gamma"], rel=1e-2)
    assert found["closed_loop"]["machine"] == "identified"


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_inputs_that_are_one_signal_in_a_band_are_named_with_the_band(logs, tmp_path, capfd):
    table = pd.read_csv(logs)
    lines = np.fft.rfft(table[["shoulder_V", "elbow_V"]].to_numpy(), axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(len(table), table["time_s"][1])
    alike = (omega > 30) & (omega < 90)
    lines[alike, 1] = 2 * lines[alike, 0]
    table["elbow_V"] = np.fft.irfft(lines, len(table), axis=0)[:, 1]
    table.to_csv(tmp_path / "log.csv", index=False)
    config = _from_log(tmp_path, tmp_path / "log.csv")
    text = config.read_text().replace("controller_order = 4", "controller_order = 0")
    config.write_text(text, encoding="utf-8")  # the loop is not what is tested
    assert _run(config) != 2
    said = " ".join(capfd.readouterr().out.replace("│", " ").split())
    assert "the inputs ['shoulder_V', 'elbow_V'] are not independent from" in said
    page = (tmp_path / "run" / "report.html").read_text()
    assert "not independent" in page
    assert "(rank 1 of 2)" in page


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        (lambda table: table.assign(elbow_rad=table["shoulder_rad"]), "same sensor twice"),
        (lambda table: table.assign(elbow_V=0.0), "elbow_V"),
        (lambda table: table.assign(elbow_V=2 * table["shoulder_V"]), "linearly dependent"),
        (lambda table: table.head(20), "samples"),
    ],
)
def test_logs_that_tell_too_little_are_refused_in_one_line(spoilt, words, logs, tmp_path, capfd):
    log = tmp_path / "log.csv"
    spoilt(pd.read_csv(logs)).to_csv(log, index=False)
    config = _from_log(tmp_path, log)
    assert _run(config) == 2
    said = capfd.readouterr().err.strip()
    assert words in said
    assert "\n" not in said
    assert len(said) < 300
    assert not (tmp_path / "run").exists()


def test_logs_that_are_not_taken_say_why(logs, tmp_path, capfd):
    source = 'time = "time_s"\nreferences = ["shoulder_rad"]'
    config = _from_log(tmp_path, logs, source)
    assert _run(config) == 2
    assert "1 references move" in capfd.readouterr().err
    text = config.read_text().replace('condition = "bent"', 'condition = "bent", role = "validation"')
    config.write_text(text.replace(source, 'time = "time_s"'), encoding="utf-8")
    assert _run(config) == 2
    assert "no record with condition 'bent' is fitted" in capfd.readouterr().err
    _from_log(tmp_path, logs)
    with config.open("a", encoding="utf-8") as file:
        file.write("\n[closed_loop]\ncoulomb_Nm = [0.1, 0.1]\n")
    assert _run(config) == 2
    assert "simulated arm only" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("input_limit = 24.0\n\n[[joints]]", "\n[[joints]]", "input_limit"),
        ('output = "elbow_rad"', 'output = "shoulder_rad"', "two joints have the output"),
        ('output = "elbow_rad"', 'output = "shoulder_V"', "'shoulder_V' is an input and an output"),
        ("bandwidth_rad_s = 5.0", "bandwidth_rad_s = 5.0\ndelay_margin_s = 0.01", "delay_margin_s"),
        ("controller_order = 4", "controller_order = 5", "two per modal block"),
        ("[design]", "[closed_loop]\nstep = [0.0, 0.0]\n\n[design]", "at least one"),
    ],
)
def test_configurations_that_do_not_fit_are_refused(old, new, words, tmp_path, capfd):
    text = _SOURCE + _JOINTS + _REST
    assert old in text
    assert _run(_written(tmp_path, text.replace(old, new))) == 2
    said = capfd.readouterr().err.strip()
    assert words in said
    assert "\n" not in said


def test_a_joint_may_rest_while_another_moves(run_of_the_arm):
    law = Controller.from_json((run_of_the_arm / "controller.json").read_text())
    step = np.array([-0.2, 0.0])
    output = np.tile(step, (100, 1)) + np.array([-0.01, 0.015])
    judged = _judged("bent", "by hand", output, np.zeros((100, 2)), step, law)
    assert judged.settled
    np.testing.assert_allclose(judged.overshoot, [0.05, 0.075])
    assert not _judged("bent", "by hand", output + 0.02, np.zeros((100, 2)), step, law).settled


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_what_cannot_be_met_is_a_result(tmp_path, capfd):
    text = (_SOURCE + _JOINTS + _REST).replace("effort_limit = 100.0", "effort_limit = 0.5")
    config = _written(tmp_path, text.replace("controller_order = 4", "controller_order = 0"))
    assert _run(config) == 3
    assert "not certified" in capfd.readouterr().err
    assert "Not certified" in (tmp_path / "run" / "report.html").read_text()
    assert np.isfinite(Controller.from_json((tmp_path / "run" / "controller.json").read_text()).D).all()


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_a_study_varies_what_a_joint_is_asked(run_of_the_arm, tmp_path):
    """From the run's models: its own point is designed as in the run, and a faster one has a larger worst
    case; the table says what the certificate and the loops of each point say."""
    study = f"""
    [study]
    base = "{run_of_the_arm}"
    [[axes]]
    key = "joints[1].bandwidth_rad_s"
    label = "elbow"
    values = [5.0, 200.0]
    [[axes]]
    key = "design.structure"
    values = ["full", "diagonal"]
    """
    assert main(["study", "--config", str(_written(tmp_path, study)), "--out", str(tmp_path / "bad")]) == 2
    study = study.replace(', "diagonal"', "")
    out = tmp_path / "study"
    where = _written(tmp_path, study)
    assert main(["study", "--config", str(where), "--out", str(out), "--quiet", "--jobs", "1"]) == 0
    table = pd.read_csv(out / "table.csv")
    assert list(table["state"]) == ["certified", "not certified"]
    assert table["worst_gamma"][0] < 1 < table["worst_gamma"][1]
    certificate = JointsResults(RunDirectory(run_of_the_arm)).certify.certificate
    disks = [disk.alpha for one in certificate.verdicts for disk in (one.input_disk, one.output_disk)]
    assert table["disk_margin"][0] == pytest.approx(min(disks), rel=1e-9)
    own = out / "points" / "1"
    for name in ("design.npz", "certify.json"):
        assert (own / "stages" / name).read_bytes() == (run_of_the_arm / "stages" / name).read_bytes()
    assert main(["report", str(own)]) == 0
    assert "worst case" in (out / "study.html").read_text()


@pytest.mark.parametrize("command", ["design", "tune"])
def test_commands_for_one_loop_say_what_to_use(command, run_of_the_arm, capfd):
    assert main([command, str(run_of_the_arm)]) == 2
    assert re.search("a run for several joints.* type: flexlink run --config ", capfd.readouterr().err)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_each_input_may_have_its_own_dead_time(logs, run_of_the_arm, tmp_path):
    """The log's commands are moved ahead of what they do: with the dead times stated, model and ball are
    those without any, each input so much later."""
    table, late = pd.read_csv(logs), (2, 5)
    for name, delay in zip(["shoulder_V", "elbow_V"], late, strict=True):
        table[name] = table[name].shift(-delay)
    table.dropna().to_csv(tmp_path / "moved.csv", index=False)
    text = _from_log(tmp_path, tmp_path / "moved.csv").read_text()
    text = text.replace("n_real = 3", f"input_delay_samples = {list(late)}\nn_real = 3")
    assert _run(_written(tmp_path, text)) == 0
    (found,) = JointsResults(RunDirectory(tmp_path / "run")).identify.points
    (own,) = JointsResults(RunDirectory(run_of_the_arm)).identify.points
    assert found.model.order == own.model.order
    omega = np.geomspace(1.0, 300.0, 50)
    phase = np.exp(-1j * omega[:, None] * own.model.dt_s * np.array(late))[:, None, :]
    here, there = found.plant(0.0), own.plant(0.0)
    nominal = matrix_response(there.nominal, omega) * phase
    gram, expected = (np.conj(x.swapaxes(1, 2)) @ x for x in (
        matrix_response(here.ball.Li, omega), matrix_response(there.ball.Li, omega) * phase
    ))  # fmt: skip
    # Seven samples of three thousand are lost: far below the phases that are tested.
    for one, other, off in ((matrix_response(here.nominal, omega), nominal, 0.01), (gram, expected, 0.1)):
        size = np.linalg.norm(other, axis=(1, 2))
        assert np.max(np.linalg.norm(one - other, axis=(1, 2)) / size) < off


@pytest.mark.slow
def test_one_joint_at_two_operating_points_gets_one_controller(tmp_path):
    """Its margin is that of each model, closed by hand; the second log is of an arm half as lively."""
    assert main(["simulate", "--config", str(FAST_ARM), "--out", str(tmp_path / "csv")]) == 0
    log = tmp_path / "csv" / "01_prbs.csv"
    table = pd.read_csv(log)
    table.assign(hub_angle_rad=0.5 * table["hub_angle_rad"]).to_csv(tmp_path / "half.csv", index=False)
    text = _from_log(tmp_path, log).read_text().replace(_JOINTS, _JOINTS.rpartition("[[joints]]")[0])
    text = text.replace(" }]", f' }}, {{ path = "{tmp_path / "half.csv"}", condition = "half" }}]')
    text = text.replace("shoulder_V", "voltage_V").replace("shoulder_rad", "hub_angle_rad")
    assert _run(_written(tmp_path, text.replace("n_real = 3\nn_pairs = 2", "n_real = 1\nn_pairs = 1"))) == 0
    run = tmp_path / "run"
    law, omega = Controller.from_json((run / "controller.json").read_text()), np.geomspace(0.1, 600.0, 2000)
    first, half = JointsResults(RunDirectory(run)).identify.points
    for point in (first, half):
        loop = law.response(omega) * matrix_response(point.plant(0.0).nominal, omega)[:, 0, 0]
        assert np.max(1 / np.abs(1 + loop)) < 1 / 0.5
    sizes = [matrix_response(point.plant(0.0).nominal, omega[:900])[:, 0, 0] for point in (first, half)]
    np.testing.assert_allclose(sizes[1], 0.5 * sizes[0], rtol=1e-3)


def test_dead_times_are_one_or_one_for_each_joint(logs, tmp_path, capfd):
    text = _from_log(tmp_path, logs).read_text().replace("n_real", "input_delay_samples = [1]\nn_real")
    assert main(["run", "--config", str(_written(tmp_path, text)), "--out", str(tmp_path / "run")]) == 2
    assert "one for each of 2 joints" in capfd.readouterr().err
