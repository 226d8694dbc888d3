"""Machines of another simulator with their truth: `flexlink run LOG...`, nothing typed.

    python -m benchmarks.machines_with_truth [--machines DIR] [--only NAME,NAME] [--keep DIR]

DIR holds a folder a machine: run*.csv and truth.json. What is printed of each: the share of the frequencies
that its command excites (above 1e-3 of the largest power density) at which the 95 % ellipse (of several parts
of a set any) holds the true response without friction; friction and modes with their intervals; whether the
certified loop keeps its modulus margin with the true response, at the frequencies that truth.json has.
"""

from __future__ import annotations

import json
import resource
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import scipy.signal

from benchmarks.harness import Print, flexlink, main

# Chi-square of two degrees of freedom, 95 %.
_RADIUS_2 = -2 * np.log(0.05)


def answered(folder: Path, work: Path) -> tuple[float, int, str]:
    """Seconds, exit code and last line."""
    logs = [str(path) for path in sorted(folder.glob("run*.csv"))]
    call = ["run", *logs, "--out", str(work / "run"), "--replace", "--json"]
    begun = time.monotonic()
    code, text, lines = flexlink(*call)
    line = str(json.loads(text).get("verdict")) if text.lstrip().startswith("{") else lines[-1]
    return time.monotonic() - begun, code, line


def told(folder: Path, work: Path) -> list[str]:
    """What the run's model and certificate say, beside the truth."""
    from workflow.engine.run_directory import RunDirectory
    from workflow.tasks.results import RunResults

    truth = json.loads((folder / "truth.json").read_text())
    run = RunDirectory(work / "run")
    sentences = list[str]()
    if run.stage_file("uncertainty") is None:
        return ["no ellipses"]
    results = RunResults(run)
    channel = results.identify.channels[0]
    spread = results.uncertainty.channels[0]
    response = truth["friction_free_response"]
    omega = np.array(response["omega_rad_s"])
    g = np.array(response["real"]) + 1j * np.array(response["imag"])
    records = results.records.of_role("estimation")
    power = np.zeros(omega.size)
    for item in records:
        u = item.record.input[:, 0]
        dt = item.record.dt_s
        f, spectrum = scipy.signal.welch(u - u.mean(), 1 / dt, nperseg=min(u.size, round(4 / dt)))
        power = power + np.interp(omega / (2 * np.pi), f, spectrum, right=0.0)
    excited = power > 1e-3 * power.max()
    inside = np.zeros(np.count_nonzero(excited), bool)
    for member in spread.members:
        part = member.posterior.at(omega[excited], spread.level)
        apart = np.stack([(g[excited] - part.centre).real, (g[excited] - part.centre).imag], axis=1)
        distance = np.einsum("fi,fij,fj->f", apart, np.linalg.pinv(part.covariance), apart)
        inside |= distance <= _RADIUS_2
    ellipses = spread.posterior.at(omega[excited], spread.level)
    low, high = omega[excited][[0, -1]] / (2 * np.pi)
    sentences.append(f"ellipses {np.mean(inside):.0%} of {low:.2f} to {high:.1f} Hz")
    width = np.sqrt(np.trace(ellipses.covariance, axis1=1, axis2=2)) / np.abs(g[excited])
    error = np.abs(g[excited] - ellipses.centre) / np.abs(g[excited])
    sentences.append(f"error {np.median(error):.1%}, width {np.median(width):.1%}")
    if results.identify.friction is not None:
        friction = results.identify.friction
        true = sum(truth["coulomb_at_each_inertia_in_command_units"])
        sentences.append(f"friction {friction.level:.4g} ± {friction.level_std:.2g} (Coulomb {true:.4g})")
    is_told = (
        [True] * len(channel.modes) if spread.intervals is None else [m.told for m in spread.intervals.modes]
    )
    modes = [
        f"{mode.frequency_Hz:.2f} ({mode.damping:.3f})"
        for mode, known in zip(channel.modes, is_told, strict=True)
        if known and channel.is_mode(mode)
    ]
    true_modes = [
        f"{f:.2f} ({z:.3f})" for f, z in zip(truth["modes_hz"], truth["mode_dampings"], strict=True)
    ]
    sentences.append(f"modes {', '.join(modes) or 'none'} Hz (true {', '.join(true_modes)})")
    law = results.design.controller
    verdict = results.certify.certificate
    if law is not None and verdict is not None:
        z = np.exp(1j * omega * law.dt_s)
        k = np.array(
            [(law.C @ np.linalg.solve(x * np.eye(law.order) - law.A, law.B) + law.D).item() for x in z]
        )
        nearest = np.min(np.abs(1 + k * g))
        stated = min(plant.worst_margins.modulus for plant in verdict.plants)
        sentences.append(f"modulus margin {nearest:.3f}, stated {stated:.3f}")
        if nearest < 0.99 * stated:
            sentences.append("VIOLATED")
    return sentences


def run(
    out: Print, *, machines: str = "../shared/machines", only: str = "", keep: str = "", jobs: int = 2
) -> None:
    """A line a machine."""
    folders = [path.parent for path in sorted(Path(machines).glob("*/truth.json"))]
    folders = [path for path in folders if not only or path.name in only.split(",")]
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(jobs) as pool:

        def one(folder: Path) -> tuple[tuple[float, int, str], list[str]]:
            work = Path(keep or scratch).absolute() / folder.name
            work.mkdir(parents=True, exist_ok=True)
            return answered(folder.absolute(), work), told(folder, work)

        for folder, ((seconds, code, line), sentences) in zip(folders, pool.map(one, folders), strict=True):
            out(f"{folder.name}: exit {code}, {seconds:.0f} s, {'; '.join(sentences)}; {line}")
    out(f"CPU {resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime:.0f} s")


if __name__ == "__main__":
    main(run, seeds="none")
