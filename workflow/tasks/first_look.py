"""What records show within a second: the band they tell, first mode, sign, spring and dry friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import butter, sosfiltfilt

from ident.basis.model import GobfModel
from ident.checks.plausible_modes import LIGHT
from ident.data.arrays import RealArray
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.nonparametric import empirical_frf, spectra_of
from ident.data.record import Record

# A response is told where its standard deviation is below this share of it ...
TOLD = 0.3
# ... at this share of the lines just below, and at so many in all: those in between may not be excited.
_OF_LINES, _FEWEST = 0.2, 3
# Of the rigid motion: half of the frequency that is tried, with two more derivatives for what bends there; it
# tells what holds the position where it explains this share of the command's power.
_EXPLAINED = 0.97
# A line with less of the instrument's largest, or of the output's at its highest frequencies, is not excited.
_EXCITED, _ABOVE_FLOOR = 1e-6, 10.0
# A term of the motion is there with so many standard deviations, and this share of the rms command below; a
# spring with a larger one: drift, the sensor's own errors and friction at the load look like a weak one.
_SURE, _WORTH, _SPRING = 5.0, 0.01, 0.1
# A limit that the command has without showing it: clipped there, so much less of it stays unexplained. Tried
# first at these quantiles of the command.
_LESS, _LIMITS = 0.25, (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98)
# Distance from one of the response times the force that the rigid motion takes, in the median: dry friction
# makes up to this of it where it is as large as that force.
_AGREES = 0.8
_ENDS = 10  # frequencies up to which the rigid motion is tried


@dataclass(frozen=True)
class Term:
    """A coefficient of the rigid motion and whether the records show it: sure, and worth its share of the
    command."""

    value: float
    deviation: float
    share: float

    @property
    def shown(self) -> bool:
        return abs(self.value) > _SURE * self.deviation and self.share > _WORTH


@dataclass(frozen=True)
class RigidMotion:
    """u = inertia y'' + viscous y' + friction sign(y') + stiffness y + constant, below the first mode; of a
    speed y the same with one derivative less, without stiffness. In units of the input and the output."""

    inertia: Term
    viscous: Term
    friction: Term
    stiffness: Term | None
    below_rad_s: float
    explained: float

    @property
    def order(self) -> int:
        """Derivatives of the output that the inertia stands before."""
        return 1 if self.stiffness is None else 2

    def agrees(self, response: FrequencyUncertainty) -> bool:
        """Whether the response says the same, as far as friction lets it: a direct fit of records that the
        feedback made may show the controller instead."""
        s = 1j * response.omega_rad_s[response.omega_rad_s <= self.below_rad_s]
        stiffness = 0.0 if self.stiffness is None else self.stiffness.value
        force = s ** (self.order - 1) * (self.inertia.value * s + self.viscous.value) + stiffness
        return bool(s.size == 0 or np.median(np.abs(1 - response.centre[: s.size] * force)) < _AGREES)

    @property
    def turned(self) -> bool:
        """Whether the machine is pushed against the command; nothing that the records contradict."""
        against = self.inertia.shown and self.inertia.value < 0 and self.explained > _EXPLAINED
        return against and not (self.viscous.shown and self.viscous.value > 0)

    @property
    def free(self) -> bool:
        """Whether nothing holds the position: a spring or weight would show."""
        return self.explained > _EXPLAINED and not (self.stiffness is None or self.stiffness.share > _WORTH)

    @property
    def sprung(self) -> bool:
        """Whether a spring or weight holds the position, or throws it over."""
        return (
            self.stiffness is not None
            and self.stiffness.shown
            and self.stiffness.share > _SPRING
            and self.explained > _EXPLAINED
        )


@dataclass(frozen=True, eq=False)
class FirstLook:
    """told_rad_s: lowest and highest frequency at which the response is told. turned: the output falls when
    the command is positive; the records have the command with its sign changed then. Of the identified model,
    where there is one: mode: natural frequency [rad/s] and damping ratio of the first; notch: frequency
    [rad/s] of the slowest lightly damped zero."""

    records: tuple[Record, ...]
    told_rad_s: tuple[float, float] | None = None
    motion: RigidMotion | None = None
    mode: tuple[float, float] | None = None
    notch: float | None = None
    turned: bool = False

    @property
    def rigid_below_rad_s(self) -> float | None:
        """Below it no mode can be: the rigid motion explains the command there."""
        told = self.motion is not None and self.motion.explained > _EXPLAINED and not self.motion.sprung
        return self.motion.below_rad_s if self.motion is not None and told else None


def first_look(records: Sequence[Record], *, position: bool) -> FirstLook:
    """Of SISO records of one sampling time; by the reference where all have one. position: of the output,
    else its speed or acceleration."""
    shortest = min(record.n_samples for record in records)
    cut = tuple(record.slice(0, shortest) for record in records)
    response = told_response(cut)
    if response is None:
        return FirstLook(cut)
    told = float(response.omega_rad_s[0]), float(response.omega_rad_s[-1])
    motion = _rigid(cut, response, position)
    turned = motion is not None and motion.turned
    if motion is not None and turned:
        cut = tuple(replace(record, input=-record.input) for record in cut)
        terms: Any = {name: one for name, one in vars(motion).items() if isinstance(one, Term)}
        motion = replace(motion, **{name: replace(one, value=-one.value) for name, one in terms.items()})
    return FirstLook(cut, told, motion, turned=turned)


def unseen_limit(look: FirstLook, *, position: bool) -> float | None:
    """The limit at which an amplifier cut the command after it was logged: with the command clipped there,
    the rigid motion explains it. None where there is none."""
    motion, told = look.motion, look.told_rad_s
    if motion is None or told is None:
        return None

    def left(limit: float) -> float:
        """Power of the command that the motion leaves, of the clipped command's."""
        clipped = [replace(one, input=np.clip(one.input, -limit, limit)) for one in look.records]
        found = rigid_motion(clipped, motion.below_rad_s, told[1], position=position)
        return np.inf if found is None else 1 - found.explained

    limits = np.quantile(np.abs(np.concatenate([record.input[:, 0] for record in look.records])), _LIMITS)
    lefts = [left(float(limit)) for limit in limits]
    k = int(np.argmin(lefts))
    if not lefts[k] < _LESS * (1 - motion.explained):
        return None
    around = float(limits[max(k - 1, 0)]), float(limits[min(k + 1, limits.size - 1)])
    return float(minimize_scalar(left, bounds=around, method="bounded", options={"maxiter": 12}).x)


