"""Guards a loop in a test suite: its controller stays certified, and no margin falls below margins.toml."""

import json
import math
import subprocess
import sys
from pathlib import Path

CERTIFY = "certify arm.json --controller controller.json --spec specification.toml --baseline margins.toml"


def test_margins_hold():
    command = [sys.executable, "-m", "flexlink", *CERTIFY.split(), "--json", "--quiet"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr  # the last line says what is not met, or worse than before
    worst = json.loads(done.stdout)["numbers"]["certificate"]["plants"][0]["worst_margins"]
    assert worst["modulus"] > 0.6  # and what no baseline may take away
    assert worst["phase_rad"] > math.radians(60)
