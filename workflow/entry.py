"""One library call per command: files and options in, a table of numbers out."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from control_design.youla import youla_bracket
from ident.record import Record
from workflow import storage
from workflow.config import RunConfig, SimulatedSource, load_config
from workflow.design_source import DesignFile, DesignSource, load_sources, read_design_file
from workflow.errors import InputError, naming
from workflow.pipeline import config_of, run_pipeline
from workflow.progress import Progress
from workflow.randomness import stage_rng
from workflow.run_directory import RunDirectory, default_directory
from workflow.simulated_rig import INPUT_NAME, OUTPUT_NAMES, simulate_record
from workflow.summary import (
    Row,
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


def _mat_bytes(controller: Controller) -> bytes:
    stream = BytesIO()
    controller.save_mat(stream)
    return stream.getvalue()


_NO_CONTROLLER = (
    "there is no controller and no certificate; lower bandwidth_rad_s, raise controller_order, or improve "
    "the model where its ellipses are widest"
)
_CONTROLLER_FILES: dict[str, Callable[[Controller], bytes]] = {
    ".json": lambda controller: controller.to_json().encode(),
    ".mat": _mat_bytes,
    ".c": lambda controller: c_source(controller).encode("ascii"),
}


def design_controller(
    sources: Path | Sequence[Path],
    specification_path: Path | None,
    *,
    out: Path | None = None,
    seed: int = 2006,
) -> RunSummary:
    """Design and certify one controller for one or several plants (files: `workflow.design_source`).

    Without a design file the source must be a run directory, whose own specification is taken. With `out` the
    controller is written, by its ending as JSON, MAT file or C source; one that is not certified carries that
    in its name. A specification that no controller can meet is a result (not certified, the reason in
    `verdict`), as in a run. Raises InputError.
    """
    paths = [Path(sources)] if isinstance(sources, (str, Path)) else [Path(path) for path in sources]
    if not paths:
        raise InputError("nothing to design for: give at least one run directory or file with a plant")
    if out is not None:
        if out.suffix.lower() not in _CONTROLLER_FILES:
            raise InputError(f"--out {out}: the ending must be one of {', '.join(_CONTROLLER_FILES)}")
        storage.check_writable(out)
        if out.absolute() in [path.absolute() for path in paths]:
            raise InputError(f"--out {out} is a source; give the controller a name of its own")
    for path in paths:
        if not path.exists():
            raise InputError(f"cannot read {path}: no such file or directory")
    asked = read_design_file(specification_path) if specification_path is not None else DesignFile()
    found = load_sources(paths, asked)
    specification, options = asked.specification, asked.synthesis or found[0].synthesis or SynthesisOptions()
    if specification is None:
        if len(paths) > 1:
            raise InputError(f"{len(paths)} plants, no specification for all of them: give --spec FILE")
        specification = found[0].specification
    if specification is None:
        raise InputError(f"{paths[0]} holds no specification: give --spec FILE")
    plants = [source.plant for source in found]
    certificate: Certificate | None = None
    advice: str | None = None
    design: dict[str, Any]
    with naming("design"):
        try:
            result = synthesise(plants, specification, options, rng=stage_rng(seed, "design"))
        except SpecificationError as impossible:
            reason = f"specification not met: {impossible}"
            design = {"synthesis": None, "met": False, "reason": reason}
        else:
            reason = result.explain()
            design = {"synthesis": result.to_dict(), "met": result.gamma <= 1.0, "reason": reason}
            if result.outcome is Outcome.NOT_CONVERGED:
                reason = f"{reason}; {_NO_CONTROLLER}"
            else:
                certificate = certify(
                    result.controller, plants, specification, between_own_points=asked.plant.between_points
                )
                if result.outcome is Outcome.NOT_MET:
                    advice = order_advice(plants, specification, result.gamma)
            if certificate is not None and out is not None:
                written = result.controller
                if not certificate.certified:
                    written = replace(written, name=f"{written.name} (NOT CERTIFIED)")
                storage.write_bytes(out, _CONTROLLER_FILES[out.suffix.lower()](written))
    certified = certificate is not None and certificate.certified
    if certificate is not None and not certified:
        missed = [item.sentence() for item in certificate.items if not item.met]
        reason = "not certified: " + ("; ".join(missed) or "unstable, or an ellipse reaches -1")
        if advice is not None:
            reason += f"; {advice}"
    verdict = {
        "certificate": None if certificate is None else certificate.to_dict(),
        "certified": certified,
        "reason": reason,
    }
    names = [plant.name for plant in plants]
    about = [
        {"file": str(path), "plant": source.plant.name, "origin": source.origin, "remarks": source.remarks}
        for path, source in zip(paths, found, strict=True)
    ]
    return RunSummary(
        title=f"controller for {names[0]}" if len(names) == 1 else f"controller for {len(names)} plants",
        sections=(
            Section("plants", tuple(row for source in found for row in _plant_rows(source))),
            Section("design", (*design_rows(design), *([Row("order", advice)] if advice else []))),
            Section("certificate", (*certificate_rows(verdict), *_not_checked_rows(certificate))),
        ),
        numbers={
            "plants": about,
            "design": {**design, "order_advice": advice},
            **verdict,
            "file": str(out) if out is not None and certificate else None,
        },
        certified=certified,
        verdict=reason,
    )


def _not_checked_rows(certificate: Certificate | None) -> list[Row]:
    words = () if certificate is None else certificate.not_checked
    return [Row("not checked" if number == 0 else "", text) for number, text in enumerate(words)]


def _plant_rows(source: DesignSource) -> list[Row]:
    return [Row(source.plant.name, source.origin), *(Row("", remark) for remark in source.remarks)]


def order_advice(plants: Sequence[UncertainPlant], specification: Specification, gamma: float) -> str | None:
    """Whether a higher order could meet what was missed, from the Youla bracket; None where it says nothing.

    The bracket knows neither structure nor damping of the controller's poles, and with several plants it is
    what one controller per plant reaches: more than that no order gives.
    """
    try:
        bracket = youla_bracket(plants, specification)
    except (ValueError, ArithmeticError):  # plants the parametrisation cannot take; the verdict stands alone
        return None
    reached = bracket.ellipse
    if not np.isfinite(reached):
        return None
    order = specification.controller_order
    if reached > 1.0:
        return (
            f"a higher order does not help: a controller of very high order reaches {reached:.4g} here "
            f"(this one {gamma:.4g}, 1 is needed); ask for less"
        )
    several = ", one for each plant" if len(plants) > 1 else ""
    return (
        f"controller_order = {order} is too low: controllers of very high order{several} reach {reached:.4g} "
        f"(this one {gamma:.4g}, at most 1 is needed)"
    )
