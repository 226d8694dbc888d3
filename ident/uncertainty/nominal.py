"""A low-order nominal model placed where the posterior is, not only where a least-squares fit left it.

A design needs a model of few poles beside the ellipses. `nominal_near` takes given poles and finds the
coefficients that are closest to the posterior mean, in units of the ellipses (weighted least squares over
frequencies). `nominals_near` goes on to better poles and more of them, for a caller that stops at the first
model that is good enough. `NominalAgreement` says how far a nominal is from the ellipses' centres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ident.basis.functions import all_pass_response
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.data.arrays import ComplexArray, RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.fit.frf_regression import THINNEST, FrfRegression, fit_response, prepare_response
from ident.search.pole_search import PoleSearch

# A model of a loop's logs outside most of its own ellipses explains nothing: machines whose certificates held
# had 87 % or more of them around their model, wrong ones 46 % or less (benchmarks.closed_loop_machines).
MOST_INSIDE_PERCENT = 50.0


def nominal_near(posterior: ResponsePosterior, poles: Poles, omega_rad_s: npt.ArrayLike) -> GobfModel:
    """GOBF model on given poles whose response stays closest to the posterior mean, in units of its ellipses.

    Parameters
    ----------
    posterior : ResponsePosterior
        Its response and covariance; gives structure, names and unstable poles of the model, too.
    poles : Poles
        In z, as many as the model gets.
    omega_rad_s : array_like, shape (F,)
        Frequencies at which the responses are compared, rad/s, ascending, up to pi / dt_s, not 0 with
        integrators.

    Returns
    -------
    GobfModel

    Raises
    ------
    ValueError
        When there are too few frequencies for the coefficients, or by `ResponsePosterior.at` for frequencies
        that do not ascend or are out of its range.

    Notes
    -----
    Coefficients (and the direct term, where the posterior has one) minimise the sum over omega of e^T P^-1 e,
    e the error of (Re, Im), P the posterior covariance.
    """
    return next(nominals_near(posterior, poles, omega_rad_s))


def nominals_near(
    posterior: ResponsePosterior, poles: Poles, omega_rad_s: npt.ArrayLike
) -> Iterator[GobfModel]:
    """Nearest models (`nominal_near`) on better and better poles, one after the other.

    Parameters
    ----------
    posterior, poles, omega_rad_s
        Those of `nominal_near`; with unstable poles `poles` holds their mirror images.

    Yields
    ------
    GobfModel
        On the given poles; on those refined from the given ones on the posterior's response
        (`PoleSearch.descend`); on each given one taken twice; then on the refined ones with one pair more
        each time (`PoleSearch.add_pair`), until the order exceeds twice the given one; unstable poles stay.
        Not every one need be nearer than the one before: the caller judges. A pole that is taken twice, or
        is added, brings a zero, which below the data may lie anywhere: outside the circle as well.

    Raises
    ------
    ValueError
        When there are too few frequencies for the coefficients of the first model, or as `nominal_near`; if
        the posterior's unstable poles are not among `poles`, by `Poles.without`. Later models are not checked
        for too few frequencies: what the data do not show gets coefficient zero.
    """
    data = _regression(posterior, omega_rad_s)
    n_coefficients = poles.order + data.feedthrough
    if data.y.size < n_coefficients:
        raise ValueError(f"{data.z.size} frequencies do not determine {n_coefficients} coefficients")

    # An integrator's pole at z = 0 is its zero, no dynamics: it is held, as are unstable poles. What is held
    # stands first among the poles, in its own digits.
    n_deadbeat = int(np.count_nonzero(poles.real == 0))
    of_integrators = Poles(np.zeros(min(posterior.integrators, n_deadbeat)))
    held = of_integrators.appended(posterior.unstable)
    known = IdentOptions(integrators=of_integrators.order).with_unstable(posterior.unstable)
    search = PoleSearch(data, known)

    yield _nearest(data, poles, posterior)
    start = held.appended(poles.without(held))
    moved = search.descend(start, "nominal").poles
    yield _nearest(data, moved, posterior)
    yield _nearest(data, poles.doubled(), posterior)
    # Up to about twice the order, which is what each pole taken twice has. Chosen.
    while moved.order <= 2 * poles.order:
        moved = search.add_pair(moved).poles
        yield _nearest(data, moved, posterior)


def _regression(posterior: ResponsePosterior, omega_rad_s: npt.ArrayLike) -> FrfRegression:
    """The posterior's mean at omega (F,) as a measured response, with its ellipses as covariances.

    Ellipses are widened by `THINNEST` (1e-4) of the response's modulus in each direction: one of no width
    would have infinite weight. Raises ValueError as `ResponsePosterior.at`.
    """
    response = posterior.at(omega_rad_s)
    thinnest = (THINNEST * np.abs(response.centre[:, None, None])) ** 2 * np.eye(2)
    data = prepare_response(
        replace(response, covariance=response.covariance + thinnest),
        integrators=posterior.integrators,
        delay_samples=posterior.input_delay_samples,
        feedthrough=posterior.has_feedthrough,
    )
    # Basis functions of a plant with unstable poles stand behind the inverse of their all-pass.
    return replace(data, common=data.common / all_pass_response(posterior.unstable, data.z))


def _nearest(data: FrfRegression, poles: Poles, posterior: ResponsePosterior) -> GobfModel:
    """Model on these poles that is nearest to the data, with structure and names of the posterior.

    data: the posterior's mean and ellipses (`_regression`). Coefficients that the data do not show are zero.
    That the posterior's unstable poles are among the poles is checked by `GobfModel` (ValueError).
    """
    fit = fit_response(data, poles)
    return GobfModel(
        poles=poles,
        coefficients=fit.coefficients,
        dt_s=posterior.dt_s,
        feedthrough=fit.feedthrough,
        integrators=posterior.integrators,
        input_delay_samples=posterior.input_delay_samples,
        input_name=posterior.input_name,
        output_name=posterior.output_name,
        unstable=posterior.unstable,
    )


@dataclass(frozen=True)
class NominalAgreement:
    """How far the nominal model of the design is from the ellipses' centres, in ellipses.

    Attributes
    ----------
    share_inside_percent : float
        Share of the frequencies at which the nominal lies inside its ellipse.
    largest_distance : float
        Largest distance from the centre; 1 is the ellipse itself.
    at_rad_s : float
        Frequency of that distance, rad/s.
    """

    share_inside_percent: float
    largest_distance: float
    at_rad_s: float

    @classmethod
    def of(
        cls, frequency: FrequencyUncertainty, nominal: Callable[[RealArray], ComplexArray]
    ) -> NominalAgreement:
        """Agreement of a nominal response, rad/s (F,) to G (F,), over the frequencies of the ellipses.

        frequency: omega_rad_s (F,) and its ellipses at their own level. Raises ValueError, by
        `FrequencyUncertainty.normalised_distance`, for a response of another shape or not finite.
        """
        distance = frequency.normalised_distance(nominal(frequency.omega_rad_s))
        worst = int(np.argmax(distance))
        return cls(
            share_inside_percent=100 * float(np.mean(distance <= 1)),
            largest_distance=float(distance[worst]),
            at_rad_s=float(frequency.omega_rad_s[worst]),
        )

    @property
    def doubt(self) -> list[Finding]:
        """What to say of a nominal that lies outside most of its ellipses: one finding, or an empty list.

        The limit is `MOST_INSIDE_PERCENT`, met exactly: no finding.
        """
        if self.share_inside_percent >= MOST_INSIDE_PERCENT:
            return []
        return [
            finding(
                FindingKind.NOMINAL_OUTSIDE,
                outside_percent=100 - self.share_inside_percent,
                times=self.largest_distance,
                at_rad_s=self.at_rad_s,
            )
        ]
