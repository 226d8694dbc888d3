"""The loop on an arm with dry friction: linear limit, statics, and its feed-forward on an exact friction."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.closed_loop_machines.simulator import Law, Plant, response
from control_design import Controller, simulate, step_metrics
from control_design.analysis.closed_loop import measure_sensitivity
from control_design.controllers.controller import FrictionFeedforward
from ident import GobfModel, IdentOptions, Poles, Record, Structure
from ident.command_timing import timing_of
from ident.friction import FrictionFit, FrictionLaw, fit_friction
from ident.friction.arm import SteppedArm
from ident.friction.spring import Spring
from plant import SampledArm, paper_link, parse_effect
from workflow.config.run_config import built_in_config
from workflow.describe.friction import settle, settling_range, stands_still
from workflow.tasks.friction_loop import (
    FrictionLoop,
    beside_recorded,
    drawn,
    friction_feedforward,
    holds_from,
    interval_of,
    soonest,
)
from workflow.tasks.results import SettlingRange, SlowSine

DT_S = 0.005
POLES = Poles(np.array([0.97]), np.array([0.93 + 0.24j]))


def fit(level: float = 0.04, level_std: float = 0.0) -> FrictionFit:
    """An integrating arm with a motor's pole and a mode, delayed by a sample; known but for its level."""
    model = GobfModel(POLES, np.array([0.01, 0.002, -0.001]), DT_S, integrators=1, input_delay_samples=1)
    arm = SteppedArm.of(POLES, Structure(integrators=1, input_delay_samples=1), DT_S)
    z = np.exp(1j * np.linspace(1e-3, np.pi, 400))
    doubled = GobfModel(POLES.doubled(), np.zeros(6), DT_S)
    rows = np.array(
        [replace(doubled, coefficients=unit).frequency_response(np.angle(z) / DT_S) for unit in np.eye(6)]
    ).T
    wanted = GobfModel(POLES, model.coefficients, DT_S).frequency_response(np.angle(z) / DT_S)
    stacked = np.vstack([rows.real, rows.imag]), np.append(wanted.real, wanted.imag)
    coefficients = np.linalg.lstsq(*stacked, rcond=None)[0]
    factor = np.zeros((8, 8))
    factor[6, 6] = level_std
    return FrictionFit(FrictionLaw(level), model, arm, coefficients, factor, 1e-3, 0.0)


def controller(**fields) -> Controller:
    """A lead around ten rad/s with a static gain of 5."""
    return Controller([[0.8]], [[1.0]], [[-1.4]], [[12.0]], DT_S, **fields)


EXCITATION = {"rms": 0.1, "band_rad_s": (1.0, 60.0), "period_samples": 2000, "lead_in_periods": 2}


def test_without_friction_it_is_the_linear_loop():
    """|S| on the lines is 1 / (1 + G K), to what the doubled poles span (a few parts in a million)."""
    found = replace(fit(), noise_std=0.0)
    rng = np.random.default_rng(1)
    seen = FrictionLoop(controller(), found, found.coefficients, FrictionLaw(0.0)).sensitivity(
        rng, rng, **EXCITATION
    )
    omega = seen.omega_rad_s
    expected = 1 / (1 + found.model.frequency_response(omega) * controller().response(omega))
    np.testing.assert_allclose(seen.response, expected, rtol=0, atol=2e-5)
    assert seen.peak[0] > 1.05, "a loop whose S has no peak would show nothing"


def test_arm_at_rest_holds_what_its_level_allows():
    """Any step: at the end the command is held by the friction, and one size comes close to the bound."""
    loop = FrictionLoop.of(controller(), fit())
    assert loop.error_at_rest == pytest.approx(0.04 / 5, rel=1e-4)
    left = [1 - loop.run(np.full(4000, size)).measured[-1] / size for size in (0.002, 0.005, 0.02, 0.3)]
    errors = np.abs(np.array(left) * [0.002, 0.005, 0.02, 0.3])
    assert np.all(errors <= loop.error_at_rest * (1 + 1e-3))
    assert np.max(errors) > 0.5 * loop.error_at_rest


def test_sticking_grows_with_the_level_and_needs_friction():
    """A deflection of given width at twice the level is the same arm at twice the size but for its stiffness:
    here, slow against it, the step doubles."""
    one, two = (FrictionLoop.of(controller(), fit(level)).sticking_step(1500) for level in (0.04, 0.08))
    assert two == pytest.approx(2 * one, rel=0.1)
    # The command's largest answer to a unit of error is its first, 12.
    assert 0.5 * 0.04 / 12 < one < 1.02 * 0.04 / 12
    assert FrictionLoop.of(controller(), fit(0.0)).sticking_step(1500) == 0.0


