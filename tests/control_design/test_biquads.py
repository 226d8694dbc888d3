"""Cascades against scipy's bilinear transform and python-control; the symbolic programme against numpy."""

import control
import numpy as np
import pytest
from scipy.signal import bilinear

from control_design.controllers.biquads import Cascade, tustin_frequency
from control_design.controllers.parts import LowPassPart, NotchPart, PidPart
from control_design.synthesis.rows import row_functions

_SECTIONS = [
    ("second_order",),
    ("first_order", "second_order"),
    ("integrator", "first_order", "second_order"),
    *(
        (PidPart(structure, None, None, None, None, 0.035), NotchPart(None, None, None, None, 0.035))
        for structure in ("p", "pi", "pd", "pid")
    ),
    (
        PidPart("pid", 2.0, 3.0, 0.2, None, 0.035),
        LowPassPart(1, 5.0, None, 0.035),
        LowPassPart(2, None, None, 0.035),
        NotchPart(2.0, 0.4, None, 3.0, 0.035),
        NotchPart(None, None, 0.1, None, 0.035),
    ),
]


@pytest.mark.parametrize("sections", _SECTIONS)
def test_cascade_is_the_bilinear_transform_of_its_sections(sections):
    rng = np.random.default_rng(5)
    dt, scale = 0.01, 7.0
    cascade = Cascade(sections, dt, scale)
    x = rng.standard_normal(cascade.parameters)
    z = np.exp(1j * np.array([0.05, 1.0, 30.0, 200.0]) * dt)
    expected = np.ones(z.size, complex)
    for numerator, denominator in cascade.split(x):
        powers = scale ** -np.arange(denominator.size - 1, -1.0, -1)
        b, a = bilinear(numerator * powers, denominator * powers, fs=1 / dt)
        expected = expected * np.polyval(b, z) / np.polyval(a, z)
    omega = np.angle(z) / dt
    np.testing.assert_allclose(cascade.response(x, omega), expected, rtol=1e-8)
    system = control.ss(*cascade.state_space(x), cascade.dt_s)
    assert system.nstates == cascade.order
    np.testing.assert_allclose(control.evalfr(system, z[1]), expected[1], rtol=1e-8)
    radius = np.abs(system.poles())
    assert np.all(radius <= 1)
    pids = [section for section in sections if isinstance(section, PidPart)]
    integrators = sections.count("integrator") + sum(pid.has_integral for pid in pids)
    assert np.sum(radius == 1) == integrators


def test_response_at_nyquist_is_the_limit():
    cascade = Cascade(("first_order", "second_order"), 0.005, 10.0)
    x = np.random.default_rng(6).standard_normal(cascade.parameters)
    a, b, c, d = cascade.state_space(x)
    at_minus_one = (c @ np.linalg.solve(-np.eye(3) - a, b) + d).item()
    np.testing.assert_allclose(cascade.response(x, np.array([np.pi / 0.005])), at_minus_one, rtol=1e-9)


@pytest.mark.parametrize("sections", _SECTIONS)
def test_symbolic_and_numeric_response_agree(sections):
    cascade = Cascade(sections, 0.01, 7.0)
    omega = np.array([1e-4, 0.3, 6.0, 8.0, 250.0, np.pi / 0.01])
    value = np.random.default_rng(7).standard_normal(cascade.parameters)
    v = tustin_frequency(omega, cascade.dt_s) / cascade.scale_rad_s
    p = np.stack([v, np.ones(v.size)]) / np.maximum(v, 1.0)
    real, imag = (np.asarray(part)[0] for part in row_functions(sections)[0].map(v.size)(value, p))
    np.testing.assert_allclose(real + 1j * imag, cascade.response(value, omega), rtol=1e-9)
