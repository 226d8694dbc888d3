"""What dry friction takes off the command, given back from the reference alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import Real


@dataclass(frozen=True)
class FrictionFeedforward:
    """level times the sign of the speed at which the loop follows its reference.

    What a loop follows a reference r with is r seen late; here q, r behind a first-order lag of lag_s, the
    delay of the closed loop at low frequency. The speed of q is (r - q) / lag_s, and its sign turns round
    while r - q goes through +-width, as the friction turns round over its pre-sliding deflection: level
    clip((r - q) / width, -1, 1). It dies out where the reference rests, so that it drives no limit cycle, and
    it is no feedback: poles and margins stay as they are.

    level >= 0 in units of the command, width > 0 of the reference, lag_s > 0. Neglected: friction that
    depends on speed, position or load; motion that something other than the reference causes.
    """

    level: float
    width: float
    lag_s: float

    def __post_init__(self) -> None:
        good = self.level >= 0 and self.width > 0 and self.lag_s > 0
        if not (good and np.all(np.isfinite([self.level, self.width, self.lag_s]))):
            raise ValueError(
                "a friction feed-forward needs level >= 0, width > 0 and lag_s > 0; "
                f"got {self.level}, {self.width} and {self.lag_s}"
            )

    def share(self, dt_s: float) -> float:
        """Of r - q that q catches up with in a sample."""
        return float(-np.expm1(-dt_s / self.lag_s))

    def at(self, ahead: float) -> float:
        """What joins the command where the reference is so far ahead of q."""
        return self.level * min(max(ahead / self.width, -1.0), 1.0)

    def signal(self, reference: Real, dt_s: float) -> Real:
        """(T,) for a reference (T,) that rested at zero before."""
        share, behind = self.share(dt_s), 0.0
        added = np.empty(reference.size)
        for k, wanted in enumerate(reference.tolist()):
            added[k] = self.at(wanted - behind)
            behind += share * (wanted - behind)
        return added
