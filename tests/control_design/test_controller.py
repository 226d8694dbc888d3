"""The running controller against python-control, anti-windup against its limits, exact round trips."""

import io
import json
from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.io
import scipy.signal

import flexlink
from benchmarks import mimo_problems as problems
from benchmarks.mimo_designs import TS, tustin
from control_design import Controller
from control_design.controllers.controller import FrictionFeedforward

from .plants import notched

_DT = 0.01


def _pi(**fields) -> Controller:
    """PI controller u = (1 + 2/s) e by the trapezoidal rule."""
    one = np.ones((1, 1))
    return Controller(one, 2 * _DT * one, one, (1 + _DT) * one, _DT, **fields)


def _random(rng: np.random.Generator, n: int = 4, **fields) -> Controller:
    a = rng.standard_normal((n, n))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    return Controller(
        a, rng.standard_normal((n, 1)), rng.standard_normal((1, n)), np.full((1, 1), 0.3), _DT, **fields
    )


def test_stepper_is_the_linear_system_without_limits():
    rng = np.random.default_rng(1)
    controller = _random(rng)
    error = rng.standard_normal(300)
    expected = control.forced_response(controller.to_control(), inputs=error).outputs
    stepper = controller.stepper()
    np.testing.assert_allclose([stepper.step(e) for e in error], expected, rtol=0, atol=1e-11)
    stepper.reset()
    np.testing.assert_allclose([stepper.step(e) for e in error], expected, rtol=0, atol=1e-11)


def test_delay_in_response_and_state_space_agree():
    controller = _random(np.random.default_rng(2), computational_delay_samples=2)
    omega = np.geomspace(0.01, np.pi / _DT, 40)
    system = controller.to_control(include_delay=True)
    assert system.nstates == 6
    expected = np.asarray(control.frequency_response(system, omega).complex).ravel()
    np.testing.assert_allclose(controller.response(omega), expected, rtol=1e-9)


def test_limits_hold_and_the_integrator_does_not_wind_up():
    limit, rate = 1.0, 20.0
    controller = _pi(input_limit=limit, rate_limit=rate)
    stepper = controller.stepper()
    command = np.array([stepper.step(1.0) for _ in range(2000)])
    assert np.all(np.abs(command) <= limit)
    assert np.all(np.abs(np.diff(command, prepend=0.0)) <= rate * _DT * (1 + 1e-12))
    # Without anti-windup the state would stand at 2 * 20 s = 40 and take 20 s to unwind at error -1.
    after = np.array([stepper.step(-1.0) for _ in range(100)])
    assert np.argmax(after < 0) < 20
    assert after[-1] == -limit


def test_anti_windup_keeps_a_non_minimum_phase_controller_bounded():
    """Controller zero at z = 1.5: conditioning with M = B/D would have a pole there; ours must not."""
    controller = Controller([[0.9]], [[1.0]], [[-0.6]], [[1.0]], _DT, input_limit=0.1)
    zero = controller.to_control().zeros()
    assert abs(zero[0]) == pytest.approx(1.5)
    assert np.abs(controller.A - controller.anti_windup_gain @ controller.C).item() < 1
    stepper = controller.stepper()
    for _ in range(5000):
        stepper.step(1.0)
    # A state below 100 asks for less than 60, which at .9 a sample is back within the limit in 61 samples.
    after = [stepper.step(0.0) for _ in range(62)]
    assert abs(after[-1]) < 0.1


@pytest.mark.parametrize(("error", "command"), [(1.0, -1.0), (-1e-3, 0.5), (2.0, 4.0)])
def test_a_law_in_other_units_is_the_same_loop(error, command):
    """Errors and commands that it takes and gives are those of the law in quantities, over the factors."""
    given = FrictionFeedforward(0.04, 1e-3, 0.17, excess=0.02, fall=0.3)
    law = _random(np.random.default_rng(6), input_limit=0.5, rate_limit=20.0, feedforward=given)
    other = law.in_units(np.array([error]), np.array([command]))
    reference = np.cumsum(0.003 * np.random.default_rng(7).standard_normal(400))
    steppers, found = (law.stepper(), other.stepper()), np.empty((2, 400))
    for k, at in enumerate(reference):
        off = 20 * at * np.sin(k / 9)
        found[:, k] = steppers[0].step(off, at), command * steppers[1].step(off / error, at / error)
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-12)
    assert 10 < np.sum(np.abs(found[0]) == 0.5) < 390


