"""Readings that wrap, made from a motion that is known."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ident.data.finding import FindingKind
from ident.data.record import Record
from ident.data.table import Table
from ident.data.wrapping import spikes_in, unwrapped, wraps_at

K = np.arange(4000)
# A machine that turns to and fro, in turns: six revolutions, and a swing about zero of a tenth of one.
TURNS = 3 * np.sin(0.004 * K) + 0.4 * np.sin(0.05 * K)
SWING = 0.05 * np.sin(0.03 * K) + 0.02 * np.sin(0.11 * K)


def wrapped(turns, period, low, step):
    counts = np.floor(turns * period / step) * step
    return (counts - low) % period + low


SENSORS = {
    "encoder of 1024 lines": (4096.0, 0.0, 1.0),
    "encoder of 1000 lines": (4000.0, 0.0, 1.0),
    "degrees about zero": (360.0, -180.0, 0.01),
    "degrees from zero": (360.0, 0.0, 0.1),
    "radians from zero": (2 * np.pi, 0.0, 2 * np.pi / 4096),
    "radians about zero": (2 * np.pi, -np.pi, 2 * np.pi / 2**14),
    "turns": (1.0, 0.0, 2.0**-12),
    "a counter of 16 bits": (65536.0, 0.0, 1.0),
    "int16": (65536.0, -32768.0, 1.0),
    "int32": (2.0**32, -(2.0**31), 1.0),
}


@pytest.mark.parametrize("turns", [TURNS, SWING], ids=["turns", "swings about zero"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_the_period_is_found_and_the_motion_comes_back(sensor, turns):
    period, low, step = SENSORS[sensor]
    # A swing about zero wraps only where zero is the end of the range.
    values = wrapped(turns if low == 0 else turns + 0.5 * (turns is SWING), period, low, step)
    assert wraps_at(values) == pytest.approx(period, rel=1e-12)
    found, doubt = unwrapped(values, period)
    truth = np.floor(turns * period / step) * step
    np.testing.assert_allclose(found - found[0], truth - truth[0], rtol=0, atol=1e-9 * period)
    assert doubt == 0


NO_WRAP = {
    "a sine": np.sin(0.01 * K),
    "a fast sine": np.sin(2.9 * K),
    "a square wave": np.sign(np.sin(0.01 * K)),
    "a noisy square wave of 0 and 4000": 4000.0 * (np.sin(0.01 * K) > 0)
    + np.round(5 * np.abs(np.random.default_rng(1).standard_normal(K.size))),
    "a binary random input": np.random.default_rng(2).choice([-3.0, 3.0], K.size),
    "random levels": np.random.default_rng(3).uniform(-180, 180, K.size),
    "levels held": np.repeat(np.random.default_rng(5).uniform(-1, 1, 600), 7),
    "white noise": np.random.default_rng(4).standard_normal(K.size),
    "steps of a lightly damped arm": np.convolve(
        180 * np.sign(np.sin(0.005 * K)), 0.05 * np.exp(-0.01 * K) * np.sin(0.2 * K)
    )[: K.size],
    "a spike": np.where(K == 700, 360.0, np.sin(0.01 * K)),
    "a sensor that drops out": np.where(K % 500 < 9, 0.0, 4040 + 40 * np.sin(0.01 * K)).round(),
    "a clipped reading": np.clip(8000 * np.sin(0.3 * K) + 2048, 0, 4095).round(),
    "standing still": np.ones(K.size),
}


@pytest.mark.parametrize("kind", NO_WRAP)
def test_what_does_not_wrap_is_left_alone(kind):
    assert wraps_at(NO_WRAP[kind]) == 0


MOVES = {
    "counts": (30000 + 30000 * np.sin(0.01 * K)).round(),
    "smooth": np.sin(0.02 * K),
    "steps": NO_WRAP["levels held"][: K.size],
}


@pytest.mark.parametrize("value", [9.9e37, 65535.0, -9999.0, 2.0**31 - 1])
@pytest.mark.parametrize("places", [(0,), (7, 8, 9), (100, 2000), (K.size - 1,), (300, 303, 304, 2500)])
def test_readings_that_are_none_are_named(value, places):
    """What instruments write for no reading, wherever it stands."""
    for name, motion in MOVES.items():
        values = motion.copy()
        values[list(places)] = value
        found = () if name == "counts" and value == 65535 and 300 in places else places
        assert tuple(spikes_in(values)) in {found, places}
    record = Record.from_file(table(values=values), ["u"], ["enc"], time="t")
    (note,) = record.doubts
    assert (note.kind, note.values["value"], note.values["rows"]) == (FindingKind.SPIKES, value, len(places))
    assert note.values["place"] == f"index {places[0]}"


SHOCK = np.where((K > 700) & (K < 720), 20 * np.sin(0.3 * (K - 700)), 0) + 0.01 * NO_WRAP["white noise"]


ALL = (
    MOVES
    | NO_WRAP
    | {
        "a shock": SHOCK,
        "a step": np.where(K > 900, 5.0, 0.0),
        "a late step": np.where(K > 3990, 5.0, 0.0) + 1e-3 * np.sin(K),
    }
)


@pytest.mark.parametrize("kind", sorted(set(ALL) - {"a sensor that drops out"}))
def test_no_motion_is_a_spike(kind):
    """The square waves begin with a sample that is alone."""
    alone = {"a spike": {700}, "a square wave": {0}, "a noisy square wave of 0 and 4000": {0}}
    assert set(spikes_in(ALL[kind])) <= alone.get(kind, set())


@given(
    st.floats(-0.9, 0.9),
    st.floats(0.001, 0.12),
    st.sampled_from([360.0, 4096.0, 2 * np.pi]),
    st.integers(0, 99),
)
def test_a_speed_beyond_half_a_period_is_followed_where_it_changes_slowly(speed, change, period, seed):
    """The speed begins slow, ends at `speed` periods per sample, and changes by less than an eighth."""
    phase = np.random.default_rng(seed).uniform()
    turns = phase + np.cumsum(speed * np.minimum(np.arange(400) * change / max(abs(speed), change), 1.0))
    found, doubt = unwrapped((turns * period) % period, period)
    np.testing.assert_allclose(found - found[0], period * (turns - turns[0]), atol=1e-6 * period)
    longest = np.max(np.abs(np.diff(turns)))
    assert (doubt == 0) == (longest <= 0.4) or abs(longest - 0.4) < 1e-6


def test_a_speed_that_jumps_near_half_a_period_is_said():
    turns = np.cumsum(np.random.default_rng(6).uniform(-0.45, 0.45, 300))
    _, doubt = unwrapped((360 * turns) % 360, 360.0)
    assert 0.43 < doubt <= 0.45


def table(name="enc", values=None):
    values = wrapped(TURNS, 4096.0, 0.0, 1.0) if values is None else values
    return Table(Path("a.npz"), {"t": 0.01 * K, "u": np.sign(np.sin(0.1 * K)), name: values})


def test_a_record_says_it_and_unwraps_on_request_before_it_scales():
    record = Record.from_file(table(), ["u"], ["enc"], time="t")
    (found,) = record.doubts
    assert (found.kind, found.values["name"], found.values["period"]) == (FindingKind.WRAPS, "enc", 4096)
    scale = {"enc": 2 * np.pi / 4096}
    record = Record.from_file(table(), ["u"], ["enc"], time="t", unwrap={"enc": 4096}, scale=scale)
    assert record.doubts == ()
    turned = (record.output[:, 0] - record.output[0, 0]) / (2 * np.pi)
    np.testing.assert_allclose(turned, TURNS - TURNS[0], atol=1 / 4096)


@pytest.mark.parametrize(
    ("unwrap", "words"),
    [
        ({"enc": 1000}, "'enc' .*4092.*1000"),
        ({"enc": 0}, "'enc' .*positive.*0"),
        ({"enc": float("nan")}, "'enc' .*positive.*nan"),
        ({"t": 360}, "'t'"),
    ],
)
def test_a_period_that_cannot_be_is_refused(unwrap, words):
    with pytest.raises(ValueError, match=words):
        Record.from_file(table(), ["u"], ["enc"], time="t", unwrap=unwrap)


@pytest.mark.parametrize("amplitude", [0.02, 1.0, 300.0])
@pytest.mark.parametrize("times", [5.0, 6.5, 8.0])
@pytest.mark.parametrize("rows", [(701,), (701, 2500), (1310, 1311)], ids=["one", "two", "in a row"])
def test_outliers_of_a_few_amplitudes_are_no_wraps(amplitude, times, rows):
    rng = np.random.default_rng(3)
    motion = amplitude * (np.sin(0.01 * K) + 0.001 * rng.standard_normal(K.size))
    motion[list(rows)] = times * amplitude
    assert wraps_at(motion) == 0
    assert wraps_at(-motion) == 0
