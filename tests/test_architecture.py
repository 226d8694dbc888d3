"""What the import contracts of pyproject.toml (`lint-imports`) do not see; and that they hold."""

import ast
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("plant", "ident", "control_design", "diagnosis", "workflow", "validation")


def test_import_contracts_hold(capsys):
    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0, (
        capsys.readouterr().out
    )


def test_numerical_packages_run_without_plotting_or_command_line():
    # Not even through a library; control_design is left out, since python-control imports matplotlib itself.
    missing = ("matplotlib", "typer", "rich", "jinja2")
    names = "from plant import *; from ident import *; from diagnosis import *"
    code = f"import sys\nfor name in {missing!r}: sys.modules[name] = None\n{names}\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_is_read_as_pickle_and_every_package_has_tests(package):
    for path in (ROOT / package).rglob("*.py"):
        assert "allow_pickle=True" not in path.read_text(encoding="utf-8"), path
    assert list((ROOT / "tests" / package).rglob("test_*.py")), f"tests/{package} has no tests"


def test_the_wheel_has_every_file_that_a_package_reads():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["package-data"]
    for package in (*PACKAGES, "flexlink"):
        patterns = stated["*"] + stated.get(package, [])
        for path in (ROOT / package).rglob("*.*"):
            name, ours = path.relative_to(ROOT / package).as_posix(), "__pycache__" not in path.parts
            there = path.suffix == ".py" or any(fnmatch(name, pattern) for pattern in patterns)
            assert there or not ours, f"{package}/{name} is in no wheel"


_OF_NUMBERS = (ast.BinOp, ast.UnaryOp, ast.operator, ast.unaryop, ast.Attribute, ast.Name, ast.expr_context)


def _is_number(value: ast.expr) -> bool:
    """A number, or one made of numbers and constants such as np.pi."""
    parts = list(ast.walk(value))
    constants = [part.value for part in parts if isinstance(part, ast.Constant)]
    rest = (part for part in parts if not isinstance(part, ast.Constant))
    return (
        bool(constants)
        and all(isinstance(one, int | float) for one in constants)
        and all(isinstance(part, _OF_NUMBERS) for part in rest)
    )


@pytest.mark.parametrize("package", PACKAGES[:-1])
def test_every_number_of_a_module_has_its_reason(package):
    """In a comment on its line or above it, or in a docstring below."""
    bare = []
    for path in sorted((ROOT / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        lines = ["", *text.splitlines(), ""]
        for one in ast.parse(text).body:
            if isinstance(one, ast.Assign | ast.AnnAssign) and one.value and _is_number(one.value):
                said = "#" in "".join(lines[one.lineno : one.end_lineno + 1])
                said |= lines[one.lineno - 1].startswith("#") or lines[one.end_lineno + 1].startswith('"""')
                bare += [] if said else [f"{path.relative_to(ROOT)}:{one.lineno}: {lines[one.lineno]}"]
    assert not bare, "numbers without a reason:\n" + "\n".join(bare)
