"""The stabilisation plot tells the modes of an independently simulated plant from peaks of its noise."""

from dataclasses import replace

import numpy as np
import pytest

from ident import IdentOptions, identify
from ident.stabilisation import DAMPING_TOLERANCE, FREQUENCY_TOLERANCE, stabilisation
from tests.ident.benchmark_plants import P2_HZ, P2_ZETA, as_record, p2


@pytest.fixture(scope="module")
def p2_plot():
    record = p2(1).record
    return stabilisation([record], identify([record]), max_pairs=7)


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.long) for seed in (3, 4))])
def test_the_three_modes_are_columns_and_nothing_else_is(seed):
    record = p2(seed).record
    plot = stabilisation([record], identify([record]))
    modes = plot.columns()
    # Cramer-Rao at 35 dB: 0.02 % in frequency; damping of the third mode 8 % (measured over 50 seeds).
    np.testing.assert_allclose([mode.omega_rad_s / (2 * np.pi) for mode in modes], P2_HZ, rtol=0.005)
    np.testing.assert_allclose([mode.zeta for mode in modes], P2_ZETA, rtol=0.25)


def test_spurious_pairs_may_stay_but_are_not_needed(p2_plot):
    away = np.abs(p2_plot.omega_rad_s[:, None] / (2 * np.pi * np.array(P2_HZ)) - 1).min(axis=1)
    spurious = away > 0.03
    assert spurious.sum() >= 8  # four fits beyond the plant's order
    assert not p2_plot.needed[spurious].any()
    # This is why staying alone does not make a mode here.
    assert (p2_plot.stable & spurious).any()
    assert len(p2_plot.columns()) == 3


def test_fits_are_nested_and_marks_follow_the_definition(p2_plot):
    assert p2_plot.rss.size == 8
    assert np.all(np.diff(p2_plot.rss) <= 0)
    assert np.bincount(p2_plot.n_pairs, minlength=8).tolist() == list(range(8))
    for k, j in enumerate(p2_plot.previous):
        if j < 0:
            assert not p2_plot.stable[k]
            continue
        assert p2_plot.n_pairs[j] == p2_plot.n_pairs[k] - 1
        assert abs(p2_plot.omega_rad_s[k] / p2_plot.omega_rad_s[j] - 1) < FREQUENCY_TOLERANCE
        near = abs(p2_plot.zeta[k] / p2_plot.zeta[j] - 1) < DAMPING_TOLERANCE
        assert p2_plot.stable[k] == near
    used = p2_plot.previous[p2_plot.previous >= 0]
    assert np.unique(used).size == used.size  # nobody is the counterpart of two


def test_the_chosen_fit_is_the_models():
    record = p2(5).record
    found = identify([record])
    plot = stabilisation([record], found)
    here = plot.n_pairs == plot.chosen
    np.testing.assert_allclose(plot.omega_rad_s[here], found.model.poles.omega_rad_s(0.005), rtol=1e-4)
    assert plot.rss[plot.chosen] <= found.rss * (1 + 1e-9)


def test_growth_ends_where_the_data_end():
    short = p2(0, 60).record
    found = identify([short], IdentOptions(n_real=1, n_pairs=1))
    plot = stabilisation([short], found)
    assert plot.rss.size < 1 + 3 + 1 + 12  # 60 samples do not carry twelve pairs
    rng = np.random.default_rng(0)
    noise = as_record(rng.normal(size=500), rng.normal(size=500))
    assert stabilisation([noise], identify([noise])).columns() == ()


def test_known_poles_are_not_drawn():
    truth = p2(3)
    w, zeta = 2 * np.pi * P2_HZ[0], P2_ZETA[0]
    pole = np.exp((-zeta + 1j * np.sqrt(1 - zeta**2)) * w * 0.005)
    options = IdentOptions(n_real=2, n_pairs=2, fixed_poles=((pole.real, pole.imag),))
    plot = stabilisation([truth.record], identify([truth.record], options), options, max_pairs=3)
    assert plot.n_real == 2
    assert np.abs(plot.omega_rad_s / w - 1).min() > 0.5


def test_shapes_are_checked(p2_plot):
    with pytest.raises(ValueError, match="pole pair"):
        replace(p2_plot, zeta=p2_plot.zeta[:-1])
