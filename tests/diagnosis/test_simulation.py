"""The same carriage as a Python file, as an FMU and as a MuJoCo model: one protocol, one motion."""

from pathlib import Path

import numpy as np
import pytest

from diagnosis import PlantExperiment
from diagnosis.machine.simulation import PythonFile, Simulation, plant_with_all

DT_S = 0.02
# Mass, spring and damper are those of the FMU.
PYTHON = """
import numpy as np
from diagnosis import EffectParameter, PlantEffect
INPUTS, OUTPUTS = "force_N", ("position_m",)
PARAMETERS = {"mass": 2.0, "spring": 80.0, "damper": 3.0}
TOLERANCES = {"spring": 0.2}
EFFECTS = (PlantEffect("drag", (EffectParameter("drag", 0.01, 100.0),)),)
def simulate(parameters, effects, inputs):
    m, k, d = parameters.values()
    drag = effects.get("drag", {"drag": 0.0})["drag"]
    x, v, found = 0.0, 0.0, np.zeros(len(inputs))
    for row, u in enumerate(inputs[:, 0]):
        found[row] = x
        for _ in range(20):
            v += 1e-3 * (u - k * x - d * v - drag * v * abs(v)) / m
            x += 1e-3 * v
    return found[:, None]
"""
MJCF = """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body name="carriage">
<joint name="position" type="slide" axis="1 0 0" stiffness="80" damping="3"/>
<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/></body></worldbody>
<actuator><motor name="force" joint="position"/></actuator>
<custom><numeric name="tolerance.position.stiffness" data="0.2"/></custom></mujoco>"""


def levels() -> np.ndarray:
    return np.random.default_rng(0).uniform(-5, 5, 15).repeat(20)[:, None]


def python_file(folder: Path) -> Simulation:
    (folder / "carriage.py").write_text(PYTHON)
    return PythonFile.read(folder / "carriage.py")


def fmu(folder: Path) -> Simulation:
    pytest.importorskip("fmpy")
    from diagnosis.machine.fmu_plant import Fmu
    from tests.diagnosis.test_fmu_plant import compiled

    return Fmu(compiled(folder), DT_S)


def mujoco_model(folder: Path) -> Simulation:
    pytest.importorskip("mujoco")
    from diagnosis.machine.mujoco_plant import MujocoArm

    (folder / "carriage.xml").write_text(MJCF)
    arm = MujocoArm.from_file(str(folder / "carriage.xml"), outputs=("position",), dt_s=DT_S)
    still = np.zeros((300, 1))
    record = PlantExperiment("a", "estimation", np.hstack([levels(), still]), 0.1 * np.sin(levels()))
    return arm.plant([record], np.array([1e-5]), named=["*.drag"]).simulation


@pytest.mark.parametrize("opened", [python_file, fmu, mujoco_model])
def test_every_simulation_says_itself_and_moves_alike(tmp_path, opened):
    simulation = opened(tmp_path)
    assert isinstance(simulation, Simulation)
    assert len(simulation.inputs) == len(simulation.outputs) == 1
    assert {"mass", "spring", "damper"} <= {
        {"stiffness": "spring", "damping": "damper"}.get(name.rpartition(".")[2], name.rpartition(".")[2])
        for name in simulation.parameters
    }
    assert "drag" in {effect.name.rpartition(".")[2] for effect in simulation.effects}
    assert not set(simulation.tolerances) - set(simulation.parameters)

    (tmp_path / "reference").mkdir()
    reference = python_file(tmp_path / "reference")
    moved = reference(reference.parameters, {}, levels())
    inputs = levels()
    if opened is mujoco_model:  # what was measured follows the commands
        inputs = np.hstack([inputs, moved])
    found = simulation(simulation.parameters, {}, inputs)
    assert found.shape == (300, 1)
    # Half a step of the integrators apart.
    assert np.std(found - moved) < 0.01 * np.std(moved)


@pytest.mark.parametrize("opened", [python_file, fmu])
def test_a_simulation_gets_all_listed_effects_around_it(tmp_path, opened):
    simulation = opened(tmp_path)
    moved = simulation(simulation.parameters, {}, levels())
    records = [PlantExperiment("a", "estimation", levels(), moved)]
    plant = plant_with_all(
        simulation,
        records,
        np.array([1e-5]),
        dt_s=DT_S,
        model_error=0.05,
        motion=(simulation.outputs[0], "position"),
    )
    names = {effect.name for effect in plant.effects}
    assert {"drag", "input_delay", "coulomb_friction", "backlash"} <= names
    assert plant.tolerances["mass"] == 0.05
    assert not plant.inactive
    unmoved = plant_with_all(simulation, records, np.array([1e-5]), dt_s=DT_S, model_error=0.05)
    assert "coulomb_friction" in unmoved.inactive


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PYTHON.replace("INPUTS, OUTPUTS", "OUTPUTS, _"), "does not define INPUTS; expected simulate"),
        (PYTHON.replace('{"spring": 0.2}', "0.2"), "TOLERANCES must be name -> number"),
        (PYTHON.replace('{"spring": 0.2}', '{"spring": "soft"}'), "spring must be a number; got 'soft'"),
        (PYTHON + "\nEFFECTS = 3\n", "EFFECTS must be a list of PlantEffect; got 3"),
        (PYTHON + "\nINPUTS = 3\n", "INPUTS must be names"),
        (PYTHON + "\nOUTPUTS = [1, 2]\n", "OUTPUTS must be names"),
        (PYTHON + "\nsimulate = 3\n", "simulate must be a function"),
        (PYTHON + "\nraise ValueError('two\\nlines')\n", r"two lines \(carriage.py, line"),
        (
            PYTHON.replace("import numpy", "import numpi"),
            r"ended with ModuleNotFoundError.*carriage.py, line 2",
        ),
    ],
)
def test_a_python_file_that_is_none_is_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "carriage.py").write_text(text)
    with pytest.raises(ValueError, match=message) as refusal:
        PythonFile.read(tmp_path / "carriage.py")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("line", "dt_s"),
    [
        ("", None),
        ("DT = 0.02", 0.02),
        ("dt, N = 0.001, 20", 0.001),
        ("Ts = 'auto'", None),
        ("DT_S = True", None),
    ],
)
def test_a_file_may_name_its_step(tmp_path, line, dt_s):
    (tmp_path / "carriage.py").write_text(f"{PYTHON}\n{line}\n")
    assert PythonFile.read(tmp_path / "carriage.py").dt_s == dt_s
