"""The command line: exit codes, one-line errors that leave nothing behind, JSON that is only JSON."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from inspect import signature

import click
import numpy as np
import pytest
import scipy.io
from typer.main import get_command

from ident.basis.options import IdentOptions
from plant.experiment_plan import ExperimentPlan
from tests.workflow.command import FAST_ARM, ROOT, start_flexlink, without_progress
from workflow import cli
from workflow.cli import app, main
from workflow.config.run_config import FileSource
from workflow.config.uncertainty_options import FitOptions, UncertaintyOptions
from workflow.diagnose.simulator_settings import SimulatorSettings
from workflow.engine import interrupts
from workflow.engine.errors import InputError

FILES_CONFIG = """
[run]
name = "own"
[source]
kind = "files"
time = "t_s"
[[source.records]]
path = "log.csv"
[[channels]]
input = "u"
output = "y"
identification = {{ n_real = {n_real}, n_pairs = 0 }}
[specification]
bandwidth_rad_s = 1.0
{more}
"""


def good_table(samples: int = 200) -> dict[str, np.ndarray]:
    """A first-order lag driven by a square wave."""
    t = np.arange(samples) * 0.01
    u = np.sign(np.sin(7 * t + 0.1))
    y = np.zeros(samples)
    for k in range(1, samples):
        y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1]
    return {"t_s": t, "u": u, "y": y + 1e-3 * np.random.default_rng(1).standard_normal(samples)}


def write_case(folder, table, *, n_real=1, more=""):
    names = list(table)
    rows = zip(*(np.asarray(column).tolist() for column in table.values()), strict=True)
    lines = [",".join(names), *(",".join(str(value) for value in row) for row in rows)]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    path = folder / "own.toml"
    path.write_text(FILES_CONFIG.format(n_real=n_real, more=more))
    return path


def test_empty_directory_that_was_there_stays_and_is_usable_again(refused, tmp_path):
    (tmp_path / "run").mkdir()
    config = write_case(tmp_path, good_table(12), n_real=8)
    refused("run", "--config", config, "--out", tmp_path / "run")
    # Either gone or empty: the corrected attempt must not be refused.
    assert not (tmp_path / "run").exists() or list((tmp_path / "run").iterdir()) == []


def test_a_log_in_place_of_a_configuration_and_a_missing_option_say_what_to_type(refused, tmp_path):
    log = write_case(tmp_path, good_table()).with_name("log.csv")
    assert refused("run", "--config", log).endswith(f"flexlink init {log} --out my.toml\n")
    assert refused("init", log).endswith("(flexlink init -h)\n")


BAD_CONFIGS = {
    "contradiction": ("+", "effort_rolloff_rad_s = 3.0", "effort_rolloff_rad_s needs effort_limit"),
    "syntax": ("+", "[closed_loop\n", "own.toml: not valid TOML"),
    "wrong machine": ("+", "[closed_loop]\nmachine = 'simulated'", "needs [source] kind = 'simulated'"),
    "no period": ('time = "t_s"', "dt_s = 0.0", "source.dt_s: input should be greater than 0, got 0.0"),
    "no time": ('time = "t_s"', "", "no time base"),
    "no log": ('"log.csv"', '"own.toml"', "unknown kind of file"),
    "too few": ("n_real = 1", "n_real = 8", "12 samples are too few for order 8"),
    "bad effect": ("coefficient_Nms = 0.02", "coefficient_Nms = -1.0", "source.effects[0]"),
    "no effect": ('"viscous_friction"', '"vicious_friction"', "unknown effect 'vicious_friction'"),
    "no rig": ('rig = "paper_link"', 'rig = "paper_lnk"', "no such rig file"),
    "no column": ('output = "hub_angle_rad"', 'output = "hub"', "'hub'"),
}


@pytest.mark.parametrize("case", BAD_CONFIGS)
def test_bad_config_is_one_line_naming_the_key(refused, tmp_path, case):
    old, new, words = BAD_CONFIGS[case]
    table = good_table(12 if case == "too few" else 200)
    table["u"][::3] *= -1
    config = write_case(tmp_path, table, more=new if old == "+" else "")
    if old not in config.read_text() and old != "+":
        config.write_text(FAST_ARM.read_text())
    if old != "+":
        assert old in config.read_text()
        config.write_text(config.read_text().replace(old, new))
    assert words in refused("run", "--config", config, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run --resume", "--resume needs --out"),
        ("run --resume --replace --out x", "contradict"),
        ("run --nonsense", "--nonsense"),
        ("fly", "fly"),
        ("report absent", "absent: no such run directory"),
    ],
)
def test_bad_arguments(refused, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in refused(*arguments.split())
    assert list(tmp_path.iterdir()) == []


def test_unwritable_output_is_refused_before_the_work(refused, tmp_path):
    (tmp_path / "file").write_text("")
    assert "is not a directory" in refused("run", "--config", FAST_ARM, "--out", tmp_path / "file" / "run")
    assert "cannot write" in refused("run", "--config", FAST_ARM, "--out", tmp_path / "file")
    assert "cannot write" in refused("simulate", "--config", FAST_ARM, "--out", tmp_path / "file" / "x")


def test_run_prints_a_table_and_the_page(flexlink, fast_run):
    always = (
        "bandwidth|modulus|overshoot|settling time|peak command|rise time|margins|predicted|certified|report."
    )
    more = "Hz, damping|fit, validation|95 % radius|γ"
    for options, lines in (([], 15), (["--verbose"], 60)):
        answer = flexlink("run", "--config", FAST_ARM, "--out", fast_run[0], "--resume", *options)
        assert (answer.code, answer.err) == (0, "")  # no progress where nobody watches
        assert [word for word in always.split("|") if word not in answer.out] == []
        assert [word in answer.out for word in more.split("|")] == [bool(options)] * 4
        assert len(answer.out.splitlines()) <= lines


def test_run_json_is_only_json(flexlink, fast_run):
    answer = flexlink("run", "--config", FAST_ARM, "--out", fast_run[0], "--resume", "--json")
    document = json.loads(answer.out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert answer.code == 0
    assert document["certified"] is True
    assert document["report"].endswith("report.html")
    assert document["numbers"]["design"]["gamma"] <= 1
    assert document["numbers"]["channels"][0]["modes"][0]["frequency_Hz"] == pytest.approx(7.6, rel=0.03)


def test_report_of_an_unfinished_run_says_what_is_missing(refused, fast_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(fast_run[0], run)
    (run / "stages" / "design.npz").unlink()
    assert "stage design is not there" in refused("report", run)


@pytest.mark.usefixtures("undrawn")
def test_impossible_specification_is_three_with_report(flexlink, tmp_path):
    """40 rad/s cannot be had: the line says how far it is missed and where, and the page is written."""
    config = tmp_path / "arm.toml"
    config.write_text(FAST_ARM.read_text().replace("bandwidth_rad_s = 1.5", "bandwidth_rad_s = 40.0"))
    answer = flexlink("run", "--config", config, "--out", tmp_path / "run")
    assert answer.code == 3
    assert answer.err.count("\n") == 1
    assert "not met" in answer.err
    assert "rad/s" in answer.err
    assert (tmp_path / "run" / "report.html").is_file()


def test_simulate_identify_design_hand_over_files(flexlink, tmp_path):
    made = flexlink("simulate", "--config", FAST_ARM, "--out", tmp_path / "logs", "--json")
    files = made.document()["files"]
    assert [name.split("/")[-1] for name in files] == ["01_prbs.csv", "02_fresh_b_prbs_b_.csv", "truth.json"]
    found = flexlink(
        *("identify", files[0], "--input", "voltage_V", "--output", "hub_angle_rad", "--time", "time_s"),
        *("--real", 1, "--pairs", 1, "--integrators", 1, "--validation", files[1]),
        *("--out", tmp_path / "hub.npz", "--json"),
    )
    numbers = found.document()["numbers"]
    (mode,) = numbers["modes"]
    assert mode["frequency_Hz"] == pytest.approx(7.6, rel=0.03)
    # The true mode stands beside it, of the physical model alone, and nothing else has changed with it.
    true = min(
        json.loads((tmp_path / "logs" / "truth.json").read_text())["modes"]["hub_angle_rad"],
        key=lambda entry: abs(entry["frequency_Hz"] / mode["frequency_Hz"] - 1),
    )
    assert true["frequency_Hz"] == pytest.approx(mode["frequency_Hz"], rel=0.03)
    (row,) = [row["value"] for row in found.document()["table"] if row["label"] == "mode"]
    assert f"true (linear arm): {true['frequency_Hz']:.3g} Hz" in row
    assert min(numbers["fit_validation_percent"].values()) > 98
    specification = tmp_path / "specification.toml"
    specification.write_text("bandwidth_rad_s = 1.5\neffort_limit = 60.0\ncontroller_order = 2\n")
    designed = flexlink(
        *("design", tmp_path / "hub.npz", "--specification", specification),
        *("--out", tmp_path / "controller.json", "--json"),
    )
    assert designed.document()["certified"] is True
    from control_design.controllers.controller import Controller

    assert Controller.from_json((tmp_path / "controller.json").read_text()).order == 2


def test_design_writes_what_the_ending_asks_for(flexlink, fast_run, tmp_path, monkeypatch):
    from control_design.controllers.controller import Controller
    from workflow.commands import design as command

    found, design = [], command._design

    def once(*given):
        found.append(found[0] if found else design(*given))
        return found[0]

    monkeypatch.setattr(command, "_design", once)  # it is about what is written of it
    for ending in (".mat", ".c"):
        assert flexlink("design", fast_run[0], "--out", tmp_path / f"controller{ending}").code == 0
    assert flexlink("design", fast_run[0], "--out", tmp_path / "controller.json").code == 0
    same = Controller.from_json((tmp_path / "controller.json").read_text())
    assert np.array_equal(scipy.io.loadmat(tmp_path / "controller.mat")["A"], same.A)
    assert f"{float(same.C[0, 0])!r}" in (tmp_path / "controller.c").read_text()
    own = tmp_path / "hub.c"
    flexlink("design", fast_run[0], "--out", own, "--c-prefix", "hub", "--c-float", "--json").document()
    assert "float hub_step(hub_state *state, float error" in own.with_suffix(".h").read_text()
    assert "double" not in own.read_text()
    wrong = flexlink("design", fast_run[0], "--out", own, "--c-prefix", "7")
    assert (wrong.code, wrong.err) == (2, "flexlink: --c-prefix: prefix must be a C identifier; got '7'\n")
    refused = flexlink("design", fast_run[0], "--out", tmp_path / "controller.txt")
    assert refused.code == 2
    assert ".json, .mat, .c" in refused.err


@pytest.mark.parametrize(("arguments", "words"), [(["--version"], "flexlink "), ([], "Exit codes")])
def test_version_and_help_of_the_module_entry(arguments, words):
    process = start_flexlink(*arguments)
    out, err = process.communicate()
    assert (process.returncode, err, words in out.decode()) == (0, b"", True)


def test_every_command_takes_a_time_limit(flexlink, monkeypatch, tmp_path):
    cli._plug_in(["those of other packages too"])
    commands = cli._commands()
    assert {"simulate", "excite", "look", "report", "blind", "paper"} <= commands.keys()
    assert [name for name, call in commands.items() if "time_limit" not in signature(call).parameters] == []
    monkeypatch.setattr(interrupts, "_came", None)
    monkeypatch.setattr("workflow.commands.run.simulate_to_csv", lambda *_: time.sleep(30))
    answer = flexlink("simulate", "--out", tmp_path / "out", "--time-limit", "0.2")
    assert (answer.code, answer.err) == (142, "flexlink: the time limit is reached\n")


def divided():
    raise ZeroDivisionError("division\nby zero")


def stopped():
    raise KeyboardInterrupt


def swallowed():
    interrupts._keep(2, None)  # in compiled code, which makes something else of it
    raise ValueError("invalid matrix")


@pytest.mark.parametrize(
    ("fails", "code", "line"),
    [
        (divided, 1, "internal error: ZeroDivisionError: division by zero (--debug shows where)\n"),
        (lambda: np.zeros(2**45), 1, "out of memory (Unable to allocate"),  # more than any address space
        (stopped, 130, "interrupted\n"),  # nothing is there to be continued
        (swallowed, 130, "interrupted\n"),
    ],
    ids=["error", "memory", "interrupt", "swallowed"],
)
@pytest.mark.parametrize("command", ["run_from_files", "simulate_to_csv"])
def test_what_nobody_expected_is_one_line(flexlink, monkeypatch, tmp_path, command, fails, code, line):
    monkeypatch.setattr(f"workflow.commands.run.{command}", lambda *arguments, **options: fails())
    monkeypatch.setattr(interrupts, "_came", None)
    call = command.partition("_")[0], "--out", tmp_path / "run"
    answer = flexlink(*call)
    assert answer.code == code
    assert answer.err.startswith(f"flexlink: {line}")
    assert answer.err.count("\n") == 1
    assert ("Traceback" in flexlink("--debug", *call).err) == (code == 1)


@pytest.mark.parametrize(
    ("command", "settings", "option", "key", "more"),
    [
        ("identify", IdentOptions, "--pairs", "n_pairs", "[at least 0; at most 12]"),
        ("identify", IdentOptions, "--integrators", "integrators", "[at least 0; at most 3; default: 0]"),
        ("identify", UncertaintyOptions, "--level", "level", "[above 0.5; below 1; default: 0.95]"),
        ("identify", FitOptions, "--noise", "noise", "[white, auto; default: auto]"),
        ("identify", IdentOptions, "--feedthrough", "feedthrough", "."),
        ("look", FileSource, "--decimal", "decimal", "[point, comma]"),
        ("excite", ExperimentPlan, "--periods", "periods", "[at least 1; at most 1000; default: 2]"),
        ("check", SimulatorSettings, "--resample-s", "resample_s", "[above 0]"),
        ("diagnose", SimulatorSettings, "--motion", "motion", "[position, speed]"),
    ],
)
def test_an_option_says_what_the_field_it_sets_says(flexlink, command, settings, option, key, more):
    shown = " ".join(flexlink(command, "--help").out.split())
    said = settings.model_fields[key].description
    said = re.escape(said[:1].upper() + said[1:])
    assert re.search(rf"{option} (<\w+> )?{said} ?{re.escape(more)} -", shown), shown


@pytest.mark.parametrize("command", sorted(get_command(app).commands))
def test_no_option_has_a_path_of_python_as_its_help(command):
    group = get_command(app)
    _, command, _ = group.resolve_command(click.Context(group), [command])
    assert not re.search(r"[a-z_]+:[A-Z]", command.get_help(click.Context(command)))


@pytest.mark.parametrize("command", [[], ["run"], ["identify"], ["diagnose"], ["report"], ["blind"]])
def test_short_help_is_the_long_one(flexlink, command):
    short = flexlink(*command, "-h")
    assert short.code == 0
    assert short.out == flexlink(*command, "--help").out
    assert "-h, --help" in short.out


@pytest.fixture
def called_flexlink(monkeypatch):
    """This process has the name that a shell knows the command by."""
    monkeypatch.setattr(sys, "argv", ["flexlink"])
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None)


@pytest.mark.parametrize(
    ("shell", "typed", "offered"),
    [
        ("bash", "flexlink di", {"diagnose"}),
        ("bash", "flexlink pa", {"paper"}),  # a command from outside
        ("bash", "flexlink identify --omega-", {"--omega-min", "--omega-max"}),
        ("zsh", "flexlink study --sch", {"--scheduler"}),
        ("fish", "flexlink re", {"report"}),
    ],
)
@pytest.mark.usefixtures("called_flexlink")
def test_a_shell_completes_commands_and_options(shell, typed, offered, monkeypatch, capsys):
    env = {"_FLEXLINK_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": typed}
    env |= {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
    for name, value in {**env, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main([])
    assert set(re.findall(r"(?:--)?[a-z-]+(?=\n|\t|\"|$)", capsys.readouterr().out)) >= offered


def test_completion_is_installed_for_the_shell_that_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    with pytest.raises(SystemExit, match=r"^0$"):
        get_command(app).main(["--install-completion", "bash"], prog_name="flexlink")
    assert "bash completion installed" in capsys.readouterr().out
    script = next((tmp_path / ".bash_completions").iterdir())
    assert "_FLEXLINK_COMPLETE=complete_bash" in script.read_text()


def test_same_log_twice_is_refused(refused, tmp_path):
    write_case(tmp_path, good_table())
    log, options = tmp_path / "log.csv", ["--input", "u", "--output", "y", "--time", "t_s"]
    assert "given twice" in refused("identify", log, log, *options)
    assert "given twice" in refused("identify", log, *options, "--validation", tmp_path / "." / "log.csv")


def test_terminal_codes_in_names_are_shown_as_text(refused, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("t,u,y\n0,1,2\n1,2,3\n")
    line = refused("identify", log, "--input", "\x1b[31mu", "--output", "y", "--time", "t")
    assert "\x1b" not in line
    assert r"\x1b[31mu" in line
    log.write_text("t,\x1b[31mu,y\n0,1,2\n1,2,3\n")
    assert "control characters" in refused("identify", log, "--input", "u", "--output", "y", "--time", "t")


def test_numpy_is_loaded_after_its_threads_are_settled():
    code = (
        "import os, sys, workflow.cli; loaded = 'numpy' in sys.modules; "
        "sys.argv = ['flexlink', '--version']; workflow.cli.main(); "
        "print(loaded, *map(os.environ.get, ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')))"
    )
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment = kept | {"OMP_NUM_THREADS": "2"}
    command = [sys.executable, "-c", code]
    answer = subprocess.run(command, env=environment, cwd=ROOT, check=True, capture_output=True, text=True)
    # One thread whatever was asked for: results are the same to the last byte (docs/limits.md).
    assert answer.stdout.splitlines()[-1] == "False 1 1"


REFUSED = {
    "run --config gone.toml": "cannot read gone.toml",
    "run --config bad.toml": "unknown key run.sead",
    "run --config own.toml --out r": "no column 'v'",
    "run --config own_gone.toml --out r": "no such file",
    "look gone.csv": "cannot read gone.csv",
    "look log.csv --time v": "no column 'v'",
    "init gone.csv --out a.toml": "cannot read gone.csv",
    "init log.csv --input v --output y --dt-s 1 --out a.toml": "no column 'v'",
    "excite --closed-loop log.csv --input v --output y --out e": "no column 'v'",
    "identify gone.csv --input u --output y --dt-s 1": "cannot read gone.csv",
    "identify log.csv --input v --output y --dt-s 1": "no column 'v'",
    "design gone.npz": "cannot read gone.npz",
    "study --config gone.toml --out s": "cannot read gone.toml",
    "study --config study.toml --out s": "unknown key axis",
    "diagnose gone --out d": "cannot read gone",
    "diagnose gap/case.toml --out d": "no column 'voltage_V'",
    "diagnose gone/case.toml --out d": "cannot read gone/case.toml",
    "check --python log.csv --log gone.csv": "cannot read gone.csv",
    "design log.csv --spec wish.toml": "unknown key specification.bandwith_rad_s",
}


def test_what_is_refused_is_refused_before_anything_slow_is_loaded(tmp_path):
    """Whatever is missing, a file, a key or a column: after each of them nothing that computes is there."""
    (tmp_path / "bad.toml").write_text(FAST_ARM.read_text().replace("\nseed =", "\nsead ="))
    (tmp_path / "wish.toml").write_text("[specification]\nbandwith_rad_s = 1.0\n")
    (tmp_path / "study.toml").write_text("[axis]\n'specification.bandwidth_rad_s' = [1.0]\n")
    own = write_case(tmp_path, good_table()).read_text()
    (tmp_path / "own.toml").write_text(own.replace('"u"', '"v"'))
    (tmp_path / "own_gone.toml").write_text(own.replace("log.csv", "gone.csv"))
    shutil.copytree(ROOT / "examples/gap_case", tmp_path / "gap")
    for log in (tmp_path / "gap/logs").iterdir():
        log.write_text(log.read_text().replace("voltage_V", "V", 1))
    slow = {"control", "matplotlib", "casadi", "nlopt", "numba", "pandas", "mujoco"}
    slow |= {"scipy.signal", "scipy.stats", "scipy.optimize"}
    code = "import sys\nfrom workflow.cli import main\nfor text in sys.argv[1:]:\n"
    code += f"    print(main(text.split()), *({slow!r} & sys.modules.keys()))"
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code, *REFUSED],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    lines = without_progress(done.stderr).splitlines()
    answers = zip(REFUSED.items(), done.stdout.splitlines(), lines, strict=True)
    for (command, words), loaded, line in answers:
        assert loaded == "2", (command, loaded)
        assert words in line, command


@pytest.mark.parametrize(
    "command",
    [
        ["look"],
        ["identify"],
        ["run", "--config"],
        ["simulate", "--config"],
        ["study", "--config"],
        ["design", "--spec", "pyproject.toml"],
        ["diagnose"],
        ["diagnose", "--log", "pyproject.toml", "--mjcf"],
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("what", ["a pipe", "a device"])
def test_nothing_is_waited_for(tmp_path, refused, command, what):
    path = "/dev/zero"
    if what == "a pipe":
        os.mkfifo(path := tmp_path / "pipe")
    out = ["--out", tmp_path / "out"] if command[0] in ("simulate", "study", "diagnose") else []
    assert "expected a f" in refused(*command, path, *out)  # a file, or a folder with case.toml


def test_a_run_without_configuration_says_that_the_arm_is_built_in(flexlink, tmp_path, monkeypatch):
    def stop(*given, **how):
        raise InputError("no further")

    monkeypatch.setattr("workflow.tasks.pipeline._perform", stop)
    for more in ((), ("--config", FAST_ARM)):
        answer = flexlink("run", *more, "--out", tmp_path / f"out{len(more)}")
        assert answer.err.endswith("no further\n")
        assert ("no --config: this is the built-in default arm" in answer.err) == (not more)
