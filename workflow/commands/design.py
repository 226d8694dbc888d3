"""`flexlink design`: one controller for one or several plants, from files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.synthesis_options import SynthesisOptions
from workflow.config.design_options import (
    AchievableOptions,
    CertificateOptions,
    ReferenceFilterSettings,
)
from workflow.config.run_config import RunConfig
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming, need
from workflow.engine.randomness import stage_rng
from workflow.tasks.achievable_performance import bracket_numbers, find_bracket
from workflow.tasks.controller_files import SUFFIXES, filter_file, targets, write_controller
from workflow.tasks.design import certify_asked, find_design, joint_numbers
from workflow.tasks.design_source import DesignFile, load_sources, read_design_file
from workflow.tasks.reference_filter import check_filter, find_filter
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    DesignResult,
    ReferenceFilterResult,
)
from workflow.tasks.summary import RunSummary
from workflow.text.templates import rows_of, said

BetweenPoints = Literal["nothing", "linear"]


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
        # A design file without [reference_filter] asks for none; it has no other way to.
        filtered = run if run is not None and file.path is None else file
        return cls(
            specification,
            file.synthesis or (run.synthesis if run else SynthesisOptions()),
            file.certificate or (run.certificate if run else CertificateOptions.model_validate({})),
            file.achievable_performance
            or (run.achievable_performance if run else AchievableOptions.model_validate({})),
            filtered.reference_filter,
        )


@dataclass(frozen=True)
class _Designed:
    """Results of a design, of the same types as a run's stages."""

    design: DesignResult
    certify: CertifyResult
    achievable: AchievablePerformance = field(default_factory=AchievablePerformance)
    reference_filter: ReferenceFilterResult = field(default_factory=ReferenceFilterResult)


def _design(
    plants: Sequence[UncertainPlant], asked: _Asked, between_own_points: BetweenPoints, seed: int
) -> _Designed:
    with naming("design"):
        design = find_design(
            plants, asked.specification, asked.synthesis, asked.certificate, stage_rng(seed, "design")
        )
        nothing = CertifyResult(None, certified=False, reason=design.reason)
        if design.synthesis is None:
            return _Designed(replace(design, reason=f"specification not met: {design.reason}"), nothing)
        achievable = find_bracket(plants, asked.specification, asked.achievable_performance)
        if not design.has_controller:
            return _Designed(design, nothing, achievable)
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
            design, certified, achievable, find_filter(controller, plants, asked.reference_filter)
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
    certificate, certified = done.certify.certificate, done.certify.certified
    synthesis, order = done.design.synthesis, asked.specification.controller_order
    files: list[Path] = []
    if out is not None and synthesis is not None and certificate is not None:
        found = done.reference_filter.filter
        files = write_controller(out, synthesis.controller, found, certified=certified)
    gamma, advice = done.design.gamma, None
    if gamma is not None and gamma > 1:
        advice = said("order_advice", done.achievable, gamma, order) or None
    reason = _reason(done, advice)
    shares = joint_numbers(done.certify.sampled)
    rows = rows_of(
        "summary/design.j2",
        sources=sources_found,
        done=done,
        order=order,
        advice=advice,
        verdict=replace(done.certify, reason=reason),
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
        sections=rows,
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
    certificate, reason = done.certify.certificate, done.design.reason
    if certificate is None:
        return reason if done.design.synthesis is None else f"{reason}; {_NO_CONTROLLER}"
    if certificate.certified:
        return reason
    missed = [said("requirement", item) for item in certificate.items if not item.met]
    text = "not certified: " + ("; ".join(missed) or "unstable, or an ellipse reaches -1")
    return f"{text}; {advice}" if advice else text
