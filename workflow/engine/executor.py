"""Tasks somewhere else: in processes of this machine (here), or on a Dask cluster (`engine.cluster`).

Every task has a fresh process, so that one that dies takes nothing else with it, and the digits do not depend
on how many there are: each meets freshly loaded kernels.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from control_design.synthesis.interrupts import interrupts_wait
from workflow.engine.errors import InputError, StageError, one_line
from workflow.engine.threads import one_thread_each

R_co = TypeVar("R_co", covariant=True)
R = TypeVar("R")
Report = Callable[[float, str], None]
Watch = Callable[[int, float, str], None]

MOST_ATTEMPTS = 3


@dataclass(frozen=True)
class Failure:
    """Why there is no result, in one line; bad_input: what the user gave is at fault, not the computation."""

    reason: str
    bad_input: bool = False


def attempt(do: Callable[[], R]) -> R | Failure:
    """The result, or what went wrong, whatever it was."""
    try:
        return do()
    except (InputError, StageError) as error:
        return Failure(str(error), bad_input=isinstance(error, InputError))
    except Exception as error:
        return Failure(f"internal error: {type(error).__name__}: {one_line(error)}")


class Task(Protocol[R_co]):
    """What can be done elsewhere: a value that can be sent there."""

    def run(self, report: Report) -> R_co:
        """The result."""


class Executor(Protocol):
    """Runs tasks somewhere; results come as they finish."""

    @property
    def width(self) -> int:
        """How many tasks run at once."""

    def run(self, tasks: Sequence[Task[R]], watch: Watch | None = None) -> Iterator[tuple[int, R | Failure]]:
        """Position and result of every task. watch: told position, share done and a word, where known."""


class LocalProcesses:
    """Up to `jobs` processes of this machine, one thread each. `close` ends them.

    A process that dies (out of memory, a crash in compiled code) leaves its task to a new one, which from the
    second time on has the machine for itself; after three times it is the task's failure. preload: modules
    that are loaded once for all processes, where the system can fork.
    """

    def __init__(self, jobs: int, preload: Sequence[str] = ()) -> None:
        if jobs < 1:
            raise ValueError(f"jobs must be at least 1, got {jobs}")
        self._jobs = jobs
        self._context: ForkServerContext | SpawnContext
        if sys.platform.startswith("linux"):
            # Forked off a process that has loaded the libraries (seconds) and done nothing else; first
            # flexlink, which sees to it that a plant.py in the current folder is not taken for ours.
            self._context = multiprocessing.get_context("forkserver")
            self._context.set_forkserver_preload(
                ["flexlink", "workflow.engine.forked_off", __name__, *preload]
            )
        else:
            self._context = multiprocessing.get_context("spawn")
        self._running: dict[Connection, tuple[int, BaseProcess]] = {}

    @property
    def width(self) -> int:
        return self._jobs

    def run(self, tasks: Sequence[Task[R]], watch: Watch | None = None) -> Iterator[tuple[int, R | Failure]]:
        """Position and result of every task, as they finish."""
        attempts = [0] * len(tasks)
        waiting = deque(range(len(tasks)))
        try:
            while waiting or self._running:
                while waiting and self._has_room(attempts, waiting[0]):
                    index = waiting.popleft()
                    attempts[index] += 1
                    self._start(index, tasks[index])
                for connection in [one for one in wait(list(self._running)) if isinstance(one, Connection)]:
                    index, process = self._running[connection]
                    share: float | None = None
                    said: Any = None
                    with suppress(EOFError, OSError):
                        share, said = connection.recv()
                    if share is not None:
                        if watch is not None:
                            watch(index, share, said)
                        continue
                    del self._running[connection]
                    connection.close()
                    process.join()
                    if said is not None:
                        yield index, said
                    elif attempts[index] < MOST_ATTEMPTS:
                        waiting.append(index)
                    else:
                        reason = f"the process computing it died {attempts[index]} times (out of memory?)"
                        yield index, Failure(reason)
        finally:
            self.close()

    def _has_room(self, attempts: Sequence[int], index: int) -> bool:
        """A task whose process died runs alone, so that there is as much memory for it as can be."""
        alone = attempts[index] > 0 or any(attempts[other] > 1 for other, _ in self._running.values())
        return not self._running if alone else len(self._running) < self._jobs

    def _start(self, index: int, task: Task[Any]) -> None:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, task), daemon=True)
        with one_thread_each():
            _begin(process)
        theirs.close()
        self._running[ours] = (index, process)

    def close(self) -> None:
        """End whatever is still running."""
        for connection, (_, process) in self._running.items():
            process.terminate()
            process.join()
            connection.close()
        self._running.clear()


def _begin(process: BaseProcess) -> None:
    """Start it, where the process that all are forked off dies meanwhile off a new one. Raises StageError."""
    for _ in range(MOST_ATTEMPTS):
        try:
            if sys.platform.startswith("linux"):
                # It loads for seconds and would tell of an interrupt from the keyboard with a traceback.
                with interrupts_wait():
                    forkserver.ensure_running()
            return process.start()
        except (EOFError, ConnectionError):
            time.sleep(0.5)  # until the dead one is known to be dead
    raise StageError("no process can be begun: the one they are forked off dies each time (out of memory?)")


def _work(connection: Connection, task: Task[Any]) -> None:
    # Interrupting from the keyboard reaches every process of the terminal; only the parent answers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, args=(connection,), daemon=True).start()

    def send(share: float | None, said: object) -> None:
        """A share done with a word, or None with the result."""
        try:
            connection.send((share, said))
        except OSError:
            os._exit(1)  # nobody waits any more

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        send(None, attempt(lambda: task.run(send)))


def _leave_with_parent(connection: Connection) -> None:
    """Nothing is ever sent this way: reading ends when the other end is gone, closed or killed."""
    with suppress(EOFError, OSError):
        connection.recv_bytes()
    os._exit(1)
