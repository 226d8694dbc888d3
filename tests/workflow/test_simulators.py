"""`flexlink diagnose` on models of other simulators: end to end, refusals, docs/simulators.md as it is."""

import contextlib
import doctest
import re
import runpy
import shlex
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from diagnosis import Change
from diagnosis.machine.telling import Alike, Telling, telling
from plant.effects import in_words
from tests.workflow.command import ROOT
from tests.workflow.diagnosis_examples import KnownAnswer
from workflow.diagnose import check
from workflow.diagnose.command import _summary, diagnose_cases
from workflow.diagnose.fleet import FleetMachine
from workflow.diagnose.simulator_case import load_simulator_case
from workflow.diagnose.simulator_settings import settings_of
from workflow.engine.errors import InputError, StageError

# A model that multiplies.
GAIN = """INPUTS, OUTPUTS, PARAMETERS = "motor", "hinge", {"k": 2.0}
def simulate(p, effects, inputs):
    return p["k"] * inputs
"""
GUIDE, EXAMPLE = ROOT / "docs" / "simulators.md", ROOT / "examples" / "mujoco_arm"
DT_S = 0.01

HINGE = """<mujoco><option timestep="0.005"/><worldbody><body name="rod">
<joint name="hinge" axis="0 0 1" damping="0.2" armature="0.01"/>
<inertial pos="0.5 0 0" mass="1" diaginertia="0.001 0.05 0.05"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


def snippets(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", GUIDE.read_text(), re.S)


def save(path: Path, rows, names: str = "time_s,motor,hinge", fmt: str = "%.18e") -> None:
    np.savetxt(path, rows, delimiter=",", header=names, comments="", fmt=fmt)


def loaded(folder: Path, text: str):
    """What a case file of this text is read as."""
    return load_simulator_case(settings_of(tomllib.loads(text), "case.toml"), folder, "case.toml")


ONE = 'mjcf = "arm.xml"\nlog = "one.csv"\n'


@pytest.fixture
def arm(tmp_path) -> Path:
    """A folder with a model and a log of it."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(HINGE)
    write_log(tmp_path / "one.csv", 0, 0.1)
    return tmp_path


def write_log(path: Path, seed: int, friction: float, gain: float = 1.0) -> None:
    """A rod on a hinge under random torques, by hand: semi-implicit steps of 0.1 ms, dry friction exact.
    gain : of the angle's sensor."""
    rng = np.random.default_rng(seed)
    torque = rng.uniform(-1, 1, 15).repeat(16)
    torque[:16] = 0.0
    x = v = 0.0
    h, rows = 1e-4, []
    for k, u in enumerate(torque):
        rows.append([k * DT_S, u, gain * x + 2e-4 * rng.standard_normal()])
        for _ in range(round(DT_S / h)):
            free = v + h / 0.31 * (u - 0.2 * v)
            v = np.sign(free) * max(abs(free) - h / 0.31 * friction, 0.0)
            x += h * v
    save(path, rows)


def test_columns_beside_the_model_are_read_along_with_the_parts_of_a_log(arm):
    rows = np.loadtxt(arm / "one.csv", delimiter=",", skiprows=1)
    load = np.sin(rows[:, 0])
    save(arm / "one.csv", np.column_stack([rows, load]), names="time_s,motor,hinge,load_N")
    first, last = loaded(arm, f'{ONE}beside = ["load_N"]').case.experiments
    np.testing.assert_allclose(np.concatenate([first.beside["load_N"], last.beside["load_N"]]), load)
    assert (first.first_row, last.first_row) == (0, len(first.output))
    assert first.input.shape[1] == 2  # no input of the model
    with pytest.raises(InputError, match="no column for weight"):
        loaded(arm, f'{ONE}beside = ["weight"]')


