"""What came out for one machine, against its truth. Nothing of the product computes here; it is only read.

Ran: `flexlink run LOGS --out run --json`, nothing typed.

Settles, 20 runs on the nonlinear machine: from rest at a start between the 5th and 95th percentile of the
recorded output, half a second later a step of 10 to 50 % of that range into it (through the reference filter
of the run, if any), friction of the machine x .8 to 1.2, inertia and weight of the load x .95 to 1.05. The
command begins at what holds the nominal machine at the start. The loop has the machine's delay and, in
every other run, the delay that controller.json states on top (who puts the controller in the place of the
old one has none). Horizon: 40 over the certified bandwidth, 4 to 30 s. A run settles if
- it stays within twice the recorded range of the set point (the weight is wrong by 5 % from the start),
- less than 1 % of the commands of the second half are at the limit,
- in the last quarter |reference - output| and half the peak-to-peak stay within the largest of 5 % of the
  step, three counts of the encoder, and breakaway friction over the stiffness |K| at the certified bandwidth.
A feed-forward of friction is left out: a step gets next to nothing of it.

Violates: the loop with the true friction-free response is unstable, or its modulus margin, gain, phase or
delay margin or bandwidth is more than 1 % worse than the worst case that the certificate states.

Ellipses: share of frequencies of the run's grid, and per half-decade, at which the 95 % ellipse, of several
parts of a set that of any, holds the true friction-free response, where the recorded command has more than
1e-3 of its largest power density. A certificate for several plants states the least of each number.
"""

from __future__ import annotations

import json
import re
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal

from benchmarks.closed_loop_machines.logs import Machine, write
from benchmarks.closed_loop_machines.machines import TAU, loop_gain, loop_radius
from benchmarks.closed_loop_machines.simulator import Array, Law, Plant, response
from benchmarks.harness import flexlink

_LONGEST_S = 900
# Chi-square of two degrees of freedom, 95 %.
_RADIUS_2 = -2 * np.log(0.05)
# A next step names a command, an option or a setting.
_STEP = re.compile(r"flexlink \w+|--[a-z]|[a-z]+_[a-z_]+ = |integrators? = |\[\w+\]")


def judged(one: Machine, folder: Path, judge_only: bool = False) -> dict[str, Any]:
    """Everything the table needs, also written to FOLDER/NAME/judged.json. judge_only: runs are there."""
    work = folder / one.name
    run = work / "run"
    answers_file = work / "told.json"
    if not judge_only:
        logs = write(one, folder / "logs", folder / "truth")
        work.mkdir(parents=True, exist_ok=True)
        begin = _cpu_s()
        words = "--out", str(run), "--replace", "--json"
        code, text, lines = flexlink("run", *map(str, logs), *words, longest_s=_LONGEST_S)
        answer = json.loads(text) if text.lstrip().startswith("{") else {}
        line = answer.get("verdict") or " | ".join(lines[-3:])
        row = {"kind": one.kind, "seed": one.seed, "code": code, "cpu_s": _cpu_s() - begin, "line": line}
        row["certified"] = code == 0 and bool(answer.get("certified"))
        row["next_step"] = (bool(answer) or len(lines) == 1) and bool(_STEP.search(line))
        answers_file.write_text(json.dumps(row, indent=1) + "\n")
    row_found = json.loads(answers_file.read_text())
    truth = json.loads((folder / "truth" / f"{one.name}.json").read_text())
    row_found |= _model(one, truth, run)
    if row_found["certified"]:
        row_found |= controller_on_machine(one, truth, run)
    (work / "judged.json").write_text(json.dumps(row_found, indent=1, default=float) + "\n")
    return row_found


def controller_on_machine(one: Machine, truth: dict[str, Any], run: Path) -> dict[str, Any]:
    """What the certificate of a run says falsely, and how many of 20 runs settle."""
    law, delay = read_law(run / "controller.json")
    plant = replace(one.plant, delay=one.plant.delay + delay)
    certificate = json.loads((run / "stages" / "certify.json").read_text())["result"]["certificate"]
    verdict = worst_of(certificate["plants"])
    plants = one.plant, plant
    good = [settles(one, truth, plants[k % 2], law, run, verdict["bandwidth_rad_s"], k) for k in range(20)]
    false = violations(plant, one.draft.q_operating, law, verdict)
    return {"violations": false, "settled": sum(good), "bad_runs": [k for k in range(20) if not good[k]]}


def worst_of(verdicts: list[dict[str, Any]]) -> dict[str, Any]:
    """What a certificate states of a machine that may be any of its plants: the least of each number."""
    margins = [verdict["worst_margins"] for verdict in verdicts]
    stated = {
        name: min(_number(margin[name]) for margin in margins)
        for name in ("modulus", "gain_up", "phase_rad", "delay_s")
    }
    stated["gain_down"] = max(_number(margin["gain_down"]) for margin in margins)
    bandwidth = min(_number(verdict["bandwidth_rad_s"]) for verdict in verdicts)
    return {"worst_margins": stated, "bandwidth_rad_s": bandwidth}


