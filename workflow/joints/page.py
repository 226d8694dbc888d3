"""The page of a run for several joints, and the last stage, which writes it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

from workflow.describe.facts import FirstScreen, PageSection
from workflow.describe.records import records_page, reproduce_page, rig_page
from workflow.describe.run import title_of
from workflow.engine import storage
from workflow.figures.subjects import AnyRunView
from workflow.joints.stages import SEVERAL_JOINTS
from workflow.joints.words import joints_first_screen, joints_pages, joints_unchecked_page
from workflow.report.pages import write_run_page
from workflow.tasks.stage import Stage, StageInput


def page_of_joints(view: AnyRunView) -> tuple[FirstScreen, list[PageSection]]:
    """First screen and sections of the page of a run for several joints."""
    results = view.results
    sections = [
        *joints_pages(view),
        joints_unchecked_page(results.certify, results.closed_loop),
        records_page(view),
        rig_page(view.config.notes),
        reproduce_page(view, is_design=False),
    ]
    return joints_first_screen(view), sections


def write_joints_page(stage: StageInput, also: Iterable[str] = ()) -> str:
    """The last stage of a run: report.html and the hash of its content; also: as of `write_run_page`."""
    # Configuration and results are those of several joints.
    results: Any = stage.results
    run = results.run
    first, parts = page_of_joints(AnyRunView(stage.config, results, run.manifest()))
    progress = partial(stage.progress.update, "report")
    path = write_run_page(run, title_of(stage.config, run), first, parts, progress, also)
    return storage.sha256_of_file(path)


# The last stage of a run for several joints.
JOINTS_REPORT = Stage(
    "report",
    tuple(stage.name for stage in SEVERAL_JOINTS.stages),
    write_joints_page,
    expected_s=5.0,
    # Words that appear on the page and nowhere before.
    uses={"run": True, "notes": True, "joints": True},
    also_writes=lambda run: (run.report_path,),
)
