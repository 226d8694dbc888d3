"""A low-order nominal model placed where the posterior is, not only where a least-squares fit left it."""

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
from ident.fit.frf_regression import THINNEST, fit_response, prepare_response
from ident.search.pole_search import PoleSearch

# A model of a loop's logs outside most of its own ellipses explains nothing: machines whose certificates held
# had 87 % or more of them around their model, wrong ones 46 % or less (benchmarks.closed_loop_machines).
MOST_INSIDE_PERCENT = 50.0


def nominal_near(posterior: ResponsePosterior, poles: Poles, omega_rad_s: npt.ArrayLike) -> GobfModel:
    """GOBF model on given poles whose response stays closest to the posterior mean, in units of its ellipses.

    Coefficients (and the direct term, where the posterior has one) minimise the sum over omega (F,) of e^T
    P^-1 e, e the error of (Re, Im), P the posterior covariance. Raises ValueError when omega has too few
    frequencies.
    """
    return next(nominals_near(posterior, poles, omega_rad_s))


def nominals_near(
    posterior: ResponsePosterior, poles: Poles, omega_rad_s: npt.ArrayLike
) -> Iterator[GobfModel]:
    """The nearest models (`nominal_near`) on given poles, on each taken twice, on those moved to where the
    posterior has them, and with ever one pair more (`PoleSearch`), up to twice the given order and a pair;
    unstable poles stay."""
    response = posterior.at(omega_rad_s)
    data = prepare_response(
        replace(
            response,
            covariance=response.covariance
            + (THINNEST * np.abs(response.centre[:, None, None])) ** 2 * np.eye(2),
        ),
        integrators=posterior.integrators,
        delay_samples=posterior.input_delay_samples,
        feedthrough=posterior.has_feedthrough,
    )
    if data.y.size < poles.order + data.feedthrough:
        raise ValueError(
            f"{data.z.size} frequencies do not determine {poles.order + data.feedthrough} coefficients"
        )
    # An integrator's pole at z = 0 is its zero, no dynamics. What is held stands first, in its own digits.
    held = Poles(np.zeros(min(posterior.integrators, int(np.count_nonzero(poles.real == 0)))))
    known = IdentOptions(integrators=held.order).with_unstable(posterior.unstable)
    data = replace(data, common=data.common / all_pass_response(posterior.unstable, data.z))
    search, held = PoleSearch(data, known), held.appended(posterior.unstable)
    tried: tuple[Poles, ...] = (poles, poles.doubled())
    while True:
        for each in tried:
            fit = fit_response(data, each)
            yield GobfModel(
                poles=each,
                coefficients=fit.coefficients,
                dt_s=posterior.dt_s,
                feedthrough=fit.feedthrough,
                integrators=posterior.integrators,
                input_delay_samples=posterior.input_delay_samples,
                input_name=posterior.input_name,
                output_name=posterior.output_name,
                unstable=posterior.unstable,
            )
        if search.minima and each.order > 2 * poles.order:
            return
        start = held.appended(poles.without(held))
        tried = ((search.add_pair(each) if search.minima else search.descend(start, "nominal")).poles,)


@dataclass(frozen=True)
class NominalAgreement:
    """How far the nominal model of the design is from the ellipses' centres, in ellipses."""

    share_inside_percent: float
    largest_distance: float
    at_rad_s: float

    @classmethod
    def of(
        cls, frequency: FrequencyUncertainty, nominal: Callable[[RealArray], ComplexArray]
    ) -> NominalAgreement:
        """Of a nominal response, rad/s (F,) to G (F,), over the frequencies of the ellipses."""
        distance = frequency.normalised_distance(nominal(frequency.omega_rad_s))
        worst = int(np.argmax(distance))
        return cls(
            share_inside_percent=100 * float(np.mean(distance <= 1)),
            largest_distance=float(distance[worst]),
            at_rad_s=float(frequency.omega_rad_s[worst]),
        )

    @property
    def doubt(self) -> list[Finding]:
        """What to say of a nominal that lies outside most of its ellipses; empty for others."""
        if self.share_inside_percent >= MOST_INSIDE_PERCENT:
            return []
        told = {"outside_percent": 100 - self.share_inside_percent, "times": self.largest_distance}
        return [finding(FindingKind.NOMINAL_OUTSIDE, **told, at_rad_s=self.at_rad_s)]
