import numpy as np
import pytest

from plant.beam import clamped_free_modes

EI, M, L, R = 2.0, 0.11, 1.3, 0.07


def _quadrature():
    x, w = np.polynomial.legendre.leggauss(200)
    return L * (x + 1) / 2, L * w / 2


def test_textbook_wave_numbers_without_tip_mass():
    modes = clamped_free_modes(EI, M, L, 5)
    # Blevins, Formulas for Natural Frequency and Mode Shape, table 8-1.
    np.testing.assert_allclose(
        modes.wave_number_rad_m * L, [1.87510407, 4.69409113, 7.85475744, 10.99554073, 14.13716839], atol=1e-8
    )
    np.testing.assert_allclose(np.abs(modes.tip), 2 / np.sqrt(M * L), rtol=1e-12)


def test_a_heavy_tip_mass_is_a_spring_with_a_pin():
    mass = 1e4
    modes = clamped_free_modes(EI, M, L, 3, tip_mass_kg=mass)
    # The first mode is the mass on the static tip stiffness 3 EI / L^3 with 33/140 of the link's mass; the
    # others have the wave numbers of a clamped-pinned link, tan = tanh.
    assert modes.omega_rad_s[0] == pytest.approx(np.sqrt(3 * EI / L**3 / (mass + 33 / 140 * M * L)), rel=1e-9)
    np.testing.assert_allclose(modes.wave_number_rad_m[1:] * L, [3.92660231, 7.06858275], rtol=1e-5)


@pytest.mark.parametrize("mass", [0.0, 0.02, 0.5])
def test_modes_are_orthonormal_and_their_integrals_are_right(mass):
    modes = clamped_free_modes(EI, M, L, 12, mass, R)
    x, w = _quadrature()
    shape, curvature = modes.shape(x), modes.curvature(x)
    gram = M * (shape.T * w) @ shape + mass * np.outer(modes.tip, modes.tip)
    np.testing.assert_allclose(gram, np.eye(12), atol=1e-11)
    energy = EI * (curvature.T * w) @ curvature / modes.omega_rad_s**2
    np.testing.assert_allclose(energy, np.eye(12), atol=1e-10)
    np.testing.assert_allclose(
        M * (w * (R + x)) @ shape + mass * (R + L) * modes.tip, modes.coupling, atol=1e-12
    )
    np.testing.assert_allclose(M * w @ shape + mass * modes.tip, modes.first_moment, atol=1e-12)
    np.testing.assert_allclose(modes.shape(np.array([L]))[0], modes.tip, rtol=1e-9)
    # Slope and curvature are the derivatives of the shape.
    at, h = np.array([0.4 * L]), 1e-6
    np.testing.assert_allclose(
        modes.slope(at), (modes.shape(at + h) - modes.shape(at - h)) / (2 * h), rtol=1e-6
    )
    np.testing.assert_allclose(
        modes.curvature(at), (modes.slope(at + h) - modes.slope(at - h)) / (2 * h), rtol=1e-6
    )


def test_high_modes_do_not_overflow():
    modes = clamped_free_modes(EI, M, L, 1000, 0.02, R)
    x = np.linspace(0, L, 7)
    for values in (modes.omega_rad_s, modes.tip, modes.coupling, modes.shape(x), modes.curvature(x)):
        assert np.all(np.isfinite(values))
    assert np.all(np.diff(modes.wave_number_rad_m) > 0)


@pytest.mark.parametrize(
    "values",
    [
        (np.nan, M, L, 3),
        (EI, 0.0, L, 3),
        (EI, M, -1.0, 3),
        (EI, M, L, 0),
        (EI, M, L, 3, -0.1),
        (EI, M, L, 3, 0.0, np.nan),
    ],
)
def test_impossible_links_are_refused(values):
    with pytest.raises(ValueError):
        clamped_free_modes(*values)


def test_positions_outside_the_link_are_refused():
    with pytest.raises(ValueError, match=f"{L} m"):
        clamped_free_modes(EI, M, L, 2).shape(np.array([1.5 * L]))
