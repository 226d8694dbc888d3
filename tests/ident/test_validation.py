"""Fresh-data fit and repeat scatter on systems whose answer is known."""

import numpy as np
import pytest

from ident import GobfModel, Poles, Record
from ident.basis.posterior import ResponsePosterior
from ident.checks.validation import fit_on_fresh_data, repeat_scatter
from ident.data.frequency_uncertainty import FrequencyUncertainty
from tests.ident.benchmark_plants import as_record

DT = 0.01
OMEGA = np.linspace(1.0, 100.0, 60)


def model(integrators=0):
    return GobfModel(Poles([0.9], [0.95 * np.exp(0.3j)]), [1.0, -0.4, 0.7], DT, integrators=integrators)


@pytest.mark.parametrize("integrators", [0, 1, 2])
def test_true_model_fits_fully_whatever_the_initial_state(integrators):
    m = model(integrators)
    u = np.random.default_rng(0).standard_normal(900)
    y = m.simulate(u) + 3.0
    middle = as_record(u[400:], y[400:], dt_s=DT)
    fit = fit_on_fresh_data(m, middle)
    assert fit.fit_percent > 99.9999
    rest, motion = ((part - part.mean()) for part in (y[400:] - m.simulate(u[400:]), y[400:]))
    assert np.linalg.norm(rest) > 1e-3 * np.linalg.norm(motion)  # of the start
    np.testing.assert_allclose(
        fit.simulated + fit.residual, middle.output[:, 0], atol=1e-12 * np.abs(y).max()
    )


def test_fit_percent_of_pure_noise_on_top():
    m = model()
    rng = np.random.default_rng(1)
    u = rng.standard_normal(20_000)
    clean = m.simulate(u)
    noise = 0.1 * np.std(clean) * rng.standard_normal(u.size)
    fit = fit_on_fresh_data(m, as_record(u, clean + noise, dt_s=DT))
    assert fit.fit_percent == pytest.approx(100 * (1 - 0.1 / np.sqrt(1.01)), abs=0.2)


def test_fresh_fit_refuses_what_it_cannot_judge():
    u = np.random.default_rng(2).standard_normal(100)
    with pytest.raises(ValueError, match="dt_s"):
        fit_on_fresh_data(model(), as_record(u, u, dt_s=2 * DT))
    with pytest.raises(ValueError, match="constant"):
        fit_on_fresh_data(model(), as_record(u, np.ones(100), dt_s=DT))
    two = Record(np.zeros((9, 2)), np.zeros((9, 1)), DT, name="w", input_names=("a", "b"))
    with pytest.raises(ValueError, match="one input"):
        fit_on_fresh_data(model(), two)


def estimate(rng, centre, sd):
    noise = sd * (rng.standard_normal(OMEGA.size) + 1j * rng.standard_normal(OMEGA.size))
    covariance = np.broadcast_to(sd**2 * np.eye(2), (OMEGA.size, 2, 2))
    return FrequencyUncertainty(OMEGA, centre + noise, covariance, DT)


def test_repeat_scatter_ratio_is_one_for_honest_bounds_and_shows_dishonest_ones():
    rng = np.random.default_rng(4)
    honest = [[estimate(rng, g, 0.01) for _ in range(3)] for g in (1.0, 1.1)]
    rows = repeat_scatter(honest, [(0, 50), (50, 101), (200, 300)])
    assert len(rows) == 2
    for row in rows:
        # 30 frequencies x 4 complex degrees of freedom: relative sd of an RMS 1 / sqrt(4 x 30 x 2) = 0.065
        assert row.ratio == pytest.approx(1.0, abs=0.26)
        # |1.1 - 1| / sqrt 2, relative to 1.05, noise 0.01 sqrt(2 / 3)
        assert row.between == pytest.approx(0.1 / np.sqrt(2) / 1.05, abs=0.01)
        assert row.between_ratio > 5
    narrow = [
        [FrequencyUncertainty(OMEGA, e.centre, e.covariance / 9, DT) for e in group] for group in honest
    ]
    assert repeat_scatter(narrow, [(0, 101)])[0].ratio == pytest.approx(3.0, abs=0.6)
    alone = repeat_scatter(honest[:1], [(0, 101)])[0]
    assert np.isnan(alone.between)
    with pytest.raises(ValueError, match="at least two repeats"):
        repeat_scatter([honest[0][:1]], [(0, 101)])
    # 30 frequencies, circular errors, 6 repeats in 2 groups: 2 x 30 x 4.
    assert rows[0].degrees_of_freedom == pytest.approx(240, rel=1e-3)


def test_interval_of_the_scatter_ratio_holds_for_few_repeats_of_a_smooth_response():
    poles = Poles.from_continuous(decay_per_s=[5.0], omega_rad_s=[30.0], zeta=[0.05], dt_s=DT)
    rng = np.random.default_rng(7)
    posterior = ResponsePosterior(poles, np.ones(3), 0.02 * rng.standard_normal((3, 3)), DT)
    at = posterior.at(OMEGA)
    inside = []
    for _ in range(400):
        draws = posterior.response_of(posterior.sample(rng, 3), OMEGA)
        repeats = [FrequencyUncertainty(OMEGA, g, at.covariance, DT) for g in draws]
        row = repeat_scatter([repeats], [(0, 101)], posterior=posterior)[0]
        inside.append(row.ratio_low <= row.ratio <= row.ratio_high)
        # Three coefficients, two degrees of freedom between repeats: not the 2 x 2 x 60 of loose frequencies.
        assert 2 <= row.degrees_of_freedom <= 6
    # Chi-square with matched mean and variance: exact for equal eigenvalues only, hence 3 % beside the 1.1 %
    # of 400 trials.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.035)
