"""Closed-loop logs: bias of the direct method, two-stage without it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from ident import IdentOptions, Record, identify
from ident.basis.options import EmbeddingOptions
from ident.checks.residual_tests import fed_back
from ident.closed_loop import two_stage, with_controller
from ident.uncertainty.embedding import tangent
from ident.unstable import find_unstable
from tests.ident.test_unstable import looped, sampled

DT = 0.01
B, A, GAIN = [0.0, 0.06, 0.05], [1.0, -1.62, 0.72], 1.5
OMEGA = np.geomspace(1.0, 250.0, 60)
TRUTH = signal.freqz(B, A, worN=OMEGA * DT)[1]
OPTIONS = IdentOptions(n_real=0, n_pairs=1, estimate_offset=False, estimate_initial_state=False)
# One mode and no other: what a mode that might be missing adds to the ellipses is tested elsewhere.
BOUNDS = EmbeddingOptions(fir_length=20, coloured_noise=True, prior_missed_mode=0.0)


def log(rng, noise=0.3, n=3000):
    r = rng.standard_normal(n)
    e = noise * signal.lfilter([1.0], [1.0, -0.7], rng.standard_normal(n))
    closed = np.polyadd(A, GAIN * np.asarray(B))
    y = signal.lfilter(B, closed, r) + signal.lfilter(A, closed, e)
    u = r - GAIN * y
    return Record(u[:, None], y[:, None], DT, name="log", reference=r[:, None])


@pytest.mark.slow
def test_two_stage_is_free_of_the_direct_method_s_bias():
    records = [log(np.random.default_rng([1, seed])) for seed in range(2)]
    stage = two_stage(records, OPTIONS)
    assert all(record.reference is None for record in stage.records)
    # The noise-free input itself is known here: S r with S = A / (A + g B).
    closed = np.polyadd(A, GAIN * np.asarray(B))
    ideal = signal.lfilter(A, closed, records[0].reference[:, 0])
    error = np.linalg.norm(stage.records[0].input[:, 0] - ideal) / np.linalg.norm(ideal)
    assert error < 0.06
    assert np.linalg.norm(records[0].input[:, 0] - ideal) / np.linalg.norm(ideal) > 5 * error

    def bounds(used, coloured_noise):
        options = BOUNDS.model_copy(update={"coloured_noise": coloured_noise})
        return tangent(used, identify(used, OPTIONS).model, options).at(OMEGA)

    # The direct method without a noise model; a true noise model would free it of its bias, too.
    opened, direct = bounds(stage.records, True), bounds(records, False)
    assert np.median(np.abs(opened.centre - TRUTH)) < 0.5 * np.median(np.abs(direct.centre - TRUTH))
    assert opened.contains(TRUTH).mean() > 0.8
    assert direct.contains(TRUTH).mean() < 0.5


@pytest.mark.slow
def test_any_model_of_the_plant_will_do_and_a_good_one_does_better():
    """G0 = 0 is the plain two-stage method: unbiased, with the error of u_hat."""
    record = log(np.random.default_rng(8), noise=0.05)
    good = two_stage([record], OPTIONS)
    nothing = replace(good.plant, coefficients=np.zeros(2))
    poor = two_stage([record], OPTIONS, replace(good.plant, coefficients=0.7 * good.plant.coefficients))
    plain = two_stage([record], OPTIONS, nothing)
    np.testing.assert_array_equal(plain.records[0].output, record.output)
    found = [identify(stage.records, OPTIONS) for stage in (good, poor, plain)]
    errors = [np.median(np.abs(one.model.frequency_response(OMEGA) / TRUTH - 1)) for one in found]
    assert max(errors) < 0.05
    assert errors[0] < errors[2]
    # Sensor noise of standard deviation .05 / sqrt(1 - .7^2).
    assert found[0].noise_std == pytest.approx(0.07, rel=0.1)


@pytest.mark.parametrize(
    ("start", "offset"),
    [
        (1000, 100.0),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((0, 0.0), (1000, 0.0), (0, 100.0))),
    ],
)
def test_a_log_may_begin_in_motion_and_stand_anywhere(start, offset):
    """The same rows of one loop: from rest, from the middle, and around another position."""
    record = log(np.random.default_rng(9), noise=0.05)
    away = replace(record, reference=record.reference + offset, output=record.output + offset)
    stage = two_stage([away.slice(start, record.n_samples)], OPTIONS)
    closed = np.polyadd(A, GAIN * np.asarray(B))
    ideal = signal.lfilter(A, closed, record.reference[:, 0])[start:]
    assert np.linalg.norm(stage.records[0].input[:, 0] - ideal) < 0.02 * np.linalg.norm(ideal)


def test_a_known_controller_tells_the_reference():
    """A PI controller in any units: denominator u + numerator y is numerator r, whatever the noise."""
    rng = np.random.default_rng(10)
    num, den = [3.0, -2.9], [1.0, -1.0]
    r, noise = rng.standard_normal(500), rng.standard_normal(500)
    u, y = np.zeros(500), noise.copy()
    for k in range(1, 500):
        y[k] = 0.9 * y[k - 1] + 0.05 * u[k - 1] + noise[k]
        u[k] = u[k - 1] + num[0] * (r[k] - y[k]) + num[1] * (r[k - 1] - y[k - 1])
    record = Record(u[:, None], y[:, None], DT, name="log")
    found = with_controller(record, num, den)
    np.testing.assert_allclose(found.reference[:, 0], np.convolve(r, num)[1:500], atol=1e-9)
    np.testing.assert_array_equal(found.input, record.input[1:])
    late = with_controller(record, num, [1.0, -1.0, 0.0])  # the same controller a sample later
    np.testing.assert_allclose(np.diff(u)[1:] + np.convolve(y, num)[1:499], late.reference[:, 0])
    with pytest.raises(ValueError, match=r"controller.*degree"):
        with_controller(record, [1.0, 2.0], [1.0])


def test_what_is_fed_back_is_seen_in_radii_of_the_ellipses():
    """Of the direct way noise in a loop is many of them; two-stage leaves none."""
    record = log(np.random.default_rng(11))
    opened = two_stage([record], OPTIONS).records
    times = [
        fed_back(tangent(used, identify(used, OPTIONS).model, BOUNDS), used) for used in ([record], opened)
    ]
    assert times[0] > 5
    assert times[1] < 1


PLANTS = {
    "stable": (sampled([40.0], [1.0, 1.5, 9.0]), IdentOptions(n_real=0, n_pairs=1)),
    "integrating": (sampled([40.0], [1.0, 1.5, 0.0]), IdentOptions(n_real=1, n_pairs=0, integrators=1)),
    "unstable": (sampled([40.0], [1.0, 1.5, -9.0]), IdentOptions(n_real=1, n_pairs=0)),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", PLANTS)
def test_ellipses_hold_the_plant_in_a_loop_with_noise(kind):
    """Two records with different controllers, a tenth of the motion is noise."""
    (num, den), options = PLANTS[kind]
    omega = np.geomspace(0.5, 300.0, 60)
    truth = signal.freqz(np.r_[0.0, num], den, worN=omega * DT)[1]
    held, bounds, runs = [], EmbeddingOptions(fir_length=20, prior_missed_mode=0.0), 30
    for seed in range(runs):
        records = [
            looped((num, den), [900 + seed, k], n=1000, noise=0.02, gains=gains)
            for k, gains in enumerate([(1.2, 0.08), (0.8, 0.12)])
        ]
        asked = options.with_unstable(find_unstable(records))
        stage = two_stage(records, asked)
        posterior = tangent(stage.records, identify(stage.records, asked).model, bounds)
        held.append(posterior.at(omega).contains(truth).mean())
    # Of a smooth response few frequencies are independent: one run has a standard deviation of 16 %.
    assert 0.95 - 3 * 0.16 / np.sqrt(runs) <= np.mean(held) <= 0.99


def test_records_without_reference_are_refused():
    record = log(np.random.default_rng(4), n=100)
    bare = Record(record.input, record.output, DT, name="b")
    with pytest.raises(ValueError, match=r"'b'.*reference"):
        two_stage([bare], OPTIONS)
