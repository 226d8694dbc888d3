"""Cases on processes of this machine: one fresh process per case, one BLAS thread each.

A process that dies takes its own case with it and nothing else. Processes of their own also make the digits
independent of the number of jobs: every case meets freshly loaded kernels.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess

from workflow.diagnose.case_files import LoadedCase
from workflow.diagnose.outputs import Engine, Options, files_of
from workflow.engine.errors import InputError, StageError, one_line

_ONE_THREAD: Mapping[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


@dataclass(frozen=True, eq=False)
class Work:
    """One case to do."""

    loaded: LoadedCase
    options: Options
    code_sha256: str
    engine: Engine


@dataclass(frozen=True, eq=False)
class Finished:
    """Files by name, or why there are none; bad_input: the failure is about what the user gave."""

    files: Mapping[str, bytes]
    cpu_s: float
    failure: str | None = None
    bad_input: bool = False


@dataclass(frozen=True)
class Step:
    """A running case has done this share of its work."""

    fraction: float
    message: str


def run_all(
    work: Sequence[Work], jobs: int, watch: Callable[[int, Step], None]
) -> Iterator[tuple[int, Finished]]:
    """Position and result of every case, as they finish; up to `jobs` at once."""
    waiting = deque(range(len(work)))
    running: dict[Connection, tuple[int, BaseProcess]] = {}
    with _one_thread_each():
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    index = waiting.popleft()
                    connection, process = _start(work[index])
                    running[connection] = (index, process)
                for ready in wait(list(running)):
                    connection = next(known for known in running if known is ready)
                    index, process = running[connection]
                    try:
                        said = connection.recv()
                    except (EOFError, OSError):
                        said = Finished({}, 0.0, "the process computing it died (out of memory?)")
                    if isinstance(said, Step):
                        watch(index, said)
                        continue
                    del running[connection]
                    connection.close()
                    process.join()
                    yield index, said
        finally:
            for connection, (_, process) in running.items():
                process.terminate()
                process.join()
                connection.close()


def _start(work: Work) -> tuple[Connection, BaseProcess]:
    context = _context()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, work), daemon=True)
    process.start()
    theirs.close()
    return ours, process


def _context() -> ForkServerContext | SpawnContext:
    """On Linux processes are forked off one that has loaded the libraries (seconds) and done nothing else."""
    if not sys.platform.startswith("linux"):
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def _work(connection: Connection, work: Work) -> None:
    # Interrupting from the keyboard reaches every process of the terminal; only the parent answers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def report(fraction: float, message: str) -> None:
        try:
            connection.send(Step(fraction, message))
        except OSError:
            os._exit(1)  # nobody waits any more

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        done = perform(work, report)
    try:
        connection.send(done)
    except OSError:
        os._exit(1)


def perform(work: Work, report: Callable[[float, str], None]) -> Finished:
    """The case, here; whatever goes wrong is said in one line. Seconds are those of this process so far."""
    try:
        files = files_of(work.loaded, work.options, work.code_sha256, engine=work.engine, report=report)
    except InputError as error:
        return Finished({}, time.process_time(), str(error), bad_input=True)
    except StageError as error:
        return Finished({}, time.process_time(), str(error))
    except Exception as error:
        reason = f"internal error: {type(error).__name__}: {one_line(error)}"
        return Finished({}, time.process_time(), reason)
    return Finished(files, time.process_time())


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """For what is spawned inside: libraries read the number of threads when they load."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
