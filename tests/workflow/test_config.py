"""The configuration: defaults, round trip, what contradicts itself, and the examples as they ship."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from tests.workflow.command import FAST_ARM, ROOT
from workflow.config.rig_settings import BangBang, Doublet, LogChirp, Multisine, Prbs
from workflow.config.run_config import FileSource, RunConfig, SimulatedSource, built_in_config, load_config
from workflow.config.settings import check
from workflow.engine.errors import InputError
from workflow.kinds import load_any
from workflow.tasks.simulated_rig import simulate_record

MINIMAL = """
[run]
name = "my_arm"
[source]
kind = "files"
time = "t_s"
[[source.records]]
path = "log.csv"
[[channels]]
input = "voltage_V"
output = "angle_rad"
[specification]
bandwidth_rad_s = 2.0
"""


def minimal(tmp_path, text=MINIMAL):
    (tmp_path / "log.csv").write_text("")
    (tmp_path / "arm.toml").write_text(text)
    return load_config(tmp_path / "arm.toml")[0]


def test_own_data_needs_a_dozen_lines(tmp_path):
    assert len(MINIMAL.split("\n")) - 2 <= 13
    config = minimal(tmp_path)
    assert isinstance(config.source, FileSource)
    assert config.machine == "identified"
    assert config.purpose_of(0) == "control"
    assert config.record_names == ["log"]
    assert config.input_files == [tmp_path / "log.csv"]


def test_a_kept_configuration_states_the_same_from_anywhere(tmp_path, monkeypatch):
    commented = MINIMAL.replace('"log.csv"', '"log.csv"  # of Monday')
    (tmp_path / "log.csv").write_text("")
    (tmp_path / "arm.toml").write_text(commented)
    config, text = load_config(tmp_path / "arm.toml")
    assert text == commented.replace("log.csv", str(tmp_path / "log.csv"))
    (tmp_path / "elsewhere").mkdir()
    kept = tmp_path / "elsewhere" / "config.toml"
    kept.write_text(text)
    assert load_config(kept) == (config, text)
    # A variable of the environment is absolute by what it stands for.
    monkeypatch.setenv("LOGS", str(tmp_path))
    kept.write_text(MINIMAL.replace("log.csv", "${LOGS}/log.csv"))
    assert load_config(kept) == (config, kept.read_text())


def test_several_missing_logs_are_counted_once_each(tmp_path):
    more = '[[source.records]]\npath = "b.csv"\n[[source.records]]\npath = "c.csv"\n[[channels]]'
    (tmp_path / "arm.toml").write_text(MINIMAL.replace("[[channels]]", more))
    with pytest.raises(InputError, match=r"records\[0\]\.path: no such file: .*log\.csv \(and 2 more\)$"):
        load_config(tmp_path / "arm.toml")


def test_document_round_trip_survives_a_moved_log(tmp_path):
    config = minimal(tmp_path)
    (tmp_path / "log.csv").unlink()
    assert RunConfig.from_document(config.to_document(), source="x") == config


def test_frozen_and_second_channel_is_performance():
    config, _ = load_config(FAST_ARM)
    with pytest.raises(ValueError, match="frozen"):
        config.run.seed = 1
    default, _ = built_in_config()
    assert (default.control_index, default.performance_index) == (0, 1)


@pytest.mark.parametrize(
    ("extra", "complaint"),
    [
        ('[[channels]]\ninput = "voltage_V"\noutput = "angle_rad"', "two channels are called 'angle_rad'"),
        ('[[channels]]\ninput = "v2"\noutput = "tip"', "same input"),
        ('[[channels]]\ninput = "voltage_V"\noutput = "tip"\npurpose = "control"', "exactly one channel"),
        ('[[source.records]]\npath = "log.csv"', "records 'log' and 'log' share rows of log.csv"),
        ('[closed_loop_data]\nmethod = "two_stage"', "needs references"),
        ('[closed_loop]\neffects = [{ name = "tip_payload", mass_kg = 0.1 }]', "simulated arm only"),
        ("[run.more]\na = 1", "unknown key run.more"),
    ],
)
def test_contradictions(tmp_path, extra, complaint):
    with pytest.raises(InputError, match=complaint):
        minimal(tmp_path, MINIMAL + extra)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('path = "log.csv"', 'path = "log.csv"\nrole = "validation"', "no record has role 'estimation'"),
        ('time = "t_s"', 'time = "t_s"\ndt_s = 0.1', "not both"),
        ('path = "log.csv"', 'path = "log.csv"\nstart_sample = 5\nstop_sample = 5', "must be above"),
        ('name = "my_arm"', 'name = "../my_arm"', "run.name"),
        ('name = "my_arm"', "seed = -1", "run.seed"),
    ],
)
def test_contradictions_in_the_source(tmp_path, old, new, complaint):
    assert old in MINIMAL
    with pytest.raises(InputError, match=complaint):
        minimal(tmp_path, MINIMAL.replace(old, new))


SIZE = {"amplitude_V": 2.0, "samples": 100}


@pytest.mark.parametrize(
    ("kind", "name", "table"),
    [
        (Prbs, "prbs", SIZE),
        (Multisine, "multisine", {"rms_V": 1.0, "period_samples": 100, "from_Hz": 2.0, "to_Hz": 50.0}),
        (LogChirp, "log_chirp", SIZE | {"from_Hz": 1.0, "to_Hz": 40.0}),
        (Doublet, "doublet", SIZE | {"pulse_s": 0.1}),
        (BangBang, "bang_bang", SIZE | {"slew_s": 0.2}),
    ],
)
def test_every_excitation_gives_its_samples_and_its_size(kind, name, table):
    signal = check(kind, {"kind": name, **table}, source="x").signal(0.005, np.random.default_rng(1))
    assert signal.shape == (100,)
    if "rms_V" in table:
        np.testing.assert_allclose(np.sqrt(np.mean(signal**2)), table["rms_V"], rtol=1e-12)
    else:
        assert 0.95 * table["amplitude_V"] < np.max(np.abs(signal)) <= table["amplitude_V"]


@pytest.mark.parametrize(
    ("channel", "complaint"),
    [
        ("uncertainty = {{ {0}, method = 'records' }}", "goes with method = 'tangent'"),
        ("uncertainty = {{ {0} }}\nincrements = true", "records as measured"),
        ("uncertainty = {{ {0} }}\nband_rad_s = [1.0, 20.0]", "records as measured"),
        ("uncertainty = {{ {0} }}\nidentification = {{ integrators = 2 }}", "at most one integrator"),
        ("uncertainty = {{ response = 'amplitude 2' }}", "response"),
    ],
)
def test_a_response_that_cannot_be_described_is_refused(tmp_path, channel, complaint):
    asked = channel.format("response = 'without friction'")
    with pytest.raises(InputError, match=complaint):
        minimal(tmp_path, MINIMAL.replace("[[channels]]", f"[[channels]]\n{asked}"))


def test_channels_are_about_the_same_amplitude(tmp_path):
    described = MINIMAL.replace("[[channels]]", "[[channels]]\nuncertainty = { response = 'this amplitude' }")
    tip = '[[channels]]\ninput = "voltage_V"\noutput = "tip_m"\n%s\n[specification]'
    other = tip % "uncertainty = { response = 'without friction' }"
    with pytest.raises(InputError, match="describe 'this amplitude' and 'without friction'"):
        minimal(tmp_path, described.replace("[specification]", other))


def test_friction_is_fed_forward_only_where_it_is_identified(tmp_path):
    asked = "[closed_loop]\nfriction_feedforward = true\n"
    with pytest.raises(InputError, match="friction_feedforward = true needs an identified friction"):
        minimal(tmp_path, MINIMAL + asked)
    described = MINIMAL.replace(
        "[[channels]]", "[[channels]]\nuncertainty = { response = 'without friction' }"
    )
    assert minimal(tmp_path, described + asked).closed_loop.friction_feedforward


def test_packaged_default_is_the_example():
    assert (ROOT / "workflow" / "data" / "default_arm.toml").read_text() == (
        ROOT / "examples" / "default_arm.toml"
    ).read_text()


# own_log.toml is a pattern to fill in and needs its logs made first: test_readme.py runs it.
NAMED_ARMS = sorted(path for path in (ROOT / "examples").glob("*.toml") if path.stem != "own_log")


@pytest.mark.parametrize(
    "path",
    [path for path in NAMED_ARMS if "[study]" not in path.read_text().split("\n")],
    ids=lambda path: path.stem,
)
def test_examples_are_valid_and_say_what_is_not_known(path, monkeypatch, request):
    if "FLEXLINK_DATA" in path.read_text():
        monkeypatch.setenv("FLEXLINK_DATA", str(request.getfixturevalue("flexlink_data")))
    config, text = load_any(path)
    assert config.notes.unknown
    assert type(config).from_document(config.to_document(), source="x") == config
    assert tomllib.loads(text)["run"]["name"] == path.stem


def test_rig_file_is_read_relative_to_the_configuration(tmp_path):
    from plant.presets import paper_link

    (tmp_path / "rig.toml").write_text(paper_link().to_toml())
    text = FAST_ARM.read_text().replace('rig = "paper_link"', 'rig = "rig.toml"')
    (tmp_path / "arm.toml").write_text(text)
    config, _ = load_config(tmp_path / "arm.toml")
    assert isinstance(config.source, SimulatedSource)
    assert config.source.rig == tmp_path / "rig.toml"
    assert config.input_files == [tmp_path / "rig.toml"]
    assert RunConfig.from_document(config.to_document(), source="x") == config
    (tmp_path / "rig.toml").write_text("[link]\nlength_m = -1.0\n")
    with pytest.raises(InputError, match=r"source\.rig: .*rig\.toml"):
        load_config(Path(tmp_path / "arm.toml"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('{ path = "a.csv", name = "again" }', "share rows of a.csv: use each row once"),
        ('{ path = "a.csv", name = "fresh", role = "validation", start_sample = 3 }', "share rows of a.csv"),
    ],
)
def test_rows_are_used_once(tmp_path, change, message):
    (tmp_path / "a.csv").write_text("t,u,y\n0,1,0\n1,0,1\n2,1,1\n3,0,2\n4,1,1\n")
    text = """[source]
