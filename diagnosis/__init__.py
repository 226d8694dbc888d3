"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.case import Case, Experiment
from diagnosis.diagnosis import Diagnosis, NamedEffect, diagnose
from diagnosis.hypotheses import Hypothesis, Probabilities, probabilities
from diagnosis.own_plant import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.residual import ResidualModel, pooled_rms
from diagnosis.search import Search, search

__all__ = [
    "Case",
    "Diagnosis",
    "EffectParameter",
    "Experiment",
    "Hypothesis",
    "NamedEffect",
    "Plant",
    "PlantCase",
    "PlantEffect",
    "PlantExperiment",
    "Probabilities",
    "ResidualModel",
    "Search",
    "diagnose",
    "pooled_rms",
    "probabilities",
    "search",
]
