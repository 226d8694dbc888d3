"""A quantised sensor in the answer: certain when its values lie on a grid, whatever else is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from plant.effects.sensor import Quantisation


@dataclass(frozen=True)
class Rounding:
    """effect: with the step of the grid; intervals: of its step; variances: (Y,) of rounding alone, in the
    outputs' units; floor: pooled RMS that rounding and noise leave over the noise; energy: mean square of
    rounding alone, over all outputs and the noise's."""

    effect: Quantisation
    intervals: dict[str, tuple[float, float]]
    variances: Real
    floor: float
    energy: float

    @property
    def name(self) -> str:
        return Quantisation.id


def rounding_effect(case: CaseOfMachine) -> Rounding | None:
    """The quantisation of a flexible link's tip sensor, if its records lie on a quantisation grid.

    Rounding errors are taken as uniform over a step: step / sqrt(12).
    """
    if not isinstance(case, Case) or "tip_m" not in case.outputs:
        return None
    tip = case.outputs.index("tip_m")
    step = float(case.steps[tip])
    if not step > 0:
        return None
    # Values are written with six digits at least: of the outermost one, the step inherits that share.
    widest = max(float(np.max(np.abs(e.output[:, tip]))) for e in case.experiments)
    error = 1e-6 * step + 1e-6 * widest / max(widest / step, 1.0)
    variances = np.zeros(case.noise.size)
    variances[tip] = step**2 / 12
    energy = np.mean(variances / case.noise**2)
    return Rounding(
        effect=Quantisation(step_m=step),
        intervals={"step_m": (step - error, step + error)},
        variances=variances,
        floor=float(np.sqrt(1 + energy)),
        energy=float(energy),
    )


def leads_over(
    case: CaseOfMachine, rounding: Rounding, refit: Mapping[str, Real], after: Mapping[str, Real]
) -> bool:
    """Whether rounding makes more of the gap than what the accepted effects take away."""
    before = np.mean([np.mean(refit[e.name] ** 2) for e in case.estimation])
    return bool(rounding.energy >= before - np.mean([np.mean(after[e.name] ** 2) for e in case.estimation]))
