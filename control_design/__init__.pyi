from .analysis.certificate import Certificate as Certificate, certify as certify
from .analysis.closed_loop import (
    ClosedLoopTrajectory as ClosedLoopTrajectory,
    LinearMachine as LinearMachine,
    SampledMachine as SampledMachine,
    simulate as simulate,
    step_metrics as step_metrics,
)
from .analysis.multivariable_certificate import (
    DiskMargin as DiskMargin,
    MultivariableCertificate as MultivariableCertificate,
    certify_multivariable as certify_multivariable,
)
from .controllers.c_code import c_source as c_source
from .controllers.controller import Controller as Controller
from .convex.convex_options import (
    ReferenceFilterOptions as ReferenceFilterOptions,
    YoulaOptions as YoulaOptions,
)
from .convex.reference_filter import design_reference_filter as design_reference_filter
from .convex.youla import youla_bracket as youla_bracket
from .plants.ellipses import Ellipses as Ellipses
from .plants.guards import Guard as Guard
from .plants.multivariable import MultivariablePlant as MultivariablePlant, ResponseBall as ResponseBall
from .plants.plant_set import PlantChannel as PlantChannel, UncertainPlant as UncertainPlant
from .plants.weights import RationalWeight as RationalWeight
from .specification import Specification as Specification, SpecificationError as SpecificationError
from .specification.multivariable import MultivariableSpecification as MultivariableSpecification
from .specification.requirement import LoopFunction as LoopFunction
from .synthesis.joint_synthesis import synthesise_jointly as synthesise_jointly
from .synthesis.multivariable import (
    MultivariableResult as MultivariableResult,
    synthesise_multivariable as synthesise_multivariable,
)
from .synthesis.synthesis import synthesise as synthesise
from .synthesis.synthesis_options import (
    MultivariableOptions as MultivariableOptions,
    SynthesisOptions as SynthesisOptions,
)
from .synthesis.synthesis_result import (
    Outcome as Outcome,
    SynthesisResult as SynthesisResult,
)
