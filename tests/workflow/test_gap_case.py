"""The case that the README diagnoses: logs that its machine makes, and the answer that is true."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "gap_case"


def test_its_logs_are_those_of_its_machine(flexlink, tmp_path):
    answer = flexlink("simulate", "--config", EXAMPLE / "machine.toml", "--out", tmp_path / "logs")
    assert answer.code == 0, answer.err
    shipped = sorted((EXAMPLE / "logs").iterdir())
    assert [path.name for path in shipped] == sorted(p.name for p in (tmp_path / "logs").glob("*.csv"))
    for path in shipped:
        made = np.loadtxt(tmp_path / "logs" / path.name, delimiter=",", skiprows=1)
        # Nine digits are written.
        np.testing.assert_allclose(np.loadtxt(path, delimiter=",", skiprows=1), made, rtol=1e-7, atol=1e-9)
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*") if path.is_file()) < 300_000


@pytest.mark.slow
def test_its_answer_is_what_the_machine_has(flexlink, tmp_path):
    answer = flexlink("diagnose", EXAMPLE, "--out", tmp_path / "out", "--no-controller", "--json")
    (found,) = answer.document()["cases"]
    (truth,) = tomllib.loads((EXAMPLE / "machine.toml").read_text())["source"]["effects"]
    assert found["combination"] == [truth["name"]]
    low, high = found["effects"][0]["intervals"]["torque_Nm"]
    # One case: the truth lies in an interval twice as wide.
    assert abs(truth["torque_Nm"] - (low + high) / 2) < high - low
    assert found["gap_after"] < 1.05 < found["gap_refit"]
