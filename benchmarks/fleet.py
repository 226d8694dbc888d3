"""A fleet on two Dask workers, one killed midway: bytes against local processes, time, memory of the parent.

    python -m benchmarks.fleet --cases 40 --out runs/fleet [--kill]

Machines are carriages on a rail: force in, position out, one candidate (dry friction), which grows with the
number of the machine from a tenth of the force to a third. The model is a Python file, so that a case takes
seconds; what is measured is the fleet, not the diagnosis.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

DT_S = 0.02
MODEL = '''"""A carriage on a rail that a force pushes."""
import numpy as np
from diagnosis import EffectParameter, PlantEffect

PARAMETERS = {"mass_kg": 1.0, "damping_Ns_m": 2.0}
INPUTS, OUTPUTS = ("force_N",), ("position_m",)
EFFECTS = (PlantEffect("dry_friction", (EffectParameter("force_N", 0.005, 1.0),)),)


def simulate(parameters, effects, inputs):
    mass, damping = parameters["mass_kg"], parameters["damping_Ns_m"]
    friction = effects.get("dry_friction", {"force_N": 0.0})["force_N"]
    x, v, found = 0.0, 0.0, []
    for force in inputs[:, 0]:
        found.append([x])
        for _ in range(5):
            v += 0.004 / mass * (force - damping * v - friction * np.tanh(v / 0.01))
            x += 0.004 * v
    return np.array(found)
'''


def write_fleet(folder: Path, count: int, samples: int = 300) -> list[Path]:
    """Case files unit-0000.toml ... with their logs and one model; seeds are the numbers."""
    folder.mkdir(parents=True)
    (folder / "carriage.py").write_text(MODEL)
    space: dict[str, object] = {}
    exec(MODEL, space)
    for k in range(count):
        rng = np.random.default_rng(k)
        size = 0.1 + 0.23 * k / max(count - 1, 1) + 0.01 * rng.standard_normal()
        name = f"unit-{k:04d}"
        for log in ("a", "b"):
            force = rng.uniform(-1, 1, samples // 15).repeat(15)
            run = space["simulate"](space["PARAMETERS"], {"dry_friction": {"force_N": size}}, force[:, None])  # type: ignore[operator]
            measured = run[:, 0] + 1e-4 * rng.standard_normal(force.size)
            rows = np.column_stack([DT_S * np.arange(force.size), force, measured])
            path = folder / f"{name}{log}.csv"
            header = "time_s,force_N,position_m"
            np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
        (folder / f"{name}.toml").write_text(
            f'python = "carriage.py"\nlog = ["{name}a.csv", "{name}b.csv"]\ncase = "{name}"\n'
            'model_error = 0.02\ncandidates = ["dry_friction"]\n'
        )
    return sorted(folder.glob("unit-*.toml"))


def _peak_MB(process: subprocess.Popen[bytes]) -> float:
    """Largest resident memory of the process itself so far."""
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return 0.0
    return int(status.split("VmHWM:")[1].split()[0]) / 1024 if "VmHWM" in status else 0.0


def diagnose(
    cases: list[Path], out: Path, *options: str, kill: subprocess.Popen[bytes] | None = None
) -> None:
    """Prints seconds and peak memory of the parent; `kill` dies when a third of the answers are there."""
    command = [
        sys.executable,
        "-m",
        "flexlink",
        "diagnose",
        *map(str, cases),
        "--out",
        str(out),
        "--quiet",
        *options,
    ]
    started = time.monotonic()
    peak = 0.0
    with open(f"{out}.txt", "wb") as printed:
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT)
        while process.poll() is None:
            peak = max(peak, _peak_MB(process))
            if kill is not None and len(list(out.glob("unit-*.json"))) * 3 >= len(cases):
                kill.send_signal(signal.SIGKILL)
                kill = None
            time.sleep(0.1)
    seconds = time.monotonic() - started
    print(f"{out.name}: exit {process.returncode}, {len(cases)} cases, {seconds:.0f} s, parent {peak:.0f} MB")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--cases", type=int, default=40)
    options.add_argument("--out", type=Path, required=True)
    options.add_argument(
        "--kill", action="store_true", help="on a cluster beside local processes, one killed"
    )
    parsed = options.parse_args()
    cases = write_fleet(parsed.out / "cases", parsed.cases)
    diagnose(cases, parsed.out / "near", "--jobs", "2")
    if not parsed.kill:
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = [*dask, "scheduler", "--host", address, "--no-dashboard"]
    worker = [*dask, "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    begun = [
        subprocess.Popen(call, cwd=parsed.out, env=os.environ, **quiet)
        for call in (scheduler, worker, worker)
    ]  # type: ignore[call-overload]
    try:
        diagnose(cases, parsed.out / "far", "--scheduler", address, kill=begun[-1])
    finally:
        for process in begun:
            process.kill()
    near, far = (
        {
            p.name: p.read_bytes()
            for p in (parsed.out / where).iterdir()
            if p.name not in ("timings.json", "lock")
        }
        for where in ("near", "far")
    )
    differ = sorted(name for name in near.keys() | far.keys() if near.get(name) != far.get(name))
    print(f"{len(near)} files, {len(differ)} differ {differ[:3]}")


if __name__ == "__main__":
    main()
