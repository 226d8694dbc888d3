"""Several inputs and outputs on shared poles: truth from modal sums by python-control."""

from functools import cache

import control
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.signal import dlsim

from ident import IdentOptions, MisoModel, Poles, Record
from ident.basis.mimo_model import MimoModel
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior

DT_S = 0.01
OMEGA = np.geomspace(0.5, 300, 60)
NAMES = ("u1", "u2"), ("y1", "y2")
NOISE = np.array([[4e-6, 2e-6], [2e-6, 3e-6]])
# The poles of the structure below, for what is not about their number.
KNOWN = {"n_real": 1, "n_pairs": 2}


def structure(shapes=((1.0, -0.4), (0.5, 1.0)), drives=((1.0, 0.2), (0.3, -1.0))) -> control.StateSpace:
    """Modes of 9 and 31 rad/s, one shape each, and a lag per motor, zero-order hold."""
    parts = []
    for omega, zeta, shape, drive in zip((9.0, 31.0), (0.03, 0.02), shapes, drives, strict=True):
        a = np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]])
        b = omega**2 * np.array([[0.0, 0.0], drive])
        parts.append((a, b, np.column_stack([shape, (0.0, 0.0)])))
    parts.append((np.array([[-4.0]]), np.array([[4.0, 1.0]]), np.array([[0.7], [-0.3]])))
    a = block_diag(*[part[0] for part in parts])
    b, c = np.vstack([p[1] for p in parts]), np.hstack([p[2] for p in parts])
    return control.c2d(control.ss(a, b, c, 0), DT_S)


