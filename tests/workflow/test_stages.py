"""What the stages leave, against known truth and against what the libraries say when called alone."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import control
import numpy as np
import pytest
from scipy.signal import lfilter

from control_design import certify
from ident import IdentOptions, Record, identify
from plant import linear_arm, paper_link, parse_effect, simulate
from tests.workflow.command import FAST_ARM
from workflow.config.design_options import ReferenceFilterSettings
from workflow.config.run_config import Channel, FileRecord, FileSource, load_config
from workflow.config.settings import check
from workflow.engine.errors import InputError
from workflow.engine.progress import Progress
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.closed_loop import run_closed_loop
from workflow.tasks.identification import as_bounded, as_fitted
from workflow.tasks.pipeline import config_of
from workflow.tasks.records import make_records, read_record, with_common_sampling_time
from workflow.tasks.results import RunResults, UncertaintyResult
from workflow.tasks.simulated_rig import encoded_arm, rig_of
from workflow.tasks.stage import StageInput
from workflow.tasks.stages import design_filter
from workflow.tasks.uncertainty import posterior_of


@pytest.fixture(scope="module")
def run(fast_run) -> RunResults:
    return RunResults(RunDirectory.open(fast_run[0]))


def true_response(omega):
    """Held input to hub angle of the fast arm, exactly: viscous friction is linear, so the rig carries it."""
    rig = paper_link()
    rig = rig.perturbed({"hub.viscous_friction_Nms": rig.hub.viscous_friction_Nms + 0.02})
    arm = linear_arm(rig)
    sampled = arm.sample(rig.sampling.dt_s, method="zoh")
    return sampled(np.exp(1j * omega * rig.sampling.dt_s))[0, 0]


def test_records_are_the_simulated_arm_and_its_sensor_noise(run):
    records, source = run.records.records, config_of(run.run).source
    assert [item.role for item in records] == ["estimation", "validation"]
    effects = [parse_effect(effect) for effect in source.effects]
    clean = simulate(rig_of(source), records[0].record.input[:, 0], effects, n_modes=source.modes)
    noise = records[0].record.output - clean.output
    sensors = paper_link().sensors
    # 700 samples: the standard deviation is known to 2.7 %; 5 sigma.
    stated = [sensors.hub_angle_noise_rad, sensors.tip_noise_m]
    np.testing.assert_allclose(noise.std(axis=0), stated, rtol=0.14)


def test_commands_beyond_what_the_amplifier_gives_are_taken_as_that(run):
    """The arm behind it is then the same: `test_identify_command.py`."""
    source = config_of(run.run).source
    entry = source.records[0]
    limit = {"name": "actuator_saturation", "limit_V": 0.7 * entry.excitation.amplitude_V}
    effects = (*source.effects, limit)
    loud = config_of(run.run).model_copy(update={"source": source.model_copy(update={"effects": effects})})
    first = make_records(StageInput(loud, run, Progress())).records[0]
    commanded = run.records.records[0].record
    assert first.record.cut == commanded.n_samples
    np.testing.assert_allclose(first.record.input, 0.7 * commanded.input, rtol=1e-12)


def test_ellipses_hold_the_true_response(run):
    frequency = run.uncertainty.channels[0].frequency
    inside = (frequency.omega_rad_s > 2) & (frequency.omega_rad_s < 100)
    truth = true_response(frequency.omega_rad_s)
    # 95 % each, strongly correlated over frequency: mostly nearly all; far less means a wrong response.
    assert np.mean(frequency.contains(truth)[inside]) > 0.7
    np.testing.assert_allclose(frequency.centre[inside], truth[inside], rtol=0.2)


def test_identification_comes_back_whole(run):
    found = run.identify.channels[0]
    assert found.fit_percent["estimation"] == {"prbs": pytest.approx(found.identification.fit_percent[0])}
    assert set(found.fit_percent["validation"]) == {"fresh <b>prbs</b>"}
    assert [fit.name for fit in found.fresh] == ["fresh <b>prbs</b>"]


def test_certificate_is_that_of_the_stored_controller(run):
    config = config_of(run.run)
    plant = run.uncertainty.plant(config)
    again = certify(run.design.synthesis.controller, [plant], config.specification)
    assert again == run.certify.certificate


def test_every_design_is_compared_with_any_order_and_sampled_whole(run):
    bracket, gamma = run.achievable_performance.bracket, run.design.gamma
    assert bracket.floor <= bracket.ellipse <= bracket.enclosing
    # The design knows more requirements than the bracket, which therefore reaches lower.
    assert bracket.ellipse < 1.001 * gamma
    joint = run.certify.sampled.joint
    assert joint.draws == 2000
    assert joint.stable_share > 0.999


def test_reference_filter_takes_the_reference_step_to_the_loop(run, tmp_path):
    shutil.copytree(run.run.path, tmp_path / "run")
    copy = RunResults(RunDirectory(tmp_path / "run"))
    corner = 0.3 * config_of(run.run).specification.bandwidth_rad_s
    settings = ReferenceFilterSettings.model_validate({"corner_rad_s": corner, "dense_points": 1000})
    config = config_of(run.run).model_copy(update={"reference_filter": settings})
    stage = StageInput(config, copy, Progress())
    result = design_filter(stage)
    found = result.filter
    assert found.error_after < found.error_before
    copy.run.save_stage("reference_filter", result, "00")
    filtered, plain = run_closed_loop(stage).check, run.closed_loop.check
    assert filtered.filtered
    assert not plain.filtered
    reference, model = filtered.reference, filtered.model_answer
    assert np.array_equal(reference, plain.reference)
    first = slice(0, reference.size // 2)

    def away(loop, signal):
        return np.max(np.abs(loop.predicted_runs.output[0, first] - signal[first]))

    # A model three times slower than the loop: with the reference filter the loop is nearer to it.
    assert away(filtered, model) < 0.7 * away(plain, model)
    assert filtered.sensitivity.measured[0].peak == plain.sensitivity.measured[0].peak


def test_closed_loop_runs_differ_in_noise_and_nothing_else(run):
    check = run.closed_loop.check
    samples = check.time_s.size
    assert check.draws == check.settled_draws == 2
    assert check.predicted_runs.output.shape == (1, samples)
    for signal in (check.achieved_runs.output, check.achieved_runs.command, check.achieved_runs.limited):
        assert signal.shape == (2, samples)
    # Noise differs between the runs, the reference does not.
    assert not np.array_equal(*check.achieved_runs.output)
    step, half = check.reference_step, samples // 2
    assert set(np.unique(check.reference)) == {0.0, step}
    assert np.all(check.disturbance[:half] == 0)
    assert np.all(check.disturbance[half:] == check.disturbance_step)
    # The model predicts the machine: friction here is viscous, so only noise and ellipse are between.
    error = check.predicted_runs.output[0] - check.achieved_runs.output[0]
    assert np.sqrt(np.mean(error**2)) < 0.05 * step


def test_sensitivity_measured_on_the_arm_is_the_predicted_one(run):
    """The fast arm has no dry friction, so S is linear: 5 % is the reach, 1 % is seen."""
    found = run.closed_loop.check.sensitivity
    assert [row.name for row in found.measured] == [
        "arm as identified",
        "arm as identified, reference ten times smaller",
    ]
    assert abs(found.measured[0].off_nominal_percent) < 5
    assert found.nominal_peak <= found.certified_peak * (1 + 1e-6)
    assert found.certified_peak == run.certify.certificate.plants[0].worst_peak_sensitivity


def test_every_condition_is_run_and_settles(run):
    check = run.closed_loop.check
    assert [row.name for row in check.conditions] == [
        "slew", "push at the tip", "payload 0 %", "payload 100 %", "payload 200 %", "late", "no friction",
        "double friction", "coarse", "voltage limit", "no anti-windup",
    ]  # fmt: skip
    assert [row.name for row in check.conditions if not row.settled] == []
    assert all(row.achieved.size == check.time_s.size // 2 for row in check.conditions)
    assert max(np.max(np.abs(row.achieved_command)) for row in check.conditions[:-1]) <= check.input_limit


def test_encoder_rounds_the_hub_angle_only():
    config, _ = load_config(FAST_ARM)
    step = 0.01
    source = config.source.model_copy(update={"encoder_step_rad": step})
    arm = encoded_arm(source, [], np.random.default_rng(1))
    for _ in range(20):
        arm.advance(6.0)
    hub, tip = arm.measure()
    assert hub / step == pytest.approx(round(hub / step), abs=1e-9)
    assert tip / step != pytest.approx(round(tip / step), abs=1e-9)
    assert abs(hub - arm.true_output[0]) < step / 2 + 6 * paper_link().sensors.hub_angle_noise_rad


def test_extra_effect_replaces_one_of_the_same_kind():
    config, _ = load_config(FAST_ARM)
    free = encoded_arm(config.source, [], np.random.default_rng(1))
    braked = encoded_arm(
        config.source, [{"name": "viscous_friction", "coefficient_Nms": 5.0}], np.random.default_rng(1)
    )
    for arm in (free, braked):
        for _ in range(100):
            arm.advance(3.0)
    assert braked.true_output[0] < 0.5 * free.true_output[0]


RESTING = {"estimate_initial_state": False}


def make_record(name="a", dt_s=0.01, u=None):
    y = np.arange(6.0)[:, None] ** 2
    u = np.array([0, 1, 0, 1, 1, 0.0])[:, None] if u is None else u
    return Record(name=name, input=u, output=y, dt_s=dt_s, input_names=("u",), output_names=("y",))


def test_channel_filters_are_what_the_settings_say():
    rng = np.random.default_rng(5)
    u = rng.standard_normal((4000, 1))
    record = replace(make_record(), input=u, output=lfilter([0.0, 0.3], [1.0, -0.7], u, axis=0))
    plain = Channel(input="u", output="y")
    for seen in (as_fitted(record, plain), as_bounded(record, plain)):
        np.testing.assert_array_equal(seen.output, record.output)
    np.testing.assert_array_equal(
        as_fitted(record, Channel(input="u", output="y", increments=True)).output,
        np.diff(record.output, axis=0),
    )
    banded = Channel(input="u", output="y", band_rad_s=(20.0, 100.0), bounds_band_rad_s=(5.0, 100.0))
    omega = 2 * np.pi * np.fft.rfftfreq(3000, 0.01)
    low = (omega > 6) & (omega < 12)

    def power(signal):
        return np.sum(np.abs(np.fft.rfft(signal[-3000:, 0]))[low] ** 2)

    # 6-12 rad/s lies inside the wider band (passed) and an octave or more below the narrower one.
    assert power(as_bounded(record, banded).output) > 0.5 * power(record.output)
    assert power(as_fitted(record, banded).output) < 0.1 * power(record.output)
    # The filter spoils the start of a record that begins in motion, not of one that begins at rest.
    at_rest = Channel(input="u", output="y", band_rad_s=(20.0, 100.0), identification=RESTING)
    assert as_fitted(record, banded).n_samples < record.n_samples == as_fitted(record, at_rest).n_samples
    with pytest.raises(ValueError, match="not both"):
        Channel(input="u", output="y", increments=True, band_rad_s=(1.0, 2.0))
    with pytest.raises(ValueError, match="goes with band_rad_s"):
        Channel(input="u", output="y", bounds_band_rad_s=(1.0, 2.0))
    with pytest.raises(ValueError, match="low < high"):
        Channel(input="u", output="y", band_rad_s=(3.0, 2.0))


@pytest.mark.slow
def test_scatter_between_records_needs_four_and_widens_the_ellipses():
    """Records of arms that differ by 20 % in gain: noise alone would never tell."""
    rng = np.random.default_rng(6)
    channel = Channel(input="u", output="y", uncertainty={"method": "records"})
    records = []
    for i, gain in enumerate((0.8, 0.95, 1.05, 1.2)):
        u = rng.standard_normal((800, 1))
        y = gain * lfilter([0.0, 0.3], [1.0, -0.7], u, axis=0) + 1e-3 * rng.standard_normal((800, 1))
        records.append(replace(make_record(f"r{i}"), input=u, output=y))
    found = identify(records, IdentOptions(n_real=1, n_pairs=0))
    result, some = found.model, tuple(records)
    omega = np.array([1.0, 10.0, 100.0])
    apart = posterior_of(result, some, channel.uncertainty).at(omega)
    noise = posterior_of(result, some, channel.uncertainty.model_copy(update={"method": "tangent"})).at(omega)
    truth = 0.3 * np.exp(-1j * omega * 0.01) / (1 - 0.7 * np.exp(-1j * omega * 0.01))
    for gain in (0.8, 1.2):
        assert np.all(apart.contains(gain * truth))
        assert not np.any(noise.contains(gain * truth))
    with pytest.raises(ValueError, match="at least four estimation records; found 3"):
        posterior_of(result, some[:3], channel.uncertainty)


def test_sampling_times_that_differ_are_refused_and_jitter_is_not():
    with pytest.raises(InputError, match=r"'a' and 'b' differ in sampling time \(0\.01 and 0\.02 s\)"):
        with_common_sampling_time([make_record("a"), make_record("b", 0.02)])
    with pytest.raises(InputError, match=r"--resample-s 0\.02 \(resample_s\)"):
        with_common_sampling_time([make_record("b", 0.02), make_record("a")])
    with pytest.raises(InputError, match="differ in sampling time"):
        with_common_sampling_time([make_record("a"), make_record("b", 0.01 * (1 + 2e-3))])
    for apart in (1e-9, 40e-6, -9e-4):  # clocks of hosts
        alike = with_common_sampling_time([make_record("a"), make_record("b", 0.01 * (1 + apart))])
        assert alike[0].dt_s == alike[1].dt_s == 0.01


def test_slice_and_mirror(tmp_path, flexlink_data):
    """The second half of the DaISy arm is the first with its sign turned, as its description says."""
    path = flexlink_data / "daisy_robot_arm" / "robot_arm.csv"
    tables = [
        {"path": str(path), "stop_sample": 512},
        {"path": str(path), "name": "second", "start_sample": 512, "mirrored": True},
    ]
    source = check(FileSource, {"kind": "files", "dt_s": 0.01, "records": tables}, source="x")
    channels = [check(Channel, {"input": "u_reaction_torque", "output": "y_acceleration"}, source="x")]
    first, second = (read_record(source, entry, channels) for entry in source.records)
    assert isinstance(source.records[0], FileRecord)
    assert first.n_samples == second.n_samples == 512
    # data/README: correlation -0.996 in u and -0.998 in y before the sign is turned.
    assert np.corrcoef(first.input[:, 0], second.input[:, 0])[0, 1] == pytest.approx(0.996, abs=1e-3)
    assert np.corrcoef(first.output[:, 0], second.output[:, 0])[0, 1] == pytest.approx(0.998, abs=1e-3)


def test_a_configuration_resamples_and_unwraps(tmp_path):
    rng = np.random.default_rng(3)
    time = np.cumsum(0.01 * rng.uniform(0.8, 1.2, 400))
    turned = 2000 * np.sin(3 * time) + 3000
    table = {"t_s": time, "u": np.sign(np.sin(9 * time)), "counts": np.round(turned) % 4096}
    np.savez(tmp_path / "log.npz", **table)
    options = {"kind": "files", "time": "t_s", "records": [{"path": str(tmp_path / "log.npz")}]}
    options |= {"resample_s": 0.02, "unwrap": {"counts": 4096}}
    source = check(FileSource, options, source="x")
    channels = [check(Channel, {"input": "u", "output": "counts"}, source="x")]
    record = read_record(source, source.records[0], channels)
    truth = 2000 * np.sin(3 * (time[0] + record.time_s)) + 3000
    # Half a count, and a straight line between readings 12 ms apart: (3 h)^2 / 8 of 2000.
    np.testing.assert_allclose(record.output[:, 0], truth, atol=0.5 + 2000 * (3 * 0.012) ** 2 / 8)


def test_a_plant_is_kept_under_all_that_it_was_made_of():
    """Two configurations that call the same channel differently get plants of their own names."""
    system = control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01)
    part = SimpleNamespace(about="", nominal=SimpleNamespace(to_control=lambda: system), posterior=None)
    channel = SimpleNamespace(members=(part,), level=0.95)
    channel.at_rate = lambda dt_s: channel
    result = UncertaintyResult((channel,))

    def named(label):
        return SimpleNamespace(
            control_channel=SimpleNamespace(label=label),
            control_index=0,
            performance_index=None,
            specification=SimpleNamespace(controller_dt_s=None),
        )

    hub, tip = named("hub"), named("tip")
    assert result.plant(hub).name == "hub"
    assert result.plant(tip).name == "tip"
    assert result.plant(hub) is result.plant(hub)
