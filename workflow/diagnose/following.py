"""The experiment to run next, for the answers that one case leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diagnosis.diagnosis import Diagnosis
from diagnosis.next_experiment.discrimination import Rival
from diagnosis.next_experiment.experiment_choices import Limits
from diagnosis.next_experiment.next_experiment import NextExperiment, next_experiment
from plant.simulate import simulate
from workflow.diagnose.findings import unlisted_words
from workflow.diagnose.words import effect_words, probability_words
from workflow.report.formats import listing

# Below this probability not even a runner-up is a rival.
_THINKABLE = 1e-4
_SHORTEST = 200  # samples


@dataclass(frozen=True, eq=False)
class Following:
    """What to run next and why, in sentences; proposal and the two likeliest rivals where there are any."""

    sentences: tuple[str, ...]
    proposal: NextExperiment | None = None
    rivals: tuple[Rival, ...] = ()

    def document(self) -> dict[str, Any]:
        found = {"sentences": list(self.sentences)}
        return found if self.proposal is None else {**found, **self.proposal.to_dict()}

    def csv_text(self) -> str:
        """The proposed voltage, one row per sample; empty without a proposal."""
        if self.proposal is None:
            return ""
        rows = [
            f"{k * self.proposal.dt_s:.9g},{v:.9g}" for k, v in enumerate(self.proposal.voltage_V.tolist())
        ]
        return "\n".join(["time_s,voltage_V", *rows]) + "\n"

    def differences(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(T, 2) what the first rival predicts minus what the second does, in noise deviations."""
        assert self.proposal is not None
        first, second = (
            simulate(rival.rig, self.proposal.voltage_V, rival.effects).output for rival in self.rivals[:2]
        )
        sensors = self.rivals[0].rig.sensors
        return np.asarray((first - second) / [sensors.hub_angle_noise_rad, sensors.tip_noise_m])


def following(found: Diagnosis) -> Following:
    """As long as the longest record, within the largest voltage, angle and deflection of all of them."""
    if found.verdict == "unknown" and "gravity" not in found.ambiguous_with:
        if found.unlisted:
            return Following(
                (f"Look at the machine for {unlisted_words(found)}: one run without it would confirm it.",)
            )
        left = {name: float(np.mean(e**2)) for name, e in found.residuals_after.items()}
        worst = max(left, key=left.__getitem__)
        return Following(
            (
                "What is missing is not on the list, so there are no rivals to part. Repeat "
                f"{worst}, where most is left, at half and at twice its amplitude and at another speed: what "
                "the residual follows then says where to look.",
            )
        )
    rivals = _left(found)
    if len(rivals) < 2 and "unknown" in found.ambiguous_with:
        return Following(
            (
                "No other effect of the list is left, only a cause outside it. Repeat the experiments: what "
                "two runs have in common beyond noise, once the answer is in the model, would be that cause.",
            )
        )
    if len(rivals) < 2:
        return Following(("No further experiment is needed: every other answer is ruled out.",))
    names = listing([f"{rival.name} ({probability_words(rival.probability)})" for rival in rivals])
    longest = max(e.voltage_V.size for e in found.case.experiments)
    proposal = next_experiment(rivals, Limits.of_records(found.case), n_samples=max(longest, _SHORTEST))
    return Following((f"Still possible: {names}.", proposal.sentence), proposal, rivals)


def _left(found: Diagnosis) -> tuple[Rival, ...]:
    """The rivals by name; a second one only where it is thinkable at all or fits as well."""
    return tuple(
        replace(rival, name=_words(tuple(type(effect).id for effect in rival.effects)))
        for k, rival in enumerate(found.rivals)
        if k == 0
        or rival.probability >= _THINKABLE
        or any(type(effect).id in found.ambiguous_with for effect in rival.effects)
    )


def _words(names: tuple[str, ...]) -> str:
    return listing([effect_words(name) for name in names or ("none",)])
