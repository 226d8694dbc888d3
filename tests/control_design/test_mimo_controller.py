"""The controller of several commands: files, limits."""

import io

import numpy as np
import pytest
import scipy.io

from benchmarks import mimo_problems as problems
from benchmarks.mimo_designs import TS, tustin
from control_design import Controller


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
