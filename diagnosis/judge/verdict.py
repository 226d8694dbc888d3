"""The answer beside a model error: what is named, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.stats import norm

from diagnosis.evidence.explanation import Explanation, best_of_sets
from diagnosis.evidence.hypotheses import Probabilities
from diagnosis.fit.likelihood import SUBSTANTIAL
from diagnosis.fit.records import Records, mean_square_left
from diagnosis.judge.judgement import Judgement
from diagnosis.judge.naming_model import fitted_model
from diagnosis.judge.set_features import EffectFeatures, SetFeatures, features_of_effects, features_of_sets
from diagnosis.machine.rounding import Rounding, rounding_effect
from diagnosis.search.loop import FOLLOWED_SETS
from diagnosis.search.search import Search

# Sets less probable than this, over the most probable one, are not looked at: a hundred of them could add a
# tenth to the presence of an effect.
_NEGLIGIBLE = 1e-3
# Width, in natural logarithms, of what solver and start add to what is left: 6 %. Chosen; with one record
# it is the whole width of the completeness.
_SOLVER_WIDTH = 0.06
# Share of the motion that is nothing.
_NOTHING = 1e-4

Names = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class JudgedEffect:
    """An effect within a set.

    Attributes
    ----------
    features : EffectFeatures
        Its name, the share of the motion that it carries, and whether it interests.
    genuine : float
        Probability that it does not stand in for a cause on no list, if its set is the right one.
    """

    features: EffectFeatures
    genuine: float

    @property
    def probability(self) -> float:
        """Probability that the effect is there and interests, if its set is the right one."""
        return self.features.interests * self.genuine


@dataclass(frozen=True, eq=False)
class WeightedSet:
    """A set of effects with its probability, whatever fitted it.

    Attributes
    ----------
    probability : float
        Among the fitted sets.
    effects : tuple of JudgedEffect
        The one that carries most first.
    unlisted_beside : float
        Probability that a cause on no list is behind what the set leaves.
    """

    probability: float
    effects: tuple[JudgedEffect, ...]
    unlisted_beside: float


@dataclass(frozen=True, eq=False)
class JudgedSet(WeightedSet):
    """A fitted set of effects with its probability.

    Attributes
    ----------
    explanation : Explanation
        Its likeliest fit.
    """

    explanation: Explanation

    def holding(self, least_probability: float) -> set[str]:
        """Its effects that are at least as probable as this."""
        return {effect.features.name for effect in self.effects if effect.probability >= least_probability}


@dataclass(frozen=True, eq=False)
class JudgedSets(Judgement):
    """A judgement with the sets that it was made from.

    Attributes
    ----------
    judged : tuple of JudgedSet
        The most probable first.
    nominal : Explanation
        Without effects: as stated, or re-estimated where that leaves less of the validation records.
    """

    judged: tuple[JudgedSet, ...] = field(kw_only=True)
    nominal: Explanation = field(kw_only=True)

    def fitted(self, names: Iterable[str]) -> set[str]:
        """Names without rounding of a sensor, which is in no fitted set."""
        return set(names) - ({self.rounding.name} if self.rounding else set())

    def probability(self, fitted: Iterable[str]) -> float:
        """Probability of exactly these fitted effects, with rounding where that interests."""
        rounding = () if self.rounding is None else (self.rounding.name,)
        return self.probabilities.sets.get(tuple(sorted((*fitted, *rounding))), 0.0)


def better_nominal(search: Search) -> Explanation:
    """The model without effects: as stated, or re-estimated where that leaves less of validation records."""
    noise = search.case.noise
    candidates = (search.nominal_alone, search.at_stated_values())
    return min(candidates, key=lambda explanation: explanation.held_out_energy(noise))


def look_closer(search: Search, nominal: Explanation) -> None:
    """Fit what is near the most probable sets: at most `FOLLOWED_SETS` rounds, fewer where one finds nothing
    new. Time is asked once a round, so that the last one may end late.

    Sets within `SUBSTANTIAL` (2 nats, a factor of 7) of the best are fitted with an effect exchanged for
    another one and with a simpler one, the best one without each of its effects. An effect that is likelier
    there than not (.5) is not exchanged.

    Parameters
    ----------
    search : Search
        After its run; it gets the new explanations.
    nominal : Explanation
        `better_nominal`.
    """
    for _ in range(FOLLOWED_SETS):
        known = len(search.explanations)
        sets = _judged_sets(search, nominal, {})
        if search.out_of_time:
            return
        near = [
            judged_set
            for judged_set in sets
            if judged_set.probability > sets[0].probability * np.exp(-SUBSTANTIAL)
        ]
        for judged_set in near:
            search.add_exchanged(judged_set.explanation, judged_set.holding(0.5))
        likeliest = sets[0].explanation
        if len(likeliest.names) > 1:
            for place in range(len(likeliest.names)):
                search.without_effect(likeliest, place)
        for explanation in [*(judged_set.explanation for judged_set in near), *search.explanations[known:]]:
            search.add_simpler(explanation)
        if len(search.explanations) == known:
            return


def judged(search: Search, nominal: Explanation, repair_shares: Mapping[Names, float]) -> JudgedSets:
    """The answer from everything that a search has fitted.

    Parameters
    ----------
    search : Search
        After its run, and `look_closer`.
    nominal : Explanation
        `better_nominal`.
    repair_shares : mapping
        Sorted names -> share of the repairs that are this set (`repair.stability`).
    """
    sets = _judged_sets(search, nominal, repair_shares)
    probabilities = probabilities_of_answers(sets, search.case.machine.weighing.listed)
    # Rounding of a sensor is read off the measured values and stands in no fitted set.
    rounding = rounding_effect(search.case)
    rounding_share = 0.0 if rounding is None else _rounding_share(search, rounding)
    if rounding is not None and rounding_share > search.case.machine.weighing.model_error:
        largest = max((effect.features.share for effect in sets[0].effects), default=0.0)
        probabilities = probabilities.with_certain_effect(rounding.name, leads=rounding_share > largest)
    else:
        rounding = None
    # What was not tried may be there, and counts as unknown.
    untried = search.untried
    probabilities = probabilities.with_untried(untried, larger=len(search.skipped_for_time) > 0)
    answer = probabilities.counting_as_unknown(untried).answer
    shares = {
        effect.features.name: effect.features.share
        for judged_set in reversed(sets)
        for effect in judged_set.effects
    }
    if rounding is not None:
        shares[rounding.name] = rounding_share
    return JudgedSets(
        probabilities,
        answer,
        accepted_set(probabilities, answer, shares),
        untried,
        rounding,
        judged=sets,
        nominal=nominal,
    )


def below_threshold(search: Search, explanation: Explanation) -> float:
    """Probability that what is left is below the threshold, which other records would show another size of.

    Log-normal, as wide as the mean of the records that there are is uncertain, and what solver and start add.
    As the records run freely or in windows, whichever leaves less: a drift alone is no error that interests.
    """
    case = search.case
    ways = [(search.records, search.held_out)]
    if search.drift_free_windows and not search.windows:
        ways.append(
            (
                Records(case, case.estimation, search.drift_free_windows),
                Records(case, case.held_out, search.drift_free_windows),
            )
        )
    probabilities = []
    for estimation, validation in ways:
        energies = [
            estimation.energies(explanation.residuals),
            validation.energies(explanation.held_out_residuals),
        ]
        squares = [np.max(mean_square_left(energy)) for energy in energies]
        left = max(float(np.sqrt(np.mean(squares))), _NOTHING)
        # Of every record, of the output that shows most of it.
        energy_left, energy_of_motion = np.concatenate(energies, axis=1)
        of_records = np.max(np.sqrt(energy_left / energy_of_motion), axis=1)
        logs = np.log(np.maximum(of_records, _NOTHING))
        width = np.hypot(_SOLVER_WIDTH, np.std(logs) / np.sqrt(logs.size))
        probabilities.append(float(norm.cdf(np.log(case.machine.weighing.model_error / left) / width)))
    return max(probabilities)


def explanations_to_judge(search: Search, nominal: Explanation) -> dict[Names, Explanation]:
    """Sorted names -> the likeliest fit of these effects, the likeliest first.

    None leaves more of the validation records than the nominal, as stated or re-estimated.
    """
    noise = search.case.noise
    farthest = nominal.held_out_energy(noise)
    explanations = {}
    for key, explanation in best_of_sets(search.explanations).items():
        if not key or explanation.held_out_energy(noise) <= farthest:
            explanations[key] = explanation
    return explanations


def _judged_sets(
    search: Search, nominal: Explanation, repair_shares: Mapping[Names, float]
) -> tuple[JudgedSet, ...]:
    """The fitted sets that are not negligible, the most probable first."""
    model = fitted_model()
    explanations = explanations_to_judge(search, nominal)
    features = features_of_sets(search, explanations, repair_shares)
    probabilities = model.set_probabilities(features)
    remaining: list[tuple[float, SetFeatures]] = []
    for probability, set_features in zip(probabilities, features, strict=True):
        if probability >= _NEGLIGIBLE * np.max(probabilities):
            remaining.append((float(probability), set_features))
    remaining.sort(key=lambda pair: -pair[0])
    total = sum(probability for probability, _ in remaining)
    sets = []
    for probability, set_features in remaining:
        effects = tuple(
            JudgedEffect(effect, model.is_genuine(effect))
            for effect in features_of_effects(search, set_features.explanation, explanations)
        )
        unlisted = model.has_unlisted_cause(set_features.rest_features, search.case.machine.weighing.stated)
        sets.append(JudgedSet(probability / total, effects, unlisted, set_features.explanation))
    return tuple(sets)


def probabilities_of_answers(sets: Sequence[WeightedSet], listed: Sequence[str]) -> Probabilities:
    """Every set shared out among those of its effects that are there.

    Each effect of a set is there, or too small to interest, or stands in for a cause on no list. Where none
    is there the cause is unknown if one of them stands in for it; if all are too small it is none, or unknown
    as far as a cause on no list is probable behind what the set leaves.

    Parameters
    ----------
    sets : sequence of WeightedSet
        With probabilities that sum to one.
    listed : sequence of str
        Effects that were looked for.
    """
    of_sets: dict[Names, float] = {(): 0.0, ("unknown",): 0.0}
    cause = {"none": 0.0, **dict.fromkeys(listed, 0.0), "unknown": 0.0}
    presence = dict.fromkeys(listed, 0.0)
    for judged_set in sets:
        none_there = judged_set.probability
        all_small = judged_set.probability
        for effect in judged_set.effects:
            none_there *= 1 - effect.probability
            all_small *= 1 - effect.features.interests
        of_sets[()] += all_small * (1 - judged_set.unlisted_beside)
        of_sets[("unknown",)] += none_there - all_small + all_small * judged_set.unlisted_beside

        possible = [effect for effect in judged_set.effects if effect.probability > 0]
        for count in range(1, len(possible) + 1):
            for present in combinations(possible, count):
                probability = judged_set.probability
                for effect in possible:
                    probability *= effect.probability if effect in present else 1 - effect.probability
                names = [effect.features.name for effect in present]
                key = tuple(sorted(names))
                of_sets[key] = of_sets.get(key, 0.0) + probability
                # The one that carries most is the main cause.
                cause[names[0]] += probability
                for name in names:
                    presence[name] += probability
    cause["none"] = of_sets[()]
    cause["unknown"] = of_sets[("unknown",)]
    return Probabilities(cause, of_sets, presence)


def accepted_set(probabilities: Probabilities, answer: str, shares: Mapping[str, float]) -> Names:
    """The most probable set that holds the answer, what carries most first; nothing for none and unknown.

    shares : name -> share of the motion that it carries, of every effect.
    """
    if answer in ("none", "unknown"):
        return ()
    holding = [key for key in probabilities.sets if answer in key]
    most_probable = max(holding, key=lambda key: probabilities.sets[key])
    return tuple(sorted(most_probable, key=lambda name: -shares.get(name, 0.0)))


def _rounding_share(search: Search, rounding: Rounding) -> float:
    """Share of the motion that rounding is, of the output that shows most of it."""
    outputs = search.case.noise.size
    samples = sum(len(record.output) for record in (*search.case.estimation, *search.case.held_out))
    motion = np.concatenate([search.records.levels.motion_energy, search.held_out.levels.motion_energy])
    motion_energy = motion.reshape(-1, outputs).sum(axis=0)
    return float(np.sqrt(np.max(rounding.variances * samples / motion_energy)))
