"""Calling the command line from tests, in this process or in one that can be killed."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[2]
FAST_ARM = Path(__file__).parent / "data" / "fast_arm.toml"


@dataclass(frozen=True)
class Answer:
    """What a command left behind."""

    code: int
    out: str
    err: str


def start_flexlink(*arguments: object, stdout: IO[bytes] | int = subprocess.PIPE) -> subprocess.Popen[bytes]:
    """`flexlink` in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "workflow", *(str(argument) for argument in arguments)],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=stdout,
        stderr=subprocess.PIPE,
    )
