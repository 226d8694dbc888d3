"""Coulomb friction identified with the arm, on records of simulators that share no code with it."""

from dataclasses import replace
from functools import cache

import control
import numpy as np
import pytest

from benchmarks.closed_loop_machines.simulator import Law, Plant, response
from benchmarks.without_friction import with_friction
from ident import GobfModel, IdentOptions, Poles, Record, Structure, friction as dry, identify
from ident.basis.posterior import ResponsePosterior
from ident.checks.residual_tests import whiteness_test
from ident.data.arrays import ComplexArray, RealArray, real_rows
from ident.friction.amplitude import damped_poles, more_at_a_strong_line
from ident.friction.arm import FrictionLaw, SteppedArm
from ident.friction.gauss_newton import linearised
from ident.friction.posterior import of_force
from ident.uncertainty.embedding import tangent
from ident.uncertainty.pole_intervals import pole_intervals
from plant import Effect, parse_effect, parse_effects, simulate
from plant.excitation import multisine, multisine_lines
from plant.modal import linear_arm
from plant.presets import paper_link
from plant.simulation import quantised
from validation.blind.truth import Truth
from workflow.config.run_config import built_in_config
from workflow.tasks.simulated_rig import OUTPUT_NAMES, rig_of

RIG = paper_link()
VOLTS_PER_NM = 1 / RIG.motor.torque_per_volt_Nm_V
OPTIONS = IdentOptions(integrators=1, n_real=1, n_pairs=2, omega_min_rad_s=30.0, decay_min_per_s=1.0)
LOW_RAD_S = np.geomspace(0.7, 60.0, 60)


def recorded(torque_Nm: float, seed: int, output: int = 0, *, independent: bool = False) -> list[Record]:
    """Binary voltage and a multisine on the nonlinear arm; hub angle (0) or tip position (1).

    independent: a truth with large rotations, made without any code of ours; its arm is linear to a few parts
    in ten thousand only, more than these ellipses are wide.
    """
    rng = np.random.default_rng(seed)
    effects = [{"name": "coulomb_friction", "torque_Nm": torque_Nm}] if torque_Nm else []
    binary = 6.0 * np.repeat(np.sign(rng.standard_normal(400)), 4)
    phases = rng.uniform(0, 2 * np.pi, 299)
    sines = np.cos(2 * np.pi * np.arange(1, 300) * np.arange(2000)[:, None] / 1000 + phases).sum(axis=1)
    records = []
    for name, voltage in (("binary", binary), ("sines", 7.0 * sines / sines.std())):
        if independent:
            truth = Truth(RIG.model_dump(), effects)
            measured = truth.record(voltage).measured(truth.noise * rng.standard_normal((voltage.size, 2)))
        else:
            measured = simulate(RIG, voltage, [parse_effect(effect) for effect in effects], rng=rng).output
        signals = voltage[:, None], measured[:, [output]]
        records.append(Record(*signals, RIG.sampling.dt_s, name=name, input_names=("voltage_V",)))
    return records


def rubbed(name: str, voltage: RealArray, effect: Effect, rng: np.random.Generator) -> Record:
    """Hub angle of the arm with one effect."""
    y = simulate(RIG, voltage, [effect], rng=rng).output[:, :1]
    return Record(
        voltage[:, None],
        y,
        RIG.sampling.dt_s,
        name=name,
        input_names=("voltage_V",),
        output_names=("hub_angle_rad",),
    )


def true_response(omega_rad_s: RealArray) -> ComplexArray:
    """Held voltage to hub angle and tip (2, F) of the linear arm."""
    sampled = linear_arm(RIG).sample(RIG.sampling.dt_s, method="zoh")
    return np.asarray(sampled(np.exp(1j * omega_rad_s * RIG.sampling.dt_s))[:, 0])


@cache
def rubbing(torque_Nm: float = 0.1) -> tuple[list[Record], dry.FrictionFit]:
    records = recorded(torque_Nm, 5)
    return records, dry.fit_friction(records, OPTIONS)


@pytest.mark.parametrize("torque_Nm", [0.02, pytest.param(0.1, marks=pytest.mark.long)])
def test_level_is_found_with_its_standard_deviation(torque_Nm: float) -> None:
    found = dry.fit_friction(recorded(torque_Nm, 5, independent=True), OPTIONS)
    off = found.level - torque_Nm * VOLTS_PER_NM
    assert found.significant
    assert abs(off) < 0.02 * torque_Nm * VOLTS_PER_NM
    assert abs(off) < 4 * found.level_std
    assert found.level_std < 0.02 * found.level


