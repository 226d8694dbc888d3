"""The tuning study on a Dask cluster: loopback, real processes, killed in the middle."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.workflow.command import ROOT, start_flexlink
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


def wait_until(condition, process: subprocess.Popen[bytes], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "nothing happened"
        assert process.poll() is None, process.communicate()[1].decode()
        time.sleep(0.005)


def finished_points(out: Path) -> int:
    return len(list(out.glob("points/*/stages/closed_loop.*")))


@pytest.mark.slow
def test_worker_killed_midway_changes_no_number(cluster, tmp_path):
    cluster.add_worker()
    cluster.add_worker()
    study = write_study(tmp_path)
    process = start_flexlink(
        "study", "--config", study, "--out", tmp_path / "far", "--scheduler", cluster.address
    )
    wait_until(lambda: finished_points(tmp_path / "far") >= 1, process)
    os.kill(cluster.workers[0].pid, signal.SIGKILL)
    _, complaint = process.communicate(timeout=120)
    assert process.returncode == 0, complaint.decode()
    assert cluster.workers[1].poll() is None
    run_study(study, tmp_path / "near", jobs=2)
    assert_same_study(tmp_path / "near", tmp_path / "far")


@pytest.mark.slow
def test_lost_scheduler_is_one_line_and_the_study_goes_on_elsewhere(cluster, tmp_path):
    cluster.add_worker()
    study = write_study(tmp_path)
    process = start_flexlink(
        "study", "--config", study, "--out", tmp_path / "out", "--scheduler", cluster.address
    )
    wait_until(lambda: finished_points(tmp_path / "out") >= 1, process)
    cluster.scheduler.kill()
    out, complaint = process.communicate(timeout=60)
    assert process.returncode == 1
    assert out == b""
    assert complaint.decode() == (
        f"flexlink: the Dask scheduler at {cluster.address} was lost; --resume continues the study\n"
    )
    done = finished_points(tmp_path / "out")
    assert 1 <= done < 6
    run_study(study, tmp_path / "out", resume=True, jobs=2)
    assert finished_points(tmp_path / "out") == 6


def test_scheduler_without_workers(cluster, refused, tmp_path, monkeypatch):
    monkeypatch.setattr("workflow.engine.cluster.WITHOUT_WORKERS_S", 0.5)
    line = refused(
        "study", "--config", write_study(tmp_path), "--out", tmp_path / "out", "--scheduler", cluster.address
    )
    assert "no worker within" in line
    assert f"dask worker {cluster.address}" in line
    assert not (tmp_path / "out").exists()


def test_nobody_at_the_address(refused, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    # A client left half made is closed whenever it is collected: that could hang the next one.
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("a client was made"))
    monkeypatch.setattr("workflow.engine.cluster.CONNECT_S", 1.0)
    address = f"tcp://127.0.0.1:{free_port()}"
    line = refused(
        "study", "--config", write_study(tmp_path), "--out", tmp_path / "out", "--scheduler", address
    )
    assert line == f"flexlink: --scheduler {address}: no Dask scheduler answers there\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("address", ["", "nonsense://127.0.0.1:1", "127.0.0.1:nine"])
def test_an_address_that_is_none(refused, tmp_path, address, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'distributed' is not installed")
    monkeypatch.setattr("workflow.engine.cluster.CONNECT_S", 1.0)
    line = refused(
        "study", "--config", write_study(tmp_path), "--out", tmp_path / "out", "--scheduler", address
    )
    assert "--scheduler" in line
    assert not (tmp_path / "out").exists()


def test_without_the_extra(refused, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    line = refused(
        "study", "--config", write_study(tmp_path), "--out", tmp_path / "out", "--scheduler", "tcp://h:1"
    )
    assert "needs the extra 'distributed': pip install 'flexlink[distributed]'" in line
    assert not (tmp_path / "out").exists()
