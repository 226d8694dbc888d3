"""The last stage of a run: one self-contained page."""

from __future__ import annotations

from collections.abc import Iterable

from workflow.engine import storage
from workflow.tasks.results import ReportResult
from workflow.tasks.stage import Stage, StageInput
from workflow.tasks.stages import STAGES


def write_page(stage: StageInput, also: Iterable[str] = ()) -> ReportResult:
    """report.html and the hash of its content; also: kinds of file for its pictures beside SVG."""
    # Imported here: matplotlib takes a second to load, and only this stage draws.
    from workflow.report.run_report import write_report

    path = write_report(
        stage.results,
        stage.config,
        lambda fraction, name: stage.progress.update("report", fraction, name),
        also,
    )
    return ReportResult(storage.sha256_of_file(path))


REPORT = Stage(
    "report",
    tuple(stage.name for stage in STAGES),
    write_page,
    expected_s=7.0,
    # Words that appear on the page and nowhere before.
    uses={"run": True, "notes": True, "specification": True},
    also_writes=lambda run: (run.report_path,),
)
