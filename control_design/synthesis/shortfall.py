"""Why a controller is no design at all: which requirement fails on which plant, and at which frequency."""

from __future__ import annotations

import numpy as np

from control_design.controllers.biquads import Cascade
from control_design.plants.ellipses import Real, scale_to_minus_one
from control_design.plants.frequency_grid import local_maxima
from control_design.synthesis.problem import Problem
from control_design.synthesis.synthesis_result import BlockingPoint

NOMINAL = "stability of the nominal loop"
ROBUST = "stability over the ellipse"
DELAYED = "stability with the extra delay"
GUARDED = "stability of a sampled response"
DAMPING = "damping of the controller's own poles"

_PLACES = 5  # named of each plant


def what_destabilises(problem: Problem, cascade: Cascade, parameters: Real) -> tuple[BlockingPoint, ...]:
    """Points at which a controller fails before any weight counts, the worst first; empty if none does.

    An unstable nominal loop is named by its poles (frequency of ln(z)/dt, the fastest growing first), one
    that is stable by the frequencies at which an ellipse, or the ellipse behind the delay of the delay
    margin, lies deepest over -1; a guard by the frequency where it comes nearest to -1; a controller that
    rings too much by its own least damped pair.
    """
    found: list[tuple[int, float, BlockingPoint]] = []
    loops = problem.closed_loop_poles(cascade, parameters)
    for plant, z in zip(problem.plants, loops, strict=True):
        for pole in z[(np.abs(z) >= 1.0) & (z.imag >= 0) & np.isfinite(z)]:
            frequency = float(np.abs(np.log(pole))) / problem.dt_s
            found.append((0, -float(np.abs(pole)), BlockingPoint(plant.name, NOMINAL, frequency, np.inf)))
    for _, data in problem.checks(cascade, parameters):
        name, omega = data.plant.name, data.ellipses.omega_rad_s
        k = cascade.response(parameters, omega)
        late = [(ROBUST, np.ones(omega.size, dtype=np.complex128))]
        if problem.spec.delay_margin_s is not None:
            late.append((DELAYED, np.exp(-1j * omega * problem.spec.delay_margin_s)))
        for word, delay in late:
            scale = scale_to_minus_one(k * data.delay * delay, data.ellipses)
            for at in local_maxima(-scale)[:_PLACES]:
                if scale[at] <= 1.0:
                    found.append((1, float(scale[at]), BlockingPoint(name, word, float(omega[at]), np.inf)))
    points = [point for *_, point in sorted(found, key=lambda entry: entry[:2])]
    return tuple(points or _guards(problem, cascade, parameters) or _ringing(problem, cascade, parameters))


def _guards(problem: Problem, cascade: Cascade, parameters: Real) -> list[BlockingPoint]:
    points = []
    for guard in problem.guards:
        if not problem.guarded(cascade, parameters, [guard]):
            omega = guard.omega_rad_s
            distance = np.abs(1.0 + guard.response * problem.delayed_response(cascade, parameters, omega))
            at = int(np.argmin(distance))
            points.append(BlockingPoint(problem.plants[guard.plant].name, GUARDED, float(omega[at]), np.inf))
    return points


def _ringing(problem: Problem, cascade: Cascade, parameters: Real) -> list[BlockingPoint]:
    asked = problem.spec.controller_damping
    least = cascade.least_damping(parameters)
    if asked is None or not least < asked:
        return []
    corners = [(parameters[at] - 0.5 * parameters[at + 1], at) for at in cascade.pair_positions]
    corner = float(np.exp(0.5 * parameters[min(corners)[1] + 1])) * cascade.scale_rad_s
    return [BlockingPoint("controller", DAMPING, corner, asked / least)]
