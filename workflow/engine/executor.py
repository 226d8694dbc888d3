"""Tasks of a command: in its own process, in processes of this machine, or on the workers of a Dask cluster
(extra `distributed`), for every command alike.

On this machine every task has a fresh process: one that dies takes nothing else with it, and digits do not
depend on how many there are. A single task that runs no code of a user's needs none: a process of its own
would load all that the command has loaded again, which takes longer than some tasks.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import Any, Protocol, TypeVar

from threadpoolctl import threadpool_limits

from workflow.engine import interrupts
from workflow.engine.errors import InputError, StageError, one_line
from workflow.engine.threads import one_thread_each

R_co = TypeVar("R_co", covariant=True)
R = TypeVar("R")
Report = Callable[[float, str], None]
Watch = Callable[[int, float, str], None]

# How often a task is begun whose process dies: the second and third time alone, when the others are done.
MOST_ATTEMPTS = 3
# Seconds in which a scheduler has to answer: one in the same network does so in milliseconds.
CONNECT_S = 10.0
# Seconds without any worker after which a cluster is given up: work that cannot go on says so in a minute.
WITHOUT_WORKERS_S = 50.0
# Seconds without an answer after which a scheduler is lost: within that minute, less the last `CONNECT_S` and
# `_ASK_S`.
SILENT_S = 40.0
# Seconds between looks at whether the pool lives: short beside any task.
_LOOK_S = 0.05
# Seconds between questions to a scheduler: often beside `SILENT_S`, seldom beside what it can answer.
_ASK_S = 2.0

# CasADi and numba's caches are used by one thread at a time, whatever a worker was started with; processes
# are begun with variables of the environment that are put back.
_ONE_AT_A_TIME = threading.Lock()


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


def _done(task: Task[R], report: Report) -> R | Failure:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return attempt(lambda: task.run(report))


class Executor:
    """Tasks on a pool of `concurrent.futures`, about `width` at once; `close` gives it up."""

    def __init__(self, pool: futures.Executor, width: int) -> None:
        self.pool = pool
        self.width = width

    def run(self, tasks: Sequence[Task[R]], watch: Watch | None = None) -> Iterator[tuple[int, R | Failure]]:
        """Position and result of every task, in the order in which they finish.

        Parameters
        ----------
        tasks : sequence of Task
        watch : callable, optional
            Called with position, share done and a word, where a task tells of its progress.

        Yields
        ------
        tuple of int and result or Failure
            What goes wrong inside a task is its result.

        Raises
        ------
        StageError
            The pool is lost.
        """
        events: queue.SimpleQueue[tuple[int, Any, str]] = queue.SimpleQueue()
        attempts = [0] * len(tasks)
        running: set[int] = set()

        def begin(index: int) -> None:
            attempts[index] += 1
            running.add(index)
            self._submit(
                tasks[index], lambda share, word: events.put((index, share, word))
            ).add_done_callback(lambda done: events.put((index, done, "")))

        for index in range(len(tasks)):
            begin(index)
        again: deque[int] = deque()
        while running or again:
            # A task whose process died runs alone, so that there is as much memory for it as can be.
            if not running:
                begin(again.popleft())
            try:
                index, what, word = events.get(timeout=_LOOK_S)
            except queue.Empty:
                self._see_that_it_lives()
                continue
            if not isinstance(what, futures.Future):
                if watch is not None:
                    watch(index, what, word)
                continue
            running.remove(index)
            try:
                result = what.result()
            except futures.BrokenExecutor:
                if attempts[index] < MOST_ATTEMPTS:
                    again.append(index)
                    continue
                result = Failure(f"the process computing it died {attempts[index]} times (out of memory?)")
            except (futures.CancelledError, Exception) as error:
                result = self._failure(error)
            yield index, result

    def _submit(self, task: Task[Any], report: Report) -> futures.Future[Any]:
        """Given to the pool; what has no way to tell of its progress does not."""
        with warnings.catch_warnings():
            # A large plant travels with its task: nothing is lost with a worker.
            warnings.simplefilter("ignore")
            return self.pool.submit(run_on_worker, task)

    def _see_that_it_lives(self) -> None:
        """Asked while nothing comes. Raises StageError."""

    def _failure(self, error: BaseException) -> Failure:
        """The failure of a task that did not run to its end; here the error goes on."""
        raise error

    def close(self) -> None:
        self.pool.shutdown(cancel_futures=True)


class ThisProcess(Executor):
    """Tasks one after another in the process of the command, one thread each.

    For our own computation only: what a user's simulation does to the process, or to what is printed, it
    would do to the command. An interrupt ends the task and is raised.
    """

    def __init__(self) -> None:
        # A pool that takes nothing.
        super().__init__(futures.Executor(), 1)

    def run(self, tasks: Sequence[Task[R]], watch: Watch | None = None) -> Iterator[tuple[int, R | Failure]]:
        """Position and result of every task, in their order. Raises KeyboardInterrupt."""
        for index, task in enumerate(tasks):

            def report(share: float, word: str, index: int = index) -> None:
                if watch is not None:
                    watch(index, share, word)

            with threadpool_limits(1):
                result = _done(task, report)
            # A compiled library may have made a result out of an interrupt.
            interrupts.check()
            yield index, result


def workers(
    jobs: int, scheduler: str | None = None, preload: Sequence[str] = ()
) -> AbstractContextManager[Executor]:
    """Up to `jobs` processes of this machine, or a scheduler's workers. Raises InputError: none there."""
    return closing(LocalProcesses(jobs, preload) if scheduler is None else DaskCluster(scheduler))


