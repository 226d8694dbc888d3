"""The page of what is stable says what the code does."""

import re
from pathlib import Path

import typer

from control_design.controllers.controller import Controller
from ident.basis import model_files
from workflow.cli import app
from workflow.diagnose import directory as diagnosis_directory, document
from workflow.engine import errors, run_directory
from workflow.study import directory as study_directory

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "stable.md").read_text(encoding="utf-8")
STABLE, UNSTABLE = re.findall(r"^\| (`run`.*?) \| (.*) \|$", PAGE, re.MULTILINE)[0]


def test_every_command_is_stable_or_named_as_not():
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert set(re.findall(r"`(\w+)`", STABLE)) | set(re.findall(r"`(\w+)`", UNSTABLE)) == set(commands) | {
        "blind",
        "paper",
    }


def test_formats_are_those_of_the_files():
    assert f"`{model_files.FORMAT}`, `format_version` {model_files.FORMAT_VERSION} |" in PAGE
    assert f"| `controller.json` | `{Controller.format_name()}` |" in PAGE
    assert f"| answer of `diagnose` | `{document.FORMAT}` |" in PAGE
    assert f"| run directory | `layout` {run_directory.LAYOUT_VERSION} in" in PAGE
    assert f"| study directory | `layout` {study_directory.LAYOUT_VERSION} in" in PAGE
    assert f"| diagnosis directory | `layout` {diagnosis_directory.LAYOUT_VERSION} in" in PAGE


def test_exit_codes_are_those_of_the_commands():
    codes = {value for name, value in vars(errors).items() if name.startswith("EXIT_")}
    (said,) = re.findall(r"exit codes ([\d, ]+) \|", PAGE)
    assert codes | {128 + 1, 128 + 14, 128 + 15} == {int(code) for code in said.split(",")}
