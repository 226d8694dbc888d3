"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.diagnosis import Diagnosis, NamedEffect, diagnose
from diagnosis.evidence.hypotheses import Hypothesis, Probabilities, probabilities
from diagnosis.evidence.search import Search, search
from diagnosis.fit.residual import ResidualModel, pooled_rms
from diagnosis.machine.case import Case, Experiment
from diagnosis.machine.own_plant import EffectParameter, Plant, PlantCase, PlantEffect, PlantExperiment
from diagnosis.next_experiment.discrimination import CompetingHypothesis, competing_hypotheses
from diagnosis.next_experiment.experiment_choices import Limits
from diagnosis.next_experiment.next_experiment import NextExperiment
from diagnosis.where.findings import Where

__all__ = [
    "Case",
    "CompetingHypothesis",
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
    "Search",
    "Where",
    "competing_hypotheses",
    "diagnose",
    "pooled_rms",
    "probabilities",
    "search",
]
