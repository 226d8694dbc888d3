"""Ellipses around an identified model, and what its residuals and its nominal model say about them.

`uncertainty` embeds the response in a posterior around the identified poles (`tangent`), behind as long a
noise model as the residuals ask for (`with_noise_model`). The result, `Uncertainty`, is that posterior with
advice: what the tests of the residuals say, whether a nominal model with the identified poles lies inside the
ellipses, and whether the data suspect a mode that is missing. Assumed: what `tangent` assumes, noise that an
autoregression describes and a linear arm.

A `ResponsePosterior` gives the ellipses of a response at frequencies (`at`: centre (F,), covariances (F, 2,
2)) and a `report` (samples, noise model, probability of a missing mode); a `ResidualTest` has `passed` and
`probability`; `Identification` has the model, residuals and warnings of a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
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
from ident.data.keywords import clear_constructor
from ident.data.record import Record
from ident.identification import Identification
from ident.uncertainty.embedding import tangent
from ident.uncertainty.nominal import NominalAgreement, nominal_near

# Largest orders of the noise model that are tried, one after the other, until the residuals behind it are
# white. The criterion takes 1 to 6 of the first for drift and friction beside sensor noise; the second, four
# times as long, is for noise that is not white behind that. Chosen: every order takes one more embedding.
NOISE_ORDERS = (8, 32)
# Factor by which the data have to raise the odds of a missing mode before it is suspected: a Bayes factor of
# "positive" evidence (Kass and Raftery, JASA 90(430), 1995), the least that is called any.
POSITIVE_EVIDENCE = 3.0
# Level of the ellipses whose size at the modes is told, and of those that a nominal model is held against:
# the usual one.
SHOWN_LEVEL = 0.95
# Lowest frequency at which ellipses are shown, as a share of the Nyquist frequency: three decades. Chosen:
# below, most logs end.
LOWEST_SHOWN_SHARE = 1e-3
PosteriorT = TypeVar("PosteriorT")
OptionsT = TypeVar("OptionsT", bound=EmbeddingOptions)
# Tests of whiteness, and of what is left of the input in the residuals.
Tests = tuple[ResidualTest, ResidualTest]


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(ResponsePosterior):
    """Posterior of a response, with ellipses at any frequency (`at`) and what to think of them.

    Attributes
    ----------
    poles, mean, covariance_factor : Poles, ndarray (n,), ndarray (n, m)
        Basis of the posterior, mean of its n coefficients and a factor of their covariance.
    dt_s, integrators, input_delay_samples, has_feedthrough, fir_length, unstable
        Sampling time, s, and the structure around the basis.
    input_name, output_name : str
        Columns of the record.
    report : object
        What the estimate rests on: samples, noise model, probability of a missing mode.
    nominal_poles : Poles
        Of the identified model.
    prior_missed_mode : float
        Probability of a mode that the model lacks, as it was stated.
    advice : tuple of Finding
        What the residuals say about the ellipses.

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
        """What to look at before trusting the ellipses: residuals, and a nominal outside most of them.

        Raises ValueError where the nominal model has more coefficients than the grid tells (`nominal_near`).
        """
        nominal_doubt = self.agreement(self.nominal().frequency_response).doubt
        return distinct((*self.advice, *nominal_doubt))

    def agreement(
        self, response: Callable[[RealArray], ComplexArray], level: float = 0.95
    ) -> NominalAgreement:
        """How far a response lies from the centres, in ellipses of a level.

        Parameters
        ----------
        response : callable
            Frequencies (F,) in rad/s to G (F,).
        level : float
            Probability of the ellipses; 0.95 is the usual one.

        Returns
        -------
        NominalAgreement
            On `shown_grid`; its `doubt` is empty where the response lies inside most ellipses.

        Raises
        ------
        ValueError
            The level is not between 0 and 1, or the response has another shape or is not finite
            (`FrequencyUncertainty`).
        """
        return NominalAgreement.of(self.at(self.shown_grid, level), response)

    def conditions(self, response: Callable[[RealArray], ComplexArray], level: float) -> list[Finding]:
        """What a certificate for a nominal response over the ellipses of a level stands or falls with.

        `response` : frequencies (F,) in rad/s to G (F,). Doubts about the ellipses, then about the nominal.
        Raises ValueError as `agreement`.
        """
        return [*conditions_of(self.advice), *self.agreement(response, level).doubt]

    @property
    def shown_grid(self) -> RealArray:
        """Frequencies (F,), rad/s, evenly in logarithm, over three decades up to the Nyquist frequency.

        F is `FREQUENCIES`, 400, the size of such grids everywhere: 1.7 % apart here.
        """
        nyquist = np.pi / self.dt_s
        return np.geomspace(LOWEST_SHOWN_SHARE * nyquist, nyquist, FREQUENCIES)

    @property
    def missed_mode_suspected(self) -> bool:
        """Whether the data raise the odds that a mode is missing, by `POSITIVE_EVIDENCE` or more.

        False where no such mode was thought possible.
        """
        before = self.prior_missed_mode
        after = getattr(self.report, "probability_missed_mode", 0.0)
        # Odds p / (1 - p) after against before, multiplied out: a probability of one would divide by zero.
        in_favour = after * (1 - before)
        needed = POSITIVE_EVIDENCE * (1 - after) * before
        return in_favour >= needed > 0

    def nominal(self) -> GobfModel:
        """Model on the identified poles that is nearest to the centre, in units of the ellipses.

        Raises ValueError where `shown_grid` has too few frequencies for so many coefficients
        (`nominal_near`).
        """
        return nominal_near(self, self.nominal_poles, self.shown_grid)

    def at_modes(self) -> list[tuple[float, float]]:
        """Frequency, rad/s, of every mode, and the major semi-axis of its 95 % ellipse over the gain there.

        Modes below the Nyquist frequency, from low to high; empty without modes. The gain is not zero there:
        `uncertainty` has refused a response that may be.
        """
        omega = np.unique(self.nominal_poles.omega_rad_s(self.dt_s))
        if not omega.size:
            return []
        is_seen = omega < np.pi / self.dt_s
        at_modes = self.at(omega[is_seen])
        relative_size = at_modes.ellipse(SHOWN_LEVEL).semi_major / np.abs(at_modes.centre)
        return list(zip(at_modes.omega_rad_s.tolist(), relative_size.tolist(), strict=True))

    @property
    def own_uncertainty(self) -> Uncertainty:
        """These ellipses themselves, which a plant made of them takes over."""
        return self

    def to_control(self) -> object:
        """`nominal` as `control.StateSpace`, without the ellipses; ImportError without python-control."""
        return self.nominal().to_control()


