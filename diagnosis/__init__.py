"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.case import Case, Experiment
from diagnosis.diagnosis import Diagnosis, NamedEffect, diagnose
from diagnosis.discrimination import Rival
from diagnosis.experiment_choices import Limits
from diagnosis.hypotheses import Hypothesis, Probabilities, probabilities
from diagnosis.next_experiment import NextExperiment
from diagnosis.own_plant import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.residual import ResidualModel, pooled_rms
from diagnosis.rivals import rivals_of
from diagnosis.search import Search, search
from diagnosis.where_records import Where

__all__ = [
    "Case",
    "Diagnosis",
    "EffectParameter",
    "Experiment",
    "Hypothesis",
    "Limits",
    "NamedEffect",
    "NextExperiment",
    "Plant",
    "PlantCase",
    "PlantEffect",
    "PlantExperiment",
    "Probabilities",
    "ResidualModel",
    "Rival",
    "Search",
    "Where",
    "diagnose",
    "pooled_rms",
    "probabilities",
    "rivals_of",
    "search",
]
