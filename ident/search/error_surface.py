"""The cost over one pole pair with everything else frozen: the paper's Fig. 1 for any record and model.

`error_surface` moves one pair of a fitted model over a grid and fits coefficients and nuisances anew at every
point. The picture shows how many local minima a descent could end in. Coordinates are those of the pole
search: (beta, gamma) of equation (29) of the paper that the package follows (its terms are in the glossary),
with gamma = |p|^2 and beta = 2 Re p / (1 + gamma) of a pole p; or frequency and damping ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter

from ident.basis.coordinates import SearchSpace
from ident.basis.model import GobfModel
from ident.basis.structure import Structure
from ident.data.arrays import RealArray, lock
from ident.data.record import Record
from ident.data.shown import Shown
from ident.fit.regression import prepare

# Default window, for a picture that holds the pair's own valley and its neighbours. Frequency: a factor of
# four, two octaves, each way. Chosen.
OMEGA_FACTOR = 4

# Share of the Nyquist frequency at which the window ends at most: at Nyquist itself a pair is two real poles.
BELOW_NYQUIST = 0.99
# Damping ratio, and width 1 - gamma: a factor of 30 each way, a decade and a half. Chosen.
DAMPING_FACTOR = 30

# Least damping ratio of the window: a lighter pair rings for more than ten thousand periods.
LEAST_ZETA = 1e-5

# Largest damping ratio of the window: at 1 the pair becomes two real poles, and near it hardly differs.
# Chosen.
LARGEST_ZETA = 0.95
# beta: so many damping widths 1 - gamma each way. Chosen: valleys of neighbours are a few widths away.
BETA_WIDTHS = 10

# Least width of beta each way, for a pair so light that ten damping widths show as a line.
LEAST_BETA_WIDTH = 0.02

# Largest |beta|: at 1 the pair is two real poles at the end of its range, less a rounding error.
INSIDE_BETA = 1 - 1e-9
# Sides (low, high) of the cube that candidates are given in: [real pole (none here), first, second]
# coordinate. Any box that holds the grid serves. raw: beta, gamma.
RAW_BOX = ((0.0, -1.0, 0.0), (1.0, 1.0, 1.0))
# log: log10 of omega [rad/sample], log10 of zeta.
LOG_BOX = ((-1.0, -12.0, -12.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True, eq=False, repr=False)
class ErrorSurface(Shown):
    """Mean square residual J / N over two coordinates of one pair, coefficients fitted at every point.

    J is the residual sum of squares of N samples, the paper's (20).

    Attributes
    ----------
    first : (A,) array
        Values of beta, or omega in rad/s.
    second : (B,) array
        Values of gamma, or zeta; no unit.
    names : tuple of two str
        What the coordinates are called.
    mean_square : (A, B) array
        In squared units of the output.
    pole : tuple of two float
        The model's own pair in these coordinates.
    """

    first: RealArray
    second: RealArray
    names: tuple[str, str]
    mean_square: RealArray
    pole: tuple[float, float]

    def __post_init__(self) -> None:
        """Locked arrays; ValueError where their shapes do not fit together."""
        lock(self, "first", "second", "mean_square")
        if self.mean_square.shape != (self.first.size, self.second.size):
            raise ValueError(
                f"mean_square must be ({self.first.size}, {self.second.size}); got {self.mean_square.shape}"
            )

    def local_minima(self) -> list[tuple[int, int]]:
        """Indices (of first, of second) of points lower than all their up to 8 neighbours, lowest first.

        Points at the edge count too; plateaus and nan do not. Empty where there is none.
        """
        neighbours = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
        least_beside = minimum_filter(self.mean_square, footprint=neighbours, mode="constant", cval=np.inf)
        is_minimum = self.mean_square < least_beside
        order = np.argsort(self.mean_square[is_minimum], kind="stable")
        return [(int(i), int(j)) for i, j in np.argwhere(is_minimum)[order]]


def error_surface(
    records: Sequence[Record],
    model: GobfModel,
    structure: Structure,
    *,
    pair: int = 0,
    coordinates: Literal["raw", "log"] = "log",
    first: RealArray | None = None,
    second: RealArray | None = None,
    n_points: int = 61,
) -> ErrorSurface:
    """Mean square residual of records with one pair of a model moved over a grid, its other poles frozen.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each.
    model : GobfModel
        Its poles; coefficients are fitted anew.
    structure : Structure
        Integrators, delay and nuisances of the fit.
    pair : int
        Which of the model's pairs, from 0.
    coordinates : str
        Any but "raw" counts as "log". "raw" for (beta, gamma), "log" for (omega [rad/s], zeta).
    first, second : (A,), (B,) array, optional
        The grid; default two octaves each way in omega and a factor of 30 in zeta, or a window of ten damping
        widths.
    n_points : int
        Points of each default grid: 61, chosen, is enough for a smooth picture.

    Returns
    -------
    ErrorSurface
        (A, B) mean squares, and where the model's own pair lies.

    Raises
    ------
    ValueError
        The model has no such pair, or a grid leaves |beta| < 1, 0 <= gamma < 1, 0 < omega < pi / dt, 0 < zeta
        < 1; or a record does not fit (`prepare`): none, several outputs, another sampling time, no rows
        behind the delay.

    Notes
    -----
    gamma = |p|^2 and beta = 2 Re p / (1 + gamma), p the pole of the pair.
    """
    if not 0 <= pair < model.poles.pairs.size:
        raise ValueError(f"the model has {model.poles.pairs.size} pole pairs; there is no pair {pair}")
    names: tuple[str, str]
    if coordinates == "raw":
        names = ("beta", "gamma")
        pole = complex(model.poles.pairs[pair])
        gamma = abs(pole) ** 2
        beta = 2 * pole.real / (1 + gamma)
        own_pair = (beta, gamma)
        width = 1 - gamma
        if first is None:
            reach = max(BETA_WIDTHS * width, LEAST_BETA_WIDTH)
            left, right = np.clip(beta + (reach * np.array([-1, 1])), -INSIDE_BETA, INSIDE_BETA)
            first = np.linspace(float(left), float(right), n_points)
        if second is None:
            widths = np.geomspace(min(DAMPING_FACTOR * width, 1.0), width / DAMPING_FACTOR, n_points)
            second = 1 - widths
        first_is_proper = np.all(np.abs(first) < 1)
        second_is_proper = np.all((second >= 0) & (second < 1))
        low, high = np.array(RAW_BOX)
        first_coordinates = first
        second_coordinates = second
    else:
        names = ("omega_rad_s", "zeta")
        nyquist = np.pi / model.dt_s
        omega = float(model.poles.omega_rad_s(model.dt_s)[pair])
        zeta = float(model.poles.zeta()[pair])
        own_pair = (omega, zeta)
        if first is None:
            highest = min(OMEGA_FACTOR * omega, BELOW_NYQUIST * nyquist)
            first = np.geomspace(omega / OMEGA_FACTOR, highest, n_points)
        if second is None:
            least = max(zeta / DAMPING_FACTOR, LEAST_ZETA)
            largest = min(DAMPING_FACTOR * zeta, LARGEST_ZETA)
            second = np.geomspace(least, largest, n_points)
        first_is_proper = np.all((first > 0) & (first < nyquist))
        second_is_proper = np.all((second > 0) & (second < 1))
        low, high = np.array(LOG_BOX)
        first_coordinates = np.log10(first * model.dt_s)
        second_coordinates = np.log10(second)
    if not (first_is_proper and second_is_proper):
        raise ValueError(
            f"the grid of {names} leaves the region of stable pole pairs below the Nyquist frequency"
        )

    # Every point of the grid as a candidate beside the frozen poles, in units of the box.
    data = prepare(records, structure)
    frozen = model.poles.without_pair(pair)
    space = SearchSpace(0, 1, low, high, coordinates == "raw", model.dt_s)
    grid = np.array([[a, b] for a in first_coordinates for b in second_coordinates])
    units = (grid - low[1:]) / (high[1:] - low[1:])
    cost = data.candidate_cost(space, frozen, frozen)
    rss = cost.rss(units).reshape(first.size, second.size)
    return ErrorSurface(first, second, names, rss / data.n_samples, own_pair)
