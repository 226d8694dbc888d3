"""The machine: rig, beam modes, motor, effects, sensors, excitation signals, simulation."""

from plant.effects import EFFECTS, Effect, parse_effect, parse_effects, without
from plant.modal import LinearArm, linear_arm
from plant.rig import Rig
from plant.simulate import SampledArm, Trajectory, simulate

__all__ = [
    "EFFECTS",
    "Effect",
    "LinearArm",
    "Rig",
    "SampledArm",
    "Trajectory",
    "linear_arm",
    "parse_effect",
    "parse_effects",
    "simulate",
    "without",
]
