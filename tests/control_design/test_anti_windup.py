"""The anti-windup gain: one for every choice of states, and limited loops that end where they must."""

import ctypes
from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import flexlink
from control_design import Controller, UncertainPlant, c_source
from control_design.analysis.limited_loop import (
    LimitedLoop,
    limited_controller,
    limited_loop,
    limited_loops,
    with_safe_limits,
)
from control_design.controllers.anti_windup import anti_windup_gain
from tests.compiler import compiled, needs_compiler

_MOTOR = control.ss(control.c2d(control.ss(control.tf([1.0], [0.2, 1.0])), 1e-3, "zoh"))


def _product(*polynomials):
    found = np.ones(1)
    for polynomial in polynomials:
        found = np.polymul(found, polynomial)
    return found


def _companion(top, bottom, dt_s, method="zoh"):
    """A law in s, sampled, in companion form: the denominator's coefficients in the first row of A."""
    if method == "bilinear":
        above, below = scipy.signal.bilinear(top, bottom, 1 / dt_s)
    else:
        above, below, _ = scipy.signal.cont2discrete((top, bottom), dt_s, method)
        above = above.ravel()
        above[0] *= len(top) == len(bottom)  # else rounding
    return _companion_in_z(above, below)


def _companion_in_z(above, below):
    direct = above[0]
    a = np.eye(below.size - 1, k=-1)
    a[0] = -below[1:]
    return a, np.eye(below.size - 1, 1), (above[1:] - below[1:] * direct)[None], np.array([[direct]])


def _pi(gain=2.0, corner=5.0):
    return gain * np.array([1.0, corner]), np.array([1.0, 0.0])


