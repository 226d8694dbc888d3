"""Tests of what the user says is known: integrators, fixed poles, input delay, relative degree;
and whether the data ask for a nuisance: an unknown initial state, an offset.

Generalised likelihood ratios Ne ln(J with the prior / J without) against a chi-square quantile, Ne the
independent samples the residual is worth. A pole at z = 1 lies on the edge of the stable ones: a true prior
is refused in less than 1 % of all records. A refused prior is kept, and the finding says so; `relative_degree
= "auto"` is imposed as far as the data agree.

Far from its limit a nuisance is judged by the first step of a descent alone (Rao's score test): J - g^T H^-1
g on the linearisation with its columns, at the poles found without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri
from scipy.stats import chi2

from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.arrays import RealArray
from ident.data.finding import TEST_LEVEL, Finding, FindingKind, PriorTest, Value, finding
from ident.data.record import Record
from ident.fit.least_squares import Regression
from ident.fit.refinement import Refined, free_optimality
from ident.fit.regression import prepare
from ident.fit.structured_fit import UnderRelativeDegree, structured_fit
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import Fitted, PoleSearch

# Descents that only compare starts stop when this fraction of J is left to gain.
ROUGH = 1e-4
# Slow poles that freed integrators start from, as decays over the whole record.
_SLOW_STARTS = {
    1: ((0.1,), (1.0,), (5.0,), (20.0,)),
    2: ((0.1, 1.0), (0.3, 5.0), (1.0, 20.0), (10.0, 30.0)),
    3: ((0.1, 0.5, 2.0), (0.3, 2.0, 10.0), (2.0, 10.0, 30.0)),
}
# Two freed integrators may also have become a slow oscillation: turns over the whole record.
_SLOW_TURNS = (0.3, 1.0, 3.0)
# A score below this part of the limit, every sample counted as independent, leaves the descent out.
_CLEARLY_BELOW = 0.6


def statistic(rss_with_prior: float, without: Fitted) -> float:
    """Ne ln(J with the prior / J without); not below 0, where only descents that ended early can bring it."""
    ratio = max(rss_with_prior, 1e-300) / max(without.end.rss, 1e-300)
    # Residuals at rounding level (noise-free data) decide nothing.
    if rss_with_prior <= 1e-18 * float(without.data.y @ without.data.y):
        return 0.0
    return max(0.0, float(without.worth() * np.log(ratio)))


def limit(degrees_of_freedom: int) -> float:
    """Chi-square quantile that a statistic of a true prior stays below in 99 % of the records."""
    return float(chi2.ppf(TEST_LEVEL, degrees_of_freedom))


def judged(
    kind: FindingKind, prior: str, value: float, degrees_of_freedom: int, **details: Value
) -> PriorTest:
    """`details`: further numbers of the sentence of this kind."""
    bound = limit(degrees_of_freedom)
    return PriorTest(kind, prior, value > bound, True, value, bound, degrees_of_freedom, details)


def fixed_poles_test(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], given: Fitted
) -> PriorTest:
    """Poles fixed by the user against as many free ones, from where they are and searched anew."""
    k, fixed, poles = given.data.structure.integrators, given.search.fixed, given.poles
    options = given.search.options.model_copy(
        update={"fixed_poles": (), "n_real": poles.real.size - k, "n_pairs": poles.pairs.size}
    )
    small = PoleSearch(prepare(*searched), options)
    ends = [small.descend(poles, "fixed poles freed", ROUGH), OrderSelection(small).run()]
    n_real = poles.real.size - k
    if n_real > 1:  # no number of real poles makes a mode: two of them may be a pair
        turned = {"n_real": n_real % 2, "n_pairs": min(poles.pairs.size + n_real // 2, options.max_pairs)}
        ends.append(OrderSelection(PoleSearch(small.data, options.model_copy(update=turned))).run())
    best = min(ends, key=lambda end: end.rss)
    search = PoleSearch(given.data, options)
    freed = Fitted(search, search.descend(best.poles, "fixed poles freed"))
    real = ", ".join(f"{a:.6g}" for a in np.sort(freed.poles.real[k:]))
    pairs = ", ".join(f"{p.real:.6g} +- {p.imag:.6g}j" for p in freed.poles.pairs)
    return judged(
        FindingKind.FIXED_POLES,
        "fixed_poles",
        statistic(given.end.rss, freed),
        fixed.real.size - k + 2 * fixed.pairs.size,
        free_poles=", ".join(part for part in (real, pairs) if part),
    )


def delay_test(records: Sequence[Record], given: Fitted, relative_degree: int) -> PriorTest:
    """The input delay against one sample less and one more, on the rows that all three explain, under the
    relative degree that the model keeps. The models are not nested; under a true delay the statistic is
    mostly negative (shown as 0), so one degree of freedom is on the safe side."""
    if relative_degree > 1:
        given = replace(given, end=best_under_relative_degree(given, relative_degree))
    structure = given.data.structure
    delay = structure.input_delay_samples
    best, chosen = 0.0, delay + 1
    for other in (delay - 1, delay + 1) if delay else (1,):
        shifted = given.refitted(records, given.poles, input_delay_samples=other)
        if relative_degree > 1:
            shifted = replace(shifted, end=best_under_relative_degree(shifted, relative_degree))
        residuals = [
            item.residual
            if structure.feedthrough  # which a relative degree of 1, the least there is, would refuse
            else structured_fit(item.data, item.poles, relative_degree).residual
            for item in (given, shifted)
        ]
        common = max(delay, other)
        ours = _power_from(residuals[0], given.data, common - delay)
        theirs = _power_from(residuals[1], shifted.data, common - other)
        worth = shifted.data.colour(residuals[1]).effective_samples
        seen = ours > 1e-18 * float(given.data.y @ given.data.y)
        value = worth * float(np.log(max(ours, 1e-300) / max(theirs, 1e-300))) if seen else 0.0
        if value > best:
            best, chosen = value, other
    return judged(FindingKind.DELAY, f"input_delay_samples = {delay}", best, 1, other_delay=chosen)


def _power_from(residual: RealArray, data: Regression, skip: int) -> float:
    parts = [residual[here][skip:] for here in data.segments]
    return float(sum(part @ part for part in parts))


def direct_term_test(records: Sequence[Record], given: Fitted) -> PriorTest:
    """Relative degree 1 (no direct term) against a model with one."""
    free = given.refitted(records, given.poles, feedthrough=True)
    return judged(FindingKind.DIRECT_TERM, "relative_degree = 1", statistic(given.end.rss, free), 1)


def relative_degree_test(free: Fitted, relative_degree: int) -> tuple[PriorTest, Refined]:
    """Relative degree r >= 2 against 1 (`free`), and the best fit under it, from there and from further
    optima of the search: a wrong start can lose a mode."""
    constrained = best_under_relative_degree(free, relative_degree)
    # Nested models: the free fit is at least as good as one that starts from the constrained optimum.
    again = free.search.descend(constrained.poles, "relative degree released")
    if again.rss < free.end.rss:
        free = replace(free, end=again)
    test = judged(
        FindingKind.RELATIVE_DEGREE,
        f"relative_degree = {relative_degree}",
        statistic(constrained.rss, free),
        relative_degree - 1,
        one_less=relative_degree - 1,
    )
    return test, constrained


def too_few_poles(relative_degree: int, order: int) -> PriorTest:
    """A relative degree above the number of poles that the data showed."""
    prior = f"relative_degree = {relative_degree}"
    free = relative_degree - 1
    return PriorTest(FindingKind.TOO_FEW_POLES, prior, True, False, 0.0, limit(free), free, {"order": order})


def best_under_relative_degree(free: Fitted, relative_degree: int) -> Refined:
    """Best descent under the relative degree from the free optimum and the next two other ones."""
    search, poles = free.search, free.poles
    starts = [poles]
    for minimum in sorted(search.minima, key=lambda item: item.rss):
        other = minimum.poles
        if other.counts != poles.counts:
            continue
        if all(_distance(other, start) > 0.15 for start in starts):
            starts.append(other)
        if len(starts) == 3:
            break
    constrained = UnderRelativeDegree(free.data, relative_degree, search.fixed)
    ends = (constrained.refine(start, search.bounds, ROUGH) for start in starts)
    return constrained.refine(min(ends, key=lambda end: end.rss).poles, search.bounds)


def _distance(one: Poles, other: Poles) -> float:
    """Largest change of a pole in natural logarithm of decay, or of frequency and decay of a pair."""
    real = np.abs(np.log(np.sort(1 - one.real) / np.sort(1 - other.real)))
    first, second = np.sort_complex(np.log(one.pairs)), np.sort_complex(np.log(other.pairs))
    return float(
        max(
            np.max(real, initial=0.0),
            np.max(np.abs(np.log(first.real / second.real)), initial=0.0),
            np.max(np.abs(np.log(first.imag / second.imag)), initial=0.0),
        )
    )


def integrators_test(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], given: Fitted
) -> tuple[PriorTest, Fitted]:
    """Integrators against as many free slow poles, order and numerator the same; also the fit with them free.

    `searched`: the records that are searched (`thinned`) and their structure, where the alternative is
    searched anew. An integrator that a zero of the model cancels is refused as well: one integrator and zero
    less are as good, while no other pole can be spared; it has to gain 2 ln Ne as any pole.
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
    """How few integrators are enough beside the same other poles, with statistic and price; None: all."""
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
    if found is not None:
        # As good without one of the searched poles, or pairs (twice the price): that one can take the place
        # of an integrator, or a pair that of two.
        poles, fixed = given.poles, given.search.fixed
        less = [(poles.without_real(i), one) for i in range(fixed.real.size, poles.real.size)]
        less += [(poles.without_pair(i), 2 * one) for i in range(fixed.pairs.size, poles.pairs.size)]
        if any(statistic(given.search.descend(start, "one less").rss, given) <= most for start, most in less):
            return None
    return found