def test_draws_spread_as_the_level_is_known():
    levels = [
        loop.friction.level for loop in drawn(controller(), fit(0.04, 0.002), np.random.default_rng(2), 400)
    ]
    assert np.mean(levels) == pytest.approx(0.04, abs=4 * 0.002 / 20)
    assert np.std(levels) == pytest.approx(0.002, rel=0.15)


def test_interval_holds_one_more_value_as_often_as_it_says():
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(1000):
        *seen, new = np.exp(0.1 * rng.standard_normal(9))
        low, high = interval_of(seen)
        held += low <= new <= high
    # Binomial: standard deviation 6.9.
    assert abs(held - 950) < 28


def test_a_claim_holds_from_where_its_excess_passes_zero():
    sizes = np.array([1.0, 0.1, 0.01])
    assert holds_from(sizes, np.array([-1.0, 1.0, -1.0])) == pytest.approx(10**-0.5)
    assert holds_from(sizes, np.array([-1.0, -1.0, 0.0])) == 0.01
    assert holds_from(sizes, np.array([0.1, -1.0, -1.0])) is None


def test_a_sine_moves_the_arm_from_where_its_command_meets_the_friction():
    loop = FrictionLoop.of(controller(), fit())
    omega = 2 * np.pi / (600 * DT_S)
    unit, from_here = np.sin(2 * np.pi * np.arange(2400) / 600), loop.moving_sine(omega)
    runs = [loop.run(share * from_here * unit).measured.ravel()[1200:] for share in (0.9, 2.0)]
    assert np.ptp(runs[0]) < 0.05 * from_here < from_here < np.ptp(runs[1])
    sines = [
        SlowSine(share * from_here, omega, 0.0, share * from_here * unit[1200:] - y, 0 * y, from_here)
        for share, y in zip((0.9, 2.0), runs, strict=True)
    ]
    assert [sine.stands_still for sine in sines] == [True, False]
    told = [stands_still(sine, "rad", feedforward=False) for sine in sines]
    assert "the arm stands still on a sine of 0.00" in told[0]
    assert "friction_feedforward = true in [closed_loop] takes the rms error" in told[0]
    assert told[1] == ""


class Slider:
    """y+ = y + gain dt (u - friction), with the friction that Coulomb's law gives a body without mass."""

    dt_s, gain = DT_S, 2.0

    def __init__(self, level: float) -> None:
        self.level = level

    def reset(self) -> None:
        self.y = 0.0

    def measure(self):
        return np.array([self.y])

    def advance(self, u: float, /, *, hub_torque_Nm: float = 0.0) -> None:
        self.y += self.gain * DT_S * (u - np.clip(u, -self.level, self.level))


def lead(gain=12.0, integral=0.0, idle=0, **fields) -> Controller:
    """`controller`, with integral action beside it, and idle states."""
    rest = [0.0] * idle
    A, B = np.diag([0.8, 1.0, *rest]), [[1.0], [1.0], *([0.0] for _ in rest)]
    return Controller(A, B, [[-1.4, integral, *rest]], [[gain]], DT_S, **fields)


def stage_of(found, records=(), step=0.02):
    """What `soonest` and `beside_recorded` read of a run's stage."""
    config = built_in_config()[0]
    asked = config.specification.model_copy(update={"lowest_bandwidth_rad_s": 1.0})
    loop = config.closed_loop.model_copy(update={"reference_step": step, "measurement_step": 0.0})
    timing = timing_of(records, in_loop=True) if records else None
    results = SimpleNamespace(
        identify=SimpleNamespace(friction=found),
        records=SimpleNamespace(fitted=lambda channel: records, timing=timing),
    )
    config = config.model_copy(update={"specification": asked, "closed_loop": loop})
    return SimpleNamespace(config=config, results=results, plants=(None,))


