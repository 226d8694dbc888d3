"""The seams: an identified posterior as uncertain plant, the nonlinear arm as sampled machine."""

from __future__ import annotations

import control
import numpy as np
import pytest

from control_design import (
    Controller,
    LinearMachine,
    Specification,
    UncertainPlant,
    certify,
    simulate,
    step_metrics,
)
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from plant import SampledArm, linear_arm, paper_link


def test_an_identified_model_with_integrator_and_its_posterior_are_an_uncertain_plant():
    dt = 0.005
    poles = Poles(np.array([0.96]), np.array([0.995 * np.exp(0.08j)]))
    mean = np.array([0.002, 1e-4, 2e-4])
    model = GobfModel(poles, mean, dt, integrators=1)
    posterior = ResponsePosterior(poles, mean, 0.02 * np.diag(mean), dt, integrators=1)
    plant = UncertainPlant("identified", model.to_control(), posterior)
    assert plant.n_integrators == 1
    omega = np.geomspace(1e-3, np.pi / dt, 50)
    ellipses = plant.at(omega)
    np.testing.assert_allclose(ellipses.centre, plant.channel.nominal_response(omega), rtol=1e-7)
    assert np.all(ellipses.semi_major > 0)
    controller = Controller.proportional(0.5, dt)
    certificate = certify(controller, [plant], Specification(), n_dense=1000)
    verdict = certificate.plants[0]
    assert verdict.nyquist.matches == verdict.stable
    assert verdict.worst_margins.modulus < verdict.nominal_margins.modulus


def test_the_arm_without_effects_answers_like_its_linear_model_and_saturates_with_a_limit():
    rig = paper_link()
    arm = SampledArm(rig)
    model = linear_arm(rig)
    hub = control.c2d(
        control.ss(model.A, np.asarray(model.B)[:, :1], np.asarray(model.C)[:1], 0), arm.dt_s, "zoh"
    )
    controller = Controller.proportional(10.0, arm.dt_s)
    reference = np.full(400, 0.2)
    on_arm = simulate(controller, arm, reference)
    predicted = simulate(controller, LinearMachine(hub), reference)
    # Exact discretisation on both sides: rounding of 400 steps of signals of size 0.2.
    np.testing.assert_allclose(on_arm.measured, predicted.measured, rtol=0, atol=1e-10)
    limited = simulate(Controller.proportional(10.0, arm.dt_s, input_limit=1.0), arm, reference)
    assert np.max(np.abs(limited.command)) == pytest.approx(1.0)
    assert step_metrics(limited).limited_fraction > 0
