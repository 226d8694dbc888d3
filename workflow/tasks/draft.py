"""A configuration drafted from logs: what is written, and the evidence for each line of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

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

# Of the first mode or notch, or of the highest frequency that the logs tell: the bandwidth that is asked for,
# and the one that is asked for at least.
_PART, _LEAST_PART = 3, 100
_ORDER = 5  # of the controller: integrator, roll-off and a notch, with one state to spare
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
    """look: at the records that are fitted. split_sample: of one log that is split, else None. limit: as
    stated, or at which commands stand in the logs (`clipped`) or were cut after they were logged (`unseen`),
    else the largest command. in_loop: a reference was recorded, or the command follows the position. step: of
    the output's quantisation, 0 without one. specification: keys of [specification]. reference_step: half the
    rms motion, or, beside an unstable pole, what the effort limit answers with the largest command.
    timing: of the command between two rows. recorded_rad_s: bandwidth of the loop that made the logs, 0 where
    they do not tell it. held_rad_s: above it a sensor that holds its readings tells no mode, 0 where none
    does."""

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
    """Of SISO records of one sampling time, of which the last validates; of one the last part, where that is
    honest. limit: of the amplifier; controller_period_s, command_averaged: of the controller that made the
    logs (`timing_of`), as far as they are known. Raises ValueError, one line, where the logs of a loop excite
    few frequencies, or contradict the period."""
    fitted = list(records[:-1]) or list(records)
    in_loop = all(record.reference is not None for record in fitted) or recorded_in_loop(fitted)
    if in_loop:
        refuse_few_lines(fitted)
    timing = timing_of(
        records, in_loop=in_loop, stated_period_s=controller_period_s, averaged=command_averaged
    )
    look = first_look(fitted, position=position)
    highest = max(float(np.max(np.abs(record.input))) for record in records)
    at_limit, unseen = _limit(records), None
    if limit is None and at_limit is None:
        unseen = unseen_limit(look, position=position)
    if unseen is not None:
        # As on a data sheet: with as few digits as the logs allow.
        rounded = [float(f"{unseen:.{digits}g}") for digits in (1, 2, 3)]
        unseen = next((value for value in rounded if abs(value / unseen - 1) < _SAME_DIGITS), unseen)
        look = first_look([record.limited(unseen) for record in fitted], position=position)
    reached = limit or at_limit or unseen or highest
    spread = _moved(fitted, look)
    # A step of half the spread may ask for the largest command.
    effort = reached / (0.5 * spread) if spread > 0 else 1.0
    unstable = _unstable_per_s(look)
    return Draft(
        look,
        position,
        in_loop,
        split_sample(records[0]) if len(records) == 1 else None,
        reached,
        at_limit is not None,
        unseen is not None,
        grid_step([record.output[:, 0] for record in records], np.finfo(np.float64).tiny),
        _specification(look, timing, effort, reached, unstable),
        _rounded(reached / effort if unstable or not spread > 0 else 0.5 * spread),
        unstable,
        timing,
        held_rad_s=min((float(held.values["from_rad_s"]) for held in held_readings(fitted)), default=0.0),
    )


def informed(draft: Draft, found: IdentifiedChannel, spread: UncertainChannel) -> Draft:
    """The same with the specification that follows from the model that came out of the logs: its first mode
    that swings and whose damping is told, its first notch, the band that its ellipses tell."""
    look, model, omega = draft.look, found.model, spread.frequency.omega_rad_s
    effort = 0.0
    recorded = 0.0
    law = draft.timing.law
    if law is not None and law.on_error is not None:
        # Largest |K S| of the recorded loop on the model, and where its |S| rises to -3 dB.
        numerator, denominator = law.on_error
        z = np.exp(1j * omega * law.dt_s)
        k = np.polyval(numerator, z) / np.polyval(denominator, z)
        sensitivity = 1 / np.abs(1 + k * model.frequency_response(omega))
        effort = float(np.max(np.abs(k) * sensitivity))
        recorded = float(omega[np.argmax(sensitivity > np.sqrt(0.5))])
    size = np.abs(spread.frequency.centre)
    known = omega[np.trace(spread.frequency.covariance, axis1=1, axis2=2) < (TOLD * size) ** 2]
    if look.told_rad_s is None or not known.size:
        return draft
    band = min(look.told_rad_s[0], float(known[0])), float(known[-1])
    intervals = [None] * len(found.modes) if spread.intervals is None else spread.intervals.modes
    modes = [
        (mode.omega_rad_s, mode.damping)
        for mode, interval in zip(found.modes, intervals, strict=True)
        if interval is not None and interval.told
        if found.is_mode(mode) and mode.damping < LIGHT
    ]
    notch = next((float(zero) for zero in notches(model) if band[0] < zero < band[1]), None)
    look = replace(look, told_rad_s=band, mode=min(modes, default=None), notch=notch)
    unstable = max((growth for growth, _ in found.unstable_poles), default=0.0)
    return replace(
        draft,
        look=look,
        specification=_specification(
            look,
            draft.timing,
            max(draft.specification["effort_limit"], effort),
            draft.limit,
            unstable,
            recorded,
        ),
        unstable_per_s=unstable,
        recorded_rad_s=recorded,
    )


def _moved(records: Sequence[Record], look: FirstLook) -> float:
    """Rms of the output in the band that the logs tell: an integrating machine in open loop walks away."""
    signals = [record.output[:, 0] for record in records]
    if look.told_rad_s is None:
        return rms_of(signals)
    high = butter(2, look.told_rad_s[0] * records[0].dt_s / np.pi, "highpass", output="sos")
    return rms_of([np.asarray(sosfiltfilt(high, signal - signal.mean())) for signal in signals])


def _limit(records: Sequence[Record]) -> float | None:
    """Where commands of both signs stand, the same for both; None where they stand nowhere."""
    clipped = [record.input[:, 0] for record in records if clipped_share(record.input[:, 0]) > 0]
    if not clipped:
        return None
    low, high = min(float(u.min()) for u in clipped), max(float(u.max()) for u in clipped)
    return high if abs(high + low) <= _SAME_LIMIT * high else None


def _unstable_per_s(look: FirstLook) -> float:
    """The pole of the rigid motion that a weight throws over, 0 where there is none."""
    motion = look.motion
    if motion is None or not motion.sprung or motion.stiffness is None or motion.stiffness.value >= 0:
        return 0.0
    return float(max(np.roots([motion.inertia.value, motion.viscous.value, motion.stiffness.value]).real))


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
    highest = look.told_rad_s[1] if look.told_rad_s else 0.05 * np.pi / dt_s
    base = look.mode[0] if look.mode else look.notch or highest
    bandwidth = max(base / _PART, _BEYOND_UNSTABLE * unstable, recorded)
    # The rows hold all of the delay from a command to the motion, and this loop waits for nothing else.
    at_once = {"computational_delay_samples": 0} if timing.acts_at_once else {}
    band = {
        "mode_peak_ratio": 1.0,
        "highest_mode_peak_ratio": _PEAK_GIVES_WAY,
        "mode_band_rad_s": [_rounded(base / 1.5), _rounded(min(1.5 * base, 0.95 * np.pi / dt_s))],
    }
    return {
        "bandwidth_rad_s": _rounded(bandwidth),
        # Below an unstable pole, too: the loop has to cross above it, tracking need not reach so far.
        "lowest_bandwidth_rad_s": _rounded(min(base / _LEAST_PART, recorded or np.inf)),
        "modulus_margin": 0.5,
        "effort_limit": _rounded(effort),
        "highest_effort_limit": _rounded(_EFFORT_GIVES_WAY * _rounded(effort)),
        # Above what the logs tell the command falls off.
        "effort_rolloff_rad_s": _rounded(min(max(highest, _PART * bandwidth), 0.5 * np.pi / dt_s)),
        **(band if look.mode else {}),
        "controller_damping": 0.3,
        "integrator": True,
        "input_limit": limit,
        "controller_order": _ORDER,
        **at_once,
    }
