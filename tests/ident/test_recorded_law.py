"""The law that made a log: found with its coefficients, and told from one that ran faster than the log."""

from dataclasses import replace

import numpy as np
import pytest

from ident import Record
from ident.recorded_law import law_of

DT = 0.001


def loop_log(numerator, denominator, *, rows=1, limit=50.0, decimals=4, n=4000, noise=1e-4, seed=11):
    """A record of every `rows`-th sample of u = K (r - y) around a damped mass, rounded in the log."""
    rng = np.random.default_rng(seed)
    order = len(denominator) - 1
    total = n * rows
    # Steps through a low-pass: what a trajectory planner gives.
    levels = np.repeat(rng.uniform(-1, 1, total // 200 + 1), 200)[:total]
    r, y, u = np.zeros(total), np.zeros(total), np.zeros(total)
    for k in range(order, total):
        r[k] = 0.97 * r[k - 1] + 0.03 * levels[k]
        y[k] = 1.98 * y[k - 1] - 0.9802 * y[k - 2] + 2e-4 * u[k - 1] + noise * rng.standard_normal()
        error = (r - y)[k - order : k + 1][::-1]
        own = u[k - order : k][::-1]
        u[k] = np.clip(numerator @ error - denominator[1:] @ own, -limit, limit)
    every = slice(0, None, rows)
    return Record(
        np.round(u[every, None], decimals),
        np.round(y[every, None], decimals + 2),
        DT * rows,
        name="log",
        reference=np.round(r[every, None], decimals + 2),
    )


def pid(pole=0.82, integrator=1.0):
    return np.convolve([1.0, -0.995], [60.0, -57.0]), np.convolve([1.0, -integrator], [1.0, -pole])


@pytest.mark.parametrize(("integrator", "limit"), [(1.0, 50.0), (0.97, 50.0), (1.0, 6.0)])
def test_a_law_that_ran_at_every_row_is_found_to_the_rounding_of_the_log(integrator, limit):
    numerator, denominator = pid(integrator=integrator)
    record = loop_log(numerator, denominator, limit=limit)
    law = law_of([record])
    assert law.repeats_command
    assert law.tells_period
    assert law.acts_at_once
    found_numerator, found_denominator = law.on_error
    z = np.exp(1j * np.geomspace(1e-2, 3.0, 50))
    exact = np.polyval(numerator, z) / np.polyval(denominator, z)
    found = np.polyval(found_numerator, z) / np.polyval(found_denominator, z)
    np.testing.assert_allclose(found, exact, rtol=0.02)
    assert np.any(np.isclose(np.roots(found_denominator), 1.0, atol=1e-9)) == (integrator == 1.0)
    assert law.residual == pytest.approx(law.rounding, rel=0.1)


@pytest.mark.parametrize("rows", [2, *(pytest.param(rows, marks=pytest.mark.long) for rows in (4, 5))])
def test_a_law_that_ran_faster_than_the_log_does_not_repeat_its_command(rows):
    law = law_of([loop_log(*pid(), rows=rows)])
    assert not law.repeats_command
    assert not law.tells_period


def test_where_signals_are_smooth_the_log_does_not_tell_the_period():
    """A slow loop without noise: rows that were left out can be guessed from those that are there."""
    numerator, denominator = 0.02 * pid(0.99)[0], pid(0.99)[1]
    every = law_of([loop_log(numerator, denominator, noise=0.0)])
    assert every.repeats_command
    assert not every.tells_period


@pytest.mark.parametrize(
    ("rows", "decimals"),
    [
        (2, 3),
        (4, 5),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((4, 3), (2, 5), (2, 9), (4, 9))),
    ],
)
def test_steps_that_fall_on_rows_do_not_tell_a_period_that_the_rest_does_not(rows, decimals):
    """A simulator steps its reference at whole tenths of a second, and nothing else is new from row to row:
    what a faster controller used between the rows can be guessed wherever no step is."""
    numerator, denominator = pid(0.95)
    law = law_of([loop_log(0.1 * numerator, denominator, rows=rows, noise=0.0, decimals=decimals, n=6000)])
    assert law is None or not law.tells_period


def test_a_law_with_the_derivative_of_the_output_alone_has_no_error_to_act_on():
    record = loop_log(*pid())
    u, y, r = record.input[:, 0].copy(), record.output[:, 0], record.reference[:, 0]
    u[1:] = np.round(40 * (r - y)[1:] - 600 * np.diff(y), 4)
    law = law_of([replace(record, input=u[:, None])])
    assert law.repeats_command
    assert law.on_error is None


def test_a_law_of_the_row_before_does_not_act_at_once():
    numerator, denominator = pid()
    late = np.append(0.0, numerator)
    law = law_of([loop_log(0.3 * late, np.append(denominator, 0.0))])
    assert law.repeats_command
    assert not law.acts_at_once


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [1, 2])
def test_a_reference_that_stands_at_zero_tells_of_the_output_alone(rows):
    record = loop_log(*pid(), rows=rows, noise=1e-3)
    rng = np.random.default_rng(4)
    output = np.cumsum(rng.standard_normal(record.n_samples)) * 1e-3
    command = np.round(np.append(0.0, 30 * output[1:] - 28 * output[:-1]), 4) + 0.01 * rng.standard_normal()
    still = replace(
        record, input=command[:, None], output=output[:, None], reference=np.zeros_like(record.reference)
    )
    law_of([still, record])
    assert np.all(np.isfinite(law_of([still]).of_reference))


def test_no_reference_and_a_relay_tell_no_law():
    record = loop_log(*pid())
    assert law_of([replace(record, reference=None, reference_names=())]) is None
    relay = law_of([replace(record, input=np.sign(record.reference - record.output))])
    assert relay is None or not relay.repeats_command


@pytest.mark.parametrize(
    "written",
    [
        lambda x: np.round(x, 6),
        lambda x: np.round(x * 180 / np.pi, 5) * np.pi / 180,
        lambda x: np.array([float(f"{value:.7g}") for value in x]),
        lambda x: x.astype(np.float32).astype(np.float64),
    ],
    ids=["decimals", "scaled", "significant digits", "32 bits"],
)
def test_the_rounding_of_a_log_is_seen_however_it_was_written(written):
    """A law is told from one that ran at half the period by what rounding leaves of each."""
    for rows, told in ((1, True), (2, False)):
        record = loop_log(*pid(), rows=rows, decimals=12)
        columns = {
            "input": written(record.input[:, 0])[:, None],
            "output": written(record.output[:, 0])[:, None],
            "reference": written(record.reference[:, 0])[:, None],
        }
        law = law_of([replace(record, **columns)])
        assert law.repeats_command == told
        assert law.tells_period == told
