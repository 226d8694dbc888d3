"""`flexlink design`: one controller for one or several plants, from files and into files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from control_design.controllers.c_code import Dialect
from control_design.controllers.engineers_numbers import engineers_numbers
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import GIVES_WAY, Specification
from workflow.commands.design_page import refuse_page, write_design_page
from workflow.config.design_file import DesignFile
from workflow.describe.certificate import certificate_section, not_checked_section
from workflow.describe.controller import controller_section
from workflow.describe.design import design_section, design_verdict, filter_section, plants_section
from workflow.describe.facts import Section, said, worded
from workflow.describe.summary import RunSummary
from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming
from workflow.engine.progress import Progress
from workflow.engine.randomness import stage_rng
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.design import (
    bracket_numbers,
    certify_asked,
    check_filter,
    find_bracket,
    find_design,
    find_filter,
    joint_numbers,
)
from workflow.tasks.design_source import DesignSource, load_sources
from workflow.tasks.exports import SUFFIXES, filter_file, targets, write_controller
from workflow.tasks.giving_way import gave_way
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    DesignResult,
    ReferenceFilterResult,
    RunResults,
)
from workflow.text.sentences.design import order_advice


def _design(
    plants: Sequence[UncertainPlant],
    specification: Specification,
    asked: DesignFile,
    seed: int,
    report: Callable[..., None],
) -> tuple[DesignResult, CertifyResult, AchievablePerformance, ReferenceFilterResult]:
    """Results of the types of a run's stages."""
    nothing = AchievablePerformance(), ReferenceFilterResult()
    with naming("design"):
        design = find_design(
            plants,
            specification,
            asked.synthesis,
            asked.certificate,
            stage_rng(seed, "design"),
            report,
            between_own_points=asked.plant.between_points,
        )
        specification = design.specification or specification
        none = CertifyResult(None, certified=False, reason=design.reason)
        if design.synthesis is None:
            return replace(design, reason=f"specification not met: {design.reason}"), none, *nothing
        achievable = find_bracket(plants, specification, asked.achievable_performance)
        controller = design.controller
        if controller is None:
            return design, none, achievable, nothing[1]
        certified = certify_asked(
            controller,
            plants,
            specification,
            asked.certificate,
            stage_rng(seed, "certify"),
            between_own_points=asked.plant.between_points,
        )
        return design, certified, achievable, find_filter(controller, plants, asked.reference_filter)


def load_asked(
    paths: Sequence[Path], file: DesignFile
) -> tuple[list[DesignSource], DesignFile, Specification]:
    """The plants of a design, its file completed by a run's own configuration, and the one specification.

    Parameters
    ----------
    paths : sequence of Path
        Files or run directories; all runs have to scale their columns alike.
    file : DesignFile

    Raises
    ------
    InputError
        One line.
    """
    sources = load_sources(paths, file)
    asked = file.completed(sources[0].config)
    named = ", ".join(map(str, paths))
    specification = (file if len(paths) > 1 else asked).specification
    if specification is None:
        raise InputError(f"{named}: no specification for all: give --spec FILE")
    # What no controller of these plants' rate can have is a mistake in the file, not a result.
    stated_in = named if file.specification is None else file.name
    with naming(f"{stated_in}: specification"):
        plants = [source.plant for source in sources]
        specification.refuse_other_rate(plants)
        specification.refuse_sampling(plants[0].dt_s)
    logged = [source.logged for source in sources if source.logged is not None]
    if len({(columns.error, columns.command) for columns in logged}) > 1:
        raise InputError(f"{named}: the runs scale their columns differently: no controller fits all")
    return sources, asked, specification


def of_run(paths: Sequence[Path]) -> RunResults | None:
    """The run whose directory is the only plant, if it has come to a design."""
    if len(paths) != 1 or not paths[0].is_dir():
        return None
    run = RunDirectory.open(paths[0])
    return RunResults(run) if run.stage_file("design") else None


def at_one_bandwidth(specification: Specification, run: RunResults | None) -> Specification:
    """The specification without limits to which requirements give way.

    Each stands as far as it gave way in the run that is passed, else as it is tried first: to search for that
    takes a dozen designs.
    """
    known = specification.model_dump(include=set(Specification.model_fields), exclude_unset=True)
    for key, limit in GIVES_WAY.items():
        if known.pop(limit, None) is not None and run is not None:
            known[key] = getattr(run.design.specification or specification, key)
    return Specification.model_validate(known)


