import numpy as np
import pytest

from ident import GobfModel, Poles, Structure, error_surface
from ident.fit.least_squares import fit
from ident.fit.regression import prepare
from tests.ident.benchmark_plants import as_record, max_length_sequence, run

POLE = Poles.from_continuous(omega_rad_s=[15.0], zeta=[0.015], dt_s=0.005)
TRUE = GobfModel(POLE, [1.0, 0.5], 0.005)


def resonant_record():
    """A second-order resonant system, as in the paper's Fig. 1, with a little noise."""
    A, B, C, D = TRUE.state_space()
    u = max_length_sequence(1, 1000)
    y = run((A, B, C, D), u)
    return as_record(u, y + 0.01 * np.std(y) * np.random.default_rng(0).normal(size=u.size))


@pytest.mark.parametrize("coordinates", ["raw", "log"])
def test_surface_is_the_fit_at_every_point(coordinates):
    record, structure = resonant_record(), Structure(estimate_offset=True)
    surface = error_surface([record], TRUE, structure, coordinates=coordinates, n_points=7)
    data = prepare([record], structure)
    for i in (0, 3, 6):
        for j in (0, 3, 6):
            a, b = surface.first[i], surface.second[j]
            if coordinates == "raw":
                re = a * (1 + b) / 2
                pole = complex(re, np.sqrt(max(b - re**2, 0)))
                if pole.imag == 0:
                    continue
            else:
                pole = np.exp(a * 0.005 * (-b + 1j * np.sqrt(1 - b**2)))
            expected = fit(data, Poles([], [pole])).rss / 1000
            assert surface.mean_square[i, j] == pytest.approx(expected, rel=1e-6)


def test_surface_is_lowest_at_the_pole_and_has_other_minima():
    surface = error_surface([resonant_record()], TRUE, Structure(), n_points=81)
    lowest, *others = surface.local_minima()
    assert surface.first[lowest[0]] == pytest.approx(surface.pole[0], rel=0.05)
    assert others  # the paper's point: descent alone is not enough
    assert surface.mean_square.min() < 0.1 * np.median(surface.mean_square)


def test_frozen_poles_stay():
    record = resonant_record()
    model = GobfModel(Poles([0.9], POLE.pairs), [0.0, 1.0, 0.5], 0.005)
    surface = error_surface([record], model, Structure(), first=np.array([15.0]), second=np.array([0.015]))
    expected = fit(prepare([record], Structure()), model.poles).rss / 1000
    assert surface.mean_square[0, 0] == pytest.approx(expected, rel=1e-6)


def test_what_cannot_be_drawn_is_refused():
    record = resonant_record()
    with pytest.raises(ValueError, match="pair 1"):
        error_surface([record], TRUE, Structure(), pair=1)
    with pytest.raises(ValueError, match="zeta"):
        error_surface([record], TRUE, Structure(), second=np.array([1.2]))
