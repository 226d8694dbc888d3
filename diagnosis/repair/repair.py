"""The repair of a model: the effects and values with which it predicts logs best that were not used.

A search has fitted many sets of effects to the estimation records. Which of them makes the simulation predict
better is asked of logs: every validation record, to which nothing was fitted, and every estimation record,
left out of the fit in turn (`left_out`). Of the sets that predict as well as the best, within one standard
error, the smallest is taken (Breiman, Friedman, Olshen, Stone, Classification and Regression Trees, 1984,
3.4.3), and of its nominal values as few are moved as predict as well. What a good model may miss anyway is no
reason for a larger set: what a real machine has beyond its model is the same in every log, so that almost any
effect makes some tiny part of it surely smaller. No probability of a cause has a say.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np
import numpy.typing as npt

from diagnosis.evidence.explanation import E, best_of_sets
from diagnosis.fit.coordinates import bounds_of, effects_at, solve_or_least_squares
from diagnosis.fit.descent import Fit, descend, loss_at
from diagnosis.repair.left_out import SharedUnknowns, fitted_without_each_log
from diagnosis.repair.prediction_error import PredictionError
from diagnosis.search.loop import FOLLOWED_SETS, SearchLoop

# Simulations of a repair, as a share of those of its search: it may cost a fifth of a diagnosis, and the last
# descent comes on top. With half of it the pendulum and the joints of `real_machine_gaps` have the same
# repair.
_SHARE_OF_SEARCH = 0.15
# Standard errors by which a set has to predict worse with an effect for that to be refuted: by chance once in
# forty times. With twice as many, logs of two or three blocks that differ would refute nothing.
_SURELY = 2.0
# Every number of moved values up to this one is tried, beyond it every doubling: a repair that moves more is
# asked less finely how many.
_EACH_NUMBER = 4


@dataclass(frozen=True, eq=False)
class Trial(Generic[E]):
    """A set of effects with some of the nominal values moved, and how well it predicts.

    Attributes
    ----------
    explanation : Explanation or Hypothesis
        With what it leaves of every record.
    moved : (P,) array of bool
        Nominal values that were re-estimated; the others are as stated.
    error : PredictionError
        Of estimation records left out in turn, where there are two or more, then of validation records.
    validation : PredictionError
        Of validation records alone.
    """

    explanation: E
    moved: npt.NDArray[np.bool_]
    error: PredictionError
    validation: PredictionError

    @property
    def names(self) -> tuple[str, ...]:
        """Effects, in the order in which they were found."""
        return self.explanation.names


class Repairs(Generic[E]):
    """Repairs from what one search has fitted.

    Attributes
    ----------
    trials : list of Trial
        What was tried, for every set of effects the better of all values moved and none; the nominal first.
    """

    def __init__(self, search: SearchLoop[E], nominal: E) -> None:
        """Try the sets of a search until its share of simulations is used or its time is up.

        Parameters
        ----------
        search : SearchLoop
            After its run.
        nominal : Explanation or Hypothesis
            The model without effects that a repair has to beat on validation records: as stated or
            re-estimated.
        """
        self.search = search
        self._budget_end = search.simulations * (1 + _SHARE_OF_SEARCH)
        self._nominal_validation = self._validation_error(nominal)
        self.trials: list[Trial[E]] = []
        for explanation in self._shortlist():
            variants = [self._tried(explanation.fit, self._all_moved(), explanation)]
            # What may be moved and need not.
            if explanation.fit.deviations.size:
                variants.append(self._tried(explanation.fit, ~self._all_moved()))
            self.trials.append(min(variants, key=lambda trial: trial.error.rms))
            if search.simulations > self._budget_end or search.out_of_time:
                break

    def best(self, named: Collection[str]) -> Trial[E]:
        """The repair: few effects, few values, descended to its end.

        Parameters
        ----------
        named : collection of str
            Effects that are named as the cause. Among sets that predict equally well they go first, so that
            name and repair agree where the logs allow it.
        """
        chosen = self._smallest_set(named)
        missing = [name for name in named if name not in chosen.names]
        if missing and self._try_with(chosen, missing):
            chosen = self._smallest_set(named)
        chosen = self._descended(self._fewest_values(chosen))
        # Within one standard error of the best a repair may still predict worse than no effect does: of logs
        # left out, which one step predicts roughly, and of those for validation.
        nominal = self.trials[0]
        is_worse = chosen.error.rms > nominal.error.rms and chosen.validation.rms > nominal.validation.rms
        return nominal if is_worse else chosen

    def refutes(self, name: str, names: Collection[str]) -> bool:
        """Whether logs are surely predicted worse by a set of effects with one of them than without it.

        Parameters
        ----------
        name : str
            The effect in question.
        names : collection of str
            The set, with it. What was not fitted refutes nothing.
        """
        trials = []
        for key in (tuple(sorted(names)), tuple(sorted(set(names) - {name}))):
            known = [trial for trial in self.trials if trial.explanation.sorted_names == key]
            if known:
                trials.append(known[0])
                continue
            explanation = best_of_sets(self.search.explanations).get(key)
            if explanation is None:
                return False
            trials.append(self._tried(explanation.fit, self._all_moved(), explanation))
        with_it, without = trials
        difference, standard_error = with_it.error.beyond(without.error)
        return difference > _SURELY * standard_error

    def _try_with(self, chosen: Trial[E], further: Collection[str]) -> bool:
        """Try a set with further effects, from where these ended elsewhere; whether there was one to try.

        A name and a repair that lacks it may only not have been fitted together. An effect that contains one
        of the set, or is contained in one, is left out.
        """
        search = self.search
        end = chosen.explanation.fit
        candidates = list(end.candidates)
        coordinates = [end.coordinates]
        for name in further:
            holding = max(
                (fit for fit in search.explanations if name in fit.names),
                key=lambda fit: fit.log_evidence,
                default=None,
            )
            if holding is None:
                continue
            place = holding.names.index(name)
            candidate = holding.fit.candidates[place]
            related = {candidate.kind.contains, *(c.kind.contains for c in candidates)}
            if related & {candidate.effect, *(c.effect for c in candidates)}:
                continue
            candidates.append(candidate)
            coordinates.append(holding.fit.coordinates_of(place))
        key = tuple(sorted(candidate.effect for candidate in candidates))
        known = any(trial.explanation.sorted_names == key for trial in self.trials)
        if known or len(candidates) == len(end.candidates) or search.out_of_time:
            return False
        fitted = descend(search.records, candidates, end.deviations, np.concatenate(coordinates), end.start)
        explanation = search.add(fitted)
        self.trials.append(self._tried(fitted, self._all_moved(), explanation))
        return True

    def _shortlist(self) -> list[E]:
        """Fitted sets that are worth a look at logs left out: the nominal, then those that leave least.

        For every number of effects the `FOLLOWED_SETS` (four) that leave least of the validation records and
        the likeliest one; none that leaves more of these than the nominal does by over one standard error.
        """
        likeliest = best_of_sets(self.search.explanations)
        energies = {}
        for key, explanation in likeliest.items():
            validation = self._validation_error(explanation)
            if validation.as_good_as(self._nominal_validation):
                energies[key] = float(np.sum(validation.energy))
        shortlist: list[tuple[str, ...]] = []
        for count in range(1, max(len(key) for key in likeliest) + 1):
            keys = [key for key in energies if len(key) == count]
            predicting = sorted(keys, key=lambda key: energies[key])[:FOLLOWED_SETS]
            # The dictionary has the likeliest first.
            shortlist += list(dict.fromkeys([*predicting, *keys[:1]]))
        shortlist.sort(key=lambda key: energies[key])
        return [self.search.nominal_alone, *(likeliest[key] for key in shortlist)]

    def _all_moved(self) -> npt.NDArray[np.bool_]:
        """(P,) True for every nominal value."""
        return np.ones(self.search.records.nominal.count, dtype=bool)

    def _validation_error(self, explanation: E) -> PredictionError:
        """Prediction error of a model, as it was fitted, in the validation records."""
        held_out = self.search.case.held_out
        residuals = self.search.whitened_residuals(explanation, held_out)
        return PredictionError.of([residuals[record.name] for record in held_out])

    def _tried(self, end: Fit, moved: npt.NDArray[np.bool_], explanation: E | None = None) -> Trial[E]:
        """The end of a fit with these values moved and the others as stated, and its prediction error.

        explanation : of that end, where all values are moved.
        """
        search = self.search
        if explanation is None:
            if not np.all(moved):
                end = self._with_values_as_stated(end, moved)
            explanation = search.explain(end)
        held_out = search.case.held_out
        whitened = search.whitened_residuals(explanation, held_out)
        residuals = [whitened[record.name] for record in held_out]
        validation = PredictionError.of(residuals)
        logs = len(search.case.estimation)
        if logs < 2 or search.out_of_time:
            return Trial(explanation, moved, validation, validation)
        left_out = []
        for log, without in enumerate(fitted_without_each_log(search.records, end, moved)):
            effects = effects_at(end.candidates, without.coordinates)
            left_out.append(search.prediction_residuals(log, without.deviations, effects, without.start))
        return Trial(explanation, moved, PredictionError.of([*left_out, *residuals]), validation)

    def _with_values_as_stated(self, end: Fit, moved: npt.NDArray[np.bool_]) -> Fit:
        """The end of a fit with the other values put back to what is stated, all else following linearly.

        Sizes that stay where they are, are tried too: where the values were far off a linearisation says
        little.
        """
        records = self.search.records
        normal = end.normal_equations(records)
        P = end.deviations.size
        A = end.coordinates.size
        back = np.zeros(normal.hessian.shape[0])
        back[:P] = np.where(moved, 0.0, -end.deviations)
        fixed = np.flatnonzero(~moved)
        free = np.setdiff1d(np.arange(back.size), fixed)
        gradient = normal.gradient(end.start, end.residual_coefficients) + normal.hessian @ back
        following = back.copy()
        following[free] -= solve_or_least_squares(normal.hessian[np.ix_(free, free)], gradient[free])

        low, high = bounds_of(end.candidates)
        ends = []
        for step in (following, back):
            deviations = records.nominal.clipped(end.deviations + step[:P])
            deviations[fixed] = 0.0
            point = SharedUnknowns(
                deviations,
                np.clip(end.coordinates + step[P : P + A], low, high),
                end.start_columns.moved(end.start, step[P + A :]),
            )
            left = records.coefficients(
                point.deviations, effects_at(end.candidates, point.coordinates), point.start
            )
            loss, prior = loss_at(records, left, point.deviations, point.start)
            ends.append(
                replace(
                    end,
                    deviations=point.deviations,
                    coordinates=point.coordinates,
                    start=point.start,
                    residual_coefficients=left,
                    weights=records.likelihood.weights(left),
                    loss=loss,
                    prior_loss=prior,
                )
            )
        return min(ends, key=lambda tried: tried.loss)

    def _smallest_set(self, named: Collection[str]) -> Trial[E]:
        """The set with most of the named effects, of those that predict as well as the best.

        Of several the one with fewest effects, then the likeliest.
        """
        best = min(self.trials, key=lambda trial: trial.error.rms)
        uninteresting = self.search.uninteresting_energy
        as_good = [trial for trial in self.trials if trial.error.as_good_as(best.error, uninteresting)]

        def rank(trial: Trial[E]) -> tuple[int, int, float]:
            named_here = len(set(trial.names) & set(named))
            return -named_here, len(trial.names), -trial.explanation.log_evidence

        return min(as_good, key=rank)

    def _fewest_values(self, chosen: Trial[E]) -> Trial[E]:
        """A trial of the same effects with as few values moved as predict as well as the best number of them.

        Which value goes back next is told by the fit with all of them moved: the one without which the
        estimation records lose least.
        """
        search = self.search
        full = best_of_sets(search.explanations)[chosen.explanation.sorted_names].fit
        P = full.deviations.size
        if not P:
            return chosen
        order = _order_of_return(full, full.normal_equations(search.records).hessian)
        sizes = sorted({*range(min(P, _EACH_NUMBER) + 1), *(2**k for k in range(2, 8) if 2**k < P), P})
        trials = [chosen]
        for size in sizes:
            moved = np.zeros(P, dtype=bool)
            moved[order[P - size :]] = True
            if np.array_equal(moved, chosen.moved):
                continue
            if search.simulations > self._budget_end or search.out_of_time:
                break
            trials.append(self._tried(full, moved))
        no_worse = [trial for trial in trials if trial.validation.as_good_as(self._nominal_validation)]
        best = min(no_worse or trials, key=lambda trial: trial.error.rms)
        # A value that surely helps is known better now than it was, however little that interests.
        as_good = [trial for trial in no_worse or trials if trial.error.as_good_as(best.error)]
        return min(as_good, key=lambda trial: (int(np.sum(trial.moved)), trial.error.rms))

    def _descended(self, chosen: Trial[E]) -> Trial[E]:
        """A repair descended to its end, the values that are as stated held; as it was where that predicts
        worse, or no time is left."""
        search = self.search
        end = chosen.explanation.fit
        if search.out_of_time or not (end.candidates or np.any(chosen.moved)):
            return chosen
        descended = descend(
            search.records,
            end.candidates,
            end.deviations,
            end.coordinates,
            end.start,
            nominal_jacobian=end.jacobian[:, : end.deviations.size],
            columns=end.start_columns,
            moved=chosen.moved,
        )
        trial = self._tried(descended, chosen.moved, search.explain(descended))
        if trial.error.rms > chosen.error.rms:
            return chosen
        return trial


def _order_of_return(end: Fit, hessian: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """(P,) nominal values in the order in which they go back to what is stated, the least missed first.

    Parameters
    ----------
    end : Descent
        Of a fit in which all of them were moved.
    hessian : (M, M) array
        Of its loss by all unknowns, the P deviations first.

    Notes
    -----
    Putting the values of a set S back by -d_S, with all else following, costs 1/2 d_S' [(H^-1)_SS]^-1 d_S to
    second order. One value at a time is added to S.
    """
    P = end.deviations.size
    inverse = np.linalg.pinv(hessian, hermitian=True)
    returned: list[int] = []
    while len(returned) < P:
        costs = {}
        for value in set(range(P)) - set(returned):
            back = [*returned, value]
            covariance = np.asarray(inverse[np.ix_(back, back)], dtype=np.float64)
            costs[value] = float(
                end.deviations[back] @ solve_or_least_squares(covariance, end.deviations[back])
            )
        returned.append(min(costs, key=lambda value: (costs[value], value)))
    return np.array(returned, dtype=np.int64)
