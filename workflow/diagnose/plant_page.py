"""The page of a diagnosis of one's own plant."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from diagnosis.answer import Diagnosis
from diagnosis.where.findings import Where
from diagnosis.where.where import where_in_records
from plant.effects import EFFECTS
from workflow.diagnose.following import Following, following
from workflow.diagnose.per_cent import moved, partial_answers, shown
from workflow.diagnose.words import FILTERS
from workflow.engine import storage
from workflow.report.rendering import render_page


@dataclass(frozen=True, eq=False)
class PlantPage:
    """What the page is made of; see `workflow.diagnose.outputs.CasePage`."""

    found: Diagnosis
    where: Where
    remains: Where
    next_experiment: Following
    numbers: str


def plant_page(found: Diagnosis) -> str:
    """One self-contained HTML page about a `PlantCase`; equal content gives equal bytes.

    Raises ValueError if the plant does not state its sampling period.
    """
    dt_s = found.case.dt_s
    if not dt_s > 0:
        raise ValueError(f"case {found.case.name}: state the plant's sampling period (dt_s) for a page")
    numbers = {
        "parameters": dict(found.rig.parameters),
        "effects": [change.to_dict() for change in found.repair],
    }
    page = PlantPage(
        found,
        where_in_records(found.case, found.residuals_refit, dt_s),
        where_in_records(found.case, found.residuals_after, dt_s),
        following(found),
        json.dumps(numbers, indent=1),
    )
    return render_page(
        "diagnosis/plant.html.j2",
        filters=FILTERS.items(),
        title=found.case.name,
        page=page,
        shown=shown(found),
        moved=moved(found, found.deviations),
        moved_refit=moved(found, found.deviations_refit),
        partial=partial_answers(found),
        effects=EFFECTS,
    ).html


def write_plant_page(found: Diagnosis, path: Path) -> None:
    """`plant_page` as a file."""
    storage.write_bytes(path, plant_page(found).encode())
