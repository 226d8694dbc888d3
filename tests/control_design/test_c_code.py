"""The generated C, compiled by the machine's compiler, against the Python controller over every option."""

import ctypes
import ctypes.util
import math
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.signal

from control_design import Controller
from control_design.controllers.c_code import Dialect, c_header, c_source, law_in
from control_design.controllers.controller import FrictionFeedforward
from control_design.convex.reference_filter import ReferenceFilter
from tests.compiler import COMPILER, compiled, needs_compiler
from workflow.tasks.exports import law_bytes

from .plants import notched

_SAMPLES = 160
_NAMES = (*"ABCDM", "LEVEL", "TURN", "SHARE", "EXCESS", "FALL", "INPUT_LIMIT", "LARGEST_CHANGE")


def _companion(corners, dt):
    return scipy.signal.tf2ss(*notched(corners, dt))


def _system(rng, inputs, outputs, dt):
    """Random, with slow poles and an integrator, or in companion form."""
    kind = rng.choice(["random", "slow", "companion"])
    if kind == "companion" and inputs == outputs == 1:
        return _companion(rng.uniform(0.03, 0.6, rng.integers(0, 3)), dt)
    n = int(rng.integers(0, 7))
    a = rng.standard_normal((n, n))
    if n and kind == "random":
        a *= rng.uniform(0.3, 0.99) / np.max(np.abs(np.linalg.eigvals(a)))
    elif n:
        a = 0.1 * np.triu(a, 1) + np.diag(1.0 - np.arange(n) * rng.choice([1e-3, 1e-2, 0.1]))
    b, c = 0.3 * rng.standard_normal((n, inputs)), rng.standard_normal((outputs, n))
    return a, b, c, rng.standard_normal((outputs, inputs)) * rng.integers(0, 2)


def _drawn(rng):
    """A controller with options at random, errors (T, Y) that bring it to its limits, references (T,)."""
    shape, dt = ((1, 1) if rng.random() < 0.7 else rng.integers(1, 4, 2)), 10 ** rng.uniform(-3.6, -2)
    errors = np.cumsum(rng.standard_normal((_SAMPLES, shape[0])), axis=0) / 9 + rng.standard_normal(shape[0])
    reference = np.cumsum(rng.choice([0.0, 1.0], _SAMPLES) * 0.03 * rng.standard_normal(_SAMPLES))
    number = rng.choice([float, np.float64])  # as they are, or of numpy
    plain = Controller(*_system(rng, *shape, dt), dt)
    options, stepper = {}, plain.stepper()
    command = np.array([stepper.step(e) for e in errors])
    for name, signal in (("input_limit", command), ("rate_limit", np.diff(command, axis=0) / dt)):
        most = np.quantile(np.abs(signal), 0.7, axis=0) + 1e-6 * np.max(np.abs(signal)) + 1e-3
        if rng.random() < 0.5:
            several = tuple(None if rng.random() < 0.3 else number(one) for one in most)
            options[name] = number(most[0]) if plain.D.size == 1 else several
    if plain.D.size == 1 and rng.random() < 0.6:
        excess, sign = number(rng.choice([0.0, rng.uniform(0.1, 2)])), rng.choice([-1, 1])
        size = np.quantile(np.abs(command), 0.5) + 0.1
        moved = 0.03 * rng.uniform(0.3, 2)
        options["feedforward"] = FrictionFeedforward(
            number(sign * size), moved, dt * rng.uniform(1, 30), sign * excess, fall=number(moved / dt)
        )
    try:
        law = Controller(plain.A, plain.B, plain.C, plain.D, number(dt), **options)
    except ValueError:  # what the command does not show winds up: the draw is one without limits
        law = plain
    held = np.isfinite([law.limits("input_limit"), law.limits("rate_limit")]).any(axis=0)
    if law.order and np.max(np.abs(np.linalg.eigvals(law.A - law.anti_windup_gain * held @ law.C))) > 1:
        law = plain  # runs away while the commands that have limits are at them: rounding would grow with it
    if law is not plain and law.order and rng.random() < 0.3:
        law = replace(law, anti_windup_gain=0.999 * law.anti_windup_gain)
    units = [np.exp(rng.uniform(-2, 2, n)) * rng.choice([-1, 1], n) for n in law.D.shape[::-1]]
    if rng.random() < 0.5:
        law, errors, reference = law.in_units(*units), errors / units[0], reference / units[0][0]
    if rng.random() < 0.2:
        errors[-4, 0] = rng.choice([np.inf, -np.inf, np.nan])
    return law, errors, reference


