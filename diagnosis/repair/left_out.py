"""Values and sizes as they would be, had one log not been fitted, without another fit.

At the end of a fit the Gauss-Newton equations of all logs are known, and each log's part in them. Without a
log its part is taken off, and one step leads to where the others would have ended (the approximate
leave-one-out of Rad and Maleki, J. R. Stat. Soc. B 82, 2020, for squares that are reweighted).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from diagnosis.fit.coordinates import bounds_of, solve_or_least_squares
from diagnosis.fit.descent import LARGEST_STEP, Fit
from diagnosis.fit.nominal import prior_curvature, prior_slope
from diagnosis.fit.records import FittedStart, RecordsToFit
from diagnosis.machine.machine_protocol import Real

# Of the diagonal, added where the logs that are left say nothing about a size: small beside any information.
_REGULAR = 1e-9


@dataclass(frozen=True, eq=False)
class SharedUnknowns:
    """What all logs have in common.

    Attributes
    ----------
    deviations : (P,) array
        Nominal values, in tolerances off.
    coordinates : (A,) array
        Sizes of the effects, as their axes count them.
    start : FittedStart
        Zeros of the sensors, and the states at the start of every log that go with them.
    """

    deviations: Real
    coordinates: Real
    start: FittedStart


def fitted_without_each_log(
    records: RecordsToFit, end: Fit, moved: npt.NDArray[np.bool_]
) -> list[SharedUnknowns]:
    """The end of a fit as every log would have left it, had that log not been fitted.

    Parameters
    ----------
    records : RecordsToFit
        The R logs that were fitted.
    end : Descent
        Where the fit ended, with the Jacobian at or near that point.
    moved : (P,) array of bool
        Nominal values that the fit may move; the others stay where they are.

    Returns
    -------
    list of SharedUnknowns
        One for every log, in the order of the records. Steps are limited to what a linearisation bears, and
        sizes to their ranges.

    Raises
    ------
    ValueError
        With a single log: nothing is left to be fitted.
    """
    logs = len(records.record_slices)
    if logs < 2:
        raise ValueError("a log can be left out of two or more; got one")
    curvatures, gradients = _parts_of_logs(records, end)

    # What is known before any log.
    P = end.deviations.size
    A = end.coordinates.size
    prior_diagonal = np.zeros(P + A + end.start.zeros.size)
    prior_diagonal[:P] = prior_curvature(end.deviations)
    prior_diagonal[P + A :] = 1 / records.zero_spread**2
    prior_gradient = np.zeros(prior_diagonal.size)
    prior_gradient[:P] = prior_slope(end.deviations)
    prior_gradient[P + A :] = end.start.zeros / records.zero_spread**2

    low, high = bounds_of(end.candidates)
    free = np.concatenate([np.flatnonzero(moved), np.arange(P, prior_diagonal.size)])
    without = []
    for log in range(logs):
        curvature = np.sum(curvatures, axis=0) - curvatures[log] + np.diag(prior_diagonal)
        curvature += _REGULAR * np.diag(np.diag(curvature) + _REGULAR)
        gradient = np.sum(gradients, axis=0) - gradients[log] + prior_gradient
        step = np.zeros(gradient.size)
        step[free] = -solve_or_least_squares(curvature[np.ix_(free, free)], gradient[free])
        step[: P + A] = np.clip(step[: P + A], -LARGEST_STEP, LARGEST_STEP)
        zeros = end.start.zeros + step[P + A :]
        without.append(
            SharedUnknowns(
                records.nominal.clipped(end.deviations + step[:P]),
                np.clip(end.coordinates + step[P : P + A], low, high),
                end.start.with_zeros(zeros, records.case.machine.unknown_start.state_per_zero),
            )
        )
    return without


def _parts_of_logs(records: RecordsToFit, end: Fit) -> tuple[Real, Real]:
    """Every log's part of the curvature (R, K, K) and of the gradient (R, K) of the loss.

    By the K shared unknowns: deviations, coordinates, zeros. The states at the start of a log belong to it
    alone and follow (Schur complement), so that a log which tells its own start by much tells the rest by
    less.
    """
    shared = np.column_stack([end.jacobian, end.start_columns.zeros])
    curvatures = []
    gradients = []
    for log, part in enumerate(records.record_slices):
        states = end.start_columns.states[log]
        weights = end.weights[part]
        weighted = shared[part] * weights[:, None]
        curvature = shared[part].T @ weighted
        gradient = weighted.T @ end.residual_coefficients[part]
        if states.shape[1]:
            across = weighted.T @ states
            spread = records.state_spread
            of_states = states.T @ (weights[:, None] * states) + np.diag(1 / spread**2)
            slope = states.T @ (weights * end.residual_coefficients[part]) + end.start.states[log] / spread**2
            following = solve_or_least_squares(of_states, np.column_stack([across.T, slope]))
            curvature = curvature - across @ following[:, :-1]
            gradient = gradient - across @ following[:, -1]
        curvatures.append(curvature)
        gradients.append(gradient)
    return np.array(curvatures), np.array(gradients)