kind = "files"
time = "t"
records = [{ path = "a.csv" }, %s]
[[channels]]
input = "u"
output = "y"
[specification]
"""
    (tmp_path / "own.toml").write_text(text % change)
    with pytest.raises(InputError, match=message):
        load_config(tmp_path / "own.toml")
    apart = '{ path = "a.csv", name = "rest", start_sample = 3 }'
    first = text.replace('{ path = "a.csv" }', '{ path = "a.csv", stop_sample = 3 }')
    (tmp_path / "own.toml").write_text(first % apart)
    assert len(load_config(tmp_path / "own.toml")[0].source.records) == 2
    (tmp_path / "own.toml").write_text(first.replace('output = "y"', 'output = "u"') % apart)
    with pytest.raises(InputError, match="input and output are the same column, 'u'"):
        load_config(tmp_path / "own.toml")


def test_a_plan_is_its_records(tmp_path):
    text = """[source]
kind = "simulated"
plan.rms_V = [2.0, 4.0]
plan.realisations = 2
plan.period_samples = 100
plan.lead_in_samples = 20
plan.from_Hz = 2.0
plan.to_Hz = 90.0
%s
[[channels]]
input = "voltage_V"
output = "hub_angle_rad"
[specification]
"""
    own = '[[source.records]]\nname = "own"\nexcitation = { kind = "prbs", amplitude_V = 1.0, samples = 50 }'
    (tmp_path / "plan.toml").write_text(text % own)
    config, _ = load_config(tmp_path / "plan.toml")
    amplitudes = [f"{rms} V rms, realisation {k}" for rms in (2, 4) for k in (1, 2)]
    assert config.record_names == [*amplitudes, "own"]
    assert RunConfig.from_document(config.to_document(), source="document") == config
    records = [simulate_record(config.source, entry, 7) for entry in config.source.records]
    spectra = [np.fft.rfft(record.input[20:120, 0]) for record in records[:4]]
    excited = [np.flatnonzero(np.abs(spectrum) > 1e-9 * np.abs(spectrum).max()) for spectrum in spectra]
    assert all(np.array_equal(excited[0], lines) for lines in excited)
    assert np.sqrt(np.mean(records[2].input[20:] ** 2)) == pytest.approx(4.0)
    (tmp_path / "plan.toml").write_text((text % own).replace("plan.period_samples = 100\n", ""))
    with pytest.raises(InputError, match=r"missing key source\.plan\.period_samples"):
        load_config(tmp_path / "plan.toml")


def test_kinds_are_named_in_the_words_of_toml(tmp_path):
    with pytest.raises(InputError, match=r"specification\.fixed: expected a table, got 3"):
        minimal(tmp_path, MINIMAL + "fixed = 3\n")
    with pytest.raises(InputError, match=r"specification\.notches: expected a list, got 3"):
        minimal(tmp_path, MINIMAL + "notches = 3\n")


@pytest.mark.parametrize(
    ("earlier", "complaint"),
    [
        ("[yardstick]\ncompute = true", "unknown key yardstick (it is called achievable_performance today)"),
        ("[prefilter]\norder = 2", "unknown key prefilter (it is called reference_filter today)"),
        ("[synthesis]\njobs = 2", "unknown key synthesis.jobs (leave it out: study --jobs computes several"),
        ("[achievable_performance]\nhull = true", "unknown key achievable_performance.hull (leave it out"),
    ],
)
def test_a_key_of_an_earlier_version_names_what_to_write_today(tmp_path, earlier, complaint):
    path = tmp_path / "arm.toml"
    path.write_text(f"{built_in_config()[1]}\n{earlier}\n")
    with pytest.raises(InputError) as caught:
        load_config(path)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("was", "now", "complaint"),
    [
        ("[specification]", "[specification]\nti_s = 1.0", "ti_s (it is called fixed.ti_s today)"),
        (
            "[specification]",
            '[specification]\nstructure = "pi_d_notch"',
            "structure: there is no 'pi_d_notch' any",
        ),
        ("response =", "promise =", "channels[0].uncertainty.promise (it is called response today)"),
    ],
)
def test_an_earlier_key_or_value_in_a_table_names_what_to_write_today(tmp_path, was, now, complaint):
    path = tmp_path / "arm.toml"
    path.write_text(built_in_config()[1].replace(was, now))
    with pytest.raises(InputError) as caught:
        load_config(path)
    assert complaint in str(caught.value)