def _rolled_off(order, corner=30.0):
    pairs = [[1 / corner**2, 1.4 / corner, 1.0]] * (order // 2)
    return _product(*pairs, *[[1 / corner, 1.0]] * (order % 2))


def _pi_rolled_off(order):
    top, bottom = _pi()
    return _companion(top, np.polymul(bottom, _rolled_off(order)), 1e-3)


def _pi_notch_rolled_off():
    top, bottom = _pi()
    notch = 100.0
    top = _product(top, [1 / notch**2, 0.1 / notch, 1.0])
    return _companion(
        top, _product(bottom, [1 / notch**2, 1.4 / notch, 1.0], _rolled_off(4, 150.0)), 1e-3, "bilinear"
    )


def _with_pole_at_zero():
    """PI through a sample of delay of its own: a pole at z = 0, D = 0."""
    a, b, c, d = _companion(*_pi(), 1e-3)
    return (
        scipy.linalg.block_diag(a, 0.0) + np.outer([0, 1], [*c[0], 0]),
        np.vstack([b, d]),
        [[0.0, 1.0]],
        [[0.0]],
    )


def _integrator_alone():
    """D = 0 and nothing but an integrator."""
    return [[1.0]], [[0.01]], [[1.0]], [[0.0]]


def _two_integrators():
    top, bottom = _pi(2.0, 1.0)
    return _companion(np.polymul(top, [1.0, 1.0]), _product(bottom, [1.0, 0.0], [1 / 60.0, 1.0]), 1e-3)


def _without_integrator():
    """A slow lag in place of the integrator, with a roll-off: asks for 10 times the error at rest."""
    return _companion(2 * np.array([1.0, 5.0]), np.polymul([1.0, 1.0], _rolled_off(3)), 1e-3)


def _trapezoidal_derivative():
    """PID with an unfiltered derivative by the trapezoidal rule: poles at z = 1 and at z = -1."""
    top = _product([1 / 8.0, 1.0], [1 / 8.0, 1.0])
    above, below = scipy.signal.bilinear(top, [1.0, 0.0], 1e3)
    return _companion_in_z(above, below)


LAWS = {
    "companion, roll-off 3": _pi_rolled_off(3),
    "companion, notch, roll-off 4": _pi_notch_rolled_off(),
    "pole at z = 0": _with_pole_at_zero(),
    "integrator alone": _integrator_alone(),
    "two integrators": _two_integrators(),
    "no integrator": _without_integrator(),
}


def _law(name, **settings):
    parts = (np.asarray(part, dtype=float) for part in LAWS[name])
    return Controller(*parts, 1e-3, **{"input_limit": 1.0, "computational_delay_samples": 0} | settings)


def _in_other_states(law, seed):
    """The same law in random states; the gain is sought anew."""
    turn = np.random.default_rng(seed).standard_normal((law.order, law.order)) + 2 * np.eye(law.order)
    back = np.linalg.inv(turn)
    return replace(law, A=turn @ law.A @ back, B=turn @ law.B, C=law.C @ back, anti_windup_gain=None), turn


def _commands(law, errors):
    stepper = law.stepper()
    return np.array([stepper.step(error) for error in errors])


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("rate_limit", [None, 20.0])
def test_a_limited_law_does_the_same_in_any_states(name, rate_limit):
    law = _law(name, rate_limit=rate_limit)
    other, turn = _in_other_states(law, 3)
    # The gain is that of the law in its new states, as far as rounding of A allows.
    size = np.max(np.abs(turn @ law.anti_windup_gain)) or 1.0
    np.testing.assert_allclose(other.anti_windup_gain, turn @ law.anti_windup_gain, rtol=0, atol=1e-5 * size)
    errors = 3 * np.sin(np.arange(1500) / 70) + 0.5
    expected = _commands(law, errors)
    assert np.mean(np.abs(expected) == 1.0) > 0.2 or rate_limit
    np.testing.assert_allclose(_commands(other, errors), expected, rtol=0, atol=1e-5)


def test_the_gain_has_the_units_of_the_command():
    a, b, c, d = (np.asarray(part) for part in LAWS["companion, roll-off 3"])
    gain = anti_windup_gain(a, b, c, d)
    np.testing.assert_allclose(anti_windup_gain(a, 1e3 * b, c, 1e3 * d), gain, rtol=1e-6)
    np.testing.assert_allclose(anti_windup_gain(a, b, 1e3 * c, 1e3 * d), 1e-3 * gain, rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in LAWS if name != "two integrators"])
def test_the_correction_is_a_positive_real_spectral_factor(name):
    """|V|^2 (1 + |K|^2/k0^2) is one number at all frequencies, Re V >= 0 and |V| <= 2."""
    a, b, c, d = (np.asarray(part, dtype=float) for part in LAWS[name])
    gain = anti_windup_gain(a, b, c, d)
    z = np.exp(1j * np.geomspace(1e-4, 3.0, 60))
    enters = np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, np.hstack([gain, b])[None])
    through = (np.asarray(c) @ enters)[:, 0]
    correction = 1 / (1 + through[:, 0])
    response = through[:, 1] + d[0, 0]
    # 1/|V|^2 = (1 + |K|^2/k0^2)/c is a straight line in |K|^2.
    design = np.column_stack([np.ones(z.size), np.abs(response) ** 2])
    weight = np.abs(correction)[:, None] ** 2
    line = np.linalg.lstsq(weight * design, np.ones(z.size), rcond=None)[0]
    np.testing.assert_allclose((weight * design) @ line, 1.0, rtol=1e-5)
    assert np.all(line > 0)
    assert np.all(correction.real > -1e-6 * np.abs(correction))
    assert np.max(np.abs(correction)) < 2.02


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("error", [0.3, 30.0, pytest.param(3.0, marks=pytest.mark.long)])
def test_a_constant_error_holds_the_limit(name, error):
    command = _commands(_law(name), np.full(6000, error))
    assert np.all(command >= 0)
    np.testing.assert_array_equal(command[-1000:], 1.0)


