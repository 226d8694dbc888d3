"""What a reader has to hold in mind only grows less: figures of the code, held below their ceilings."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import concepts


@pytest.fixture(scope="module")
def figures():
    return concepts.figures()


def test_no_figure_stands_above_its_ceiling(figures):
    assert concepts.above(figures, concepts.ceilings()) == []


def test_a_figure_above_its_ceiling_is_named_and_no_ceiling_is_raised(monkeypatch, figures):
    held = {"product": {"classes": figures["product"]["classes"] - 1}}
    assert concepts.above(figures, held)[0].startswith("product: ")
    monkeypatch.setattr(concepts, "ceilings", lambda: held)
    monkeypatch.setattr(concepts, "figures", lambda: figures)
    before = concepts.CEILINGS.read_text()
    with pytest.raises(SystemExit, match="no ceiling is raised: product: "):
        concepts.run(lambda line="": None, lower=True)
    assert concepts.CEILINGS.read_text() == before


SOURCE = '''"""Said."""
import os
from dataclasses import dataclass
A, B = 1.0, 2
NAMES = ("x", 3)
LIMIT: float = 4 * 5
MADE = float(6)
FLAG = True

@dataclass(frozen=True)
class One:
    """Said."""
    x: int = 7

class Settings2(BaseModel):
    y: int
    z: int = 8

def f(x, option=typer.Option()):
    if x:
        raise ValueError(x)
    return lambda: x
'''


def test_what_is_counted():
    found, names = concepts.count(SOURCE)
    counted = {"statements": 13, "functions": 1, "classes": 2, "dataclasses": 1, "numbers": 3}
    assert found == {"files": 1, "lines": SOURCE.count("\n"), **counted, "settings": 2, "options": 1}
    assert names == {"One", "Settings2"}


def test_the_other_program_that_counts_finds_the_same(figures):
    """An independent program beside the project, where it is at hand."""
    other = concepts.ROOT.parent / "shared" / "tools" / "concepts.py"
    if not other.is_file():
        pytest.skip(f"{other.name} is not beside the project")
    status = ["git", "status", "--porcelain"]
    if subprocess.run(status, cwd=concepts.ROOT, capture_output=True, check=True).stdout:
        pytest.skip("files are not committed, which the other program does not see")
    done = subprocess.run(
        [sys.executable, str(other), "--json"], cwd=concepts.ROOT, capture_output=True, check=True
    )
    assert json.loads(done.stdout)["product"] == dict(figures["product"])


def test_reference_computation():
    """Fixed work in Python and LAPACK, whose time `benchmarks.durations` sets beside that of all tests."""
    matrix = np.random.default_rng(0).standard_normal((120, 120))
    own = [np.abs(np.linalg.eigvals(matrix + shift)).max() for shift in range(40)]
    total = sum(math.sqrt(k) for k in range(4_000_000))
    assert own[0] == pytest.approx(np.sqrt(120), rel=0.3)  # the circular law
    assert total == pytest.approx(2 / 3 * 4e6**1.5, rel=1e-5)