def _cpu_s() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def read_law(path: Path) -> tuple[Law, int]:
    """u = K (reference - measurement) of controller.json, and the delay that it states."""
    file = json.loads(path.read_text())
    n = len(file["A"])
    a, b, c, m = (np.array(file[k], float) for k in ("A", "B", "C", "anti_windup_gain"))
    d = float(np.array(file["D"]).item())
    column = b.reshape(n, 1)
    law = Law(a.reshape(n, n), np.hstack([column, -column]), c.reshape(n), np.array([d, -d]), m.reshape(n))
    return law, int(file["computational_delay_samples"])


def _number(stored: Any) -> float:
    return float(stored["$float"] if isinstance(stored, dict) else stored)  # infinities are tagged


def violations(plant: Plant, q_operating: float, law: Law, verdict: dict[str, Any]) -> list[str]:
    """Numbers of a certificate's verdict on a plant that the true friction-free loop does not keep."""

    def radius(gain: float) -> float:
        return loop_radius(plant, q_operating, law._replace(C=gain * law.C, D=gain * law.D))

    if not radius(1.0) < 1:
        return [f"unstable: pole radius {radius(1.0):.6f}"]
    worst = {name: _number(value) for name, value in verdict["worst_margins"].items() if name != "$type"}
    theta = np.unique(np.concatenate([np.geomspace(1e-5, np.pi, 20_000), np.linspace(1e-3, np.pi, 20_000)]))
    gain = loop_gain(plant, q_operating, law, theta / plant.dt_s)
    nearest = float(np.min(np.abs(1 + gain)))
    violated = []
    if nearest < 0.99 * worst["modulus"]:
        violated.append(f"modulus {nearest:.4f}, stated {worst['modulus']:.4f}")
    up = min(worst["gain_up"], 1e3)
    down = worst["gain_down"]
    ends = 1 + 0.99 * (up - 1), max(1 - 0.99 * (1 - down), 1e-3)
    gains = np.concatenate([np.geomspace(1, end, 20) for end in ends])
    violated += [f"gain {g:.4f} unstable, stated {down:.4f} to {up:.4f}" for g in gains if radius(g) >= 1][:1]
    # Where the loop crosses the unit circle.
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(gain) - 1)))
    phase = np.abs(np.angle(-gain[crossings]))
    if np.min(phase, initial=np.pi) < 0.99 * min(worst["phase_rad"], np.pi):
        violated.append(f"phase {np.min(phase):.4f} rad, stated {worst['phase_rad']:.4f}")
    delay = np.min(np.mod(np.angle(-gain[crossings]), TAU) / theta[crossings], initial=np.inf) * plant.dt_s
    if delay < 0.99 * worst["delay_s"]:
        violated.append(f"delay {delay:.4g} s, stated {worst['delay_s']:.4g}")
    within = theta < 0.99 * verdict["bandwidth_rad_s"] * plant.dt_s
    if np.any(within) and np.min(np.abs(1 + gain[within])) < 0.99 * np.sqrt(2):
        violated.append(f"bandwidth, stated {verdict['bandwidth_rad_s']:.4g} rad/s")
    return violated


