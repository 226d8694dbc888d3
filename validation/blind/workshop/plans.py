"""Experiments of a workshop: wholly in closed loop, or open loop with at most a last record under control."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Literal

import numpy as np

from validation.blind.inputs import Planned
from validation.blind.rigs import magnitudes, rounded
from validation.blind.truth import Before, Feedback, OutOfBoundsError, Real, Truth

Controller = Literal["none", "P", "PD"]
# Effects that pull towards a hub angle of zero: an arm in open loop is started near it.
_TURNING_BACK = ("gravity", "hardening_spring", "ground_spring")
# Largest deflection over the length.
_LARGEST_BEND = 0.08
# Seconds that a machine runs before its record begins.
_BEFORE_S = 1.2


@dataclass(frozen=True, eq=False)
class Run:
    """A plan with how it begins; voltages and references contain the rows before the first."""

    plan: Planned
    before: Before


def plan_workshop(
    truth: Truth, closed: bool, effects: tuple[str, ...], samples: tuple[int, int], rng: np.random.Generator
) -> tuple[tuple[Run, ...], Controller]:
    """Six runs whose sizes suit the machine without effects (`truth`), and the kind of controller in them."""
    makers = _Makers(truth, samples, rng)
    pulled = any(name in _TURNING_BACK for name in effects)
    controller: Controller = str(rng.choice(["P", "P", "PD"]))  # type: ignore[assignment]
    loop = makers.loop(controller)
    u = rng.uniform
    if closed:
        small = u(0.25, 0.5)
        large = u(0.5, 1.2)
        fresh = u(0.4, 1.2)
        runs = [
            ("steps_low", "random steps of the reference, small", makers.steps(small)),
            ("steps_high", "random steps of the reference, large", makers.steps(large)),
            ("multisine", "random-phase multisine reference", makers.tones(u(0.15, 0.5))),
            ("slews", "smooth slews of the reference", makers.slews(u(0.7, 1.3))),
            ("steps_fresh", "random steps of the reference, another sequence", makers.steps(fresh)),
            ("mixed", "multisine on slews of the reference", makers.mixed()),
        ]
    else:
        low = u(0.1, 0.2)
        high = u(0.3, 0.6)
        fresh = u(0.2, 0.4)
        runs = [
            ("prbs_low", "random binary voltage, low amplitude", makers.binary(low)),
            ("prbs_high", "random binary voltage, high amplitude", makers.binary(high)),
            ("multisine", "random-phase multisine voltage, periodic", makers.sines(u(0.12, 0.3))),
            ("doublet_decay", "voltage doublets with pauses at zero volts", makers.doublets(u(0.12, 0.35))),
            ("prbs_fresh", "random binary voltage, another sequence", makers.binary(fresh)),
        ]
        if rng.random() < 0.6:
            runs.append(("mixed", "multisine on slews of the reference", makers.mixed()))
        else:
            controller = "none"
            runs.append(("mixed", "smoothed random voltage", makers.wandering(u(0.3, 0.5))))
    made = []
    for k, (kind, words, shape) in enumerate(runs):
        role = "estimation" if k < 4 else "held_out"
        in_loop = closed or words.startswith("multisine on")
        # Gravity pulls a machine in open loop away: it begins near its rest.
        farthest = 3.1
        if pulled:
            farthest = 1.2 if in_loop else 0.25
        start = rounded(u(-farthest, farthest))
        plan = Planned(f"{k + 1:02d}_{kind}", kind, role, words, shape)
        if in_loop:
            offset = truth.background.hub_offset_rad
            wanted = replace(loop, reference_rad=np.round(shape + start + offset, 6))
            plan = replace(plan, voltage_V=np.zeros(shape.size), feedback=wanted)
        made.append(Run(plan, Before(start, makers.rows_before)))
    if closed or controller != "none":
        made = _limited(truth, made, rng)
    return tuple(made), controller


def _limited(truth: Truth, runs: list[Run], rng: np.random.Generator) -> list[Run]:
    """The runs with a limit of the controller, which the largest of its motions may reach."""
    peaks = [
        np.max(np.abs(truth.record(r.plan.voltage_V, r.plan.feedback, None, r.before).voltage_V))
        for r in runs
        if r.plan.feedback
    ]
    limit = rounded(float(np.max(peaks)) * rng.uniform(0.8, 2.0), 2)
    return [
        replace(r, plan=replace(r.plan, feedback=replace(r.plan.feedback, limit_V=limit)))
        if r.plan.feedback
        else r
        for r in runs
    ]


class _Makers:
    """Shapes of voltages and references (rows before the first, and the record's)."""

    def __init__(self, truth: Truth, samples: tuple[int, int], rng: np.random.Generator) -> None:
        self.truth = truth
        self.samples = samples
        self.rng = rng
        self.dt = truth.dt_s
        self.rows_before = int(_BEFORE_S / self.dt)
        M, K, _ = truth.linear()
        squares = np.linalg.eigvals(np.linalg.solve(M, K)).real
        self.first_rad_s = float(np.sqrt(np.sort(squares)[1]))
        self.inertia = float(M[0, 0])
        known = magnitudes(truth.rig)
        self.per_volt = known.per_volt
        self.braking = known.braking + known.viscous

    def length(self) -> int:
        return int(self.rng.integers(self.samples[0], self.samples[1] + 1)) + self.rows_before

    def loop(self, controller: Controller) -> Feedback:
        """Gains lowered until steps of the machine without effects end quietly."""
        rng = self.rng
        bandwidth = min(rng.uniform(3.0, 6.0), 0.25 * self.first_rad_s)
        step = np.full(int(6.0 / self.dt), 0.3) + self.truth.background.hub_offset_rad
        for _ in range(12):
            proportional = self.inertia * bandwidth**2 / self.per_volt
            derivative = 0.0
            if controller == "PD":
                derivative = max(1.6 * bandwidth * self.inertia - self.braking, 0.05 * self.braking)
            loop = Feedback(
                step,
                rounded(proportional),
                rounded(derivative / self.per_volt),
                float(np.exp(-1 / rng.uniform(2.0, 5.0))),
            )
            try:
                angle = self.truth.record(np.zeros(step.size), loop, None, Before(0.0, 0)).hub_angle_rad
            except ValueError:
                angle = np.array([0.0, 1.0])
            late = angle[-angle.size // 4 :]
            if np.std(late) < 0.015 and np.max(angle) < 0.3 * 1.7:
                return loop
            bandwidth *= 0.8
        raise OutOfBoundsError("no loop loop: at every bound")

    # ---- references

    def steps(self, span_rad: float) -> Real:
        """Levels held between 0.5 and 1.8 s, over this span."""
        T = self.length()
        reference = np.zeros(T)
        k = self._first_move()
        while k < T:
            reference[k:] = self.rng.uniform(-0.5, 0.5) * span_rad
            k += int(self.rng.uniform(0.5, 1.8) / self.dt)
        return reference

    def tones(self, span_rad: float) -> Real:
        T = self.length()
        rise = np.clip(np.arange(T) / self.rows_before, 0.0, 1.0)
        wave = self._multisine(T, 0.25, min(1.2 * self.first_rad_s / (2 * pi), 0.2 / self.dt))
        return span_rad * rise * wave / np.ptp(wave)

    def slews(self, span_rad: float) -> Real:
        """A reference (T,) of smooth moves with rests in between, within a span."""
        T = self.length()
        reference = np.zeros(T)
        level = 0.0
        k = self._first_move()
        rows = np.arange(T)
        while k < T:
            target = self.rng.uniform(-0.5, 0.5) * span_rad
            if abs(target - level) < 0.25 * span_rad:
                target = level - np.sign(level or 1.0) * 0.5 * span_rad
            lasts = int(self.rng.uniform(0.6, 1.4) / self.dt)
            x = np.clip((rows - k) / lasts, 0.0, 1.0)
            reference += (target - level) * x**3 * (10 - 15 * x + 6 * x**2)
            level = target
            k += lasts + int(self.rng.uniform(0.1, 0.9) / self.dt)
        return reference

    def mixed(self) -> Real:
        slews = self.slews(self.rng.uniform(0.7, 1.2))
        rise = np.clip(np.arange(slews.size) / self.rows_before, 0.0, 1.0)
        wave = self._multisine(slews.size, 0.5, 1.2 * self.first_rad_s / (2 * pi))
        return slews + rise * wave / np.ptp(wave) * self.rng.uniform(0.1, 0.3)

    def _first_move(self) -> int:
        """Some records are at rest until their first row, others are moving."""
        before = self.rows_before
        if self.rng.random() < 0.4:
            return before + int(self.rng.uniform(0.05, 0.4) / self.dt)
        return int(self.rng.uniform(0.1, 0.9) * before)

    # ---- voltages

    def binary(self, span_rad: float) -> Real:
        """+-1, held for random times; starts with the record."""
        T = self.length()
        hold = max(2, round(self.rng.uniform(0.012, 0.03) / self.dt))
        bits = self.rng.integers(0, 2, -(-T // hold))
        wave = np.where(np.repeat(bits, hold)[:T] == 1, 1.0, -1.0)
        return self._scaled(wave, span_rad)

    def sines(self, span_rad: float) -> Real:
        wave = self._multisine(self.length(), 0.5, min(35.0, 0.35 / self.dt))
        return self._scaled(wave, span_rad)

    def doublets(self, span_rad: float) -> Real:
        """A voltage (T,) of pulses forth and back with rests in between."""
        T = self.length()
        wave = np.zeros(T)
        k = self.rows_before + int(0.1 / self.dt)
        while k < T:
            pulse = int(self.rng.uniform(0.1, 0.25) / self.dt)
            sign = self.rng.choice([-1.0, 1.0])
            wave[k : k + pulse] = sign
            wave[k + pulse : k + 2 * pulse] = -sign * self.rng.uniform(0.7, 1.0)
            k += 2 * pulse + int(self.rng.uniform(0.8, 1.6) / self.dt)
        return self._scaled(wave, span_rad)

    def wandering(self, span_rad: float) -> Real:
        """White noise behind a first-order low pass."""
        T = self.length()
        pole = float(np.exp(-self.dt * 2 * pi * self.rng.uniform(1.5, 4.0)))
        wave = np.zeros(T)
        now = 0.0
        for k, white in enumerate(self.rng.standard_normal(T).tolist()):
            now = pole * now + (1 - pole) * white
            wave[k] = now
        return self._scaled(wave, span_rad)

    def _multisine(self, T: int, low_Hz: float, high_Hz: float) -> Real:
        """Two periods in T rows, random phases, lines between the frequencies."""
        period = T // 2
        lines = np.arange(1, period // 2)
        frequency = lines / (period * self.dt)
        is_excited = (frequency >= low_Hz) & (frequency <= high_Hz)
        lines = lines[is_excited]
        spectrum = np.zeros(period // 2 + 1, dtype=np.complex128)
        spectrum[lines] = np.exp(2j * pi * self.rng.random(lines.size))
        wave = np.fft.irfft(spectrum, period)
        return np.tile(wave, 3)[:T]

    def _scaled(self, wave: Real, span_rad: float) -> Real:
        """Until the hub's span or the largest deflection is reached; before the first row at most a pulse."""
        rows = self.rows_before
        wave = wave.copy()
        wave[:rows] = 0.0
        if self.rng.random() < 0.6:
            at = int(self.rng.uniform(0.3, 0.9) * rows)
            size = self.rng.uniform(-0.4, 0.4) * np.max(np.abs(wave))
            wave[at : at + int(0.08 / self.dt)] = size
        unit = 1e-2 * wave / np.max(np.abs(wave))
        link = self.truth.rig["link"]
        hub = self.truth.rig["hub"]
        clean = self.truth.record(unit)
        arm = hub["radius_m"] + link["length_m"]
        bend = float(np.max(np.abs(clean.tip_m - arm * clean.hub_angle_rad))) / link["length_m"]
        factor = min(span_rad / float(np.ptp(clean.hub_angle_rad[rows:])), _LARGEST_BEND / bend)
        return np.asarray(np.round(factor * unit, 4))
