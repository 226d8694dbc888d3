"""Frequency grids: a lean one for the optimiser, a dense one for its checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from control_design.plants.ellipses import Complex, Integer, Real
from control_design.plants.plant_set import Mode, UncertainPlant
from ident.data.settings import Settings

_LOWEST_ANGLE = 5e-7
"""Lowest frequency of the grids, rad per sample (1e-4 rad/s at 200 Hz), above slower poles."""
_BELOW_SLOWEST = 1e-2
"""Share of the slowest root's distance from z = 1 that the grids begin at, where that is lower."""
_INTEGRATES = 1e-9
"""Roots nearer to z = 1 count as integrators (`count_integrators`)."""
_WIDE = 0.1
"""Roots farther from the circle than this, rad per sample, leave nothing narrow between grid points."""


class GridOptions(Settings):
    """How fine the frequency grids of a programme and of its dense check are."""

    grid_points: int = Field(default=110, ge=20, le=2000, description="logarithmic points of the programme")
    mode_points: int = Field(default=60, ge=0, le=1000, description="points spread around the flexible modes")
    dense_points: int = Field(default=8000, ge=500, le=100_000, description="points of the dense check")
    omega_min_rad_s: float | None = Field(
        default=None,
        gt=0,
        description="lowest frequency of all grids, rad/s; none = 5e-7 rad per sample, or a hundredth of the "
        "slowest pole",
    )


def lowest_rad_s(dt_s: float, roots_z: Complex) -> float:
    """Where grids begin for a sampling time and the poles and zeros that are to be seen, rad/s."""
    away = np.abs(np.asarray(roots_z, dtype=np.complex128) - 1.0)
    slowest = float(np.min(away, initial=np.inf, where=away > _INTEGRATES))
    return min(_LOWEST_ANGLE, _BELOW_SLOWEST * slowest) / dt_s


def near_the_circle(roots_z: Complex, dt_s: float, per_decade: int = 25) -> Real:
    """Frequencies [rad/s] around poles and zeros close to the unit circle, geometric from a tenth of their
    distance."""
    parts = [np.zeros(0)]
    for root in np.unique(np.asarray(roots_z, dtype=np.complex128)):
        angle, distance = abs(float(np.angle(root))), abs(abs(complex(root)) - 1.0)
        if not 1e-16 < distance < _WIDE:
            continue
        decades = np.log10(_WIDE / distance) + 1.0
        step = np.geomspace(0.1 * distance, _WIDE, int(np.ceil(per_decade * decades)))
        parts.append(np.concatenate([angle - step, [angle], angle + step]))
    angles = np.concatenate(parts)
    return np.asarray(np.unique(angles[(angles > 0) & (angles < np.pi)]) / dt_s, dtype=np.float64)


def mode_points(mode: Mode, count: int, half_widths: float = 20.0) -> Real:
    """Frequencies spaced like sinh within +-half_widths half-bandwidths (zeta omega) of a mode."""
    width = max(mode.zeta, 1e-6) * mode.omega_rad_s
    reach = np.arcsinh(half_widths)
    points = mode.omega_rad_s + width * np.sinh(np.linspace(-reach, reach, count))
    return np.asarray(points[points > 0], dtype=np.float64)


