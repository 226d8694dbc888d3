"""`flexlink excite`: what is written keeps the limits; what cannot be kept is refused in one line."""

import json

import numpy as np
import pytest

from plant import paper_link
from workflow.cli import main
from workflow.excite.experiment import ExperimentLimits, plan_experiment
from workflow.excite.page import experiment_page

LIMITS = ["--band", "0.5", "40", "--dt-s", "0.005", "--duration", "60", "--voltage", "10"]


def test_files_keep_the_limits_and_the_plan_says_what_is_in_them(tmp_path):
    out = tmp_path / "plan"
    options = ["--rig", "paper_link", "--angle", "30", "--noise-std", "0.001", "--realisations", "2"]
    assert main(["excite", "--out", str(out), *LIMITS, *options]) == 0
    plan = json.loads((out / "plan.json").read_text())
    assert {path.name for path in out.glob("*.csv")} == {record["file"] for record in plan["records"]}
    total = 0.0
    for record in plan["records"]:
        table = np.loadtxt(out / record["file"], delimiter=",", skiprows=1)
        voltage = table[plan["plan"]["lead_in_samples"] :, 1]
        total += table.shape[0] * 0.005
        assert np.abs(voltage).max() == pytest.approx(record["peak_V"], rel=1e-6)
        assert record["peak_V"] <= 10
        assert record["peak_angle_deg"] <= 30
        assert np.sqrt(np.mean(voltage**2)) == pytest.approx(record["rms_V"], rel=1e-6)
        spectrum = np.abs(np.fft.rfft(voltage[: plan["plan"]["period_samples"]]))
        spacing = 1 / (plan["plan"]["period_samples"] * 0.005)
        excited = np.flatnonzero(spectrum > 1e-6 * spectrum.max()) * spacing
        np.testing.assert_allclose(excited, plan["lines_Hz"])
    assert total == pytest.approx(plan["duration_s"])
    assert total <= 60
    assert "Planned experiment" in (out / "plan.html").read_text()


@pytest.mark.parametrize(
    ("options", "noise_rad", "words"),
    [([], 4.43e-4, "assumed: an encoder of 12 bits"), (["--rig", "paper_link"], 1e-3, "that of the rig")],
)
def test_the_radius_is_predicted_though_nobody_states_the_noise(tmp_path, options, noise_rad, words):
    assert main(["excite", "--out", str(tmp_path / "plan"), *LIMITS, "--rms", "3", *options]) == 0
    found = json.loads((tmp_path / "plan" / "plan.json").read_text())
    own = found["plan"]
    samples = own["period_samples"] * own["realisations"] * own["periods"]
    v = 2 * len(found["lines_Hz"]) * noise_rad**2 / (samples * 3.0**2)
    assert found["expected_radius_rad_per_V"] == [pytest.approx(np.sqrt(-np.log(0.05) * v), rel=1e-3)]
    assert words in (tmp_path / "plan" / "plan.html").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--duration", "10"], ["needs periods of 2 s", "10 s are allowed"]),
        (["--rms", "9"], ["9 V rms, realisation 1", "10 V are allowed"]),
        (["--angle", "5"], ["give a rig or gain_rad_per_Vs"]),
        (["--rms", "3", "--angle", "5", "--gain", "1"], ["expected to turn by", "5 are allowed"]),
        (["--band", "0.5", "140"], ["Nyquist"]),
        (["--voltage", "-1"], ["--voltage: input should be greater than 0"]),
        (["--rig", "absent.toml"], ["absent.toml"]),
    ],
)
def test_impossible_limits_are_one_line(tmp_path, capsys, options, words):
    assert main(["excite", "--out", str(tmp_path / "plan"), *LIMITS, *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert not (tmp_path / "plan").exists()


@pytest.mark.parametrize("stated", [{"rig": paper_link(), "angle_deg": 40.0}, {"gain_rad_per_Vs": 2.0}, {}])
def test_the_page_says_what_is_planned_and_what_to_expect(stated):
    limits = ExperimentLimits(band_Hz=(0.5, 90.0), dt_s=0.005, duration_s=40.0, peak_V=24.0, **stated)
    plan = plan_experiment(limits, seed=1, realisations=1)
    page = experiment_page(plan)
    rows = {row.name: row for row in page.first.rows}
    assert rows["records"].value.plain == plan.plan.n_records
    assert rows["highest voltage"].value.plain == max(record.peak_V for record in plan.records) <= 24.0
    turns = rows["hub turns by at most"]
    if stated:
        assert turns.value.plain == max(record.peak_angle_deg for record in plan.records)
        assert ("40 allowed" in turns.remark) == ("rig" in stated)
    else:
        assert (turns.value.text, turns.remark) == ("not predicted", "give --rig or --gain")
    radius = rows["95 % radius of the response"]
    assert radius.value.unit == ("%" if stated else "rad/V")
    assert any("One realisation" in bullet for bullet in page.first.bullets)
    uncertainty, files = page.sections
    assert len(uncertainty.blocks[0].rows) == len(plan.plan.rms_V)
    assert [row[0] for row in files.blocks[0].rows] == [record.file for record in plan.records]
