"""Several inputs with shared poles: limits, identities and plants made by SciPy alone."""

import numpy as np
import pytest
from scipy import signal

from ident import IdentOptions, MisoModel, Poles, Record, identify
from ident.checks.input_checks import alike_inputs
from ident.data.finding import FindingKind
from ident.fit.regression import prepare_inputs
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior
from tests.ident.benchmark_plants import p3
from tests.ident.findings import kinds

DT_S = 0.01
OMEGA = np.geomspace(0.5, 200.0, 80)
# Decay of the slow pole, then frequencies and dampings of two modes; gains (slow, mode 1, mode 2) of each
# input. From input 0 the second mode is a thousandth of the first, 20 dB below the noise at the resonance.
DECAY, MODES = 2.0, ((20.0, 0.03), (90.0, 0.02))
GAINS = np.array([[1.0, 0.8, 0.0008], [0.6, -0.5, 0.4]])


def plant(gains=GAINS):
    """Continuous state space, poles shared: every input drives the same modes."""
    a = np.zeros((5, 5))
    a[0, 0] = -DECAY
    b = np.zeros((5, gains.shape[0]))
    b[0] = DECAY * gains[:, 0]
    c = np.array([[1.0, 1.0, 0.0, 1.0, 0.0]])
    for i, (omega, zeta) in enumerate(MODES):
        at = 1 + 2 * i
        a[at, at + 1] = 1.0
        a[at + 1, at : at + 2] = -(omega**2), -2 * zeta * omega
        b[at + 1] = omega**2 * gains[:, 1 + i]
    return a, b, c, np.zeros((1, gains.shape[0]))


def sampled(gains=GAINS):
    return signal.cont2discrete(plant(gains), DT_S)[:4]


def response(system, omega=OMEGA):
    A, B, C, D = system
    eye = np.eye(A.shape[0])
    return np.array([(C @ np.linalg.solve(np.exp(1j * w * DT_S) * eye - A, B) + D)[0] for w in omega])


def record(seed, n=3000, noise_std=0.05, system=None, start=None):
    """Random binary inputs, white noise on the output; from rest unless a start state is given."""
    rng = np.random.default_rng(seed)
    system = sampled() if system is None else system
    u = rng.choice([-1.0, 1.0], (n, system[1].shape[1]))
    y = signal.dlsim((*system, DT_S), u, x0=start)[1][:, 0]
    names = tuple(f"motor_{i + 1}" for i in range(u.shape[1]))
    return Record(
        u,
        (y + noise_std * rng.normal(size=n))[:, None],
        DT_S,
        name=f"seed {seed}",
        input_names=names,
        output_names=("tip",),
    )


@pytest.fixture(scope="module")
def fitted():
    return identify_mimo([record(0)])


def some_model(integrators=0, delay=0, zeros=None, feedthrough=True):
    rng = np.random.default_rng(3)
    zeros = integrators if zeros is None else zeros
    poles = Poles(np.array([0.0] * zeros + [0.9, -0.3]), np.array([0.9 + 0.3j, 0.5 + 0.8j]))
    direct = rng.normal(size=3) if feedthrough else np.zeros(3)
    return MisoModel(
        poles, rng.normal(size=(3, poles.order)), direct, DT_S, ("a", "b", "c"), "y", integrators, delay
    )


def test_one_input_is_the_single_input_identification():
    truth = p3(3, 0, 40)
    for options in (
        IdentOptions(estimate_offset=True, n_real=2, n_pairs=3),
        IdentOptions(estimate_offset=True, estimate_initial_state=True, max_pairs=3),
    ):
        one, several = identify([truth.record], options), identify_mimo([truth.record], options)
        # Either descent stops when 1e-9 of J is left to gain: within sqrt(1e-9 N) = 1.4e-3 of the poles'
        # standard deviations, the largest of which is a few thousandths.
        np.testing.assert_allclose(several.noise_covariance[0, 0], one.noise_std**2, rtol=1e-2)
        np.testing.assert_allclose(several.model.poles.values, one.model.poles.values, rtol=0, atol=1e-5)
        scale = np.max(np.abs(one.model.coefficients))
        np.testing.assert_allclose(
            several.model.coefficients[0, 0], one.model.coefficients, rtol=0, atol=1e-5 * scale
        )


