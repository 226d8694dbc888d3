"""What the search spends its time on, as independent tasks: one start each, a function of its fields alone.

They are done here or in processes of their own; the answers come in the order of the tasks. Processes are
spawned, not forked: BLAS and IPOPT keep threads and locks that do not survive a fork. Each has one BLAS
thread, leaves interrupts from the keyboard to its parent and ends when the parent does.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any

import control
import numpy as np
from threadpoolctl import threadpool_limits

from control_design.controllers.biquads import Cascade
from control_design.plants.ellipses import Real
from control_design.plants.guards import Guard
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.angle_program import AngleProgram
from control_design.synthesis.descent import MinimaxDescent
from control_design.synthesis.interrupts import interrupts_wait, leave_to_parent
from control_design.synthesis.problem import Problem
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import LARGEST_GAMMA, StartReport

_STEPS = 100  # of the descent


@dataclass(frozen=True, eq=False)
class StartTask:
    """One start: controller parameters, the lean grids of all plants, and how it is improved.

    eased: first the interior point without W4 of the measured output, which crosses steep tracking weights
    better than the descent; the descent goes on from there, or from the start itself where that is unstable.
    """

    cascade: Cascade
    parameters: Real
    grids: tuple[Real, ...]
    eased: bool = False


@dataclass(frozen=True, eq=False)
class Candidate:
    """Where a start ended: parameters, worst case on the lean grid it came from and on the dense grid (inf:
    unstable), what was run."""

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

    def do(self, task: StartTask) -> Candidate:
        """Improve one start."""
        descent = self.descent(task.cascade, task.grids)
        start, reports = task.parameters, []
        if task.eased:
            gamma = self.problem.gamma(task.cascade, start, eased=True)
            found, report = self._eased_program(task).solve(start, gamma)
            reports.append(report)
            if np.isfinite(descent.value(found)):
                start = found
        end, gamma, steps = descent.run(start, _STEPS)
        dense = self.problem.gamma(task.cascade, end) if np.isfinite(gamma) else float("inf")
        seen = min(gamma, LARGEST_GAMMA), dense if np.isfinite(dense) else None
        reports.append(StartReport("descent", steps, *seen))
        return Candidate(end, gamma, dense, tuple(reports))

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


_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _parts(system: control.StateSpace) -> tuple[Any, tuple[Any, ...]]:
    """How a state space travels to another process: python-control keeps a local function in its own."""
    matrices = (np.asarray(getattr(system, name)) for name in "ABCD")
    return control.StateSpace, (*matrices, system.dt)


ForkingPickler.register(control.StateSpace, _parts)  # for transport between our processes only


class WorkPool:
    """Does start tasks with `jobs` processes (1: in this one); use as a context manager.

    Raises ValueError if jobs > 1 and the plants cannot be sent to another process (an uncertainty made of
    local functions).
    """

    def __init__(self, workshop: Workshop, jobs: int) -> None:
        self._workshop = workshop
        self._pool: ProcessPoolExecutor | None = None
        if jobs == 1:
            return
        problem = workshop.problem
        parts = problem.plants, problem.spec, problem.options, problem.guards
        try:
            ForkingPickler.dumps(parts)
        except Exception as error:  # what a plant made of local functions raises differs between versions
            raise ValueError(
                f"jobs = {jobs} needs plants that can be sent to another process: {error}; use jobs = 1"
            ) from error
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=parts)
        with interrupts_wait():
            pool.submit(int)  # the first task starts all processes
        self._pool = pool

    def do(self, tasks: Sequence[StartTask]) -> Iterator[Candidate]:
        """Answers in the order of the tasks. Whoever stops asking leaves the rest undone."""
        return map(self._workshop.do, tasks) if self._pool is None else self._pool.map(_do, tasks)

    def __enter__(self) -> WorkPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends the processes: at an error or an interrupt at once, else after the task they are at (which
        takes a second at most)."""
        if self._pool is None:
            return
        if error is not None:
            for process in list(self._pool._processes.values()):
                process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)


_own: Workshop | None = None  # of a worker process


def _begin(
    plants: tuple[UncertainPlant, ...],
    specification: Specification,
    options: SynthesisOptions,
    guards: tuple[Guard, ...],
) -> None:
    """First thing in a worker process."""
    global _own
    leave_to_parent()
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # for what IPOPT has yet to load
    threadpool_limits(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    _own = Workshop(Problem(plants, specification, options, guards))


def _do(task: StartTask) -> Candidate:
    assert _own is not None
    return _own.do(task)
