"""What the search spends its time on: tasks of one start each, functions of their fields alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.controllers.biquads import Cascade
from control_design.plants.ellipses import Real
from control_design.synthesis.angle_program import AngleProgram
from control_design.synthesis.descent import MinimaxDescent
from control_design.synthesis.problem import Problem
from control_design.synthesis.synthesis_result import LARGEST_GAMMA, StartReport

STEPS = 100  # of the descent


@dataclass(frozen=True, eq=False)
class StartTask:
    """One start: controller parameters, the lean grids of all plants, and how it is improved.

    eased: first the interior point without W4 of the measured output, which crosses steep tracking weights
    better than the descent; the descent goes on from there, or from the start itself where that is unstable.
    steps: of the descent. checked: on the dense grid, too.
    """

    cascade: Cascade
    parameters: Real
    grids: tuple[Real, ...]
    eased: bool = False
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
        self._program: AngleProgram | None = None

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
        descent = self.descent(task.cascade, task.grids)
        start, reports = task.parameters, []
        if task.eased:
            gamma = self.problem.gamma(task.cascade, start, eased=True)
            found, report = self._eased_program(task).solve(start, gamma)
            reports.append(report)
            if np.isfinite(descent.value(found)):
                start = found
        end, gamma, steps = descent.run(start, task.steps)
        checked = task.checked and np.isfinite(gamma)
        dense = self.problem.gamma(task.cascade, end) if checked else float("inf")
        seen = min(gamma, LARGEST_GAMMA), dense if np.isfinite(dense) else None
        reports.append(StartReport("descent", steps, *seen))
        return TriedController(end, gamma, dense, tuple(reports))

    def _eased_program(self, task: StartTask) -> AngleProgram:
        if self._program is None:
            self._program = AngleProgram(
                task.cascade,
                self.problem.rows(task.grids),
                controller_damping=self.problem.spec.controller_damping,
                max_iterations=self.problem.options.iterations,
            )
        return self._program

    def _turn_to(self, cascade: Cascade, grids: tuple[Real, ...]) -> None:
        known = self._for
        if known is not None and known[0] == cascade and all(map(np.array_equal, known[1], grids)):
            return
        self._for, self._descent, self._program = (cascade, grids), None, None
