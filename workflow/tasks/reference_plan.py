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

_LEVELS = (1.0, 0.5)  # shares of the largest: what differs between them is not linear
# Beyond what the logs tell, the loop is taken to answer so many times as much as at the last line they tell.
_UNTOLD = 2.0
# Where no band is stated: from this part of the highest frequency that is told, and so many periods of the
# lowest in all records together.
_DECADES, _PERIODS = 100.0, 60.0
# Command that dry friction leaves recognisable: rms over its level.
_ABOVE_FRICTION = 3.0


@dataclass(frozen=True, eq=False)
class PlannedReference:
    """references (A, M, T) over amplitudes, realisations and samples, about `offset`; each with the largest
    command and motion (A, M) to expect of the steady state, and the rms of the command. Both in the units of
    the logs, without the operating point. friction: level in the logs, 0 where none shows. told: share of the
    lines at which the logs tell the loop; without a recorded reference commands and motions are nan."""

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

    records: SISO, of the loop as it is. largest_command, largest_motion: allowed, from the operating point;
    those of the records where left out, of the command a share of it. band_Hz: where left out two decades
    up to the highest frequency that the records tell; duration_s: what that needs. rms: of the reference,
    asked for where the records have none. settings: fields of the plan by name. Raises InputError where there
    is no plan.
    """
    dt_s, look = records[0].dt_s, first_look(records, position=position)
    if band_Hz is None:
        highest = look.told_rad_s[1] / (2 * np.pi) if look.told_rad_s else 0.05 / dt_s
        band_Hz = float(f"{highest / _DECADES:.2g}"), float(f"{min(highest, 0.4 / dt_s):.2g}")
    duration_s = duration_s or _PERIODS / band_Hz[0]
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
    deviations = [
        max(float(np.max(np.abs(signal - signal.mean()))) for signal in signals)
        for signals in ([one.input for one in records], [one.output for one in records])
    ]
    command_limit = largest_command or share * deviations[0]
    motion_limit = largest_motion or deviations[1]
    omega = np.asarray(2 * np.pi * lines / (plan.period_samples * dt_s), dtype=np.float64)
    known = all(record.reference is not None for record in records)
    answers = [told_response(from_reference(records, of)) if known else None for of in ("input", "output")]
    if (answers[0] is None or answers[1] is None) and rms is None:
        why = "the logs do not tell how the loop answers" if known else "no reference is recorded"
        raise InputError(
            f"{records[0].label}: {why}: name a column with --reference, or state the amplitude of the new "
            "one with --rms VALUE, small at first"
        )
    to_command, to_motion = (
        np.full(omega.size, np.nan) if one is None else _at(one, omega) for one in answers
    )
    if None in answers:
        shape = np.ones(omega.size)
    else:
        shape = 1 / (np.abs(to_command) / command_limit + np.abs(to_motion) / motion_limit)
    rng = np.random.default_rng(seed)
    spectra = np.stack([_drawn(plan, lines, shape, to_command, rng) for _ in range(plan.realisations)])

    def peaks(gain: ComplexArray | RealArray) -> RealArray:
        return np.asarray(np.max(np.abs(_signal(plan, lines, gain * spectra)), axis=-1))

    unit = _signal(plan, lines, spectra)
    if rms is not None:
        scale = rms / float(np.sqrt(np.mean(unit**2)))
    else:
        scale = 1 / max(
            float(np.max(peaks(to_command))) / command_limit, float(np.max(peaks(to_motion))) / motion_limit
        )
    levels = scale * np.array(_LEVELS)[:, None]
    ramp = np.ones(plan.n_samples)
    half = max(plan.lead_in_samples // 2, 1)
    ramp[:half] = 0.5 - 0.5 * np.cos(np.pi * np.arange(half) / half)
    at = np.arange(-plan.lead_in_samples, plan.periods * plan.period_samples) % plan.period_samples
    motion = look.motion
    friction = abs(motion.friction.value) if motion is not None and motion.friction.shown else 0.0
    told = np.zeros(1) if answers[0] is None else answers[0].omega_rad_s
    offsets = [float(np.mean(one.reference if one.reference is not None else one.output)) for one in records]
    return PlannedReference(
        plan,
        dt_s,
        seed,
        omega / (2 * np.pi),
        levels[..., None] * unit[:, at] * ramp,
        float(np.median(offsets)),
        levels[:, 0] * float(np.sqrt(np.mean(unit**2))),
        levels * peaks(to_command),
        levels * np.sqrt(np.mean(_signal(plan, lines, to_command * spectra) ** 2, axis=-1)),
        levels * peaks(to_motion),
        command_limit,
        motion_limit,
        friction,
        float(np.mean((omega >= told[0]) & (omega <= told[-1]))),
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
    return np.asarray(draws[int(np.argmin([np.max(np.abs(one)) / np.std(one) for one in signals]))])


def _at(response: FrequencyUncertainty, omega_rad_s: RealArray) -> ComplexArray:
    """The told response at other frequencies (H,): magnitude and phase between neighbours, larger outside."""
    known = response.omega_rad_s
    size = np.exp(np.interp(omega_rad_s, known, np.log(np.abs(response.centre))))
    size[(omega_rad_s < known[0]) | (omega_rad_s > known[-1])] *= _UNTOLD
    phase = np.interp(omega_rad_s, known, np.unwrap(np.angle(response.centre)))
    return np.asarray(size * np.exp(1j * phase))
