"""How well a share is known from counting."""

from __future__ import annotations

import math
from statistics import NormalDist


def wilson_interval(count: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a probability after `count` of `total`; E. B. Wilson, JASA 22, 1927.

    Raises ValueError unless 0 <= count <= total, total > 0 and 0 < level < 1.
    """
    if not (0 <= count <= total and total > 0 and 0 < level < 1):
        raise ValueError(f"need 0 <= count <= total and a level in (0, 1); got {count}, {total}, {level}")
    z = NormalDist().inv_cdf(0.5 + 0.5 * level)
    share, weight = count / total, z * z / total
    centre = (share + 0.5 * weight) / (1 + weight)
    half = math.sqrt(share * (1 - share) * weight + 0.25 * weight * weight) / (1 + weight)
    # At the ends the score test allows the end itself; subtraction leaves a rounding error there.
    low = 0.0 if count == 0 else max(0.0, centre - half)
    high = 1.0 if count == total else min(1.0, centre + half)
    return low, high
