"""The rebuilt machines, the yardsticks, the usual starts and the counting, each against known truth."""

import numpy as np
import pytest
import scipy.signal

from ident import ErrorSurface, Record
from ident.comparators.prediction_error import arx_polynomials
from validation.example_arms import paper_example
from validation.paper import surface as paper
from validation.paper.bounds import coverage_of
from validation.paper.experiments import frequencies
from validation.paper.machines import NOISE_STD, SNR_DB, LinkExperiment, SimulationExample
from validation.paper.methods import fit_percent, is_mode, score
from validation.paper.settings import DT_S, PaperSettings
from validation.paper.usual_starts import instrumental_variables, usual_oe


def test_simulation_example_is_the_printed_plant():
    """Held input by another discretisation; zeros and poles are in test_example_arms."""
    plant = paper_example()
    numerator, denominator, _ = scipy.signal.cont2discrete(
        (plant.num[0][0], plant.den[0][0]), DT_S, method="zoh"
    )
    omega = np.geomspace(1.0, 100.0, 50)
    _, expected = scipy.signal.freqz(numerator[0], denominator, worN=omega * DT_S)
    # Expanded polynomials with two roots at 1 lose digits there: 1e-6 is what is left at 1 rad/s.
    np.testing.assert_allclose(SimulationExample().response(omega), expected, rtol=1e-6)


def test_simulation_records_have_the_printed_noise():
    machine = SimulationExample()
    trial = machine.trial(np.random.default_rng(3))
    assert trial.fitted.n_samples == 1000
    clean = machine.output(trial.fitted.input[:, 0])
    assert 20 * np.log10(np.std(clean) / NOISE_STD) == pytest.approx(SNR_DB, abs=1e-6)
    noise = trial.fitted.output[:, 0] - clean
    assert np.std(noise) == pytest.approx(NOISE_STD, rel=0.1)  # 1000 samples: 2.2 % standard error
    np.testing.assert_array_equal(np.unique(np.abs(trial.fresh.input)), np.unique(np.abs(trial.fitted.input)))


def test_arm_without_friction_is_its_linear_response():
    """The simulated arm run by run against its own frequency response, through the transform of a pulse."""
    machine = LinkExperiment(friction=False)
    trial = machine.trial(np.random.default_rng(0))
    u, y = trial.fresh.input[:, 0], trial.fresh_clean
    # A linear machine: output of u is the sum of shifted pulse responses, pulse = derivative of the step.
    omega = np.pi / DT_S * (np.arange(4096) + 0.5) / 4096
    damped = np.exp(-3.0 * DT_S)  # weights e^{-3 t} make the integrator's response summable
    z = np.exp(1j * omega * DT_S) / damped
    pulse_spectrum = _response_at(machine, z)
    k = np.arange(u.size)
    # Inverse transform on the circle of radius 1/damped.
    pulse = np.real(np.exp(1j * np.outer(k, omega * DT_S)) @ pulse_spectrum) / 4096 * damped ** (-k)
    np.testing.assert_allclose(np.convolve(u, pulse)[: u.size], y, atol=2e-6 * np.ptp(y) + 1e-9)


def _response_at(machine: LinkExperiment, z):
    system = machine.system
    n = system.A.shape[0]
    return np.array(
        [(system.C[1] @ np.linalg.solve(value * np.eye(n) - system.A, system.B[:, 0])) for value in z]
    )


def test_friction_makes_the_arm_nonlinear():
    """Not twice the output for twice the input."""
    from plant import simulate

    machine = LinkExperiment()
    u = machine.trial(np.random.default_rng(0)).fitted.input[:, 0]
    one, two = (simulate(machine.rig, factor * u, machine.effects).tip_true_m for factor in (1.0, 2.0))
    assert np.linalg.norm(two - 2 * one) > 0.02 * np.linalg.norm(two)


class _Truth:
    """The machine's own response as a model, as far as the yardsticks look at it."""

    def __init__(self, machine, poles):
        self._machine, self.poles = machine, poles

    def frequency_response(self, omega_rad_s):
        return self._machine.response(omega_rad_s)

    def simulate(self, u):
        return self._machine.output(u)


def test_the_truth_scores_fully():
    machine = SimulationExample()
    trial = machine.trial(np.random.default_rng(1))
    poles = np.exp(paper_example().poles() * DT_S)
    marks = score(machine, trial, _Truth(machine, poles), frequencies())
    assert marks.response_error == pytest.approx(0, abs=1e-12)
    assert marks.mode_found
    assert marks.mode == pytest.approx(machine.mode, rel=1e-6)
    # 30 dB on the fitted record, about as much on the fresh one: 3 % of its spread are noise.
    assert 90 < marks.fit_percent < 100


