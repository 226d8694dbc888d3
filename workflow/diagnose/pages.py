"""The pages of a diagnosis, of a rig and of an own plant, from what `workflow.describe` says of them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from importlib import metadata

from markupsafe import Markup

from diagnosis.answer import Diagnosis
from diagnosis.machine.own_plant import PlantCase
from diagnosis.where.findings import Where
from diagnosis.where.where import where, where_in_records
from workflow.describe.diagnosis_page import (
    ProposedExperiment,
    Provenance,
    own_plant_page,
    rig_page,
)
from workflow.describe.diagnosis_view import DiagnosisView
from workflow.describe.facts import Table
from workflow.describe.summary import RunSummary
from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.following import Following
from workflow.diagnose.stick_figures import moving_figures
from workflow.report.rendering import render_described
from workflow.tasks.controller_check import ControllerCheck


def case_page(
    view: DiagnosisView,
    loaded: LoadedCase,
    coming: Following,
    advice: Sequence[str],
    *,
    check: ControllerCheck | None,
    no_check: str,
    rig_text: str,
    effects_text: str,
    progress: Callable[[float, str], None] | None = None,
) -> str:
    """One self-contained HTML page of a rig; equal content gives equal bytes.

    Args:
        view: The diagnosis, and where the error lies.
        loaded: The case and what its files say beside the numbers.
        coming: What to do next.
        advice: The same in sentences.
        check: Of the controllers of both models; None, and `no_check` says why.
        no_check: As in `rig_page`.
        rig_text: Content of the repaired rig file.
        effects_text: Content of the file of effects; "" without.
        progress: Told of each picture.
    """
    versions = [(name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "numba")]
    versions.append(("python", sys.version.split()[0]))
    proposed = None
    if coming.proposal is not None and coming.proposal.separates:
        names = [answer.name for answer in coming.competing]
        proposed = ProposedExperiment(coming.proposal, coming.differences(), names)
    page = rig_page(
        view,
        advice,
        Provenance(loaded.rig_file, loaded.input_sha256, loaded.descriptions, versions),
        suspected=loaded.suspected,
        proposed=proposed,
        check=check,
        no_check=no_check,
        rig_text=rig_text,
        effects_text=effects_text,
    )
    return render_described(page, progress).html


def plant_page(
    diagnosis: Diagnosis,
    advice: Sequence[str],
    told: RunSummary | None = None,
    model_error: float = 0.0,
    repaired: str = "",
    *,
    places: tuple[Where, Where] | None = None,
) -> str:
    """One self-contained HTML page about a `PlantCase`; equal content gives equal bytes.

    Parameters
    ----------
    diagnosis : Diagnosis
    advice : sequence of str
        On what to do next, in sentences (`advice_words`).
    told : RunSummary, optional
        What its records can tell (`workflow.diagnose.check`).
    model_error : float
        As specified, a share of the motion.
    repaired : str
        File of the repaired model beside the page.
    places : (Where, Where), optional
        Where the error lies and where what remains lies; computed where they are not given.

    Raises
    ------
    ValueError
        The plant does not state its sampling period (`where_in_records`).
    """
    if places is None:
        case = diagnosis.case
        places = where_in_records(case, diagnosis.residuals_refit, case.dt_s), remains_of(diagnosis)
    place, remains = places
    numbers = {
        "parameters": dict(diagnosis.rig.parameters),
        "effects": [change.to_dict() for change in diagnosis.repair],
    }
    page = own_plant_page(
        DiagnosisView(diagnosis, place, remains),
        advice,
        can_show=() if told is None else _can_show(told),
        model_error=model_error,
        repaired_file=repaired,
        moving=moving_figures(diagnosis) or Markup(),
        numbers_text=json.dumps(numbers, indent=1),
    )
    return render_described(page).html


def _can_show(told: RunSummary) -> list[Table]:
    """What records can tell; a next record is advised for the answer, not for all that could be one."""
    tables = []
    for section in told.sections:
        if section.title != "next record":
            rows = tuple((row.name, row.text) for row in section.rows)
            tables.append(Table((section.title, ""), rows))
    return tables


def remains_of(diagnosis: Diagnosis) -> Where:
    """Where the rest lies that the repaired model leaves."""
    if isinstance(diagnosis.case, PlantCase):
        return where_in_records(diagnosis.case, diagnosis.residuals_after, diagnosis.case.dt_s)
    return where(diagnosis.case, diagnosis.residuals_after)
