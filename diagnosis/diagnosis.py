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
from diagnosis.where.late import is_noise, samples_late

# Share of a time limit for fits; the rest is for what the answer needs besides. Chosen: intervals and shares
# take less than a tenth of a search.
_SEARCHED = 0.9
# Share of the progress that the first search is; the second may not be needed. Of what is shown only.
_FIRST_SEARCH = 0.6
# Noise of an own machine is what the quietest octave shows where that is below this share of what is stated:
# nobody states noise to better than a factor of two.
_TOO_LOUD = 0.5
# And no less than this share of it: records that show none (made by a simulation) would have infinite weight.
_LEAST_NOISE = 1e-3


def diagnose(
    case: CaseOfMachine,
    *,
    progress: Progress | None = None,
    rng: np.random.Generator | None = None,
    time_limit_s: float = np.inf,
) -> Diagnosis:
    """Search, weigh, and answer.

    Parameters
    ----------
    case : Case or PlantCase
        Of a flexible link, or of a simulation of one's own.
    progress : callable, optional
        Called with the share done (0 to 1) and what is being done.
    rng : numpy Generator, optional
        Of interval draws and bootstrap; without it a fixed sequence, so that one case has one answer.
    time_limit_s : float
        After it nothing more is tried, and the answer says what was not.

    Returns
    -------
    Diagnosis
        A candidate with which a simulation of one's own fails is left out, and a doubt of the answer says so.

    Raises
    ------
    ValueError
        The simulation is random (`doubts_about`).
    SimulationError
        It fails without any candidate, or with the only one.

    Warns
    -----
    UserWarning
        Where the records of an own machine show less noise than is stated, and an effect in what that hid,
        and of what makes its answer doubtful.
    """
    # Matrices are small: threads of linear algebra would only wait for one another, at several times the CPU.
    with threadpool_limits(1):
        rng = np.random.default_rng(0) if rng is None else rng
        progress = progress or (lambda fraction, message: None)
        deadline_s = time.monotonic() + _SEARCHED * time_limit_s
        if not isinstance(case, PlantCase):
            return _at_noise_seen(case, progress, rng, deadline_s)

        # Every failure takes one candidate off the list: there are no more rounds than candidates.
        failures: tuple[str, ...] = ()
        while True:
            try:
                doubts = (*failures, *doubts_about(case, deadline_s))
                answer = _at_noise_seen(case, progress, rng, deadline_s)
                break
            except SimulationError as error:
                case, sentence = case.without_failing(error)
                failures = (*failures, sentence)
        for doubt in doubts:
            warnings.warn(f"plant: {doubt}", stacklevel=2)
        return replace(answer, doubts=(*doubts, *_late(answer), *_unstated(case, answer), *answer.doubts))


def _late(answer: Diagnosis) -> tuple[str, ...]:
    """A doubt where the simulation is late, as stated, re-estimated or repaired; else none.

    A repaired model that leaves noise alone has found another cause.
    """
    if is_noise(answer.residuals_after.values()):
        return ()
    for residuals in (answer.residuals_before, answer.residuals_refit, answer.residuals_after):
        late = samples_late(answer.case, residuals)
        if late:
            samples = "one sample" if late == 1 else f"{late} samples"
            return (
                f"the motion follows the stated input by {samples} more than the machine's: does the"
                " simulation step before it reads its input, or return each row one step later?",
            )
    return ()


def _unstated(case: PlantCase, answer: Diagnosis) -> tuple[str, ...]:
    """What decides an "unknown" that is small where nobody has said how much the simulation may miss: a doubt
    that says so, else none."""
    if case.machine.weighing.stated or answer.verdict != "unknown":
        return ()
    remains = answer.completeness.most
    usual = case.machine.weighing.model_error
    # Zero is the completeness of an answer whose effects were not all tried: nothing was measured.
    if not 0 < remains < usual:
        return ()
    return (
        f"model_error is unspecified, and {100 * remains:.2g} % of the motion remains, more than noise. If a"
        f" good simulation may miss that much, specify it, as model_error={usual:g}",
    )


def _at_noise_seen(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float
) -> Diagnosis:
    """The answer with the noise as stated, or as the records of an own machine show it where that tells more.

    An answer without any gap may be due to noise that was stated far too large.
    """
    answer = _answered(case, progress, rng, deadline_s)
    hidden = answer.verdict == "none" or (answer.shares and not any(answer.shares.before))
    if not (hidden and isinstance(case, PlantCase)) or time.monotonic() > deadline_s:
        return answer
    seen = quietest([e * case.noise for e in answer.residuals_refit.values()])
    if not np.any(seen < _TOO_LOUD * case.noise):
        return answer
    quieter = case.with_noise(np.clip(seen, _LEAST_NOISE * case.noise, case.noise))
    again = _answered(quieter, lambda done, what: progress(1.0, f"{what}, less noise"), rng, deadline_s)
    if again.verdict != "effect":
        return answer
    noise = zip(case.outputs, map(float, quieter.noise), map(float, case.noise), strict=True)
    again = replace(again, noise_below_stated=tuple(noise))
    words = ", ".join(
        f"{name} {seen:.3g}, stated {stated:.3g}" for name, seen, stated in again.noise_below_stated
    )
    warnings.warn(f"plant: the records show less noise than stated, which counts: {words}", stacklevel=3)
    return again


def _answered(
    case: CaseOfMachine, progress: Progress, rng: np.random.Generator, deadline_s: float
) -> Diagnosis:
    """The answer with the noise as stated: by the noise where that is known, else beside a model error."""
    weighing = case.machine.weighing
    if not weighing.model_error > 0:
        return KnownNoise(WhiteSearch(case, progress, deadline_s).run_in_time()).answer(rng)
    if isinstance(case, Case):
        case = case.at_fast_lengths()
    search = Search(case, lambda done, what: progress(_FIRST_SEARCH * done, what), deadline_s).run_in_time()
    if search.skipped_for_time:
        return BesideModelError(search, rng).answer(rng)

    def progress_of_second(done: float, what: str) -> None:
        progress(_FIRST_SEARCH + (1 - _FIRST_SEARCH) * done, what)

    # A simulation whose error may be none is first taken for exact: beside the sensors' noise alone smaller
    # effects are told.
    if isinstance(case, PlantCase) and not weighing.stated and reaches_noise(search):
        as_sensors = replace(case, plant=replace(case.plant, model_error=0.0))
        exact_search = WhiteSearch(as_sensors, progress_of_second, deadline_s).run_in_time()
        exact = KnownNoise(exact_search).answer(rng)
        if exact.verdict != "unknown":
            return exact
    return looked_at_again(BesideModelError(search, rng), progress_of_second, deadline_s, rng)
