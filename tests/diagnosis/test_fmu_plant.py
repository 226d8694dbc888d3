"""An FMU as a plant: compiled here from a source of our own, against the same equation in Python."""

import gc
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("fmpy")

from diagnosis import Plant, PlantCase, PlantExperiment, diagnose
from diagnosis.machine.fmu_plant import Fmu

HERE = Path(__file__).parent / "fmu"
DT_S = 0.02


def compiled(folder: Path, *flags: str) -> Path:
    library = folder / "carriage.so"
    source = str(HERE / "carriage.c")
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", *flags, "-o", str(library), source], check=True)
    path = folder / "carriage.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(HERE / "modelDescription.xml", "modelDescription.xml")
        archive.write(library, "binaries/linux64/carriage.so")
    return path


@pytest.fixture(scope="module")
def carriage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("fmu"))


def unpacked() -> set[Path]:
    return set(Path(tempfile.gettempdir()).glob("flexlink-fmu-*"))


def exact(force: np.ndarray, mass: float, spring: float, damper: float) -> np.ndarray:
    """Positions of the linear carriage under held forces, by the matrix exponential."""
    from scipy.signal import cont2discrete

    A, B, C = [[0, 1], [-spring / mass, -damper / mass]], [[0], [1 / mass]], [[1, 0]]
    Ad, Bd, *_ = cont2discrete((np.array(A), np.array(B), np.array(C), np.zeros((1, 1))), DT_S)
    x, found = np.zeros(2), np.zeros(force.size)
    for k, u in enumerate(force):
        found[k] = x[0]
        x = Ad @ x + Bd[:, 0] * u
    return found


def test_values_of_the_file_are_parameters_and_what_is_zero_an_effect(carriage: Path) -> None:
    fmu = Fmu(carriage, DT_S)
    assert (fmu.inputs, fmu.outputs) == (("force",), ("position",))
    assert fmu.units == {"position": "m"}
    assert fmu.parameters == {"mass": 2.0, "spring": 80.0, "damper": 3.0}
    assert [(e.name, e.parameters[0].high) for e in fmu.effects] == [("drag", 100.0)]


def test_it_follows_the_equation_and_starts_anew_every_time(carriage: Path) -> None:
    fmu = Fmu(carriage, DT_S)
    force = np.random.default_rng(0).choice([-1.0, 1.0], 20).repeat(10)
    values = {"mass": 1.7, "spring": 60.0, "damper": 4.0}
    found = fmu(values, {}, force[:, None])
    np.testing.assert_array_equal(found, fmu(values, {}, force[:, None]))
    # Steps of a millisecond of the first order.
    np.testing.assert_allclose(found[:, 0], exact(force, *values.values()), rtol=0, atol=3e-4)
    assert np.std(found[:, 0]) > 5e-3


@pytest.mark.slow
def test_a_drag_that_the_model_has_at_zero_is_named(carriage: Path) -> None:
    """Truth by an integrator of its own: central differences at a tenth of the FMU's step."""
    rng = np.random.default_rng(1)
    experiments = []
    for role in ("estimation", "held_out"):
        force = 20 * rng.choice([-1.0, 1.0], 15).repeat(20)
        x = last = 0.0
        y = np.zeros(force.size)
        h = DT_S / 200
        for k, u in enumerate(force):
            y[k] = x
            for _ in range(200):
                v = (x - last) / h
                x, last = 2 * x - last + h * h / 2.0 * (u - 80 * x - 3 * v - 8 * v * abs(v)), x
        y += 1e-4 * rng.standard_normal(y.size)
        experiments.append(PlantExperiment(role, role, force[:, None], y[:, None]))
    fmu = Fmu(carriage, DT_S)
    tolerances = dict.fromkeys(fmu.parameters, 0.03)
    plant = Plant(fmu, fmu.parameters, tolerances, fmu.outputs, np.array([1e-4]), fmu.effects, 0.03, DT_S)
    found = diagnose(PlantCase("carriage", plant, tuple(experiments)))
    assert found.combination == ("drag",)
    assert found.repair[0].values["drag"] == pytest.approx(8.0, rel=0.1)


def test_what_is_no_fmu_is_refused_in_one_line(tmp_path: Path) -> None:
    broken = tmp_path / "broken.fmu"
    broken.write_text("nothing")
    with pytest.raises(ValueError, match=r"^.*broken\.fmu: cannot be read as an FMU \(not a zip archive\)$"):
        Fmu(broken, DT_S)


GOOD = {"mass": 2.0, "spring": 80.0, "damper": 3.0}


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        pytest.param({"spring": 600.0}, "the process of the FMU ended with -6", marks=pytest.mark.slow),
        pytest.param({"spring": 0.5}, "the process of the FMU did not answer", marks=pytest.mark.long),
        ({"mass": 0.05}, "the FMU reports: .*fmi2DoStep"),
    ],
)
def test_an_fmu_that_misbehaves_ends_a_trial_and_nothing_else(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    values: dict,
    complaint: str,
) -> None:
    """It aborts, hangs, or returns an error, and it prints; the next trial is as if nothing had been."""
    monkeypatch.setattr("diagnosis.machine.fmu_plant._LONGEST_S", 3.0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # others unpack at the same time
    before = unpacked()
    fmu = Fmu(compiled(tmp_path, "-DMISBEHAVES"), DT_S)
    force = np.ones((40, 1))
    first = fmu(GOOD, {}, force)
    with pytest.raises(ArithmeticError, match=complaint):
        fmu({**GOOD, **values}, {}, force)
    np.testing.assert_array_equal(fmu(GOOD, {}, force), first)
    del fmu
    gc.collect()
    assert unpacked() == before
    assert capfd.readouterr() == ("", "")


def test_files_of_an_fmu_leave_with_a_command_that_is_killed(carriage: Path) -> None:
    before = unpacked()
    program = (
        "import sys, numpy\nfrom pathlib import Path\nfrom diagnosis.machine.fmu_plant import Fmu\n"
        f"fmu = Fmu(Path({str(carriage)!r}), {DT_S})\n"
        "fmu(fmu.parameters, {}, numpy.ones((5, 1)))\nprint('ready', flush=True)\nsys.stdin.read()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=HERE.parents[2]
    )
    assert process.stdout.readline() == b"ready\n"
    assert len(unpacked() - before) == 1
    process.kill()
    process.communicate()
    for _ in range(100):
        if unpacked() == before:
            break
        time.sleep(0.05)
    assert unpacked() == before