def from_reference(records: Sequence[Record], of: Literal["input", "output"]) -> list[Record]:
    """Records of the loop: its reference as the input, and the command or the motion as the output."""
    return [
        Record(
            record.name,
            np.asarray(record.reference),
            getattr(record, of),
            record.dt_s,
            record.reference_names,
            record.input_names if of == "input" else record.output_names,
        )
        for record in records
    ]


def told_response(records: Sequence[Record]) -> FrequencyUncertainty | None:
    """The response at the frequencies where it is told; None where it is not. By the reference, or by the
    command where that tells nothing."""
    found = _told_by(records)
    if found is None and any(record.reference is not None for record in records):
        found = _told_by([replace(one, reference=None, reference_names=()) for one in records])
    return found


def _told_by(records: Sequence[Record]) -> FrequencyUncertainty | None:
    half = 1 if len(records) > 2 else 2
    response, spectra = empirical_frf(records, half_width_lines=half), spectra_of(records, periodic=False)
    omega = response.omega_rad_s
    spread = np.sqrt(np.trace(response.covariance, axis1=1, axis2=2))
    width = 2 * half + 1
    instrument, output = (
        np.sum(
            np.abs(part[:, : omega.size * width].reshape(len(records), omega.size, width)) ** 2, axis=(0, 2)
        )
        for part in (spectra.instrument, spectra.output)
    )
    floor = float(np.median(output[-max(1, omega.size // 5) :]))
    told = (spread < TOLD * np.abs(response.centre)) & (instrument > _EXCITED * instrument.max())
    told &= output > _ABOVE_FLOOR * floor
    before = np.concatenate([[0], np.cumsum(told)])
    first = np.searchsorted(omega, omega / 1.5)
    k = np.arange(omega.size)
    last = np.flatnonzero(told & ((before[k + 1] - before[first]) >= _OF_LINES * (k + 1 - first)))
    told[last[-1] + 1 if last.size else 0 :] = False
    if np.count_nonzero(told) < _FEWEST:
        return None
    return replace(
        response, omega_rad_s=omega[told], centre=response.centre[told], covariance=response.covariance[told]
    )


def notches(model: GobfModel) -> RealArray:
    """Natural frequencies [rad/s] of lightly damped zeros, ascending."""
    zeros = np.asarray(model.zeros())
    s = np.log(zeros[(np.imag(zeros) > 0) & (np.abs(zeros) > 0)]) / model.dt_s
    return np.sort(np.abs(s)[np.abs(np.real(s)) < LIGHT * np.abs(s)])


def _rigid(records: Sequence[Record], response: FrequencyUncertainty, position: bool) -> RigidMotion | None:
    """The rigid motion up to where it explains most of the command."""
    low, high = response.omega_rad_s[[0, -1]].tolist()
    ends = np.geomspace(high, min(2 * low, high), _ENDS).tolist()
    tried = (rigid_motion(records, end / 2, high, position=position) for end in ends)
    found = [motion for motion in tried if motion is not None and motion.agrees(response)]
    return max(found, key=lambda motion: motion.explained, default=None)


def rigid_motion(
    records: Sequence[Record], below_rad_s: float, speed_rad_s: float, *, position: bool
) -> RigidMotion | None:
    """Least squares of the command on the motion, both low-passed below a frequency, over all records.

    speed_rad_s: below it the speed whose sign friction has. Two more derivatives stand for what bends below
    the first mode, a constant in each record for weight and offset. The standard deviations count as many
    samples as the band holds. None where it holds too few. Neglected: noise in the output's derivatives.
    """
    dt_s = records[0].dt_s
    low, high = (
        butter(3, min(omega * dt_s / np.pi, 0.6), output="sos")
        for omega in (below_rad_s, max(speed_rad_s, below_rad_s))
    )
    trim = int(np.ceil(2 * np.pi / (below_rad_s * dt_s)))
    rows, targets = [], []
    for k, record in enumerate(records):
        if record.n_samples < max(4 * trim, 100):
            return None
        y, u = record.output[:, 0] - record.output[:, 0].mean(), sosfiltfilt(low, record.input[:, 0])

        def derivative(signal: RealArray, times: int) -> RealArray:
            for _ in range(times):
                signal = np.gradient(signal, dt_s)
            return signal

        more, smooth = int(position), sosfiltfilt(low, y)
        speed = derivative(sosfiltfilt(high, y), more)
        # A fiftieth of the usual speed counts as part of the turn.
        sign = sosfiltfilt(low, np.tanh(speed / max(0.02 * float(np.std(speed)), 1e-300)))
        of_record = np.zeros((record.n_samples, len(records)))
        of_record[:, k] = 1.0
        columns = [derivative(smooth, times + more) for times in (1, 0, 2, 3)]
        columns += [sign, *([smooth] if position else [])]
        rows.append(np.column_stack([*columns, of_record])[trim:-trim])
        targets.append(u[trim:-trim])
    matrix, target = np.concatenate(rows), np.concatenate(targets)
    scale = np.sqrt(np.mean(matrix**2, axis=0))
    if not np.all(scale > 0):
        return None
    q, r = np.linalg.qr(matrix / scale)
    solution = np.linalg.lstsq(r, q.T @ target, rcond=1e-12)[0]
    independent = target.size * min(1.0, below_rad_s * dt_s / np.pi)
    if independent < 4 * matrix.shape[1]:
        return None
    rss = float(np.sum((target - q @ (r @ solution)) ** 2))
    noise = rss / (independent - matrix.shape[1]) * independent / target.size
    spread = np.sqrt(noise * np.sum(np.linalg.pinv(r) ** 2, axis=1) * target.size / independent)
    total = float(np.std(target))

    def term(k: int) -> Term:
        return Term(
            float(solution[k] / scale[k]), float(spread[k] / scale[k]), float(abs(solution[k])) / total
        )

    return RigidMotion(
        term(0),
        term(1),
        term(4),
        term(5) if position else None,
        below_rad_s,
        1 - rss / total**2 / target.size,
    )
