"""Tasks on the workers of a Dask cluster that is already there (extra `distributed`)."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
import uuid
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib import import_module
from typing import Any

from threadpoolctl import threadpool_limits

from workflow.engine.errors import InputError, StageError, one_line
from workflow.engine.executor import Failure, R, Task, Watch, attempt

CONNECT_S = 10.0
# A study that cannot go on says so within a minute.
WITHOUT_WORKERS_S = 50.0
SILENT_S = 40.0
ANSWER_S = 10.0
_LOOK_S = 0.05
_ASK_S = 2.0

# CasADi and numba's caches are used by one thread at a time, whatever a worker was started with.
_ONE_AT_A_TIME = threading.Lock()


def run_on_worker(task: Task[R]) -> R | Failure:
    """One task at a time in each worker, one thread each."""
    with _ONE_AT_A_TIME, threadpool_limits(1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return attempt(lambda: task.run(lambda fraction, message: None))


async def _call(distributed: Any, address: str) -> None:
    """Connect and hang up. Raises whatever an address is refused with."""
    line = await distributed.comm.connect(address, timeout=CONNECT_S)
    await line.close()


class DaskCluster:
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
            raise InputError(
                "--scheduler needs the extra 'distributed': pip install 'flexlink[distributed]'"
            ) from error
        self._distributed = distributed
        self.address = address
        self._last_seen: dict[str, Any] = {}
        self._heard_s = self._staffed_s = 0.0
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
            with ThreadPoolExecutor(1) as aside:
                aside.submit(asyncio.run, _call(distributed, address)).result()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # differing versions of packages: the code digest is checked
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

    def close(self) -> None:
        """Leave the cluster and its workers as they are."""
        with suppress(OSError, TimeoutError, RuntimeError):  # gone already
            self._client.close(timeout=2)
        self._restore()

    @property
    def width(self) -> int:
        """How many tasks run at once, as far as is known."""
        self._ask()
        return max(1, len(self._last_seen))

    def run(self, tasks: Sequence[Task[R]], watch: Watch | None = None) -> Iterator[tuple[int, R | Failure]]:
        """Position and result of every task, as they finish. Raises StageError when the scheduler is lost or
        silent, or has no workers."""
        name = uuid.uuid4().hex  # results of other work on the same cluster are not ours
        with warnings.catch_warnings():
            # A large plant travels with its task: nothing is lost with a worker.
            warnings.simplefilter("ignore")
            futures = {
                self._client.submit(run_on_worker, task, key=f"flexlink-{name}-{index}", pure=False): index
                for index, task in enumerate(tasks)
            }
        asked_s = self._heard_s = self._staffed_s = time.monotonic()
        while futures:
            # A client that loses its scheduler cancels them all.
            finished = [future for future in futures if future.done()]
            if not finished:
                time.sleep(_LOOK_S)
            if time.monotonic() - asked_s > _ASK_S:
                self._ask()
                asked_s = time.monotonic()
                missing = ""
                if asked_s - self._heard_s > SILENT_S:
                    missing = f"the Dask scheduler at {self.address} has not answered for {SILENT_S:.0f} s"
                elif self._heard_s - self._staffed_s > WITHOUT_WORKERS_S:
                    seconds = f"{WITHOUT_WORKERS_S:.0f} s"
                    missing = f"the Dask cluster at {self.address} had no worker that answers for {seconds}"
                if missing:
                    raise StageError(f"{missing}; --resume continues the study")
            for future in finished:
                yield futures.pop(future), self._result(future)

    def _result(self, future: Any) -> Any:
        try:
            return future.result(timeout=CONNECT_S)
        except self._distributed.KilledWorker:
            return Failure("every worker computing it died (out of memory?)")
        except (self._distributed.client.FutureCancelledError, TimeoutError, OSError):
            raise StageError(
                f"the Dask scheduler at {self.address} was lost; --resume continues the study"
            ) from None
        except Exception as error:
            # What goes wrong in a task is its result: this is a worker that cannot even load it.
            return Failure(f"the worker cannot run flexlink ({type(error).__name__}: {one_line(error)})")

    def _ask(self) -> None:
        """Note when the scheduler was heard of last, and when it had heard of a worker. A process that is
        stopped, or cut off, keeps its connections: only what it says tells that it is there."""
        # KeyError: while a connection is broken.
        with suppress(OSError, TimeoutError, RuntimeError, KeyError):
            identity = self._client.sync(self._client.scheduler.identity, callback_timeout=ANSWER_S)
            seen = {name: about["last_seen"] for name, about in identity["workers"].items()}
            self._heard_s = time.monotonic()
            if any(self._last_seen.get(name) != at for name, at in seen.items()):
                self._staffed_s = self._heard_s
            self._last_seen = seen

    def _restore(self) -> None:
        self._settings.__exit__(None, None, None)
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)
