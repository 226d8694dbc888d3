"""Identify a model from a measured frequency response whose errors have known covariances.

The response is divided by its errors' size, so that the residual energy is chi-square where the model is
right. Poles are searched and their number is chosen as for records (`_OrderFit`). Poles that no measured
frequency shows are then replaced where fits without them are as good but for chance (`_limited_to_data`).
What is left are the model, ellipses around it (`embed_response`), standard deviations of its poles, and what
it assumes outside the measured band. Assumed: errors that are independent from frequency to frequency.

Types of other files that travel here: `FrequencyUncertainty`, a response (F,) at frequencies with covariances
(F, 2, 2) of its real and imaginary parts; `FrfRegression`, its rows divided by these; `PoleSearch`, a search
on them with fixed poles, bounds and trace; `Refined`, the end of a descent (poles, chi-square rss).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

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

# Frequencies at which the model is looked at over two decades below the measured band: 2.3 % apart, so that
# the peak of a mode of damping .01 (2 % wide) is not missed.
POINTS_BELOW = 200
# Frequencies from the last measured one to the Nyquist frequency: .12 % apart over a decade, so that the peak
# of a mode of damping .001 is not missed.
POINTS_ABOVE = 2000
# Share of the Nyquist frequency from which the look below begins at least, where frequency zero was measured:
# six decades, more than any measurement spans. Chosen.
LOWEST_SHARE = 1e-6
# Eigenvalues of the normal matrix, columns scaled to one length, below this share of the largest are
# rounding: the data do not show these directions, which get no variance.
SMALLEST_EIGENVALUE = 1e-14
# Smallest number that still can be divided by, in place of a length of zero.
TINY = 1e-300


@dataclass(frozen=True, eq=False, repr=False)
class FrfIdentification(Shown):
    """A model fitted to a measured frequency response, and how well it fits.

    Attributes
    ----------
    model : GobfModel
        R real poles and P pairs, coefficients, direct term, known integrators and delay.
    posterior : ResponsePosterior
        Tangent embedding on the same rows: ellipses at any frequency.
    omega_rad_s : ndarray, shape (F,)
        Measured frequencies.
    residual : ndarray, shape (F,), complex
        Measured minus fitted.
    distance : ndarray, shape (F,)
        Length of the residual in units of the measurement's own ellipses; up to 1 inside.
    rss : float
        Chi-square.
    degrees_of_freedom : int
        Measured real numbers minus unknowns.
    decay_std_per_s : ndarray, shape (R,)
        Standard deviations of the real poles' decays, 1/s, to first order, times sqrt(rss /
        degrees_of_freedom) where that is above 1. Known poles (first of each type) have 0.
    omega_std_rad_s, zeta_std : ndarray, shape (P,)
        Those of the pairs' frequencies, rad/s, and damping ratios.
    order_table : tuple of OrderStep
        Every structure that was tried.
    verdicts : tuple of Finding
        Chi-square, what is assumed outside the band, and a direct term that was not stated.
    search : SearchTrace
        Searches, descents and warnings.
    response : FrequencyUncertainty
        The measurement.
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
        """Make the arrays read-only; raise ValueError where shapes do not agree or no freedom is left."""
        lock(self, "omega_rad_s", "distance", "decay_std_per_s", "omega_std_rad_s", "zeta_std")
        lock(self, "residual", dtype=np.complex128)
        if not (self.omega_rad_s.shape == self.residual.shape == self.distance.shape):
            raise ValueError("omega_rad_s, residual and distance must be (F,)")
        if not self.degrees_of_freedom > 0:
            raise ValueError(f"degrees_of_freedom must be positive; got {self.degrees_of_freedom}")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What to look at before trusting the model: poles at a bound, or outside the measured band; often
        empty."""
        return self.search.warnings

    @property
    def share_inside(self) -> float:
        """Share of the measured points whose ellipses, of the measurement's own level, hold the model.

        0 .. 1; there is one point at least.
        """
        return float(np.mean(self.distance <= 1.0))

    @property
    def own_uncertainty(self) -> ResponsePosterior:
        """The posterior of the response, which a plant made of this fit takes over."""
        return self.posterior

    def to_control(self) -> Any:
        """The model as `control.StateSpace`; ImportError without python-control."""
        return self.model.to_control()

    def save(self, path: str | Path) -> None:
        """Write the model to a file (`GobfModel.save`); OSError where it cannot be written."""
        self.model.save(path)


def identify_frf(
    response: FrequencyUncertainty,
    options: IdentOptions | None = None,
    embedding: EmbeddingOptions | None = None,
    *,
    shared_gain_std: float = 0.0,
) -> FrfIdentification:
    """Fit a GOBF model to a measured frequency response, each frequency weighted by its covariance.

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
        A frequency has no covariance, there are too few frequencies for the given order, or an option asks
        for an offset, an initial state or a relative degree. That frequencies increase and numbers are
        finite, `FrequencyUncertainty` has seen to.

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
    n_real = options.n_real or 0
    n_pairs = options.n_pairs or 0
    order = fixed.order + n_real + 2 * n_pairs
    needed = data.n_parameters(order, fixed.order)
    if not data.n_samples > needed:
        raise ValueError(
            f"{response.omega_rad_s.size} frequencies are too few for order {order}, which "
            # A frequency gives two real numbers, and one number has to be left.
            f"has {needed} unknowns; expected at least {needed // 2 + 1}"
        )

    # Poles wherever they fit best; then only where the data show them, if that costs no more than chance.
    best_fit = _OrderFit.of(data, options)
    # Bands (K, 2) in radians per sample: all up to the last frequency; the measured points; those and all
    # below.
    angles_rad = response.omega_rad_s * response.dt_s
    to_last = np.array([[0.0, angles_rad[-1]]])
    points = np.column_stack([angles_rad, angles_rad])
    points_and_below = np.vstack([[0.0, angles_rad[0]], points])
    # First what lies above the last frequency: a direct term may take the misfit that other poles follow.
    direct_term_helps = "feedthrough" not in options.model_fields_set
    best_fit = _limited_to_data(best_fit, response, options, to_last, also_direct_term=direct_term_helps)
    best_fit = _limited_to_data(best_fit, response, options, points_and_below)
    best_fit = _limited_to_data(best_fit, response, options, points)

    data = best_fit.data
    search = best_fit.search
    poles = in_order(best_fit.end.poles, fixed)
    fit = fit_response(data, poles)
    freedom = data.n_samples - data.n_parameters(poles.order, fixed.order)
    # A fit worse than its covariances has more error than they state, one that is better no less.
    variance_factor = max(1.0, fit.rss / freedom)
    pole_std = _pole_deviations(data, poles, fixed, variance_factor)
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
    band_rad_s = (float(response.omega_rad_s[0]), float(response.omega_rad_s[-1]))
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
    warnings = distinct(
        [
            *pole_warnings(model, fixed, search.bounds),
            *pairs_outside(poles, fixed, response.dt_s, band_rad_s),
        ]
    )
    return FrfIdentification(
        model=model,
        posterior=posterior,
        omega_rad_s=response.omega_rad_s,
        residual=response.centre - fit.response,
        distance=response.normalised_distance(fit.response),
        rss=fit.rss,
        degrees_of_freedom=freedom,
        decay_std_per_s=pole_std.decay_per_s,
        omega_std_rad_s=pole_std.omega_rad_s,
        zeta_std=pole_std.zeta,
        order_table=best_fit.selection.table(best_fit.end),
        verdicts=tuple(verdicts),
        search=SearchTrace(tuple(search.stages), tuple(search.minima), warnings, search.evaluations),
        response=response,
    )


