"""The rooms and the arrows between them (docs/theory.md, 'The house') hold in the code as it is."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

MAY_IMPORT = {
    "plant": set(),
    "ident": set(),
    "control_design": {"ident"},
    "diagnosis": {"plant", "ident"},
    "workflow": {"plant", "ident", "control_design", "diagnosis"},
}
ROOMS = set(MAY_IMPORT)
# control_design takes result types from ident, never its estimators.
RESULT_TYPES = {"ident.uncertainty", "ident.basis.model", "ident.basis.poles", "ident"}
NOT_IN_NUMERICAL_CODE = ("matplotlib", "typer", "rich", "jinja2")


def _imports(path: Path) -> set[str]:
    """Dotted names of the modules a file imports, at any depth of the file, relative ones resolved."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            prefix = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            found.add(".".join(part for part in (prefix, node.module or "") if part))
    return found


def _files(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_imports_point_one_way(room):
    files = _files(room)
    assert files, f"room {room} has no code"
    for path in files:
        for name in _imports(path):
            top = name.split(".")[0]
            if top in ROOMS and top != room:
                assert top in MAY_IMPORT[room], f"{path.relative_to(ROOT)} imports {name}"
                if room == "control_design":
                    assert name in RESULT_TYPES, f"{path.relative_to(ROOT)} imports {name}, not a result type"


def test_arrows_have_no_circle():
    order = ["plant", "ident", "control_design", "diagnosis", "workflow"]
    for position, room in enumerate(order):
        assert MAY_IMPORT[room] <= set(order[:position])


@pytest.mark.parametrize("room", ["plant", "ident", "control_design", "diagnosis"])
def test_numerical_rooms_run_without_plotting_or_command_line(room):
    # A fresh interpreter in which those modules cannot be found: an import inside a function counts as well
    # only when it runs, so the static check below looks at every import statement.
    code = f"import sys\nfor name in {NOT_IN_NUMERICAL_CODE!r}: sys.modules[name] = None\nimport {room}\n"
    if room == "control_design":
        # python-control draws with matplotlib and imports it itself; only our own imports are on trial there.
        code = f"import {room}\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for path in _files(room):
        bad = {name for name in _imports(path) if name.split(".")[0] in NOT_IN_NUMERICAL_CODE}
        assert not bad, f"{path.relative_to(ROOT)} imports {sorted(bad)}"


def test_no_pickle_anywhere():
    for room in sorted(ROOMS):
        for path in _files(room):
            assert not _imports(path) & {"pickle", "cloudpickle", "joblib", "dill", "shelve"}, path
            text = path.read_text(encoding="utf-8")
            assert "allow_pickle=True" not in text, path


def test_tests_mirror_the_packages():
    for room in sorted(ROOMS):
        assert list((ROOT / "tests" / room).glob("test_*.py")), f"tests/{room} has no tests"
