"""A diagnosis in the sizes that people are shown, with where its error lies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import copysign

import numpy as np

from diagnosis.answer import Diagnosis, left_of
from diagnosis.machine.case import Case
from diagnosis.machine.rounding import rounding_effect
from diagnosis.where.findings import Where
from diagnosis.where.where import motion_of, over_levels
from workflow.describe.diagnosis_words import times_noise
from workflow.describe.where import Floor
from workflow.text.formats import number

# Sets of effects that are shown as partial answers: a picture holds no more that one can read.
_MOST_PARTIAL = 5


@dataclass(frozen=True)
class OutputError:
    """What the models miss of one output in validation records.

    Attributes:
        output: Its name.
        errors: Share of its motion and RMS in its unit, for every model that is compared.
        noise: Of the sensor, in the output's unit.
    """

    output: str
    errors: tuple[tuple[float, float], ...]
    noise: float


@dataclass(frozen=True, eq=False)
class DiagnosisView:
    """What the sentences of a page are about.

    Attributes:
        found: As computed.
        place: Where the error lies when the nominal parameters are re-estimated within their tolerances.
        remains: Where that lies which the repaired model leaves.
    """

    found: Diagnosis
    place: Where
    remains: Where

    @cached_property
    def shown(self) -> Diagnosis:
        """`found` with the sizes of the page."""
        return shown(self.found)

    @property
    def floor(self) -> Floor:
        return Floor(self.found.case.model_error)

    @property
    def rough(self) -> bool:
        """Whether the simulation may miss a share of the motion: sizes are in per cent of it then."""
        return self.floor.is_threshold

    @property
    def of_rig(self) -> bool:
        """Whether the machine is a flexible link of a rig file, not a simulation of one's own."""
        return isinstance(self.found.case, Case)

    @property
    def is_all(self) -> bool:
        """Whether it is likelier than not that no more than the threshold remains."""
        return self.found.completeness.probability >= 0.5

    @property
    def converged(self) -> bool:
        return self.found.detail_verdict != "not_converged"

    @property
    def moved(self) -> Mapping[str, float]:
        """Nominal values -> by how many tolerances they moved, with the effects in the model."""
        return moved(self.found, self.found.deviations)

    @property
    def moved_refit(self) -> Mapping[str, float]:
        """How far nominal values have to move without any effect, in tolerances."""
        return moved(self.found, self.found.deviations_refit)

    @property
    def partial(self) -> tuple[tuple[tuple[str, ...], float], ...]:
        """Effects that explain a part of the validation error by themselves, with that share, most first."""
        closes = self.found.shares.closes if self.found.shares else ()
        return tuple(closing for closing in closes if closing[1] > 0)[:_MOST_PARTIAL]

    @property
    def left(self) -> tuple[OutputError, ...]:
        """What every model misses of every output."""
        diagnosis = self.found
        of_model = [left_of(diagnosis.case, diagnosis.residuals[model]) for model in diagnosis.models]
        return tuple(
            OutputError(
                name,
                tuple((float(share[k]), float(rms[k])) for share, rms in of_model),
                float(diagnosis.case.noise[k]),
            )
            for k, name in enumerate(diagnosis.case.machine.output_names)
        )

    def bare_size(self, size: float) -> str:
        """A size of the model error without its unit."""
        return number(size, 3) if self.rough else times_noise(size)

    def size(self, size: float) -> str:
        """A size of the model error with its unit: over the noise, or in per cent of the motion."""
        return f"{self.bare_size(size)} {'% of the motion' if self.rough else '× noise'}"


def shown(found: Diagnosis) -> Diagnosis:
    """Residuals over a hundredth of each output's motion (RMS about its mean, validation records), and sizes
    in it: of the output with most, beyond sensor noise and rounding.

    The floor is then the stated model error in per cent. As it is where the simulation is exact.
    """
    if not found.case.model_error > 0:
        return found
    # One unit of the scaled residuals is one per cent of the motion.
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
        page.size_of([residuals_of[e.name] for e in case.held_out]) for residuals_of in (before, refit, after)
    )
    return replace(page, gap_before=start, gap_refit=moved_to, gap_after=end)


def moved(found: Diagnosis, deviations: Mapping[str, float]) -> Mapping[str, float]:
    """Stated values that were re-estimated -> by how many tolerances, positive where the value grew.

    A deviation multiplies: a value below zero falls where its deviation is above.
    """
    stated = found.case.machine.description
    return {key: d * copysign(1.0, stated.value(key)) for key, d in deviations.items()}
