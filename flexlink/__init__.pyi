from .causes import Case as Case, Diagnosis as Diagnosis, Experiment as Experiment, diagnose as diagnose
from .design import (
    Certificate as Certificate,
    Controller as Controller,
    LoopRun as LoopRun,
    RationalWeight as RationalWeight,
    Specification as Specification,
    SynthesisOptions as SynthesisOptions,
    SynthesisResult as SynthesisResult,
    UncertainPlant as UncertainPlant,
    c_source as c_source,
    certify as certify,
    simulate_loop as simulate_loop,
    step_metrics as step_metrics,
    synthesise as synthesise,
)
from .machines import (
    Rig as Rig,
    SampledArm as SampledArm,
    Simulation as Simulation,
    effect as effect,
    multisine as multisine,
    paper_link as paper_link,
    prbs as prbs,
    simulate as simulate,
)
from .models import (
    EmbeddingOptions as EmbeddingOptions,
    FrequencyUncertainty as FrequencyUncertainty,
    FrfRepeats as FrfRepeats,
    GobfModel as GobfModel,
    Identification as Identification,
    IdentOptions as IdentOptions,
    Poles as Poles,
    Record as Record,
    Uncertainty as Uncertainty,
    band_limited as band_limited,
    empirical_frf as empirical_frf,
    identify as identify,
    identify_frf as identify_frf,
    identify_miso as identify_miso,
    pole_intervals as pole_intervals,
    uncertainty as uncertainty,
)
from .pictures import bode as bode, compare as compare, plot as plot
from .tables import table as table