def test_the_recorded_loop_stands_beside_the_new_one():
    """A log that a loop with friction made: its controller is found, and leaves what was recorded."""
    rng, found = np.random.default_rng(3), replace(fit(), noise_std=1e-6)
    reference = 0.2 * np.cumsum(rng.standard_normal(4000)) / 60
    made = FrictionLoop.of(lead(integral=0.02, computational_delay_samples=0), found)
    run = made.run(reference, rng)
    signals = [run.command[:, None], run.measured[:, None]]
    record = Record(*signals, DT_S, name="log", reference=reference[:, None])
    step = np.append(0.0, np.full(400, 0.02))
    slower = FrictionLoop.of(lead(gain=9.0, integral=0.002), found)
    seen = beside_recorded(stage_of(found, [record]), slower, step)
    assert seen["errors"][1] == pytest.approx(seen["errors"][0], rel=3e-3)  # without the noise
    assert seen["errors"][2] > 1.2 * seen["errors"][0]
    assert seen["recorded"].settling_time_s == pytest.approx(
        step_metrics(made.answer(step)).settling_time_s, rel=0.02
    )
    unknown = replace(record, reference=None, reference_names=())
    assert seen["recorded_settling"] == made.settling(step)
    assert beside_recorded(stage_of(found, [unknown]), slower, step) == {}


@pytest.mark.parametrize(("first", "chosen"), [(0.001, 3), (0.03, 5)])
def test_fewer_states_are_taken_where_friction_lets_them_settle_sooner(monkeypatch, first, chosen):
    """Little integral action waits until friction lets go; no design is tried where it does not."""
    monkeypatch.setattr("workflow.tasks.friction_loop.closed_loop_poles", lambda *_: np.array([0.98]))
    stage, tried = stage_of(fit()), list[int]()

    def again(asked):
        tried.append(asked.controller_order)
        law = lead(
            9.0, {5: first, 4: 0.002, 3: 0.05}[asked.controller_order], idle=asked.controller_order - 2
        )
        return SimpleNamespace(met=True, controller=law, specification=asked)

    best = soonest(stage, again(stage.config.specification.model_copy(update={"controller_order": 5})), again)
    assert best.controller.order == chosen
    assert tried == ([5, 4, 3] if chosen == 3 else [5])


def test_feedforward_is_the_friction_of_a_pure_integrator():
    """Ten lags after a ramp has begun it equals the friction, so that the loop follows as without either; at
    rest it is gone, and what friction leaves is that of the loop without it."""
    gain, level, width = 5.0, 0.3, 1e-4
    plain = Controller.proportional(gain, DT_S, computational_delay_samples=0)
    law = replace(plain, feedforward=FrictionFeedforward(level, width, 1 / (gain * Slider.gain)))
    time_s = np.arange(4000) * DT_S
    reference = np.interp(time_s, [0, 3, 5, 9, 12, 20], [0, 0.5, 0.5, -0.3, 0.2, 0.2])
    linear, given, without = (
        simulate(one, Slider(size), reference) for one, size in ((plain, 0.0), (law, level), (plain, level))
    )
    moving = ((time_s > 1) & (time_s < 3)) | ((time_s > 6) & (time_s < 9)) | ((time_s > 10) & (time_s < 12))
    friction = np.clip(given.command, -level, level)
    added = law.feedforward.signal(reference, DT_S)
    # e^-10 of the level, and of twice the level where the ramp turns round.
    np.testing.assert_allclose(added[moving], friction[moving], rtol=0, atol=1e-4 * level)
    np.testing.assert_allclose(given.measured[moving], linear.measured[moving], rtol=0, atol=1e-4)
    assert np.min(np.abs(without.measured - linear.measured)[moving]) > 0.9 * level / gain
    assert abs(added[-1]) < 1e-6 * level
    assert abs(given.measured[-1] - reference[-1]) <= level / gain


def test_feedforward_is_as_late_as_the_loop_follows_a_ramp():
    """Velocity error of a type-1 loop: behind a ramp by its speed over Kv, that is, late by 1 / Kv."""
    found = replace(fit(), noise_std=0.0)
    ramp = 0.1 * np.arange(4000) * DT_S
    behind = (
        ramp[-1]
        - FrictionLoop(controller(), found, found.coefficients, FrictionLaw(0.0)).run(ramp).measured[-1]
    )
    given = friction_feedforward(controller(), found)
    assert (given.level, given.width) == (found.level, found.law.presliding)
    assert given.lag_s == pytest.approx(behind / 0.1, rel=1e-3)


