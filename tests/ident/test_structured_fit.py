"""Fit and descent under a relative degree: difference quotients, SciPy's optimiser, known truths."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal

from ident import IdentOptions, Poles, Structure
from ident.fit.least_squares import fit
from ident.fit.refinement import Bounds, pole_system
from ident.fit.regression import prepare
from ident.fit.structured_fit import UnderRelativeDegree, structured_fit
from tests.ident.benchmark_plants import DT_S, by_factors, p1, p1_friction, p2

OMEGA = np.geomspace(0.1, 600, 400)
BOUNDS = Bounds.from_options(IdentOptions(), 1000, DT_S)


def moved(poles, n_fixed_real, n_fixed_pairs, index, step):
    """The poles with one free unknown changed: 1 - a of real poles, then (s, f) of each pair."""
    real, log = poles.real.copy(), np.log(poles.pairs)
    n_real = real.size - n_fixed_real
    if index < n_real:
        real[n_fixed_real + index] -= step
    else:
        pair, which = divmod(index - n_real, 2)
        log[n_fixed_pairs + pair] += 1j * step if which else -step
    return Poles(real, np.exp(log))


MODE, UNKNOWN = 0.99 * np.exp(0.08j), {"estimate_offset": True, "estimate_initial_state": True}
LATE = Structure(integrators=1, estimate_initial_state=True, input_delay_samples=2)
# Structure, poles, how many of the real ones and of the pairs are fixed.
CASES = {
    "from rest": (Structure(), Poles([0.998, 0.9], [MODE]), 0, 0),
    "offset, initial state": (Structure(**UNKNOWN), Poles([0.998, 0.9], [MODE]), 0, 0),
    "integrators, a fixed pole": (Structure(integrators=2), Poles([0.0, 0.0, 0.95, 0.8], [MODE]), 3, 0),
    "a fixed pair": (LATE, Poles([0.0, 0.99], [0.98 * np.exp(0.2j), MODE]), 1, 1),
}


@pytest.mark.parametrize("relative_degree", [1, 2, 3])
@pytest.mark.parametrize("case", CASES)
def test_gradient_is_exact(case, relative_degree):
    """-2 S^T r against central differences of J, two records."""
    structure, poles, n_fixed_real, n_fixed_pairs = CASES[case]
    data = prepare([p1(0, 400).record, p1_friction(1, 300).record], structure)
    fixed = Poles(poles.real[:n_fixed_real], poles.pairs[:n_fixed_pairs])
    here = UnderRelativeDegree(data, relative_degree, fixed).linearise(*poles.writable())
    gradient = -2 * pole_system(here, poles, fixed)[1]
    free = np.concatenate(
        [1 - poles.real[n_fixed_real:], np.abs(np.log(poles.pairs[n_fixed_pairs:])).repeat(2)]
    )
    assert gradient.shape == free.shape
    for i, size in enumerate(free):
        step = 1e-4 * size
        above, below = (
            structured_fit(
                data, moved(poles, n_fixed_real, n_fixed_pairs, i, sign * step), relative_degree
            ).rss
            for sign in (1, -1)
        )
        # Error of the quotient: step^2 times the third derivative; at most 7e-7 relative measured.
        np.testing.assert_allclose(gradient[i], (above - below) / (2 * step), rtol=1e-5)


def test_fit_is_the_least_squares_fit_over_sampled_plants_of_that_relative_degree():
    """Continuous-time numerators of limited degree, sampled by SciPy one by one, span the same outputs."""
    denominator, poles = by_factors([3.0], [(15.0, 0.015), (90.0, 0.02)], 1)
    record = p1(0).record
    data = prepare([record], Structure(integrators=1))
    for relative_degree in (2, 3, 5):
        columns = []
        for degree in range(denominator.size - relative_degree):
            numerator = np.eye(1, degree + 1)[0] * 15.0**-degree
            A, B, C, D, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(numerator, denominator), DT_S)
            columns.append(scipy.signal.dlsim((A, B, C, D, DT_S), record.input)[1][:, 0])
        columns = np.array(columns).T / np.linalg.norm(columns, axis=1)
        y = record.output[:, 0]
        residual = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
        found = structured_fit(data, poles, relative_degree)
        assert found.rss == pytest.approx(residual @ residual, rel=1e-9)
        np.testing.assert_allclose(found.residual, residual, atol=1e-7 * np.linalg.norm(y))


def test_relative_degree_one_is_the_plain_fit():
    data = prepare([p2(0, 500).record], Structure(estimate_offset=True, estimate_initial_state=True))
    poles = Poles([0.99, -0.3], [0.98 * np.exp(0.1j)])
    plain, structured = fit(data, poles), structured_fit(data, poles, 1)
    assert structured.rss == pytest.approx(plain.rss, rel=1e-12)
    np.testing.assert_allclose(structured.coefficients, plain.coefficients, rtol=1e-8)


def test_descent_ends_where_scipys_optimiser_does():
    """P1 as five numbers of a continuous-time plant, simulated and optimised by SciPy from the truth."""
    truth = p1(3)
    record = truth.record

    def residual(x):
        b2, b1, b0, d1, d0 = x * [1e-2, 1e-2, 1.0, 0.45, 225.0]
        A = np.eye(4, k=1)
        A[3] = [0, 0, -d0, -d1]
        system = A, np.eye(4)[:, 3:], np.array([[b0, b1, b2, 0]]), np.zeros((1, 1))
        sampled = scipy.signal.cont2discrete(system, DT_S)[:4]
        return record.output[:, 0] - scipy.signal.dlsim((*sampled, DT_S), record.input)[1][:, 0]

    # The numerator enters linearly: begin at its best for the true mode.
    base = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    plain = residual(base)
    columns = np.array([plain - residual(base + unit) for unit in np.eye(5)[:3]]).T
    base[:3] = np.linalg.lstsq(columns, plain, rcond=None)[0]
    reference = scipy.optimize.least_squares(
        residual, base, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    data = prepare([record], Structure(integrators=2))
    problem = UnderRelativeDegree(data, 2, Poles([0.0, 0.0]))
    end = problem.refine(Poles([0.0, 0.0], [0.97 * np.exp(0.09j)]), BOUNDS)
    assert end.converged
    assert end.rss == pytest.approx(2 * reference.cost, rel=1e-7)
    assert end.poles.omega_rad_s(DT_S)[0] == pytest.approx(np.sqrt(225 * reference.x[4]), rel=1e-5)
    assert problem.optimality(end.poles, BOUNDS) < 1e-4
    assert problem.optimality(Poles([0.0, 0.0], [0.99 * np.exp(0.08j)]), BOUNDS) > 0.1


def test_descent_keeps_its_bounds_and_fixed_poles():
    truth = p1(1)
    data = prepare([truth.record], Structure())
    bounds = Bounds.from_options(
        IdentOptions(omega_min_rad_s=20.0, zeta_max=0.3, decay_min_per_s=0.5), 1000, DT_S
    )
    end = UnderRelativeDegree(data, 2, Poles([0.999])).refine(
        Poles([0.999, -0.4], [0.9 * np.exp(0.2j)]), bounds
    )
    assert end.poles.real[0] == 0.999
    assert 0.01 * (1 - 1e-9) <= end.poles.real[1] <= np.exp(-0.5 * DT_S) * (1 + 1e-12)
    assert end.poles.omega_rad_s(DT_S)[0] >= 20 * (1 - 1e-9)
    assert end.poles.zeta()[0] <= 0.3 * (1 + 1e-9)
    problem = UnderRelativeDegree(data, 2, end.poles)
    everything_fixed = problem.refine(end.poles, bounds)
    np.testing.assert_array_equal(everything_fixed.poles.values, end.poles.values)
    assert everything_fixed.rss == pytest.approx(end.rss)
    assert problem.optimality(end.poles, bounds) == 0


def test_what_cannot_be_fitted_is_refused():
    record = p1(0, 8).record
    with pytest.raises(ValueError, match="8 for 9"):
        structured_fit(
            prepare([record], Structure(estimate_offset=True)), Poles([0.9, 0.8, 0.7, 0.6, 0.5]), 3
        )
    data = prepare([p1(0).record], Structure(feedthrough=True))
    with pytest.raises(ValueError, match="feedthrough = false"):
        structured_fit(data, Poles([0.9, 0.8]), 2)
