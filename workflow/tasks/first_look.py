"""What records show within a second: the band they tell, first mode, sign, spring and dry friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ident.basis.model import GobfModel
from ident.checks.plausible_modes import LIGHT
from ident.data.arrays import RealArray
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.nonparametric import empirical_frf, spectra_of
from ident.data.record import Record

# A response is told at a frequency where its standard deviation is below this share of its size ...
TOLD = 0.3
# ... and at this share of the lines within a factor of 1.5 below: those in between may not be excited.
_LINES_TOLD_BELOW = 0.2
# Lines that are told at least: fewer are no response.
_FEWEST_LINES = 3
# Share of the command's power that the rigid motion explains where it says what holds the position. Chosen.
_EXPLAINED = 0.97
# Power of the reference or command at a line, over that of its strongest, below which it is not excited.
_EXCITED = 1e-6
# Power of the output at a line over the median of its highest fifth of frequencies, which is taken as noise.
_ABOVE_FLOOR = 10.0
# Standard deviations by which a term of the motion differs from zero where it counts as there.
_SURE = 5.0
# Share of the rms command that such a term takes.
_WORTH = 0.01
# Share that a spring takes: drift, the sensor's own errors and friction at the load look like a weak one.
_SPRING = 0.1
# The command was cut at a limit where, clipped there, this part of what was unexplained stays so.
_STAYS_UNEXPLAINED = 0.25
# Quantiles of the size of the command at which such a limit is tried first.
_LIMIT_QUANTILES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98)
# Distance from one of the response times the force that the rigid motion takes, in the median: dry friction
# makes up to this of it where it is as large as that force.
_AGREES = 0.8
# Frequencies up to which the rigid motion is tried, evenly over their logarithm.
_ENDS = 10


@dataclass(frozen=True)
class Term:
    """A coefficient of the rigid motion.

    Attributes
    ----------
    value, deviation : float
        With its standard deviation, in units of input and output.
    share : float
        Rms of its force over that of the command.
    """

    value: float
    deviation: float
    share: float

    @property
    def shown(self) -> bool:
        """Whether the records show it: it differs from zero for sure, and takes some of the command."""
        return abs(self.value) > _SURE * self.deviation and self.share > _WORTH


@dataclass(frozen=True)
class RigidMotion:
    """The motion below the first mode: u = inertia y'' + viscous y' + friction sign(y') + stiffness y.

    A constant in each record stands for weight and offset. Where y is a speed each term has one derivative
    less, and there is no stiffness.

    Attributes
    ----------
    inertia, viscous, friction : Term
    stiffness : Term or None
        None where y is a speed.
    below_rad_s : float
        Command and motion were low-passed here before they were compared [rad/s].
    explained : float
        Share of the command's power, 1 for all of it.
    """

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
        is_below = response.omega_rad_s <= self.below_rad_s
        s = 1j * response.omega_rad_s[is_below]
        if s.size == 0:
            return True
        stiffness = 0.0 if self.stiffness is None else self.stiffness.value
        free = s ** (self.order - 1) * (self.inertia.value * s + self.viscous.value)
        force = free + stiffness
        distance = np.abs(1 - response.centre[: s.size] * force)
        return bool(np.median(distance) < _AGREES)

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
    """What records show without a model.

    Attributes
    ----------
    records : tuple of Record
        Cut to one length; where `turned`, the command has its sign changed.
    told_rad_s : tuple of two float, or None
        Lowest and highest frequency at which the response is told [rad/s].
    motion : RigidMotion or None
        Below the first mode, where it could be read off.
    mode : tuple of two float, or None
        Natural frequency [rad/s] and damping ratio of the first mode of an identified model, if there is one.
    notch : float or None
        Frequency [rad/s] of the slowest lightly damped zero of that model.
    turned : bool
        The output falls when the command is positive.
    """

    records: tuple[Record, ...]
    told_rad_s: tuple[float, float] | None = None
    motion: RigidMotion | None = None
    mode: tuple[float, float] | None = None
    notch: float | None = None
    turned: bool = False

    @property
    def rigid_below_rad_s(self) -> float | None:
        """Below it no mode can be: the rigid motion explains the command there."""
        motion = self.motion
        if motion is None or motion.sprung or not motion.explained > _EXPLAINED:
            return None
        return motion.below_rad_s


def first_look(records: Sequence[Record], *, position: bool) -> FirstLook:
    """What these records show.

    Parameters
    ----------
    records : sequence of Record
        One input, one output, one sampling time. Where all have a reference the response is taken by it.
    position : bool
        Whether the output is a position, else a speed or an acceleration.
    """
    shortest = min(record.n_samples for record in records)
    cut = tuple(record.slice(0, shortest) for record in records)
    response = told_response(cut)
    if response is None:
        return FirstLook(cut)
    told_rad_s = float(response.omega_rad_s[0]), float(response.omega_rad_s[-1])
    motion = _rigid(cut, response, position)
    turned = motion is not None and motion.turned
    if motion is not None and turned:
        cut = tuple(replace(record, input=-record.input) for record in cut)
        negated: dict[str, Any] = {}
        for name, term in vars(motion).items():
            if isinstance(term, Term):
                negated[name] = replace(term, value=-term.value)
        motion = replace(motion, **negated)
    return FirstLook(cut, told_rad_s, motion, turned=turned)


def unseen_limit(look: FirstLook, *, position: bool) -> float | None:
    """The limit at which an amplifier cut the command after it was logged, in units of the input.

    With the command clipped there the rigid motion explains most of what it left unexplained before. None
    where no limit does that, or there is no rigid motion.
    """
    # Imported here: it takes its time to load.
    from scipy.optimize import minimize_scalar

    motion = look.motion
    told_rad_s = look.told_rad_s
    if motion is None or told_rad_s is None:
        return None

    def unexplained(limit: float) -> float:
        """Share of the clipped command's power that the motion does not explain."""
        clipped = [replace(record, input=np.clip(record.input, -limit, limit)) for record in look.records]
        rigid = rigid_motion(clipped, motion.below_rad_s, told_rad_s[1], position=position)
        return np.inf if rigid is None else 1 - rigid.explained

    commands = np.concatenate([record.input[:, 0] for record in look.records])
    limits = np.quantile(np.abs(commands), _LIMIT_QUANTILES)
    unexplained_at = [unexplained(float(limit)) for limit in limits]
    best = int(np.argmin(unexplained_at))
    if not unexplained_at[best] < _STAYS_UNEXPLAINED * (1 - motion.explained):
        return None
    # The best one lies between the neighbours of the best that was tried.
    below = float(limits[max(best - 1, 0)])
    above = float(limits[min(best + 1, limits.size - 1)])
    nearest = minimize_scalar(unexplained, bounds=(below, above), method="bounded", options={"maxiter": 12})
    return float(nearest.x)