def test_a_law_without_integrator_ends_at_what_it_asks():
    command = _commands(_law("no integrator"), np.full(9000, 0.05))
    assert command[-1] == pytest.approx(0.5, abs=1e-3)  # K(1) = 10


def test_a_step_beyond_the_limit_ends_where_clipping_alone_does():
    law = _law("companion, roll-off 3", computational_delay_samples=1)
    clipped = replace(law, input_limit=None)
    for reference in (0.8, 0.95):
        run = flexlink.simulate_loop(law, _MOTOR, np.full(6000, reference))
        other = flexlink.simulate_loop(clipped, _MOTOR, np.full(6000, reference), clip=1.0)
        assert run.limited.any()
        assert run.measured[-1] == pytest.approx(other.measured[-1], abs=1e-3)
    run = flexlink.simulate_loop(law, _MOTOR, np.full(6000, 1.5))  # more than the motor reaches
    assert run.measured[-1] == pytest.approx(1.0, abs=1e-6)
    assert np.all(run.command[-1000:] == 1.0)


@needs_compiler
@pytest.mark.parametrize("name", LAWS)
def test_the_exported_code_is_what_is_simulated(name, tmp_path):
    law = _law(name, rate_limit=50.0)
    library = compiled(c_source(law, "law"), tmp_path)
    library.law_step.restype = ctypes.c_double
    state = ctypes.create_string_buffer(4096)
    library.law_reset(state)
    machine = control.ss([[0.0]], [[0.0]], [[1.0]], [[0.0]], law.dt_s)  # its output stays at zero
    reference = np.where(np.arange(4000) < 2000, 2.0, -0.7)
    simulated = flexlink.simulate_loop(law, machine, reference)
    code = [library.law_step(state, ctypes.c_double(error)) for error in reference]
    np.testing.assert_allclose(code, simulated.command, rtol=0, atol=1e-8)


def _old_gain(law):
    """What places A - M C near deadbeat in the law's own states."""
    noise = law.B @ law.B.T + 1e-6 * float(np.linalg.norm(law.B)) ** 2 * np.eye(law.order)
    output = law.D @ law.D.T + 1e-9 * float(np.trace(law.C @ noise @ law.C.T)) * np.eye(1)
    p = scipy.linalg.solve_discrete_are(law.A.T, law.C.T, noise, output)
    return law.A @ p @ law.C.T / (law.C @ p @ law.C.T + output)


def test_a_gain_that_hunts_is_found_out():
    law = _law("companion, roll-off 3", computational_delay_samples=1)
    hunting = replace(law, anti_windup_gain=_old_gain(law))
    assert np.max(np.abs(np.linalg.eigvals(law.A - hunting.anti_windup_gain @ law.C))) < 1
    plant = UncertainPlant(_MOTOR, name="motor")
    specification = flexlink.Specification(modulus_margin=0.2, controller_order=4)
    found = flexlink.certify(hunting, plant, specification)
    assert not found.certified
    missed = [item for item in found.items if not item.met]
    assert {item.plant for item in missed} == {"controller", "motor"}
    assert all("limited" in item.requirement for item in missed)
    assert all(item.achieved > 0.5 for item in missed)
    # A design takes another gain instead of handing that one on.
    mended = with_safe_limits(hunting, lambda tried: limited_loops(tried, [plant]))
    assert flexlink.certify(mended, plant, specification).certified
    assert flexlink.certify(law, plant, specification).certified


def test_a_certificate_without_limits_says_nothing_of_them():
    law = replace(_law("companion, roll-off 3"), input_limit=None, anti_windup_gain=None)
    specification = flexlink.Specification(
        modulus_margin=0.2, controller_order=4, computational_delay_samples=0
    )
    found = flexlink.certify(law, UncertainPlant(_MOTOR, name="motor"), specification)
    assert found.limited == ()
    assert not any("limited" in item.requirement for item in found.items)


