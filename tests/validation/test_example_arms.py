import numpy as np
import pytest

from plant import linear_arm, paper_link
from plant.rig import Hub
from validation.example_arms import paper_example, two_link_matrices, two_link_operating_point

RIG = paper_link().perturbed({"hub.radius_m": 0.0, "payload.mass_kg": 0.03})
HUBS = (
    Hub(inertia_kg_m2=0.02, radius_m=0.0, viscous_friction_Nms=0.01),
    Hub(inertia_kg_m2=0.003, radius_m=0.0, viscous_friction_Nms=0.02),
)
ELBOW, PAYLOAD = 0.2, 0.05


def _matrices(links, angle, n_modes=3):
    return two_link_matrices(links, HUBS, ELBOW, PAYLOAD, angle, n_modes)


@pytest.mark.parametrize("angle", [0.0, 1.1, np.pi / 2, 2.5])
def test_the_rigid_part_is_the_double_pendulum(angle):
    link = RIG.link
    mass = _matrices((link, link), angle)[0][:2, :2]
    # Siciliano et al., Robotics, planar two-link arm, for two uniform rods, an elbow mass and a tip mass.
    m, length = link.mass_per_length_kg_m * link.length_m, link.length_m
    a = m * length**2 / 3 + (ELBOW + m + PAYLOAD) * length**2 + HUBS[0].inertia_kg_m2
    b = m * length**2 / 3 + PAYLOAD * length**2 + HUBS[1].inertia_kg_m2
    c = (m / 2 + PAYLOAD) * length**2 * np.cos(angle)
    np.testing.assert_allclose(mass, [[a + b + 2 * c, b + c], [b + c, b]], rtol=1e-12)


def test_mass_is_positive_definite_and_turning_as_a_whole_bends_nothing():
    mass, damping, stiffness, _ = _matrices((RIG.link, RIG.link), 0.7, 6)
    np.testing.assert_allclose(mass, mass.T, atol=1e-15)
    assert np.linalg.eigvalsh(mass)[0] > 0
    np.testing.assert_array_equal(stiffness[:2], 0)
    assert np.linalg.eigvalsh(damping)[0] > -1e-15


def test_straight_and_with_the_elbow_locked_two_halves_are_one_link():
    # Two halves of one link, no elbow mass or hub, theta_2 held at zero: the link of twice the length.
    link = RIG.link
    half = link.model_copy(update={"length_m": link.length_m / 2})
    hubs = (
        RIG.hub.model_copy(update={"viscous_friction_Nms": 0.0}),
        Hub(inertia_kg_m2=1e-12, radius_m=0.0, viscous_friction_Nms=0.0),
    )
    n_modes = 8
    mass, _, stiffness, tip = two_link_matrices((half, half), hubs, 0.0, RIG.payload.mass_kg, 0.0, n_modes)
    free = np.delete(np.arange(3 + 2 * n_modes), 1)
    mass, stiffness, tip = mass[np.ix_(free, free)], stiffness[np.ix_(free, free)], tip[free]
    omega = np.array([1.0, 10.0, 40.0, 100.0])
    torque = np.eye(free.size)[0]
    got = np.array([tip @ np.linalg.solve(stiffness - w**2 * mass, torque) for w in omega])
    undamped = RIG.perturbed(
        {"link.kelvin_voigt_s": 0.0, "hub.viscous_friction_Nms": 0.0, "motor.back_emf_Vs_rad": 0.0}
    )
    expected = linear_arm(undamped, 24)(1j * omega)[1, 1]
    np.testing.assert_allclose(got, expected.real, rtol=1e-6)


def test_the_preset_is_stable_but_for_its_two_angles():
    system = two_link_operating_point()
    poles = system.poles()
    assert np.sum(np.abs(poles) < 1e-6) == 2
    assert np.all(poles[np.abs(poles) >= 1e-6].real < 0)
    assert system.output_labels == ["shoulder_angle_rad", "elbow_angle_rad", "tip_m"]


def test_bad_arms_are_refused():
    with pytest.raises(ValueError, match="radii must be zero"):
        two_link_matrices((RIG.link, RIG.link), (paper_link().hub, HUBS[1]), 0.1, 0.1, 0.0, 2)
    with pytest.raises(ValueError, match="finite angle"):
        two_link_matrices((RIG.link, RIG.link), HUBS, 0.1, 0.1, np.nan, 2)


def test_the_example_has_the_zeros_and_poles_of_the_paper():
    system = paper_example()
    np.testing.assert_allclose(np.sort(system.zeros().real), [-10.5, 10.8], rtol=1e-9)
    np.testing.assert_allclose(system.zeros().imag, 0, atol=1e-9)
    poles = system.poles()
    poles = poles[np.argsort(np.abs(poles))]
    np.testing.assert_allclose(poles[:2], 0, atol=1e-9)
    np.testing.assert_allclose(np.abs(poles[2:]), 15.0, rtol=1e-9)
    assert -poles[2].real / 15.0 == pytest.approx(0.0198, rel=0.01)
    assert system.isctime()
