"""Structured controllers: a cascade of first- and second-order sections in the Tustin plane.

With p = (2/dt)(z - 1)/(z + 1)/scale (on the circle p = j (2/dt) tan(omega dt/2)/scale) the controller is K =
prod (n2 p^2 + n1 p + n0)/(p^2 + e^a p + e^b) times, for odd orders, (n1 p + n0)/(p + e^a), times (n1 p +
n0)/p for an integrator, times notches (p^2 + e^c p + e^b)/(p^2 + e^a p + e^b). Every parameter vector is
stable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from control_design.plants.ellipses import Complex, Real

SectionKind = Literal["integrator", "first_order", "second_order", "notch"]
_NUMERATORS: dict[SectionKind, int] = {"integrator": 2, "first_order": 2, "second_order": 3, "notch": 1}
_DENOMINATORS: dict[SectionKind, int] = {"integrator": 0, "first_order": 1, "second_order": 2, "notch": 2}

SOLVER_SLACK = 1e-3
"""Relative; a bound on the denominators may be off by the solver's acceptable tolerance (1e-4)."""


@dataclass(frozen=True)
class Cascade:
    """Structure of the controller: section kinds, sampling time and frequency scale of p."""

    sections: tuple[SectionKind, ...]
    dt_s: float
    scale_rad_s: float

    @property
    def order(self) -> int:
        return sum(2 if kind in ("second_order", "notch") else 1 for kind in self.sections)

    @property
    def parameters(self) -> int:
        """Length of the parameter vector: numerators then log denominators, section by section."""
        return sum(_NUMERATORS[kind] + _DENOMINATORS[kind] for kind in self.sections)

    @property
    def pair_positions(self) -> tuple[int, ...]:
        """Where the log denominator (a, b) of each second-order section starts in the parameter vector."""
        positions, at = [], 0
        for kind in self.sections:
            if kind in ("second_order", "notch"):
                positions.append(at + _NUMERATORS[kind])
            at += _NUMERATORS[kind] + _DENOMINATORS[kind]
        return tuple(positions)

    def least_damping(self, x: Sequence[float] | Real) -> float:
        """Smallest damping ratio of the second-order denominators in p; infinite without any."""
        values = np.asarray(x, dtype=np.float64)
        ratios = [0.5 * np.exp(values[at] - 0.5 * values[at + 1]) for at in self.pair_positions]
        return float(min(ratios, default=np.inf))

    def split(self, x: Sequence[float] | Real) -> list[tuple[Real, Real]]:
        """(numerator, denominator) coefficients in p of every section, highest power first."""
        values = np.asarray(x, dtype=np.float64)
        if values.shape != (self.parameters,):
            raise ValueError(f"need {self.parameters} parameters for {self.sections}; got {values.shape}")
        return [(np.array(top), np.array(bottom)) for top, bottom in self.split_with(values, np.exp)]

    def split_with(self, x: Any, exp: Callable[[Any], Any]) -> list[tuple[list[Any], list[Any]]]:
        """`split` of a vector of numbers or symbols."""
        pairs, at = [], 0
        for kind in self.sections:
            logs = at + _NUMERATORS[kind]
            numerator = [x[i] for i in range(at, logs)]
            tail = [exp(x[i]) for i in range(logs, logs + _DENOMINATORS[kind])]
            if kind == "notch":  # parameters: log of the numerator's damping term, then the log denominator
                numerator = [1.0, exp(x[at]), tail[1]]
            pairs.append((numerator, [1.0, *(tail or [0.0])]))
            at = logs + _DENOMINATORS[kind]
        return pairs

    def response(self, x: Sequence[float] | Real, omega_rad_s: Real) -> Complex:
        """K(e^{j omega dt}), (F,); omega below pi/dt (at Nyquist p is infinite: the limit is used)."""
        p = 1j * tustin_frequency(omega_rad_s, self.dt_s) / self.scale_rad_s
        value = np.ones(p.shape, dtype=np.complex128)
        for numerator, denominator in self.split(x):
            # Divide both by the leading power, so that p ~ 1e16 at Nyquist stays exact.
            big = np.abs(p) > 1.0
            q = np.where(big, 1.0 / np.where(big, p, 1.0), 0.0)
            direct = np.polyval(numerator, np.where(big, 0.0, p)) / np.where(
                big, 1.0, np.polyval(denominator, np.where(big, 1.0, p))
            )
            inverted = np.polyval(numerator[::-1], q) / np.polyval(denominator[::-1], q)
            value = value * np.where(big, inverted, direct)
        return value

    def roots(self, x: Sequence[float] | Real) -> Complex:
        """Zeros and poles of all sections in z, (n,); those at infinity left out."""
        h = self.dt_s * self.scale_rad_s / 2.0
        p = np.concatenate([np.roots(part) for pair in self.split(x) for part in pair])
        p = p[np.abs(1.0 - h * p) > 1e-12]
        return np.asarray((1.0 + h * p) / (1.0 - h * p), dtype=np.complex128)

    def state_space(self, x: Sequence[float] | Real) -> tuple[Real, Real, Real, Real]:
        """Discrete (A, B, C, D) of the cascade, every section by the trapezoidal rule: x' = F x + g u becomes
        A = (I - F h)^-1 (I + F h), h = dt scale/2."""
        h = self.dt_s * self.scale_rad_s / 2.0
        a: Real = np.zeros((0, 0))
        b: Real = np.zeros((0, 1))
        c: Real = np.zeros((1, 0))
        d: Real = np.ones((1, 1))
        for numerator, denominator in self.split(x):
            aj, bj, cj, dj = _tustin_section(numerator, denominator, h)
            n, m = a.shape[0], aj.shape[0]
            a = np.block([[a, np.zeros((n, m))], [bj @ c, aj]])
            b = np.vstack([b, bj @ d])
            c = np.hstack([dj @ c, cj])
            d = dj @ d
        return a, b, c, d


