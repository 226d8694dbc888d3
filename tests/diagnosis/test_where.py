"""Where the gap lies: places made on purpose are found, noise alone is not, recorded gaps are located."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.fft import dct
from scipy.signal import lfilter
from scipy.stats import binom

from diagnosis import (
    Case,
    EffectParameter,
    Experiment,
    Plant,
    PlantCase,
    PlantEffect,
    PlantExperiment,
    ResidualModel,
)
from diagnosis.where.distortion import periodic_findings
from diagnosis.where.regimes import motions
from diagnosis.where.where import subsystem_mass, where, where_in_records
from diagnosis.where.where_energy import band_gaps, sensor_gaps
from diagnosis.where.where_trends import amplitude_finding, common_findings
from plant import EFFECTS, multisine, multisine_lines, simulate
from plant.effects.joint import CoulombFriction, HardeningSpring, PeriodicDisturbance
from plant.effects.link import LinkStiffness, TipPayload
from plant.effects.sensor import Quantisation, SensorGain
from tests.diagnosis.recorded import recorded_case
from tests.diagnosis.synthetic_residuals import DT, MODEL, NOISE, PERIOD, RIG, inputs, made, white


def _sum(a, b):
    return {name: a[name] + b[name] for name in a}


def _gap(shape):
    """A gap made by shape(name, T) -> (T, 2), on top of white noise of one seed."""
    residuals = white(np.random.default_rng(5))
    return _sum(residuals, {name: shape(name, e.shape[0]) for name, e in residuals.items()})


def test_noise_alone_is_said_to_be_noise():
    residuals = white(np.random.default_rng(2))
    found = where(made(residuals), residuals)
    assert not found.gap.found
    assert not found.is_gap


def test_a_band_is_found_in_the_sensor_it_was_put_in():
    frequency = 5.0

    def tone(name, T):
        signal = 2.0 * np.sqrt(2) * np.sin(2 * np.pi * frequency * DT * np.arange(T) + len(name))
        return np.column_stack([np.zeros(T), signal])

    residuals = _gap(tone)
    found = where(made(residuals), residuals)
    band = max(found.bands, key=lambda b: b.gap.share)
    assert band.sensor == "tip"
    assert band.low_Hz < frequency < band.high_Hz
    # The tone's energy is 4 T in the band it lies in, less what the ends of a record leak out of it.
    assert band.gap.share > 0.95
    assert found.dominant_sensor == "tip"
    run = found.concentration("tip")
    assert (run.low_Hz, run.high_Hz) == (band.low_Hz, band.high_Hz)
    tip = next(s.gap for s in found.sensors if s.sensor == "tip")
    assert tip.interval[0] <= 2.0 <= tip.interval[1]


@pytest.mark.slow
def test_intervals_of_energy_and_share_cover():
    """The gap's energy and its share are known; 95 % intervals hold them in 95 of 100 noises."""
    rng = np.random.default_rng(17)
    time = DT * np.arange(1000)
    gap = np.column_stack([0.4 * np.sin(2 * np.pi * 2 * time), 0.8 * np.sin(2 * np.pi * 15 * time)])
    energy = np.sum(gap**2, axis=0)
    # Whole periods: all of a tone's energy lies in the band that holds it but for the ends of the record.
    spectrum = dct(gap, axis=0, norm="ortho") ** 2
    inside = np.arange(1000) / (2 * 1000 * DT)
    share = spectrum[(inside >= 10) & (inside < 30), 1].sum() / energy.sum()
    seeds, held = 400, np.zeros(2)
    for _ in range(seeds):
        e = {"one": gap + rng.standard_normal(gap.shape)}
        tip = sensor_gaps(e, ("hub_angle", "tip"), 0.01)[1].gap
        band = next(
            b.gap
            for b in band_gaps(e, ("hub_angle", "tip"), DT, 0.01)
            if b.sensor == "tip" and b.low_Hz == 10
        )
        held[0] += tip.interval[0] <= np.sqrt(energy[1] / 1000) <= tip.interval[1]
        held[1] += band.share_interval[0] <= share <= band.share_interval[1]
    # Binomial with 400 draws at 0.95: four standard deviations are 0.044.
    assert np.all(np.abs(held / seeds - 0.95) < 0.044), held / seeds


