"""From an uncertain frequency response to a certified controller."""

from importlib import import_module
from typing import Any

_MODULES = {
    "analysis.certificate": ("Certificate", "certify"),
    "analysis.closed_loop": (
        "ClosedLoopTrajectory",
        "LinearMachine",
        "SampledMachine",
        "simulate",
        "step_metrics",
    ),
    "controllers.c_code": ("c_source",),
    "controllers.controller": ("Controller",),
    "convex.convex_options": ("ReferenceFilterOptions", "YoulaOptions"),
    "convex.reference_filter": ("design_reference_filter",),
    "convex.youla": ("youla_bracket",),
    "plants.ellipses": ("Ellipses",),
    "plants.guards": ("Guard",),
    "plants.plant_set": ("Channel", "UncertainPlant"),
    "plants.weights": ("RationalWeight",),
    "specification": ("Specification", "SpecificationError"),
    "specification.requirement": ("LoopFunction",),
    "synthesis.joint_synthesis": ("synthesise_jointly",),
    "synthesis.synthesis": ("synthesise",),
    "synthesis.synthesis_options": ("SynthesisOptions",),
    "synthesis.synthesis_result": ("Outcome", "SynthesisError", "SynthesisResult"),
}
_WHERE = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    """PEP 562: a specification is read before what designs for it is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'control_design' has no attribute {name!r}")
    value = getattr(import_module(f"control_design.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