def tustin_frequency(omega_rad_s: Real, dt_s: float) -> Real:
    """v = (2/dt) tan(omega dt/2): the imaginary axis of the Tustin plane."""
    return np.asarray(2.0 / dt_s * np.tan(np.asarray(omega_rad_s) * dt_s / 2.0), dtype=np.float64)


def imaginary_axis(omega_rad_s: Real, dt_s: float) -> Complex:
    """s = j (2/dt) tan(omega dt/2), where weights and sections are evaluated."""
    return np.asarray(1j * tustin_frequency(omega_rad_s, dt_s), dtype=np.complex128)


def _tustin_section(numerator: Real, denominator: Real, h: float) -> tuple[Real, Real, Real, Real]:
    """Balanced companion of numerator/denominator in p, mapped by the trapezoidal rule with step 2 h.

    The rule needs (I - h F)^-1; for one or two states it is written out, since searches build many loops.
    The symmetric split sqrt(2h) on input and output keeps both of one size.
    """
    direct = float(numerator[0])
    tail = [float(value) for value in numerator[1:] - direct * denominator[1:]]
    root = float(np.sqrt(2.0 * h))
    if denominator.size == 2:
        f = -float(denominator[1])
        inverse = 1.0 / (1.0 - h * f)
        return (
            np.array([[(1.0 + h * f) * inverse]]),
            np.array([[root * inverse]]),
            np.array([[root * tail[0] * inverse]]),
            np.array([[direct + h * tail[0] * inverse]]),
        )
    # States (w0 x, x') with w0 = sqrt(e^b): both of one size around the section's own frequency.
    # F = [[0, w0], [-w0, -d]], g = (0, 1)', row = (tail1/w0, tail0).
    w0, d = float(np.sqrt(denominator[2])), float(denominator[1])
    v = h * w0
    scale = 1.0 / (1.0 + h * d + v * v)  # 1/det(I - h F)
    inverse_2 = np.array([[(1.0 + h * d) * scale, v * scale], [-v * scale, scale]])
    through = np.array([[tail[1] / w0, tail[0]]]) @ inverse_2
    # (I - hF)^-1 (I + hF) = 2 (I - hF)^-1 - I
    a = 2.0 * inverse_2
    a[0, 0] -= 1.0
    a[1, 1] -= 1.0
    return a, root * inverse_2[:, 1:], root * through, np.array([[direct + h * float(through[0, 1])]])
