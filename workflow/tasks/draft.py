"""A configuration drafted from logs: what is written, and the evidence for each line of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification, SpecificationError
from control_design.synthesis.synthesis import synthesise
from control_design.synthesis.synthesis_options import SynthesisOptions
from diagnosis.machine.quantisation_grid import grid_step
from ident.checks.input_checks import clipped_share
from ident.data.record import Record
from workflow.tasks.first_look import FirstLook, first_look, from_reference, told_response
from workflow.tasks.loop_sensitivity import rms_of

# Bandwidths that are tried, as parts of the first mode, or of the highest frequency that the logs tell.
_PARTS = (3, 4, 6, 9, 14, 20)
# The quick model carries no ellipses: a design for it keeps so much clear of its specification.
_CLEAR = 0.85
_SEARCH = SynthesisOptions(
    starts=1,
    sufficient_gamma=_CLEAR,
    exchange_rounds=0,
    iterations=50,
    grid_points=60,
    mode_points=30,
    dense_points=1500,
)
_ORDER = 5
# An unstable pole has to be left behind by the bandwidth, by this factor.
_BEYOND_UNSTABLE = 2.5
# Of one log the last part validates, where that leaves so many samples and the parts are driven alike within
# a factor of two.
_FITTED, _FEWEST = 0.7, 1000
# Gain of the controller, beside that of the recorded loop; it falls off so far beyond the bandwidth.
_MORE, _ROLL_OFF = 3.0, 10.0
# Both ends of the command stand at one limit within this.
_SAME_LIMIT = 1e-3


@dataclass(frozen=True)
class Draft:
    """look: at the records that are fitted. fitted, validates: samples of one log that is split, else None.
    limit: at which commands stand in the logs, else the largest command, and whether it was `clipped`.
    step: of the output's quantisation, 0 without one. specification: keys of [specification]. part: of the
    first mode (or of the highest frequency told) that the bandwidth is, 0 where an unstable pole sets it;
    gamma: of the design that the quick model allows, None where none was found or tried."""

    look: FirstLook
    position: bool
    split_sample: int | None
    limit: float
    clipped: bool
    step: float
    specification: Mapping[str, Any]
    part: int
    gamma: float | None
    unstable_per_s: float

    @property
    def reference_step(self) -> float:
        """What the effort limit answers with the largest command."""
        return _rounded(self.limit / self.specification["effort_limit"])

    @property
    def friction(self) -> bool:
        """Dry friction shows, at a shaft whose position is measured."""
        motion = self.look.motion
        return self.position and motion is not None and motion.friction.shown and motion.friction.value > 0


def draft_of(records: Sequence[Record], *, position: bool, limit: float | None = None) -> Draft:
    """Of SISO records of one sampling time, of which the last validates; of one the last part, where that is
    honest. limit: of the amplifier, if it is known."""
    fitted = list(records[:-1]) or list(records)
    look = first_look(fitted, position=position)
    highest = max(float(np.max(np.abs(record.input))) for record in records)
    at_limit = _limit(records)
    reached = limit or at_limit or highest
    spread = _moved(fitted, look)
    # A step of half the spread may ask for the largest command, and the loop for more than the recorded one.
    effort = max(reached / (0.5 * spread) if spread > 0 else 1.0, _MORE * recorded_effort(look.records))
    unstable = _unstable_per_s(look)
    part, specification, gamma = _specification(look, effort, reached, unstable)
    return Draft(
        look,
        position,
        _split(records[0]) if len(records) == 1 else None,
        reached,
        limit is not None or at_limit is not None,
        grid_step([record.output[:, 0] for record in records], np.finfo(np.float64).tiny),
        specification,
        part,
        gamma,
        unstable,
    )


def recorded_effort(records: Sequence[Record]) -> float:
    """Largest |K S| of the recorded loop, from the reference to the command where that is told; without a
    reference, rms of the command over that of the output."""
    if all(record.reference is not None for record in records):
        response = told_response(from_reference(records, "input"))
        if response is not None:
            return float(np.quantile(np.abs(response.centre), 0.95))
    spread = rms_of([record.output[:, 0] for record in records])
    return rms_of([record.input[:, 0] for record in records]) / spread if spread > 0 else 0.0


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


def _split(record: Record) -> int | None:
    """First sample of the part of one log that validates; None where a part would be too short or still."""
    at = round(_FITTED * record.n_samples)
    if record.n_samples - at < _FEWEST:
        return None
    first, second = (float(np.std(part)) for part in (record.input[:at], record.input[at:]))
    return at if 0.5 < second / first < 2 else None


def _unstable_per_s(look: FirstLook) -> float:
    """The pole of the rigid motion that a weight throws over, 0 where there is none."""
    motion = look.motion
    if motion is None or not motion.sprung or motion.stiffness is None or motion.stiffness.value >= 0:
        return 0.0
    return float(max(np.roots([motion.inertia.value, motion.viscous.value, motion.stiffness.value]).real))


def _nominal(look: FirstLook, unstable: bool) -> UncertainPlant | None:
    if look.model is not None and look.model.order and not unstable:
        return UncertainPlant("output", look.model.to_control())
    motion = look.motion
    if motion is None or not motion.inertia.shown:
        return None
    import control

    terms = [motion.inertia.value, motion.viscous.value]
    terms += [] if motion.stiffness is None else [motion.stiffness.value if motion.sprung else 0.0]
    plant = control.ss(control.tf([1.0], terms))
    return UncertainPlant("output", control.c2d(plant, look.records[0].dt_s, method="zoh"))


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")


def _specification(
    look: FirstLook, effort: float, limit: float, unstable: float
) -> tuple[int, dict[str, Any], float | None]:
    """The highest bandwidth of those tried that a design for the quick model allows, else the lowest."""
    dt_s = look.records[0].dt_s
    highest = look.told_rad_s[1] if look.told_rad_s else 0.05 * np.pi / dt_s
    base = look.mode[0] if look.mode else highest
    plant = _nominal(look, unstable > 0)

    def stated(part: int) -> dict[str, Any]:
        bandwidth = _BEYOND_UNSTABLE * unstable if unstable else base / part
        # Above what the logs tell the command falls off.
        rolloff = min(max(highest, _ROLL_OFF * bandwidth), 0.5 * np.pi / dt_s)
        return {
            "bandwidth_rad_s": _rounded(bandwidth),
            "modulus_margin": 0.5,
            "effort_limit": _rounded(effort),
            "effort_rolloff_rad_s": _rounded(rolloff),
            **({"mode_peak_ratio": 1.0} if look.mode else {}),
            **({"mode_band_rad_s": _band(look.mode[0], dt_s)} if look.mode else {}),
            "controller_damping": 0.3,
            "integrator": True,
            "input_limit": limit,
            "controller_order": _ORDER,
        }

    def gamma(part: int) -> float:
        if plant is None:
            return np.inf
        try:
            specification = Specification.model_validate(stated(part))
            return synthesise([plant], specification, _SEARCH, rng=np.random.default_rng(0)).gamma
        except (SpecificationError, ValueError):
            return np.inf

    reached, found = len(_PARTS) - 1, None
    low, high = 0, len(_PARTS)  # the parts from `high` on are met, those before `low` are not
    if unstable:
        return 0, stated(len(_PARTS)), None
    while plant is not None and low < high:
        middle = (low + high) // 2
        value = gamma(_PARTS[middle])
        if value <= _CLEAR:
            high, reached, found = middle, middle, value
        else:
            low = middle + 1
    return _PARTS[reached], stated(_PARTS[reached]), found


def _band(mode_rad_s: float, dt_s: float) -> list[float]:
    return [_rounded(mode_rad_s / 1.5), _rounded(min(1.5 * mode_rad_s, 0.95 * np.pi / dt_s))]
