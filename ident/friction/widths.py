"""How well the friction and the arm of logs of a loop are known: equations to first order, and their widths.

Behind an observer the friction follows from the measured motion, so that whitened equations are linear in the
arm and to first order in the law (`observed_equations`). They say what noise leaves open; `heterogeneity`
tells by how much more the parts of the logs differ, and `with_widths` takes both into a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ident.basis.functions import nuisance_columns, regressor
from ident.basis.structure import answered, driving_input, stabilised
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.friction.gauss_newton import (
    FrictionFit,
    LostError,
    driven_by_law,
    least_squares,
    with_covariance,
)
from ident.friction.inverse_dynamics import speed_classes
from ident.friction.logs import LoopLogs
from ident.friction.observer import ObserverFilter
from ident.uncertainty.embedding_algebra import RANK, by_class, sandwiched


def with_widths(fit: FrictionFit, logs: LoopLogs, *, every: int = 1) -> FrictionFit:
    """A fit with its covariance: wider by what parts of the logs differ in, then by what speeds differ in.

    Parameters
    ----------
    fit : FrictionFit
        At its optimum, with an observer, its arm with each pole twice.
    logs : LoopLogs
        Whole.
    every : int
        One row in so many counts: what the fit leaves in those between is not independent of it
        (`LoopLogs.rows_of_a_reading`).

    Returns
    -------
    FrictionFit
        Raises LostError where something is not finite.
    """
    whiten = ObserverFilter.of(fit)
    blocks, targets = observed_equations(fit, logs.records, whiten, every=every)
    n_rows = sum(target.size for target in targets)
    noise = float(np.sqrt(sum(target @ target for target in targets) / n_rows))
    fit = with_covariance(fit, blocks, targets, noise)
    wider_factor = np.sqrt(heterogeneity(fit, logs.records, whiten, every=every)) * fit.covariance_factor

    solution = least_squares(blocks, targets, np.zeros((0, blocks[0].shape[1] + 1)))
    record_scores = []
    for record, block, target in zip(logs.records, blocks, targets, strict=True):
        residual = target - block @ solution.change
        classes = speed_classes(record)[::-1][::every][::-1]
        record_scores.append(by_class(residual, classes).T @ block)
    scores = sum(record_scores) @ fit.covariance_factor * n_rows / solution.residual_rss
    return replace(fit, covariance_factor=sandwiched(wider_factor, scores))


def observed_equations(
    fit: FrictionFit,
    records: Sequence[Record],
    whiten: Callable[[RealArray], RealArray],
    *,
    every: int = 1,
) -> tuple[list[RealArray], list[RealArray]]:
    """Whitened equations of a Gauss-Newton step behind an observer, record by record.

    Derivatives (M, P + Q') of y - G (u - f - bias) with respect to the coefficients of the doubled poles and
    to the columns of `driven_by_law`, and what the fit leaves (M,), output units behind the filter. What the
    start of the record may be (free responses, an offset) is taken off both. `whiten` filters rows (T, ...)
    and drops those in which it settles; of the others one in `every` counts, the last one among them. Raises
    LostError where something is not finite.
    """
    structure = fit.arm.structure
    delay = structure.input_delay_samples
    blocks = []
    targets = []
    for record in records:
        forced = fit.forced(record)
        driven = driving_input(forced.input[:, 0], structure.integrators, delay)
        basis = regressor(fit.arm.poles.doubled(), driven)
        position = answered(stabilised(record.output[:, 0], structure.unstable), delay)
        by_law = answered(driven_by_law(fit, record), delay)
        rows = whiten(np.column_stack([basis, by_law, position - basis @ fit.coefficients]))

        # Orthonormal columns of what the start may be; those below rounding say what the others say.
        n_powers = max(1, structure.integrators)
        nuisance = whiten(nuisance_columns(fit.model.poles, driven.size, n_powers, True))
        with np.errstate(over="ignore"):  # of an observer that does not follow
            length = np.linalg.norm(nuisance, axis=0)
        if not np.all(np.isfinite(length)):
            raise LostError
        is_used = length > 0
        u, sizes, _ = np.linalg.svd(nuisance[:, is_used] / length[is_used], full_matrices=False)
        counts = sizes > RANK * sizes.max(initial=0.0)
        u = u[:, counts]
        rows = rows - u @ (u.T @ rows)
        if not np.all(np.isfinite(rows)):
            raise LostError
        rows = rows[::-1][::every][::-1]
        blocks.append(rows[:, :-1])
        targets.append(rows[:, -1])
    return blocks, targets


def heterogeneity(
    found: FrictionFit,
    records: Sequence[Record],
    whiten: Callable[[RealArray], RealArray],
    *,
    every: int = 1,
) -> float:
    """How much more the parts of the records differ in arm and friction than their noise makes them.

    Parameters
    ----------
    found : FrictionFit
        With an observer.
    records : sequence of Record
        Each is parted in two halves.
    whiten : callable
        Filter of rows (T, ...) that makes the residuals white.
    every : int
        One row in so many counts, as of `with_widths`.

    Returns
    -------
    float
        Chow's F (Econometrica 28(3), 1960), not below 1: a factor of variances.
    """
    halves = []
    for record in records:
        middle = record.n_samples // 2
        halves.append(record.slice(0, middle))
        halves.append(record.slice(middle, record.n_samples))
    blocks, targets = observed_equations(found, halves, whiten, every=every)
    nothing_known = np.zeros((0, blocks[0].shape[1] + 1))
    together = least_squares(blocks, targets, nothing_known)
    singles = []
    for block, target in zip(blocks, targets, strict=True):
        singles.append(least_squares([block], [target], nothing_known))

    rank_together = _rank(together.triangle)
    rank_of_singles = sum(_rank(single.triangle) for single in singles)
    rss_of_singles = sum(single.residual_rss for single in singles)
    n_rows = sum(target.size for target in targets)
    numerator_freedom = max(rank_of_singles - rank_together, 1)
    denominator_freedom = n_rows - rank_of_singles
    difference = (together.residual_rss - rss_of_singles) / numerator_freedom
    return max(1.0, float(difference / (rss_of_singles / denominator_freedom)))


def _rank(triangle: RealArray) -> int:
    """Number of directions of a triangle (P, P) above rounding, its columns at unit length."""
    length = np.linalg.norm(triangle, axis=0)
    return int(np.linalg.matrix_rank(triangle / np.where(length > 0, length, 1.0), tol=RANK))
