"""The poles of a basis: real ones and conjugate pairs, inside the unit circle.

`Poles` keeps them in the one order that all coefficients, states and sensitivities of a basis have: real
poles first, then two places per pair. It changes numbers of poles (`without`, `doubled`, `appended`), and
gives their frequencies, damping ratios and decays. A pole that stays inside the circle is all that is
assumed: zeros and repeated poles are allowed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from ident.data.arrays import ComplexArray, RealArray, lock
from ident.data.keywords import clear_constructor


@clear_constructor
@dataclass(frozen=True, eq=False)
class Poles:
    """Discrete-time poles inside the unit circle, in the order of their basis functions.

    Parameters
    ----------
    real : (R,) array
        Real poles; zeros (FIR) and equal poles are allowed.
    pairs : (P,) complex array
        Of every conjugate pair the pole above the real axis.

    Raises
    ------
    ValueError
        If a pole is not inside the unit circle, not finite, or of a pair and not above the real axis.

    Examples
    --------
    >>> poles = flexlink.Poles.from_continuous(omega_rad_s=[20.0], zeta=[0.05], dt_s=0.01)
    >>> poles.order, poles.omega_rad_s(0.01).round(6)
    (2, array([20.]))
    """

    real: RealArray = field(default_factory=lambda: np.zeros(0))
    pairs: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))

    def __post_init__(self) -> None:
        """Lock the arrays and check every pole. Raises ValueError as the class says."""
        lock(self, "real")
        lock(self, "pairs", dtype=np.complex128)
        if self.real.ndim != 1 or self.pairs.ndim != 1:
            raise ValueError(f"poles must be 1-d arrays; got shapes {self.real.shape} and {self.pairs.shape}")
        # Number by number: a search makes tens of these, for a few poles each.
        real = self.real.tolist()
        pairs = self.pairs.tolist()
        for pole in (*real, *pairs):
            modulus = math.hypot(pole.real, pole.imag)
            if not modulus < 1:
                raise ValueError(
                    f"every pole must lie inside the unit circle; got {pole:.6g} (|p| = {modulus:.6g})"
                )
        for pole in pairs:
            if not pole.imag > 0:
                raise ValueError(f"a pair is given by its pole with positive imaginary part; got {pole:.6g}")

    @classmethod
    def from_continuous(
        cls,
        *,
        decay_per_s: Iterable[float] = (),
        omega_rad_s: Iterable[float] = (),
        zeta: Iterable[float] = (),
        dt_s: float,
    ) -> Poles:
        """Poles of a basis from those of continuous time.

        Parameters
        ----------
        decay_per_s : iterable of float
            Of each real pole, which becomes exp(-decay dt); 1/s, positive.
        omega_rad_s, zeta : iterable of float, equally long
            Undamped frequency, rad/s, and damping ratio of each pair, which becomes
            exp((-zeta +- j sqrt(1 - zeta^2)) omega dt).
        dt_s : float
            Sampling time, s.

        Returns
        -------
        Poles

        Raises
        ------
        ValueError
            dt_s is not positive, omega_rad_s and zeta are not equally long, a damping ratio is not between 0
            and 1, a damped frequency is not between 0 and pi / dt_s, or a pole would not lie inside the
            circle.
        """
        if not (np.isfinite(dt_s) and dt_s > 0):
            raise ValueError(f"dt_s must be positive; got {dt_s}")
        omega = np.array(list(omega_rad_s), dtype=np.float64)
        damping = np.array(list(zeta), dtype=np.float64)
        if omega.shape != damping.shape:
            raise ValueError(
                f"omega_rad_s and zeta must be equally long; got {omega.size} and {damping.size}"
            )
        if not (np.all(damping > 0) and np.all(damping < 1)):
            raise ValueError(f"a pair needs 0 < zeta < 1; got {damping}")
        # Damped angle per sample. From pi on a pole would look like one of a lower frequency.
        angle = omega * np.sqrt(1 - damping**2) * dt_s
        is_positive = angle > 0
        is_below_nyquist = angle < np.pi
        if not np.all(is_positive & is_below_nyquist):
            raise ValueError(
                f"the damped frequency of a pair must lie in (0, pi/dt); got {angle / dt_s} rad/s"
            )
        decay = np.array(list(decay_per_s), dtype=np.float64)
        real = np.exp(-decay * dt_s)
        pairs = np.exp(-damping * omega * dt_s + 1j * angle)
        return cls(real, pairs)

    @property
    def order(self) -> int:
        """Number of poles, a pair counted twice; also the number of basis functions."""
        return int(self.real.size + 2 * self.pairs.size)

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers (R, P) of real poles and of pairs."""
        return self.real.size, self.pairs.size

    @property
    def values(self) -> ComplexArray:
        """Poles (B,), both of each pair: the real ones, then p, conj(p) for each pair."""
        # Row by row, so that the two poles of a pair stand side by side as its two basis functions do.
        pair_poles = np.column_stack([self.pairs, self.pairs.conj()]).ravel()
        return np.concatenate([self.real.astype(np.complex128), pair_poles])

    def writable(self) -> tuple[RealArray, ComplexArray]:
        """Copies of real (R,) and pairs (P,) as compiled code takes them: contiguous and writable."""
        return self.real.copy(), self.pairs.copy()

    def blocks(self) -> tuple[Poles, ...]:
        """Each real pole and each pair by itself, R + P `Poles`, in order."""
        reals = [Poles(real=self.real[i : i + 1]) for i in range(self.real.size)]
        pairs = [Poles(pairs=self.pairs[i : i + 1]) for i in range(self.pairs.size)]
        return (*reals, *pairs)

    def without_real(self, index: int | slice) -> Poles:
        """These poles but the real one (or those) at `index`, 0 .. R - 1. IndexError for a number beyond."""
        return Poles(np.delete(self.real, index), self.pairs)

    def without_pair(self, index: int | slice) -> Poles:
        """These poles but the pair (or those) at `index`, 0 .. P - 1. IndexError for a number beyond."""
        return Poles(self.real, np.delete(self.pairs, index))

    def doubled(self, n_fixed: tuple[int, int] = (0, 0)) -> Poles:
        """Every pole twice, neighbours equal, but the first of each type, fixed, once.

        The basis of these poles, Phi2, spans the derivatives of the basis functions by their poles. n_fixed:
        numbers of fixed real poles and of fixed pairs; larger ones than there are fix all, which is not
        refused.
        """
        n_fixed_real, n_fixed_pairs = n_fixed
        real = np.concatenate([self.real[:n_fixed_real], np.repeat(self.real[n_fixed_real:], 2)])
        pairs = np.concatenate([self.pairs[:n_fixed_pairs], np.repeat(self.pairs[n_fixed_pairs:], 2)])
        return Poles(real, pairs)

    def without(self, others: Poles) -> Poles:
        """These poles, each of the others taken away once. Raises ValueError if one is not among them.

        Equal means bit by bit; of equal ones the first is taken away.
        """
        remaining_of_type = []
        for poles, taken_away in ((self.real, others.real), (self.pairs, others.pairs)):
            remaining = poles.tolist()
            for pole in taken_away.tolist():
                if pole not in remaining:
                    raise ValueError(f"{pole:.6g} is not among the poles")
                remaining.remove(pole)
            remaining_of_type.append(remaining)
        return Poles(*remaining_of_type)

    def moved(self, changes: RealArray) -> Poles:
        """These poles after changes (B,): of each real pole, then of real and imaginary part of each pair.

        B = R + 2 P, no unit. Raises ValueError if a pole leaves the circle, or a pair the upper half plane,
        or (numpy's) for another number of changes.
        """
        n_real = self.real.size
        # A row (real, imaginary) for each pair, then as complex numbers.
        by_pair = changes[n_real:].reshape(-1, 2)
        return Poles(self.real + changes[:n_real], self.pairs + by_pair @ (1, 1j))

    def appended(self, other: Poles) -> Poles:
        """These poles and then the other's, real before pairs; equal ones are not refused, they repeat."""
        return Poles(np.concatenate([self.real, other.real]), np.concatenate([self.pairs, other.pairs]))

    def omega_rad_s(self, dt_s: float) -> RealArray:
        """Undamped natural frequency |log p|/dt of each pair, (P,), rad/s. dt_s: s, positive, not checked."""
        return np.asarray(np.abs(np.log(self.pairs)) / dt_s, dtype=np.float64)

    def zeta(self) -> RealArray:
        """Damping ratio -Re log p / |log p| of each pair, (P,), in (0, 1), of any sampling time."""
        log = np.log(self.pairs)
        return np.asarray(-log.real / np.abs(log), dtype=np.float64)

    def decay_per_s(self, dt_s: float) -> RealArray:
        """Decay rate -log(a)/dt of each real pole, (R,), 1/s.

        A pole a <= 0 has no real continuous-time counterpart: its rate is -log|a|/dt, infinite at a = 0.
        dt_s: s, positive, not checked.
        """
        # A pole at zero is a sample of delay: infinitely fast, and no reason for a warning.
        with np.errstate(divide="ignore"):
            rate = -np.log(np.abs(self.real)) / dt_s
        return np.asarray(rate, dtype=np.float64)


# A basis without functions; also "no unstable poles" and "no fixed poles".
NO_POLES = Poles()

# Modulus below which a pole stands for a sample of delay, or part of one: it falls to a fifth within a
# sample. Chosen below .37, the pole of a lag as long as the sampling time, which is a lag and no delay.
DEADBEAT = 0.2
