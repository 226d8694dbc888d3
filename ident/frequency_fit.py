"""A measured frequency response in, a GOBF model with everything needed to judge it out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.plausible_modes import pairs_outside, pole_warnings
from ident.data.arrays import RealArray, lock
from ident.data.finding import TEST_LEVEL, Finding, FindingKind, distinct, finding
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.fit.frf_regression import FrfRegression, fit_response, prepare_response
from ident.fit.refinement import pole_system
from ident.one_input import in_order
from ident.search.order_selection import OrderSelection, OrderStep
from ident.search.pole_search import PoleSearch, SearchTrace
from ident.uncertainty.embedding import embed_response

__all__ = ["FrfIdentification", "identify_frf"]


@dataclass(frozen=True, eq=False)
class FrfIdentification:
    """A model fitted to a measured frequency response (F,), and how well it fits.

    posterior: tangent embedding on the same rows. residual (F,): measured minus fitted; distance (F,): its
    length in units of the measurement's own ellipses. rss: chi-square; degrees_of_freedom: measured real
    numbers minus unknowns. decay_std_per_s (R,), omega_std_rad_s (P,), zeta_std (P,): standard deviations of
    the model's poles, to first order, times sqrt(rss / degrees_of_freedom) where that is above 1; known
    poles (first of each type) have 0.
    """

    model: GobfModel
    posterior: ResponsePosterior
    omega_rad_s: RealArray
    residual: np.ndarray[Any, np.dtype[np.complex128]]
    distance: RealArray
    rss: float
    degrees_of_freedom: int
    decay_std_per_s: RealArray
    omega_std_rad_s: RealArray
    zeta_std: RealArray
    order_table: tuple[OrderStep, ...]
    verdicts: tuple[Finding, ...]
    search: SearchTrace

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s", "distance", "decay_std_per_s", "omega_std_rad_s", "zeta_std")
        lock(self, "residual", dtype=np.complex128)
        if not (self.omega_rad_s.shape == self.residual.shape == self.distance.shape):
            raise ValueError("omega_rad_s, residual and distance must be (F,)")
        if not self.degrees_of_freedom > 0:
            raise ValueError(f"degrees_of_freedom must be positive; got {self.degrees_of_freedom}")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What to look at before trusting the model."""
        return self.search.warnings


