"""The tuning study on a Dask cluster: loopback, real processes, killed in the middle."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.workflow.command import ROOT, finish, start_flexlink, wait_until
from tests.workflow.study_examples import assert_same_study, write_study
from workflow.study.run import run_study


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

    def add_worker(self) -> None:
        self.workers.append(
            self._start("worker", self.address, "--no-nanny", "--nthreads", "1", "--no-dashboard")
        )

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            cwd=self._folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
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
    return len(list(out.glob("points/*/stages/closed_loop.*")))


@pytest.mark.slow
def test_worker_killed_midway_changes_no_number(cluster, tmp_path):
    cluster.add_worker()
    cluster.add_worker()
    study, call = far_study(tmp_path, cluster.address)
    process = start_flexlink(*call)
    wait_until(lambda: finished_points(tmp_path / "out") >= 1, process)
    os.kill(cluster.workers[0].pid, signal.SIGKILL)
    finish(process)
    assert cluster.workers[1].poll() is None
    run_study(study, tmp_path / "near", jobs=2)
    assert_same_study(tmp_path / "near", tmp_path / "out")


@pytest.mark.slow
def test_lost_scheduler_is_one_line_and_the_study_goes_on_elsewhere(cluster, tmp_path):
    cluster.add_worker()
    study, call = far_study(tmp_path, cluster.address)
    process = start_flexlink(*call)
    wait_until(lambda: finished_points(tmp_path / "out") >= 1, process)
    cluster.scheduler.kill()
    out, complaint = process.communicate(timeout=60)
    assert process.returncode == 1
    assert out == b""
    lines = [line for line in complaint.decode().splitlines() if not re.match(r"flexlink: \d+ s: ", line)]
    assert lines == [
        f"flexlink: the Dask scheduler at {cluster.address} was lost; --resume continues the study"
    ]
    done = finished_points(tmp_path / "out")
    assert 1 <= done < 6
    run_study(study, tmp_path / "out", resume=True, jobs=2)
    assert finished_points(tmp_path / "out") == 6


def test_scheduler_without_workers(cluster, refused, tmp_path, monkeypatch):
    monkeypatch.setattr("workflow.engine.cluster.WITHOUT_WORKERS_S", 0.5)
    line = refused(*far_study(tmp_path, cluster.address)[1])
    assert "no worker within" in line
    assert f"dask worker {cluster.address}" in line
    assert not (tmp_path / "out").exists()


def test_nobody_at_the_address(refused, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    # A client left half made is closed whenever it is collected: that could hang the next one.
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("a client was made"))
    monkeypatch.setattr("workflow.engine.cluster.CONNECT_S", 1.0)
    address = f"tcp://127.0.0.1:{free_port()}"
    line = refused(*far_study(tmp_path, address)[1])
    assert line == f"flexlink: --scheduler {address}: no Dask scheduler answers there\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["", "nonsense://127.0.0.1:1", "127.0.0.1:nine"])
def test_an_address_that_is_none(refused, tmp_path, address, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    monkeypatch.setattr("workflow.engine.cluster.CONNECT_S", 1.0)
    line = refused(*far_study(tmp_path, address)[1])
    assert "--scheduler" in line
    assert not (tmp_path / "out").exists()


def test_without_the_extra(refused, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    line = refused(*far_study(tmp_path, "tcp://h:1")[1])
    assert "needs the extra 'distributed': pip install 'flexlink[distributed]'" in line
    assert not (tmp_path / "out").exists()
