"""One library call per command: files and options in, a table of numbers out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np

from control_design.analysis.certificate import Certificate
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.synthesis_options import SynthesisOptions
from ident.data.record import Record
from workflow.config.design_options import (
    AchievableOptions,
    CertificateOptions,
    ReferenceFilterSettings,
)
from workflow.config.run_config import RunConfig, SimulatedSource, load_config, load_simulation
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming, need
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.engine.run_directory import RunDirectory, default_directory
from workflow.report.environment import rows_of, said
from workflow.tasks.achievable_performance import bracket_numbers, find_bracket
from workflow.tasks.controller_files import SUFFIXES, filter_file, targets, write_controller
from workflow.tasks.design_source import DesignFile, load_sources, read_design_file
from workflow.tasks.joint_coverage import certify_asked, joint_numbers
from workflow.tasks.pipeline import config_of, run_pipeline
from workflow.tasks.reference_filter import check_filter, find_filter
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    DesignResult,
    ReferenceFilterResult,
    SampledResponses,
)
from workflow.tasks.simulated_rig import INPUT_NAME, OUTPUT_NAMES, simulate_record
from workflow.tasks.stages.design import find_design
from workflow.tasks.summary import RunSummary, sections_of

BetweenPoints = Literal["nothing", "linear"]


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
    config = load_simulation(config_path) if config_path is not None else built_in_config()[0]
    if not isinstance(config.source, SimulatedSource):
        raise InputError(f"{config_path}: source.kind is 'files'; simulating needs kind = 'simulated'")
    out = Path(out)
    RunDirectory(out).refuse_unless_free()
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


_NO_CONTROLLER = (
    "there is no controller and no certificate; lower bandwidth_rad_s, raise controller_order, or improve "
    "the model where its ellipses are widest"
)


@dataclass(frozen=True)
class _Asked:
    """What a design is to be: from the design file, else from the first plant's run, else the defaults."""

    specification: Specification
    synthesis: SynthesisOptions
    certificate: CertificateOptions
    achievable_performance: AchievableOptions
    reference_filter: ReferenceFilterSettings | None

    @classmethod
    def of(cls, file: DesignFile, run: RunConfig | None, paths: Sequence[Path]) -> _Asked:
        """Raises InputError where nothing says what to design for."""
        specification = file.specification
        if specification is None:
            if len(paths) > 1:
                raise InputError(f"{len(paths)} plants, no specification for all of them: give --spec FILE")
            if run is None:
                raise InputError(f"{paths[0]} holds no specification: give --spec FILE")
            specification = run.specification
        if run is None:
            return cls(
                specification,
                file.synthesis or SynthesisOptions(),
                file.certificate or CertificateOptions.model_validate({}),
                file.achievable_performance or AchievableOptions.model_validate({}),
                file.reference_filter,
            )
        return cls(
            specification,
            file.synthesis or run.synthesis,
            file.certificate or run.certificate,
            file.achievable_performance or run.achievable_performance,
            # A design file without [reference_filter] asks for none; it has no other way to.
            run.reference_filter if file.path is None else file.reference_filter,
        )


@dataclass(frozen=True)
class _Designed:
    """Results of a design, of the same types as a run's stages."""

    design: DesignResult
    achievable: AchievablePerformance = field(default_factory=AchievablePerformance)
    certify: CertifyResult | None = None
    reference_filter: ReferenceFilterResult = field(default_factory=ReferenceFilterResult)

    @property
    def certificate(self) -> Certificate | None:
        return None if self.certify is None else self.certify.certificate

    @property
    def controller(self) -> Controller | None:
        """The controller, where there is one that means something."""
        return self.design.synthesis.controller if self.design.synthesis and self.certify else None


def _design(
    plants: Sequence[UncertainPlant], asked: _Asked, between_own_points: BetweenPoints, seed: int
) -> _Designed:
    with naming("design"):
        design = find_design(
            plants, asked.specification, asked.synthesis, asked.certificate, stage_rng(seed, "design")
        )
        if design.synthesis is None:
            return _Designed(replace(design, reason=f"specification not met: {design.reason}"))
        achievable = find_bracket(plants, asked.specification, asked.achievable_performance)
        if not design.has_controller:
            return _Designed(design, achievable)
        controller = design.synthesis.controller
        certified = certify_asked(
            controller,
            plants,
            asked.specification,
            asked.certificate,
            stage_rng(seed, "certify"),
            between_own_points=between_own_points,
        )
        return _Designed(
            design, achievable, certified, find_filter(controller, plants, asked.reference_filter)
        )