def record(system, seed: int, samples: int = 3000, noise=NOISE) -> Record:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], (samples // 2, system.ninputs)), 2, axis=0)
    y = dlsim((system.A, system.B, system.C, system.D, DT_S), u)[1]
    y = y + rng.multivariate_normal(np.zeros(system.noutputs), noise, len(y))
    names = (NAMES[0][: system.ninputs], NAMES[1][: system.noutputs])
    return Record(u, y, DT_S, name=f"seed {seed}", input_names=names[0], output_names=names[1])


def response(system, omega=OMEGA) -> np.ndarray:
    return np.moveaxis(np.asarray(system(np.exp(1j * omega * DT_S))).reshape(*system.D.shape, -1), 2, 0)


@cache
def identified():
    return identify_mimo([record(structure(), 0)])


def test_modes_shapes_and_states_are_those_of_the_structure():
    result, truth = identified(), structure()
    assert result.model.order == truth.nstates == len(result.model.state_space()[0])
    assert all(result.rank_one)
    found = np.sort(np.abs(np.log(result.model.poles.pairs)) / DT_S)
    np.testing.assert_allclose(found, [9.0, 31.0], rtol=1e-3)
    residues = result.model.residues()
    first = residues.pole[np.argmin(np.abs(np.abs(np.log(residues.poles)) / DT_S - 9.0))]
    np.testing.assert_allclose(first[1] / first[0], -0.4, rtol=0.02)  # which sensors move in this mode
    np.testing.assert_allclose(first[:, 1] / first[:, 0], 0.2, rtol=0.02)  # which motor drives it
    error = np.abs(result.model.frequency_response(OMEGA) - response(truth))
    assert np.max(error / np.abs(response(truth)).max(axis=0)) < 2e-3


def test_the_noise_covariance_is_found():
    # 3000 samples: relative standard deviation sqrt(2/3000) = 2.6 % of a variance.
    np.testing.assert_allclose(identified().noise_covariance, NOISE, rtol=0.12)


def test_the_realisation_has_the_response_of_the_model():
    model = identified().model
    found = response(model.to_control())
    np.testing.assert_allclose(found, model.frequency_response(OMEGA), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(("n_outputs", "n_inputs"), [(1, 3), (3, 2), (2, 3)])
@pytest.mark.parametrize("integrators", [0, 1])
def test_any_numbers_of_inputs_and_outputs_are_realised(n_outputs, n_inputs, integrators):
    rng = np.random.default_rng(n_outputs)
    poles = Poles(np.array([0.0, 0.9][1 - integrators :]), np.array([0.7 + 0.5j]))
    outputs = [
        MisoModel(
            poles, rng.normal(size=(n_inputs, poles.order)), rng.normal(size=n_inputs), DT_S,
            tuple(f"u{j}" for j in range(n_inputs)), f"y{k}", integrators, input_delay_samples=2,
        )
        for k in range(n_outputs)
    ]  # fmt: skip
    model = MimoModel(tuple(outputs))
    np.testing.assert_allclose(response(model.to_control()), model.frequency_response(OMEGA), rtol=1e-8)


@pytest.mark.slow
def test_two_modes_at_one_place_keep_a_free_residue():
    """A second structure beside the first, at the same frequency: the residue has rank two."""
    one = structure()
    both = control.ss(one.A, one.B, one.C, 0, DT_S)
    other = structure(shapes=((0.3, 1.0), (0.5, 1.0)), drives=((-0.5, 1.0), (0.0, 0.0)))
    keep = slice(0, 2)
    extra = control.ss(other.A[keep, keep], other.B[keep], other.C[:, keep], 0, DT_S)
    result = identify_mimo([record(both + extra, 1)])
    omega = np.abs(np.log(result.model.residues().poles)) / DT_S
    at = int(np.argmin(np.abs(omega - 9.0)))
    assert not result.rank_one[at]
    assert sum(result.rank_one) == len(result.rank_one) - 1
    assert len(result.model.state_space()[0]) == one.nstates + 2


@pytest.mark.parametrize(
    ("runs", "numbers"), [(2, KNOWN), pytest.param(14, {}, marks=pytest.mark.long)], ids=["2", "14"]
)
def test_balls_hold_the_response_as_often_as_they_say(runs, numbers):
    """60 frequencies of one record are not independent, so the bounds are wide: the lower one is two standard
    deviations of the mean of the shares, .12 or so each."""
    truth, held = response(structure()), []
    for seed in range(runs):
        item = record(structure(), 100 + seed, samples=1500)
        balls = matrix_posterior([item], identify_mimo([item], IdentOptions(**numbers))).at(OMEGA)
        held.append(np.mean(balls.holds(truth)))
    assert 0.945 - 2 * 0.12 / np.sqrt(runs) < np.mean(held) < (0.995 if runs > 2 else 1.01)
    assert not np.any(balls.holds(2 * truth))


@pytest.mark.parametrize("integrators", [0, 1])
def test_the_rational_factor_is_that_of_the_balls(integrators):
    system = structure()
    if integrators:
        system = control.ss(np.eye(2), np.eye(2), DT_S * np.eye(2), np.zeros((2, 2)), DT_S) * system
    item = record(system, 5)
    posterior = matrix_posterior(
        [item], identify_mimo([item], IdentOptions(integrators=integrators, **KNOWN))
    )
    factor = control.ss(*posterior.input_factor(0.01), DT_S, remove_useless_states=False)
    assert np.max(np.abs(factor.poles())) < 1
    values, own = response(factor), posterior.at(OMEGA).input_factor
    np.testing.assert_allclose(
        values.conj().swapaxes(1, 2) @ values, own.conj().swapaxes(1, 2) @ own, rtol=1e-4, atol=1e-14
    )


def test_a_start_in_motion_is_estimated():
    item = record(structure(), 4, samples=3400)
    result = identify_mimo([item.slice(200, 3200)], IdentOptions(**KNOWN))
    assert result.structure.estimate_initial_state
    np.testing.assert_allclose(result.model.frequency_response(OMEGA), response(structure()), atol=0.02)


def _twice(item: Record) -> Record:
    return Record(
        item.input, item.output[:, [0, 0]], DT_S, name="x", input_names=NAMES[0], output_names=NAMES[1]
    )


def _still(item: Record) -> Record:
    return Record(
        item.input, item.output * [1.0, 0.0], DT_S, name="x", input_names=NAMES[0], output_names=NAMES[1]
    )


def _alike(item: Record) -> Record:
    return Record(
        item.input[:, [0, 0]], item.output, DT_S, name="x", input_names=NAMES[0], output_names=NAMES[1]
    )


@pytest.mark.parametrize(
    ("spoil", "options", "fact"),
    [
        (lambda item: [_twice(item)], {}, r"'x'.*y1.*y2"),
        (lambda item: [_still(item)], {}, "'x'.*'y2'"),
        (lambda item: [_alike(item)], {}, r"'x'.*u1.*u2"),
        # Samples, order, unknowns of the model, and how many samples would do.
        (lambda item: [item.slice(0, 14)], {"n_pairs": 2, "n_real": 1}, r"14\D+5\D+16\D+17"),
        (
            lambda item: [
                item,
                Record(
                    item.input, item.output, 2 * DT_S, name="x", input_names=NAMES[0], output_names=NAMES[1]
                ),
            ],
            {},
            "dt_s",
        ),
        (lambda item: [item, item.only(0)], {}, r"\['y1'\].*\['y1', 'y2'\]"),
        (lambda item: [item], {"integrators": 2}, "integrators = 2"),
        (lambda item: [item], {"relative_degree": 2}, "relative_degree = 2"),
    ],
)
def test_a_refusal_names_in_one_line_what_cannot_be_fitted(spoil, options, fact):
    with pytest.raises(ValueError, match=fact) as refusal:
        identify_mimo(spoil(record(structure(), 0)), IdentOptions(**options))
    assert "\n" not in str(refusal.value)


def test_one_long_record_of_which_the_start_was_searched_is_fitted_as_a_whole():
    log = record(structure(), seed=8)
    options = {**KNOWN, "estimate_initial_state": False}
    searched = identify_mimo([log], IdentOptions(**options, search_samples=600))
    whole = identify_mimo([log], IdentOptions(**options))
    assert len(searched.residuals[0]) == log.n_samples
    np.testing.assert_allclose(searched.rss, whole.rss, rtol=1e-6)
    np.testing.assert_allclose(
        searched.model.frequency_response(OMEGA), whole.model.frequency_response(OMEGA), rtol=1e-3
    )
