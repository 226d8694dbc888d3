"""Which poles a search left where they should not be, and which pole pairs can be modes of a machine."""

from __future__ import annotations

from enum import Enum

import numpy as np

from ident.basis.coordinates import ZETA_LIMIT
from ident.basis.model import GobfModel, MisoModel
from ident.basis.poles import DEADBEAT, Poles
from ident.data.arrays import BoolArray, ComplexArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.fit.refinement import Bounds

# Of fewer periods a record does not show that anything swings.
FEWEST_PERIODS = 3.0
# Above it (overshoot of a step below 10 %) a pair swings no more than two real poles do.
LARGEST_DAMPING = 0.6
# Relative: a pole that a search holds at its least width is within it; exp and log round on the way.
_HELD_AT_BOUND = 1 + 1e-6
# Lightly damped: above it a pair's peak, or notch, is less than 1.75 of the gain at rest, 1 / (2 zeta).
LIGHT = 0.3


class PairKind(Enum):
    """What a pole pair stands for."""

    MODE = "mode"
    SLOW = "slow pole pair, no mode"
    OVERDAMPED = "strongly damped pole pair, no mode"


def kind_of_pair(omega_rad_s: float, zeta: float, longest_s: float) -> PairKind:
    """longest_s: length of the longest record."""
    if omega_rad_s * longest_s < 2 * np.pi * FEWEST_PERIODS:
        return PairKind.SLOW
    return PairKind.OVERDAMPED if zeta > LARGEST_DAMPING else PairKind.MODE


def implausible_pairs(poles: Poles, fixed: Poles, dt_s: float, longest_s: float) -> list[Finding]:
    """One finding for each pair that was found and can be no mode."""
    found = []
    pairs = sorted(zip(poles.omega_rad_s(dt_s).tolist(), poles.zeta().tolist(), strict=True))
    known = set(zip(fixed.omega_rad_s(dt_s).tolist(), fixed.zeta().tolist(), strict=True))
    for omega, zeta in pairs:
        if (omega, zeta) in known:
            continue
        kind = kind_of_pair(omega, zeta, longest_s)
        pair = {"omega_rad_s": omega, "zeta": zeta}
        if kind is PairKind.SLOW:
            found.append(
                finding(FindingKind.SLOW_PAIR, **pair, longest_s=longest_s, fewest_periods=FEWEST_PERIODS)
            )
        elif kind is PairKind.OVERDAMPED:
            found.append(finding(FindingKind.DAMPED_PAIR, **pair, largest_zeta=LARGEST_DAMPING))
    return found


def poles_without_data(poles: Poles, fixed: Poles, measured_rad: RealArray) -> Poles:
    """Searched poles that have no measured band within their half-power width.

    Parameters
    ----------
    poles, fixed : Poles
        All poles of a fit, the known ones (fixed) first of each type.
    measured_rad : (K, 2) array
        Low and high end of each measured band in rad/sample, from 0 to pi; a single frequency has both ends.

    Returns
    -------
    Poles
        Those whose decay per sample, -ln |p|, is smaller than the distance of their angle to every band. A
        positive real pole stands at angle 0, a negative one at pi.
    """
    real = poles.real[fixed.real.size :]
    pairs = poles.pairs[fixed.pairs.size :]
    low, high = measured_rad.T

    def without(values: ComplexArray) -> BoolArray:
        # A pole at zero has no angle and an infinite width.
        decay = -np.log(np.maximum(np.abs(values), np.finfo(float).tiny))
        angle = np.abs(np.angle(values))[:, None]
        distance = np.maximum(np.maximum(low - angle, angle - high), 0.0).min(axis=1)
        return np.asarray(distance > decay * _HELD_AT_BOUND)

    return Poles(real[without(real.astype(np.complex128))], pairs[without(pairs)])


def pairs_outside(poles: Poles, fixed: Poles, dt_s: float, band_rad_s: tuple[float, float]) -> list[Finding]:
    """One finding for each pair that was found outside the band of the data."""
    low, high = band_rad_s
    known = set(fixed.omega_rad_s(dt_s).tolist())
    return [
        finding(FindingKind.OUTSIDE_BAND, omega_rad_s=omega, low_rad_s=low, high_rad_s=high)
        for omega in poles.omega_rad_s(dt_s).tolist()
        if omega not in known and not low <= omega <= high
    ]


def pole_warnings(model: GobfModel | MisoModel, fixed: Poles, bounds: Bounds) -> list[Finding]:
    """One finding for each searched pole that ended at a bound."""
    poles, dt_s = model.poles, model.dt_s
    found = [] if poles.order else [finding(FindingKind.NO_POLE)]
    close = 1 + 1e-6
    for a in poles.real[fixed.real.size :]:
        if 1 - a <= bounds.distance_min * close:
            found.append(finding(FindingKind.SLOW_BOUND, a=a, integrators=model.integrators))
        elif 1 - a >= bounds.distance_max / close:
            found.append(finding(FindingKind.FAST_BOUND, a=a))
    real, pairs = poles.real[fixed.real.size :], poles.pairs[fixed.pairs.size :]
    late = np.count_nonzero(np.abs(real) < DEADBEAT) + 2 * np.count_nonzero(np.abs(pairs) < DEADBEAT)
    # A single one is the part of a sample that a delay has beyond whole ones.
    if late > 1:
        found.append(finding(FindingKind.DEADBEAT, poles=late, delay=model.input_delay_samples + late))
    omegas, zetas = poles.omega_rad_s(dt_s), poles.zeta()
    for pole, omega, zeta in list(zip(poles.pairs, omegas, zetas, strict=True))[fixed.pairs.size :]:
        if zeta >= ZETA_LIMIT - 1e-6:
            found.append(finding(FindingKind.OVERDAMPED_PAIR, omega_rad_s=omega, zeta=zeta))
        elif zeta >= bounds.zeta_max / close or zeta <= bounds.zeta_min * close:
            found.append(finding(FindingKind.DAMPING_BOUND, omega_rad_s=omega, zeta=zeta))
        elif -np.log(abs(pole)) <= bounds.s_min * close:
            found.append(finding(FindingKind.NO_DECAY, omega_rad_s=omega))
        if not bounds.omega_min * close < omega * dt_s < bounds.omega_max / close:
            found.append(finding(FindingKind.FREQUENCY_BOUND, omega_rad_s=omega))
    return found
