"""Empirical responses against known systems, open and closed loop, and coherence."""

import numpy as np
import pytest
from scipy import signal

from ident.data.nonparametric import coherence, empirical_frf
from ident.data.record import Record

DT = 0.01
B, A = [0.0, 0.2, 0.1], [1.0, -1.5, 0.7]


def truth(omega):
    return signal.freqz(B, A, worN=omega * DT)[1]


def record(u, y, r=None):
    reference = None if r is None else r[:, None]
    names = () if r is None else ("r",)
    return Record(u[:, None], y[:, None], DT, name="a", reference=reference, reference_names=names)


def periodic_records(rng, n_records, noise, n=512):
    u = rng.standard_normal(n)
    steady = signal.lfilter(B, A, np.tile(u, 4))[-n:]
    return [record(u, steady + noise * rng.standard_normal(n)) for _ in range(n_records)]


def test_noise_free_periods_give_the_exact_response():
    frf = empirical_frf(periodic_records(np.random.default_rng(0), 3, 0.0), periodic=True)
    # The start transient 0.837^1536 is below rounding.
    np.testing.assert_allclose(frf.centre, truth(frf.omega_rad_s), rtol=1e-9)
    assert frf.enclosing_radius().max() < 1e-8


@pytest.mark.parametrize("n_records", [3, 6])
def test_ellipses_of_repeats_cover_at_their_level(n_records):
    rng = np.random.default_rng(1)
    hits = np.concatenate(
        [
            (frf := empirical_frf(periodic_records(rng, n_records, 0.5), periodic=True)).contains(
                truth(frf.omega_rad_s)
            )
            for _ in range(8)
        ]
    )
    # 8 x 256 independent frequencies: sd 0.5 %; 4 of those. (Circular noise makes the widened region exact.)
    assert abs(hits.mean() - 0.95) < 0.02


def test_single_record_by_averaging_lines_and_drift_does_not_leak():
    rng = np.random.default_rng(2)
    n = 20_000
    u = rng.standard_normal(n)
    y = signal.lfilter(B, A, u) + 30.0 + 20.0 * np.arange(n) / n
    band = {"omega_min_rad_s": 1.0, "omega_max_rad_s": 100.0, "half_width_lines": 10}
    drift_removed = empirical_frf([record(u, y)], **band)
    leaking = empirical_frf([record(u, y)], periodic=True, **band)
    error = np.abs(drift_removed.centre / truth(drift_removed.omega_rad_s) - 1)
    assert error.max() < 0.02
    worst = np.abs(leaking.centre / truth(leaking.omega_rad_s) - 1).max()
    assert worst > 5 * error.max()


def closed_loop_records(rng, n_records, n=4000, gain=0.8, noise=0.3):
    r = np.sin(2 * np.pi * np.cumsum(np.linspace(0.001, 0.3, n)))
    records = []
    for _ in range(n_records):
        e = noise * rng.standard_normal(n)
        # u = r - g y, y = B/A u + e: polynomials of the closed loop, strictly proper plant.
        closed = np.polyadd(A, gain * np.asarray(B))
        y = signal.lfilter(B, closed, r) + signal.lfilter(A, closed, e)
        records.append(record(r - gain * y, y, r))
    return records


def test_reference_as_instrument_removes_the_closed_loop_bias():
    records = closed_loop_records(np.random.default_rng(3), 40)
    options = {"half_width_lines": 8, "omega_min_rad_s": 2.0, "omega_max_rad_s": 150.0}
    by_reference = empirical_frf(records, **options)
    bare = [Record(r.input, r.output, DT, name=r.name) for r in records]
    direct = empirical_frf(bare, **options)
    g = truth(by_reference.omega_rad_s)
    weak = np.abs(g) < 0.3
    assert by_reference.method == "empirical, by reference"
    assert np.median(np.abs(by_reference.centre - g)[weak]) < 0.02
    # Noise through the loop pulls the direct estimate towards -1 / feedback gain.
    assert np.median((direct.centre - g).real[weak]) < -0.04
    assert by_reference.contains(g).mean() > 0.85


def test_repeated_distortion_is_not_averaged_away():
    rng = np.random.default_rng(4)
    n = 3000
    u = rng.standard_normal(n)
    distortion = 0.5 * signal.lfilter(B, A, rng.standard_normal(n))  # the same in every repeat
    records = [
        record(u, signal.lfilter(B, A, u) + distortion + 1e-3 * rng.standard_normal(n)) for _ in range(9)
    ]
    frf = empirical_frf(records, half_width_lines=4, omega_min_rad_s=5.0)
    assert frf.contains(truth(frf.omega_rad_s)).mean() == pytest.approx(0.95, abs=0.06)
    blind = empirical_frf(records, half_width_lines=0, omega_min_rad_s=5.0)
    assert blind.contains(truth(blind.omega_rad_s)).mean() < 0.2


def test_coherence_is_the_share_of_linear_power():
    rng = np.random.default_rng(5)
    n, noise = 60_000, 0.7
    u = rng.standard_normal(n)
    y = signal.lfilter(B, A, u) + noise * rng.standard_normal(n)
    omega, value = coherence([record(u, y)], half_width_lines=100)
    power = np.abs(truth(omega)) ** 2
    expected = power / (power + noise**2)
    # 201 lines: the coherence estimate has sd about sqrt(2 c) (1 - c) / sqrt(201) <= 0.04 and bias 1 / 201.
    np.testing.assert_allclose(value, expected, atol=0.15)
    assert np.abs(value - expected).mean() < 0.03


def test_bad_input_is_refused():
    u = np.random.default_rng(6).standard_normal(50)
    with pytest.raises(ValueError, match="record"):
        empirical_frf([])
    with pytest.raises(ValueError, match=r"40 samples at 0.01 s.*50 at 0.01 s"):
        empirical_frf([record(u, u), record(u[:40], u[:40])])
    with pytest.raises(ValueError, match="half_width_lines >= 1"):
        empirical_frf([record(u, u)], half_width_lines=0)
    with pytest.raises(ValueError, match=r"half_width_lines .*-1"):
        empirical_frf([record(u, u)], half_width_lines=-1)
    with pytest.raises(ValueError, match=r"5 lines .*1000"):
        empirical_frf([record(u, u)], omega_min_rad_s=1000.0)
    # Five lines of half a second: the first is 2 pi / 0.5 s.
    with pytest.raises(ValueError, match=r"omega = 12\.5664 rad/s"):
        empirical_frf([record(np.zeros(50), u)])