@dataclass(frozen=True)
class NuisanceTest:
    """Verdict of the data on one nuisance of so many columns."""

    name: str
    columns: int
    statistic: float

    @property
    def limit(self) -> float:
        return float(chdtri(self.columns, 1 - TEST_LEVEL))

    @property
    def needed(self) -> bool:
        return self.statistic > self.limit

    @property
    def finding(self) -> Finding:
        return finding(
            FindingKind.NUISANCE,
            name=self.name,
            needed=self.needed,
            columns=self.columns,
            statistic=self.statistic,
            limit=self.limit,
            level=TEST_LEVEL,
        )


def nuisance_test(name: str, without: Fitted, with_it: Fitted) -> NuisanceTest:
    """Likelihood ratio of two optima."""
    ratio = max(without.end.rss, 1e-300) / max(with_it.end.rss, 1e-300)
    return NuisanceTest(name, _columns(without, with_it.data), float(with_it.worth() * np.log(ratio)))


def clearly_left_out(name: str, without: Fitted, with_it: Regression) -> NuisanceTest | None:
    """The score test if the nuisance is not needed even if each of the N samples counted, else None: descend
    and compare. The statistic shown counts what the residual without it is worth."""
    poles, search = without.poles, without.search
    here = with_it.linearise(*poles.writable())
    promised = here.rss * (1 - free_optimality(here, poles, search.bounds, search.fixed) ** 2)
    gain = float(np.log(max(without.end.rss, 1e-300) / max(promised, 1e-300)))
    test = NuisanceTest(name, _columns(without, with_it), without.worth() * gain)
    return test if with_it.n_samples * gain < _CLEARLY_BELOW * test.limit else None


def _columns(without: Fitted, with_it: Regression) -> int:
    order = without.poles.order
    return with_it.n_parameters(order) - without.data.n_parameters(order)
