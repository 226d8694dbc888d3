"""Logs that their columns alone show to be hopeless or doubtful; nothing is said of good ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ident import Record
from ident.checks import early_checks
from ident.checks.early_checks import copied_column, early_doubts, refuse_hopeless
from ident.data.finding import FindingKind
from ident.data.record_files import read_table
from ident.data.roles import roles_of

N = 3000
DT_S = 0.005
ARM = ([0, 0.02, 0.01], np.polymul([1, -1.9, 0.93], [1, -0.8]))


def held(rng, samples=6, n=N):
    return np.repeat(rng.standard_normal(n // samples + 1), samples)[:n]


def opened(seed=0, noise=1e-3):
    rng = np.random.default_rng(seed)
    command = held(rng)
    return {"u": command, "y": lfilter(*ARM, command) + noise * rng.standard_normal(N)}


def looped(seed=0, noise=1e-3, limit=np.inf, gain=0.5):
    """An integrating arm under a P loop: y' = u + disturbance, the sensor with noise."""
    rng = np.random.default_rng(seed)
    reference = held(rng, 30)
    signals = {"r": reference, "u": np.zeros(N), "y": np.zeros(N)}
    position = speed = 0.0
    for k in range(N):
        signals["y"][k] = position + noise * rng.standard_normal()
        signals["u"][k] = np.clip(gain * (reference[k] - signals["y"][k]), -limit, limit)
        speed += 0.1 * (signals["u"][k] - speed)
        position += 0.2 * speed
    return signals


def record(signals, **changed):
    signals = signals | changed
    of_loop = {"reference": signals["r"][:, None], "reference_names": ("r",)} if "r" in signals else {}
    return Record(signals["u"][:, None], signals["y"][:, None], DT_S, name="log", **of_loop)


def complaint(*records, loop=False, order=0):
    try:
        refuse_hopeless(records, early_checks.early_checks(order, loop=loop))
    except ValueError as error:
        line = str(error)
        assert "\n" not in line
        assert line.startswith("record 'log': ")
        return line
    return ""


def speaker(*records, loop=False):
    """Name of the check whose complaint is heard; None where all are silent."""
    for check in early_checks.early_checks(loop=loop):
        if check.complaint(records):
            assert check.complaint(records) == complaint(*records, loop=loop)
            return check.name
    return None


def late(signals):
    return np.where(np.arange(N) < N - 30, 0.0, signals["u"])


def at_end(signals):
    return np.where(np.arange(N) % 100 == 50, 0.1 * signals["y"], 1.57)


def first_rows(signals):
    return {name: column[:50] for name, column in signals.items()}


def two_values(signals):
    return {"y": 0.5 * (signals["y"] > 0)}


COPY = "the output is no other column again"
PLACE = "the output leaves its place"
# How a log is made, what is changed, which check speaks, what its complaint names.
HOPELESS = {
    "still output": (opened, lambda s: {"y": 0 * s["y"] + 0.3}, "the output moves", "'y' 0.3"),
    "still input": (opened, lambda s: {"u": 0 * s["u"]}, "the input moves", "'u' (0)"),
    "all zeros": (looped, lambda s: {"u": 0 * s["u"], "y": 0 * s["y"]}, "the input moves", "'u' (0)"),
    "50 samples": (opened, first_rows, "more samples than a residual test needs", "50"),
    "late step": (opened, lambda s: {"u": late(s)}, "the command moves before the end", "'u' 30"),
    "two readings": (opened, two_values, "more than one step of the sensor", "'y' 0.5"),
    "lost digits": (opened, lambda s: {"y": 1e9 + 1e-10 * s["y"]}, "the output moves", "'y'"),
    "sensor at its end": (opened, lambda s: {"y": at_end(s)}, PLACE, "'y' 1.57 30 3000"),
    "output is the command": (opened, lambda s: {"y": 3 - 2 * s["u"]}, COPY, "'y' input 'u'"),
    "output is the reference": (looped, lambda s: {"y": 1.0 * s["r"]}, COPY, "'y' reference 'r'"),
}  # fmt: skip


