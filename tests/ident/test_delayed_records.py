"""Records of a delayed plant that begin in the middle of things: at an operating point, and in motion.

The first rows answer to inputs that nobody recorded. The generator makes them from inputs before the record.
"""

import numpy as np
import pytest
from scipy import signal

from ident import GobfModel, IdentOptions, Poles, Record, identify
from ident.basis.options import EmbeddingOptions
from ident.checks.residual_tests import independence_test, whiteness_test
from ident.checks.validation import fit_on_fresh_data
from ident.friction import fit_friction
from ident.uncertainty.embedding import tangent

DT = 0.001
OMEGA = np.geomspace(5, 2500, 50)
BEFORE = 600


def plant(kind):
    """Numerator and denominator in z^-1."""
    if kind == "motor":
        a = np.exp(-DT / 0.0265)
        return np.array([0, 0.27 * (1 - a)]), np.array([1, -a])
    if kind == "mode":
        p = np.exp(DT * 2 * np.pi * 20 * (-0.05 + 1j))
        den = np.poly([p, p.conjugate()]).real
        return np.array([0, 0.5, 0.5]) * den.sum(), den
    a = np.exp(-30 * DT)
    return np.array([0, 0.05 * (1 - a)]), np.polymul([1, -a], [1, -1])


def measured(kind, delay, offset, seed, *, n=1500, noise_pole=0.0, size=500.0):
    """The last n samples of a run around an operating point, with the response to all that came before."""
    rng = np.random.default_rng(seed)
    num, den = plant(kind)
    move = size * np.repeat(rng.choice([-1.0, 1.0], (BEFORE + n) // 8 + 1), 8)[: BEFORE + n]
    y = signal.lfilter(np.concatenate([np.zeros(delay), num]), den, move)
    e = signal.lfilter([np.sqrt(1 - noise_pole**2)], [1, -noise_pole], rng.standard_normal(BEFORE + n))
    y = y + 0.03 * np.std(y) * e
    if kind != "integrator":
        y = y + offset * num.sum() / den.sum()
    u = move + (0 if kind == "integrator" else offset)
    return Record(u[BEFORE:, None], y[BEFORE:, None], DT, name="log")


def less(record, value):
    return Record(record.input - value, record.output, DT, name="log")


def truth(kind, delay):
    num, den = plant(kind)
    z = np.exp(1j * OMEGA * DT)
    powers = z[:, None] ** -np.arange(max(num.size, den.size))
    return powers[:, : num.size] @ num / (powers[:, : den.size] @ den) * z**-delay


def ellipses(kind, delay, record, **noise):
    options = IdentOptions(input_delay_samples=delay, integrators=int(kind == "integrator"))
    found = identify([record], options)
    return found, tangent([record], found.model, EmbeddingOptions(**noise))


CASES = [("motor", 14, 2000.0), ("motor", 3, -5000.0), ("mode", 14, 2000.0), ("integrator", 14, 0.0)]


# All cases, with both colours of noise, are in the long run.
@pytest.mark.parametrize(
    ("kind", "delay", "offset"),
    [pytest.param(*CASES[0], marks=pytest.mark.long), *CASES[2:]],
)
def test_ellipses_hold_the_truth_wherever_the_log_begins(kind, delay, offset):
    hits = []
    for seed in range(2):
        found, posterior = ellipses(kind, delay, measured(kind, delay, offset, seed))
        hits.append(posterior.at(OMEGA).contains(truth(kind, delay)).mean())
        assert found.model.order == {"motor": 1, "mode": 2, "integrator": 2}[kind]
    # The ellipses of a run move together; 0.12 with rows that answer to unrecorded input among the data.
    assert np.mean(hits) > 0.85


@pytest.mark.long
@pytest.mark.parametrize("noise_pole", [0.0, 0.8])
@pytest.mark.parametrize(("kind", "delay", "offset"), CASES)
def test_coverage_of_delayed_records(kind, delay, offset, noise_pole):
    hits = []
    for seed in range(20):
        record = measured(kind, delay, offset, seed, noise_pole=noise_pole)
        _, posterior = ellipses(kind, delay, record, coloured_noise=noise_pole > 0)
        hits.append(posterior.at(OMEGA).contains(truth(kind, delay)).mean())
    # Whole runs are worth few independent hits each: three standard deviations of the mean of the runs.
    assert np.mean(hits) > 0.95 - 3 * max(np.std(hits), 0.02) / np.sqrt(len(hits))


@pytest.mark.parametrize(("kind", "delay", "offset"), CASES[1:2])
def test_the_operating_point_changes_nothing(kind, delay, offset):
    record = measured(kind, delay, offset, 1)
    _, there = ellipses(kind, delay, record)
    _, shifted = ellipses(kind, delay, less(record, record.input[0, 0]))
    one, other = there.at(OMEGA), shifted.at(OMEGA)
    # What descents leave of the poles; with the same poles they are equal to rounding.
    assert np.max(one.normalised_distance(other.centre)) < 1e-3
    np.testing.assert_allclose(one.enclosing_radius(), other.enclosing_radius(), rtol=1e-3)


def test_validation_and_residual_tests_leave_the_same_rows_out():
    delay = 14
    record, fresh = (measured("motor", delay, 2000.0, seed) for seed in (2, 3))
    found, _ = ellipses("motor", delay, record)
    there = fit_on_fresh_data(found.model, fresh)
    shifted = fit_on_fresh_data(found.model, less(fresh, 2000.0))
    assert there.residual.size == there.simulated.size == fresh.n_samples - delay
    assert there.fit_percent == pytest.approx(shifted.fit_percent, abs=1e-9)
    assert there.answers
    np.testing.assert_allclose(there.residual, shifted.residual, atol=1e-8 * np.abs(fresh.output).max())
    assert there.fit_percent == pytest.approx(100 * (1 - 0.03), abs=0.5)
    assert whiteness_test([there.residual]).passed
    assert independence_test([fresh.input[:-delay, 0]], [there.residual]).passed


def test_a_record_no_longer_than_the_delay_is_refused_by_name():
    model = GobfModel(Poles([0.96]), np.array([0.1]), DT, input_delay_samples=14)
    short = measured("motor", 14, 0.0, 5, n=14)
    with pytest.raises(ValueError, match=r"log\D+14\D+14"):
        fit_on_fresh_data(model, short)


@pytest.mark.slow
def test_friction_leaves_the_rows_out_that_answer_to_no_recorded_input():
    rng = np.random.default_rng(6)
    u = np.repeat(rng.choice([-2.0, 2.0], 60), 10)
    a, delay = np.exp(-5 * 0.01), 4
    y = np.zeros(u.size)
    speed = 0.0
    for k in range(1, u.size):
        drive = u[k - 1 - delay] if k > delay else 0.0
        slip = drive - 0.5 * np.sign(speed if speed else drive)
        speed = a * speed + (1 - a) * slip if abs(drive) > 0.5 or speed else 0.0
        y[k] = y[k - 1] + 0.01 * speed
    y += 1e-5 * rng.standard_normal(u.size)
    record = Record(u[:, None], y[:, None], 0.01, name="shaft")
    options = IdentOptions(integrators=1, input_delay_samples=delay, n_real=1, n_pairs=0)
    found = fit_friction([record], options)
    assert found.residual(record).size == u.size - delay
    assert found.level == pytest.approx(0.5, rel=0.2)
