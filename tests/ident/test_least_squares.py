"""Fits and their derivatives against dense linear algebra and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import lstsq

from ident import IdentOptions, Poles, Record, Structure, regressor
from ident.basis.functions import free_response
from ident.basis.structure import filter_input
from ident.fit.least_squares import fit, linearisation, project
from ident.fit.refinement import Bounds, free_optimality, pole_system, refine
from ident.fit.regression import prepare, prepare_inputs, thinned
from tests.ident.benchmark_plants import as_record, p2

STRUCTURES = {
    "plain": Structure(),
    "offset": Structure(estimate_offset=True),
    "initial state": Structure(estimate_initial_state=True),
    "all": Structure(
        integrators=2,
        input_delay_samples=2,
        feedthrough=True,
        estimate_offset=True,
        estimate_initial_state=True,
    ),
}
POLES = Poles([0.7, 0.95], [0.9 * np.exp(0.5j)])


def every_kind(test):
    """Of one input and of two that share the poles."""
    structures = pytest.mark.parametrize("structure", STRUCTURES.values(), ids=STRUCTURES)
    return pytest.mark.parametrize("n_inputs", [1, 2])(structures(test))


def records(n_inputs=1):
    """Two records of unequal length whose output has nothing to do with any model."""
    rng, names = np.random.default_rng(0), tuple("ab"[:n_inputs])
    return [
        Record(
            rng.normal(size=(n, n_inputs)), 1 + rng.normal(size=(n, 1)), 0.005, name="test", input_names=names
        )
        for n in (150, 90)
    ]


def dense(data, poles):
    """Every column of the regression, record by record, as one explicit matrix; shared columns last."""
    structure, blocks = data.structure, []
    for here in data.segments:
        n = here.stop - here.start
        local = [np.linspace(-1, 1, n) ** k for k in range(structure.n_polynomials)]
        if structure.estimate_initial_state:
            local += list(free_response(poles, n).T)
        for column in local:
            whole = np.zeros(data.n_samples)
            whole[here] = column
            blocks.append(whole)
    shared = [np.concatenate([regressor(poles, u[here]) for here in data.segments]) for u in data.u]
    if structure.feedthrough:
        shared.append(data.u.T)
    return np.column_stack([*blocks, *shared])


def dense_residual(data, poles):
    columns = dense(data, poles)
    columns = columns / np.linalg.norm(columns, axis=0)
    return data.y - columns @ lstsq(columns, data.y, rcond=1e-13)[0]


@every_kind
def test_fit_is_the_dense_least_squares_fit(structure, n_inputs):
    data = prepare_inputs(records(n_inputs), structure)
    expected = dense_residual(data, POLES)
    linear = fit(data, POLES)
    # Integrating twice makes columns of very different directions nearly parallel: 1e-9 instead of 1e-12.
    np.testing.assert_allclose(linear.residual, expected, atol=1e-9)
    columns = dense(data, POLES)
    theta = lstsq(columns, data.y, rcond=None)[0]
    found = [*linear.coefficients.ravel(), *(linear.feedthrough if structure.feedthrough else ())]
    np.testing.assert_allclose(found, theta[-len(found) :], rtol=1e-6)


@every_kind
def test_compiled_linearisation_is_that_of_the_orthogonal_factorisation(structure, n_inputs):
    data = prepare_inputs(records(n_inputs), structure)
    residual = dense_residual(data, POLES)
    expected = linearisation(data, POLES)
    rss, normal, gradient = data.linearise(*POLES.writable())
    assert expected.rss == pytest.approx(residual @ residual, rel=1e-9)
    assert rss == pytest.approx(expected.rss, rel=1e-12)
    scale = np.sqrt(np.max(np.diag(expected.normal)))
    # The inputs of "all" are integrated twice: products of columns near 1e4 are subtracted from each other.
    np.testing.assert_allclose(normal, expected.normal, atol=1e-8 * scale**2)
    np.testing.assert_allclose(gradient, expected.gradient, atol=1e-9 * scale * np.sqrt(rss))
    assert data.linearise(*POLES.writable(), 0.0).rss == rss


def test_nearly_dependent_columns_are_factorised():
    """Three delays of a very slow input: products know nothing, the orthogonal factorisation is used."""
    u = np.sin(1e-5 * np.arange(2000))
    data, poles = prepare([as_record(u, u)], Structure()), Poles([0.0, 0.0, 0.0])
    expected, found = linearisation(data, poles), data.linearise(*poles.writable())
    assert found.rss == expected.rss
    np.testing.assert_array_equal(found.normal, expected.normal)


@every_kind
def test_gradient_is_the_difference_quotient(structure, n_inputs):
    """dJ/dp = -2 r^T s_p for 1 - a of the real poles and (s, f) of the pair."""
    data = prepare_inputs(records(n_inputs), structure)
    _, slope = pole_system(data.linearise(*POLES.writable()), POLES)

    def cost(x):
        poles = Poles(1 - x[:2], [np.exp(-x[2] + 1j * x[3])])
        residual = dense_residual(data, poles)
        return residual @ residual

    log = np.log(POLES.pairs[0])
    x = np.array([*(1 - POLES.real), -log.real, log.imag])
    for i in range(4):
        step = np.zeros(4)
        step[i] = 1e-5
        quotient = (cost(x + step) - cost(x - step)) / 2e-5
        # Truncation (1e-5)^2 times third derivatives, rounding 1e-12 J / 1e-5 with J about 240.
        assert -2 * slope[i] == pytest.approx(quotient, rel=1e-5, abs=1e-3)


def test_certificate_is_the_projection_on_the_doubled_basis():
    """For records from rest the reported optimality is |Phi2^T r|/|r| with orthonormal Phi2."""
    data = prepare(records(), Structure(estimate_offset=True))
    here = linearisation(data, POLES)
    doubled = project(data, POLES.doubled())
    tangent = np.sqrt(here.rss - doubled.residual @ doubled.residual)
    bounds = Bounds.from_options(IdentOptions(), 150, 0.005)
    assert free_optimality(here, POLES, bounds) == pytest.approx(tangent / np.sqrt(here.rss), rel=1e-8)
    assert tangent / np.sqrt(here.rss) > 0.05  # so that the comparison says something


def test_refinement_leaves_fixed_poles_alone_and_keeps_bounds():
    data = prepare([p2(0, 500).record], Structure())
    options = IdentOptions(omega_min_rad_s=30.0, omega_max_rad_s=50.0, zeta_min=0.05)
    start = Poles([0.9, 0.5], Poles.from_continuous(omega_rad_s=[35.0], zeta=[0.2], dt_s=0.005).pairs)
    end = refine(data, start, Bounds.from_options(options, 500, 0.005), fixed=Poles([0.9]))
    assert end.poles.real[0] == 0.9
    assert end.poles.real[1] != 0.5
    assert 30 * (1 - 1e-9) <= end.poles.omega_rad_s(0.005)[0] <= 50 * (1 + 1e-9)
    assert end.poles.zeta()[0] >= 0.05 * (1 - 1e-9)
    assert end.rss < linearisation(data, start).rss


def test_integrators_filter_the_input_exactly():
    u = np.random.default_rng(1).normal(size=40)
    structure = Structure(integrators=2, input_delay_samples=3)
    expected = np.cumsum(np.cumsum(np.concatenate([np.zeros(3), u[:-3]])))
    np.testing.assert_allclose(filter_input(u, 2, 3), expected, atol=1e-12)
    data = prepare([as_record(u, u)], structure)
    np.testing.assert_allclose(data.u[0], expected[3:], atol=1e-12)
    np.testing.assert_array_equal(data.y, u[3:])


def test_records_must_fit_together():
    a, b = records()
    with pytest.raises(ValueError, match=r"0\.01.*0\.005"):
        prepare([a, replace(b, dt_s=0.01)], Structure())
    with pytest.raises(ValueError, match="record"):
        prepare([], Structure())
    with pytest.raises(ValueError, match=r"150.*delay 150"):
        prepare([a], Structure(input_delay_samples=150))
    wide = replace(a, input=np.ones((150, 2)), input_names=("a", "b"))
    with pytest.raises(ValueError, match=r"Record\.siso"):
        prepare([wide], Structure())


def test_thinning_keeps_whole_records_or_the_most_exciting_stretch():
    a, b = records()
    assert thinned([a, b], 1000) == ([a, b], False)
    assert thinned([a, b, a, b], 250) == ([a, a], False)
    quiet = np.concatenate([0.01 * a.input[:, 0], a.input[:, 0]])
    (part,), in_mid_record = thinned([as_record(quiet, quiet)], 150)
    assert in_mid_record
    np.testing.assert_array_equal(part.input[:, 0], quiet[148:298])


def test_too_few_samples_are_refused():
    data = prepare([as_record(np.arange(8.0), np.arange(8.0))], Structure())
    with pytest.raises(ValueError, match=r"8 for 8 .* 4 poles"):
        fit(data, POLES)
