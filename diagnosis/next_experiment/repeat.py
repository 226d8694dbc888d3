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
# Records of the largest and the smallest motion, and between them.
_MOST_RECORDS = 4


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
    """What the hypotheses predict, whitened (Y T,) sample by sample by a noise which theirs is `scale` of."""

    record: str
    change: Change
    inputs: Real
    competing: Sequence[CompetingHypothesis]
    whitened: Sequence[Real]
    scale: Real

    @property
    def at_most(self) -> tuple[float, float]:
        """Score if no free parameter followed; they only lessen a difference."""
        apart = [np.linalg.norm(a - b) for a, b in combinations(self.whitened, 2)]
        return expected_log_bayes_factor(np.array(apart), pair_weights(self.competing))

    @cached_property
    def apart(self) -> Real:
        return distances(self.competing, self.inputs, self.whitened, self.scale)[0]

    @property
    def score(self) -> tuple[float, float]:
        return expected_log_bayes_factor(self.apart, pair_weights(self.competing))


def best_repeat(case: CaseOfMachine, competing: Sequence[CompetingHypothesis]) -> Repeat | None:
    """The repeat that parts the hypotheses, two at least, best once their free parameters have followed; None
    where none can be simulated.

    The part of their noise that is not the sensors' is a share of the motion and changes with it. Neglected:
    starts that are not at rest.
    """
    choices = [
        choice
        for record in _records(case)
        for change in get_args(Change)
        if not (change == "slower" and record.input.shape[1] > 1)
        if (choice := _choice(case, competing, record, change)) is not None
    ]
    best: _Choice | None = None
    for choice in sorted(choices, key=lambda c: c.at_most, reverse=True):
        if best is not None and choice.at_most <= best.score:
            break
        if best is None or choice.score > best.score:
            best = choice
    if best is None:
        return None
    same = next((c for c in choices if (c.record, c.change) == (best.record, "same")), best)
    parted, before = (separations(competing, choice.apart) for choice in (best, same))
    return Repeat(best.record, best.change, parted, before, any(pair.separated for pair in parted))


def _choice(
    case: CaseOfMachine, competing: Sequence[CompetingHypothesis], record: RecordOfMachine, change: Change
) -> _Choice | None:
    inputs = _CHANGES[change](record.input)
    outputs = [one.outputs(inputs) for one in competing]
    # That of a hypothesis about the records, for this motion, (Y,).
    beyond = np.maximum(competing[0].noise ** 2 - case.noise**2, 0.0)
    recorded = np.mean([np.var(e.output, axis=0) for e in case.experiments], axis=0)
    noise = np.sqrt(case.noise**2 + beyond * np.var(outputs[0], axis=0) / recorded)
    whitened = [np.asarray(y / noise).ravel() for y in outputs]
    if not all(np.all(np.isfinite(y)) for y in whitened):
        return None
    scale = np.tile(competing[0].noise / noise, len(inputs))
    return _Choice(record.name, change, inputs, competing, whitened, scale)


_CHANGES: dict[Change, Callable[[Real], Real]] = {
    "same": lambda u: u,
    "third": lambda u: u / 3,
    "reversed": lambda u: -u,
    "slower": lambda u: np.repeat(u, 2, axis=0)[: len(u)],
}


def _records(case: CaseOfMachine) -> list[RecordOfMachine]:
    ranked = sorted(case.experiments, key=lambda e: float(np.mean(np.var(e.output, axis=0) / case.noise**2)))
    chosen = np.unique(np.linspace(0, len(ranked) - 1, _MOST_RECORDS).round().astype(int))
    return [ranked[k] for k in chosen]
