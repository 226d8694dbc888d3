from .answer import Diagnosis as Diagnosis, NamedEffect as NamedEffect
from .diagnosis import diagnose as diagnose
from .fit.residual import ResidualModel as ResidualModel, pooled_rms as pooled_rms
from .machine.around import (
    Actuator as Actuator,
    Body as Body,
    MeasuredBody as MeasuredBody,
    Sensor as Sensor,
)
from .machine.case import Case as Case, Experiment as Experiment
from .machine.own_plant import Plant as Plant, PlantCase as PlantCase, PlantExperiment as PlantExperiment
from .machine.plant_effect import (
    Change as Change,
    EffectParameter as EffectParameter,
    PlantEffect as PlantEffect,
)
from .machine.with_effects import with_effects as with_effects
