"""Hypotheses about a gap, their evidence, and probabilities over none, every effect and unknown.

A hypothesis is a set of effects with fitted parameters. Residuals of a true hypothesis have variance
1 + delta^2: delta stands for what two correct solvers disagree about, small for smooth effects and larger
where contacts switch. The hypothesis "unknown" is the best of the others with delta free: what is left over
is no noise, and no effect of the list describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from diagnosis.fit import Fit, log_evidence
from plant.effects import EFFECTS

# Solver disagreement in noise deviations (half-normal scale); with play two correct solvers differ by 0.2.
_DISCREPANCY = {"smooth": 0.03, "continuous": 0.06, "jagged": 0.25}
# An unknown cause leaves at least this much beyond the noise, and at most the other.
_UNKNOWN_RANGE = (0.12, 100.0)
# Prior probabilities by number of effects; they are shared equally among the sets of that size.
_PRIOR_NONE, _PRIOR_UNKNOWN = 0.25, 0.1
_PRIOR_COUNT = {1: 0.5, 2: 0.14, 3: 0.01}
_UNKNOWN = ("unknown",)
# Where contacts switch, what two correct solvers disagree about is not white: further effects beside a jagged
# one can follow some of it, so they have to gain more (in log weight) to be believed.
_BESIDE_JAGGED = 20.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A fit and the log of (prior probability times evidence), comparable within a case."""

    fit: Fit
    log_weight: float

    @property
    def names(self) -> tuple[str, ...]:
        return self.fit.names

    @classmethod
    def of(cls, fit: Fit) -> Hypothesis:
        beside = len(fit.names) - 1
        jagged = any(EFFECTS[name].dependence == "jagged" for name in fit.names)
        allowed = _BESIDE_JAGGED * beside if jagged else 0.0
        return cls(fit, log_evidence(fit) + discrepancy_gain(fit) + log_prior(fit.names) - allowed)


def log_prior(names: Sequence[str]) -> float:
    """log prior probability of exactly this set of effects."""
    n = len(EFFECTS)
    if not names:
        return float(np.log(_PRIOR_NONE))
    count = len(names)
    sets = np.prod([(n - i) / (i + 1) for i in range(count)])
    return float(np.log(_PRIOR_COUNT.get(count, 1e-3)) - np.log(sets))


def discrepancy_gain(fit: Fit) -> float:
    """log likelihood gained by the discrepancy that the effects' solvers are allowed, its prior counted."""
    scale = max([_DISCREPANCY["smooth"], *(_DISCREPANCY[EFFECTS[name].dependence] for name in fit.names)])
    n, rss = fit.residuals.size, float(fit.residuals @ fit.residuals)

    def loss(delta: float) -> float:
        return -(_gain(delta, n, rss) - 0.5 * (delta / scale) ** 2)

    best = minimize_scalar(loss, bounds=(0.0, 5 * scale), method="bounded")
    return max(0.0, -float(best.fun))


def unknown_gain(fit: Fit) -> float:
    """log likelihood gained by a discrepancy of any size, log-uniform over its range (Laplace)."""
    n, rss = fit.residuals.size, float(fit.residuals @ fit.residuals)
    low, high = _UNKNOWN_RANGE
    delta = float(np.clip(np.sqrt(max(rss / n - 1, 0.0)), low, high))
    # Curvature of the log likelihood in log delta at its maximum: 2 N (delta^2/(1 + delta^2))^2.
    spread = 1 / np.sqrt(max(2 * n * (delta**2 / (1 + delta**2)) ** 2, 1.0))
    return _gain(delta, n, rss) + float(np.log(spread * np.sqrt(2 * np.pi) / np.log(high / low)))


def _gain(delta: float, n: int, rss: float) -> float:
    """log likelihood with variance 1 + delta^2 over that with variance 1."""
    return float(-0.5 * n * np.log1p(delta**2) + 0.5 * rss * delta**2 / (1 + delta**2))


@dataclass(frozen=True, eq=False)
class Probabilities:
    """What the evidence says, in three views of the same numbers.

    cause : over "none", every effect and "unknown", summing to one: the main cause of the gap. The
        probability of a set of several effects belongs to its first member, found to explain most.
    sets : over sets of effects (sorted names; () is none, ("unknown",) unknown), summing to one.
    presence : effect -> probability that it is there at all, as the main cause or beside another.
    """

    cause: dict[str, float]
    sets: dict[tuple[str, ...], float]
    presence: dict[str, float]

    @property
    def answer(self) -> str:
        """The most probable cause."""
        return max(self.cause, key=self.cause.__getitem__)


def probabilities(hypotheses: Sequence[Hypothesis], *, temperature: float = 1.0) -> Probabilities:
    """Probabilities from the evidence of everything that was fitted.

    temperature > 1 makes the answer less sure than the bare evidence.

    Raises
    ------
    ValueError
        If there is no hypothesis, or the temperature is not above zero.
    """
    if not hypotheses:
        raise ValueError("probabilities need at least one hypothesis")
    if not temperature > 0:
        raise ValueError(f"temperature must be above zero; got {temperature}")
    best: dict[tuple[str, ...], Hypothesis] = {}
    for hypothesis in hypotheses:
        key = tuple(sorted(hypothesis.names))
        if key not in best or hypothesis.log_weight > best[key].log_weight:
            best[key] = hypothesis
    unknown = max(
        log_evidence(h.fit) + unknown_gain(h.fit) + log_prior(h.names) - log_prior(()) for h in hypotheses
    ) + np.log(_PRIOR_UNKNOWN)
    keys = [*best, _UNKNOWN]
    logs = np.array([*(h.log_weight for h in best.values()), unknown]) / temperature
    weight = np.exp(logs - np.max(logs))
    weight /= weight.sum()
    sets = {key: float(p) for key, p in zip(keys, weight, strict=True)}
    cause = {"none": sets.get((), 0.0), **dict.fromkeys(EFFECTS, 0.0), "unknown": sets[_UNKNOWN]}
    presence = dict.fromkeys(EFFECTS, 0.0)
    for key, hypothesis in best.items():
        for name in hypothesis.names[:1]:
            cause[name] += sets[key]
        for name in key:
            presence[name] += sets[key]
    return Probabilities(cause, sets, presence)
