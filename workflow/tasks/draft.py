"""A configuration drafted from logs: what is written, and the evidence for each line of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diagnosis.machine.quantisation_grid import grid_step
from ident.checks.early_checks import held_readings, refuse_few_lines
from ident.checks.plausible_modes import LIGHT
from ident.command_timing import CommandTiming, timing_of
from ident.data.arrays import clipped_share
from ident.data.record import Record
from ident.friction import recorded_in_loop
from workflow.tasks.early_refusals import split_sample
from workflow.tasks.first_look import (
    TOLD,
    FirstLook,
    first_look,
    notches,
    unseen_limit,
)
from workflow.tasks.loop_sensitivity import rms_of
from workflow.tasks.results import IdentifiedChannel, UncertainChannel

# First mode or notch (or the highest frequency that the logs tell) over the bandwidth that is asked for.
# Chosen; doubled, the draft asks for half the bandwidth. The command is to fall off as many times above it.
_MODE_OVER_BANDWIDTH = 3
# First mode or notch over the lowest bandwidth that is asked for. Chosen; only a loop below it is a miss.
_MODE_OVER_LOWEST_BANDWIDTH = 100
# Order of the controller: integrator, roll-off and a notch, with one state to spare.
_ORDER = 5
# How far a drafted effort limit gives way where it cannot be met, as a factor: it is what the recorded
# command allows a step of half the motion's spread, at four times of it (12 dB) a step of an eighth stays
# within the command's limit. Chosen; doubled, a machine that misses it is certified for smaller steps.
_EFFORT_GIVES_WAY = 4.0
# How far the drafted peak of a mode gives way, as a factor: at twice of it (6 dB) the loop takes no more than
# about half of the mode's damping. Chosen; doubled, three quarters.
_PEAK_GIVES_WAY = 2.0
# An unstable pole has to be left behind by the bandwidth, by this factor.
_BEYOND_UNSTABLE = 2.5
# Both ends of the command stand at one limit within this.
_SAME_LIMIT = 1e-3
# A limit that the motion shows is known to this share.
_SAME_DIGITS = 5e-3


@dataclass(frozen=True)
class Draft:
    """What a configuration file is drafted from.

    Attributes
    ----------
    look : FirstLook
        At the records that are fitted.
    position : bool
        Whether the output is a position.
    in_loop : bool
        A reference was recorded, or the command follows the position.
    split_sample : int or None
        First sample that validates of one log that is split; None for several logs.
    limit : float
        Of the command, in its unit: as stated, or at which commands stand in the logs (`clipped`) or were cut
        after they were logged (`unseen`), else the largest command.
    clipped, unseen : bool
        Where the limit comes from.
    step : float
        Of the output's quantisation, 0 without one.
    specification : mapping of str to value
        Keys of [specification].
    reference_step : float
        Half the rms motion, or, beside an unstable pole, the step that the effort limit answers with the
        largest command; in units of the output.
    unstable_per_s : float
        Growth rate of the pole of an arm that its weight throws over [1/s], 0 without one.
    timing : CommandTiming
        Of the command between two rows.
    recorded_rad_s : float
        Bandwidth of the loop that made the logs [rad/s], 0 where they do not tell it.
    held_rad_s : float
        Above it a sensor that holds its readings tells no mode [rad/s]; 0 where none does.
    """

    look: FirstLook
    position: bool
    in_loop: bool
    split_sample: int | None
    limit: float
    clipped: bool
    unseen: bool
    step: float
    specification: Mapping[str, Any]
    reference_step: float
    unstable_per_s: float
    timing: CommandTiming
    recorded_rad_s: float = 0.0
    held_rad_s: float = 0.0

    @property
    def friction(self) -> bool:
        """Dry friction shows, at a shaft whose position is measured."""
        motion = self.look.motion
        return self.position and motion is not None and motion.friction.shown and motion.friction.value > 0


def draft_of(
    records: Sequence[Record],
    *,
    position: bool,
    limit: float | None = None,
    controller_period_s: float | None = None,
    command_averaged: bool = False,
) -> Draft:
    """The draft of a configuration for these logs.

    Parameters
    ----------
    records : sequence of Record
        One input, one output, one sampling time. The last one validates; of a single one its last part, where
        that moves as the first (`split_sample`).
    position : bool
        Whether the output is a position.
    limit : float, optional
        Of the amplifier, in units of the input.
    controller_period_s : float, optional
        Of the controller that made the logs [s], where it is known.
    command_averaged : bool
        Each row has the mean of the command since the row before.

    Returns
    -------
    Draft

    Raises
    ------
    ValueError
        One line: the logs of a loop excite few frequencies, or contradict the period.
    """
    fitted = list(records[:-1]) or list(records)
    in_loop = all(record.reference is not None for record in fitted) or recorded_in_loop(fitted)
    if in_loop:
        refuse_few_lines(fitted)
    timing = timing_of(
        records, in_loop=in_loop, stated_period_s=controller_period_s, averaged=command_averaged
    )

    # The command's limit: as stated, where commands stand, or where the motion shows that they were cut.
    look = first_look(fitted, position=position)
    largest_commands = [np.max(np.abs(record.input)) for record in records]
    highest = max(map(float, largest_commands))
    at_limit = _limit(records)
    cut_limit = None
    if limit is None and at_limit is None:
        cut_limit = unseen_limit(look, position=position)
    if cut_limit is not None:
        # As on a data sheet: with as few digits as the logs allow.
        rounded = [float(f"{cut_limit:.{digits}g}") for digits in (1, 2, 3)]
        close_enough = [value for value in rounded if abs(value / cut_limit - 1) < _SAME_DIGITS]
        if close_enough:
            cut_limit = close_enough[0]
        look = first_look([record.limited(cut_limit) for record in fitted], position=position)
    reached = limit or at_limit or cut_limit or highest

    # Sizes of the drafted requirements.
    spread = _moved(fitted, look)
    # A step of half the spread may ask for the largest command.
    effort = reached / (0.5 * spread) if spread > 0 else 1.0
    unstable = _unstable_per_s(look)
    reference_step = 0.5 * spread
    if unstable or not spread > 0:
        reference_step = reached / effort
    # The finest grid of readings is what the sensor counts in; 0 where there is none.
    step = grid_step([record.output[:, 0] for record in records], np.finfo(np.float64).tiny)
    held_from_rad_s = [float(held.values["from_rad_s"]) for held in held_readings(fitted)]
    return Draft(
        look=look,
        position=position,
        in_loop=in_loop,
        split_sample=split_sample(records[0]) if len(records) == 1 else None,
        limit=reached,
        clipped=at_limit is not None,
        unseen=cut_limit is not None,
        step=step,
        specification=_specification(look, timing, effort, reached, unstable),
        reference_step=_rounded(reference_step),
        unstable_per_s=unstable,
        timing=timing,
        held_rad_s=min(held_from_rad_s, default=0.0),
    )


def informed(draft: Draft, channel: IdentifiedChannel, uncertain: UncertainChannel) -> Draft:
    """The draft with a specification that follows from the model that was identified.

    Parameters
    ----------
    draft : Draft
        From the logs alone.
    channel : IdentifiedChannel
        Its first mode that swings and whose damping the records tell, and its first notch, set the bandwidth.
    uncertain : UncertainChannel
        The band in which its ellipses are small takes the place of that of the first look.

    Returns
    -------
    Draft
        Unchanged where no response is told.
    """
    look = draft.look
    model = channel.model
    omega = uncertain.frequency.omega_rad_s
    effort = 0.0
    recorded = 0.0
    law = draft.timing.law
    if law is not None and law.on_error is not None:
        # The new loop is to be no slower than the recorded one: largest |K S| of that on the model, and where
        # its |S| rises to -3 dB.
        numerator, denominator = law.on_error
        z = np.exp(1j * omega * law.dt_s)
        k = np.polyval(numerator, z) / np.polyval(denominator, z)
        sensitivity = 1 / np.abs(1 + k * model.frequency_response(omega))
        effort = float(np.max(np.abs(k) * sensitivity))
        recorded = float(omega[np.argmax(sensitivity > np.sqrt(0.5))])
    # The band that is told: where the ellipses are small beside the response.
    size = np.abs(uncertain.frequency.centre)
    variance = np.trace(uncertain.frequency.covariance, axis1=1, axis2=2)
    is_told = variance < (TOLD * size) ** 2
    known = omega[is_told]
    if look.told_rad_s is None or not known.size:
        return draft
    lowest_told_rad_s = min(look.told_rad_s[0], float(known[0]))
    band = lowest_told_rad_s, float(known[-1])
    intervals = [None] * len(channel.modes) if uncertain.intervals is None else uncertain.intervals.modes
    modes = []
    for mode, interval in zip(channel.modes, intervals, strict=True):
        damping_is_known = interval is not None and interval.told
        if damping_is_known and channel.is_mode(mode) and mode.damping < LIGHT:
            modes.append((mode.omega_rad_s, mode.damping))
    in_band = [float(zero) for zero in notches(model) if band[0] < zero < band[1]]
    notch = in_band[0] if in_band else None
    look = replace(look, told_rad_s=band, mode=min(modes, default=None), notch=notch)
    unstable = max((growth for growth, _ in channel.unstable_poles), default=0.0)
    # The first draft was made without a model: it is not to become stricter by having one.
    largest_effort = max(draft.specification["effort_limit"], effort)
    specification = _specification(look, draft.timing, largest_effort, draft.limit, unstable, recorded)
    return replace(
        draft,
        look=look,
        specification=specification,
        unstable_per_s=unstable,
        recorded_rad_s=recorded,
    )


def _moved(records: Sequence[Record], look: FirstLook) -> float:
    """Rms of the output in the band that the logs tell: an integrating machine in open loop walks away."""
    # Imported here: it takes its time to load.
    from scipy.signal import butter, sosfiltfilt

    signals = [record.output[:, 0] for record in records]
    if look.told_rad_s is None:
        return rms_of(signals)
    # Slower than what the logs tell is drift. Both ways, so that nothing is delayed.
    corner = look.told_rad_s[0] * records[0].dt_s / np.pi
    high = butter(2, corner, "highpass", output="sos")
    moved = [sosfiltfilt(high, signal - signal.mean()) for signal in signals]
    return rms_of([np.asarray(signal) for signal in moved])


def _limit(records: Sequence[Record]) -> float | None:
    """The value at which commands of both signs stand, as far from zero; None where they stand nowhere."""
    clipped = [record.input[:, 0] for record in records if clipped_share(record.input[:, 0]) > 0]
    if not clipped:
        return None
    low = min(float(command.min()) for command in clipped)
    high = max(float(command.max()) for command in clipped)
    return high if abs(high + low) <= _SAME_LIMIT * high else None


def _unstable_per_s(look: FirstLook) -> float:
    """Growth rate [1/s] of the rigid motion that a weight throws over, 0 where there is none."""
    motion = look.motion
    if motion is None or not motion.sprung or motion.stiffness is None or motion.stiffness.value >= 0:
        return 0.0
    polynomial = [motion.inertia.value, motion.viscous.value, motion.stiffness.value]
    return float(max(np.roots(polynomial).real))


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")


def _specification(
    look: FirstLook,
    timing: CommandTiming,
    effort: float,
    limit: float,
    unstable: float,
    recorded: float = 0.0,
) -> dict[str, Any]:
    """Requirements that leave the bandwidth to what the identified arm allows; no less is asked for than the
    recorded loop had."""
    dt_s = look.records[0].dt_s * timing.rows_per_command
    # Without a known band: a twentieth of the Nyquist frequency, where sampling costs hardly any phase.
    highest = look.told_rad_s[1] if look.told_rad_s else 0.05 * np.pi / dt_s
    # What the bandwidth stays below: the first mode, else the first notch, else what the logs tell.
    base = look.mode[0] if look.mode else look.notch or highest
    bandwidth = max(base / _MODE_OVER_BANDWIDTH, _BEYOND_UNSTABLE * unstable, recorded)
    # The rows hold all of the delay from a command to the motion, and this loop waits for nothing else.
    at_once = {"computational_delay_samples": 0} if timing.acts_at_once else {}
    peak_of_mode: dict[str, Any] = {}
    if look.mode:
        highest_of_band = min(1.5 * base, 0.95 * np.pi / dt_s)
        peak_of_mode = {
            "mode_peak_ratio": 1.0,
            "highest_mode_peak_ratio": _PEAK_GIVES_WAY,
            "mode_band_rad_s": [_rounded(base / 1.5), _rounded(highest_of_band)],
        }
    lowest_bandwidth = min(base / _MODE_OVER_LOWEST_BANDWIDTH, recorded or np.inf)
    effort_limit = _rounded(effort)
    # The sampling rate leaves no room above half of the Nyquist frequency.
    rolloff = min(max(highest, _MODE_OVER_BANDWIDTH * bandwidth), 0.5 * np.pi / dt_s)
    return {
        "bandwidth_rad_s": _rounded(bandwidth),
        # Below an unstable pole, too: the loop has to cross above it, tracking need not reach so far.
        "lowest_bandwidth_rad_s": _rounded(lowest_bandwidth),
        "modulus_margin": 0.5,
        "effort_limit": effort_limit,
        "highest_effort_limit": _rounded(_EFFORT_GIVES_WAY * effort_limit),
        # Above what the logs tell the command falls off.
        "effort_rolloff_rad_s": _rounded(rolloff),
        **peak_of_mode,
        "controller_damping": 0.3,
        "integrator": True,
        "input_limit": limit,
        "controller_order": _ORDER,
        **at_once,
    }
