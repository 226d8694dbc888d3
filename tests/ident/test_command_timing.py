"""What a command does between two rows: the response that is identified is the one of a held command."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from scipy import signal

from ident import IdentOptions, Poles, Record, identify
from ident.basis.posterior import ResponsePosterior
from ident.command_timing import (
    HELD,
    CommandTiming,
    Hold,
    TimingSource,
    filtered,
    timing_of,
    with_equivalent_command,
    with_unknown_timing,
)
from ident.data.arrays import real_rows
from ident.resampling import ratio_of
from tests.ident.test_recorded_law import loop_log, pid

STEP_S = 0.002
# 5 rad/s and a mode at 120 rad/s, damping .05: continuous A, B, C from command to position.
A = scipy.linalg.block_diag([[-5.0]], [[0.0, 1.0], [-(120.0**2), -12.0]])
B = np.array([[5.0], [0.0], [120.0**2]])
C = np.array([[1.0, 0.5, 0.0]])
OMEGA = np.geomspace(1.0, 700.0, 80)


def sampled(period_s):
    """Discrete A, B of a command held for a period."""
    held = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 4))]]) * period_s)
    return held[:3, :3], held[:3, 3:]


def response(period_s, omega=OMEGA):
    a, b = sampled(period_s)
    z = np.exp(1j * omega * period_s)
    return np.array([(C @ np.linalg.solve(x * np.eye(3) - a, b)).item() for x in z])


def fast_log(rows, averaged=False, n=6000, seed=5):
    """A band-limited command that changes `rows` times between two rows, and the motion at the rows."""
    rng = np.random.default_rng(seed)
    sos = signal.butter(4, 0.4 / rows, output="sos")
    u = signal.sosfiltfilt(sos, rng.standard_normal(n * rows))
    a, b = sampled(STEP_S / rows)
    x, y = np.zeros(3), np.zeros(u.size)
    for k, command in enumerate(u):
        y[k] = (C @ x).item()
        x = a @ x + b[:, 0] * command
    if averaged:
        u = np.convolve(u, np.full(rows, 1 / rows))[: u.size]
    every = slice(0, None, rows)
    return Record(u[every, None], y[every, None], STEP_S, name="log")


@pytest.mark.parametrize(
    ("rows", "averaged"), [pytest.param(2, False, marks=pytest.mark.long), (5, False), (4, True)]
)
def test_the_arm_identified_from_a_slower_log_is_the_arm_under_a_held_command(rows, averaged):
    record = fast_log(rows, averaged)
    timing = timing_of([record], in_loop=False, stated_period_s=STEP_S / rows, averaged=averaged)
    options = IdentOptions(n_real=1, n_pairs=1, input_delay_samples=0)
    found = identify(with_equivalent_command([record], timing), options).model
    as_logged = identify([record], options).model
    exact = response(STEP_S)
    error = np.abs(found.frequency_response(OMEGA) / exact - 1)
    before = np.abs(as_logged.frequency_response(OMEGA) / exact - 1)
    within = OMEGA < 400
    assert np.max(error[within]) < 0.01
    assert np.max(before[within]) > 0.1


@pytest.mark.parametrize("hold", [Hold(0.5), Hold(0.2), Hold(0.0), Hold(0.25, averaged=True)])
def test_the_filter_is_one_over_the_mean_of_the_commands_of_a_step(hold):
    """Up to half the Nyquist frequency to half a per cent; a constant stays exactly one."""
    pulse = np.zeros((2048, 1))
    pulse[1024] = 1.0
    angle = 2 * np.pi * np.arange(1, 512) / 2048
    spectrum = np.fft.fft(np.roll(filtered(pulse, hold)[:, 0], -1024))[1:512]
    np.testing.assert_allclose(spectrum, hold.response(angle), rtol=5e-3)
    np.testing.assert_allclose(filtered(np.full((50, 1), 3.0), hold), 3.0, rtol=1e-12)


def test_the_mean_is_that_of_so_many_commands():
    """S of four commands a step by its definition."""
    angle = np.linspace(0.1, 3.0, 20)
    mean = np.mean([np.exp(-1j * angle * k / 4) for k in range(4)], axis=0)
    np.testing.assert_allclose(Hold(0.25).response(angle), 1 / mean)
    np.testing.assert_allclose(Hold(1e-6).response(angle), Hold(0.0).response(angle), rtol=1e-5)
    np.testing.assert_allclose(Hold(1.0).response(angle), 1.0)


def test_the_period_is_read_off_or_not_known():
    every = timing_of([loop_log(*pid())], in_loop=True)
    assert every.source is TimingSource.LAW
    assert every.period_s == pytest.approx(0.001)
    assert every.known
    faster = timing_of([loop_log(*pid(), rows=2)], in_loop=True)
    assert faster.source is TimingSource.UNKNOWN
    assert faster.law is None
    assert faster.possible
    open_loop = timing_of([fast_log(2)], in_loop=False)
    assert open_loop.source is TimingSource.OPEN_LOOP
    assert open_loop.taken == HELD


def test_every_row_is_used_of_a_command_that_repeats_and_was_made_by_no_law():
    """A held random command: of an experiment that may have been taken for a loop."""
    rng = np.random.default_rng(3)
    command = np.repeat(rng.standard_normal(300), 8)[:, None]
    record = Record(command, np.cumsum(command, axis=0) * 1e-3, STEP_S, name="held")
    timing = timing_of([record], in_loop=True)
    assert timing.source is TimingSource.REPEATS
    assert timing.known
    (used,) = with_equivalent_command([record], timing)
    np.testing.assert_array_equal(used.input, record.input)
    assert used.dt_s == STEP_S


def test_logs_of_two_controllers_have_a_law_each():
    logs = [loop_log(*pid(pole), seed=seed) for pole, seed in ((0.82, 1), (0.6, 2))]
    timing = timing_of(logs, in_loop=True)
    assert timing.source is TimingSource.LAW
    assert timing.law is None
    assert not timing.acts_at_once


def test_a_reference_that_nobody_moved_and_a_model_of_nothing_are_no_faults():
    record = loop_log(*pid())
    still = replace(record, reference=np.zeros_like(record.reference))
    assert timing_of([still], in_loop=True).source in (TimingSource.LAW, TimingSource.UNKNOWN)
    nothing = ResponsePosterior(Poles([0.5]), np.zeros(1), np.eye(1), STEP_S)
    unknown = CommandTiming(TimingSource.UNKNOWN, STEP_S, None, possible=(HELD, Hold(0.0)))
    assert with_unknown_timing(nothing, unknown) is nothing


def test_a_command_logged_several_times_is_used_at_the_rows_where_it_changes():
    """A log at three times the rate of its controller: the law and the period are those of the controller."""
    slow = loop_log(*pid())
    rows = 3
    command = np.repeat(slow.input, rows, axis=0)
    # The position goes on in between; at the rows of the controller it is what the controller read.
    fine = np.arange(rows * slow.n_samples) / rows
    output = np.interp(fine, np.arange(slow.n_samples), slow.output[:, 0])[:, None]
    reference = np.repeat(slow.reference, rows, axis=0)
    log = Record(command, output, 0.001 / rows, name="fast", reference=reference)
    log = log.slice(1, log.n_samples)
    timing = timing_of([log], in_loop=True)
    assert timing.source is TimingSource.REPEATS
    assert timing.period_s == pytest.approx(0.001)
    assert timing.law is not None
    (used,) = with_equivalent_command([log], timing)
    assert used.dt_s == pytest.approx(0.001)
    np.testing.assert_array_equal(used.output, slow.output[1 : 1 + used.n_samples])
    np.testing.assert_array_equal(used.input, slow.input[1 : 1 + used.n_samples])


@pytest.mark.parametrize(
    ("period_s", "allowed"),
    [(0.0003, "such as 0.000333333"), (0.004, "at most 0.001")],
)
def test_a_period_that_the_log_contradicts_is_refused_with_one_that_it_allows(period_s, allowed):
    with pytest.raises(ValueError, match=allowed) as refused:
        timing_of([loop_log(*pid())], in_loop=True, stated_period_s=period_s)
    assert "--controller-period" in str(refused.value)
    assert "\n" not in str(refused.value)


def faster_log(rows, *, late=0, seed=11):
    """A loop's log at `rows` times the rate of its controller; `late` first rows are missing."""
    slow = loop_log(*pid(), seed=seed)
    fine = np.arange(rows * slow.n_samples) / rows
    log = Record(
        np.repeat(slow.input, rows, axis=0),
        np.interp(fine, np.arange(slow.n_samples), slow.output[:, 0])[:, None],
        0.001 / rows,
        name="fast",
        reference=np.repeat(slow.reference, rows, axis=0),
    )
    return log.slice(late, log.n_samples)


