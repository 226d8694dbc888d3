"""From an uncertain frequency response to a certified controller."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from control_design.analysis.certificate import Certificate, certify
    from control_design.analysis.closed_loop import (
        ClosedLoopTrajectory,
        LinearMachine,
        SampledMachine,
        simulate,
        step_metrics,
    )
    from control_design.controllers.c_code import c_source
    from control_design.controllers.controller import Controller
    from control_design.convex.convex_options import ReferenceFilterOptions, YoulaOptions
    from control_design.convex.reference_filter import design_reference_filter
    from control_design.convex.youla import youla_bracket
    from control_design.plants.ellipses import Ellipses
    from control_design.plants.guards import Guard
    from control_design.plants.plant_set import Channel, UncertainPlant
    from control_design.plants.weights import RationalWeight
    from control_design.specification import Specification, SpecificationError
    from control_design.specification.requirement import LoopFunction
    from control_design.synthesis.joint_synthesis import synthesise_jointly
    from control_design.synthesis.synthesis import synthesise
    from control_design.synthesis.synthesis_options import SynthesisOptions
    from control_design.synthesis.synthesis_result import Outcome, SynthesisError, SynthesisResult

__all__ = [
    "Certificate",
    "Channel",
    "ClosedLoopTrajectory",
    "Controller",
    "Ellipses",
    "Guard",
    "LinearMachine",
    "LoopFunction",
    "Outcome",
    "RationalWeight",
    "ReferenceFilterOptions",
    "SampledMachine",
    "Specification",
    "SpecificationError",
    "SynthesisError",
    "SynthesisOptions",
    "SynthesisResult",
    "UncertainPlant",
    "YoulaOptions",
    "c_source",
    "certify",
    "design_reference_filter",
    "simulate",
    "step_metrics",
    "synthesise",
    "synthesise_jointly",
    "youla_bracket",
]

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


def __getattr__(name: str) -> Any:
    """PEP 562: a specification is read before what designs for it is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'control_design' has no attribute {name!r}")
    value = getattr(import_module(f"control_design.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