@pytest.mark.parametrize("kind", HOPELESS)
def test_hopeless_logs_are_refused_by_their_check_with_column_and_number(kind):
    make, change, check, facts = HOPELESS[kind]
    signals = make()
    hopeless = record(signals, **change(signals))
    assert speaker(hopeless) == check
    assert all(fact in complaint(hopeless) for fact in facts.split())
    assert complaint(record(signals)) == ""


@pytest.mark.parametrize("make", [opened, pytest.param(looped, marks=pytest.mark.long)])
def test_the_output_of_another_machine_is_named(make):
    """Held commands of two machines that move at the same samples. Chance passes for an answer now and then:
    ten tests, each of many lines or lags, at a thousandth."""
    named = 0
    for seed in range(6):
        named += speaker(record(make(seed), y=make(seed + 50)["y"])) == "the output answers"
    assert named >= 5


@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_that_shows_noise_in_a_loop_does_not_answer(seed):
    """The command follows the noise, and so do earlier commands: only the reference tells."""
    rng = np.random.default_rng(seed)
    noise = lfilter([1], [1, -0.7], rng.standard_normal(N))
    reference = held(rng, 30)
    log = record({"r": reference, "u": reference - noise, "y": noise})
    assert speaker(log) == "the output answers"


@pytest.mark.parametrize("seed", range(4))
def test_good_logs_are_not_refused_nor_doubted(seed):
    rng = np.random.default_rng(seed)
    step = (np.arange(N) > 200).astype(float)
    sines = np.sin(0.05 * np.arange(N)) + np.sin(0.21 * np.arange(N) + 1)
    ramp = np.cumsum(lfilter([0, 0.1], [1, -0.9], step)) + 0.01 * rng.standard_normal(N)
    binary = np.sign(held(rng))
    good = [
        opened(seed),
        opened(seed, noise=0.3),
        looped(seed),
        looped(seed, noise=0.05),
        {"u": binary, "y": lfilter(*ARM, binary)},
        {"u": step, "y": ramp},
        {"u": sines, "y": lfilter(*ARM, sines)},
        {"u": held(rng), "y": np.zeros(N)},
    ]
    delayed = good[-1]
    delayed["y"][900:] = lfilter(*ARM, delayed["u"])[:-900]
    delayed["y"] += 0.05 * rng.standard_normal(N)
    for signals in good:
        assert complaint(record(signals)) == ""
        assert early_doubts([record(signals)]) == []


def test_one_good_log_among_hopeless_ones_is_enough():
    signals = opened()
    short = {name: column[:40] for name, column in signals.items()}
    other = signals | {"y": opened(7)["y"]}
    assert complaint(record(short), record(signals)) == ""
    assert complaint(record(other), record(signals)) == ""
    assert complaint(record(other), record(other)) != ""


def test_a_loop_of_few_frequencies_is_refused_where_it_is_to_be_opened():
    time = np.arange(N) * DT_S
    signals = {"r": np.sin(9 * time), "u": np.sin(9 * time + 1), "y": np.sin(9 * time - 1)}
    band = "the command of a loop excites a band"
    assert speaker(record(signals), loop=True) == band
    assert "1.4" in complaint(record(signals), loop=True)  # 9 rad/s in Hz
    assert complaint(record(signals)) == ""
    still = looped() | {"r": np.ones(N)}
    assert speaker(record(still), loop=True) == band
    assert "'r'" in complaint(record(still), loop=True)
    assert complaint(record(looped()), loop=True) == ""


def test_a_stated_order_is_named():
    signals = {name: column[:12] for name, column in opened().items()}
    line = complaint(record(signals), order=8)
    assert "12" in line
    assert "order 8" in line


def test_readings_that_jump_or_wrap_are_left_to_their_own_words():
    signals = opened()
    jumps = np.where(np.arange(N) == 1234, -9999.0, signals["u"])
    assert complaint(record(signals, u=jumps)) == ""
    turned = np.mod(np.floor(200 * np.cumsum(signals["u"] + 3)), 4096.0)
    assert complaint(record(signals, y=turned)) == ""