@pytest.mark.parametrize("lost", [[8000], pytest.param([5000, 11000], marks=pytest.mark.long)])
def test_rows_that_lost_the_phase_of_the_command_are_not_thinned(lost):
    """Every fourth row of what follows a lost one would hold a command that is about to change."""
    log = faster_log(4).each(lambda signal: np.delete(signal, lost, axis=0))
    records = [log, faster_log(4, seed=12)]
    found = timing_of(records, in_loop=True)
    assert not found.known
    assert found.rows_per_command == 1
    stated = timing_of(records, in_loop=True, stated_period_s=0.001)
    assert stated.rows_per_command == 1
    assert stated.taken == HELD


def test_a_log_whose_command_hardly_changes_tells_no_period_of_the_others():
    still = faster_log(4, seed=12)
    still = replace(still, input=np.where(np.arange(still.n_samples) < 100, 1.0, 2.0)[:, None])
    found = timing_of([faster_log(4, late=3), still], in_loop=True)
    assert found.source is TimingSource.REPEATS
    assert found.rows_per_command == 4
    assert found.first_row[0] == 1


def test_a_stated_period_shorter_than_the_repeats_of_a_command_counts_from_where_it_changes():
    """A command column that is refreshed every fourth row, of a controller that ran at every second one."""
    refreshed = faster_log(4)
    noise = 0.1 * np.random.default_rng(3).standard_normal((refreshed.n_samples // 4, 1))
    # A law that is not linear tells no period.
    refreshed = replace(refreshed, input=refreshed.input + np.repeat(noise, 4, axis=0))
    stated = timing_of([refreshed], in_loop=True, stated_period_s=0.0005)
    assert stated.rows_per_command == 4
    assert stated.taken == Hold(0.5)
    (used,) = with_equivalent_command([refreshed], stated)
    np.testing.assert_allclose(used.input, filtered(refreshed.input[::4], Hold(0.5)))


@pytest.mark.parametrize(
    ("record", "period_s"), [(loop_log(*pid()), 0.00025), (faster_log(4), 0.00025), (faster_log(3), 0.0005)]
)
def test_a_period_shorter_than_that_of_the_law_in_the_log_is_refused(record, period_s):
    with pytest.raises(ValueError, match=r"0\.001.*--controller-period"):
        timing_of([record], in_loop=True, stated_period_s=period_s)


@pytest.mark.parametrize(
    ("period_s", "offered_s"), [(0.0005, 0.0005), (0.0014, 0.002), (0.002, 0.002), (None, 0.002)]
)
def test_a_new_controller_is_offered_a_period_that_it_may_have(period_s, offered_s):
    timing = CommandTiming(TimingSource.STATED, STEP_S, period_s)
    assert timing.offered_dt_s == pytest.approx(offered_s)
    ratio_of(STEP_S, timing.offered_dt_s)


def test_a_mean_of_commands_in_open_loop_needs_the_period_of_each():
    with pytest.raises(ValueError, match="--controller-period"):
        timing_of([fast_log(4, averaged=True)], in_loop=False, averaged=True)


@pytest.mark.parametrize("integrators", [0, 1])
def test_ellipses_of_an_unknown_period_hold_the_response_of_each(integrators):
    """Narrow ellipses hold every possibility then, up to half the Nyquist frequency; those of a known period
    stay as they are."""
    poles = Poles([np.exp(-5 * STEP_S)], [np.exp((-6 + 120j) * STEP_S)])
    doubled = poles.doubled()
    unknown = ResponsePosterior(
        doubled, np.ones(doubled.order), np.eye(doubled.order), STEP_S, integrators=integrators
    )
    grid = np.geomspace(0.5, 1000.0, 300)
    arm = response(STEP_S, grid) / (1j * grid) ** integrators
    rows = real_rows(unknown.frequency_rows(grid) / arm[:, None])
    mean = np.linalg.lstsq(rows, real_rows(np.ones((grid.size, 1), complex)), rcond=None)[0][:, 0]
    narrow = replace(unknown, mean=mean, covariance_factor=1e-4 * np.diag(np.abs(mean)))
    possible = (HELD, Hold(0.0), Hold(0.0, averaged=True))
    timing = CommandTiming(TimingSource.UNKNOWN, STEP_S, None, possible=possible, middle=Hold(0.0))
    wide = with_unknown_timing(narrow, timing)
    omega = np.geomspace(1.0, 0.5 * np.pi / STEP_S, 100)
    middle = narrow.centre(omega) / timing.middle.response(omega * STEP_S)
    # Off by less than what the ellipses are wide along the gain.
    assert np.all(np.abs(wide.centre(omega) / middle - 1) < 0.1 * omega * STEP_S / 2 + 1e-3)
    ellipses = wide.at(omega)
    for hold in possible:
        assert np.all(ellipses.contains(narrow.centre(omega) / hold.response(omega * STEP_S)))
    # Nor wider than what a delay of two steps would ask for.
    late = np.exp(-2j * omega * STEP_S) * narrow.centre(omega)
    assert not np.any(ellipses.contains(late)[(omega > 50) & (omega < 400)])
    known = replace(timing, possible=())
    assert with_unknown_timing(narrow, known) is narrow


def test_ellipses_stay_as_wide_below_poles_that_are_slower_than_a_record():
    """Far below the slowest pole ellipses are as wide over their centre as around it; a fit that begins above
    a pole is free to turn there."""
    rates = np.geomspace(2e-4, 5.0, 12)
    poles = Poles(np.exp(-rates * STEP_S), [np.exp((-6 + 120j) * STEP_S)])
    empty = ResponsePosterior(poles, np.ones(14), np.eye(14), STEP_S, integrators=1)
    grid = np.geomspace(1e-6, 1000.0, 600)
    arm = response(STEP_S, grid) / (1j * grid)
    # Columns: a tenth of the gain, behind lags and leads of all rates.
    slow = 1 / (1 + 1j * grid[:, None] / np.geomspace(1e-3, 100.0, 8))
    wanted = np.column_stack([np.ones(grid.size), 0.1 * slow])
    rows = real_rows(empty.frequency_rows(grid) / arm[:, None])
    found = np.linalg.lstsq(rows, real_rows(wanted), rcond=1e-10)[0]
    narrow = replace(empty, mean=found[:, 0], covariance_factor=found[:, 1:])
    timing = CommandTiming(
        TimingSource.UNKNOWN, STEP_S, None, possible=(HELD, Hold(0.0, averaged=True)), middle=Hold(0.0)
    )

    def width(posterior, omega):
        ellipses = posterior.at(np.array([omega]))
        return float(ellipses.ellipse().semi_major[0] / np.abs(ellipses.centre[0]))

    wide = with_unknown_timing(narrow, timing)
    for omega in (1e-6, 1e-5, 1e-4, 1e-3):
        assert width(wide, omega) == pytest.approx(width(narrow, omega), rel=0.02)


@pytest.mark.parametrize("first", [0, 1, 2, 3])
def test_a_record_that_was_not_seen_is_used_from_the_row_at_which_its_command_changes(first):
    rng = np.random.default_rng(first)
    seen = np.repeat(rng.standard_normal(200), 4)
    unseen = np.repeat(rng.standard_normal(200), 4)[(4 - first) % 4 :]
    records = [Record(u[:, None], np.cumsum(u)[:, None] * 1e-3, STEP_S, name="log") for u in (seen, unseen)]
    timing = CommandTiming(
        TimingSource.REPEATS, STEP_S, period_s=4 * STEP_S, rows_per_command=4, first_row=(0,)
    )
    _, used = with_equivalent_command(records, timing)
    np.testing.assert_array_equal(used.input[:, 0], unseen[first::4])
