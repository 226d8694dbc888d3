"""Which pole pairs can be modes of a machine, given the records they come from."""

from __future__ import annotations

from enum import Enum

import numpy as np

from ident.basis.poles import Poles
from ident.data.finding import Finding, FindingKind, finding

# Of fewer periods a record does not show that anything swings.
FEWEST_PERIODS = 3.0
# Above it (overshoot of a step below 10 %) a pair swings no more than two real poles do.
LARGEST_DAMPING = 0.6


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


def pairs_outside(poles: Poles, fixed: Poles, dt_s: float, band_rad_s: tuple[float, float]) -> list[Finding]:
    """One finding for each pair that was found outside the band of the data."""
    low, high = band_rad_s
    known = set(fixed.omega_rad_s(dt_s).tolist())
    return [
        finding(FindingKind.OUTSIDE_BAND, omega_rad_s=omega, low_rad_s=low, high_rad_s=high)
        for omega in poles.omega_rad_s(dt_s).tolist()
        if omega not in known and not low <= omega <= high
    ]
