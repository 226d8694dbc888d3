"""Frequency grids: a lean one for the optimiser, a dense one for its checks.

A requirement must hold at every frequency; programmes and checks ask it on a grid. Between two points nothing
narrow may hide, so a grid is logarithmic from `lowest_rad_s` to Nyquist with points around every light mode
(`mode_points`) and around every pole and zero near the unit circle (`near_the_circle`). `programme_grid`
gives the grid that an optimiser begins with, or that of its dense check, `checked_grid` the one a design is
judged on. Where the uncertainty is known on frequencies of its own, grids keep to these. The functions at the
end refine a grid where a requirement is exceeded, and give the first partition for bounds that hold on whole
intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from control_design.plants.ellipses import Complex, Integer, Real
from control_design.plants.plant_set import Mode, UncertainPlant
from ident.data.settings import Settings

# Lowest frequency of the grids in rad per sample, 1e-4 rad/s at 200 Hz: a period of 17 hours, below which no
# arm is judged. Chosen; slower poles lower it.
_LOWEST_ANGLE_RAD = 5e-7

# Where a root in z is slower, the grids begin at this share of its distance from z = 1: two decades below a
# corner a response is flat or a pure power of frequency within 1e-4.
_BELOW_SLOWEST_SHARE = 1e-2

# Roots nearer to z = 1 count as integrators, as in `plant_set.count_integrators`: no grid begins below them.
_INTEGRATOR_DISTANCE = 1e-9

# Roots farther from the unit circle than this, in rad per sample, leave nothing narrow between the points of
# a logarithmic grid: their bandwidth is a thirtieth of the band, some ten points wide.
_WIDE_ANGLE_RAD = 0.1

# Roots nearer than this are on the circle but for rounding: no geometric row of points converges on them.
_ON_CIRCLE_DISTANCE = 1e-16

# Smallest damping ratio that points are spread for: below it the row of points would collapse into one.
_SMALLEST_ZETA = 1e-6

# Two points nearer than this share of their frequency carry no information twice, and rows of an equation at
# both are singular.
_SAME_FREQUENCY_SHARE = 1e-9

# Points that each mode gets at least, whatever the number of modes: ten on each flank, five of all within the
# bandwidth. Chosen.
_LEAST_MODE_POINTS = 20

# Share of a dense check's points that are logarithmic; the others stand around the modes. Chosen: 5600 of
# 8000 are 0.3 % from one to the next.
_DENSE_LOG_SHARE = 0.7

# Share of its points that stand around the modes: what the logarithmic ones leave, so both add up to one.
_DENSE_MODE_SHARE = 0.3

# First partition of the frequency axis: logarithmic edges (in all at least, and per decade) and edges around
# each mode. Intervals on which a bound is not tight are split later, so the number changes time, no result.
_LEAST_EDGES = 60

# Edges per decade, 6 % from one to the next. Chosen.
_EDGES_PER_DECADE = 40

# Edges around each mode. Chosen.
_EDGES_PER_MODE = 40


class GridOptions(Settings):
    """How fine the frequency grids of a programme and of its dense check are; limits refuse grids too coarse
    to show a mode, or too long for memory."""

    # Chosen: 15 % from one to the next, since the programme's grid grows where a requirement is exceeded.
    grid_points: int = Field(default=110, ge=20, le=2000, description="logarithmic points of the programme")
    # Chosen: three modes get twenty each, the fewest that show one.
    mode_points: int = Field(default=60, ge=0, le=1000, description="points spread around the flexible modes")
    # Chosen: seventy times as many as the programme begins with.
    dense_points: int = Field(default=8000, ge=500, le=100_000, description="points of the dense check")
    omega_min_rad_s: float | None = Field(
        default=None,
        gt=0,
        description="lowest frequency of all grids, rad/s; none = 5e-7 rad per sample, or a hundredth of the "
        "slowest pole",
    )


def lowest_rad_s(dt_s: float, roots_z: Complex) -> float:
    """Frequency in rad/s where grids begin, for a sampling period in seconds and the poles and zeros in z
    (N,) that are to be seen.

    Roots at z = 1 do not count; without others it is 5e-7 rad per sample. Not checked: dt_s above zero.
    """
    distance = np.abs(np.asarray(roots_z, dtype=np.complex128) - 1.0)
    slowest = float(np.min(distance, initial=np.inf, where=distance > _INTEGRATOR_DISTANCE))
    return min(_LOWEST_ANGLE_RAD, _BELOW_SLOWEST_SHARE * slowest) / dt_s


def near_the_circle(roots_z: Complex, dt_s: float, per_decade: int = 25) -> Real:
    """Frequencies around poles and zeros close to the unit circle.

    Parameters
    ----------
    roots_z : (N,) complex array
        Poles and zeros in z.
    dt_s : float
        Sampling period in seconds.
    per_decade : int
        Points on each side in each decade of distance from the root's frequency: 25 are 10 % apart, in that
        distance. Chosen.

    Returns
    -------
    (F,) array
        Ascending, rad/s, between 0 and Nyquist: each root's own frequency, and points on both sides at
        distances that grow geometrically from a tenth of the root's distance from the circle (where the
        response is flat within 0.5 %) to 0.1 rad per sample. Empty where no root is near; nan is none.
    """
    parts = [np.zeros(0)]
    for root in np.unique(np.asarray(roots_z, dtype=np.complex128)):
        angle = abs(float(np.angle(root)))
        distance = abs(abs(complex(root)) - 1.0)
        if not _ON_CIRCLE_DISTANCE < distance < _WIDE_ANGLE_RAD:
            continue
        # One more, because the points begin at a tenth of the distance.
        decades = np.log10(_WIDE_ANGLE_RAD / distance) + 1.0
        n_points = int(np.ceil(per_decade * decades))
        # From a tenth of the distance on: nearer points would see the same response.
        offset = np.geomspace(0.1 * distance, _WIDE_ANGLE_RAD, n_points)
        parts.append(np.concatenate([angle - offset, [angle], angle + offset]))
    angles = np.concatenate(parts)
    above_zero = angles > 0
    below_nyquist = angles < np.pi
    in_band = above_zero & below_nyquist
    return np.asarray(np.unique(angles[in_band]) / dt_s, dtype=np.float64)


def mode_points(mode: Mode, count: int, half_widths: float = 20.0) -> Real:
    """Frequencies in rad/s within +-half_widths half-bandwidths (zeta omega) of a mode, at most `count` of
    them.

    They are spaced like sinh: evenly within the bandwidth, where phase turns, and geometrically beyond. At
    twenty half-bandwidths the mode's own term is a twentieth of its peak, and the logarithmic grid takes
    over.

    Ascending, (N,), those above 0. An unstable mode (zeta < 0) gets the narrowest row, so callers give |zeta|
    where it matters. Not checked: Nyquist.
    """
    half_bandwidth = max(mode.zeta, _SMALLEST_ZETA) * mode.omega_rad_s
    reach = np.arcsinh(half_widths)
    points = mode.omega_rad_s + half_bandwidth * np.sinh(np.linspace(-reach, reach, count))
    is_positive = points > 0
    return np.asarray(points[is_positive], dtype=np.float64)


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
    """Grid from the lowest frequency to Nyquist, finer around modes.

    Parameters
    ----------
    nyquist_rad_s, omega_min_rad_s : float
        Ends of the grid; Nyquist is its last point.
    modes : sequence of Mode
        Modes that get points around them: undamped frequency, rad/s, and damping ratio of each.
    n_log, n_mode : int
        Logarithmic points, and points shared out over the modes (at least twenty each).
    extra : (E,) array
        Further points; those outside of the ends are left out.
    further : sequence of Mode
        Modes that get as many points as one of `modes`, if fewer than two points of the grid lie in their
        bandwidth.

    Returns
    -------
    (F,) array
        Ascending, rad/s.

    Raises
    ------
    ValueError, IndexError
        By numpy, for an end that is zero, or a lowest frequency above Nyquist. Negative ends are not refused
        and give negative frequencies: callers take them from a plant.
    """
    per_mode = max(_LEAST_MODE_POINTS, n_mode // max(len(modes), 1))
    parts = [np.geomspace(omega_min_rad_s, nyquist_rad_s, n_log), np.asarray(extra, dtype=np.float64)]
    parts.extend(mode_points(mode, per_mode) for mode in modes)
    grid = np.concatenate(parts)
    # Modes that fall between two points so far.
    parts = [grid]
    for mode in further:
        relative_distance = np.abs(grid / mode.omega_rad_s - 1.0)
        n_inside = np.count_nonzero(relative_distance < max(abs(mode.zeta), _SMALLEST_ZETA))
        # One point in the bandwidth shows a mode, two show its flank.
        if n_inside < 2:
            parts.append(mode_points(mode, per_mode))
    grid = np.concatenate(parts)
    above_lowest = grid >= omega_min_rad_s
    below_nyquist = grid <= nyquist_rad_s
    in_range = above_lowest & below_nyquist
    grid = np.unique(grid[in_range])
    # Which rounding of the logarithm may have moved, or left out.
    grid[-1] = nyquist_rad_s
    is_new = np.concatenate([[True], np.diff(grid) > _SAME_FREQUENCY_SHARE * grid[1:]])
    return np.asarray(grid[is_new], dtype=np.float64)


def checked_grid(
    plant: UncertainPlant,
    modes: Sequence[Mode],
    n_log: int,
    per_mode: int,
    *,
    roots: npt.ArrayLike = (),
    extra: npt.ArrayLike = (),
) -> Real:
    """Grid (F,) in rad/s that a design is checked on, ascending from below its slowest root to Nyquist.

    Parameters
    ----------
    plant : UncertainPlant
        Its sampling period, poles in z, and `ellipse_modes`: modes of the basis functions that its posterior
        has coefficients of, which the nominal need not have.
    modes : sequence of Mode
        Modes of plant, controller or loop that get `per_mode` points each.
    n_log, per_mode : int
        Logarithmic points, and points of each mode.
    roots : (N,) complex array
        Poles and zeros in z beside the plant's poles, of which the slowest tells where the grid begins.
    extra : (E,) array
        Further points in rad/s.

    Raises
    ------
    ValueError
        By numpy, for a negative number of points.
    """
    all_roots = np.concatenate([plant.poles, np.asarray(roots, dtype=np.complex128)])
    return frequency_grid(
        plant.nyquist_rad_s,
        modes,
        omega_min_rad_s=lowest_rad_s(plant.dt_s, all_roots),
        n_log=n_log,
        n_mode=per_mode * len(modes),
        extra=extra,
        further=plant.ellipse_modes,
    )


def programme_grid(
    plant: UncertainPlant,
    modes: Sequence[Mode],
    options: GridOptions,
    extra: npt.ArrayLike = (),
    *,
    dense: bool = False,
) -> Real:
    """Frequencies (F,) in rad/s that a programme begins with, or those of its dense check.

    Parameters
    ----------
    plant : UncertainPlant
        Where its uncertainty is known on frequencies of its own, the grid keeps to these within their range.
    modes : sequence of Mode
        Modes that get points around them.
    options : GridOptions
        Numbers of points, and `omega_min_rad_s` where the grid begins (none: from the slowest pole).
    extra : (E,) array
        Further points in rad/s.
    dense : bool
        The dense check: more points, also around those of `plant.ellipse_modes` (modes of the basis functions
        that the posterior has coefficients of) in whose bandwidth fewer than two points lie.

    Raises
    ------
    IndexError
        By numpy, where `omega_min_rad_s` lies above Nyquist.
    """
    lowest = options.omega_min_rad_s or lowest_rad_s(plant.dt_s, plant.poles)
    if dense:
        grid = frequency_grid(
            plant.nyquist_rad_s,
            modes,
            omega_min_rad_s=lowest,
            n_log=int(_DENSE_LOG_SHARE * options.dense_points),
            n_mode=int(_DENSE_MODE_SHARE * options.dense_points),
            extra=extra,
            further=plant.ellipse_modes,
        )
        return with_own_grid(plant, grid)
    grid = frequency_grid(
        plant.nyquist_rad_s,
        modes,
        omega_min_rad_s=lowest,
        n_log=options.grid_points,
        n_mode=options.mode_points,
        extra=extra,
    )
    return plant_grid(plant, grid)


def _outside(own_grid: Real, wanted: Real) -> Real:
    """Those frequencies of `wanted` (W,) that lie outside the range of `own_grid` (F,), both in rad/s.

    own_grid ascending, at least one; not checked.
    """
    below = wanted < own_grid[0] * (1 - _SAME_FREQUENCY_SHARE)
    above = wanted > own_grid[-1] * (1 + _SAME_FREQUENCY_SHARE)
    is_outside = below | above
    return np.asarray(wanted[is_outside], dtype=np.float64)


def with_own_grid(plant: UncertainPlant, wanted: Real) -> Real:
    """Frequencies to check a plant at, ascending in rad/s: `wanted` (W,) itself where its uncertainty is
    known everywhere, else all positive frequencies that it is known at, and `wanted` outside their range.

    wanted ascending, not checked; the plant has checked its own frequencies.
    """
    own_grid = plant.own_grid
    if own_grid is None:
        return wanted
    is_positive = own_grid > 0
    return np.union1d(own_grid[is_positive], _outside(own_grid, wanted))


def plant_grid(plant: UncertainPlant, wanted: Real) -> Real:
    """Frequencies to optimise a plant at, ascending in rad/s: `wanted` (W,) itself where its uncertainty is
    known everywhere, else the next higher frequency that it is known at for each, both ends of these, and
    `wanted` outside their range.

    wanted ascending, not checked; none of it in range leaves the two ends.
    """
    own_grid = plant.own_grid
    if own_grid is None:
        return wanted
    above_lowest = wanted >= own_grid[0]
    below_highest = wanted <= own_grid[-1]
    in_range = above_lowest & below_highest
    last = own_grid.size - 1
    index = np.unique(np.clip(np.searchsorted(own_grid, wanted[in_range]), 0, last))
    index = np.union1d(index, np.array([0, last]))
    return np.union1d(own_grid[index], _outside(own_grid, wanted))


def local_maxima(value: Real) -> Integer:
    """Positions (M,) of local maxima of value (F,), ends included, largest value first; of equal neighbours
    the last one.

    Nan is no maximum, and beside it there is none. Empty for F = 0.
    """
    padded = np.concatenate([[-np.inf], value, [-np.inf]])
    middle = padded[1:-1]
    not_below_left = middle >= padded[:-2]
    above_right = middle > padded[2:]
    is_maximum = not_below_left & above_right
    index = np.flatnonzero(is_maximum)
    return np.asarray(index[np.argsort(-value[index], kind="stable")], dtype=np.int64)


def around_maxima(omega: Real, values: Sequence[Real], most: int) -> Real:
    """Frequencies in rad/s to look at anew around the largest values, ascending, none of `omega`.

    Parameters
    ----------
    omega : (F,) array
        Ascending grid in rad/s.
    values : sequence of (F,) arrays
        What is sought the maxima of, each by itself; minus infinity where there is no value.
    most : int
        Largest local maxima of each that get points.

    Returns
    -------
    (N,) array
        Nine evenly spaced points between the two neighbours of each maximum: it is then located five times
        more finely. Nine are chosen; empty where there is no maximum. Not checked: lengths.
    """
    refined = []
    for value in values:
        for position in local_maxima(value)[:most]:
            if value[position] == -np.inf:
                continue
            left = omega[max(position - 1, 0)]
            right = omega[min(position + 1, omega.size - 1)]
            # Eleven with the neighbours themselves.
            refined.append(np.linspace(left, right, 11)[1:-1])
    return np.setdiff1d(refined, omega)


def joined(
    omega: Real, values: Sequence[Any], new: Real, added: Sequence[Any]
) -> tuple[Real, tuple[Any, ...]]:
    """Grid with new frequencies, ascending, and the values at both.

    ValueError where numbers of quantities or shapes do not fit; a frequency in both comes twice, not checked.

    Parameters
    ----------
    omega, new : (F,), (N,) array
        Frequencies in rad/s, none of them in both.
    values, added : sequence of arrays
        Of each quantity its values (F, ...) at omega and (N, ...) at new.

    Returns
    -------
    tuple
        Frequencies (F + N,), and the values (F + N, ...) of each quantity in their order.
    """
    all_omega = np.concatenate([omega, new])
    order = np.argsort(all_omega, kind="stable")
    all_values = tuple(
        np.concatenate([old_value, new_value])[order]
        for old_value, new_value in zip(values, added, strict=True)
    )
    return all_omega[order], all_values


def with_violations(grid: Real, omega: Real, value: Real, limit: float, most: int) -> Real:
    """Grid (G,) in rad/s together with those frequencies of omega (F,) at which value (F,) has its largest
    local maxima above the limit, at most `most` of them.

    most not negative, lengths of omega and value the same: not checked. Nan is no violation.
    """
    exceeding = [position for position in local_maxima(value) if value[position] > limit]
    return np.union1d(grid, omega[exceeding[:most]])


def starting_edges(plant: UncertainPlant, modes: Sequence[Mode], extra: npt.ArrayLike = ()) -> Real:
    """Edges (E,) in rad/s, ascending from 0 to Nyquist, of a first partition for bounds that hold on whole
    intervals: logarithmic, finer around modes, with the `extra` (N,) edges between 0 and Nyquist.

    modes: frequency, rad/s, and damping ratio of each. An edge of `extra` that is not finite is left out.
    """
    decades = np.log10(plant.nyquist_rad_s / lowest_rad_s(plant.dt_s, plant.poles))
    count = max(_LEAST_EDGES, int(_EDGES_PER_DECADE * decades))
    inner = checked_grid(plant, modes, count, _EDGES_PER_MODE)
    further = np.asarray(extra, dtype=np.float64)
    above_zero = further > 0
    below_nyquist = further < plant.nyquist_rad_s
    in_band = above_zero & below_nyquist
    edges = np.concatenate([[0.0], inner, further[in_band]])
    return np.asarray(np.unique(edges), dtype=np.float64)