def test_shared_modes_are_found_and_the_invisible_one_too(fitted):
    poles = fitted.model.poles
    assert (poles.real.size, poles.pairs.size) == (1, 2)
    # Gauss-Newton deviations here: 2e-4 relative in frequency, 1 % in damping, 1 % in the decay.
    np.testing.assert_allclose(poles.omega_rad_s(DT_S), [20.0, 90.0], rtol=2e-3)
    np.testing.assert_allclose(poles.zeta(), [0.03, 0.02], rtol=0.1)
    np.testing.assert_allclose(poles.decay_per_s(DT_S), [DECAY], rtol=0.05)
    assert np.sqrt(fitted.noise_covariance[0, 0]) == pytest.approx(0.05, rel=0.05)
    assert fitted.tangent_optimality < 1e-3
    assert fitted.warnings == ()
    error = np.abs(fitted.model.frequency_response(OMEGA)[:, 0] - response(sampled()))
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.02)

    # The same channel by itself, the other motor at rest: that mode is not there.
    alone = identify([record(0, system=sampled(GAINS[:1])).siso()])
    assert alone.model.poles.pairs.size == 1


def test_order_criterion_counts_one_plus_u_numbers_per_pole():
    data = prepare_inputs([record(0, n=300)], IdentOptions(feedthrough=True).structure())
    # 6 poles, 6 coefficients and a direct term for each of two inputs, and the offset.
    assert data.n_parameters(6) == 6 + 2 * 6 + 2 + 1


@pytest.mark.parametrize(("integrators", "zeros"), [(0, 0), (1, 1), (2, 2), (3, 3), (2, 0)])
@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_state_space_shares_the_poles_and_equals_the_channels(integrators, zeros, delay, feedthrough):
    model = some_model(integrators, delay, zeros, feedthrough)
    A, B, C, D = model.state_space()
    order = model.order + delay + (integrators - min(zeros, integrators))
    assert (A.shape, B.shape, C.shape, D.shape) == ((order, order), (order, 3), (1, order), (1, 3))
    expected = model.frequency_response(OMEGA)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert np.max(np.abs(response((A, B, C, D)) - expected) / scale) < 1e-12
    u = np.random.default_rng(0).normal(size=(200, 3))
    y = model.simulate(u)
    np.testing.assert_allclose(
        signal.dlsim((A, B, C, D, DT_S), u)[1][:, 0], y, rtol=0, atol=1e-11 * np.abs(y).max()
    )
    at = np.array([30.0])
    np.testing.assert_allclose(
        model.to_control()(np.exp(1j * at * DT_S))[0, :, 0], model.frequency_response(at)[0], rtol=1e-9
    )
    if zeros == integrators:
        # Minimal: every mode is reached from the inputs and seen at the output (Popov-Belevitch-Hautus).
        for value in np.linalg.eigvals(A):
            assert np.linalg.svd(np.hstack([A - value * np.eye(order), B]))[1][-1] > 1e-6
            assert np.linalg.svd(np.vstack([A - value * np.eye(order), C]))[1][-1] > 1e-6


def test_integrators_and_delay_are_exact():
    # 1/(z - 1) behind the plant and two samples of delay.
    A, B, C, D = sampled()
    A = np.block([[A, np.zeros((5, 1))], [C, np.ones((1, 1))]])
    B = np.vstack([B, D])
    C = np.array([[0.0] * 5 + [1.0]])
    rng = np.random.default_rng(5)
    u = rng.choice([-1.0, 1.0], (3000, 2))
    late = np.vstack([np.zeros((2, 2)), u[:-2]])
    y = signal.dlsim((A, B, C, D, DT_S), late)[1][:, 0] + 0.01 * rng.normal(size=3000)
    item = Record(u, y[:, None], DT_S, name="arm", input_names=("a", "b"), output_names=("tip",))
    result = identify_mimo([item], IdentOptions(integrators=1, input_delay_samples=2, n_real=1, n_pairs=2))
    np.testing.assert_allclose(result.model.poles.omega_rad_s(DT_S), [20.0, 90.0], rtol=2e-3)
    truth = response((A, B, C, D)) * np.exp(-2j * OMEGA * DT_S)[:, None]
    error = np.abs(result.model.frequency_response(OMEGA)[:, 0] - truth) / np.abs(truth).max(axis=0)
    assert np.max(error) < 0.01


def test_one_motor_at_a_time_in_records_of_their_own():
    items = []
    for i in range(2):
        only = np.zeros((2000, 2))
        only[:, i] = record(i, n=2000).input[:, i]
        y = signal.dlsim((*sampled(), DT_S), only)[1] + 0.02 * np.random.default_rng(i).normal(size=(2000, 1))
        items.append(Record(only, y, DT_S, name=f"motor {i}", input_names=("a", "b"), output_names=("tip",)))
    result = identify_mimo(items, IdentOptions(n_real=1, n_pairs=2))
    np.testing.assert_allclose(result.model.poles.omega_rad_s(DT_S), [20.0, 90.0], rtol=2e-3)
    assert len(result.residuals) == 2


