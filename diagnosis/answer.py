"""What a diagnosis answers: verdict, effects with probabilities, gaps, the repaired model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from diagnosis.fit.residual import pooled_rms
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from diagnosis.machine.rounding import rounding_effect
from diagnosis.next_experiment.discrimination import CompetingHypothesis
from ident.data.keywords import clear_constructor
from ident.data.shown import Shown
from plant.effects.search_space import Candidate

Verdict = Literal["none", "effect", "unknown"]
# "parametric": no effect, but values far outside their tolerances. "ambiguous": an effect, and another answer
# is possible.
DetailVerdict = Literal["none", "parametric", "effect", "ambiguous", "unknown", "not_converged"]
# Nominal parameters as stated, re-estimated within their tolerances, effects added.
Model = Literal["stated", "refit", "repaired"]

# Whitened residuals of a true model have unit variance.
NOISE_FLOOR = 1.0
# A nominal parameter that has to be off by more tolerances than this is significant by itself: tolerances are
# standard deviations, and one in 370 is further off.
FAR_OFF = 3.0
# Below this probability of the first answer it is called ambiguous. Chosen: one in five is a rival.
SURE = 0.8
# And with another answer above this one: one in twenty, the level of a usual test.
POSSIBLE = 0.05
# An effect more likely than not is called present.
_PRESENT = 0.5
# Part of a range: a value this near its end is pinned there, as steps of a fit end there.
_PINNED = 1e-3
# Part of a range: an interval this wide says nothing about where in it the value is. Chosen.
_WIDE = 0.9
# Draws of the bootstrap of the share closed: ends of a 95 % interval are known to 6 % of a deviation.
_DRAWS = 2000
# Samples of a block of it: longer than residuals resemble each other, as a rule. Chosen; shorter blocks make
# an interval too narrow.
BLOCK = 50
# Bounds of 95 % of the draws.
_INTERVAL = (0.025, 0.975)
# Standard deviations by which energies exceed that of noise, or it is noise: one in a thousand records of
# noise is above.
_CHANCE = 3.0
# Times the noise that an output has to move in a record for a share of its motion to mean anything. Chosen;
# doubled, records whose motion is a tenth noise are passed over.
_MOVES = 3.0


@dataclass(frozen=True, eq=False)
class NamedEffect:
    """One possible answer.

    name : effect id, or "none" or "unknown"
    probability : float. That it is the main cause; over all answers the sum is one.
    presence : float
        That it is there at all, as the main cause or beside another (equals `probability` for none, unknown).
    parameters, intervals : parameter -> value, 95 % interval (low, high). From the most probable set of
        effects that holds it; empty for none and unknown, and where no size of the effect was worth a fit.
    gap_after : float. Pooled RMS of the held-out residuals over the noise with that set; nan without a fit.
    explains : share, its 95 % interval (low, high). Of the energy of the validation error beyond noise that
        it explains in that set; of one that is not in the repaired model without an interval (nan).
    remarks : parameter -> what its interval does not say: at an end of its range, or as wide as that.
    untried : what it would need to be tried; "" where it was.
    widened_by : key of the nominal value that the first interval is widest by, where tolerances make up most
        of it; else "". Were all of them exact, it would be half as wide or less.
    """

    name: str
    probability: float
    presence: float
    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    gap_after: float
    explains: tuple[float, float, float] = (float("nan"),) * 3
    remarks: Mapping[str, str] = field(default_factory=dict)
    untried: str = ""
    widened_by: str = ""


@dataclass(frozen=True)
class Completeness:
    """Whether the effects of the repaired model are all, whichever they are.

    Attributes
    ----------
    probability : float
        That no more than the threshold remains, from all records.
    threshold : float
        Share of the motion; 0 where the simulation is to be as good as the sensors.
    remains : output -> float
        Share of the motion (RMS about its mean), 0 to 1, that remains beyond sensor noise in validation
        records.
    in_units : output -> float
        What remains there in the output's unit, RMS.
    in_record : str
        The record, validation or not, of whose motion most remains.
    remains_in_record : output -> float
        Share of that record's own motion that remains in it.
    """

    probability: float
    threshold: float
    remains: Mapping[str, float]
    in_units: Mapping[str, float]
    in_record: str = ""
    remains_in_record: Mapping[str, float] = field(default_factory=dict)

    @property
    def most(self) -> float:
        """Share of the output that shows most in validation records."""
        return max(self.remains.values())

    @property
    def most_in_record(self) -> float:
        """Share of the output that shows most in the record that is furthest off."""
        return max(self.remains_in_record.values(), default=self.most)

    @property
    def above_elsewhere(self) -> bool:
        """Whether validation records stay below the threshold, and another record does not."""
        return self.most < self.threshold <= self.most_in_record


@dataclass(frozen=True)
class Shares:
    """What effects carry of the gap of a machine with a model error, on held-out records.

    names : of the outputs. before, after : RMS left beyond sensor noise over that of the motion, per output:
        nominal values re-estimated, effects added; 1 where as much as the motion is left or more. interests :
        share of the motion from which on a gap does.
    carried : effect of the repaired model, small ones too -> (share of the gap's energy beyond noise that it
        closes, whatever the order in which effects are added, with its 95 % interval).
    small : effects in the repaired model that carry less than what interests.
    closes : (effects, share of the gap closed by them alone), most first; also where the answer is unknown.
    not_tried : what a time limit left out.
    silent : effects of the answer that do nothing in the held-out records.
    in_windows : the answer rests on windows, each from the state that fits it best (`fit.windows`), and so do
        all residuals and shares of it.
    horizon_samples : length of these, and horizon_before, horizon_after : what is left in them, as before and
        after; 0 and empty for a machine that forgets its inputs. horizon_closed : share of the gap that the
        effects close in them, none above 1; nan without a gap there.
    """

    names: tuple[str, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    interests: float
    carried: dict[str, tuple[float, float, float]]
    small: tuple[str, ...]
    closes: tuple[tuple[tuple[str, ...], float], ...]
    not_tried: tuple[str, ...]
    silent: tuple[str, ...] = ()
    in_windows: bool = False
    horizon_samples: int = 0
    horizon_before: tuple[float, ...] = ()
    horizon_after: tuple[float, ...] = ()
    horizon_closed: float = float("nan")


@dataclass(frozen=True)
class Prediction:
    """How well the repaired model predicts logs that it was not fitted to.

    Such logs are the validation records and, where there are two or more, the estimation records, each left
    out of the fit in turn. Errors are RMS of (measured - model) / noise over all of them.

    Attributes
    ----------
    effects : tuple of str
        Of the repaired model: the smallest set that predicts as well as the best one tried, within one
        standard error.
    values : tuple of str
        Nominal values that are moved in it; all others are as stated.
    error_nominal, error, error_best : float
        Without effects, the better of all nominal values moved and none; with the repair; with the best set
        of effects that was tried.
    standard_error : float
        Of the difference between the first two, as a share of the energy of the first.
    unexplained : float
        Share of the validation error beyond noise that the repair leaves, 0 to 1; nan without an error.
    tried : tuple of (effects, error)
        Sets that were compared, the nominal model first.
    """

    effects: tuple[str, ...]
    values: tuple[str, ...]
    error_nominal: float
    error: float
    error_best: float
    standard_error: float
    unexplained: float
    tried: tuple[tuple[tuple[str, ...], float], ...]


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Shown):
    """What is wrong with a model, as far as its records tell.

    Attributes
    ----------
    case : Case or PlantCase
        What was diagnosed.
    verdict, detail_verdict : str
        "none", "effect" or "unknown"; in detail also "parametric" (stated values are off), "ambiguous" or
        "not_converged".
    probabilities : dict of answer to float
        Of the main cause; they sum to one. "none": no effect, and that is all; "unknown": none of the
        candidates, and more remains than the threshold.
    sets : dict of effects to float
        Probability of each set of effects; they sum to one. () is none, ("unknown",) unknown. Whether a set
        is all is another question (`completeness`).
    effects : tuple of NamedEffect
        Every effect, none and unknown, each with `presence`, `parameters` and `intervals`: the answer first,
        then by presence, with none and unknown last unless they are the answer.
    combination : tuple of str
        Effects that are accepted together; empty for the verdicts none and unknown.
    ambiguous_with : tuple of str
        Answers that the records cannot rule out beside the first.
    gap_before, gap_refit, gap_after : float
        Pooled RMS of (measured - model)/noise over the validation experiments: nominal rig, nominal
        parameters moved within their tolerances, accepted effects added.
    noise_floor : float
        What the same number is for noise alone.
    gap_closed, gap_closed_interval : float, (low, high)
        1 - (R_after - F)/(R_refit - F) with R, F the mean squares of the validation experiments and of the
        noise floor, and its 95 % bootstrap interval over blocks of samples; nan without a gap to close.
    deviations, deviations_refit : dict of key to float
        How far the nominal parameters are off, in tolerances: with the accepted effects in the model, and
        without any effect.
    rig, repair : object, tuple of effects
        The repaired model: nominal parameters moved (a Rig, or a Plant of one's own), and effects to add (of
        `plant.effects`, or changes of the own plant).
    residuals_before, residuals_refit, residuals_after : dict of experiment to (T, Y) array
        Whitened, every experiment, in the machine's order of outputs.
    simulations : int
        Number of simulated records.
    completeness : Completeness
        Whether that is all: the probability that no more than the threshold remains, and what remains.
    held_out_decided : bool
        The validation records did not confirm what the others said, and chose among the answers (none was
        fitted to them).
    unlisted : tuple of effects
        What explains the records where the answer is unknown and yet can be named: a cause beyond the list
        that looks like one of it, with whatever it acts beside.
    partial_model : tuple of str
        Effects of the repaired model where the answer is none or unknown: with them it predicts better, and
        nobody says that they are the cause.
    noise_below_stated : tuple of (output, noise, stated noise)
        Of an own machine whose records show less noise than is stated, in whose place it was counted.
    doubts : tuple of str
        What makes the answer doubtful, whatever the fit says.
    competing : tuple of CompetingHypothesis
        Fitted explanations that contradict each other, most probable first, for the next experiment; only for
        a flexible link.
    shares : Shares or None
        Only of a machine with a stated model error.
    white : (Y,) array or None
        What sensors have in the unit of the residuals of a page, taken off their sizes; None: sizes are over
        noise, which is one of them.
    prediction : Prediction or None
        What the repaired model is worth in logs that it was not fitted to.

    Examples
    --------
    >>> found = flexlink.diagnose(example_case())
    >>> found.combination, found.effects[0].presence > 0.9
    (('coulomb_friction',), True)
    >>> low, high = found.effects[0].intervals["torque_Nm"]
    >>> low < 0.05 < high
    True
    """

    table_in_notebook = True

    case: Any
    verdict: Verdict
    detail_verdict: DetailVerdict
    probabilities: dict[str, float]
    sets: dict[tuple[str, ...], float]
    effects: tuple[NamedEffect, ...]
    combination: tuple[str, ...]
    ambiguous_with: tuple[str, ...]
    gap_before: float
    gap_refit: float
    gap_after: float
    noise_floor: float
    gap_closed: float
    gap_closed_interval: tuple[float, float]
    deviations: dict[str, float]
    deviations_refit: dict[str, float]
    rig: Any
    repair: tuple[Any, ...]
    residuals_before: dict[str, Real]
    residuals_refit: dict[str, Real]
    residuals_after: dict[str, Real]
    simulations: int
    completeness: Completeness
    held_out_decided: bool = False
    unlisted: tuple[Any, ...] = ()
    partial_model: tuple[str, ...] = ()
    noise_below_stated: tuple[tuple[str, float, float], ...] = ()
    doubts: tuple[str, ...] = ()
    competing: tuple[CompetingHypothesis, ...] = ()
    shares: Shares | None = None
    white: Real | None = None
    prediction: Prediction | None = None

    @property
    def added(self) -> tuple[str, ...]:
        """Effects of the repaired model, whether they are the answer or only make it predict better."""
        if self.prediction is None:
            return self.combination or self.partial_model
        return self.prediction.effects

    @property
    def probability(self) -> float:
        """Probability of the answer: of the main cause where it stands alone, of the whole set where there
        are several; no more than the presence of any of them."""
        if self.verdict != "effect":
            return self.probabilities[self.verdict]
        if len(self.combination) == 1:
            of_answer = self.probabilities[self.combination[0]]
        else:
            of_answer = self.sets[tuple(sorted(self.combination))]
        return min(of_answer, *map(self.presence, self.combination))

    def presence(self, name: str) -> float:
        """Probability that an effect is there at all; of "none" and "unknown" that they are the answer."""
        return next(effect.presence for effect in self.effects if effect.name == name)

    @property
    def present(self) -> tuple[NamedEffect, ...]:
        """Effects that are more likely there than not, and those of the answer."""
        likely = (e for e in self.effects if e.name not in ("none", "unknown"))
        return tuple(e for e in likely if e.presence >= _PRESENT or e.name in self.combination)

    @property
    def untried(self) -> dict[str, str]:
        """Effect -> what it needs to be tried."""
        return {e.name: e.untried for e in self.effects if e.untried}

    @property
    def nothing_tried(self) -> bool:
        """Whether a time limit left no candidate tried."""
        return self.verdict == "unknown" and 0 < len(self.untried) == len(self.effects) - 2

    @property
    def beside(self) -> tuple[str, ...]:
        """Effects of the repaired model with the answer that carry less than the threshold."""
        return self.shares.small if self.shares and self.combination else ()

    @property
    def instead(self) -> tuple[str, ...]:
        """Answers that the records cannot rule out in place of the first."""
        return tuple(name for name in self.ambiguous_with if name not in (*self.beside, *self.perhaps))

    @property
    def perhaps(self) -> tuple[str, ...]:
        """Of `ambiguous_with`, effects that are likely beside the answer alone: one of another output cannot
        take its place."""
        if not self.combination:
            return ()
        with_answer = {key: p for key, p in self.sets.items() if set(self.combination) <= set(key)}
        perhaps = []
        for name in self.ambiguous_with:
            beside_answer = sum(p for key, p in with_answer.items() if name in key)
            without_answer = self.presence(name) - beside_answer
            if name not in self.beside and beside_answer >= POSSIBLE > without_answer:
                perhaps.append(name)
        return tuple(perhaps)

    @property
    def runner_up(self) -> str:
        """The likeliest answer beside the accepted ones."""
        other_answers = [name for name in self.probabilities if name not in self.combination]
        return max((self.presence(name), name) for name in other_answers)[1]

    @property
    def residuals(self) -> dict[Model, dict[str, Real]]:
        """Model -> experiment -> residuals (T, Y) over noise."""
        return {
            "stated": self.residuals_before,
            "refit": self.residuals_refit,
            "repaired": self.residuals_after,
        }

    @property
    def models(self) -> tuple[Model, ...]:
        """Models to compare: re-estimated where there are tolerances, repaired where effects were found."""
        moved: tuple[Model, ...] = ("refit",) if self.deviations else ()
        added: tuple[Model, ...] = ("repaired",) if self.added else ()
        return ("stated", *moved, *added)

    @property
    def gaps(self) -> dict[Model, float]:
        """Held-out residual over noise of the models to compare."""
        pooled: dict[Model, float] = {
            "stated": self.gap_before,
            "refit": self.gap_refit,
            "repaired": self.gap_after,
        }
        return {model: pooled[model] for model in self.models}

    @cached_property
    def replays(self) -> dict[Model, dict[str, Real]]:
        """First and last of the models -> validation record -> outputs (T, Y) from its start on under its
        commands alone. Empty where no simulation is held near its records: residuals are of these then."""
        plant = self.case.machine
        if getattr(plant, "untracked", None) is None:
            return {}
        runs = {"stated": plant.replayed(()), self.models[-1]: self.rig.replayed(self.repair)}
        replays = {}
        for model, run in runs.items():
            replays[model] = {record.name: run(record.input) for record in self.case.held_out}
        return replays

    @property
    def replayed(self) -> dict[str, dict[Model, float]]:
        """Output -> model -> RMS of measured less replayed, in the output's unit, all validation records."""
        if not self.replays:
            return {}
        rms = {}
        for model, runs in self.replays.items():
            errors = np.concatenate([record.output - runs[record.name] for record in self.case.held_out])
            rms[model] = np.sqrt(np.mean(errors**2, axis=0))
        names = self.case.machine.output_names
        return {
            name: {model: float(of_model[k]) for model, of_model in rms.items()}
            for k, name in enumerate(names)
        }

    @property
    def rounding_rms(self) -> float:
        """What rounding of a sensor alone leaves over noise, whatever the model; 0 where none is seen."""
        rounding = rounding_effect(self.case)
        return 0.0 if rounding is None else float(np.sqrt(rounding.energy))

    @property
    def gap_by_experiment(self) -> dict[str, dict[Model, float]]:
        """Experiment -> model -> RMS of the residuals over noise, all sensors together."""
        return {
            e.name: {model: self.size_of([self.residuals[model][e.name]]) for model in self.models}
            for e in self.case.experiments
        }

    def size_of(self, residuals: Sequence[Real]) -> float:
        """The one size of residuals (T, Y) of some records: RMS of all outputs, or, where `white` says what
        sensors have, that of the worst output beyond it."""
        together = np.concatenate(residuals)
        if self.white is None:
            return pooled_rms(together)
        return float(np.max(_beyond(np.mean(together**2, axis=0), self.white**2, len(together))))

    @property
    def worst_experiment(self) -> tuple[str, float]:
        """Where most is left with the effects added: its name and RMS over noise."""
        after = {name: self.size_of([e]) for name, e in self.residuals_after.items()}
        name = max(after, key=after.__getitem__)
        return name, after[name]


