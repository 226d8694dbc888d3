"""Which record of one's own machine to repeat, and how changed, so that the answers that are left come apart.

Every choice is a record again: as it was, at a third of its size, with the sign of every input changed, or,
of one input, half as fast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine
from diagnosis.next_experiment.discrimination import CompetingHypothesis, distances
from diagnosis.next_experiment.next_experiment import (
    Separation,
    expected_log_bayes_factor,
    pair_weights,
    separations,
)

Change = Literal["same", "third", "reversed", "slower"]
# Records that are tried: of the largest and the smallest motion, and two between them. Each is simulated four
# times for every hypothesis. Chosen; twice as many take twice the time.
_MOST_RECORDS = 4
# Times the largest size of an output in the records beyond which a hypothesis runs away: no machine is asked
# to go there, and how far it runs says nothing. A record twice as slow takes a mass four times as far.
_RUNS_AWAY = 10.0


@dataclass(frozen=True, eq=False)
class Repeat:
    """A record to repeat.

    record, change : Which, and how changed.
    separations : tuple of Separation. Every pair of hypotheses, the most probable ones first; same : of the
        record as it was.
    separates : bool. Whether some pair comes apart.
    """

    record: str
    change: Change
    separations: tuple[Separation, ...]
    same: tuple[Separation, ...]
    separates: bool


@dataclass(frozen=True, eq=False)
class _Choice:
    """A changed record with what the hypotheses predict for it.

    inputs : (T, U). whitened : of every hypothesis, (Y T,) outputs sample by sample over a noise.
    scale : (Y T,) noise of the hypotheses over that one.
    """

    record: str
    change: Change
    inputs: Real
    competing: Sequence[CompetingHypothesis]
    whitened: Sequence[Real]
    scale: Real

    @property
    def at_most(self) -> tuple[float, float]:
        """Score if no free parameter followed; they only lessen a difference."""
        differences = [np.linalg.norm(a - b) for a, b in combinations(self.whitened, 2)]
        return expected_log_bayes_factor(np.array(differences), pair_weights(self.competing))

    @cached_property
    def apart(self) -> Real:
        """(pairs,) standard deviations between the hypotheses, once their free parameters have followed."""
        return distances(self.competing, self.inputs, self.whitened, self.scale)[0]

    @property
    def score(self) -> tuple[float, float]:
        """What the choice is compared by (`expected_log_bayes_factor`)."""
        return expected_log_bayes_factor(self.apart, pair_weights(self.competing))


def best_repeat(case: CaseOfMachine, competing: Sequence[CompetingHypothesis]) -> Repeat | None:
    """The repeat that parts the hypotheses best once their free parameters have followed.

    The part of their noise that is not the sensors' is a share of the motion and changes with it. Neglected:
    starts that are not at rest.

    Parameters
    ----------
    case : CaseOfMachine
    competing : sequence of CompetingHypothesis
        Two at least.

    Returns
    -------
    Repeat or None
        None where no changed record can be simulated, or all of them run away.
    """
    choices = []
    for record in _records(case):
        for change in get_args(Change):
            # Of several inputs none is slowed down against the others.
            if change == "slower" and record.input.shape[1] > 1:
                continue
            choice = _choice(case, competing, record, change)
            if choice is not None:
                choices.append(choice)

    best: _Choice | None = None
    for choice in sorted(choices, key=lambda choice: choice.at_most, reverse=True):
        # What cannot win without free parameters need not be computed with them.
        if best is not None and choice.at_most <= best.score:
            break
        if best is None or choice.score > best.score:
            best = choice
    if best is None:
        return None
    as_it_was = [choice for choice in choices if (choice.record, choice.change) == (best.record, "same")]
    same = as_it_was[0] if as_it_was else best
    parted = separations(competing, best.apart)
    return Repeat(
        record=best.record,
        change=best.change,
        separations=parted,
        same=separations(competing, same.apart),
        separates=any(pair.separated for pair in parted),
    )


def _choice(
    case: CaseOfMachine, competing: Sequence[CompetingHypothesis], record: RecordOfMachine, change: Change
) -> _Choice | None:
    """A record changed, with its predictions; None where one of them is not finite or runs away."""
    inputs = _CHANGES[change](record.input)
    outputs = [hypothesis.outputs(inputs) for hypothesis in competing]
    largest = np.max([np.max(np.abs(e.output), axis=0) for e in case.experiments], axis=0)
    for output in outputs:
        if not np.all(np.abs(output) <= _RUNS_AWAY * largest):
            return None
    # What a hypothesis misses beyond sensor noise, (Y,) about the records, is in proportion to the motion.
    missed_variance = np.maximum(competing[0].noise ** 2 - case.noise**2, 0.0)
    recorded_variance = np.mean([np.var(e.output, axis=0) for e in case.experiments], axis=0)
    growth = np.var(outputs[0], axis=0) / recorded_variance
    noise = np.sqrt(case.noise**2 + missed_variance * growth)
    whitened = [np.asarray(output / noise).ravel() for output in outputs]
    scale = np.tile(competing[0].noise / noise, len(inputs))
    return _Choice(record.name, change, inputs, competing, whitened, scale)


_CHANGES: dict[Change, Callable[[Real], Real]] = {
    "same": lambda u: u,
    "third": lambda u: u / 3,
    "reversed": lambda u: -u,
    "slower": lambda u: np.repeat(u, 2, axis=0)[: len(u)],
}


def _records(case: CaseOfMachine) -> list[RecordOfMachine]:
    """Records from the smallest to the largest motion over the noise, four at most."""

    def motion(record: RecordOfMachine) -> float:
        return float(np.mean(np.var(record.output, axis=0) / case.noise**2))

    ranked = sorted(case.experiments, key=motion)
    chosen = np.unique(np.linspace(0, len(ranked) - 1, _MOST_RECORDS).round().astype(int))
    return [ranked[k] for k in chosen]
