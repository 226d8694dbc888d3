"""Closed-loop logs that cannot carry a model, or look as if they could not: one line with the next step, or
the right answer; never a traceback, never a wrong model.

The machine is two inertias on a spring with dry friction, from the independent simulator of
`benchmarks.closed_loop_machines`. What is taken is run up to its design, and compared with the truth.
"""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.closed_loop_machines.judge import read_law, violations
from benchmarks.closed_loop_machines.simulator import Law, Plant, response
from tests.workflow.command import perform_stages
from workflow.engine.errors import InputError
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults
from workflow.tasks.stages import ONE_LOOP

DT_S, PERIOD = 0.004, 1500
MOTOR, LOAD, ANTIRESONANCE, TORQUE, COULOMB = 2e-3, 5e-3, 2 * np.pi * 5.0, 0.6, 0.03
REACHED = "its design is reached"
COLUMNS = {"t_s": "t", "ref_rad": "r", "i_cmd_A": "u", "enc_rad": "y"}
NO_REFERENCE = {name: key for name, key in COLUMNS.items() if key != "r"}


def plant(*, load=LOAD, limit=np.inf, stiction=COULOMB, count=2 * np.pi / 16384):
    stiffness = LOAD * ANTIRESONANCE**2
    damping = 0.1 * np.sqrt(stiffness / (1 / MOTOR + 1 / LOAD))
    friction = np.array([[COULOMB, stiction, 0.05, 0, 0], [0, 0, 1, 0, 0]])
    return Plant(
        np.array([MOTOR, load]), np.array([4e-3, 0]), np.zeros(2), np.array([[0, 1, stiffness, damping, 0]]),
        friction, np.zeros(3), TORQUE, 0, 1.0, DT_S, 1, count, limit,
    )  # fmt: skip


def pid(p=1.0, d=0.06, i=0.0):
    """u = p e + d de/dt (over 6 ms) + i times the integral of e."""
    keep = np.exp(-DT_S / 0.006)
    steep, one = d * (1 - keep) / DT_S, np.array([1.0, -1.0])
    b = np.array([(1 - keep) * one, i * DT_S * one])
    return Law(np.diag([keep, 1.0]), b, np.array([-steep, 1.0]), (p + steep) * one, np.zeros(2))


def multisine(rng, rms):
    lines = np.arange(2, round(25 * PERIOD * DT_S))
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size)) / np.hypot(1, lines / (2 * PERIOD * DT_S))
    signal = np.fft.irfft(spectrum, PERIOD)
    return np.tile(rms * signal / signal.std(), 3)


def log(seed, rms=0.2, *, machine=None, law=None, reference=None, noise=0.0):
    """The last two of three periods: t, r, u, y and `applied`, the command behind the amplifier's limit."""
    rng = np.random.default_rng(seed)
    r = multisine(rng, rms) if reference is None else reference
    got = (machine or plant()).run(law or pid(), r, 0.0, noise * rng.standard_normal(r.size))
    late = {name: got[name][PERIOD:] for name in ("u", "y")}
    limit = np.inf if machine is None else machine.limit
    r = r[PERIOD:]
    return {"t": np.arange(r.size) * DT_S, "r": r, **late, "applied": np.clip(late["u"], -limit, limit)}


def logs(*, levels=(0.2, 0.1, 0.15), **how):
    return [log(k, rms, **how) for k, rms in enumerate(levels, 1)]


def written(folder, made, columns=COLUMNS):
    paths = []
    for k, one in enumerate(made, 1):
        paths.append(folder / f"run{k}.csv")
        table = np.column_stack([one[key] for key in columns.values()])
        np.savetxt(paths[-1], table, "%.7g", delimiter=",", header=",".join(columns), comments="")
    return paths


@pytest.fixture
def up_to_design(monkeypatch):
    """`flexlink run` ends before its design."""

    def stop(stage):
        raise InputError(REACHED)

    stages = [replace(one, run=stop) if one.name == "design" else one for one in ONE_LOOP.stages]
    perform_stages(monkeypatch, stages)


