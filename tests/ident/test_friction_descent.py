"""A fit of friction in a loop ends at its optimum, whatever it began with; its parts are what they say."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from benchmarks.closed_loop_machines.logs import machine as drafted
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.friction import refuse_missed_friction
from ident.friction.arm import FrictionLaw, SteppedArm
from ident.friction.behind import behind_drive, with_bias_of_free_runs
from ident.friction.descent import converged, with_each_pole_once
from ident.friction.estimator import fit_friction_in_loop
from ident.friction.gauss_newton import FrictionFit, lag_filter, started
from ident.friction.kernel import behind_motor
from ident.friction.logs import LoopLogs
from ident.friction.loop_start import simplest
from ident.friction.observer import observed
from ident.friction.parameters import FrictionParameters, has_least_damping
from ident.friction.structure_steps import with_dead_time, with_poles, with_stribeck
from ident.friction.structures import Candidate, Search
from ident.friction.time_step import at_step

DT_S = 0.002
OPTIONS = IdentOptions(integrators=1)


def rubbing_arm(delay: int, lag: float, noise: float, level: float = 0.3, steps: int = 20) -> Record:
    """A mass of .01 with viscous and Coulomb friction on a slow PD loop, stepped twenty times a sample by its
    own code: the position, with a little noise, and the command, held and late."""
    rng = np.random.default_rng(5)
    n = 2000
    times = np.arange(n) * DT_S
    phases = rng.uniform(0, 2 * np.pi, 12)
    rates = 2 * np.pi * np.arange(1, 13) * 0.7
    reference = 0.3 * np.cos(np.outer(times, rates) + phases).sum(axis=1)
    command = np.zeros(n)
    position = np.zeros(n)
    place, speed, driven, before = 0.0, 0.0, 0.0, 0.0
    h = DT_S / steps
    for k in range(n):
        position[k] = place + noise * rng.standard_normal()
        error = reference[k] - position[k]
        command[k] = 4.0 * error + 0.12 * (error - before) / DT_S
        before = error
        held = command[k - delay] if k >= delay else 0.0
        for _ in range(steps):
            force = held
            if lag:
                later = held + (driven - held) * np.exp(-1 / (lag * steps))
                force = 0.5 * (driven + later)
                driven = later
            free = speed + h * (force - 0.02 * speed) / 0.01
            speed = np.sign(free) * max(abs(free) - h * level / 0.01, 0.0)
            place += h * speed
    return Record(command[:, None], position[:, None], DT_S, name="log")


@cache
def logs(delay: int = 0, lag: float = 0.0, noise: float = 1e-4) -> LoopLogs:
    return LoopLogs.of([rubbing_arm(delay, lag, noise)])


def begun(decay_per_s: float = 2.0, level: float = 0.3) -> FrictionFit:
    """An arm of the right kind: 1 / (s (.01 s + .02)) near its own decay of 2 / s."""
    poles = Poles(np.array([0.0, np.exp(-decay_per_s * DT_S)]))
    structure = OPTIONS.structure()
    unit = GobfModel(poles, np.array([1.0, 0.0]), DT_S, integrators=1)
    omega = np.array([3.0, 30.0])
    wanted = 1 / (1j * omega * (0.01j * omega + 0.02))
    columns = [replace(unit, coefficients=row).frequency_response(omega) for row in np.eye(2)]
    rows = np.column_stack(columns) / wanted[:, None]
    found = np.linalg.lstsq(np.vstack([rows.real, rows.imag]), np.r_[1, 1, 0, 0], rcond=None)[0]
    model = replace(unit, coefficients=found)
    return with_each_pole_once(started(model, structure, FrictionLaw(level, logs().presliding)))


def test_the_end_does_not_hinge_on_the_start() -> None:
    """From half and from one and a half times the friction, and from another damping: each end is within a
    third of a deviation of the optimum, and all are the true one."""
    ends = [
        converged(begun(decay, level), logs(), OPTIONS)
        for decay, level in ((2.0, 0.3), (1.0, 0.15), (4.0, 0.45))
    ]
    assert all(end.is_converged for end in ends)
    levels = np.array([end.fit.level for end in ends])
    assert np.ptp(levels) < 0.6 * ends[0].level_std
    assert levels[0] == pytest.approx(0.3, abs=4 * ends[0].level_std)
    assert ends[0].level_std < 0.002
    errors = np.array([end.errors for end in ends])
    # By two variances of the noise at most, of two thousand in all.
    assert np.ptp(errors) < 2 * errors[0] / ends[0].n_rows


def test_other_digits_of_the_log_give_the_same_end() -> None:
    """Rounded to a hundredth of its noise, and told in another unit."""
    (record,) = logs().records
    rounded = replace(record, output=np.round(record.output, 7))
    in_degrees = replace(record, output=np.degrees(record.output))
    end = converged(begun(), logs(), OPTIONS)
    again = converged(begun(), LoopLogs.of([rounded]), OPTIONS)
    assert abs(again.fit.level - end.fit.level) < 0.6 * end.level_std
    start = begun()
    model = replace(start.model, coefficients=np.degrees(start.model.coefficients))
    law = replace(start.law, presliding=np.degrees(start.law.presliding))
    start = with_each_pole_once(started(model, OPTIONS.structure(), law))
    other = converged(start, LoopLogs.of([in_degrees]), OPTIONS)
    assert abs(other.fit.level - end.fit.level) < 0.6 * end.level_std


def test_parameters_are_packed_and_put_back() -> None:
    fit = observed(begun(), logs().records)
    fit = replace(fit, lag=0.7, law=replace(fit.law, excess=0.02, fall=0.1))
    parameters = FrictionParameters.of(fit)
    vector = parameters.pack()
    assert len(parameters.names) == vector.size
    same = parameters.unpack(vector).onto(fit)
    assert same.model.coefficients == pytest.approx(fit.model.coefficients, rel=1e-9)
    assert (same.lag, same.law.excess) == pytest.approx((0.7, 0.02))
    for name, value in (("drive_lag_samples", 1.5), ("coulomb_level", 0.4)):
        changed = vector.copy()
        changed[parameters.names.index(name)] = value
        moved = parameters.unpack(changed).onto(fit)
        assert {"drive_lag_samples": moved.lag, "coulomb_level": moved.law.level}[name] == value
        assert moved.model.coefficients == pytest.approx(fit.model.coefficients, rel=1e-9)
    assert parameters.level_at_load is None


def test_a_pole_that_moves_leaves_the_response_where_it_is_anchored() -> None:
    fit = observed(begun(), logs().records)
    parameters = FrictionParameters.of(fit)
    vector = parameters.pack()
    vector[parameters.names.index("log_decays")] += 0.1
    moved = parameters.unpack(vector).onto(fit)
    assert moved.model.poles.real[1] == pytest.approx(np.exp(-2.0 * np.exp(0.1) * DT_S))
    omega = np.geomspace(5.0, 500.0, 20)
    change = moved.model.frequency_response(omega) / fit.model.frequency_response(omega) - 1
    assert np.max(np.abs(change)) < 0.05
    assert np.max(np.abs(moved.model.coefficients / fit.model.coefficients - 1)) > 0.02


@pytest.mark.parametrize(("delay", "lag"), [(1, 1.5), pytest.param(2, 0.0, marks=pytest.mark.long)])
def test_dead_time_and_lag_of_the_drive_are_found(delay: int, lag: float) -> None:
    whole = logs(delay, lag, 2e-5)
    search = Search(whole, OPTIONS, 1, True)
    began = delay + round(lag)
    candidate = Candidate(converged(begun(), search.logs(began), OPTIONS), began)
    found = with_dead_time(search, candidate)
    # Within a sample a lag is taken for its mean: together both are known best.
    assert found.delay_samples + found.fit.lag == pytest.approx(delay + lag, abs=0.2)
    assert (found.fit.lag > 0) == (lag > 0)
    assert found.criterion <= candidate.criterion


def test_no_structure_is_added_that_the_logs_do_not_ask_for() -> None:
    search = Search(logs(), OPTIONS, 1, False)
    candidate = Candidate(converged(begun(), search.logs(0), OPTIONS), 0)
    for step in (with_stribeck, with_poles):
        assert step(search, candidate) is candidate


@pytest.mark.slow
def test_a_needless_pair_is_given_up() -> None:
    search = Search(logs(), OPTIONS, 1, False)
    start = begun()
    poles = Poles(start.model.poles.real, np.array([0.9 * np.exp(0.3j)]))
    coefficients = np.append(start.model.coefficients, [1e-9, 1e-9])
    model = replace(start.model, poles=poles, coefficients=coefficients)
    start = with_each_pole_once(started(model, OPTIONS.structure(), start.law))
    candidate = Candidate(converged(start, search.logs(0), OPTIONS), 0)
    assert with_poles(search, candidate).fit.model.poles.counts == (2, 0)


def test_a_damping_that_may_be_anything_is_varied_within_its_limits() -> None:
    """Of a pair of next to nothing at the largest damping the deviation is many factors of e; that much less
    damping is none at all, and no fit has a pole on the unit circle."""
    from ident.friction.descent import _Point, _Problem

    start = begun()
    pair = np.exp((-0.6 + 0.8j) * 0.3)
    poles = Poles(start.model.poles.real, np.array([pair]))
    model = replace(start.model, poles=poles, coefficients=np.append(start.model.coefficients, [1e-9, 1e-9]))
    start = with_each_pole_once(started(model, OPTIONS.structure(), start.law))
    fit = observed(start, logs().records)
    problem = _Problem.of(fit, logs(), OPTIONS.model_copy(update={"zeta_max": 0.6}))
    point = _Point(fit, problem.parameters.pack(), logs().prediction_errors(fit))
    (place,) = np.flatnonzero(problem.names == "log_dampings")
    changes = problem.first_changes(fit)
    changes[place] = 60.0
    derivatives = problem.secants(point, changes)
    changed = point.vector.copy()
    changed[place] = problem.lowest[place]
    least_damped = problem.parameters.unpack(changed).onto(fit)
    change = changed[place] - point.vector[place]
    wanted = (logs().prediction_errors(least_damped) - point.errors) / change
    assert derivatives[:, place] == pytest.approx(wanted, rel=1e-9)


def test_thinned_logs_take_the_position_later_by_the_dead_time() -> None:
    command = np.arange(20.0)
    record = Record(command[:, None], 100 + command[:, None], DT_S, name="log")
    whole = replace(logs(), records=(record,))
    (thin,) = whole.thinned(4, 3).records
    assert thin.dt_s == 4 * DT_S
    assert thin.input[:, 0].tolist() == [1.5, 5.5, 9.5, 13.5]
    assert thin.output[:, 0].tolist() == [103.0, 107.0, 111.0, 115.0]


def test_an_arm_at_another_step_is_the_same_in_continuous_time() -> None:
    poles = Poles.from_continuous(omega_rad_s=[40.0], zeta=[0.05], decay_per_s=[1.0], dt_s=DT_S)
    poles = Poles(np.append(0.0, poles.real), poles.pairs)
    model = GobfModel(poles, np.array([0.1, 2.0, 0.5, -0.3]), DT_S, integrators=1)
    fit = with_each_pole_once(started(model, Structure(integrators=1), FrictionLaw(0.1)))
    other = at_step(replace(fit, lag=2.0), 4 * DT_S)
    assert other.lag == 0.5
    omega = np.geomspace(1.0, 100.0, 30)
    before = fit.arm.continuous_response(omega) @ fit.coefficients
    after = other.arm.continuous_response(omega) @ other.coefficients
    assert np.max(np.abs(after / before - 1)) < 0.01
    # The sampled model is the continuous one behind a hold, which lags by half a sample and rolls off.
    half = omega * DT_S / 2
    held = before * np.exp(-1j * half) * np.sin(half) / half
    assert np.max(np.abs(held / fit.model.frequency_response(omega) - 1)) < 0.01


def test_the_lag_of_a_drive_is_the_mean_over_each_sample() -> None:
    """Against fine steps of 1 / (1 + lag s) behind a held command."""
    lag, fine = 1.3, 2000
    command = np.random.default_rng(0).standard_normal(50)
    state, means = 0.0, []
    for value in command:
        part = np.exp(-(np.arange(fine) + 0.5) / fine / lag)
        means.append(np.mean(value + (state - value) * part))
        state = value + (state - value) * np.exp(-1 / lag)
    numerator, denominator = lag_filter(lag)
    filtered, x, u = [], 0.0, 0.0
    for value in command:
        x = numerator[0] * value + numerator[1] * u - denominator[1] * x
        u = value
        filtered.append(x)
    assert np.array(filtered) == pytest.approx(np.array(means), abs=1e-5)
    assert lag_filter(0.0)[0].tolist() == [1.0, 0.0]
    fit = replace(observed(begun(), logs().records), lag=lag)
    omega = np.geomspace(1.0, 1000.0, 20)
    wanted = fit.model.frequency_response(omega) * fit.drive_response(omega)
    assert behind_drive(fit).frequency_response(omega) == pytest.approx(wanted, rel=1e-6)


def load_force(motor: RealArray, spring: RealArray, dt_s: float) -> RealArray:
    force = np.empty(motor.size)
    behind_motor(motor, spring, dt_s, force)
    return force


def test_a_load_gives_the_same_force_at_every_rate() -> None:
    """A motor that swings, told at 250 and at 4000 Hz: the force of the load's friction differs by a
    thousandth, and its damper is not late."""
    spring = np.array([35.0, 0.05, 40.0, 0.0, np.inf, 1.0])
    times = np.arange(16000) / 4000
    motor = np.sin(2 * np.pi * 1.1 * times) + 0.3 * np.sin(2 * np.pi * 2.7 * times)
    fine = load_force(motor, spring, 1 / 4000).reshape(-1, 16).mean(axis=1)
    coarse = load_force(motor[::16], spring, 16 / 4000)
    assert np.sqrt(np.mean((coarse - fine)[5:-5] ** 2)) < 4e-3 * np.sqrt(np.mean(fine**2))
    # A load that slips one way all the time: the mean over the samples is what a linear filter makes of it.
    w, zeta = spring[:2]
    a = np.array([[0.0, 1.0], [-(w**2), -2 * zeta * w]])
    block = expm(np.block([[a, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]) * 1e-3)
    ramp = 3.0 * np.arange(2000) * 1e-3
    x = np.zeros(3)
    x[2] = 1.0
    answers = []
    for _ in range(2000):
        x = block @ x
        answers.append(w**2 * x[0] + 2 * zeta * w * x[1])
    force = load_force(ramp, np.array([w, zeta, 1e-3, 0.0, np.inf, 1.0]), 1e-3)
    assert np.mean(force[200:]) == pytest.approx(np.mean(answers[200:]), abs=2e-3)


def test_the_observer_is_the_kalman_filter_of_the_arm() -> None:
    from ident.friction.observer import _real_form, _steady_covariance

    fit = begun()
    a, b, c = _real_form(fit.arm, fit.coefficients)
    size = np.abs(b)
    a, b, c = a * (size / size[:, None]), b / size, c * size
    for ratio in (1.0, 100.0):
        noise = ratio**2 * (np.outer(b, b) + 1e-9 * np.eye(b.size))
        wanted = solve_discrete_are(a.T, c[:, None], noise, np.ones((1, 1)))
        assert _steady_covariance(a, c, noise) == pytest.approx(wanted, rel=1e-6, abs=1e-9 * ratio**2)


def test_one_pole_each_is_the_arm_with_two() -> None:
    poles = Poles(np.array([0.0, 0.99]), np.array([0.97 * np.exp(0.2j)]))
    structure = Structure(integrators=1)
    single = SteppedArm.of(poles, structure, DT_S, doubled=False)
    model = GobfModel(poles, np.array([0.1, 0.4, 0.2, -0.1]), DT_S, integrators=1)
    double = started(model, structure, FrictionLaw(0.2))
    command = np.sign(np.sin(0.05 * np.arange(400)))
    law = FrictionLaw(0.2, 1e-4)
    once = single.run(model.coefficients, command, law)
    twice = double.arm.run(double.coefficients, command, law)
    assert once[0] == pytest.approx(twice[0], abs=1e-4 * np.ptp(twice[0]))
    assert once[1] == pytest.approx(twice[1], abs=0.02)


def test_an_arm_without_a_pole_is_refused():
    """A search behind the friction may find that nothing answers."""
    with pytest.raises(ValueError, match="at least one pole"):
        SteppedArm.of(Poles(), OPTIONS.structure(), DT_S, doubled=False)


def test_rows_of_a_reading_are_those_of_a_moving_shaft() -> None:
    """A sensor of one count a millisecond, read ten times as often; it stands still for a third of it."""
    counts = np.concatenate([np.repeat(np.arange(200), 10), np.full(1000, 200)])
    record = Record(counts[:, None] * 0.01, counts[:, None] * 0.1, 1e-4, name="log")
    assert LoopLogs.of([record]).rows_of_a_reading == 10
    assert logs().rows_of_a_reading == 1


@pytest.mark.slow
def test_friction_is_found_through_a_coarse_sensor() -> None:
    """Of five rows four read as the one before: what is rounded off there is no white noise."""
    (record,) = logs(noise=1e-9).records
    step = 5 * float(np.median(np.abs(np.diff(record.output[:, 0]))))
    coarse = replace(record, output=step * np.round(record.output / step))
    assert LoopLogs.of([coarse]).rows_of_a_reading > 2
    found = fit_friction_in_loop([coarse], OPTIONS)
    assert found.level == pytest.approx(0.3, abs=3 * found.level_std)
    assert found.level_std < 0.1


def test_the_bias_is_the_one_of_free_runs() -> None:
    """An observer follows with a bias as large as the friction nearly as well; a free run does not."""
    (record,) = logs().records
    fit = converged(begun(), logs(), OPTIONS).fit
    biased = replace(fit, bias=fit.bias + fit.level)
    told = with_bias_of_free_runs(biased, [record])
    assert abs(told.bias) < 0.1 * fit.level, told.bias


@pytest.mark.long
def test_a_dead_time_of_five_samples_is_found_from_none() -> None:
    """Poles first take the place of a part of it, so that the next dead time explains less."""
    one = drafted("late", 1, 21)
    got, begin = one.record(0, one.rng(0))
    signals = got["u"][begin:, None], got["y"][begin:, None]
    record = Record(*signals, one.plant.dt_s, name="log")
    stated, _ = simplest(LoopLogs.of([record]), IdentOptions(integrators=1))
    assert stated.input_delay_samples == one.plant.delay == 5


def test_a_pair_without_damping_is_a_line_unless_it_was_stated() -> None:
    zeta = np.array([1e-3, 0.02])
    assert has_least_damping(zeta, IdentOptions()).tolist() == [True, False]
    assert not has_least_damping(zeta, IdentOptions(n_pairs=2)).any()
    assert not has_least_damping(zeta, IdentOptions(zeta_min=1e-3)).any()


def test_an_arm_that_is_thrown_over_grows_as_fast_at_another_step() -> None:
    """Growth of 2 / s and a pole that decays at 5 / s, at a step five times as long and back."""
    image = Poles(np.array([np.exp(-2.0 * DT_S)]))
    structure = IdentOptions(integrators=0).with_unstable(image).structure()
    poles = Poles(np.exp(-np.array([2.0, 5.0]) * DT_S))
    model = GobfModel(poles, np.array([0.1, 0.05]), DT_S, unstable=image)
    fit = with_each_pole_once(started(model, structure, FrictionLaw(0.3, 1e-5)))
    longer = at_step(fit, 5 * DT_S)
    assert longer.model.unstable.real == pytest.approx(np.exp(-2.0 * 5 * DT_S))
    assert longer.arm.structure.unstable.real == pytest.approx(longer.model.unstable.real)
    back = at_step(longer, DT_S)
    omega = np.geomspace(1.0, 50.0, 20)
    ratio = back.model.frequency_response(omega) / fit.model.frequency_response(omega)
    assert np.max(np.abs(ratio - 1)) < 0.02


def test_friction_that_shows_and_is_not_found_acts_elsewhere() -> None:
    fit = begun(level=0.3)
    refuse_missed_friction(fit, 0.9, "y")
    refuse_missed_friction(fit, 0.0, "y")
    with pytest.raises(ValueError, match="does not act where 'y' is measured; response = 'as recorded'"):
        refuse_missed_friction(begun(level=0.003), 0.3, "y")