def test_a_law_of_two_joints_in_other_units():
    rng, error, command = np.random.default_rng(8), np.array([2.0, -3.0]), np.array([-0.5, 4.0])
    law = Controller(
        0.8 * np.eye(3), rng.standard_normal((3, 2)), rng.standard_normal((2, 3)), np.eye(2), _DT,
        input_limit=(1.0, None), rate_limit=(None, 300.0),
    )  # fmt: skip
    other = law.in_units(error, command)
    assert (other.input_limit, other.rate_limit) == ((2.0, None), (None, 75.0))
    steppers = law.stepper(), other.stepper()
    for given in rng.standard_normal((50, 2)):
        wanted = steppers[0].step(given)
        np.testing.assert_allclose(command * steppers[1].step(given / error), wanted, atol=1e-12)


def from_mat(path) -> Controller:
    """A controller from its MATLAB file, in which no limit is inf."""
    found = scipy.io.loadmat(path, simplify_cells=True)
    found |= {name: None for name in ("input_limit", "rate_limit") if found[name] == np.inf}
    return Controller.from_dict({"format": Controller.format_name(), "feedforward": None, **found})


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("order", [0, 1])
def test_files_name_the_law_with_its_delay_and_without(order, delay, tmp_path):
    law = _pi() if order else Controller.proportional(2.0, _DT)
    law = replace(law, computational_delay_samples=delay)
    omega = np.array([0.1, 3.0, 0.9 * np.pi / _DT])
    (tmp_path / "k.mat").write_bytes(law.to_mat())
    mat = scipy.io.loadmat(tmp_path / "k.mat", simplify_cells=True)

    for document in (json.loads(law.to_json()), mat):
        for name, with_delay in (("K_with_delay", True), ("K_without_delay", False)):
            part = document[name]
            n = law.order + (delay if with_delay else 0)
            shapes = ((n, n), (n, 1), (1, n), (1, 1))
            matrices = [np.reshape(part[m], shape) for m, shape in zip("ABCD", shapes, strict=True)]
            found = control.ss(*matrices, part["dt_s"])(np.exp(1j * omega * _DT))
            np.testing.assert_allclose(found, law.response(omega, with_delay=with_delay), rtol=1e-9)

    names = [law.to_control(include_delay=both).name for both in (False, True)]
    assert names == (["K", "K"] if delay == 0 else ["K_without_delay", "K_with_delay"])


def test_a_file_from_before_the_names_is_read():
    document = json.loads(_pi().to_json())
    older = {name: value for name, value in document.items() if not name.startswith("K_")}
    assert older.keys() < document.keys()
    assert Controller.from_dict(older).to_dict() == document


def test_json_and_mat_round_trip_exactly(tmp_path):
    for controller in (
        _random(np.random.default_rng(3), input_limit=5.0, rate_limit=100.0, name="hub"),
        _pi(),
        Controller.proportional(2.0, _DT),
        Controller.proportional(2.0, _DT, feedforward=FrictionFeedforward(0.04, 1e-5, 0.17)),
        replace(_pi(), signals="error: y [rad]; command: u [V]"),
    ):
        text = controller.to_json()
        copies = [Controller.from_json(text)]
        (tmp_path / "k.mat").write_bytes(controller.to_mat())
        copies.append(from_mat(tmp_path / "k.mat"))
        assert json.loads(text)["law"].startswith("u = C x + D e")
        for copy in copies:
            for name in ("A", "B", "C", "D", "anti_windup_gain"):
                np.testing.assert_array_equal(getattr(copy, name), getattr(controller, name))
            for name in (
                "dt_s",
                "input_limit",
                "rate_limit",
                "computational_delay_samples",
                "name",
                "feedforward",
                "signals",
            ):
                assert getattr(copy, name) == getattr(controller, name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": "flexlink-controller-1", "feedforward": {"level": 1}}', "needs level, width, lag_s"),
        ("{", "line 1 column 2"),
        ("[]", "must be an object"),
        ("{}", "expected 'flexlink-controller-1'"),
        ('{"format": "flexlink-controller-1", "A": []}', "lacks the key 'B'"),
    ],
)
def test_files_that_are_no_controller_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Controller.from_json(text)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"dt_s": 0.0}, "dt_s must be positive"),
        ({"A": np.array([[np.nan]])}, "not finite"),
        ({"B": np.ones((2, 1))}, "needs A"),
        ({"input_limit": -1.0}, "input_limit must be positive"),
        ({"computational_delay_samples": -1}, "must not be negative"),
        ({"computational_delay_samples": 1.5}, "and whole; got 1.5"),
        ({"input_limit": 1.0, "anti_windup_gain": np.zeros((1, 1))}, "would wind up"),
        ({"input_limit": 1.0, "C": np.zeros((1, 1))}, "no anti-windup gain found for the limits"),
    ],
)
def test_controllers_that_cannot_run_are_refused(fields, message):
    one = np.ones((1, 1))
    with pytest.raises(ValueError, match=message):
        Controller(**({"A": one, "B": one, "C": one, "D": one, "dt_s": 0.01} | fields))


