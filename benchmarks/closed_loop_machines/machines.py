"""Ten kinds of machine, five further ones, and the controllers that people give them, drawn from a seed.

Everything is drawn before friction: friction is a share of the command, which the recorded motion decides
(`logs.machine`). Belt drive, seed 0 of series 1, is the log reported by a user.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.closed_loop_machines.simulator import Law, Plant, response

TAU = 2 * np.pi
# Inertia of the motor side in 1e-3 kg m^2 (logarithmic), load over motor inertia, antiresonance Hz, damping
# of the resonance, torque per unit of input, bandwidth over antiresonance, rms motion in rad, share of the
# friction on the motor side, columns that occur (see below).
_NAMES = ("inertia", "ratio", "anti", "zeta", "torque", "bandwidth", "motion", "share", "columns")
_ROWS = {
    "belt": ((0.5, 5), (1, 5), (4, 15), (0.02, 0.06), (0.1, 1), (0.15, 0.35), (0.03, 0.3), 1.0, "ra da rv"),
    "joint": ((100, 500), (0.5, 3), (5, 15), (0.02, 0.08), (4, 20), (0.15, 0.35), (0.02, 0.2), 0.8, "dt ra"),
    "link": ((2, 20), (1, 5), (2, 5), (0.005, 0.02), (0.1, 1), (0.2, 0.4), (0.03, 0.3), 1.0, "ra rv dt"),
    "pendulum": ((1, 30), (3, 10), (8, 20), (0.02, 0.05), (0.1, 1), (2.5, 4), (0.02, 0.1), 1.0, "ra dt rt"),
    "screw": ((0.05, 0.5), (0.3, 2), (25, 60), (0.02, 0.05), (0.1, 1), (0.08, 0.2), (0.5, 4), 0.5, "ma mt"),
    "wheel": ((2, 10), (4, 12), (3, 7), (0.06, 0.15), (0.1, 1), (0.15, 0.35), (0.2, 2), 0.2, "ra rv dt"),
    "play": ((0.5, 5), (1, 4), (6, 20), (0.02, 0.06), (0.1, 1), (0.15, 0.35), (0.03, 0.2), 0.7, "ra da rt"),
    "slow": ((0.5, 5), (1, 4), (15, 30), (0.01, 0.04), (0.1, 1), (0.03, 0.06), (0.05, 0.5), 0.8, "ra rt"),
    "fast": ((0.5, 5), (0.5, 3), (6, 15), (0.02, 0.06), (0.1, 1), (0.5, 0.9), (0.02, 0.1), 0.8, "ra da dt"),
    "saturation": ((0.5, 5), (1, 4), (5, 15), (0.02, 0.06), (0.1, 1), (0.2, 0.4), (0.05, 0.3), 0.8, "ra rv"),
}  # fmt: skip
KINDS = tuple(_ROWS)
# What the ten leave out: a loop at 4 kHz whose logs are too short for its coasting time; the sensor at the
# load and the friction at the motor; the friction at the load; a chirp at the drive's limit; a delay of five
# samples.
_FURTHER_ROWS = {
    "quick": ((0.5, 5), (0.1, 1), (20, 60), (0.02, 0.06), (0.1, 1), (0.15, 0.35), (0.01, 0.1), 1.0, "ra da"),
    "tip": ((0.5, 5), (0.3, 2), (5, 20), (0.02, 0.06), (0.1, 1), (0.06, 0.15), (0.03, 0.3), 1.0, "ra da"),
    "load": ((0.5, 5), (0.5, 3), (8, 30), (0.02, 0.06), (0.1, 1), (0.1, 0.3), (0.03, 0.3), 0.0, "ra ma rt"),
    "clipped": ((0.5, 5), (1, 4), (5, 15), (0.02, 0.06), (0.1, 1), (0.2, 0.4), (0.05, 0.3), 0.8, "ra rv dt"),
    "late": ((0.5, 5), (1, 4), (5, 15), (0.02, 0.06), (0.1, 1), (0.1, 0.25), (0.03, 0.3), 0.8, "ra da rv"),
}
FURTHER_KINDS = tuple(_FURTHER_ROWS)
# A kind's place is part of its seed.
ALL_KINDS = KINDS + FURTHER_KINDS
# Output unit per rad (None: millimetres of a screw), column of time, reference, input by its letter, output.
_OUTPUTS = {
    "r": (1.0, "t_ms", "ref_rad", "enc_rad"),
    "d": (360 / TAU, "time_s", "pos_ref_deg", "pos_deg"),
    "m": (None, "time_s", "x_ref_mm", "x_mm"),
}
_INPUTS = {"a": "i_cmd_A", "t": "torque_cmd_Nm", "v": "u_V"}
_COUNTS = (4096, 8192, 16384, 40_000, 65_536, 262_144, 1_000_000)
_RATES_HZ = (250, 500, 1000, 2000, 4000)


class Draft(NamedTuple):
    """A machine before its friction."""

    kind: str
    plant: Plant
    law: Law
    q_operating: float  # rad; the linear plant is taken here
    motion_rad: float  # rms
    share: float  # of the friction, on the motor side
    columns: tuple[str, str, str, str]  # time, reference, input, output
    bandwidth_hz: float
    mode_hz: float  # lowest mode, friction-free
    noise_counts: float


def draft(kind: str, seed: int, rng: np.random.Generator) -> Draft:
    """Plant, controller and habits of one machine; no friction, no limit."""
    row: dict[str, Any] = dict(zip(_NAMES, (_ROWS | _FURTHER_ROWS)[kind], strict=True))
    u = rng.uniform
    reported = kind == "belt" and rng.bit_generator.seed_seq.entropy == [1, 0, 0]  # type: ignore[attr-defined]
    motor = 1e-3 * float(np.exp(u(*np.log(row["inertia"]))))
    ratio = float(u(*row["ratio"]))
    anti = float(u(*row["anti"]))
    zeta = float(u(*row["zeta"]))
    letters = str(rng.choice(row["columns"].split()))
    per_rad, time, reference, output = _OUTPUTS[letters[0]]
    columns = (time, reference, _INPUTS[letters[1]], output)
    gear = float(rng.choice([50, 80, 100])) if kind == "joint" else 1.0
    torque = float(np.exp(u(*np.log(row["torque"])))) if letters[1] != "t" else gear
    load = motor * ratio
    counts = int(rng.choice(_COUNTS))
    least = max(12 * anti * np.sqrt(1 + ratio), 1000 * (kind == "screw"))
    rates = [rate for rate in _RATES_HZ if rate >= least]
    rate = float(rng.choice(rates[:3]))
    delay = int(rng.random() < 0.5)
    if kind == "quick":
        rate = 4000.0
    if kind == "late":
        delay = 5
    if reported:
        motor = 2e-3
        load = 5e-3
        anti = 5.0
        zeta = 0.0374
        torque = 0.6
        per_rad = 1.0
        counts = 16384
        columns = ("t_ms", "ref_rad", "i_cmd_A", "enc_rad")
        rate = 1000.0
        delay = 1
    total = motor + load
    # A coasting time of seconds; back-EMF, where the input is a voltage, brakes faster.
    viscous = np.array([total / u(1, 5) if letters[1] != "v" else total / u(0.3, 1.5), 0.0])
    inertia = np.array([motor, load])
    gravity = np.zeros(2)
    springs = _spring(motor, load, anti, zeta)
    if reported:
        viscous[0] = 4e-3
    if kind == "play":
        springs[0, 4] = 0.5e-4
    if kind == "quick":
        viscous[0] = total / u(5, 20)
    if kind == "link":  # a clamped beam: share of the inertia and frequency of its first three modes
        shares = np.array([0.9707, 0.0247, 0.0032])
        times = np.array([1, 6.267, 17.55])
        inertia = np.concatenate([[motor + load * (1 - shares.sum())], load * shares])
        rows = [_spring(motor, inertia[j], anti * times[j - 1], zeta, j) for j in (1, 2, 3)]
        springs = np.concatenate(rows)
        viscous = np.append(viscous[:1], np.zeros(3))
        gravity = np.zeros(4)
    q_operating = 0.0
    if kind == "pendulum":  # odd seeds: an arm held above the horizontal
        gravity[1] = load * 9.81 / u(0.2, 0.8)
        q_operating = float(u(0.5, 1.1) * rng.choice([-1, 1])) if seed % 2 else 0.0
    scale = per_rad or float(rng.choice([5, 10, 20])) / TAU
    waves = {"joint": (1.0, 2 * gear), "belt": (0.3, 12.0)}.get(kind, (0.0, 12.0))
    ripple = np.array([*waves, u(0, TAU)])
    size = inertia.size
    at_load = kind == "tip" or (kind == "screw" and seed % 2 == 1)
    plant = Plant(
        inertia, viscous, gravity, springs, np.tile([0, 0, 1.0, 0, 0], (size, 1)), ripple, torque,
        int(at_load), scale, 1 / rate, delay, TAU * scale / (counts * gear), np.inf,
    )  # fmt: skip
    poles = plant.linear(q_operating)[3]
    bandwidth = u(*row["bandwidth"]) * TAU * anti
    if kind == "pendulum":
        bandwidth = u(*row["bandwidth"]) * max(np.max(poles.real), 3.0)
    law, bandwidth = _design(plant, q_operating, float(bandwidth), rng)
    if reported:
        law = _pid((1.5, 0.06, 0.0), 1e-6, 0.0, 1e-3, False, 0.0)
    motion = float(np.exp(u(*np.log(row["motion"]))))
    motion = 0.22 if reported else max(motion, 20 * plant.count / scale)
    noisy = float(u(0.5, 2)) if counts >= 200_000 else 0.0
    is_upper = poles.imag > 1e-6
    mode = float(np.min(np.abs(poles[is_upper]))) / TAU
    return Draft(kind, plant, law, q_operating, motion, row["share"], columns, bandwidth / TAU, mode, noisy)


def _spring(motor: float, load: float, anti_hz: float, zeta: float, to: int = 1) -> Any:
    """Row of `springs` from inertia 0: antiresonance of the load alone, damping of the mode of both."""
    stiffness = load * (TAU * anti_hz) ** 2
    mode = np.sqrt(stiffness * (1 / motor + 1 / load))
    return np.array([[0, to, stiffness, 2 * zeta * stiffness / mode, 0.0]])


def _pid(gains: Any, filter_s: float, low_pass_s: float, dt_s: float, on_output: bool, bias: float) -> Law:
    """P, filtered D (of the error or of the output), I with back-calculation, low-pass; gains P, D, I."""
    kp, kd, ki = gains
    keep = np.exp(-dt_s / filter_s)
    soft = np.exp(-dt_s / low_pass_s) if low_pass_s else 0.0
    slope = np.array([0.0, -1.0]) if on_output else np.array([1.0, -1.0])
    error = np.array([1.0, -1.0])
    steep = kd * (1 - keep) / dt_s  # a backward difference where the filter is faster than the sampling
    c = np.array([-steep, 1.0, 0.0])
    d = kp * error + steep * slope
    a = np.diag([keep, float(ki > 0), soft]) + np.outer([0, 0, 1 - soft], c)
    b = np.array([(1 - keep) * slope, ki * dt_s * error, (1 - soft) * d])
    wind = np.array([0.0, ki * dt_s / kp, 0.0])
    return Law(a, b, (1 - soft) * c + np.array([0, 0, soft]), (1 - soft) * d, wind, bias)


def loop_radius(plant: Plant, q_operating: float, law: Law) -> float:
    """Largest pole modulus of the loop of the friction-free plant."""
    a, b, c = plant.sampled(q_operating)
    loop = np.block([[a + b * law.D[1] @ c, b @ law.C[None, :]], [law.B[:, 1:] @ c, law.A]])
    return float(np.max(np.abs(np.linalg.eigvals(loop))))


def loop_gain(plant: Plant, q_operating: float, law: Law, omega_rad_s: Any) -> Any:
    """L with y = -L y in the open loop, (F,)."""
    g = response(*plant.sampled(q_operating), omega_rad_s, plant.dt_s)
    return -g * (response(law.A, law.B[:, 1:], law.C[None, :], omega_rad_s, plant.dt_s) + law.D[1])


def _design(plant: Plant, q_operating: float, bandwidth: float, rng: Any) -> tuple[Law, float]:
    """PD, PID or PID with a low-pass that keeps |S| under 2.8; slower by a tenth until it does."""
    u = rng.uniform
    kind = int(rng.integers(3))
    zeta = u(0.5, 1.0)
    times = u(5, 15)
    on_output = bool(rng.random() < 0.4)
    low = u(6, 12)
    slow = u(4, 10)
    held = -np.sum(plant.gravity) * np.sin(q_operating) / plant.torque_per_u * u(0.9, 1.1)
    gain = plant.torque_per_u * plant.scale / plant.inertia.sum()
    lift = max(np.sum(plant.gravity) * np.cos(q_operating) / plant.inertia.sum(), 0.0)
    theta = np.geomspace(1e-4, np.pi, 2000)
    for _ in range(40):
        natural = bandwidth / 1.5
        kp = (natural**2 + lift) / gain
        kd = 2 * zeta * natural / gain
        ki = kp * natural / slow if kind else 0.0
        soft = 1 / (low * bandwidth) if kind == 2 else 0.0
        law = _pid((kp, kd, ki), 1 / (times * bandwidth), soft, plant.dt_s, on_output, float(held))
        nearest = np.min(np.abs(1 + loop_gain(plant, q_operating, law, theta / plant.dt_s)))
        if loop_radius(plant, q_operating, law) < 1 and nearest > 1 / 2.8:
            return law, bandwidth
        bandwidth *= 0.9
        if lift and bandwidth < 2 * np.sqrt(lift):  # an unstable plant needs speed: give up filters instead
            bandwidth = 4 * np.sqrt(lift)
            kind = min(kind, 1)
            times = 2 * times
            low = 2 * low
    raise RuntimeError(f"no PID holds {plant}")
