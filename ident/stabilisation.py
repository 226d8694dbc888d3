"""Which modes stay when more poles are allowed: the stabilisation plot of modal analysis.

A pole pair is stable when its counterpart in the fit with one pair less lies within 1 % in frequency and 5 %
in damping (Peeters and De Roeck, Mechanical Systems and Signal Processing 13(6), 1999; their mode shapes need
several sensors). Each order is grown from the one below, so that a pair on a peak of the noise stays, too.
Hence a pair has to be needed: without it Ne ln(J0/J1) exceeds 4 ln Ne, the criterion of the order selection,
with J1 and J0 the sums of squares with and without it and Ne the number of independent samples.
`stabilisation` makes the fits and compares them; `Stabilisation.columns` are the modes that stayed.

`Regression`, of another file, holds records made ready for a fit (outputs y (N,)); `Refined` is the end of a
descent: its poles, fixed ones first of each type, and their residual sum of squares rss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

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

# Relative difference in frequency up to which a pair has stayed (Peeters and De Roeck, see above).
FREQUENCY_TOLERANCE = 0.01
# Relative difference in damping up to which a pair has stayed (Peeters and De Roeck, see above).
DAMPING_TOLERANCE = 0.05
# Pairs beyond the model's that are tried: a mode that is stable needs a fit that has it first and two that
# keep it, so it shows in these.
_BEYOND_CHOSEN = 3
# More samples than this say no more about which modes stay, and a dozen fits of order 20 take their time.
# Chosen.
_MOST_SAMPLES = 10_000
# Pairs that are tried at most, as many as `IdentOptions.n_pairs` takes.
_MOST_PAIRS = 12
# Factor on ln Ne that the gain of a needed pair exceeds: one for each of its free numbers, two of the pole
# and two coefficients, as in the criterion of `ident.search.order_selection`.
_NEEDED = 4


class StableMode(NamedTuple):
    """A column of the plot: mean frequency and damping over the fits in which it is stable and needed.

    omega_rad_s : natural frequency, rad/s; zeta : damping ratio, no unit.
    """

    omega_rad_s: float
    zeta: float


@dataclass(frozen=True, eq=False)
class Stabilisation:
    """Fits with 0, 1, 2 ... pole pairs, and of each of their K pole pairs whether it stays and is needed.

    Attributes
    ----------
    rss : ndarray, shape (S,)
        Sum of squares of each of the S fits, output units squared.
    n_real : int
        Real poles of every fit, known ones not counted.
    chosen : int
        Pairs of the model.
    n_pairs : ndarray of int, shape (K,)
        Pairs of the fit that the pair is from, ascending.
    omega_rad_s, zeta : ndarray, shape (K,)
        Natural frequency and damping ratio.
    previous : ndarray of int, shape (K,)
        Index of the counterpart with one pair less, within `FREQUENCY_TOLERANCE`; -1 without one.
    same_damping : ndarray of bool, shape (K,)
        Whether the counterpart's damping is within `DAMPING_TOLERANCE`.
    needed : ndarray of bool, shape (K,)
        Whether the data would miss the pair in its fit.

    Raises
    ------
    ValueError
        If the arrays do not have one entry per pole pair.
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
        """Lock the arrays; raise ValueError where they do not have one entry per pair; values are not
        checked."""
        lock(self, "rss", "omega_rad_s", "zeta")
        lock(self, "n_pairs", "previous", dtype=np.int64)
        lock(self, "same_damping", "needed", dtype=np.bool_)
        per_pair = (self.omega_rad_s, self.zeta, self.previous, self.same_damping, self.needed)
        if any(array.shape != self.n_pairs.shape for array in per_pair):
            raise ValueError("need one entry per pole pair (K,)")

    @property
    def stable(self) -> BoolArray:
        """Whether each pair has the same frequency and damping as with one pair less, (K,); False without
        counterpart."""
        has_counterpart = self.previous >= 0
        return np.asarray(has_counterpart & self.same_damping)

    def columns(self) -> tuple[StableMode, ...]:
        """Modes that are stable and needed in at least two fits, by frequency; empty without any."""
        # Pairs that are each other's counterparts are a chain, named by its first pair. Fits ascend, so that
        # a counterpart has been given its chain already.
        chain = np.arange(self.n_pairs.size)
        for k in range(self.n_pairs.size):
            if self.previous[k] >= 0:
                chain[k] = chain[self.previous[k]]
        modes = []
        for first in np.unique(chain):
            in_column = np.flatnonzero((chain == first) & self.stable & self.needed)
            # In a single fit nothing has stayed.
            if in_column.size > 1:
                omega = float(np.mean(self.omega_rad_s[in_column]))
                zeta = float(np.mean(self.zeta[in_column]))
                modes.append(StableMode(omega, zeta))
        return tuple(sorted(modes))


