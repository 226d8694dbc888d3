"""Case files: column maps, and one line for everything that can be wrong with them."""

import tomllib

import numpy as np
import pandas as pd
import pytest

from tests.workflow.diagnosis_examples import FRICTION, write_case
from workflow.config.settings import check
from workflow.diagnose.case_files import load_case
from workflow.diagnose.case_settings import Column
from workflow.engine.errors import InputError


@pytest.fixture
def folder(tmp_path):
    return write_case(tmp_path / "arm", FRICTION)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_case_folder_is_read_as_it_stands(folder):
    loaded = load_case(folder)
    case = loaded.case
    assert case.name == "arm"
    assert [e.role for e in case.experiments] == ["estimation"] * 3 + ["held_out"]
    table = np.loadtxt(folder / "experiments/02_prbs.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(case.experiments[1].voltage_V, table[:, 1])
    np.testing.assert_array_equal(case.experiments[1].output, table[:, 2:])
    assert loaded.rig_file == "rig.toml"
    assert set(load_case(folder, "rig_uncertain.toml").case.rig.tolerances) == {
        "hub.inertia_kg_m2",
        "motor.resistance_ohm",
    }


def test_own_logs_with_a_column_map_give_the_same_case(folder, tmp_path):
    case = load_case(folder).case
    shop = tmp_path / "shop"
    shop.mkdir()
    (shop / "arm.toml").write_text((folder / "rig.toml").read_text())
    entries = []
    for number, experiment in enumerate(case.experiments):
        table = np.column_stack(
            [experiment.voltage_V, np.degrees(experiment.output[:, 0]), 1e3 * experiment.output[:, 1] + 7]
        )
        np.savetxt(
            shop / f"{number}.csv", table, delimiter=",", header="u,encoder deg,tip", comments="", fmt="%.17g"
        )
        entries.append(f'[[experiments]]\nfile = "{number}.csv"\nrole = "{experiment.role}"\n')
    (shop / "night_shift.toml").write_text(
        f'rig = "arm.toml"\ndt_s = {case.rig.sampling.dt_s}\nsuspected = ["backlash"]\n[columns]\n'
        f'voltage_V = "u"\nhub_angle_rad = {{ column = "encoder deg", scale = {np.pi / 180!r} }}\n'
        'tip_m = { column = "tip", scale = 1e-3, offset = -7e-3 }\n' + "\n".join(entries)
    )
    loaded = load_case(shop / "night_shift.toml")
    assert loaded.case.name == "night_shift"
    assert loaded.suspected == ("backlash",)
    for one, other in zip(loaded.case.experiments, case.experiments, strict=True):
        assert one.role == other.role
        np.testing.assert_array_equal(one.voltage_V, other.voltage_V)
        # Degrees and millimetres there and back: a few units in the last place of the largest value.
        np.testing.assert_allclose(one.output, other.output, rtol=0, atol=1e-14)


WORKSHOP = [
    *(f"labelled/work-{n:02d}" for n in range(1, 25, 3)),
    *(f"sealed/case-{n:02d}" for n in range(2, 31, 6)),
]


@pytest.mark.parametrize("name", WORKSHOP)
def test_a_workshop_case_is_what_its_files_say(gap_cases, name):
    folder = gap_cases / "workshop" / name
    if not folder.is_dir():
        pytest.skip(f"no such case: {folder}")
    stated = tomllib.loads((folder / "case.toml").read_text())
    case = load_case(folder).case
    assert case.outputs == tuple(stated["outputs"])
    assert case.model_error == stated["model_error"]
    assert np.all(case.noise > 0)
    answer = folder / "answer.toml"
    records = tomllib.loads(answer.read_text())["records"] if answer.is_file() else {}
    for entry, experiment in zip(stated["experiments"], case.experiments, strict=True):
        log = pd.read_csv(folder / entry["file"])

        def by_hand(quantity, log=log):
            column = stated["columns"][quantity]
            return column["scale"] * log[column["column"]].to_numpy() + column["offset"]

        assert len(experiment.output) == len(log) + len(experiment.missing)
        if experiment.name in records:
            assert experiment.missing == tuple(records[experiment.name]["lost_rows"])
        rows = np.setdiff1d(np.arange(len(experiment.output)), experiment.missing)
        np.testing.assert_array_equal(experiment.voltage_V[rows], by_hand("voltage_V"))
        late = np.max(np.abs(by_hand("time_s") / case.rig.sampling.dt_s - rows))
        for k, quantity in enumerate(case.outputs):
            read = by_hand(quantity)
            # Late by that much of a step, an output is off by no more than that share of its largest slope.
            moved = np.max(np.abs(experiment.output[rows, k] - read))
            assert moved <= (0 if late < 1e-3 else 2 * late * np.max(np.abs(np.diff(read)))), quantity
        assert (experiment.reference_rad is not None) == entry["closed_loop"]


def test_only_the_stated_outputs_are_asked_for(folder):
    head = 'case = "arm"\noutputs = ["hub_angle_rad"]\nmodel_error = 0.1'
    edit(folder / "case.toml", 'case = "arm"', head)
    for log in (folder / "experiments").iterdir():
        log.write_text("\n".join(line.rpartition(",")[0] for line in log.read_text().splitlines()))
    case = load_case(folder).case
    assert case.model_error == 0.1
    assert case.noise.tolist() == [case.rig.sensors.hub_angle_noise_rad]
    assert case.machine.simulator(())(case.experiments[0].input).shape == (240, 1)
    assert not {c.effect for c in case.machine.candidates(case.experiments)} & {"sensor_lag", "sensor_drift"}


def test_the_input_hash_follows_every_file(folder):
    hashes = {load_case(folder).input_sha256, load_case(folder, "rig_uncertain.toml").input_sha256}
    edit(folder / "case.toml", 'kind = "prbs"', 'kind = "noise"')
    hashes.add(load_case(folder).input_sha256)
    log = folder / "experiments/01_prbs.csv"
    edit(log, "\n0,", "\n-0,")
    hashes.add(load_case(folder).input_sha256)
    assert len(hashes) == 4


def _nan(folder):
    log = folder / "experiments/03_prbs.csv"
    lines = log.read_text().splitlines()
    first, _, *rest = lines[41].split(",")
    lines[41] = ",".join([first, "nan", *rest])
    log.write_text("\n".join(lines) + "\n")


def _dead(folder):
    log = folder / "experiments/02_prbs.csv"
    head, *lines = log.read_text().splitlines()
    log.write_text("\n".join([head, *(line.rpartition(",")[0] + ",0.25" for line in lines)]) + "\n")


def _case(old, new):
    return lambda folder: edit(folder / "case.toml", old, new)


def _rig(old, new):
    return lambda folder: edit(folder / "rig.toml", old, new)


SPOILT = {
    "unknown key": (_case("kind =", "knid ="), ["case.toml", "experiments[0].knid", "did you mean kind?"]),
    "unknown role": (_case('"held_out"', '"validation"'), ["case.toml", "experiments[3].role", "'held_out'"]),
    "no held-out role": (_case('"held_out"', '"estimation"'), ["case.toml", "no experiment", "held_out"]),
    "no such effect": (
        _case('case = "arm"', 'case = "arm"\nsuspected = ["colomb_friction"]'),
        ["case.toml", "suspected[0]", "colomb_friction", "did you mean coulomb_friction?"],
    ),
    "no such log": (_case("01_prbs.csv", "01_prbs.txt"), ["case.toml", "experiments[0].file", "01_prbs.txt"]),
    "wrong number of rows": (_case("samples = 240", "samples = 250"), ["[0].samples", "250", "240"]),
    "forbidden name": (_case('case = "arm"', 'case = "../arm"'), ["case.toml", "case", "../arm"]),
    "taken name": (_case('case = "arm"', 'case = "index"'), ["case.toml", "'index'"]),
    "no such reference": (
        _case('role = "estimation"', 'role = "estimation"\ncolumns = { reference_rad = "setpiont" }'),
        ["01_prbs.csv", "no column 'setpiont'"],
    ),
    "no such column": (
        _case('role = "estimation"', 'role = "estimation"\ncolumns = { tip_m = "tip_mm" }'),
        ["01_prbs.csv", "no column 'tip_mm'", "time_s"],
    ),
    "no hub angle": (
        _case('case = "arm"', 'case = "arm"\noutputs = ["tip_m"]'),
        ["case.toml: outputs", "expected hub_angle_rad", "got tip_m"],
    ),
    "one column twice": (
        _case('role = "estimation"', 'role = "estimation"\ncolumns = { tip_m = "hub_angle_rad" }'),
        ["case.toml: experiments[0]", "hub_angle_rad and tip_m are both 'hub_angle_rad'"],
    ),
    "a restart": (
        lambda folder: edit(folder / "experiments/01_prbs.csv", "\n0.5,", "\n0.4,"),
        ["01_prbs.csv, line 102", "goes from 0.495 to 0.4 s"],
    ),
    "millivolts as volts": (
        _case(
            "[[experiments]]",
            '[columns]\nvoltage_V = { column = "voltage_V", scale = 1e3 }\n\n[[experiments]]',
        ),
        ["case.toml: all records", "hub_angle_rad and tip_m", "voltage_V off by 1000"],
    ),
    "scale of nothing": (
        _case("[[experiments]]", '[columns]\ntip_m = { column = "tip_m", scale = 0 }\n\n[[experiments]]'),
        ["case.toml", "columns.tip_m", "scale must not be 0"],
    ),
    "not a number": (_nan, ["03_prbs.csv", "line 42", "'voltage_V'"]),
    "dead sensor": (_dead, ["02_prbs.csv", "tip_m is 0.25 throughout", "dead"]),
    "other sampling": (_rig("dt_s = 0.005", "dt_s = 0.004"), ["01_prbs.csv", "0.005", "sampling.dt_s"]),
    "no noise level": (_rig("tip_noise_m = 0.001", "tip_noise_m = 0.0"), ["case.toml", "noise level"]),
    "misspelt rig key": (_rig("inertia_kg_m2", "inerta_kg_m2"), ["rig.toml", "hub.inerta_kg_m2"]),
    "unreadable rig": (_rig("[hub]", "[hub"), ["rig.toml", "not valid TOML"]),
}


@pytest.mark.parametrize("what", SPOILT)
def test_bad_input_is_one_line_and_leaves_nothing(what, folder, refused, tmp_path):
    spoil, words = SPOILT[what]
    spoil(folder)
    line = refused("diagnose", folder, "--out", tmp_path / "out")
    for word in words:
        assert word in line, line
    assert not (tmp_path / "out").exists()


def test_wrong_calls_are_one_line(folder, refused, tmp_path):
    out = tmp_path / "out"
    assert "no such file or directory" in refused("diagnose", tmp_path / "nowhere", "--out", out)
    line = refused("diagnose", folder, "--out", out, "--rig", "rig_exact.toml")
    assert "rig_exact.toml: no such rig file" in line
    assert "rig_uncertain.toml" in line
    assert "two cases are called 'arm'" in refused("diagnose", folder, folder, "--out", out)
    assert "--jobs" in refused("diagnose", folder, "--out", out, "--jobs", 0)
    assert "contradict" in refused("diagnose", folder, "--out", out, "--resume", "--replace")
    assert not out.exists()


def test_a_damaged_case_names_itself(tmp_path):
    with pytest.raises(InputError, match=r"case\.toml"):
        load_case(tmp_path)


def test_a_case_folder_reads_nothing_outside_itself(folder, tmp_path):
    """Unless the user names the case file himself."""
    inside = folder / "experiments/01_prbs.csv"
    inside.rename(tmp_path / "01_prbs.csv")
    inside.symlink_to(tmp_path / "01_prbs.csv")
    with pytest.raises(InputError, match=r"experiments\[0\].file: .* lies outside the case folder"):
        load_case(folder)
    for other in ("../01_prbs.csv", str(tmp_path / "01_prbs.csv")):
        edit(folder / "case.toml", "experiments/01_prbs.csv", other)
        with pytest.raises(InputError, match="lies outside the case folder"):
            load_case(folder)
        assert load_case(folder / "case.toml").case.experiments[0].name == "01_prbs"
        edit(folder / "case.toml", other, "experiments/01_prbs.csv")


def test_a_column_that_wraps_goes_on_before_it_is_scaled():
    turns = np.sin(0.05 * np.arange(300))
    entry = check(Column, {"column": "counts", "unwrap": 4096, "scale": 2.0, "offset": 1.0}, source="x")
    found = entry.quantity(np.round(4096 * turns) % 4096)
    np.testing.assert_array_equal(found, 2 * np.round(4096 * turns) + 1)
    with pytest.raises(InputError, match="unwrap"):
        check(Column, {"column": "counts", "unwrap": 0}, source="x")