@pytest.mark.long
def test_a_trace_of_colour_in_long_records_leaves_a_free_run_as_it_is() -> None:
    """Noise of which its past predicts .002: long records tell it from white, as one in some hundred are."""
    records, found = rubbing()
    rng, longer, coloured = np.random.default_rng(4), [], []
    for record in records:
        driven = replace(record, input=np.tile(record.input, (4, 1)), output=np.tile(record.output, (4, 1)))
        noise = found.noise_std * rng.standard_normal(driven.output.shape)
        coloured.append(noise[1:, 0] + 0.045 * noise[:-1, 0])
        noise[1:, 0] = coloured[-1]
        longer.append(replace(driven, output=found.motion(driven)[0][:, None] + noise))
    assert not whiteness_test(coloured).passed
    fit = dry.fit_friction(longer, OPTIONS)
    assert not fit.observed
    assert fit.level == pytest.approx(found.level, rel=0.02)


@pytest.mark.long
def test_a_pair_that_does_not_swing_takes_no_mode_from_the_arm() -> None:
    """Records of the default arm whose start has two overdamped pairs: their fit had a level 2 % too low, a
    Stribeck excess that is not there, and no mode at 33 Hz."""
    source = built_in_config()[0].source
    source = with_friction(source, 0.1, 16384)
    lines = multisine_lines(1000, 0.005, (0.2, 95.0), "odd_random", np.random.default_rng(99))
    rng, records = np.random.default_rng([8, 38]), []
    for k, rms_V in enumerate((2.0, 2.0, 6.0, 6.0)):
        u = multisine(lines, 1000, rms_V, rng, periods=2, draws=20)
        y = simulate(rig_of(source), u, parse_effects(source.effects), rng=rng).output
        y = quantised(y, source.encoder_step_rad)
        records.append(
            Record(
                u[:, None],
                y,
                0.005,
                name=f"record {k}",
                input_names=("voltage_V",),
                output_names=OUTPUT_NAMES,
            )
        )
    options = OPTIONS.model_copy(update={"input_delay_samples": 1})
    found = dry.fit_friction([record.siso("voltage_V", "hub_angle_rad") for record in records], options)
    assert found.level == pytest.approx(0.1 * VOLTS_PER_NM, rel=0.003)
    assert found.law.excess == 0
    # 205.6 in these records.
    np.testing.assert_allclose(found.model.poles.omega_rad_s(RIG.sampling.dt_s), [47.9, 208.4], rtol=0.03)


@pytest.mark.slow
def test_friction_that_falls_with_speed_is_told_from_coulomb_friction() -> None:
    """All four numbers of the law, each inside four of its standard deviations."""
    rng = np.random.default_rng(1)
    wanted = {"static_torque_Nm": 0.15, "coulomb_torque_Nm": 0.05, "stribeck_velocity_rad_s": 0.05}
    effect = parse_effect({"name": "stribeck_friction", **wanted})
    lines = multisine_lines(1000, RIG.sampling.dt_s, (0.2, 60.0), "odd")
    voltages = (multisine(lines, 1000, rms, rng) for rms in (1.5, 3.0, 6.0))
    records = [rubbed(f"{k}", voltage, effect, rng) for k, voltage in enumerate(voltages)]
    found = dry.fit_friction(records, OPTIONS)
    truth = np.array([0.05 * VOLTS_PER_NM, np.log(1e-5), 0.1 * VOLTS_PER_NM, np.log(0.05)])
    law = found.law
    off = np.array([law.level, np.log(law.presliding), law.excess, np.log(law.fall)]) - truth
    std = np.linalg.norm(found.covariance_factor[found.coefficients.size :][:4], axis=1)
    assert np.all(np.abs(off) < 4 * std)
    assert np.all(std < [0.02 * truth[0], 1.0, 0.15 * truth[2], 0.2])