def test_what_may_be_meant_is_doubted():
    banging = record(looped(limit=1e-3, gain=1e6))
    (doubt,) = early_doubts([banging])
    assert doubt.kind is FindingKind.SATURATED
    assert (doubt.values["low"], doubt.values["high"]) == (-1e-3, 1e-3)
    assert complaint(banging) == ""
    signals = opened()
    few = record(signals, y=np.round(np.clip(signals["y"] / signals["y"].std(), -2, 2)))
    assert [doubt.kind for doubt in early_doubts([few])] == [FindingKind.FEW_READINGS]
    assert early_doubts([few])[0].values["count"] == 5


@pytest.mark.parametrize(
    ("late", "when"), [(0, "sample by sample"), (1, "a row later"), (40, "40 rows later")]
)
@pytest.mark.parametrize(("times", "level"), [(1.0, 0.0), (2.0, 1.0), (-57.3, 300.0)])
def test_a_reference_that_was_logged_as_the_output_is_told_however_late(late, when, times, level):
    rng = np.random.default_rng(5)
    reference = np.cumsum(rng.standard_normal(3000))
    output = times * np.r_[np.full(late, reference[0]), reference[: 3000 - late]] + level
    # Six digits, as a text log has them.
    digits = [float(f"{value:.6g}") for value in output]
    command = rng.standard_normal(3000)
    record = Record(
        command[:, None], np.array(digits)[:, None], 0.002, name="log", reference=reference[:, None]
    )
    assert f"'y' is the reference column 'r' again, {when}" in copied_column([record])
    # A servo that follows to a thousandth is none.
    near = replace(record, output=record.output * (1 + 1e-3 * rng.standard_normal((3000, 1))))
    assert copied_column([near]) == ""


def of_loop(seed=0, *, drive=0.0, integral=0.0, rows=N):
    """A loop whose reference stands still after row 0; the sensor's noise, and `drive`, move its command."""
    rng = np.random.default_rng(seed)
    added = drive * held(rng, 4)
    signals = {"r": np.full(N, 0.7), "u": np.zeros(N), "y": np.zeros(N)}
    position = speed = summed = 0.0
    for k in range(N):
        signals["y"][k] = position + 1e-2 * rng.standard_normal()
        error = signals["r"][k] - signals["y"][k]
        summed += integral * error
        signals["u"][k] = 0.3 * error + summed + added[k]
        speed += 0.1 * (signals["u"][k] - speed)
        position += 0.2 * speed + 0.01 * rng.standard_normal()
    return {name: column[:rows] for name, column in signals.items()}


@pytest.mark.parametrize("integral", [0.0, 0.003])
@pytest.mark.parametrize("digits", [9, 6])
def test_a_command_that_the_controller_makes_of_the_output_alone_tells_no_machine(integral, digits):
    """A P and a PI loop at a standing reference, moved by noise and an unseen load."""
    still = {name: np.round(column, digits) for name, column in of_loop(integral=integral).items()}
    said = complaint(record(still))
    assert "the reference 'r' stands still" in said
    assert "makes of 'y' alone" in said
    # What is added to the command tells of the machine: no refusal, but a word.
    driven = record(of_loop(integral=integral, drive=0.5))
    assert complaint(driven) == ""
    (doubt,) = [found for found in early_doubts([driven]) if found.kind is FindingKind.REFERENCE_STILL]
    assert doubt.values["name"] == "r"
    assert doubt.values["value"] == pytest.approx(0.7)


def test_one_still_reference_among_moving_ones_is_doubted():
    records = [record(looped(1)), record(of_loop(2, drive=0.5)), record(looped(3))]
    assert complaint(*records) == ""
    kinds = [found.kind for found in early_doubts(records)]
    assert kinds == [FindingKind.REFERENCE_STILL]


@pytest.mark.parametrize(
    ("rows", "in_loop", "words"),
    [
        (60, True, "60 samples are too few to tell a machine from the loop"),
        (96, True, "expected more than 96 in one log"),
        (50, False, "50 samples are too few"),
        (60, False, ""),
    ],
)
def test_a_loop_needs_more_samples_than_a_machine_alone(rows, in_loop, words):
    signals = looped() if in_loop else opened()
    said = complaint(record({name: column[:rows] for name, column in signals.items()}), loop=in_loop)
    assert words in said
    assert bool(said) == bool(words)


