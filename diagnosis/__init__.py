"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.diagnosis import Diagnosis, NamedEffect, diagnose
from diagnosis.evidence.hypotheses import Hypothesis, Probabilities, probabilities
from diagnosis.evidence.search import Search, search
from diagnosis.fit.residual import ResidualModel, pooled_rms
from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.own_plant import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.next_experiment.competing import rivals_of
from diagnosis.next_experiment.discrimination import Rival
from diagnosis.next_experiment.experiment_choices import Limits
from diagnosis.next_experiment.next_experiment import NextExperiment
from diagnosis.where.where_records import Where

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
