"""From what fitted sets of effects leave to probabilities: a small model fitted to diagnoses of known truth.

Three logistic forms with ten coefficients stand between what a search has fitted and what is said:

- A set of effects S has the probability exp(f(S) . a + log prior(S)), normalised over the fitted sets
  (conditional logit, McFadden 1974), mixed with the share of the repairs that are this set.
- An effect of the set is there, and no stand-in for something that nobody listed, with the probability
  1 / (1 + exp(-g . b)).
- Beside what the set leaves there is a cause on no list with the probability 1 / (1 + exp(-h . c)), where a
  model error is stated. Where nobody has said what does not interest, whatever is left has a cause.

The coefficients stand in `naming_model.toml`, with the command that fits them to made machines of every kind,
some of which have causes on no list. What the features are is said in `diagnosis.judge.set_features`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from scipy.special import expit, softmax

from diagnosis.judge.set_features import (
    EFFECT_FEATURES,
    REST_FEATURES,
    SET_FEATURES,
    EffectFeatures,
    SetFeatures,
)
from diagnosis.machine.machine_protocol import Real

# Share of prediction in the probability of a set, the rest is evidence. Where much is left that nobody
# listed, evidence hardly tells sets apart, and documented effects of measured machines were denied that
# explain most of the error. Cross-validated (`python -m benchmarks.naming`, with this constant changed) the
# log loss of the cause is .886 with 0, .836 with .3 and .834 with .5, where five answers fewer are right.
PREDICTION = 0.3


@dataclass(frozen=True, eq=False)
class NamingModel:
    """The fitted coefficients.

    Attributes
    ----------
    of_set : (3,) array
        a, in the order of `SET_FEATURES`.
    of_effect : (5,) array
        b, in the order of `EFFECT_FEATURES`.
    of_rest : (2,) array
        c, in the order of `REST_FEATURES`.
    """

    of_set: Real
    of_effect: Real
    of_rest: Real

    def set_probabilities(self, sets: Sequence[SetFeatures]) -> Real:
        """(S,) probabilities of the sets among each other, summing to one.

        Where none of the sets is a repair, evidence alone counts.
        """
        features = np.array([set_features.features for set_features in sets])
        log_priors = np.array([set_features.log_prior for set_features in sets])
        by_evidence = softmax(features @ self.of_set + log_priors)
        repair_shares = np.array([set_features.repair_share for set_features in sets])
        if not np.sum(repair_shares) > 0:
            return np.asarray(by_evidence)
        by_prediction = repair_shares / np.sum(repair_shares)
        return np.asarray((1 - PREDICTION) * by_evidence + PREDICTION * by_prediction)

    def is_genuine(self, effect: EffectFeatures) -> float:
        """Probability that an effect of the right set is there, and does not stand in for a cause on no list.

        0 for what is no answer.
        """
        if not effect.is_answer:
            return 0.0
        return (1 - effect.by_name) * float(expit(np.dot(effect.features, self.of_effect)))

    def has_unlisted_cause(self, rest_features: tuple[float, ...], model_error_is_stated: bool) -> float:
        """Probability that a cause on no list is behind what is left.

        Where nobody has said what does not interest, whatever is left has a cause: 1.

        rest_features : `SetFeatures.rest_features` of the set that leaves it.
        """
        if not model_error_is_stated:
            return 1.0
        return float(expit(np.dot(rest_features, self.of_rest)))


@cache
def fitted_model() -> NamingModel:
    """The coefficients of `naming_model.toml`.

    Raises
    ------
    ValueError
        If the file is of another version: its features are not those of this one.
    """
    text = resources.files(__package__).joinpath("naming_model.toml").read_text("utf-8")
    tables = tomllib.loads(text)
    coefficients = []
    for table, names in (("set", SET_FEATURES), ("effect", EFFECT_FEATURES), ("rest", REST_FEATURES)):
        if tuple(tables[table]) != names:
            raise ValueError(
                f"naming_model.toml: table {table!r} has {', '.join(tables[table])}; this version asks for "
                f"{', '.join(names)}. Fit it anew: python -m benchmarks.naming"
            )
        coefficients.append(np.array(list(tables[table].values()), dtype=np.float64))
    return NamingModel(*coefficients)
