"""Which modes stay when more poles are allowed: the stabilisation plot of modal analysis.

A pole pair is stable when its counterpart in the fit with one pair less lies within 1 % in frequency and 5 %
in damping (Peeters and De Roeck, Mechanical Systems and Signal Processing 13(6), 1999; their mode shapes need
several sensors). Each order is grown from the one below, so that a pair on a peak of the noise stays, too.
Hence a pair has to be needed: without it Ne ln(J0/J1) exceeds 4 ln Ne, the criterion of the order (design
4.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ident.basis.options import IdentOptions
from ident.coloured_noise import prewhitened
from ident.data.arrays import BoolArray, IntArray, RealArray, lock
from ident.data.record import Record
from ident.fit.least_squares import EXPLAINED, Regression, fit
from ident.fit.refinement import Refined
from ident.fit.regression import prepare, thinned
from ident.identification import Identification
from ident.search.order_selection import Progress
from ident.search.pole_search import PoleSearch

FREQUENCY_TOLERANCE = 0.01  # Peeters and De Roeck, see above
DAMPING_TOLERANCE = 0.05  # the same

_BEYOND_CHOSEN = 3  # pairs: stable in two fits beyond the model's shows in these
# More samples than this say no more about which modes stay, and a dozen fits of order 20 take their time.
_MOST_SAMPLES = 10_000
_MOST_PAIRS = 12  # as many as `IdentOptions.n_pairs` takes


class StableMode(NamedTuple):
    """A column of the plot: mean frequency and damping over the fits in which it is stable and needed."""

    omega_rad_s: float
    zeta: float


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """Pole pairs (K,) of fits with 0, 1, 2 ... pairs (S,), and rss (S,) of each fit.

    n_real: real poles of every fit, known ones not counted; chosen: pairs of the model. By pole pair: n_pairs
    of its fit, ascending; omega_rad_s, zeta; previous, index of its counterpart with one pair less within
    `FREQUENCY_TOLERANCE`, else -1; same_damping, within `DAMPING_TOLERANCE`; needed by the data in that fit.
    """

    rss: RealArray
    n_real: int
    chosen: int
    n_pairs: IntArray
    omega_rad_s: RealArray
    zeta: RealArray
    previous: IntArray
    same_damping: BoolArray
    needed: BoolArray

    def __post_init__(self) -> None:
        lock(self, "rss", "omega_rad_s", "zeta")
        lock(self, "n_pairs", "previous", dtype=np.int64)
        lock(self, "same_damping", "needed", dtype=np.bool_)
        each = (self.omega_rad_s, self.zeta, self.previous, self.same_damping, self.needed)
        if any(array.shape != self.n_pairs.shape for array in each):
            raise ValueError("need one entry per pole pair (K,)")

    @property
    def stable(self) -> BoolArray:
        """(K,): same frequency and same damping as with one pair less."""
        return np.asarray((self.previous >= 0) & self.same_damping)

    def columns(self) -> tuple[StableMode, ...]:
        """Modes that are stable and needed in at least two fits, by frequency."""
        chain = np.arange(self.n_pairs.size)
        for k in range(self.n_pairs.size):  # ascending: the counterpart has been given its chain already
            if self.previous[k] >= 0:
                chain[k] = chain[self.previous[k]]
        modes = []
        for start in np.unique(chain):
            here = np.flatnonzero((chain == start) & self.stable & self.needed)
            if here.size > 1:  # in one fit alone nothing has stayed
                omega, zeta = np.mean(self.omega_rad_s[here]), np.mean(self.zeta[here])
                modes.append(StableMode(float(omega), float(zeta)))
        return tuple(sorted(modes))


def stabilisation(
    records: Sequence[Record],
    found: Identification,
    options: IdentOptions | None = None,
    *,
    max_pairs: int | None = None,
    progress: Progress | None = None,
) -> Stabilisation:
    """Fits with 0, 1, ... max_pairs pole pairs around an identification `found` of these records and options.

    max_pairs: default three more than were chosen, at most twelve; the data may end it earlier. Real poles
    and structure are those of the model, at its number of pairs the poles, too. Long records are thinned.
    """
    options = options or IdentOptions()
    records = [prewhitened(record, found.noise) for record in records]
    part, in_mid_record = thinned(records, min(options.search_samples, _MOST_SAMPLES))
    structure = replace(found.structure, estimate_initial_state=True) if in_mid_record else found.structure
    data = prepare(part, structure)
    search = PoleSearch(data, options)
    fixed_real, fixed_pairs = search.fixed.counts
    n_real = found.model.poles.real.size - fixed_real
    chosen = found.model.poles.pairs.size - fixed_pairs
    most = min(chosen + _BEYOND_CHOSEN, _MOST_PAIRS) if max_pairs is None else max_pairs
    fits: list[Refined] = []
    for count in range(most + 1):
        if progress is not None:
            progress(count / (most + 1), f"{count} pole pairs")
        if not data.n_samples > 2 * data.n_parameters(search.fixed.order + n_real + 2 * count):
            break
        if fits and fits[-1].rss <= EXPLAINED * float(data.y @ data.y):
            break
        end = search.joint(n_real, 0) if count == 0 else search.add_pair(fits[-1].poles)
        if count == chosen:
            known = search.descend(found.model.poles, "the model's own poles")
            end = min(known, end, key=lambda candidate: candidate.rss)
        fits.append(end)
    return _compared(data, fits, n_real, chosen, fixed_pairs)


def _compared(
    data: Regression, fits: Sequence[Refined], n_real: int, chosen: int, fixed_pairs: int
) -> Stabilisation:
    columns: list[tuple[npt.NDArray[Any], ...]] = [(np.zeros(0),) * 6]
    start, omega_before, zeta_before = 0, np.zeros(0), np.zeros(0)
    for count, end in enumerate(fits):
        order = np.argsort(end.poles.omega_rad_s(data.dt_s)[fixed_pairs:]) + fixed_pairs
        omega, zeta = end.poles.omega_rad_s(data.dt_s)[order], end.poles.zeta()[order]
        match = _counterparts(omega, omega_before)
        known, same = match >= 0, np.zeros(omega.size, dtype=np.bool_)
        there = zeta_before[match[known]]
        same[known] = np.abs(zeta[known] - there) < DAMPING_TOLERANCE * there
        previous = np.where(known, match + start - omega_before.size, -1)
        # Whether the data miss each pair when it is taken out and the other poles stay where they are.
        worth = data.colour(data.residual(end.poles)).effective_samples
        floor = max(EXPLAINED * float(data.y @ data.y), float(np.finfo(np.float64).tiny))
        without = [max(fit(data, end.poles.without_pair(index)).rss, floor) for index in order]
        columns.append(
            (
                np.full(omega.size, count),
                omega,
                zeta,
                previous,
                same,
                np.asarray(worth * np.log(np.array(without) / max(end.rss, floor)) > 4 * np.log(worth)),
            )
        )
        start, omega_before, zeta_before = start + omega.size, omega, zeta
    rss = np.array([end.rss for end in fits])
    return Stabilisation(rss, n_real, chosen, *map(np.concatenate, zip(*columns, strict=True)))


def _counterparts(omega: RealArray, before: RealArray) -> IntArray:
    """For each frequency the index of its counterpart, nearest first and each used once; -1 without one."""
    match = np.full(omega.size, -1)
    if before.size == 0:
        return match
    away = np.abs(omega[:, None] - before) / before
    for flat in np.argsort(away, axis=None):
        i, j = divmod(int(flat), before.size)
        if not away[i, j] < FREQUENCY_TOLERANCE:
            break
        if match[i] < 0 and j not in match:
            match[i] = j
    return match
