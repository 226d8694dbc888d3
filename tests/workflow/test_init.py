"""`flexlink init`: what it reads off logs of machines simulated here, and that what it writes runs.

The machine is a motor and a load on a spring with dry friction at the motor, integrated here (semi-implicit
Euler, 20 steps a sample) and shared with nothing of the product.
"""

import math
import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest

from workflow.config.run_config import RunConfig, load_config
from workflow.config.settings import check
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.records import read_record
from workflow.tasks.results import RunResults

DT_S, STEPS = 0.002, 20
MOTOR, LOAD, SPRING, DAMPER, VISCOUS, COULOMB = 0.002, 0.004, 4.0, 0.004, 0.01, 0.03
_A = np.zeros((4, 4))
_A[:2, 2:] = np.eye(2)
_A[2] = np.array([-SPRING, SPRING, -DAMPER - VISCOUS, DAMPER]) / MOTOR
_A[3] = np.array([SPRING, -SPRING, DAMPER, -DAMPER]) / LOAD
_POLE = max(np.linalg.eigvals(_A), key=np.imag)
MODE_RAD_S, DAMPING = abs(_POLE), -_POLE.real / abs(_POLE)
REPORTED = Path(__file__).parents[3] / "shared" / "reported" / "closed_loop_friction"


def multisine(rng, n, rms, low_Hz=0.3, high_Hz=30.0):
    lines = np.arange(1, n // 2)
    lines = lines[(lines / (n * DT_S) > low_Hz) & (lines / (n * DT_S) < high_Hz) & (lines % 2 == 1)]
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size)) / np.sqrt(lines)
    signal = np.fft.irfft(spectrum, n)
    return np.tile(rms * signal / signal.std(), 2)


def recorded(
    seed,
    *,
    rms=0.0,
    reference=None,
    gravity=0.0,
    limit=np.inf,
    coulomb=COULOMB,
    closed=True,
    gain=(2.0, 0.06),
):
    """time [s], reference [rad], command [A], encoder [rad] of the motor under a PD controller, or in open
    loop under the reference as the command."""
    reference = multisine(np.random.default_rng(seed), 4000, rms) if reference is None else reference
    # Plain numbers: arrays of two take ten times as long.
    q, load, v, load_v, last, rows = 0.0, 0.0, 0.0, 0.0, 0.0, []
    step = DT_S / STEPS
    for r in np.asarray(reference).tolist():
        encoder = 2 * np.pi / 65536 * round(q * 65536 / (2 * np.pi))
        error = r - encoder
        command = gain[0] * error + gain[1] * (error - last) / DT_S
        command = min(max(command, -limit), limit) if closed else r
        last = error
        rows.append((r, command, encoder))
        for _ in range(STEPS):
            twist = SPRING * (q - load) + DAMPER * (v - load_v)
            against = coulomb * math.tanh(v / 1e-3) + VISCOUS * v + gravity * math.sin(q)
            v += step * (command - against - twist) / MOTOR
            load_v += step * twist / LOAD
            q += step * v
            load += step * load_v
    return np.arange(len(rows)) * DT_S, *np.array(rows).T


@pytest.fixture(scope="module")
def signals():
    return [recorded(seed, rms=rms) for seed, rms in ((1, 0.1), (2, 0.2), (3, 0.15))]


def write(folder, signals, names, units=(1.0, 1.0, 1.0, 1.0), separator=","):
    """CSV files of (time, reference, command, output); a column without a name is left out."""
    paths = []
    for k, columns in enumerate(signals, 1):
        kept = [(n, c * u) for n, c, u in zip(names, columns, units, strict=True) if n]
        path = folder / f"run{k}.csv"
        header = separator.join(name for name, _ in kept)
        rows = np.column_stack([values for _, values in kept])
        np.savetxt(path, rows, "%.9g", delimiter=separator, header=header, comments="")
        paths.append(path)
    return paths


def drafted(flexlink, logs, *options):
    out = logs[0].parent / "my.toml"
    answer = flexlink("init", *logs, "--out", out, *options, "--json")
    document = answer.document()
    assert "certified" not in document  # nothing was
    return document, out.read_text(), load_config(out)[0]


