"""Dead time of the input, sought together with the order.

`first_answer` asks a long ARX model up to which lag the inputs are not missed by the output; later answers
show in a correlation of changes. `seek` selects the order again behind that many samples, moves the number to
the best one, and keeps the delay where the criterion of the order, which charges for it, clearly prefers the
delayed model. Both numbers are sought together because poles near zero stand for delay, and a pole too many
for a delay that is wrong by a sample. Neglected: a delay of each input by itself; a loop around the plant.

`Fitted`, of another file, is an optimum (`poles`, fixed ones first of each type; `end.rss`, its J) with its
`data` (records made ready for a fit), its `search`, and `worth()`, the independent samples Ne that its
residual is worth. Records are those of a fit that has refused unusable ones; nothing is refused here unless
it is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2

from ident.basis.poles import DEADBEAT
from ident.data.arrays import RealArray
from ident.data.ellipses import LEVEL
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.fit.least_squares import EXPLAINED, Regression
from ident.fit.refinement import Refined
from ident.fit.regression import prepare_inputs
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import Fitted, PoleSearch

# Lags of the output in the long model: fifteen pairs of poles for what the plant and the noise do by
# themselves. Chosen.
OUTPUT_LAGS = 30
# Lags of the input in the long model; later answers are left to the correlation. Chosen: a model of 131
# columns takes little time.
INPUT_LAGS = 100
# Rows that the shortest record has for each lag at least: the lags then take up a twentieth of the noise.
ROWS_PER_LAG = 20
# Records that have no room for so many lags tell no delay: with a single lag there is none before an answer
# that could be left out.
FEWEST_LAGS = 2
# Inputs that are missed less probably than this by chance are missed. Chosen: errors cost time only, as what
# is found here is judged again.
MISSED_BY_CHANCE = 1e-3
# Changes of the number of samples that are tried around the best one so far, in this order: next to it, and
# over a gap, as J swings with the delay where the input is limited to a band. Chosen.
STEPS = (-1, 1, -3, 3, -8, 8)
# A delay is shorter than this part of the shortest record: behind it as much has to be left to fit.
LONGEST_PART = 2
# Changes of the number of samples beside the best one where the order is selected again from its poles ...
NEAR_STEPS = (-1, 1)
# ... and where it is selected again from the start, as the poles may stand for a wrong number of samples.
# Chosen: a real pole and a pair at zero stand for three.
ANEW_STEPS = (-3, -2, -1, 0, 1, 2, 3)
# Selections of the order behind one number of samples after the other, at most. A bound on time: they end
# where the number stays.
MOST_ROUNDS = 6
# Gain of the criterion (-2 log of a Bayes factor) from which a delay is kept: strong evidence (Kass and
# Raftery, JASA 90(430), 1995). Below, a fast pole is likelier.
STRONG = 6.0


def seek(records: Sequence[Record], plain: Fitted, starts: Sequence[int]) -> SearchOutcome | None:
    """Model behind a delay that the criterion of the order prefers to one without; None where there is none.

    Parameters
    ----------
    records : sequence of Record
        One input each.
    plain : Fitted
        End of a search without a delay on these records.
    starts : sequence of int
        Delays in samples where the search begins (`first_answer`); empty: none is sought. They are shorter
        than the shortest record, else `prepare_inputs` raises ValueError.

    Returns
    -------
    SearchOutcome or None
        `dead_time`: the finding DEAD_TIME, with the interval of delays that fit as well with these poles.
    """
    if not starts:
        return None
    # From each start the order; the best one moved to where it fits best, and the order selected again.
    outcomes = [_behind(records, plain, start) for start in starts]
    best = max(outcomes, key=lambda outcome: outcome.gain_over(plain))
    for _ in range(MOST_ROUNDS):
        moved = _moved(records, best).best
        if _delay(moved) == _delay(best):
            break
        best = _behind(records, moved, _delay(moved))

    # Neighbours, each with an order of its own.
    for _ in range(MOST_ROUNDS):
        if _delay(best) == 0 or best.gain_over(plain) <= STRONG:
            return None
        neighbour = _better_neighbour(records, best)
        if neighbour is None:
            break
        best = neighbour

    # Delays that fit as well with these poles (95 %).
    fits = _moved(records, best).by_delay
    limit = float(chi2.ppf(LEVEL, 1))
    likely = [delay for delay, other in fits.items() if gain(best, other) <= limit]
    if min(likely) < _delay(best):
        # Ellipses hold a response that begins later than the delay, never one that begins earlier.
        earliest = _behind(records, fits[min(likely)], min(likely))
        if earliest.poles.order <= best.poles.order:
            best = earliest

    # The poles that were left may also do without a delay, in a place that the first search has missed.
    if best.gain_over(_behind(records, best, 0)) <= STRONG:
        return None
    searched_real = best.poles.real[best.search.fixed.real.size :]
    dead_time = finding(
        FindingKind.DEAD_TIME,
        delay=_delay(best),
        delay_ms=1e3 * _delay(best) * best.data.dt_s,
        low=min(likely),
        high=max(likely),
        partial=bool(np.any(np.abs(searched_real) < DEADBEAT)),
        order=best.poles.order,
        order_without=plain.poles.order,
        gain=best.gain_over(plain),
    )
    return replace(best, dead_time=dead_time)


class FirstAnswer(NamedTuple):
    """Where the response to the input begins.

    Attributes
    ----------
    starts : tuple of int
        Numbers of samples after which it may begin, beside the one sample that every response without a
        direct term has; empty: with the next sample, or not known.
    at_once : bool
        The output misses the input of the very sample: there is a direct term.
    """

    starts: tuple[int, ...]
    at_once: bool


def first_answer(records: Sequence[Record]) -> FirstAnswer:
    """Where the response begins, as a long ARX model and a correlation of changes say.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each, one record at least (ValueError without).

    Returns
    -------
    FirstAnswer
        Without starts, and not at once, where records are too short, or where nothing is left of the output,
        as of data without noise.

    Notes
    -----
    y(k) = sum_i a_i y(k - i) + sum_j b_j u(k - j) + constant of the record + e(k), j from 0, by one QR
    factorisation of all columns with y last. The inputs stand before it, the latest at the end: the sum of
    the last squares of R's last column is what leaving out the latest inputs costs, chi-square over the
    variance of e. An answer beyond the lags shows as a peak of the correlation of changes of input and
    output.
    """
    shortest = min(record.n_samples for record in records)
    lags = min(INPUT_LAGS, shortest // ROWS_PER_LAG)
    output_lags = min(OUTPUT_LAGS, lags)
    if lags < FEWEST_LAGS:
        return FirstAnswer((), at_once=False)

    # Rows of the regression: constant of each record, past outputs, inputs from the oldest to the latest,
    # output.
    regressors = []
    targets = []
    for record in records:
        u = record.input[:, 0] - record.input[0, 0]
        y = record.output[:, 0] - record.output[0, 0]
        past_outputs = np.lib.stride_tricks.sliding_window_view(y[:-1], lags)[:, lags - output_lags :]
        inputs = np.lib.stride_tricks.sliding_window_view(u, lags + 1)
        regressors.append(np.hstack([past_outputs, inputs]))
        targets.append(y[lags:])
    n_rows_each = [rows.shape[0] for rows in regressors]
    constants = np.repeat(np.eye(len(records)), n_rows_each, axis=0)
    columns = np.column_stack([constants, np.vstack(regressors), np.concatenate(targets)])
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    triangle = np.asarray(np.linalg.qr(scaled, mode="r"))

    n_rows, n_columns = columns.shape
    freedom = n_rows - n_columns + 1
    noise = float(triangle[-1, -1] ** 2) / max(freedom, 1)
    if freedom < 1 or not noise > 0:
        return FirstAnswer((), at_once=False)
    # What leaving out the input at lag 0, 1, ... lags costs, each after those before it were left out.
    # The last row of the triangle is that of the output itself, so lag 0 stands in the one before, at -2.
    last_column = triangle[-2 : -lags - 3 : -1, -1]
    costs = last_column**2 / noise
    at_once = bool(chi2.sf(costs[0], 1) < MISSED_BY_CHANCE)
    # Whether the inputs at lags 1 to 1, 2, ... lags are missed together.
    by_chance = chi2.sf(np.cumsum(costs[1:]), np.arange(1, lags + 1))
    missed = np.asarray(by_chance < MISSED_BY_CHANCE)
    if missed[0]:
        return FirstAnswer((), at_once)
    starts = []
    if missed.any():
        starts.append(int(np.argmax(missed)))
    # Lags up to half the shortest record: behind a longer delay less than that is left to fit
    # (`LONGEST_PART`).
    late = _late_answer(records, shortest // 2)
    if late > lags or (late and not starts):
        starts.append(late)
    return FirstAnswer(tuple(starts), at_once)


def _late_answer(records: Sequence[Record], n_lags: int) -> int:
    """Delay in samples at the peak of the correlation of changes of input and output; 0 where none stands
    out.

    Over lags 0 to n_lags - 1, all records together. A peak counts that lags of nothing but chance would show
    once in a thousand such records: normal with the root mean square of all lags, the largest of n_lags,
    which is sqrt(2 ln(n_lags / p)) deviations at probability p. Every record has more than n_lags rows
    (ValueError of NumPy else); 0 also where nothing moves.
    """
    total: RealArray = np.zeros(n_lags)
    for record in records:
        input_changes = np.diff(record.input[:, 0])
        output_changes = np.diff(record.output[:, 0])
        at_all_lags = correlate(output_changes, input_changes, mode="full", method="fft")
        zero_lag = input_changes.size - 1
        total += at_all_lags[zero_lag:][:n_lags]
    peak = int(np.argmax(np.abs(total)))
    usual = float(np.sqrt(np.mean(total**2)))
    by_chance = usual * np.sqrt(2 * np.log(n_lags / MISSED_BY_CHANCE))
    if not abs(total[peak]) > by_chance:
        return 0
    # A response without a direct term begins one sample after the input in any case.
    return max(peak - 1, 0)


@dataclass(frozen=True, eq=False)
class SearchOutcome(Fitted):
    """End of a search for order and poles on one structure.

    Attributes
    ----------
    selection : OrderSelection
        Of the order, with its table.
    free : Refined or None
        End of the descent with free initial states by which these were tested; None where none was made.
    from_rest : Finding or None
        The verdict by which initial states were left out without a descent; None else.
    dead_time : Finding or None
        The delay that was found.
    """

    selection: OrderSelection
    free: Refined | None = None
    from_rest: Finding | None = None
    dead_time: Finding | None = None

    def gain_over(self, other: Fitted) -> float:
        """By how much the criterion of the order is lower than that of another fit of the same records.

        Ne ln(J' / J) + (free numbers' - free numbers) ln Ne - 2 (ln(1 + d) - ln(1 + d')), those of the other
        fit with a prime. A delay of d samples costs 2 ln(1 + d), as an integer of which the small ones are
        the likelier (Rissanen, Annals of Statistics 11(2), 1983). That both are fits of the same records is
        not checked.
        """
        n_numbers = self.data.n_parameters(self.poles.order)
        n_fewer = other.data.n_parameters(other.poles.order) - n_numbers
        longer = float(np.log1p(_delay(self)) - np.log1p(_delay(other)))
        return gain(self, other) + n_fewer * float(np.log(self.worth())) - 2 * longer


def _behind(records: Sequence[Record], near: Fitted, delay: int, anew: bool = False) -> SearchOutcome:
    """Order and poles selected behind a delay in samples.

    From the poles of `near`, a model with another delay; from the start where that has none, or with `anew`.
    Raises ValueError (`prepare_inputs`) where a record has no rows behind the delay, or the delay is below
    zero.
    """
    search = _search(records, near, delay)
    selection = OrderSelection(search)
    start = None
    if near.poles.order > search.fixed.order and not anew:
        start = search.descend(near.poles, f"delay {delay}")
    return SearchOutcome(search, selection.run(start), selection)


def _better_neighbour(records: Sequence[Record], best: SearchOutcome) -> SearchOutcome | None:
    """Order and poles selected again behind a neighbouring delay, where the criterion prefers that; else
    None.

    A pole too many stands for what is wrong with the number of samples, so neighbours are also selected from
    the start. Those are left out that lose more with these poles than all free numbers of the fit are worth:
    fewer poles could not win that back. Raises ValueError where a neighbour has no rows: `best` lies far from
    the end of the records.
    """
    fits = _moved(records, best).by_delay
    worth_of_numbers = best.data.n_parameters(best.poles.order) * float(np.log(best.worth()))
    trials = [(step, False) for step in NEAR_STEPS] + [(step, True) for step in ANEW_STEPS]
    neighbours = []
    for step, anew in trials:
        delay = _delay(best) + step
        if delay in fits and gain(best, fits[delay]) >= worth_of_numbers:
            continue
        # There is no delay below zero: zero takes its place.
        neighbours.append(_behind(records, best, max(delay, 0), anew))
    best_neighbour = max(neighbours, key=lambda outcome: outcome.gain_over(best), default=best)
    if best_neighbour.gain_over(best) > 0:
        return best_neighbour
    return None


def _search(records: Sequence[Record], near: Fitted, delay: int) -> PoleSearch[Regression]:
    """A search like that of `near` on the records behind a delay in samples; nothing is searched yet.

    Raises ValueError (`prepare_inputs`, `Structure`) where a record has no rows behind it, or it is below
    zero.
    """
    data = prepare_inputs(records, replace(near.data.structure, input_delay_samples=delay))
    return PoleSearch(data, near.search.options.model_copy(update={"input_delay_samples": delay}))


def _delay(fitted: Fitted) -> int:
    """Input delay of a fit in samples, 0 or more."""
    return fitted.data.structure.input_delay_samples


class DelayFits(NamedTuple):
    """Fits of one order behind several delays in samples, and the best of them."""

    best: Fitted
    by_delay: dict[int, Fitted]


def _moved(records: Sequence[Record], fitted: Fitted) -> DelayFits:
    """The order of a fit behind the number of samples that fits best, and behind all that were tried.

    From the fit's own delay by the first of `STEPS` that gains, until none does; poles are refined each time.
    Delays below zero, or of half the shortest record and more, are passed over.
    """
    best = fitted
    by_delay = {_delay(fitted): fitted}
    longest = min(record.n_samples for record in records) // LONGEST_PART
    gained = True
    while gained:
        gained = False
        for step in STEPS:
            delay = _delay(best) + step
            if not 0 <= delay < longest or delay in by_delay:
                continue
            search = _search(records, best, delay)
            trial = Fitted(search, search.descend(best.poles, f"delay {delay}"))
            by_delay[delay] = trial
            if gain(trial, best) > 0:
                best = trial
                gained = True
                break
    return DelayFits(best, by_delay)


def gain(fitted: Fitted, other: Fitted) -> float:
    """Ne ln(J of other / J of fitted) on the rows that both explain: how much better `fitted` is.

    Ne: independent samples that the residual of `fitted` is worth. 0 where both leave rounding only. Both are
    fits of the same records (not checked).
    """
    common_delay = max(_delay(fitted), _delay(other))
    power = _power_from(fitted, common_delay)
    other_power = _power_from(other, common_delay)
    floor = EXPLAINED * fitted.data.power
    return fitted.worth() * float(np.log(max(other_power, floor) / max(power, floor)))


def _power_from(fitted: Fitted, delay: int) -> float:
    """Sum of squares of the residual of a fit in the rows from this delay on, over all records.

    In output units squared; the delay is not below the fit's own.
    """
    residual = fitted.residual
    # `delay` is at least the fit's own (`gain`); rows beyond the end of a record are an empty sum. Residuals
    # of a record begin behind the fit's own delay.
    skip = delay - _delay(fitted)
    return sum(float(np.sum(residual[rows][skip:] ** 2)) for rows in fitted.data.segments)
