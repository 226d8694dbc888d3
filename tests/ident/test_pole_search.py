import typing

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.signal import lfilter

from ident.basis.coordinates import search_space
from ident.basis.functions import block_parameters
from ident.basis.options import Algorithm, IdentOptions
from ident.basis.poles import Poles
from ident.fit.regression import prepare
from ident.search.direct import best_apart, minimise
from ident.search.pole_search import PoleSearch
from tests.ident.benchmark_plants import as_record, p1, p2

DIRECT = [name for name in typing.get_args(Algorithm) if "DIRECT" in name]


@given(st.lists(st.floats(0, 1), min_size=6, max_size=6), st.sampled_from(["log", "raw"]))
def test_points_of_the_cube_are_ordered_poles_inside_the_circle(unit, coordinates):
    space = search_space(2, 2, 1000, 0.005, IdentOptions(coordinates=coordinates))
    unit = np.array(unit)
    poles = space.poles(unit)
    assert np.all(np.abs(poles.values) < 1)
    point = space.coordinates(unit[None, :])[0]
    assert point[0] <= point[1] + 1e-12
    assert point[2] <= point[4] + 1e-12
    if coordinates == "log":
        np.testing.assert_allclose(space.blocks(unit), block_parameters(poles), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(10 ** point[[2, 4]], poles.omega_rad_s(0.005), rtol=1e-9)
        np.testing.assert_allclose(10 ** point[[3, 5]], poles.zeta(), rtol=1e-6)
        np.testing.assert_allclose(1 - 10 ** point[:2], poles.real, rtol=1e-12)


def test_box_comes_from_length_and_sampling_time():
    space = search_space(1, 1, 1000, 0.01, IdentOptions())
    corners = 10 ** space.coordinates(np.array([[0.0, 0, 0], [1, 1, 1]]))
    np.testing.assert_allclose(corners[0], [0.2e-3, 4 * np.pi / 10, 1e-3])
    np.testing.assert_allclose(corners[1], [0.7, 90 * np.pi, 0.63])


def test_given_bounds_replace_the_sides_of_the_box():
    pairs = {"omega_min_rad_s": 5, "omega_max_rad_s": 50, "zeta_min": 0.01, "zeta_max": 0.1}
    options = IdentOptions(**pairs, decay_min_per_s=1, decay_max_per_s=20)
    space = search_space(1, 1, 1000, 0.01, options)
    corners = 10 ** space.coordinates(np.array([[0.0, 0, 0], [1, 1, 1]]))
    np.testing.assert_allclose(corners[0], [1 - np.exp(-0.01), 5, 0.01])
    np.testing.assert_allclose(corners[1], [1 - np.exp(-0.2), 50, 0.1])


def test_an_empty_box_is_refused():
    with pytest.raises(ValueError, match="pair frequency"):
        search_space(1, 1, 1000, 0.01, IdentOptions(omega_min_rad_s=1e4))


@pytest.mark.parametrize("algorithm", DIRECT)
def test_every_variant_of_direct_finds_the_lowest_of_many_minima(algorithm):
    def cost(x):
        return np.sum((x - [0.3, 0.8]) ** 2 - 0.02 * np.cos(40 * (x - [0.3, 0.8])), axis=-1)

    points, costs = minimise(cost, 2, algorithm, 800)
    assert len(costs) >= 300
    best = points[np.argmin(costs)]
    # Neighbouring minima are 2 pi/40 = 0.16 away.
    np.testing.assert_allclose(best, [0.3, 0.8], atol=0.05)


def searching(record, **options):
    options = IdentOptions(**options)
    return PoleSearch(prepare([record], options.structure()), options)


def test_best_points_are_apart():
    points = np.array([[0.5, 0.5], [0.52, 0.5], [0.9, 0.9], [0.1, 0.1]])
    chosen = best_apart(points, np.array([1.0, 1.1, 2.0, 3.0]), 3)
    np.testing.assert_array_equal(chosen, points[[0, 2, 3]])


def test_a_pair_between_two_close_modes_is_split_into_both():
    # 3 % apart, half widths of 0.5 %: one pair in the middle is what a model with a pair less ends with.
    true = Poles.from_continuous(omega_rad_s=[19.7, 20.3, 60.0], zeta=[0.005, 0.005, 0.01], dt_s=0.005)
    u = np.sign(np.random.default_rng(0).standard_normal(1000))
    modes = zip((1.0, -1.0, 3.0), true.pairs, strict=True)
    y = sum(lfilter([0.0, gain], [1.0, -2 * pole.real, abs(pole) ** 2], u) for gain, pole in modes)
    search = searching(as_record(u, y + 1e-3 * np.std(y) * np.random.default_rng(1).standard_normal(u.size)))
    between = Poles.from_continuous(omega_rad_s=[20.0, 60.0], zeta=[0.02, 0.01], dt_s=0.005)
    found = search.split_pair(search.descend(between, "one pair less").poles)
    assert found.rss < 1.02e-6 * u.size * np.var(y)
    np.testing.assert_allclose(np.sort(found.poles.omega_rad_s(0.005)), [19.7, 20.3, 60.0], rtol=1e-3)


@pytest.mark.parametrize("algorithm", ["GN_DIRECT_L", "GN_ORIG_DIRECT_L"])
def test_joint_search_finds_the_mode_and_traces_it(algorithm):
    search = searching(p1(0).record, algorithm=algorithm)
    end = search.rescan(search.joint(2, 1))
    assert end.poles.omega_rad_s(0.005)[0] == pytest.approx(15.0, rel=0.02)
    stage = search.stages[0]
    assert stage.points.shape == (stage.log_cost.size, 4)
    assert stage.log_cost.size >= 0.9 * IdentOptions().evaluations  # scipy ends between iterations
    assert search.evaluations >= stage.log_cost.size
    assert min(minimum.rss for minimum in search.minima) == end.rss


def test_paper_coordinates_can_be_chosen():
    search = searching(p1(1).record, coordinates="raw")
    search.joint(2, 1)
    assert search.stages[0].coordinate_names == ("x 1", "x 2", "beta 1", "gamma 1")


def test_rescan_leaves_a_wrong_minimum():
    """A descent from far above the mode ends in a local minimum; the rescan of the pair finds the mode."""
    search = searching(p1(2).record)
    start = Poles.from_continuous(decay_per_s=[0.1, 25], omega_rad_s=[104.0], zeta=[0.1], dt_s=0.005)
    wrong = search.descend(start, "start")
    right = search.rescan(wrong)
    assert wrong.poles.omega_rad_s(0.005)[0] > 50
    assert right.poles.omega_rad_s(0.005)[0] == pytest.approx(15.0, rel=0.02)
    assert right.rss < 0.2 * wrong.rss


def test_a_further_mode_is_found_on_the_residual():
    search = searching(p2(0).record)
    first = search.rescan(search.joint(2, 1))
    second = search.add_pair(first.poles)
    found = np.sort(second.poles.omega_rad_s(0.005)) / 2 / np.pi
    np.testing.assert_allclose(found, [2.5, 11.0], rtol=0.01)


def test_no_poles_to_search_means_the_fixed_ones():
    rng = np.random.default_rng(0)
    record = as_record(rng.normal(size=100), rng.normal(size=100))
    search = searching(record, fixed_poles=((0.9, 0.0), (0.8, 0.1)))
    end = search.joint(0, 0)
    np.testing.assert_array_equal(end.poles.values, [0.9, 0.8 + 0.1j, 0.8 - 0.1j])
