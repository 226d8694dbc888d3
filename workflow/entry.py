"""One library call per command: files and options in, a table of numbers out."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import resources
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from control_design.c_code import c_source
from control_design.certificate import Certificate, certify
from control_design.controller import Controller
from control_design.plant_set import UncertainPlant
from control_design.specification import Specification, SpecificationError
from control_design.synthesis import SynthesisOptions, synthesise
from control_design.synthesis_result import Outcome
from ident.model import GobfModel
from ident.record import Record
from ident.uncertainty import ResponsePosterior
from workflow import storage
from workflow.config import RunConfig, SimulatedSource, load_config
from workflow.errors import InputError, naming
from workflow.pipeline import config_of, run_pipeline
from workflow.progress import Progress
from workflow.randomness import stage_rng
from workflow.run_directory import RunDirectory, default_directory
from workflow.settings import check, read_toml
from workflow.simulated_rig import INPUT_NAME, OUTPUT_NAMES, simulate_record
from workflow.stages.results import load_plant
from workflow.storage import AnyArray
from workflow.summary import (
    RunSummary,
    Section,
    certificate_rows,
    design_rows,
)


def built_in_config() -> tuple[RunConfig, str]:
    """The default arm: configuration and its text."""
    with resources.as_file(resources.files("workflow") / "data" / "default_arm.toml") as path:
        return load_config(path)


def run_from_files(
    config_path: Path | None,
    out: Path | None,
    *,
    resume: bool = False,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Load a configuration and run it; see `run_pipeline`.

    Without `config_path` the built-in default arm is run, or on resuming the configuration kept in `out`;
    without `out` a new directory below runs/ is made. Raises InputError.
    """
    if resume and replace:
        raise InputError("--resume and --replace contradict each other")
    if (resume or replace) and out is None:
        raise InputError(
            f"{'--resume' if resume else '--replace'} needs --out DIR, the directory of the earlier run"
        )
    if config_path is not None:
        config, text = load_config(config_path)
    elif resume and out is not None and (out / "manifest.json").is_file():
        config, text = config_of(RunDirectory.open(out)), ""
    else:
        config, text = built_in_config()
    return run_pipeline(
        config,
        out if out is not None else default_directory(config.run.name),
        config_text=text,
        resume=resume,
        replace=replace,
        progress=progress,
    )


def simulate_to_csv(config_path: Path | None, out: Path) -> list[Path]:
    """Simulate the experiments of a configuration; one CSV per record, named after it.

    Columns time_s, voltage_V, hub_angle_rad, tip_m, so that the files can be read back as a log. Raises
    InputError.
    """
    config, _ = load_config(config_path) if config_path is not None else built_in_config()
    if not isinstance(config.source, SimulatedSource):
        raise InputError(f"{config_path}: source.kind is 'files'; simulating needs kind = 'simulated'")
    out = Path(out)
    RunDirectory.check_free(out)
    records = []
    for index, entry in enumerate(config.source.records):
        with naming(f"source.records[{index}] ({entry.name})"):
            records.append(simulate_record(config.source, entry, config.run.seed).record)
    existed = out.is_dir()
    files: list[Path] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for number, record in enumerate(records, start=1):
            path = out / f"{number:02d}_{file_name(record.name)}.csv"
            storage.write_text(path, csv_text(record))
            files.append(path)
    except (OSError, InputError) as error:
        for path in files:  # all of the experiments or none
            path.unlink()
        if not existed and out.is_dir():
            out.rmdir()
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot write {out}: {error.strerror or error}") from error
    return files


def file_name(name: str) -> str:
    """A record's name in a file name: all but letters, digits, '_', '.' and '-' becomes '_'."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name)


def csv_text(record: Record) -> str:
    """The record as CSV with one header line; nine digits, far below any sensor's noise."""
    lines = [",".join(("time_s", INPUT_NAME, *OUTPUT_NAMES))]
    table = np.column_stack([record.time_s, record.input, record.output])
    lines += [",".join(f"{value:.9g}" for value in row) for row in table]
    return "\n".join(lines) + "\n"


def load_plant_file(path: Path) -> UncertainPlant:
    """The uncertain plant in a file of `plant_arrays`. Raises InputError."""
    arrays = storage.read_npz(path)

    def under(prefix: str) -> dict[str, AnyArray]:
        return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}

    try:
        model = GobfModel.from_arrays(under("model/"))
        posterior = ResponsePosterior.from_arrays(under("posterior/"))
        level = float(arrays["level"])
    except KeyError as error:
        raise InputError(
            f"{path}: not written by flexlink identify --out: {error.args[0]!r} is missing"
        ) from error
    return UncertainPlant(model.output_name, model.to_control(), posterior, level=level)


def _mat_bytes(controller: Controller) -> bytes:
    stream = BytesIO()
    controller.save_mat(stream)
    return stream.getvalue()


_CONTROLLER_FILES: dict[str, Callable[[Controller], bytes]] = {
    ".json": lambda controller: controller.to_json().encode(),
    ".mat": _mat_bytes,
    ".c": lambda controller: c_source(controller).encode("ascii"),
}


def design_controller(
    source: Path, specification_path: Path | None, *, out: Path | None = None, seed: int = 2006
) -> RunSummary:
    """Design and certify a controller for a run's identified plant, or for a file of `flexlink identify
    --out`.

    With `out` the controller is written, by its ending as JSON, MAT file or C source. A specification that no
    controller can meet is a result (not certified, the reason in `verdict`), as in a run. Raises InputError.
    """
    source = Path(source)
    if out is not None:
        if out.suffix.lower() not in _CONTROLLER_FILES:
            raise InputError(f"--out {out}: the ending must be one of {', '.join(_CONTROLLER_FILES)}")
        storage.check_writable(out)
    if source.is_dir():
        run = RunDirectory.open(source)
        config = config_of(run)
        plant, specification, options = load_plant(run, config), config.specification, config.synthesis
    else:
        plant, options = load_plant_file(source), SynthesisOptions()
        if specification_path is None:
            raise InputError(f"{source} holds no specification: give --specification FILE")
    if specification_path is not None:
        _, document = read_toml(specification_path)
        specification = check(
            Specification, document.get("specification", document), source=str(specification_path)
        )
    certificate: Certificate | None = None
    design: dict[str, Any]
    with naming("design"):
        try:
            result = synthesise([plant], specification, options, rng=stage_rng(seed, "design"))
        except SpecificationError as impossible:
            reason = f"specification not met: {impossible}"
            design = {"synthesis": None, "met": False, "reason": reason}
        else:
            reason = result.explain()
            design = {"synthesis": result.to_dict(), "met": result.gamma <= 1.0, "reason": reason}
            if result.outcome is not Outcome.NOT_CONVERGED:
                certificate = certify(result.controller, [plant], specification)
                if out is not None:
                    storage.write_bytes(out, _CONTROLLER_FILES[out.suffix.lower()](result.controller))
    certified = certificate is not None and certificate.certified
    if certificate is not None and not certified:
        missed = [item.sentence() for item in certificate.items if not item.met]
        reason = "not certified: " + ("; ".join(missed) or "unstable, or an ellipse reaches -1")
    verdict = {
        "certificate": None if certificate is None else certificate.to_dict(),
        "certified": certified,
        "reason": reason,
    }
    return RunSummary(
        title=f"controller for {plant.name}",
        sections=(Section("design", design_rows(design)), Section("certificate", certificate_rows(verdict))),
        numbers={"design": design, **verdict, "file": str(out) if out is not None and certificate else None},
        certified=certified,
        verdict=reason,
    )