@pytest.fixture
def taken(flexlink, tmp_path, up_to_design):
    """Results of `run` on logs that have to be taken."""

    def run(paths):
        answer = flexlink("run", *paths, "--out", tmp_path / "out")
        assert REACHED in answer.err, answer.err
        return RunResults(RunDirectory.open(tmp_path / "out"))

    return run


@pytest.fixture
def records(flexlink, tmp_path, monkeypatch):
    """Records that `run` makes of logs, and its configuration; nothing is identified."""
    seen = []

    def stop(stage):
        seen.append((stage.results.records.records, stage.config))
        raise InputError(REACHED)

    stages = [replace(one, run=stop) if one.name == "identify" else one for one in ONE_LOOP.stages]
    perform_stages(monkeypatch, stages)

    def run(paths):
        answer = flexlink("run", *paths, "--out", tmp_path / "out")
        assert REACHED in answer.err, answer.err
        return seen.pop()

    return run


@pytest.fixture
def line(flexlink, tmp_path, up_to_design):
    """The one line with which `run` refuses logs; nothing is left of it."""

    def ask(paths):
        answer = flexlink("run", *paths, "--out", tmp_path / "out")
        assert (answer.code, answer.out, (tmp_path / "out").exists()) == (2, "", False), answer
        *doubts, refusal = answer.err.splitlines()
        assert all(doubt.startswith("flexlink: doubt: ") for doubt in doubts), answer.err
        assert REACHED not in answer.err
        return refusal

    return ask


def assert_right(results, *, share=0.02, friction=0.02):
    """First mode, friction and response between .5 and 25 Hz are the true ones, within so much."""
    channel, machine = results.uncertainty.channels[0], plant()
    a, b, c = machine.sampled()
    pole = max(np.linalg.eigvals(machine.linear()[0]), key=np.imag)
    model = results.identify.channels[0].model
    (omega,) = model.poles.omega_rad_s(DT_S)
    assert omega == pytest.approx(abs(pole), rel=share)
    assert results.identify.friction.level == pytest.approx(COULOMB / TORQUE, rel=friction)
    at = np.geomspace(3, 150, 100)
    error = channel.posterior.at(at).centre / response(a, b, c, at, DT_S) - 1
    assert np.median(np.abs(error)) < share


@pytest.mark.long
def test_two_controllers_are_taken(taken, tmp_path):
    made = [log(1), log(2, law=pid(1.5, 0.08)), log(4, 0.12)]
    # Measured: .03 % of the response.
    assert_right(taken(written(tmp_path, made)))


def faster(one):
    """Of a logger that writes every sample four times."""
    several = {key: np.repeat(values, 4) for key, values in one.items()}
    return several | {"t": np.arange(several["t"].size) * DT_S / 4}


