from __future__ import annotations

import numpy as np
import pytest

from plant import linear_arm, paper_example, paper_example_rig, paper_link


def test_the_paper_link_has_the_papers_link():
    rig = paper_link()
    assert (rig.link.length_m, rig.link.width_m, rig.link.thickness_m) == (1.0, 0.00635, 0.00635)
    assert rig.sampling.dt_s == 1 / 200


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


def test_the_example_is_the_arm_it_says():
    # The transfer function is written by hand from the equations; the arm's state space knows nothing of it.
    omega = np.geomspace(0.5, 100, 30)
    arm = linear_arm(paper_example_rig(), n_modes=1)
    np.testing.assert_allclose(arm(1j * omega)[1, 1], paper_example()(1j * omega), rtol=1e-8)
    # The rigid-body gain is that of the turning arm, (L / I) / s^2.
    rig = paper_example_rig()
    inertia = rig.hub.inertia_kg_m2 + rig.link.mass_per_length_kg_m / 3
    slow = np.array([1e-3])
    assert np.real(paper_example()(1j * slow) * (1j * slow) ** 2)[0] == pytest.approx(1 / inertia, rel=1e-4)
