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

# Damping ratio above which a zero is no load behind a spring, nor a pole its mode. Chosen; twice as much
# would admit zeros that do not swing.
_LARGEST_DAMPING = 0.5
# Frequency at which the inertia is read off, as a share of the zero's. Chosen: below the zero, where the arm
# is an inertia.
_RIGID = 0.5


@dataclass(frozen=True)
class Spring:
    """How the load of an arm follows its motor.

    Attributes
    ----------
    omega_rad_s, zeta : float
        Frequency and damping ratio of the load with the motor held still.
    compliance : float
        Of the spring, in output units per input unit; 0 where it does not show.
    dt_s : float
        Step of the records, s.
    """

    omega_rad_s: float
    zeta: float
    compliance: float
    dt_s: float

    @classmethod
    def of(cls, model: GobfModel) -> Spring | None:
        """Spring and load that a model of the motor's position shows by its lowest zero.

        Parameters
        ----------
        model : GobfModel
            Of the response from input to the motor's position, without friction.

        Returns
        -------
        Spring or None
            None where no lightly damped zero has a lightly damped mode above it.

        Notes
        -----
        Below the zero the arm is an inertia J, bent up by the zero and down by the mode above it; the load's
        share of J is 1 - (zero / mode)^2, and its spring's stiffness that share times zero^2.
        """
        zeros = model.zeros()
        # Logarithms of the zeros in the upper half plane over the step: zeros in continuous time, rad/s.
        upper = zeros.imag > 0
        rates = np.log(zeros[upper]) / model.dt_s
        zero_zeta = np.abs(rates.real) / np.abs(rates)
        pole_zeta = model.poles.zeta()
        modes_rad_s = np.where(pole_zeta < _LARGEST_DAMPING, model.poles.omega_rad_s(model.dt_s), 0.0)
        candidate = (zero_zeta < _LARGEST_DAMPING) & (np.abs(rates) < modes_rad_s.max(initial=0.0))
        if not np.any(candidate):
            return None
        lowest = int(np.flatnonzero(candidate)[np.argmin(np.abs(rates[candidate]))])
        zero = float(np.abs(rates[lowest]))
        above = int(np.argmin(np.where(modes_rad_s > zero, modes_rad_s, np.inf)))
        pole = float(modes_rad_s[above])

        # Below the zero the arm is an inertia, of which the load's share sets the mode apart from the zero.
        omega = _RIGID * zero
        late_samples = model.input_delay_samples + 0.5
        undelayed = np.exp(1j * omega * model.dt_s * late_samples)
        stiffness = 1 / (undelayed * model.frequency_response(np.array([omega]))[0])
        bend_of_zero = 1 - (omega / zero) ** 2 + 2j * zero_zeta[lowest] * omega / zero
        bend_of_pole = 1 - (omega / pole) ** 2 + 2j * pole_zeta[above] * omega / pole
        inertia = -float(np.real(stiffness * bend_of_zero / bend_of_pole)) / omega**2
        load = inertia * (1 - (zero / pole) ** 2)
        compliance = 1 / (load * zero**2) if load > 0 else 0.0
        return cls(zero, float(zero_zeta[lowest]), compliance, model.dt_s)

    def force(self, position: RealArray, level: float, law: FrictionLaw) -> RealArray:
        """Friction at the load per unit of its level, as it acts at the motor.

        Parameters
        ----------
        position : ndarray, shape (T,)
            Of the motor, output units.
        level : float
            Of the load's friction, units of the input; it holds the load where the spring pulls less.
        law : FrictionLaw
            Of the motor; the load's friction falls with speed alike.

        Returns
        -------
        ndarray, shape (T,)
            Without unit, held over each sample; the load starts at rest with the motor.
        """
        force = np.empty(position.size)
        behind_motor(position - position[0], self.array(level, law), self.dt_s, force)
        return force

    def array(self, level: float, law: FrictionLaw) -> RealArray:
        """Numbers (6,) by which `ident.friction.kernel.hold_load` steps the load.

        Frequency (rad/s), damping ratio, level as an acceleration (output units / s^2), Stribeck excess per
        unit of the level, the speed (output units / s) above which that is gone, level (units of the input).
        `level` and `law` are those of `force`.
        """
        acceleration = level * self.compliance * self.omega_rad_s**2
        excess = law.excess / max(law.level, np.finfo(np.float64).tiny)
        return np.array([self.omega_rad_s, self.zeta, acceleration, excess, law.fall, level])
