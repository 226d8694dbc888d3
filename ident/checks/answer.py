"""Does the output answer to the input at all?

`explains_nothing` asks the fit: what the driven columns explain is held against the price that the choice of
the order asks of any pole, beside nuisances that need no input. `refuse_unanswered` asks the ellipses: where
a response of zero lies inside all of them, no number of the model means anything. That also sees an output
that wanders by itself (drift, hum), which a fit takes for slow poles.

`Regression`, of another file, holds records made ready for a fit; N samples of all records.
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

# Level of the ellipses within which a response of zero counts as possible. An output that does not answer
# passes where chance puts zero outside: once in a thousand at each independent frequency. Chosen.
ZERO_LEVEL = 0.999


def explains_nothing(data: Regression, poles: Poles, fixed: Poles, residual: RealArray) -> list[Finding]:
    """Finding NO_ANSWER where the driven columns explain no more than poles fitted to noise; else empty.

    Parameters
    ----------
    data : Regression
        Records made ready for a fit: inputs u (U, N), output, nuisance columns.
    poles, fixed : Poles
        Poles of the fit, and those of them that were stated as known.
    residual : (N,) array
        What the fit leaves of the output.

    Returns
    -------
    list of Finding
        With the share of the motion (RMS) that is explained, per cent. Empty also for an output that stands
        still. A residual of another length is not refused.

    Notes
    -----
    The criterion of the order (`ident.fit.least_squares.information_criterion`) asks ln Ne of each free
    number: J has to be below J0 exp(-k ln Ne / Ne), J0 that without the input, k the coefficients, direct
    terms and searched poles, Ne the independent samples that the residual is worth. Nuisances (offset, free
    responses) are on both sides: a free decay or a hum is no answer to the input.
    """
    structure = replace(data.structure, feedthrough=False, relative_degree=1)
    undriven = project(replace(data, structure=structure), NO_POLES, poles).residual
    power_undriven = float(undriven @ undriven)
    power = float(residual @ residual)
    worth = data.colour(residual).effective_samples
    n_coefficients = data.n_inputs * (poles.order + data.structure.feedthrough)
    n_numbers = n_coefficients + poles.order - fixed.order
    if not power_undriven > 0 or power <= power_undriven * np.exp(-n_numbers * np.log(worth) / worth):
        return []
    explained = 1 - np.sqrt(power / power_undriven)
    return [finding(FindingKind.NO_ANSWER, explained_percent=100 * max(explained, 0.0))]


def refuse_unanswered(
    posterior: ResponsePosterior, omega_rad_s: RealArray, warnings: Iterable[Finding], *, why: str = ""
) -> None:
    """Nothing, where the ellipses say that the output answers; else raises an error of one line.

    Parameters
    ----------
    posterior : ResponsePosterior
        Mean and ellipses of a response; `report.n_rows`: samples behind them.
    omega_rad_s : (F,) array
        Frequencies at which the ellipses are asked.
    warnings : iterable of Finding
        Of the fit: NO_POLE or NO_ANSWER among them make zero likelier.
    why : str
        What else is known, for the error.

    Raises
    ------
    ValueError
        A response of zero lies inside the ellipses at all frequencies, at 99.9 %; below
        (`ResponsePosterior.at`): frequencies that do not increase, or lie above Nyquist.

    Notes
    -----
    Where the fit is doubted, the level is that over all N / 2 frequencies at which noise may have put a pole
    (Bonferroni).
    """
    doubts = {FindingKind.NO_POLE, FindingKind.NO_ANSWER} & {warning.kind for warning in warnings}
    # Squared distance of zero from the centre, chi-square with two degrees of freedom (real, imaginary part).
    ellipses = posterior.at(omega_rad_s)
    distance = ellipses.normalised_distance(np.zeros(ellipses.centre.size))
    squared = distance**2 * chi2.ppf(ellipses.level, 2)
    n_frequencies = 1.0
    if doubts:
        # Two rows, one frequency, where nobody said how many there are.
        n_rows = 2 if posterior.report is None else max(posterior.report.n_rows, 2)
        n_frequencies = n_rows / 2
    limit = chi2.isf((1 - ZERO_LEVEL) / n_frequencies, 2)
    if np.all(squared <= limit):
        unknown = "no response at all explains the log as well as any model; check columns, wiring and unit"
        names = f"the output '{posterior.output_name}' does not answer to the input '{posterior.input_name}'"
        raise ValueError(f"{names}: {why or unknown}")
