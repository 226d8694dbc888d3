"""Why simulation and machine disagree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from threadpoolctl import threadpool_limits

from diagnosis import answer, diagnosis as chain
from diagnosis.machine.case import Case, Experiment
from flexlink.shown import Shown, dressed

__all__ = ["Case", "Diagnosis", "Experiment", "diagnose"]


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Shown, answer.Diagnosis):
    """Result of `diagnose`; fields as in `diagnosis.Diagnosis`."""

    table_in_notebook = True


def diagnose(case: Any, **more: Any) -> Diagnosis:
    """Find the effect that explains the model error of a rig or of your own simulation.

    case: a `Case`, or a `diagnosis.PlantCase` (docs/own_plant.md). more: `time_limit_s` and the other
    arguments of `diagnosis.diagnose`.

    Takes about ten seconds for records of a few thousand samples.

    Examples
    --------
    >>> rig, rubbing = flexlink.paper_link(), flexlink.effect("coulomb_friction", torque_Nm=0.05)
    >>> def measured(name, role, amplitude_V):
    ...     voltage = flexlink.prbs(8, 4, amplitude_V, 600)
    ...     run = flexlink.simulate(rig, voltage, [rubbing], rng=default_rng(int(amplitude_V)))
    ...     return flexlink.Experiment(name, role, run.voltage_V, run.output)
    >>> case = flexlink.Case("arm", rig, (measured("a", "estimation", 6.0), measured("b", "held_out", 4.0)))
    >>> found = flexlink.diagnose(case)
    >>> found.verdict, found.effects[0].name
    ('effect', 'coulomb_friction')
    """
    with threadpool_limits(1):
        return dressed(Diagnosis, chain.diagnose(case, **more))
