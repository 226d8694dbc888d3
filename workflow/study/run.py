"""A whole study as one library call."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.study.settings import load_study

if TYPE_CHECKING:
    from workflow.tasks.summary import RunSummary


def run_study(
    config_path: Path,
    out: Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunSummary:
    """Compute every point of a study into `out`, then table and page; the table's numbers in the summary.

    `resume` takes up the study that is there, `replace` deletes it first (when all that was given is right).

    jobs: processes of this machine (default: one per processor). scheduler: address of a Dask scheduler whose
    workers compute the points; what the points share is still computed here. A point that cannot be certified
    is a result.

    Raises InputError (one line) for anything wrong with what the user gave, StageError when points failed
    (table and page are written all the same, and a resumed study tries them again) or the scheduler was lost.
    """
    if jobs is not None and scheduler is not None:
        raise InputError("--jobs and --scheduler contradict each other: the cluster's workers set the number")
    given = load_study(config_path)
    # Here: what computes takes seconds to load, and a study that is refused does not need it.
    from workflow.study.work import compute_study

    return compute_study(
        given,
        config_path,
        out,
        jobs=jobs,
        scheduler=scheduler,
        resume=resume,
        replace=replace,
        progress=progress or Progress(),
    )
