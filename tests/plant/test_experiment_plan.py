import numpy as np
import pytest

from plant import ExperimentPlan, paper_link, simulate

DT = 0.005
ARM = {"band_Hz": (0.2, 95.0), "dt_s": DT, "lead_in_s": 1.0}


def test_records_share_their_lines_and_nothing_else():
    plan = ExperimentPlan.within(duration_s=100.0, rms_V=(2.0, 4.0), **ARM)
    voltages = plan.records(DT, np.random.default_rng(1))
    assert voltages.shape == (2, 4, plan.n_samples)
    assert voltages.size * DT == pytest.approx(plan.duration_s(DT))
    # The lead-in is the same periodic signal, so every window of a period has the same spectrum but a phase.
    assert np.array_equal(voltages[..., plan.period_samples :], voltages[..., : -plan.period_samples])
    spectra = np.fft.rfft(voltages[..., plan.lead_in_samples :][..., : plan.period_samples])
    excited = np.abs(spectra) > 1e-9 * np.abs(spectra).max()
    lines = plan.lines(DT)
    np.testing.assert_array_equal(np.flatnonzero(excited.all(axis=(0, 1))), lines)
    np.testing.assert_array_equal(np.flatnonzero(excited.any(axis=(0, 1))), lines)
    assert lines[0] * 0.2 == pytest.approx(0.2)  # the lower edge of the band is excited
    assert np.all(lines % 2 == 1)
    # One of four odd lines is left out.
    assert abs(lines.size / np.arange(1, lines[-1] + 1, 2).size - 0.75) < 0.01
    # Independent phases: the mean of H unit phasors is of size 1 / sqrt(H), here within four of them.
    phases = np.exp(1j * np.angle(spectra.reshape(8, -1)[:, lines]))
    products = np.abs(phases @ phases.conj().T)[np.triu_indices(8, 1)] / lines.size
    assert products.max() < 4 / np.sqrt(lines.size)


def test_the_period_is_the_longest_that_the_duration_allows():
    for duration_s, multiple in ((88.0, 1), (247.0, 1), (248.0, 3), (1e5, 15)):
        plan = ExperimentPlan.within(duration_s=duration_s, **ARM)
        assert plan.period_samples == multiple * 1000
        assert plan.duration_s(DT) <= duration_s
    with pytest.raises(ValueError, match=r"\b5 s\b.*\b8 records.*\b88 s\b.*\b87 s\b"):
        ExperimentPlan.within(duration_s=87.0, **ARM)


def test_the_ladder_reaches_the_first_of_its_limits_and_keeps_both():
    def motion(voltage):
        return simulate(paper_link(), voltage).hub_angle_true_rad

    plan = ExperimentPlan.within(duration_s=88.0, realisations=2, **ARM)
    for peak_V, angle_deg in ((24.0, 60.0), (5.0, 60.0)):
        drawn = plan.records(DT, np.random.default_rng(3))
        scaled = plan.scaled(drawn, peak_V=peak_V, angle_rad=np.radians(angle_deg), motion=motion)
        voltages = scaled.records(DT, np.random.default_rng(3))
        peak = np.abs(voltages).max() / peak_V
        turned = max(np.degrees(np.abs(motion(v)).max()) for rung in voltages for v in rung) / angle_deg
        assert 0.99 < max(peak, turned) <= 1.0  # three digits of the ladder, rounded down


def test_expected_radius_holds_the_response_in_95_percent():
    plan = ExperimentPlan(
        rms_V=(3.0,), period_samples=200, lead_in_samples=0, from_Hz=1.0, to_Hz=90.0, realisations=3
    )
    rng, lines, std = np.random.default_rng(5), None, 0.2
    lines = plan.lines(DT)
    inside = []
    for _ in range(60):
        u = plan.records(DT, rng)[0].reshape(3, 2, 200)
        spectra = (np.fft.rfft(signal)[..., lines] for signal in (u + std * rng.standard_normal(u.shape), u))
        y, u = spectra
        inside.append(np.abs(np.mean(y / u, axis=(0, 1)) - 1.0) < plan.radius(3.0, DT, std))
    # 60 x 68 lines: sd 0.34 %; four of those.
    assert abs(np.mean(inside) - 0.95) < 0.014


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rms_V": (1.0, 1.0)}, r"rms_V.*1\.0, 1\.0"),
        ({"rms_V": (-1.0,)}, r"rms_V.*-1\.0"),
        ({"band_Hz": (0.2, 101.0)}, r"\b100 Hz.*\b101\b"),
        ({"realisations": 0}, "realisations"),
        ({"period": 5}, "period"),
    ],
)
def test_nonsense_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        ExperimentPlan.within(**(ARM | {"duration_s": 100.0} | change))