def test_short_and_quiet_records_are_no_trouble():
    """Forty samples, one of them without input: little can be said, and nothing breaks."""
    rng = np.random.default_rng(1)
    voltages = {"rest": np.zeros(40), "step": np.ones(40), "again": np.ones(40)}
    residuals = {name: rng.standard_normal((40, 2)) for name in voltages}
    experiments = [
        Experiment(
            name,
            "held_out" if name == "again" else "estimation",
            v,
            simulate(RIG, v).output + residuals[name] * NOISE,
        )
        for name, v in voltages.items()
    ]
    found = where(Case("short", RIG, tuple(experiments)), residuals, level=1e-4)
    assert found.periodic == ()
    assert not found.is_gap


def test_a_gap_near_reversals_is_found_there():
    base = white(np.random.default_rng(5))
    near = {name: motion.near_reversal for name, motion in motions(made(base), base).items()}

    def more_noise(name, T):
        # Independent of the white part: its own stream, twice the noise, only near reversals.
        extra = 2.0 * np.random.default_rng(len(name)).standard_normal(T)
        return np.column_stack([extra * near[name], np.zeros(T)])

    residuals = _gap(more_noise)
    case = made(residuals)
    found = where(case, residuals)
    reversal = next(r for r in found.regimes if r.axis == "reversal" and r.sensor == "hub_angle")
    assert reversal.found
    # mean of e^2 is 1 away from reversals and 1 + 4 near them
    away, at = reversal.bins
    for regime, energy in ((away, 1.0), (at, 5.0)):
        assert regime.energy == pytest.approx(energy, rel=5 * np.sqrt(2 / regime.samples))
    assert "near reversals" in [r.peak.label for r in found.telling_regimes]
    assert not any(r.found for r in found.regimes if r.sensor == "tip")


@pytest.mark.slow
def test_a_drift_is_found_with_its_rate():
    rate = 0.5 * 8e-4  # m/s: half a noise deviation per second, 2 to 3.5 at the end of a record

    def drift(name, T):
        return np.column_stack([np.zeros(T), rate / 8e-4 * DT * np.arange(T)])

    residuals = _gap(drift)
    found = where(made(residuals), residuals)
    (tip,) = (d for d in found.drift if d.found)
    assert tip.sensor == "tip"
    # Student with three degrees of freedom: 99.9 % at 12.9 standard errors, 95 % at 3.18.
    half = (tip.interval[1] - tip.interval[0]) / 2
    assert abs(tip.rate - rate) < 12.9 / 3.18 * half
    assert tip.notable
    first = found.dependences[0]
    assert (first.acts, first.place, first.quantity, first.shape) == ("reading", "tip_m", "time", "line")
    # The dependence's slope holds the same rate.
    assert abs(first.slope - rate) < 4 * first.slope_error


@cache
def _of_effect(*effects):
    """Residuals of noisy records of a rig with effects against the nominal rig."""
    rng = np.random.default_rng(8)
    residuals = {
        name: (simulate(RIG, voltage, effects, rng=rng).output - MODEL[name]) / NOISE
        for name, voltage in inputs().items()
    }
    return where(made(residuals), residuals)


def test_a_torque_that_depends_on_the_angle_is_read_off():
    k3 = 0.05
    found = _of_effect(HardeningSpring(cubic_Nm_rad3=k3))
    first = found.dependences[0]
    assert (first.acts, first.place, first.quantity, first.of) == (
        "force",
        "hub",
        "position",
        "hub_angle_rad",
    )
    assert (first.own, first.value_unit, first.judged_on, first.shape) == (True, "N m", "logs", "curve")
    assert 0.75 < first.share <= 1
    # The curve against -k3 theta^3, to a tenth of its largest value.
    theta, torque = np.array(first.centres), np.array(first.values)
    assert np.max(np.abs(torque + k3 * theta**3)) < 0.1 * k3 * np.max(np.abs(theta)) ** 3


