"""Hypotheses about a gap, their evidence, and probabilities over none, every effect and unknown.

A true set of effects leaves white noise and what two correct solvers disagree about, more where contacts
switch. "unknown" is the best set with something of any size left over (`diagnosis.fit.discrepancy`).
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

# By how much two correct solvers of such an effect differ, RMS in noise deviations: scale of a half-normal
# prior. Two independent solvers of backlash differ by 0.2; matrix exponentials and smooth forces by far less.
# Doubled, no answer of four cases moved (backlash, a short record, nothing, an unlisted cause; `python -m
# benchmarks.frozen_answers --only exact --change`).
DISAGREEMENT = {"smooth": 0.03, "continuous": 0.06, "non-smooth": 0.25}
# Prior probability of sets by their number of effects; it is shared equally among the sets of that number.
# One missing effect is what a user looks for most often, one gap in four has none of the listed ones; two are
# a quarter as frequent as one, three a fourteenth of that. Chosen.
_PRIOR_OF_COUNT = {0: 0.25, 1: 0.5, 2: 0.14, 3: 0.01}
# Prior of larger sets, each number of effects by itself: no search looks for them under known noise. Chosen:
# a tenth of three.
_PRIOR_OF_MORE = 1e-3
# Prior probability of a cause beyond the list: what the numbers of effects above leave.
PRIOR_UNKNOWN = 0.1
# How probable a cause beyond the list that looks like an effect is, as a share of the effect itself. Chosen:
# neither may be ruled out by the prior.
UNLISTED = 1 / 3
# Prior probabilities of one effect, of several, and of a cause beyond the list.
PRIORS = (_PRIOR_OF_COUNT[1], _PRIOR_OF_COUNT[2] + _PRIOR_OF_COUNT[3], PRIOR_UNKNOWN)
# Log odds of an unknown cause beside a set of effects against that set alone: as those of an unknown cause
# against no effect at all. Twice the odds take 0.04 off the probability of a backlash, nothing elsewhere.
_LOG_UNKNOWN_BESIDE = float(np.log(PRIOR_UNKNOWN / _PRIOR_OF_COUNT[0]))
# Beyond so many deviations of their prior, what is left is no disagreement of solvers: 3 in 1000 are.
_LARGEST_DISAGREEMENT = 3.0
# Key of "something that no listed effect describes" among sets of effects.
_UNKNOWN = ("unknown",)
# Added to the Hessian, relative to its diagonal after scaling: only rounding is smaller.
_RIDGE = 1e-10
# Curvature below which a coordinate is taken to change nothing, so that its scale is no division by zero.
_SMALLEST_CURVATURE = 1e-12


@dataclass(frozen=True, eq=False)
class Hypothesis(WeighedFit):
    """A fit under known noise, and the logarithms of its prior probability times its evidence.

    Both logarithms have the same unknown constant for all hypotheses of a case, so that differences count.

    Attributes
    ----------
    log_weight : float
        That the gap is exactly these effects, with the disagreement their solvers are allowed; -inf for a
        cause beyond the list, which is no answer by itself but part of what is unknown.
    log_weight_with_unknown : float
        That it is these effects, none of them perhaps, and something else that no effect describes.
    listed : tuple of str
        Effects that are looked for.
    """

    log_weight: float
    log_weight_with_unknown: float
    listed: tuple[str, ...] = tuple(EFFECTS)

    @property
    def is_answer(self) -> bool:
        """Whether all causes of this hypothesis are listed effects."""
        return self.log_weight > -np.inf

    @property
    def log_evidence(self) -> float:
        """Log weight of these effects, alone or with something unknown besides."""
        return max(self.log_weight, self.log_weight_with_unknown)

    @property
    def log_cause_weight(self) -> float:
        """Log weight of these causes alone; one beyond the list counts as unknown."""
        if self.is_answer:
            return self.log_weight
        return self.log_weight_with_unknown

    @classmethod
    def of(
        cls,
        fit: Fit,
        left: Discrepancy,
        drift: Drift = NO_DRIFT,
        listed: tuple[str, ...] = tuple(EFFECTS),
    ) -> Hypothesis:
        """Weigh a fit.

        Parameters
        ----------
        fit : Fit
            Under white noise of known size.
        left : Discrepancy
            What is left of its residuals beyond noise, once the drift of correct solvers is taken off.
        drift : Drift
            What that drift gained; none where no contacts switch.
        listed : tuple of str
            Effects that are looked for; the prior is shared among their sets.
        """
        # Where contacts switch, what two correct solvers disagree about is not white, and further effects can
        # follow some of it: each must be decisive.
        contact_charge = 0.0
        if fit.non_smooth:
            contact_charge = DECISIVE * (len(fit.names) - 1)
        # The evidence charges only for parameters that the records determine: an effect that contains another
        # (Stribeck and Coulomb friction) costs nothing where it looks like it; the simpler name is better.
        further_parameters = sum(len(candidate.axes) - 1 for candidate in fit.candidates)
        log_prior_of_set = log_prior(fit.names, len(listed)) - further_parameters

        evidence = log_evidence(fit) + drift.log_gain
        exactly = evidence + disagreement_gain(fit, left) + log_prior_of_set - contact_charge
        with_unknown = evidence + left.log_gain_some + log_prior_of_set - contact_charge + _LOG_UNKNOWN_BESIDE
        for k, candidate in enumerate(fit.candidates):
            if candidate.at_edge(fit.coordinates_of(k)):
                # Something is described well, but not by what the effect is: a period is never completed.
                with_unknown = max(with_unknown, exactly + _LOG_UNKNOWN_BESIDE)
                return cls(fit, exactly - SUBSTANTIAL, with_unknown, listed)
        return cls(fit, exactly, with_unknown, listed)


def log_prior(names: Sequence[str], listed_count: int | None = None) -> float:
    """Logarithm of the prior probability of exactly these effects.

    Parameters
    ----------
    names : sequence of str
        Effects of the set; empty for none.
    listed_count : int, optional
        Number of effects that are looked for, at least as many as the set has: with fewer there is no such
        set, and the result is no logarithm of a probability. By default all registered.

    Returns
    -------
    float
        log of `_PRIOR_OF_COUNT`, above three effects of `_PRIOR_OF_MORE`, over the number of sets with as
        many effects, a binomial coefficient.
    """
    if listed_count is None:
        listed_count = len(EFFECTS)
    count = len(names)
    sets = np.prod([(listed_count - i) / (i + 1) for i in range(count)])
    return float(np.log(_PRIOR_OF_COUNT.get(count, _PRIOR_OF_MORE)) - np.log(sets))


def disagreement_gain(fit: Fit, left: Discrepancy) -> float:
    """Log evidence gained by the disagreement that two correct solvers of these effects may have.

    Its size has a half-normal prior, cut off at `_LARGEST_DISAGREEMENT` deviations: more than that is no
    disagreement. At least 0: no hypothesis loses by being allowed one.
    """
    scale = max([DISAGREEMENT["smooth"], *(DISAGREEMENT[c.dependence] for c in fit.candidates)])
    deviations = left.size / scale
    if deviations >= _LARGEST_DISAGREEMENT:
        return 0.0
    # Something unknown may have any size over four decades; this one is known to a factor of three: the log
    # of the ratio of these ranges (in their logarithms).
    expected = 0.0
    if fit.non_smooth:
        expected = SUBSTANTIAL
    return max(0.0, left.log_gain - 0.5 * deviations**2 + expected)


@dataclass(frozen=True, eq=False)
class Probabilities:
    """What the evidence says, in three views of the same numbers.

    Attributes
    ----------
    cause : dict
        "none", every effect and "unknown" -> probability that it is the main cause of the gap; they sum to
        one. The probability of a set of several effects belongs to its first member, found to explain most.
    sets : dict
        Sorted names of effects -> probability of exactly these; () is none, ("unknown",) unknown. They sum to
        one.
    presence : dict
        Effect -> probability that it is there at all, as the main cause or beside another.
    """

    cause: dict[str, float]
    sets: dict[tuple[str, ...], float]
    presence: dict[str, float]

    def with_certain_effect(self, name: str, *, leads: bool) -> Probabilities:
        """Probabilities once an effect is known to be there, in every set but unknown.

        Parameters
        ----------
        name : str
            The effect, listed or not; a set that has it already is the same set.
        leads : bool
            It explains more than whatever else there is, and takes the place of every other main cause.
        """
        certain = 1.0 - self.sets[_UNKNOWN]
        cause = dict(self.cause)
        if leads:
            cause = {**dict.fromkeys(cause, 0.0), "unknown": cause["unknown"], name: certain}
        else:
            cause[name] = cause.get(name, 0.0) + cause["none"]
            cause["none"] = 0.0
        # Sets with the effect and without it become one.
        sets: dict[tuple[str, ...], float] = {}
        for names, probability in self.sets.items():
            certain_names = names
            if names != _UNKNOWN:
                certain_names = tuple(sorted({*names, name}))
            sets[certain_names] = sets.get(certain_names, 0.0) + probability
        return Probabilities(cause, sets, {**self.presence, name: certain})

    def with_untried(self, untried: Mapping[str, str], *, larger: bool) -> Probabilities:
        """Probabilities once unknown is shared with effects that were not tried.

        What no candidate explains may be one that was not tried, or a larger set where none was tried. The
        probability of unknown is shared between these and a cause beyond the list, as their priors are.

        Parameters
        ----------
        untried : mapping
            Effects that were not tried -> what they need; where empty, all listed effects share equally.
        larger : bool
            No set of several effects was tried; else those were whose members were tried, taken as pairs.
        """
        cause = dict(self.cause)
        presence = dict(self.presence)
        listed = dict.fromkeys([*presence, *untried])
        tried_share = 1 - len(untried) / len(listed)
        tried_share_of_sets = 0.0 if larger else tried_share**2
        prior_one, prior_several, prior_beyond = PRIORS
        prior_missed = prior_one * (1 - tried_share) + prior_several * (1 - tried_share_of_sets)
        moved = cause["unknown"] * prior_missed / (prior_missed + prior_beyond)

        sets = {**self.sets, _UNKNOWN: self.sets[_UNKNOWN] - moved}
        cause["unknown"] -= moved
        receiving = untried or listed
        for name in receiving:
            share = moved / len(receiving)
            sets[(name,)] = sets.get((name,), 0.0) + share
            cause[name] = cause.get(name, 0.0) + share
            presence[name] = presence.get(name, 0.0) + share
        return Probabilities(cause, sets, presence)

    def counting_as_unknown(self, untried: Iterable[str]) -> Probabilities:
        """Probabilities in which effects that were not tried are part of "unknown" among the causes."""
        cause = {name: p for name, p in self.cause.items() if name not in untried}
        cause["unknown"] += sum(self.cause.values()) - sum(cause.values())
        return replace(self, cause=cause)

    @property
    def answer(self) -> str:
        """The most probable main cause: "none", the name of an effect, or "unknown"."""
        return max(self.cause, key=self.cause.__getitem__)


def probabilities(hypotheses: Sequence[Hypothesis]) -> Probabilities:
    """Probabilities from the evidence of everything that was fitted.

    Of several fits by one set the likeliest counts; unknown has the weight of the likeliest set with
    something unknown besides.

    Raises
    ------
    ValueError
        If there is no hypothesis.
    """
    if not hypotheses:
        raise ValueError("probabilities need at least one hypothesis")
    best = best_of_sets((h for h in hypotheses if h.is_answer), lambda h: h.log_weight)
    unknown = max(h.log_weight_with_unknown for h in hypotheses)
    keys = [*best, _UNKNOWN]
    log_weights = np.array([*(h.log_weight for h in best.values()), unknown])
    weights = np.exp(log_weights - np.max(log_weights))
    weights /= weights.sum()
    sets = {names: float(p) for names, p in zip(keys, weights, strict=True)}

    listed = hypotheses[0].listed
    cause = {"none": sets.get((), 0.0), **dict.fromkeys(listed, 0.0), "unknown": sets[_UNKNOWN]}
    presence = dict.fromkeys(listed, 0.0)
    for names, hypothesis in best.items():
        for main_cause in hypothesis.names[:1]:
            cause[main_cause] += sets[names]
        for name in names:
            presence[name] += sets[names]
    return Probabilities(cause, sets, presence)


def log_evidence(fit: Fit) -> float:
    """Logarithm of the integral of exp(-(|e|^2 + |d|^2)/2) p(x) over deviations d and coordinates x.

    Laplace's approximation, cut off at the bounds: along every coordinate that ends at or near a bound, the
    Gaussian (or the slope down from the bound) is integrated over the inside only, given the others at their
    best. p is `Candidate.log_density`. Constants common to all hypotheses of a case are left out.

    Parameters
    ----------
    fit : Fit
        Under white noise; its Hessian, cost and gradient are those of the end of the descent.
    """
    P = fit.deviations.size
    hessian = fit.hessian
    scale = np.sqrt(np.maximum(np.diag(hessian), _SMALLEST_CURVATURE))
    scaled = hessian / np.outer(scale, scale) + _RIDGE * np.eye(scale.size)
    _, log_determinant = np.linalg.slogdet(scaled)
    log_determinant += 2 * float(np.sum(np.log(scale)))
    n_coordinates = hessian.shape[0] - P
    value = -0.5 * fit.cost - 0.5 * log_determinant + 0.5 * n_coordinates * np.log(2 * np.pi)
    if n_coordinates == 0:
        return float(value)

    # Spreads are of the same matrix as the determinant: a coordinate that nothing depends on integrates to
    # its range.
    spreads = (np.sqrt(np.diag(np.linalg.inv(scaled))) / scale)[P:]
    gradient = (fit.jacobian.T @ fit.residual_coefficients)[P:]
    place = 0
    for k, candidate in enumerate(fit.candidates):
        x = fit.coordinates_of(k)
        value += candidate.log_density(x)
        low, high = candidate.box
        for i in range(x.size):
            value += _log_share_inside(x[i], gradient[place], spreads[place], low[i], high[i])
            place += 1
    return float(value)


def _log_share_inside(x: float, slope: float, spread: float, low: float, high: float) -> float:
    """Logarithm of the integral of exp(-slope t - t^2/(2 spread^2)) inside the bounds.

    t is the distance from x; the integral is divided by spread sqrt(2 pi). An angle, without finite bounds,
    is integrated over one turn at most.
    """
    if not np.isfinite(low):
        return min(0.0, float(np.log(2 * np.pi / (spread * np.sqrt(2 * np.pi)))))
    # Complete the square only where a bound holds the coordinate; elsewhere the slope is rounding, or a jump.
    held = (x <= low and slope > 0) or (x >= high and slope < 0)
    centre = x
    log_peak = 0.0
    if held:
        centre = x - slope * spread**2
        log_peak = 0.5 * (slope * spread) ** 2
    a = (low - centre) / spread
    b = (high - centre) / spread
    # log(Phi(b) - Phi(a)), from the tail that keeps digits.
    if a > 0:
        a, b = -b, -a
    upper = log_ndtr(b)
    lower = log_ndtr(a)
    # A difference of zero would make the logarithm that of zero.
    return float(log_peak + upper + np.log1p(-np.exp(min(lower - upper, -1e-300))))