class LocalProcesses(Executor):
    """Up to `jobs` processes of this machine, one thread each. `close` ends them.

    A process that dies (out of memory, a crash in compiled code) leaves its task to a new one, which has the
    machine for itself; after three times it is the task's failure. preload: modules that are loaded once for
    all processes, where the system can fork.
    """

    def __init__(self, jobs: int, preload: Sequence[str] = ()) -> None:
        if jobs < 1:
            raise ValueError(f"jobs must be at least 1, got {jobs}")
        # A thread waits for each process.
        super().__init__(futures.ThreadPoolExecutor(jobs), jobs)
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
        self._processes: set[BaseProcess] | None = set()

    def _submit(self, task: Task[Any], report: Report) -> futures.Future[Any]:
        return self.pool.submit(self._compute, task, report)

    def _compute(self, task: Task[Any], report: Report) -> Any:
        """In a process of its own. Raises BrokenExecutor where that dies."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, task), daemon=True)
        with ours:
            with _ONE_AT_A_TIME, theirs, one_thread_each():
                if self._processes is None:
                    raise futures.BrokenExecutor
                _begin(process)
                self._processes.add(process)
            try:
                while True:
                    share, content = ours.recv()
                    # Without a share it is the result.
                    if share is None:
                        return content
                    report(share, content)
            except (EOFError, OSError) as error:
                raise futures.BrokenExecutor from error
            finally:
                process.join()
                with _ONE_AT_A_TIME:
                    if self._processes is not None:
                        self._processes.remove(process)

    def close(self) -> None:
        """End whatever is still running."""
        with _ONE_AT_A_TIME:
            ended = self._processes or set()
            self._processes = None
        for process in ended:
            process.terminate()
        super().close()


def _begin(process: BaseProcess) -> None:
    """Start it, where the process that all are forked off dies meanwhile off a new one. Raises StageError."""
    for _ in range(MOST_ATTEMPTS):
        try:
            if sys.platform.startswith("linux"):
                # It loads for seconds and would tell of an interrupt from the keyboard with a traceback.
                with _interrupts_wait():
                    forkserver.ensure_running()
            return process.start()
        except (EOFError, ConnectionError):
            # Until the dead one is known to be dead.
            time.sleep(0.5)
    raise StageError("no process can be begun: the one they are forked off dies each time (out of memory?)")


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Interrupts come through only at the end; processes begun inside do not see them."""
    # It would start by itself later, and let interrupts through.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(connection: Connection, task: Task[Any]) -> None:
    """What runs in a process of its own: the task, its progress and its result through the connection."""
    # Interrupting from the keyboard reaches every process of the terminal; only the parent answers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, args=(connection,), daemon=True).start()

    def send(share: float | None, said: object) -> None:
        """A share done with a word, or None with the result."""
        try:
            connection.send((share, said))
        except OSError:
            os._exit(1)  # nobody waits any more

    send(None, _done(task, send))


def _leave_with_parent(connection: Connection) -> None:
    """Nothing is ever sent this way: reading ends when the other end is gone, closed or killed."""
    with suppress(EOFError, OSError):
        connection.recv_bytes()
    os._exit(1)


def run_on_worker(task: Task[R]) -> R | Failure:
    """One task at a time in each worker, one thread each."""
    with _ONE_AT_A_TIME, threadpool_limits(1):
        return _done(task, lambda fraction, message: None)


async def _call(distributed: Any, address: str) -> None:
    """Connect and hang up. Raises whatever an address is refused with."""
    line = await distributed.comm.connect(address, timeout=CONNECT_S)
    await line.close()