def test_a_coarse_tip_sensor_is_found_there_and_at_all_frequencies():
    # Rounding to 8 noise deviations leaves an even error of 8/sqrt(12) = 2.3, like noise where the arm moves.
    found = _of_effect(Quantisation(step_m=8 * RIG.sensors.tip_noise_m))
    hub, tip = (s.gap for s in found.sensors)
    assert not hub.found
    assert tip.gap_rms == pytest.approx(8 / np.sqrt(12), rel=0.1)
    assert found.dominant_sensor == "tip"
    top = next(b.gap for b in found.bands if b.sensor == "tip" and b.high_Hz == 0.5 / DT)
    assert top.found
    # Most of the width of the spectrum lies there, and so does most of an even error.
    assert top.share > 0.5


@pytest.mark.slow
def test_a_wrong_sensor_gain_is_an_error_over_the_tip_position():
    ratio = 1.05
    found = _of_effect(SensorGain(ratio=ratio))
    first = found.dependences[0]
    assert (first.acts, first.place, first.quantity, first.of) == ("reading", "tip_m", "position", "tip_m")
    assert (first.shape, len(found.dependences)) == ("line", 1)
    assert first.share > 0.98
    # The error over the reading ratio x, over the true position x, or over what lies between.
    assert 0.99 * (ratio - 1) / ratio < first.slope < 1.01 * (ratio - 1)
    assert found.dominant_sensor == "tip"
    assert found.linear.share > 0.9


@pytest.mark.slow
def test_a_disturbance_is_the_same_whatever_the_input():
    frequency = 3.1
    found = _of_effect(PeriodicDisturbance(amplitude_Nm=0.01, frequency_Hz=frequency, phase_rad=0.4))
    for finding in found.common:
        assert finding.found
        assert finding.experiments == 4
        assert finding.share == pytest.approx(1.0, abs=0.02)
        # Lines lie one over the record apart; the shortest has 1200 samples.
        assert abs(finding.peak_Hz - frequency) <= 1 / (1200 * DT)
    # A gap that follows the inputs is shared by four experiments as chance has it.
    assert not any(c.found for c in _of_effect(TipPayload(mass_kg=0.02)).common)


def test_experiments_with_the_same_input_do_not_count_as_different():
    rng = np.random.default_rng(6)
    voltage = inputs()["prbs_high"]
    residuals = {f"run{i}": rng.standard_normal((voltage.size, 2)) for i in range(5)}
    experiments = [
        Experiment(name, "held_out" if i else "estimation", voltage * (1 + i), e)
        for i, (name, e) in enumerate(residuals.items())
    ]
    assert common_findings(Case("same", RIG, tuple(experiments)), residuals, 0.01) == ()


def test_linear_and_nonlinear_causes_are_told_apart():
    heavier = _of_effect(TipPayload(mass_kg=0.02))
    assert heavier.linear.share > 0.9
    assert heavier.linear.linear
    friction = _of_effect(CoulombFriction(torque_Nm=0.01))
    assert friction.linear.share < 0.6
    assert friction.amplitude.exponent < 0.5


@pytest.mark.slow
def test_a_periodic_record_shows_the_response_and_the_distortion():
    found = _of_effect(LinkStiffness(ratio=0.9))
    (periodic,) = found.periodic
    assert (periodic.experiment, periodic.period_samples, periodic.periods) == ("multisine", PERIOD, 2)
    assert any(b.found for b in periodic.bands)
    # A linear machine answers at no line that was not excited, and every line below 35 Hz is.
    assert not any(g.found for g in periodic.groups)
    assert not periodic.even_odd_separable


def test_even_and_odd_distortion_come_apart_on_an_odd_multisine():
    rng = np.random.default_rng(4)
    lines = multisine_lines(PERIOD, DT, (0.2, 12.0), "odd_random", rng)
    voltage = multisine(lines, PERIOD, 0.8, rng, periods=3)
    noise = rng.standard_normal((voltage.size, 2))
    even = np.tile(0.5 * np.sqrt(2) * np.cos(2 * np.pi * 20 / PERIOD * np.arange(PERIOD)), 3)
    output = simulate(RIG, voltage).output
    residual = noise + np.column_stack([np.zeros_like(even), even])
    experiments = [
        Experiment(name, role, voltage, output + residual * (1e-3, 8e-4), "multisine")
        for name, role in (("odd", "estimation"), ("again", "held_out"))
    ]
    case = Case("odd", RIG, tuple(experiments))
    finding = periodic_findings(case, {"odd": residual, "again": residual}, 0.01)[0]
    assert finding.even_odd_separable
    found = {(g.sensor, g.group) for g in finding.groups if g.found}
    assert found == {("tip", "not excited, even")}


