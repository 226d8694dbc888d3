"""Dry friction in the loop: |S| by size of the reference, sticking, error at rest, and its feed-forward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from control_design.analysis.closed_loop import simulate
from control_design.controllers.controller import Controller
from ident.friction import FrictionFit, FrictionLaw
from workflow.tasks.friction_loop import (
    FrictionLoop,
    Interval,
    drawn,
    friction_feedforward,
    interval_of,
    predicted_peak,
)
from workflow.tasks.loop_sensitivity import SMALL, measured_on_arm, sensitivity_plan, settling_samples
from workflow.tasks.results import FrictionCheck, SensitivityCheck, SlowSine
from workflow.tasks.simulated_rig import converter_steps, loop_of_arm
from workflow.tasks.stage import StageInput

Real = npt.NDArray[np.float64]

_DRAWS = 16
TOLERANCE_PERCENT = 5.0
# Shares of the large size; the first and SMALL are measured by `sensitivity_on_arm`.
_SHARES = (1.0, 0.3, SMALL, 0.03, 0.01)
# The sine's period is so many times the delay of the loop; its linear error is 2 pi over that.
_SLOW, _LONGEST = 300.0, 20_000
_SINE_SHARE = 0.2  # of the reference step


def check_friction(
    stage: StageInput,
    controller: Controller,
    step: float,
    transient_samples: int,
    sensitivity: SensitivityCheck | None,
) -> FrictionCheck:
    """What friction does to the loop of this controller (without feed-forward), predicted and, where
    `sensitivity` was measured on the simulated arm, measured."""
    found, certificate = stage.results.identify.friction, stage.results.certify.certificate
    assert found is not None
    assert certificate is not None
    steps = converter_steps(stage.config.closed_loop)
    loops = drawn(controller, found, stage.rng("closed_loop", "friction"), _DRAWS, **steps)
    plan = sensitivity_plan(stage, controller, transient_samples)
    names = ["0", "further 1", "1", "further 2", "further 3"]
    low, high, measured = np.empty(len(_SHARES)), np.empty(len(_SHARES)), np.empty(len(_SHARES))
    for k, (name, share) in enumerate(zip(names, _SHARES, strict=True)):
        excitation = plan.excitation(share)
        noise = stage.rng("closed_loop", "friction noise", name)
        phases = partial(stage.rng, "closed_loop", "sensitivity", name)
        low[k], high[k] = predicted_peak(loops, phases, noise, **excitation)
        if sensitivity is not None and name.isdigit():
            measured[k] = sensitivity.measured[int(name)].peak
        elif sensitivity is not None:
            measured[k] = measured_on_arm(stage, controller, excitation, name).peak[0]
    sizes = plan.rms * np.array(_SHARES)
    certified = certificate.plants[0].worst_peak_sensitivity
    fitted = FrictionLoop.of(controller, found, **steps)
    radius = float(np.max(np.abs(controller.poles), initial=0.0))
    rest = settling_samples(radius, 200, 6000)
    # With integral action the command grows until the arm moves, however small the step.
    sticking = [0.0 if radius > 1 - 1e-9 else loop.sticking_step(rest) for loop in (fitted, *loops)]
    tolerance = TOLERANCE_PERCENT / 100
    return FrictionCheck(
        level=found.law.breakaway,
        level_interval=_around(found.law.breakaway, found),
        presliding=found.law.presliding,
        sizes=sizes,
        low=low,
        high=high,
        measured=None if sensitivity is None else measured,
        nominal_peak=plan.nominal_peak,
        certified_peak=certified,
        tolerance_percent=TOLERANCE_PERCENT,
        certified_from=holds_from(sizes, high / certified - 1 - tolerance),
        linear_from=holds_from(sizes, np.abs(np.sqrt(low * high) / plan.nominal_peak - 1) - tolerance),
        sticking_step=sticking[0],
        sticking_interval=interval_of(sticking[1:]) if min(sticking) > 0 else (0.0, max(sticking)),
        error_at_rest=fitted.error_at_rest,
        error_interval=_around(fitted.error_at_rest, found),
        tracking=slow_sine(stage, controller, _SINE_SHARE * step, on_arm=sensitivity is not None),
    )


def _around(value: float, found: FrictionFit) -> Interval:
    """95 % interval of what is proportional to the level."""
    share = 1.96 * found.level_std / found.level if found.level > 0 else 0.0
    return value * max(1 - share, 0.0), value * (1 + share)


def holds_from(sizes: Sequence[float] | Real, excess: Real) -> float | None:
    """The size from which on, up to the first (largest), the excess (N,) is not positive; between sizes
    straight over their logarithm."""
    over = np.flatnonzero(~(excess <= 0))
    if over.size == 0:
        return float(sizes[-1])
    k = int(over[0])
    if k == 0:
        return None
    share = excess[k - 1] / (excess[k - 1] - excess[k])
    return float(sizes[k - 1] * (sizes[k] / sizes[k - 1]) ** share)


def slow_sine(stage: StageInput, controller: Controller, amplitude: float, *, on_arm: bool) -> SlowSine:
    """The error on a slow sine without feed-forward and with it, on the simulated arm as identified or on the
    identified arm with its friction; after the first quarter of a period."""
    found = stage.results.identify.friction
    assert found is not None
    forward = friction_feedforward(controller, found)
    period = int(min(_SLOW * forward.lag_s / controller.dt_s, _LONGEST))
    reference = amplitude * np.sin(2 * np.pi * np.arange(round(1.25 * period)) / period)
    given = stage.results.reference_filter.filter
    reference = reference if given is None else given.filtered(reference)
    errors = []
    for feedforward in (None, forward):
        law = replace(controller, feedforward=feedforward)
        noise = stage.rng("closed_loop", "slow sine")
        if on_arm:
            run = simulate(law, reference=reference, **loop_of_arm(stage.config, noise))
        else:
            run = FrictionLoop.of(law, found).run(reference, noise)
        errors.append((run.reference - run.measured)[period // 4 :])
    linear = FrictionLoop(controller, found, found.coefficients, FrictionLaw(0.0)).run(reference)
    rest = (linear.reference - linear.measured)[period // 4 :]
    return SlowSine(
        amplitude=amplitude,
        omega_rad_s=2 * np.pi / (period * controller.dt_s),
        linear_rms=float(np.sqrt(np.mean(rest**2))),
        without=errors[0],
        given=errors[1],
    )
