"""Starts in processes of their own: the same result, nothing left behind, a clear word where it cannot be."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from control_design import Specification, SynthesisOptions, UncertainPlant, synthesise
from workflow.engine import codec

from .plants import RelativeDisc, hub_arm, uncertain_hub

_SPECIFICATION = Specification(bandwidth_rad_s=2.0, effort_limit=60.0, controller_order=3)

# A shell that runs the tests in the background has told them to ignore interrupts, and children inherit that.
_ENDLESS = """
import signal
import numpy as np
from control_design import SynthesisOptions, synthesise
from validation.example_plants import flexible_link, flexible_link_specification

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    tell = lambda fraction, message: print(message, flush=True)
    synthesise(
        [flexible_link("B")],
        flexible_link_specification(6),
        SynthesisOptions(jobs=2, starts=50, agreeing_starts=50),
        rng=np.random.default_rng(1),
        progress=tell,
    )
"""


@pytest.mark.slow
def test_the_number_of_processes_does_not_change_the_result():
    results = [
        synthesise(
            [uncertain_hub(0.03)],
            _SPECIFICATION,
            SynthesisOptions(starts=2, exchange_rounds=1, jobs=jobs),
            rng=np.random.default_rng(3),
        )
        for jobs in (1, 2)
    ]
    assert codec.plain(results[0]) == codec.plain(results[1])


def test_a_plant_that_cannot_travel_is_refused_by_name_of_the_option():
    class Local(RelativeDisc):
        """Known inside this function only."""

    plant = UncertainPlant("hub", hub_arm(), Local(hub_arm(), 0.03, 60.0))
    with pytest.raises(ValueError, match="jobs = 2 needs plants that can be sent"):
        synthesise([plant], _SPECIFICATION, SynthesisOptions(jobs=2), rng=np.random.default_rng(1))


def _group(leader: int) -> list[int]:
    """Processes of a session, zombies left out."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[3]) == leader and fields[0] != "Z":
                found.append(int(entry.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="lists processes through /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupt_leaves_no_process_behind(tmp_path, how):
    """SIGINT to the whole group, as the keyboard does; SIGKILL to the parent alone."""
    script = tmp_path / "endless.py"
    script.write_text(_ENDLESS)
    root = str(Path(__file__).resolve().parents[2])
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
    )
    try:
        assert process.stdout is not None
        assert "start 1" in process.stdout.readline()
        assert len(_group(process.pid)) >= 3
        if how is signal.SIGINT:
            os.killpg(process.pid, how)
        else:
            process.send_signal(how)
        assert process.wait(30) == -how  # an interrupt that nobody took for the end of a solver
        process.stdout.close()
        deadline = time.monotonic() + 20
        while _group(process.pid) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert _group(process.pid) == []
    finally:
        for left in _group(process.pid):
            os.kill(left, signal.SIGKILL)
