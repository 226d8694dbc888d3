"""Nominal model from a posterior: recovers a model in its span, weighs frequencies by the ellipses."""

import numpy as np
import pytest

from ident import GobfModel, Poles, basis_response
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import real_rows
from ident.uncertainty.nominal import nominal_near, nominals_near

DT = 0.01
OMEGA = np.geomspace(0.5, 200.0, 60)
POLES = Poles([0.95], [0.9 * np.exp(0.5j)])


@pytest.mark.parametrize(("integrators", "delay", "direct"), [(0, 0, False), (1, 2, True)])
def test_a_model_in_the_span_is_recovered(integrators, delay, direct):
    rng = np.random.default_rng(0)
    size = 6 + direct + 3
    mean = np.zeros(size)
    mean[:6] = rng.standard_normal(6)
    mean[6] = 0.3 if direct else 0.0
    posterior = ResponsePosterior(
        POLES.doubled(), mean, 0.1 * rng.standard_normal((size, size)), DT, 3, direct, integrators, delay
    )
    model = nominal_near(posterior, POLES.doubled(), OMEGA)
    np.testing.assert_allclose(model.coefficients, mean[:6], atol=1e-9)
    assert model.feedthrough == pytest.approx(mean[6] if direct else 0.0, abs=1e-9)
    np.testing.assert_allclose(model.frequency_response(OMEGA), posterior.centre(OMEGA), rtol=1e-8)


def test_low_order_model_goes_where_the_ellipses_are_small():
    # Two coefficient directions known badly: the nominal may leave the mean there and nowhere else.
    rng = np.random.default_rng(1)
    true = GobfModel(POLES, [1.0, 0.5, -0.3], DT)
    doubled = POLES.doubled()
    wide = np.zeros((6, 2))
    wide[:, 0] = rng.standard_normal(6)
    exact = nominal_near(ResponsePosterior(doubled, np.zeros(6), np.eye(6), DT), doubled, OMEGA)
    assert np.all(np.abs(exact.coefficients) < 1e-12)
    z = np.exp(1j * OMEGA * DT)
    # The true model in the doubled basis, plus an error of three standard deviations in the wide direction.
    big = basis_response(doubled, z)
    target = true.frequency_response(OMEGA)
    coefficients = np.linalg.lstsq(real_rows(big), real_rows(target))[0]
    posterior = ResponsePosterior(
        doubled, coefficients + 3 * wide[:, 0], np.hstack([wide, 1e-3 * np.eye(6)]), DT
    )
    model = nominal_near(posterior, POLES, OMEGA)
    weighted = posterior.at(OMEGA).normalised_distance(model.frequency_response(OMEGA))
    plain = np.linalg.lstsq(real_rows(basis_response(POLES, z)), real_rows(posterior.centre(OMEGA)))[0]
    unweighted = posterior.at(OMEGA).normalised_distance(
        GobfModel(POLES, plain, DT).frequency_response(OMEGA)
    )
    assert np.mean(weighted**2) < np.mean(unweighted**2)


def test_too_few_frequencies_are_refused():
    posterior = ResponsePosterior(POLES, np.zeros(3), np.eye(3), DT)
    with pytest.raises(ValueError, match=r"2 frequencies .* 6"):
        nominal_near(posterior, POLES.doubled(), OMEGA[:2])


@pytest.mark.parametrize("integrators", [0, 1])
def test_the_nominal_follows_poles_that_the_posterior_moved_and_a_mode_it_adds(integrators):
    """A real pole three times as fast as the one given, and a mode that nobody gave."""
    given = Poles([0.0] * integrators + [0.99], [0.9 * np.exp(0.5j)])
    own = Poles([0.0] * integrators + [0.97], [0.9 * np.exp(0.5j), 0.98 * np.exp(1.5j)])
    true = GobfModel(own, [1.0] * integrators + [1.0, 0.5, -0.3, 0.1, 0.05], DT, integrators=integrators)
    posterior = ResponsePosterior(
        own, true.coefficients, 1e-3 * np.eye(own.order), DT, integrators=integrators
    )
    models, ellipses = list(nominals_near(posterior, given, OMEGA)), posterior.at(OMEGA)
    inside = [np.mean(ellipses.contains(model.frequency_response(OMEGA))) for model in models]
    extra = [model.poles.order - given.order for model in models]
    assert extra == [0, 0, given.order, *range(2, given.order + 3, 2)]
    assert max(inside[:3]) < 0.9 < inside[3] == 1


def test_an_unstable_pole_stays_in_its_own_digits():
    """The mirror image of an unstable pole, whose inverse of the inverse is another number."""
    image = next(a for a in np.linspace(0.9, 0.95, 99) if 1 / (1 / a) != a)
    given, off = Poles([image, 0.7], [0.9 * np.exp(0.5j)]), Poles([image])
    posterior = ResponsePosterior(given.doubled(), np.ones(9), 1e-3 * np.eye(9), DT, unstable=off)
    assert sum(image in model.poles.real for model in nominals_near(posterior, given, OMEGA)) > 3


def test_a_rate_that_the_data_move_brings_no_zero_below_them():
    """An axis 1 / (s (s + .3)) about a rate of .1, known above 1 rad/s. With that pole taken twice the
    nominal stays in its ellipses, too, but has a zero outside the circle below the data, where nothing
    contradicts it and which no loop could track beyond."""
    given = Poles([0.0, np.exp(-0.1 * DT)], [])
    own = given.doubled().appended(Poles([np.exp(-0.3 * DT)]))
    z = np.exp(1j * OMEGA * DT)
    # Sampled with a hold, by partial fractions, 1 / s and 1 / (s + .3).
    lag = -np.expm1(-0.3 * DT)
    axis = DT / (z - 1) - lag / (z - 1 + lag) / 0.3
    empty = ResponsePosterior(own, np.zeros(own.order), np.eye(own.order), DT, integrators=1)
    known = np.where(OMEGA > 1, OMEGA**2, 0.0)[:, None]
    rows = real_rows(empty.frequency_rows(OMEGA) * known)
    mean = np.linalg.lstsq(rows, real_rows(axis[:, None] * known))[0][:, 0]
    posterior = ResponsePosterior(own, mean, 0.03 * np.linalg.pinv(rows), DT, integrators=1)
    ellipses = posterior.at(OMEGA)

    def inside(model):
        return np.mean(ellipses.contains(model.frequency_response(OMEGA)))

    def zeros_outside(model):
        """Real zeros slower than 3 rad/s, by changes of sign of the response there."""
        a, b, c, d = model.state_space()
        outside = np.exp(np.geomspace(1e-3, 3.0, 200) * DT)
        values = [(c @ np.linalg.solve(at * np.eye(len(a)) - a, b) + d)[0, 0] for at in outside]
        return np.count_nonzero(np.diff(np.sign(values)))

    candidates = nominals_near(posterior, given, OMEGA)
    first, moved, doubled = (next(candidates) for _ in range(3))
    assert inside(first) < 0.9
    assert inside(moved) > 0.9
    assert inside(doubled) > 0.9
    assert zeros_outside(moved) == 0
    assert zeros_outside(doubled) == 1