class _Running:
    """The documented law in arithmetic of one precision, in the order of the code."""

    def __init__(self, law, kind):
        self.law, self.kind, given = law, kind, law.feedforward
        self.a, self.b, self.c, self.d, self.m = (
            np.asarray(part, kind) for part in (law.A, law.B, law.C, law.D, law.anti_windup_gain)
        )
        self.limit, self.change = (
            np.minimum(law.limits(name) * factor, 3e38).astype(kind)
            for name, factor in (("input_limit", 1.0), ("rate_limit", law.dt_s))
        )
        self.limited = [any(law.limits(name) < np.inf) for name in ("rate_limit", "input_limit")]
        self.x, self.last = np.zeros(law.order, kind), np.zeros(law.D.shape[0], kind)
        self.before, self.smoothed = kind(0), kind(0)
        if given is not None:
            own = (
                given.level,
                given.turn(law.dt_s),
                given.share(law.dt_s),
                given.excess,
                given.fall * law.dt_s,
            )
            self.friction = [kind(value) for value in own]

    def step(self, error, reference):
        error, kind = error.astype(self.kind), self.kind
        wanted = np.zeros(self.last.size, kind)
        for column, x in zip(self.c.T, self.x, strict=True):
            wanted = wanted + column * x
        for column, e in zip(self.d.T, error, strict=True):
            wanted = wanted + (column * e + (e - e))
        if self.law.feedforward is not None:
            level, turn, share, excess, fall = self.friction
            moved = kind(reference) - self.before
            strength = level + excess * _exp(kind)(-abs(moved) / fall) if excess else level
            friction = strength * min(max(moved / turn, kind(-1)), kind(1))
            self.smoothed = self.smoothed + share * (friction - self.smoothed)
            self.before, wanted = kind(reference), wanted + self.smoothed
        command = wanted
        bounds = [(self.last - self.change, self.last + self.change)] * self.limited[0]
        for low, high in bounds + [(-self.limit, self.limit)] * self.limited[1]:
            command = np.where(command > high, high, np.where(command < low, low, command))
        parts = [(self.a, self.x), (self.b, error)] + [(self.m, command - wanted)] * any(self.limited)
        x = np.zeros(self.x.size, kind)
        for matrix, values in parts:
            for column, value in zip(matrix.T, values, strict=True):
                x = x + (column * value + (value - value) if matrix is self.b else column * value)
        self.x, self.last = x, command
        return command


@cache
def _exp(kind):
    """As the C library has it."""
    if kind is not np.float32:
        return np.exp if kind is np.longdouble else math.exp
    found = ctypes.CDLL(ctypes.util.find_library("m")).expf
    found.restype, found.argtypes = ctypes.c_float, [ctypes.c_float]
    return lambda value: np.float32(found(value))


def _in_one_file(sources):
    """Pieces of code in one translation unit, each with constants of its own."""
    lines = ["#include <math.h>"]
    for prefix, source in sources.items():
        lines += [f"#define {name} {prefix}_{name}" for name in _NAMES]
        lines += [source] + [f"#undef {name}" for name in _NAMES]
    return "\n".join(lines)


