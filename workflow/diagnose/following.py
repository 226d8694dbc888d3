"""What to do next for the answers that one case leaves: `advice_words` (advice.py) says it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from diagnosis.answer import Diagnosis
from diagnosis.machine.case import Case
from diagnosis.next_experiment.discrimination import CompetingHypothesis
from diagnosis.next_experiment.experiment_choices import Limits
from diagnosis.next_experiment.next_experiment import NextExperiment, next_experiment
from diagnosis.next_experiment.repeat import Repeat, best_repeat
from plant.effects import LOOK_ALIKES, in_words
from workflow.diagnose.document import LEAST_SHOWN
from workflow.engine import storage
from workflow.text.formats import listing

# Samples of a proposed experiment at least, however short the records are: two periods of a hundred, which
# is what `excitations` needs.
_SHORTEST = 200
# From this probability on an effect is looked for at the machine first, though an unknown cause is likelier.
# Chosen; a look costs less than a record.
_LOOKED_FOR = 0.2
# Below this probability that no more than the threshold remains, something else is there as likely as not.
_COMPLETE = 0.5


@dataclass(frozen=True, eq=False)
class Following:
    """What to do next, and the experiment or record that it names.

    Attributes
    ----------
    advice : str
        "time": nothing was tried, or the fit did not converge. "confirm": look at the machine for the
        unlisted cause.
        "repeat_worst": repeat the record with most error otherwise, to see what an unknown cause follows;
        "repeat_all": repeat all, for what they have in common. "none": nothing. "separate": run the proposal,
        which separates the competing answers. "look": look at the machine for every cause left, or repeat
        the record that separates them.
    proposal : NextExperiment or None
        Of "separate" only.
    competing : tuple of CompetingHypothesis
        Answers that are left, in words.
    repeat : Repeat or None
        Of one's own machine, the record that separates the competing ones best.
    """

    advice: Literal["time", "confirm", "repeat_worst", "repeat_all", "none", "separate", "look"]
    proposal: NextExperiment | None = None
    competing: tuple[CompetingHypothesis, ...] = ()
    repeat: Repeat | None = None

    def csv_text(self) -> str:
        """The proposed voltage, one row per sample; empty without a proposal."""
        if self.proposal is None:
            return ""
        voltage = self.proposal.voltage_V
        return storage.csv_text(
            {"time_s": self.proposal.dt_s * np.arange(voltage.size), "voltage_V": voltage}
        )

    def differences(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(T, Y) what the first hypothesis predicts minus what the second does, in noise deviations; outputs
        that are measured, the hub angle first."""
        assert self.proposal is not None
        noise = self.competing[0].noise
        first, second = (answer.outputs(self.proposal.voltage_V) for answer in self.competing[:2])
        return np.asarray(((first - second) / noise)[:, np.isfinite(noise)])


def following(diagnosis: Diagnosis) -> Following:
    """The one advice for an answer.

    A proposed experiment is as long as the longest record, within the largest voltage, angle and deflection
    of all of them.
    """
    # Without a fit nothing is known that an experiment could decide.
    if diagnosis.detail_verdict == "not_converged" or diagnosis.nothing_tried:
        return Following("time")

    # Where an effect that others imitate is still possible, the cause may have one of their names: they are
    # separated like any named answers.
    imitated = {kind.look_alike_of for kind in LOOK_ALIKES.values()}
    if diagnosis.verdict == "unknown" and not imitated & set(diagnosis.ambiguous_with):
        if diagnosis.unlisted:
            return Following("confirm")
        # A likely named effect is worth a look before a record: a look costs less.
        named = [name for name in diagnosis.ambiguous_with if name != "none"]
        is_likely = any(diagnosis.presence(name) >= _LOOKED_FOR for name in named)
        return Following("look" if is_likely else "repeat_worst")

    competing = _competing(diagnosis)
    has_limits = isinstance(diagnosis.case, Case) and not diagnosis.case.model_error > 0
    if has_limits and len(competing) < 2:
        return _without_rivals(diagnosis)
    if isinstance(diagnosis.case, Case) and len(competing) > 1:
        longest = max(e.voltage_V.size for e in diagnosis.case.experiments)
        limits = Limits.of_records(diagnosis.case)
        proposal = next_experiment(competing, limits, n_samples=max(longest, _SHORTEST))
        return Following("separate", proposal, competing)

    # Of a machine of one's own nobody has said what it can be asked for: a record is repeated.
    named_rivals = set(diagnosis.ambiguous_with) - {"unknown"}
    if not named_rivals and not (diagnosis.combination and diagnosis.ambiguous_with):
        return _without_rivals(diagnosis)
    repeat = best_repeat(diagnosis.case, competing) if len(competing) > 1 else None
    return Following("look", competing=competing, repeat=repeat)


def _competing(diagnosis: Diagnosis) -> tuple[CompetingHypothesis, ...]:
    """Fitted answers in words; a second one only where it is thinkable at all or fits as well."""
    competing = []
    for k, hypothesis in enumerate(diagnosis.competing):
        is_open = any(cause in diagnosis.ambiguous_with for cause in hypothesis.causes)
        if k == 0 or hypothesis.probability >= LEAST_SHOWN or is_open:
            causes = [in_words(cause) for cause in hypothesis.causes] or [in_words("none")]
            competing.append(replace(hypothesis, name=listing(causes)))
    return tuple(competing)


def _without_rivals(diagnosis: Diagnosis) -> Following:
    """Where no other named answer is left: more records for what is no name, or none."""
    if diagnosis.completeness.probability < _COMPLETE:
        return Following("repeat_worst")
    return Following("repeat_all" if "unknown" in diagnosis.ambiguous_with else "none")