def best_first(
    entries: Sequence[NamedEffect], answer: str, accepted: Sequence[str]
) -> tuple[NamedEffect, ...]:
    """The answer first, then accepted effects in their order, then others by presence; none and unknown last
    unless they are the answer."""
    order = {answer: -1}
    order.update({name: k for k, name in enumerate(accepted)})
    last = {"none", "unknown"} - {answer}

    def place(effect: NamedEffect) -> tuple[bool, int, float, float]:
        in_order = order.get(effect.name, len(order))
        return effect.name in last, in_order, -effect.presence, -effect.probability

    return tuple(sorted(entries, key=place))


def held_out_gap(case: CaseOfMachine, residuals: dict[str, Real]) -> float:
    """RMS of the residuals (T, Y) of all validation records and outputs together, over the noise."""
    return pooled_rms(np.concatenate([residuals[e.name].ravel() for e in case.held_out]))


def remarks(
    candidate: Candidate, coordinates: Real, intervals: Mapping[str, tuple[float, float]]
) -> dict[str, str]:
    """Parameter -> what its interval does not say: pinned at an end of its range, or as wide as that.

    Parameters
    ----------
    candidate : Candidate
    coordinates : (A,) array
        Of its axes, as fitted.
    intervals : parameter -> (low, high)
        Of its values; a parameter without one has no remark.
    """
    remark_of = {}
    for axis, x in zip(candidate.axes, coordinates, strict=True):
        low, high = axis.box
        if axis.parameter not in intervals or not np.isfinite(high - low):
            continue
        ends = np.clip(np.sort(np.abs(intervals[axis.parameter])), axis.low, axis.high)
        to_low = x - low
        to_high = high - x
        if min(to_low, to_high) < _PINNED * (high - low):
            end = "lower" if to_low < to_high else "upper"
            remark_of[axis.parameter] = f"at the {end} end of its range"
        # Of an axis with both signs the interval of the size does not say how wide it is.
        elif axis.low >= 0 and axis.coordinate(ends[1]) - axis.coordinate(ends[0]) > _WIDE * (high - low):
            remark_of[axis.parameter] = "anywhere in its range"
    return remark_of


