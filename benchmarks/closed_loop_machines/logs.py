"""References as users have them, friction as a share of the command, logs as a logger prints, the truth."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.signal

from benchmarks.closed_loop_machines.machines import ALL_KINDS, TAU, Draft, draft
from benchmarks.closed_loop_machines.simulator import Array, Plant

CLASSES = ("multisine", "prbs", "chirp", "moves")
# Every log is cut out of a longer motion.
_BEFORE_S = 3.0


@dataclass(frozen=True, eq=False)
class Machine:
    """A machine, its controller, and how it was recorded."""

    kind: str
    seed: int
    series: int
    draft: Draft
    plant: Plant
    classes: tuple[str, ...]  # of the reference, per log; the last log validates
    levels: tuple[float, ...]  # rms of the reference over that of level 1
    at_rest: tuple[bool, ...]  # the log starts after a stop, or in mid-motion
    duration_s: float
    centre: float  # of the motion, output units
    kept: bool  # reference recorded
    as_commanded: bool  # command logged before saturation

    @property
    def name(self) -> str:
        return f"{self.kind}_{self.seed}"

    def reference(self, log: int, rng: np.random.Generator) -> tuple[Array, int]:
        """Reference in output units, (T,), and the sample at which the log begins."""
        d = self.draft
        dt = self.plant.dt_s
        before = round(_BEFORE_S / dt)
        n = round(self.duration_s / dt)
        shape = _shape(self.classes[log], n, before, dt, d, rng)
        size = self.levels[log] * d.motion_rad * self.plant.scale
        r = shape * size / np.std(shape[before:])
        if self.at_rest[log]:  # stood here for a while; the experiment begins where it stood
            r[before:] -= r[before]
            r[before // 2 : before] = 0.0
        return self.centre + r, before

    def record(self, log: int, rng: np.random.Generator) -> tuple[dict[str, Array], int]:
        """Signals of one run with its `reference`, and the sample at which the log begins."""
        r, begin = self.reference(log, rng)
        noise = self.draft.noise_counts * self.plant.count * rng.standard_normal(r.size)
        start = self.centre / self.plant.scale
        return {"r": r, **self.plant.run(self.draft.law, r, start, noise, begin)}, begin

    def play(self, reference: Array, rng: np.random.Generator) -> dict[str, Array]:
        """Signals of one run with a reference (T,) in output units, from rest at the centre."""
        noise = self.draft.noise_counts * self.plant.count * rng.standard_normal(reference.size)
        start = self.centre / self.plant.scale
        return {"r": reference, **self.plant.run(self.draft.law, reference, start, noise)}

    def rng(self, log: int) -> np.random.Generator:
        return np.random.default_rng([self.series, ALL_KINDS.index(self.kind), self.seed, 1 + log])


def machine(kind: str, seed: int, series: int = 1) -> Machine:
    """The machine of a seed. Friction is 2 to 30 % of the rms command of its logs."""
    rng = np.random.default_rng([series, ALL_KINDS.index(kind), seed])
    d = draft(kind, seed, rng)
    u = rng.uniform
    reported = kind == "belt" and (series, seed) == (1, 0)
    logs = int(rng.choice([3, 4]))
    main = str(rng.choice(CLASSES, p=[0.35, 0.25, 0.2, 0.2]))
    classes = [main if rng.random() < 0.8 else str(rng.choice(CLASSES)) for _ in range(logs)]
    if kind == "clipped":
        classes = ["chirp"] * logs
    levels = [1.0, 0.5, 1.0, 0.5][:logs] if rng.random() < 0.4 else [1.0] * logs
    begins_at_rest = [bool(rng.random() < 0.6) for _ in range(logs)]
    duration = round(float(u(8, 20)), 1)
    if d.plant.dt_s < 4e-4:
        duration = min(duration, 10.0)
    away = 0.0 if kind == "pendulum" else float(u(-5, 5)) * d.motion_rad
    share = float(np.exp(u(*np.log([0.1 if kind == "screw" else 0.02, 0.3]))))
    model = rng.random()
    high = float(u(1.1, 1.4))
    slow = float(u(0.03, 0.2))
    shift = float(np.exp(u(*np.log([1e-4, 1e-3]))))
    ripple = float(u(0.003, 0.02))
    clip = float(u(0.96, 0.995))
    if reported:
        classes = ["multisine"] * 4
        levels = [1.0, 1.0, 0.5, 0.5]
        begins_at_rest = [True] * 4
        duration = 16.0
        away = 0.0
        model = 0.0
        logs = 4
    centre = (d.q_operating + away) * d.plant.scale
    habits = tuple(classes), tuple(levels), tuple(begins_at_rest), duration, centre, seed % 6 < 4
    is_limited = kind in ("saturation", "clipped")
    if kind == "clipped":  # a tenth of the samples more, and more
        clip -= 0.1
    bare = Machine(kind, seed, series, d, d.plant, *habits, is_limited and seed % 6 in (2, 4))
    plant = replace(d.plant, ripple=np.zeros(3))
    level = 0.0
    for _ in range(10):  # friction raises the command that it is a share of
        ran = [replace(bare, plant=plant).record(log, bare.rng(log)) for log in range(logs)]
        rms = [float(np.std(signals["applied"][begin:])) for signals, begin in ran]
        command = min(max(share * np.exp(np.mean(np.log(rms))), 0.02 * max(rms)), 0.3 * min(rms))
        speed = np.concatenate([signals["speed"][begin:] for signals, begin in ran])
        if 0 < level <= 0.305 * min(rms) * plant.torque_per_u or (level and reported):
            break
        level = 0.03 if reported else command * plant.torque_per_u
        friction = np.zeros((plant.inertia.size, 5))
        friction[:2, 0] = level * np.array([d.share, 1 - d.share])
        friction[:, 1] = friction[:, 0] * (high if 0.45 < model < 0.75 else 1.0)
        friction[:, 2] = slow * np.std(speed)
        if model >= 0.75:
            friction[:, 3] = friction[:, 0] / min(shift, d.motion_rad / 30)
            friction[:, 4] = 0.5 * np.sqrt(friction[:, 3] * plant.inertia)
        plant = replace(plant, friction=friction)
    waves = d.plant.ripple * [ripple * min(rms) * d.plant.torque_per_u, 1, 1]
    plant = replace(plant, ripple=waves * (0.0 if reported else 1.0))
    rough = replace(bare, plant=plant)
    ran = [rough.record(log, rough.rng(log)) for log in range(logs)]
    peaks = np.concatenate([np.abs(signals["u"][begin:]) for signals, begin in ran])
    if not np.all(np.isfinite(peaks)):
        raise RuntimeError(f"{bare.name} of series {series} does not hold")
    limit = float(np.quantile(peaks, clip)) if is_limited else 2.5 * float(np.max(peaks))
    return replace(rough, plant=replace(plant, limit=limit))


def _shape(name: str, n: int, before: int, dt: float, d: Draft, rng: np.random.Generator) -> Array:
    """Zero-mean shape of a reference, (before + n,)."""
    u = rng.uniform
    total = before + n
    t = (np.arange(total) - before) * dt
    nyquist = 0.5 / dt
    top = min(d.mode_hz * u(2, 6), 0.4 / dt)
    if name == "multisine":
        period = round(n / 2)
        lines = np.arange(1, int(top * period * dt))
        size = 1 / np.sqrt(1 + (lines / (period * dt) / (d.bandwidth_hz * u(0.5, 3))) ** 2)
        spectrum = np.zeros(period // 2 + 1, complex)
        spectrum[lines] = size * np.exp(1j * u(0, TAU, lines.size))
        wave = np.fft.irfft(spectrum, period)
        return wave[(np.arange(total) - before) % period]
    if name == "prbs":
        hold = max(round(1 / (u(2, 4) * d.mode_hz) / dt), 1)
        levels = np.repeat(rng.choice([-1.0, 1.0], total // hold + 1), hold)[:total]
        keep = np.exp(-TAU * min(d.mode_hz * u(0.5, 1.5), nyquist) * dt)
        return scipy.signal.lfilter([(1 - keep) ** 2], [1, -2 * keep, keep**2], levels)
    if name == "chirp":
        first = u(0.1, 0.3)
        last = min(2 * d.mode_hz, 0.4 / dt)
        rate = np.log(last / first) / (n * dt)
        phase = TAU * first * np.where(t < 0, t, (np.exp(rate * np.maximum(t, 0)) - 1) / rate)
        return np.sin(phase)
    # moves of trapezoidal speed, with stops
    shape = np.zeros(total)
    at = 0
    last = 0.0
    while at < total:
        target = u(-2, 2)
        moving = max(round(u(0.8, 3) / (TAU * d.bandwidth_hz) / dt), 8)
        s = np.clip(np.arange(moving + round(u(0.2, 0.8) / dt)) / moving, 0, 1)
        ramp = u(0.15, 0.3)
        up = np.where(s > 1 - ramp, 1 - ramp - (1 - s) ** 2 / (2 * ramp), s - ramp / 2)
        up = np.where(s < ramp, s**2 / (2 * ramp), up)
        part = last + (target - last) * up / (1 - ramp)
        last = float(part[-1])
        shape[at : at + s.size] = part[: total - at]
        at += s.size
    return shape


def printed(one: Machine, got: dict[str, Array], begin: int, start_s: float, path: Path) -> None:
    """A run from sample `begin` on, as a logger prints it."""
    time, reference, command, output = one.draft.columns
    u = got["u"] if one.as_commanded else np.clip(got["u"], -one.plant.limit, one.plant.limit)
    u = u[begin:]
    n = got["u"].size - begin
    clock = np.arange(n) * one.plant.dt_s + start_s
    digits = max(4 - int(np.floor(np.log10(np.std(u)))), 2)
    places = 6 if one.plant.scale == 1 else 5
    table = {time: [f"{t * 1e3:.6g}" for t in clock] if time == "t_ms" else [f"{t:.5f}" for t in clock]}
    if one.kept:
        table[reference] = [f"{v:.{places}f}" for v in got["r"][begin:]]
    table[command] = [f"{v:.{digits}f}" for v in u]
    table[output] = [f"{v:.{places}f}" for v in got["y"][begin:]]
    rows = [",".join(table), *map(",".join, zip(*table.values(), strict=True))]
    path.write_bytes(gzip.compress(("\n".join(rows) + "\n").encode(), mtime=0))


def write(one: Machine, folder: Path, truth: Path) -> list[Path]:
    """FOLDER/NAME/run1.csv.gz and on; TRUTH/NAME.json. The last run validates."""
    where = folder / one.name
    where.mkdir(parents=True, exist_ok=True)
    truth.mkdir(parents=True, exist_ok=True)
    levels = []
    paths = []
    moved = []
    dt = one.plant.dt_s
    for log in range(len(one.classes)):
        rng = one.rng(log)
        got, begin = one.record(log, rng)
        start_s = 0.0 if one.at_rest[log] else round(float(rng.uniform(1, 60)), 1)
        paths.append(where / f"run{log + 1}.csv.gz")
        printed(one, got, begin, start_s, paths[-1])
        moved.append(got["true"][begin:])
        levels.append(float(got["friction_Nm"]) / one.plant.torque_per_u)
    p = one.plant
    d = one.draft
    a, b, c = p.sampled(d.q_operating)
    poles = p.linear(d.q_operating)[3]
    is_upper = poles.imag > 1e-6
    modes = sorted(poles[is_upper], key=abs)
    known = {
        "kind": one.kind, "seed": one.seed, "series": one.series, "dt_s": dt, "delay_samples": p.delay,
        "A": a.tolist(), "B": b.tolist(), "C": c.tolist(),  # friction-free, sampled, in the log's units
        "modes_hz": [abs(m) / TAU for m in modes], "dampings": [-m.real / abs(m) for m in modes],
        "unstable_1_s": [float(m.real) for m in poles if m.real > 1e-6],
        "coulomb_in_input_units": float(p.friction[:, 0].sum() / p.torque_per_u),
        "breakaway_in_input_units": float(p.friction[:, 1].sum() / p.torque_per_u),
        "friction_as_recorded_in_input_units": levels,  # work over path, per log
        "bristle": bool(np.any(p.friction[:, 3])), "play_rad": float(2 * p.springs[0, 4]),
        "limit_in_input_units": p.limit, "count_in_output_units": p.count, "bandwidth_hz": d.bandwidth_hz,
        "controller": {k: np.asarray(v).tolist() for k, v in d.law._asdict().items()},
        "classes": one.classes, "levels": one.levels, "at_rest": one.at_rest,
        "reference_recorded": one.kept, "command_before_limit": one.as_commanded,
        "operating_point": d.q_operating * p.scale,
        "output_range": list(np.percentile(np.concatenate(moved), [5, 95])),
    }  # fmt: skip
    (truth / f"{one.name}.json").write_text(json.dumps(known, indent=1) + "\n")
    return paths