def test_subsystem_mass_keeps_the_whole_probability():
    names = [*EFFECTS, "none", "unknown"]
    rng = np.random.default_rng(0)
    probabilities = dict(zip(names, rng.dirichlet(np.ones(len(names))), strict=True))
    mass = subsystem_mass(probabilities)
    assert sum(mass.values()) == pytest.approx(1.0)
    assert mass["environment"] == pytest.approx(
        probabilities["periodic_disturbance"] + probabilities["gravity"]
    )
    with pytest.raises(ValueError, match="magnetism: no such effect"):
        subsystem_mass({"magnetism": 1.0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.pop("fresh"), "no residuals of experiment fresh"),
        (lambda r: r.update(fresh=r["fresh"][:, :1]), "residuals of fresh must be finite and"),
        (lambda r: r["fresh"].__setitem__((3, 1), np.nan), "residuals of fresh must be finite"),
    ],
)
def test_residuals_that_do_not_fit_the_case_are_refused(change, message):
    residuals = white(np.random.default_rng(2))
    case = made(residuals)
    change(residuals)
    with pytest.raises(ValueError, match=message):
        where(case, residuals)
    with pytest.raises(ValueError, match="level must lie between 0 and 1"):
        where(case, white(np.random.default_rng(2)), level=1.5)


def _recorded(gap_cases, name):
    case = recorded_case(gap_cases / "labelled" / name)
    return where(case, ResidualModel(case).by_experiment(np.zeros(0), ()))


@pytest.mark.long
def test_recorded_sensor_drift_is_a_drift_of_the_tip_sensor(gap_cases):
    found = _recorded(gap_cases, "sensor_drift")
    (tip,) = (d for d in found.drift if d.found)
    assert tip.sensor == "tip"
    # answer.toml: rate_m_s
    assert tip.interval[0] <= -0.002875 <= tip.interval[1]
    assert found.dominant_sensor == "tip"
    assert tip.notable


def test_recorded_saturation_shows_in_the_one_experiment_that_saturates(gap_cases):
    found = _recorded(gap_cases, "actuator_saturation")
    assert [x.experiment for x in found.experiments if x.gap.found] == ["experiments/03_multisine.csv"]


@pytest.mark.long
def test_recorded_dry_friction_turns_round_with_the_speed(gap_cases):
    found = _recorded(gap_cases, "coulomb_friction")
    first = found.dependences[0]
    assert (first.acts, first.quantity, first.shape) == ("force", "speed", "jump")
    # answer.toml: torque_Nm, against the motion.
    assert first.slope == pytest.approx(-0.01047, rel=0.1)
    assert found.amplitude.growth == "offset"


@pytest.mark.parametrize(
    ("name", "linear"),
    [
        ("backlash", False),
        *(
            pytest.param(name, True, marks=pytest.mark.long)
            for name in ("tip_payload", "input_delay", "link_stiffness")
        ),
    ],
)
def test_recorded_linear_causes_are_called_linear(gap_cases, name, linear):
    found = _recorded(gap_cases, name)
    assert (found.linear.share > 0.9) == linear
    assert (found.linear.share < 0.6) == (not linear)


@pytest.mark.slow
def test_beside_a_model_error_sizes_are_over_what_a_model_may_miss():
    """Three times as much missed as allowed, wherever a record starts and with the hub angle alone."""
    error, case = 0.05, made(white(np.random.default_rng(3)))
    experiments = tuple(
        replace(e, outputs=("hub_angle_rad",), output=e.output[:, :1] + 2.0) for e in case.experiments
    )
    case = replace(case, experiments=experiments, model_error=error)
    (held,) = case.held_out
    size = 3 * error * np.std(held.output) / NOISE[0]
    tone = {
        e.name: np.sqrt(2) * size * np.sin(2 * np.pi * 5 * DT * np.arange(len(e.output))) for e in experiments
    }
    found = where(case, {name: e[:, None] for name, e in tone.items()})
    # Sensor noise is allowed beside it.
    allowed = np.hypot(error * np.std(held.output), NOISE[0]) / NOISE[0]
    assert found.gap.gap_rms == pytest.approx(np.sqrt((size / allowed) ** 2 - 1), rel=0.01)
    assert "deflection" not in {r.axis for r in found.regimes}
    assert found.dominant_sensor is None
    assert not where(case, {name: e[:, None] / 4 for name, e in tone.items()}).is_gap


