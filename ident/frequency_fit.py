"""A measured frequency response in, a GOBF model with everything needed to judge it out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.plausible_modes import pairs_outside, pole_warnings, poles_without_data
from ident.data.arrays import RealArray, lock
from ident.data.finding import TEST_LEVEL, Finding, FindingKind, distinct, finding
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.shown import Shown
from ident.fit.frf_regression import FrfRegression, fit_response, prepare_response
from ident.fit.refinement import Bounds, Refined, pole_system
from ident.one_input import in_order
from ident.search.order_selection import OrderSelection, OrderStep
from ident.search.pole_search import PoleSearch, SearchTrace
from ident.uncertainty.embedding import embed_response

__all__ = ["FrfIdentification", "identify_frf"]


@dataclass(frozen=True, eq=False, repr=False)
class FrfIdentification(Shown):
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
    response: FrequencyUncertainty

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

    @property
    def share_inside(self) -> float:
        """Share of the measured points whose ellipses, of the measurement's own level, hold the model."""
        return float(np.mean(self.distance <= 1.0))

    def to_control(self) -> Any:
        """The model as `control.StateSpace`."""
        return self.model.to_control()

    def save(self, path: str | Path) -> None:
        """Write the model as `GobfModel.save`."""
        self.model.save(path)


def identify_frf(
    response: FrequencyUncertainty,
    options: IdentOptions | None = None,
    embedding: EmbeddingOptions | None = None,
    *,
    shared_gain_std: float = 0.0,
) -> FrfIdentification:
    """A GOBF model fitted to a measured frequency response, each frequency weighted by its covariance.

    Parameters
    ----------
    response : FrequencyUncertainty
        (F,) frequencies in rad/s with a covariance at each; their errors are independent.
    options : IdentOptions, optional
        As for records. Offset and initial state must be "auto" or False.
    embedding : EmbeddingOptions, optional
        `fir_length` and `hyperparameters` count.
    shared_gain_std : float
        Relative standard deviation of a real factor common to all frequencies, which the residual does not
        show; widens the posterior.

    Returns
    -------
    FrfIdentification
        Model, posterior and what the data say of them. Deterministic.

    Raises
    ------
    ValueError
        For a frequency without covariance, too few frequencies for the given order, or an option for an
        offset, an initial state or a relative degree.

    Notes
    -----
    A pole is kept if chi-square, divided by its excess over what the covariances explain, falls by more than
    2 ln Ne, Ne the independent real numbers. A pole with no measured frequency within its half-power width
    (above the last frequency, below the first, between two wide points) is kept there only if fits without
    such poles are worse by more than chance. These may have a direct term unless `feedthrough` is stated: a
    response measured without the hold lacks half a sample of delay, which poles near pi/dt imitate.
    """
    options = options or IdentOptions()
    if options.estimate_offset is True or options.estimate_initial_state is True:
        raise ValueError("a frequency response has no offset and no initial state; leave them at 'auto'")
    if options.relative_degree not in (None, 1):
        raise ValueError(
            f"relative_degree = {options.relative_degree} is not imposed on a response: leave it out"
        )

    # Is there enough for the order that was given?
    data = _prepared(response, options)
    fixed = options.fixed()
    searched = (options.n_real or 0) + 2 * (options.n_pairs or 0)
    needed = data.n_parameters(fixed.order + searched, fixed.order)
    if not data.n_samples > needed:
        raise ValueError(
            f"{response.omega_rad_s.size} frequencies are too few for order {fixed.order + searched}, which "
            f"has {needed} unknowns; expected at least {needed // 2 + 1}"
        )

    # Poles wherever they fit best; then only where the data show them, if that costs no more than chance.
    best_fit = _OrderFit.of(data, options)
    angles_rad = response.omega_rad_s * response.dt_s
    points = np.column_stack([angles_rad, angles_rad])
    to_last = np.array([[0.0, angles_rad[-1]]])
    points_and_below = np.vstack([[0.0, angles_rad[0]], points])
    # What lies above the last frequency first: the misfit that other poles follow may be gone with it.
    direct_term_helps = "feedthrough" not in options.model_fields_set
    best_fit = _limited_to_data(best_fit, response, options, to_last, also_direct_term=direct_term_helps)
    best_fit = _limited_to_data(best_fit, response, options, points_and_below)
    best_fit = _limited_to_data(best_fit, response, options, points)

    data = best_fit.data
    search = best_fit.search
    poles = in_order(best_fit.end.poles, fixed)
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

    # What the data say of the fit, and what the model assumes where there are none.
    band_rad_s = float(response.omega_rad_s[0]), float(response.omega_rad_s[-1])
    verdicts = [
        finding(
            FindingKind.CHI_SQUARE,
            chi_square=fit.rss,
            degrees_of_freedom=freedom,
            expected_low=chi2.ppf(1 - TEST_LEVEL, freedom),
            expected_high=chi2.ppf(TEST_LEVEL, freedom),
        ),
        _assumed_outside(model, band_rad_s),
    ]
    if data.feedthrough and not options.feedthrough:
        verdicts.append(finding(FindingKind.RESPONSE_AT_ONCE, direct_term=fit.feedthrough))
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
        order_table=best_fit.selection.table(best_fit.end),
        verdicts=tuple(verdicts),
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
        response=response,
    )


