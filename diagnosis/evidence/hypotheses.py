"""Hypotheses about a gap, their evidence, and probabilities over none, every effect and unknown.

A true set of effects leaves white noise and what two correct solvers disagree about, more where contacts
switch. "unknown" is the best set with something of any size left over.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from diagnosis.evidence.explanation import WeighedFit, best_of_sets
from diagnosis.fit.descent import Fit
from diagnosis.fit.discrepancy import Discrepancy
from diagnosis.fit.likelihood import DECISIVE, SUBSTANTIAL
from diagnosis.fit.solver_spread import NO_DRIFT, Drift
from plant.effects import EFFECTS

# Solver disagreement in noise deviations (half-normal scale); 0.2 between two solvers of backlash.
DISAGREEMENT = {"smooth": 0.03, "continuous": 0.06, "non-smooth": 0.25}
# Prior probabilities by number of effects; they are shared equally among the sets of that size.
_PRIOR_COUNT, PRIOR_UNKNOWN = {0: 0.25, 1: 0.5, 2: 0.14, 3: 0.01}, 0.1
# How probable a cause beyond the list is that looks like an effect, beside the effect.
UNLISTED = 1 / 3
PRIORS = (_PRIOR_COUNT[1], _PRIOR_COUNT[2] + _PRIOR_COUNT[3], PRIOR_UNKNOWN)
_UNKNOWN = ("unknown",)
# An unknown cause beside a set of effects, relative to that set alone.
_UNKNOWN_BESIDE = float(np.log(PRIOR_UNKNOWN / _PRIOR_COUNT[0]))


@dataclass(frozen=True, eq=False)
class Hypothesis(WeighedFit):
    """A fit, what it leaves over, and logs of (prior probability times evidence), comparable within a case.

    log_weight : exactly these effects, with the disagreement their solvers are allowed; -inf for a cause
        beyond the list, which is no answer by itself but part of what is unknown.
    unknown_weight : these effects, none of them perhaps, and something else that no effect describes.
    listed : effects that are looked for.
    """

    log_weight: float
    log_weight_with_unknown: float
    listed: tuple[str, ...] = tuple(EFFECTS)

    @property
    def is_answer(self) -> bool:
        return self.log_weight > -np.inf

    @property
    def log_evidence(self) -> float:
        """Log weight of these effects, alone or with something unknown besides."""
        return max(self.log_weight, self.log_weight_with_unknown)

    @property
    def log_cause_weight(self) -> float:
        """Log weight of these causes alone, which for one beyond the list counts as unknown."""
        return self.log_weight if self.is_answer else self.log_weight_with_unknown

    @classmethod
    def of(
        cls,
        fit: Fit,
        left: Discrepancy,
        drift: Drift = NO_DRIFT,
        listed: tuple[str, ...] = tuple(EFFECTS),
    ) -> Hypothesis:
        """left: what the fit leaves over, of residuals without the drift of correct solvers."""
        # Where contacts switch, what two correct solvers disagree about is not white, and further effects can
        # follow some of it.
        allowed = DECISIVE * (len(fit.names) - 1) if fit.non_smooth else 0.0
        further = sum(len(candidate.axes) - 1 for candidate in fit.candidates)
        # The evidence charges only for parameters that the records determine: an effect that contains another
        # (Stribeck and Coulomb friction) costs nothing where it looks like it; the simpler name is better.
        prior = log_prior(fit.names, len(listed)) - further
        evidence = log_evidence(fit) + drift.log_gain
        exactly = evidence + disagreement_gain(fit, left) + prior - allowed
        besides = evidence + left.log_gain_some + prior - allowed + _UNKNOWN_BESIDE
        if any(c.at_edge(fit.coordinates_of(k)) for k, c in enumerate(fit.candidates)):
            # Something is described well, but not by what the effect is: a period is never completed.
            return cls(fit, exactly - SUBSTANTIAL, max(besides, exactly + _UNKNOWN_BESIDE), listed)
        return cls(fit, exactly, besides, listed)


def log_prior(names: Sequence[str], n: int | None = None) -> float:
    """log prior probability of exactly this set of effects out of n that are listed (None: the registry)."""
    n = len(EFFECTS) if n is None else n
    count = len(names)
    sets = np.prod([(n - i) / (i + 1) for i in range(count)])
    return float(np.log(_PRIOR_COUNT.get(count, 1e-3)) - np.log(sets))


def disagreement_gain(fit: Fit, left: Discrepancy) -> float:
    """log evidence gained by the disagreement that two correct solvers of these effects may have.

    Its size has a half-normal prior, cut off beyond three deviations: more than that is no disagreement.
    """
    z = left.size / max([DISAGREEMENT["smooth"], *(DISAGREEMENT[c.dependence] for c in fit.candidates)])
    # Something unknown may have any size over four decades; this one is known to a factor of three: the log
    # of the ratio of these ranges (in their logarithms).
    expected = SUBSTANTIAL if fit.non_smooth else 0.0
    return max(0.0, left.log_gain - 0.5 * z**2 + expected) if z < 3 else 0.0


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

    def with_certain_effect(self, name: str, *, leads: bool) -> Probabilities:
        """The same answers with one more effect that is certain, in every set but unknown.

        leads: it explains more than whatever else there is.
        """
        certain, cause = 1.0 - self.sets[_UNKNOWN], dict(self.cause)
        if leads:
            cause = {**dict.fromkeys(cause, 0.0), "unknown": cause["unknown"], name: certain}
        else:
            cause[name] += cause["none"]
            cause["none"] = 0.0
        sets = {key if key == _UNKNOWN else tuple(sorted((*key, name))): p for key, p in self.sets.items()}
        return Probabilities(cause, sets, {**self.presence, name: certain})

    def with_untried(
        self, untried: Mapping[str, str], priors: tuple[float, float, float] = PRIORS, *, larger: bool
    ) -> Probabilities:
        """What no candidate explains may be one that was not tried, or a larger set where none was (larger).

        Unknown is shared between these and a cause beyond the list, as their prior probabilities are
        (priors: of one effect, of several, of such a cause).
        """
        cause, presence = dict(self.cause), dict(self.presence)
        listed = dict.fromkeys([*presence, *untried])
        tried = 1 - len(untried) / len(listed)
        one, several, beyond = priors
        missed = one * (1 - tried) + several * (1 - (0.0 if larger else tried**2))
        moved = cause["unknown"] * missed / (missed + beyond)
        sets = {**self.sets, _UNKNOWN: self.sets[_UNKNOWN] - moved}
        cause["unknown"] -= moved
        for name in untried or listed:
            share = moved / len(untried or listed)
            sets[(name,)] = sets.get((name,), 0.0) + share
            for entries in (cause, presence):
                entries[name] = entries.get(name, 0.0) + share
        return Probabilities(cause, sets, presence)

    def counting_as_unknown(self, untried: Iterable[str]) -> Probabilities:
        """What was not tried counts as unknown, of the cause."""
        cause = {name: p for name, p in self.cause.items() if name not in untried}
        cause["unknown"] += sum(self.cause.values()) - sum(cause.values())
        return replace(self, cause=cause)

    @property
    def answer(self) -> str:
        """The most probable cause."""
        return max(self.cause, key=self.cause.__getitem__)


def probabilities(hypotheses: Sequence[Hypothesis]) -> Probabilities:
    """Probabilities from the evidence of everything that was fitted.

    Raises ValueError if there is no hypothesis.
    """
    if not hypotheses:
        raise ValueError("probabilities need at least one hypothesis")
    best = best_of_sets((h for h in hypotheses if h.is_answer), lambda h: h.log_weight)
    unknown, keys = max(h.log_weight_with_unknown for h in hypotheses), [*best, _UNKNOWN]
    logs = np.array([*(h.log_weight for h in best.values()), unknown])
    weight = np.exp(logs - np.max(logs))
    weight /= weight.sum()
    sets = {key: float(p) for key, p in zip(keys, weight, strict=True)}
    listed = hypotheses[0].listed
    cause = {"none": sets.get((), 0.0), **dict.fromkeys(listed, 0.0), "unknown": sets[_UNKNOWN]}
    presence = dict.fromkeys(listed, 0.0)
    for key, hypothesis in best.items():
        for name in hypothesis.names[:1]:
            cause[name] += sets[key]
        for name in key:
            presence[name] += sets[key]
    return Probabilities(cause, sets, presence)


def log_evidence(fit: Fit) -> float:
    """log of the integral of exp(-(|e|^2 + |d|^2)/2) over d (standard normal) and x (`Axis.log_density`).

    Laplace's approximation, cut off at the boxes: along every coordinate that ends at or near a bound, the
    Gaussian (or the slope down from the bound) is integrated over the inside only, given the others at their
    best. Constants common to all hypotheses of a case are left out.
    """
    P, H = fit.deviations.size, fit.hessian
    scale = np.sqrt(np.maximum(np.diag(H), 1e-12))
    scaled = H / np.outer(scale, scale) + 1e-10 * np.eye(scale.size)
    _, logdet = np.linalg.slogdet(scaled)
    logdet += 2 * float(np.sum(np.log(scale)))
    A = H.shape[0] - P
    value = -0.5 * fit.cost - 0.5 * logdet + 0.5 * A * np.log(2 * np.pi)
    if not A:
        return float(value)
    # Of the same matrix as the determinant: a coordinate that nothing depends on integrates to its range.
    spread = (np.sqrt(np.diag(np.linalg.inv(scaled))) / scale)[P:]
    gradient, at = (fit.jacobian.T @ fit.residual_coefficients)[P:], 0
    for k, candidate in enumerate(fit.candidates):
        x = fit.coordinates_of(k)
        value += candidate.log_density(x)
        low, high = candidate.box
        for i in range(x.size):
            value += _inside(x[i], gradient[at], spread[at], low[i], high[i])
            at += 1
    return float(value)


def _inside(x: float, slope: float, spread: float, low: float, high: float) -> float:
    """log of the integral of exp(-slope t - t^2/(2 spread^2)) inside the box, over spread sqrt(2 pi)."""
    if not np.isfinite(low):
        return min(0.0, float(np.log(2 * np.pi / (spread * np.sqrt(2 * np.pi)))))
    # Complete the square only where a bound holds the coordinate; elsewhere the slope is rounding, or a jump.
    held = (x <= low and slope > 0) or (x >= high and slope < 0)
    centre = x - slope * spread**2 if held else x
    shift = 0.5 * (slope * spread) ** 2 if held else 0.0
    a, b = (low - centre) / spread, (high - centre) / spread
    # log(Phi(b) - Phi(a)), from the tail that keeps digits.
    if a > 0:
        a, b = -b, -a
    upper, lower = log_ndtr(b), log_ndtr(a)
    return float(shift + upper + np.log1p(-np.exp(min(lower - upper, -1e-300))))
