"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

from diagnosis.case import Case, Experiment
from diagnosis.hypotheses import Hypothesis, probabilities
from diagnosis.residual import ResidualModel, pooled_rms
from diagnosis.search import Search, search

__all__ = [
    "Case",
    "Experiment",
    "Hypothesis",
    "ResidualModel",
    "Search",
    "pooled_rms",
    "probabilities",
    "search",
]
