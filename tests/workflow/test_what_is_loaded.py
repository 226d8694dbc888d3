"""What a command loads: nobody waits for libraries that his command does not use."""

import json
import subprocess
import sys

import numpy as np
import pytest

# Each takes longer to load than a log takes to be read.
NEVER_FOR_A_LOG = {"numba", "scipy", "control", "matplotlib", "casadi", "pandas", "nlopt"}
# What only designs, tables and drawings need: a second or more together, and a model is identified in less.
NEVER_FOR_A_MODEL = {"control", "matplotlib", "casadi", "pandas"}
# Packages of workflow that the main job does without (CONTRIBUTING.md).
ROOMS = {"diagnose", "excite", "joints", "look", "responses", "study", "tune"}
SHOW = "import json, sys; sys.stderr.write('\\n' + json.dumps(sorted(sys.modules)))"
COMMAND = f"import sys\nfrom workflow.__main__ import main\ntry:\n    main()\nfinally:\n    {SHOW}"
IDENTIFY = (
    "import flexlink, numpy\n"
    "u = flexlink.prbs(register_length=9, hold_samples=2, amplitude_V=12.0, n_samples=1000)\n"
    "rng = numpy.random.default_rng(1)\n"
    "log = flexlink.simulate(flexlink.paper_link(), u, rng=rng).record('hub_angle_rad')\n"
    "flexlink.identify(log, integrators=1, n_real=1, n_pairs=1)\n"
)


def loaded(code: str, *arguments: str) -> set[str]:
    """Modules of a fresh process after it has run this code."""
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    return set(json.loads(done.stderr.splitlines()[-1]))


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log (500 rows) of a lag that is driven by a random voltage."""
    rng = np.random.default_rng(3)
    voltage = np.repeat(rng.choice([-1.0, 1.0], 125), 4)
    angle = np.zeros(500)
    for k in range(499):
        angle[k + 1] = 0.9 * angle[k] + 0.1 * voltage[k]
    table = np.column_stack([0.01 * np.arange(500), voltage, angle + 0.001 * rng.standard_normal(500)])
    path = tmp_path_factory.mktemp("log") / "log.csv"
    np.savetxt(path, table, delimiter=",", header="time_s,voltage_V,hub_angle_rad", comments="")
    return str(path)


def test_the_package_alone_loads_nothing():
    assert not loaded(f"import flexlink\n{SHOW}") & {"numpy", *NEVER_FOR_A_LOG}


def test_a_log_that_is_refused_waits_for_no_numerical_library(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("a,b\n1,2\n")
    assert not loaded(COMMAND, "run", str(path), "--out", str(tmp_path / "run")) & NEVER_FOR_A_LOG


@pytest.mark.long
def test_a_look_at_a_log_loads_no_design(log, tmp_path):
    modules = loaded(COMMAND, "look", log, "--out", str(tmp_path / "look.html"))
    assert (tmp_path / "look.html").exists()
    assert not modules & NEVER_FOR_A_MODEL


@pytest.mark.slow
def test_a_model_is_identified_without_what_designs_and_draws(log, tmp_path):
    """With its page, which needs all that the command alone needs."""
    page = ("--report", str(tmp_path / "page.html"))
    modules = loaded(COMMAND, "identify", log, "--real", "1", "--pairs", "0", "--integrators", "0", *page)
    assert "ident.one_input" in modules
    assert not modules & NEVER_FOR_A_MODEL


@pytest.mark.long
def test_nor_from_python():
    assert not loaded(IDENTIFY + SHOW) & NEVER_FOR_A_MODEL


@pytest.mark.slow
def test_a_diagnosis_begins_without_what_checks_controllers_and_draws():
    assert not loaded(f"import workflow.diagnose.command\n{SHOW}") & NEVER_FOR_A_MODEL


@pytest.mark.slow
def test_a_run_of_logs_enters_no_room(log, tmp_path):
    """Only a run enters everything that it loads: imports inside functions count, too."""
    modules = loaded(COMMAND, "run", log, "--out", str(tmp_path / "run"))
    assert (tmp_path / "run" / "report.html").exists()
    entered = {name.split(".")[1] for name in modules if name.startswith("workflow.")}
    assert {"kinds", "describe", "figures", "report", "tasks"} <= entered
    assert not entered & ROOMS