def identify_frf(
    response: FrequencyUncertainty,
    options: IdentOptions | None = None,
    embedding: EmbeddingOptions | None = None,
    *,
    shared_gain_std: float = 0.0,
) -> FrfIdentification:
    """Fit a GOBF model to a measured frequency response, each frequency weighted by its covariance.

    response: with a covariance at every frequency, whose errors are independent. options: as for records;
    offset and initial state must be "auto" or False. embedding: fir_length and
    hyperparameters count. shared_gain_std: relative standard deviation of a real factor common to all
    frequencies, which the residual does not show; widens the posterior.

    Raises ValueError for a frequency without covariance, too few frequencies for the given order, or an
    option for an offset, an initial state or a relative degree. A pole is kept if chi-square, divided by its
    excess over what the covariances explain, falls by more than 2 ln Ne, Ne the independent real numbers.
    Deterministic.
    """
    options = options or IdentOptions()
    if options.estimate_offset is True or options.estimate_initial_state is True:
        raise ValueError("a frequency response has no offset and no initial state; leave them at 'auto'")
    if options.relative_degree not in (None, 1):
        raise ValueError(
            f"relative_degree = {options.relative_degree} is not imposed on a response: leave it out"
        )
    data = prepare_response(
        response,
        integrators=options.integrators,
        delay_samples=options.input_delay_samples,
        feedthrough=options.feedthrough,
    )
    fixed = options.fixed()
    searched = (options.n_real or 0) + 2 * (options.n_pairs or 0)
    needed = data.n_parameters(fixed.order + searched, fixed.order)
    if not data.n_samples > needed:
        raise ValueError(
            f"{response.omega_rad_s.size} frequencies are too few for order {fixed.order + searched}, which "
            f"has {needed} unknowns; expected at least {needed // 2 + 1}"
        )
    search = PoleSearch(data, options)
    selection = OrderSelection(search)
    best = selection.run()
    if None not in (options.n_real, options.n_pairs):
        best = selection.exchanged(best)
    poles = in_order(best.poles, fixed)
    fit = fit_response(data, poles)
    freedom = data.n_samples - data.n_parameters(poles.order, fixed.order)
    decay, omega, zeta = _pole_deviations(data, poles, fixed, max(1.0, fit.rss / freedom))
    model = GobfModel(
        poles=poles,
        coefficients=fit.coefficients,
        dt_s=response.dt_s,
        feedthrough=fit.feedthrough,
        integrators=options.integrators,
        input_delay_samples=options.input_delay_samples,
    )
    posterior = embed_response(data, model, fixed, embedding, shared_gain_std=shared_gain_std)
    explained = finding(
        FindingKind.CHI_SQUARE,
        chi_square=fit.rss,
        degrees_of_freedom=freedom,
        expected_low=chi2.ppf(1 - TEST_LEVEL, freedom),
        expected_high=chi2.ppf(TEST_LEVEL, freedom),
    )
    band_rad_s = float(response.omega_rad_s[0]), float(response.omega_rad_s[-1])
    return FrfIdentification(
        model=model,
        posterior=posterior,
        omega_rad_s=response.omega_rad_s,
        residual=response.centre - fit.response,
        distance=response.normalised_distance(fit.response),
        rss=fit.rss,
        degrees_of_freedom=freedom,
        decay_std_per_s=decay,
        omega_std_rad_s=omega,
        zeta_std=zeta,
        order_table=selection.table(best),
        verdicts=(explained,),
        search=SearchTrace(
            tuple(search.stages),
            tuple(search.minima),
            distinct(
                [
                    *pole_warnings(model, fixed, search.bounds),
                    *pairs_outside(poles, fixed, response.dt_s, band_rad_s),
                ]
            ),
            search.evaluations,
        ),
    )


def _pole_deviations(
    data: FrfRegression, poles: Poles, fixed: Poles, scale: float
) -> tuple[RealArray, RealArray, RealArray]:
    """Standard deviations of decay (R,) [1/s], omega (P,) [rad/s] and zeta (P,) from the Kaufman Jacobian."""
    n_real, n_pairs = fixed.counts
    decay = np.zeros(poles.real.size)
    omega, zeta = np.zeros(poles.pairs.size), np.zeros(poles.pairs.size)
    normal, _ = pole_system(data.linearise(*poles.writable()), poles, fixed)
    if normal.size == 0:
        return decay, omega, zeta
    lengths = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(lengths, lengths), rcond=1e-14, hermitian=True)
    covariance = scale * inverse / np.outer(lengths, lengths)
    n_free = poles.real.size - n_real
    real = np.abs(poles.real[n_real:])
    # d decay / d (1 - a) = 1 / (a dt): infinite at a = 0, where decay itself is.
    with np.errstate(divide="ignore"):
        decay[n_real:] = np.sqrt(np.maximum(np.diag(covariance)[:n_free], 0.0)) / real / data.dt_s
    for i in range(n_pairs, poles.pairs.size):
        at = n_free + 2 * (i - n_pairs)
        s, f = -np.log(np.abs(poles.pairs[i])), np.angle(poles.pairs[i])
        size = np.hypot(s, f)
        # omega = |s + jf|, zeta = s / omega.
        slopes = np.array([[s / size, f / size], [f**2 / size**3, -s * f / size**3]])
        spread = np.sqrt(np.maximum(np.diag(slopes @ covariance[at : at + 2, at : at + 2] @ slopes.T), 0.0))
        omega[i], zeta[i] = spread[0] / data.dt_s, spread[1]
    return decay, omega, zeta
