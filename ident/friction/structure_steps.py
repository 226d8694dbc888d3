"""The steps by which a fit of friction in a loop finds its structure: `STEPS`, in their order.

Each takes a search and a candidate, proposes other structures, and returns the best of them and the candidate
(`ident.friction.structures.Search.better`).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.friction.gauss_newton import FrictionFit
from ident.friction.loop_start import LONGEST_DELAY
from ident.friction.spring import Spring
from ident.friction.structures import Candidate, Search, moving, on_model, on_poles, white, without_slow_pairs
from ident.one_input import untested_model

# How dead time and lag of a drive are changed, samples later and whether it then has a lag: of one with a
# lag,
_SHIFTS_WITH_LAG = ((-1, True), (1, True), (0, False))
# and of one without.
_SHIFTS_WITHOUT_LAG = ((-1, True), (1, False), (-1, False), (0, True))
# Least lag that a drive begins with, in samples. Chosen: its optimum is a few steps away.
_LEAST_LAG_SAMPLES = 0.3
# Speeds of Stribeck friction that are begun with, in units of the rms speed. Chosen, factors of three.
_FALLS = (0.03, 0.1, 0.3)
# Its excess at the start, as a share of the level. Chosen.
_EXCESS = 0.1
# Share of the level that begins at the load, where a spring shows. Chosen: nothing says which has more. A
# load sticks and slips at other times with another share, so that the errors have many optima; of the shares
# .05, .2, .5 and .8 the one that begins best gave 1 in place of .6 of the true response in a slow axis, and
# .71 in place of .95 in a geared joint, whose certificate it cost.
_SHARE_AT_LOAD = 0.5


def with_dead_time(search: Search, candidate: Candidate) -> Candidate:
    """The dead time and the lag of the drive, in place of a part of it, that predict best.

    The dead time changes only where it is left open. After a change that helps its neighbours are tried.
    """
    improves = True
    while improves:
        improves = False
        shifts: tuple[tuple[int, bool], ...] = _SHIFTS_WITHOUT_LAG
        if candidate.fit.lag > 0:
            shifts = _SHIFTS_WITH_LAG
        for later, has_lag in shifts:
            delay_samples = candidate.delay_samples + later
            may_shift = later == 0 or (search.delay_is_open and 0 <= delay_samples <= LONGEST_DELAY)
            if not may_shift:
                continue
            lag = 0.0
            if has_lag:
                # Dead time and lag together are known best: what one gives up the other takes.
                lag = max(candidate.fit.lag - later / search.steps, _LEAST_LAG_SAMPLES / search.steps)
            start = replace(candidate.fit, lag=lag)
            better = search.better(candidate, [(start, delay_samples)])
            if better is not candidate:
                candidate = better
                improves = True
    return candidate


def with_friction_at_load(search: Search, candidate: Candidate) -> Candidate:
    """Friction at the load, behind the first spring, where that predicts better."""
    fit = candidate.fit
    spring = Spring.of(fit.model)
    if fit.spring is not None or spring is None or not candidate.at_optimum.significant:
        return candidate
    at_load = _SHARE_AT_LOAD * fit.law.level
    law = replace(fit.law, level=fit.law.level - at_load)
    start = replace(fit, spring=spring, beyond=at_load, law=law)
    return search.better(candidate, [(start, candidate.delay_samples)])


def with_stribeck(search: Search, candidate: Candidate) -> Candidate:
    """Friction that falls with speed, where that predicts better."""
    fit = candidate.fit
    if np.isfinite(fit.law.fall) or not candidate.at_optimum.significant:
        return candidate
    logs = search.logs(candidate.delay_samples)
    excess = _EXCESS * fit.law.level
    starts = list[FrictionFit]()
    for share in _FALLS:
        law = replace(fit.law, level=fit.law.level - excess, excess=excess, fall=share * logs.rms_speed)
        starts.append(replace(fit, law=law))
    # Of the speeds the one that begins best: all of them move to the same optimum, or to none.
    best = min(starts, key=lambda start: float(np.sum(logs.prediction_errors(start) ** 2)))
    return search.better(candidate, [(best, candidate.delay_samples)])


def with_poles(search: Search, candidate: Candidate) -> Candidate:
    """As many poles of the arm as the logs ask for: those of a search behind the friction, or one less."""
    fit = candidate.fit
    logs = search.logs(candidate.delay_samples)
    options = moving(without_slow_pairs(fit, search.options))
    starts = list[tuple[FrictionFit, int]]()
    with suppress(ValueError):
        model = untested_model(white(logs, fit), options.model_copy(update={"input_delay_samples": 0}))
        starts.append((on_model(fit, model), candidate.delay_samples))
    for poles in _with_one_less(fit, search.options):
        starts.append((on_poles(logs, fit, poles), candidate.delay_samples))
    return search.better(candidate, starts)


def _with_one_less(fit: FrictionFit, options: IdentOptions) -> list[Poles]:
    """Poles of a fit without one real pole or pair, each that was not stated and is no part of the
    structure."""
    poles = fit.model.poles
    kept = options.fixed()
    kept_values = np.concatenate([kept.real, kept.pairs, fit.arm.structure.unstable.values])
    fewer = list[Poles]()
    if options.n_pairs is None:
        for place, pair in enumerate(poles.pairs):
            if not np.any(kept_values == pair):
                fewer.append(Poles(poles.real, np.delete(poles.pairs, place)))
    if options.n_real is None:
        for place, pole in enumerate(poles.real):
            if not np.any(kept_values == pole):
                fewer.append(Poles(np.delete(poles.real, place), poles.pairs))
    return [few for few in fewer if few.order > 0]


# What a fit is improved by, in this order, with what is reported meanwhile.
STEPS: tuple[tuple[str, Callable[[Search, Candidate], Candidate]], ...] = (
    ("friction at the load", with_friction_at_load),
    ("dead time and lag of the drive", with_dead_time),
    ("friction that falls with speed", with_stribeck),
    ("number of poles", with_poles),
)