# Of the encoder; a turned sign of the command: tests/workflow/test_init.py.
@pytest.mark.parametrize(
    ("change", "side"),
    [
        pytest.param(lambda one: {**one, "y": -one["y"]}, -1, marks=pytest.mark.long),
        pytest.param(faster, 1, marks=pytest.mark.slow),
    ],
    ids=["turned", "faster"],
)
def test_what_a_log_is_otherwise_is_taken_back(records, tmp_path, change, side):
    """A model of the same signals is the same: the records are those of the logs as they are, or command and
    encoder have both the other sign."""
    made = logs(levels=(0.2, 0.15))
    plain, _ = records(written(tmp_path, made))
    found, _ = records(written(tmp_path, map(change, made)))
    for own, other in zip(found, plain, strict=True):
        assert own.record.dt_s == other.record.dt_s
        np.testing.assert_array_equal(side * own.record.output, other.record.output)
        np.testing.assert_allclose(side * own.record.input, other.record.input, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("column", ["u", pytest.param("applied", marks=pytest.mark.slow)])
def test_a_limit_of_the_amplifier_is_seen_before_and_after_it(records, tmp_path, column):
    made = logs(levels=(0.2, 0.2), machine=plant(limit=0.5))
    found, config = records(written(tmp_path, made, COLUMNS | {"i_cmd_A": column}))
    assert config.source.input_limit == 0.5
    for item, one in zip(found, made, strict=True):
        np.testing.assert_allclose(item.record.input[:, 0], one["applied"], rtol=1e-6)


@pytest.mark.long
def test_a_noisy_sensor_without_a_reference_widens(taken, tmp_path):
    """Noise a tenth of the motion: measured 1.6 % of the response, 3 % of the friction."""
    assert_right(taken(written(tmp_path, logs(noise=0.02), NO_REFERENCE)), share=0.05, friction=0.1)


def test_one_log_has_its_last_part_validate(records, tmp_path):
    reference = np.tile(multisine(np.random.default_rng(1), 0.2), 2)
    made = log(1, reference=reference)
    found, _ = records(written(tmp_path, [made]))
    assert [item.role for item in found] == ["estimation", "validation"]
    first, last = (item.record.input[:, 0] for item in found)
    np.testing.assert_allclose(np.append(first, last), made["u"], rtol=1e-6)
    assert 0.2 < last.size / made["u"].size < 0.5


def sine(k):
    return 0.1 * (1 + k) * np.sin(2 * np.pi * 1.5 * DT_S * np.arange(3 * PERIOD))


def kick(k):
    return np.where(np.arange(3 * PERIOD) < 100, 0.5 * k, 0.0)


def step(k):
    return np.where(np.arange(3 * PERIOD) > 300, 0.1 * k, 0.0)


SINE = "sine or a limit cycle"


@pytest.mark.parametrize(
    ("reference", "law", "machine", "columns", "words"),
    [
        (sine, pid(), plant(), COLUMNS, SINE),
        (sine, pid(), plant(), NO_REFERENCE, SINE),
        (kick, pid(3.0, -0.03), plant(limit=1.0), COLUMNS, "stands still, and the command"),
        (kick, pid(3.0, -0.03), plant(limit=1.0), NO_REFERENCE, SINE),
        (step, pid(1.0, 0.06, 4.0), plant(stiction=2 * COULOMB), COLUMNS, "too few to tell a machine"),
    ],
    ids=["sine", "sine, no reference", "limit cycle", "limit cycle, no reference", "hunting"],
)
def test_few_frequencies_are_refused(line, refused, tmp_path, reference, law, machine, columns, words):
    made = [log(k, reference=reference(k), law=law, machine=machine) for k in (1, 2, 3)]
    paths = written(tmp_path, made, columns)
    said = line(paths)
    assert words in said
    assert "flexlink excite --closed-loop" in said
    if "ref_rad" in columns and np.ptp(made[0]["r"]) > 0:
        named = "--reference", "ref_rad", "--input", "i_cmd_A", "--output", "enc_rad", "--integrators", 1
        assert "sine or a limit cycle" in refused("identify", *paths, *named)


def test_two_references_are_asked_about(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # long paths cut the words
    made = [{**one, "s": 0.9 * one["r"]} for one in logs(levels=(0.2, 0.1))]
    said = line(written(Path(), made, COLUMNS | {"soll_rad": "s"}))
    assert "ref_rad and soll_rad may be the reference of 'enc_rad'" in said
    assert "--reference ref_rad" in said


def test_a_log_without_motion_is_named(line, tmp_path):
    made = [log(k, reference=1e-3 * multisine(np.random.default_rng(k), 1.0)) for k in (1, 2)]
    assert "'enc_rad' stands still" in line(written(tmp_path, made))


def before_lag(signal, a):
    return lfilter([1, -a], [1 - a], signal)


def other_load(one, k):
    return log(k, machine=plant(load=3 * LOAD)) if k == 1 else {}


TWO, THREE = (0.2, 0.15), (0.2, 0.1, 0.15)


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "said", "levels"),
    [
        (lambda one, k: {"u": log(10 + k)["u"]}, "'enc_rad'", TWO),
        (other_load, "explains these logs", THREE),
    ],
    ids=["command of another axis", "another load"],
)
def test_logs_that_contradict_an_arm_are_refused(line, tmp_path, change, said, levels):
    made = [one | change(one, k) for k, one in enumerate(logs(levels=levels))]
    assert said in line(written(tmp_path, made))


