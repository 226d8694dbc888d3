"""Which pole pairs can be modes of a machine, and which poles a search left where they should not be.

A pair is a mode where the longest record shows a few of its periods and a step of it overshoots
(`kind_of_pair`); others are named (`implausible_pairs`). Of measured responses, poles must have a measured
band within their half-power width (`poles_without_data`) and pairs should lie in the band of the data
(`pairs_outside`). `pole_warnings` names searched poles that ended at a bound of the search, which says that
the best place is beyond it. Poles are discrete; frequencies omega = |log p| / dt and damping ratios zeta =
-Re log p / |log p| are those of the continuous pole.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from ident.basis.coordinates import ZETA_LIMIT
from ident.basis.model import GobfModel, MisoModel
from ident.basis.poles import DEADBEAT, Poles
from ident.data.arrays import BoolArray, ComplexArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.fit.refinement import Bounds

# Periods that the longest record has of a mode at least: of fewer it does not show that anything swings.
# Chosen: one may be a drift, two may be chance.
FEWEST_PERIODS = 3.0
# Damping ratio above which a pair swings no more than two real poles do: its step overshoots by
# exp(-pi zeta / sqrt(1 - zeta^2)) = 10 %.
LARGEST_DAMPING = 0.6
# Damping ratio up to which a mode is lightly damped: the peak of its response, or the notch, is 1.75 times
# the gain at rest, 1 / (2 zeta sqrt(1 - zeta^2)), and loop shaping has to mind it.
LIGHT = 0.3
# Factor within which a pole that a search holds at a bound is near it: exp and log round on the way.
AT_BOUND = 1 + 1e-6
# Distance of a damping ratio from `ZETA_LIMIT`, the largest one of a search, up to which it is at this limit:
# exp and log round on the way.
AT_ZETA_LIMIT = 1e-6
# Poles at zero that are called dead time at least. A single one is the part of a sample that a delay has
# beyond whole ones.
FEWEST_DEADBEAT = 2


class PairKind(Enum):
    """What a pole pair stands for; the value is the word for it in a table of poles."""

    MODE = "mode"
    SLOW = "slow pole pair, no mode"
    OVERDAMPED = "strongly damped pole pair, no mode"


def kind_of_pair(omega_rad_s: float, zeta: float, longest_s: float) -> PairKind:
    """What a pole pair stands for: a mode, or slow, or strongly damped; slow where it is both.

    Parameters
    ----------
    omega_rad_s : float
        Natural frequency.
    zeta : float
        Damping ratio.
    longest_s : float
        Length of the longest record, s.

    Returns
    -------
    PairKind
        MODE for nan: numbers are not checked.
    """
    if omega_rad_s * longest_s < 2 * np.pi * FEWEST_PERIODS:
        return PairKind.SLOW
    if zeta > LARGEST_DAMPING:
        return PairKind.OVERDAMPED
    return PairKind.MODE


def implausible_pairs(poles: Poles, fixed: Poles, dt_s: float, longest_s: float) -> list[Finding]:
    """Findings SLOW_PAIR and DAMPED_PAIR, one for each searched pair that can be no mode, by frequency.

    Parameters
    ----------
    poles, fixed : Poles
        Poles of a fit, and those of them that were stated as known, which are not judged.
    dt_s : float
        Sampling time, s, above zero (not checked).
    longest_s : float
        Length of the longest record, s.

    Returns
    -------
    list of Finding
        Empty where every searched pair may be a mode. A fixed pair is known by its exact numbers.
    """
    findings = []
    pairs = zip(poles.omega_rad_s(dt_s).tolist(), poles.zeta().tolist(), strict=True)
    fixed_pairs = set(zip(fixed.omega_rad_s(dt_s).tolist(), fixed.zeta().tolist(), strict=True))
    for omega, zeta in sorted(pairs):
        if (omega, zeta) in fixed_pairs:
            continue
        kind = kind_of_pair(omega, zeta, longest_s)
        pair = {"omega_rad_s": omega, "zeta": zeta}
        if kind is PairKind.SLOW:
            findings.append(
                finding(FindingKind.SLOW_PAIR, **pair, longest_s=longest_s, fewest_periods=FEWEST_PERIODS)
            )
        elif kind is PairKind.OVERDAMPED:
            findings.append(finding(FindingKind.DAMPED_PAIR, **pair, largest_zeta=LARGEST_DAMPING))
    return findings


def poles_without_data(poles: Poles, fixed: Poles, measured_rad: RealArray) -> Poles:
    """Searched poles that have no measured band within their half-power width.

    Parameters
    ----------
    poles, fixed : Poles
        All poles of a fit, the known ones (fixed) first of each type.
    measured_rad : (K, 2) array
        Low and high end of each measured band in rad/sample, from 0 to pi; a single frequency has both ends.
        No band at all is a ValueError of NumPy.

    Returns
    -------
    Poles
        Those whose decay per sample, -ln |p|, is smaller than the distance of their angle to every band. A
        positive real pole stands at angle 0, a negative one at pi.
    """
    real = poles.real[fixed.real.size :]
    pairs = poles.pairs[fixed.pairs.size :]
    real_without = _without_data(real.astype(np.complex128), measured_rad)
    pairs_without = _without_data(pairs, measured_rad)
    return Poles(real[real_without], pairs[pairs_without])


def _without_data(values: ComplexArray, measured_rad: RealArray) -> BoolArray:
    """Whether poles (P,) are farther from every band (K, 2) [rad/sample] than their half-power width, (P,).

    K is at least 1 (ValueError of NumPy without); of a pair the upper pole is given.
    """
    low, high = measured_rad.T
    # A pole at zero has no angle and an infinite width.
    size = np.maximum(np.abs(values), np.finfo(float).tiny)
    half_power_width = -np.log(size)
    angle = np.abs(np.angle(values))[:, None]
    outside = np.maximum(low - angle, angle - high)
    distance = np.maximum(outside, 0.0).min(axis=1)
    return np.asarray(distance > half_power_width * AT_BOUND)


def pairs_outside(poles: Poles, fixed: Poles, dt_s: float, band_rad_s: tuple[float, float]) -> list[Finding]:
    """Findings OUTSIDE_BAND, one for each searched pair whose frequency is outside the band of the data.

    Parameters
    ----------
    poles, fixed : Poles
        Poles of a fit, and those of them that were stated as known, which are not judged.
    dt_s : float
        Sampling time, s, above zero (not checked).
    band_rad_s : (low, high)
        Both ends belong to the band. With ends exchanged every pair is outside.

    Returns
    -------
    list of Finding
        Empty where every searched pair lies inside. A fixed pair is known by its exact frequency.
    """
    low, high = band_rad_s
    fixed_omegas = set(fixed.omega_rad_s(dt_s).tolist())
    findings = []
    for omega in poles.omega_rad_s(dt_s).tolist():
        if omega in fixed_omegas or low <= omega <= high:
            continue
        findings.append(finding(FindingKind.OUTSIDE_BAND, omega_rad_s=omega, low_rad_s=low, high_rad_s=high))
    return findings


def pole_warnings(model: GobfModel | MisoModel, fixed: Poles, bounds: Bounds) -> list[Finding]:
    """Findings, one for each searched pole that ended at a bound, and on poles that stand for dead time.

    Parameters
    ----------
    model : GobfModel or MisoModel
        Its poles, the known ones first of each type, with integrators and delay.
    fixed : Poles
        Known poles, which are not judged.
    bounds : Bounds
        Of the search: distance 1 - a of real poles a, frequency [rad/sample], damping ratio and least decay
        per sample of pairs.

    Returns
    -------
    list of Finding
        NO_POLE alone where nothing was found; SLOW_BOUND, FAST_BOUND of real poles; DEADBEAT with the delay
        that poles at zero stand for, in samples; of each pair at most one of OVERDAMPED_PAIR, DAMPING_BOUND
        and NO_DECAY, and FREQUENCY_BOUND. Nothing is raised; that the model has the fixed poles first is not
        checked.
    """
    poles = model.poles
    findings = []
    if not poles.order:
        findings.append(finding(FindingKind.NO_POLE))

    real = poles.real[fixed.real.size :]
    for pole in real:
        distance = 1 - pole
        if distance <= bounds.distance_min * AT_BOUND:
            findings.append(finding(FindingKind.SLOW_BOUND, a=pole, integrators=model.integrators))
        elif distance >= bounds.distance_max / AT_BOUND:
            findings.append(finding(FindingKind.FAST_BOUND, a=pole))

    pairs = poles.pairs[fixed.pairs.size :]
    real_at_zero = np.count_nonzero(np.abs(real) < DEADBEAT)
    pairs_at_zero = np.count_nonzero(np.abs(pairs) < DEADBEAT)
    n_deadbeat = real_at_zero + 2 * pairs_at_zero
    if n_deadbeat >= FEWEST_DEADBEAT:
        delay = model.input_delay_samples + n_deadbeat
        findings.append(finding(FindingKind.DEADBEAT, poles=n_deadbeat, delay=delay))

    omegas = poles.omega_rad_s(model.dt_s)[fixed.pairs.size :]
    zetas = poles.zeta()[fixed.pairs.size :]
    for pole, omega, zeta in zip(pairs, omegas, zetas, strict=True):
        at_most_damping = zeta >= bounds.zeta_max / AT_BOUND
        at_least_damping = zeta <= bounds.zeta_min * AT_BOUND
        decay = -np.log(abs(pole))
        if zeta >= ZETA_LIMIT - AT_ZETA_LIMIT:
            findings.append(finding(FindingKind.OVERDAMPED_PAIR, omega_rad_s=omega, zeta=zeta))
        elif at_most_damping or at_least_damping:
            findings.append(finding(FindingKind.DAMPING_BOUND, omega_rad_s=omega, zeta=zeta))
        elif decay <= bounds.s_min * AT_BOUND:
            findings.append(finding(FindingKind.NO_DECAY, omega_rad_s=omega))
        angle = omega * model.dt_s
        if not bounds.omega_min * AT_BOUND < angle < bounds.omega_max / AT_BOUND:
            findings.append(finding(FindingKind.FREQUENCY_BOUND, omega_rad_s=omega))
    return findings
