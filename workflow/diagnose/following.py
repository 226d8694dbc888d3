"""The experiment to run next, for the answers that one case leaves."""

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

_SHORTEST = 200  # samples
# From this probability on an effect is looked for at the machine first, though an unknown cause is likelier.
_LOOKED_FOR = 0.2


@dataclass(frozen=True, eq=False)
class Following:
    """What to run next and why.

    advice: look at the machine for the unlisted cause (confirm); repeat the worst experiment, or all of them,
    to see what an unknown cause follows; nothing (none); the proposal, which separates the competing ones;
    a look at the machine for every cause left (look), where no simulation can show that they separate, or
    where one is likely though an unknown cause is likelier.
    repeat : of one's own machine, the record that separates the competing ones.
    """

    advice: Literal["confirm", "repeat_worst", "repeat_all", "none", "separate", "look"]
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
        first, second = (one.outputs(self.proposal.voltage_V) for one in self.competing[:2])
        return np.asarray(((first - second) / noise)[:, np.isfinite(noise)])


def following(found: Diagnosis) -> Following:
    """As long as the longest record, within the largest voltage, angle and deflection of all of them."""
    imitated = {kind.look_alike_of for kind in LOOK_ALIKES.values()}
    if found.verdict == "unknown" and not imitated & set(found.ambiguous_with):
        if found.unlisted:
            return Following("confirm")
        likely = {name for name in found.ambiguous_with if found.presence(name) >= _LOOKED_FOR} - {"none"}
        return Following("look" if likely else "repeat_worst")
    # By name; a second one only where it is thinkable at all or fits as well.
    competing = tuple(
        replace(one, name=listing([in_words(cause) for cause in one.causes] or [in_words("none")]))
        for k, one in enumerate(found.competing)
        if k == 0
        or one.probability >= LEAST_SHOWN
        or any(cause in found.ambiguous_with for cause in one.causes)
    )
    if not isinstance(found.case, Case) or (found.case.model_error > 0 and len(competing) < 2):
        # Of a machine of one's own nobody has said what it can be asked for.
        repeat = best_repeat(found.case, competing) if len(competing) > 1 else None
        return Following("look" if found.ambiguous_with else "none", competing=competing, repeat=repeat)
    if len(competing) < 2:
        return Following("repeat_all" if "unknown" in found.ambiguous_with else "none")
    longest = max(e.voltage_V.size for e in found.case.experiments)
    proposal = next_experiment(competing, Limits.of_records(found.case), n_samples=max(longest, _SHORTEST))
    return Following("separate", proposal, competing)