@pytest.mark.parametrize("torque_Nm", [0.02, pytest.param(0.1, marks=pytest.mark.long)])
def test_ellipses_hold_the_arm_behind_its_friction(torque_Nm: float) -> None:
    """As recorded, hardly any ellipse of these records does."""
    records, found = rubbing(torque_Nm)
    truth, _ = true_response(LOW_RAD_S)
    ellipses = dry.without_friction(records, found).response.at(LOW_RAD_S)
    as_recorded = tangent(records, identify(records, OPTIONS).model).at(LOW_RAD_S)
    assert np.mean(ellipses.contains(truth)) > 0.8
    assert np.mean(as_recorded.contains(truth)) < 0.5
    error = [np.median(np.abs(found_.centre - truth) / np.abs(truth)) for found_ in (ellipses, as_recorded)]
    assert error[0] < 0.003 if torque_Nm < 0.1 else error[0] < 0.008
    assert error[0] < 0.1 * error[1]


def test_friction_of_the_shaft_is_taken_off_the_tip_too() -> None:
    found, tip = rubbing(0.02)[1], recorded(0.02, 5, output=1)
    model = identify([found.taken_off(record) for record in tip], OPTIONS).model
    _, truth = true_response(LOW_RAD_S)
    ellipses = dry.other_output_without_friction(tip, found, model).response.at(LOW_RAD_S)
    assert np.mean(ellipses.contains(truth)) > 0.7
    # What is not known of the friction widens the ellipses.
    known = tangent([found.taken_off(record) for record in tip], model).at(LOW_RAD_S)
    assert np.median(known.enclosing_radius()[:20]) < 0.8 * np.median(ellipses.enclosing_radius()[:20])


def test_where_friction_acts_as_none_the_ellipses_at_an_amplitude_are_those_without_friction() -> None:
    """A limit, for the tip, whose model has a pair of its own beside those of the shaft's."""
    found, tip = rubbing()[1], recorded(0.1, 5, output=1)
    three = OPTIONS.model_copy(update={"n_pairs": 3})
    model = identify([found.taken_off(record) for record in tip], three).model
    behind = dry.other_output_without_friction(tip, found, model)
    none, lines = np.zeros(5), np.array([1.0, 300.0])
    equivalent = dry.EquivalentFriction(found, 1.0, lines, np.zeros(2), none, none, np.zeros((5, 5)))
    omega = np.geomspace(1.0, 500.0, 100)
    posterior, _ = dry.at_amplitude(behind, equivalent, np.random.default_rng(1))
    ratio = posterior.at(omega).enclosing_radius() / behind.response.at(omega).enclosing_radius()
    # 400 draws leave 1 / sqrt(800) of a standard deviation open.
    assert np.all(np.abs(ratio - 1) < 4 / np.sqrt(800))


def test_no_friction_is_not_significant() -> None:
    found = dry.fit_friction(recorded(0.0, 5), OPTIONS)
    assert not found.significant
    assert found.level < 4 * found.level_std < 0.01 * 6.0


def arm_of(delay: int, integrators: int) -> tuple[SteppedArm, GobfModel, RealArray]:
    poles = Poles(np.array([0.96]), np.array([0.944 + 0.229j]))
    structure = Structure(integrators=integrators, input_delay_samples=delay)
    arm = SteppedArm.of(poles, structure, 0.005)
    rng = np.random.default_rng(3)
    doubled = GobfModel(
        poles.doubled(), rng.normal(size=6), 0.005, integrators=integrators, input_delay_samples=delay
    )
    return arm, doubled, rng.normal(size=400)


@pytest.mark.parametrize(("delay", "integrators"), [(0, 1), (2, 1), (1, 0)])
def test_stepped_between_the_samples_without_friction_is_the_discrete_model(
    delay: int, integrators: int
) -> None:
    arm, model, u = arm_of(delay, integrators)
    position, friction = arm.run(model.coefficients, u, FrictionLaw(0.0))
    exact = model.simulate(u)
    assert np.max(np.abs(position - exact)) < 1e-8 * np.max(np.abs(exact))
    assert np.all(friction == 0)


def test_held_friction_moves_the_arm_as_far_as_the_one_that_turns_within_a_sample() -> None:
    """To four millionths of a motion of 1 rad."""
    records, found = rubbing()
    arm = GobfModel(found.arm.poles.doubled(), found.coefficients, records[0].dt_s, integrators=1)
    for record in records:
        position, friction = found.motion(record)
        assert np.std(arm.simulate(record.input[:, 0] - friction) - position) < 4e-6


