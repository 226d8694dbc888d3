"""The walkthrough of the README: simulated logs as anybody's CSV files, identified and designed for."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from plant import linear_arm
from plant.presets import paper_link
from tests.golden.margins import ROOT
from workflow.tasks.model_files import read_model


@pytest.mark.slow
def test_readme_walkthrough_from_csv_files_to_a_certified_controller(flexlink, tmp_path):
    shutil.copy(ROOT / "examples" / "own_log.toml", tmp_path)
    logs, model = tmp_path / "logs", tmp_path / "hub.npz"
    assert flexlink("simulate", "--out", logs).code == 0
    *measured, fresh = sorted(logs.glob("*.csv"))
    assert len(measured) == 8
    columns = ["--input", "voltage_V", "--output", "hub_angle_rad", "--time", "time_s"]
    structure = ["--integrators", 1, "--delay", 1, "--real", 1, "--pairs", 2]
    written = ["--report", tmp_path / "hub.html", "--export", tmp_path / "hub.mat", "--out", model]
    told = flexlink("identify", *measured, "--validation", fresh, *columns, *structure, *written, "--json")
    numbers = told.document()["numbers"]
    assert (tmp_path / "hub.html").is_file()
    assert read_model(tmp_path / "hub.mat").model.output_name == "hub_angle_rad"
    # First mode of the arm behind the logs with its hub free, from the physical model alone.
    poles = linear_arm(paper_link()).poles()
    flexible = min(abs(pole) for pole in poles if pole.imag > 10) / (2 * np.pi)
    modes = [mode["frequency_Hz"] for mode in numbers["modes"]]
    assert min(abs(frequency - flexible) for frequency in modes) < 0.02 * flexible
    designed = flexlink("design", model, "--specification", specification_of(tmp_path), "--json")
    assert designed.code == 0
    done = flexlink("run", "--config", tmp_path / "own_log.toml", "--out", tmp_path / "run", "--json")
    assert done.code == 0
    assert (tmp_path / "run" / "report.html").is_file()


def specification_of(folder: Path) -> Path:
    """The [specification] of the example as a file of its own."""
    wanted = tomllib.loads((folder / "own_log.toml").read_text(encoding="utf-8"))["specification"]
    path = folder / "specification.toml"
    path.write_text("\n".join(f"{key} = {value}" for key, value in wanted.items()), encoding="utf-8")
    return path