def test_initial_state_is_noticed():
    start = np.array([3.0, 2.0, 0.0, -1.0, 0.0])
    result = identify_mimo([record(0, start=start)], IdentOptions(n_real=1, n_pairs=2))
    assert result.structure.estimate_initial_state
    np.testing.assert_allclose(result.model.poles.omega_rad_s(DT_S), [20.0, 90.0], rtol=2e-3)


def test_a_model_is_locked_and_gives_its_channels(fitted):
    with pytest.raises(ValueError, match="read-only"):
        fitted.model.outputs[0].coefficients[0, 0] = 1.0
    assert fitted.model.outputs[0].channel(1).input_name == "motor_2"


def test_refused_records_and_models_are_named_by_column_and_kind():
    good = record(0, n=300)
    still = Record(good.input * [1, 0], good.output, DT_S, name="still", input_names=("a", "b"))
    with pytest.raises(ValueError, match=r"'still'.*'b'"):
        identify_mimo([still])
    with pytest.raises(ValueError, match="record"):
        identify_mimo([])
    with pytest.raises(ValueError, match="coefficients"):
        MisoModel(Poles(np.array([0.5])), np.ones((1, 1)), np.zeros(2), DT_S, ("a", "b"))
    with pytest.raises(ValueError, match="finite"):
        MisoModel(Poles(np.array([0.5])), np.array([[np.nan]]), np.zeros(1), DT_S, ("a",))


def covariances(records, result, omega):
    """(F, U, U) of the channels' errors, conj(e_u) e_v, for noise of one."""
    factor = matrix_posterior(records, result).at(omega).input_factor
    return factor.conj().swapaxes(1, 2) @ factor


def test_uncertainty_with_fixed_poles_is_that_of_linear_least_squares():
    item = record(0, n=800)
    omega, zeta = zip(*MODES, strict=True)
    poles = Poles.from_continuous(decay_per_s=[DECAY], omega_rad_s=omega, zeta=zeta, dt_s=DT_S)
    fixed = tuple((float(p.real), float(p.imag)) for p in [*poles.real.astype(complex), *poles.pairs])
    options = IdentOptions(
        fixed_poles=fixed, n_real=0, n_pairs=0, estimate_offset=False, estimate_initial_state=False
    )
    result = identify_mimo([item], options)
    functions = [MisoModel(poles, np.eye(5)[[j]], np.zeros(1), DT_S, ("u",)) for j in range(5)]
    phi = np.column_stack([one.simulate(u[:, None]) for u in item.input.T for one in functions])
    covariance = np.linalg.inv(phi.T @ phi).reshape(2, 5, 2, 5)
    basis = MisoModel(poles, np.eye(5), np.zeros(5), DT_S, tuple("abcde")).frequency_response(OMEGA)
    expected = np.einsum("fi,uivj,fj->fuv", basis.conj(), covariance, basis)
    np.testing.assert_allclose(covariances([item], result, OMEGA), expected, rtol=1e-6, atol=1e-12)


def test_uncertainty_is_that_of_all_unknowns_together():
    """Gauss-Newton covariance of poles and coefficients from finite differences of the simulation."""
    options = IdentOptions(
        integrators=1, input_delay_samples=1, feedthrough=True, n_real=1, n_pairs=1,
        estimate_offset=False, estimate_initial_state=False,
    )  # fmt: skip
    u = np.random.default_rng(2).normal(size=(400, 2))
    truth = MisoModel(
        Poles(np.array([0.0, 0.9]), np.array([0.8 + 0.5j])),
        np.random.default_rng(3).normal(size=(2, 4)), np.array([0.5, -0.3]), DT_S, ("a", "b"), "y", 1, 1,
    )  # fmt: skip
    y = truth.simulate(u) + 0.1 * np.random.default_rng(4).normal(size=400)
    item = Record(u, y[:, None], DT_S, name="test", input_names=("a", "b"))
    result = identify_mimo([item], options)
    (model,) = result.model.outputs

    def moved(x):
        poles = Poles(np.array([0.0, x[0]]), np.array([complex(x[1], x[2])]))
        return MisoModel(poles, x[3:11].reshape(2, 4), x[11:], DT_S, ("a", "b"), "y", 1, 1)

    pair = model.poles.pairs[0]
    best = np.concatenate(
        [[model.poles.real[1], pair.real, pair.imag], model.coefficients.ravel(), model.feedthrough]
    )
    omega = np.geomspace(1.0, 300.0, 12)
    of_output, of_response, step = [], [], 1e-6
    for direction in np.eye(best.size):
        up, down = moved(best + step * direction), moved(best - step * direction)
        of_output.append((up.simulate(u) - down.simulate(u))[1:] / (2 * step))
        of_response.append((up.frequency_response(omega) - down.frequency_response(omega)) / (2 * step))
    jacobian = np.array(of_output).T
    columns = np.array(of_response)
    expected = np.einsum("ifu,ij,jfv->fuv", columns.conj(), np.linalg.inv(jacobian.T @ jacobian), columns)
    scale = np.trace(expected, axis1=1, axis2=2).real[:, None, None]
    # The residual is orthogonal to the tangent space only to the tolerance of the descent; differences
    # carry 1e-9 or so.
    found = covariances([item], result, omega)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=1e-5)