def test_what_cannot_be_said_is_not_said():
    law = Controller.proportional(5.0, 1e-3, input_limit=1.0, computational_delay_samples=0)
    falling = control.ss([[1.001]], [[1e-3]], [[1.0]], 0, 1e-3)
    loop = limited_loop(law, UncertainPlant(falling, name="inverted"))
    assert loop.obstacle.name == "PLANT_UNSTABLE"
    assert loop.steps == ()
    assert loop.ends
    unstable = replace(law, D=-law.D)
    assert limited_loop(unstable, UncertainPlant(_MOTOR, name="motor")).obstacle.name == "LOOP_UNSTABLE"
    differentiator = Controller([[0.9]], [[1.0]], [[-0.1]], [[1.0]], 1e-3, input_limit=1.0)
    assert limited_controller(differentiator).obstacle.name == "ENDS_UNKNOWN"


def test_only_a_rate_limit_is_looked_at_too():
    law = _law("companion, roll-off 3", input_limit=None, rate_limit=5.0)
    alone, loop = limited_loops(law, [UncertainPlant(_MOTOR, name="motor")])
    assert len(alone.steps) == 3
    assert len(loop.steps) == 1
    assert alone.ends
    assert loop.ends
    stuck = replace(law, rate_limit=1e-3, anti_windup_gain=_old_gain(law))
    assert isinstance(limited_controller(stuck), LimitedLoop)


def test_a_stored_controller_may_leave_its_gain_open():
    law = _law("companion, notch, roll-off 4")
    document = law.to_dict() | {"anti_windup_gain": None}
    np.testing.assert_allclose(
        Controller.from_dict(document).anti_windup_gain, law.anti_windup_gain, rtol=0, atol=1e-12
    )
    # One that an earlier version stored keeps its own.
    old = law.to_dict() | {"anti_windup_gain": (0.5 * law.anti_windup_gain).tolist()}
    np.testing.assert_array_equal(Controller.from_dict(old).anti_windup_gain, 0.5 * law.anti_windup_gain)


def test_only_limited_commands_are_corrected():
    """Two PI beside each other, one with a limit: its integrator alone is corrected, and holds."""
    one = np.eye(2)
    law = Controller(one, 0.01 * one, one, one, 1e-3, input_limit=(1.0, None))
    assert law.anti_windup_gain[0, 0] > 0
    commands = _commands(law, np.full((3000, 2), 0.5))
    np.testing.assert_array_equal(commands[-500:, 0], 1.0)
    assert commands[-1, 1] == pytest.approx(0.5 + 0.005 * 2999, rel=1e-9)


def test_units_of_several_commands_do_not_matter():
    rng = np.random.default_rng(5)
    a = scipy.linalg.block_diag(1.0, 1.0, 0.8 * np.eye(2)) + 0.05 * np.triu(rng.standard_normal((4, 4)), 2)
    b = 0.1 * rng.standard_normal((4, 2))
    c = rng.standard_normal((2, 4))
    d = rng.standard_normal((2, 2))
    size = np.diag([1e3, 1e-2])
    gain = anti_windup_gain(a, b, c, d)
    scaled = anti_windup_gain(a, b @ size, size @ c, size @ d @ size)
    np.testing.assert_allclose(scaled @ size, gain, rtol=0, atol=1e-5 * np.max(np.abs(gain)))
    assert np.max(np.abs(np.linalg.eigvals(a - gain @ c))) < 1


def test_a_pole_at_minus_one_is_corrected_too():
    law = Controller(*_trapezoidal_derivative(), 1e-3, input_limit=1.0, computational_delay_samples=0)
    assert np.min(np.abs(law.poles + 1)) < 1e-9
    assert np.max(np.abs(np.linalg.eigvals(law.A - law.anti_windup_gain @ law.C))) < 1
    np.testing.assert_array_equal(_commands(law, np.full(6000, 0.3))[-1000:], 1.0)
