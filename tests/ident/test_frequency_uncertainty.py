"""Ellipses, distances, user's files and repeated measurements against known truth."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ident.data.frf_records import FrfRepeats
from ident.uncertainty import FrequencyUncertainty

DT = 0.01
OMEGA = np.array([1.0, 2.0, 5.0])


def covariance_of(s1, s2, angle):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ np.diag([s1**2, s2**2]) @ turn.T


def single(covariance, centre=1 + 2j, level=0.95):
    return FrequencyUncertainty(np.array([1.0]), np.array([centre]), covariance[None], DT, level)


@given(major=st.floats(-12, 3), ratio=st.floats(-6, 0), angle=st.floats(0, np.pi))
def test_axes_come_back_from_any_covariance(major, ratio, angle):
    s1, s2 = 10.0**major, 10.0 ** (major + ratio)
    record = single(covariance_of(s1, s2, angle))
    ellipse = record.ellipse()
    assert record.enclosing_radius()[0] == ellipse.semi_major[0]
    radius = np.sqrt(-2 * np.log(0.05))
    assert ellipse.semi_major[0] == pytest.approx(radius * s1, rel=1e-9)
    # The covariance itself carries s2^2 to eps * s1^2 only.
    assert abs(ellipse.semi_minor[0] ** 2 - (radius * s2) ** 2) <= 1e-14 * (radius * s1) ** 2
    if ratio < -0.1:
        cross = (ellipse.direction * np.exp(-1j * angle)).imag
        assert abs(cross[0]) < 1e-9


@given(angle=st.floats(0, np.pi), ratio=st.floats(-4, 0), inside=st.floats(0, 2 * np.pi))
def test_distance_is_one_on_the_boundary_and_scales(angle, ratio, inside):
    s1, s2 = 0.3, 0.3 * 10.0**ratio
    record = single(covariance_of(s1, s2, angle))
    radius = np.sqrt(-2 * np.log(0.05))
    point = radius * np.exp(1j * angle) * (s1 * np.cos(inside) + 1j * s2 * np.sin(inside))
    for stretch in (0.5, 0.999, 1.001, 3.0):
        response = record.centre + stretch * point
        assert record.normalised_distance(response)[0] == pytest.approx(stretch, rel=1e-6)
        assert record.contains(response)[0] == (stretch < 1)


def test_degenerate_ellipses_contain_themselves_and_nothing_else():
    point = single(np.zeros((2, 2)))
    assert point.contains(np.array([1 + 2j]))[0]
    assert not point.contains(np.array([1 + 2j + 1e-12]))[0]
    segment = single(covariance_of(1.0, 0.0, 0.4))
    along = np.exp(0.4j)
    assert segment.ellipse().semi_minor[0] <= 1e-7
    assert segment.contains(np.array([1 + 2j + 2.0 * along]))[0]
    assert not segment.contains(np.array([1 + 2j + 1e-3j * along]))[0]
    tiny = single(np.eye(2) * 1e-300, centre=0j)
    assert tiny.ellipse().semi_major[0] == pytest.approx(np.sqrt(-2 * np.log(0.05)) * 1e-150, rel=1e-12)


def test_boundary_points_lie_at_distance_one():
    record = FrequencyUncertainty(
        OMEGA, np.ones(3), np.stack([covariance_of(1, r, 0.3) for r in (1, 0.1, 1e-3)]), DT
    )
    for column in record.ellipse().boundary(16).T:
        np.testing.assert_allclose(record.normalised_distance(record.centre + column), 1.0, rtol=1e-8)


def test_to_control_and_round_trip(tmp_path):
    rng = np.random.default_rng(2)
    factor = rng.standard_normal((3, 2, 2))
    record = FrequencyUncertainty(
        OMEGA, rng.standard_normal(3) + 1j, factor @ factor.transpose(0, 2, 1), DT, 0.9, "test"
    )
    response = record.to_control()
    assert response.dt == DT
    np.testing.assert_array_equal(response.frdata[0, 0], record.centre)
    record.to_csv(tmp_path / "a.csv")
    again = FrequencyUncertainty.from_csv(tmp_path / "a.csv", DT, level=0.9)
    for name in ("omega_rad_s", "centre", "covariance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(record, name))
    assert (again.dt_s, again.level) == (DT, 0.9)
    with pytest.raises(ValueError, match="read-only"):
        record.covariance[0, 0, 0] = 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"omega_rad_s": [1.0, 3.0, 2.0]}, "increasing.*omega = 2"),
        ({"omega_rad_s": [1.0, 2.0, 400.0]}, r"314\.159 rad/s.*omega = 400"),
        ({"omega_rad_s": [-1.0, 2.0, 4.0]}, "negative.*omega = -1"),
        ({"omega_rad_s": [1.0, np.nan, 4.0]}, "omega .*finite.*omega = nan"),
        ({"centre": [1.0, np.inf, 1.0]}, r"centre .*finite.*omega = 2"),
        ({"covariance": [np.eye(2), np.diag([1.0, -1.0]), np.eye(2)]}, "semidefinite.*omega = 2"),
        ({"covariance": [np.eye(2), [[1, 2], [2, 1]], np.eye(2)]}, "semidefinite.*omega = 2"),
        ({"covariance": [np.eye(2), [[1, 0.2], [0, 1]], np.eye(2)]}, "symmetric.*omega = 2"),
        ({"covariance": [np.eye(2)]}, r"\(1, 2, 2\)"),
        ({"dt_s": 0.0}, "dt_s .*0.0"),
        ({"level": 1.0}, "level .*1.0"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, message):
    values = {"omega_rad_s": OMEGA, "centre": np.ones(3), "covariance": [np.eye(2)] * 3, "dt_s": DT} | change
    with pytest.raises(ValueError, match=message) as caught:
        FrequencyUncertainty(**values)
    assert "\n" not in str(caught.value)


HEADER = "omega_rad_s,real,imag,variance_real,variance_imag,covariance_real_imag\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER + "1,1,0,1,1,0\n2,1,x,1,1,0\n", "line 3: .*'imag' .*'x'"),
        (HEADER + "1,1,nan,1,1,0\n", "line 2: .*'imag' .*'nan'"),
        (HEADER + "1,1,0,-1,1,0\n", "line 2: .*variance .*negative"),
        (HEADER + "1,1,0,1,1,2\n", "semidefinite.*omega = 1"),
        (HEADER + "2,1,0,1,1,0\n1,1,0,1,1,0\n", "increasing.*omega = 1"),
        (HEADER + "1,1,0\n", "line 2: 3 cells .*line 1 has 6"),
        (HEADER, "no rows"),
        ("omega_rad_s,real\n1,2\n", "'imag'.*omega_rad_s, real"),
        ("real,imag\n1,2\n", "exactly one of the columns .*omega_rad_s"),
    ],
)
def test_csv_errors_name_file_and_place(tmp_path, text, message):
    path = tmp_path / "frf.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        FrequencyUncertainty.from_csv(path, DT)
    assert "frf.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("repeats", "pool"), [(10, 0), (4, 0), (3, 2)])
def test_ellipse_from_repeats_covers_the_truth_at_its_level(repeats, pool):
    rng = np.random.default_rng(3)
    omega = np.arange(1.0, 201.0)
    truth = (2 + np.sin(omega)) * np.exp(1j * omega)
    factor = np.linalg.cholesky(covariance_of(0.1, 0.02, 0.5))
    noise = rng.standard_normal((repeats, omega.size, 2)) @ factor.T
    # Scatter fixed relative to the response, so that pooling over neighbours is right.
    points = truth * (1 + noise[..., 0] + 1j * noise[..., 1])
    record = FrfRepeats(np.tile(omega, repeats), points.ravel()).mean(0.001, pool_neighbours=pool)
    hits = record.contains(truth).sum()
    # Hotelling is exact without pooling; 4 binomial standard deviations of 200 at 0.95 are 12.
    assert abs(hits - 190) <= 12