def design_controller(
    paths: Sequence[Path],
    file: DesignFile | None = None,
    *,
    out: Path | None = None,
    page: Path | None = None,
    seed: int = 2006,
    dialect: Dialect | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Design and certify one controller for one or several plants.

    Parameters
    ----------
    paths : sequence of Path
        Plants, see `workflow.tasks.design_source`.
    file : DesignFile, optional
        None takes the specification of a run directory.
    out : Path, optional
        Of the controller, by its ending as JSON, MAT file or C source, and beside it of a reference filter; a
        directory: all of them.
    page : Path, optional
        Of the design, for the plant of one run; default: report.html beside the files in a directory.
    seed : int
    dialect : Dialect, optional
        Of the C code.
    progress : Progress, optional

    Returns
    -------
    RunSummary
        A specification that no controller can meet is a result: not certified, the reason in `verdict`.

    Raises
    ------
    InputError
        One line.
    """
    name = str(paths[0]) if file is None else file.name
    file = file or DesignFile()
    written = [] if out is None else targets(out)
    if out is not None and not out.is_dir() and out.suffix.lower() not in SUFFIXES:
        raise InputError(f"--out {out}: the ending must be one of {', '.join(SUFFIXES)}, or a directory")
    outputs = [("--out", output) for path in written for output in (path, filter_file(path))]
    storage.refuse_in_the_way(paths, outputs)
    progress = progress or Progress()
    if page is not None:
        storage.refuse_in_the_way(paths, [("--report", page)])
    progress.plan([("plants", 5.0), ("design", 30.0)])
    with progress.stage("plants"):
        sources_found, asked, specification = load_asked(paths, file)

    # A page is of the design for one run; refused before anything is designed.
    if page is not None:
        refuse_page(asked, list(paths), sources_found[0].config)
    elif out is not None and out.is_dir() and len(paths) == 1 and "level" not in file.plant.model_fields_set:
        page = None if sources_found[0].config is None else out / "report.html"
    plants = [source.plant for source in sources_found]
    logged = [source.logged for source in sources_found if source.logged is not None]
    check_filter(asked.reference_filter, plants[0].dt_s, name)

    # Design, certificate, bound and filter.
    with progress.stage("design") as update:
        design, certify, achievable, prefilter = _design(plants, specification, asked, seed, update)
    controller = design.controller
    gamma = design.gamma
    order = (design.specification or specification).controller_order

    # Files: the controller for the columns of the logs, where a run knows them.
    files: list[Path] = []
    law = controller
    if controller is not None and logged:
        law = logged[0].law(controller)
    numbers = None if law is None else engineers_numbers(law)
    if out is not None and law is not None:
        known = "; ".join(dict.fromkeys(source.certified_for for source in sources_found))
        files = write_controller(
            out, law, prefilter.filter, certified=certify.certified, about=known, dialect=dialect
        )
    if page is not None and sources_found[0].config is not None:
        with progress.stage("report"):
            write_design_page(
                paths[0],
                sources_found[0].config,
                asked,
                specification,
                (design, certify, achievable, prefilter),
                page,
                progress,
            )
    advice = None
    if gamma is not None and gamma > 1:
        advice = order_advice(achievable.bracket, gamma, order, specification.structure) or None
    given_way = gave_way(specification, design.specification)
    reason = design_verdict(design, certify.certificate, advice, specification, given_way)
    shares = joint_numbers(certify.sampled)
    signals = logged[0].signals if logged else ""
    scaled = signals if "as logged" in signals else ""
    names = [plant.name for plant in plants]
    about = [
        {
            "file": str(source.path),
            "plant": source.plant.name,
            "origin": source.origin,
            "remarks": source.remarks,
        }
        for source in sources_found
    ]
    title = f"controller for {names[0]}" if len(names) == 1 else f"controller for {len(names)} plants"
    file_rows = [worded("signals", scaled if files else "")]
    file_rows += [worded("", str(path)) for path in files]
    sections = [
        plants_section(sources_found),
        design_section(design, achievable, order, advice=advice or ""),
        controller_section(numbers, specification.computational_delay_samples, scaled),
        certificate_section(certify, shares),
        not_checked_section(certify),
        filter_section(prefilter),
        Section("written", said(*file_rows)),
    ]
    design_numbers = {
        **codec.plain(design),
        "order_advice": advice,
        "gave_way": codec.plain(given_way),
    }
    return RunSummary(
        title=title,
        sections=sections,
        numbers={
            "plants": about,
            "design": design_numbers,
            "engineers_numbers": None if numbers is None else numbers.to_dict(),
            "achievable_performance": bracket_numbers(achievable, gamma),
            "certificate": codec.plain(certify.certificate),
            "certified": certify.certified,
            "reason": reason,
            "sampled_responses": shares,
            "reference_filter": codec.plain(prefilter.filter),
            "file": str(files[0]) if files else None,
            "files": [str(path) for path in files],
        },
        certified=certify.certified,
        verdict=reason,
        report_path=None if page is None else str(page),
    )
