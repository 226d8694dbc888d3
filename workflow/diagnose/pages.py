"""The pages of a diagnosis, of a rig and of an own plant; beside a model error in per cent of the motion."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from math import copysign
from typing import Any

import numpy as np

from diagnosis.answer import Diagnosis, left_of
from diagnosis.machine.own_plant import PlantCase
from diagnosis.machine.rounding import rounding_effect
from diagnosis.where.findings import Where
from diagnosis.where.where import motion_of, over_levels, where, where_in_records
from plant.effects import EFFECTS
from workflow.describe.summary import RunSummary
from workflow.diagnose.stick_figures import moving_figures
from workflow.diagnose.words import FILTERS
from workflow.report.rendering import render_page


def case_page(found: Diagnosis, progress: Callable[[float, str], None] | None = None, **page: object) -> str:
    """One self-contained HTML page; equal content gives equal bytes.

    page: the loaded case; where the gap is when the nominal parameters are re-estimated within their
    tolerances, and what remains of it; next_experiment, and its advice in words; the controller's check, or
    None and no_check, why; rig_text and effects_text of the files.
    """
    versions = [(name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "numba")]
    versions.append(("python", sys.version.split()[0]))
    page["found"] = found
    return _rendered("diagnosis/case.html.j2", found, progress, page=page, versions=versions)


def plant_page(
    found: Diagnosis,
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
    found : Diagnosis
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
    dt_s = found.case.dt_s
    numbers = {
        "parameters": dict(found.rig.parameters),
        "effects": [change.to_dict() for change in found.repair],
    }
    place, remains = places or (where_in_records(found.case, found.residuals_refit, dt_s), remains_of(found))
    page = {
        "found": found,
        "where": place,
        "remains": remains,
        "advice": advice,
        "can_show": told,
        "model_error": model_error,
        "repaired": repaired,
        "moving": moving_figures(found),
        "numbers": json.dumps(numbers, indent=1),
    }
    return _rendered("diagnosis/plant.html.j2", found, page=page)


def _rendered(
    template: str,
    found: Diagnosis,
    progress: Callable[[float, str], None] | None = None,
    **values: Any,
) -> str:
    return render_page(
        template,
        progress,
        filters=FILTERS.items(),
        title=found.case.name,
        shown=shown(found),
        moved=moved(found, found.deviations),
        moved_refit=moved(found, found.deviations_refit),
        # Effects that close a part of the held-out gap by themselves, with that share, most first.
        partial=tuple(one for one in (found.shares.closes if found.shares else ()) if one[1] > 0)[:5],
        left=left(found),
        effects=EFFECTS,
        **values,
    ).html


def shown(found: Diagnosis) -> Diagnosis:
    """Residuals over a hundredth of each output's motion (RMS about its mean, validation records), and sizes
    in it: of the output with most, beyond sensor noise and rounding.

    The floor is then the stated model error in per cent. As it is where the simulation is exact.
    """
    if not found.case.model_error > 0:
        return found
    level, rounding = 0.01 * motion_of(found.case), rounding_effect(found.case)
    (case, before), (_, refit), (_, after) = (
        over_levels(found.case, residuals, level)
        for residuals in (found.residuals_before, found.residuals_refit, found.residuals_after)
    )
    white = np.sqrt(found.case.noise**2 + (0.0 if rounding is None else rounding.variances)) / level
    page = replace(
        found,
        case=case,
        residuals_before=before,
        residuals_refit=refit,
        residuals_after=after,
        noise_floor=100 * found.case.model_error,
        white=white,
    )
    start, moved_to, end = (
        page.size_of([one[e.name] for e in case.held_out]) for one in (before, refit, after)
    )
    return replace(page, gap_before=start, gap_refit=moved_to, gap_after=end)


def left(found: Diagnosis) -> list[tuple[str, list[tuple[float, float]], float]]:
    """Output, (share of the motion, RMS in its unit) of every model of the page, noise in its unit."""
    models = [left_of(found.case, found.residuals[model]) for model in found.models]
    return [
        (name, [(float(share[k]), float(rms[k])) for share, rms in models], float(found.case.noise[k]))
        for k, name in enumerate(found.case.machine.output_names)
    ]


def remains_of(found: Diagnosis) -> Where:
    """Where the rest lies that the repaired model leaves."""
    if isinstance(found.case, PlantCase):
        return where_in_records(found.case, found.residuals_after, found.case.dt_s)
    return where(found.case, found.residuals_after)


def moved(found: Diagnosis, deviations: Mapping[str, float]) -> Mapping[str, float]:
    """Stated values that were re-estimated -> by how many tolerances, positive where the value grew.

    A deviation multiplies: a value below zero falls where its deviation is above.
    """
    stated = found.case.machine.description
    return {key: d * copysign(1.0, stated.value(key)) for key, d in deviations.items()}