def test_derivatives_are_those_of_the_simulation() -> None:
    """Against the simulation with another coefficient, and with another level."""
    u = np.repeat(np.sign(np.random.default_rng(1).standard_normal(150)), 4) * 5.0
    record = recorded(0.02, 1)[0]
    found = dry.fit_friction([record], OPTIONS)
    _, _, by, _ = linearised(found.arm, found.coefficients, found.law, u)
    for j in (0, 3):
        step = np.zeros(found.coefficients.size)
        step[j] = 1e-4 * np.abs(found.coefficients).max()
        ends = [found.arm.run(found.coefficients + sign * step, u, found.law)[0] for sign in (1, -1)]
        direct = (ends[0] - ends[1]) / (2 * step[j])
        assert np.linalg.norm(by[:, j] - direct) < 0.01 * np.linalg.norm(direct)
    laws = [replace(found.law, level=found.level * f) for f in (1.01, 0.99)]
    ends = [found.arm.run(found.coefficients, u, law)[0] for law in laws]
    direct = (ends[0] - ends[1]) / (0.02 * found.level)
    assert np.linalg.norm(by[:, found.coefficients.size] - direct) < 0.02 * np.linalg.norm(direct)


def test_more_viscous_friction_moves_the_poles_where_the_equations_of_motion_say() -> None:
    """The arm's own matrices with another hub against the identified model's with damping added."""
    added_Nms = 0.3
    volts = added_Nms / RIG.motor.torque_per_volt_Nm_V
    hub = RIG.hub.model_copy(update={"viscous_friction_Nms": RIG.hub.viscous_friction_Nms + added_Nms})
    arms = [linear_arm(rig, n_modes=2) for rig in (RIG, RIG.model_copy(update={"hub": hub}))]
    before, after = (np.sort_complex(np.exp(np.linalg.eigvals(arm.A) * RIG.sampling.dt_s)) for arm in arms)
    moving = before[np.abs(before - 1) > 1e-9]
    # The sampled position has one term more than an integrator and these poles.
    poles = Poles(np.append(2e-3, moving[moving.imag == 0].real), moving[moving.imag > 0])
    u = np.random.default_rng(2).standard_normal(600)
    y = simulate(RIG, u, n_modes=2).output[:, 0]
    columns = np.column_stack(
        [
            GobfModel(poles, one, RIG.sampling.dt_s, integrators=1).simulate(u)
            for one in np.eye(poles.real.size + 2 * poles.pairs.size)
        ]
    )
    exact = GobfModel(poles, np.linalg.lstsq(columns, y)[0], RIG.sampling.dt_s, integrators=1)
    assert np.max(np.abs(exact.simulate(u) - y)) < 1e-4 * np.max(np.abs(y))
    moved = damped_poles(exact, volts)
    there = np.sort_complex(np.concatenate([moved.real[1:], moved.pairs, moved.pairs.conj()]))
    np.testing.assert_allclose(there, after[np.abs(after - 1) > 1e-9], rtol=1e-4)
    assert np.max(np.abs(there - np.sort_complex(moving))) > 1e-3


@pytest.mark.long
def test_friction_is_viscous_on_average_at_an_amplitude_that_was_not_recorded() -> None:
    """Ellipses at the rms of all records hold the mean of many fresh experiments there; half were made at 2 V
    and half at 6 V."""
    period, dt_s, torque_Nm = 500, RIG.sampling.dt_s, 0.05
    lines = multisine_lines(period, dt_s, (0.5, 45.0), "odd")
    omega = 2 * np.pi * lines / (period * dt_s)
    friction, records = [parse_effect({"name": "coulomb_friction", "torque_Nm": torque_Nm})], []
    for k, rms in enumerate((2.0, 2.0, 6.0, 6.0)):
        rng = np.random.default_rng(k)
        records.append(rubbed(str(k), multisine(lines, period, rms, rng, periods=2), friction[0], rng))
    found = dry.fit_friction(records, OPTIONS)
    rng = np.random.default_rng(9)
    equivalent = dry.equivalent_friction(found, records, rng)
    posterior, _ = dry.at_amplitude(dry.without_friction(records, found), equivalent, rng)

    ratios = []
    for _ in range(300):
        u = multisine(lines, period, equivalent.rms, rng, periods=2)
        moved = np.diff(simulate(RIG, u, friction).output[:, 0])[-period:]
        ratios.append(np.fft.rfft(moved)[lines] / np.fft.rfft(u[-period:])[lines])
    truth = np.mean(ratios, axis=0) / (1 - np.exp(-1j * omega * dt_s))
    ellipses = posterior.at(omega)
    assert np.mean(ellipses.contains(truth)) > 0.8
    # That of the arm without friction is another one, by more than they are wide.
    linear = true_response(omega)[0]
    low = omega < 10
    assert np.all((ellipses.enclosing_radius() < 0.5 * np.abs(truth - linear))[low])
    assert not np.any(ellipses.contains(linear)[low])
    assert equivalent.rms == pytest.approx(np.sqrt(20.0), rel=0.01)