def test_yardsticks_at_their_limits():
    assert is_mode((16.4, 0.02), (15.0, 0.02))
    assert not is_mode((16.6, 0.02), (15.0, 0.02))
    assert not is_mode((15.0, 0.041), (15.0, 0.02))
    assert not is_mode((15.0, -0.02), (15.0, 0.02))  # an unstable pair is not the mode
    y = np.array([1.0, -1.0, 2.0])
    assert fit_percent(y, y) == 100
    assert fit_percent(y, np.full(3, y.mean())) == pytest.approx(0)
    assert fit_percent(y, np.array([0.0, np.inf, np.nan])) == -np.inf


def _driven(noise_std: float, n: int = 4000):
    rng = np.random.default_rng(5)
    a, b = np.array([1.0, -1.5, 0.7]), np.array([0.5, 0.3])
    u = np.where(rng.random(n) < 0.5, -1.0, 1.0)
    return a, b, u, scipy.signal.lfilter(b, a, u) + noise_std * rng.standard_normal(n)


def test_instrumental_variables_are_exact_without_noise_and_unbiased_with():
    a, b, u, y = _driven(0.0)
    found_a, found_b = instrumental_variables(u, y, 2, 2)
    np.testing.assert_allclose(found_a, a, atol=1e-9)
    np.testing.assert_allclose(found_b, b, atol=1e-9)
    _, _, u, y = _driven(1.0)
    by_arx, _ = arx_polynomials(u, y, 2, 2)
    by_instruments, _ = instrumental_variables(u, y, 2, 2)
    # White output noise biases ARX however long the record; the instruments do not see the noise.
    assert np.linalg.norm(by_arx - a) > 0.3
    assert np.linalg.norm(by_instruments - a) < 0.05


def test_output_error_from_usual_starts_finds_a_well_damped_plant():
    a, b, u, y = _driven(0.3)
    delayed = np.concatenate([[0.0], y[:-1]])  # the record's own delay of one sample
    record = Record(u[:, None], delayed[:, None], DT_S, name="driven")
    model = usual_oe(record, 2, 2)
    np.testing.assert_allclose(model.f, a, atol=0.02)
    np.testing.assert_allclose(model.b, b, atol=0.05)


def test_resonance_lies_in_the_paper_s_window():
    pole = paper.true_pair().pairs[0]
    gamma = abs(pole) ** 2
    assert 0.98 < 2 * pole.real / (1 + gamma) < 1
    assert 0.9988 < gamma < 1
    record = paper.resonant_record(np.random.default_rng(0))
    assert np.var(record.output) == pytest.approx(0.04, rel=0.01)


def test_minima_inside_are_counted_apart_from_the_border():
    """cos has its minima at odd multiples of pi; a tilt across them moves them all to one border."""
    x, y = np.linspace(0, 6 * np.pi, 121), np.linspace(-1, 1, 21)
    bowl = np.cos(x)[:, None] + y[None, :] ** 2
    valley = np.cos(x)[:, None] + y[None, :]

    def surface(values):
        return ErrorSurface(x, y, ("a", "b"), values, (0.0, 0.0))

    assert paper._count(surface(bowl)) == paper.MinimaCount(121, 3, 0)
    assert paper._count(surface(valley)) == paper.MinimaCount(121, 0, 3)
    ((at, along),) = paper.slices(surface(valley), [-0.99])
    assert at == -1
    assert paper.minima_along(along) == 3


def test_shares_are_over_all_variants():
    hits = {("order 2", "raw", "A"): 4, ("order 2", "raw", "B"): 1, ("order 4", "raw", "A"): 0}
    shares = paper.SearchShares(5, 500, hits)
    assert shares.share_percent("order 2", "raw") == 50
    assert shares.share_percent("order 4", "raw") == 0


@pytest.mark.slow
def test_tangent_bounds_hold_the_linear_arm_and_the_classical_do_not():
    """Twenty records of the arm without friction: mean coverage of a calibrated bound is 86.5 %.

    Frequencies of one record hang together, so the mean of 20 moves by about 5 points; measured 95 and 68.
    """
    settings = PaperSettings(repeats=20)
    omega = np.geomspace(1, 100, 60)
    rows = coverage_of(LinkExperiment(friction=False), omega, settings, lambda *_: None)
    by_recipe = {row.recipe: row.inside_percent for row in rows}
    assert by_recipe["tangent"] > 75
    assert by_recipe["classical"] < by_recipe["tangent"]
