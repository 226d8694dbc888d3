"""The generated C, compiled by the machine's compiler, against the Python controller."""

from __future__ import annotations

import ctypes
import subprocess

import numpy as np
import pytest
import scipy.linalg

from control_design import Controller
from control_design.controllers.c_code import c_header, c_source
from control_design.controllers.controller import FrictionFeedforward
from tests.compiler import COMPILER, compiled, needs_compiler

_DT = 0.005


def _controller(order: int, **fields) -> Controller:
    rng = np.random.default_rng(order)
    a = rng.standard_normal((order, order))
    if order:
        a *= 0.95 / np.max(np.abs(np.linalg.eigvals(a)))
    b, c = 0.3 * rng.standard_normal((order, 1)), rng.standard_normal((1, order))
    return Controller(a, b, c, np.full((1, 1), 2.0), _DT, **fields)


def _compiled(controller: Controller, folder, number: str = "double"):
    """(step, reset) of the compiled controller, with its state inside."""
    code = compiled(c_source(controller, "arm", number), folder)
    real = ctypes.c_double if number == "double" else ctypes.c_float
    code.arm_step.restype = real
    code.arm_step.argtypes = [ctypes.c_void_p, real] + [real] * (controller.feedforward is not None)
    state = ctypes.create_string_buffer(8 * (controller.order + 6))
    return lambda *error: code.arm_step(state, *error), lambda: code.arm_reset(
        ctypes.c_void_p(ctypes.addressof(state))
    )


def _closed_loop(step, n_samples: int = 2000):
    """Commands of a step reference on a lightly damped mode, delayed by one sample; outside of both codes."""
    w, zeta = 15.0, 0.02
    matrix = scipy.linalg.expm(np.array([[0, 1, 0], [-(w**2), -2 * zeta * w, w**2], [0, 0, 0]]) * _DT)
    x, previous, commands = np.zeros(2), 0.0, []
    for k in range(n_samples):
        reference = 1.0 if k < n_samples // 2 else -0.5
        command = step(0.4 * (reference - x[0]))
        x = matrix[:2, :2] @ x + matrix[:2, 2] * previous
        previous = command
        commands.append(command)
    return np.array(commands)


@needs_compiler
@pytest.mark.parametrize("order", [0, 1, 4, 9])
@pytest.mark.parametrize("limits", [{}, {"input_limit": 0.5}, {"input_limit": 0.5, "rate_limit": 15.0}])
def test_a_closed_loop_run_with_saturation_agrees_to_1e_12(tmp_path, order, limits):
    controller = _controller(order, **limits)
    step, reset = _compiled(controller, tmp_path)
    reset()
    ours = controller.stepper()
    expected = _closed_loop(ours.step)
    found = _closed_loop(step)
    if limits:
        assert np.sum(np.abs(expected) == 0.5) > 20, "the run must saturate to mean anything"
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    reset()
    np.testing.assert_array_equal(_closed_loop(step), found)


@needs_compiler
@pytest.mark.parametrize("excess", [0.0, 0.02])
def test_friction_feedforward_agrees_to_1e_12_and_ends_with_the_reference(tmp_path, excess):
    """A move, a rest and a move back: friction of either sign at the reference's speed, and none at rest."""
    given = FrictionFeedforward(0.04, 1e-5, 0.1, excess=excess, fall=0.3)
    controller = _controller(3, input_limit=0.5, feedforward=given)
    step, reset = _compiled(controller, tmp_path)
    reset()
    ours = controller.stepper()
    reference = 0.3 * np.concatenate(
        [np.linspace(0, 1, 200), np.ones(600), np.linspace(1, 0, 200), np.zeros(600)]
    )
    error = 0.1 * np.random.default_rng(4).standard_normal(reference.size)
    expected, found = (
        np.array([law(e, r) for e, r in zip(error, reference, strict=True)]) for law in (ours.step, step)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    assert np.sum(np.abs(expected) == 0.5) > 20, "the run must saturate to mean anything"
    signal = given.signal(reference, _DT)
    friction = 0.04 + excess * np.exp(-0.3 / 199 / _DT / 0.3)
    np.testing.assert_allclose(signal[[199, 999]], [friction, -friction], rtol=1e-4)
    assert max(abs(signal[790]), abs(signal[-1])) < 1e-6 * given.level


@needs_compiler
def test_single_precision_agrees_to_its_own_rounding(tmp_path):
    controller = _controller(4, input_limit=0.5)
    step, reset = _compiled(controller, tmp_path, "float")
    reset()
    difference = _closed_loop(step) - _closed_loop(controller.stepper().step)
    assert 0 < np.max(np.abs(difference)) < 1e-3


@needs_compiler
@pytest.mark.parametrize("number", ["double", "float"])
@pytest.mark.parametrize("limits", [{}, {"input_limit": 0.5}, {"rate_limit": 15.0}])
def test_limits_and_anti_windup_are_there_where_they_are_given(tmp_path, number, limits):
    controller = _controller(3, **limits)
    text = c_source(controller, "arm", number)
    for words in (" M[3]", "int limited", "M[i] * (command - wanted)"):
        assert (words in text) == bool(limits)
    assert ("INPUT_LIMIT" in text) == ("input_limit" in limits)
    assert ("state->last" in text) == ("LARGEST_CHANGE" in text) == ("rate_limit" in limits)
    assert ("double" in text) == (number == "double")
    step, reset = _compiled(controller, tmp_path, number)
    reset()
    expected = _closed_loop(controller.stepper().step)
    # Rounding of 24 bits, which the loop carries on for a few hundred samples.
    tolerance = (1e-12 if number == "double" else 1e-3) * np.max(np.abs(expected))
    np.testing.assert_allclose(_closed_loop(step), expected, rtol=0, atol=tolerance)


def test_a_type_that_is_none_of_c_is_refused():
    with pytest.raises(ValueError, match="'double' or 'float'; got 'int16_t'"):
        c_source(_controller(1), number="int16_t")


@needs_compiler
def test_header_and_source_belong_together(tmp_path):
    controller = _controller(2, name="a */ tricky name \n", signals="error: y */ [°]; command: u [V]")
    (tmp_path / "arm.h").write_text(c_header(controller, "arm"))
    assert "   error: y ? [?]; command: u [V].\n" in c_header(controller, "arm")
    (tmp_path / "main.c").write_text(
        '#include "arm.h"\nint main(void) { arm_state s; arm_reset(&s); return arm_step(&s, 0.0) != 0.0; }\n'
    )
    (tmp_path / "arm.c").write_text('#include "arm.h"\n' + c_source(controller, "arm"))
    program = tmp_path / "program"
    files = [str(tmp_path / "main.c"), str(tmp_path / "arm.c")]
    subprocess.run(
        [COMPILER, "-std=c99", "-Werror", *files, "-o", str(program)], check=True, capture_output=True
    )
    assert subprocess.run([str(program)], check=False).returncode == 0


@pytest.mark.parametrize("prefix", ["", "2fast", "a-b", "a b"])
def test_a_prefix_that_is_no_identifier_is_refused(prefix):
    with pytest.raises(ValueError, match="C identifier"):
        c_source(_controller(1), prefix)
