"""Which effect carries how much of the held-out gap, with intervals, and what closes a part of it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np

from diagnosis.answer import BLOCK, Shares
from diagnosis.evidence.explanation import Explanation
from diagnosis.fit.coordinates import DRAWS
from diagnosis.fit.records import Records
from diagnosis.judge.verdict import is_silent
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.rounding import rounding_effect
from diagnosis.search.loop import SEVERAL
from diagnosis.search.search import Search

# A further effect of a partial answer closes so much more, a third one twice that.
_CLOSES = 0.05


def shares_of(
    search: Search,
    matter: Sequence[str],
    accepted: Explanation,
    nominal: Explanation,
    rng: np.random.Generator,
) -> Shares:
    """Shares of the energy of the held-out residuals beyond white noise of the stated size.

    matter : those of the effects of the repaired model that are not small. nominal : what they are added to.

    Carried is the Shapley value of every effect of the repaired model, small ones included: what it closes,
    averaged over the orders in which they could be added, so that it depends on none and all together are
    what the model closes; intervals by bootstrap over blocks of samples. Empty where a time limit left no
    time for the parts of the model.
    """
    held, fitted = search.held_out, [name for name in matter if name in accepted.names]
    names = (*fitted, *(name for name in accepted.names if name not in fitted))
    parts = [chosen for count in range(len(names) + 1) for chosen in combinations(names, count)]
    known = {accepted.key, *(e.key for e in search.found)}
    in_time = not search.out_of_time or all(tuple(sorted(chosen)) in known for chosen in parts)
    subsets = {chosen: search.by_these(chosen, accepted) for chosen in (parts if in_time else ((),))}
    # Alone a part may run away, far beyond what the nominal leaves: it carries nothing.
    nothing = _blocks(search, nominal)
    blocks = {
        chosen: min(_blocks(search, explanation), nothing, key=np.sum)
        for chosen, explanation in subsets.items()
    }
    drawn, carried = rng.integers(0, blocks[()].size, (DRAWS, blocks[()].size)), {}
    for name in names if in_time else ():
        value = _shapley(name, names, {c: b.sum(keepdims=True) for c, b in blocks.items()})[0]
        spread = _shapley(name, names, {c: b[drawn].sum(axis=1) for c, b in blocks.items()})
        low, high = np.quantile(spread, [0.025, 0.975])
        carried[name] = (float(value), min(float(low), 1.0), min(float(high), 1.0))
    ranked = sorted(search.found, key=lambda e: e.evidence)
    closed = {e.key: closed_by(search, e, nominal) for e in ranked if e.names}
    # What closes more than any part of it does.
    best = {
        key: max([0.0, *(closed.get(rest, 0.0) for rest in combinations(key, len(key) - 1))])
        for key in closed
    }
    told = sorted(
        ((c, key) for key, c in closed.items() if c > best[key] + _CLOSES * (1 if len(key) < 3 else 2)),
        reverse=True,
    )[:SEVERAL]
    return Shares(
        names=tuple(search.case.machine.output_names),
        before=tuple(map(float, held.shares(nominal.left_held_out))),
        after=tuple(map(float, held.shares(accepted.left_held_out))),
        interests=search.case.machine.weighing.model_error,
        carried=carried,
        small=tuple(name for name in names if name not in matter),
        closes=tuple((key, c) for c, key in told),
        not_tried=tuple(search.left_out),
        silent=tuple(name for name in fitted if is_silent(search, accepted, name)),
        in_windows=search.windows is not None,
        **_over_horizon(search, accepted, nominal),
    )


def closed_by(search: Search, explanation: Explanation, nominal: Explanation) -> float:
    """Share of the energy of the held-out residuals beyond noise that a set closes."""
    return min(1 - float(np.sum(_blocks(search, explanation)) / np.sum(_blocks(search, nominal))), 1.0)


def _over_horizon(search: Search, accepted: Explanation, nominal: Explanation) -> dict[str, Any]:
    if search.horizon is None:
        return {}
    within = Records(search.case, search.case.held_out, search.horizon)
    before, after = (tuple(map(float, within.shares(e.left_held_out))) for e in (nominal, accepted))
    return {"horizon_samples": search.horizon.samples, "horizon_before": before, "horizon_after": after}


def _blocks(search: Search, explanation: Explanation) -> Real:
    """Energy over noise of blocks of the held-out residuals, less what noise and rounding have."""
    noise, rounding = search.case.noise, rounding_effect(search.case)
    white = 1.0 if rounding is None else 1.0 + rounding.variances / noise**2
    whitened = [np.sum((part / noise) ** 2 - white, axis=1) for part in explanation.left_held_out]
    return np.concatenate([np.add.reduceat(e, np.arange(0, e.size, BLOCK)) for e in whitened])


def _shapley(name: str, names: Sequence[str], energy: dict[tuple[str, ...], Real]) -> Real:
    others, total = [n for n in names if n != name], np.zeros_like(energy[()])
    for count in range(len(names)):
        weight = factorial(count) * factorial(len(names) - count - 1) / factorial(len(names))
        for before in combinations(others, count):
            after = tuple(n for n in names if n in (*before, name))
            total = total + weight * (energy[tuple(n for n in names if n in before)] - energy[after])
    return np.asarray(total / energy[()])