def _prepared(response: FrequencyUncertainty, options: IdentOptions) -> FrfRegression:
    """The whitened response with the known factors of the options."""
    return prepare_response(
        response,
        integrators=options.integrators,
        delay_samples=options.input_delay_samples,
        feedthrough=options.feedthrough,
    )


@dataclass(frozen=True, eq=False)
class _OrderFit:
    """One order selection that has ended: its problem, its search, and the poles it chose."""

    data: FrfRegression
    search: PoleSearch[FrfRegression]
    selection: OrderSelection
    end: Refined

    @classmethod
    def of(
        cls,
        data: FrfRegression,
        options: IdentOptions,
        measured_rad: RealArray | None = None,
        start: Poles | None = None,
    ) -> _OrderFit:
        """Order and poles from the data.

        measured_rad: (K, 2) bands that limit the poles (`Bounds.shown_by`). start: poles to go on from; None:
        a global search.
        """
        bounds = None
        if measured_rad is not None:
            bounds = Bounds.from_options(options, data.longest, data.dt_s).shown_by(measured_rad)
        search = PoleSearch(data, options, bounds)
        selection = OrderSelection(search)
        end = selection.run(None if start is None else search.descend(start, "poles shown by the data"))
        if None not in (options.n_real, options.n_pairs):
            end = selection.exchanged(end)
        return cls(data, search, selection, end)


def _limited_to_data(
    fit: _OrderFit,
    response: FrequencyUncertainty,
    options: IdentOptions,
    measured_rad: RealArray,
    *,
    also_direct_term: bool = False,
) -> _OrderFit:
    """The fit, or one whose poles all have a band of measured_rad (K, 2) within their half-power width.

    The limited fits compete by the criterion of the order selection. The best of them replaces the given fit
    unless that is better by more than chance makes the unknowns of its poles without data; one with more
    unknowns than the given fit has to be better. also_direct_term:
    limited fits with a direct term compete, too, which does what poles near pi/dt do for a response without
    the half sample of a hold.
    """
    unshown_poles = poles_without_data(fit.end.poles, fit.search.fixed, measured_rad)
    if unshown_poles.order == 0:
        return fit

    structures = [options.model_copy(update={"feedthrough": fit.data.feedthrough})]
    if also_direct_term and not fit.data.feedthrough:
        structures.append(options.model_copy(update={"feedthrough": True}))

    # The criterion of every fit is read from the residual of the given one, so that they can be compared.
    worth = fit.search.colour(fit.end).effective_samples
    scale_of = (fit.end.rss, fit.end.poles.order, worth)
    given_criterion = fit.data.criterion(*scale_of)(fit.end.rss, fit.end.poles.order)
    given_unknowns = fit.data.n_parameters(fit.end.poles.order)
    by_chance = float(chi2.ppf(TEST_LEVEL, unshown_poles.order))
    best_fit = fit
    best_criterion = np.inf
    for structure in structures:
        # Poles of a fit with a direct term are others; without one the given poles are near those sought.
        start = None if also_direct_term else fit.end.poles
        limited_fit = _OrderFit.of(_prepared(response, structure), structure, measured_rad, start)
        end = limited_fit.end
        criterion = limited_fit.data.criterion(*scale_of)(end.rss, end.poles.order)
        more_unknowns = limited_fit.data.n_parameters(end.poles.order) > given_unknowns
        allowed = given_criterion if more_unknowns else given_criterion + by_chance
        # A pair is never damped beyond its largest ratio, not even where it should be wider.
        complies = poles_without_data(end.poles, limited_fit.search.fixed, measured_rad).order == 0
        if complies and criterion <= min(allowed, best_criterion):
            best_fit = limited_fit
            best_criterion = criterion
    return best_fit


def _assumed_outside(model: GobfModel, band_rad_s: tuple[float, float]) -> Finding:
    """Largest gains of the model below and above the measured band, and where the larger ones are."""
    low_rad_s, high_rad_s = band_rad_s
    nyquist_rad_s = np.pi / model.dt_s
    # Two decades below the first frequency a model without integrators has its gain at rest.
    below = np.geomspace(
        max(low_rad_s, 1e-6 * nyquist_rad_s) / 100, max(low_rad_s, 1e-6 * nyquist_rad_s), 200
    )
    above = np.geomspace(min(high_rad_s, nyquist_rad_s), nyquist_rad_s, 2000)
    gain_below = np.abs(model.frequency_response(below))
    gain_above = np.abs(model.frequency_response(above))
    highest = int(np.argmax(gain_above))
    return finding(
        FindingKind.ASSUMED_OUTSIDE,
        low_rad_s=low_rad_s,
        high_rad_s=high_rad_s,
        nyquist_rad_s=nyquist_rad_s,
        integrators=model.integrators,
        gain_at_low=float(gain_below[-1]),
        largest_below=float(gain_below.max()),
        gain_at_high=float(gain_above[0]),
        largest_above=float(gain_above[highest]),
        largest_above_rad_s=float(above[highest]),
        gain_at_nyquist=float(gain_above[-1]),
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
