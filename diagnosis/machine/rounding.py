"""A quantised sensor in the answer: certain when its values lie on a grid, whatever else is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from plant.effects.sensor import Quantisation

# Share of a value that a file may round off: values are written with six digits at least.
_DIGITS = 1e-6


@dataclass(frozen=True)
class Rounding:
    """The quantisation of a sensor, read off its values.

    Parameters
    ----------
    effect : Quantisation
        With the step of the grid.
    intervals : dict
        Parameter -> (low, high), of its step [m].
    variances : (Y,)
        Of rounding alone, in the outputs' units squared; zero of all others.
    floor : float
        RMS over all outputs, over the noise, that rounding and noise leave together.
    energy : float
        Mean square over all outputs, over the noise, of rounding alone.
    """

    effect: Quantisation
    intervals: dict[str, tuple[float, float]]
    variances: Real
    floor: float
    energy: float

    @property
    def name(self) -> str:
        """Name of the effect in answers."""
        return Quantisation.id


def rounding_effect(case: CaseOfMachine) -> Rounding | None:
    """The quantisation of a flexible link's tip sensor, if its records lie on a quantisation grid.

    None for any other machine. Rounding errors are taken as uniform over a step, with a variance of
    step^2 / 12 each.
    """
    if not isinstance(case, Case) or "tip_m" not in case.outputs:
        return None
    tip = case.outputs.index("tip_m")
    step = float(case.steps[tip])
    if not step > 0:
        return None
    # The step is read off the outermost value, the most steps away from zero: of what the file rounds off
    # there the step has one part in as many.
    outermost = max(float(np.max(np.abs(e.output[:, tip]))) for e in case.experiments)
    steps_away = max(outermost / step, 1.0)
    error = _DIGITS * step + _DIGITS * outermost / steps_away
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
    """Whether rounding makes more of the gap than what the accepted effects take away.

    Parameters
    ----------
    case : CaseOfMachine
    rounding : Rounding
    refit, after : mapping
        Name of an experiment -> residuals (T, Y) over the noise: of the model without effects, and with them.
    """
    before = np.mean([np.mean(refit[e.name] ** 2) for e in case.estimation])
    left = np.mean([np.mean(after[e.name] ** 2) for e in case.estimation])
    return bool(rounding.energy >= before - left)
