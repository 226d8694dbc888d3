"""Do the held-out records confirm the answer that the estimation records gave?

They decide only where they leave more over than noise, solver disagreement and uncertain values explain, or
where a competing hypothesis predicts them far better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.evidence.hypotheses import Hypothesis, disagreement_gain
from diagnosis.fit.coordinates import box, effects_at, quotients
from diagnosis.fit.descent import Descent, steps_of
from diagnosis.fit.discrepancy import Discrepancy, discrepancy
from diagnosis.fit.likelihood import DECISIVE, SUBSTANTIAL
from diagnosis.fit.residual import ResidualModel
from diagnosis.fit.solver_spread import solver_spread, without_drift
from diagnosis.machine.machine_protocol import Real


def confronted(
    model: ResidualModel, hypotheses: Sequence[Hypothesis], leading: Hypothesis
) -> list[Hypothesis] | None:
    """The hypotheses with the log density of the held-out records added to their weights, and to an unknown
    rest what that gains; None if the records confirm the leading one and it is an answer, no look-alike."""
    if not model.case.held_out:
        return None
    first = _prediction(model, leading.end)
    confirmed = leading.is_answer and first.unknown_gain < SUBSTANTIAL
    if confirmed and not _contradicted(model, hypotheses, leading, first):
        return None
    best = max(h.evidence for h in hypotheses)
    seen = {
        k: first if h is leading else _prediction(model, h.end)
        for k, h in enumerate(hypotheses)
        if h.evidence > best - DECISIVE
    }
    # All others stay behind the best prediction by what they were behind before.
    least = _Prediction(max(p.gain for p in seen.values()), 0.0, 0.0)
    return [_with(h, seen.get(k, least)) for k, h in enumerate(hypotheses)]


def _contradicted(
    model: ResidualModel, hypotheses: Sequence[Hypothesis], leading: Hypothesis, first: _Prediction
) -> bool:
    """Whether another one with no more effects is well ahead of the leading one once both have predicted."""
    ahead = leading.log_weight + first.gain + SUBSTANTIAL
    close: dict[tuple[frozenset[str], bool], Hypothesis] = {}
    for h in sorted(hypotheses, key=lambda h: -h.weight):
        if len(h.names) <= len(leading.names) or not leading.names:
            close.setdefault((frozenset(h.names), h.is_answer), h)
    return any(
        h.weight + _prediction(model, h.end).gain > ahead
        for h in close.values()
        if h is not leading and h.weight > leading.log_weight - DECISIVE
    )


def _with(hypothesis: Hypothesis, seen: _Prediction) -> Hypothesis:
    known = hypothesis.log_weight + seen.gain
    unknown = hypothesis.unknown_weight + seen.gain
    if hypothesis.is_answer:
        unknown += seen.unknown_gain
    return replace(hypothesis, log_weight=known, unknown_weight=unknown)


@dataclass(frozen=True)
class _Prediction:
    """What held-out records say of a fit.

    log_density : of the records given the fitted values and their uncertainty, up to a common constant.
    allowed_gain : log evidence more if correct solvers may disagree.
    unknown_gain : log odds that they add to an unknown rest, beyond that.
    """

    log_density: float
    allowed_gain: float
    unknown_gain: float

    @property
    def gain(self) -> float:
        """What they add to the log weight of exactly these effects."""
        return self.log_density + self.allowed_gain


def _prediction(model: ResidualModel, end: Descent) -> _Prediction:
    case = model.case
    outputs = case.noise.size
    fitted, _ = without_drift(end.left, solver_spread(model, end))
    e, log_density = _unpredicted(model, end)
    segments = [len(record.output) for record in case.estimation]
    both = [*segments, *(len(record.output) for record in case.held_out)]
    before = discrepancy(fitted, segments, outputs)
    after = discrepancy(np.concatenate([fitted, e]), both, outputs)
    allowed = disagreement_gain(end, after) - disagreement_gain(end, before)
    return _Prediction(log_density, allowed, _odds(end, after) - _odds(end, before))


def _odds(end: Descent, left: Discrepancy) -> float:
    return left.log_gain_some - disagreement_gain(end, left)


def _unpredicted(model: ResidualModel, end: Descent) -> tuple[Real, float]:
    """Held-out residuals (N,) without what the fitted values' uncertainty may do to them; log density.

    The most probable shift of the values given both kinds of records, linearised at the fit. Where contacts
    switch the noise includes what correct solvers disagree about.
    """
    case = model.case
    e = model.of(end.deviations, end.effects, case.held_out)
    if not end.jacobian.shape[1]:
        return e, -0.5 * float(e @ e)
    at, held, by = end.coordinates, case.held_out, steps_of(end.candidates)
    J = np.hstack(
        [
            quotients(
                lambda d: model.of(d, end.effects, held),
                end.deviations,
                e,
                np.full(end.deviations.size, by[0]),
            ),
            quotients(
                lambda x: model.of(end.deviations, effects_at(end.candidates, x), held),
                at,
                e,
                by[1],
                box(end.candidates)[1],
            ),
        ]
    )
    spread = solver_spread(model, end, case.held_out)
    narrow, drift = without_drift(e, spread)
    density = drift.log_gain + 0.5 * float(narrow @ narrow - e @ e)
    if drift.size > 0:
        e, J = narrow, J / np.sqrt(1.0 + spread)[:, None]
    H = end.hessian
    scale = np.sqrt(np.maximum(np.diag(H), 1e-12))
    H = H + 1e-8 * np.diag(scale**2)
    A, gradient = H + J.T @ J, J.T @ e
    step = np.asarray(-np.linalg.solve(A, gradient))
    # A value that would leave its range stays where it is.
    free, step = np.flatnonzero(_inside(end, step)), np.zeros(step.size)
    step[free] = -np.linalg.solve(A[np.ix_(free, free)], gradient[free])
    cost = float(e @ e + gradient @ step)
    determinants = (
        np.linalg.slogdet(A / np.outer(scale, scale))[1] - (np.linalg.slogdet(H / np.outer(scale, scale))[1])
    )
    return np.asarray(e + J @ step), density - 0.5 * (cost + float(determinants))


def _inside(end: Descent, step: Real) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which of (d, x) stay in their ranges after a step (P + A,)."""
    P = end.deviations.size
    x = end.coordinates + step[P:]
    low, high = box(end.candidates)
    return np.concatenate([np.ones(P, dtype=bool), (low <= x) & (x <= high)])