@pytest.mark.usefixtures("unidentified")
@pytest.mark.parametrize(
    ("names", "units", "columns"),
    [
        pytest.param(
            ("t_ms", "ref_rad", "i_cmd_A", "enc_rad"),
            (1e3, 1, 1, 1),
            ("ref_rad", "i_cmd_A", "enc_rad"),
            marks=pytest.mark.long,
        ),
        (
            ("Zeit [s]", "Sollwert [°]", "Strom [A]", "Winkel [°]"),
            (1, 180 / np.pi, 1, 180 / np.pi),
            ("Sollwert [°]", "Strom [A]", "Winkel [°]"),
        ),
        pytest.param(
            ("time_us", "target_counts", "pwm", "position_counts"),
            (1e6, 65536 / (2 * np.pi), 100, 65536 / (2 * np.pi)),
            ("target_counts", "pwm", "position_counts"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_columns_units_and_structure(flexlink, tmp_path, signals, names, units, columns):
    document, text, config = drafted(flexlink, write(tmp_path, signals, names, units))
    seen, channel = document["numbers"]["seen"], config.channels[0]
    assert (config.source.references, channel.input, channel.output) == ((columns[0],), *columns[1:])
    assert [record.role for record in config.source.records] == ["estimation", "estimation", "validation"]
    assert seen["motion"]["friction"]["value"] == pytest.approx(COULOMB * units[2], rel=0.2)
    assert seen["motion"]["inertia"]["value"] == pytest.approx((MOTOR + LOAD) * units[2] / units[3], rel=0.1)
    assert channel.uncertainty.response == "without friction"
    assert "# friction_feedforward = true" in text
    assert channel.identification.integrators == 1
    assert not seen["turned"]
    assert config.specification.integrator
    wish = config.specification
    assert wish.modulus_margin == 0.5
    # What is drafted gives way, and says how far.
    assert wish.lowest_bandwidth_rad_s < wish.bandwidth_rad_s
    assert wish.highest_effort_limit == pytest.approx(4 * wish.effort_limit, rel=0.05)
    assert (wish.highest_mode_peak_ratio is None) == (wish.mode_peak_ratio is None)
    assert f"{1 / DT_S:g} Hz" in text


@pytest.mark.usefixtures("unidentified")
@pytest.mark.parametrize(
    ("names", "factors", "words", "typed"),
    [
        (("t_s", "ref_rad", "u_A", "y_rad"), (1, 1, 180 / np.pi), "'y_rad' follows the reference 'ref_rad'",
         "--scale y_rad=0.01745329252 --unit y_rad=rad"),
        pytest.param(("t_s", "ref_deg", "u_A", "y_deg"), (1, 1, 180 / np.pi),
         "'y_deg' follows the reference 'ref_deg'", "--scale ref_deg=57.29577951", marks=pytest.mark.long),
        pytest.param(("t_s", "ref_mm", "u_A", "y_m"), (1, 1e3, 1),
         "'ref_mm' looks like the reference of 'y_m'", "--reference ref_mm --scale ref_mm=0.001",
         marks=pytest.mark.slow),
        (("t_s", "ref_deg", "u_A", "y_rad"), (1, 1, 1), "the output follows it in numbers as they stand",
         "--reference ref_deg --unit ref_deg=rad"),
    ],
)  # fmt: skip
def test_a_wrong_unit_is_doubted_and_the_next_command_states_it(
    flexlink, tmp_path, signals, names, factors, words, typed
):
    logs = write(tmp_path, signals[:1], names, (factors[0], factors[1], 1, factors[2]))
    # Limits of the terminal cut sentences into lines.
    seen = flexlink("look", logs[0]).out
    assert words in " ".join(seen.replace("│", " ").split())
    assert seen.splitlines()[-1] == f"flexlink run {logs[0]} {typed} --out runs/arm"
    doubted = " ".join(flexlink("init", *logs, "--out", tmp_path / "a.toml").out.replace("│", " ").split())
    assert words in doubted
    assert typed in doubted
    if "--reference" not in typed:  # else nobody told the run of one
        written = load_config(tmp_path / "a.toml")[0]
        (doubt,) = read_record(written.source, written.source.records[0], written.channels).doubts
        assert doubt.values["options"] == typed
    assert "doubts" not in flexlink("init", *logs, *typed.split(), "--out", tmp_path / "b.toml").out


def uncommented(text):
    """Every text with one of the lines that are left out taken in, and the one with all of them."""
    lines = text.splitlines()
    marked = [k for k, line in enumerate(lines) if re.match(r"# \w+ = ", line)]
    for chosen in ([k] for k in marked):
        yield "\n".join(line[2:] if k in chosen else line for k, line in enumerate(lines))
    yield "\n".join(line[2:] if k in marked else line for k, line in enumerate(lines))


@pytest.mark.usefixtures("unidentified")
def test_what_is_left_out_is_valid_and_the_text_is_stable(flexlink, tmp_path, signals):
    for k, names in enumerate((("t_s", "ref_rad", "u_V", "y_rad"), ("t_s", "", "u_V", "enc_counts"))):
        folder = tmp_path / str(k)
        folder.mkdir()
        logs = write(folder, signals[:1], names)
        _, text, _ = drafted(flexlink, logs)
        assert k or drafted(flexlink, logs, "--replace")[1] == text
        texts = list(uncommented(text))
        assert len(texts) > 3
        for changed in texts:
            check(RunConfig, tomllib.loads(changed), source="changed", context={"base": folder})


@pytest.mark.usefixtures("unidentified")
def test_the_sign_is_turned_where_the_output_falls(flexlink, tmp_path, signals):
    turned = [(t, -r, u, -y) for t, r, u, y in signals]
    document, text, config = drafted(flexlink, write(tmp_path, turned, ("t_s", "ref_rad", "u_V", "y_rad")))
    assert document["numbers"]["seen"]["turned"]
    assert config.source.scale == {"u_V": -1.0}
    assert config.source.units == {"u_V": "V"}
    assert "the controller's files have the sign of the logs" in text


@pytest.mark.slow
def test_open_loop_without_friction(flexlink, tmp_path):
    logs = [recorded(seed, rms=rms, closed=False, coulomb=0.0) for seed, rms in ((1, 0.1), (2, 0.2))]
    document, text, config = drafted(flexlink, write(tmp_path, logs, ("t_s", "", "u_V", "y_rad")))
    assert config.source.references == ()
    assert '# references = ["reference"]' in text
    assert not document["numbers"]["seen"]["friction"]
    assert config.channels[0].uncertainty.response == "as recorded"
    assert "friction_feedforward" not in text
    assert document["numbers"]["seen"]["first_mode"][0] == pytest.approx(MODE_RAD_S, rel=0.01)


@pytest.mark.parametrize(
    "gravity",
    [pytest.param(0.8, marks=pytest.mark.long), pytest.param(-0.3, marks=pytest.mark.slow)],
    ids=["holds", "throws"],
)
def test_a_weight_that_holds_and_one_that_throws_over(flexlink, tmp_path, gravity):
    logs = [recorded(seed, rms=rms, gravity=gravity) for seed, rms in ((1, 0.1), (2, 0.2))]
    document, _, config = drafted(flexlink, write(tmp_path, logs, ("t_s", "ref_rad", "u_A", "y_rad")))
    assert config.channels[0].identification.integrators == 0
    found = document["numbers"]["seen"]["unstable_per_s"]
    if gravity > 0:  # the first mode is the swing
        low, high = config.specification.mode_band_rad_s
        assert low < np.sqrt(gravity / (MOTOR + LOAD)) < high
    roots = np.roots([MOTOR + LOAD, VISCOUS, gravity])
    assert found == pytest.approx(max(0.0, roots.real.max()), rel=0.1)


@pytest.mark.usefixtures("unidentified")
def test_clipped_commands_are_the_limit(flexlink, tmp_path):
    logs = [recorded(seed, rms=0.2, limit=0.9) for seed in (1, 2)]
    _, text, config = drafted(flexlink, write(tmp_path, logs, ("t_s", "ref_rad", "u_A", "y_rad")))
    assert config.source.input_limit == config.specification.input_limit == 0.9
    assert "commands stand there in the logs" in text


@pytest.mark.usefixtures("unidentified")
def test_one_log_is_split_or_nothing_validates(flexlink, tmp_path, signals):
    logs = write(tmp_path, signals[:1], ("t_s", "ref_rad", "u_A", "y_rad"))
    _, text, config = drafted(flexlink, logs)
    first, last = config.source.records
    assert first.stop_sample == last.start_sample
    assert last.role == "validation"
    assert "One log: its last part validates." in text
    (tmp_path / "short").mkdir()
    short = [tuple(column[:900] for column in signals[0])]
    _, text, config = drafted(flexlink, write(tmp_path / "short", short, ("t_s", "ref_rad", "u_A", "y_rad")))
    assert len(config.source.records) == 1
    assert "nothing validates" in text


@pytest.mark.usefixtures("unidentified")
def test_refused_in_a_line_that_says_what_to_type(refused, flexlink, tmp_path, signals):
    out = tmp_path / "my.toml"
    logs = write(tmp_path, [(t, r, u, y) for t, r, u, y in signals[:2]], ("t_s", "ref_rad", "u_V", "y_rad"))
    two = tmp_path / "two.csv"
    two.write_text(
        "t_s,ref_rad,soll_rad,u_V,y_rad\n" + "".join(f"{k},{k},{k * k},{k % 7},{k % 5}\n" for k in range(60))
    )
    line = refused("init", two, "--out", out)
    assert "ref_rad and soll_rad may be the reference of 'y_rad'" in line
    typed = shlex.split(line.split("type: flexlink ")[1])
    assert typed[0] == "init"
    assert typed[-2:] == ["--reference", "ref_rad"]
    assert "--input" in refused("init", write_names(tmp_path, "t_s,u_V,i_A,y_rad"), "--out", out)
    assert "--dt-s SECONDS" in refused("init", write_names(tmp_path, "u_V,y_rad"), "--out", out)
    assert not out.exists()
    assert flexlink("init", *logs, "--out", out).code == 0
    assert "--replace" in refused("init", *logs, "--out", out)
    assert "given twice" in refused("init", logs[0], logs[0], "--out", tmp_path / "b.toml")


def write_names(folder, names):
    path = folder / "other.csv"
    rows = [
        [f"{k if j == 0 else (k * (j + 3)) % 11}" for j in range(names.count(",") + 1)] for k in range(200)
    ]
    path.write_text("\n".join([names, *(",".join(row) for row in rows)]) + "\n")
    return path


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_the_reported_log_becomes_a_controller_without_an_edit(flexlink, tmp_path):
    if not REPORTED.is_dir():
        pytest.skip("the reported logs are not there: shared/reported/closed_loop_friction")
    logs = [REPORTED / f"run{k}.csv.gz" for k in (1, 3, 4, 2)]
    answer = flexlink("run", *logs, "--out", tmp_path / "out", "--json")
    assert answer.document()["certified"]
    results = RunResults(RunDirectory.open(tmp_path / "out"))
    friction, (channel,) = results.identify.friction, results.uncertainty.channels
    assert friction.level == pytest.approx(0.05, rel=0.01)
    (mode,) = channel.intervals.modes
    # The README states four digits.
    assert mode.frequency_Hz[0] - 5e-4 < 9.353 < mode.frequency_Hz[1] + 5e-4
    assert mode.damping[0] - 5e-5 < 0.0496 < mode.damping[1] + 5e-5


@pytest.mark.long
@pytest.mark.usefixtures("undrawn")
def test_the_axis_of_emps_becomes_a_controller(refused, flexlink, tmp_path, flexlink_data):
    """Against its published model: 95.1089 kg, 203.5034 N s/m, 20.3935 N, 35.15065188 N/V."""
    out = tmp_path / "my.toml"
    line = refused("init", flexlink_data / "emps" / "emps_train.csv", "--out", out)
    assert flexlink(*shlex.split(line.split("type: flexlink ")[1]), "--out", out).code == 0
    few = "[closed_loop]\ndraws = 2\nconditions = false\n"
    out.write_text(out.read_text().replace("[closed_loop]\n", few))
    answer = flexlink("run", "--config", out, "--out", tmp_path / "out", "--json")
    assert answer.document()["certified"]
    results = RunResults(RunDirectory.open(tmp_path / "out"))
    # Our own inverse dynamics of the record: 20.4 N, 95.1 kg; measured here 20.1 N, 2.15 1/s, 93.7 kg.
    assert 35.15065 * results.identify.friction.level == pytest.approx(20.39, rel=0.03)
    model = results.identify.channels[0].model
    # No mode of a rigid axis: a pair, if any, is damped and far above what the log moves.
    assert np.all(model.poles.zeta() > 0.2)
    assert np.all(model.poles.omega_rad_s(model.dt_s) > 200)
    slowest = -np.log(np.max(model.poles.real[model.poles.real < 1])) / model.dt_s
    assert slowest == pytest.approx(203.5034 / 95.1089, rel=0.03)
    s = 1j * np.array([5.0, 10.0, 20.0])
    published = np.abs(35.15065 / (s * (95.1089 * s + 203.5034)))
    assert np.abs(model.frequency_response(s.imag)) == pytest.approx(published, rel=0.05)


@pytest.mark.slow
def test_a_reference_planned_for_the_loop_keeps_its_limits_on_the_machine(flexlink, tmp_path, signals):
    """Played on the machine that made the logs: within 15 % of what is expected, as friction bends it."""
    logs = write(tmp_path, signals, ("t_s", "ref_rad", "u_A", "y_rad"))
    out = tmp_path / "plan"
    answer = flexlink(
        "excite", "--closed-loop", *logs, "--out", out, "--band", 0.5, 20, "--duration", 60,
        "--realisations", 2, "--voltage", 1.5, "--json",
    )  # fmt: skip
    numbers = answer.document()["numbers"]
    assert numbers["told"] == 1.0
    assert numbers["friction"] == pytest.approx(COULOMB, rel=0.2)
    files = sorted(out.glob("*.csv"))
    assert len(files) == 4
    for file, level, k in zip(files, (0, 0, 1, 1), (0, 1, 0, 1), strict=True):
        assert file.read_text().startswith("time_s,ref_rad\n")
        played = np.loadtxt(file, delimiter=",", skiprows=1)[:, 1]
        _, _, command, motion = recorded(0, reference=played)
        period = numbers["plan"]["period_samples"]
        assert np.abs(command[-period:]).max() == pytest.approx(numbers["command_peak"][level][k], rel=0.15)
        assert np.abs(motion[-period:]).max() <= 1.15 * numbers["motion_peak"][level][k] + 0.01
        assert np.abs(command).max() < 1.15 * 1.5
    motion = np.max(numbers["motion_peak"]) / numbers["largest_motion"]
    assert max(np.max(numbers["command_peak"]) / 1.5, motion) == pytest.approx(1.0)


def test_a_reference_cannot_be_planned_without_knowing_the_loop(refused, flexlink, tmp_path, signals):
    logs = write(tmp_path, signals, ("t_s", "", "u_A", "y_rad"))
    wanted = ("--out", tmp_path / "plan", "--band", 0.5, 20, "--duration", 60)
    line = refused("excite", "--closed-loop", *logs, *wanted)
    assert "no reference is recorded" in line
    assert "--rms" in line
    assert "--closed-loop" in refused("excite", *logs, *wanted)
    assert "--dt-s" in refused("excite", *wanted)
    assert not (tmp_path / "plan").exists()
    answer = flexlink("excite", "--closed-loop", *logs, *wanted, "--rms", 0.05, "--json")
    assert answer.document()["numbers"]["rms"] == [pytest.approx(0.05), pytest.approx(0.025)]


@pytest.mark.parametrize("depth", [1, 4, 8])
def test_what_to_type_is_whole_however_long_the_path(refused, flexlink, tmp_path, signals, depth):
    """A message is cut where it is long: never in the command at its end."""
    folder = tmp_path.joinpath(*["measured on the axis at the window"] * depth)
    folder.mkdir(parents=True)
    (log, *_) = write(folder, signals, ("zeit [s]", "kanal a", "kanal b", "kanal c"))
    line = refused("init", log, "--out", tmp_path / "my.toml")
    words = shlex.split(line.split("type: flexlink ")[1])
    assert words[1] == str(log)
    assert words[words.index("--out") + 1] == "my.toml"
    assert words.count("--input") == words.count("--output") == 1
    assert not any(word.endswith("...") for word in words[2:])


@pytest.mark.slow
@pytest.mark.usefixtures("unidentified")
def test_the_period_of_the_controller_is_read_off_stated_or_asked_for(flexlink, tmp_path, signals):
    """Every row of a loop tells its period, and that a command is made of its own row's position; every
    second row does not; a stated period is taken, and refused where the log contradicts it."""
    names = ("t_s", "ref_rad", "i_cmd_A", "enc_rad")
    folders = [tmp_path / name for name in ("every", "second", "stated")]
    for folder in folders:
        folder.mkdir()
    _, text, config = drafted(flexlink, write(folders[0], signals, names))
    assert config.source.controller_period_s == pytest.approx(DT_S)
    assert config.specification.computational_delay_samples == 0
    assert "repeats every command from the rows" in text
    assert "made of the output of its own row" in text

    thinned = [tuple(column[::2] for column in log) for log in signals]
    logs = write(folders[1], thinned, names)
    _, text, config = drafted(flexlink, logs)
    assert config.source.controller_period_s is None
    assert config.specification.computational_delay_samples == 1
    assert "they do not tell it" in text

    _, text, config = drafted(flexlink, logs, "--replace", "--controller-period", DT_S)
    assert config.source.controller_period_s == DT_S
    assert "as stated" in text
    wrong = flexlink("init", *logs, "--out", tmp_path / "wrong.toml", "--controller-period", 3 * DT_S)
    assert wrong.code == 2
    assert "more often than a controller" in wrong.err
