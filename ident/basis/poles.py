"""The poles of a basis: real ones and conjugate pairs, inside the unit circle."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from ident.data.arrays import ComplexArray, RealArray, lock


@dataclass(frozen=True, eq=False)
class Poles:
    """Discrete-time poles inside the circle: real (R,), then pairs (P,), each by its pole of the upper half
    plane.

    Zeros (FIR) and equal poles are allowed; the order is that of the basis functions. Raises ValueError if a
    pole is not inside the unit circle, not finite, or of a pair and not above the real axis.
    """

    real: RealArray = field(default_factory=lambda: np.zeros(0))
    pairs: ComplexArray = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))

    def __post_init__(self) -> None:
        lock(self, "real")
        lock(self, "pairs", dtype=np.complex128)
        if self.real.ndim != 1 or self.pairs.ndim != 1:
            raise ValueError(f"poles must be 1-d arrays; got shapes {self.real.shape} and {self.pairs.shape}")
        # Number by number: a search makes tens of these, for a few poles each.
        real, pairs = self.real.tolist(), self.pairs.tolist()
        for pole in (*real, *pairs):
            if not math.hypot(pole.real, pole.imag) < 1:
                raise ValueError(
                    f"every pole must lie inside the unit circle; got {pole:.6g} "
                    f"(|p| = {math.hypot(pole.real, pole.imag):.6g})"
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
        """Real poles exp(-decay dt) and pairs exp((-zeta +- j sqrt(1 - zeta^2)) omega dt), 0 < zeta < 1."""
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
        angle = omega * np.sqrt(1 - damping**2) * dt_s
        if not np.all((angle > 0) & (angle < np.pi)):
            raise ValueError(
                f"the damped frequency of a pair must lie in (0, pi/dt); got {angle / dt_s} rad/s"
            )
        real = np.exp(-np.array(list(decay_per_s), dtype=np.float64) * dt_s)
        return cls(real, np.exp(-damping * omega * dt_s + 1j * angle))

    @property
    def order(self) -> int:
        """Number of poles, a pair counted twice; also the number of basis functions."""
        return int(self.real.size + 2 * self.pairs.size)

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of real poles and of pairs."""
        return self.real.size, self.pairs.size

    @property
    def values(self) -> ComplexArray:
        """All poles (B,): the real ones, then p, conj(p) for each pair."""
        both = np.column_stack([self.pairs, self.pairs.conj()]).ravel()
        return np.concatenate([self.real.astype(np.complex128), both])

    def writable(self) -> tuple[RealArray, ComplexArray]:
        """Copies of real and pairs as compiled code takes them (`ident.data.arrays.kernel_array`)."""
        return self.real.copy(), self.pairs.copy()

    def blocks(self) -> tuple[Poles, ...]:
        """Each real pole and each pair by itself, in order."""
        real = (Poles(real=self.real[i : i + 1]) for i in range(self.real.size))
        return (*real, *(Poles(pairs=self.pairs[i : i + 1]) for i in range(self.pairs.size)))

    def without_real(self, index: int | slice) -> Poles:
        """These poles but the real one (or those) at `index`."""
        return Poles(np.delete(self.real, index), self.pairs)

    def without_pair(self, index: int | slice) -> Poles:
        """These poles but the pair (or those) at `index`."""
        return Poles(self.real, np.delete(self.pairs, index))

    def doubled(self, n_fixed: tuple[int, int] = (0, 0)) -> Poles:
        """Every pole twice, neighbours equal: those of Phi2; the first of each type, fixed,
        once."""
        kept = zip((self.real, self.pairs), n_fixed, strict=True)
        return Poles(*(np.concatenate([part[:n], np.repeat(part[n:], 2)]) for part, n in kept))

    def without(self, others: Poles) -> Poles:
        """These poles, each of the others taken away once. Raises ValueError if one is not among them."""
        kept = []
        for own, theirs in ((self.real, others.real), (self.pairs, others.pairs)):
            left = own.tolist()
            for pole in theirs.tolist():
                if pole not in left:
                    raise ValueError(f"{pole:.6g} is not among the poles")
                left.remove(pole)
            kept.append(left)
        return Poles(*kept)

    def moved(self, changes: RealArray) -> Poles:
        """These poles after changes (order,): of each real pole, then of real and imaginary part of each
        pair. Raises ValueError if one leaves the circle, or a pair the upper half."""
        n = self.real.size
        return Poles(self.real + changes[:n], self.pairs + changes[n:].reshape(-1, 2) @ (1, 1j))

    def appended(self, other: Poles) -> Poles:
        """These poles and then the other's, real before pairs."""
        return Poles(np.concatenate([self.real, other.real]), np.concatenate([self.pairs, other.pairs]))

    def omega_rad_s(self, dt_s: float) -> RealArray:
        """Undamped natural frequency |log p|/dt of each pair, (P,)."""
        return np.asarray(np.abs(np.log(self.pairs)) / dt_s, dtype=np.float64)

    def zeta(self) -> RealArray:
        """Damping ratio of each pair, (P,), in (0, 1); it does not depend on the sampling time."""
        log = np.log(self.pairs)
        return np.asarray(-log.real / np.abs(log), dtype=np.float64)

    def decay_per_s(self, dt_s: float) -> RealArray:
        """Decay rate -log(a)/dt of each real pole, (R,).

        A pole a <= 0 has no real continuous-time counterpart: its rate is -log|a|/dt, infinite at a = 0.
        """
        with np.errstate(divide="ignore"):
            return np.asarray(-np.log(np.abs(self.real)) / dt_s, dtype=np.float64)


NO_POLES = Poles()

DEADBEAT = 0.2
"""Modulus below which a pole stands for a sample of delay, or part of one: it falls to a fifth within a
sample."""
