"""The controller of several commands: files, C code, limits."""

from __future__ import annotations

import io
import shutil
import subprocess

import numpy as np
import pytest
import scipy.io

from benchmarks import mimo_problems as problems
from benchmarks.mimo_designs import TS, tustin
from control_design import Controller, c_source


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


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.parametrize("settings", [{}, LIMITS, {"input_limit": (1.0, 2.0)}])
def test_c_code_does_what_the_stepper_does(tmp_path, settings):
    given = controller(**settings)
    limited = ", s.limited" if settings else ", 0"
    driver = (
        "\n#include <stdio.h>\nint main(void){controller_state s;controller_reset(&s);double e[2],u[2];"
        'while(scanf("%lf %lf",&e[0],&e[1])==2){controller_step(&s,e,u);'
        f'printf("%.17g %.17g %d\\n",u[0],u[1]{limited});}}return 0;}}\n'
    )
    source, program = tmp_path / "c.c", tmp_path / "c"
    source.write_text(c_source(given) + driver)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run(["gcc", *flags, str(source), "-o", str(program)], check=True)
    errors = np.random.default_rng(0).standard_normal((300, 2))
    text = "\n".join(f"{a!r} {b!r}" for a, b in errors.tolist())
    told = subprocess.run([str(program)], input=text, capture_output=True, text=True, check=True).stdout
    found = np.array([[float(v) for v in line.split()] for line in told.splitlines()])
    stepper = given.matrix_stepper()
    expected = np.array([[*stepper.step(e), stepper.limited @ [1, 2]] for e in errors])
    # Sums in another order: 1e-16 of commands of size 1e2.
    np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=0, atol=1e-11)
    if settings:
        np.testing.assert_array_equal(found[:, 2], expected[:, 2])


def test_the_stepper_of_one_loop_and_of_a_matrix_agree():
    one = Controller([[0.9]], [[0.5]], [[1.0]], [[2.0]], 0.01, input_limit=1.5, rate_limit=80.0)
    single, matrix = one.stepper(), one.matrix_stepper()
    for error in np.random.default_rng(1).standard_normal(200):
        assert matrix.step(np.array([error]))[0] == pytest.approx(single.step(float(error)), abs=1e-14)


@pytest.mark.parametrize("limit", [(24.0,), 24.0, (24.0, -1.0)])
def test_limits_that_do_not_fit_are_refused(limit):
    with pytest.raises(ValueError, match="input_limit"):
        controller(input_limit=limit)
