import numpy as np
import pytest

from plant import bang_bang, crest_factor, doublet, log_chirp, multisine, multisine_lines, prbs


@pytest.mark.parametrize("register_length", range(2, 21))
def test_prbs_has_full_period_and_the_autocorrelation_of_a_maximum_length_sequence(register_length):
    period = 2**register_length - 1
    signal = prbs(register_length, 1, 1.0, 2 * period, np.random.default_rng(register_length))
    one = signal[:period]
    np.testing.assert_array_equal(signal[period:], one)
    # sum_k s_k s_(k+l) is the period for l = 0 and -1 otherwise; by FFT exact to rounding, so to an integer.
    correlation = np.fft.irfft(np.abs(np.fft.rfft(one)) ** 2, period)
    np.testing.assert_allclose(correlation[0], period, rtol=1e-9)
    np.testing.assert_allclose(correlation[1:], -1, atol=1e-6)


def test_prbs_holds_scales_and_starts_where_told():
    held = prbs(5, 4, 2.5, 100)
    assert set(np.unique(held)) == {-2.5, 2.5}
    np.testing.assert_array_equal(held[:100:4], 2.5 * prbs(5, 1, 1.0, 25))
    np.testing.assert_array_equal(held, np.repeat(held[::4], 4))
    a = prbs(7, 1, 1.0, 127, [1, 0, 0, 0, 0, 0, 0])
    b = prbs(7, 1, 1.0, 127, [0, 1, 0, 1, 0, 0, 1])
    shifts = [np.array_equal(np.roll(a, k), b) for k in range(127)]
    assert sum(shifts) == 1


@pytest.mark.parametrize(
    ("signal", "arguments"),
    [
        *((prbs, (n, 1, 1.0, 10)) for n in (1, 21)),
        *[(prbs, (5, 0, 1.0, 10)), (prbs, (5, 1, np.nan, 10)), (prbs, (5, 1, 1.0, 0))],
        *((prbs, (5, 1, 1.0, 10, state)) for state in ([0, 0, 0, 0, 0], [1, 0])),
        *((multisine_lines, (1000, 0.005, band)) for band in ((0.0, 10.0), (5.0, 200.0), (0.41, 0.42))),
        *((multisine_lines, (1000, 0.005, (1, 9), grid)) for grid in ("odd_random", "even")),
        *((multisine, (lines, 400, 1.0)) for lines in ([], [0, 1], [1, 1], [200])),
        (log_chirp, (1.0, 1e4, 1.0, 100, 0.01)),
        (doublet, (1.0, -0.1, 0.3, 100, 0.005)),
    ],
)
def test_nonsense_is_refused(signal, arguments):
    random = {"rng": np.random.default_rng(0)} if signal is multisine else {}
    with pytest.raises(ValueError):
        signal(*arguments, **random)


def test_multisine_grids():
    full = multisine_lines(1000, 0.005, (0.2, 35.0))
    np.testing.assert_array_equal(full, np.arange(1, 176))
    odd = multisine_lines(1000, 0.005, (0.2, 35.0), "odd")
    assert np.all(odd % 2 == 1)
    assert odd.size == 88
    drawn = multisine_lines(1000, 0.005, (0.2, 35.0), "odd_random", np.random.default_rng(0))
    assert set(drawn) < set(odd)
    missing = np.setdiff1d(odd, drawn)
    # One of every four consecutive odd lines.
    np.testing.assert_array_equal(np.searchsorted(odd, missing) // 4, np.arange(22))


def test_multisine_excites_its_lines_and_no_others():
    rng = np.random.default_rng(5)
    lines = multisine_lines(700, 0.005, (0.5, 35.0), "odd_random", rng)
    signal = multisine(lines, 700, 1.7, rng, periods=3)
    assert signal.shape == (2100,)
    np.testing.assert_array_equal(signal[:700], signal[700:1400])
    assert np.sqrt(np.mean(signal**2)) == pytest.approx(1.7, rel=1e-12)
    spectrum = np.abs(np.fft.rfft(signal[:700])) * np.sqrt(2) / 700
    np.testing.assert_allclose(spectrum[lines], 1.7 / np.sqrt(lines.size), rtol=1e-10)
    assert np.max(np.delete(spectrum, lines)) < 1e-12


def test_more_draws_lower_the_crest_factor():
    lines = np.arange(1, 60)
    one = crest_factor(multisine(lines, 400, 1.0, np.random.default_rng(2)))
    best = crest_factor(multisine(lines, 400, 1.0, np.random.default_rng(2), draws=50))
    assert np.sqrt(2) < best < one


def test_log_chirp_sweeps_by_a_constant_factor():
    f0, f1, n, dt = 0.5, 20.0, 40000, 0.0005
    signal = log_chirp(f0, f1, 2.0, n, dt)
    assert np.max(np.abs(signal)) <= 2.0
    # Upward zero crossings count full turns: (f1 - f0) T / ln(f1 / f0) in all; the instantaneous frequency
    # follows.
    crossings = (np.flatnonzero((signal[:-1] < 0) & (signal[1:] >= 0)) + 0.5) * dt
    assert abs(crossings.size - (f1 - f0) * n * dt / np.log(f1 / f0)) <= 1.5
    middle = 0.5 * (crossings[1:] + crossings[:-1])
    np.testing.assert_allclose(1 / np.diff(crossings), f0 * (f1 / f0) ** (middle / (n * dt)), rtol=0.03)


def test_doublet_and_bang_bang_switch_where_they_should():
    signal = doublet(3.0, 0.1, 0.3, 200, 0.005)
    assert signal[19] == 0
    np.testing.assert_array_equal(np.unique(signal), [-3, 0, 3])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(signal)) + 1, [20, 80, 140])
    np.testing.assert_array_equal(bang_bang(3.0, 0.1, 0.6, 200, 0.005), signal)
    assert np.sum(signal) == 0