def from_reference(records: Sequence[Record], of: Literal["input", "output"]) -> list[Record]:
    """Records of the loop: its reference as the input, and the command or the motion as the output."""
    return [
        Record(
            np.asarray(record.reference),
            getattr(record, of),
            record.dt_s,
            name=record.name,
            input_names=record.reference_names,
            output_names=record.input_names if of == "input" else record.output_names,
        )
        for record in records
    ]


def told_response(records: Sequence[Record]) -> FrequencyUncertainty | None:
    """The response at the frequencies where the records tell it; None where they do nowhere.

    Taken by the reference, or by the command where the reference tells nothing.
    """
    response = _told_by(records)
    if response is None and any(record.reference is not None for record in records):
        without_reference = [replace(record, reference=None, reference_names=()) for record in records]
        response = _told_by(without_reference)
    return response


def _told_by(records: Sequence[Record]) -> FrequencyUncertainty | None:
    """The response by the instrument that `empirical_frf` takes, at the frequencies where it is told."""
    half = 1 if len(records) > 2 else 2
    response = empirical_frf(records, half_width_lines=half)
    spectra = spectra_of(records, periodic=False)
    omega = response.omega_rad_s
    spread = np.sqrt(np.trace(response.covariance, axis1=1, axis2=2))
    width = 2 * half + 1
    # Power of each signal about each frequency, over all records.
    powers = []
    for part in (spectra.instrument, spectra.output):
        lines = part[:, : omega.size * width].reshape(len(records), omega.size, width)
        powers.append(np.sum(np.abs(lines) ** 2, axis=(0, 2)))
    instrument, output = powers

    # Lines that are excited and known: small deviation, some power at the instrument, output above the noise.
    last_fifth = max(1, omega.size // 5)
    floor = float(np.median(output[-last_fifth:]))
    is_told = spread < TOLD * np.abs(response.centre)
    is_told &= instrument > _EXCITED * instrument.max()
    is_told &= output > _ABOVE_FLOOR * floor

    # Far above the excited band a line may be known by chance: the last one has others just below it.
    told_before = np.concatenate([[0], np.cumsum(is_told)])
    first = np.searchsorted(omega, omega / 1.5)
    k = np.arange(omega.size)
    told_below = told_before[k + 1] - told_before[first]
    in_company = np.flatnonzero(is_told & (told_below >= _LINES_TOLD_BELOW * (k + 1 - first)))
    end = in_company[-1] + 1 if in_company.size else 0
    is_told[end:] = False
    if np.count_nonzero(is_told) < _FEWEST_LINES:
        return None
    return replace(
        response,
        omega_rad_s=omega[is_told],
        centre=response.centre[is_told],
        covariance=response.covariance[is_told],
    )


def notches(model: GobfModel) -> RealArray:
    """Natural frequencies [rad/s] of lightly damped zeros, ascending."""
    zeros = np.asarray(model.zeros())
    is_upper = (np.imag(zeros) > 0) & (np.abs(zeros) > 0)
    s = np.log(zeros[is_upper]) / model.dt_s
    is_light = np.abs(np.real(s)) < LIGHT * np.abs(s)
    return np.sort(np.abs(s)[is_light])


def _rigid(records: Sequence[Record], response: FrequencyUncertainty, position: bool) -> RigidMotion | None:
    """The rigid motion up to the frequency where it explains most of the command; None where the response
    contradicts it at every frequency."""
    low, high = response.omega_rad_s[[0, -1]].tolist()
    ends = np.geomspace(high, min(2 * low, high), _ENDS).tolist()
    agreeing = []
    for end in ends:
        # Up to half of it: the motion has two more derivatives for what bends above.
        motion = rigid_motion(records, end / 2, high, position=position)
        if motion is not None and motion.agrees(response):
            agreeing.append(motion)
    return max(agreeing, key=lambda motion: motion.explained, default=None)


def rigid_motion(
    records: Sequence[Record], below_rad_s: float, speed_rad_s: float, *, position: bool
) -> RigidMotion | None:
    """Least squares of the command on the motion over all records, both low-passed.

    Two more derivatives stand for what bends below the first mode, a constant in each record for weight and
    offset. The standard deviations count as many samples as the band holds.

    Parameters
    ----------
    records : sequence of Record
        One input, one output, one sampling time.
    below_rad_s : float
        Corner of the low-pass [rad/s].
    speed_rad_s : float
        Corner for the speed whose sign friction has [rad/s]; at least `below_rad_s` is taken.
    position : bool
        Whether the output is a position.

    Returns
    -------
    RigidMotion or None
        None where the records are too short for the band, or the output stands still.

    Notes
    -----
    Neglected: noise in the output's derivatives.
    """
    # Imported here: it takes its time to load.
    from scipy.signal import butter, sosfiltfilt

    dt_s = records[0].dt_s
    low, high = (
        # The corner of a filter has to lie below the Nyquist frequency; 0.6 of it is chosen.
        butter(3, min(omega * dt_s / np.pi, 0.6), output="sos")
        for omega in (below_rad_s, max(speed_rad_s, below_rad_s))
    )
    # A period of the corner at either end is spoilt by the filter.
    trim = int(np.ceil(2 * np.pi / (below_rad_s * dt_s)))
    rows = []
    targets = []
    for k, record in enumerate(records):
        if record.n_samples < max(4 * trim, 100):
            return None
        y = record.output[:, 0] - record.output[:, 0].mean()
        u = sosfiltfilt(low, record.input[:, 0])

        def derivative(signal: RealArray, times: int) -> RealArray:
            for _ in range(times):
                signal = np.gradient(signal, dt_s)
            return signal

        # A position has one derivative more than a speed.
        to_speed = int(position)
        smooth = sosfiltfilt(low, y)
        speed = derivative(sosfiltfilt(high, y), to_speed)
        # A fiftieth of the usual speed counts as part of the turn.
        usual_speed = float(np.std(speed))
        sign = sosfiltfilt(low, np.tanh(speed / max(0.02 * usual_speed, 1e-300)))
        of_record = np.zeros((record.n_samples, len(records)))
        of_record[:, k] = 1.0
        # Inertia, viscous friction, two further derivatives, dry friction, spring.
        columns = [derivative(smooth, times + to_speed) for times in (1, 0, 2, 3)]
        columns.append(sign)
        if position:
            columns.append(smooth)
        rows.append(np.column_stack([*columns, of_record])[trim:-trim])
        targets.append(u[trim:-trim])

    # Scaled columns: derivatives of different order differ by orders of magnitude.
    matrix = np.concatenate(rows)
    target = np.concatenate(targets)
    scale = np.sqrt(np.mean(matrix**2, axis=0))
    if not np.all(scale > 0):
        return None
    q, r = np.linalg.qr(matrix / scale)
    solution = np.linalg.lstsq(r, q.T @ target, rcond=1e-12)[0]

    # Low-passed samples are not independent: only a band's share of them counts.
    independent = target.size * min(1.0, below_rad_s * dt_s / np.pi)
    if independent < 4 * matrix.shape[1]:
        return None
    residual = target - q @ (r @ solution)
    rss = float(np.sum(residual**2))
    # Neighbouring samples are alike behind the filter: as many count as are independent.
    noise = rss / (independent - matrix.shape[1]) * independent / target.size
    variances = np.sum(np.linalg.pinv(r) ** 2, axis=1)
    spread = np.sqrt(noise * variances * target.size / independent)
    total = float(np.std(target))

    def term(k: int) -> Term:
        value = float(solution[k] / scale[k])
        std = float(spread[k] / scale[k])
        share = float(abs(solution[k])) / total
        return Term(value, std, share)

    return RigidMotion(
        inertia=term(0),
        viscous=term(1),
        friction=term(4),
        stiffness=term(5) if position else None,
        below_rad_s=below_rad_s,
        explained=1 - rss / total**2 / target.size,
    )
