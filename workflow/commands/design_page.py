"""The page of a design for the plant of a run: that of a run, without a simulated loop."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from control_design.specification import Specification
from workflow.config.design_file import DesignFile
from workflow.config.run_config import RunConfig
from workflow.describe.run import title_of
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.pipeline import stage_input_hash
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    ClosedLoopResult,
    DesignResult,
    ReferenceFilterResult,
    RunResults,
)
from workflow.tasks.stage import PLANT
from workflow.tasks.stages import STAGES

# Sections of a run's configuration that a design file states in their place.
_OF_DESIGN_FILE = ("synthesis", "certificate", "achievable_performance", "reference_filter")


def refuse_page(asked: DesignFile, paths: list[Path], config: RunConfig | None) -> None:
    """Refuse a page that would not show what was designed for, before anything is designed.

    Parameters
    ----------
    asked : DesignFile
    paths : list of Path
        Of the plants.
    config : RunConfig or None
        Of the run; None: the plant is not a run's.

    Raises
    ------
    InputError
        There are several plants, or no run with records and a model to show, or another level than the run's.
    """
    if len(paths) != 1 or config is None:
        raise InputError("--report: a page shows one run's records and model: give one run directory")
    if "level" in asked.plant.model_fields_set:
        raise InputError(
            "--report: the page shows ellipses of the run's level: leave level out of [plant] of "
            f"{asked.name}"
        )


def write_design_page(
    source: Path,
    config: RunConfig,
    asked: DesignFile,
    specification: Specification,
    designed: tuple[DesignResult, CertifyResult, AchievablePerformance, ReferenceFilterResult],
    page: Path,
    progress: Progress,
) -> None:
    """Write the page of a design, from the run's stages up to the plant and the results of the design.

    Parameters
    ----------
    source : Path
        The run's directory; it stays as it is.
    config : RunConfig
        Of the run.
    asked : DesignFile
        Completed by the run's configuration.
    specification : Specification
        As it was asked.
    designed : tuple
        Results of the design.
    page : Path
        Written whole or not at all.
    progress : Progress

    Raises
    ------
    InputError
        A stage of the run is missing or damaged, or the page cannot be written.
    """
    # Loads what draws: a second.
    from workflow.report.pages import write_report

    design, certify, achievable, prefilter = designed
    changed: dict[str, Any] = {name: getattr(asked, name) for name in _OF_DESIGN_FILE}
    earlier = RunDirectory.open(source)
    headline = f"{page.name}: a design for the run {title_of(config, earlier)}"
    about = config.run.model_copy(update={"title": headline})
    shown = config.model_copy(update={**changed, "specification": specification, "run": about})
    not_run = ClosedLoopResult(skipped="flexlink design does not simulate it; flexlink run --from does")
    results = {
        "design": design,
        "achievable_performance": achievable,
        "certify": certify,
        "reference_filter": prefilter,
        "closed_loop": not_run,
    }
    inputs = earlier.manifest()["inputs"]
    with tempfile.TemporaryDirectory(prefix="flexlink-") as folder:
        run = RunDirectory(Path(folder))
        run.begin_run(
            config_text=shown.to_toml(), config=shown.to_document(), seed=shown.run.seed, inputs=inputs
        )
        for name, content in earlier.stage_files(PLANT).items():
            place = Path(name)
            run.write_stage(place.stem, place.suffix, content)
        for stage in STAGES:
            if stage.name in results:
                run.save_stage(stage.name, results[stage.name], stage_input_hash(stage, shown, run, inputs))
        write_report(RunResults(run), shown, partial(progress.update, "report"), is_design=True)
        storage.write_bytes(page, run.report_path.read_bytes())
