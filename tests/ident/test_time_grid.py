"""Stamps that jitter, or leave rows out, against a signal whose values on the grid are known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from ident.data.record_files import Table, read_table
from ident.data.time_grid import TimeGrid

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

    def said_of(time) -> str:
        with pytest.raises(ValueError) as caught:
            TimeGrid.of(table_of(tmp_path, time), "t", time)
        return str(caught.value)

    late = even.copy()
    late[50] += 0.3 * DT_S
    assert "log.csv, line 52: time 't' steps by 0.0052 s" in said_of(late)
    assert "within 20%" in said_of(late)
    assert TimeGrid.of(table_of(tmp_path, even), "t", np.delete(even, range(70, 75))).missing == tuple(
        range(70, 75)
    )
    gap = said_of(np.delete(even, range(70, 76)))
    assert "line 72" in gap
    assert "at most 5 rows" in gap
    assert "line 202: time 't' goes from 0.796 to 0 s" in said_of(np.concatenate([even[:200], even[:200]]))
    rare = said_of(np.delete(even, range(5, 400, 15)))
    assert "27 of 400 rows are missing" in rare
