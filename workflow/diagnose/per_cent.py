"""A diagnosis beside a model error as its page shows it: residuals in per cent of the motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import copysign

from diagnosis.answer import Diagnosis, held_out_gap
from diagnosis.where.where import motion_of, over_levels


def shown(found: Diagnosis) -> Diagnosis:
    """Residuals and gaps over a hundredth of each output's motion (RMS about its mean, held-out records).

    The floor is then the stated model error in per cent. As it is where the simulation is exact.
    """
    if not found.case.model_error > 0:
        return found
    level = 0.01 * motion_of(found.case)
    (case, before), (_, refit), (_, after) = (
        over_levels(found.case, residuals, level)
        for residuals in (found.residuals_before, found.residuals_refit, found.residuals_after)
    )
    return replace(
        found,
        case=case,
        residuals_before=before,
        residuals_refit=refit,
        residuals_after=after,
        gap_before=held_out_gap(case, before),
        gap_refit=held_out_gap(case, refit),
        gap_after=held_out_gap(case, after),
        noise_floor=100 * found.case.model_error,
    )


def moved(found: Diagnosis, deviations: Mapping[str, float]) -> Mapping[str, float]:
    """Stated values that were re-estimated -> by how many tolerances, positive where the value grew.

    A deviation multiplies: a value below zero falls where its deviation is above.
    """
    stated = found.case.machine.description
    return {key: d * copysign(1.0, stated.value(key)) for key, d in deviations.items()}


def partial_answers(found: Diagnosis, most: int = 5) -> tuple[tuple[tuple[str, ...], float], ...]:
    """Effects that close a part of the held-out gap by themselves, with that share, most first."""
    closes = () if found.shares is None else found.shares.closes
    return tuple(one for one in closes if one[1] > 0)[:most]
