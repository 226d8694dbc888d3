"""Single responses that must stay stable: draws that the ellipses do not describe.

Ellipses propagate parameter spreads to first order. A lightly damped mode that moves by several of its
half-widths leaves them, and a loop that is stable over ellipses of any level may be unstable for it. A
`Guard` is such a response on its own frequency grid; the search keeps 1 + K G winding as a stable loop's
does, at the distance `GUARD_MODULUS` from the origin. `different_responses` chooses guards that differ from
many draws, and `sorted_by_plant` stacks those that can be evaluated together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import Complex, Ellipses, Integer, Real
from ident.data.arrays import lock

# Distance of the loop from -1 that is asked of a guard. It stands for stability, not for a margin: large
# enough that a search on a grid does not end on the wrong side between two points, small against the .5 that
# a specification asks of the ellipses, so that unlikely draws do not take the place of the requirement.
# Chosen.
GUARD_MODULUS = 0.1

# Draws whose mean relative difference is below this are rounding of one another: a second one adds nothing.
_SAME_RESPONSE_SHARE = 1e-9


@dataclass(frozen=True, eq=False)
class Guard:
    """One response that the loop must stay stable with.

    Parameters
    ----------
    plant : int
        Number of the plant in its set.
    omega_rad_s : (F,) array
        Ascending frequencies that end at Nyquist, F >= 2.
    response : (F,) complex array
        Finite; it has the integrators and unstable poles of that plant's nominal.

    Raises
    ------
    ValueError
        For other shapes, frequencies that do not ascend, or a response that is not finite.
    """

    plant: int
    omega_rad_s: Real
    response: Complex

    def __post_init__(self) -> None:
        """Lock the arrays and check them.

        Raises the ValueError that the class names; the number of the plant is not checked.
        """
        lock(self, "omega_rad_s")
        lock(self, "response", dtype=np.complex128)
        omega = self.omega_rad_s
        if omega.ndim != 1 or self.response.shape != omega.shape or omega.size < 2:
            raise ValueError(
                f"a guard needs omega and response of one shape (F,); got {omega.shape} and "
                f"{self.response.shape}"
            )
        ascending = np.all(np.diff(omega) > 0)
        if not (ascending and np.all(np.isfinite(self.response))):
            raise ValueError("a guard needs ascending frequencies and a finite response")

    def ellipses(self, wanted: Real) -> Ellipses:
        """Ellipses of no size at those of the guard's own frequencies nearest to `wanted` (W,) in rad/s, each
        frequency once.

        No wanted frequency gives no ellipses; one outside of the range the end. Nan is not checked.
        """
        omega = self.omega_rad_s
        upper = np.clip(np.searchsorted(omega, wanted), 1, omega.size - 1)
        lower = upper - 1
        lower_is_nearer = wanted - omega[lower] < omega[upper] - wanted
        nearest = np.unique(np.where(lower_is_nearer, lower, upper))
        return Ellipses.of_no_size(omega[nearest], self.response[nearest])


def different_responses(responses: Complex, most: int) -> Integer:
    """Positions of responses that differ as much as possible from one another, the first one first.

    Parameters
    ----------
    responses : (D, F) complex array
        Draws on one grid of frequencies.
    most : int
        Largest number of positions; of zero or less still the first.

    Returns
    -------
    (N,) integer array
        N <= most. Each position is the one farthest from its nearest neighbour among those before it; fewer
        where what is left differs by rounding only. Not checked: at least one draw, all finite (a draw with
        nan is chosen first).

    Notes
    -----
    The distance of two draws is the mean over frequency of |difference|/(sum of sizes), between 0 and 1, so
    that resonances do not outweigh frequencies of small gain.
    """
    chosen = [0]
    size = np.abs(responses)

    def distance_from(index: int) -> Real:
        """Distance (D,) of every draw from the one at `index`.

        Between 0 and 1, no unit; nan for a draw with nan.
        """
        difference = np.abs(responses - responses[index])
        # The smallest sum keeps 0/0, two draws that vanish at one frequency, from being nan.
        return np.asarray(np.mean(difference / np.maximum(size + size[index], 1e-300), axis=1))

    nearest = distance_from(0)
    while len(chosen) < min(most, responses.shape[0]):
        farthest = int(np.argmax(nearest))
        if nearest[farthest] <= _SAME_RESPONSE_SHARE:
            break
        chosen.append(farthest)
        nearest = np.minimum(nearest, distance_from(farthest))
    return np.array(chosen, dtype=np.int64)


def sorted_by_plant(guards: Sequence[Guard]) -> list[tuple[int, Real, Complex]]:
    """Guards that have plant and grid in common, stacked: (number of the plant, omega (F,) in rad/s,
    responses (D, F)), in the order in which each pair appears first.

    Empty without guards. Guards have checked themselves; grids are the same only bit for bit.
    """
    groups: dict[tuple[int, bytes], list[Guard]] = {}
    for guard in guards:
        key = (guard.plant, guard.omega_rad_s.tobytes())
        groups.setdefault(key, []).append(guard)
    stacked = []
    for (number, _), group in groups.items():
        responses = np.array([guard.response for guard in group])
        stacked.append((number, group[0].omega_rad_s, responses))
    return stacked