def test_advice_on_alike_inputs_and_coloured_residuals():
    item = record(0, n=1000)
    nearly = np.column_stack([item.input[:, 0], item.input[:, 0] + 0.05 * item.input[:, 1]])
    y = signal.dlsim((*sampled(), DT_S), nearly)[1]
    noise = signal.lfilter(
        [1.0], [1.0, -0.97], 0.05 * np.random.default_rng(1).normal(size=(1000, 1)), axis=0
    )
    options = IdentOptions(n_real=1, n_pairs=2)
    result = identify_mimo(
        [Record(nearly, y + noise, DT_S, name="alike", input_names=("a", "b"), output_names=("tip",))],
        options,
    )
    assert {FindingKind.ALIKE_INPUTS, FindingKind.COLOURED_RESIDUAL} <= kinds(result.warnings)


def _bands(*inputs):
    """Of every finding: inputs, rank, lowest and highest frequency [rad/s]; 10 ms, an output beside it."""
    records = [
        Record(u, u[:, :1], 0.01, name="r", input_names=tuple(f"u{i}" for i in range(u.shape[1])))
        for u in inputs
    ]
    found = [item.values for item in alike_inputs(records)]
    return [(v["inputs"], v["rank"], v["low_rad_s"], v["high_rad_s"]) for v in found]


def _in_band(signal_, low_rad_s, high_rad_s):
    lines = np.fft.rfft(signal_, axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(len(signal_), 0.01)
    lines[(omega < low_rad_s) | (omega > high_rad_s)] = 0
    return np.fft.irfft(lines, len(signal_), axis=0)


@pytest.mark.parametrize("seed", range(3))
def test_dependent_inputs_are_named_with_their_band_and_rank(seed):
    a = np.random.default_rng(seed).normal(size=(4000, 3))
    alike = a[:, :2] - _in_band(a[:, :2], 20, 80) + _in_band(a[:, 2:], 20, 80) * [1.0, -3.0]
    ((names, rank, low, high),) = _bands(np.column_stack([alike, a[:, 2]])[:, :2])
    assert (names, rank) == ("['u0', 'u1']", 1)
    np.testing.assert_allclose([low, high], [20, 80], rtol=0.26)  # a third of an octave: lines are few there
    resting = np.column_stack([a[:, 0], _in_band(a[:, 1], 0, 40)])
    ((names, rank, low, high),) = _bands(resting)
    assert (names, rank) == ("['u1']", 1)
    np.testing.assert_allclose([low, high], [40, np.pi / 0.01], rtol=0.26)
    ((names, rank, *_),) = _bands(np.column_stack([a, a[:, 0] + a[:, 2]]))
    assert (names, rank) == ("['u0', 'u2', 'u3']", 3)
    late = np.column_stack([a[:, 0], np.roll(a[:, 0], 7)])  # independent as whole records are
    assert _bands(late)[0][:2] == ("['u0', 'u1']", 1)


@pytest.mark.parametrize("seed", range(5))
def test_independent_inputs_are_not_called_alike(seed):
    rng = np.random.default_rng(seed)
    for n, count in ((60, 2), (400, 7), (3000, 3)):
        white = rng.normal(size=(n, count))
        assert not _bands(white)
        assert not _bands(np.cumsum(white, axis=0))
        assert not _bands(np.tile(white, (6, 1)))  # a period: every line of it has rank one
    one = rng.normal(size=(500, 1))
    assert not _bands(one * [1.0, 0.0], one * [0.0, 1.0])


@pytest.mark.slow
def test_two_link_example(tmp_path):
    from examples import two_link_arm  # here: it draws

    result, truth, bands = two_link_arm.run(n_samples=3000)
    # One integrator (its pole at z = 0 is counted), two real poles and the modes.
    assert result.model.poles.real.size == 3
    found = result.model.poles.omega_rad_s(two_link_arm.DT_S)
    np.testing.assert_allclose(found[:2], [132.19, 141.42], rtol=0.01)
    low = two_link_arm.OMEGA <= 200
    error = np.abs(result.model.frequency_response(two_link_arm.OMEGA)[:, 0] / truth - 1)[low]
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < [0.03, 0.01])
    picture = tmp_path / "bode.png"
    two_link_arm.figure(result, truth, bands).savefig(picture)
    assert picture.stat().st_size > 10_000
