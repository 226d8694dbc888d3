"""Tasks on processes of this machine: spawned, one BLAS thread each, replaced when they die."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Self

from workflow.study.task import Done, Task, failed, run_task

_Running = Future[tuple[Done, ...]]

MOST_ATTEMPTS = 3
_ONE_THREAD: Mapping[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class LocalProcesses:
    """Up to `jobs` spawned processes. Use as a context manager.

    A process that dies (out of memory, a crash in compiled code) takes its task with it: the task is given to
    a new process, from the second time on alone, and after three times it is that task's failure.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise ValueError(f"jobs must be at least 1, got {jobs}")
        self._jobs = jobs
        self._context = multiprocessing.get_context("spawn")
        self._pool: ProcessPoolExecutor | None = None
        self._leash: Connection | None = None
        self._environment: dict[str, str | None] = {}

    def __enter__(self) -> Self:
        self._environment = {name: os.environ.get(name) for name in _ONE_THREAD}
        os.environ.update(_ONE_THREAD)  # inherited by what is spawned; libraries read it when they load
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close(at_once=kind is not None)
        for name, value in self._environment.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

    @property
    def width(self) -> int:
        """How many tasks run at once."""
        return self._jobs

    def run(self, tasks: Sequence[Task]) -> Iterator[tuple[int, tuple[Done, ...]]]:
        """Position and result of every task, as they finish."""
        attempts = [0] * len(tasks)
        waiting = deque(range(len(tasks)))
        running: dict[_Running, int] = {}
        while waiting or running:
            while waiting and len(running) < self._room(attempts, waiting, running):
                index = waiting.popleft()
                attempts[index] += 1
                running[self._submit(tasks[index])] = index
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            lost = []
            for future in finished:
                index = running.pop(future)
                try:
                    done = future.result()
                except BrokenProcessPool:
                    lost.append(index)
                else:
                    yield index, done
            if lost:
                # Whatever else was in that pool is lost as well.
                lost += running.values()
                running.clear()
                self._close(at_once=True)
                for index in sorted(lost):
                    if attempts[index] < MOST_ATTEMPTS:
                        waiting.append(index)
                    else:
                        reason = f"the process computing it died {attempts[index]} times (out of memory?)"
                        yield index, failed(tasks[index], reason)

    def _room(self, attempts: Sequence[int], waiting: deque[int], running: Mapping[_Running, int]) -> int:
        """One at a time while a suspect is about, so that nobody else is blamed for its deaths."""
        suspects = any(attempts[index] > 1 for index in running.values())
        return 1 if suspects or (waiting and attempts[waiting[0]] > 0) else self._jobs

    def _submit(self, task: Task) -> _Running:
        if self._pool is None:
            self._open()
        assert self._pool is not None
        try:
            return self._pool.submit(run_task, task)
        except BrokenProcessPool:  # an idle process died
            self._close(at_once=True)
            self._open()
            return self._pool.submit(run_task, task)

    def _open(self) -> None:
        held, self._leash = self._context.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(
            self._jobs, mp_context=self._context, initializer=_begin_worker, initargs=(held,)
        )

    def _close(self, *, at_once: bool) -> None:
        pool, leash = self._pool, self._leash
        self._pool, self._leash = None, None
        if at_once and leash is not None:
            leash.close()
        if pool is not None:
            if at_once:
                _stop_feeding(pool)
            pool.shutdown(wait=True, cancel_futures=True)
        if leash is not None:
            leash.close()


def _stop_feeding(pool: ProcessPoolExecutor) -> None:
    """Before Python 3.11.5 a pool whose process died while a task was on its way to it waits forever.

    CPython issue 94777: what is still being written needs to find that nobody reads it. Later versions close
    the same end in a thread of their own, and two that close it at once fail.
    """
    queue = getattr(pool, "_call_queue", None)
    if queue is not None and sys.version_info < (3, 11, 5):
        queue._reader.close()


def _begin_worker(leash: Connection) -> None:
    """Leave as soon as the other end of the leash is gone, whether closed or because its process was killed.

    Interrupting from the keyboard reaches every process of the terminal; only the parent answers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        try:
            leash.recv_bytes()
        except (EOFError, OSError):
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
