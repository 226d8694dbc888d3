"""The case that the README diagnoses has the logs that its machine makes (its answer: `test_readme.py`)."""

from pathlib import Path

import numpy as np

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
