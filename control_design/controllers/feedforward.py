"""What dry friction takes off the command, given back from the reference alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import Real


@dataclass(frozen=True)
class FrictionFeedforward:
    """Friction at the reference's speed v, smoothed, as late as the loop follows.

    The friction is sign(v) (level + excess exp(-|v| / fall)), Coulomb's and Stribeck's. The sign turns round
    while the speed goes through +-width / lag_s, at which the reference moves by the pre-sliding deflection
    `width` while the loop answers; the friction then goes through a first-order lag of lag_s, the delay of
    the closed loop towards standstill, and joins the command: p+ = p + share (friction - p). It dies out
    where the reference rests, so that it drives no limit cycle, and it is no feedback: poles and margins stay
    as they are. A step is over in one sample and gets next to nothing of it.

    level, excess >= 0 in units of the command, width > 0 of the reference, fall > 0 of the reference per
    second, lag_s > 0. Neglected: friction that depends on position or load; motion that something other than
    the reference causes; a reference that comes in steps longer than a sample, which counts as resting
    between them.
    """

    level: float
    width: float
    lag_s: float
    excess: float = 0.0
    fall: float = 1.0

    def __post_init__(self) -> None:
        good = min(self.level, self.excess) >= 0 and min(self.width, self.lag_s, self.fall) > 0
        if not (good and np.all(np.isfinite(list(vars(self).values())))):
            raise ValueError(
                f"a friction feed-forward needs level, excess >= 0 and width, lag_s, fall > 0; got {self}"
            )

    def share(self, dt_s: float) -> float:
        """Of its way that the lag goes in a sample."""
        return float(-np.expm1(-dt_s / self.lag_s))

    def turn(self, dt_s: float) -> float:
        """Motion of the reference in a sample from which on its sign is whole."""
        return self.width * dt_s / self.lag_s

    def friction(self, moved: Real, dt_s: float) -> Real:
        """At the motion (T,) of the reference in each sample, before the lag."""
        strength = self.level + self.excess * np.exp(-np.abs(moved) / (self.fall * dt_s))
        return np.asarray(np.minimum(np.maximum(moved / self.turn(dt_s), -1.0), 1.0) * strength)

    def signal(self, reference: Real, dt_s: float) -> Real:
        """What joins the command, (T,), for a reference (T,) that rested at zero before."""
        from scipy.signal import lfilter  # here: every command would wait for it

        share = self.share(dt_s)
        friction = self.friction(np.diff(reference, prepend=0.0), dt_s)
        return np.asarray(lfilter([share], [1.0, share - 1.0], friction))
