"""Random plants of the benchmark are what they claim; a proved loop keeps its sampled plants stable."""

import control
import numpy as np
import pytest

from benchmarks.random_designs import LOW_EFFORT, RADIUS, SAMPLED, random_case, state_space, unstable_samples
from control_design import Controller, Outcome, Specification, certify, synthesise


@pytest.mark.parametrize("seed", range(2))
def test_state_space_of_a_draw_is_the_posteriors_response_inside_the_ellipses(seed):
    plant, posterior, _ = random_case(seed)
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal(posterior.covariance_factor.shape[1])
    direction *= RADIUS / np.linalg.norm(direction)
    drawn = posterior.mean + posterior.covariance_factor @ direction
    omega = np.geomspace(1.0, 0.99 * plant.nyquist_rad_s, 200)
    expected = posterior.response_of(drawn[None, :], omega)[0]
    system = state_space(posterior, drawn)
    value = np.asarray(control.frequency_response(system, omega).complex).reshape(-1)
    # (z - 1)^2 at 1 rad/s is 2.5e-5 of a difference of numbers of size 1
    np.testing.assert_allclose(value, expected, rtol=1e-7, atol=1e-9 * np.max(np.abs(expected)))
    # a point of the generators' ball lies in every ellipse; on the boundary of none or some
    record = posterior.at(omega, 0.95)
    assert np.max(record.normalised_distance(expected)) <= 1 + 1e-7


def test_sampled_plants_of_a_proved_loop_are_stable_and_of_a_bad_one_are_not():
    seed = 0
    plant, posterior, _ = random_case(seed)
    size = 1 / np.max(np.abs(posterior.centre(np.geomspace(0.1, 600, 2000))))
    gentle, wild = (Controller.proportional(share * size, plant.dt_s) for share in (0.3, 100.0))
    certificate = certify(gentle, [plant], Specification(modulus_margin=0.2), n_dense=1500)
    assert certificate.plants[0].all_frequencies.proved
    assert unstable_samples(gentle, posterior, np.random.default_rng(1)) == 0
    assert unstable_samples(wild, posterior, np.random.default_rng(1)) == SAMPLED
    assert not certify(wild, [plant], Specification(modulus_margin=0.2), n_dense=1500).certified


@pytest.mark.parametrize(
    "seed", [pytest.param(155, marks=pytest.mark.long), pytest.param(107, marks=pytest.mark.long)]
)
def test_a_step_below_the_grids_is_seen(seed):
    """Both lack an integrator and ask for rejection down to zero frequency: a slow pole below every grid
    of the plant can hide a step of the sensitivity there from the search."""
    plant, _, specification = random_case(seed)
    result = synthesise([plant], specification, LOW_EFFORT, rng=np.random.default_rng(seed))
    assert certify(result.controller, [plant], specification).gamma == pytest.approx(result.gamma, rel=0.005)


@pytest.mark.long
def test_a_case_without_a_design_is_not_handed_out_as_one():
    """Seed 149: nothing robust was found; a loop on the edge of stability must not pass for a design."""
    plant, _, specification = random_case(149)
    result = synthesise([plant], specification, LOW_EFFORT, rng=np.random.default_rng(149))
    if result.outcome is Outcome.NOT_CONVERGED:
        assert result.blocking[0].plant == plant.name
        assert result.blocking[0].omega_rad_s > 0
    else:
        assert certify(result.controller, [plant], specification).plants[0].all_frequencies.proved
