"""The tuning study on a Dask cluster: loopback, real processes, killed in the middle."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.workflow.command import ROOT, start_flexlink, wait_until
from tests.workflow.study_examples import TWO_POINTS, assert_same_study, write_study
from workflow.engine.errors import StageError
from workflow.engine.executor import SILENT_S, DaskCluster
from workflow.study.settings import load_study
from workflow.study.work import run_study


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Cluster:
    """A scheduler and workers as processes of their own; all are gone after `stop`."""

    def __init__(self, folder: Path) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._folder = folder
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", self.address.rpartition(":")[2], "--no-dashboard"
        )
        self.workers: list[subprocess.Popen[bytes]] = []
        wait_until(self._listens, self.scheduler)

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", int(self.address.rpartition(":")[2]))) == 0

    def add_worker(self, code: Path = ROOT) -> None:
        options = ("--no-nanny", "--nthreads", "1", "--no-dashboard")
        self.workers.append(self._start("worker", self.address, *options, code=code))

    def _start(self, *arguments: str, code: Path = ROOT) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            cwd=self._folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(code)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    folder = tmp_path / "cluster"
    folder.mkdir()
    started = Cluster(folder)
    yield started
    started.stop()


def far_study(folder: Path, address: str) -> tuple[Path, tuple[object, ...]]:
    """A study as a file, and the arguments that run it on the scheduler at this address."""
    study = write_study(folder)
    return study, ("study", "--config", study, "--out", folder / "out", "--scheduler", address)


def finished_points(out: Path) -> int:
    # Not through the links that have the points' numbers.
    folders = [point for point in out.glob("points/*") if not point.is_symlink()]
    return sum(1 for point in folders for _ in point.glob("stages/closed_loop.*"))


@pytest.mark.long
def test_lost_scheduler_is_one_line_and_the_study_goes_on_elsewhere(cluster, small_study, tmp_path):
    cluster.add_worker()
    study, call = far_study(tmp_path, cluster.address)
    process = start_flexlink(*call)
    wait_until(lambda: finished_points(tmp_path / "out") >= 1, process)
    cluster.scheduler.kill()
    out, complaint = process.communicate(timeout=60)
    assert process.returncode == 1
    assert out == b""
    lines = [line for line in complaint.decode().splitlines() if not re.match(r"flexlink: \d+ s: ", line)]
    assert lines == [f"flexlink: the Dask scheduler at {cluster.address} was lost; --resume continues it"]
    done = finished_points(tmp_path / "out")
    assert 1 <= done < 6
    run_study(load_study(study), tmp_path / "out", resume=True, jobs=2)
    assert finished_points(tmp_path / "out") == 6
    assert_same_study(small_study[0], tmp_path / "out")


@dataclass(frozen=True)
class Sleep:
    """A task that takes so long."""

    seconds: float

    def run(self, report):
        time.sleep(self.seconds)
        return self.seconds


@pytest.mark.long
@pytest.mark.parametrize(
    ("who", "words"),
    [("scheduler", "has not answered for 4 s"), ("worker", "no worker that answers for 4 s")],
)
def test_a_network_that_stalls(cluster, monkeypatch, who, words):
    """A process that is stopped keeps its connections and says nothing, as behind a dead switch. It is told
    within a minute: the time of silence, and what it takes to notice; here with a shorter one."""
    assert SILENT_S + 20 <= 60
    cluster.add_worker()
    with closing(DaskCluster(cluster.address)) as far:
        found = far.run([Sleep(0.0), Sleep(300.0)])
        assert next(found) == (0, 0.0)
        # Not before: a worker says nothing while it imports what its first task needs.
        for name, seconds in {"SILENT_S": 4, "WITHOUT_WORKERS_S": 4, "CONNECT_S": 1, "_ASK_S": 0.2}.items():
            monkeypatch.setattr(f"workflow.engine.executor.{name}", seconds)
        stalled = cluster.scheduler if who == "scheduler" else cluster.workers[0]
        stalled.send_signal(signal.SIGSTOP)
        began_s = time.monotonic()
        with pytest.raises(StageError, match=f"{words}; --resume continues it"):
            next(found)
    assert time.monotonic() - began_s < 4 + 20


@pytest.mark.long
def test_another_version_on_the_worker(cluster, tmp_path, flexlink):
    other = tmp_path / "other"
    for room in ("plant", "ident", "control_design", "workflow", "flexlink"):
        shutil.copytree(ROOT / room, other / room)
    with open(other / "workflow/study/task.py", "a") as file:
        file.write("# edited\n")
    cluster.add_worker(other)
    study = write_study(tmp_path, TWO_POINTS)
    call = ("study", "--config", study, "--out", tmp_path / "out", "--scheduler", cluster.address)
    answer = flexlink(*call)
    assert answer.code == 1
    assert "2 of 2 points failed" in answer.err
    assert "the code of the worker is not that of the study" in answer.err
    assert flexlink(*call[:5], "--resume").code == 0
    assert flexlink(*call[:4], tmp_path / "near").code == 0
    assert_same_study(tmp_path / "near", tmp_path / "out")


def test_scheduler_without_workers(cluster, refused, tmp_path, monkeypatch):
    monkeypatch.setattr("workflow.engine.executor.WITHOUT_WORKERS_S", 0.5)
    line = refused(*far_study(tmp_path, cluster.address)[1])
    assert "no worker within" in line
    assert f"dask worker {cluster.address}" in line
    assert not (tmp_path / "out").exists()


def test_nobody_at_the_address(refused, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    # A client left half made is closed whenever it is collected: that could hang the next one.
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("a client was made"))
    monkeypatch.setattr("workflow.engine.executor.CONNECT_S", 1.0)
    address = f"tcp://127.0.0.1:{free_port()}"
    line = refused(*far_study(tmp_path, address)[1])
    assert line == f"flexlink: --scheduler {address}: no Dask scheduler answers there\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["", "nonsense://127.0.0.1:1", "127.0.0.1:nine"])
def test_an_address_that_is_none(refused, tmp_path, address, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    monkeypatch.setattr("workflow.engine.executor.CONNECT_S", 1.0)
    line = refused(*far_study(tmp_path, address)[1])
    assert "--scheduler" in line
    assert not (tmp_path / "out").exists()


def test_without_the_extra(refused, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    line = refused(*far_study(tmp_path, "tcp://h:1")[1])
    assert "-m pip install distributed" in line
    assert not (tmp_path / "out").exists()
