"""The answer about one case: is there a gap, which effect, how sure, how far the gap shrinks with it."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from diagnosis.answer import Diagnosis
from diagnosis.fit.levels import quietest
from diagnosis.judge.known_noise import KnownNoise
from diagnosis.judge.model_error import (
    BesideModelError,
    looked_at_again,
    reaches_noise,
)
from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import CaseOfMachine
from diagnosis.machine.own_plant import PlantCase, SimulationError
from diagnosis.machine.probed import doubts_about
from diagnosis.search.loop import Progress
from diagnosis.search.search import Search
from diagnosis.search.white import WhiteSearch

# Share of a time limit for fits; the rest is for what the answer needs besides.
_SEARCHED = 0.9
# Share of the progress that the first search is; the second may not be needed.
_FIRST_SEARCH = 0.6
# Noise of an own machine is what the quietest octave shows where that is below the one share of what is
# stated, not below the other.
_TOO_LOUD, _LEAST = 0.5, 1e-3


def diagnose(
    case: CaseOfMachine,
    *,
    progress: Progress | None = None,
    rng: np.random.Generator | None = None,
    time_limit_s: float = np.inf,
) -> Diagnosis:
    """Search, weigh, and answer.

    case : A `Case` (flexible link) or a `PlantCase` (a simulation of one's own).
    progress : Called with the share done (0 to 1) and what is being done.
    time_limit_s : After it nothing more is tried, and the answer says what was not.
    rng : Of interval draws and bootstrap; without it a fixed sequence, so that one case has one answer.

    A candidate with which a simulation of one's own fails is left out, and a doubt of the answer says so.

    Warns where the records of an own machine show less noise than is stated, and an effect in what that hid,
    and of what makes its answer doubtful (`doubts_about`, which raises ValueError where it is random).
    """
    # Matrices are small: threads of linear algebra would only wait for one another, at several times the CPU.
    with threadpool_limits(1):
        rng = np.random.default_rng(0) if rng is None else rng
        progress = progress or (lambda fraction, message: None)
        deadline_s = time.monotonic() + _SEARCHED * time_limit_s
        if not isinstance(case, PlantCase):
            answer = _at_noise_seen(case, progress, rng, deadline_s)
            return replace(answer, doubts=(*_asked_of(case, answer), *answer.doubts))

        # Every failure takes one candidate off the list: there are no more rounds than candidates.
        left_out: tuple[str, ...] = ()
        while True:
            try:
                doubts = (*left_out, *doubts_about(case, deadline_s))
                answer = _at_noise_seen(case, progress, rng, deadline_s)
                break
            except SimulationError as error:
                case, said = case.without_failing(error)
                left_out = (*left_out, said)
        for doubt in doubts:
            warnings.warn(f"plant: {doubt}", stacklevel=2)
        return replace(answer, doubts=(*doubts, *_asked_of(case, answer), *answer.doubts))


def _asked_of(case: CaseOfMachine, answer: Diagnosis) -> tuple[str, ...]:
    """What decides an "unknown" that is small where nobody has said how much the simulation may miss."""
    if not isinstance(case, PlantCase) or case.machine.weighing.stated or answer.verdict != "unknown":
        return ()
    left, usual = answer.completeness.most, case.machine.weighing.model_error
    if not left < usual:
        return ()
    return (
        f"model_error is unspecified, and {100 * left:.2g} % of the motion remains, more than noise. If a"
        f" good simulation may miss that much, specify it, as model_error={usual:g}",
    )


def _at_noise_seen(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float
) -> Diagnosis:
    """With the noise as stated, or as the records show it where that tells more."""
    answer = _answered(case, progress, rng, deadline_s)
    hidden = answer.verdict == "none" or (answer.shares and not any(answer.shares.before))
    if not (hidden and isinstance(case, PlantCase)) or time.monotonic() > deadline_s:
        return answer
    seen = quietest([e * case.noise for e in answer.residuals_refit.values()])
    if not np.any(seen < _TOO_LOUD * case.noise):
        return answer
    quieter = case.with_noise(np.clip(seen, _LEAST * case.noise, case.noise))
    last = _answered(quieter, lambda done, what: progress(1.0, f"{what}, less noise"), rng, deadline_s)
    if last.verdict != "effect":
        return answer
    noise = zip(case.outputs, map(float, quieter.noise), map(float, case.noise), strict=True)
    last = replace(last, noise_below_stated=tuple(noise))
    words = ", ".join(
        f"{name} {seen:.3g}, stated {stated:.3g}" for name, seen, stated in last.noise_below_stated
    )
    warnings.warn(f"plant: the records show less noise than stated, which counts: {words}", stacklevel=3)
    return last


def _answered(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float
) -> Diagnosis:
    """With the noise as stated."""
    weighing = case.machine.weighing
    if not weighing.model_error > 0:
        return KnownNoise(WhiteSearch(case, progress, deadline_s).run_in_time()).answer(rng)
    if isinstance(case, Case):
        case = case.at_fast_lengths()
    found = Search(case, lambda done, what: progress(_FIRST_SEARCH * done, what), deadline_s).run_in_time()
    if found.skipped_for_time:
        return BesideModelError(found, rng).answer(rng)

    def again(done: float, what: str) -> None:
        progress(_FIRST_SEARCH + (1 - _FIRST_SEARCH) * done, what)

    if isinstance(case, PlantCase) and not weighing.stated and reaches_noise(found):
        as_sensors = replace(case, plant=replace(case.plant, model_error=0.0))
        exact = KnownNoise(WhiteSearch(as_sensors, again, deadline_s).run_in_time()).answer(rng)
        if exact.verdict != "unknown":
            return exact
    return looked_at_again(BesideModelError(found, rng), again, deadline_s, rng)
