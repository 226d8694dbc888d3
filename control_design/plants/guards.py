"""Single responses that must stay stable: draws that the ellipses do not describe.

Ellipses propagate parameter spreads to first order; a lightly damped mode that moves by several half-widths
leaves them, and a loop stable over ellipses of any level may be unstable for it. A guard is such a response
on its own grid: the search keeps 1 + K G winding as a stable loop's, at a modest distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control_design.plants.ellipses import Complex, Ellipses, Integer, Real
from ident.data.arrays import lock

GUARD_MODULUS = 0.1  # distance from -1 asked of a guard: stability with something to spare


@dataclass(frozen=True, eq=False)
class Guard:
    """One response of one plant: its number, omega (F,) ending at Nyquist, response (F,) with the nominal's
    integrators and unstable poles."""

    plant: int
    omega_rad_s: Real
    response: Complex

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s")
        lock(self, "response", dtype=np.complex128)
        omega = self.omega_rad_s
        if omega.ndim != 1 or self.response.shape != omega.shape or omega.size < 2:
            raise ValueError(
                f"a guard needs omega and response of one shape (F,); got {omega.shape} and "
                f"{self.response.shape}"
            )
        if not (np.all(np.diff(omega) > 0) and np.all(np.isfinite(self.response))):
            raise ValueError("a guard needs ascending frequencies and a finite response")

    def ellipses(self, wanted: Real) -> Ellipses:
        """Points (ellipses of no size) at those of its own frequencies nearest to `wanted`."""
        own = self.omega_rad_s
        above = np.clip(np.searchsorted(own, wanted), 1, own.size - 1)
        index = np.unique(np.where(wanted - own[above - 1] < own[above] - wanted, above - 1, above))
        return Ellipses.of_no_size(self.omega_rad_s[index], self.response[index])


def different_responses(responses: Complex, most: int) -> Integer:
    """Positions of up to `most` of the responses (D, F), each as far as can be from those before it: largest
    mean of |difference|/(sum of sizes), from the first one on."""
    chosen = [0]
    size = np.abs(responses)

    def apart(index: int) -> Real:
        difference = np.abs(responses - responses[index])
        return np.asarray(np.mean(difference / np.maximum(size + size[index], 1e-300), axis=1))

    nearest = apart(0)
    while len(chosen) < min(most, responses.shape[0]):
        farthest = int(np.argmax(nearest))
        if nearest[farthest] <= 1e-9:
            break
        chosen.append(farthest)
        nearest = np.minimum(nearest, apart(farthest))
    return np.array(chosen, dtype=np.int64)


def sorted_by_plant(guards: Sequence[Guard]) -> list[tuple[int, Real, Complex]]:
    """Guards of one plant on one grid together: (number of the plant, omega (F,), responses (D, F))."""
    together: dict[tuple[int, bytes], list[Guard]] = {}
    for guard in guards:
        together.setdefault((guard.plant, guard.omega_rad_s.tobytes()), []).append(guard)
    return [
        (number, alike[0].omega_rad_s, np.array([guard.response for guard in alike]))
        for (number, _), alike in together.items()
    ]
