"""What a diagnosis answers: verdict, effects with probabilities, gaps, the repaired model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from diagnosis.fit.residual import pooled_rms
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.machine.rounding import rounding_effect
from diagnosis.next_experiment.discrimination import CompetingHypothesis

Verdict = Literal["none", "effect", "unknown"]
DetailVerdict = Literal["none", "parametric", "effect", "ambiguous", "unknown", "not_converged"]
# Nominal parameters as stated, re-estimated within their tolerances, effects added.
Model = Literal["stated", "refit", "repaired"]

NOISE_FLOOR = 1.0
# A nominal parameter that has to be off by more tolerances than this is significant by itself.
FAR_OFF = 3.0
# Below this probability of the first answer, or with another one above that, the answer is called ambiguous.
SURE, POSSIBLE = 0.8, 0.05
# Of the bootstrap of the share closed: draws, samples of a block.
_BLOCKS, _BLOCK = 2000, 50


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
    """

    name: str
    probability: float
    presence: float
    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    gap_after: float


@dataclass(frozen=True)
class Shares:
    """What effects carry of the gap of a machine with a model error, on held-out records.

    names : of the outputs. before, after : RMS left beyond sensor noise over that of the motion, per output:
        nominal values re-estimated, effects added. interests : share of the motion from which on a gap does.
    carried : effect of the repaired model, small ones too -> (share of the gap's energy beyond noise that it
        closes, whatever the order in which effects are added, with its 95 % interval).
    small : effects in the repaired model that carry less than what interests.
    closes : (effects, share of the gap closed by them alone), most first; also where the answer is unknown.
    not_tried : what a time limit left out.
    silent : effects of the answer that do nothing in the held-out records.
    at_inputs : the share that interests is one of the inputs, whatever the machine makes of it; shares are of
        the motion without what a bias of that size lets drift.
    horizon_samples : length of windows, each from the state that fits it best (`imperfect.horizon`), and
        horizon_before, horizon_after : what is left in them, as before and after; 0 and empty for a machine
        that says no states.
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
    at_inputs: bool = False
    horizon_samples: int = 0
    horizon_before: tuple[float, ...] = ()
    horizon_after: tuple[float, ...] = ()

    @property
    def horizon_closed(self) -> float:
        """Share of the gap that the effects close in the windows; nan without a gap there."""
        before, after = (float(np.sum(np.square(s))) for s in (self.horizon_before, self.horizon_after))
        return 1 - after / before if before > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is wrong with a model, as far as its records tell.

    verdict, detail_verdict : str
    effects : tuple of NamedEffect. Every effect, none and unknown; the answer first, then by presence, with
        none and unknown last unless they are the answer.
    combination : tuple of str. Effects that are accepted together; empty for the verdicts none and unknown.
    ambiguous_with : tuple of str. Answers that the records cannot rule out beside the first.
    gap_before, gap_refit, gap_after : float. Pooled RMS of (measured - model)/noise over the held-out
        experiments: nominal rig, nominal parameters moved within their tolerances, accepted effects added.
    gap_closed, gap_closed_interval : float, (low, high)
        1 - (R_after - F)/(R_refit - F) with R, F the held-out mean squares and the noise floor's (design 6.2)
        and its 95 % bootstrap interval over blocks of samples; nan without a gap to close.
    deviations : key -> tolerances
        How far the nominal parameters are off, with the accepted effects in the model.
    deviations_refit : key -> tolerances. How far they have to move without any effect.
    rig, repair : The repaired model: nominal parameters moved (a Rig, or a Plant of one's own), effects to
        add (of `plant.effects`, or changes of the own plant).
    residuals_before, residuals_refit, residuals_after : experiment -> (T, 2)
        Whitened, every experiment; (T, Y) in the machine's order of outputs.
    simulations : int. Number of simulated records.
    held_out_decided : bool. The held-out records did not confirm what the others said, and chose among the
        answers (none was fitted to them).
    unlisted : tuple of effects. What explains the records where the answer is unknown and yet can be named: a
        cause beyond the list that looks like one of it, with whatever it acts beside.
    partial_model : tuple of str. Effects of the repaired model where the answer is unknown: they close most
        of the held-out gap, and nobody says that they are the cause.
    noise_below_stated : tuple of (output, noise, stated noise). Of an own machine whose records show less
        noise than is stated, in whose place it was counted.
    competing : tuple of CompetingHypothesis. Fitted explanations that contradict each other, most probable
        first, for `next_experiment`; only for a flexible link.
    shares : Shares or None. Only of a machine with a stated model error.
    """

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
    held_out_decided: bool = False
    unlisted: tuple[Any, ...] = ()
    partial_model: tuple[str, ...] = ()
    noise_below_stated: tuple[tuple[str, float, float], ...] = ()
    competing: tuple[CompetingHypothesis, ...] = ()
    shares: Shares | None = None

    @property
    def added(self) -> tuple[str, ...]:
        """Effects of the repaired model, whether they are the answer or only close most of the gap."""
        return self.combination or self.partial_model

    @property
    def probability(self) -> float:
        """Of the answer: the main cause where it stands alone, the whole set where there are several."""
        if self.verdict != "effect":
            return self.probabilities[self.verdict]
        if len(self.combination) == 1:
            return self.probabilities[self.combination[0]]
        return self.sets[tuple(sorted(self.combination))]

    def presence(self, name: str) -> float:
        """Probability that an effect is there at all; of "none" and "unknown" that they are the answer."""
        return next(effect.presence for effect in self.effects if effect.name == name)

    @property
    def runner_up(self) -> str:
        """The likeliest answer beside the accepted ones."""
        others = [name for name in self.probabilities if name not in self.combination]
        return max((self.presence(name), name) for name in others)[1]

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

    @property
    def rounding_rms(self) -> float:
        """What rounding of a sensor alone leaves over noise, whatever the model; 0 where none is seen."""
        rounding = rounding_effect(self.case)
        return 0.0 if rounding is None else float(np.sqrt(rounding.energy))

    @property
    def gap_by_experiment(self) -> dict[str, dict[Model, float]]:
        """Experiment -> model -> RMS of the residuals over noise, all sensors together."""
        return {
            e.name: {model: pooled_rms(self.residuals[model][e.name]) for model in self.models}
            for e in self.case.experiments
        }

    @property
    def worst_experiment(self) -> tuple[str, float]:
        """Where most is left with the effects added: its name and RMS over noise."""
        after = {name: pooled_rms(e) for name, e in self.residuals_after.items()}
        name = max(after, key=after.__getitem__)
        return name, after[name]


