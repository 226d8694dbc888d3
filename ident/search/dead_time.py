"""Dead time of the input, sought together with the order.

A long ARX model tells up to which lag the inputs are not missed. The order is selected again behind that many
samples, the number moved to the best one; the delay stays where the criterion of the order, which charges for
it, prefers the delayed model. Neglected: a delay of each input by itself; a loop around the plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2

from ident.basis.poles import DEADBEAT
from ident.data.ellipses import LEVEL
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.fit.least_squares import EXPLAINED, Regression
from ident.fit.refinement import Refined
from ident.fit.regression import prepare_inputs
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import Fitted, PoleSearch

# Lags of output and input of the long model, as far as the shortest record has this many rows for each.
_OUTPUT_LAGS, _INPUT_LAGS = 30, 100
_ROWS_PER_LAG = 20  # the lags then take up a twentieth of the noise
# Lags that are missed less probably than this are missed: what is found here is judged again.
_MISSED = 1e-3
# Samples from the best one so far: next to it, and over a gap of a band-limited input.
_STEPS = (-1, 1, -3, 3, -8, 8)
# Numbers of samples beside the best one where the order is selected again, and whether from the start.
_NEIGHBOURS = ((-1, False), (1, False), *((step, True) for step in (-3, -2, -1, 0, 1, 2, 3)))
# Selections of the order behind one number of samples after the other, at most.
_ROUNDS = 6
# -2 log of a Bayes factor: strong from 6 on (Kass and Raftery, JASA 90(430), 1995); a fast pole is likelier.
_STRONG = 6.0


def seek(records: Sequence[Record], plain: Fitted, starts: Sequence[int]) -> SearchOutcome | None:
    """The model behind a delay that the criterion of the order prefers to `plain`, the end of a search
    without one on these records; None where there is none.

    records: one input each. starts: where the search begins, as of `first_answer`.
    """
    if not starts:
        return None
    best = max((_behind(records, plain, start) for start in starts), key=lambda end: end.gain_over(plain))
    for _ in range(_ROUNDS):
        moved, _ = _moved(records, best)
        if _delay(moved) == _delay(best):
            break
        best = _behind(records, moved, _delay(moved))
    for _ in range(_ROUNDS):
        if _delay(best) == 0 or best.gain_over(plain) <= _STRONG:
            return None
        other = _better_neighbour(records, best)
        if other is None:
            break
        best = other
    _, known = _moved(records, best)
    limit = float(chi2.ppf(LEVEL, 1))
    likely = [delay for delay, other in known.items() if gain(best, other) <= limit]
    if min(likely) < _delay(best):
        # Ellipses hold a response that begins later than the delay, never one that begins earlier.
        early = _behind(records, known[min(likely)], min(likely))
        best = early if early.poles.order <= best.poles.order else best
    # The poles that were left may also do without a delay, in a place that the first search has missed.
    if best.gain_over(_behind(records, best, 0)) <= _STRONG:
        return None
    told = finding(
        FindingKind.DEAD_TIME,
        delay=_delay(best),
        delay_ms=1e3 * _delay(best) * best.data.dt_s,
        low=min(likely),
        high=max(likely),
        partial=bool(np.any(np.abs(best.poles.real[best.search.fixed.real.size :]) < DEADBEAT)),
        order=best.poles.order,
        order_without=plain.poles.order,
        gain=best.gain_over(plain),
    )
    return replace(best, dead_time=told)


def first_answer(records: Sequence[Record]) -> tuple[tuple[int, ...], bool]:
    """Where the response begins, as a long ARX model says: how many of the latest inputs the output may not
    miss, and whether it misses that of the very sample; nothing is missed where records are too short for it.
    The inputs stand last in one factorisation, the latest at its end: the sum of the last squares is what
    leaving out the latest inputs costs. What answers beyond its lags shows in the correlation of changes."""
    shortest = min(record.n_samples for record in records)
    lags = min(_INPUT_LAGS, shortest // _ROWS_PER_LAG)
    own = min(_OUTPUT_LAGS, lags)
    if lags < 2:
        return (), False
    blocks, targets = [], []
    for record in records:
        u, y = (signal[:, 0] - signal[0, 0] for signal in (record.input, record.output))
        past = np.lib.stride_tricks.sliding_window_view(y[:-1], lags)[:, lags - own :]
        blocks.append(np.hstack([past, np.lib.stride_tricks.sliding_window_view(u, lags + 1)]))
        targets.append(y[lags:])
    offsets = np.repeat(np.eye(len(records)), [block.shape[0] for block in blocks], axis=0)
    columns = np.column_stack([offsets, np.vstack(blocks), np.concatenate(targets)])
    scale = np.linalg.norm(columns, axis=0)
    triangle = np.asarray(np.linalg.qr(columns / np.where(scale > 0, scale, 1.0), mode="r"))
    freedom = columns.shape[0] - columns.shape[1] + 1
    noise = float(triangle[-1, -1] ** 2) / max(freedom, 1)
    if freedom < 1 or not noise > 0:
        return (), False
    squares = triangle[-2 : -lags - 3 : -1, -1] ** 2 / noise
    missed = np.asarray(chi2.sf(np.cumsum(squares[1:]), np.arange(1, lags + 1)) < _MISSED)
    at_once = bool(chi2.sf(squares[0], 1) < _MISSED)
    if missed[0]:
        return (), at_once
    starts = [int(np.argmax(missed))] if missed.any() else []
    total = np.zeros(shortest // 2)
    for record in records:
        u, y = np.diff(record.input[:, 0]), np.diff(record.output[:, 0])
        total += correlate(y, u, mode="full", method="fft")[u.size - 1 :][: total.size]
    # A peak that lags of nothing but chance would show once in a thousand such records.
    peak, usual = int(np.argmax(np.abs(total))), float(np.sqrt(np.mean(total**2)))
    late = max(peak - 1, 0) if (abs(total[peak]) > usual * np.sqrt(2 * np.log(total.size / _MISSED))) else 0
    return (*starts, *([late] if late > lags or (late and not starts) else [])), at_once


@dataclass(frozen=True, eq=False)
class SearchOutcome(Fitted):
    """A search at its end on one structure. from_rest: what the test said that left initial states out; free:
    the end of a descent with them, where it took one; dead_time: the delay that was found."""

    selection: OrderSelection
    free: Refined | None = None
    from_rest: Finding | None = None
    dead_time: Finding | None = None

    def gain_over(self, other: Fitted) -> float:
        """By how much the criterion of the order is lower; a delay of d samples costs 2 ln(1 + d), as an
        integer of which the small ones are the likelier (Rissanen)."""
        fewer = other.data.n_parameters(other.poles.order) - self.data.n_parameters(self.poles.order)
        longer = float(np.log1p(_delay(self)) - np.log1p(_delay(other)))
        return gain(self, other) + fewer * float(np.log(self.worth())) - 2 * longer


def _behind(records: Sequence[Record], near: Fitted, delay: int, again: bool = False) -> SearchOutcome:
    """Order and poles selected behind a delay, from the poles of a model with another one or from the
    start."""
    search = _search(records, near, max(delay, 0))
    selection = OrderSelection(search)
    known = near.poles.order > search.fixed.order and not again
    start = search.descend(near.poles, f"delay {delay}") if known else None
    return SearchOutcome(search, selection.run(start), selection)


def _better_neighbour(records: Sequence[Record], found: SearchOutcome) -> SearchOutcome | None:
    """The order selected again, at neighbours and from the start: a pole too many stands for what is wrong
    with the number of samples. None where nothing is better."""
    _, known = _moved(records, found)
    # What a neighbour loses with these poles, fewer of them would have to be worth.
    most = found.data.n_parameters(found.poles.order) * float(np.log(found.worth()))
    near = [
        _behind(records, found, _delay(found) + step, again)
        for step, again in _NEIGHBOURS
        if _delay(found) + step not in known or gain(found, known[_delay(found) + step]) < most
    ]
    other = max(near, key=lambda item: item.gain_over(found), default=found)
    return other if other.gain_over(found) > 0 else None


def _search(records: Sequence[Record], near: Fitted, delay: int) -> PoleSearch[Regression]:
    data = prepare_inputs(records, replace(near.data.structure, input_delay_samples=delay))
    return PoleSearch(data, near.search.options.model_copy(update={"input_delay_samples": delay}))


def _delay(found: Fitted) -> int:
    return found.data.structure.input_delay_samples


def _moved(records: Sequence[Record], found: Fitted) -> tuple[Fitted, dict[int, Fitted]]:
    """The same order behind the number of samples that fits best, and behind all that were tried."""
    known = {_delay(found): found}
    longest = min(record.n_samples for record in records) // 2
    while True:
        for step in _STEPS:
            delay = _delay(found) + step
            if not 0 <= delay < longest or delay in known:
                continue
            search = _search(records, found, delay)
            known[delay] = there = Fitted(search, search.descend(found.poles, f"delay {delay}"))
            if gain(there, found) > 0:
                found = there
                break
        else:
            return found, known


def gain(found: Fitted, other: Fitted) -> float:
    """Ne ln(J of other / J of found) on the rows that both answer to."""
    delay = max(_delay(found), _delay(other))
    ours, theirs = (
        sum(float(np.sum(item.residual[here][delay - _delay(item) :] ** 2)) for here in item.data.segments)
        for item in (found, other)
    )
    floor = EXPLAINED * found.data.power
    return found.worth() * float(np.log(max(theirs, floor) / max(ours, floor)))
