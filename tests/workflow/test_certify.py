"""`flexlink certify`: a controller that is there, its certificate, and the baseline that a CI job holds."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.signal

from control_design.controllers.controller import Controller
from tests.test_docs import run_command


@pytest.fixture
def example(examples_alone, monkeypatch):
    monkeypatch.chdir("examples/margins_in_ci")
    return ["certify", "arm.json", "--spec", "specification.toml", "--controller"]


def test_the_job_holds_the_margins_and_fails_where_the_controller_is_changed(flexlink, example):
    (job,) = re.findall(r"run: >-\n((?: {10}.+\n)+)", Path("margins.yml").read_text())
    printed = run_command(job, flexlink)
    assert len(re.findall(r"^│", printed, re.MULTILINE)) <= 10
    assert "certified: every requirement is met, and nothing is worse than in margins.toml" in printed
    law = Controller.from_json(Path("controller.json").read_text())
    for gain, words in (
        (0.985, "certified, but worse than margins.toml: arm gamma 0.9916 (0.9772); written to new.toml\n"),
        (1.2, "; new.toml is not written\n"),
    ):
        Path("changed.json").write_text(replace(law, C=gain * law.C, D=gain * law.D).to_json())
        told = flexlink(*job.replace("controller.json", "changed.json --write-baseline new.toml").split()[1:])
        assert (told.code, words in told.err) == (1, True), told.err


@pytest.mark.slow
def test_every_form_of_a_controller_has_one_certificate(flexlink, example):
    law = Controller.from_json(Path("controller.json").read_text())
    above, below = scipy.signal.ss2tf(law.A, law.B, law.C, law.D)
    zeros, poles, gain = scipy.signal.tf2zpk(above[0], below)
    pairs = [[[r.real, r.imag] for r in roots if r.imag >= 0] for roots in (zeros, poles)]
    forms = {
        "tf.json": {"numerator": above[0].tolist(), "denominator": below.tolist()},
        "pairs.json": {"zeros": pairs[0], "poles": pairs[1], "gain": gain},
        "matrices.json": {name: getattr(law, name).tolist() for name in "ABCD"},
    }
    for name, form in forms.items():
        Path(name).write_text(json.dumps({**form, "dt_s": law.dt_s}))
    scipy.io.savemat("roots.mat", {"zeros": zeros, "poles": poles, "gain": gain, "Ts": law.dt_s})
    Path("law.mat").write_bytes(law.to_mat())
    found = [flexlink(*example, name, "--json").document() for name in (*forms, "roots.mat", "law.mat")]
    worst = [each["numbers"]["worst_cases"]["arm"] for each in found]
    assert worst == [pytest.approx(worst[0], rel=1e-6)] * 5


def test_a_run_certifies_its_own_controller_and_writes_its_baseline(flexlink, fast_run, tmp_path):
    out, summary = fast_run
    baseline = tmp_path / "new.toml"
    told = flexlink("certify", out, "--write-baseline", baseline, "--json").document()
    assert told["numbers"]["certificate"]["gamma"] == summary.numbers["certificate"]["gamma"]
    text = baseline.read_text().replace("gamma = 0.005", "gamma = 0.3  # as agreed")
    baseline.write_text(text + '\n["other loop"]\ngamma = 0.7\n')
    assert flexlink("certify", out, "--write-baseline", baseline).code == 0
    assert "# as agreed" in baseline.read_text()
    assert '["other loop"]\ngamma = 0.7' in baseline.read_text()
    rows = flexlink("certify", out, "--baseline", baseline, "--json").document()["numbers"]["baseline"]
    assert {row["verdict"] for row in rows["hub"].values()} == {"as before"}


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("margins.toml", "[arm", "[leg", r"no table \[arm\]"),
        ("margins.toml", "\ngamma", "\ngama", "gama: unknown .did you mean gamma"),
        ("margins.toml", "gamma = 0.005", "gamma = '5 %'", "gamma: expected a number"),
        ("margins.toml", "delay_margin_s = 0.02", "delay_s = 0.02", r"tolerance\] delay_s: no such number"),
        ("controller.json", "0.005", "0.01", "sampled every 0.01 s"),
        ("controller.json", '"signals": ""', '"signals": "y as logged"', "certify it with its run"),
        ("specification.toml", "[specification]", "[synthesis]", "no specification|unknown key"),
    ],
)
def test_what_cannot_be_compared_is_bad_input(refused, example, file, old, new, words):
    text = Path(file).read_text()
    assert old in text
    Path(file).write_text(text.replace(old, new, 2 if old == "[arm" else 1))
    assert re.search(words, refused(*example, "controller.json", "--baseline", "margins.toml"))


def test_what_is_said_of_a_limited_loop(flexlink, example):
    """Nothing without a limit; with one that it ends where it must, or that it does not, which is no
    certificate."""
    told = flexlink(*example, "controller.json")
    assert "nothing is said: the controller has no input_limit and no rate_limit" in " ".join(
        told.out.split()
    )
    law = Controller.from_json(Path("controller.json").read_text())
    open_gain = law.to_dict() | {"input_limit": 1.0, "anti_windup_gain": None}
    Path("limited.json").write_text(json.dumps(open_gain))
    told = flexlink(*example, "limited.json", "--json").document()["numbers"]["certificate"]
    alone, loop = told["limited"]
    assert (alone["plant"], loop["plant"]) == ("controller", "arm")
    assert max(alone["error_left"] + loop["error_left"]) < 0.02
    about = {item["requirement"] for item in told["items"] if "limited" in item["requirement"]}
    assert len(about) == 2


def test_what_is_no_controller_is_bad_input(refused, example, fast_run):
    assert "holds a model" in refused(*example, fast_run[0] / "model.json")
    Path("law.json").write_text('{"zeros": [[0.5, 0.1]], "poles": [1], "gain": 1, "dt_s": 0.005}')
    assert "no more zeros than poles" in refused(*example, "law.json")
    assert "give --controller" in refused(*example[:-1])


@pytest.mark.slow
def test_one_sweep_of_two_lags_is_judged_by_its_points_and_says_what_is_assumed_beyond(flexlink, tmp_path):
    """An exact sweep of 1.2 / ((s/6 + 1) (s/150 + 1)); the loop's distances are those of its own points."""
    dt_s = 0.002
    omega = np.geomspace(2.0, 400.0, 90)
    response = 1.2 / ((1j * omega / 6 + 1) * (1j * omega / 150 + 1))
    rows = zip(omega, 20 * np.log10(np.abs(response)), np.degrees(np.angle(response)), strict=True)
    table = tmp_path / "sweep.csv"
    lines = [",".join(f"{value:.6g}" for value in row) for row in rows]
    table.write_text("\n".join(["Frequency [rad/s],Magnitude [dB],Phase [deg]", *lines]) + "\n")
    law = {"dt_s": dt_s, "numerator": [4.0, -3.9], "denominator": [1.0, -1.0]}
    (tmp_path / "law.json").write_text(json.dumps(law))
    (tmp_path / "asked.toml").write_text(
        "[specification]\nmodulus_margin = 0.5\ncomputational_delay_samples = 0\ncontroller_order = 2\n"
        f"[plant]\ndt_s = {dt_s}\n[uncertainty]\nmultiplicative = 0.02\n"
    )
    command = ["certify", table, "--controller", tmp_path / "law.json", "--spec", tmp_path / "asked.toml"]
    assert "Outside 2 to 400 rad/s nothing was measured" in " ".join(flexlink(*command).out.split())
    (verdict,) = flexlink(*command, "--json").document()["numbers"]["certificate"]["plants"]

    z = np.exp(1j * omega * dt_s)
    loop = response * (4.0 * z - 3.9) / (z - 1)
    assert verdict["stable"] is True
    assert verdict["nominal_margins"]["modulus"] == pytest.approx(np.abs(1 + loop).min(), rel=0.01)
    # Where the gain crosses 1, between two points.
    crossing = np.interp(0.0, -np.log(np.abs(loop)), np.unwrap(np.angle(loop)))
    assert verdict["nominal_margins"]["phase_rad"] == pytest.approx(np.pi + crossing, abs=0.02)
    # Two per cent of uncertainty takes no more than 2 % of |L| off the distance.
    assert 0.95 < verdict["worst_margins"]["modulus"] / verdict["nominal_margins"]["modulus"] < 1.0