@pytest.mark.long
def test_a_second_output_behind_the_friction_is_refused(flexlink, refused, tmp_path, up_to_design):
    made = [one | {"tip": lfilter([0.3], [1, -0.7], one["y"])} for one in logs(levels=(0.2, 0.15))]
    paths, config = written(tmp_path, made, COLUMNS | {"tip_m": "tip"}), tmp_path / "my.toml"
    assert flexlink("init", *paths, "--out", config).code == 0
    more = '[[channels]]\ninput = "i_cmd_A"\noutput = "tip_m"\npurpose = "performance"\n'
    more += "[channels.identification]\nintegrators = 1\n[channels.uncertainty]\n"
    config.write_text(f'{config.read_text()}\n{more}response = "without friction"\n')
    said = refused("run", "--config", config, "--out", tmp_path / "out")
    assert "leave this channel out, or give it response = 'as recorded'" in said


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_what_is_taken_is_certified_and_holds_on_the_true_machine(flexlink, tmp_path):
    """Logged with the sign of its command turned: the controller's files are for the machine as logged."""
    machine = plant(limit=0.5)
    more = {"machine": machine}
    made = [log(1, **more), log(2, law=pid(1.5, 0.08), **more), log(3, 0.15, **more)]
    paths = written(tmp_path, [{**one, "u": -one["u"]} for one in made])
    answer = flexlink("run", *paths, "--out", tmp_path / "out", "--json")
    assert answer.document()["certified"]
    said = answer.document()["numbers"]["signals"]
    assert said == (
        "error: reference - measurement of enc_rad [rad]; command: i_cmd_A as logged (A = -1 * column)"
    )
    for name in ("controller.h", "controller.c", "controller.json"):
        assert said in (tmp_path / "out" / name).read_text(), name
    results = RunResults(RunDirectory.open(tmp_path / "out"))
    (verdict,) = results.certify.certificate.plants
    law, delay = read_law(tmp_path / "out" / "controller.json")
    stated = {"worst_margins": vars(verdict.worst_margins), "bandwidth_rad_s": verdict.bandwidth_rad_s}
    assert violations(replace(plant(), delay=1 + delay, torque_per_u=-TORQUE), 0.0, law, stated) == []


@pytest.mark.slow
def test_the_configuration_of_a_run_of_logs_runs_again_to_the_same(flexlink, refused, tmp_path, taken):
    """Its specification follows from the model: a band around its mode, whatever was taken for it before."""
    paths = written(tmp_path, logs(levels=(0.2, 0.15)))
    first = taken(paths)
    pole = max(np.linalg.eigvals(plant().linear()[0]), key=np.imag)
    config = tmp_path / "out" / "config.toml"
    low, high = tomllib.loads(config.read_text())["specification"]["mode_band_rad_s"]
    assert low < abs(pole) < high
    assert REACHED in flexlink("run", "--config", config, "--out", tmp_path / "again").err
    again = RunResults(RunDirectory.open(tmp_path / "again"))
    assert np.array_equal(
        again.uncertainty.channels[0].posterior.mean, first.uncertainty.channels[0].posterior.mean
    )
    assert "not both" in refused("run", *paths, "--config", config, "--out", tmp_path / "third")
    assert "name them, as in flexlink run LOG... --unwrap" in refused("run", "--unwrap", "a=1", "--out", "x")


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_the_margins_of_a_drive_that_lags_hold(flexlink, tmp_path):
    """What turns the motor is the command behind a filter: a lag of 7/3 samples after one of dead time."""
    paths = written(tmp_path, [one | {"u": before_lag(one["u"], 0.7)} for one in logs(levels=TWO)])
    assert flexlink("run", *paths, "--out", tmp_path / "out").code == 0
    results, omega = RunResults(RunDirectory.open(tmp_path / "out")), np.geomspace(0.1, np.pi / DT_S, 3000)
    found, (verdict,) = results.identify.friction, results.certify.certificate.plants
    assert found.lag + found.arm.structure.input_delay_samples == pytest.approx(1 + 7 / 3, abs=0.1)
    assert found.level == pytest.approx(COULOMB / TORQUE, rel=0.1)
    machine = response(*plant().sampled(), omega, DT_S) * 0.3 / (1 - 0.7 * np.exp(-1j * omega * DT_S))
    assert (
        np.min(np.abs(1 + results.design.controller.response(omega) * machine))
        > 0.99 * verdict.worst_margins.modulus
    )
