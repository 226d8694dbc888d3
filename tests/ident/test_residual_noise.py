"""Noise models from residuals: exact whitening, and the bias of a fit taken out."""

import numpy as np
import pytest
from scipy import signal

from ident import Poles, Record, Structure
from ident.basis.arma_noise import ArmaNoise
from ident.basis.autoregressive_noise import WHITE_NOISE, AutoregressiveNoise
from ident.basis.options import EmbeddingOptions
from ident.uncertainty.autoregression import absorbed_gradient, fit_autoregression
from ident.uncertainty.embedding import tangent
from ident.uncertainty.embedding_algebra import (
    conditional_posterior,
    evaluate_grid,
    kernel_spectrum,
    reduce_regression,
    tc_factor,
)
from ident.uncertainty.embedding_rows import EmbeddingRows, gls_residuals

from .benchmark_plants import DT_S as DT
from .three_mode_arm import random_arm

NOISES = [
    AutoregressiveNoise(np.array(a_polynomial))
    for a_polynomial in ([1.0, -0.9], [1.0, -1.2, 0.6], [1.0, -0.5, 0.1, -0.3, 0.2])
]
# A resonance over a floor 1e-7 below it: the first rows are dropped.
NARROW = AutoregressiveNoise(np.real(np.poly([0.96 * np.exp(0.1j), 0.96 * np.exp(-0.1j), 0.9, 0.8, 0.9])))


# Forgets within the rows of the records here.
ARMA = ArmaNoise(np.array([1.0, -0.9]), np.array([1.0, -0.5]))


def covariance(noise, n):
    """Toeplitz covariance (n,n) of a noise from a long impulse response."""
    h = noise.coloured(np.eye(1, 4000)[0])
    gamma = np.array([h[k:] @ h[: h.size - k] for k in range(n)])
    index = np.arange(n)
    return gamma[np.abs(index[:, None] - index)]


@pytest.mark.parametrize("noise", [WHITE_NOISE, NOISES[0], NOISES[1], ARMA])
def test_residuals_and_what_the_fit_absorbs_equal_the_dense_ones(noise):
    rng = np.random.default_rng(3)
    sizes = (60, 45)
    records = [Record(rng.standard_normal((n, 1)), rng.standard_normal((n, 1)), DT, name="r") for n in sizes]
    structure = Structure(estimate_offset=True, estimate_initial_state=True)
    rows = EmbeddingRows(tuple(records), structure, Poles(np.array([0.8, 0.5])), 3, noise)
    reduced = reduce_regression(rows.blocks())
    # No kernel: all weight on alpha = 0, so that the fit is plain generalised least squares.
    grid = evaluate_grid(reduced, [kernel_spectrum(reduced, 0.5, tc_factor(0.5, 3))], np.ones(1), np.ones(1))
    kernel = conditional_posterior(grid, np.zeros((1, 1)), 1.0)
    residuals, absorbed = gls_residuals(rows, reduced, kernel)

    total, flat, cov = sum(sizes), [], np.zeros((sum(sizes), sum(sizes)))
    start = 0
    for index, (record, n) in enumerate(zip(records, sizes, strict=True)):
        u = record.input[:, 0]
        own = [signal.lfilter([0.0, 1.0], [1.0, -a], u) for a in (0.8, 0.5)]
        local = np.zeros((n, 6))
        local[:, 3 * index : 3 * index + 3] = np.column_stack(
            [np.ones(n), 0.8 ** np.arange(n), 0.5 ** np.arange(n)]
        )
        flat.append(np.column_stack([local, *own]))
        cov[start : start + n, start : start + n] = covariance(noise, n)
        start += n
    k, y = np.vstack(flat), np.concatenate([record.output[:, 0] for record in records])
    weight = np.linalg.inv(cov)
    taken = k @ np.linalg.solve(k.T @ weight @ k, k.T)
    np.testing.assert_allclose(np.concatenate(residuals), y - taken @ weight @ y, atol=1e-9 * np.abs(y).max())
    ours = np.vstack(absorbed)
    start = 0
    for n, z in zip(sizes, absorbed, strict=True):
        here = slice(start, start + n)
        np.testing.assert_allclose(z @ z.T, taken[here, here], atol=1e-9 * np.abs(taken).max())
        start += n
    assert ours.shape[0] == total