def _prepared(response: FrequencyUncertainty, options: IdentOptions) -> FrfRegression:
    """Regression of the response, divided by the size of its errors.

    Integrators, delay and direct term are those of the options. Raises ValueError for a frequency without
    covariance.
    """
    return prepare_response(
        response,
        integrators=options.integrators,
        delay_samples=options.input_delay_samples,
        feedthrough=options.feedthrough,
    )


@dataclass(frozen=True, eq=False)
class _OrderFit:
    """An order selection that has ended.

    data : the regression that was fitted, with or without a direct term
    search : its pole search, with bounds and trace
    selection : structures that were tried
    end : the poles that were chosen, and their chi-square
    """

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

        `measured_rad` : (K, 2) bands, radians per sample; poles need one within their half-power width
        (`Bounds.shown_by`). `start` : poles to go on from, fixed ones first; None: a global search. Neither
        is checked here: the caller made them of a measured response and of an earlier fit.
        """
        bounds = None
        if measured_rad is not None:
            bounds = Bounds.from_options(options, data.longest, data.dt_s).shown_by(measured_rad)
        search = PoleSearch(data, options, bounds)
        selection = OrderSelection(search)
        first = None if start is None else search.descend(start, "poles shown by the data")
        end = selection.run(first)
        if options.n_real is not None and options.n_pairs is not None:
            # With given numbers a pair may stand where two real poles should.
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
    """Order fit whose poles the data show, or the given one where that is better beyond chance.

    `measured_rad` : bands (K, 2), radians per sample; a pole is shown if one of them meets its half-power
    width. Fits that are limited to such poles compete by the criterion of the order selection. The best of
    them replaces the given fit unless that is better by more than chance makes the unknowns of its poles
    without data; one with more unknowns than the given fit has to be better.

    `also_direct_term` : limited fits with a direct term compete, too, which does what poles near pi/dt do for
    a response without the half sample of a hold. Nothing is raised beyond what `identify_frf` has asked of
    `response` and `options`; a fit all of whose poles are shown is returned as it is.
    """
    unshown_poles = poles_without_data(fit.end.poles, fit.search.fixed, measured_rad)
    if unshown_poles.order == 0:
        return fit

    structures = [options.model_copy(update={"feedthrough": fit.data.feedthrough})]
    if also_direct_term and not fit.data.feedthrough:
        structures.append(options.model_copy(update={"feedthrough": True}))

    # The criterion of every fit is read from the residual of the given one, so that they can be compared.
    worth = fit.search.colour(fit.end).effective_samples
    read_from = (fit.end.rss, fit.end.poles.order, worth)
    given_criterion = fit.data.criterion(*read_from)(fit.end.rss, fit.end.poles.order)
    given_unknowns = fit.data.n_parameters(fit.end.poles.order)
    by_chance = float(chi2.ppf(TEST_LEVEL, unshown_poles.order))
    best_fit = fit
    best_criterion = np.inf
    for structure in structures:
        # Poles of a fit with a direct term are others; without one the given poles are near those sought.
        start = None if also_direct_term else fit.end.poles
        limited_fit = _OrderFit.of(_prepared(response, structure), structure, measured_rad, start)
        end = limited_fit.end
        criterion = limited_fit.data.criterion(*read_from)(end.rss, end.poles.order)
        more_unknowns = limited_fit.data.n_parameters(end.poles.order) > given_unknowns
        allowed = given_criterion if more_unknowns else given_criterion + by_chance
        # A limited fit may still hold a pair that no band shows: at the largest damping ratio it gets no
        # wider.
        complies = poles_without_data(end.poles, limited_fit.search.fixed, measured_rad).order == 0
        if complies and criterion <= min(allowed, best_criterion):
            best_fit = limited_fit
            best_criterion = criterion
    return best_fit


def _assumed_outside(model: GobfModel, band_rad_s: tuple[float, float]) -> Finding:
    """Finding on the gains of the model below and above the measured band, where nothing was measured.

    `band_rad_s` : first and last measured frequency. The finding has the gains at both ends of the band and
    at the Nyquist frequency, and the largest ones below and above with the frequency of the one above, in
    units of the response. The band, ascending and above zero or from zero on, is that of a measurement: not
    checked.
    """
    low_rad_s, high_rad_s = band_rad_s
    nyquist_rad_s = np.pi / model.dt_s
    # Two decades (100) below the first frequency a model without integrators has its gain at rest.
    start_rad_s = max(low_rad_s, LOWEST_SHARE * nyquist_rad_s)
    below_rad_s = np.geomspace(start_rad_s / 100, start_rad_s, POINTS_BELOW)
    above_rad_s = np.geomspace(min(high_rad_s, nyquist_rad_s), nyquist_rad_s, POINTS_ABOVE)
    gain_below = np.abs(model.frequency_response(below_rad_s))
    gain_above = np.abs(model.frequency_response(above_rad_s))
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
        largest_above_rad_s=float(above_rad_s[highest]),
        gain_at_nyquist=float(gain_above[-1]),
    )


class _PoleDeviations(NamedTuple):
    """Standard deviations of poles: decays (R,) in 1/s, frequencies (P,) in rad/s, damping ratios (P,)."""

    decay_per_s: RealArray
    omega_rad_s: RealArray
    zeta: RealArray


def _pole_deviations(
    data: FrfRegression, poles: Poles, fixed: Poles, variance_factor: float
) -> _PoleDeviations:
    """Standard deviations of the poles from the Kaufman Jacobian, to first order; 0 for the fixed ones.

    `variance_factor` : by which the covariances of the measurement are too small. The unknowns of the
    Jacobian are 1 - a of a real pole a, and decay s and angle f per sample of a pair. `fixed` : known poles,
    first of each type in `poles` (not checked). Directions that the data do not show get 0; the decay of a
    real pole at zero gets infinity.
    """
    n_fixed_real, n_fixed_pairs = fixed.counts
    deviations = _PoleDeviations(
        decay_per_s=np.zeros(poles.real.size),
        omega_rad_s=np.zeros(poles.pairs.size),
        zeta=np.zeros(poles.pairs.size),
    )
    normal, _ = pole_system(data.linearise(*poles.writable()), poles, fixed)
    if normal.size == 0:
        return deviations

    # Scaled to columns of one length, so that what counts as unseen has no units.
    lengths = np.sqrt(np.maximum(np.diag(normal), TINY))
    scale = np.outer(lengths, lengths)
    inverse = np.linalg.pinv(normal / scale, rcond=SMALLEST_EIGENVALUE, hermitian=True)
    covariance = variance_factor * inverse / scale

    n_free_real = poles.real.size - n_fixed_real
    variance = np.maximum(np.diag(covariance)[:n_free_real], 0.0)
    modulus = np.abs(poles.real[n_fixed_real:])
    # d decay / d (1 - a) = 1 / (a dt): infinite at a = 0, where decay itself is.
    with np.errstate(divide="ignore"):
        deviations.decay_per_s[n_fixed_real:] = np.sqrt(variance) / modulus / data.dt_s
    for index in range(n_fixed_pairs, poles.pairs.size):
        first = n_free_real + 2 * (index - n_fixed_pairs)
        block = covariance[first : first + 2, first : first + 2]
        decay = -np.log(np.abs(poles.pairs[index]))
        angle = np.angle(poles.pairs[index])
        # omega = |decay + j angle|, zeta = decay / omega: their slopes with decay and angle.
        omega = np.hypot(decay, angle)
        omega_slopes = [decay / omega, angle / omega]
        zeta_slopes = [angle**2 / omega**3, -decay * angle / omega**3]
        slopes = np.array([omega_slopes, zeta_slopes])
        omega_std, zeta_std = np.sqrt(np.maximum(np.diag(slopes @ block @ slopes.T), 0.0))
        deviations.omega_rad_s[index] = omega_std / data.dt_s
        deviations.zeta[index] = zeta_std
    return deviations
