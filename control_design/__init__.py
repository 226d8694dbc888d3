"""From an uncertain frequency response to a certified controller."""

from control_design.analysis.between_grid_points import AllFrequencies
from control_design.analysis.certificate import Certificate, PlantVerdict, certify
from control_design.analysis.closed_loop import (
    ClosedLoopTrajectory,
    LinearMachine,
    SampledMachine,
    StepMetrics,
    simulate,
    step_metrics,
)
from control_design.analysis.joint_coverage import JointCoverage
from control_design.analysis.margins import Margins
from control_design.controllers.c_code import c_header, c_source
from control_design.controllers.controller import Controller, ControllerStepper
from control_design.convex.reference_filter import (
    ReferenceFilter,
    ReferenceFilterOptions,
    design_reference_filter,
)
from control_design.convex.youla import YoulaBracket, YoulaOptions, youla_bracket
from control_design.plants.ellipses import Ellipses
from control_design.plants.guards import Guard
from control_design.plants.plant_set import Channel, Mode, UncertainPlant
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification, SpecificationError
from control_design.specification.requirement import LoopFunction, SpecificationItem
from control_design.synthesis.joint_synthesis import JointDesign, synthesise_jointly
from control_design.synthesis.synthesis import SynthesisOptions, synthesise
from control_design.synthesis.synthesis_result import (
    BlockingPoint,
    Outcome,
    StartReport,
    SynthesisError,
    SynthesisResult,
)

__all__ = [
    "AllFrequencies",
    "BlockingPoint",
    "Certificate",
    "Channel",
    "ClosedLoopTrajectory",
    "Controller",
    "ControllerStepper",
    "Ellipses",
    "Guard",
    "JointCoverage",
    "JointDesign",
    "LinearMachine",
    "LoopFunction",
    "Margins",
    "Mode",
    "Outcome",
    "PlantVerdict",
    "RationalWeight",
    "ReferenceFilter",
    "ReferenceFilterOptions",
    "SampledMachine",
    "Specification",
    "SpecificationError",
    "SpecificationItem",
    "StartReport",
    "StepMetrics",
    "SynthesisError",
    "SynthesisOptions",
    "SynthesisResult",
    "UncertainPlant",
    "YoulaBracket",
    "YoulaOptions",
    "c_header",
    "c_source",
    "certify",
    "design_reference_filter",
    "simulate",
    "step_metrics",
    "synthesise",
    "synthesise_jointly",
    "youla_bracket",
]