def frequency_grid(
    nyquist_rad_s: float,
    modes: Sequence[Mode],
    *,
    omega_min_rad_s: float,
    n_log: int,
    n_mode: int,
    extra: npt.ArrayLike = (),
    further: Sequence[Mode] = (),
) -> Real:
    """Ascending grid from omega_min to Nyquist; `n_mode` points are shared out over the modes (at least 20
    each), and as many for each of `further` that has fewer than two of these points in its bandwidth."""
    each = max(20, n_mode // max(len(modes), 1))
    parts = [np.geomspace(omega_min_rad_s, nyquist_rad_s, n_log), np.asarray(extra, dtype=np.float64)]
    grid = np.concatenate([*parts, *(mode_points(mode, each) for mode in modes)])
    hidden = [
        mode
        for mode in further
        if np.count_nonzero(np.abs(grid / mode.omega_rad_s - 1.0) < max(abs(mode.zeta), 1e-6)) < 2
    ]
    grid = np.concatenate([grid, *(mode_points(mode, each) for mode in hidden)])
    grid = np.unique(grid[(grid >= omega_min_rad_s) & (grid <= nyquist_rad_s)])
    grid[-1] = nyquist_rad_s
    # Points closer than 1e-9 relative carry no information and make unwrapping rows singular.
    keep = np.concatenate([[True], np.diff(grid) > 1e-9 * grid[1:]])
    return np.asarray(grid[keep], dtype=np.float64)


def checked_grid(
    plant: UncertainPlant,
    modes: Sequence[Mode],
    n_log: int,
    per_mode: int,
    *,
    roots: npt.ArrayLike = (),
    extra: npt.ArrayLike = (),
) -> Real:
    """Grid that a design is checked on: from `lowest_rad_s` of the plant and the further `roots`."""
    low = lowest_rad_s(plant.dt_s, np.concatenate([plant.poles, np.asarray(roots, dtype=np.complex128)]))
    n_mode, top = per_mode * len(modes), plant.nyquist_rad_s
    return frequency_grid(
        top, modes, omega_min_rad_s=low, n_log=n_log, n_mode=n_mode, extra=extra, further=plant.ellipse_modes
    )


def programme_grid(
    plant: UncertainPlant,
    modes: Sequence[Mode],
    options: GridOptions,
    extra: npt.ArrayLike = (),
    *,
    dense: bool = False,
) -> Real:
    """Frequencies of a programme, to begin with, or of its dense check."""
    checked = int(0.7 * options.dense_points), int(0.3 * options.dense_points)
    points = checked if dense else (options.grid_points, options.mode_points)
    low = options.omega_min_rad_s or lowest_rad_s(plant.dt_s, plant.poles)
    grid = frequency_grid(
        plant.nyquist_rad_s, modes, omega_min_rad_s=low, n_log=points[0], n_mode=points[1], extra=extra,
        further=plant.ellipse_modes if dense else (),
    )  # fmt: skip
    return (with_own_grid if dense else plant_grid)(plant, grid)


def _outside(own: Real, wanted: Real) -> Real:
    outside = (wanted < own[0] * (1 - 1e-9)) | (wanted > own[-1] * (1 + 1e-9))
    return np.asarray(wanted[outside], dtype=np.float64)


def with_own_grid(plant: UncertainPlant, wanted: Real) -> Real:
    """`wanted`; of an uncertainty with its own frequencies all of these, and `wanted` outside their range."""
    own = plant.own_grid
    return wanted if own is None else np.union1d(own[own > 0], _outside(own, wanted))


def plant_grid(plant: UncertainPlant, wanted: Real) -> Real:
    """`wanted`; of an uncertainty with its own frequencies the nearest of these, and `wanted` outside their
    range."""
    own = plant.own_grid
    if own is None:
        return wanted
    inside = wanted[(wanted >= own[0]) & (wanted <= own[-1])]
    index = np.unique(np.clip(np.searchsorted(own, inside), 0, own.size - 1))
    index = np.union1d(index, np.array([0, own.size - 1]))
    return np.union1d(own[index], _outside(own, wanted))


def local_maxima(value: Real) -> Integer:
    """Positions of local maxima of (F,), ends included, largest value first."""
    padded = np.concatenate([[-np.inf], value, [-np.inf]])
    index = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]))
    return np.asarray(index[np.argsort(-value[index], kind="stable")], dtype=np.int64)


def around_maxima(omega: Real, values: Sequence[Real], most: int) -> Real:
    """New frequencies, nine of them between the neighbours of each of the `most` largest local maxima
    of each of the values (F,) at omega (F,); none at those of minus infinity."""
    ends = [
        (omega[max(at - 1, 0)], omega[min(at + 1, omega.size - 1)])
        for value in values
        for at in local_maxima(value)[:most]
        if value[at] > -np.inf
    ]
    return np.setdiff1d([np.linspace(*both, 11)[1:-1] for both in ends], omega)


def joined(
    omega: Real, values: Sequence[Any], new: Real, added: Sequence[Any]
) -> tuple[Real, tuple[Any, ...]]:
    """Grid and values with others, at other frequencies."""
    order = np.argsort(np.concatenate([omega, new]), kind="stable")
    both = tuple(np.concatenate([a, b])[order] for a, b in zip(values, added, strict=True))
    return np.concatenate([omega, new])[order], both


def with_violations(grid: Real, omega: Real, value: Real, limit: float, most: int) -> Real:
    """The grid with the `most` largest local maxima of value (F,) at omega (F,) that exceed the limit."""
    return np.union1d(grid, omega[[i for i in local_maxima(value) if value[i] > limit][:most]])


def starting_edges(plant: UncertainPlant, modes: Sequence[Mode], extra: npt.ArrayLike = ()) -> Real:
    """Edges of a first partition of [0, Nyquist] for bounds on intervals: logarithmic, finer around modes."""
    count = max(60, int(40 * np.log10(plant.nyquist_rad_s / lowest_rad_s(plant.dt_s, plant.poles))))
    inner = checked_grid(plant, modes, count, 40)
    more = np.asarray(extra, dtype=np.float64)
    more = more[(more > 0) & (more < plant.nyquist_rad_s)]
    return np.asarray(np.unique(np.concatenate([[0.0], inner, more])), dtype=np.float64)