def left_of(
    case: CaseOfMachine, residuals: Mapping[str, Real], records: Sequence[RecordOfMachine] | None = None
) -> tuple[Real, Real]:
    """Share of the motion, and size, of what a model leaves beyond sensor noise and rounding.

    Parameters
    ----------
    case : CaseOfMachine
    residuals : record -> (T, Y) array
        (measured - model) / noise.
    records : sequence, optional
        Those that count, together; by default the validation records.

    Returns
    -------
    shares : (Y,) array
        Of the motion, RMS about the mean of a record; 1 where as much as the motion is left or more, for of
        an output that hardly moves a model may miss any multiple.
    rms : (Y,) array
        In the outputs' units.
    """
    records = case.held_out if records is None else records
    rounding = rounding_effect(case)
    samples = sum(len(record.output) for record in records)
    white = np.ones(case.noise.size) if rounding is None else 1.0 + rounding.variances / case.noise**2
    energy = np.sum([np.sum(residuals[record.name] ** 2, axis=0) for record in records], axis=0)
    rms = case.noise * _beyond(energy / samples, white, samples)
    moved = sum(len(record.output) * np.var(record.output, axis=0) for record in records)
    motion = np.sqrt(moved / samples)
    with np.errstate(divide="ignore", invalid="ignore"):
        # An output that stands still: all of what is left, or nothing.
        shares = np.where(rms > 0, np.minimum(rms / motion, 1.0), 0.0)
    return shares, rms


