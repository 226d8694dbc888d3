"""`flexlink design`: one controller for one or several plants, from files and into files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from control_design.controllers.c_code import Dialect
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from workflow.config.design_file import DesignFile
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.tasks.design import (
    bracket_numbers,
    certify_asked,
    check_filter,
    find_bracket,
    find_design,
    find_filter,
    joint_numbers,
)
from workflow.tasks.design_source import load_sources
from workflow.tasks.exports import SUFFIXES, filter_file, targets, write_controller
from workflow.tasks.results import AchievablePerformance, CertifyResult, DesignResult, ReferenceFilterResult
from workflow.text.templates import RunSummary, rows_of, said


@dataclass(frozen=True)
class _Designed:
    """Results of a design, of the same types as a run's stages."""

    design: DesignResult
    certify: CertifyResult
    achievable: AchievablePerformance = field(default_factory=AchievablePerformance)
    reference_filter: ReferenceFilterResult = field(default_factory=ReferenceFilterResult)


def _design(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    asked: DesignFile,
    seed: int,
    report: Callable[..., None],
) -> _Designed:
    with naming("design"):
        design = find_design(
            plants, specification, asked.synthesis, asked.certificate, stage_rng(seed, "design"), report
        )
        specification = design.specification or specification
        nothing = CertifyResult(None, certified=False, reason=design.reason)
        if design.synthesis is None:
            return _Designed(replace(design, reason=f"specification not met: {design.reason}"), nothing)
        achievable = find_bracket(plants, specification, asked.achievable_performance)
        if (controller := design.controller) is None:
            return _Designed(design, nothing, achievable)
        certified = certify_asked(
            controller,
            plants,
            specification,
            asked.certificate,
            stage_rng(seed, "certify"),
            between_own_points=asked.plant.between_points,
        )
        return _Designed(
            design, certified, achievable, find_filter(controller, plants, asked.reference_filter)
        )


def design_controller(
    paths: Sequence[Path],
    file: DesignFile | None = None,
    *,
    out: Path | None = None,
    seed: int = 2006,
    dialect: Dialect | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Design and certify one controller for one or several plants (files: `workflow.tasks.design_source`).

    file: None takes the specification of a run directory. out: of the controller, by its ending as JSON, MAT
    file or C source (as of dialect), and beside it of a reference filter. A specification that no controller
    can meet is a result: not certified, the reason in `verdict`. Raises InputError.
    """
    name, file = (file.name, file) if file is not None else (str(paths[0]), DesignFile())
    written = [] if out is None else targets(out)
    if out is not None and not out.is_dir() and out.suffix.lower() not in SUFFIXES:
        raise InputError(f"--out {out}: the ending must be one of {', '.join(SUFFIXES)}, or a directory")
    storage.refuse_in_the_way(
        paths, [("--out", one) for path in written for one in (path, filter_file(path))]
    )
    progress = progress or Progress()
    progress.plan([("plants", 5.0), ("design", 30.0)])
    with progress.stage("plants"):
        sources_found = load_sources(paths, file)
    asked = file.completed(sources_found[0].config)
    specification = file.specification if len(paths) > 1 else asked.specification
    if specification is None:
        raise InputError(f"{', '.join(map(str, paths))}: no specification for all: give --spec FILE")
    plants = [source.plant for source in sources_found]
    logged = [source.logged for source in sources_found if source.logged is not None]
    if len({(one.error, one.command) for one in logged}) > 1:
        raise InputError(
            f"{', '.join(map(str, paths))}: the runs scale their columns differently: no controller fits all"
        )
    check_filter(asked.reference_filter, plants[0].dt_s, name)
    with progress.stage("design") as update:
        done = _design(plants, specification, asked, seed, update)
    certificate, certified = done.certify.certificate, done.certify.certified
    controller = done.design.controller
    order = (done.design.specification or specification).controller_order
    files: list[Path] = []
    if out is not None and controller is not None:
        law = logged[0].law(controller) if logged else controller
        found = done.reference_filter.filter
        known = "; ".join(dict.fromkeys(source.certified_for for source in sources_found))
        files = write_controller(out, law, found, certified=certified, about=known, dialect=dialect)
    gamma, advice = done.design.gamma, None
    if gamma is not None and gamma > 1:
        advice = said("order_advice", done.achievable, gamma, order) or None
    reason = said("design_verdict", done.design, certificate, advice, specification)
    shares = joint_numbers(done.certify.sampled)
    rows = rows_of(
        "summary/design.j2",
        sources=sources_found,
        done=done,
        order=order,
        advice=advice,
        verdict=done.certify,
        shares=shares,
        files=files,
        signals=logged[0].signals if logged else "",
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