def settles(
    one: Machine, truth: dict[str, Any], plant: Plant, law: Law, run: Path, bandwidth_rad_s: float, k: int
) -> bool:
    """Run k of the docstring's 20."""
    rng = one.rng(1000 + k)
    dt = plant.dt_s
    low, high = truth["output_range"]
    start = rng.uniform(low, high)
    size = rng.uniform(0.1, 0.5) * (high - low)
    step = size if start + size < high else -size
    friction = plant.friction.copy()
    friction[:, [0, 1, 3]] *= rng.uniform(0.8, 1.2)
    load = np.ones(plant.inertia.size)
    load[1:] = rng.uniform(0.95, 1.05)
    varied = replace(plant, friction=friction, inertia=plant.inertia * load, gravity=plant.gravity * load)
    limit = json.loads((run / "controller.json").read_text())["input_limit"]
    varied = replace(varied, limit=min(plant.limit, limit or np.inf))
    n = round(float(np.clip(40 / max(bandwidth_rad_s, 1e-3), 4, 30)) / dt)
    at = round(0.5 / dt)
    moved = np.where(np.arange(n) < at, 0.0, step)
    smoother = run / "controller_reference_filter.json"
    if smoother.exists():
        f = json.loads(smoother.read_text())
        moved = scipy.signal.dlsim((*(np.array(f[x]) for x in "ABCD"), dt), moved[:, None])[1][:, 0]
    held = -np.sum(plant.gravity * np.sin(start / plant.scale)) / plant.torque_per_u
    noise = one.draft.noise_counts * plant.count * rng.standard_normal(n)
    got = varied.run(law._replace(bias=float(held)), start + moved, start / plant.scale, noise)
    at_bandwidth = response(law.A, law.B[:, :1], law.C[None, :], [bandwidth_rad_s], dt)
    stiffness = abs(at_bandwidth[0] + law.D[0])
    holding = friction[:, 1].sum() / plant.torque_per_u / max(stiffness, 1e-12)
    tolerance = max(0.05 * size, 3 * plant.count, float(holding))
    away = np.abs(start + step - got["true"])
    last = got["true"][-n // 4 :]
    return bool(
        np.all(away < 2 * (high - low) + tolerance)
        and np.mean(np.abs(got["u"][n // 2 :]) >= varied.limit) < 0.01
        and np.max(away[-n // 4 :]) <= tolerance
        and np.ptp(last) <= 2 * tolerance
    )


def _model(one: Machine, truth: dict[str, Any], run: Path) -> dict[str, Any]:
    """Mode, friction, unstable pole and ellipses of the stages that are there, against the truth."""
    from workflow.engine.run_directory import RunDirectory
    from workflow.tasks.results import RunResults

    judged: dict[str, Any] = {}
    try:
        results = RunResults(RunDirectory.open(run))
        identify = results.identify
        spread = results.uncertainty.channels[0]
    except (OSError, ValueError, KeyError):  # refused before there was a model
        return judged
    channel = identify.channels[0]
    intervals = spread.intervals
    rows = [mode for mode in channel.modes if channel.is_mode(mode)]
    if rows:
        near = min(rows, key=lambda mode: abs(np.log(mode.frequency_Hz / truth["modes_hz"][0])))
        at = channel.modes.index(near)
        judged["frequency_error"] = near.frequency_Hz / truth["modes_hz"][0] - 1
        judged["damping"] = near.damping
        judged["damping_true"] = truth["dampings"][0]
        if intervals is not None and at < len(intervals.modes):
            (low, high) = intervals.modes[at].frequency_Hz
            (smallest, largest) = intervals.modes[at].damping
            judged["frequency_inside"] = bool(low <= truth["modes_hz"][0] <= high)
            judged["damping_inside"] = bool(smallest <= truth["dampings"][0] <= largest)
    if identify.friction is not None:
        law = identify.friction.law
        level = identify.friction.level
        used = truth["friction_as_recorded_in_input_units"][:-1]
        true = truth["coulomb_in_input_units"] if law.excess > 0 else float(np.mean(used))
        judged["friction_error"] = level / true - 1
        judged["friction_inside"] = bool(abs(level - true) <= 1.96 * identify.friction.level_std)
    if truth["unstable_1_s"]:
        growth = [pole for pole, _ in channel.unstable_poles]
        judged["unstable_error"] = growth[0] / truth["unstable_1_s"][0] - 1 if len(growth) == 1 else None
    omega = spread.frequency.omega_rad_s
    a, b, c = (np.array(truth[k]) for k in "ABC")
    excited = _excited(one, omega)
    true = response(a, b, c, omega, one.plant.dt_s)
    parts = [member.posterior.at(omega, spread.level) for member in spread.members]
    inside = np.any([_holds(ellipses, true) for ellipses in parts], axis=0)
    judged["ellipses"] = float(np.mean(inside[excited])) if np.any(excited) else None
    band = np.floor(2 * np.log10(omega)).astype(int)
    shares = {k: float(np.mean(inside[excited & (band == k)])) for k in np.unique(band[excited])}
    judged["by_half_decade"] = {f"{10 ** (k / 2):.3g} rad/s": share for k, share in shares.items()}
    return judged


def _holds(ellipses: Any, g: Array) -> Array:
    """Whether the 95 % ellipse holds g, (F,)."""
    apart = np.stack([(g - ellipses.centre).real, (g - ellipses.centre).imag], axis=1)
    return np.einsum("fi,fij,fj->f", apart, np.linalg.pinv(ellipses.covariance), apart) <= _RADIUS_2


def _excited(one: Machine, omega: Array) -> Array:
    """Where the recorded command (estimation logs) has more than 1e-3 of its largest power density."""
    power = 0.0
    for log in range(len(one.classes) - 1):
        got, begin = one.record(log, one.rng(log))
        u = np.clip(got["u"][begin:], -one.plant.limit, one.plant.limit)
        f, spectrum = scipy.signal.welch(
            u, 1 / one.plant.dt_s, nperseg=min(u.size, round(4 / one.plant.dt_s))
        )
        power = power + spectrum
    return np.interp(omega, TAU * f, power) > 1e-3 * np.max(power)