def _run_code(code, prefix, law, number, errors, reference):
    """Commands (T, U) of the compiled code, and whether a limit was active: one bit of each command, (T,)."""
    kind, real = (np.float64, ctypes.c_double) if number == "double" else (np.float32, ctypes.c_float)
    one, rubs = law.D.size == 1, law.feedforward is not None
    step, state = code[f"{prefix}_step"], ctypes.create_string_buffer(8 * (law.order + law.D.shape[0] + 6))
    step.restype = real if one else None
    step.argtypes = [ctypes.c_void_p] + ([real] * (1 + rubs) if one else [ctypes.c_void_p] * 2)
    code[f"{prefix}_reset"].argtypes = [ctypes.c_void_p]
    code[f"{prefix}_reset"](state)
    commands, flags = np.empty((len(errors), law.D.shape[0]), kind), np.zeros(len(errors), int)
    rate, limited = law.rate_limit is not None, law.input_limit is not None or law.rate_limit is not None
    at = np.dtype(kind).itemsize * (max(law.order, 1) + rate * law.D.shape[0] + 2 * rubs)
    for k, error in enumerate(errors.astype(kind)):
        if one:
            commands[k, 0] = step(state, error[0], *[reference[k]] * rubs)
        else:
            step(state, error.ctypes.data, commands[k].ctypes.data)
        if limited:
            flags[k] = ctypes.c_int.from_buffer(state, at).value
    return commands, flags


def _run(stepper, errors, reference):
    with np.errstate(all="ignore"):
        return np.array([np.atleast_1d(stepper.step(e, r)) for e, r in zip(errors, reference, strict=True)])


class _Stepper:
    """The product's own, with the same bits."""

    def __init__(self, law):
        self.own, self.flags = law.stepper(), []

    def step(self, error, reference):
        command = self.own.step(error, reference)
        self.flags.append(self.own.limited @ (1 << np.arange(command.size)))
        return command


@needs_compiler
@pytest.mark.parametrize("count", [12, pytest.param(500, marks=pytest.mark.long)])
def test_the_code_of_any_controller_is_its_stepper(tmp_path, count):
    """In either precision to the last bit what the law is in that arithmetic; in `double` the stepper, to a
    few times what the stepper's own rounding is, measured by more digits."""
    drawn = [_drawn(np.random.default_rng([count, k])) for k in range(count)]
    sources, refused = {}, 0
    for k, (law, *_) in enumerate(drawn):
        sources[f"d{k}"] = c_source(law, f"d{k}")
        try:
            sources[f"f{k}"] = c_source(law, f"f{k}", "float")
        except ValueError:
            refused += 1
    assert refused <= 0.1 * count
    code, limited = compiled(_in_one_file(sources), tmp_path), 0
    for k, (law, errors, reference) in enumerate(drawn):
        found, flags = _run_code(code, f"d{k}", law, "double", errors, reference)
        np.testing.assert_array_equal(found, _run(_Running(law, np.float64), errors, reference), str(k))
        stepper = _run(running := _Stepper(law), errors, reference)
        exact = _run(_Running(law, np.longdouble), errors, reference)
        finite = np.isfinite(exact)
        np.testing.assert_array_equal(np.isnan(stepper), ~finite)
        assert np.all(finite) == np.all(np.isfinite(errors))
        largest, own = np.max(np.abs(exact[finite])), np.max(np.abs(stepper - exact)[finite])
        assert own <= 1e-6 * largest
        assert np.max(np.abs(found - stepper)[finite]) <= 30 * own + 1e-12 * largest
        if law.input_limit is not None or law.rate_limit is not None:  # two that are next to it may differ
            assert np.sum(flags != running.flags) <= 2
        limited += np.sum(flags > 0)
        if f"f{k}" in sources:
            rounded = law_in("float", law)
            single, _ = _run_code(code, f"f{k}", law, "float", errors, reference)
            documented = _run(_Running(rounded, np.float32), errors, reference)
            np.testing.assert_array_equal(single, documented, str(k))
    assert limited > 10 * count, "the runs must saturate to mean anything"


@pytest.mark.parametrize("limits", [{}, {"input_limit": 0.5}, {"rate_limit": 15.0}])
def test_limits_and_anti_windup_are_there_where_they_are_given(limits):
    text = c_source(Controller([[0.9]], [[1.0]], [[1.0]], [[2.0]], 0.005, **limits), "arm")
    for words in (" M[1]", "int limited", "M[i] * (command - wanted)"):
        assert (words in text) == bool(limits)
    assert ("INPUT_LIMIT" in text) == ("input_limit" in limits)
    assert ("state->last" in text) == ("LARGEST_CHANGE" in text) == ("rate_limit" in limits)