@pytest.mark.parametrize("asked", [0.3, 0.7])
def test_a_line_that_makes_much_of_the_motion_meets_more_friction(asked: float) -> None:
    """Measured on the simulated arm, where no equivalent friction is known to any code: N from voltage over
    angle with friction, less that of the linear arm."""
    period, dt_s, count = 1000, RIG.sampling.dt_s, 48
    lines, rng = multisine_lines(period, dt_s, (0.2, 60.0), "odd"), np.random.default_rng(0)
    omega = 2 * np.pi * lines / (period * dt_s)
    linear = true_response(omega)[0]
    strong = int(np.argmin(np.abs(omega - 8.8)))
    size, speed = np.ones(lines.size), np.abs(omega * linear)
    size[strong] = np.sqrt(asked / (1 - asked) * (np.sum(speed**2) - speed[strong] ** 2)) / speed[strong]
    ratios = np.empty((count, lines.size), dtype=np.complex128)
    friction = [parse_effect({"name": "coulomb_friction", "torque_Nm": 0.02})]
    for ratio in ratios:
        spectrum = np.zeros(period // 2 + 1, dtype=np.complex128)
        spectrum[lines] = size * np.exp(2j * np.pi * rng.random(lines.size))
        u = np.tile(np.fft.irfft(spectrum, period), 2)
        u *= 5.0 / np.std(u)
        moved = np.diff(simulate(RIG, u, friction).output[:, 0])[-period:]
        ratio[:] = np.fft.rfft(moved)[lines] / np.fft.rfft(u[-period:])[lines]
    ratios /= 1 - np.exp(-1j * omega * dt_s)
    mean = ratios.mean(axis=0)
    met = ((1 / mean - 1 / linear) / (1j * omega)).real
    error = ratios.std(axis=0) / (np.abs(mean) ** 2 * omega * np.sqrt(count))
    power = np.abs(omega * mean * size) ** 2
    around = [k for k in range(strong - 5, strong + 6) if k != strong]
    others = np.average(met[around], weights=error[around] ** -2)
    excess = met[strong] / others - 1
    deviation = np.hypot(error[strong], np.sum(error[around] ** -2) ** -0.5) / others
    predicted = more_at_a_strong_line(power / power.sum())[strong]
    assert deviation < 0.06
    assert abs(excess - predicted) < 3 * deviation
    assert more_at_a_strong_line(np.array([1e-3, 1.0])) == pytest.approx([0.25e-3, 1.0], rel=2e-3)


def test_a_strong_line_meets_more_friction_in_the_response_too() -> None:
    """N at the lines as simulated: one line with most of the motion among weak ones."""
    records, found = rubbing()
    period, rng = 1000, np.random.default_rng(0)
    spectrum = np.zeros(period // 2 + 1, dtype=np.complex128)
    lines = np.arange(1, 80, 2)
    spectrum[lines] = np.where(lines == 7, 12.0, 1.0) * np.exp(2j * np.pi * rng.random(lines.size))
    u = np.fft.irfft(spectrum, period)
    u *= np.std(records[0].input) / np.std(u)
    record = replace(records[0], input=np.tile(u, 2)[:, None], output=np.tile(u, 2)[:, None])
    equivalent = dry.equivalent_friction(found, [record], rng)
    at = 2 * np.pi * lines / (period * record.dt_s)
    values = equivalent.drawn(np.zeros(200), at, rng).mean(axis=0).real
    strong = int(np.flatnonzero(lines == 7)[0])
    # It has some 95 % of the motion: 8 to 9 tenths more, and its neighbours' quarters of their small shares.
    assert 1.7 < values[strong] / np.mean(values[[strong - 1, strong + 1]]) < 1.95


@pytest.mark.long
def test_what_no_poles_follow_of_strong_lines_is_small_beside_the_ellipses() -> None:
    """N that falls with frequency and has no phase: the formula of the best linear approximation itself, on
    the centre of the arm. Of several records: what modes may be missed is drawn and differs with rounding."""
    omega, n = np.geomspace(1.0, 100.0, 80), 0.04
    stronger = 0.03 / (1 + (omega / 10) ** 2)
    mean = np.array([n, 0.0, 0.0, 0.0, 0.0])
    largest = []
    for seed in (2, 3, 4):
        records = recorded(0.1, seed)
        found = dry.fit_friction(records, OPTIONS)
        behind = dry.without_friction(records, found)
        equivalent = dry.EquivalentFriction(found, 1.0, omega, stronger, mean, np.zeros(5), np.zeros((5, 5)))
        posterior, _ = dry.at_amplitude(behind, equivalent, np.random.default_rng(1))
        met = n * (1 + stronger) * 1j * omega * behind.shaft.centre(omega)
        off = np.abs(posterior.centre(omega) - behind.response.centre(omega) / (1 + met))
        largest.append(np.max(off / posterior.at(omega).enclosing_radius()))
    # 0.14; errors weighed half relative to the response itself leave 0.19.
    assert np.median(largest) < 1 / 6


def test_modes_narrower_than_the_grid_stay_what_they_are() -> None:
    """G / (1 + j omega N G_shaft) also at and between the modes that may have been missed: several lightly
    damped pairs side by side, for one."""
    records, found = rubbing()
    behind = dry.without_friction(records, found)
    linear, dt_s, rng = behind.response, found.model.dt_s, np.random.default_rng(3)
    z = np.exp((-0.01 + 1j) * np.geomspace(32.0, 37.0, 12) * dt_s)
    at, count = linear.poles.order, 2 * z.size
    # The all-pass of the missed modes comes last, so that the others are the same.
    linear = replace(
        linear,
        poles=Poles(linear.poles.real, np.append(linear.poles.pairs, z)),
        mean=np.insert(linear.mean, at, np.zeros(count)),
        covariance_factor=np.insert(
            linear.covariance_factor, [at], 2e-8 * rng.standard_normal((count, behind.level_factor.size)), 0
        ),
    )
    n, lines, none = 0.03, np.array([1.0, 300.0]), np.zeros(5)
    mean = np.array([n, 0.0, 0.0, 0.0, 0.0])
    equivalent = dry.EquivalentFriction(found, 2.0, lines, np.zeros(2), mean, none, np.zeros((5, 5)))
    posterior, _ = dry.at_amplitude(replace(behind, response=linear), equivalent, rng)
    omega = np.linspace(20.0, 60.0, 4000)
    speed = 1j * omega * behind.shaft.centre(omega)
    expected = linear.centre(omega) / (1 + n * speed)
    # 400 draws leave a twentieth of a standard deviation of the mean open.
    off = np.abs(posterior.centre(omega) - expected) / linear.at(omega).enclosing_radius()
    assert np.max(off) < 0.25


def test_a_stuck_shaft_and_an_output_that_is_no_position_are_refused() -> None:
    record = recorded(0.0, 1)[0]
    with pytest.raises(ValueError, match="binary"):
        dry.fit_friction([replace(record, output=np.zeros_like(record.output))], OPTIONS)
    with pytest.raises(ValueError, match="integrator"):
        dry.fit_friction([record], OPTIONS.model_copy(update={"integrators": 2}))


@pytest.mark.slow
def test_a_shaft_that_the_records_do_not_show_is_refused() -> None:
    records, found = rubbing()
    dry.refuse_unseen_shaft(found, records)
    steps = np.ptp(records[0].output) / 8
    coarse = [replace(record, output=steps * np.round(record.output / steps)) for record in records]
    with pytest.raises(ValueError, match=r"'y'\D+9 .*response = 'as recorded'"):
        dry.refuse_unseen_shaft(found, coarse)
    one = records[0]
    stuck = [replace(one, input=one.input / 1000, output=one.output - found.motion(one)[0][:, None])]
    with pytest.raises(ValueError, match=r"'y' \(rms .*noise"):
        dry.refuse_unseen_shaft(dry.fit_friction(stuck, OPTIONS), stuck)
    tip = [recorded(0.1, 5, output=1)[0].slice(0, 400)]
    with pytest.raises(ValueError, match=r"'y'.* degrees"):
        dry.refuse_unseen_shaft(dry.fit_friction(tip, OPTIONS), tip)


@pytest.mark.slow
def test_an_observer_follows_what_a_free_run_does_not_explain():
    """Friction at motor and load in open loop: a free run with the motor's takes it for another arm."""
    friction, spring = np.zeros((2, 5)), np.array([[0, 1, 6.5, 4.8e-4, 0]])
    friction[:, :3] = [[2.9e-3, 2.9e-3, 1.0], [1.3e-3, 1.3e-3, 1.0]]
    inertia, viscous, none = np.array([7.8e-5, 7.1e-5]), np.array([2.5e-4, 0]), np.zeros(3)
    plant = Plant(inertia, viscous, none[:2], spring, friction, none, 0.02, 0, 1.0, 1e-3, 0, 1e-5, np.inf)
    through = Law(np.zeros((1, 1)), np.zeros((1, 2)), none[:1], np.array([1.0, 0.0]), none[:1])
    phases, turn = np.random.default_rng(1).uniform(0, 2 * np.pi, 99), 2 * np.pi * np.arange(1000) / 1000
    volts = 0.424 * np.cos(np.outer(turn, np.arange(1, 100)) + phases).sum(axis=1)
    angle = plant.run(through, volts, 0.0, np.zeros(volts.size))["y"]
    record = Record(
        volts[:, None],
        angle[:, None],
        1e-3,
        name="log",
        input_names=("motor_V",),
        output_names=("angle_rad",),
    )
    found = dry.fit_friction([record], IdentOptions(integrators=1))
    assert found.observed
    assert found.law.level == pytest.approx(2.9e-3 / 0.02, rel=0.05)
    assert found.beyond == pytest.approx(1.3e-3 / 0.02, rel=0.05)
    assert found.spring is not None
    assert found.spring.compliance == pytest.approx(0.02 / 6.5, rel=0.05)
    omega, behind = np.geomspace(2 * np.pi, 200 * np.pi, 100), dry.without_friction([record], found)
    truth = response(*plant.sampled(), omega, 1e-3)
    assert np.mean(behind.response.at(omega, 0.95).contains(truth)) >= 0.93
    assert np.all(pole_intervals(behind.shaft, behind.poles).omega_rad_s < 1e3)


@pytest.mark.parametrize(("wide", "share"), [(0.3, 0.95), (1.0, 0.7)])
def test_ellipses_hold_the_force_that_the_data_leave_open(wide: float, share: float) -> None:
    """1 / (s^2 + c s), c above 0 and known to a third of itself, or to itself; c lies on an arc."""
    dt_s, omega, size = 0.01, np.geomspace(0.05, 50.0, 100), 2 + 20
    damped = 1 + wide * np.random.default_rng(3).standard_normal(600)

    def arm(c: float) -> ComplexArray:
        return np.asarray(control.tf([1], [1, c, 0]).sample(dt_s)(np.exp(1j * omega * dt_s)))

    poles, middle = Poles(np.array([np.exp(-dt_s)])), arm(1.0)
    nothing = ResponsePosterior(poles.doubled(), np.zeros(size), np.zeros((size, 1)), dt_s, 20, integrators=1)
    rows = nothing.frequency_rows(omega) / middle[:, None]
    change = -wide * 1j * omega * middle
    wanted = real_rows(np.column_stack([0 * omega + 1, change]))
    mean, column = np.linalg.lstsq(real_rows(rows), wanted)[0].T
    straight = replace(nothing, mean=mean, covariance_factor=np.column_stack([column, 1e-6 * np.eye(size)]))
    ellipses = of_force(straight, poles, 100.0)[0].at(omega, 0.95)
    inside = [ellipses.contains(arm(c)) for c in damped[damped > 0.25]]
    assert np.mean(inside, axis=0).min() > share
    assert np.mean(inside) > 0.95
    assert np.mean(straight.at(omega, 0.95).contains(arm(1 + 1.9 * wide))) < 0.5
