"""Published comparison numbers that one design reaches in seconds: order 6, mode damping, reference filter.

The others have their tests beside their subject: order 5 in test_synthesis, joint coverage in
test_joint_coverage and test_joint_synthesis, certificate in test_between_grid_points and test_random_designs,
the transmission with three loads in test_landau_score.
"""

import control
import numpy as np
import pytest

import control_design
from validation.example_plants import flexible_link, flexible_link_specification

pytestmark = pytest.mark.slow

# Damping of the mode, and max(|W1 S|, |W3 K S|) of the full-order controllers that were published.
PUBLISHED = ((0.015, 0.965), (0.028, 1.137), (0.050, 1.40))
MODEL = control_design.RationalWeight(numerator=(1.0,), denominator=(0.25, 1.0, 1.0))


@pytest.mark.parametrize(
    ("scenario", "youla"),
    [("A", 0.931), *(pytest.param(*case, marks=pytest.mark.long) for case in (("B", 1.065), ("C", 1.268)))],
)
def test_order_6_comes_within_2_percent_of_what_any_order_was_published_to_reach(scenario, youla):
    """The better of two searches: one search may end in a valley 0.8 % worse (scenario C, seed 1)."""
    plant, specification = flexible_link(scenario), flexible_link_specification(6)
    limit = 1.02 * youla
    for seed in (2, 1):
        result = control_design.synthesise([plant], specification, rng=np.random.default_rng(seed))
        certificate = control_design.certify(result.controller, [plant], specification)
        assert certificate.plants[0].all_frequencies.proved
        if certificate.gamma <= limit:
            break
    assert certificate.gamma <= limit


@pytest.mark.long
def test_damping_of_the_mode_costs_less_than_published_for_a_full_order_controller():
    """One design with the peak halved lies below all three published points: damping 0.05 and more at less
    than the cost published for 0.015."""
    link = flexible_link("A")
    plant = control_design.UncertainPlant(link.nominal, name="link without ellipses")
    specification = flexible_link_specification(6).model_copy(update={"mode_peak_ratio": 0.5})
    result = control_design.synthesise(
        [plant], specification, control_design.SynthesisOptions(starts=2), rng=np.random.default_rng(1)
    )
    # Poles and responses by python-control: a controller could put a badly damped pole beside the mode.
    law = result.controller.to_control(include_delay=True)
    z = control.feedback(plant.nominal, law).poles()
    assert np.max(np.abs(z)) < 1
    s = np.log(z[z.imag > 1e-9]) / plant.dt_s
    near = s[(np.abs(s) > 10) & (np.abs(s) < 22.5)]
    assert np.min(-near.real / np.abs(near)) >= max(zeta for zeta, _ in PUBLISHED)
    around = 15 + 0.01 * np.sinh(np.linspace(-7, 7, 10_001))
    omega = np.unique(np.r_[np.geomspace(1e-4, plant.nyquist_rad_s * (1 - 1e-9), 30_000), around])
    k, g = (control.frequency_response(one, omega).complex.ravel() for one in (law, plant.nominal))
    w1, w3 = (
        specification.magnitude(plant, omega, f)
        for f in (control_design.LoopFunction.SENSITIVITY, control_design.LoopFunction.EFFORT)
    )
    cost = np.max(np.maximum(w1, w3 * np.abs(k)) / np.abs(1 + g * k))
    assert cost <= min(cost for _, cost in PUBLISHED)


@pytest.mark.long
def test_first_order_reference_filter_of_scenario_b_divides_the_worst_matching_error_by_four():
    plant, specification = flexible_link("B"), flexible_link_specification(5)
    result = control_design.synthesise([plant], specification, rng=np.random.default_rng(1))
    reference_filter = control_design.design_reference_filter(
        result.controller, plant, MODEL, control_design.ReferenceFilterOptions(order=1)
    )
    assert reference_filter.error_before >= 4.0 * reference_filter.error_after
    assert reference_filter.error_after <= 0.23