@pytest.mark.parametrize("noise", [NOISES[0], NOISES[1], NOISES[2], NARROW])
def test_bias_of_the_estimating_equations_equals_the_dense_one(noise):
    rng = np.random.default_rng(5)
    n, order, start = 80, 5, 6
    record = Record(rng.standard_normal((n, 1)), rng.standard_normal((n, 1)), DT, name="r")
    structure = Structure(estimate_offset=True, estimate_initial_state=True)
    rows = EmbeddingRows((record,), structure, Poles(np.array([0.9, 0.6])), 3, noise)
    reduced = reduce_regression(rows.blocks())
    grid = evaluate_grid(reduced, [kernel_spectrum(reduced, 0.5, tc_factor(0.5, 3))], np.ones(1), np.ones(1))
    _, absorbed = gls_residuals(rows, reduced, conditional_posterior(grid, np.zeros((1, 1)), 1.0))

    a = np.arange(n)
    k = np.column_stack(
        [np.ones(n), 0.9**a, 0.6**a]
        + [signal.lfilter([0.0, 1.0], [1.0, -p], record.input[:, 0]) for p in (0.9, 0.6)]
    )
    filtering = noise.filtered(np.eye(n))
    white = filtering.copy()
    if noise is NARROW:
        white = white[noise.order :]
    else:
        white[: noise.order] = 0
        head = covariance(noise, n)[: noise.order, : noise.order]
        white[: noise.order, : noise.order] = np.linalg.inv(np.linalg.cholesky(head))
    fit = k @ np.linalg.lstsq(white @ k, white, rcond=None)[0]
    left = np.eye(n) - fit
    moments = filtering @ left @ covariance(noise, n) @ left.T
    expected = [-sum(moments[t, t - i] for t in range(start, n)) for i in range(1, order + 1)]
    np.testing.assert_allclose(
        absorbed_gradient(absorbed, noise, order, start), expected, atol=1e-5 * np.abs(expected).max()
    )


def test_nothing_absorbed_changes_nothing_and_the_bias_of_a_mean_is_put_back():
    rng = np.random.default_rng(4)
    e = NOISES[0].coloured(rng.standard_normal(3000))
    plain = fit_autoregression([e], 1)
    nothing = [np.zeros((3000, 1))]
    again = fit_autoregression([e], 1, NOISES[0], nothing)
    np.testing.assert_allclose(again.a_polynomial, plain.a_polynomial, rtol=1e-12)
    # The mean estimated: Z = 1 (1^T S^-1 1)^(-1/2), and the bias of a is known to be (1 + rho) / N.
    weight = np.linalg.norm(NOISES[0].whiten(np.ones(3000)))
    moved = fit_autoregression([e], 1, NOISES[0], [np.full((3000, 1), 1 / weight)])
    assert moved.a_polynomial[1] - plain.a_polynomial[1] == pytest.approx(-1.9 / 3000, rel=0.1)


def test_a_correction_that_is_no_small_perturbation_is_shrunk():
    """Noise with a range of eight decades, most of it absorbed: the spectrum moves by less than two."""
    rng = np.random.default_rng(6)
    e = NARROW.coloured(rng.standard_normal(4000))
    slow = np.column_stack([np.cos(w * np.arange(4000)) for w in np.linspace(0.05, 0.15, 40)])
    plain = fit_autoregression([e], 5)
    for size in (1.0, 1e3, 1e6):
        moved = fit_autoregression([e], 5, NARROW, [size * slow])
        assert np.all(np.abs(np.roots(moved.a_polynomial)) < 1)
        w = np.linspace(0, np.pi, 3000)
        after = signal.freqz(moved.a_polynomial, [1.0], w)[1]
        before = signal.freqz(plain.a_polynomial, [1.0], w)[1]
        ratio = np.abs(after / before) ** 2
        assert ratio.min() > 0.499
        assert ratio.max() < 2.0
    # Had it not been shrunk it would have been 1e6 times what it is.
    assert np.abs(ratio - 1).max() > 0.3


def test_first_rows_are_dropped_where_their_covariance_is_nearly_singular():
    np.testing.assert_array_equal(NARROW.first_rows, np.zeros((5, 5)))
    assert NARROW.drops_start
    y = np.random.default_rng(7).standard_normal((30, 2))
    white = NARROW.whiten(y)
    np.testing.assert_array_equal(white[:5], 0.0)
    np.testing.assert_allclose(
        white[5:], signal.lfilter(NARROW.a_polynomial, [1.0], y, axis=0)[5:], rtol=1e-12
    )
    record = Record(y[:, :1], y[:, 1:], DT, name="r")
    rows = EmbeddingRows((record,), Structure(), Poles(np.array([0.5])), 3, NARROW)
    (block,) = rows.blocks()
    assert block.output.size == block.kernel.shape[0] == len(block.nuisance) == 25
    (pair,) = rows.pair_blocks()
    np.testing.assert_array_equal(pair.regressors[:5], 0.0)
    np.testing.assert_array_equal(pair.first, 0.0)


@pytest.mark.long
def test_noise_model_is_not_biased_by_the_fit():
    """A pole of the plant (0.88) beside that of the noise (0.9), offset and initial state estimated."""
    found = []
    for seed in range(10):
        arm = random_arm(np.random.default_rng([40, seed]), n_samples=1000, noise_pole=0.9)
        model = arm.model()
        found.append(
            tangent([arm.record], model, EmbeddingOptions(coloured_noise=True)).report.ar_coefficients[0]
        )
    # sd sqrt((1 - 0.81) / 1000) = 0.014 each, 0.0044 of the mean; left alone the bias is -0.03 to -0.05.
    assert np.mean(found) == pytest.approx(-0.9, abs=0.0132)
