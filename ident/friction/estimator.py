"""Dry friction and the arm behind it from logs of a loop: any start, and arms that drift.

An observer follows the log (`ident.friction.observer`), for a free run would drift. Its prediction errors are
least at the arm, the friction and the noise of the logs (`ident.friction.descent`), which is the direct
method of a loop (Ljung, System Identification, 2nd ed., section 13.4: no bias if the noise model is right).
From a start by inverse dynamics, the steps of `STEPS` propose other structures: dead time and lag of the
drive, friction at the load, friction that falls with speed, other poles. Each proposal is brought to its own
optimum before it is compared, by the Bayesian information criterion; the steps end when none of them finds a
better structure. They see logs thinned for the highest mode (`ident.friction.logs`); the last descent sees
the whole ones, or those thinned to one row of each reading of a coarse sensor.

Neglected: a level that depends on position or load; what the sensor's noise does to the friction itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from ident.basis.options import IdentOptions
from ident.checks.early_checks import refuse_few_lines
from ident.data.record import Record
from ident.friction.behind import with_bias_of_free_runs
from ident.friction.descent import converged
from ident.friction.gauss_newton import FrictionFit, LostError, started
from ident.friction.logs import LoopLogs
from ident.friction.loop_start import possible_structures, simplest
from ident.friction.observer import correction_of, observed
from ident.friction.structure_steps import STEPS
from ident.friction.structures import Candidate, Search, above_noise, without_empty_parts
from ident.friction.time_step import at_step, steps_for
from ident.friction.widths import with_widths
from ident.search.order_selection import Progress

# Errors of the fewest poles over those of the other structure of the arm, above which a structure is not
# completed. An arm that a weight throws over was right at 1.02 of an integrator's errors, and ended at .79.
_WORSE_AT_FIRST = 1.5
# Times that derivatives are taken for the simplest arm, which is hardly ever the last one. Chosen.
_FEW_DERIVATIVES = 3
# Rounds of all steps at most. Chosen; they end when no step finds a better structure, usually the second.
_ROUNDS = 4


def fit_friction_in_loop(
    records: Sequence[Record], options: IdentOptions, *, progress: Progress | None = None
) -> FrictionFit:
    """Law of the friction and the arm behind it from logs of a loop.

    Parameters
    ----------
    records : sequence of Record
        One input, and the position of the shaft that the friction acts on; from any start.
    options : IdentOptions
        Of the search for the arm's poles; a delay that is not stated is sought, and so are integrators.
    progress : callable, optional
        Called with a share of the work (0 to 1) and a message.

    Returns
    -------
    FrictionFit
        With an observer. What parts of the logs differ in widens all widths; what speeds differ in, those
        that it moves.

    Raises
    ------
    ValueError
        As `identify`, or the logs excite few frequencies. `LostError`, a ValueError, where no observer
        follows them.
    """
    report = progress or (lambda fraction, message: None)
    refuse_few_lines(records)
    whole = LoopLogs.of(records)
    options = above_noise(whole.records, options)

    # Each structure of the arm with the fewest poles, on logs thinned for the highest mode of them all.
    report(0.0, "friction: level and a simple arm")
    # Rows in which the sensor reads the same tell nothing new, and what it rounds off there is no white
    # noise.
    least_steps = 1
    if not options.fixed_poles and not options.unstable_poles:
        least_steps = whole.rows_of_a_reading
    coarse = whole.thinned(least_steps, 0)
    starts = list[tuple[IdentOptions, FrictionFit]]()
    for possible in possible_structures(options):
        with suppress(LostError):
            starts.append(simplest(coarse, possible))
    steps = least_steps * min((steps_for(fit, stated, coarse.dt_s) for stated, fit in starts), default=1)
    begun = list[tuple[Search, Candidate]]()
    for structure_options, start_fit in starts:
        delay_samples = least_steps * structure_options.input_delay_samples
        searched = structure_options.model_copy(update={"input_delay_samples": 0})
        search = Search(whole, searched, steps, options.delay_left_to_data)
        with suppress(LostError):
            start = at_step(start_fit, steps * whole.dt_s)
            logs = search.logs(delay_samples)
            optimum = converged(start, logs, searched, most_derivatives=_FEW_DERIVATIVES)
            begun.append((search, Candidate(optimum, delay_samples)))
    if not begun:
        raise LostError

    # Those that are far behind are not completed; the others take the steps, one after the other, until none
    # of them finds a better structure.
    least_errors = min(candidate.at_optimum.errors for _, candidate in begun)
    ends = list[Candidate]()
    for search, candidate in begun:
        if candidate.at_optimum.errors > _WORSE_AT_FIRST * least_errors:
            continue
        for round_number in range(_ROUNDS):
            before = candidate
            for place, (name, step) in enumerate(STEPS):
                share = (round_number + place / len(STEPS)) / _ROUNDS
                report(0.1 + 0.8 * share, f"friction: {name}")
                candidate = step(search, candidate)
            if candidate is before:
                break
            candidate = search.completed(candidate)
        ends.append(candidate)
    best = min(ends, key=lambda end: end.criterion)

    # The last descent sees every row in which the sensor may read something new.
    report(0.9, "friction: all samples")
    fit = at_step(without_empty_parts(best.fit, whole.rms_speed), least_steps * whole.dt_s)
    fit = converged(fit, whole.thinned(least_steps, best.delay_samples), options).fit
    if least_steps > 1:
        fit = observed(at_step(fit, whole.dt_s), whole.thinned(1, best.delay_samples).records)
    fit = with_widths(_complete(fit, best.delay_samples), whole, every=least_steps)
    return with_bias_of_free_runs(fit, whole.records)


def _complete(fit: FrictionFit, delay_samples: int) -> FrictionFit:
    """A fit with its dead time, samples, its arm with each pole twice, and its observer on that arm."""
    structure = replace(fit.arm.structure, input_delay_samples=delay_samples)
    model = replace(fit.model, input_delay_samples=delay_samples)
    doubled = started(model, structure, fit.law)
    correction = correction_of(doubled.arm, doubled.coefficients, fit.ratio)
    return replace(
        fit,
        model=model,
        arm=doubled.arm,
        coefficients=doubled.coefficients,
        covariance_factor=doubled.covariance_factor,
        correction=correction,
    )