def _beyond(mean_square: Real, white: Real | float, samples: int) -> Real:
    """(Y,) RMS beyond white noise of this variance; 0 where the noise of so many samples could make it."""
    left_beyond_noise = mean_square - white
    return np.sqrt(
        np.where(left_beyond_noise > _CHANCE * white * np.sqrt(2 / samples), left_beyond_noise, 0.0)
    )


def completeness_of(case: CaseOfMachine, probability: float, residuals: Mapping[str, Real]) -> Completeness:
    """What a model leaves, as `Completeness` says it.

    Parameters
    ----------
    case : CaseOfMachine
    probability : float
        That no more than the threshold remains.
    residuals : record -> (T, Y) array
        Of every record, (measured - model) / noise.
    """
    names = case.machine.output_names
    shares, rms = left_of(case, residuals)
    by_record: dict[str, dict[str, float]] = {}
    for record in case.experiments:
        of_record, _ = left_of(case, residuals, [record])
        # An output that rests in a record has no motion to take a share of.
        moves = np.std(record.output, axis=0) > _MOVES * case.noise
        of_record = np.where(moves, of_record, 0.0)
        by_record[record.name] = dict(zip(names, map(float, of_record), strict=True))
    furthest_off = max(by_record, key=lambda name: max(by_record[name].values()))
    return Completeness(
        probability=float(probability),
        threshold=case.machine.weighing.model_error,
        remains=dict(zip(names, map(float, shares), strict=True)),
        in_units=dict(zip(names, map(float, rms), strict=True)),
        in_record=furthest_off,
        remains_in_record=by_record[furthest_off],
    )