def with_noise_model(
    options: OptionsT, white: bool, found_with: Callable[[OptionsT], tuple[PosteriorT, Tests]]
) -> tuple[tuple[PosteriorT, Tests], OptionsT]:
    """Posterior behind as long a noise model as the residuals ask for.

    Parameters
    ----------
    options : EmbeddingOptions
        A noise model that is stated (`coloured_noise` True or False) is used as it is.
    white : bool
        The residuals of the identification are white: no noise model is needed.
    found_with : callable
        Settings to a posterior and the tests of its residuals: of whiteness first, then of independence. What
        it raises goes up.

    Returns
    -------
    tuple
        The posterior and the tests; of several orders those with the whitest residuals, the first of equals.
    EmbeddingOptions
        Settings with the noise model that was used.

    Notes
    -----
    White-noise bounds around coloured residuals are far too narrow, so the data decide unless it is stated.
    """
    if options.coloured_noise != "auto":
        return found_with(options), options
    if white:
        plain_options = options.model_copy(update={"coloured_noise": False})
        return found_with(plain_options), plain_options
    best = None
    best_options = options
    best_probability = -np.inf
    for order in NOISE_ORDERS:
        order_options = options.model_copy(update={"coloured_noise": True, "max_ar_order": order})
        result = found_with(order_options)
        whiteness, _ = result[1]
        # A longer noise model has to make the residuals whiter: inside a band it can also turn upon itself.
        if best is None or whiteness.probability > best_probability:
            best = result
            best_options = order_options
            best_probability = whiteness.probability
        if whiteness.passed:
            break
    assert best is not None
    return best, best_options


def uncertainty(
    records: Sequence[Record], identification: Identification, options: EmbeddingOptions
) -> Uncertainty:
    """Posterior of the response around an identified model, with what its residuals say.

    Parameters
    ----------
    records : sequence of Record
        Those of the identification.
    identification : Identification
        Its model (poles, integrators, delay), its residuals, and warnings that make no answer likelier.
    options : EmbeddingOptions
        Kernel, taps, noise model and the probability of a missing mode.

    Returns
    -------
    Uncertainty
        Without advice where the records are too short for the tests of residuals.

    Raises
    ------
    ValueError
        Records are too short, of another sampling time, or do not excite the poles (`tangent`); or the output
        does not answer to the input: a response of zero lies inside all ellipses.
    """

    def posterior_with(step_options: EmbeddingOptions) -> tuple[ResponsePosterior, Tests]:
        """Posterior behind this noise model, and the tests of its residuals.

        Raises ValueError where the records are too short for either.
        """
        posterior = tangent(records, identification.model, step_options)
        return posterior, residual_tests(posterior, records)

    try:
        white = whiteness_test(identification.residuals).passed
        (posterior, tests), _ = with_noise_model(options, white, posterior_with)
        noise_order = 0 if posterior.report is None else len(posterior.report.ar_coefficients)
        advice = residual_advice(*tests, noise_order=noise_order)
    except ValueError:
        # Records are too short for a test, or there is nothing left to test: a noise model only if it is
        # stated.
        coloured = options.coloured_noise is True
        untested_options = options.model_copy(update={"coloured_noise": coloured})
        posterior = tangent(records, identification.model, untested_options)
        advice = []
    spread = Uncertainty(
        **{field.name: getattr(posterior, field.name) for field in fields(posterior)},
        nominal_poles=identification.model.poles,
        prior_missed_mode=options.prior_missed_mode,
        advice=tuple(advice),
    )
    refuse_unanswered(spread, spread.shown_grid, identification.warnings)
    return spread
