"""What is known or assumed around the basis: integrators, delay, direct term, and nuisance columns.

A fit finds the coefficients of a basis for given poles; everything else it needs to know about the plant is a
`Structure`. Integrators and delay are applied to signals before the fit, exactly and from rest
(`driving_input`), and to frequency responses as a factor (`front_response`); the output of an unstable plant
goes through an all-pass first (`stabilised`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.basis.poles import NO_POLES, Poles
from ident.data.arrays import ComplexArray, RealArray, one_signal


@dataclass(frozen=True)
class Structure:
    """Fixed structure of y = [sum_i c_i L_i(q) + feedthrough] (1 - q^-1)^-integrators q^-delay u + nuisance.

    Raises ValueError for negative numbers, and for a relative degree above 1 with a direct term or unstable
    poles.

    Attributes
    ----------
    integrators : int
        Number of poles at z = 1.
    input_delay_samples : int
        Delay of the input, samples.
    feedthrough : bool
        There is a direct term from the input to the output of the same sample.
    estimate_offset : bool
        Each record has a constant on its output.
    estimate_initial_state : bool
        Each record has the free responses of all poles and the polynomials that integrators leave free
        (1, k, ... k^(integrators - 1)).
    relative_degree : int
        Of the continuous plant behind the hold (1: no direct term).
    unstable : Poles
        Mirror images 1 / conj(p) of the unstable poles p, inside the circle; see `stabilised`.
    """

    integrators: int = 0
    input_delay_samples: int = 0
    feedthrough: bool = False
    estimate_offset: bool = False
    estimate_initial_state: bool = False
    relative_degree: int = 1
    unstable: Poles = NO_POLES

    def __post_init__(self) -> None:
        """Check the numbers. Raises ValueError as the class says."""
        if not (self.integrators >= 0 and self.input_delay_samples >= 0):
            raise ValueError(
                "integrators and input_delay_samples must not be negative; "
                f"got {self.integrators} and {self.input_delay_samples}"
            )
        # Conditions on the coefficients do not hold a direct term, and were not written for mirrored poles.
        needs_degree_one = self.feedthrough or self.unstable.order
        if not self.relative_degree >= 1 or (needs_degree_one and self.relative_degree > 1):
            raise ValueError(
                "relative_degree must be at least 1, and 1 with a direct term or unstable poles; got "
                f"{self.relative_degree}, feedthrough = {self.feedthrough}, {self.unstable.order} unstable"
            )

    @property
    def n_polynomials(self) -> int:
        """Number of polynomial nuisance columns per record, degrees 0, 1, ..."""
        # Degree 0 is the offset; the initial states of k integrators make all degrees up to k - 1.
        of_offset = 1 if self.estimate_offset else 0
        of_integrators = self.integrators if self.estimate_initial_state else 0
        return max(of_offset, of_integrators)


def filter_input(u: RealArray, integrators: int, delay_samples: int) -> RealArray:
    """Input (1 - q^-1)^-integrators q^-delay u behind integrators and delay, from rest, (T,).

    u (T,) or (T, 1): delayed by whole samples, then summed, the present sample included; both are exact. Its
    unit stays. integrators, delay_samples: at least 0. Not checked: a negative delay, or u with several
    columns, ends in numpy's ValueError of shapes or in numbers that mean nothing. NaN stays, behind
    integrators to the end.
    """
    u = one_signal(u)
    # At rest before the record: what the delay brings in from there is zero, all of it if the delay is
    # longer.
    delayed = np.zeros_like(u)
    delayed[delay_samples:] = u[: max(u.size - delay_samples, 0)]
    for _ in range(integrators):
        delayed = np.cumsum(delayed)
    return delayed


def answered(signal: RealArray, delay_samples: int) -> RealArray:
    """Rows (T - delay, ...) of a signal (T, ...) of a record that answer to its recorded input.

    The first `delay_samples` rows answer to what was before the record. Raises ValueError where none is left;
    a negative delay, which `Structure` refuses, would give the last rows.
    """
    if not len(signal) > delay_samples:
        raise ValueError(f"{len(signal)} samples, not more than the input delay {delay_samples}")
    return signal[delay_samples:]


def stabilised(y: RealArray, unstable: Poles) -> RealArray:
    """Output B(q) y of a plant without its unstable poles, (T,), from rest.

    Parameters
    ----------
    y : ndarray, shape (T,)
        Output of one record.
    unstable : Poles
        Mirror images 1 / conj(p) of the unstable poles p; none: y itself is returned.

    Raises
    ------
    ValueError
        By `all_pass_signal`, for y of another shape, where there are unstable poles.

    Notes
    -----
    B is the all-pass whose zeros are the unstable poles and whose poles are their mirror images. B G is
    stable, B v white if v is, and in a loop independent of past inputs.

    References
    ----------
    U. Forssell, L. Ljung, IEEE Transactions on Automatic Control 45(1), 2000.
    """
    if not unstable.order:
        return y
    # Here and not above: its compiled code is slow to load, and settings need this file, but no signals.
    from ident.basis.functions import all_pass_signal

    return all_pass_signal(unstable, y)


def driving_input(u: RealArray, integrators: int, delay_samples: int) -> RealArray:
    """Input behind integrators and delay in the rows that answer to u (T,), (T - delay,), from rest.

    u (T,) or (T, 1), its unit stays. Raises ValueError where the record is not longer than the delay; else as
    `filter_input`.
    """
    return answered(filter_input(u, integrators, delay_samples), delay_samples)


def level_before(u: RealArray) -> float:
    """Input before a record u (T,) whose offset and initial state are unknown, in units of the input.

    Zero if the input reaches or passes it; else its first value. Basis functions hold the difference in their
    free responses, taps do not. NaN in u: its first value, too; numpy's ValueError for a record without
    samples.
    """
    # An input that passes zero was most likely switched on from there.
    passes_zero = np.min(u) <= 0 <= np.max(u)
    return 0.0 if passes_zero else float(u[0])


def front_response(omega_rad_s: RealArray, dt_s: float, integrators: int, delay_samples: int) -> ComplexArray:
    """Response (z/(z - 1))^integrators z^-delay of integrators and delay, (F,).

    omega_rad_s (F,): rad/s, not 0 with integrators, where it is infinite or NaN, with numpy's warning; up to
    pi / dt_s, not checked. dt_s: sampling time, s. No unit.
    """
    response = np.exp(-1j * omega_rad_s * dt_s * delay_samples)
    if integrators:
        # 1 - z^-1 written with sin keeps its digits near omega = 0 where the difference would lose them.
        half_angle = 0.5 * omega_rad_s * dt_s
        difference = 2j * np.sin(half_angle) * np.exp(-1j * half_angle)
        response = response / difference**integrators
    return np.asarray(response, dtype=np.complex128)
