"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from importlib import import_module
from typing import Any

_MODULES = {
    "answer": ("Diagnosis", "NamedEffect"),
    "diagnosis": ("diagnose",),
    "fit.residual": ("ResidualModel", "pooled_rms"),
    "machine.case": ("Case", "Experiment"),
    "machine.own_plant": ("Plant", "PlantCase", "PlantExperiment"),
    "machine.plant_effect": ("EffectParameter", "PlantEffect"),
    "machine.with_effects": ("with_effects",),
}
_WHERE = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    """PEP 562: a case file is read before what diagnoses it is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'diagnosis' has no attribute {name!r}")
    value = getattr(import_module(f"diagnosis.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
