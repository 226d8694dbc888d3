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
from workflow.tasks.first_look import first_look, from_reference, told_response

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
        highest = look.told_rad_s[1] / (2 * np.pi) if look.told_rad_s else 0.05 / dt_s
        band_Hz = float(f"{highest / _HIGHEST_OVER_LOWEST:.2g}"), float(f"{min(highest, 0.4 / dt_s):.2g}")
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
        return max(float(np.max(np.abs(signal - signal.mean()))) for signal in signals)

    command_limit = largest_command or share * largest_deviation([record.input for record in records])
    motion_limit = largest_motion or largest_deviation([record.output for record in records])

    # How the loop answers a reference, with its command and its motion.
    omega = np.asarray(2 * np.pi * lines / (plan.period_samples * dt_s), dtype=np.float64)
    known = all(record.reference is not None for record in records)
    command_response = told_response(from_reference(records, "input")) if known else None
    motion_response = told_response(from_reference(records, "output")) if known else None
    is_told = command_response is not None and motion_response is not None
    if not is_told and rms is None:
        why = "the logs do not tell how the loop answers" if known else "no reference is recorded"
        raise InputError(
            f"{records[0].label}: {why}: name a column with --reference, or state the amplitude of the new "
            "one with --rms VALUE, small at first"
        )
    unknown = np.full(omega.size, np.nan, dtype=np.complex128)
    to_command = unknown if command_response is None else _at(command_response, omega)
    to_motion = unknown if motion_response is None else _at(motion_response, omega)

    # Amplitudes over the lines: each line takes its share of both limits. Then phases.
    shape = np.ones(omega.size)
    if is_told:
        shape = 1 / (np.abs(to_command) / command_limit + np.abs(to_motion) / motion_limit)
    rng = np.random.default_rng(seed)
    spectra = np.stack([_drawn(plan, lines, shape, to_command, rng) for _ in range(plan.realisations)])

    def peaks(gain: ComplexArray | RealArray) -> RealArray:
        return np.asarray(np.max(np.abs(_signal(plan, lines, gain * spectra)), axis=-1))

    # Size: as stated, or up to the first limit.
    unit = _signal(plan, lines, spectra)
    if rms is not None:
        scale = rms / float(np.sqrt(np.mean(unit**2)))
    else:
        scale = 1 / max(
            float(np.max(peaks(to_command))) / command_limit, float(np.max(peaks(to_motion))) / motion_limit
        )
    levels = scale * np.array(_LEVELS)[:, None]

    # The lead-in rises from rest within its first half.
    ramp = np.ones(plan.n_samples)
    half = max(plan.lead_in_samples // 2, 1)
    ramp[:half] = 0.5 - 0.5 * np.cos(np.pi * np.arange(half) / half)
    at = np.arange(-plan.lead_in_samples, plan.periods * plan.period_samples) % plan.period_samples
    motion = look.motion
    friction = abs(motion.friction.value) if motion is not None and motion.friction.shown else 0.0
    told_omega = np.zeros(1) if command_response is None else command_response.omega_rad_s
    is_inside = (omega >= told_omega[0]) & (omega <= told_omega[-1])
    offsets = []
    for record in records:
        followed = record.output if record.reference is None else record.reference
        offsets.append(float(np.mean(followed)))
    command = _signal(plan, lines, to_command * spectra)
    return PlannedReference(
        plan=plan,
        dt_s=dt_s,
        seed=seed,
        lines_Hz=omega / (2 * np.pi),
        references=levels[..., None] * unit[:, at] * ramp,
        offset=float(np.median(offsets)),
        rms=levels[:, 0] * float(np.sqrt(np.mean(unit**2))),
        command_peak=levels * peaks(to_command),
        command_rms=levels * np.sqrt(np.mean(command**2, axis=-1)),
        motion_peak=levels * peaks(to_motion),
        largest_command=command_limit,
        largest_motion=motion_limit,
        friction=friction,
        told=float(np.mean(is_inside)),
    )


def _signal(plan: ExperimentPlan, lines: IntArray, amplitudes: ComplexArray) -> RealArray:
    """One period (..., N) of complex amplitudes (..., H) at its lines."""
    spectrum = np.zeros((*amplitudes.shape[:-1], plan.period_samples // 2 + 1), dtype=np.complex128)
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
    gain = np.ones(lines.size) if np.isnan(to_command).any() else to_command
    draws = shape * np.exp(2j * np.pi * rng.random((plan.phase_draws, lines.size)))
    signals = [_signal(plan, lines, gain * draw) for draw in draws]
    crests = [np.max(np.abs(signal)) / np.std(signal) for signal in signals]
    return np.asarray(draws[int(np.argmin(crests))])


def _at(response: FrequencyUncertainty, omega_rad_s: RealArray) -> ComplexArray:
    """The told response at other frequencies (H,): magnitude and phase between neighbours, larger outside."""
    known = response.omega_rad_s
    size = np.exp(np.interp(omega_rad_s, known, np.log(np.abs(response.centre))))
    is_outside = (omega_rad_s < known[0]) | (omega_rad_s > known[-1])
    size[is_outside] *= _UNTOLD
    phase = np.interp(omega_rad_s, known, np.unwrap(np.angle(response.centre)))
    return np.asarray(size * np.exp(1j * phase))