class DaskCluster(Executor):
    """The workers behind a scheduler's address. `close` hangs up.

    A worker that dies, or is not heard of any more while others are, is the scheduler's business: its task
    goes to another one. A scheduler that dies or does not answer, or has no worker that it hears of, ends the
    work with one line.

    Raises InputError when the extra is not installed, nobody answers, or there are no workers.
    """

    def __init__(self, address: str) -> None:
        try:
            dask: Any = import_module("dask")
            distributed: Any = import_module("distributed")
        except ImportError as error:
            need = f"--scheduler needs the package distributed: {sys.executable} -m pip install distributed"
            raise InputError(need) from error
        self._distributed = distributed
        self.address = address
        self._last_seen: dict[str, Any] = {}
        # Its own reports of lost connections would bury our one line.
        self._loggers = [
            logger
            for name, logger in list(logging.root.manager.loggerDict.items())
            if isinstance(logger, logging.Logger) and name.startswith(("distributed", "tornado"))
        ]
        self._levels = [logger.level for logger in self._loggers]
        for logger in self._loggers:
            logger.setLevel(logging.CRITICAL + 1)
        self._settings = dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECT_S:.0f}s"})
        try:
            # First without a client: one that fails to connect is closed when it is collected, at any time
            # and in any thread, and waits forever for the lock of a client that is being made just then.
            with futures.ThreadPoolExecutor(1) as aside:
                aside.submit(asyncio.run, _call(distributed, address)).result()
            with warnings.catch_warnings():
                # Differing versions of packages: the code digest is checked.
                warnings.simplefilter("ignore")
                self._client: Any = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        except Exception as error:  # a wrong address ends in whatever its parts are read with
            self._restore()
            raise InputError(f"--scheduler {address}: no Dask scheduler answers there") from error
        try:
            self._client.wait_for_workers(1, timeout=WITHOUT_WORKERS_S)
        except (TimeoutError, OSError) as error:
            self.close()
            raise InputError(
                f"--scheduler {address}: no worker within {WITHOUT_WORKERS_S:.0f} s; start one with "
                f"`dask worker {address}`"
            ) from error
        self._ask()
        super().__init__(self._client.get_executor(pure=False), max(1, len(self._last_seen)))

    def close(self) -> None:
        """Leave the cluster and its workers as they are."""
        with suppress(OSError, TimeoutError, RuntimeError):  # gone already
            self._client.close(timeout=2)
        self._restore()

    def run(self, tasks: Sequence[Task[R]], watch: Watch | None = None) -> Iterator[tuple[int, R | Failure]]:
        """Position and result of every task, see `Executor.run`.

        Raises StageError when the scheduler is lost or silent, or has no workers.
        """
        self._asked_s = self._heard_s = self._staffed_s = time.monotonic()
        for result in super().run(tasks, watch):
            yield result
            # What finishes tells of both.
            self._heard_s = self._staffed_s = time.monotonic()

    def _see_that_it_lives(self) -> None:
        if time.monotonic() - self._asked_s < _ASK_S:
            return
        self._ask()
        self._asked_s = time.monotonic()
        missing = ""
        if self._asked_s - self._heard_s > SILENT_S:
            missing = f"the Dask scheduler at {self.address} has not answered for {SILENT_S:.0f} s"
        elif self._heard_s - self._staffed_s > WITHOUT_WORKERS_S:
            seconds = f"{WITHOUT_WORKERS_S:.0f} s"
            missing = f"the Dask cluster at {self.address} had no worker that answers for {seconds}"
        if missing:
            raise StageError(f"{missing}; --resume continues it")

    def _failure(self, error: BaseException) -> Failure:
        if isinstance(error, self._distributed.KilledWorker):
            return Failure("every worker computing it died (out of memory?)")
        if isinstance(error, (futures.CancelledError, TimeoutError, OSError)):
            raise StageError(
                f"the Dask scheduler at {self.address} was lost; --resume continues it"
            ) from None
        # What goes wrong in a task is its result: this is a worker that cannot even load it.
        return Failure(f"the worker cannot run flexlink ({type(error).__name__}: {one_line(error)})")

    def _ask(self) -> None:
        """Note when the scheduler was heard of last, and when it had heard of a worker. A process that is
        stopped, or cut off, keeps its connections: only what it says tells that it is there."""
        # KeyError: while a connection is broken.
        with suppress(OSError, TimeoutError, RuntimeError, KeyError):
            identity = self._client.sync(self._client.scheduler.identity, callback_timeout=CONNECT_S)
            seen = {name: about["last_seen"] for name, about in identity["workers"].items()}
            self._heard_s = time.monotonic()
            if any(self._last_seen.get(name) != at for name, at in seen.items()):
                self._staffed_s = self._heard_s
            self._last_seen = seen

    def _restore(self) -> None:
        self._settings.__exit__(None, None, None)
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)
