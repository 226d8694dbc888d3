"""Several inputs, one output, one basis: identification with shared poles (MISO).

The paper's remark on multi-link manipulators: at an operating point every motor excites the same modes, so
y = sum_i sum_m c_im L_m(q) u_i + nuisances + v has one set of poles and a row of coefficients per input. A
mode that one motor hardly moves is found through the others, and all data sharpen every pole.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from ident.basis.miso_model import MisoModel
from ident.basis.options import IdentOptions
from ident.checks.input_checks import few_samples, least_independence, refuse_unusable
from ident.checks.plausible_modes import pole_warnings
from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.fit.regression import prepare_inputs
from ident.identification import MisoIdentification
from ident.one_input import description, fitted_on_all, least_order, searched
from ident.search.order_selection import Progress, silent
from ident.search.pole_search import Fitted

# Where a combination of the inputs has less of the power the channels are told apart badly.
_ALIKE_INPUT = 1e-2
# A residual worth less than this share of its samples is not white.
_COLOURED = 0.8

__all__ = ["MisoIdentification", "MisoModel", "identify_miso"]


def identify_miso(
    records: Sequence[Record], options: IdentOptions | None = None, *, progress: Progress | None = None
) -> MisoIdentification:
    """Fit one model with shared poles to all inputs of all records together.

    records : sequence of records of equal inputs, one output and equal sampling time. Each has its own
        nuisance columns (offset, initial state). An input may rest in some records, so experiments that
        excite one motor at a time can be put together; over all records the inputs must be distinguishable.
    options : IdentOptions
        As for `identify`, the same for every input: integrators, delay and direct terms are those of all
        channels. A relative degree is not imposed here, and what is stated as known is not tested.
    progress : callable, optional. Called with a fraction 0..1 and a short message.

    Raises ValueError if a record cannot be used, the inputs of the records differ or are one signal, the data
    are too short for the order asked for, or the options ask for a relative degree.

    Search, descent and choice of the order are those of `identify` on the joint cost; with one input the
    results agree. Deterministic: the same records and options give the same numbers.
    """
    options = options or IdentOptions()
    if options.relative_degree is not None:
        raise ValueError(
            f"relative_degree = {options.relative_degree} is not available with several inputs; leave it out"
        )
    report = progress or silent
    data = prepare_inputs(records, options.structure())
    refuse_unusable(records, data, least_order(options))
    outcome, _ = searched(records, data, options, report)
    fitted, verdicts = fitted_on_all(records, outcome)
    model, found = description(records, outcome, fitted)
    report(1.0, "identified")
    return MisoIdentification(
        model=model, verdicts=verdicts, advise=partial(_advice, fitted, model, found["residuals"]), **found
    )


def _advice(fitted: Fitted, model: MisoModel, residuals: tuple[RealArray, ...]) -> list[Finding]:
    data, search = fitted.data, fitted.search
    found = pole_warnings(model, search.fixed, search.bounds)
    found += few_samples(data, model.order)
    if least_independence(data) < _ALIKE_INPUT:
        found.append(finding(FindingKind.ALIKE_INPUTS, inputs=str(list(model.input_names))))
    worth = data.colour(np.concatenate(residuals)).effective_samples
    if worth < _COLOURED * data.n_samples:
        found.append(finding(FindingKind.COLOURED_RESIDUAL, n_samples=data.n_samples, worth=worth))
    return found
