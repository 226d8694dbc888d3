"""Tests of what the user states as known, and of nuisances that the data may ask for.

Stated are integrators, fixed poles, an input delay, a relative degree. Each is held against a fit without it
by a generalised likelihood ratio, Ne ln(J with the prior / J without), J the residual sum of squares and Ne
the independent samples that the residual without it is worth, against the chi-square quantile at 99 %
(`TEST_LEVEL`). The alternative is searched anew, so that a wrong prior cannot hide behind the poles found
under it. A pole at z = 1 lies on the edge of the stable ones: a true integrator is refused in less than 1 %
of all records. A refused prior is kept, and the finding says so; only `relative_degree = "auto"` is imposed
as far as the data agree.

Nuisances are an unknown initial state and an offset. Far from its limit a nuisance is judged by the first
step of a descent alone (Rao's score test): J - g^T H^-1 g on the linearisation with its columns, at the poles
found without them.

Neglected: the noise is taken as stationary, its colour counts through Ne only.

Types of other files: `Fitted`, an optimum (`poles`, fixed ones first of each type; `end.rss`, its J) with its
`data`, records made ready for a fit (outputs y (N,)), its `search`, and `worth()`, which is Ne; `Refined`,
the end of a descent (poles, rss); `Structure`, integrators, delay and nuisances; `PriorTest`, a verdict. All
records and fits were made by an identification that has refused unusable ones; nothing is refused here unless
it is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri
from scipy.stats import chi2

from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.arrays import RealArray
from ident.data.finding import TEST_LEVEL, Finding, FindingKind, PriorTest, Value, finding
from ident.data.record import Record
from ident.fit.least_squares import EXPLAINED, Regression
from ident.fit.refinement import Refined, free_optimality
from ident.fit.regression import prepare
from ident.fit.structured_fit import UnderRelativeDegree, structured_fit
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import Fitted, PoleSearch

# Share of J that is left to gain when a descent ends that only compares starts: at 1000 independent samples
# the statistic is then known to 0.1, its limit being 6.6. Ten times as much or as little moves no test of
# priors.
ROUGH = 1e-4
# Slow poles from which freed integrators start, by number of integrators: distances from one times the
# samples of the longest record, from a pole that hardly decays (0.1) to one that has settled after a
# twentieth (20). Chosen: a few to a decade, spread over both where there are several.
SLOW_STARTS = {
    1: ((0.1,), (1.0,), (5.0,), (20.0,)),
    2: ((0.1, 1.0), (0.3, 5.0), (1.0, 20.0), (10.0, 30.0)),
    3: ((0.1, 0.5, 2.0), (0.3, 2.0, 10.0), (2.0, 10.0, 30.0)),
}
# Two freed integrators may also have become a slow oscillation: its turns over the longest record. Chosen
# around one turn.
SLOW_TURNS = (0.3, 1.0, 3.0)
# Decay of such a pair as a share of its angle: a damping ratio of 0.29, in the middle of what a search
# allows. Chosen.
SLOW_PAIR_DECAY = 0.3
# Decay over the longest record of the real pole that a third integrator starts as, beside such a pair.
# Chosen: it hardly decays in the record, as an integrator does.
SLOW_BESIDE_PAIR = 0.3
# Largest change of the logarithm of a decay or frequency (15 %) up to which two ends of a search are one
# start: from so near, descents end alike. Chosen.
SAME_START = 0.15
# Starts of a descent under a relative degree: the optimum without it and two others. A wrong start can lose a
# mode. Chosen, as each one more takes a descent.
STARTS_UNDER_DEGREE = 3
# A score below this part of the limit, every sample counted as independent, leaves the descent out. The score
# is a first step; the rest of the way would have to gain two thirds as much again. Halved, or at the limit
# itself, no test of priors moves.
CLEARLY_BELOW = 0.6
# Keeps ratios of residual sums of squares finite where one is zero.
TINY = 1e-300


def statistic(rss_with_prior: float, without: Fitted) -> float:
    """Ne ln(J with the prior / J without), not below 0: large where the data contradict the prior.

    Parameters
    ----------
    rss_with_prior : float
        Residual sum of squares J of the fit under the prior.
    without : Fitted
        The fit without it: its J, and Ne, the independent samples that its residual is worth.

    Returns
    -------
    float
        0 also where the residual under the prior is rounding (noise-free data): that decides nothing. nan
        where a sum is nan.

    Notes
    -----
    Negative values would mean that the fit with more freedom ended early.
    """
    ratio = max(rss_with_prior, TINY) / max(without.end.rss, TINY)
    if rss_with_prior <= EXPLAINED * float(without.data.y @ without.data.y):
        return 0.0
    return max(0.0, float(without.worth() * np.log(ratio)))


def limit(degrees_of_freedom: int) -> float:
    """Chi-square quantile that the statistic of a true prior stays below in 99 % of the records.

    nan for no degree of freedom, or less.
    """
    return float(chi2.ppf(TEST_LEVEL, degrees_of_freedom))


def judged(
    kind: FindingKind, prior: str, value: float, degrees_of_freedom: int, **details: Value
) -> PriorTest:
    """Verdict on a prior that the model keeps: refused where the statistic `value` exceeds its limit.

    prior: the setting in words, such as "integrators = 2". details: further numbers of the sentence of this
    kind of finding; which they have to be is not checked. A statistic of nan is not refused.
    """
    bound = limit(degrees_of_freedom)
    return PriorTest(
        kind=kind,
        prior=prior,
        refused=value > bound,
        imposed=True,
        statistic=value,
        limit=bound,
        degrees_of_freedom=degrees_of_freedom,
        details=details,
    )


def fixed_poles_test(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], with_prior: Fitted
) -> PriorTest:
    """Verdict on poles fixed by the user, against as many free ones.

    Parameters
    ----------
    records : sequence of Record
        All records of the fit; not used, as the alternative is fitted on the rows of `with_prior`.
    searched : (records, Structure)
        The part of the records that is searched (`thinned`), and its structure.
    with_prior : Fitted
        The fit with the fixed poles, on all records.

    Returns
    -------
    PriorTest
        One degree of freedom for each fixed real number; `free_poles` names where free poles end. Asked only
        where there are fixed poles.

    Notes
    -----
    Free poles are sought from where the fixed ones are, by a search anew with the same numbers of real poles
    and pairs, and, with two real poles or more, by a search with pairs in their place: no number of real
    poles makes a mode.
    """
    n_integrators = with_prior.data.structure.integrators
    fixed = with_prior.search.fixed
    poles = with_prior.poles
    n_real = poles.real.size - n_integrators
    n_pairs = poles.pairs.size
    as_many_free = {"fixed_poles": (), "n_real": n_real, "n_pairs": n_pairs}
    options = with_prior.search.options.model_copy(update=as_many_free)

    small = PoleSearch(prepare(*searched), options)
    ends = [small.descend(poles, "fixed poles freed", ROUGH)]
    ends.append(OrderSelection(small).run())
    if n_real > 1:
        pairs_instead = min(n_pairs + n_real // 2, options.max_pairs)
        turned = options.model_copy(update={"n_real": n_real % 2, "n_pairs": pairs_instead})
        ends.append(OrderSelection(PoleSearch(small.data, turned)).run())
    best = min(ends, key=lambda end: end.rss)
    search = PoleSearch(with_prior.data, options)
    freed = Fitted(search, search.descend(best.poles, "fixed poles freed"))

    real_words = [f"{pole:.6g}" for pole in np.sort(freed.poles.real[n_integrators:])]
    pair_words = [f"{pole.real:.6g} +- {pole.imag:.6g}j" for pole in freed.poles.pairs]
    return judged(
        FindingKind.FIXED_POLES,
        "fixed_poles",
        statistic(with_prior.end.rss, freed),
        fixed.real.size - n_integrators + 2 * fixed.pairs.size,
        free_poles=", ".join(real_words + pair_words),
    )


def delay_test(records: Sequence[Record], with_prior: Fitted, relative_degree: int) -> PriorTest:
    """Verdict on the input delay, against one sample less and one more.

    Parameters
    ----------
    records : sequence of Record
        All records of the fit.
    with_prior : Fitted
        The fit with the stated delay.
    relative_degree : int
        That the model keeps; below 2 it asks nothing of the poles.

    Returns
    -------
    PriorTest
        `other_delay`: the better of the two, in samples; delay + 1 where neither is better.

    Raises
    ------
    ValueError
        A record has no rows behind one sample of delay more (`prepare`).

    Notes
    -----
    Compared on the rows that both models explain. They are not nested; under a true delay the statistic is
    mostly negative (shown as 0), so one degree of freedom is on the safe side.
    """
    if relative_degree > 1:
        with_prior = replace(with_prior, end=best_under_relative_degree(with_prior, relative_degree))
    structure = with_prior.data.structure
    delay = structure.input_delay_samples
    residual = _residual_under(with_prior, relative_degree)
    least_power = EXPLAINED * float(with_prior.data.y @ with_prior.data.y)

    largest = 0.0
    other_delay = delay + 1
    trials = [1] if delay == 0 else [delay - 1, delay + 1]
    for trial in trials:
        shifted = with_prior.refitted(records, with_prior.poles, input_delay_samples=trial)
        if relative_degree > 1:
            shifted = replace(shifted, end=best_under_relative_degree(shifted, relative_degree))
        shifted_residual = _residual_under(shifted, relative_degree)
        # A record has no rows before its delay: the later one of both starts the common rows.
        common_delay = max(delay, trial)
        power = _power_from(residual, with_prior.data, common_delay - delay)
        shifted_power = _power_from(shifted_residual, shifted.data, common_delay - trial)
        worth = shifted.data.colour(shifted_residual).effective_samples
        value = 0.0
        if power > least_power:
            value = worth * float(np.log(max(power, TINY) / max(shifted_power, TINY)))
        if value > largest:
            largest = value
            other_delay = trial
    prior = f"input_delay_samples = {delay}"
    return judged(FindingKind.DELAY, prior, largest, 1, other_delay=other_delay)


def _residual_under(fitted: Fitted, relative_degree: int) -> RealArray:
    """Residual (N,) of a fit with its coefficients under a relative degree.

    Where there is a direct term the coefficients are free, whatever the degree: even 1, the least there is,
    would refuse it. `relative_degree` : 1 or more; that the fit has as many poles the caller knows.
    """
    if fitted.data.structure.feedthrough:
        return fitted.residual
    return structured_fit(fitted.data, fitted.poles, relative_degree).residual


def _power_from(residual: RealArray, data: Regression, skip: int) -> float:
    """Sum of squares of a residual (N,) without the first `skip` rows of each record; 0 where none are
    left."""
    parts = [residual[rows][skip:] for rows in data.segments]
    return float(sum(part @ part for part in parts))


def direct_term_test(records: Sequence[Record], with_prior: Fitted) -> PriorTest:
    """Verdict on relative degree 1 (no direct term), against a model with a direct term.

    records: all records of the fit `with_prior`, which has none. One degree of freedom. A fit that has one
    already is compared with itself, and not refused.
    """
    free = with_prior.refitted(records, with_prior.poles, feedthrough=True)
    return judged(FindingKind.DIRECT_TERM, "relative_degree = 1", statistic(with_prior.end.rss, free), 1)


def relative_degree_test(free: Fitted, relative_degree: int) -> tuple[PriorTest, Refined]:
    """Verdict on a relative degree r >= 2, and the end of the best descent under it.

    Parameters
    ----------
    free : Fitted
        The fit of relative degree 1, with further optima in the trace of its search.
    relative_degree : int
        r, at most the number of poles (`too_few_poles` says so of others); r - 1 degrees of freedom.

    Returns
    -------
    (PriorTest, Refined)
        Kind RELATIVE_DEGREE; poles and J under the degree.
    """
    constrained = best_under_relative_degree(free, relative_degree)
    # Nested models: the free fit is at least as good as one that starts from the constrained optimum.
    released = free.search.descend(constrained.poles, "relative degree released")
    if released.rss < free.end.rss:
        free = replace(free, end=released)
    test = judged(
        FindingKind.RELATIVE_DEGREE,
        f"relative_degree = {relative_degree}",
        statistic(constrained.rss, free),
        relative_degree - 1,
        one_less=relative_degree - 1,
    )
    return test, constrained


def too_few_poles(relative_degree: int, order: int) -> PriorTest:
    """Verdict "refused, not imposed" on a relative degree above the number of poles `order` of the fit.

    That it is above is not checked; the statistic is 0, as there is no fit to compare.
    """
    return PriorTest(
        kind=FindingKind.TOO_FEW_POLES,
        prior=f"relative_degree = {relative_degree}",
        refused=True,
        imposed=False,
        statistic=0.0,
        limit=limit(relative_degree - 1),
        degrees_of_freedom=relative_degree - 1,
        details={"order": order},
    )


def best_under_relative_degree(free: Fitted, relative_degree: int) -> Refined:
    """End of the best descent under a relative degree.

    Parameters
    ----------
    free : Fitted
        The fit without it. Descents start from its poles and from the two lowest ends in the trace of its
        search that are other optima with the same numbers of real poles and pairs.
    relative_degree : int
        2 or more, at most the number of poles (not checked here).

    Returns
    -------
    Refined
        Poles, fixed ones first of each type, and J under the degree.
    """
    search = free.search
    starts = [free.poles]
    for minimum in sorted(search.minima, key=lambda end: end.rss):
        other = minimum.poles
        if other.counts != free.poles.counts:
            continue
        if all(_distance(other, start) > SAME_START for start in starts):
            starts.append(other)
        if len(starts) == STARTS_UNDER_DEGREE:
            break
    constrained = UnderRelativeDegree(free.data, relative_degree, search.fixed)
    ends = [constrained.refine(start, search.bounds, ROUGH) for start in starts]
    best = min(ends, key=lambda end: end.rss)
    return constrained.refine(best.poles, search.bounds)


def _distance(first: Poles, second: Poles) -> float:
    """Largest change between two sets of as many poles, in natural logarithms.

    Of the distance 1 - a of real poles, compared in order; of decay and of angle per sample of pairs,
    compared by decay. 0 without poles. Raises ValueError of NumPy where the numbers of poles differ.
    """
    decays = np.sort(1 - first.real)
    other_decays = np.sort(1 - second.real)
    pairs = np.sort_complex(np.log(first.pairs))
    other_pairs = np.sort_complex(np.log(second.pairs))
    of_real = np.abs(np.log(decays / other_decays))
    of_pair_decay = np.abs(np.log(pairs.real / other_pairs.real))
    of_pair_angle = np.abs(np.log(pairs.imag / other_pairs.imag))
    changes = np.concatenate([of_real, of_pair_decay, of_pair_angle])
    return float(np.max(changes, initial=0.0))


def integrators_test(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], with_prior: Fitted
) -> tuple[PriorTest, Fitted]:
    """Verdict on integrators, against as many free slow poles; and the fit with these.

    Parameters
    ----------
    records : sequence of Record
        All records of the fit.
    searched : (records, Structure)
        The part of them that is searched (`thinned`), and its structure; the alternative is searched anew
        there.
    with_prior : Fitted
        The fit with k integrators, 1 to 3 (KeyError for others: `SLOW_STARTS`; the options have refused
        them).

    Returns
    -------
    (PriorTest, Fitted)
        INTEGRATORS with k degrees of freedom and the largest number of integrators that is accepted; or,
        where that is not refused, SPARE_INTEGRATORS where fewer are enough (`_spare_integrators`). The fit
        without integrators has the same order and numerator.

    Notes
    -----
    An integrator that a zero of the model cancels is refused as well: one integrator and zero less are as
    good, while no other pole can be spared; it has to gain 2 ln Ne as any pole.
    """
    n_integrators = with_prior.data.structure.integrators
    free = _without_integrators(records, searched, with_prior)
    accepted = 0
    for fewer in range(n_integrators - 1, 0, -1):
        if _fewer_integrators_value(records, free, fewer) <= limit(fewer):
            accepted = fewer
            break
    prior = f"integrators = {n_integrators}"
    value = statistic(with_prior.end.rss, free)
    test = judged(FindingKind.INTEGRATORS, prior, value, n_integrators, accepted=accepted)
    if test.refused:
        return test, free

    spare = _spare_integrators(records, with_prior)
    if spare is None:
        return test, free
    test = PriorTest(
        kind=FindingKind.SPARE_INTEGRATORS,
        prior=prior,
        refused=True,
        imposed=True,
        statistic=spare.statistic,
        limit=spare.price,
        degrees_of_freedom=n_integrators - spare.enough,
        details={"enough": spare.enough},
    )
    return test, free


def _without_integrators(
    records: Sequence[Record], searched: tuple[Sequence[Record], Structure], with_prior: Fitted
) -> Fitted:
    """Best fit of all records with free poles in place of the integrators of `with_prior`.

    Starts are compared on the part that is searched: the other poles of `with_prior` with slow real poles, or
    a slow pair, in place of the integrators; and a search anew. The best goes on with all samples. KeyError
    (`SLOW_STARTS`) for other numbers of integrators than 1 to 3.
    """
    n_integrators = with_prior.data.structure.integrators
    fixed = with_prior.search.fixed
    # The integrators stand first among the real poles, the fixed ones.
    other_poles = Poles(with_prior.poles.real[n_integrators:], with_prior.poles.pairs)
    options = with_prior.search.options.model_copy(
        update={
            "integrators": 0,
            "n_real": with_prior.poles.real.size - fixed.real.size + n_integrators,
            "n_pairs": with_prior.poles.pairs.size - fixed.pairs.size,
            "decay_min_per_s": None,
        }
    )

    def prepared(chosen: Sequence[Record], structure: Structure) -> Regression:
        """The records without integrators, with the polynomials that integrators leave free: they belong to
        both sides of the comparison. Raises ValueError as `prepare`: no record, no rows behind the delay."""
        polynomials = prepare(chosen, structure).polynomials
        return replace(prepare(chosen, replace(structure, integrators=0)), polynomials=polynomials)

    small = PoleSearch(prepared(*searched), options)
    longest = small.data.longest
    starts = []
    for decays in SLOW_STARTS[n_integrators]:
        starts.append(other_poles.appended(Poles(1 - np.array(decays) / longest)))
    if n_integrators >= 2:
        further = 1 - np.array([SLOW_BESIDE_PAIR] * (n_integrators - 2)) / longest
        for turns in SLOW_TURNS:
            pair = np.exp(2 * np.pi * turns / longest * np.array([-SLOW_PAIR_DECAY + 1j]))
            starts.append(other_poles.appended(Poles(further, pair)))
    ends = [small.descend(start, "integrators freed", ROUGH) for start in starts]
    ends.append(OrderSelection(small).run())
    best = min(ends, key=lambda end: end.rss)

    search = PoleSearch(prepared(records, with_prior.data.structure), options)
    search.evaluations = small.evaluations
    return Fitted(search, search.descend(best.poles, "integrators freed"))


def _fewer_integrators_value(records: Sequence[Record], free: Fitted, fewer: int) -> float:
    """Statistic of `fewer` integrators against none; infinite without so many searched real poles.

    free: the fit without integrators; its slowest searched real poles become the integrators. `fewer` is at
    least 1.
    """
    n_fixed = free.search.fixed.real.size
    searched_real = np.sort(free.poles.real[n_fixed:])
    n_left = searched_real.size - fewer
    if n_left < 0:
        return np.inf
    # Integrators come first among the fixed poles; the zeros only hold their places.
    real = np.concatenate([np.zeros(fewer), free.poles.real[:n_fixed], searched_real[:n_left]])
    start = Poles(real, free.poles.pairs)
    return statistic(free.refitted(records, start, integrators=fewer).end.rss, free)


class SpareIntegrators(NamedTuple):
    """How many integrators are enough; the statistic of the others, and the price they would have to gain.

    Both without a unit, in twice the logarithm of a likelihood.
    """

    enough: int
    statistic: float
    price: float


def _spare_integrators(records: Sequence[Record], with_prior: Fitted) -> SpareIntegrators | None:
    """How few integrators are enough beside the same other poles of `with_prior`; None where all are needed.

    Each integrator has to gain 2 ln Ne. None also where a searched pole, or a pair at twice the price, can be
    spared as well: that one can take the place of an integrator. Nothing is raised; a fit without integrators
    gives None.
    """
    n_integrators = with_prior.data.structure.integrators
    price_of_one = 2 * float(np.log(with_prior.worth()))
    other_poles = Poles(with_prior.poles.real[n_integrators:], with_prior.poles.pairs)
    spare: SpareIntegrators | None = None
    for fewer in range(n_integrators - 1, -1, -1):
        if other_poles.order + fewer == 0:
            break
        start = Poles(np.concatenate([np.zeros(fewer), other_poles.real]), other_poles.pairs)
        value = statistic(with_prior.refitted(records, start, integrators=fewer).end.rss, with_prior)
        price = (n_integrators - fewer) * price_of_one
        if value > price:
            break
        spare = SpareIntegrators(fewer, value, price)
    if spare is None:
        return None

    poles = with_prior.poles
    fixed = with_prior.search.fixed
    reduced = [(poles.without_real(i), price_of_one) for i in range(fixed.real.size, poles.real.size)]
    reduced += [(poles.without_pair(i), 2 * price_of_one) for i in range(fixed.pairs.size, poles.pairs.size)]
    for start, price in reduced:
        if statistic(with_prior.search.descend(start, "one less").rss, with_prior) <= price:
            return None
    return spare


@dataclass(frozen=True)
class NuisanceTest:
    """Verdict of the data on one nuisance.

    Attributes
    ----------
    name : str
        "initial state" or "offset".
    columns : int
        Free real numbers that it adds to a fit; the degrees of freedom.
    statistic : float
        Ne ln(J without / J with it).
    """

    name: str
    columns: int
    statistic: float

    @property
    def limit(self) -> float:
        """Chi-square quantile at 99 % that the statistic of a nuisance that is not there stays below.

        nan where it adds no number to the fit: nothing is needed then.
        """
        return float(chdtri(self.columns, 1 - TEST_LEVEL))

    @property
    def needed(self) -> bool:
        """Whether the data ask for the nuisance; False for a statistic or limit of nan."""
        return self.statistic > self.limit

    @property
    def finding(self) -> Finding:
        """The verdict as a finding NUISANCE, for the sentence: statistic and limit as above, level 0 .. 1."""
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
    """Verdict on a nuisance by the likelihood ratio of two optima, `without` and `with_it`.

    name : "initial state" or "offset". The optima are of the same rows and of as many poles: not checked. J =
    0 counts as `TINY`.
    """
    ratio = max(without.end.rss, TINY) / max(with_it.end.rss, TINY)
    value = float(with_it.worth() * np.log(ratio))
    return NuisanceTest(name, _columns(without, with_it.data), value)


def clearly_left_out(name: str, without: Fitted, with_it: Regression) -> NuisanceTest | None:
    """Verdict "not needed" by the score test; None where only a descent can decide.

    Parameters
    ----------
    name : str
        Of the nuisance.
    without : Fitted
        The optimum without it.
    with_it : Regression
        The same rows with its columns; more rows than unknowns, which the caller has asked for.

    Returns
    -------
    NuisanceTest or None
        Where the gain of the first step stays clearly below the limit even if each of the N samples counted
        as independent. The statistic shown counts what the residual without the nuisance is worth.
    """
    poles = without.poles
    search = without.search
    here = with_it.linearise(*poles.writable())
    # |P r| / |r| over the directions in which the poles are free: their first step takes away this share.
    optimality = free_optimality(here, poles, search.bounds, search.fixed)
    promised = here.rss * (1 - optimality**2)
    gain = float(np.log(max(without.end.rss, TINY) / max(promised, TINY)))
    test = NuisanceTest(name, _columns(without, with_it), without.worth() * gain)
    if with_it.n_samples * gain < CLEARLY_BELOW * test.limit:
        return test
    return None


def _columns(without: Fitted, with_it: Regression) -> int:
    """Free real numbers that the data `with_it` have more in a fit than those of `without`, at its order.

    Negative where they have fewer: the caller does not exchange them.
    """
    order = without.poles.order
    return with_it.n_parameters(order) - without.data.n_parameters(order)
