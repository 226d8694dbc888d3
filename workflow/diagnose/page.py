"""The page of one case; its sentences and layout stand in `workflow/templates/diagnosis`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata

from diagnosis.diagnosis import Diagnosis
from diagnosis.where.findings import Where
from plant.effects import LOOK_ALIKES
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.controller_check import ControllerCheck
from workflow.diagnose.following import Following
from workflow.diagnose.words import FILTERS
from workflow.report.rendering import render_page


@dataclass(frozen=True, eq=False)
class CasePage:
    """Everything the page is made of.

    where: of the gap that is left when the nominal parameters are re-estimated within their tolerances;
    remains: of what the effects leave. check is None where there was nothing to compare, no_check says why.
    """

    loaded: LoadedCase
    found: Diagnosis
    where: Where
    remains: Where
    next_experiment: Following
    check: ControllerCheck | None
    no_check: str
    rig_text: str
    effects_text: str


def case_page(page: CasePage, progress: Callable[[float, str], None] | None = None) -> str:
    """One self-contained HTML page; equal content gives equal bytes."""
    versions = [(name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "numba")]
    return render_page(
        "diagnosis/case.html.j2",
        progress,
        filters=FILTERS.items(),
        title=page.loaded.case.name,
        page=page,
        look_alikes=LOOK_ALIKES,
        versions=[*versions, ("python", sys.version.split()[0])],
    ).html
