"""Intervals of frequency and damping: exact to first order, and they hold the truth as often as they say."""

import numpy as np
import pytest

from ident import GobfModel, IdentOptions, Poles, basis_response, identify
from ident.basis.posterior import ResponsePosterior
from ident.uncertainty.embedding import tangent
from ident.uncertainty.pole_intervals import pole_intervals
from tests.ident.benchmark_plants import P2_HZ, P2_ZETA, as_record, p2
from tests.ident.three_mode_arm import random_arm
from validation.paper.classical import classical

DT_S = 0.005
CIRCLE = np.exp(1j * np.linspace(0.001, np.pi, 4000))
DECAY, OMEGA, ZETA = [0.5, 25.0], [15.0, 70.0], [0.02, 0.3]


def on_doubled_basis(poles, response):
    """Coefficients of a response on every pole taken twice, by least squares on the circle."""
    rows = basis_response(poles.doubled(), CIRCLE)
    stacked, wanted = np.vstack([rows.real, rows.imag]), np.concatenate([response.real, response.imag])
    return np.linalg.lstsq(stacked, wanted, rcond=None)[0]


def partial_fractions(poles):
    """One residue per pole, written out: shares no code with the basis."""
    z = CIRCLE
    total = sum(r / (z - a) for r, a in zip((0.3, -0.2), poles.real, strict=True))
    for r, p in zip((0.05 - 0.02j, 0.01 + 0.03j), poles.pairs, strict=True):
        total = total + r / (z - p) + np.conj(r) / (z - np.conj(p))
    return total


@pytest.mark.parametrize("which", ["omega_rad_s", "zeta", "decay_per_s"])
@pytest.mark.parametrize("index", [0, 1])
def test_half_width_is_that_of_a_moved_pole(which, index):
    """A covariance of one direction, the one in which a pole moves: the interval is that very move."""
    numbers = {"omega_rad_s": list(OMEGA), "zeta": list(ZETA), "decay_per_s": list(DECAY)}
    poles = Poles.from_continuous(**numbers, dt_s=DT_S)
    share = 1e-6
    numbers[which][index] *= 1 + share
    moved = Poles.from_continuous(**numbers, dt_s=DT_S)
    mean = on_doubled_basis(poles, partial_fractions(poles))
    change = on_doubled_basis(poles, partial_fractions(moved)) - mean
    posterior = ResponsePosterior(poles.doubled(), mean, change[:, None], DT_S)
    found = pole_intervals(posterior, poles, level=0.6826894921370859)  # one standard deviation
    centres = {"omega_rad_s": OMEGA, "zeta": ZETA, "decay_per_s": DECAY}
    for name, centre in centres.items():
        half = np.log(getattr(found, name)[:, 1] / np.array(centre))
        expected = np.zeros(2)
        if name == which:
            expected[index] = share
        # Second order: the move over the distance to the circle, 0.005 %, times 1/zeta = 50 in damping.
        np.testing.assert_allclose(half, expected, rtol=0, atol=0.01 * share)


def test_intervals_of_p2_hold_the_truth_and_say_which_mode_is_known_best():
    record = p2(0).record
    model = identify([record], IdentOptions(n_real=2, n_pairs=3)).model
    found = pole_intervals(tangent([record], model), model.poles, level=0.999)
    hertz = found.omega_rad_s / (2 * np.pi)
    assert np.all((hertz[:, 0] < P2_HZ) & (hertz[:, 1] > P2_HZ))
    assert np.all((found.zeta[:, 0] < P2_ZETA) & (found.zeta[:, 1] > P2_ZETA))
    relative = np.log(hertz[:, 1] / hertz[:, 0])
    assert relative.argmax() == 2  # the third mode is the weakest


@pytest.mark.parametrize(
    "runs", [pytest.param(4, marks=pytest.mark.slow), pytest.param(34, marks=pytest.mark.long)]
)
def test_intervals_hold_the_truth_as_often_as_they_say(runs):
    hits = []
    for seed in range(runs):
        arm = random_arm(np.random.default_rng([5, seed]))
        model = identify([arm.record], IdentOptions(n_real=2, n_pairs=3)).model
        found = pole_intervals(tangent([arm.record], model), model.poles)
        truth = Poles(arm.poles[:2].real, arm.poles[2:])
        order = np.argsort(truth.omega_rad_s(DT_S))
        wanted = (truth.omega_rad_s(DT_S)[order], truth.zeta()[order], np.sort(truth.decay_per_s(DT_S)))
        ends = (found.omega_rad_s, found.zeta, found.decay_per_s)
        for value, (low, high) in zip(np.concatenate(wanted), np.concatenate(ends), strict=True):
            hits.append(low <= value <= high)
    # 8 numbers a run, nearly independent: 3 sd of a binomial. First order leaves a little out (weak third
    # modes), so the lower side has 2 % more.
    off = 3 * np.sqrt(0.95 * 0.05 / (8 * runs))
    assert 0.93 - off <= np.mean(hits) <= min(0.95 + off, 1)


def test_what_the_records_do_not_tell_is_open():
    """A pole whose coefficient is zero could be anywhere."""
    poles = Poles.from_continuous(omega_rad_s=[20.0], zeta=[0.1], dt_s=DT_S)
    posterior = ResponsePosterior(poles.doubled(), np.zeros(4), np.eye(4), DT_S)
    found = pole_intervals(posterior, poles)
    assert found.omega_rad_s.tolist() == [[0.0, np.inf]]
    assert found.zeta.tolist() == [[0.0, 1.0]]


def test_a_pair_that_adds_nothing_outside_its_ellipse_is_open():
    """Two pairs of which one is a hundredth of the other: told, or not, by the size of the ellipses."""
    poles = Poles.from_continuous(omega_rad_s=[20.0, 90.0], zeta=[0.1, 0.05], dt_s=DT_S)
    z, (first, second) = CIRCLE, poles.pairs
    response = 1 / (z - first) + 1 / (z - np.conj(first)) + 0.01 / (z - second) + 0.01 / (z - np.conj(second))
    mean = on_doubled_basis(poles, response)
    for size, told in ((1e-4, [True, True]), (0.02, [True, False])):
        found = pole_intervals(ResponsePosterior(poles.doubled(), mean, size * np.eye(8), DT_S), poles)
        assert np.isfinite(found.omega_rad_s[:, 1]).tolist() == told


def test_real_pole_left_of_zero_has_no_rate():
    poles = Poles(np.array([-0.3, 0.5]))
    posterior = ResponsePosterior(poles.doubled(), np.ones(4), 1e-6 * np.eye(4), DT_S)
    found = pole_intervals(posterior, poles)
    assert np.isnan(found.decay_per_s[0]).all()
    assert found.decay_per_s[1, 0] < -np.log(0.5) / DT_S < found.decay_per_s[1, 1]


def test_only_the_posterior_of_these_poles_is_taken():
    rng = np.random.default_rng(0)
    poles = Poles.from_continuous(omega_rad_s=[20.0], zeta=[0.1], dt_s=DT_S)
    model = GobfModel(poles, np.ones(2), DT_S)
    u = rng.normal(size=500)
    record = as_record(u, model.simulate(u) + 0.01 * rng.normal(size=500))
    with pytest.raises(ValueError, match="tangent"):
        pole_intervals(classical([record], model), poles)
    with pytest.raises(ValueError, match=r"level .*1\.0"):
        pole_intervals(tangent([record], model), poles, level=1.0)