@pytest.fixture(scope="module")
def belt():
    """Motor and load on a belt, friction at both, and the fit that perfect records would give."""
    friction = np.array([[0.03, 0.03, 1, 0, 0], [0.01, 0.01, 1, 0, 0]])
    machine = Plant(
        np.array([2e-3, 4e-3]), np.array([4e-3, 2e-3]), np.zeros(2), np.array([[0, 1, 3.33, 0.008, 0]]),
        friction, np.zeros(3), 1.0, 0, 1.0, DT_S, 0, 1e-7, np.inf,
    )  # fmt: skip
    a, b, c = machine.sampled()
    z, omega = np.linalg.eigvals(a), np.geomspace(0.1, 0.95 * np.pi / DT_S, 400)
    slow = z[(z.imag == 0) & (z.real < 1 - 1e-6)].real
    poles, models = Poles(np.append(0.0, slow), z[z.imag > 0]), []
    for these in (poles, poles.doubled()):
        one = GobfModel(these, np.zeros(these.order), DT_S, integrators=1)
        rows = [replace(one, coefficients=unit).frequency_response(omega) for unit in np.eye(these.order)]
        shares = np.array(rows).T / response(a, b, c, omega, DT_S)[:, None]
        stacked = np.vstack([shares.real, shares.imag]), np.repeat([1.0, 0.0], omega.size)
        models.append(replace(one, coefficients=np.linalg.lstsq(*stacked, rcond=None)[0]))
    arm = SteppedArm.of(poles, Structure(integrators=1), DT_S)
    model, twice = models
    factor = np.zeros((11, 1))
    factor[-1] = 0.001
    law, spring = FrictionLaw(0.03), Spring.of(model)
    return machine, FrictionFit(
        law, model, arm, twice.coefficients, factor, 0.0, 0.0, spring=spring, beyond=0.01
    )


@pytest.mark.parametrize(
    "jump", [pytest.param(0.0, marks=pytest.mark.long), pytest.param(-0.4, marks=pytest.mark.slow)]
)
def test_friction_at_the_load_acts_in_the_loop(belt, jump):
    """A step with integral action, against the two masses; also where the fit has the speed jump a little
    against the force, which on a shaft that sticks would grow."""
    machine, found = belt
    keep = np.exp(-DT_S / 0.008)
    steep = 0.05 * (1 - keep) / DT_S
    law = Controller(
        np.diag([keep, 1.0]), np.array([[1 - keep], [DT_S]]), np.array([[-steep, 0.5]]), [[1 + steep]], DT_S,
        computational_delay_samples=0,
    )  # fmt: skip
    both = Law(law.A, np.hstack([law.B, -law.B]), law.C[0], np.append(law.D, -law.D), np.zeros(2))
    step = np.full(4000, 0.12)
    true = machine.run(both, step, 0.0, np.zeros(step.size))["true"]
    weights = found.arm.weights.copy()
    weights[np.argmax(np.abs(found.arm.rates)), 0] += jump / found.coefficients[0]
    loop = FrictionLoop.of(law, replace(found, arm=replace(found.arm, weights=weights)))
    assert np.max(np.abs(loop.run(step).measured - true)) < 1e-3
    assert np.max(np.abs(replace(loop, load_level=0.0).run(step).measured - true)) > 9e-3
    assert friction_feedforward(law, found).level == pytest.approx(0.04)
    drawn_levels = [one.load_level for one in drawn(law, found, np.random.default_rng(1), 200)]
    assert np.std(drawn_levels) == pytest.approx(0.001, rel=0.2)
    assert replace(loop, controller=controller()).error_at_rest == pytest.approx(0.04 / 5, rel=1e-4)


def hunting(integral: float) -> tuple[Controller, Law]:
    """A law with integral action whose step on the belt sticks in and out of its band: for flexlink, and for
    the simulator of the machine."""
    keep = np.exp(-DT_S / 0.008)
    steep = 0.05 * (1 - keep) / DT_S
    law = Controller(
        np.diag([keep, 1.0]), np.array([[1 - keep], [DT_S]]), np.array([[-steep, integral]]), [[1 + steep]],
        DT_S, computational_delay_samples=0,
    )  # fmt: skip
    return law, Law(law.A, np.hstack([law.B, -law.B]), law.C[0], np.append(law.D, -law.D), np.zeros(2))


