"""From an uncertain frequency response to a certified controller."""

from control_design.between_grid_points import AllFrequencies
from control_design.c_code import c_header, c_source
from control_design.certificate import Certificate, PlantVerdict, SpecificationItem, certify
from control_design.closed_loop import (
    ClosedLoopTrajectory,
    LinearMachine,
    SampledMachine,
    StepMetrics,
    simulate,
    step_metrics,
)
from control_design.controller import Controller, ControllerStepper
from control_design.ellipses import Ellipses
from control_design.guards import Guard
from control_design.joint_coverage import JointCoverage
from control_design.joint_synthesis import JointDesign, synthesise_jointly
from control_design.margins import Margins
from control_design.plant_set import Channel, Mode, UncertainPlant
from control_design.prefilter import Prefilter, PrefilterOptions, design_prefilter
from control_design.specification import Specification, SpecificationError
from control_design.synthesis import SynthesisOptions, synthesise
from control_design.synthesis_result import (
    BlockingPoint,
    Outcome,
    StartReport,
    SynthesisError,
    SynthesisResult,
)
from control_design.weights import RationalWeight
from control_design.youla import YoulaBracket, YoulaOptions, youla_bracket

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
    "Margins",
    "Mode",
    "Outcome",
    "PlantVerdict",
    "Prefilter",
    "PrefilterOptions",
    "RationalWeight",
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
    "design_prefilter",
    "simulate",
    "step_metrics",
    "synthesise",
    "synthesise_jointly",
    "youla_bracket",
]
