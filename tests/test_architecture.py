"""What the import contracts of pyproject.toml (`lint-imports`) do not see; and that they hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("plant", "ident", "control_design", "diagnosis", "workflow", "validation")


def test_import_contracts_hold(capsys):
    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0, (
        capsys.readouterr().out
    )


@pytest.mark.parametrize("package", ["plant", "ident", "diagnosis"])
def test_numerical_packages_run_without_plotting_or_command_line(package):
    # Not even through a library; control_design is left out, since python-control imports matplotlib itself.
    missing = ("matplotlib", "typer", "rich", "jinja2")
    code = f"import sys\nfor name in {missing!r}: sys.modules[name] = None\nfrom {package} import *\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_is_read_as_pickle_and_every_package_has_tests(package):
    for path in (ROOT / package).rglob("*.py"):
        assert "allow_pickle=True" not in path.read_text(encoding="utf-8"), path
    assert list((ROOT / "tests" / package).rglob("test_*.py")), f"tests/{package} has no tests"
