"""Levels of noise and distortion against systems of which both are known."""

import numpy as np
import pytest
from scipy import signal

from ident.checks.distortion_findings import distortion_findings
from ident.data.distortion import distortion_of, period_of
from ident.data.record import Record
from plant import ExperimentPlan

DT = 0.01
B, A = [0.0, 0.2, 0.1], [1.0, -1.5, 0.7]
PLAN = ExperimentPlan(
    rms_V=(1.0,), realisations=6, periods=3, period_samples=600, lead_in_samples=150, from_Hz=0.17, to_Hz=45.0
)


def record(u, y, name="r"):
    return Record(u[:, None], y[:, None], DT, name=name)


def records_of(rng, system, plan=PLAN):
    return [
        record(u, system(u), f"r{k}") for k, u in enumerate(plan.records(DT, rng).reshape(-1, plan.n_samples))
    ]


def test_linear_and_noisy_is_told_as_linear_with_its_noise():
    rng = np.random.default_rng(0)
    std, seen, held = 0.3, 0, []
    for _ in range(10):
        (found,) = distortion_of(
            records_of(rng, lambda u: signal.lfilter(B, A, u) + std * rng.standard_normal(u.size))
        )
        assert (found.realisations, found.periods, found.period_samples) == (6, 3, 600)
        # |E|^2 = N std^2 over |U|^2 = N^2 rms^2 / (2 H).
        expected = std * np.sqrt(2 * found.omega_rad_s.size / 600)
        level = np.sqrt(np.mean(found.noise_std**2))
        # 6 realisations x 2 x 101 lines and more: standard deviation below 2 %; four of them.
        assert level == pytest.approx(expected, rel=0.08)
        truth = signal.freqz(B, A, found.omega_rad_s * DT)[1]
        error = np.abs(found.gain - truth)
        held.append(np.mean(found.response(0.9).contains(truth)))
        assert np.sqrt(np.mean(error**2)) == pytest.approx(expected / np.sqrt(6 * 3), rel=0.3)
        for lines in (found.excited, found.odd, found.even):
            bands = [lines.within(low, high, 0.99) for low, high in found.bands_rad_s]
            seen += sum(band.significant for band in bands if band is not None)
    # 10 x 101 lines and more: standard deviation 0.9 %.
    assert np.mean(held) == pytest.approx(0.9, abs=0.03)
    # 10 x 15 bands at 0.5 % each: 0.75 expected, more than four once in a thousand.
    assert seen <= 4


def test_cubic_behind_a_filter_has_its_known_odd_distortion_and_gain():
    """y = w + c w^3 of Gaussian w with autocovariance r: best linear gain 1 + 3 c r(0), and the rest,
    orthogonal to w, has the autocovariance 6 c^2 r^3 (third Hermite polynomial; Price's theorem)."""
    rng, c = np.random.default_rng(1), 0.2
    # Phases as they are drawn: those of low crest factor are less Gaussian.
    plan = PLAN.model_copy(update={"realisations": 40, "to_Hz": 49.9, "phase_draws": 1})
    (found,) = distortion_of(
        records_of(rng, lambda u: u + c * u**3 + 0.02 * rng.standard_normal(u.size), plan)
    )
    np.testing.assert_allclose(np.mean(found.gain), 1 + 3 * c, rtol=0.01)
    of_line = np.zeros(301)
    of_line[plan.lines(DT)] = 0.5 / found.omega_rad_s.size
    r = 600 * np.fft.irfft(of_line)
    expected = 6 * c**2 * np.fft.rfft(r**3).real / (600 * 0.5 / found.omega_rad_s.size)
    for lines, power_of in ((found.excited, 0.02), (found.odd, 0.04)):
        at = np.round(lines.omega_rad_s * 600 * DT / (2 * np.pi)).astype(int)
        rest = lines.power - lines.noise
        # 39 x 112 and 40 x 38 independent values: 1.5 and 2.6 %.
        assert rest.mean() == pytest.approx(expected[at].mean(), rel=4 * power_of)
        np.testing.assert_allclose(rest, expected[at], rtol=6 / np.sqrt(39))
    low, high = found.bands_rad_s[-1]
    band = found.excited.within(low, high, 0.999)
    at = (found.omega_rad_s >= low) & (found.omega_rad_s < high)
    level = np.sqrt(expected[plan.lines(DT)[at]].mean()) / (1 + 3 * c)
    assert band.interval[0] < level < band.interval[1]
    even = found.even.within(found.omega_rad_s[0], found.omega_rad_s[-1], 0.99)
    assert not even.significant


def test_squarer_shows_at_even_detection_lines_only():
    rng = np.random.default_rng(2)

    def system(u):
        return signal.lfilter(B, A, u) + 0.05 * u**2 + 0.01 * rng.standard_normal(u.size)

    (found,) = distortion_of(records_of(rng, system))
    ends = found.omega_rad_s[0], found.omega_rad_s[-1] * 1.001
    assert found.even.within(*ends, 0.99).significant
    assert not found.odd.within(*ends, 0.99).significant
    assert not found.excited.within(*ends, 0.99).significant