def best_first(
    entries: Sequence[NamedEffect], answer: str, accepted: Sequence[str]
) -> tuple[NamedEffect, ...]:
    """The answer and what is accepted first, then by presence; none and unknown last unless they are it."""
    order = {answer: -1, **{name: k for k, name in enumerate(accepted)}}
    last = {"none", "unknown"} - {answer}

    def place(e: NamedEffect) -> tuple[bool, int, float, float]:
        return e.name in last, order.get(e.name, len(order)), -e.presence, -e.probability

    return tuple(sorted(entries, key=place))


def held_out_gap(case: CaseOfMachine, residuals: dict[str, Real]) -> float:
    return pooled_rms(np.concatenate([residuals[e.name].ravel() for e in case.held_out]))


def share_closed(
    case: CaseOfMachine,
    before: dict[str, Real],
    after: dict[str, Real],
    rng: np.random.Generator,
    floor: float,
) -> tuple[float, tuple[float, float]]:
    """Share of the explainable held-out energy that is gone, with a block bootstrap."""
    pairs = []
    for experiment in case.held_out:
        T = len(experiment.output)
        for start in range(0, T, _BLOCK):
            part = slice(start, start + _BLOCK)
            a, b = before[experiment.name][part], after[experiment.name][part]
            pairs.append((float(np.sum(a**2)), float(np.sum(b**2)), a.size))
    sums = np.array(pairs)
    drawn = sums[rng.integers(0, len(sums), (_BLOCKS, len(sums)))].sum(axis=1)

    def share(total: Real) -> Real:
        explainable = total[..., 0] / total[..., 2] - floor**2
        left = total[..., 1] / total[..., 2] - floor**2
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(explainable > 0, 1 - left / explainable, np.nan))

    # A gap that the noise of so many samples could make is none to close.
    count = sums[:, 2].sum()
    if sums[:, 0].sum() / count - floor**2 < 3 * floor**2 * np.sqrt(2 / count):
        return float("nan"), (float("nan"), float("nan"))
    low, high = np.nanquantile(share(drawn), [0.025, 0.975])
    return float(share(sums.sum(axis=0))), (float(low), float(high))