def design_controller(
    sources: Path | Sequence[Path],
    specification_path: Path | None,
    *,
    out: Path | None = None,
    seed: int = 2006,
) -> RunSummary:
    """Design and certify one controller for one or several plants (files: `workflow.tasks.design_source`).

    Without a design file the source must be a run directory, whose own specification is taken. With `out` the
    controller is written, by its ending as JSON, MAT file or C source, and beside it a reference filter if
    there is one; a controller that is not certified carries that in its name. A specification that no
    controller can meet is a result (not certified, the reason in `verdict`), as in a run. Raises InputError.
    """
    paths = [Path(sources)] if isinstance(sources, (str, Path)) else [Path(path) for path in sources]
    if not paths:
        raise InputError("nothing to design for: give at least one run directory or file with a plant")
    if out is not None:
        _check_out(out, paths)
    need(*paths)
    file = read_design_file(specification_path) if specification_path is not None else DesignFile()
    sources_found = load_sources(paths, file)
    asked = _Asked.of(file, sources_found[0].config, paths)
    plants = [source.plant for source in sources_found]
    check_filter(asked.reference_filter, plants[0].dt_s, str(file.path or paths[0]))
    done = _design(plants, asked, file.plant.between_points, seed)
    certificate, order = done.certificate, asked.specification.controller_order
    certified = certificate is not None and certificate.certified
    files: list[Path] = []
    if out is not None and done.controller is not None:
        found = done.reference_filter.filter
        files = write_controller(out, done.controller, found, certified=certified)
    gamma, advice = done.design.gamma, None
    if gamma is not None and gamma > 1:
        advice = said("order_advice", done.achievable, gamma, order) or None
    reason = _reason(done, advice)
    sampled = SampledResponses() if done.certify is None else done.certify.sampled
    shares = joint_numbers(sampled)
    rows = rows_of(
        "summary/design.j2",
        sources=sources_found,
        done=done,
        order=order,
        advice=advice,
        verdict=CertifyResult(certificate, certified, reason, sampled),
        shares=shares,
        files=files,
    )
    names = [plant.name for plant in plants]
    about = [
        {"file": str(path), "plant": source.plant.name, "origin": source.origin, "remarks": source.remarks}
        for path, source in zip(paths, sources_found, strict=True)
    ]
    return RunSummary(
        title=f"controller for {names[0]}" if len(names) == 1 else f"controller for {len(names)} plants",
        sections=sections_of(rows),
        numbers={
            "plants": about,
            "design": {**codec.plain(done.design), "order_advice": advice},
            "achievable_performance": bracket_numbers(done.achievable, gamma),
            "certificate": codec.plain(certificate),
            "certified": certified,
            "reason": reason,
            "sampled_responses": shares,
            "reference_filter": codec.plain(done.reference_filter.filter),
            "file": str(files[0]) if files else None,
            "files": [str(path) for path in files],
        },
        certified=certified,
        verdict=reason,
    )


def _check_out(out: Path, sources: Sequence[Path]) -> None:
    """Refuse a place for the controller before anything is computed."""
    if not out.is_dir() and out.suffix.lower() not in SUFFIXES:
        raise InputError(f"--out {out}: the ending must be one of {', '.join(SUFFIXES)}, or a directory")
    for path in (one for target in targets(out) for one in (target, filter_file(target))):
        storage.check_writable(path)
        if path.absolute() in [source.absolute() for source in sources]:
            raise InputError(f"--out {out}: {path} is a source; give the controller a name of its own")


def _reason(done: _Designed, advice: str | None) -> str:
    """How the design stands, in one line."""
    certificate, reason = done.certificate, done.design.reason
    if certificate is None:
        return reason if done.design.synthesis is None else f"{reason}; {_NO_CONTROLLER}"
    if certificate.certified:
        return reason
    missed = [said("requirement", item) for item in certificate.items if not item.met]
    text = "not certified: " + ("; ".join(missed) or "unstable, or an ellipse reaches -1")
    return f"{text}; {advice}" if advice else text
