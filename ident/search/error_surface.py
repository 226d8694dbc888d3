"""The cost over one pole pair with everything else frozen: the paper's Fig. 1 for any record and model."""

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


@dataclass(frozen=True, eq=False, repr=False)
class ErrorSurface(Shown):
    """Mean square residual J/N (20) over two coordinates of one pair, coefficients fitted at every point.

    first (A,), second (B,): values of (beta, gamma) of (29), or (omega [rad/s], zeta), called `names`;
    mean_square (A, B) in squared units of the output; pole: the model's own pair.
    """

    first: RealArray
    second: RealArray
    names: tuple[str, str]
    mean_square: RealArray
    pole: tuple[float, float]

    def __post_init__(self) -> None:
        lock(self, "first", "second", "mean_square")
        if self.mean_square.shape != (self.first.size, self.second.size):
            raise ValueError(
                f"mean_square must be ({self.first.size}, {self.second.size}); got {self.mean_square.shape}"
            )

    def local_minima(self) -> list[tuple[int, int]]:
        """Grid points lower than all their (up to 8) neighbours, lowest first."""
        beside = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
        lowest = self.mean_square < minimum_filter(
            self.mean_square, footprint=beside, mode="constant", cval=np.inf
        )
        order = np.argsort(self.mean_square[lowest], kind="stable")
        return [(int(i), int(j)) for i, j in np.argwhere(lowest)[order]]


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
    """Mean square residual with the pair number `pair` of the model moved over a grid, its other poles
    frozen.

    coordinates: "raw" for (beta, gamma), "log" for (omega, zeta). first, second: grid; default two octaves
    each way in omega and a factor of 30 in zeta, or a window of ten damping widths. Raises ValueError if the
    model has no such pair, or a grid leaves |beta| < 1, 0 <= gamma < 1, 0 < omega < pi/dt, 0 < zeta < 1.
    """
    if not 0 <= pair < model.poles.pairs.size:
        raise ValueError(f"the model has {model.poles.pairs.size} pole pairs; there is no pair {pair}")
    pole = complex(model.poles.pairs[pair])
    nyquist = np.pi / model.dt_s
    if coordinates == "raw":
        gamma = abs(pole) ** 2
        own = (2 * pole.real / (1 + gamma), gamma)
        width = 1 - gamma
        if first is None:
            left, right = np.clip(own[0] + (max(10 * width, 0.02) * np.array([-1, 1])), -1 + 1e-9, 1 - 1e-9)
            first = np.linspace(float(left), float(right), n_points)
        if second is None:
            second = 1 - np.geomspace(min(30 * width, 1.0), width / 30, n_points)
        names = ("beta", "gamma")
        proper = np.all(np.abs(first) < 1) and np.all((second >= 0) & (second < 1))
        box = np.array([[0.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
        values_first, values_second = first, second
    else:
        own = (float(model.poles.omega_rad_s(model.dt_s)[pair]), float(model.poles.zeta()[pair]))
        if first is None:
            first = np.geomspace(own[0] / 4, min(4 * own[0], 0.99 * nyquist), n_points)
        if second is None:
            second = np.geomspace(max(own[1] / 30, 1e-5), min(30 * own[1], 0.95), n_points)
        names = ("omega_rad_s", "zeta")
        proper = np.all((first > 0) & (first < nyquist)) and np.all((second > 0) & (second < 1))
        box = np.array([[-1.0, -12.0, -12.0], [0.0, 1.0, 0.0]])
        values_first, values_second = np.log10(first * model.dt_s), np.log10(second)
    if not proper:
        raise ValueError(
            f"the grid of {names} leaves the region of stable pole pairs below the Nyquist frequency"
        )
    data = prepare(records, structure)
    kept = model.poles.without_pair(pair)
    low, high = box
    space = SearchSpace(0, 1, low, high, coordinates == "raw", model.dt_s)
    grid = np.array([[a, b] for a in values_first for b in values_second])
    cost = data.candidate_cost(space, kept, kept)
    rss = cost.rss((grid - low[1:]) / (high[1:] - low[1:])).reshape(first.size, second.size)
    return ErrorSurface(first, second, names, rss / data.n_samples, own)
