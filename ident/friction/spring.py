"""Friction beyond the first spring of an arm: at the load of a belt, a shaft or a harmonic drive.

The load follows the motor as Z = (w^2 + 2 zeta w s) / (s^2 + 2 zeta w s + w^2), w, zeta the lowest zero of
the motor's response, less what its friction holds back; by reciprocity a torque at the load moves the motor
as Z times as much at the motor does. The load is stepped behind the motor's position, from rest. Neglected:
further springs; what a weight adds to the stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.basis.model import GobfModel
from ident.data.arrays import RealArray
from ident.friction.arm import FrictionLaw
from ident.friction.kernel import behind_motor

# A zero that is damped more than this is no load behind a spring.
_LARGEST_DAMPING = 0.5
# Of the zero: where the inertia is read off.
_RIGID = 0.5


@dataclass(frozen=True)
class Spring:
    """How the load follows the motor; omega_rad_s, zeta: of the load with the motor held still; compliance:
    of the spring, in output units per input unit, 0 where it does not show."""

    omega_rad_s: float
    zeta: float
    compliance: float
    dt_s: float

    @classmethod
    def of(cls, model: GobfModel) -> Spring | None:
        """From the lowest zero with a mode above it of a model of the motor's position, if there is one."""
        zeros = model.zeros()
        rates = np.log(zeros[zeros.imag > 0]) / model.dt_s
        zeta = np.abs(rates.real) / np.abs(rates)
        of_poles = model.poles.zeta()
        modes = np.where(of_poles < _LARGEST_DAMPING, model.poles.omega_rad_s(model.dt_s), 0.0)
        low = (zeta < _LARGEST_DAMPING) & (np.abs(rates) < modes.max(initial=0.0))
        if not np.any(low):
            return None
        k = int(np.flatnonzero(low)[np.argmin(np.abs(rates[low]))])
        zero = float(np.abs(rates[k]))
        above = int(np.argmin(np.where(modes > zero, modes, np.inf)))
        pole, both = float(modes[above]), (zeta[k], of_poles[above])
        # Below the zero the arm is an inertia, of which the load's share sets the mode apart from the zero.
        at = _RIGID * zero
        late = np.exp(1j * at * model.dt_s * (model.input_delay_samples + 0.5))
        stiff = 1 / (late * model.frequency_response(np.array([at]))[0])
        bends = [
            1 - (at / omega) ** 2 + 2j * damping * at / omega
            for omega, damping in zip((zero, pole), both, strict=True)
        ]
        load = (-float(np.real(stiff * bends[0] / bends[1])) / at**2) * (1 - (zero / pole) ** 2)
        return cls(zero, float(zeta[k]), 1 / (load * zero**2) if load > 0 else 0.0, model.dt_s)

    def force(self, position: RealArray, level: float, law: FrictionLaw) -> RealArray:
        """(T,) friction per unit of its level at the load of a motor at position (T,), as it acts at the
        motor, held over each sample. level: in units of the input; it holds the load where the spring pulls
        less. law: of the motor; that of the load falls with speed alike."""
        found = np.empty(position.size)
        behind_motor(position - position[0], self.array(level, law), self.dt_s, found)
        return found

    def array(self, level: float, law: FrictionLaw) -> RealArray:
        """(6,) for the kernel, as of `force`: frequency, damping, level as an acceleration, excess per unit
        of it and the speed above which that is gone, level."""
        kept = level * self.compliance * self.omega_rad_s**2
        excess = law.excess / max(law.level, np.finfo(np.float64).tiny)
        return np.array([self.omega_rad_s, self.zeta, kept, excess, law.fall, level])
