"""The machine: rig, beam modes, motor, effects, sensors, excitation signals, simulation."""

from plant.effects import EFFECTS, Effect, parse_effect, parse_effects
from plant.excitation import bang_bang, crest_factor, doublet, log_chirp, multisine, multisine_lines, prbs
from plant.experiment_plan import ExperimentPlan
from plant.modal import linear_arm
from plant.presets import paper_link
from plant.rig import Rig, parameter_keys
from plant.simulate import SampledArm, Trajectory, simulate

__all__ = [
    "EFFECTS",
    "Effect",
    "ExperimentPlan",
    "Rig",
    "SampledArm",
    "Trajectory",
    "bang_bang",
    "crest_factor",
    "doublet",
    "linear_arm",
    "log_chirp",
    "multisine",
    "multisine_lines",
    "paper_link",
    "parameter_keys",
    "parse_effect",
    "parse_effects",
    "prbs",
    "simulate",
]