def share_closed(
    case: CaseOfMachine,
    before: Mapping[str, Real],
    after: Mapping[str, Real],
    rng: np.random.Generator,
    floor: float,
) -> tuple[float, tuple[float, float]]:
    """Share of the explainable energy of the validation error that is gone, with its 95 % interval.

    1 - (R_after - F)/(R_before - F) with mean squares R and that of the noise F: no more than one, and below
    zero where a model leaves more. The interval is by bootstrap over blocks of 50 samples.

    Parameters
    ----------
    case : CaseOfMachine
    before, after : record -> (T, Y) array
        Residuals over the noise.
    rng : numpy Generator
    floor : float
        RMS that noise and rounding leave, over the noise.

    Returns
    -------
    share : float
    interval : (low, high)
        All nan without a gap beyond what the noise of so many samples makes.
    """
    blocks = []  # energy before, energy after, values
    for record in case.held_out:
        for start in range(0, len(record.output), BLOCK):
            part = slice(start, start + BLOCK)
            block_before = before[record.name][part]
            block_after = after[record.name][part]
            blocks.append((float(np.sum(block_before**2)), float(np.sum(block_after**2)), block_before.size))
    sums = np.array(blocks)
    total = sums.sum(axis=0)
    drawn = sums[rng.integers(0, len(sums), (_DRAWS, len(sums)))].sum(axis=1)

    def share(totals: Real) -> Real:
        """(D,) of sums (D, 3)."""
        explainable = totals[..., 0] / totals[..., 2] - floor**2
        left = totals[..., 1] / totals[..., 2] - floor**2
        with np.errstate(divide="ignore", invalid="ignore"):
            # Less than noise leaves is by chance: no more than all is explained.
            return np.asarray(np.where(explainable > 0, np.minimum(1 - left / explainable, 1.0), np.nan))

    gap = total[0] / total[2] - floor**2
    if gap < _CHANCE * floor**2 * np.sqrt(2 / total[2]):
        return float("nan"), (float("nan"), float("nan"))
    low, high = np.nanquantile(share(drawn), _INTERVAL)
    return float(share(total)), (float(low), float(high))
