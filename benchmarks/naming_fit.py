"""Fits the coefficients of `diagnosis.judge.naming_model` to cases of known truth; says how good they are.

With coefficients x = (a, b, c) the model gives each case i a probability for every effect to be present, for
every main cause, and for an unlisted cause (`naming_model`). Fitted is what minimises

    1/N sum_i w_i [ - sum_e log P_i(effect e is present, or is not, as it is)
                    - log P_i(the main cause is a right one)
                    - UNLISTED_WEIGHT log P_i(an unlisted cause is there, or is not, as it is) ]
    + 1/N sum_j ((x_j - start_j) / width_j)^2

with `SMALLEST` added to every probability. The weights w_i, one in the mean, make every kind of machine count
the same, however many cases of it there are: cheap ones would decide otherwise. Within a kind they make cases
with a cause on no list count `UNLISTED_SHARE`: how often such causes are made says nothing about how often
users have them, and where they are frequent every effect is doubted. The sum over effects e is
over all effects that some fitted set of the case holds: what no set holds has the probability zero whatever
the coefficients are. The ridge, worth one case, draws what few cases tell towards the start. The minimum is
sought by BFGS with numerical gradients: some ten coefficients, and a loss that takes milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import expit

from diagnosis.evidence.hypotheses import Probabilities
from diagnosis.judge.naming_model import PREDICTION, NamingModel
from diagnosis.judge.set_features import EFFECT_FEATURES, REST_FEATURES, SET_FEATURES, EffectFeatures
from diagnosis.judge.verdict import JudgedEffect, WeightedSet, accepted_set, probabilities_of_answers

Real = npt.NDArray[np.float64]

# Feature names of each table of the model, in their order.
TABLES = {"set": SET_FEATURES, "effect": EFFECT_FEATURES, "rest": REST_FEATURES}
# Coefficient -> where the fit starts and where the ridge draws (sign and size that one expects before any
# data; doubled, they move the fitted ones by less than their uncertainty), and what a positive one means.
COEFFICIENTS = {
    "set": {
        "log_evidence_behind": (
            1.0,
            "the probability of a set falls with this power of its log evidence behind the best one",
        ),
        "evidence_behind": (
            1.0,
            "it falls exponentially with log evidence as well; 10 would trust the likelihood",
        ),
        "left_beyond_model_error": (
            -1.0,
            "negative: a set that leaves more than the model error is less probable",
        ),
    },
    "effect": {
        "added": (0.0, "an added effect that carries as much as is left is genuine"),
        "added_share_to_left": (1.0, "the more it carries beside what is left, the more probably it is"),
        "value": (0.0, "a wrong stated value that is far off is genuine where little is left"),
        "value_beside_left": (-1.0, "negative: where much is left, a wrong value probably stands in for it"),
        "value_off": (2.0, "the more tolerances a value is off, the more probably it is wrong"),
    },
    "rest": {
        "constant": (
            -2.0,
            "negative: what is as large as the stated model error has no cause that interests",
        ),
        "left_to_model_error": (2.0, "the more is left, the more probably an unlisted cause is behind it"),
    },
}
# The ridge is as wide as the start is far from zero, at least this.
LEAST_WIDTH = 0.5
# Of the loss of the unlisted cause: it decides no name, only what is said of the rest. Chosen; twice of it
# moved no coefficient of the other two tables by more than a tenth.
UNLISTED_WEIGHT = 0.3
# Share of machines with a cause on no list, which is a belief about the machines of users. Chosen; the series
# of blind cases have 15 %. Cross-validated (`python -m benchmarks.naming` with this constant changed), the
# log loss of the cause is .84 with .15, .81 with .25, .80 with .4, and .83 with as many as were made, which
# is half of all; of 48 cases of the workshop 45, 44, 42 and 42 have the right first answer.
UNLISTED_SHARE = 0.25
# Added to probabilities: no case costs more than 7, however sure and wrong. A label may be wrong.
SMALLEST = 1e-3
# Iterations of the descent; it converges within some 40.
ITERATIONS = 100
# Parts of the cases of which each is judged by a fit to the others.
FOLDS = 5
# An answer above this is sure.
SURE = 0.8
# Ranges of the said probability of an answer that are counted one by one.
SAID = ((0.3, 0.5), (0.5, 0.8), (0.8, 1.0))


@dataclass(frozen=True)
class TrainingSet:
    """A fitted set of a case: the numbers of its `SetFeatures`, and the features of its effects.

    Attributes
    ----------
    log_prior : float
    features : (3,) tuple of float
    rest_features : (2,) tuple of float
    repair_share : float
    effects : tuple of EffectFeatures
        The one that carries most first; none of the nominal.
    """

    log_prior: float
    features: tuple[float, ...]
    rest_features: tuple[float, ...]
    repair_share: float
    effects: tuple[EffectFeatures, ...]


@dataclass(frozen=True)
class TrainingCase:
    """What a search has found of a case, and what is true.

    Attributes
    ----------
    route : str
        Kind of the machine.
    name : str
    listed : tuple of str
        Effects that were looked for.
    present : frozenset of str
        Effects of the list that are there.
    model_error_is_stated : bool
        Where it is not, the model takes it for certain that what is left has a cause.
    has_unlisted : bool
        Whether a cause on no list is there.
    sets : tuple of TrainingSet
        Every fitted set, that without effects among them.
    """

    route: str
    name: str
    listed: tuple[str, ...]
    present: frozenset[str]
    model_error_is_stated: bool
    has_unlisted: bool
    sets: tuple[TrainingSet, ...]

    @property
    def right_causes(self) -> frozenset[str]:
        """Main causes that are right: any effect that is there; else unknown, or none."""
        if self.present:
            return self.present
        return frozenset(["unknown" if self.has_unlisted else "none"])


@dataclass(frozen=True, eq=False)
class Predictions:
    """What a model says of all cases of `TrainingData`.

    Attributes
    ----------
    presence : (P,) array
        Of every pair of a case and an effect.
    right_cause : (N,) array
        Probability of each case that its main cause is a right one.
    unlisted : (N,) array
        Probability of each case that a cause on no list is there.
    """

    presence: Real
    right_cause: Real
    unlisted: Real


def case_weights(cases: Sequence[TrainingCase], unlisted_share: float | None) -> Real:
    """(N,) weights, one in the mean, with which every route counts the same.

    Parameters
    ----------
    cases : sequence of TrainingCase
        N of them.
    unlisted_share : float or None
        What cases with a cause on no list count of a route that has cases of both sorts; None: as many as
        were made.
    """
    weights = np.zeros(len(cases))
    routes = np.array([case.route for case in cases])
    has_unlisted = np.array([case.has_unlisted for case in cases], dtype=bool)
    for route in set(routes.tolist()):
        with_unlisted = (routes == route) & has_unlisted
        without = (routes == route) & ~has_unlisted
        share = np.sum(with_unlisted) / np.sum(routes == route) if unlisted_share is None else unlisted_share
        if not np.any(without):
            share = 1.0
        elif not np.any(with_unlisted):
            share = 0.0
        weights[with_unlisted] = share / max(np.sum(with_unlisted), 1)
        weights[without] = (1 - share) / max(np.sum(without), 1)
    return np.asarray(weights / np.mean(weights))


class TrainingData:
    """The features of all cases in arrays: N cases, S sets, E effects of sets, P pairs of case and effect."""

    def __init__(self, cases: Sequence[TrainingCase], unlisted_share: float | None = UNLISTED_SHARE) -> None:
        """
        Parameters
        ----------
        cases : sequence of TrainingCase
        unlisted_share : float or None
            See `case_weights`.

        Raises
        ------
        ValueError
            If there are no cases.
        """
        if not cases:
            raise ValueError("no cases to fit to: give a route more than 0 cases")
        self.cases = tuple(cases)
        sets = [(i, fitted) for i, case in enumerate(cases) for fitted in case.sets]
        self.case_of_set = np.array([i for i, _ in sets])
        self.first_set = np.searchsorted(self.case_of_set, np.arange(len(cases)))
        self.set_features = np.array([fitted.features for _, fitted in sets])
        self.rest_features = np.array([fitted.rest_features for _, fitted in sets])
        self.is_stated = np.array([cases[i].model_error_is_stated for i, _ in sets], dtype=bool)
        self.log_priors = np.array([fitted.log_prior for _, fitted in sets])
        repair_shares = np.array([fitted.repair_share for _, fitted in sets])
        of_case = np.add.reduceat(repair_shares, self.first_set)[self.case_of_set]
        # Where no set is a repair, evidence alone counts (`NamingModel.set_probabilities`).
        self.prediction = np.where(of_case > 0, PREDICTION, 0.0)
        self.by_prediction = repair_shares / np.where(of_case > 0, of_case, 1.0)

        # Effects of all sets one below the other. places: (S, most effects of a set) -> row of the effect,
        # the one that carries most first; E, a row behind the last, where the set has fewer.
        pairs: dict[tuple[int, str], int] = {}
        features = []
        is_answer = []
        interests = []
        by_name = []
        pair_of_effect = []
        rows = [[] for _ in sets]  # type: list[list[int]]
        for row, (i, fitted) in zip(rows, sets, strict=True):
            for effect in fitted.effects:
                row.append(len(features))
                features.append(effect.features)
                is_answer.append(effect.is_answer)
                interests.append(effect.interests)
                by_name.append(effect.by_name)
                pair_of_effect.append(pairs.setdefault((i, effect.name), len(pairs)))
        count = len(features)
        longest_row = max(map(len, rows))
        self.effect_features = np.array(features).reshape(count, len(EFFECT_FEATURES))
        self.is_answer = np.array(is_answer, dtype=bool)
        self.interests = np.array(interests)
        self.by_name = np.array(by_name)
        self.places = np.array([row + [count] * (longest_row - len(row)) for row in rows], dtype=int)
        self.places = self.places.reshape(len(sets), longest_row)
        # Effects without a set of their own belong to the pair behind the last.
        self.pair_of_effect = np.array([*pair_of_effect, len(pairs)], dtype=int)
        self.pairs = tuple(pairs)

        # The truth.
        self.is_present = np.array([name in cases[i].present for i, name in pairs], dtype=bool)
        self.case_of_pair = np.array([i for i, _ in pairs], dtype=int)
        self.has_unlisted = np.array([case.has_unlisted for case in cases], dtype=bool)
        self.has_effect = np.array([bool(case.present) for case in cases], dtype=bool)

        self.case_weights = case_weights(cases, unlisted_share)

    def predicted(self, model: NamingModel) -> Predictions:
        """What `verdict.probabilities_of_answers` says, of all cases at once."""
        count = len(self.cases)
        score = self.set_features @ model.of_set + self.log_priors
        score -= np.maximum.reduceat(score, self.first_set)[self.case_of_set]
        weights = np.exp(score)
        weights /= np.add.reduceat(weights, self.first_set)[self.case_of_set]
        weights = (1 - self.prediction) * weights + self.prediction * self.by_prediction
        genuine = expit(self.effect_features @ model.of_effect) * (1 - self.by_name) * self.is_answer
        # A row behind the last: an effect that is not there, too small and no stand-in.
        is_there = np.append(self.interests * genuine, 0.0)
        is_small = np.append(1 - self.interests, 1.0)
        stands_in = np.append(self.interests * (1 - genuine), 0.0)
        unlisted_beside = np.where(self.is_stated, expit(self.rest_features @ model.of_rest), 1.0)

        # An effect is the main cause where it is there and none that carries more is.
        presence = np.zeros(len(self.pairs) + 1)
        main_cause = np.zeros(len(self.pairs) + 1)
        none_there = np.ones(len(weights))
        all_small = np.ones(len(weights))
        none_stands_in = np.ones(len(weights))
        for place in self.places.T:
            pair = self.pair_of_effect[place]
            probability = weights * is_there[place]
            presence += np.bincount(pair, probability, presence.size)
            main_cause += np.bincount(pair, probability * none_there, presence.size)
            none_there = none_there * (1 - is_there[place])
            all_small = all_small * is_small[place]
            none_stands_in = none_stands_in * (1 - stands_in[place])
        presence = presence[:-1]
        main_cause = main_cause[:-1]

        def over_sets(of_set: Real) -> Real:
            return np.asarray(np.add.reduceat(weights * of_set, self.first_set))

        none = over_sets(all_small * (1 - unlisted_beside))
        unknown = over_sets(none_there - all_small * (1 - unlisted_beside))
        right = np.bincount(self.case_of_pair, main_cause * self.is_present, count)
        right = np.where(self.has_effect, right, np.where(self.has_unlisted, unknown, none))
        unlisted = 1 - over_sets(none_stands_in * (1 - unlisted_beside))
        return Predictions(presence, right, unlisted)

    def loss(self, model: NamingModel) -> float:
        """The weighted mean over the cases, without the ridge; the module has the equation."""
        predictions = self.predicted(model)
        as_labelled = np.where(self.is_present, predictions.presence, 1 - predictions.presence)
        unlisted = np.where(self.has_unlisted, predictions.unlisted, 1 - predictions.unlisted)
        losses = -np.bincount(self.case_of_pair, np.log(as_labelled + SMALLEST), len(self.cases))
        losses -= np.log(predictions.right_cause + SMALLEST)
        losses -= UNLISTED_WEIGHT * np.log(unlisted + SMALLEST)
        return float(np.mean(self.case_weights * losses))


def _model_of(x: Real) -> NamingModel:
    """x : all coefficients (11,), in the order of `TABLES`."""
    sets = len(SET_FEATURES)
    effects = len(EFFECT_FEATURES)
    return NamingModel(x[:sets], x[sets : sets + effects], x[sets + effects :])


def start_model() -> NamingModel:
    """The model that the fit starts from.

    Raises
    ------
    ValueError
        If the judge has a feature of which `COEFFICIENTS` says nothing, or the other way round.
    """
    for table, names in TABLES.items():
        if tuple(COEFFICIENTS[table]) != names:
            raise ValueError(
                f"COEFFICIENTS[{table!r}] has {', '.join(COEFFICIENTS[table])}; the judge's features are "
                f"{', '.join(names)}. Give each a start and a meaning, in this order"
            )
    return _model_of(np.array([start for table in COEFFICIENTS.values() for start, _ in table.values()]))


def fitted(cases: Sequence[TrainingCase], unlisted_share: float | None = UNLISTED_SHARE) -> NamingModel:
    """The coefficients that minimise the loss of these cases with the ridge (equation of the module).

    Parameters
    ----------
    cases : sequence of TrainingCase
    unlisted_share : float or None
        See `case_weights`.

    Raises
    ------
    ValueError
        If there are no cases.
    """
    data = TrainingData(cases, unlisted_share)
    model = start_model()
    start = np.concatenate([model.of_set, model.of_effect, model.of_rest])
    width = np.maximum(np.abs(start), LEAST_WIDTH)

    def penalised(x: Real) -> float:
        ridge = float(np.sum(((x - start) / width) ** 2)) / len(cases)
        return data.loss(_model_of(x)) + ridge

    # BFGS may end where rounding of the numerical gradient hides further descent: that is its end here.
    return _model_of(minimize(penalised, start, method="BFGS", options={"maxiter": ITERATIONS}).x)


def answered(case: TrainingCase, model: NamingModel) -> Probabilities:
    """What the judge would say of a case with these coefficients, by the judge's own functions.

    Neglected: rounding of a sensor and effects that were not tried, which change the judge's answer later.
    """
    weights = model.set_probabilities(case.sets)  # type: ignore[arg-type]
    sets = []
    for weight, training_set in zip(weights, case.sets, strict=True):
        effects = tuple(JudgedEffect(effect, model.is_genuine(effect)) for effect in training_set.effects)
        beside = model.has_unlisted_cause(training_set.rest_features, case.model_error_is_stated)
        sets.append(WeightedSet(float(weight), effects, beside))
    return probabilities_of_answers(sets, case.listed)


@dataclass(frozen=True)
class Outcome:
    """One case as it was answered.

    Attributes
    ----------
    case : TrainingCase
    first : str
        The most probable main cause.
    said : float
        Its probability.
    is_right : bool
        Whether the first is a right one.
    is_exact : bool
        Whether the accepted set is exactly what is there.
    presence : mapping
        Effect that was looked for -> probability.
    presence_error : float
        Brier score: sum over the effects of (probability - truth)^2.
    cause_loss : float
        Minus the logarithm of the probability of the right main causes.
    """

    case: TrainingCase
    first: str
    said: float
    is_right: bool
    is_exact: bool
    presence: Mapping[str, float]
    presence_error: float
    cause_loss: float


def outcome(case: TrainingCase, model: NamingModel) -> Outcome:
    """How a model answers a case."""
    answer = answered(case, model)
    first = answer.answer
    shares: dict[str, float] = {}
    weights = model.set_probabilities(case.sets)  # type: ignore[arg-type]
    for place in np.argsort(weights):  # the likeliest set last: its shares count
        shares |= {effect.name: effect.share for effect in case.sets[place].effects}
    is_right = first in case.right_causes
    is_exact = is_right and set(accepted_set(answer, first, shares)) == case.present
    squares = [(p - (name in case.present)) ** 2 for name, p in answer.presence.items()]
    right = sum(answer.cause.get(name, 0.0) for name in case.right_causes)
    return Outcome(
        case,
        first,
        answer.cause[first],
        is_right,
        is_exact,
        answer.presence,
        float(sum(squares)),
        float(-np.log(right + SMALLEST)),
    )


def cross_validated(cases: Sequence[TrainingCase], seed: int = 0) -> list[Outcome]:
    """Every case as a fit to the other folds answers it; in the order given.

    Parameters
    ----------
    cases : sequence of TrainingCase
    seed : int
        Of the draw of the folds.
    """
    fold = np.random.default_rng(seed).permutation(len(cases)) % FOLDS
    outcomes: dict[int, Outcome] = {}
    for left_out in range(min(FOLDS, len(cases))):
        rest_of_cases = [case for case, number in zip(cases, fold, strict=True) if number != left_out]
        model = fitted(rest_of_cases)
        for i in np.flatnonzero(fold == left_out):
            outcomes[int(i)] = outcome(cases[i], model)
    return [outcomes[i] for i in range(len(cases))]


def table(rows: Mapping[str, Sequence[Outcome]]) -> list[str]:
    """Lines of a table with one row for each group of outcomes; a dash where nothing was said.

    brier: of presence, per case; log loss: of the main cause; said and right: mean probability of the first
    answer and share of them that is right, where that probability lies in a range.
    """
    ranges = [f"said {low}-{high}: n, said, right" for low, high in SAID]
    head = ["", "cases", "brier", "log loss", "first right", "exact", f"wrong > {SURE}", *ranges]
    lines = [head]
    for title, outcomes in rows.items():
        if not outcomes:
            continue
        line = [
            title,
            str(len(outcomes)),
            f"{np.mean([each.presence_error for each in outcomes]):.3f}",
            f"{np.mean([each.cause_loss for each in outcomes]):.3f}",
            str(sum(each.is_right for each in outcomes)),
            str(sum(each.is_exact for each in outcomes)),
            str(sum(each.said > SURE and not each.is_right for each in outcomes)),
        ]
        for low, high in SAID:
            within = [each for each in outcomes if low <= each.said < high or each.said == high == 1]
            if not within:
                line.append("-")
                continue
            mean_probability = np.mean([each.said for each in within])
            right = np.mean([each.is_right for each in within])
            line.append(f"{len(within)}, {mean_probability:.2f}, {right:.2f}")
        lines.append(line)
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]