def stabilisation(
    records: Sequence[Record],
    found: Identification,
    options: IdentOptions | None = None,
    *,
    max_pairs: int | None = None,
    progress: Progress | None = None,
) -> Stabilisation:
    """Fits with 0, 1, ... max_pairs pole pairs around an identification of these records, compared.

    Parameters
    ----------
    records : sequence of Record
        One input, one output each. Long ones are thinned.
    found : Identification
        Of these records and options: its noise model, structure and number of real poles hold for every fit,
        its poles are a start for the fit with as many pairs.
    options : IdentOptions, optional
        Those of the identification: bounds, evaluations and samples of a search; default: the usual ones.
    max_pairs : int, optional
        Below zero there are no fits. Default three more than were chosen, at most twelve; the data may end it
        earlier.
    progress : callable, optional
        Told the share that is done, 0 to 1, and what is being done.

    Returns
    -------
    Stabilisation
        S fits, one for each number of pairs from 0, as far as the data go.

    Raises
    ------
    ValueError
        No record, another sampling time, several columns, or no rows behind noise model and delay
        (`prepare`). Too few samples for a fit end the list of fits, without an error.
    """
    options = options or IdentOptions()
    records = [prewhitened(record, found.noise) for record in records]
    part, in_mid_record = thinned(records, min(options.search_samples, _MOST_SAMPLES))
    structure = found.structure
    if in_mid_record:
        structure = replace(structure, estimate_initial_state=True)
    data = prepare(part, structure)
    search = PoleSearch(data, options)
    fixed_real, fixed_pairs = search.fixed.counts
    n_real = found.model.poles.real.size - fixed_real
    chosen = found.model.poles.pairs.size - fixed_pairs
    if max_pairs is None:
        max_pairs = min(chosen + _BEYOND_CHOSEN, _MOST_PAIRS)

    # Each fit grows from the one with a pair less.
    explained = EXPLAINED * float(data.y @ data.y)
    fits: list[Refined] = []
    for count in range(max_pairs + 1):
        if progress is not None:
            progress(count / (max_pairs + 1), f"{count} pole pairs")
        n_poles = search.fixed.order + n_real + 2 * count
        # Two samples for each free number, as the order selection asks for another pair.
        if not data.n_samples > 2 * data.n_parameters(n_poles):
            break
        if fits and fits[-1].rss <= explained:
            break
        end = search.joint(n_real, 0) if count == 0 else search.add_pair(fits[-1].poles)
        if count == chosen:
            # The poles of the model may be the better end.
            from_model = search.descend(found.model.poles, "the model's own poles")
            end = min(from_model, end, key=lambda candidate: candidate.rss)
        fits.append(end)
    return _compared(data, fits, n_real, chosen, fixed_pairs)


def _compared(
    data: Regression, fits: Sequence[Refined], n_real: int, chosen: int, fixed_pairs: int
) -> Stabilisation:
    """The pairs of all fits with their counterparts, and whether each is needed.

    fits: with 0, 1, 2 ... pairs beside the first fixed_pairs, which are known and not drawn; without fits all
    arrays are empty. n_real, chosen: numbers of searched real poles, and of pairs of the model; copied.
    Nothing is checked.
    """
    # A sum of squares below what counts as explained is rounding, and so would be a ratio of two.
    smallest = float(np.finfo(np.float64).tiny)
    floor = max(EXPLAINED * float(data.y @ data.y), smallest)
    n_pairs: list[RealArray] = [np.zeros(0)]
    omegas: list[RealArray] = [np.zeros(0)]
    zetas: list[RealArray] = [np.zeros(0)]
    previous: list[RealArray] = [np.zeros(0)]
    same_damping: list[BoolArray] = [np.zeros(0, dtype=np.bool_)]
    needed: list[BoolArray] = [np.zeros(0, dtype=np.bool_)]
    first_of_previous = 0
    for count, end in enumerate(fits):
        # The drawn pairs of this fit, by frequency.
        all_omega = end.poles.omega_rad_s(data.dt_s)
        order = np.argsort(all_omega[fixed_pairs:]) + fixed_pairs
        omega = all_omega[order]
        zeta = end.poles.zeta()[order]

        # Their counterparts in the fit with one pair less.
        omega_before = omegas[-1]
        zeta_before = zetas[-1]
        match = _counterparts(omega, omega_before)
        has_counterpart = match >= 0
        zeta_of_match = zeta_before[match[has_counterpart]]
        away = np.abs(zeta[has_counterpart] - zeta_of_match)
        same = np.zeros(omega.size, dtype=np.bool_)
        same[has_counterpart] = away < DAMPING_TOLERANCE * zeta_of_match
        index = np.where(has_counterpart, match + first_of_previous, -1)
        first_of_previous += omega_before.size

        # Whether the data miss each pair when it is taken out and the other poles stay where they are.
        independent_samples = data.colour(data.residual(end.poles)).effective_samples
        without = [max(fit(data, end.poles.without_pair(pair)).rss, floor) for pair in order]
        ratio = np.array(without) / max(end.rss, floor)
        gain = independent_samples * np.log(ratio)

        n_pairs.append(np.full(omega.size, count))
        omegas.append(omega)
        zetas.append(zeta)
        previous.append(index)
        same_damping.append(same)
        needed.append(np.asarray(gain > _NEEDED * np.log(independent_samples)))
    return Stabilisation(
        rss=np.array([end.rss for end in fits]),
        n_real=n_real,
        chosen=chosen,
        n_pairs=np.concatenate(n_pairs),
        omega_rad_s=np.concatenate(omegas),
        zeta=np.concatenate(zetas),
        previous=np.concatenate(previous),
        same_damping=np.concatenate(same_damping),
        needed=np.concatenate(needed),
    )


def _counterparts(omega: RealArray, before: RealArray) -> IntArray:
    """Index of the counterpart of each frequency among those before, nearest first, each used once.

    omega (K,), before (L,), rad/s, above zero; (K,), -1 where none within `FREQUENCY_TOLERANCE` is left, or
    where there are none before.
    """
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
