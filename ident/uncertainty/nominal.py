"""A low-order nominal model placed where the posterior is, not only where a least-squares fit left it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ident.basis.functions import all_pass_response, basis_response
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.basis.structure import front_response
from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import standard_axes
from ident.data.finding import Finding, FindingKind, finding
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.fit.frf_regression import THINNEST

# A model of a loop's logs outside most of its own ellipses explains nothing: machines whose certificates held
# had 87 % or more of them around their model, wrong ones 46 % or less (benchmarks.closed_loop_machines).
MOST_INSIDE_PERCENT = 50.0


def nominal_near(posterior: ResponsePosterior, poles: Poles, omega_rad_s: npt.ArrayLike) -> GobfModel:
    """GOBF model on given poles whose response stays closest to the posterior mean, in units of its ellipses.

    Coefficients (and the direct term, where the posterior has one) minimise the sum over omega (F,) of e^T
    P^-1 e, e the error of (Re, Im), P the posterior covariance. Raises ValueError when omega has too few
    frequencies.
    """
    uncertainty = posterior.at(omega_rad_s)
    direct = posterior.has_feedthrough
    omega = uncertainty.omega_rad_s
    n_coefficients = poles.order + int(direct)
    if 2 * omega.size < n_coefficients:
        raise ValueError(f"{omega.size} frequencies do not determine {n_coefficients} coefficients")
    z = np.exp(1j * omega * posterior.dt_s)
    columns = basis_response(poles, z)
    if direct:
        columns = np.column_stack([columns, np.ones(omega.size)])
    common = front_response(omega, posterior.dt_s, posterior.integrators, posterior.input_delay_samples)
    common = common / all_pass_response(posterior.unstable, z)
    s1, s2, u1 = standard_axes(uncertainty.covariance)
    floor = THINNEST * np.abs(uncertainty.centre)
    aligned = (common * u1.conj())[:, None] * columns
    target = uncertainty.centre * u1.conj()
    along, across = 1 / np.hypot(s1, floor), 1 / np.hypot(s2, floor)
    rows = np.vstack([along[:, None] * aligned.real, across[:, None] * aligned.imag])
    solution, *_ = np.linalg.lstsq(
        rows, np.concatenate([along * target.real, across * target.imag]), rcond=None
    )
    return GobfModel(
        poles=poles,
        coefficients=solution[: poles.order],
        dt_s=posterior.dt_s,
        feedthrough=float(solution[-1]) if direct else 0.0,
        integrators=posterior.integrators,
        input_delay_samples=posterior.input_delay_samples,
        input_name=posterior.input_name,
        output_name=posterior.output_name,
        unstable=posterior.unstable,
    )


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
