"""The machine: rig, beam modes, motor, effects, sensors, excitation signals, simulation."""

from importlib import import_module
from typing import Any

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
__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    """PEP 562: a rig is read before what simulates it is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'plant' has no attribute {name!r}")
    value = getattr(import_module(f"plant.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
