"""Ellipses around the response behind the friction.

What the friction takes off the input is not known exactly: its level is estimated, and it depends on the
motion of an arm that is estimated too. Both are columns beside the basis functions in the regression of
`ident.uncertainty.embedding`, so that the ellipses hold them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.posterior import ResponsePosterior
from ident.data.record import Record
from ident.friction.arm import less_friction
from ident.friction.fit import FrictionFit, linearised, moved_to
from ident.uncertainty.embedding import EmbeddingOptions, tangent
from ident.uncertainty.embedding_rows import Beside


def without_friction(
    records: Sequence[Record],
    found: FrictionFit,
    model: GobfModel | None = None,
    options: EmbeddingOptions | None = None,
) -> ResponsePosterior:
    """Posterior of the response from input to the shaft's position, as if there were no dry friction.

    records: those of the fit, as measured. model: of the arm, fitted with the friction taken off, that the
    posterior is to be made around; none: that of the fit. The level of the friction is estimated anew with
    the response, so that what either does not know widens the other. Raises ValueError as `tangent`.
    """
    if model is not None:
        found = moved_to(found, records, model)
    moved, beside = [], []
    for record in records:
        local = linearised(found.arm, found.coefficients, found.level, found.presliding, record.input[:, 0])
        # To first order y = y0 + D (c - c0) + d (level - level0): rows for the coefficients c themselves.
        target = record.output[:, 0] - local.position + local.by_coefficients @ found.coefficients
        less = less_friction(record, local.friction, found.arm.structure.input_delay_samples)
        moved.append(replace(less, output=target[:, None]))
        beside.append(Beside(local.by_coefficients, local.by_level[:, None]))
    return tangent(moved, found.model, options, beside=beside)


def other_output_without_friction(
    records: Sequence[Record],
    found: FrictionFit,
    model: GobfModel,
    options: EmbeddingOptions | None = None,
) -> ResponsePosterior:
    """The same for another output of the arm, which the same friction reaches through the motor's shaft.

    records: with that output; model: fitted to them with the friction taken off. The friction is that of the
    fit to the shaft's position; what is not known about it is what that fit does not know.
    """
    undelayed = GobfModel(model.poles, model.coefficients, model.dt_s, integrators=model.integrators)
    less, beside = [], []
    for record in records:
        local = linearised(found.arm, found.coefficients, found.level, found.presliding, record.input[:, 0])
        less.append(less_friction(record, local.friction, found.arm.structure.input_delay_samples))
        columns = -local.friction_by @ found.covariance_factor
        driven = np.column_stack([undelayed.simulate(column) for column in columns.T])
        beside.append(Beside(np.zeros((record.n_samples, 0)), driven))
    return tangent(less, model, options, beside=beside, known_to_one=True)
