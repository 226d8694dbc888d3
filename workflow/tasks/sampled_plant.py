"""A plant drawn from an identified posterior, and a linear plant in a closed loop."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING

import numpy as np

from control_design.analysis.closed_loop import ClosedLoopTrajectory, LinearMachine, simulate
from control_design.controllers.controller import Controller
from ident.basis.functions import inverse_all_pass
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.data.arrays import RealArray
from ident.uncertainty import ResponsePosterior

if TYPE_CHECKING:
    import control

# Input at which a machine is clipped only so that a loop that runs away stays made of numbers.
FINITE = 1e9


def realise(posterior: ResponsePosterior, coefficients: RealArray) -> control.StateSpace:
    """One draw of coefficients (P,): poles and kernel in parallel.

    A kernel of L taps is the basis of L poles at zero; both parts carry their own integrators and delay.
    Unstable poles are those of the draw, behind the sum: once, or what rounding leaves between would grow.
    """
    n = posterior.poles.order
    direct = int(posterior.has_feedthrough)
    parts = [_part(posterior, posterior.poles, coefficients[:n], float(coefficients[n]) if direct else 0.0)]
    taps = posterior.fir_length
    if taps:
        shift = Poles(np.zeros(taps), np.zeros(0, dtype=np.complex128))
        parts.append(_part(posterior, shift, coefficients[n + direct :][:taps], 0.0))
    stable = reduce(add, parts)
    if not posterior.unstable.order:
        return stable
    drawn = inverse_all_pass(posterior.unstable.moved(coefficients[n + direct + taps :]))
    # Imported here: it brings a plotting library with it.
    import control

    return control.ss(*drawn, stable.dt, remove_useless_states=False) * stable


def _part(
    posterior: ResponsePosterior, poles: Poles, coefficients: RealArray, feedthrough: float
) -> control.StateSpace:
    """The poles of a basis with their coefficients, integrators and delay as a discrete system."""
    return GobfModel(
        poles,
        coefficients,
        posterior.dt_s,
        feedthrough=feedthrough,
        integrators=posterior.integrators,
        input_delay_samples=posterior.input_delay_samples,
    ).to_control()


def simulate_plant(
    controller: Controller,
    plant: control.StateSpace,
    reference: RealArray,
    *,
    input_disturbance: RealArray | None = None,
    output_disturbance: RealArray | None = None,
    measurement_step: float = 0.0,
    command_step: float = 0.0,
    clip: float = np.inf,
) -> ClosedLoopTrajectory:
    """The loop on a discrete plant, as of `realise`; signals (T,), steps and clip as of `simulate`.

    A direct term answers to the input of the same instant, which a sampled machine cannot do: it is measured
    before the input is known. There the machine keeps one sample of the loop's computational delay itself.
    Raises ValueError where the loop has none.
    """
    direct = bool(np.any(plant.D != 0))
    if direct:
        delay = controller.computational_delay_samples
        if delay < 1:
            raise ValueError(
                "a plant with a direct term needs at least one sample of computational delay in the loop"
            )
        controller = replace(controller, computational_delay_samples=delay - 1)
        # Imported here: it brings a plotting library with it.
        import control

        plant = plant * control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], plant.dt)
        if input_disturbance is not None:
            input_disturbance = np.append(input_disturbance[1:], input_disturbance[-1])
    run = simulate(
        controller,
        LinearMachine(plant),
        reference,
        input_disturbance=input_disturbance,
        output_disturbance=output_disturbance,
        measurement_step=measurement_step,
        command_step=command_step,
        clip=clip,
    )
    # With a direct term the machine acted on each command one sample after it was handed over.
    return replace(run, command=np.concatenate([[0.0], run.command[:-1]])) if direct else run
