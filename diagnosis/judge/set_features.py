"""What a search has found about every set of effects, in the numbers that tell whether they are there.

`diagnosis.judge.naming_model` turns them into probabilities. Shares are of the motion: RMS of an output about
its mean, of the output that shows most of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import comb, log

import numpy as np
from scipy.special import expit

from diagnosis.evidence.explanation import Explanation
from diagnosis.evidence.hypotheses import UNLISTED
from diagnosis.fit.nominal import EDGE
from diagnosis.machine.machine_protocol import Real
from diagnosis.search.search import Search

# Share of the stated model error that is little: validation records of which an effect changes less say
# nothing about it, and one standard deviation of it may act as an effect does. Set by eye on made cases,
# where dry friction and cogging of the background added to what was found; twice of it is not measured.
LITTLE = 0.25
# Features are logarithms of ratios; a ratio beyond this one says no more than that it is large (or small).
_LOG_RATIO_LIMIT = 3.0
# The same of how far a value is off: between .6 and 33 tolerances a logarithm tells something.
_LOG_TOLERANCES_LIMIT = 2.0
# Tolerances from which on a wrong stated value interests, however little it changes: by chance a value is so
# far off once in 100 000 times.
_FAR_OFF_TOLERANCES = 4.4
# Tolerances below which a wrong value and a deviation that cancel each other are no finding: a nominal value
# re-estimated by so much is within its usual range.
_NEAR_TOLERANCES = EDGE
# Width, in natural logarithms, of a threshold: 6 %, as uncertain as a share is that solvers compute.
_THRESHOLD_WIDTH = 0.06
# Log likelihood per unit of the feature that is linear in it: it keeps the coefficients of one size.
_EVIDENCE_UNIT = 10.0
# Share of the motion that is nothing.
_NOTHING = 1e-4
# Operating points are one where they leave no more of a constant's energy than this, as error bars of a third
# of them do.
_SAME_POINT = 0.1
# Change of a signal, over its size, up to which it is a constant: rounding of a simulation.
_CONSTANT = 1e-3

SET_FEATURES = ("log_evidence_behind", "evidence_behind", "left_beyond_model_error")
EFFECT_FEATURES = (
    "added",
    "added_share_to_left",
    "value",
    "value_beside_left",
    "value_off",
)
REST_FEATURES = ("constant", "left_to_model_error")


@dataclass(frozen=True)
class EffectFeatures:
    """One effect within a set.

    Attributes
    ----------
    name : str
        The effect.
    is_answer : bool
        False for a look-alike that is on no list, and for what validation records refute.
    share : float
        Of the motion, what the effect carries.
    interests : float
        Probability that the effect is one that interests: it carries more than the stated model error, or it
        is a stated value that is far off. Where nobody has stated a model error every size interests.
    by_name : float
        Probability that it is that effect only by its name: the records do not show what makes it this one.
    features : (5,) tuple of float
        In the order of `EFFECT_FEATURES`. An effect that is added and a stated value that is wrong have
        features of their own, zero for the other kind.
    """

    name: str
    is_answer: bool
    share: float
    interests: float
    by_name: float
    features: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class SetFeatures:
    """One fitted set of effects.

    Attributes
    ----------
    explanation : Explanation
        The likeliest fit of the set.
    log_prior : float
        Of the stated values that it moves, and of the set among those of its size: log of one over their
        number. A look-alike on no list counts `UNLISTED` of an effect, and each parameter of an effect beyond
        its first counts a factor of e.
    features : (3,) tuple of float
        In the order of `SET_FEATURES`.
    rest_features : (2,) tuple of float
        Of what the set leaves, in the order of `REST_FEATURES`.
    repair_share : float
        Share of the repairs that are this set, when the logs are drawn anew.
    """

    explanation: Explanation
    log_prior: float
    features: tuple[float, ...]
    rest_features: tuple[float, ...]
    repair_share: float


def features_of_sets(
    search: Search,
    explanations: Mapping[tuple[str, ...], Explanation],
    repair_shares: Mapping[tuple[str, ...], float],
) -> list[SetFeatures]:
    """The features of every set, in the order given.

    Parameters
    ----------
    search : Search
        That has fitted them.
    explanations : mapping
        Sorted names -> the likeliest fit of these effects; () is the nominal without an effect.
    repair_shares : mapping
        Sorted names -> share of the repairs that are this set (`repair.stability`); empty where nobody has
        looked at logs left out yet.

    Notes
    -----
    Evidence is the log likelihood of all records with Laplace's volume of the effects' sizes. Coefficients of
    what a model error leaves are correlated, by nobody knows how much, so that its logarithm enters as well:
    the probability of a set falls with a power of its odds. Where even the likeliest set leaves more than the
    model error the linear part counts less.
    """
    weighing = search.case.machine.weighing
    evidence = {
        key: explanation.log_likelihood + explanation.log_volume for key, explanation in explanations.items()
    }
    best_evidence = max(evidence.values())
    most_likely = max(evidence, key=lambda key: evidence[key])
    left_by_it = share_left(explanations[most_likely]) / weighing.model_error
    # What a cause on no list leaves is no noise: the more of it, the less differences of likelihood say.
    trust = 1 / (1 + left_by_it**2)
    sets = []
    for key, explanation in explanations.items():
        behind = best_evidence - evidence[key]
        left_to_model_error = _log_ratio(share_left(explanation), weighing.model_error, _LOG_RATIO_LIMIT)
        unlisted = sum(name not in weighing.listed for name in explanation.names)
        # An effect that contains another (Stribeck and Coulomb friction) fits as well where it looks like it:
        # the simpler name is the better one.
        further_parameters = sum(len(candidate.axes) - 1 for candidate in explanation.fit.candidates)
        log_prior = explanation.log_prior - log(max(comb(len(weighing.listed), len(explanation.names)), 1))
        sets.append(
            SetFeatures(
                explanation=explanation,
                log_prior=log_prior + unlisted * log(UNLISTED) - further_parameters,
                features=(
                    -float(np.log1p(behind)),
                    -trust * behind / _EVIDENCE_UNIT,
                    max(left_to_model_error, 0.0),
                ),
                rest_features=(1.0, left_to_model_error),
                repair_share=repair_shares.get(key, 0.0),
            )
        )
    return sets


def features_of_effects(
    search: Search, explanation: Explanation, explanations: Mapping[tuple[str, ...], Explanation]
) -> tuple[EffectFeatures, ...]:
    """The features of the effects of one set, the one that carries most first.

    Parameters
    ----------
    search : Search
        That has fitted the sets.
    explanation : Explanation
        The likeliest fit of the set.
    explanations : mapping
        Sorted names -> the likeliest fit: what is left without one of the effects.
    """
    weighing = search.case.machine.weighing
    left = share_left(explanation)
    left_beyond_model_error = max(_log_ratio(left, weighing.model_error, _LOG_RATIO_LIMIT), 0.0)
    shares = _shares_carried(search, explanation, explanations)
    effects = []
    for place, name in enumerate(explanation.names):
        share = shares[name]
        interests = _exceeds(share, weighing.model_error) if weighing.stated else 1.0
        by_name = is_none_but_by_name(search, explanation, place)
        tolerances_off = _tolerances_off(search, explanation, place)
        if tolerances_off is None:
            to_left = _log_ratio(share, left, _LOG_RATIO_LIMIT)
            features = (1.0, to_left, 0.0, 0.0, 0.0)
        else:
            # What a wrong value changes, the others imitate within their tolerances: its share tells little.
            off = _log_ratio(tolerances_off, _FAR_OFF_TOLERANCES, _LOG_TOLERANCES_LIMIT)
            features = (0.0, 0.0, 1.0, left_beyond_model_error, off)
            interests = max(interests, _exceeds(tolerances_off, _FAR_OFF_TOLERANCES))
            interests *= _exceeds(tolerances_off, _NEAR_TOLERANCES)
        is_listed = name in weighing.listed and explanation.fit.effects[place].as_listed
        is_answer = is_listed and name not in search.refuted
        effects.append(EffectFeatures(name, is_answer, share, interests, by_name, features))
    return tuple(sorted(effects, key=lambda effect: -effect.share))


def share_left(explanation: Explanation) -> float:
    """Share of the motion that a set leaves beyond noise: RMS of estimation and of validation records."""
    largest = np.max(explanation.residual_shares, axis=1)
    return float(np.sqrt(np.mean(largest**2)))


def share_beside(without: Explanation, explanation: Explanation) -> float:
    """Share of the motion that a set carries beyond a part of it: geometric mean of estimation and of
    validation records."""
    return float(np.sqrt(np.prod(_carried(without, explanation))))


def best_without(
    explanations: Mapping[tuple[str, ...], Explanation], explanation: Explanation, name: str
) -> Explanation:
    """The set without this effect; where nobody fitted that, the likeliest of its parts."""
    other_names = {other for other in explanation.names if other != name}
    parts = [part for key, part in explanations.items() if other_names.issuperset(key)]
    return max(parts, key=lambda part: (len(part.names) == len(other_names), part.log_evidence))


def is_silent(search: Search, explanation: Explanation, name: str) -> bool:
    """Whether validation records say nothing about an effect: it does next to nothing there."""
    acts = search.held_out_share_of(explanation, explanation.names.index(name))
    return acts < LITTLE * search.case.machine.weighing.model_error


def is_none_but_by_name(search: Search, explanation: Explanation, place: int) -> float:
    """Probability that an effect of a set is none but by its name: the records do not show what makes it one.

    At an end of its range it is: 1. A constant is what a static error of an unlisted cause adds, too, where
    it is one share, below one, of the operating points of all records: then as probable as an unlisted
    look-alike beside the effect.

    Parameters
    ----------
    search : Search
        That has fitted the set.
    explanation : Explanation
        The set.
    place : int
        Of the effect among its names.
    """
    fit = explanation.fit
    records = search.records
    if fit.candidates[place].at_edge(fit.coordinates_of(place)):
        return 1.0
    first_column = fit.deviations.size + sum(len(c.axes) for c in fit.candidates[:place])
    by_size = fit.jacobian[:, first_column]
    outputs = search.case.noise.size
    added = [-records.likelihood.to_residuals(by_size[part], outputs) for part in records.record_slices]
    constants = np.array([np.mean(signal, axis=0) for signal in added])
    if not np.any(constants):
        return 0.0
    for signal in added:
        for output in signal.T:
            if np.any(output) and np.ptp(output) > _CONSTANT * np.max(np.abs(output)):
                return 0.0

    # The constant of every record and output against the operating point there.
    modelled = [e.output - left for e, left in zip(records.experiments, explanation.residuals, strict=True)]
    points = np.array([np.mean(output, axis=0) for output in modelled]) - constants
    points = np.where(constants, points, 0.0)
    share = np.sum(constants * points) / (np.sum(points**2) or 1.0)
    off_line = np.sum((constants - share * points) ** 2)
    if off_line < _SAME_POINT * np.sum(constants**2) and abs(share) < 1:
        return UNLISTED / (1 + UNLISTED)
    return 0.0


def _shares_carried(
    search: Search, explanation: Explanation, explanations: Mapping[tuple[str, ...], Explanation]
) -> dict[str, float]:
    """Effect -> share of the motion that it carries within the set, or within a part of it.

    Two effects that can replace each other carry nothing beside each other. So the one goes first without
    which the records are the likeliest, of those that carry less than the model error, and the others are
    asked again within what is left of the set.
    """
    model_error = search.case.machine.weighing.model_error
    shares = dict.fromkeys(explanation.names, 0.0)
    reduced = explanation
    while reduced.names:
        without = {name: best_without(explanations, reduced, name) for name in reduced.names}
        for name in reduced.names:
            shares[name] = max(shares[name], _share_carried(search, reduced, name, without[name]))
        small = [without[name] for name in reduced.names if shares[name] < model_error]
        smaller_by_one = [part for part in small if len(part.names) == len(reduced.names) - 1]
        if not smaller_by_one:
            break
        reduced = max(smaller_by_one, key=lambda part: part.log_evidence)
    return shares


def _share_carried(search: Search, explanation: Explanation, name: str, without: Explanation) -> float:
    """Share of the motion that an effect carries of validation records.

    Estimation records say less: an effect that they were fitted with makes up for a drift, and one that
    others imitate, with values that validation records refute, carries nothing of them. They count where
    validation records say nothing about the effect.
    """
    estimation, validation = map(float, _carried(without, explanation))
    model_error = search.case.machine.weighing.model_error
    if validation < model_error < estimation and is_silent(search, explanation, name):
        return estimation
    return validation


def _carried(without: Explanation, explanation: Explanation) -> Real:
    """(2,) share of the motion that a set carries beyond a part of it, of estimation and of validation
    records."""
    energy = np.maximum(without.energy_ratios - explanation.energy_ratios, 0.0)
    return np.asarray(np.max(np.sqrt(energy), axis=1))


def _tolerances_off(search: Search, explanation: Explanation, place: int) -> float | None:
    """How far an effect and the deviations together move the value that it changes, in tolerances.

    None for effects that change no stated value, and for values without a tolerance: none of theirs is there
    to imitate what the effect does.
    """
    fit = explanation.fit
    machine = search.case.machine
    kind = fit.candidates[place].kind
    key = kind.multiplies or kind.adds_to
    if key is None or key not in machine.tolerances:
        return None
    stated = machine.description.value(key)
    if not stated > 0:
        return None
    tolerance = machine.tolerances[key]
    deviation = float(fit.deviations[search.records.nominal.keys.index(key)])
    value = stated * np.exp(tolerance * deviation)
    size = next(iter(fit.effects[place].parameters().values()))
    value = value * size if kind.multiplies else value + size
    return abs(float(value / stated) - 1) / tolerance


def _log_ratio(size: float, reference: float, limit: float) -> float:
    """Logarithm of a ratio of two sizes, neither less than nothing, between -limit and limit."""
    ratio = max(size, _NOTHING) / max(reference, _NOTHING)
    return float(np.clip(np.log(ratio), -limit, limit))


def _exceeds(size: float, threshold: float) -> float:
    """Probability that a size, uncertain by `_THRESHOLD_WIDTH`, is beyond a threshold."""
    return float(expit(np.log(max(size, _NOTHING) / threshold) / _THRESHOLD_WIDTH))
