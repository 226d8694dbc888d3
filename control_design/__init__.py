"""From an uncertain frequency response to a certified controller."""

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
from control_design.convex.reference_filter import ReferenceFilterOptions, design_reference_filter
from control_design.convex.youla import YoulaOptions, youla_bracket
from control_design.plants.ellipses import Ellipses
from control_design.plants.guards import Guard
from control_design.plants.plant_set import Channel, UncertainPlant
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification, SpecificationError
from control_design.specification.requirement import LoopFunction
from control_design.synthesis.joint_synthesis import synthesise_jointly
from control_design.synthesis.synthesis import SynthesisOptions, synthesise
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
