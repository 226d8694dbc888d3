"""Friction and arm from logs of a loop, made by machines that share no code with the product."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.closed_loop_machines.logs import Machine, machine as drafted
from benchmarks.closed_loop_machines.simulator import Law, response
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import NO_POLES, Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.validation import fit_in_windows, fit_on_fresh_data
from ident.data.arrays import RealArray, real_rows
from ident.data.record import Record
from ident.friction import FrictionFit, fit_friction, identify_behind, without_friction
from ident.friction.arm import FrictionLaw
from ident.friction.command_causes import recorded_in_loop, with_commands_in_time
from ident.friction.gauss_newton import LostError, least_squares
from ident.friction.inverse_dynamics import direction_of, level_of, smoothed
from ident.friction.posterior import of_force
from ident.friction.spring import Spring
from ident.identification import Identification


@cache
def machine(kind: str, seed: int) -> Machine:
    """A machine with the controller that was drafted for it: drafting takes half a second."""
    return drafted(kind, seed)


@cache
def played(kind: str, seed: int, log: int) -> tuple[dict[str, RealArray], int]:
    """Signals of one run of a machine, and the sample at which its log begins."""
    one = machine(kind, seed)
    return one.record(log, one.rng(log))


def logged(one: Machine, log: int, *, reference: bool = True) -> Record:
    got, begin = played(one.kind, one.seed, log)
    signals = got["u"][begin:, None], got["y"][begin:, None]
    kept = {"reference": got["r"][begin:, None], "reference_names": ("r",)} if reference else {}
    return Record(*signals, one.plant.dt_s, name=f"log {log}", **kept)


def levels_of(one: Machine) -> float:
    """Coulomb friction in units of the input."""
    return float(one.plant.friction[:, 0].sum() / one.plant.torque_per_u)


def modes_of(one: Machine) -> list[complex]:
    poles = one.plant.linear(one.draft.q_operating)[3]
    return sorted(poles[poles.imag > 1e-6], key=abs)


@pytest.fixture(scope="module")
def belt() -> tuple[Machine, list[Record], FrictionFit]:
    """The kind of log that was reported: a belt under its PD controller."""
    one = machine("belt", 0)
    log = logged(one, 0)
    records = [log.slice(0, round(0.12 * log.n_samples))]
    return one, records, fit_friction(records, IdentOptions(integrators=1))


@pytest.fixture(scope="module")
def arm_of_the_belt(belt) -> Identification:
    """Behind the friction that was found in its logs."""
    _, records, found = belt
    return identify_behind(
        found, [found.taken_off(record) for record in records], IdentOptions(integrators=1)
    )


@pytest.mark.slow
def test_level_and_dead_time_of_a_belt_are_found(belt) -> None:
    one, _, found = belt
    assert found.observed
    assert found.significant
    assert found.level == pytest.approx(levels_of(one), rel=0.02)
    assert abs(found.level - levels_of(one)) < 4 * found.level_std
    assert found.arm.structure.input_delay_samples == one.plant.delay
    assert found.law.excess == 0
    assert found.beyond == 0


def every(record: Record, rows: int) -> Record:
    """A log that was written every so many rows: the commands between them are lost."""
    assert record.reference is not None
    return replace(
        record,
        input=record.input[::rows],
        output=record.output[::rows],
        reference=record.reference[::rows],
        dt_s=rows * record.dt_s,
    )


@pytest.mark.parametrize(
    ("at_motor", "delay", "rows"),
    [
        pytest.param(0.8, 1, 3, marks=pytest.mark.slow),
        pytest.param(1.0, 1, 2, marks=pytest.mark.long),
        pytest.param(1.0, 0, 2, marks=pytest.mark.long),
        pytest.param(1.0, 1, 3, marks=pytest.mark.long),
        pytest.param(0.8, 1, 2, marks=pytest.mark.long),
        pytest.param(0.8, 0, 2, marks=pytest.mark.long),
    ],
)
def test_friction_is_in_its_interval_in_a_log_of_every_few_rows(
    at_motor: float, delay: int, rows: int
) -> None:
    """The controller goes on between two rows: its mean command is up to half a step late."""
    one = machine("belt", 0)
    level = float(one.plant.friction[0, 0])
    friction = one.plant.friction.copy()
    friction[:2, 0] = level * np.array([at_motor, 1 - at_motor])
    friction[:2, 1] = friction[:2, 0]
    slower = replace(one, plant=replace(one.plant, friction=friction, delay=delay))
    records = []
    for log in range(2):
        got, begin = slower.record(log, slower.rng(log))
        rows_kept = slice(begin, begin + 6000)
        signals = [got[name][rows_kept, None] for name in "uyr"]
        whole = Record(*signals[:2], one.plant.dt_s, name=f"log {log}", reference=signals[2])
        records.append(every(whole, rows))
    found = fit_friction(records, IdentOptions(integrators=1))
    assert abs(found.level - levels_of(slower)) < 2 * found.level_std
    assert found.level_std < 0.05 * levels_of(slower)
    assert found.beyond / found.level == pytest.approx(1 - at_motor, abs=0.03)


@pytest.mark.slow
def test_ellipses_and_mode_of_a_belt_are_those_without_friction(belt, arm_of_the_belt) -> None:
    one, records, found = belt
    about = arm_of_the_belt
    mode, omega = modes_of(one)[0], np.geomspace(1.0, 200.0, 80)
    k = int(np.argmin(np.abs(about.model.poles.omega_rad_s(one.plant.dt_s) - abs(mode))))
    assert about.model.poles.omega_rad_s(one.plant.dt_s)[k] == pytest.approx(abs(mode), rel=1e-3)
    assert about.model.poles.zeta()[k] == pytest.approx(-mode.real / abs(mode), rel=0.02)
    assert np.all(about.fit_percent > 95)
    true = response(*one.plant.sampled(0.0), omega, one.plant.dt_s)
    ellipses = without_friction(records, found, about.model).response.at(omega)
    assert np.mean(ellipses.contains(true)) > 0.9
    assert np.median(np.abs(ellipses.centre / true - 1)) < 0.005
    # Viscous friction a fourth of what it is: the level, which is not known either, brings it back.
    poles = about.model.poles
    slow = Poles(poles.real ** np.where(poles.real > 0.9, 0.25, 1.0), poles.pairs)
    behind = without_friction(records, found, replace(about.model, poles=slow))
    assert np.mean(behind.response.at(omega).contains(true)) > 0.9
    assert behind.poles.real.max() == pytest.approx(poles.real.max(), abs=0.2 * (1 - poles.real.max()))


@pytest.mark.slow
@pytest.mark.parametrize("times", [pytest.param(12, marks=pytest.mark.long), 40])
def test_a_hardly_known_rate_is_raised_to_where_a_tangent_follows(belt, arm_of_the_belt, times: int) -> None:
    """.4 s of a log tell a rate of .57 / s to a factor of some ten, so that a tenth of it lies within its
    interval; but a tangent there has a mean that no arm has."""
    one, records, found = belt
    about = arm_of_the_belt
    poles = about.model.poles
    slow = Poles(poles.real ** np.where(poles.real > 0.9, 1 / times, 1.0), poles.pairs)
    short = [record.slice(0, record.n_samples // 5) for record in records]
    behind = without_friction(short, found, replace(about.model, poles=slow))
    assert np.log(behind.poles.real.max()) / np.log(poles.real.max()) == pytest.approx(1, abs=0.6)
    omega = np.geomspace(0.3, 200.0, 80)
    true = response(*one.plant.sampled(0.0), omega, one.plant.dt_s)
    holds = [part.response.at(omega).contains(true) for part in behind.members or [behind]]
    assert np.mean(np.any(holds, axis=0)) > 0.9


@pytest.mark.slow
def test_ellipses_hold_a_part_of_the_friction_that_looks_like_damping(belt) -> None:
    """5 % of the friction, one standard deviation: no residual shows it where it moves with the speed."""
    one, records, found = belt
    omega, dt_s = np.geomspace(2.0, 20.0, 30), one.plant.dt_s
    arm = response(*one.plant.sampled(0.0), omega, dt_s)
    ellipses = without_friction(records, found).response.at(omega)
    speed = np.concatenate([np.gradient(smoothed(record.output[:, 0]), dt_s) for record in records])
    damping = 0.05 * levels_of(one) / np.sqrt(np.mean(speed**2))
    for sign in (-1.0, 1.0):
        damped, far = (arm / (1 + sign * n * damping * 1j * omega * arm) for n in (1.0, 4.0))
        assert np.all(ellipses.contains(damped))
        assert not np.any(ellipses.contains(far))


@pytest.mark.parametrize(
    "kind", ["belt", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("fast", "pendulum"))]
)
def test_a_loop_is_told_by_its_reference_or_by_its_command(kind: str) -> None:
    one = machine(kind, 1)
    assert recorded_in_loop([logged(one, 0)])
    assert recorded_in_loop([logged(one, 0, reference=False)])


def test_one_log_that_shows_the_loop_is_enough() -> None:
    """The logs of one experiment come from one loop, however little the others show."""
    one = machine("belt", 1)
    told, still = logged(one, 0, reference=False), logged(one, 1, reference=False)
    rng = np.random.default_rng(0)
    unseen = replace(still, input=rng.standard_normal(still.input.shape))
    assert not recorded_in_loop([unseen])
    assert recorded_in_loop([unseen, told])


@pytest.mark.long
def test_friction_at_the_load_of_a_wheel_is_found_with_its_share() -> None:
    """Four fifths of the friction are at the load, which stands while the spring pulls less."""
    one = machine("wheel", 2)
    motor, load = one.plant.friction[:2, 0] / one.plant.torque_per_u
    found = fit_friction([logged(one, 0)], IdentOptions())
    assert found.level == pytest.approx(motor + load, rel=0.03)
    assert found.beyond / found.level == pytest.approx(load / (motor + load), rel=0.03)
    spring = one.plant.springs[0, 2]
    assert found.spring is not None
    assert found.spring.compliance == pytest.approx(
        one.plant.torque_per_u / spring * one.plant.scale, rel=0.05
    )


@pytest.mark.long
def test_the_fit_decides_that_a_weight_throws_the_arm_over() -> None:
    one = machine("pendulum", 1)
    log = logged(one, 0)
    found = fit_friction([log.slice(0, round(0.4 * log.n_samples))], IdentOptions())
    structure = found.arm.structure
    (growth,) = [pole.real for pole in one.plant.linear(one.draft.q_operating)[3] if pole.real > 1e-6]
    assert structure.integrators == 0
    assert -np.log(structure.unstable.real) / one.plant.dt_s == pytest.approx([growth], rel=0.02)
    assert found.level == pytest.approx(levels_of(one), rel=0.03)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_command_that_nobody_closes_a_loop_around_is_none(seed: int) -> None:
    """Binary and sinusoidal commands of a belt drive that turns as it likes."""
    one, rng = machine("belt", seed), np.random.default_rng(seed)
    open_loop = Law(np.zeros((1, 1)), np.zeros((1, 2)), np.zeros(1), np.array([1.0, 0.0]), np.zeros(1))
    size = 5 * levels_of(one)
    binary = size * np.repeat(np.sign(rng.standard_normal(400)), 10)
    times = np.arange(4000) * one.plant.dt_s
    phases, lines = rng.uniform(0, 2 * np.pi, 60), np.arange(1, 61)
    sines = size * np.cos(2 * np.pi * lines * times[:, None] / 2 + phases).sum(axis=1) / np.sqrt(30)
    noise = rng.standard_normal(4000)
    for command in (binary, sines + 1e-3 * size * noise):
        got = one.plant.run(open_loop, command, 0.0, np.zeros(command.size))
        record = Record(command[:, None], got["y"][:, None], one.plant.dt_s, name="open")
        assert not recorded_in_loop([record])
    quick = size * np.sign(rng.standard_normal(4000))
    got = one.plant.run(open_loop, quick, 0.0, np.zeros(4000))
    late = replace(record, input=np.roll(quick, 5)[:, None], output=got["y"][:, None])
    taken = with_commands_in_time([late])[0]
    assert 2 <= taken.notes[0].values["samples"] <= 5 - one.plant.delay
    assert with_commands_in_time([replace(logged(one, 0), reference=None, reference_names=())])[0].notes == ()


@pytest.mark.parametrize(
    "kind",
    ["belt", pytest.param("pendulum", marks=pytest.mark.long), pytest.param("slow", marks=pytest.mark.long)],
)
def test_inverse_dynamics_give_a_start_of_the_level(kind: str) -> None:
    """Within a third, which is what the fit takes: it never moves by more at once."""
    one = machine(kind, 0)
    records = [logged(one, log) for log in (0, 1)]
    size = float(np.std(records[0].output))
    ways = [direction_of(smoothed(record.output[:, 0]), 1e-4 * size) for record in records]
    assert level_of(records, ways, stiff=kind == "pendulum") == pytest.approx(levels_of(one), rel=1 / 3)


def test_an_arm_that_drifts_is_judged_in_windows() -> None:
    """A random walk of force beside the command: windows of 2.5 s tell what a free run over 40 s does not."""
    rng, poles = np.random.default_rng(2), Poles.from_continuous(decay_per_s=[5.0], dt_s=0.01)
    model = GobfModel(poles, np.array([0.1]), 0.01, integrators=1)
    command = np.sign(rng.standard_normal(400)).repeat(10)
    walk = 0.002 * np.cumsum(rng.standard_normal(4000))
    record = Record(command[:, None], model.simulate(command + walk)[:, None], 0.01, name="drifts")
    assert fit_on_fresh_data(model, record).fit_percent < 20
    windows = fit_in_windows(model, record)
    assert windows.fit_percent > 60
    assert windows.residual.size == record.n_samples
    assert windows.answers


def test_the_load_of_a_belt_is_the_lowest_zero_of_the_motor() -> None:
    """Two inertias of 2 and 5 g m^2 on a spring of 4.935 N m/rad: the load alone swings at 5 Hz."""
    motor, load, spring, dt_s = 2e-3, 5e-3, 5e-3 * (10 * np.pi) ** 2, 1e-3
    omega = np.sqrt(spring * (1 / motor + 1 / load))
    poles = Poles.from_continuous(omega_rad_s=[omega], zeta=[0.02], decay_per_s=[0.5], dt_s=dt_s)
    w = np.geomspace(5.0, 400.0, 300)
    s = 1j * w
    wanted = (
        (load * s**2 + 0.1 * s + spring)
        / (s**2 + 0.04 * omega * s + omega**2)
        / (s * (s + 0.5))
        / (motor * load)
    )
    basis = [GobfModel(poles, row, dt_s, integrators=1).frequency_response(w) for row in np.eye(poles.order)]
    a = np.stack(basis, axis=1) / np.abs(wanted)[:, None]
    b = wanted / np.abs(wanted)
    fitted = np.linalg.lstsq(np.vstack([a.real, a.imag]), np.concatenate([b.real, b.imag]), rcond=None)[0]
    found = Spring.of(GobfModel(poles, fitted, dt_s, integrators=1))
    assert found is not None
    assert found.omega_rad_s == pytest.approx(10 * np.pi, rel=0.02)
    assert found.compliance == pytest.approx(1 / spring, rel=0.05)
    # A steady motion meets the whole of the load's friction; below a twist of level / spring the load stands,
    # and its friction is what the spring pulls.
    ramp, level, law = np.linspace(0.0, 1.0, 5000), 0.5, FrictionLaw(1.0)
    assert found.force(ramp, level, law)[-1] == pytest.approx(1.0, abs=0.01)
    twist = 0.4 * level / spring * np.sin(2 * np.pi * 0.2 * dt_s * np.arange(20_000))
    assert found.force(twist, level, law)[5000:] == pytest.approx(spring * twist[5000:] / level, abs=0.02)


def test_equations_that_are_not_finite_lose_the_log():
    rows = np.ones((6, 2))
    rows[3, 1] = np.inf
    with pytest.raises(LostError):
        least_squares([rows], [np.arange(6.0)], np.zeros((0, 3)))


@pytest.mark.parametrize("unstable", [False, True])
def test_small_changes_of_the_force_are_inside_the_bent_ellipses(unstable: bool) -> None:
    """What an arm with 4 % less or more force answers, exactly: 1 / D in the changed D."""
    away, omega = Poles(np.array([np.exp(-0.03)])) if unstable else NO_POLES, np.geomspace(0.1, 20.0, 60)
    poles = Poles(np.array([np.exp(-0.04)]), np.array([0.9 * np.exp(0.4j)])).appended(away)
    mean = np.random.default_rng(1).standard_normal(poles.doubled().order)
    mean = np.append(mean, np.zeros(away.order))
    plain = ResponsePosterior(
        poles.doubled(), mean, np.eye(mean.size), 0.01, integrators=int(not unstable), unstable=away
    )
    # A force k + d s that is added to D moves G by -G^2 (k + d s): within the doubled poles.
    gain, rows = plain.centre(omega)[:, None], plain.frequency_rows(omega)
    wanted = (1j * omega[:, None]) ** [0, 1][int(not unstable) :] * gain**2
    factor = np.linalg.lstsq(real_rows(rows / gain), real_rows(wanted / gain))[0]
    factor = factor * 0.04 / np.max(np.abs(rows @ factor / gain), axis=0)
    bent = of_force(replace(plain, covariance_factor=factor), poles, 30.0)[0].at(omega)
    for change in (rows @ factor / gain).T:
        for t in (-1.0, -0.5, 0.0, 0.5, 1.0):
            assert np.mean(bent.contains(gain[:, 0] / (1 - t * change))) > 0.95


def test_a_light_mode_survives_where_the_arm_hardly_answers() -> None:
    """Ellipses of an arm on a spring, and of a kernel of noise far above its gain where it hardly answers:
    bending them moves the light mode by less than its ellipse."""
    dt_s, n_kernel, rates = 0.002, 20, np.array([-0.16 + 3.98j, -3.7 + 120j])
    poles = Poles(np.array([np.exp(-10.7 * dt_s)]), np.exp(rates * dt_s))
    nothing = np.zeros((poles.doubled().order + n_kernel, 1))
    plain = ResponsePosterior(poles.doubled(), nothing[:, 0], nothing, dt_s, n_kernel)
    s = 1j * np.geomspace(1e-3, 1500.0, 900)
    rows = plain.frequency_rows(s.imag)
    arm = 3000 / np.prod([(s - r) * (s - r.conj()) for r in rates], axis=0)
    wanted = np.column_stack([arm, *(0.03 * s**k * 16 ** (1 - k / 2) / 60 * arm**2 for k in (0, 1))])
    found = np.linalg.lstsq(real_rows(rows / arm[:, None]), real_rows(wanted / arm[:, None]), rcond=1e-9)[0]
    factor = np.hstack([found[:, 1:], 1e-4 * np.eye(nothing.size)[:, -n_kernel:]])
    plain, around = replace(plain, mean=found[:, 0], covariance_factor=factor), np.geomspace(3.5, 4.5, 40)
    bent, straight = of_force(plain, poles, 30.0)[0].at(around), plain.at(around)
    assert np.max(np.abs(bent.centre - straight.centre) / straight.ellipse().semi_major) < 1
    assert bent.ellipse().semi_major == pytest.approx(straight.ellipse().semi_major, rel=0.3)