@pytest.mark.slow
def test_a_mujoco_model_is_diagnosed_and_comes_back_repaired(tmp_path, flexlink, monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    scaled = '<custom><numeric name="hinge.gain" data="1.1"/></custom><actuator>'
    (tmp_path / "arm.xml").write_text(HINGE.replace("<actuator>", scaled))
    write_log(tmp_path / "first.csv", 0, 0.12, gain=1.1)
    write_log(tmp_path / "second.csv", 1, 0.12, gain=1.1)
    (tmp_path / "arm.toml").write_text('mjcf = "arm.xml"\nlog = ["first.csv", "second.csv"]\n')
    out = tmp_path / "found"
    answer = flexlink("diagnose", str(tmp_path / "arm.toml"), "--out", str(out), "--json", "--jobs", "1")
    (case,) = answer.document()["cases"]
    assert case["combination"] == ["hinge.frictionloss"]
    repaired = mujoco.MjModel.from_xml_path(str(out / "arm.xml"))
    assert repaired.joint("hinge").frictionloss[0] == pytest.approx(0.12, rel=0.1)
    assert "  hinge.frictionloss: 0 to 0.1" in (out / "arm.xml").read_text()
    page = (out / "arm.html").read_text()
    assert "hinge.frictionloss" in page
    assert 'href="arm.xml"' in page
    assert page.count('<animate attributeName="d"') == 3  # measured, stated, repaired
    # The guide's replay gives the number of the answer, through the gain that MuJoCo does not apply.
    (replay,) = [text for text in snippets("python") if "genfromtxt" in text]
    monkeypatch.chdir(tmp_path)
    printed: list[float] = []
    exec(replay, {"print": printed.append})
    # MJCF has six digits.
    assert printed == pytest.approx([case["replayed"]["hinge"]["repaired"]], rel=1e-3)
    for stated, doubted in ((case["replayed"]["hinge"]["stated"], False), (0.0, True)):
        case["replayed"]["hinge"]["stated"] = stated
        (section,) = _summary([case], [FleetMachine.of(case)], [], out / "arm.html").sections
        assert any("worse than nominal" in row.text for row in section.rows) == doubted


@pytest.mark.long
def test_a_model_that_ends_its_process_does_not_end_the_command(arm):
    case = loaded(arm, ONE).case.name
    (arm / "case.toml").write_text(ONE)
    with pytest.raises(StageError, match="died"):
        diagnose_cases([arm / "case.toml"], arm / "out", controller=False, engine=KnownAnswer(dies=(case,)))


def test_a_replay_of_a_delay_starts_with_the_commands_before_it(tmp_path, monkeypatch):
    """As the guide and the head of the repaired file say: a keyframe holds none."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(HINGE)
    write_log(tmp_path / "second.csv", 1, 0.0)
    rows = np.loadtxt(tmp_path / "second.csv", delimiter=",", skiprows=1)
    rows[:, 1] += 0.5  # whatever moved it: the commands before the first are not zero
    save(tmp_path / "second.csv", rows)
    case = loaded(tmp_path, 'mjcf = "arm.xml"\nlog = ["second.csv", "second.csv"]').case
    record = replace(case.held_out[0], name="second")
    changes = (Change("motor.delay", {"delay_s": 0.05}),)
    text = case.plant.simulation.arm.repaired(case.plant, case.plant, changes, (record,))
    assert "mj_initCtrlHistory of 0, with the first value" in text.split("-->")[0]
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "arm.xml").write_text(text)
    monkeypatch.chdir(tmp_path)
    printed: list[float] = []
    (replay,) = [text for text in snippets("python") if "genfromtxt" in text]
    exec(replay, {"print": printed.append})
    left = record.output - case.plant.replayed(changes)(record.input)
    assert printed == pytest.approx([np.sqrt(np.mean(left**2))], rel=1e-3)


PENDULUM = """<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody><body name="arm">
<joint name="shoulder" axis="0 1 0" damping="0.05" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" density="1000"/></body></worldbody>
<actuator><motor name="torque" joint="shoulder"/></actuator>
<sensor><jointpos name="angle" joint="shoulder"/></sensor></mujoco>"""


def write_pendulum_log(path: Path, seed: int, load_kg: float, friction_Nm: float) -> None:
    """Under a PD controller, by the classical Runge-Kutta method: rod and caps by hand, a load at the tip."""
    cylinder, ball = np.pi * 0.02**2 * 0.5 * 1000, 4 / 3 * np.pi * 0.02**3 * 1000
    mass = cylinder + ball
    inertia = cylinder * (0.5**2 / 12 + 0.02**2 / 4 + 0.25**2) + ball * (0.4 * 0.02**2 + 0.5**2 / 2)
    inertia += 0.01 + load_kg * 0.52**2
    weight = 9.81 * (0.25 * mass + 0.52 * load_kg)
    rng = np.random.default_rng(seed)
    goal = rng.uniform(-1.2, 1.2, 10).repeat(50)
    x, rows, h = np.zeros(2), [], 0.01 / 20

    def slope(x: np.ndarray, u: float) -> np.ndarray:
        left = u - 0.05 * x[1] - friction_Nm * np.tanh(x[1] / 5e-3) - weight * np.sin(x[0])
        return np.array([x[1], left / inertia])

    for k in range(500):
        angle = x[0] + 2e-4 * rng.standard_normal()
        u = 6.0 * (goal[k] - angle) - 0.6 * x[1]
        rows.append([k * DT_S, u, angle])
        for _ in range(20):
            k1 = slope(x, u)
            k2 = slope(x + h / 2 * k1, u)
            k3 = slope(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, u))
    save(path, rows, "time_s,torque,angle")


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("integrator", "load_kg", "friction_Nm"), [("implicitfast", 0.15, 0.12), ("implicit", 0.0, 0.1)]
)
def test_a_load_and_friction_of_a_pendulum_without_a_site_are_found(
    tmp_path, flexlink, integrator, load_kg, friction_Nm
):
    """A load, weight and the gain of the drive look alike: what is not ruled out is said to be open. Friction
    of 2 % of the motion is named, or in the repaired model as an effect below the threshold."""
    pytest.importorskip("mujoco")
    (tmp_path / "pend.xml").write_text(PENDULUM.format(integrator=integrator))
    arguments = ["--mjcf", str(tmp_path / "pend.xml")]
    for seed in range(2):
        write_pendulum_log(tmp_path / f"p{seed}.csv", seed, load_kg, friction_Nm)
        arguments += ["--log", str(tmp_path / f"p{seed}.csv")]
    answer = flexlink("diagnose", *arguments, "--out", str(tmp_path / "out"), "--json", "--jobs", "1")
    (case,) = answer.document()["cases"]
    sizes = {"arm.payload": load_kg, "shoulder.frictionloss": friction_Nm}
    for name, size in sizes.items():
        found = case["presence"][name]
        if size == 0:
            assert found["probability"] < 0.5
            continue
        (low, high) = next(iter(found["intervals"].values()))
        assert low <= size <= high
        if name not in case["shares"]["small"]:
            assert found["probability"] > 0.2
        if name not in (*case["combination"], *case["shares"]["small"]):
            assert name in case["ambiguous_with"]
    wrong = {*case["combination"]} - {name for name, size in sizes.items() if size}
    assert not wrong or case["probability"] < 0.8
    left = case["replayed"]["angle"]
    assert left["repaired"] < 0.2 * left["stated"]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('mjcf = "no.xml"\nlog = "one.csv"', "no such model file"),
        ('mjcf = "arm.xml"\nlog = "no.csv"', "no.csv: no such file"),
        ('mjcf = "arm.xml"\nfmu = "arm.fmu"\nlog = "one.csv"', "one of mjcf, fmu, python; got mjcf and fmu"),
        ('mjcf = "one.csv"\nlog = "one.csv"', "one.csv: not a model that MuJoCo reads"),
        (ONE + 'columns = {hinge = "q"}', "is named after a joint or sensor"),
        ('mjcf = "arm.xml"\nlog = "other.csv"', 'columns = {hinge = "COLUMN"}; the log has t'),
        (
            ONE + 'columns = {motor = "u"}',
            "no column for motor: in a case file (.toml) with mjcf = ... and log = [...] write "
            'columns = {motor = "COLUMN"}; the log has time_s',
        ),
        (ONE + "tolerances = {mass = 0.1}", "no parameter is called 'mass'"),
        (ONE + "noise = {elbow = 0.1}", "no output is called 'elbow'"),
        (ONE + "model_err = 0.1", "did you mean model_error?"),
        ('python = "empty.py"\nlog = "one.csv"', "does not define simulate"),
        (
            'python = "wrong.py"\nlog = "one.csv"',
            "ended with NameError: name 'nothing' is not defined (wrong.py, line 1)",
        ),
        (
            'python = "bug.py"\nlog = "one.csv"',
            "ended with AttributeError: 'list' object has no attribute 'shape' (bug.py, line 5)",
        ),
        ('python = "left.py"\nlog = "one.csv"', "ended with SystemExit"),
        ('python = "list.py"\nlog = "one.csv"', "TOLERANCES must be name -> number"),
        ('python = "gain.py"\nlog = "short.csv"', "last third validates; give more of it, or a second --log"),
        ('python = "gain.py"\nlog = "row.csv"', "a single row of numbers"),
        (f'python = "gain.py"\nlog = {["no.csv"] * 501}', "501 records, at most 500"),
        ('fmu = "arm.xml"\nlog = "one.csv"', "not a zip archive"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(arm, text, complaint):
    pytest.importorskip("fmpy")
    log, bug = (arm / "one.csv").read_text(), "def shape_of(y):\n    return [y].shape\n"
    for name, content in {
        "empty.py": "",
        "wrong.py": "nothing",
        "gain.py": GAIN,
        "bug.py": GAIN.replace("return", "return shape_of(").rstrip() + f")\n{bug}",
        "list.py": GAIN + 'TOLERANCES = ["k"]\n',
        "left.py": "raise SystemExit",
        "other.csv": log.replace("motor,hinge", "u1,q1").replace("time_s", "t"),
        "short.csv": "\n".join(log.splitlines()[:13]),
        "row.csv": "\n".join(log.splitlines()[:2]),
    }.items():
        (arm / name).write_text(content)
    with pytest.raises(InputError, match=re.escape(complaint)) as raised:
        loaded(arm, text)
    assert "\n" not in str(raised.value)
    assert "return nan" not in str(raised.value)  # advice on trials; these are the stated values


@pytest.mark.parametrize(
    ("motor", "hinge", "sensor", "columns", "complaint"),
    [
        ("hinge", "hinge", "", {"hinge": "u"}, 'which is which, columns = {"actuator hinge" = ..., "joint'),
        ("hinge", "hinge", "", {"actuator hinge": "u"}, ""),
        ("u", "hinge", "hinge", {}, 'is which, columns = {"sensor hinge" = ..., "joint hinge" = ...}'),
        ("u", "hinge", "hinge", {"joint hinge": "hinge"}, ""),
        ("u", "hinge", "hinge as it is", {}, ""),
        ("s", "hinge", "s", {"actuator s": "u", "sensor s": "speed"}, ""),
        ("a", "a", "a", {"actuator a": "u", "sensor a": "speed", "joint a": "hinge"}, ""),
        ("motor", "hinge", "", {"motor": "hinge"}, "column 'hinge' is both motor and hinge: say which of"),
        ("u", "hinge", "", {"elbow": "speed"}, "no actuator, sensor or joint is called 'elbow'"),
        ("u", "hinge", "s", {"s": "velocity"}, "has no column 'velocity' (s)"),
    ],
)
def test_a_name_that_two_things_have_is_asked_for(arm, motor, hinge, sensor, columns, complaint):
    """Angle, speed and command of the log each end where they belong, or one line asks."""
    text = HINGE.replace('name="hinge"', f'name="{hinge}"').replace('joint="hinge"', f'joint="{hinge}"')
    text = text.replace('"motor"', f'"{motor}"')
    if sensor:
        kind, sensor = ("jointpos", hinge) if sensor == "hinge as it is" else ("jointvel", sensor)
        velocity = f'<sensor><{kind} name="{sensor}" joint="{hinge}"/></sensor></mujoco>'
        text = text.replace("</mujoco>", velocity)
    (arm / "arm.xml").write_text(text)
    rows = np.loadtxt(arm / "one.csv", delimiter=",", skiprows=1)
    rows = np.column_stack([rows, np.gradient(rows[:, 2], DT_S)])
    angle = "joint hinge" if columns == {"actuator hinge": "u"} else "hinge"
    save(arm / "one.csv", rows, f"time_s,u,{angle},speed")
    settings = settings_of({"mjcf": "arm.xml", "log": "one.csv", "columns": columns}, "case.toml")
    if complaint:
        with pytest.raises(InputError, match=re.escape(complaint)):
            load_simulator_case(settings, arm, "case.toml")
        return
    (first, _) = load_simulator_case(settings, arm, "case.toml").case.experiments
    assert np.array_equal(first.input[:, 0], rows[: len(first.input), 1])
    measured = [3] * any("sensor" in c for c in columns) + [2] * (hinge == "hinge" or "joint a" in columns)
    assert np.array_equal(first.output, rows[: len(first.output), measured])


@pytest.mark.slow
def test_candidates_are_chosen_excluded_and_bounded(arm):
    def plant_of(more: str):
        return loaded(arm, ONE + more).case.plant

    every = plant_of("")
    chosen = plant_of(
        'candidates = ["hinge.*", "*.mass"]\nexclude = ["*.sensor_*", "hinge.backlash"]\n'
        'bounds = {"hinge.frictionloss" = [0.05, 0.2]}'
    )
    assert [*chosen.tolerances] == ["hinge.damping", "hinge.armature", "rod.mass"]
    assert [effect.name for effect in chosen.effects] == ["hinge.frictionloss", "hinge.stiffness"]
    (friction,) = chosen.effects[0].parameters
    assert (friction.low, friction.high) == (0.05, 0.2)
    left_out = sum("candidates" in why for why in chosen.inactive.values())
    assert len(chosen.missing) + left_out == len(every.missing)
    # What is left out keeps its stated value.
    assert chosen.parameters == every.parameters
    for more, complaint in (
        ('candidates = ["elbow.*"]', "candidates: 'elbow.*' matches nothing"),
        ('exclude = ["hinge.drag"]', "exclude: 'hinge.drag' matches nothing"),
        ('bounds = {"rod.mass" = [0.5, 2.0]}', "bounds: 'rod.mass' is no effect that is tried"),
        ('bounds = {"hinge.frictionloss" = [0.2, 0.1]}', "needs low < high; got 0.2 and 0.1"),
    ):
        with pytest.raises(InputError, match=re.escape(complaint)):
            plant_of(more)


def rewritten(path: Path, kind: str) -> str:
    """The same log as somebody else writes it; TOML that it needs."""
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    header, more = ["time_s", "motor", "hinge"], ""
    factor = {"deg": 180 / np.pi, "mrad": 1e3, "counts": 4096 / (2 * np.pi)}
    if kind in ("t_ms", "Time [us]", "t", "Zeit"):
        header[0] = kind
        rows[:, 0] *= {"t_ms": 1e3, "Time [us]": 1e6}.get(kind, 1.0)
    elif kind == "no time":
        header, rows, more = header[1:], rows[:, 1:], "dt_s = 0.01"
    elif kind in ("hinge_deg", "hinge [mrad]", "counts"):
        unit = next(u for u in factor if u in kind)
        header[2], rows[:, 2] = ("hinge_counts" if unit == "counts" else kind), rows[:, 2] * factor[unit]
        if unit == "counts":
            header[2] = "enc [counts]"
            more = f'columns = {{hinge = {{column = "enc [counts]", scale = {1 / factor[unit]!r}}}}}'
    elif kind == "motor [mNm]":
        header[1], rows[:, 1] = kind, 1e3 * rows[:, 1]
    elif kind == "wraps":
        rows[:, 2] = np.mod(rows[:, 2], 0.02)
        more = 'columns = {hinge = {column = "hinge", unwrap = 0.02}}'
    elif kind == "jitter":
        rows[1:-1, 0] += 5e-4 * np.random.default_rng(0).uniform(-1, 1, len(rows) - 2)
        more = "repair = true"
    elif kind == "gap":
        rows, more = np.delete(rows, [50, 51, 120], axis=0), "repair = true"
    elif kind == "dead":
        header.append("grip")
        rows = np.column_stack([rows, np.zeros(len(rows))])
    save(path, rows, ",".join(header), "%.12g")
    return ONE + more


KINDS = ["t_ms", "Time [us]", "t", "Zeit", "no time", "hinge_deg", "hinge [mrad]", "counts"]
KINDS += ["motor [mNm]", "wraps", "jitter", "gap", "dead"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_is_read_as_it_is_written(arm, kind):
    """Units of headers, whatever time is called, stamps that jitter, lost rows, a column that is dead."""
    grip = '</body><body><joint name="grip"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    (arm / "arm.xml").write_text(HINGE.replace("</body>", grip, 1))
    rows = np.loadtxt(arm / "one.csv", delimiter=",", skiprows=1)
    text = rewritten(arm / "one.csv", kind)
    dead = "columns that never change are left out: grip"
    with pytest.warns(UserWarning, match=dead) if kind == "dead" else contextlib.nullcontext():
        found = loaded(arm, text)
    (doubt,) = found.doubts
    assert doubt == dead if kind == "dead" else "no column measures grip" in doubt
    case = found.case
    assert case.plant.dt_s == pytest.approx(DT_S, rel=1e-4)
    assert case.outputs == ("hinge",)
    first = case.experiments[0]
    # Between readings that were lost or came late a spline of noisy angles is as good as these are.
    loose = {"jitter": 1e-3, "gap": 1e-3, "wraps": 0.02 + 1e-9}.get(kind, 1e-9)
    np.testing.assert_allclose(first.output, rows[: len(first.output), 2:], rtol=0, atol=loose)
    if kind == "wraps":
        steps = [np.diff(one) for one in (first.output[:, 0], rows[: len(first.output), 2])]
        np.testing.assert_allclose(*steps, atol=1e-9)
    kept = np.ones(len(first.output), bool)
    kept[[50, 51, 120]] = kind != "gap"
    np.testing.assert_allclose(first.input[kept, 0], rows[: len(first.output)][kept, 1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "complaint"),
    [
        ("jitter", "--repair (repair = true)"),
        ("gap", "--repair (repair = true)"),
        ("counts", 'columns = {"hinge" = {column = "enc [counts]", scale = ...}}'),
        ("no time", "state its period (--dt-s, dt_s = ...)"),
    ],
)
def test_what_a_log_lacks_is_asked_for_with_options_that_exist(arm, refused, kind, complaint):
    rewritten(arm / "one.csv", kind)
    (arm / "arm.toml").write_text(f'{ONE}columns = {{hinge = "enc [counts]"}}')
    model = ("--mjcf", arm / "arm.xml", "--log", arm / "one.csv")
    arguments = (arm / "arm.toml",) if kind == "counts" else model
    assert complaint in refused("diagnose", *arguments, "--out", arm / "out")


REACHES = [
    ('range="-150 150"', 80.0, "motor and hinge in degrees (motor up to 80, the model 2.62 rad)?"),
    ("", 80.0, "scale = 0.0174533}} (1: in the model's unit)"),
    ('type="slide" range="0 0.5"', 400.0, "motor and hinge in millimetres"),
    ('range="-150 150"', 2.0, ""),
]


@pytest.mark.parametrize(("joint", "size", "asked"), REACHES)
def test_positions_far_out_of_reach_are_asked_for_before_anything_runs(tmp_path, joint, size, asked):
    pytest.importorskip("mujoco")
    servo = HINGE.replace('<motor name="motor" joint', '<position name="motor" kp="9" joint')
    (tmp_path / "arm.xml").write_text(servo.replace('name="hinge"', f'name="hinge" {joint}', 1))
    rows = [(DT_S * k, size * np.sin(0.05 * k), size * np.sin(0.05 * k)) for k in range(300)]
    save(tmp_path / "one.csv", rows)
    with pytest.raises(InputError, match=re.escape(asked)) if asked else contextlib.nullcontext():
        loaded(tmp_path, ONE)


@pytest.mark.parametrize("model", ['mjcf = "arm.xml"', 'python = "gain.py"'], ids=["mjcf", "python"])
@pytest.mark.parametrize(
    ("header", "per_s", "unit"),
    [("time_s", 1e3, "ms"), ("t", 1e3, "ms"), ("t", 1e6, "us"), ("t", 1 / DT_S, "ms"), ("t_ms", 1.0, "s")],
)
def test_time_in_another_unit_is_refused_before_anything_runs(arm, model, header, per_s, unit):
    """10 ms are two steps of the model: 10 s, 1 s (counted samples) and 10 us are no sampling of it. Without
    a step whole numbers give it away."""
    (arm / "gain.py").write_text(GAIN)
    rows = np.loadtxt(arm / "one.csv", delimiter=",", skiprows=1)
    rows[:, 0] = np.round(rows[:, 0] * per_s, 6)
    save(arm / "one.csv", rows, f"{header},motor,hinge", "%.8g")

    def load(more: str = "") -> float:
        return loaded(arm, f'{model}\nlog = "one.csv"\n{more}').case.dt_s

    if "python" in model and header == "t_ms":
        assert load() == pytest.approx(1e-3 * DT_S)  # of 10 us nobody knows that they are wrong
        return
    with pytest.raises(InputError, match=rf"one.csv: '{header}' steps by .*: is it in {unit}\?") as raised:
        load()
    (remedy,) = re.findall(r"columns = \{time_s.*?\}\}", str(raised.value))
    assert load(remedy) == pytest.approx(DT_S if per_s != 1 / DT_S else 1e-3)
    if "mjcf" in model:
        with pytest.raises(InputError, match="2000 steps of the model"):
            load(f"{remedy}\nresample_s = 10")


def test_the_command_refuses_with_exit_code_2(tmp_path, refused):
    for arguments in (("--mjcf", "arm.xml"), ("--log", "run.csv"), ()):
        assert "--mjcf" in refused("diagnose", *arguments, "--out", tmp_path / "out")
        assert not (tmp_path / "out").exists()


def test_a_folder_of_a_stranger_runs_nothing(tmp_path, refused):
    (tmp_path / "case.toml").write_text('python = "evil.py"\nlog = "one.csv"\n')
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    assert "name case.toml itself" in refused("diagnose", tmp_path, "--out", tmp_path / "out")
    assert not (tmp_path / "ran").exists()


def test_a_python_file_becomes_a_case(tmp_path):
    source = snippets("python")[-1]
    (tmp_path / "motor.py").write_text(source)
    voltage = np.random.default_rng(0).uniform(-1, 1, 20).repeat(15)
    speed, rows = 0.0, []
    for k, u in enumerate(voltage):
        rows.append([k * DT_S, u, speed])
        speed += DT_S / 0.2 * (10 * u - speed)
    save(tmp_path / "run.csv", rows, "time_s,voltage_V,speed_rad_s")
    case = loaded(tmp_path, 'python = "motor.py"\nlog = "run.csv"').case
    assert [len(e.output) for e in case.experiments] == [200, 100]
    assert [e.role for e in case.experiments] == ["estimation", "held_out"]
    assert {"input_delay", "output_offset"} <= {effect.name for effect in case.plant.effects}
    assert case.plant.tolerances == {"time_constant_s": 0.05, "gain_rad_Vs": 0.05}


@pytest.mark.slow
def test_the_guide_runs_and_its_files_are_those_of_the_example():
    pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    assert snippets("toml")[0] == (EXAMPLE / "arm.toml").read_text()
    settings_of(tomllib.loads(snippets("toml")[1]), "guide")
    experiments = loaded(EXAMPLE, snippets("toml")[0]).case.experiments
    given = {"MujocoArm": MujocoArm, "np": np, "example": EXAMPLE, "experiments": experiments}
    test = doctest.DocTestParser().get_doctest(GUIDE.read_text(), given, GUIDE.name, str(GUIDE), 0)
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test)
    assert (result.failed, result.attempted) == (0, 5)


def test_the_logs_of_the_example_are_what_its_script_records(tmp_path):
    pytest.importorskip("mujoco")
    import runpy

    runpy.run_path(str(EXAMPLE / "record.py"))["main"](tmp_path)
    for name in ("first.csv", "second.csv"):
        again, kept = (np.loadtxt(folder / name, delimiter=",", skiprows=1) for folder in (tmp_path, EXAMPLE))
        np.testing.assert_allclose(again, kept, rtol=0, atol=1e-3)


def set_point(seed: int, rate_s: float = 0.06) -> np.ndarray:
    """Levels of a servo behind a filter, as its log has it: six digits."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-1, 1, 14).repeat(rng.integers(30, 150, 14))
    return np.round(lfilter([1 - np.exp(-DT_S / rate_s)], [1, -np.exp(-DT_S / rate_s)], levels), 6)


# From level to level at a steady speed, and held there for as long.
RAMPS = np.interp(
    np.arange(1200), np.arange(0, 1200, 20), np.random.default_rng(3).uniform(-1, 1, 30).repeat(2)
)


@pytest.mark.parametrize(
    ("command", "cut"),
    [
        (np.random.default_rng(0).uniform(-1, 1, 60).repeat(25), False),
        (np.random.default_rng(0).uniform(-1, 1, 60).repeat(25).clip(-0.8, 0.8), True),
        (np.sin(np.arange(1500) / 40), False),
        (np.sin(np.arange(1500) / 40).clip(-0.9, 0.7), True),
        (np.where(np.random.default_rng(0).random(1500) > 0.5, 1.0, -1.0), False),
        *((set_point(seed), False) for seed in range(4)),
        (set_point(0).clip(-0.3, 0.3), True),
        (RAMPS, False),
    ],
    ids=["levels", "levels cut off", "sine", "sine cut off", "two levels"]
    + ["set point"] * 4
    + ["set point cut off", "ramps"],
)
def test_a_command_is_cut_off_where_it_stays_at_its_ends(command, cut):
    assert bool(check.share_at_ends(command)) == cut


@pytest.mark.parametrize(
    ("names", "motion", "units"),
    [
        (
            ("force_N", "place_m"),
            "position",
            {"coulomb_friction": "force_N", "viscous_friction": "coefficient_Ns_m", "backlash": "gap_m"}
            | {"hardening_spring": "cubic_N_m3", "input_drift": "rate_N_s", "input_delay": ""},
        ),
        (
            ("drive_V", "speed_rad_s"),
            "speed",
            {"spring": "stiffness_V_rad", "output_drift": "rate_rad_s2", "output_offset": "offset_rad_s"},
        ),
        (("u", "y"), "speed", {"coulomb_friction": "", "output_offset": ""}),
    ],
    ids=["position", "speed", "no units"],
)
def test_sizes_have_the_units_of_inputs_and_outputs(tmp_path, names, motion, units):
    integrated = "np.cumsum(speed) * 0.01" if motion == "position" else "speed"
    (tmp_path / "m.py").write_text(
        "import numpy as np\nfrom scipy.signal import lfilter\n"
        f"INPUTS, OUTPUTS, PARAMETERS = {names[0]!r}, {names[1]!r}, {{'gain': 2.0}}\n"
        "def simulate(p, effects, u):\n    speed = lfilter([0, 0.05 * p['gain']], [1, -0.95], u[:, 0])\n"
        f"    return ({integrated})[:, None]\n"
    )
    u = np.random.default_rng(0).uniform(-1, 1, 20).repeat(20)
    rows = np.column_stack([0.01 * np.arange(400), u, np.cumsum(u) * 0.01])
    save(tmp_path / "m.csv", rows, f"time_s,{','.join(names)}")
    settings = settings_of({"python": "m.py", "log": "m.csv", "motion": motion}, "here")
    loaded = load_simulator_case(settings, tmp_path, "here")
    for effect, parameter in units.items():
        assert next(iter(loaded.units[effect].values()), "") == parameter


@pytest.mark.slow
def test_check_says_what_logs_can_tell(tmp_path, flexlink, refused):
    """Of a bad log: a command that is cut off, one column of noise, values that act alike."""
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(HINGE)
    for seed, name in enumerate(("one.csv", "two.csv")):
        write_log(tmp_path / name, seed, 0.1)
    rows = np.loadtxt(tmp_path / "two.csv", delimiter=",", skiprows=1)
    rows[:, 1] = np.clip(rows[:, 1] + 1e-3 * np.arange(len(rows)), -0.5, 0.5)
    save(tmp_path / "two.csv", rows)
    arguments = ["--mjcf", str(tmp_path / "arm.xml")]
    for name in ("one.csv", "two.csv"):
        arguments += ["--log", str(tmp_path / name)]
    document = flexlink("check", *arguments, "--json").document()
    rows_of = {(row["section"], row["label"]): row["value"] for row in document["table"]}
    assert "is it cut off?" in rows_of["two", "motor"]
    assert ("one", "motor") not in rows_of
    assert rows_of["two", "samples"].endswith("validation")
    assert document["numbers"]["doubts"] == []
    assert rows_of["smallest size that shows", "motor.gain"].endswith("% of 1")
    groups = [{*one["names"]} for one in document["numbers"]["alike"]]
    assert {"hinge.damping", "rod.mass", "motor.gain"} in groups
    assert any("with a known mass on it" in words for words in document["numbers"]["advice"])
    (tmp_path / "arm.toml").write_text('mjcf = "arm.xml"\nlog = ["one.csv", "two.csv"]\n')
    again = flexlink("check", str(tmp_path / "arm.toml"), "--json").document()
    assert again["numbers"]["alike"] == document["numbers"]["alike"]
    rows = np.loadtxt(tmp_path / "one.csv", delimiter=",", skiprows=1)
    rows[:, 2] = np.rad2deg(rows[:, 2])
    save(tmp_path / "one.csv", rows)
    (doubt,) = flexlink("check", *arguments, "--json").document()["numbers"]["doubts"]
    assert "is its column in degrees?" in doubt
    (tmp_path / "rig.toml").write_text('rig = "rig.toml"\nexperiments = []\n')
    assert "names no simulator's model" in refused("check", tmp_path / "rig.toml")
    next_command = shlex.join(["flexlink", "diagnose", *arguments])
    assert document["verdict"].endswith(f"Next: {next_command} --out found")
    assert again["verdict"].endswith(f"Next: flexlink diagnose {tmp_path / 'arm.toml'} --out found")


SWIVEL = """
import numpy as np
INPUTS, OUTPUTS = ("torque_Nm",), ("angle_rad",)
PARAMETERS = {"J": 0.02, NAME: 1.5, "damp": 0.04}
def simulate(p, effects, u):
    angle, speed, found = 0.0, 0.0, []
    for torque in u[:, 0]:
        found.append([angle])
        for _ in range(4):
            speed += 0.0025 * (torque - p[NAME] * angle - p["damp"] * speed) / p["J"]
            angle += 0.0025 * speed
    return np.array(found)
"""


def swivel_case(folder, name, more=""):
    """A motor on a spring whose stiffness has this name; the logs are of a spring 10 % stiffer."""
    (folder / "swivel.py").write_text(SWIVEL.replace("NAME", repr(name)))
    simulate = runpy.run_path(str(folder / "swivel.py"))["simulate"]
    for seed, log in enumerate(("one.csv", "two.csv")):
        rng = np.random.default_rng(seed)
        torque = rng.uniform(-1, 1, 15).repeat(20)[:, None]
        angle = simulate({"J": 0.02, name: 1.65, "damp": 0.04}, {}, torque)
        angle = angle + 1e-3 * rng.standard_normal(angle.shape)
        rows = np.column_stack([0.01 * np.arange(len(torque)), torque, angle])
        save(folder / log, rows, "time_s,torque_Nm,angle_rad")
    text = f'python = "swivel.py"\nlog = ["one.csv", "two.csv"]\n{more}'
    return load_simulator_case(settings_of(tomllib.loads(text), "here"), folder, "here")


@pytest.mark.parametrize(
    "name",
    [
        "spring",
        "wrong_J",
        *(pytest.param(k, marks=pytest.mark.long) for k in ("input_delay", "ratio", "coulomb_friction")),
    ],
)
def test_candidates_are_the_same_whatever_a_parameter_is_called(tmp_path, name):
    """Of a parameter that is called like a listed effect, and of one that nothing is called."""
    plain = telling(swivel_case(tmp_path, "zeta").case)
    found = telling(swivel_case(tmp_path, name).case)
    assert len(found.least) == len(plain.least)
    called = f"wrong_{name}" if name in plain.least else name
    assert {**plain.least, called: plain.least["zeta"]} == {**found.least, "zeta": found.least[called]}
    assert len(found.alike) == len(plain.alike)


def test_an_effect_and_a_value_of_one_name_are_left_out_one_by_one(tmp_path):
    every = swivel_case(tmp_path, "spring").case.plant
    assert "spring" in every.tolerances
    assert "spring" in {effect.name for effect in every.effects}
    for pattern, value, effect in (("wrong_spring", False, True), ("spring", True, False)):
        plant = swivel_case(tmp_path, "spring", f'exclude = ["{pattern}"]').case.plant
        assert ("spring" in plant.tolerances) is value
        assert ("spring" in {effect.name for effect in plant.effects}) is effect
        assert "candidates" in plant.inactive["wrong_spring" if effect else "spring"]
    for pattern in ("J", "wrong_J"):
        assert "J" not in swivel_case(tmp_path, "spring", f'exclude = ["{pattern}"]').case.plant.tolerances


def test_a_symbol_with_an_index_states_no_unit(tmp_path):
    """k_s is a stiffness as likely as a value in seconds; time_constant_s states what it is in."""
    for name, said in (("k_s", "of 1.5"), ("free_s", "of 1.5 s")):
        loaded = swivel_case(tmp_path, name)
        summary = check.of_case(loaded, telling(loaded.case))
        (sizes,) = [section for section in summary.sections if section.title == "smallest size that shows"]
        assert {row.name: row.text for row in sizes.rows}[name].endswith(said)


def test_advice_stays_a_sentence_and_names_are_those_of_the_model():
    alike = tuple(Alike((f"a_{k}.x", f"b_{k}.y"), 0.1) for k in range(8))
    (words,) = check._advice(Telling({}, (), alike))
    assert words.startswith("for a_0.x and b_0.y; a_1.x and b_1.y and 6 more groups: record at another speed")
    assert in_words("elbow_cmd.delay") == "elbow_cmd.delay"
    assert in_words("own_effect") == "own effect"


@pytest.mark.parametrize("command", [("check",), ("diagnose", "--out", "found")])
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--mjcf arm.xml", "--log FILE, once for each"),
        ("--mjcf arm.xml --log a.csv b.csv c.csv", "b.csv: write --log before each log"),
        ("--log a.csv", "expected a case file, or --mjcf"),
        ("--mjcf arm.xml --log a.csv --exclude *.mass", "write exclude = ... in a case file"),
        ("--mjcf arm.xml --log a.csv --model-error 0.1", "write model_error = ... in a case file"),
        ("--mjcf arm.xml --log a.csv --sizes", "No such option: --sizes"),
    ],
)
def test_a_call_that_is_no_case_is_told_what_to_write(refused, command, arguments, said):
    assert said in refused(*command, *arguments.split())
