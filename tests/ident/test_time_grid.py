"""Stamps that jitter, or leave rows out, against a signal whose values on the grid are known."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st

from ident.data.finding import FindingKind
from ident.data.record import Record
from ident.data.record_files import Table, read_table
from ident.data.time_grid import CoarseGrid, TimeGrid, option_for, sampling_time

DT_S = 0.004
LOST = (17, 240, 241)


def signal(time_s):
    return np.column_stack([np.sin(40 * time_s) + 3.0, np.cos(90 * time_s)])


def stamps(jitter: float, seed: int = 0):
    rng = np.random.default_rng(seed)
    kept = np.delete(np.arange(600), LOST)
    return kept, DT_S * (kept + np.clip(jitter * rng.standard_normal(kept.size), -3 * jitter, 3 * jitter))


def table_of(tmp_path, time) -> Table:
    path = tmp_path / "log.csv"
    pd.DataFrame({"t": time}).to_csv(path, index=False, float_format="%.12g")
    return read_table(path)


@pytest.mark.parametrize("jitter", [0.0, 0.012, 0.06])
def test_outputs_come_back_on_the_grid(tmp_path, jitter):
    kept, time = stamps(jitter)
    grid = TimeGrid.of(table_of(tmp_path, time), "t", time + 7.0)
    assert grid.missing == LOST
    np.testing.assert_array_equal(grid.rows, kept)
    found = grid.sampled(signal(time))
    # Phase of the grid: a line through 597 stamps, at its ends known to 2 jitter / sqrt(597), times three.
    phase = 6 * jitter / np.sqrt(kept.size) * DT_S
    # Cubic spline, error 5/384 h^4 |y''''|, h up to 1 + 6 jitter rows, and three where two in a row are lost.
    steps = np.full(600, 1 + 6 * jitter)
    steps[list(LOST)] = 3 + 6 * jitter
    for column, omega in enumerate((40.0, 90.0)):
        error = np.abs(found[:, column] - signal(DT_S * np.arange(600))[:, column])
        bound = phase * omega + 5 / 384 * (steps * omega * DT_S) ** 4
        # Within four rows of a lost one (and of the ends) the spline's slopes are wrong by its error there.
        far = np.min(np.abs(np.arange(600)[:, None] - [0, *LOST, 599]), axis=1) > 4
        assert np.all(error[far] <= bound[far])
        assert np.max(error) <= 2 * np.max(bound)
        # Without the correction, jitter of 1.2 % makes an error of 3 % of omega dt: ten times as much.
        if jitter:
            raw = np.abs(signal(time)[:, column] - signal(DT_S * kept)[:, column])
            assert np.max(raw) > 3 * np.max(error[kept])


def test_readings_on_the_grid_stay_as_they_are_and_inputs_lie_between(tmp_path):
    kept, time = stamps(0.0)
    grid = TimeGrid.of(table_of(tmp_path, time), "t", time)
    np.testing.assert_array_equal(grid.sampled(signal(time))[kept], signal(time))
    held = grid.held(np.sign(np.sin(kept + 0.5)))
    np.testing.assert_array_equal(held[kept], np.sign(np.sin(kept + 0.5)))
    assert held[17] == 0.5 * (held[16] + held[18])


def test_stamps_that_are_no_jitter_are_refused_with_their_row(tmp_path):
    even = DT_S * np.arange(400)

    def complaint(time) -> str:
        with pytest.raises(ValueError) as caught:
            TimeGrid.of(table_of(tmp_path, time), "t", time)
        return str(caught.value)

    late = even.copy()
    late[50] += 0.3 * DT_S
    for fact in ("log.csv, line 52", "'t'", "0.30 of a step of 0.004 s", "--resample-s 0.02"):
        assert fact in complaint(late)
    five_lost = np.delete(even, range(70, 75))
    grid = TimeGrid.of(table_of(tmp_path, even), "t", five_lost)
    assert grid.missing == tuple(range(70, 75))
    for fact in ("line 72", "5 rows"):
        assert fact in complaint(np.delete(even, range(70, 76)))
    for fact in ("line 202", "'t'", "from 0.796 to 0 s"):
        assert fact in complaint(np.concatenate([even[:200], even[:200]]))
    assert "27 of 400 rows" in complaint(np.delete(even, range(5, 400, 15)))


def clock(kind: str) -> np.ndarray:
    """600 stamps [s] of loops as people write them."""
    k, rng = np.arange(600), np.random.default_rng(5)
    if kind == "host jitter":
        return DT_S * (k + rng.uniform(-0.02, 0.02, k.size))
    if kind == "rows lost":
        return DT_S * np.delete(k, [90, 400])
    if kind == "many rows lost":
        return DT_S * np.delete(k, np.arange(4, 600, 10))
    if kind == "free running":  # each step by itself, as a loop with a sleep has them
        return np.cumsum(DT_S * rng.uniform(0.9, 1.1, k.size))
    if kind == "warming up":  # from 3 % slow to 3 % fast
        return np.cumsum(DT_S * np.linspace(1.03, 0.97, k.size))
    if kind == "pauses":  # every hundredth step waits for the disk
        return np.cumsum(DT_S * np.where(k % 100 == 50, 3.4, 1.0))
    return DT_S * np.delete(k, np.arange(200, 300))


CLOCKS = {
    "host jitter": ("no row is missing, the clock jitters by up to 3", "--repair"),
    "rows lost": ("rows missing: 2 of 600", "--repair"),
    "many rows lost": ("rows missing: 60 of 600", "--resample-s 0.02"),
    "free running": ("no row is missing, the clock jitters", "--resample-s 0.02"),
    "warming up": ("no row is missing, the clock jitters", "--resample-s 0.02"),
    "pauses": ("the stamps keep to no grid, steps are 0.004 to 0.0136 s", "--resample-s 0.02"),
    "split": ("rows missing: 100 of 600", "split"),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_the_cause_is_the_right_one_and_what_is_proposed_works(tmp_path, kind):
    time, (cause, option) = clock(kind), CLOCKS[kind]
    table = table_of(tmp_path, time)
    with pytest.raises(ValueError) as caught:
        sampling_time(table, time, "t", None)
    assert cause in str(caught.value)
    assert option_for(time) == option
    assert f": {option}" in str(caught.value)
    if option == "--repair":
        assert TimeGrid.of(table, "t", time).dt_s == pytest.approx(DT_S, rel=1e-3)
        return
    with pytest.raises(ValueError, match=option):
        TimeGrid.of(table, "t", time)
    if option != "split":
        assert CoarseGrid.of(table, "t", time, float(option.split()[1])).n_samples > 100


@given(st.integers(0, 10**6), st.floats(0.05, 0.9), st.sampled_from([1.0, 2.5, 7.0]))
def test_a_coarse_grid_keeps_lines_and_what_an_input_pushes(seed, jitter, ratio):
    rng = np.random.default_rng(seed)
    time = np.cumsum(DT_S * rng.uniform(1 - jitter, 1 + jitter, 300))
    table = Table("a.csv", {"t": time})
    grid = CoarseGrid.of(table, "t", time, 1.02 * ratio * float(np.median(np.diff(time))))
    instants = grid.dt_s * np.arange(grid.n_samples)
    np.testing.assert_allclose(grid.sampled(3 - 40 * time), 3 - 40 * (time[0] + instants), atol=1e-9)
    # An integrator driven by the held input is at every instant where the log has it.
    u = rng.standard_normal(300)
    position = np.concatenate([[0.0], np.cumsum(u[:-1] * np.diff(time))])
    pushed = np.concatenate([[0.0], np.cumsum(grid.held(u)[:-1] * grid.dt_s)])
    np.testing.assert_allclose(pushed, np.interp(time[0] + instants, time, position), atol=1e-12)


def test_resampling_is_on_request_and_says_its_bounds(tmp_path):
    time = clock("free running")
    path = tmp_path / "log.csv"
    pd.DataFrame({"t": time, "u": np.sign(np.sin(60 * time)), "y": np.cos(20 * time)}).to_csv(
        path, index=False
    )

    def read(**options):
        return Record.from_file(path, ["u"], ["y"], time="t", **options)

    for options in ({}, {"repair": True}):
        with pytest.raises(ValueError, match=r"--resample-s 0\.02 \(resample_s = 0\.02\)"):
            read(**options)
    record = read(resample_s=0.02, repair=True)  # the option is added to the line that was refused
    assert record.dt_s == 0.02
    # A straight line between readings: (omega h)^2 / 8 at h of at most 1.1 steps.
    truth = np.cos(20 * (time[0] + record.time_s))
    np.testing.assert_allclose(record.output[:, 0], truth, atol=(20 * 1.1 * DT_S) ** 2 / 8)
    (found,) = record.doubts
    # Means that are held, 1 - sinc^2(x/2) = 1 %, against x = 0.3464: the next term is 0.1 % of it.
    x = found.values["faithful_rad_s"] * 0.02
    assert 1 - (np.sin(x / 2) / (x / 2)) ** 2 == pytest.approx(0.01, rel=0.01)
    assert (found.values["missing"], found.values["dt_s"]) == (0, 0.02)
    for wrong in (0.001, 100.0):
        with pytest.raises(ValueError, match=r"resample_s = .* try --resample-s 0\.02"):
            read(resample_s=wrong)
    with pytest.raises(ValueError, match=r"resample_s .* time column"):
        Record.from_file(path, ["u"], ["y"], dt_s=0.004, resample_s=0.02)


def test_a_gap_is_not_bridged_by_a_coarse_grid(tmp_path):
    time = clock("split")
    with pytest.raises(ValueError, match=r"line 202: .* split the file there"):
        CoarseGrid.of(table_of(tmp_path, time), "t", time, 0.02)
    assert CoarseGrid.of(table_of(tmp_path, time), "t", time, 0.1).repair.missing == 3


@pytest.mark.parametrize(
    ("interval", "told"),
    [
        (0.01 * (1 + 0.004 * np.sin(np.linspace(0, 6, 3000))), True),  # temperature goes up and down
        (np.linspace(0.00995, 0.01005, 3000), True),  # a clock that warms up
        (np.repeat([0.01, 0.01003], 1500), True),  # the rate was changed in between
        (np.full(3000, 0.01), False),
        (0.01 + 2e-5 * np.sin(np.arange(3000.0)), False),  # jitter that does not add up
    ],
)
def test_a_clock_that_drifts_within_every_step_is_told(interval, told, tmp_path):
    """Every step is within 1 % of the usual one; what is told is the rate of the parts, known here."""
    t = np.concatenate([[0.0], np.cumsum(interval)])
    u = np.sign(np.sin(1.3 * t))
    rows = "\n".join(f"{a:.9f},{b:g},{c:.6f}" for a, b, c in zip(t, u, np.sin(6 * np.pi * t), strict=True))
    path = tmp_path / "log.csv"
    path.write_text(f"time_s,u_V,y_rad\n{rows}\n")
    notes = Record.from_file(path, ["u_V"], ["y_rad"], time="time_s").notes
    found = [note for note in notes if note.kind is FindingKind.CLOCK_DRIFTS]
    assert bool(found) is told
    if told:
        parts = [np.mean(part) for part in np.array_split(interval, 10)]
        assert found[0].values["share"] == pytest.approx(max(np.abs(parts / np.mean(interval) - 1)), rel=1e-3)
