"""Models and controllers in files for other programs; a controller that is not certified says so inside."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from control_design.controllers.c_code import Dialect, c_header, c_source
from control_design.controllers.controller import Controller
from control_design.convex.reference_filter import ReferenceFilter
from ident.basis.model_files import ModelFile
from ident.data.foreign_files import content_of
from workflow.config.run_config import AnyConfig, FileSource
from workflow.engine import documents, storage
from workflow.engine.errors import naming
from workflow.engine.run_directory import CONTROLLER_SUFFIXES
from workflow.tasks.results import RecordsResult
from workflow.text.sentences.records import signals
from workflow.text.templates import render_text

# Formats of a controller file, by its ending.
SUFFIXES = (".json", ".mat", ".c")


def filter_file(controller_file: Path) -> Path:
    """Where the reference filter of a controller is written: beside it, by the same ending."""
    return controller_file.with_name(f"{controller_file.stem}_reference_filter{controller_file.suffix}")


def law_bytes(law: Controller | ReferenceFilter, suffix: str, dialect: Dialect = Dialect()) -> bytes:  # noqa: B008
    """Content of a file of a controller or reference filter.

    Parameters
    ----------
    law : Controller or ReferenceFilter
    suffix : str
        ".json", ".mat", ".h", or any other for C source.
    dialect : Dialect
        Names and number type of the C code.
    """
    suffix = suffix.lower()
    if suffix == ".json":
        return law.to_json().encode()
    if suffix == ".mat":
        return law.to_mat()
    code = c_header if suffix == ".h" else c_source
    if isinstance(law, Controller):
        return code(law, dialect.prefix, dialect.number).encode("ascii")
    names = dialect.beside("reference_filter")
    note = render_text("reference_filter_note.h.j2", prefix=names.prefix).rstrip()
    # The controller's generator serves: a state space without limits, from reference to filtered one.
    law = Controller(
        A=law.A, B=law.B, C=law.C, D=law.D, dt_s=law.dt_s,
        computational_delay_samples=0, anti_windup_gain=np.zeros_like(law.B), name="reference_filter",
    )  # fmt: skip
    return f"{note}\n{code(law, names.prefix, names.number)}".encode("ascii")


def gain_unit_of(command_unit: str, error_unit: str) -> str:
    """Unit of a controller's gain, "V/rad"; "" where one of the two is not known ("")."""
    if not (command_unit and error_unit):
        return ""
    if re.search(r"[/ *]", error_unit):
        error_unit = f"({error_unit})"
    return f"{command_unit}/{error_unit}"


@dataclass(frozen=True)
class Logged:
    """Columns of the logs in which a controller is written: it needs no scale and no turned sign on the
    machine.

    Attributes
    ----------
    error, command : tuples of float
        Scales of the Y errors and U commands, of quantity = scale * column + offset.
    signals : str
        What errors and commands are, in words.
    gain_unit : str
        Unit of command over error, "" where it is not known.
    """

    error: tuple[float, ...]
    command: tuple[float, ...]
    signals: str
    gain_unit: str = ""

    @classmethod
    def of(cls, config: AnyConfig, records: RecordsResult) -> Logged:
        """The columns of a run's loops; of simulated records scales are 1."""
        source = config.source
        loops = config.loops
        scale, offset = (source.scale, source.offset) if isinstance(source, FileSource) else ({}, {})
        outputs, inputs = [loop.output for loop in loops], [loop.input for loop in loops]
        columns = [outputs, inputs]
        error, command = (tuple(scale.get(name, 1.0) for name in names) for names in columns)
        units = {name: records.unit(name) for names in columns for name in names}
        known = [units[names[0]] for names in columns if len(names) == 1 and units[names[0]]]
        as_logged = all(factor == 1 for factor in (*error, *command))
        gain_unit = ""
        if len(known) == len(columns) and as_logged:
            error_unit, command_unit = known
            gain_unit = gain_unit_of(command_unit, error_unit)
        return cls(error, command, signals(outputs, inputs, units, scale, offset), gain_unit)

    def law(self, law: Controller) -> Controller:
        """The law for the columns, of one for quantities."""
        scaled = law.in_units(np.array(self.error), np.array(self.command))
        return replace(scaled, signals=self.signals, gain_unit=self.gain_unit)


def targets(out: Path) -> list[Path]:
    """Files of a controller written to `out`: those of a run in a directory, C with its header."""
    if out.is_dir():
        return [out / f"controller{suffix}" for suffix in CONTROLLER_SUFFIXES]
    return [out, out.with_suffix(".h")] if out.suffix.lower() == ".c" else [out]


def write_controller(
    out: Path,
    controller: Controller,
    reference_filter: ReferenceFilter | None,
    *,
    certified: bool,
    about: str = "",
    dialect: Dialect | None = None,
) -> list[Path]:
    """Write the `targets` of `out`; files that have this content already are left alone.

    Parameters
    ----------
    out : Path
        A file, or a directory: then all formats.
    controller : Controller
    reference_filter : ReferenceFilter or None
        Written beside the controller, by `filter_file`.
    certified : bool
        Otherwise the name inside the files says NOT CERTIFIED.
    about : str
        What it is certified for.
    dialect : Dialect, optional
        Of the C code.

    Returns
    -------
    list of Path
        All files of the controller and its filter, written or not.
    """
    c = dialect or Dialect()
    if not certified:
        remark = " (NOT CERTIFIED)"
    elif about:
        remark = f", certified for {about}"
    else:
        remark = ""
    law = replace(controller, name=controller.name + remark)
    content = {path: law_bytes(law, path.suffix, c) for path in targets(out)}
    if reference_filter is not None:
        content |= {filter_file(path): law_bytes(reference_filter, path.suffix, c) for path in targets(out)}
    changed = {}
    for path, data in content.items():
        # A file that would stay the same keeps its time.
        if not path.is_file() or path.read_bytes() != data:
            changed[path] = data
    storage.write_together(changed)
    return list(content)


def model_bytes(path: Path, file: ModelFile) -> bytes:
    """Content of a model file: MAT or, by any other ending of `MODEL_SUFFIXES`, JSON."""
    return file.to_mat() if path.suffix.lower() == ".mat" else file.to_json().encode("utf-8")


def read_model(path: Path) -> ModelFile:
    """The model in a file of `model_bytes`. Raises InputError: one line that names the file."""
    with naming(str(path)):
        if path.suffix.lower() == ".mat":
            return ModelFile.from_mat(content_of(path), str(path))
        return ModelFile.from_json(documents.read_text(path), str(path))
