"""Friction beyond the first spring of an arm: at the load of a belt, a shaft or a harmonic drive.

The load of a motor that is held still swings at the lowest zero of the motor's response. Nothing but friction
acts on the load, so that it follows the motor as Z = omega^2 / (s^2 + 2 zeta omega s + omega^2), and by
reciprocity a torque at the load moves the motor as Z times as much at the motor does. Neglected: what the
load's friction does to the load's own motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.signal import bilinear, lfilter

from ident.basis.model import GobfModel
from ident.data.arrays import RealArray
from ident.friction.inverse_dynamics import direction_of

# A zero that is damped more than this, or lies above the first mode, is no load behind a spring.
_LARGEST_DAMPING = 0.5


@dataclass(frozen=True)
class Spring:
    """How the load follows the motor; omega_rad_s, zeta: of the load with the motor held still."""

    omega_rad_s: float
    zeta: float
    dt_s: float

    @classmethod
    def of(cls, model: GobfModel) -> Spring | None:
        """From the lowest zero below the first mode of a model of the motor's position, if there is one."""
        zeros = model.zeros()
        rates = np.log(zeros[zeros.imag > 0]) / model.dt_s
        zeta = np.abs(rates.real) / np.abs(rates)
        modes = model.poles.omega_rad_s(model.dt_s)[model.poles.zeta() < _LARGEST_DAMPING]
        low = (zeta < _LARGEST_DAMPING) & (np.abs(rates) < modes.min(initial=np.inf))
        if not (modes.size and np.any(low)):
            return None
        k = int(np.flatnonzero(low)[np.argmin(np.abs(rates[low]))])
        return cls(float(np.abs(rates[k])), float(zeta[k]), model.dt_s)

    def force(self, position: RealArray, presliding: float) -> RealArray:
        """(T,) friction of unit level at the load of a motor at position (T,), as it acts at the motor."""
        return self._followed(direction_of(self._followed(position - position[0]), presliding))

    @cached_property
    def _filter(self) -> tuple[RealArray, RealArray]:
        square = self.omega_rad_s**2
        return bilinear([square], [1.0, 2 * self.zeta * self.omega_rad_s, square], 1 / self.dt_s)

    def _followed(self, signal: RealArray) -> RealArray:
        return np.asarray(lfilter(*self._filter, signal))
