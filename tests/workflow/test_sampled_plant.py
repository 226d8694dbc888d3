"""Drawn plants: state space, stepping and direct terms against responses computed elsewhere."""

from __future__ import annotations

import control
import numpy as np
import pytest
from scipy.signal import dlsim

from control_design.analysis.closed_loop import simulate
from control_design.controllers.controller import Controller
from ident.basis.poles import Poles
from ident.uncertainty import ResponsePosterior
from workflow.tasks.sampled_plant import FINITE, ClippedMachine, StateSpaceMachine, realise

DT_S = 0.01


def posterior(*, feedthrough: bool, integrators: int, delay: int, fir: int = 7) -> ResponsePosterior:
    rng = np.random.default_rng(5)
    poles = Poles(np.array([0.9, 0.2]), np.array([0.95 * np.exp(0.3j)]))
    size = poles.order + int(feedthrough) + fir
    return ResponsePosterior(
        poles=poles,
        mean=0.1 * rng.standard_normal(size),
        covariance_factor=0.01 * rng.standard_normal((size, 3)),
        dt_s=DT_S,
        fir_length=fir,
        has_feedthrough=feedthrough,
        integrators=integrators,
        input_delay_samples=delay,
    )


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("integrators", [0, 1])
@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("fir", [0, 7])
def test_realisation_has_the_response_of_the_draw(feedthrough, integrators, delay, fir):
    found = posterior(feedthrough=feedthrough, integrators=integrators, delay=delay, fir=fir)
    draw = found.sample(np.random.default_rng(1), 1)[0]
    a, b, c, d = realise(found, draw)
    omega = np.geomspace(0.5, 300.0, 40)
    z = np.exp(1j * omega * DT_S)
    response = [(c @ np.linalg.solve(value * np.eye(a.shape[0]) - a, b)) + d for value in z]
    np.testing.assert_allclose(response, found.response_of(draw[None, :], omega)[0], rtol=1e-9)


def test_stepping_is_the_linear_simulation():
    found = posterior(feedthrough=False, integrators=1, delay=1)
    a, b, c, d = realise(found, found.mean)
    machine = StateSpaceMachine(a, b, c, d, DT_S, holds_input=False)
    u = np.random.default_rng(2).standard_normal(60)
    outputs = []
    for value in u:
        outputs.append(machine.measure()[0])
        machine.advance(value)
    _, expected, _ = dlsim((a, b[:, None], c[None, :], np.array([[d]]), DT_S), u)
    np.testing.assert_allclose(outputs, expected[:, 0], atol=1e-12)
    machine.reset()
    assert machine.measure()[0] == 0.0


def test_closed_loop_with_a_direct_term_is_the_linear_feedback():
    """One sample of delay kept by the machine gives the loop that python-control computes from K z^-1 G."""
    found = posterior(feedthrough=True, integrators=0, delay=0)
    a, b, c, d = realise(found, found.mean)
    assert d != 0
    gain = 0.3
    law = Controller(
        np.zeros((0, 0)),
        np.zeros((0, 1)),
        np.zeros((1, 0)),
        np.array([[gain]]),
        DT_S,
        computational_delay_samples=0,
    )
    reference = np.where(np.arange(80) >= 5, 1.0, 0.0)
    run = simulate(law, StateSpaceMachine(a, b, c, d, DT_S, holds_input=True), reference)
    plant = control.ss(a, b[:, None], c[None, :], [[d]], DT_S)
    late = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], DT_S)
    loop = control.feedback(plant * late * gain, 1)
    expected = control.forced_response(loop, inputs=reference).outputs
    np.testing.assert_allclose(run.measured, expected, atol=1e-10)


def test_direct_term_without_held_input_is_refused():
    with pytest.raises(ValueError, match="holds_input"):
        StateSpaceMachine(np.zeros((1, 1)), np.ones(1), np.ones(1), 0.5, DT_S, holds_input=False)


def test_hub_torque_has_nowhere_to_go():
    machine = StateSpaceMachine(np.zeros((1, 1)), np.ones(1), np.ones(1), 0.0, DT_S, holds_input=False)
    with pytest.raises(ValueError, match="no input for a hub torque"):
        machine.advance(1.0, hub_torque_Nm=0.1)


def test_loop_that_runs_away_stays_finite():
    """Far too much gain on an integrator: the clipped machine keeps every number a number."""
    machine = StateSpaceMachine(np.ones((1, 1)), np.ones(1), np.ones(1), 0.0, DT_S, holds_input=False)
    law = Controller(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[50.0]]), DT_S)
    run = simulate(law, ClippedMachine(machine, FINITE), np.ones(3000))
    assert np.all(np.isfinite(run.measured))
    assert np.max(np.abs(run.measured)) > 1e8


def test_clipping_is_clipping():
    machine = StateSpaceMachine(np.zeros((1, 1)), np.ones(1), np.ones(1), 0.0, DT_S, holds_input=False)
    clipped = ClippedMachine(machine, 2.0)
    seen = []
    for value in (1.0, 5.0, -7.0):
        clipped.advance(value)
        seen.append(float(clipped.measure()[0]))
    assert seen == [1.0, 2.0, -2.0]
    assert clipped.dt_s == DT_S
