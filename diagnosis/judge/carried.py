"""Which effect carries how much of the held-out gap, with intervals, and what closes a part of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np

from diagnosis.answer import BLOCK, Shares
from diagnosis.evidence.explanation import Explanation
from diagnosis.fit.coordinates import MONTE_CARLO_DRAWS
from diagnosis.fit.records import Records
from diagnosis.judge.set_features import is_silent
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.rounding import rounding_effect
from diagnosis.search.loop import FOLLOWED_SETS
from diagnosis.search.search import Search

# Share of the validation error that a further effect has to close for a set with it to be listed among the
# sets that close much; for a third effect twice that, as any third number closes something. Chosen;
# only the list of partial answers reads it.
_CLOSES = 0.05
# Quantiles between which 95 % of the bootstrap lie.
_INTERVAL = (0.025, 0.975)

# Standard deviations of the energy of white noise by which a validation error exceeds it, or it is noise: one
# in a thousand records of noise is above. Doubled, errors of a tenth of the noise count as none in records of
# some thousand samples.
_CHANCE = 3.0

Names = tuple[str, ...]


def shares_of(
    search: Search,
    matter: Sequence[str],
    repaired: Explanation,
    nominal: Explanation,
    rng: np.random.Generator,
) -> Shares:
    """Shares of the validation error, in energy beyond white noise of the stated size, that effects carry.

    Parameters
    ----------
    search : Search
        After its run. Parts of the repaired model that it has not fitted are fitted, if there is time.
    matter : sequence of str
        Effects that are not small. Others of the repaired model are recorded as small.
    repaired : Explanation
        The repaired model.
    nominal : Explanation
        What the effects are added to.
    rng : numpy.random.Generator
        Of the bootstrap.

    Returns
    -------
    Shares
        `carried` is empty where a time limit left no time for the parts of the repaired model, and where the
        nominal leaves no error beyond chance to share out.

    Notes
    -----
    What an effect carries is its Shapley value (Shapley 1953): what it closes, averaged over the orders in
    which the effects could be added. It depends on no order, and all together are what the model closes.
    Intervals: bootstrap over blocks of `BLOCK` samples. Neglected: correlation between neighbouring blocks.
    """
    interesting = [name for name in matter if name in repaired.names]
    names = (*interesting, *(name for name in repaired.names if name not in interesting))
    held_out = search.held_out
    return Shares(
        names=tuple(search.case.machine.output_names),
        before=_no_more_than_all(held_out.rms_shares(nominal.held_out_residuals)),
        after=_no_more_than_all(held_out.rms_shares(repaired.held_out_residuals)),
        interests=search.case.machine.weighing.model_error,
        carried=_carried_by_each(search, names, repaired, nominal, rng),
        small=tuple(name for name in names if name not in matter),
        closes=_sets_that_close(search, nominal),
        not_tried=tuple(search.skipped_for_time),
        silent=tuple(name for name in interesting if is_silent(search, repaired, name)),
        in_windows=search.windows is not None,
        **_over_horizon(search, repaired, nominal),
    )


def closed_by(search: Search, explanation: Explanation, nominal: Explanation) -> float:
    """Share of the energy of the validation error beyond noise that a set closes, -1 to 1.

    0 where the nominal leaves no error beyond chance: there is nothing to close, and any quotient of two
    energies about zero. Negative where the set leaves more than the nominal; -1 where it leaves twice as much
    or more.
    """
    if not _has_gap(search, nominal):
        return 0.0
    left = float(np.sum(_blocks(search, explanation)))
    before = float(np.sum(_blocks(search, nominal)))
    return float(np.clip(1 - left / before, -1.0, 1.0))


def _has_gap(search: Search, explanation: Explanation) -> bool:
    """Whether the validation error has more energy than white noise of so many values has by chance."""
    values = sum(residual.size for residual in explanation.held_out_residuals)
    return bool(np.sum(_blocks(search, explanation)) > _CHANCE * np.sqrt(2 * values))


def _carried_by_each(
    search: Search,
    names: Names,
    repaired: Explanation,
    nominal: Explanation,
    rng: np.random.Generator,
) -> dict[str, tuple[float, float, float]]:
    """Effect -> share of the validation error, and ends of its 95 % interval, none above 1."""
    parts = [part for count in range(len(names) + 1) for part in combinations(names, count)]
    fitted_keys = {repaired.sorted_names, *(explanation.sorted_names for explanation in search.explanations)}
    all_fitted = all(tuple(sorted(part)) in fitted_keys for part in parts)
    if (search.out_of_time and not all_fitted) or not _has_gap(search, nominal):
        return {}

    # A part of the model that runs away alone, far beyond what the nominal leaves, carries nothing.
    nominal_blocks = _blocks(search, nominal)
    blocks = {}
    for part in parts:
        part_blocks = _blocks(search, search.with_only(part, repaired))
        blocks[part] = min(part_blocks, nominal_blocks, key=np.sum)

    count = blocks[()].size
    drawn = rng.integers(0, count, (MONTE_CARLO_DRAWS, count))
    totals = {part: energy.sum(keepdims=True) for part, energy in blocks.items()}
    drawn_totals = {part: energy[drawn].sum(axis=1) for part, energy in blocks.items()}
    carried = {}
    for name in names:
        share = float(_shapley(name, names, totals)[0])
        low, high = np.quantile(_shapley(name, names, drawn_totals), _INTERVAL)
        carried[name] = (share, min(float(low), 1.0), min(float(high), 1.0))
    return carried


def _sets_that_close(search: Search, nominal: Explanation) -> tuple[tuple[Names, float], ...]:
    """The `FOLLOWED_SETS` (four) sets that close most of the validation error, with the shares they close.

    Each closes surely more than the best fitted part of it with one effect fewer: `_CLOSES` more, twice
    as much from three effects on. A part that was not fitted counts as closing nothing.
    """
    by_evidence = sorted(search.explanations, key=lambda explanation: explanation.log_evidence)
    # The likeliest fit of a set comes last and stays.
    closed = {e.sorted_names: closed_by(search, e, nominal) for e in by_evidence if e.names}
    listed = []
    for key, share in closed.items():
        parts = combinations(key, len(key) - 1)
        best_part = max([0.0, *(closed.get(part, 0.0) for part in parts)])
        least_gain = _CLOSES if len(key) < 3 else 2 * _CLOSES
        if share > best_part + least_gain:
            listed.append((share, key))
    listed.sort(reverse=True)
    return tuple((key, share) for share, key in listed[:FOLLOWED_SETS])


def _over_horizon(search: Search, repaired: Explanation, nominal: Explanation) -> dict[str, Any]:
    """Fields of `Shares` about windows of a machine that does not forget its inputs; empty for others."""
    if search.drift_free_windows is None:
        return {}
    windows = Records(search.case, search.case.held_out, search.drift_free_windows)
    before = windows.rms_shares(nominal.held_out_residuals)
    after = windows.rms_shares(repaired.held_out_residuals)
    energy_before = float(np.sum(before**2))
    closed = float("nan")
    if energy_before > 0:
        closed = min(1 - float(np.sum(after**2)) / energy_before, 1.0)
    return {
        "horizon_samples": search.drift_free_windows.samples,
        "horizon_before": _no_more_than_all(before),
        "horizon_after": _no_more_than_all(after),
        "horizon_closed": closed,
    }


def _no_more_than_all(shares: Real) -> tuple[float, ...]:
    """Shares (Y,) of the motion; 1 of an output of which a model misses more than its motion."""
    return tuple(map(float, np.minimum(shares, 1.0)))


def _blocks(search: Search, explanation: Explanation) -> Real:
    """(B,) energy of the validation error, in squares of the noise, of blocks of `BLOCK` samples of every
    record, less what noise and rounding of the sensors have."""
    noise = search.case.noise
    rounding = rounding_effect(search.case)
    expected = np.ones(noise.size)
    if rounding is not None:
        expected = expected + rounding.variances / noise**2
    blocks = []
    for residual in explanation.held_out_residuals:
        beyond_noise = np.sum((residual / noise) ** 2 - expected, axis=1)
        blocks.append(np.add.reduceat(beyond_noise, np.arange(0, beyond_noise.size, BLOCK)))
    return np.concatenate(blocks)


def _shapley(name: str, names: Names, energy: Mapping[Names, Real]) -> Real:
    """(D,) share of the energy left by no effect that an effect closes, averaged over the orders of adding.

    Parameters
    ----------
    name : str
        The effect.
    names : tuple of str
        All effects.
    energy : mapping
        Every subset of the names, in their order -> (D,) energy that it leaves, of D draws.
    """
    other_names = [other for other in names if other != name]
    gain = np.zeros_like(energy[()])
    for count in range(len(names)):
        # Share of the orders in which exactly these others come first.
        weight = factorial(count) * factorial(len(names) - count - 1) / factorial(len(names))
        for before in combinations(other_names, count):
            after = tuple(n for n in names if n == name or n in before)
            gain = gain + weight * (energy[before] - energy[after])
    return np.asarray(gain / energy[()])