def test_a_short_loop_is_not_called_a_limit_cycle():
    """A hundred rows of a fast log hold a swing or two: that is too short, whatever its spectrum."""
    turn = 2 * np.pi * 2 * np.arange(120) / 120
    fast = {"r": np.sin(turn), "u": np.sin(turn + 1), "y": np.sin(turn - 1)}
    said = complaint(record(fast), loop=True)
    assert "120 samples" in said
    assert "record longer" in said
    assert "limit cycle" not in said


def test_a_command_that_stands_at_its_ends_is_named_as_the_reason_where_it_turns_seldom():
    """Saturated by huge slow steps; saturated by fast ones it turns often, and a model can be found."""
    rng = np.random.default_rng(4)
    slow = looped(limit=0.05) | {"r": 30 * held(rng, 1000)}
    fast = looped(limit=0.05)
    for signals in (slow, fast):
        position = speed = 0.0
        for k in range(N):
            signals["y"][k] = position + 1e-3 * rng.standard_normal()
            signals["u"][k] = np.clip(0.5 * (signals["r"][k] - signals["y"][k]), -0.05, 0.05)
            speed += 0.1 * (signals["u"][k] - speed)
            position += 0.2 * speed
    said = complaint(record(slow), loop=True)
    assert "stands at -0.05 or 0.05" in said
    assert "smaller reference" in said
    assert complaint(record(fast), loop=True) == ""
    assert [found.kind for found in early_doubts([record(fast)])] == [FindingKind.SATURATED]


@pytest.mark.parametrize(
    ("name", "is_named"), [("ref_rad", True), ("pos_soll_rad", True), ("i_ref_A", False), ("gear", False)]
)
def test_a_set_point_of_the_output_that_stands_still_is_not_dropped_in_silence(tmp_path, name, is_named):
    """A constant column is no reference, but one that is called so is named; others are passed over."""
    path = tmp_path / "log.csv"
    rows = np.column_stack(
        [np.arange(200) * DT_S, opened()["u"][:200], opened()["y"][:200], np.full(200, 0.25)]
    )
    np.savetxt(path, rows, delimiter=",", header=f"t_s,u_V,pos_rad,{name}", comments="")
    roles = roles_of(read_table(path), str(path))
    assert (roles.input, roles.output, roles.reference) == ("u_V", "pos_rad", None)
    assert [dict(doubt.values) for doubt in roles.doubts] == [
        {"name": name, "value": 0.25, "record": ""} for _ in range(is_named)
    ]


def held_speed(edges, *, seed=0, rows=4000):
    """Speed of a driven shaft (u to v), and what a Hall sensor with so many edges a turn tells of it."""
    rng = np.random.default_rng(seed)
    command = 1.0 + 0.1 * held(rng, 40, rows)
    speed = 40 * lfilter([0.005], [1, -0.995], command - 1.0) + 40.0
    angle = np.cumsum(speed) * DT_S / 10
    edge = np.floor(angle / (2 * np.pi / edges))
    signals = {"u": command, "y": speed.copy()}
    last = 0
    reading = speed[0]
    for k in range(1, rows):
        if edge[k] > edge[k - 1]:
            reading = (angle[k] - angle[last]) / (k - last)
            last = k
        signals["y"][k] = reading
    return signals


@pytest.mark.parametrize("edges", [24, 42, 60])
def test_readings_that_a_sensor_holds_are_doubted_with_the_rate_it_tells(edges):
    logged = record(held_speed(edges))
    assert complaint(logged) == ""
    (doubt,) = [found for found in early_doubts([logged]) if found.kind is FindingKind.READINGS_HELD]
    rows = 2 * np.pi / edges / (40.0 * DT_S / 10)  # between two edges at the mean speed
    assert doubt.values["fewest"] <= rows <= doubt.values["most"] + 1
    assert doubt.values["from_rad_s"] == pytest.approx(1 / (doubt.values["most"] * DT_S))


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.05])
def test_a_coarse_encoder_holds_nothing(step):
    """It repeats readings, too, near standstill; but goes on by a step."""
    signals = opened()
    output = lfilter([0.02], [1, -0.98], signals["u"])
    if step:
        output = step * np.round(output / step)
    kinds = [found.kind for found in early_doubts([record(signals | {"y": output})])]
    assert FindingKind.READINGS_HELD not in kinds
