"""Simulated machines: a rig, effects that its data sheet lacks, and records of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flexlink.models import Record
from flexlink.shown import Shown, dressed
from plant import simulation
from plant.effects import Effect, parse_effect
from plant.excitation import multisine, prbs
from plant.presets import paper_link
from plant.rig import Rig
from plant.simulation import SampledArm

__all__ = ["Rig", "SampledArm", "Simulation", "effect", "multisine", "paper_link", "prbs", "simulate"]


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Shown, simulation.Trajectory):
    """A simulated experiment: fields as in `plant.Trajectory`; `record` makes a `Record` of it."""

    @property
    def dt_s(self) -> float:
        return float(self.time_s[1])

    def record(self, output: str = "hub_angle_rad", name: str = "simulated") -> Record:
        """Voltage and one measured output, `hub_angle_rad` or `tip_m`, as a `Record`."""
        if output not in SampledArm.output_names:
            raise ValueError(f"no output {output!r}; there are {', '.join(SampledArm.output_names)}")
        return Record(
            self.voltage_V, getattr(self, output), self.dt_s,
            name=name, input_names=("voltage_V",), output_names=(output,),
        )  # fmt: skip


def effect(name: str, **parameters: Any) -> Effect:
    """An effect that a rig file does not describe: friction, backlash, delay, ... (`plant.EFFECTS`).

    Raises ValueError for an unknown name (and lists the known ones) or an unsuitable parameter.

    Examples
    --------
    >>> flexlink.effect("coulomb_friction", torque_Nm=0.02)
    CoulombFriction(torque_Nm=0.02)
    """
    return parse_effect({"name": name, **parameters})


def simulate(
    rig: Rig,
    voltage_V: npt.ArrayLike,
    effects: Sequence[Effect] = (),
    *,
    rng: np.random.Generator | None = None,
    **settings: Any,
) -> Simulation:
    """Drive a machine from rest with a held voltage (T,); arguments as in `plant.simulate`.

    Examples
    --------
    >>> arm = flexlink.simulate(flexlink.paper_link(), flexlink.prbs(8, 4, 6.0, 500), rng=default_rng(1))
    >>> arm
    Simulated 500 samples, every 0.005 s: hub to 1.77 rad, tip to 1.92 m
    >>> arm.record("tip_m").output.shape
    (500, 1)
    """
    result = simulation.simulate(rig, voltage_V, effects, rng=rng, **settings)
    return dressed(Simulation, result)
