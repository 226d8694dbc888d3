"""Does the output answer to the input at all?

By the fit: what the driven columns explain against the price that the choice of the order asks of any pole,
beside nuisances that need no input. By the ellipses: a response of zero inside all of them, which also sees
an output that wanders by itself (drift, hum).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from ident.basis.poles import NO_POLES, Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.fit.least_squares import Regression, project

# A response of zero is kept up to this level.
_LEVEL = 0.999


def explains_nothing(data: Regression, poles: Poles, fixed: Poles, residual: RealArray) -> list[Finding]:
    """One finding where the driven columns explain no more than poles fitted to noise would.

    residual (N,): of the fit with these poles, of which `fixed` were given. Nuisances (offset, free
    responses) are on both sides: a free decay or a hum is no answer to the input.
    """
    undriven = replace(data, structure=replace(data.structure, feedthrough=False, relative_degree=1))
    without = project(undriven, NO_POLES, poles).residual
    power, rest = float(without @ without), float(residual @ residual)
    worth = data.colour(residual).effective_samples
    numbers = data.n_inputs * (poles.order + data.structure.feedthrough) + poles.order - fixed.order
    if not power > 0 or rest <= power * np.exp(-numbers * np.log(worth) / worth):
        return []
    return [finding(FindingKind.NO_ANSWER, explained_percent=100 * max(1 - np.sqrt(rest / power), 0.0))]


def refuse_unanswered(
    posterior: ResponsePosterior, omega_rad_s: RealArray, warnings: Iterable[Finding], *, why: str = ""
) -> None:
    """Raises ValueError, one line, where a response of zero lies inside all ellipses at omega (F,): no number
    of such a model means anything. warnings: of the fit; why: what else is known."""
    doubts = {FindingKind.NO_POLE, FindingKind.NO_ANSWER} & {warning.kind for warning in warnings}
    # At 99.9 %; where the fit is doubted, over the N / 2 frequencies at which noise may have put a pole.
    ellipses = posterior.at(omega_rad_s)
    squared = ellipses.normalised_distance(np.zeros(ellipses.centre.size)) ** 2 * chi2.ppf(ellipses.level, 2)
    n_rows = 2 if posterior.report is None else max(posterior.report.n_rows, 2)
    if np.all(squared <= chi2.isf((1 - _LEVEL) / (n_rows / 2 if doubts else 1.0), 2)):
        unknown = "no response at all explains the log as well as any model; check columns, wiring and unit"
        names = f"the output '{posterior.output_name}' does not answer to the input '{posterior.input_name}'"
        raise ValueError(f"{names}: {why or unknown}")
