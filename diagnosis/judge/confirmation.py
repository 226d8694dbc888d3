"""Whether validation records confirm the answer that the estimation records gave.

They decide only where they leave more over than noise, solver disagreement and uncertain values explain, or
where a competing hypothesis predicts them far better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from diagnosis.evidence.hypotheses import Hypothesis, disagreement_gain
from diagnosis.fit.coordinates import bounds_of, difference_quotients, effects_at
from diagnosis.fit.descent import Fit, steps_of
from diagnosis.fit.discrepancy import Discrepancy, discrepancy
from diagnosis.fit.likelihood import DECISIVE, SUBSTANTIAL
from diagnosis.fit.residual import ResidualModel
from diagnosis.fit.solver_spread import solver_spread, without_drift
from diagnosis.machine.machine_protocol import Real

# Smallest diagonal of a Hessian, in squares per square of a coordinate, for its scaling: nothing that a
# record tells is as weak, and a zero would divide.
_LEAST_CURVATURE = 1e-12
# Share of its own diagonal that is added to a Hessian before it is solved with: half the digits of a double,
# so that a coordinate on which nothing depends stays where it is and no other one moves by what is seen.
_DAMPING = 1e-8


def confronted(
    model: ResidualModel, hypotheses: Sequence[Hypothesis], leading: Hypothesis
) -> list[Hypothesis] | None:
    """The hypotheses weighed by validation records too; None where these confirm the leading one.

    Parameters
    ----------
    model : ResidualModel
        Of the case.
    hypotheses : sequence of Hypothesis
        Weighed by the estimation records.
    leading : Hypothesis
        The likeliest of them. A look-alike is never confirmed: it is no answer.

    Returns
    -------
    list of Hypothesis or None
        In the same order. To every weight the log density of the validation records is added, and to that of
        an unknown cause what such a cause gains from them. None, too, where there are no validation records.
    """
    if not model.case.held_out:
        return None
    leading_prediction = _prediction(model, leading.fit)
    leaves_nothing = leading.is_answer and leading_prediction.unknown_gain < SUBSTANTIAL
    if leaves_nothing and not _contradicted(model, hypotheses, leading, leading_prediction):
        return None

    best_evidence = max(hypothesis.log_evidence for hypothesis in hypotheses)
    predictions = {}
    for k, hypothesis in enumerate(hypotheses):
        if hypothesis is leading:
            predictions[k] = leading_prediction
        elif hypothesis.log_evidence > best_evidence - DECISIVE:
            predictions[k] = _prediction(model, hypothesis.fit)
    # Others are not worth a simulation: with the best prediction they stay behind by what they were behind.
    best_gain = max(prediction.gain for prediction in predictions.values())
    not_predicted = _Prediction(best_gain, 0.0, 0.0)
    return [_with(h, predictions.get(k, not_predicted)) for k, h in enumerate(hypotheses)]


def _contradicted(
    model: ResidualModel,
    hypotheses: Sequence[Hypothesis],
    leading: Hypothesis,
    leading_prediction: _Prediction,
) -> bool:
    """Whether a hypothesis with no more effects is well ahead of the leading one by both kinds of records.

    Of each set of effects the best fit is asked; any number of effects where the leading one has none.
    """
    needed = leading.log_weight + leading_prediction.gain + SUBSTANTIAL
    rivals: dict[tuple[frozenset[str], bool], Hypothesis] = {}
    for hypothesis in sorted(hypotheses, key=lambda h: -h.log_cause_weight):
        if len(hypothesis.names) <= len(leading.names) or not leading.names:
            rivals.setdefault((frozenset(hypothesis.names), hypothesis.is_answer), hypothesis)
    for rival in rivals.values():
        if rival is leading or rival.log_cause_weight <= leading.log_weight - DECISIVE:
            continue
        if rival.log_cause_weight + _prediction(model, rival.fit).gain > needed:
            return True
    return False


def _with(hypothesis: Hypothesis, prediction: _Prediction) -> Hypothesis:
    """A hypothesis with what validation records add to its log weights."""
    log_weight_with_unknown = hypothesis.log_weight_with_unknown + prediction.gain
    if hypothesis.is_answer:
        log_weight_with_unknown += prediction.unknown_gain
    return replace(
        hypothesis,
        log_weight=hypothesis.log_weight + prediction.gain,
        log_weight_with_unknown=log_weight_with_unknown,
    )


@dataclass(frozen=True)
class _Prediction:
    """What validation records say of a fit.

    Attributes
    ----------
    log_density : float
        Of the records given the fitted values and their uncertainty, up to a constant of the case.
    allowed_gain : float
        Log evidence that is gained if correct solvers may disagree.
    unknown_gain : float
        Log odds that the records add to an unknown cause, beyond that.
    """

    log_density: float
    allowed_gain: float
    unknown_gain: float

    @property
    def gain(self) -> float:
        """What the records add to the log weight of exactly these effects."""
        return self.log_density + self.allowed_gain


def _prediction(model: ResidualModel, fit: Fit) -> _Prediction:
    """What validation records say of the end of a fit."""
    case = model.case
    outputs = case.noise.size
    estimation_samples = [len(record.output) for record in case.estimation]
    validation_samples = [len(record.output) for record in case.held_out]
    fitted, _ = without_drift(fit.residual_coefficients, solver_spread(model, fit))
    unpredicted, log_density = _unpredicted(model, fit)
    before = discrepancy(fitted, estimation_samples, outputs)
    after = discrepancy(
        np.concatenate([fitted, unpredicted]), [*estimation_samples, *validation_samples], outputs
    )
    allowed_gain = disagreement_gain(fit, after) - disagreement_gain(fit, before)
    return _Prediction(log_density, allowed_gain, _unknown_odds(fit, after) - _unknown_odds(fit, before))


def _unknown_odds(fit: Fit, left: Discrepancy) -> float:
    """Log odds of an unknown cause for what is left, beyond the disagreement of correct solvers."""
    return left.log_gain_some - disagreement_gain(fit, left)


def _unpredicted(model: ResidualModel, fit: Fit) -> tuple[Real, float]:
    """Validation residuals without what the fitted values' uncertainty may do to them, and their log density.

    Returns
    -------
    residuals : (N,) array
        In noise deviations, all records and outputs in a row.
    log_density : float
        Up to a constant of the case.

    Notes
    -----
    With H the Hessian of the fit and J the Jacobian of the validation residuals e, the most probable shift of
    the values given both kinds of records is -(H + J'J)^-1 J'e, linearised at the fit; the density is that of
    a Gaussian with the covariance I + J H^-1 J'. Where contacts switch, the noise includes what correct
    solvers disagree about.
    """
    held_out = model.case.held_out
    residuals = model.of(fit.deviations, fit.effects, held_out)
    if not fit.jacobian.shape[1]:
        return residuals, -0.5 * float(residuals @ residuals)
    step_sizes = steps_of(fit.candidates)
    by_deviations = difference_quotients(
        lambda deviations: model.of(deviations, fit.effects, held_out),
        fit.deviations,
        residuals,
        np.full(fit.deviations.size, step_sizes[0]),
    )
    by_coordinates = difference_quotients(
        lambda coordinates: model.of(fit.deviations, effects_at(fit.candidates, coordinates), held_out),
        fit.coordinates,
        residuals,
        step_sizes[1],
        bounds_of(fit.candidates)[1],
    )
    J = np.hstack([by_deviations, by_coordinates])

    spread = solver_spread(model, fit, held_out)
    narrowed, drift = without_drift(residuals, spread)
    log_density = drift.log_gain + 0.5 * float(narrowed @ narrowed - residuals @ residuals)
    if drift.size > 0:
        residuals = narrowed
        J = J / np.sqrt(1.0 + spread)[:, None]

    H = fit.hessian
    scale = np.sqrt(np.maximum(np.diag(H), _LEAST_CURVATURE))
    H = H + _DAMPING * np.diag(scale**2)
    hessian_of_both = H + J.T @ J
    gradient = J.T @ residuals
    step = np.asarray(-np.linalg.solve(hessian_of_both, gradient))
    # A value that would leave its range stays where it is.
    free = np.flatnonzero(_inside(fit, step))
    step = np.zeros(step.size)
    step[free] = -np.linalg.solve(hessian_of_both[np.ix_(free, free)], gradient[free])

    quadratic = float(residuals @ residuals + gradient @ step)
    # Scaled, so that values of different size lose no digits.
    scales = np.outer(scale, scale)
    log_determinant = float(np.linalg.slogdet(hessian_of_both / scales)[1] - np.linalg.slogdet(H / scales)[1])
    return np.asarray(residuals + J @ step), log_density - 0.5 * (quadratic + log_determinant)


def _inside(fit: Fit, step: Real) -> npt.NDArray[np.bool_]:
    """(P + A,) which unknowns stay in their ranges after a step (P + A,): P deviations always do, of A
    coordinates those within the bounds of their effects."""
    P = fit.deviations.size
    coordinates = fit.coordinates + step[P:]
    low, high = bounds_of(fit.candidates)
    return np.concatenate([np.ones(P, dtype=bool), (low <= coordinates) & (coordinates <= high)])
