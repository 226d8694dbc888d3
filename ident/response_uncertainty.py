"""Ellipses around an identified model, and what its residuals and its nominal model say about them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from operator import itemgetter
from typing import TypeVar

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions
from ident.basis.poles import NO_POLES, Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.answer import refuse_unanswered
from ident.checks.residual_tests import (
    ResidualTest,
    conditions_of,
    residual_advice,
    residual_tests,
    whiteness_test,
)
from ident.data.arrays import ComplexArray, RealArray
from ident.data.finding import Finding, distinct
from ident.data.frequency_uncertainty import FREQUENCIES
from ident.data.record import Record
from ident.identification import Identification
from ident.uncertainty.embedding import tangent
from ident.uncertainty.nominal import NominalAgreement, nominal_near

# Largest orders of the noise model that are tried, until the residuals behind it are white.
NOISE_ORDERS = (8, 32)
# Factor on the odds: Bayes factor of "positive" evidence (Kass and Raftery, 1995).
_POSITIVE = 3.0
T = TypeVar("T")
OptionsT = TypeVar("OptionsT", bound=EmbeddingOptions)
Tests = tuple[ResidualTest, ResidualTest]


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(ResponsePosterior):
    """Response with ellipses at any frequency (`at`).

    nominal_poles: of the identified model; prior_missed_mode: as it was stated; advice: what the residuals
    say about the ellipses.

    Examples
    --------
    >>> spread = flexlink.uncertainty(flexlink.identify(example_record(), n_pairs=1, n_real=0))
    >>> spread.at([5.0, 20.0]).ellipse(0.95).semi_major.shape
    (2,)
    """

    nominal_poles: Poles = NO_POLES
    prior_missed_mode: float = 0.0
    advice: tuple[Finding, ...] = ()

    @cached_property
    def warnings(self) -> tuple[Finding, ...]:
        """What to look at before trusting the ellipses: residuals, and a nominal outside most of them."""
        return distinct((*self.advice, *self.agreement(self.nominal().frequency_response).doubt))

    def agreement(
        self, response: Callable[[RealArray], ComplexArray], level: float = 0.95
    ) -> NominalAgreement:
        """How far a response, rad/s (F,) to G (F,), is from the centres, in ellipses of a level."""
        return NominalAgreement.of(self.at(self.shown_grid, level), response)

    def conditions(self, response: Callable[[RealArray], ComplexArray], level: float) -> list[Finding]:
        """What a certificate for this nominal response over the ellipses stands or falls with."""
        return [*conditions_of(self.advice), *self.agreement(response, level).doubt]

    @property
    def shown_grid(self) -> RealArray:
        """Frequencies (F,) over three decades up to the Nyquist frequency."""
        nyquist = np.pi / self.dt_s
        return np.geomspace(1e-3 * nyquist, nyquist, FREQUENCIES)

    @property
    def missed_mode_suspected(self) -> bool:
        """The data themselves raise the odds that a mode is missing."""
        now, before = getattr(self.report, "probability_missed_mode", 0.0), self.prior_missed_mode
        return now * (1 - before) >= _POSITIVE * (1 - now) * before > 0

    def nominal(self) -> GobfModel:
        """Model on the identified poles, nearest to the centre in units of the ellipses."""
        return nominal_near(self, self.nominal_poles, self.shown_grid)

    def at_modes(self) -> list[tuple[float, float]]:
        """(frequency [rad/s], major semi-axis of the 95 % ellipse over gain) at every mode."""
        omega = np.unique(self.nominal_poles.omega_rad_s(self.dt_s))
        here = self.at(omega[omega < np.pi / self.dt_s]) if omega.size else None
        if here is None:
            return []
        share = here.ellipse(0.95).semi_major / np.abs(here.centre)
        return list(zip(here.omega_rad_s.tolist(), share.tolist(), strict=True))

    def to_control(self) -> object:
        """`nominal` as `control.StateSpace`, without the ellipses."""
        return self.nominal().to_control()


def with_noise_model(
    options: OptionsT, white: bool, found_with: Callable[[OptionsT], tuple[T, Tests]]
) -> tuple[tuple[T, Tests], OptionsT]:
    """What is found with as much of a noise model as the residuals ask for, and the settings with it.

    White-noise bounds around coloured residuals are far too narrow, so the data decide unless it is stated.
    """
    if options.coloured_noise != "auto":
        return found_with(options), options
    if white:
        plain = options.model_copy(update={"coloured_noise": False})
        return found_with(plain), plain
    tried = []
    for order in NOISE_ORDERS:
        asked = options.model_copy(update={"coloured_noise": True, "max_ar_order": order})
        found = found_with(asked)
        whiteness, _ = found[1]
        tried.append((whiteness.probability, found, asked))
        if whiteness.passed:
            break
    # A longer noise model has to make the residuals whiter: inside a band it can also turn upon itself.
    _, best, asked = max(tried, key=itemgetter(0))
    return best, asked


def uncertainty(
    records: Sequence[Record], identification: Identification, options: EmbeddingOptions
) -> Uncertainty:
    """Posterior of the response around an identified model, as `tangent`, with what its residuals say.

    records: those of the identification. Raises ValueError as `tangent`, and where the output does not answer
    to the input.
    """

    def behind(asked: EmbeddingOptions) -> tuple[ResponsePosterior, Tests]:
        found = tangent(records, identification.model, asked)
        return found, residual_tests(found, records)

    try:
        white = whiteness_test(identification.residuals).passed
        (found, tests), _ = with_noise_model(options, white, behind)
        order = 0 if found.report is None else len(found.report.ar_coefficients)
        advice = residual_advice(*tests, noise_order=order)
    except ValueError:  # records too short for a test, or nothing left to test
        coloured = options.coloured_noise is True
        found = tangent(
            records, identification.model, options.model_copy(update={"coloured_noise": coloured})
        )
        advice = []
    spread = Uncertainty(
        **{each.name: getattr(found, each.name) for each in fields(found)},
        nominal_poles=identification.model.poles,
        prior_missed_mode=options.prior_missed_mode,
        advice=tuple(advice),
    )
    refuse_unanswered(spread, spread.shown_grid, identification.warnings)
    return spread
