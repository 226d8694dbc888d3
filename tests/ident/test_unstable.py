"""Plants with poles outside the unit circle: models, files, fits and ellipses against other arithmetic."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from control_design import Controller, Specification, UncertainPlant, certify
from ident import GobfModel, IdentOptions, MisoModel, Poles, Record, identify
from ident.basis.functions import all_pass_response, all_pass_signal, all_pass_slopes, log_all_pass_slopes
from ident.basis.model_files import ModelFile
from ident.basis.options import EmbeddingOptions
from ident.basis.posterior import ResponsePosterior
from ident.checks.validation import fit_on_fresh_data
from ident.uncertainty.conditions import combine_posteriors, repeat_posteriors
from ident.uncertainty.embedding import tangent
from ident.uncertainty.nominal import nominal_near
from ident.uncertainty.pole_intervals import growth_intervals
from ident.unstable import find_unstable
from tests.workflow.test_codec import same
from workflow.engine import codec
from workflow.tasks.sampled_plant import realise

DT = 0.01
REAL, PAIR = Poles([1 / 1.05]), Poles(pairs=[1 / (1.02 * np.exp(-0.1j))])
OMEGA = np.geomspace(0.1, 300.0, 80)
Z = np.exp(1j * OMEGA * DT)
# theta'' = k theta - b theta' + g u behind a hold: sampled by scipy, closed by a PD controller in numpy.
NUM = np.squeeze(signal.cont2discrete(([40.0], [1.0, 1.5, -9.0]), DT)[0])[1:]
DEN = signal.cont2discrete(([40.0], [1.0, 1.5, -9.0]), DT)[1]
OUTSIDE = float(np.max(np.roots(DEN)))
TRUTH = signal.freqz(np.r_[0.0, NUM], DEN, worN=OMEGA * DT)[1]


def looped(plant, seed, n=3000, noise=1e-3, gains=(1.2, 0.08), push=0.0, limit=np.inf):
    """Difference equations of a plant (num of the delayed inputs, den) behind u = clip(p e + d de/dt),
    e = r - y, with white sensor noise; push: white noise beside u."""
    (num, den), rng = plant, np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.3, 0.3], n // 8 + 1), 8)[:n]
    measured, plain, u = np.zeros(n), np.zeros(n), np.zeros(n)
    pushed, m = u + push * rng.standard_normal(n), len(num)
    for k in range(n):
        past = range(1, min(m, k) + 1)
        plain[k] = sum(num[i - 1] * pushed[k - i] - den[i] * plain[k - i] for i in past)
        measured[k] = plain[k] + noise * rng.standard_normal()
        error = r[k] - measured[k]
        rate = (error - (r[k - 1] - measured[k - 1])) / DT if k else 0.0
        u[k] = np.clip(gains[0] * error + gains[1] * rate, -limit, limit)
        pushed[k] += u[k]
    return Record(u[:, None], measured[:, None], DT, name=f"{seed}", reference=r[:, None])  # fmt: skip


def sampled(numerator, denominator, dt_s=DT):
    num, den = (np.squeeze(part) for part in signal.cont2discrete((numerator, denominator), dt_s)[:2])
    return num[1:], den


def pendulum(seed, n=3000, **more):
    return looped((NUM, DEN), seed, n, **more)


def model(unstable, *, integrators=1, delay=2, doubled=False, feedthrough=0.3):
    rng = np.random.default_rng(3)
    poles = Poles([0.5, 0.9], [0.8 + 0.3j]).appended(unstable)
    poles = poles.doubled() if doubled else poles
    return GobfModel(
        poles, rng.standard_normal(poles.order), DT, feedthrough, integrators, delay, "i", "q", unstable
    )


@pytest.mark.parametrize("unstable", [REAL, PAIR, REAL.appended(PAIR), Poles([-1 / 1.3, 1 / 1.05])])
@pytest.mark.parametrize("doubled", [False, True])
def test_state_space_is_minimal_and_has_the_response(unstable, doubled):
    given = model(unstable, doubled=doubled)
    a, b, c, d = given.state_space()
    assert len(a) == given.order + 3
    found = np.linalg.eigvals(a)
    # Of a double pole rounding leaves its root.
    for outside in given.unstable_poles:
        assert np.min(np.abs(found - outside)) < 1e-9
    assert np.count_nonzero(np.abs(found) > 1 + 1e-6) == unstable.order
    by_states = [(c @ np.linalg.solve(z * np.eye(len(a)) - a, b) + d).item() for z in Z]
    np.testing.assert_allclose(given.frequency_response(OMEGA), by_states, rtol=1e-7)
    # Divided by an all-pass: the size is that of the stable part.
    sizes = [np.abs(one.frequency_response(OMEGA)) for one in (given, given.stable_part)]
    np.testing.assert_allclose(*sizes, rtol=1e-9)
    assert given.stable_poles.order == given.order - unstable.order


def test_zeros_and_several_inputs_are_those_of_the_states():
    given = model(REAL, integrators=0, delay=0)
    zeros = np.sort_complex(given.zeros())
    np.testing.assert_allclose(zeros, np.sort_complex(given.to_control().zeros()), atol=1e-8)
    miso = MisoModel(
        given.poles, np.stack([given.coefficients, 2 * given.coefficients]), [0.3, 0.6], DT, ("a", "b"), "q",
        1, 2, REAL,
    )  # fmt: skip
    expected = model(REAL).frequency_response(OMEGA)
    np.testing.assert_allclose(miso.frequency_response(OMEGA)[:, 0], expected, rtol=1e-9)
    by_states = miso.to_control()(Z)
    np.testing.assert_allclose(by_states[0], np.stack([expected, 2 * expected]), rtol=1e-7)


def test_an_unstable_pole_without_its_image_and_free_runs_are_refused():
    with pytest.raises(ValueError, match="poles"):
        replace(model(REAL), unstable=PAIR)
    with pytest.raises(ValueError, match="free run"):
        model(REAL).simulate(np.ones(5))
    with pytest.raises(ValueError, match=r"1\.11111"):
        IdentOptions(unstable_poles=((0.9, 0.0),))
    with pytest.raises(ValueError, match="unstable_poles has 0, which is inside the unit circle"):
        IdentOptions(unstable_poles=[0])
    with pytest.raises(ValueError, match="relative_degree"):
        identify([pendulum(0, 500)], IdentOptions(unstable_poles=((1.1, 0),), relative_degree=2))


@pytest.mark.parametrize("unstable", [REAL, PAIR])
def test_files_keep_every_bit_and_old_ones_are_read(unstable):
    given = model(unstable)
    file = ModelFile(given)
    assert same(given, ModelFile.from_json(file.to_json()).model)
    assert same(given, ModelFile.from_mat(file.to_mat()).model)
    stable = ModelFile(given.stable_part).to_json()
    assert "unstable" not in stable
    document, arrays = codec.pack(given)
    assert same(given, codec.unpack(GobfModel, document, arrays))
    del document["unstable"]
    assert same(given.stable_part, codec.unpack(GobfModel, document, arrays))
    del document["poles"]
    with pytest.raises(codec.CodecError, match="'poles'"):
        codec.unpack(GobfModel, document, arrays)


@pytest.mark.parametrize("unstable", [REAL, PAIR, REAL.appended(PAIR)])
def test_slopes_are_differences_of_all_passes(unstable):
    y = np.random.default_rng(0).standard_normal(400)
    columns, logs, step = all_pass_slopes(unstable, y), log_all_pass_slopes(unstable, Z), 1e-6
    for i, change in enumerate(step * np.eye(unstable.order)):
        up, down = unstable.moved(change), unstable.moved(-change)
        expected = (all_pass_signal(up, y) - all_pass_signal(down, y)) / (2 * step)
        np.testing.assert_allclose(columns[:, i], expected, atol=2e-7 * np.abs(expected).max())
        ratio = np.log(all_pass_response(up, Z) / all_pass_response(down, Z)) / (2 * step)
        np.testing.assert_allclose(logs[:, i], ratio, rtol=1e-6)


def test_a_draw_has_its_own_unstable_pole_and_one_only():
    """To first order in the response, exactly in states: both agree for small changes."""
    rng, poles = np.random.default_rng(1), Poles([0.5], [0.8 + 0.3j]).appended(REAL)
    size = poles.order + 1 + 4 + 1
    posterior = ResponsePosterior(
        poles, np.r_[rng.standard_normal(size - 1), 0.0], 1e-4 * np.eye(size), DT, 4, True, unstable=REAL
    )
    draw = posterior.sample(rng, 1)[0]
    plant = realise(posterior, draw)
    outside = plant.poles()[np.abs(plant.poles()) > 1]
    np.testing.assert_allclose(outside, [1 / (REAL.real[0] + draw[-1])], rtol=1e-9)
    first_order = posterior.response_of(draw[None], OMEGA)[0]
    change = np.abs(first_order - posterior.centre(OMEGA))
    assert np.all(np.abs(plant(Z) - first_order) < 0.02 * change.max())


def options(**more):
    given = {"n_real": 1, "n_pairs": 0, "unstable_poles": ((OUTSIDE, 0.0),)}
    return IdentOptions(**(given | more))


def test_a_stated_pole_gives_the_true_response_in_a_loop():
    record, other = pendulum(1), pendulum(2)
    found = identify([record], options())
    assert found.model.unstable_poles == pytest.approx([OUTSIDE])
    # sqrt(N) of the noise, the gain about 1: the response is known to parts in a thousand.
    relative = np.abs(found.model.frequency_response(OMEGA) / TRUTH - 1)
    assert np.median(relative) < 5e-3
    # |B| = 1: white noise stays white and of its size.
    assert found.noise_std == pytest.approx(1e-3, rel=5 / np.sqrt(2 * 3000))
    fresh = fit_on_fresh_data(found.model, other)
    assert np.std(fresh.residual) == pytest.approx(1e-3 * OUTSIDE, rel=0.1)
    np.testing.assert_allclose(fresh.simulated + fresh.residual, other.output[:, 0])
    # Without it no stable model comes near.
    stable = identify([record], options(unstable_poles=(), n_real=2))
    assert stable.noise_std > 10 * found.noise_std


@pytest.mark.parametrize("runs", [12, pytest.param(40, marks=pytest.mark.long)])
def test_ellipses_hold_truth_though_the_stated_pole_is_a_little_off(runs):
    """Its error is a column of the fit; the pole is off by more than its own standard deviation."""
    held, intervals = [], []
    for seed in range(runs):
        off = OUTSIDE * (1 + 2e-5 * np.cos(seed))
        stated = options(unstable_poles=((off, 0.0),))
        record = pendulum(100 + seed, n=1500)
        bounds = EmbeddingOptions(fir_length=20, prior_missed_mode=0.0)
        posterior = tangent([record], identify([record], stated).model, bounds)
        held.append(posterior.at(OMEGA).contains(TRUTH))
        change, spread = posterior.mean[-1], np.linalg.norm(posterior.covariance_factor[-1])
        intervals.append(abs(1 / off + change - 1 / OUTSIDE) < 1.96 * spread)
        nominal = nominal_near(posterior, Poles([posterior.poles.real[0], 1 / off]), OMEGA)
        assert nominal.unstable_poles == pytest.approx([off])
    # A run's response moves together, as a few independent frequencies. Intervals: two standard deviations of
    # a binomial of 95 %.
    assert 0.9 <= np.mean(held) <= 0.99
    assert np.sum(intervals) >= 0.95 * runs - 2 * np.sqrt(0.95 * 0.05 * runs)


LOOPS = {
    "sensor": {},
    "noisy": {"noise": 1e-2},
    "pushed": {"push": 0.03, "noise": 1e-4},
    "limited": {"limit": 0.6},
}


@pytest.mark.parametrize("runs", [1, pytest.param(10, marks=pytest.mark.long)])
@pytest.mark.parametrize("case", LOOPS)
def test_the_pendulum_s_pole_is_found(case, runs):
    found = [find_unstable([pendulum(seed, **LOOPS[case])]) for seed in range(runs)]
    assert [poles.counts for poles in found] == [(1, 0)] * runs
    growths = np.array([-np.log(poles.real[0]) for poles in found]) / np.log(OUTSIDE)
    assert np.max(np.abs(growths - 1)) < 0.05


@pytest.mark.parametrize(
    ("case", "runs"),
    [("noisy", 1), *(pytest.param(case, 5, marks=pytest.mark.long) for case in LOOPS if case != "limited")],
)
@pytest.mark.parametrize(
    "plant",
    [
        pytest.param(sampled([40.0], [1.0, 1.5, 9.0]), id="hanging"),
        pytest.param(sampled([40.0], [1.0, 1.5, 0.0]), id="integrator"),
        pytest.param(sampled([40.0], [1.0, 0.01, 0.0]), id="nearly two integrators"),
        pytest.param(sampled([40.0], [1.0, 1.5, 0.05]), id="slow"),
        pytest.param(sampled([40.0 * 900], np.polymul([1.0, 1.5, 0.3], [1, 1.2, 900])), id="slow and a mode"),
    ],
)
def test_stable_plants_have_none(plant, case, runs):
    gains = (0.3, 0.02) if len(plant[1]) > 3 else (1.2, 0.08)
    for seed in range(runs):
        assert find_unstable([looped(plant, seed, gains=gains, **LOOPS[case])]).order == 0


def test_an_oscillation_that_grows_is_a_pair():
    """Negative damping; two records, each with its own start."""
    plant = sampled([40.0], [1.0, -0.8, 16.0])
    for seed in range(2):
        found = find_unstable([looped(plant, [seed, k], n=2000) for k in range(2)])
        assert found.counts == (0, 1)
        s = np.log(1 / found.pairs[0].conj()) / DT
        expected = np.roots([1.0, -0.8, 16.0])
        assert abs(s - expected[expected.imag > 0][0]) < 0.02 * abs(s)


@pytest.mark.parametrize("runs", [6, pytest.param(60, marks=pytest.mark.long)])
def test_its_interval_and_the_ellipses_hold_the_truth(runs):
    held, inside, bounds = [], [], EmbeddingOptions(fir_length=20, prior_missed_mode=0.0)
    for seed in range(runs):
        record = pendulum(400 + seed, n=1500)
        asked = IdentOptions(n_real=1, n_pairs=0).with_unstable(find_unstable([record]))
        posterior = tangent([record], identify([record], asked).model, bounds)
        # A record in which no growth is found counts as one that misses it.
        inside.append(
            [low < np.log(OUTSIDE) / DT < high for low, high in growth_intervals(posterior)] == [True]
        )
        held.append(posterior.at(OMEGA).contains(TRUTH))
    # Binomial of a true 95 %, three standard deviations: 52 or more of 60. Responses of a run move together.
    assert np.sum(inside) >= 0.95 * runs - 3 * np.sqrt(0.95 * 0.05 * runs)
    assert abs(np.mean(held) - 0.95) <= 0.04 * np.sqrt(60 / runs)


def test_repeats_are_combined_with_their_unstable_pole():
    records = [pendulum(200 + k, n=1500) for k in range(4)]
    found = identify(records, options()).model
    bounds = EmbeddingOptions(fir_length=20)
    (each,) = repeat_posteriors([records], found, bounds)
    combined = combine_posteriors(each, small_sample_level=0.95)
    assert combined.unstable is found.unstable
    assert combined.at(OMEGA).contains(TRUTH).mean() > 0.9
    with pytest.raises(ValueError, match="poles"):
        combine_posteriors([each[0], each[1].stable_part])


def test_an_identified_pendulum_is_certified_between_all_frequencies():
    """The ellipses' own count of unstable poles: certificate, draws and lower bound of a PD controller."""
    record = pendulum(300)
    model = identify([record], options()).model
    posterior = tangent([record], model, EmbeddingOptions(fir_length=20))
    plant = UncertainPlant(
        nominal_near(posterior, model.poles, OMEGA).to_control(), name="pendulum", uncertainty=posterior
    )
    assert plant.unstable_poles == 1
    # 1.2 e + .08 de/dt, the difference filtered over two samples.
    controller = Controller([[0.5]], [[0.5]], [[-4.0]], [[1.2 + 4.0]], DT, computational_delay_samples=0)
    specification = Specification(modulus_margin=0.3, computational_delay_samples=0)
    certificate = certify(
        controller, [plant], specification, joint_coverage=0.9, rng=np.random.default_rng(0), joint_draws=500
    )
    proof = certificate.plants[0].all_frequencies
    assert certificate.certified
    assert proof.proved
    assert proof.half_turns == 1.0
    assert certificate.joint.stable_share == 1.0
    # Without feedback it falls.
    loose = Controller([[0.5]], [[0.5]], [[-0.04]], [[0.05]], DT, computational_delay_samples=0)
    assert not certify(loose, [plant], specification).certified
