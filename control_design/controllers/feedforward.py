"""What dry friction takes off the command, given back from the reference alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from control_design.plants.ellipses import Real


@dataclass(frozen=True)
class FrictionFeedforward:
    """level times the smoothed sign of the reference's speed, as late as the loop follows.

    The sign turns round while the speed goes through +-width / lag_s, at which the reference moves by the
    pre-sliding deflection `width` while the loop answers; it then goes through a first-order lag of lag_s,
    the delay of the closed loop towards standstill: p+ = p + share (clip(lag_s v / width, -1, 1) - p), level
    p joins the command. It dies out where the reference rests, so that it drives no limit cycle, and it is no
    feedback: poles and margins stay as they are. A step is over in one sample and gets next to nothing of it.

    level >= 0 in units of the command, width > 0 of the reference, lag_s > 0. Neglected: friction that
    depends on speed, position or load; motion that something other than the reference causes; a reference
    that comes in steps longer than a sample, which counts as resting between them.
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
        """Of its way that the lag goes in a sample."""
        return float(-np.expm1(-dt_s / self.lag_s))

    def turn(self, dt_s: float) -> float:
        """Motion of the reference in a sample from which on its sign is whole."""
        return self.width * dt_s / self.lag_s

    def signal(self, reference: Real, dt_s: float) -> Real:
        """What joins the command, (T,), for a reference (T,) that rested at zero before."""
        share = self.share(dt_s)
        sign = np.clip(np.diff(reference, prepend=0.0) / self.turn(dt_s), -1.0, 1.0)
        return np.asarray(self.level * lfilter([share], [1.0, share - 1.0], sign))
