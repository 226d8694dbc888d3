"""A reference for the loop that is there, planned from its own logs: lines, amplitudes, what to expect.

The loop is known where the logs tell it, without any model; its steady state follows line by line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.data.arrays import ComplexArray, IntArray, RealArray
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record
from plant.experiment_plan import ExperimentPlan
from workflow.engine.errors import InputError
from workflow.tasks.first_look import FirstLook, first_look, from_reference, told_response

# Amplitudes as shares of the largest: what differs between them is not linear.
_LEVELS = (1.0, 0.5)
# Beyond what the logs tell, the loop is taken to answer so many times as much as at the last line they tell.
_UNTOLD = 2.0
# Where no band is stated: highest frequency that the logs tell over the lowest that is excited. Two decades.
_HIGHEST_OVER_LOWEST = 100.0
# Where no duration is stated: periods of the lowest frequency in all records together. Chosen.
_PERIODS_OF_LOWEST = 60.0
# Command that dry friction leaves recognisable: rms over its level.
_ABOVE_FRICTION = 3.0


@dataclass(frozen=True, eq=False)
class PlannedReference:
    """A reference to play on the loop, and what to expect of it.

    Commands and motions are those of the steady state, in the units of the logs and without the operating
    point; they are nan without a recorded reference.

    Attributes
    ----------
    plan : ExperimentPlan
    dt_s : float
    seed : int
    lines_Hz : (H,) array
        Excited frequencies.
    references : (A, M, T) array
        Over amplitudes, realisations and samples, about `offset`.
    offset : float
        Operating point: the median of the records' mean references (outputs where none was recorded).
    rms : (A,) array
        Of the references.
    command_peak, command_rms, motion_peak : (A, M) arrays
        To expect.
    largest_command, largest_motion : float
        What was allowed.
    friction : float
        Level of dry friction in the logs, in units of the command; 0 where none shows.
    told : float
        Share of the lines at which the logs tell the loop.
    """

    plan: ExperimentPlan
    dt_s: float
    seed: int
    lines_Hz: RealArray
    references: RealArray
    offset: float
    rms: RealArray
    command_peak: RealArray
    command_rms: RealArray
    motion_peak: RealArray
    largest_command: float
    largest_motion: float
    friction: float
    told: float

    @property
    def above_friction(self) -> bool:
        """Whether the larger level drives the machine well above its dry friction, if that is known."""
        return not self.friction or bool(self.command_rms[0].min() > _ABOVE_FRICTION * self.friction)


def plan_reference(
    records: Sequence[Record],
    *,
    band_Hz: tuple[float, float] | None = None,
    duration_s: float | None = None,
    position: bool,
    largest_command: float | None = None,
    largest_motion: float | None = None,
    share: float = 0.8,
    rms: float | None = None,
    seed: int = 2006,
    lead_in_s: float = 1.0,
    **settings: object,
) -> PlannedReference:
    """Two levels of random-phase multisines that excite command and motion alike, each as far as allowed.

    Parameters
    ----------
    records : sequence of Record
        One input, one output, of the loop as it is.
    band_Hz : tuple of two float, optional
        Frequencies to excite; default: two decades up to the highest that the records tell.
    duration_s : float, optional
        Of all records together; default: what the band needs.
    position : bool
        Whether the output is a position.
    largest_command, largest_motion : float, optional
        Allowed, from the operating point; default: those of the records, of the command a share of it.
    share : float
        That share.
    rms : float, optional
        Of the reference; needed where the records do not tell how the loop answers.
    seed : int
        Of the random phases and of the lines that are left out.
    lead_in_s : float
        From rest to steady state.
    **settings : object
        Fields of `ExperimentPlan` by name.

    Raises
    ------
    InputError
        One line: no experiment stays within the limits, or the amplitude is not known.
    """
    dt_s = records[0].dt_s
    look = first_look(records, position=position)
    if band_Hz is None:
        band_Hz = _band_of(look, dt_s)
    duration_s = duration_s or _PERIODS_OF_LOWEST / band_Hz[0]
    try:
        plan = ExperimentPlan.within(
            band_Hz=band_Hz,
            dt_s=dt_s,
            duration_s=duration_s,
            lead_in_s=lead_in_s,
            rms_V=_LEVELS,
            lines_seed=seed,
            **settings,
        )
        lines = plan.lines(dt_s)
    except ValueError as error:
        raise InputError(str(error)) from error

    # What is allowed: as stated, or what the records had.
    def largest_deviation(signals: Sequence[RealArray]) -> float:
        deviations = [np.abs(signal - signal.mean()) for signal in signals]
        return max(float(np.max(deviation)) for deviation in deviations)

    commands = [record.input for record in records]
    motions = [record.output for record in records]
    command_limit = largest_command or share * largest_deviation(commands)
    motion_limit = largest_motion or largest_deviation(motions)

    # How the loop answers a reference, with its command and its motion.
    period_s = plan.period_samples * dt_s
    omega = np.asarray(2 * np.pi * lines / period_s, dtype=np.float64)
    known = all(record.reference is not None for record in records)
    command_response: FrequencyUncertainty | None = None
    motion_response: FrequencyUncertainty | None = None
    if known:
        command_response = told_response(from_reference(records, "input"))
        motion_response = told_response(from_reference(records, "output"))
    is_told = command_response is not None and motion_response is not None
    if not is_told and rms is None:
        why = "no reference is recorded"
        if known:
            why = "the logs do not tell how the loop answers"
        raise InputError(
            f"{records[0].label}: {why}: name a column with --reference, or state the amplitude of the new "
            "one with --rms VALUE, small at first"
        )
    unknown = np.full(omega.size, np.nan, dtype=np.complex128)
    to_command = unknown
    if command_response is not None:
        to_command = _at(command_response, omega)
    to_motion = unknown
    if motion_response is not None:
        to_motion = _at(motion_response, omega)

    # Amplitudes over the lines: each line takes its share of both limits. Then phases.
    shape = np.ones(omega.size)
    if is_told:
        command_share = np.abs(to_command) / command_limit
        motion_share = np.abs(to_motion) / motion_limit
        shape = 1 / (command_share + motion_share)
    rng = np.random.default_rng(seed)
    draws = [_drawn(plan, lines, shape, to_command, rng) for _ in range(plan.realisations)]
    spectra = np.stack(draws)

    # One period of reference, command and motion, of each realisation at a size of 1.
    unit = _signal(plan, lines, spectra)
    command = _signal(plan, lines, to_command * spectra)
    motion_signal = _signal(plan, lines, to_motion * spectra)
    command_peaks = np.max(np.abs(command), axis=-1)
    motion_peaks = np.max(np.abs(motion_signal), axis=-1)

    # Size: as stated, or up to the first limit.
    unit_rms = float(np.sqrt(np.mean(unit**2)))
    if rms is not None:
        scale = rms / unit_rms
    else:
        command_used = float(np.max(command_peaks)) / command_limit
        motion_used = float(np.max(motion_peaks)) / motion_limit
        scale = 1 / max(command_used, motion_used)
    levels = scale * np.array(_LEVELS)[:, None]

    # The lead-in rises from rest within its first half.
    ramp = np.ones(plan.n_samples)
    half = max(plan.lead_in_samples // 2, 1)
    ramp[:half] = 0.5 - 0.5 * np.cos(np.pi * np.arange(half) / half)
    # The lead-in is the end of a period, so that the first whole one follows without a jump.
    last_sample = plan.periods * plan.period_samples
    at = np.arange(-plan.lead_in_samples, last_sample) % plan.period_samples

    # What the logs tell: dry friction that hides small commands, and the lines where the loop is known.
    motion = look.motion
    friction = 0.0
    if motion is not None and motion.friction.shown:
        friction = abs(motion.friction.value)
    told_omega = np.zeros(1)
    if command_response is not None:
        told_omega = command_response.omega_rad_s
    is_above_lowest = omega >= told_omega[0]
    is_below_highest = omega <= told_omega[-1]
    is_inside = is_above_lowest & is_below_highest

    # Around the operating point of the logs.
    offsets = []
    for record in records:
        followed = record.output
        if record.reference is not None:
            followed = record.reference
        offsets.append(float(np.mean(followed)))
    command_rms = np.sqrt(np.mean(command**2, axis=-1))
    return PlannedReference(
        plan=plan,
        dt_s=dt_s,
        seed=seed,
        lines_Hz=omega / (2 * np.pi),
        references=levels[..., None] * unit[:, at] * ramp,
        offset=float(np.median(offsets)),
        rms=levels[:, 0] * unit_rms,
        command_peak=levels * command_peaks,
        command_rms=levels * command_rms,
        motion_peak=levels * motion_peaks,
        largest_command=command_limit,
        largest_motion=motion_limit,
        friction=friction,
        told=float(np.mean(is_inside)),
    )


def _band_of(look: FirstLook, dt_s: float) -> tuple[float, float]:
    """Two decades up to the highest frequency [Hz] that the records tell, to two digits."""
    # A twentieth of the sampling rate where they tell none: ten samples and more in each half period.
    highest_Hz = 0.05 / dt_s
    if look.told_rad_s:
        highest_Hz = look.told_rad_s[1] / (2 * np.pi)
    lowest_Hz = highest_Hz / _HIGHEST_OVER_LOWEST
    # Near the Nyquist frequency a held reference falls off.
    highest_Hz = min(highest_Hz, 0.4 / dt_s)
    return float(f"{lowest_Hz:.2g}"), float(f"{highest_Hz:.2g}")


def _signal(plan: ExperimentPlan, lines: IntArray, amplitudes: ComplexArray) -> RealArray:
    """One period (..., N) of complex amplitudes (..., H) at its lines."""
    frequencies = plan.period_samples // 2 + 1
    spectrum = np.zeros((*amplitudes.shape[:-1], frequencies), dtype=np.complex128)
    spectrum[..., lines] = amplitudes
    return np.asarray(np.fft.irfft(spectrum, plan.period_samples, axis=-1))


def _drawn(
    plan: ExperimentPlan,
    lines: IntArray,
    shape: RealArray,
    to_command: ComplexArray,
    rng: np.random.Generator,
) -> ComplexArray:
    """Amplitudes (H,) with random phases: of the draws the one whose command, or reference, peaks least."""
    # Where the command is not known, the reference itself is to have small peaks.
    gain = to_command
    if np.isnan(to_command).any():
        gain = np.ones(lines.size, dtype=np.complex128)
    turns = rng.random((plan.phase_draws, lines.size))
    draws = shape * np.exp(2j * np.pi * turns)
    signals = [_signal(plan, lines, gain * draw) for draw in draws]
    crests = [np.max(np.abs(signal)) / np.std(signal) for signal in signals]
    return np.asarray(draws[int(np.argmin(crests))])


def _at(response: FrequencyUncertainty, omega_rad_s: RealArray) -> ComplexArray:
    """The told response at other frequencies (H,): magnitude and phase between neighbours, larger outside."""
    known = response.omega_rad_s
    log_size = np.log(np.abs(response.centre))
    size = np.exp(np.interp(omega_rad_s, known, log_size))
    is_below = omega_rad_s < known[0]
    is_above = omega_rad_s > known[-1]
    size[is_below | is_above] *= _UNTOLD
    known_phase = np.unwrap(np.angle(response.centre))
    phase = np.interp(omega_rad_s, known, known_phase)
    return np.asarray(size * np.exp(1j * phase))
