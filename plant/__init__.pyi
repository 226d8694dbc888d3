from .effects import (
    EFFECTS as EFFECTS,
    Effect as Effect,
    parse_effect as parse_effect,
    parse_effects as parse_effects,
)
from .excitation import (
    bang_bang as bang_bang,
    crest_factor as crest_factor,
    doublet as doublet,
    log_chirp as log_chirp,
    multisine as multisine,
    multisine_lines as multisine_lines,
    prbs as prbs,
)
from .experiment_plan import ExperimentPlan as ExperimentPlan
from .modal import linear_arm as linear_arm
from .presets import paper_link as paper_link, two_link_arm as two_link_arm
from .rig import Rig as Rig, parameter_keys as parameter_keys
from .simulation import SampledArm as SampledArm, Trajectory as Trajectory, simulate as simulate
from .two_link import TwoLinkArm as TwoLinkArm, TwoLinkMachine as TwoLinkMachine
