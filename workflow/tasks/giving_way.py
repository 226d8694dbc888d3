"""What gave way between a specification as it was asked and what a controller was designed for."""

from __future__ import annotations

from dataclasses import dataclass

from control_design.specification import GIVES_WAY, Specification
from control_design.specification.specification import Effort, ModePeak, Tracking

# Caption of the requirement that a key makes, as a certificate lists it.
_CAPTIONS = {
    "bandwidth_rad_s": Tracking.caption,
    "effort_limit": Effort.caption,
    "mode_peak_ratio": ModePeak.caption,
}
# Relative difference of two values that counts as none: bandwidths are rounded to three digits.
_SAME = 1e-3


@dataclass(frozen=True)
class GaveWay:
    """A requirement of which less was designed for than asked.

    Attributes
    ----------
    key : str
        Of the specification.
    asked, used : float
        As it was asked, and as it was designed for and certified.
    limit : float
        How far it was allowed to give way.
    caption : str
        Of its requirement in a certificate.
    """

    key: str
    asked: float
    used: float
    limit: float
    caption: str


def gave_way(asked: Specification, used: Specification | None) -> tuple[GaveWay, ...]:
    """What gave way, in the order in which it does.

    Parameters
    ----------
    asked : Specification
        With the limits of what gives way; without any, nothing did.
    used : Specification or None
        What was designed for; None: there was no design.

    Returns
    -------
    tuple of GaveWay
    """
    changes = []
    for key, limit in GIVES_WAY.items():
        how_far = getattr(asked, limit)
        if used is None or how_far is None:
            continue
        before = getattr(asked, key)
        after = getattr(used, key)
        if abs(after - before) > _SAME * before:
            changes.append(GaveWay(key, before, after, how_far, _CAPTIONS[key]))
    return tuple(changes)
