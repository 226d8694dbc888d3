"""Rational responses by gain, zeros and poles, for bounds between frequencies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.linalg

from control_design.plants.ellipses import Complex, Real
from control_design.plants.first_order import FirstOrder, Intervals
from control_design.plants.weights import RationalWeight

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, eq=False)
class RationalResponse:
    """gain z^-delay_samples prod (z - q)/prod (z - p)/(z - 1)^integrators.

    zeros_minus_1, poles_minus_1 hold q - 1 and p - 1: slow poles keep their digits that way.
    """

    gain: float
    zeros_minus_1: Complex
    poles_minus_1: Complex
    integrators: int
    dt_s: float
    delay_samples: int = 0

    @classmethod
    def from_state_space(cls, system: control.StateSpace, integrators: int) -> RationalResponse:
        """Zeros and poles of a SISO discrete system; its `integrators` poles nearest z = 1 are put exactly
        there.

        With relative degree r the zeros are the eigenvalues of A + B F, F = -C A^r/(C A^(r-1) B), on the
        subspace where C, CA, ..., C A^(r-1) vanish: exactly n - r of them, none spurious.
        """
        a, b, c = (np.asarray(getattr(system, name), dtype=np.float64) for name in "ABC")
        d = float(np.asarray(system.D)[0, 0])
        n = a.shape[0]
        identity = np.eye(n)
        poles = _eigenvalues(a - identity)
        poles = poles[np.argsort(np.abs(poles), kind="stable")][integrators:]
        if n == 0 or abs(d) > 1e-12 * np.linalg.norm(b) * np.linalg.norm(c):
            zeros = _eigenvalues(a - b @ c / d - identity) if d else np.zeros(0, complex)
            return cls(d, zeros, poles, integrators, float(system.dt))
        rows: list[npt.NDArray[np.float64]] = []
        row, markov = c, 0.0
        while len(rows) < n:
            size = float(np.linalg.norm(row))
            rows.append(row / (size or 1.0))
            markov = float((row @ b)[0, 0])
            if abs(markov) > 1e-12 * size * float(np.linalg.norm(b)):
                break
            row = row @ a
        else:
            return cls(0.0, np.zeros(0, complex), poles, integrators, float(system.dt))
        inside = scipy.linalg.null_space(np.vstack(rows), rcond=1e-13)
        zeros = _eigenvalues(inside.T @ (a - b @ (row @ a) / markov - identity) @ inside)
        return cls(markov, zeros, poles, integrators, float(system.dt))

    @classmethod
    def from_weight(cls, weight: RationalWeight, dt_s: float) -> RationalResponse:
        """A weight in s (up to its sign) seen through s = (2/dt) (z - 1)/(z + 1), in which s - r = (2/dt - r)
        (z - q)/(z + 1) with q = (1 + r dt/2)/(1 - r dt/2)."""
        gain = abs(weight.numerator[0] / weight.denominator[0])
        roots: list[list[complex]] = []
        for coefficients, sign in ((weight.numerator, 1), (weight.denominator, -1)):
            found: list[complex] = []
            for root in np.roots(coefficients):
                scale = 2.0 / dt_s - root
                if abs(scale) < 1e-12 / dt_s:  # q at infinity: s - 2/dt = -(4/dt)/(z + 1)
                    gain *= (4.0 / dt_s) ** sign
                    continue
                gain *= float(abs(scale)) ** sign
                found.append(complex(2.0 * root / scale))
            roots.append(found)
        missing = len(weight.denominator) - len(weight.numerator)
        # Integrators of a weight are roots at s = 0.
        at_one = sum(1 for root in roots[1] if root == 0)
        return cls(
            gain,
            np.array([*roots[0], *([-2.0] * missing)], dtype=np.complex128),
            np.array([root for root in roots[1] if root != 0], dtype=np.complex128),
            at_one,
            dt_s,
        )

    def delayed(self, samples: int) -> RationalResponse:
        """Times z^-samples."""
        return replace(self, delay_samples=self.delay_samples + samples)

    def expand(self, intervals: Intervals, cleared: int = 0) -> FirstOrder:
        """(z - 1)^cleared times the response, to first order on the intervals."""
        result = intervals.constant(self.gain)
        zeros = self.zeros_minus_1[np.argsort(np.abs(self.zeros_minus_1), kind="stable")]
        poles = self.poles_minus_1[np.argsort(np.abs(self.poles_minus_1), kind="stable")]
        for index in range(max(zeros.size, poles.size)):
            # One pole, one zero in turn: partial products keep the size of the whole.
            if index < poles.size:
                result = result.times(intervals.pole(complex(poles[index])))
            if index < zeros.size:
                result = result.times(intervals.zero(complex(zeros[index])))
        if self.delay_samples:
            result = result.times(intervals.shift(-self.delay_samples))
        if cleared != self.integrators:
            result = result.times(intervals.cleared(cleared - self.integrators))
        return result

    def at(self, omega_rad_s: Real) -> Complex:
        """Values at omega (F,)."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        return self.expand(Intervals(omega, np.zeros(omega.size), self.dt_s)).value


def _eigenvalues(matrix: npt.NDArray[np.float64]) -> Complex:
    return np.asarray(np.linalg.eigvals(matrix), dtype=np.complex128)
