"""What the search spends its time on: tasks of one start each, functions of their fields alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.controllers.biquads import Cascade
from control_design.plants.ellipses import Real
from control_design.synthesis.descent import MinimaxDescent
from control_design.synthesis.problem import Problem
from control_design.synthesis.synthesis_result import LARGEST_GAMMA, StartReport

STEPS = 100  # of the descent


@dataclass(frozen=True, eq=False)
class StartTask:
    """One start: controller parameters, the lean grids of all plants, and how it is improved.

    steps: of the descent. checked: on the dense grid, too.
    """

    cascade: Cascade
    parameters: Real
    grids: tuple[Real, ...]
    steps: int = STEPS
    checked: bool = True


@dataclass(frozen=True, eq=False)
class TriedController:
    """Where a start ended: parameters, worst case on the lean grid it came from and on the dense grid (inf:
    unstable, or not checked), what was run."""

    parameters: Real
    gamma_grid: float
    gamma: float
    reports: tuple[StartReport, ...] = ()


class Workshop:
    """A problem with the tools for its tasks; the last cascade's and grids' are kept between tasks."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._for: tuple[Cascade, tuple[Real, ...]] | None = None
        self._descent: MinimaxDescent | None = None

    def descent(self, cascade: Cascade, grids: tuple[Real, ...]) -> MinimaxDescent:
        """Descent for a cascade on given grids."""
        self._turn_to(cascade, grids)
        if self._descent is None:
            problem = self.problem
            self._descent = MinimaxDescent(
                cascade,
                problem.rows(grids),
                lambda x: problem.stable(cascade, x),
                controller_damping=problem.spec.controller_damping,
            )
        return self._descent

    def do(self, task: StartTask) -> TriedController:
        """Improve one start."""
        end, gamma, steps = self.descent(task.cascade, task.grids).run(task.parameters, task.steps)
        checked = task.checked and np.isfinite(gamma)
        dense = self.problem.gamma(task.cascade, end) if checked else float("inf")
        seen = min(gamma, LARGEST_GAMMA), dense if np.isfinite(dense) else None
        return TriedController(end, gamma, dense, (StartReport("descent", steps, *seen),))

    def _turn_to(self, cascade: Cascade, grids: tuple[Real, ...]) -> None:
        known = self._for
        if known is not None and known[0] == cascade and all(map(np.array_equal, known[1], grids)):
            return
        self._for, self._descent = (cascade, grids), None
