"""The seams: an identified posterior as uncertain plant, the nonlinear arm as sampled machine."""

import re

import control
import numpy as np
import pytest

import control_design
from control_design.plants.frequency_grid import GridOptions, checked_grid, programme_grid
from examples import two_joints
from ident import GobfModel, Poles
from ident.basis.posterior import ResponsePosterior
from plant import SampledArm, linear_arm, paper_link


def test_an_identified_model_with_integrator_and_its_posterior_are_an_uncertain_plant():
    dt = 0.005
    poles = Poles(np.array([0.96]), np.array([0.995 * np.exp(0.08j)]))
    mean = np.array([0.002, 1e-4, 2e-4])
    model = GobfModel(poles, mean, dt, integrators=1)
    posterior = ResponsePosterior(poles, mean, 0.02 * np.diag(mean), dt, integrators=1)
    plant = control_design.UncertainPlant(model.to_control(), name="identified", uncertainty=posterior)
    assert plant.n_integrators == 1
    omega = np.geomspace(1e-3, np.pi / dt, 50)
    ellipses = plant.at(omega)
    np.testing.assert_allclose(ellipses.centre, plant.channel.nominal_response(omega), rtol=1e-7)
    assert np.all(ellipses.semi_major > 0)
    controller = control_design.Controller.proportional(0.5, dt)
    certificate = control_design.certify(controller, [plant], control_design.Specification(), n_dense=1000)
    verdict = certificate.plants[0]
    assert verdict.nyquist.matches == verdict.stable
    assert verdict.worst_margins.modulus < verdict.nominal_margins.modulus


@pytest.mark.parametrize("zeta", [3e-4, 0.003, 0.03])
def test_dense_grids_see_the_peak_of_a_mode_that_only_the_ellipses_have(zeta):
    dt, omega = 0.005, 21.3
    pair = np.exp(omega * dt * (-zeta + 1j * np.sqrt(1 - zeta**2)))
    mean = np.array([0.01, 1e-3 * np.sqrt(zeta), 0.0])
    seen = ResponsePosterior(Poles(np.array([0.96]), np.array([pair])), mean, 0.02 * np.diag(mean), dt)
    lag = control_design.UncertainPlant(
        control.ss([[0.96]], [[1.0]], [[0.01]], 0, dt), name="lag", uncertainty=seen
    )
    fine = omega * (1 + 5 * zeta * np.linspace(-1, 1, 4001))
    for grid in (programme_grid(lag, (), GridOptions(), dense=True), checked_grid(lag, (), 1000, 100)):
        near = grid[np.abs(grid / omega - 1) < 5 * zeta]
        # Of 20 points by sinh over 20 half bandwidths one is within .2 of the peak: 2 % lower.
        assert np.max(np.abs(lag.at(near).centre)) > 0.98 * np.max(np.abs(lag.at(fine).centre))
    bare = control_design.UncertainPlant(lag.nominal, name="lag")
    sizes = [programme_grid(p, (), GridOptions(), dense=d).size for d in (False, True) for p in (lag, bare)]
    assert (sizes[0] - sizes[1], sizes[2] > sizes[3]) == (0, zeta < 0.001)


def test_the_arm_without_effects_answers_like_its_linear_model_and_saturates_with_a_limit():
    rig = paper_link()
    arm, model = SampledArm(rig), linear_arm(rig)
    continuous = control.ss(model.A, np.asarray(model.B)[:, :1], np.asarray(model.C)[:1], 0)
    hub = control.c2d(continuous, arm.dt_s, "zoh")
    controller = control_design.Controller.proportional(10.0, arm.dt_s)
    reference = np.full(400, 0.2)
    on_arm = control_design.simulate(controller, arm, reference)
    predicted = control_design.simulate(controller, control_design.LinearMachine(hub), reference)
    # Exact discretisation on both sides: rounding of 400 steps of signals of size 0.2.
    np.testing.assert_allclose(on_arm.measured, predicted.measured, rtol=0, atol=1e-10)
    limited = control_design.simulate(
        control_design.Controller.proportional(10.0, arm.dt_s, input_limit=1.0), arm, reference
    )
    assert np.max(np.abs(limited.command)) == pytest.approx(1.0)
    assert control_design.step_metrics(limited).limited_fraction > 0


@pytest.mark.long
def test_logs_of_two_joints_become_a_certified_controller(tmp_path, capsys):
    two_joints.run(tmp_path)
    said = capsys.readouterr().out
    assert "certified: True" in said
    assert float(re.search(r"worst case ([\d.]+)", said)[1]) < 1
    assert float(re.search(r"largest pole ([\d.]+)", said)[1]) < 1
    # 2 free joints, 2 friction poles, 5 pairs: n + integrators, not twice as many.
    assert 12 <= int(re.search(r"model: (\d+) states", said)[1]) <= 15
    assert (tmp_path / "two_joints.c").read_text().count("limit") > 1
