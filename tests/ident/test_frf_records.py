"""Repeated points of a frequency response: files, loops, means and regions of one more run."""

import numpy as np
import pytest

from ident import IdentOptions, identify_frf
from ident.data.frf_records import FrfRepeats
from ident.uncertainty import FrequencyUncertainty

DT = 0.01
GRID = np.geomspace(1, 100, 40)


def repeats(rng, n_runs, scatter=0.05, label="a", truth=None):
    g = 1 / (1 + 0.1j * GRID) if truth is None else truth
    noise = rng.standard_normal((n_runs, GRID.size)) + 1j * rng.standard_normal((n_runs, GRID.size))
    points = g * (1 + scatter * noise)
    return FrfRepeats(np.tile(GRID, n_runs), points.ravel(), (label,) * points.size)


def test_file_in_either_form_gives_the_same_points(tmp_path):
    points = repeats(np.random.default_rng(0), 3)
    rectangular = ["frequency_Hz,real,imag,date"]
    polar = ["date,omega_rad_per_s,gain,phase_rad"]
    for w, g in zip(points.omega_rad_s.tolist(), points.response.tolist(), strict=True):
        rectangular.append(f"{w / 2 / np.pi!r},{g.real!r},{g.imag!r},a")
        polar.append(f"a,{w!r},{abs(g)!r},{float(np.angle(g))!r}")
    for name, lines in (("r.csv", rectangular), ("p.csv", polar)):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        read = FrfRepeats.from_csv(tmp_path / name, label="date")
        np.testing.assert_allclose(read.omega_rad_s, points.omega_rad_s, rtol=1e-14)
        np.testing.assert_allclose(read.response, points.response, rtol=1e-14)
        assert read.labels == ("a",)


def test_bad_files_are_named_in_one_line(tmp_path):
    path = tmp_path / "bad.csv"
    for text, complaint in (
        ("omega_rad_s,real\n1,2\n", "line 1: "),
        ("omega_rad_s,real,imag\n1,2,x\n", "line 2: .*'imag' .*'x'"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=complaint) as error:
            FrfRepeats.from_csv(path)
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)


def test_label_must_exist(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("omega_rad_s,real,imag\n1,2,3\n")
    with pytest.raises(ValueError, match=r"date.*'omega_rad_s', 'real', 'imag'"):
        FrfRepeats.from_csv(path, label="date")
    with pytest.raises(ValueError, match="'b'"):
        FrfRepeats.from_csv(path).only("b")
    with pytest.raises(ValueError, match="no measured point"):
        FrfRepeats.from_csv(path).band(5, 6)
    with pytest.raises(ValueError, match=r"none\.csv"):
        FrfRepeats.from_csv(tmp_path / "none.csv")


def test_too_few_repeats_are_told_what_helps():
    once = FrfRepeats(np.arange(1.0, 6.0), np.ones(5))
    with pytest.raises(ValueError, match="variance_real"):
        once.mean(DT)
    # Two repeats give one degree of freedom each; with a neighbour on either side there are two at least.
    twice = FrfRepeats(np.repeat(np.arange(1.0, 6.0), 2), np.ones(10))
    with pytest.raises(ValueError, match=r"omega = 1 .*2 repeats.*at least 3.*pool_neighbours = 1"):
        twice.mean(DT)
    with pytest.raises(ValueError, match=r"pool_neighbours .*-1"):
        twice.mean(DT, pool_neighbours=-1)
    with pytest.raises(ValueError, match=r"outlier_threshold .*0"):
        twice.mean(DT, outlier_threshold=0.0)


def test_opened_loop_is_exact_and_agrees_with_the_mapped_ellipses():
    plant = 2.0 / (1j * GRID)
    rng = np.random.default_rng(1)
    closed = repeats(rng, 12, 0.01, truth=plant / (1 + 1.65 * plant))
    exact = FrfRepeats(GRID, plant / (1 + 1.65 * plant), ("",) * GRID.size).open_loop(1.0, 1.65)
    np.testing.assert_allclose(exact.response, plant, rtol=1e-12)
    opened = closed.open_loop(1.0, 1.65).mean(DT)
    loop = closed.mean(DT)
    rest = 1.0 - 1.65 * loop.centre
    # 1 % of T: above 3 rad/s |1 - 1.65 T| > 0.67, so second-order terms are 2 % of an ellipse.
    high = opened.omega_rad_s > 3
    np.testing.assert_allclose(opened.centre[high], (loop.centre / rest)[high], rtol=2e-3)
    ratio = (opened.enclosing_radius() / (loop.enclosing_radius() / np.abs(rest) ** 2))[high]  # dG/dT
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)


@pytest.mark.parametrize(("n_runs", "tolerance"), [(5, 0.02), (10, 0.02)])
def test_region_of_one_more_run_holds_it_at_its_level(n_runs, tolerance):
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(60):
        region = repeats(rng, n_runs).mean(DT, of="next run")
        hits.append(region.contains(repeats(rng, 1).response))
    # Hotelling's region is exact; 2400 trials, sd 0.45 %.
    assert np.mean(hits) == pytest.approx(0.95, abs=tolerance)


def test_wild_points_are_left_out_and_good_ones_kept():
    rng = np.random.default_rng(3)
    good = 1 + 0.01 * (rng.standard_normal(8) + 1j * rng.standard_normal(8))
    wild = np.array([1.5, 8.0, 15.0, 100.0, -40.0])
    points = FrfRepeats(np.ones(13), np.concatenate([good, wild]), ("",) * 13)
    found = points.mean(DT, outlier_threshold=6.0)
    assert found.centre[0] == pytest.approx(good.mean(), abs=1e-12)


def test_shared_gain_is_one_direction_of_the_posterior():
    frf = repeats(np.random.default_rng(4), 6).mean(DT)
    options = IdentOptions(n_real=1, n_pairs=0)
    plain = identify_frf(frf, options).posterior.at(GRID)
    wide = identify_frf(frf, options, shared_gain_std=0.03).posterior.at(GRID)
    g = plain.centre
    along = np.stack([g.real, g.imag], -1)
    expected = plain.covariance + 0.03**2 * along[:, :, None] * along[:, None, :]
    np.testing.assert_allclose(wide.covariance, expected, rtol=1e-9)
    with pytest.raises(ValueError, match="shared_gain_std"):
        identify_frf(frf, options, shared_gain_std=-1.0)


def test_records_are_checked_and_locked():
    with pytest.raises(ValueError, match=r"\(2,\), \(3,\) and 2"):
        FrfRepeats(np.ones(2), np.ones(3), ("", ""))
    with pytest.raises(ValueError, match="finite"):
        FrfRepeats(np.array([np.nan]), np.ones(1), ("",))
    with pytest.raises(ValueError, match="read-only"):
        repeats(np.random.default_rng(5), 1).response[0] = 0
    assert isinstance(repeats(np.random.default_rng(6), 4).mean(DT), FrequencyUncertainty)
    with pytest.raises(ValueError, match="omega = 1 rad/s"):
        FrfRepeats(np.ones(1), np.array([0.5]), ("",)).open_loop(1.0, 2.0)