def _shares_of(found):
    """All shares that a page may show, with the ends of their intervals."""
    gaps = [found.gap, *(s.gap for s in found.sensors), *(b.gap for b in found.bands)]
    gaps += [g for x in found.experiments for g in (x.gap, *x.sensors)]
    shares = [value for g in gaps for value in (g.share, *g.share_interval)]
    shares += [c.share for c in found.common] + [d.share for d in found.drift]
    shares += [d.share for d in found.dependences]
    if found.linear is not None:
        shares += [found.linear.share, *found.linear.interval]
    runs = [found.concentration(), *(found.concentration(s.sensor) for s in found.sensors)]
    return np.array(shares + [run.share for run in runs if run is not None])


def _less_noise_than_stated(name, T):
    """A tip sensor with a tenth of the noise that is stated; the white part of `_gap` has all of it."""
    tip = -0.9 * white(np.random.default_rng(5))[name][:, 1]
    return np.column_stack([0.6 * np.sin(0.3 * np.arange(T)), tip])


def _only_in_one_record(name, T):
    """What a correction of the estimation records makes worse in the held-out one."""
    voltage = inputs()[name]
    sign = -1.0 if name == "fresh" else 1.0
    return np.column_stack([sign * lfilter([0.5], [1, -0.95], voltage), np.zeros(T)])


def _same_everywhere(name, T):
    return np.column_stack([2.0 * np.sin(0.1 * np.arange(T)), 0.01 * np.arange(T)])


@pytest.mark.parametrize(
    ("shape", "model_error"),
    [
        (_less_noise_than_stated, 0.0),
        pytest.param(_only_in_one_record, 0.02, marks=pytest.mark.slow),
        *(
            pytest.param(*one, marks=pytest.mark.long)
            for one in (
                (_less_noise_than_stated, 0.02),
                (_only_in_one_record, 0.0),
                (_same_everywhere, 0.0),
                (_same_everywhere, 0.02),
            )
        ),
    ],
)
def test_shares_lie_between_none_and_all(shape, model_error):
    residuals = _gap(shape)
    shares = _shares_of(where(replace(made(residuals), model_error=model_error), residuals))
    assert np.all((shares >= 0) & (shares <= 1)), shares[(shares < 0) | (shares > 1)]


def test_a_sensor_below_its_noise_takes_nothing_off_the_shares_of_others():
    """Two sensors have gaps of 3 and 1 in energy, a third one none of the noise that is stated."""
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((4000, 3)) * (1.0, 1.0, 0.0)
    tones = np.sqrt(2) * np.sin(np.outer(np.arange(4000), (0.3, 0.3, 0.0))) * np.sqrt((3.0, 1.0, 0.0))
    first, second, third = sensor_gaps({"one": noise + tones}, ("a", "b", "c"), 0.01)
    assert first.gap.share == pytest.approx(0.75, abs=0.03)
    assert second.gap.share == pytest.approx(0.25, abs=0.03)
    assert third.gap.share == 0.0


def test_more_noise_than_stated_is_called_that():
    residuals = {name: e * (1.0, 1.5) for name, e in white(np.random.default_rng(12)).items()}
    found = where(made(residuals), residuals)
    assert found.even("tip")
    assert found.dominant_sensor == "tip"
    tip = found.sensors[1].gap
    # 1.5^2 - 1 beyond the noise
    assert tip.gap_rms == pytest.approx(np.sqrt(1.25), rel=0.1)


