"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.answer import Diagnosis, NamedEffect
from diagnosis.diagnosis import diagnose
from diagnosis.fit.residual import ResidualModel, pooled_rms
from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.own_plant import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment

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
]
