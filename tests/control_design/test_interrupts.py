"""An interrupt from the keyboard ends the synthesis, whoever it comes through to first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from control_design.synthesis.interrupts import interrupts_kept

# CasADi asks Python for signals in IPOPT and takes the exception for the end of the solver.
_INTERRUPTED = """
import os, signal, sys, threading
import numpy as np
from control_design import SynthesisOptions, synthesise
from control_design.synthesis.angle_program import AngleProgram
from validation.example_plants import flexible_link, flexible_link_specification

signal.signal(signal.SIGINT, signal.default_int_handler)
plain, delay = AngleProgram.solve, float(sys.argv[1])

def solve(self, parameters, gamma):
    AngleProgram.solve = plain
    threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT)).start()
    return plain(self, parameters, gamma)

AngleProgram.solve = solve
try:
    synthesise(
        [flexible_link("B")],
        flexible_link_specification(1),  # no fit of a controller of any order is near enough
        SynthesisOptions(starts=2, iterations=2000),
        rng=np.random.default_rng(1),
    )
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize("delay_s", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_an_interrupt_in_the_interior_point_ends_the_synthesis(tmp_path, delay_s):
    script = tmp_path / "interrupted.py"
    script.write_text(_INTERRUPTED)
    ended = subprocess.run(
        [sys.executable, str(script), str(delay_s)],
        capture_output=True,
        timeout=120,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2]), "OMP_NUM_THREADS": "1"},
    )
    assert (ended.returncode, ended.stderr) == (130, b"")


def test_a_swallowed_interrupt_is_raised_and_the_handler_restored():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), interrupts_kept(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        with interrupts_kept():
            pass
    finally:
        signal.signal(signal.SIGINT, before)