@pytest.mark.parametrize(("samples", "said"), [(90, False), (150, False), (400, True)])
def test_of_records_shorter_than_a_second_no_growth_with_the_input_is_said(samples, said):
    """Half-second blocks are resampled: of none, or one, there is no interval."""
    rng = np.random.default_rng(0)

    def record(name, size):
        voltage = size * np.ones(samples)
        return SimpleNamespace(name=name, kind="prbs", closed_loop=False, voltage_V=voltage)

    sampling = SimpleNamespace(dt_s=0.005)
    rig, records = SimpleNamespace(sampling=sampling), (record("low", 1.0), record("high", 3.0))
    case = SimpleNamespace(experiments=records, outputs=("hub_angle_rad",), rig=rig)
    residuals = {name: size * rng.standard_normal((samples, 1)) for name, size in (("low", 3), ("high", 9))}
    found = amplitude_finding(case, residuals, 0.05, rng)
    assert (found is not None) == said
    assert found is None or np.all(np.isfinite(found.interval))


@pytest.mark.parametrize(
    ("added", "said"),
    [
        (lambda y, v, u, t, noise: 2 * (v > 0) * noise, "direction of a: where a "),
        pytest.param(
            lambda y, v, u, t, noise: 3.0 * (np.abs(u) > 0.8),
            "size of input 1: where input 1 has a size of 0.",
            marks=pytest.mark.long,
        ),
        pytest.param(
            lambda y, v, u, t, noise: 3.0 * (y > 0.3), "value of a: where a is 0.", marks=pytest.mark.long
        ),
        pytest.param(
            lambda y, v, u, t, noise: 3.0 * (t > 6),
            "time: 6.7 to 8 s after the start",
            marks=pytest.mark.slow,
        ),
        (lambda y, v, u, t, noise: 0 * y, ""),
    ],
)
def test_of_any_machine_it_is_said_when_it_errs(added, said):
    """One of two outputs, in a direction, for a size of an input, at a place, late, never."""

    def simulate_lag(parameters, effects, inputs):
        return lfilter([0.1], [1.0, -0.9], inputs, axis=0)

    rng, records, left, t = np.random.default_rng(1), [], {}, 0.01 * np.arange(800)
    for name in "nopqrw":
        u = rng.uniform(-1, 1, (100, 2)).repeat(8, axis=0)
        y, e = simulate_lag({}, {}, u), rng.standard_normal((800, 2))
        e[:, 0] += added(y[:, 0], np.gradient(y[:, 0]), u[:, 0], t, rng.standard_normal(800))
        role = "held_out" if name == "w" else "estimation"
        records.append(PlantExperiment(name, role, u, y + 1e-3 * e))
        left[name] = e
    listed = (PlantEffect("gain", (EffectParameter("ratio", 0.1, 1.0),)),)
    plant = Plant(simulate_lag, {}, {}, ("a", "b"), np.full(2, 1e-3), listed, 0.0, 0.01)
    case = PlantCase("lag", plant, tuple(records))
    found = where_in_records(case, left, 0.01).telling_regimes
    assert {one.sensor for one in found} <= {"a"}
    assert any(f"{one.axis}: {one.peak.label}".startswith(said) for one in found) == bool(said)


LEVEL = 0.1
SEEDS = 100


def _alarms(found):
    return {
        "sensors": any(s.gap.found for s in found.sensors),
        "experiments": any(g.found for x in found.experiments for g in (x.gap, *x.sensors)),
        "bands": any(b.gap.found for b in found.bands),
        "regimes": any(r.found for r in found.regimes),
        "drift": any(d.found for d in found.drift),
        "common": any(c.found for c in found.common),
        "dependences": bool(found.dependences),
        "periodic": any(v.found for p in found.periodic for v in (*p.bands, *p.groups)),
    }


# Axes whose tests cover their level; dependences and periodic ask for more than chance and stay below.
REACHED = ("sensors", "experiments", "bands", "regimes", "drift")


@pytest.mark.long
def test_every_axis_keeps_its_level():
    count: dict[str, int] = {}
    for seed in range(SEEDS):
        rng = np.random.default_rng(1000 + seed)
        residuals = white(rng)
        for axis, alarm in _alarms(where(made(residuals), residuals, level=LEVEL, rng=rng)).items():
            count[axis] = count.get(axis, 0) + alarm
    # One in ten thousand for each axis and side; overlapping tests may use up half of their level.
    assert max(count.values()) <= binom.ppf(1 - 1e-4, SEEDS, LEVEL), count
    assert min(count[axis] for axis in REACHED) >= binom.ppf(1e-4, SEEDS, LEVEL / 2), count
