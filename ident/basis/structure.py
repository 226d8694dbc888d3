"""What is known or assumed around the basis: integrators, delay, direct term, and nuisance columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.basis.poles import NO_POLES, Poles
from ident.data.arrays import ComplexArray, RealArray, one_signal


@dataclass(frozen=True)
class Structure:
    """Fixed structure of y = [sum_i c_i L_i(q) + feedthrough] (1 - q^-1)^-integrators q^-delay u + nuisance.

    Nuisance of each record: a constant (`estimate_offset`), and with `estimate_initial_state` the free
    responses of all poles and the polynomials that integrators leave free (1, k, ... k^(integrators - 1)).
    `relative_degree`: of the continuous plant behind the hold (1: no direct term). `unstable`: mirrored, see
    `stabilised`.
    """

    integrators: int = 0
    input_delay_samples: int = 0
    feedthrough: bool = False
    estimate_offset: bool = False
    estimate_initial_state: bool = False
    relative_degree: int = 1
    unstable: Poles = NO_POLES

    def __post_init__(self) -> None:
        if not (self.integrators >= 0 and self.input_delay_samples >= 0):
            raise ValueError(
                "integrators and input_delay_samples must not be negative; "
                f"got {self.integrators} and {self.input_delay_samples}"
            )
        more = self.feedthrough or self.unstable.order
        if not self.relative_degree >= 1 or (more and self.relative_degree > 1):
            raise ValueError(
                "relative_degree must be at least 1, and 1 with a direct term or unstable poles; got "
                f"{self.relative_degree}, feedthrough = {self.feedthrough}, {self.unstable.order} unstable"
            )

    @property
    def n_polynomials(self) -> int:
        """Number of polynomial nuisance columns per record, degrees 0, 1, ..."""
        return max(int(self.estimate_offset), self.integrators if self.estimate_initial_state else 0)


def filter_input(u: RealArray, integrators: int, delay_samples: int) -> RealArray:
    """(1 - q^-1)^-integrators q^-delay u (T,) or (T, 1), from rest: delayed by samples, summed, exact."""
    u = one_signal(u)
    delayed = np.zeros_like(u)
    delayed[delay_samples:] = u[: max(u.size - delay_samples, 0)]
    for _ in range(integrators):
        delayed = np.cumsum(delayed)
    return delayed


def answered(signal: RealArray, delay_samples: int) -> RealArray:
    """Rows (T - delay, ...) of a signal (T, ...) of a record that answer to its recorded input. Raises
    ValueError where none is left."""
    if not len(signal) > delay_samples:
        raise ValueError(f"{len(signal)} samples, not more than the input delay {delay_samples}")
    return signal[delay_samples:]


def stabilised(y: RealArray, unstable: Poles) -> RealArray:
    """B(q) y (T,), from rest, B the all-pass whose zeros are the unstable poles and whose poles are their
    mirror images 1 / conj(p). B G is stable, B v white if v is, and in a loop independent of past inputs
    (Forssell and Ljung, Automatica 36(1), 2000)."""
    if not unstable.order:
        return y
    from ident.basis.functions import all_pass_signal  # its compiled code is slow to load; options are not

    return all_pass_signal(unstable, y)


def driving_input(u: RealArray, integrators: int, delay_samples: int) -> RealArray:
    """(1 - q^-1)^-integrators q^-delay u in the rows that answer to u (T,): (T - delay,), from rest."""
    return answered(filter_input(u, integrators, delay_samples), delay_samples)


def level_before(u: RealArray) -> float:
    """Input before a record (T,) whose offset and initial state are unknown: zero, unless the input never
    comes near it; then its first value. Basis functions hold the difference in their free responses, taps do
    not."""
    return 0.0 if np.min(u) <= 0 <= np.max(u) else float(u[0])


def front_response(omega_rad_s: RealArray, dt_s: float, integrators: int, delay_samples: int) -> ComplexArray:
    """(z/(z - 1))^integrators z^-delay at omega (F,) in rad/s (not 0 with integrators), (F,)."""
    response = np.exp(-1j * omega_rad_s * dt_s * delay_samples)
    if integrators:
        # 1 - z^-1 written with sin keeps its digits near omega = 0 where the difference would lose them.
        half = 0.5 * omega_rad_s * dt_s
        response = response / (2j * np.sin(half) * np.exp(-1j * half)) ** integrators
    return np.asarray(response, dtype=np.complex128)
