"""Where a fit of friction in a loop begins: a simple arm behind the friction of the measured direction."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.coloured_noise import long_arx_filter, prewhitened
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.least_squares import fit as linear_fit
from ident.fit.regression import prepare
from ident.friction.arm import FrictionLaw
from ident.friction.descent import converged, with_each_pole_once
from ident.friction.gauss_newton import FrictionFit, started
from ident.friction.inverse_dynamics import with_measured_direction
from ident.friction.logs import LoopLogs
from ident.friction.observer import observed
from ident.friction.structures import few_poles, moving, on_model, white
from ident.one_input import untested_model
from ident.search.pole_search import PoleSearch
from ident.unstable import find_unstable

# Longest dead time of a drive that is tried, in samples. Chosen.
LONGEST_DELAY = 20
# Dead times beyond the best one so far that are tried, samples: where poles took the place of a part of it,
# the next ones are worse at first. Chosen.
_DELAYS_BEYOND = 4


def possible_structures(options: IdentOptions) -> list[IdentOptions]:
    """Options with each structure of the arm that is possible: that stated, or one integrator, or none: a
    spring or a weight holds the arm, or throws it over."""
    if options.states("integrators", "unstable_poles"):
        return [options]
    return [options.model_copy(update={"integrators": integrators}) for integrators in (1, 0)]


def simplest(logs: LoopLogs, options: IdentOptions) -> tuple[IdentOptions, FrictionFit]:
    """Options with the unstable poles that show, and a start with the fewest poles, each once, from the
    measured direction of the motion; without observer."""
    undelayed = options.model_copy(update={"input_delay_samples": 0})
    unstable_sought = not options.integrators and not options.unstable_poles
    if unstable_sought:
        used = _by_direction(logs.thinned(1, options.input_delay_samples), options)[1]
        undelayed = undelayed.with_unstable(find_unstable(used, undelayed))

    # Dead time and lag of the drive together, as a dead time: the arm's poles would take the place of them.
    few = few_poles(undelayed)
    level, used = _by_direction(logs, undelayed)
    whitens = long_arx_filter(used, few)
    frictions = [record.input - free.input for record, free in zip(logs.records, used, strict=True)]
    best: _Start | None = None
    for delay_samples in range(options.input_delay_samples, LONGEST_DELAY + 1):
        whitened = []
        for record, friction in zip(logs.thinned(1, delay_samples).records, frictions, strict=True):
            force = record.input - friction[delay_samples : delay_samples + record.n_samples]
            whitened.append(prewhitened(replace(record, input=force), whitens))
        if best is None:
            poles = untested_model(whitened, moving(few)).poles
        else:
            # The poles move little from one dead time to the next.
            data = prepare(whitened, moving(few).structure())
            poles = PoleSearch(data, moving(few)).descend(best.poles, "friction").poles
        linear = linear_fit(prepare(whitened, moving(few).structure()), poles)
        if best is None or linear.rss < best.rss:
            best = _Start(poles, np.ravel(linear.coefficients), delay_samples, linear.rss)
        if not options.delay_left_to_data or delay_samples - best.delay_samples >= _DELAYS_BEYOND:
            break
    assert best is not None
    dt_s = logs.dt_s
    model = GobfModel(
        best.poles, best.coefficients, dt_s, integrators=few.integrators, unstable=few.unstable()
    )
    law = FrictionLaw(max(level, logs.least_level), logs.presliding)
    fit = with_each_pole_once(replace(started(model, few.structure(), law), centre=logs.centre))
    shifted = logs.thinned(1, best.delay_samples)
    fit = _behind_observer(shifted, fit, few)
    if unstable_sought and undelayed.unstable_poles:
        # Once more with a better friction, which the growth depends on.
        fit = converged(fit, shifted, undelayed).fit
        used = [fit.forced(record) for record in shifted.records]
        undelayed = undelayed.with_unstable(find_unstable(used, undelayed))
        few = few_poles(undelayed)
        model = untested_model([prewhitened(one, long_arx_filter(used, few)) for one in used], moving(few))
        begun = started(model, few.structure(), fit.law)
        fit = _behind_observer(
            shifted, with_each_pole_once(replace(begun, centre=logs.centre, bias=fit.bias)), few
        )
    return undelayed.model_copy(update={"input_delay_samples": best.delay_samples}), fit


class _Start(NamedTuple):
    """A linear arm behind the friction of the measured direction, for a dead time in samples of the logs.

    coefficients (B,) on the poles, output units per input unit; rss: sum of squares that the arm leaves of
    whitened positions, output units squared.
    """

    poles: Poles
    coefficients: RealArray
    delay_samples: int
    rss: float


def _by_direction(logs: LoopLogs, options: IdentOptions) -> tuple[float, list[Record]]:
    """Level, units of the input, and records without friction, by the measured direction of the motion."""
    return with_measured_direction(logs.records, logs.presliding, 0, stiff=not options.integrators)


def _behind_observer(shifted: LoopLogs, fit: FrictionFit, few: IdentOptions) -> FrictionFit:
    """A start with its observer, on the poles that a search behind that observer finds where these are
    better: the first search may have taken a slow pole for noise."""
    fit = observed(fit, shifted.records)
    model = untested_model(white(shifted, fit), moving(few))
    again = observed(on_model(fit, model), shifted.records)
    return min(fit, again, key=lambda one: float(np.sum(shifted.prediction_errors(one) ** 2)))
