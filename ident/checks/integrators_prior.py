"""Are the stated integrators there? Replaced by slow poles, or left out beside the same other poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.checks.prior_tests import ROUGH, judged, limit, statistic
from ident.data.finding import FindingKind, PriorTest
from ident.data.record import Record
from ident.fit.least_squares import Regression
from ident.fit.regression import prepare
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import Fitted, PoleSearch

# Slow poles that freed integrators start from, as decays over the whole record.
_SLOW_STARTS = {
    1: ((0.1,), (1.0,), (5.0,), (20.0,)),
    2: ((0.1, 1.0), (0.3, 5.0), (1.0, 20.0), (10.0, 30.0)),
    3: ((0.1, 0.5, 2.0), (0.3, 2.0, 10.0), (2.0, 10.0, 30.0)),
}
# Two freed integrators may also have become a slow oscillation: turns over the whole record.
_SLOW_TURNS = (0.3, 1.0, 3.0)


def integrators_test(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], given: Fitted
) -> tuple[PriorTest, Fitted]:
    """Integrators against as many free slow poles, order and numerator the same; also the fit with them free.

    `searched` are the records that are searched (see `ident.fit.regression.thinned`) and what is estimated on
    them. The alternative is searched anew, too: wrong integrators lose a mode, and no descent from there
    finds it again. An integrator that a zero of the model cancels is refused as well: with enough other poles
    no freed pole can improve on it, but the model with one integrator and one zero less is as good, while
    no other pole can be spared. It has to gain what the choice of the order asks of any pole, 2 ln Ne.
    """
    k = given.data.structure.integrators
    free = _without_integrators(records, searched, given)
    accepted = next(
        fewer
        for fewer in range(k - 1, -1, -1)
        if fewer == 0 or _fewer_integrators_value(records, free, fewer) <= limit(fewer)
    )
    value = statistic(given.end.rss, free)
    name = f"integrators = {k}"
    test = judged(FindingKind.INTEGRATORS, name, value, k, accepted=accepted)
    if not test.refused:
        spare = _spare_integrators(records, given)
        if spare is not None:
            fewer, needless, price = spare
            test = PriorTest(
                FindingKind.SPARE_INTEGRATORS, name, True, True, needless, price, k - fewer, {"enough": fewer}
            )
    return test, free


def _without_integrators(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], given: Fitted
) -> Fitted:
    k, fixed = given.data.structure.integrators, given.search.fixed
    plain = given.poles
    others = Poles(plain.real[k:], plain.pairs)
    n_real = plain.real.size - fixed.real.size + k
    n_pairs = plain.pairs.size - fixed.pairs.size
    options = given.search.options.model_copy(
        update={"integrators": 0, "n_real": n_real, "n_pairs": n_pairs, "decay_min_per_s": None}
    )

    def prepared(chosen: Sequence[Record], structure: Structure) -> Regression:
        # The polynomials that integrators leave free belong to both sides of the comparison.
        polynomials = prepare(chosen, structure).polynomials
        return replace(prepare(chosen, replace(structure, integrators=0)), polynomials=polynomials)

    # Starts are compared on the part that is searched, the best goes on with all samples.
    small = PoleSearch(prepared(*searched), options)
    longest = small.data.longest
    starts = [others.appended(Poles(1 - np.array(decays) / longest)) for decays in _SLOW_STARTS[k]]
    if k >= 2:
        rest = 1 - np.array([0.3] * (k - 2)) / longest
        for turns in _SLOW_TURNS:
            pair = np.exp(2 * np.pi * turns / longest * np.array([-0.3 + 1j]))
            starts.append(others.appended(Poles(rest, pair)))
    ends = [small.descend(start, "integrators freed", ROUGH) for start in starts]
    ends.append(OrderSelection(small).run())
    best = min(ends, key=lambda end: end.rss)
    search = PoleSearch(prepared(records, given.data.structure), options)
    search.evaluations = small.evaluations
    return Fitted(search, search.descend(best.poles, "integrators freed"))


def _fewer_integrators_value(records: Sequence[Record], free: Fitted, fewer: int) -> float:
    """Statistic of `fewer` integrators against none: the slowest real poles of the free fit become theirs."""
    n_fixed = free.search.fixed.real.size
    own = np.sort(free.poles.real[n_fixed:])
    if own.size < fewer:
        return np.inf
    start = Poles(
        np.concatenate([np.zeros(fewer), free.poles.real[:n_fixed], own[: own.size - fewer]]),
        free.poles.pairs,
    )
    return statistic(free.refitted(records, start, integrators=fewer).end.rss, free)


def _spare_integrators(records: Sequence[Record], given: Fitted) -> tuple[int, float, float] | None:
    """How few integrators are enough beside the same other poles, with statistic and price; None: all are
    needed."""
    k = given.data.structure.integrators
    one = 2 * float(np.log(given.worth()))
    others = Poles(given.poles.real[k:], given.poles.pairs)
    found: tuple[int, float, float] | None = None
    for fewer in range(k - 1, -1, -1):
        if others.order + fewer == 0:
            break
        start = Poles(np.concatenate([np.zeros(fewer), others.real]), others.pairs)
        value = statistic(given.refitted(records, start, integrators=fewer).end.rss, given)
        if value > (k - fewer) * one:
            break
        found = fewer, value, (k - fewer) * one
    if found is not None and _other_pole_to_spare(given, one):
        return None
    return found


def _other_pole_to_spare(given: Fitted, price: float) -> bool:
    """Is the model as good without one of its searched poles, or pairs (twice the price)?

    Then the pole too many was another one: it can take the place of an integrator, or a pair that of two.
    """
    poles, fixed = given.poles, given.search.fixed
    fewer = [(poles.without_real(i), price) for i in range(fixed.real.size, poles.real.size)]
    fewer += [(poles.without_pair(i), 2 * price) for i in range(fixed.pairs.size, poles.pairs.size)]
    return any(
        statistic(given.search.descend(start, "one less").rss, given) <= limit_here
        for start, limit_here in fewer
    )
