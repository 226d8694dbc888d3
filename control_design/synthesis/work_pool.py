"""Tasks of the search done here or in processes of their own; the answers come in the order of the tasks.

Processes are spawned, not forked: BLAS and IPOPT keep threads and locks that do not survive a fork. Each has
one BLAS thread, leaves interrupts from the keyboard to its parent and ends when the parent does.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any

import control
import numpy as np
from threadpoolctl import threadpool_limits

from control_design.plants.guards import Guard
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.synthesis.interrupts import interrupts_wait, leave_to_parent
from control_design.synthesis.problem import Problem
from control_design.synthesis.search_tasks import Candidate, StartTask, Workshop
from control_design.synthesis.synthesis_options import SynthesisOptions

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
            pool.submit(_ready)  # the first task starts all processes
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


def _ready() -> None:
    """Nothing: a task that starts the processes."""


def _do(task: StartTask) -> Candidate:
    assert _own is not None
    return _own.do(task)
