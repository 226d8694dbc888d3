"""Simulated machines: a rig, effects that its data sheet lacks, and records of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from flexlink.keywords import front_door
from ident.data.keywords import clear_constructor, refuse_rate
from ident.data.record import Record
from ident.data.shown import Shown
from plant import excitation, modal, presets, simulation
from plant.effects import Effect, parse_effect
from plant.plan import SUBSTEP_S
from plant.rig import Rig

__all__ = [
    "Rig",
    "SampledArm",
    "Simulation",
    "effect",
    "linear_arm",
    "multisine",
    "paper_link",
    "prbs",
    "simulate",
]

# Functions of `plant`, on one thread and with calls refused in a line.
linear_arm = front_door(modal.linear_arm)
multisine = front_door(excitation.multisine)
paper_link = front_door(presets.paper_link)
prbs = front_door(excitation.prbs)


@clear_constructor
class SampledArm(simulation.SampledArm):
    __doc__ = simulation.SampledArm.__doc__


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Shown, simulation.Trajectory):
    """A simulated experiment of T samples; `record` makes a `Record` of it. All arrays (T,), read-only.

    Attributes
    ----------
    time_s : ndarray
        Instants of the samples, s.
    voltage_V : ndarray
        Commanded voltage, held from its instant to the next.
    hub_angle_rad, tip_m : ndarray
        As measured, before the voltage of the same row takes effect: with effects of the sensors, and with
        noise if the simulation was given a generator.
    hub_angle_true_rad, tip_true_m : ndarray
        Before every effect of a sensor and without noise.
    tip_acceleration_m_s2 : ndarray
        Zero unless an accelerometer was asked for.
    hub_speed_rad_s, tip_deflection_m : ndarray
        Speed of the hub, and deflection of the tip from the straight link, as measured.

    Raises
    ------
    ValueError
        An array has another shape than the others.

    Examples
    --------
    >>> run = flexlink.simulate(flexlink.paper_link(), flexlink.prbs(8, 4, 6.0, 500))
    >>> run.hub_angle_rad.shape, run.record("tip_m").dt_s
    ((500,), 0.005)
    """

    @property
    def dt_s(self) -> float:
        return float(self.time_s[1])

    def record(self, output: str = "hub_angle_rad", name: str = "simulated") -> Record:
        """Voltage and one signal of the machine, as `hub_angle_rad` or `tip_m`, as a `Record`."""
        # What is measured: all but time and input.
        signals = [each.name for each in fields(self) if each.name not in ("time_s", "voltage_V")]
        if output not in signals:
            raise ValueError(f"no output {output!r}; there are {', '.join(signals)}")
        signal = getattr(self, output)
        return Record(
            self.voltage_V, signal, self.dt_s, name=name, input_names="voltage_V", output_names=output
        )


@front_door
def effect(name: str, **parameters: Any) -> Effect:
    """Return an effect that a rig file does not describe: friction, backlash, delay and others.

    Parameters
    ----------
    name : str
        Of one of `plant.EFFECTS`, as "coulomb_friction" or "backlash".
    **parameters
        Its sizes, their units in the names: `torque_Nm=0.02`.

    Returns
    -------
    Effect
        For `simulate` and `SampledArm`.

    Raises
    ------
    ValueError
        An unknown name (the message lists the known ones) or an unsuitable parameter.

    Examples
    --------
    >>> flexlink.effect("coulomb_friction", torque_Nm=0.02)
    CoulombFriction(torque_Nm=0.02)
    """
    return parse_effect({"name": name, **parameters})


@front_door
def simulate(
    rig: Rig,
    voltage_V: npt.ArrayLike,
    effects: Effect | Sequence[Effect] = (),
    *,
    rng: np.random.Generator | int | None = None,
    dt_s: float | None = None,
    hub_torque_Nm: npt.ArrayLike | None = None,
    tip_force_N: npt.ArrayLike | None = None,
    n_modes: int | None = None,
    substep_s: float = SUBSTEP_S,
) -> Simulation:
    """Drive a machine from rest with a held voltage.

    Parameters
    ----------
    rig : Rig
        The nominal arm.
    voltage_V : (T,) array
        Commanded voltage, V; before the first sample it is zero.
    effects : Effect or sequence of them
        What the machine has beside the rig.
    rng : numpy Generator or int, optional
        Source of the sensor noise, or its seed; without it there is no noise.
    dt_s : float, optional
        Sampling time, s; by default the rig's.
    hub_torque_Nm, tip_force_N : (T,) array, optional
        Torque on the hub and transverse force at the tip from outside, held over each sample.
    n_modes : int, optional
        Modes of the link; by default those that the sampling time shows.
    substep_s : float
        Longest step, s, where the machine is not linear.

    Returns
    -------
    Simulation

    Raises
    ------
    ValueError
        A signal that is not (T,) or not finite, or an effect given twice.

    Examples
    --------
    >>> arm = flexlink.simulate(flexlink.paper_link(), flexlink.prbs(8, 4, 6.0, 500), rng=default_rng(1))
    >>> arm
    Simulated 500 samples, every 0.005 s: hub to 1.77 rad, tip to 1.92 m
    >>> arm.record("tip_m").output.shape
    (500, 1)
    """
    # 200 would be simulated as one sample in 200 s.
    if dt_s is not None:
        refuse_rate(dt_s)
    trajectory = simulation.simulate(
        rig,
        voltage_V,
        (effects,) if isinstance(effects, Effect) else effects,
        rng=None if rng is None else np.random.default_rng(rng),
        dt_s=dt_s,
        hub_torque_Nm=hub_torque_Nm,
        tip_force_N=tip_force_N,
        n_modes=n_modes,
        substep_s=substep_s,
    )
    # The same fields, with words, pictures and tables.
    return Simulation(**{field.name: getattr(trajectory, field.name) for field in fields(trajectory)})
