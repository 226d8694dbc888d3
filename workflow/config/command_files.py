"""Files that one command reads or writes, as its options name them."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from workflow.config.settings import Section
from workflow.engine.errors import InputError

# Formats of a model file, by its ending.
MODEL_SUFFIXES = (".json", ".mat")


class CommandFiles(Section):
    """None where there is none: no key of a configuration."""

    validation: tuple[Path, ...] = Field((), description="log kept for validation (repeatable)")
    report: Path | None = Field(
        None,
        description="write a one-page report here (HTML, one file): findings first, then the pictures",
    )
    export: Path | None = Field(
        None,
        description="write the model here for other programs: .json or .mat by the ending (state space, "
        "poles, ellipses)",
    )
    controller: Path | None = Field(
        None,
        description="file of the controller: controller.json of a run, or A, B, C, D, or numerator and "
        "denominator in z, or zeros, poles and gain, with dt_s (.json, .mat, .npz); default: that of the run",
    )
    baseline: Path | None = Field(
        None,
        description="worst cases and margins to hold (TOML): none may be worse by more than its tolerance",
    )
    write_baseline: Path | None = Field(
        None, description="write the baseline, where all is certified; tolerances that are there are kept"
    )


def refuse_model_ending(export: Path | None) -> None:
    """Raises InputError for a file of a model whose ending says no format (`MODEL_SUFFIXES`)."""
    if export is not None and export.suffix.lower() not in MODEL_SUFFIXES:
        raise InputError(f"--export {export}: the ending must be {' or '.join(MODEL_SUFFIXES)}")