@pytest.mark.parametrize(
    "integral", [pytest.param(0.5, marks=pytest.mark.long), pytest.param(1.0, marks=pytest.mark.slow)]
)
def test_the_range_over_sizes_holds_the_time_of_another_integration(belt, integral):
    """One step's settling time jumps from 0.15 s to many with its size, and differs by seconds from that of a
    simulator with other steps; the range covers both."""
    machine, found = belt
    law, both = hunting(integral)
    loop = FrictionLoop.of(law, found)
    step = np.append(0.0, np.full(600, 0.12))
    settling = loop.settling(step)
    assert settling.worst_s > 20 * settling.settled_s[0]
    for share in (0.7, 0.85, 1.2):
        run = loop.answer(share * step)
        true = machine.run(both, run.reference, 0.0, np.zeros(run.reference.size))["true"]
        for output in (run.output, true[:, None]):
            time_s = step_metrics(replace(run, output=output)).settling_time_s
            assert 0.98 * settling.settled_s[0] <= time_s <= 1.02 * settling.worst_s
    # Chance decides how long the step itself takes; the middle of all sizes hardly moves with the step.
    near = loop.settling(1.03 * step)
    assert near.median_s == pytest.approx(settling.median_s, rel=0.15)


def test_without_friction_every_size_takes_the_same_time():
    loop = FrictionLoop.of(lead(), replace(fit(), noise_std=0.0))
    step = np.append(0.0, np.full(400, 0.02))
    settling = replace(loop, friction=FrictionLaw(0.0)).settling(step)
    assert len(set(settling.times_s)) == 1
    assert settling.sizes[0] == pytest.approx(0.01)
    assert settling.sizes[-1] == pytest.approx(0.04)


def test_range_and_median_over_sizes():
    """Sizes that lie close together count as one; a step that does not settle is later than all."""
    crowded = SettlingRange((0.5, 1.0, 1.01, 1.02, 2.0), (2.0, 1.0, 9.0, 9.0, 3.0), 30.0)
    assert (crowded.settled_s, crowded.worst_s, crowded.median_s) == ((1.0, 2.0, 3.0, 9.0, 9.0), 9.0, 2.0)
    some = SettlingRange((0.5, 1.0, 2.0), (2.0, None, 0.2), 30.0)
    assert (some.worst_s, some.median_s) == (None, 2.0)
    none = SettlingRange((0.5, 1.0, 2.0), (None, None, 1.0), 30.0)
    assert none.median_s == np.inf
    told = [settling_range(each) for each in (crowded, some, SettlingRange((1.0, 2.0), (2.71, 2.71), 30.0))]
    assert told == ["1 to 9 s", "0.2 to over 30 s", "2.7 to 2.8 s"]
    assert settling_range(SettlingRange((1.0, 2.0), (None, None), 30.0)) == "over 30 s"
    assert settle(none) == "settle to 2 % in 1 to over 30 s"
    never = SettlingRange((1.0, 2.0), (None, None), 30.0)
    assert settle(never) == "do not settle to 2 % in 30 s"


def test_predicted_response_is_that_of_the_nonlinear_arm():
    """Noise aside: arm and friction from records of the nonlinear arm, S where friction changes it by 5 %."""
    arm = SampledArm(paper_link(), [parse_effect({"name": "coulomb_friction", "torque_Nm": 0.05})], None)
    rng, records = np.random.default_rng(4), []
    for name in ("one", "two"):
        arm.reset()
        voltage, angle = 6.0 * np.repeat(np.sign(rng.standard_normal(400)), 4), []
        for u in voltage:
            angle.append(arm.measure()[0])
            arm.advance(u)
        noisy = np.array(angle) + 1e-4 * rng.standard_normal(voltage.size)
        records.append(Record(voltage[:, None], noisy[:, None], DT_S, name=name, input_names=("voltage_V",)))
    options = IdentOptions(integrators=1, n_real=1, n_pairs=2, omega_min_rad_s=30.0, decay_min_per_s=1.0)
    found = replace(fit_friction(records, options), noise_std=0.0)
    law = Controller([[0.75]], [[1.0]], [[-3.5]], [[20.0]], DT_S)
    excitation = EXCITATION | {"rms": 0.02}
    truth = measure_sensitivity(law, arm, np.random.default_rng(5), **excitation).response
    seen, linear = (
        FrictionLoop(law, found, found.coefficients, friction)
        .sensitivity(np.random.default_rng(5), rng, **excitation)
        .response
        for friction in (found.law, FrictionLaw(0.0))
    )
    away, linear_away = (np.sqrt(np.mean(np.abs(one - truth) ** 2)) for one in (seen, linear))
    assert linear_away > 0.05
    assert away < 0.002
