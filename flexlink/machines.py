"""Simulated machines: a rig, effects that its data sheet lacks, and records of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from flexlink.keywords import front_door
from ident.data.keywords import refuse_rate
from ident.data.record import Record
from ident.data.shown import Shown
from plant import excitation, modal, presets, simulation
from plant.effects import Effect, parse_effect
from plant.plan import SUBSTEP_S
from plant.rig import Rig
from plant.simulation import SampledArm

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


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Shown, simulation.Trajectory):
    """A simulated experiment: fields as in `plant.Trajectory`; `record` makes a `Record` of it."""

    @property
    def dt_s(self) -> float:
        return float(self.time_s[1])

    def record(self, output: str = "hub_angle_rad", name: str = "simulated") -> Record:
        """Voltage and one signal of the machine, as `hub_angle_rad` or `tip_m`, as a `Record`."""
        signals = [each.name for each in fields(self) if each.name not in ("time_s", "voltage_V")]
        if output not in signals:
            raise ValueError(f"no output {output!r}; there are {', '.join(signals)}")
        signal = getattr(self, output)
        return Record(
            self.voltage_V, signal, self.dt_s, name=name, input_names="voltage_V", output_names=output
        )


@front_door
def effect(name: str, **parameters: Any) -> Effect:
    """An effect that a rig file does not describe: friction, backlash, delay, ... (`plant.EFFECTS`).

    Raises ValueError for an unknown name (and lists the known ones) or an unsuitable parameter.

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
    """Drive a machine from rest with a held voltage (T,).

    effects: one or several of `effect`. rng: a generator or the seed of one, for the sensor noise; without it
    there is none. dt_s: sampling time, s (default: the rig's). hub_torque_Nm, tip_force_N: (T,) from outside.
    n_modes: of the link (default: those that the sampling time shows). substep_s: longest step, s, where the
    machine is not linear. Raises ValueError for a signal that is not (T,) or not finite, or an effect given
    twice.

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