@pytest.mark.parametrize("corners", [[0.01], [0.005, 0.012], [0.02, 0.06], [0.05, 0.2]])
def test_single_precision_has_slow_notches_in_sections(corners):
    """Companion forms, whose poles leave the circle once rounded: the code has those of the law."""
    law = Controller(*_companion(corners, 1e-3), 1e-3)
    written = law_in("float", law)
    a, b, c, d = (getattr(written, name).astype(np.float32).astype(float) for name in "ABCD")
    rounded = Controller(a, b, c, d, 1e-3)
    assert written is not law
    assert np.max(np.abs(rounded.poles)) <= max(1.0, np.max(np.abs(law.poles))) + 2e-7
    omega = np.geomspace(1, 3000, 50)
    np.testing.assert_allclose(rounded.response(omega), law.response(omega), rtol=0.011)


_P = Controller.proportional(1.0, 0.01)
_CLOSE = Controller(*_companion([1e-3, 3e-3, 5e-3], 1e-4), 1e-4)
_HUGE = Controller([[0.5]], [[1e-30]], [[1e45]], [[0.0]], 0.01)


@pytest.mark.parametrize(
    ("law", "options", "message"),
    [
        (_P, {"number": "int16_t"}, "'double' or 'float'; got 'int16_t'"),
        *((_P, {"prefix": prefix}, "C identifier") for prefix in ("", "2fast", "a-b", "a b")),
        (_CLOSE, {"number": "float"}, "use number = 'double'"),
        (_HUGE, {"number": "float"}, "use number = 'double'"),
        (replace(_P, input_limit=1e-50), {"number": "float"}, "input_limit = 1e-50 does not fit"),
        (Controller.proportional(1e40, 0.01), {"number": "float"}, r"1e\+40 .*double"),
    ],
)
def test_code_that_would_not_be_the_law_is_refused(law, options, message):
    with pytest.raises(ValueError, match=message) as refused:
        c_source(law, **options)
    assert "\n" not in str(refused.value)


@needs_compiler
def test_header_and_source_belong_together(tmp_path):
    law = Controller([[0.9]], [[1.0]], [[1.0]], [[2.0]], np.float64(0.005), name="a */ tricky name \n")
    law = replace(law, signals="error: y */ [°]; command: u [V]")
    header = c_header(law, "arm")
    assert "   error: y ? [?]; command: u [V].\n" in header
    assert "one call every 0.005 s" in header
    (tmp_path / "arm.h").write_text(header)
    (tmp_path / "main.c").write_text(
        '#include "arm.h"\nint main(void) { arm_state s; arm_reset(&s); return arm_step(&s, 0.0) != 0.0; }\n'
    )
    (tmp_path / "arm.c").write_text('#include "arm.h"\n' + c_source(law, "arm"))
    files = [str(tmp_path / name) for name in ("main.c", "arm.c", "program")]
    subprocess.run(
        [COMPILER, "-std=c99", "-Werror", *files[:2], "-o", files[2]], check=True, capture_output=True
    )
    assert subprocess.run([files[2]], check=False).returncode == 0


@needs_compiler
@pytest.mark.parametrize("number", ["double", "float"])
def test_the_code_of_a_reference_filter_is_the_filter(tmp_path, number):
    rng = np.random.default_rng(3)
    law = ReferenceFilter(
        np.diag([0.9, 0.99]), np.ones((2, 1)), np.array([[0.02, 0.005]]), [[0.3]], 0.01, 1, 1, 1
    )
    text = law_bytes(law, ".c", Dialect("arm", number)).decode()
    reference = rng.standard_normal((300, 1))
    as_law = Controller(law.A, law.B, law.C, law.D, 0.01)
    code, name = compiled(text, tmp_path), "arm_reference_filter"
    found, _ = _run_code(code, name, as_law, number, reference, reference)
    tolerance = 20 * np.finfo(np.float32 if number == "float" else float).eps / (1 - 0.99)
    np.testing.assert_allclose(found[:, 0], law.filtered(reference[:, 0]), rtol=0, atol=tolerance)