def test_a_controller_is_frozen():
    controller = _pi()
    with pytest.raises(ValueError, match="read-only"):
        controller.A[0, 0] = 2


_NOTCHES = ((), (5.0,), (5.0, 12.0), (20.0, 60.0), (50.0, 200.0), (50.0, 200.0, 500.0))


@pytest.mark.parametrize("dt_s", [5e-3, 2e-3, 1e-3, 2.5e-4])
def test_companion_forms_of_slow_controllers_are_taken(dt_s):
    """PI and notches: poles so close together that rounding moves them. A gain is sought for a limit only."""
    for corners in _NOTCHES:
        above, below = notched(dt_s * np.array(corners), dt_s)
        law = scipy.signal.tf2ss(above, below)
        assert not Controller(*law, dt_s).anti_windup_gain.any()
        if dt_s * min(corners, default=1e3) > 1e-3 * 5 ** len(corners):  # else A - M C is lost in rounding
            limited = Controller(*law, dt_s, input_limit=5.0)
            inner = limited.A - limited.anti_windup_gain @ limited.C
            assert np.max(np.abs(np.linalg.eigvals(inner))) < 1
        plant = control.c2d(control.tf([0.5], [0.1, 1]), dt_s)
        found = flexlink.certify(
            control.tf(above, below, dt_s), plant, flexlink.Specification(modulus_margin=0.3)
        )
        assert found.certified
        # Proved for all frequencies, which takes poles and zeros that agree with the state space to 1e-6.
        assert found.gamma_bound < 1.01 * found.gamma


@pytest.mark.parametrize("order", [2, 3])
def test_a_transfer_function_keeps_its_integrators(order):
    """Three integrators in a loop, of which rounding leaves a triangle about z = 1 in companion form."""
    dt_s = 1e-3
    k = control.tf(5 * np.poly([0.998] * order), np.poly([1.0] * order), dt_s)
    plant = control.c2d(control.tf([1], [0.1, 1]), dt_s)
    found = flexlink.certify(k, plant, flexlink.Specification(modulus_margin=0.3))
    assert found.certified
    assert found.plants[0].nyquist.required == order / 2
    assert np.sum(found.controller.poles == 1) == order
    omega = np.geomspace(10, 3000, 50)
    z = np.exp(1j * omega * dt_s)
    exact = 5 * ((z - 0.998) / (z - 1)) ** order
    np.testing.assert_allclose(found.controller.response(omega, with_delay=False), exact, rtol=1e-6)


def controller(**settings) -> Controller:
    return Controller(*tustin(*problems.order_six_t(), TS), TS, computational_delay_samples=0, **settings)


LIMITS = {"input_limit": (24.0, None), "rate_limit": (None, 50.0)}


def test_json_and_mat_keep_everything():
    given = controller(**LIMITS)
    again = Controller.from_json(given.to_json())
    for name in ("A", "B", "C", "D", "anti_windup_gain"):
        np.testing.assert_array_equal(getattr(again, name), getattr(given, name))
    assert (again.input_limit, again.rate_limit) == (given.input_limit, given.rate_limit)
    mat = scipy.io.loadmat(io.BytesIO(given.to_mat()))
    np.testing.assert_array_equal(mat["B"], given.B)
    np.testing.assert_array_equal(mat["input_limit"], [[24.0, np.inf]])
    assert given.to_control().ninputs == 2


@pytest.mark.parametrize("limit", [(24.0,), 24.0, (24.0, -1.0)])
def test_limits_that_do_not_fit_are_refused(limit):
    with pytest.raises(ValueError, match="input_limit"):
        controller(input_limit=limit)
