"""The reduced formulas against the same model written out with N x N matrices."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.stats import multivariate_normal

from ident.uncertainty.embedding_algebra import (
    Delays,
    RegressionBlock,
    conditional_posterior,
    evaluate_grid,
    exponential_factor,
    grid_weights,
    joint_factor,
    kernel_spectrum,
    nuisance_basis,
    pieces,
    reduce_regression,
    symmetric_factor,
    tc_factor,
)
from validation.paper.classical import prior_posterior

N, P, L = 90, 4, 12


def problem(seed, n_records=2):
    rng = np.random.default_rng(seed)
    blocks = []
    for _ in range(n_records):
        u = rng.standard_normal(N)
        kernel = toeplitz(np.concatenate([[0.0], u[:-1]]), np.zeros(L))
        regressors = np.cumsum(rng.standard_normal((N, P)), axis=0) * [1.0, 1e-3, 50.0, 1.0]
        nuisance = np.column_stack([np.ones(N), 0.9 ** np.arange(N), 2 * 0.9 ** np.arange(N)])  # rank 2
        blocks.append(RegressionBlock(nuisance, regressors, kernel, rng.standard_normal(N)))
    return blocks


def stacked(blocks):
    nuisance = np.zeros((N * len(blocks), 2 * len(blocks)))
    for i, block in enumerate(blocks):
        nuisance[i * N : (i + 1) * N, 2 * i : 2 * i + 2] = block.nuisance[:, :2]
    return (
        nuisance,
        np.vstack([b.regressors for b in blocks]),
        np.vstack([b.kernel for b in blocks]),
        np.concatenate([b.output for b in blocks]),
    )


def dense_posterior(flat, kernel, y, covariance, s2):
    """Textbook Gaussian formulas: flat coefficients by generalised least squares, eta by conditioning."""
    sigma = kernel @ covariance @ kernel.T + s2 * np.eye(y.size)
    weight = np.linalg.inv(sigma)
    root = np.linalg.cholesky(weight).T
    pseudo = np.linalg.pinv(root @ flat)
    cov_flat, estimate = pseudo @ pseudo.T, pseudo @ root @ y
    gain = covariance @ kernel.T @ weight
    eta = gain @ (y - flat @ estimate)
    cov_eta = covariance - gain @ kernel @ covariance + gain @ flat @ cov_flat @ flat.T @ gain.T
    cross = -gain @ flat @ cov_flat
    return np.concatenate([estimate, eta]), np.block([[cov_flat, cross.T], [cross, cov_eta]]), sigma


@pytest.mark.parametrize("shape", [tc_factor, exponential_factor])
@pytest.mark.parametrize("lam", [0.8, 0.01])  # the second dies out before the last tap
def test_reduced_posterior_and_likelihood_equal_the_dense_ones(shape, lam):
    blocks = problem(1)
    reduced = reduce_regression(blocks)
    alpha = 0.37
    spectrum = kernel_spectrum(reduced, lam, shape(lam, L))
    assert (spectrum.singular.size < L) == (lam == 0.01)
    grid = evaluate_grid(reduced, [spectrum], np.array([alpha * np.sum(spectrum.singular**2)]), np.ones(1))
    posterior = conditional_posterior(grid, np.ones((1, 1)), 0.0)
    mean, factor = joint_factor(reduced, posterior)

    nuisance, regressors, kernel, y = stacked(blocks)
    flat = np.hstack([nuisance, regressors])
    assert reduced.n_rows == y.size - nuisance.shape[1]
    ct = alpha * shape(lam, L) @ shape(lam, L).T
    s2 = posterior.noise_variance
    dense_mean, dense_cov, sigma = dense_posterior(flat, kernel, y, s2 * ct, s2)
    kept = slice(nuisance.shape[1], None)
    scale = np.sqrt(np.diag(dense_cov)[kept])
    # Taps whose prior has died out are left out: their standard deviations are compared with the others'.
    scale[P:] = np.maximum(scale[P:], 1e-3 * scale[P:].max())
    np.testing.assert_allclose((mean - dense_mean[kept]) / scale, 0, atol=1e-9)
    np.testing.assert_allclose(
        (factor @ factor.T - dense_cov[kept, kept]) / np.outer(scale, scale), 0, atol=1e-9
    )

    # Restricted likelihood = likelihood of contrasts orthogonal to all flat columns, maximal over s2.
    orthogonal = np.linalg.svd(flat)[0][:, flat.shape[1] :]
    contrast, spread = orthogonal.T @ y, orthogonal.T @ sigma @ orthogonal
    nu = contrast.size
    assert s2 == pytest.approx(contrast @ np.linalg.solve(spread / s2, contrast) / nu, rel=1e-10)
    dense = multivariate_normal(cov=spread).logpdf(contrast)
    free = multivariate_normal(cov=np.eye(nu) * grid.noise_variance_none).logpdf(contrast)
    difference = grid.log_likelihood[0, 0] - grid.log_likelihood_none
    assert difference == pytest.approx(dense - free, abs=1e-9)


def test_averaging_two_kernels_gives_the_moments_of_the_mixture():
    reduced = reduce_regression(problem(3))
    spectra = [kernel_spectrum(reduced, lam, tc_factor(lam, L)) for lam in (0.5, 0.9)]
    grid = evaluate_grid(reduced, spectra, np.array([1.0, 100.0]), np.array([0.7, 0.3]))
    weights, none = grid_weights(grid, 0.5)
    assert weights.sum() + none == pytest.approx(1.0, rel=1e-12)
    mixed = conditional_posterior(grid, weights, none)
    mean, second = np.zeros(L), np.zeros((L, L))
    for k in range(2):
        for a in range(2):
            pick = np.zeros((2, 2))
            pick[k, a] = 1.0
            one = conditional_posterior(grid, pick, 0.0)
            mean += weights[k, a] * one.kernel_mean
            covariance = one.kernel_factor @ one.kernel_factor.T
            second += weights[k, a] * (covariance + np.outer(one.kernel_mean, one.kernel_mean))
    np.testing.assert_allclose(mixed.kernel_mean, mean, atol=1e-12)
    covariance = second - np.outer(mean, mean)
    np.testing.assert_allclose(
        mixed.kernel_factor @ mixed.kernel_factor.T, covariance, atol=1e-12 * np.abs(covariance).max()
    )


def test_all_weight_on_no_remainder_is_ordinary_least_squares():
    blocks = problem(4)
    reduced = reduce_regression(blocks)
    grid = evaluate_grid(reduced, [kernel_spectrum(reduced, 0.8, tc_factor(0.8, L))], np.ones(1), np.ones(1))
    mean, factor = joint_factor(reduced, conditional_posterior(grid, np.zeros((1, 1)), 1.0))
    nuisance, regressors, _, y = stacked(blocks)
    columns = np.hstack([nuisance, regressors])
    solution, rest, *_ = np.linalg.lstsq(columns, y, rcond=None)
    np.testing.assert_allclose(mean[:P], solution[-P:], rtol=1e-9)
    assert np.all(mean[P:] == 0)
    covariance = np.linalg.inv(columns.T @ columns)[-P:, -P:] * rest[0] / (y.size - columns.shape[1])
    np.testing.assert_allclose((factor @ factor.T)[:P, :P] / covariance, 1, rtol=1e-8)


def test_classical_posterior_keeps_the_prior_of_the_kernel():
    reduced = reduce_regression(problem(5))
    grid = evaluate_grid(
        reduced,
        [kernel_spectrum(reduced, lam, exponential_factor(lam, L)) for lam in (0.6, 0.9)],
        np.geomspace(0.01, 100, 9),
        np.full(9, 1 / 9),
    )
    prior = prior_posterior(grid)
    expected = prior.noise_variance * prior.alpha * prior.lam ** np.arange(1, L + 1)
    np.testing.assert_allclose(np.diag(prior.kernel_factor @ prior.kernel_factor.T), expected, rtol=1e-12)
    assert np.all(prior.kernel_mean == 0)


def test_nuisance_basis_drops_repeated_and_zero_columns():
    rng = np.random.default_rng(6)
    a = rng.standard_normal((20, 2))
    basis = nuisance_basis(np.column_stack([a, a @ [1.0, 2.0], np.zeros(20)]))
    assert basis.shape == (20, 2)
    np.testing.assert_allclose(basis @ (basis.T @ a), a, atol=1e-12)


def test_too_few_rows_and_zero_regressors_are_refused():
    block = problem(7, 1)[0]
    short = RegressionBlock(block.nuisance[:15], block.regressors[:15], block.kernel[:15], block.output[:15])
    # 15 rows without two of the nuisance, four regressors and twelve taps.
    with pytest.raises(ValueError, match=r"13 .* 4 regressors and 12 .*fir_length"):
        reduce_regression([short])
    zero = np.column_stack([block.regressors, np.zeros(N)])
    with pytest.raises(ValueError, match="5 of 5"):
        reduce_regression([RegressionBlock(block.nuisance, zero, block.kernel, block.output)])
    with pytest.raises(ValueError, match="record"):
        reduce_regression([])


def test_a_column_given_twice_is_left_out_and_nothing_else_changes():
    block = problem(8, 1)[0]
    twice = np.insert(block.regressors, 2, block.regressors @ [1.0, 1.0, 0.0, 0.0], axis=1)

    def solve(regressors):
        reduced = reduce_regression([RegressionBlock(block.nuisance, regressors, block.kernel, block.output)])
        grid = evaluate_grid(
            reduced, [kernel_spectrum(reduced, 0.8, tc_factor(0.8, L))], np.ones(1), np.ones(1)
        )
        return joint_factor(reduced, conditional_posterior(grid, np.ones((1, 1)), 0.0))

    (mean, factor), (mean_twice, factor_twice) = solve(block.regressors), solve(twice)
    assert mean_twice[2] == 0
    assert not np.any(factor_twice[2])
    rest = np.delete(np.arange(mean_twice.size), 2)
    np.testing.assert_allclose(mean_twice[rest], mean, atol=1e-9)
    covariance = factor @ factor.T
    np.testing.assert_allclose(
        (factor_twice @ factor_twice.T)[np.ix_(rest, rest)], covariance, atol=1e-9 * np.abs(covariance).max()
    )


def test_delays_are_the_toeplitz_matrix_whose_first_rows_are_replaced():
    rng = np.random.default_rng(11)
    u, first = rng.standard_normal(40), rng.standard_normal((3, 7))
    whole = toeplitz(np.concatenate([[0.0], u[:-1]]), np.zeros(7))
    whole[:3] = first
    delays = Delays(u, 7, first)
    np.testing.assert_array_equal(delays[:], whole)
    for rows in (slice(0, 2), slice(2, 9), slice(5, 40), slice(38, 99)):
        np.testing.assert_array_equal(delays[rows], whole[rows])
    np.testing.assert_array_equal(Delays(u, 7, first, 3)[2:9], whole[5:12])
    taps = rng.standard_normal(7)
    np.testing.assert_allclose(delays @ taps, whole @ taps, rtol=1e-12)


def test_a_record_longer_than_a_piece_is_reduced_as_if_it_were_whole():
    rng = np.random.default_rng(12)
    n = 70_000
    assert len(pieces(n)) == 2
    u, y = rng.standard_normal(n), rng.standard_normal(n)
    regressors = rng.standard_normal((n, 2))
    delays = Delays(u, 3, np.zeros((0, 3)))
    reduced = reduce_regression([RegressionBlock(np.ones((n, 1)), regressors, delays, y)])
    everything = np.column_stack([regressors, delays[:], y])
    triangle = np.linalg.qr(everything - everything.mean(axis=0), mode="r")
    np.testing.assert_allclose(np.abs(reduced.r11), np.abs(triangle[:2, :2]), atol=1e-9)
    np.testing.assert_allclose(np.abs(reduced.r12), np.abs(triangle[:2, 2:5]), atol=1e-9)
    np.testing.assert_allclose(np.abs(reduced.r22), np.abs(triangle[2:5, 2:5]), atol=1e-9)
    assert reduced.unexplained == pytest.approx(triangle[-1, -1] ** 2, rel=1e-10)
    assert reduced.n_rows == n - 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_covariance_that_is_no_number_is_refused_and_not_taken_for_certainty(bad):
    covariance = np.diag([4.0, 1.0, 0.0])
    factor = symmetric_factor(covariance)
    assert factor.shape == (3, 2)
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=0, atol=1e-15)
    covariance[2, 0] = bad
    with pytest.raises(ValueError, match="finite"):
        symmetric_factor(covariance)
