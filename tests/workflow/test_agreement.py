"""`flexlink identify` and `flexlink run` find the same numbers in the same logs; the data decide how logs of
a loop are used."""

import json
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from control_design import Controller
from ident import IdentOptions, Record
from ident.command_timing import timing_of
from ident.data.finding import FindingKind
from tests.workflow.test_init import DT_S, recorded, write
from workflow.commands.logs import read_logs
from workflow.config.run_config import ClosedLoopData, RunConfig
from workflow.config.settings import check
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.tasks.identification import identify_channels, made_in_loop, with_stated_controller
from workflow.tasks.log_identification import identify_records
from workflow.tasks.records import make_records
from workflow.tasks.results import IdentifiedChannel, UncertainChannel
from workflow.tasks.stage import StageInput
from workflow.tasks.uncertainty import find_uncertainty

NAMES = ("time_s", "r_rad", "u_A", "y_rad")
NO_REFERENCE = ("time_s", "", "u_A", "y_rad")


def open_loop(seed: int) -> tuple[np.ndarray, ...]:
    """A mode at 40 rad/s and sensor noise that is a random walk, no white one."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 400), 5)
    pole = np.exp((-4 + 40j) * DT_S)
    y = lfilter([0.0, 0.01], [1.0, -2 * pole.real, abs(pole) ** 2], u)
    return np.arange(u.size) * DT_S, np.zeros(u.size), u, y + np.cumsum(0.003 * rng.standard_normal(u.size))


def in_loop(seed: int, *, coulomb: float) -> tuple[np.ndarray, ...]:
    return tuple(column[:2500] for column in recorded(seed, rms=0.2, coulomb=coulomb))


# How a log is made, its reference, what is said of it, and how it is used.
CASES = {
    "open loop": (open_loop, None, {}, None),
    "in a band": (open_loop, None, {"band_rad_s": (10.0, 200.0)}, None),
    "reference": (partial(in_loop, coulomb=0.0), "r_rad", {}, FindingKind.TWO_STAGE),
    "friction": (
        partial(in_loop, coulomb=0.03), "r_rad",
        {"described": UncertaintyOptions(response="without friction"),
         "options": IdentOptions(integrators=1)}, FindingKind.DIRECT_WITH_FRICTION,
    ),
}  # fmt: skip


def by_run(
    logs, reference, options=None, described=None, band_rad_s=None, loop=None, **source
) -> tuple[IdentifiedChannel, UncertainChannel]:
    """The channel of a configuration that says no more than it has to."""
    channel = {"input": "u_A", "output": "y_rad"}
    channel |= {} if band_rad_s is None else {"band_rad_s": band_rad_s}
    channel |= {} if options is None else {"identification": {"integrators": options.integrators}}
    channel |= {} if described is None else {"uncertainty": {"response": described.response}}
    roles = ["estimation"] * (len(logs) - 1) + ["validation"]
    records = [{"path": str(path), "role": role} for path, role in zip(logs, roles, strict=True)]
    document: dict[str, Any] = {
        "source": {"kind": "files", "time": "time_s", "records": records, **source},
        "channels": [channel],
        "specification": {"bandwidth_rad_s": 1.0},
    }
    document["source"] |= {} if reference is None else {"references": [reference]}
    document |= {} if loop is None else {"closed_loop_data": loop}
    results = SimpleNamespace()
    stage = StageInput(check(RunConfig, document, source="test"), results, Progress())
    results.records = make_records(stage)
    results.identify = identify_channels(stage)
    results.uncertainty = find_uncertainty(stage)
    return results.identify.channels[0], results.uncertainty.channels[0]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param("friction", marks=pytest.mark.slow),  # it goes through every stage
        *(pytest.param(k, marks=pytest.mark.long) for k in ("open loop", "in a band", "reference")),
    ],
)
def test_the_same_numbers_by_identify_and_by_run(case, tmp_path):
    made, reference, settings, way = CASES[case]
    signals = [made(k) for k in (1, 2)]
    names = NAMES if reference else (NAMES[0], "", *NAMES[2:])
    logs = write(tmp_path, [*signals, signals[0]], names)
    read = read_logs(logs[:-1], validation=logs[-1:])  # columns as names and units say
    timing = timing_of([*read.measured, *read.fresh], in_loop=made_in_loop(read.measured))
    found = identify_records(read.measured, read.fresh, timing=timing, **settings)
    about, spread = by_run(logs, reference, **settings)
    np.testing.assert_array_equal(about.model.poles.pairs, found.about.model.poles.pairs)
    np.testing.assert_array_equal(about.model.poles.real, found.about.model.poles.real)
    assert about.modes
    assert spread.intervals == found.spread.intervals
    np.testing.assert_array_equal(spread.frequency.omega_rad_s, found.spread.frequency.omega_rad_s)
    np.testing.assert_array_equal(spread.frequency.centre, found.spread.frequency.centre)
    np.testing.assert_array_equal(spread.frequency.covariance, found.spread.frequency.covariance)
    assert spread.noise_order == found.spread.noise_order
    assert about.fit_percent == found.about.fit_percent
    assert (about.closed_loop and about.closed_loop.kind) == way
    assert about.closed_loop == found.about.closed_loop
    assert (*about.identification.warnings, *spread.advice) == found.careful


GAIN, MODE = 8.0, np.exp((-3 + 30j) * 0.01)


def noisy_loop(seed: int) -> tuple[np.ndarray, ...]:
    """u = 8 (r - y) at once, y a mode of 30 rad/s with as much coloured noise as motion."""
    rng = np.random.default_rng(seed)
    n, a1, a2 = 2000, 2 * MODE.real, -(abs(MODE) ** 2)
    noise = lfilter([1.0], [1.0, -0.9], 0.05 * rng.standard_normal(n))
    r = 0.3 * np.repeat(rng.choice([-1.0, 1.0], n // 4), 4)
    x, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        x[k] = a1 * x[k - 1] + a2 * x[k - 2] + 0.02 * u[k - 1] if k > 1 else 0.0
        u[k] = GAIN * (r[k] - x[k] - noise[k])
    return np.arange(n) * 0.01, r, u, x + noise


@pytest.fixture
def noisy_logs(tmp_path):
    return write(tmp_path, [noisy_loop(k) for k in (1, 2, 3)], NO_REFERENCE)


def share_held(spread: UncertainChannel) -> float:
    """Of the frequencies that were excited, how many ellipses hold the truth."""
    omega = spread.frequency.omega_rad_s
    late = np.exp(-0.01j * omega)
    true = 0.02 * late / (1 - 2 * MODE.real * late + abs(MODE) ** 2 * late**2)
    return float(np.mean(spread.frequency.contains(true)[omega > 1]))


def test_noise_in_a_loop_without_reference_is_refused(flexlink, noisy_logs):
    command = ("identify", *noisy_logs, "--pairs", 1, "--real", 0)
    answer = flexlink(*command)
    assert (answer.code, answer.out, answer.err.count("\n")) == (2, "", 1)
    assert "flexlink excite --closed-loop" in answer.err
    assert "take the input as it is (--loop-method direct)" in answer.err
    with pytest.raises(InputError, match=r"\(closed_loop_data.method = 'direct'\)"):
        by_run(noisy_logs, None)
    told = flexlink(*command, "--loop-method", "direct", "--json").document()["numbers"]["closed_loop"]
    assert told["method"] == "direct"
    assert "as specified: what the loop feeds back moves the response" in told["reason"]


@pytest.mark.slow
def test_a_stated_controller_opens_the_loop(tmp_path):
    law = Controller.proportional(GAIN, 0.01, computational_delay_samples=0)
    matrices = {"A": [[0.5]], "B": [[0.0]], "C": [[1.0]], "D": [[GAIN]], "dt_s": 0.01}
    files = {"controller.json": law.to_dict(), "matrices.json": matrices}
    for name, content in files.items():
        (tmp_path / name).write_text(json.dumps(content))
    stated = [{"controller_file": str(tmp_path / name)} for name in files]
    # The command is logged with its sign turned and halved: so is the controller of these logs.
    turned = write(tmp_path, [(t, r, -u / 2, y) for t, r, u, y in map(noisy_loop, (1, 2, 3))], NO_REFERENCE)
    half = {"controller": {"numerator": [-GAIN / 2], "denominator": [1.0]}}
    about, spread = by_run(turned, None, loop=half, scale={"u_A": -2.0})
    assert about.closed_loop.kind is FindingKind.INDIRECT
    assert about.closed_loop.values["least_percent"] > 50
    assert about.modes[0].omega_rad_s == pytest.approx(30.0, rel=0.05)
    assert share_held(spread) > 0.9
    # Whatever form it has, it tells the reference behind its numerator: 8, or 8 (1 - 0.5/z).
    _, reference, u, y = noisy_loop(1)
    record = Record(u[:, None], y[:, None], 0.01, name="a", input_names=("u_A",), output_names=("y_rad",))
    behind, less = GAIN * reference, GAIN * (reference[1:] - 0.5 * reference[:-1])
    plain = {"controller": {"numerator": [GAIN], "denominator": [1.0]}}
    for form, told in zip((plain, *stated), (behind, behind, less), strict=True):
        (opened,) = with_stated_controller([record], check(ClosedLoopData, form, source="test"))
        np.testing.assert_allclose(opened.reference[:, 0], told, atol=1e-12)


def test_a_clean_sensor_needs_no_reference_and_a_still_one_is_none(tmp_path):
    signals = [in_loop(k, coulomb=0.0) for k in (1, 2, 1)]
    logs = write(tmp_path, [(t, 0 * r, u, y) for t, r, u, y in signals], NAMES)
    about, _ = by_run(logs, "r_rad", IdentOptions(integrators=1))
    assert about.closed_loop.kind is FindingKind.DIRECT
    assert about.closed_loop.values["why"] in ("clean", "small")


def test_what_contradicts_itself_is_refused(noisy_logs):
    for loop, words in (
        ({"method": "indirect"}, "needs the controller of the loop"),
        ({"method": "direct", "controller": {"numerator": [1], "denominator": [1]}}, "uses no controller"),
        ({"controller": {"numerator": [1, 2], "denominator": [1]}}, "of at least the numerator's degree"),
        ({"controller_file": "gone.json"}, "no such file"),
    ):
        with pytest.raises(InputError, match=words):
            by_run(noisy_logs, None, loop=loop)
