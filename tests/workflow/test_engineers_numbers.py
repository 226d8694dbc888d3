"""A PID with a fixed notch as a user asks for it: design file, terminal, JSON, page, C code."""

import ctypes
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import control
import numpy as np
import pytest

from control_design.controllers.controller import Controller, ControllerStepper
from control_design.controllers.engineers_numbers import engineers_numbers
from tests.compiler import compiled, needs_compiler
from tests.workflow.test_design_sources import DT_S, QUICK, arm, document, write_json
from workflow.config.design_file import read_design_file
from workflow.tune.session import TuningSession
from workflow.tune.views import bode

WISH = """
[specification]
bandwidth_rad_s = 0.7
modulus_margin = 0.4
effort_limit = 20.0
structure = "pid"
fixed = { ti_s = 0.8 }
notches = [{ frequency_hz = 1.9, depth_db = 10.0, width_hz = 0.6 }]
low_pass = { frequency_hz = 7.0, damping = 0.7 }

[uncertainty]
multiplicative = 0.05
"""
FREE = """
[specification]
bandwidth_rad_s = 0.7
modulus_margin = 0.4
effort_limit = 20.0
controller_order = 3

[uncertainty]
multiplicative = 0.05
"""


def _asked(path):
    write_json(path / "arm.json", document(arm()))
    (path / "pid.toml").write_text(WISH + QUICK)
    return path / "arm.json", "--spec", path / "pid.toml"


def test_the_terminal_and_the_json_show_what_is_fixed_and_what_was_found(flexlink, tmp_path):
    out = tmp_path / "hub.json"
    answer = flexlink("design", *_asked(tmp_path), "--out", out, "--json")
    assert answer.code == 0, answer.err
    told = json.loads(answer.out)
    found = told["numbers"]["engineers_numbers"]
    assert found == json.loads(out.read_text())["engineers_numbers"]
    assert found["structure"] == "PID, 1 notch, low-pass"
    assert found["pid"]["ti_s"] == pytest.approx(0.8, rel=1e-9)
    (notch,) = found["notches"]
    assert [notch["frequency_hz"], notch["depth_db"], notch["width_hz"]] == pytest.approx([1.9, 10.0, 0.6])
    rows = {row["label"]: row["value"] for row in told["table"] if row["section"] == "controller"}
    assert re.fullmatch(r"Kp = \S+, Ti = 0.8 s, Td = \S+ s, Tf = \S+ s(, Td/Tf at .*)?", rows["PID"])
    assert rows["notch"].startswith("1.9 Hz, 10 dB deep, 0.6 Hz wide")
    assert rows["low-pass"] == "7 Hz, order 2, damping 0.7"
    assert "K_without_delay" in rows["computational delay"]


def test_every_crossover_is_listed_and_the_margins_are_the_smallest_of_them(flexlink, tmp_path):
    answer = flexlink("design", *_asked(tmp_path), "--json")
    (plant,) = json.loads(answer.out)["numbers"]["certificate"]["plants"]
    margins, found = plant["nominal_margins"], plant["crossovers"]
    assert found["gain"]
    assert found["phase"]
    phases = [abs(each["phase_margin_rad"]) for each in found["gain"]]
    assert min(phases) == pytest.approx(margins["phase_rad"])
    assert min(each["delay_margin_s"] for each in found["gain"]) == pytest.approx(margins["delay_s"])
    rises = [each["gain_margin"] for each in found["phase"] if each["gain_margin"] > 1]
    assert min(rises) == pytest.approx(margins["gain_up"])
    places = [each["omega_rad_s"] for each in found["gain"]]
    assert places == sorted(places)


def test_a_controller_that_is_brought_is_shown_in_these_numbers(flexlink, tmp_path):
    """Textbook numbers into z by the trapezoidal rule, with no help of the product."""
    pid = control.tf([0.3], [1.0]) * (1 + control.tf([1.0], [0.8, 0.0]) + control.tf([0.1, 0.0], [0.06, 1.0]))
    law = control.ss(control.sample_system(pid, DT_S, "bilinear"))
    write_json(tmp_path / "typed.json", document(law))
    (tmp_path / "wish.toml").write_text(WISH[: WISH.index("structure")] + WISH[WISH.index("\n[unc") :])
    write_json(tmp_path / "arm.json", document(arm()))
    answer = flexlink(
        "certify",
        tmp_path / "arm.json",
        "--controller",
        tmp_path / "typed.json",
        "--spec",
        tmp_path / "wish.toml",
        "--verbose",
    )
    assert "Kp = 0.3, Ti = 0.8 s, Td = 0.1 s, Tf = 0.06 s" in answer.out
    assert "gain crossover" in answer.out


@pytest.mark.parametrize("slope_deg", [-300.0, -90.0, 0.0, 60.0, 250.0])
def test_the_phase_that_tune_draws_shows_the_phase_margin(slope_deg):
    """Whatever turn the phase begins in: the loop is a margin above -180 degrees where its gain is one."""
    omega = np.geomspace(0.05, 500, 400)
    decades = np.log10(omega / 5.0)
    loop = 10.0 ** (-1.5 * decades) * np.exp(1j * np.radians(-140.0 + slope_deg * decades))
    law = Controller.proportional(2.0, 1e-3, computational_delay_samples=0)
    plant = SimpleNamespace(at=lambda omega_rad_s: SimpleNamespace(centre=loop / 2.0))
    seen = bode(law, plant, omega, ("V", "rad"))
    of_loop, of_plant, of_controller = seen["curves"]
    assert [curve["unit"] for curve in seen["curves"]] == ["1", "rad / V", "V / rad"]
    crossover = int(np.argmin(np.abs(decades)))
    assert of_loop["deg"][crossover] == pytest.approx(-140.0, abs=5)
    assert of_plant["deg"] == pytest.approx(of_loop["deg"], abs=0.02)
    assert np.ptp(of_loop["deg"]) == pytest.approx(4.0 * abs(slope_deg), abs=0.1)
    assert set(of_controller["gain"]) == {2.0}
    assert set(of_controller["deg"]) == {0.0}


