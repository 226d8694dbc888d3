"""The machine: rig, beam modes, motor, effects, sensors, excitation signals, simulation."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plant.effects import EFFECTS, Effect, parse_effect, parse_effects
    from plant.excitation import bang_bang, crest_factor, doublet, log_chirp, multisine, multisine_lines, prbs
    from plant.experiment_plan import ExperimentPlan
    from plant.modal import linear_arm
    from plant.presets import paper_link
    from plant.rig import Rig, parameter_keys
    from plant.simulation import SampledArm, Trajectory, simulate

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

_MODULES = {
    "effects": ("EFFECTS", "Effect", "parse_effect", "parse_effects"),
    "excitation": (
        *("bang_bang", "crest_factor", "doublet", "log_chirp", "multisine", "multisine_lines", "prbs"),
    ),
    "experiment_plan": ("ExperimentPlan",),
    "modal": ("linear_arm",),
    "presets": ("paper_link",),
    "rig": ("Rig", "parameter_keys"),
    "simulation": ("SampledArm", "Trajectory", "simulate"),
}
_WHERE = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """PEP 562: a rig is read before what simulates it is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'plant' has no attribute {name!r}")
    value = getattr(import_module(f"plant.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
