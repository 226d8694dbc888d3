"""Which pole pairs can be modes of a machine, given the records they come from."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np

from ident.basis.poles import Poles

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


def implausible_pairs(poles: Poles, fixed: Poles, dt_s: float, longest_s: float) -> Sequence[str]:
    """One sentence for each pair that was found and can be no mode."""
    sentences = []
    pairs = sorted(zip(poles.omega_rad_s(dt_s).tolist(), poles.zeta().tolist(), strict=True))
    known = set(zip(fixed.omega_rad_s(dt_s).tolist(), fixed.zeta().tolist(), strict=True))
    for omega, zeta in pairs:
        if (omega, zeta) in known:
            continue
        kind = kind_of_pair(omega, zeta, longest_s)
        at = f"the pole pair at {omega / (2 * np.pi):.3g} Hz (damping {zeta:.2g})"
        if kind is PairKind.SLOW:
            sentences.append(
                f"{at} is no mode: the longest record lasts {longest_s:.3g} s, fewer than "
                f"{FEWEST_PERIODS:g} of its periods; such slow poles stand for dry friction or drift; check "
                "the unit of the time column, and set omega_min above it"
            )
        elif kind is PairKind.OVERDAMPED:
            sentences.append(
                f"{at} is no mode: with a damping ratio above {LARGEST_DAMPING:g} nothing swings; it stands "
                "for two real poles, or for dynamics beyond the excited band; fit one pair less, or set "
                "zeta_max"
            )
    return sentences
