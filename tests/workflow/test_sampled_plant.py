"""Drawn plants: state space, stepping and direct terms against responses computed elsewhere."""

import control
import numpy as np
import pytest

from control_design import Controller, LinearMachine, simulate
from ident import Poles
from ident.uncertainty import ResponsePosterior
from workflow.tasks.sampled_plant import FINITE, realise, simulate_plant

DT_S = 0.01


def posterior(*, feedthrough: bool, integrators: int, delay: int, fir: int = 7) -> ResponsePosterior:
    rng = np.random.default_rng(5)
    poles = Poles(np.array([0.9, 0.2]), np.array([0.95 * np.exp(0.3j)]))
    size = poles.order + int(feedthrough) + fir
    return ResponsePosterior(
        poles=poles, mean=0.1 * rng.standard_normal(size),
        covariance_factor=0.01 * rng.standard_normal((size, 3)), dt_s=DT_S, fir_length=fir,
        has_feedthrough=feedthrough, integrators=integrators, input_delay_samples=delay,
    )  # fmt: skip


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("integrators", [0, 1])
@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("fir", [0, 7])
def test_realisation_has_the_response_of_the_draw(feedthrough, integrators, delay, fir):
    found = posterior(feedthrough=feedthrough, integrators=integrators, delay=delay, fir=fir)
    draw = found.sample(np.random.default_rng(1), 1)[0]
    plant = realise(found, draw)
    omega = np.geomspace(0.5, 300.0, 40)
    z = np.exp(1j * omega * DT_S)
    response = [
        plant.C @ np.linalg.solve(value * np.eye(plant.nstates) - plant.A, plant.B) + plant.D for value in z
    ]
    response = np.ravel(response)
    np.testing.assert_allclose(response, found.response_of(draw[None, :], omega)[0], rtol=1e-9)


def law(gain: float, delay: int) -> Controller:
    nothing = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0))
    return Controller(*nothing, np.array([[gain]]), DT_S, computational_delay_samples=delay)


@pytest.mark.parametrize("feedthrough", [False, True])
def test_closed_loop_is_the_linear_feedback(feedthrough):
    """With a direct term, too: the loop that python-control computes from K z^-1 G, and a disturbance of the
    plant's input that acts at its own sample."""
    found = posterior(feedthrough=feedthrough, integrators=0, delay=0)
    gain = 0.3
    reference = np.where(np.arange(80) >= 5, 1.0, 0.0)
    disturbance = np.where(np.arange(80) >= 40, 0.5, 0.0)
    run = simulate_plant(law(gain, 1), realise(found, found.mean), reference, input_disturbance=disturbance)
    plant = realise(found, found.mean)
    assert (plant.D.item() != 0) == feedthrough
    late = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], DT_S)
    loop = control.feedback(plant * late * gain, 1)
    expected = control.forced_response(loop, inputs=reference).outputs
    expected = (
        expected + control.forced_response(control.feedback(plant, late * gain), inputs=disturbance).outputs
    )
    np.testing.assert_allclose(run.measured, expected, atol=1e-10)
    acted = gain * np.concatenate([[0.0], (reference - run.measured)[:-1]])
    np.testing.assert_allclose(run.command, acted, atol=1e-10)


def test_direct_term_without_a_delay_is_refused():
    found = posterior(feedthrough=True, integrators=0, delay=0)
    with pytest.raises(ValueError, match="at least one sample of computational delay"):
        simulate_plant(law(0.3, 0), realise(found, found.mean), np.ones(5))


def test_loop_that_runs_away_stays_finite():
    """Far too much gain on an integrator: the clipped machine keeps every number a number."""
    machine = LinearMachine(control.ss([[1.0]], [[1.0]], [[1.0]], [[0.0]], DT_S))
    run = simulate(law(50.0, 1), machine, np.ones(3000), clip=FINITE)
    assert np.all(np.isfinite(run.measured))
    assert np.max(np.abs(run.measured)) > 1e8


def test_clipping_is_clipping():
    machine = LinearMachine(control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], DT_S))
    load = np.array([1.0, 5.0, -7.0, 0.0])
    run = simulate(law(0.0, 0), machine, np.zeros(4), input_disturbance=load, clip=2.0)
    np.testing.assert_array_equal(run.measured, [0.0, 1.0, 2.0, -2.0])