def test_drift_and_start_leave_the_levels_alone():
    rng = np.random.default_rng(3)

    def system(u, drift=0.0, start=0.0):
        at_start = signal.lfilter([1.0], A, np.eye(1, u.size)[0])
        return signal.lfilter(B, A, u) + start * at_start + drift * np.arange(u.size)

    inputs = PLAN.records(DT, rng)[0]
    (clean,) = distortion_of([record(u, system(u)) for u in inputs])
    (moved,) = distortion_of([record(u, system(u, 0.02, 5.0)) for u in inputs])
    assert moved.drift == pytest.approx(0.02 * 600, rel=1e-3)
    np.testing.assert_allclose(moved.gain, clean.gain, rtol=1e-6)
    assert moved.excited.power.max() < 1e-10 * np.abs(clean.gain).max() ** 2


def test_amplitudes_are_told_apart_and_equal_inputs_are_further_periods():
    rng = np.random.default_rng(4)
    plan = PLAN.model_copy(update={"rms_V": (1.0, 3.0), "realisations": 2})
    records = records_of(rng, lambda u: signal.lfilter(B, A, u), plan)
    found = distortion_of([*records, *records[:2]])
    assert [f.rms for f in found] == pytest.approx([1.0, 3.0])
    assert [(f.realisations, len(f.names)) for f in found] == [(2, 4), (2, 2)]
    (single,) = distortion_of(records[:1])
    assert single.excited is None
    assert single.odd is not None
    assert single.noise_std is not None


def test_period_is_found_where_there_is_one():
    rng = np.random.default_rng(5)
    slow = signal.lfilter([0.02], [1.0, -0.98], np.tile(rng.standard_normal(400), 3))[400:]
    assert period_of(slow) == 400
    assert period_of(np.tile(rng.standard_normal(150), 4)[37:]) == 150
    assert period_of(rng.standard_normal(500)) is None
    assert period_of(np.ones(200)) is None
    assert period_of(np.sin(np.linspace(0, 9, 400) ** 2)) is None
    assert distortion_of([record(u, u) for u in rng.standard_normal((2, 300))]) == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda u: (u[:500], u[:500]), r"record 'bad': 500 samples are no period of 600"),
        (lambda u: (np.roll(u, 5) + np.arange(u.size), u), "'bad': the input does not repeat after 600"),
        (lambda u: (u, np.full_like(u, 0.3)), "'bad': output column 'y' stands still at 0.3"),
    ],
)
def test_records_that_carry_nothing_are_refused(change, words):
    (u,) = PLAN.model_copy(update={"realisations": 1}).records(DT, np.random.default_rng(6))[0]
    with pytest.raises(ValueError, match=words):
        distortion_of([record(*change(u), "bad")], period_samples=600)


def test_periods_that_differ_are_refused():
    rng = np.random.default_rng(7)
    one, other = (np.tile(rng.standard_normal(n), 3) for n in (100, 120))
    with pytest.raises(ValueError, match="repeats after 120 samples, that of record 'a' after 100"):
        distortion_of([record(one, one, "a"), record(other, other, "b")])


def verdicts(records):
    return {item.kind.name: item.values for item in distortion_findings(records, distortion_of(records))}


def test_verdicts_name_kind_and_trend():
    ladder = PLAN.model_copy(update={"rms_V": (1.0, 3.0), "to_Hz": 20.0})
    rng = np.random.default_rng(8)

    def behind(static, noise=0.002):
        return lambda u: signal.lfilter(B, A, static(u)) + noise * rng.standard_normal(u.size)

    linear = verdicts(records_of(rng, behind(lambda u: u), ladder))
    assert linear.keys() == {"LINEAR"}
    assert linear["LINEAR"]["percent"] < 1
    rubbing = verdicts(records_of(rng, behind(lambda u: u - 0.2 * np.sign(u)), ladder))["DISTORTED"]
    assert (rubbing["parity"], rubbing["trend"]) == ("odd", "falls")
    stiff = verdicts(records_of(rng, behind(lambda u: np.clip(u, -4, 4)), ladder))["DISTORTED"]
    assert (stiff["parity"], stiff["trend"]) == ("odd", "grows")
    leaning = verdicts(records_of(rng, behind(lambda u: u + 0.1 * u**2), ladder))
    assert leaning["LINEAR"]["percent"] < 1  # no even distortion at odd lines: the model is not touched
    both = verdicts(records_of(rng, behind(lambda u: u + 0.1 * u**2 - 0.05 * u**3), ladder))["DISTORTED"]
    assert both["parity"] == "both"


def test_what_cannot_be_told_is_said():
    rng = np.random.default_rng(9)
    records = records_of(rng, lambda u: signal.lfilter(B, A, u) + 0.01 * rng.standard_normal(u.size))
    assert "ONE_REALISATION" in verdicts(records[:1])
    two = [r.slice(0, 1350) for r in records[:2]]  # lead-in and two periods
    assert "ONE_PERIOD" not in verdicts(two)
    assert "ONE_PERIOD" in verdicts([r.slice(150, 1350) for r in records[:2]])  # the first is the transient
    drowned = records_of(rng, lambda u: signal.lfilter(B, A, u) + 30 * rng.standard_normal(u.size))
    assert "NOISE_HIDES" in verdicts(drowned)
    u = rng.standard_normal(1000)
    assert verdicts([record(u, signal.lfilter(B, A, u))])["NOT_PERIODIC"]["n_records"] == 1
    clipped = records_of(rng, lambda u: np.clip(signal.lfilter(B, A, u), -1.0, 1.0))
    assert "CLIPPED" in verdicts(clipped)
