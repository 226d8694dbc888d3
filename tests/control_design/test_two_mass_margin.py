"""The exact robust stability margin of the two-mass benchmark against its published bounds and the poles."""

from __future__ import annotations

import control
import numpy as np
import pytest

from benchmarks.two_mass_margin import (
    PUBLISHED,
    SPREAD,
    closed_loop_poles,
    controller,
    largest_real_part,
    margin,
    real_axis_frequencies,
)


def test_margin_lies_between_the_published_bounds_at_the_published_frequency():
    found = margin()
    low, high, omega = PUBLISHED
    # the bounds are published with four decimals, the frequency with two
    assert low - 5e-5 <= found.scaling <= high + 5e-5
    assert found.omega_rad_s == pytest.approx(omega, abs=0.01)
    assert round(found.scaling, 2) in (2.88, 2.89)


def test_worst_plant_has_a_pole_at_that_frequency_and_python_control_agrees():
    found = margin()
    poles = closed_loop_poles(*found.plant)
    assert np.min(np.abs(poles - 1j * found.omega_rad_s)) < 1e-6 * found.omega_rad_s
    s = control.tf("s")
    m1, m2, k = found.plant
    plant = k / (m1 * s**2 * (m2 * s**2 + (1 + m2 / m1) * k))
    loop = plant * 100 * ((s + 1) / (0.001 * s + 1)) ** 3
    value = complex(control.evalfr(loop, 1j * found.omega_rad_s))
    assert value == pytest.approx(-1, abs=1e-9)


def test_every_sampled_plant_inside_is_stable_and_one_outside_is_not():
    found = margin()
    assert largest_real_part(0.999 * found.scaling, 7) < 0
    assert largest_real_part(1.001 * found.scaling, 2) > 0
    rng = np.random.default_rng(0)
    for _ in range(500):
        side = 1 + 0.9999 * SPREAD * found.scaling * rng.uniform(-1, 1, 3)
        assert np.max(closed_loop_poles(*side).real) < 0


def test_the_controller_is_real_at_exactly_the_listed_frequencies():
    frequencies = real_axis_frequencies()
    for omega in frequencies:
        assert abs(controller(1j * omega).imag) < 1e-9 * abs(controller(1j * omega))
    omega = np.geomspace(1e-4, 1e7, 200_001)
    imag = np.array([controller(1j * w).imag for w in omega[::20]])
    assert np.count_nonzero(np.diff(np.sign(imag))) == len(frequencies) == 2
