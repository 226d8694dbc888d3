"""Mutants: one change each, of code inside functions, in a copy only."""

from pathlib import Path

import pytest

from benchmarks.mutants import Copy, Judge, drawn, mutants_of

SOURCE = b'''"""Docs with 3 * 4."""
from dataclasses import dataclass
LIMIT = 3.0


@dataclass(frozen=True)
class Beam:
    """A beam of 2 parts."""

    length: int = 7

    def inertia(self, scale: "float" = 2.0) -> "tuple[1, 2]":
        """Of 5 - 4 parts."""
        if not scale > 0.5:  # 8 - 9
            raise ValueError(f"scale is {scale - 1}; expected more than {6 + 7}")
        a = (self.length  # above - below
             - scale)
        b = -(1.5 if a else a) ** 2
        b += 11
        \xce\xb1 = "\xc2\xb0"; c = a if b and True else \xce\xb1
        return c

    def __repr__(self):
        return str(12 + 13)


def nothing():
    return None
'''


def test_every_operator_sign_constant_and_return_inside_functions_and_nothing_else():
    found = mutants_of("plant", "plant/a.py", SOURCE)
    assert sorted((one.before.decode(), one.after.decode()) for one in found) == sorted(
        [(">", "<"), ("0.5", "1.0"), ("-", "+"), ("-", "+"), ("+=", "-="), ("11", "12"), ("1.5", "3.0"),
         ("(1.5 if a else a) ** 2", "((1.5 if a else a) * 2)"), ("2", "3"), ("b and True", "(b or True)"),
         ("True", "False"), ("c", "None")]
    )  # fmt: skip


CODE = """def area(width, height):
    return width * height


def twice(x):
    y = 2 * x
    return y
"""
TEST = """import sys
from pathlib import Path
sys.path.insert(0, str(Path(__file__).parents[2]))
from plant.shape import area


def test_area():
    assert area(2, 3) == 6


def test_fails_anyway():
    assert not Path("wrong").exists() and False
"""


@pytest.fixture
def checkout(tmp_path):
    """A small one: one function is tested, one is not, and one test fails."""
    root = tmp_path / "checkout"
    for file, text in {
        "plant/__init__.py": "",  # else an installed package of that name is found first
        "plant/shape.py": CODE,
        "tests/plant/test_shape.py": TEST,
        "pyproject.toml": "[tool.pytest.ini_options]\nmarkers = ['slow: long']\n",
        ".git/config": "",
    }.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(text)
    return root


def texts(root: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def by_function(root: Path, function: str):
    return next(one for one in drawn(root, 0, 9, ["plant"]) if one.function == function)


def test_what_tests_see_and_what_survives_and_the_checkout_stays_as_it_is(checkout, tmp_path):
    before = texts(checkout)
    copy = Copy(checkout, tmp_path / "copies")
    judge = Judge(copy, slow=False)
    seen, not_seen = (judge.verdict(by_function(checkout, each), frozen=True) for each in ("area", "twice"))
    assert seen == "killed by tests/plant/test_shape.py::test_area"
    assert not_seen == "survived the tests; no frozen answers are stored"
    assert judge.fail_anyway == {"tests/plant/test_shape.py::test_fails_anyway"}
    assert judge.cpu_s > 0
    assert texts(checkout) == before
    assert copy.left_behind() == []
    assert not (copy.path / ".git").exists()


def test_tests_that_cannot_be_run_are_said_instead_of_run_for_ever(checkout, tmp_path):
    (checkout / "tests/plant/test_shape.py").write_text("import nowhere\n")
    judge = Judge(Copy(checkout, tmp_path / "copies"), slow=False)
    with pytest.raises(RuntimeError, match="cannot be run without a mutant either: tests/plant/test_shape"):
        judge.verdict(by_function(checkout, "area"), frozen=False)
