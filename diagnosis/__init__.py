"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.answer import Diagnosis, NamedEffect
from diagnosis.diagnosis import diagnose
from diagnosis.fit.residual import ResidualModel, pooled_rms
from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.own_plant import Plant, PlantCase, PlantExperiment
from diagnosis.machine.plant_effect import EffectParameter, PlantEffect
from diagnosis.machine.with_effects import with_effects

__all__ = [
    "Case",
    "Diagnosis",
    "EffectParameter",
    "Experiment",
    "NamedEffect",
    "Plant",
    "PlantCase",
    "PlantEffect",
    "PlantExperiment",
    "ResidualModel",
    "diagnose",
    "pooled_rms",
    "with_effects",
]