def test_tune_keeps_the_notch_and_draws_the_loop(tmp_path):
    plant, _, spec = _asked(tmp_path)
    session = TuningSession([plant], read_design_file(spec), tmp_path / "saved", 2006)
    # What the page's slider and switch say of order and integrator follows from the structure.
    found = session.design({"bandwidth_rad_s": 0.6, "controller_order": 4, "integrator": False})
    assert found["certified"]
    numbers = dict(found["numbers"])
    assert "notch 1.9 Hz, 10 dB deep" in numbers["controller"]
    assert numbers["controller order"] == "6"
    (seen,) = found["plants"]
    drawn = seen["bode"]
    loop, of_plant, controller = drawn["curves"]
    assert [one["symbol"] for one in drawn["curves"]] == ["K G", "G", "K"]
    assert len(drawn["x"]) == len(loop["gain"]) == len(of_plant["deg"])
    nominal = arm()
    at = len(drawn["x"]) // 2
    gain = abs(nominal(np.exp(1j * drawn["x"][at] * DT_S)))
    assert of_plant["gain"][at] == pytest.approx(gain, rel=1e-3)
    assert loop["gain"][at] == pytest.approx(gain * controller["gain"][at], rel=1e-3)
    real, imaginary = seen["roots"]["plant poles"]
    poles = np.sort_complex(np.array(real) + 1j * np.array(imaginary))
    np.testing.assert_allclose(poles, np.sort_complex(nominal.poles()), atol=1e-4)
    assert len(seen["roots"]["controller poles"][0]) == 6
    # Of a free cascade the page may ask for a PID.
    (tmp_path / "free.toml").write_text(FREE + QUICK)
    session = TuningSession([plant], read_design_file(tmp_path / "free.toml"), tmp_path / "saved", 2006)
    found = session.design({"structure": "pid"})
    assert dict(found["numbers"])["controller"].startswith("PID Kp = ")


@pytest.mark.slow
@needs_compiler
def test_a_fixed_notch_is_certified_on_the_simulated_link_and_runs_as_c(flexlink, tmp_path):
    """From simulated logs to C code: the notch is where and as deep as it was asked."""
    logs = tmp_path / "logs"
    assert flexlink("simulate", "--out", logs).code == 0
    chosen = [logs / f"0{k}_4_V_rms_realisation_{k}.csv" for k in (1, 2)] + [logs / "09_prbs.csv"]
    columns = ["--input", "voltage_V", "--output", "hub_angle_rad"]
    assert flexlink("init", *chosen, *columns, "--out", tmp_path / "own.toml").code == 0
    text = (tmp_path / "own.toml").read_text()
    left_out = "controller_order|integrator|controller_damping|mode_|lowest_bandwidth|highest_"
    text = re.sub(rf"^({left_out})\w* =.*\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^bandwidth_rad_s = .*$", "bandwidth_rad_s = 5.0", text, flags=re.MULTILINE)
    asked = 'structure = "pid"\nnotches = [{ frequency_hz = 8.0, depth_db = 10.0 }]\nlow_pass = {}\n'
    text = text.replace("[specification]\n", f"[specification]\n{asked}")
    text += "\n[certificate]\njoint_draws = 0\n\n[achievable_performance]\ncompute = false\n"
    (tmp_path / "own.toml").write_text(text)
    out = tmp_path / "run"
    answer = flexlink("run", "--config", tmp_path / "own.toml", "--out", out, "--c-prefix", "hub")
    assert answer.code == 0, answer.err
    assert "notch 8 Hz, 10 dB deep" in " ".join(answer.out.replace("│", " ").split())

    page = (out / "report.html").read_text()
    assert "The controller in numbers: PID, 1 notch, low-pass" in page
    assert "8 Hz, 10 dB deep" in page
    assert "every crossover at the centres" in page

    # The constants of the header are those of the law that runs.
    header = (out / "controller.h").read_text()
    constants = dict(re.findall(r"#define HUB_(\w+) (\S+)", header))
    assert [float(constants[f"NOTCH_1_{name}"]) for name in ("HZ", "DEPTH_DB")] == pytest.approx([8.0, 10.0])
    law = Controller.from_json((out / "controller.json").read_text())
    found = engineers_numbers(law)
    assert float(constants["KP"]) == pytest.approx(found.pid.kp, rel=1e-12)

    # The code answers as the law does, whose response has the depth at the notch: over the same law without.
    library = compiled((out / "controller.c").read_text(), tmp_path)
    library.hub_step.restype = ctypes.c_double
    library.hub_step.argtypes = [ctypes.c_void_p, ctypes.c_double]
    state = ctypes.create_string_buffer(4096)
    library.hub_reset(state)
    errors = 1e-3 * np.random.default_rng(2).standard_normal(300)
    stepper = ControllerStepper(law)
    computed = [library.hub_step(state, float(error)) for error in errors]
    np.testing.assert_allclose(computed, [stepper.step(float(error)) for error in errors], atol=1e-12)
    omega = np.array([2 * np.pi * 8.0])
    without = replace(found, notches=())
    ratio = abs(law.response(omega, with_delay=False) / without.response(omega))[0]
    assert ratio == pytest.approx(10 ** (-10 / 20), rel=1e-9)
