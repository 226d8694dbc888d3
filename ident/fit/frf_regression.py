"""A measured frequency response as a weighted least-squares problem, linear in everything but the poles.

The rows of a frequency are its error, turned into the axes of its ellipse and divided by their standard
deviations: two real numbers of unit variance. They play the part of the samples in the time domain (design
4.2): thin QR, residual r, J = |r|^2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ident.basis.coordinates import SearchSpace
from ident.basis.functions import all_pass_response, basis_response, block_responses
from ident.basis.poles import Poles
from ident.basis.structure import front_response
from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import standard_axes
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.fit.least_squares import RANK_TOLERANCE
from ident.fit.problem import CandidateCost, Linearisation, ResidualColour, residual_colour

# A thinner ellipse (over its major axis, or the response) would let one frequency overrule all the others.
THINNEST = 1e-4


@dataclass(frozen=True, eq=False)
class FrfRegression:
    """Everything a fit of a frequency response (F,) needs but the poles.

    z (F,): exp(j omega dt). common (F,): integrators (z / (z - 1))^k and delay z^-d. turn (F,): into the axes
    of the ellipse; weight (2, F): one over the standard deviations there, the second 0 at 0 and pi/dt, where
    both responses are real. y (2 F,): the whitened measurement.
    """

    z: ComplexArray
    common: ComplexArray
    turn: ComplexArray
    weight: RealArray
    y: RealArray
    feedthrough: bool
    dt_s: float

    @cached_property
    def n_samples(self) -> int:
        """Number of real numbers that were measured: two per frequency, one at 0 and at pi/dt."""
        return int(np.count_nonzero(self.weight))

    @cached_property
    def power(self) -> float:
        """|y|^2."""
        return float(self.y @ self.y)

    @cached_property
    def longest(self) -> int:
        """Samples of a record that shows the lowest measured frequency twice."""
        angle = np.angle(self.z)
        return int(np.ceil(4 * np.pi / angle[angle > 0].min()))

    @cached_property
    def omega_max_rad_s(self) -> float | None:
        """The last measured frequency: beyond nothing shows where a pair is."""
        return min(float(np.angle(self.z).max()), 0.9 * np.pi) / self.dt_s

    def n_parameters(self, order: int, n_fixed: int = 0) -> int:
        """Number of free real numbers of a fit: coefficients, direct term, poles that are not known."""
        return int(2 * order - n_fixed + self.feedthrough)

    def whiten(self, response: ComplexArray) -> RealArray:
        """Complex columns (..., F, K) -> real rows of unit variance (..., 2 F, K)."""
        aligned = response * self.turn[:, np.newaxis]
        return np.concatenate(
            [aligned.real * self.weight[0][:, np.newaxis], aligned.imag * self.weight[1][:, np.newaxis]],
            axis=-2,
        )

    def responses(self, poles: Poles) -> ComplexArray:
        """Basis functions, and the direct term if there is one, times the known factor, (F, B or B + 1)."""
        parts = [basis_response(poles, self.z)]
        if self.feedthrough:
            parts.append(np.ones((self.z.size, 1), dtype=np.complex128))
        return np.asarray(self.common[:, np.newaxis] * np.hstack(parts))

    def columns(self, poles: Poles) -> RealArray:
        """The same whitened, (2 F, B or B + 1)."""
        return self.whiten(self.responses(poles))

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and Kaufman linearisation at these poles."""
        poles = Poles(real, pairs)
        here = fit_response(self, poles)
        if not here.rss < below:
            return Linearisation(here.rss, np.zeros((0, 0)), np.zeros(0))
        rows = self.whiten(here.response[:, np.newaxis] * block_responses(poles, self.z))
        rows -= here.q @ (here.q.T @ rows)
        return Linearisation(here.rss, rows.T @ rows, rows.T @ here.residual)

    def residual(self, poles: Poles) -> RealArray:
        """The whitened residual (2 F,)."""
        return fit_response(self, poles).residual

    def colour(self, residual: RealArray) -> ResidualColour:
        """Colour of a whitened residual (2 F,) over frequency; what it is worth counts measured numbers."""
        count = self.z.size
        found = residual_colour(residual, np.array([0, count, 2 * count], dtype=np.int64))
        share = found.effective_samples / residual.size
        return ResidualColour(max(share * self.n_samples, 3.0), found.white)

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """J / scale + (free numbers) ln Ne, Ne = worth: a pole, of two numbers, is kept if J falls by more
        than 2 ln Ne (a pair: 4 ln Ne). J is a chi-square because the covariances are known; where
        it is larger than they explain, they are multiplied by its excess, the scale."""
        scale = max(1.0, rss / max(self.n_samples - self.n_parameters(order), 1))
        share, price = worth / self.n_samples, float(np.log(worth))
        return lambda rss, order: share * rss / scale + self.n_parameters(order) * price

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles; a response has no free ones."""
        frozen = self.columns(shared)
        q = np.linalg.qr(frozen)[0] if frozen.shape[1] else frozen
        residual = self.y - q @ (q.T @ self.y)
        drive = self.common * all_pass_response(shared, self.z)

        def costs(units: RealArray) -> RealArray:
            blocks = np.stack([space.blocks(unit) for unit in units])
            rows = self.whiten(_cascade_responses(blocks, space.n_real, self.z, drive))
            q_new = np.linalg.qr(rows - q @ (q.T @ rows))[0]
            return np.asarray(
                residual @ residual - np.sum(np.einsum("enk,n->ek", q_new, residual) ** 2, axis=1)
            )

        return CandidateCost(space, self.power, lambda unit: float(costs(unit[np.newaxis])[0]), costs)


def _cascade_responses(blocks: RealArray, n_real: int, z: ComplexArray, drive: ComplexArray) -> ComplexArray:
    """Responses (E, F, B) of E cascades, given by their blocks (E, R + P, 4), behind `drive` (F,)."""
    drive = np.broadcast_to(drive, (len(blocks), z.size))
    columns = []
    for i in range(blocks.shape[1]):
        p0, p1, p2, p3 = (blocks[:, i, j, np.newaxis] for j in range(4))
        if i < n_real:
            columns.append(p1 / (z - p0) * drive)
            drive = drive * (1 - p0 * z) / (z - p0)
        else:
            below = z**2 - p1 * (1 + p0) * z + p0
            columns += [p2 * (z - p1) / below * drive, p2 * p3 / below * drive]
            drive = drive * (1 - p1 * (1 + p0) * z + p0 * z**2) / below
    return np.stack(columns, axis=-1)


def prepare_response(
    response: FrequencyUncertainty, *, integrators: int, delay_samples: int, feedthrough: bool
) -> FrfRegression:
    """Whiten a measured response. Raises ValueError without any uncertainty, or at omega = 0 with
    integrators."""
    omega = response.omega_rad_s
    s1, s2, direction = standard_axes(response.covariance)
    turn = np.conj(direction)
    real_only = (omega == 0) | (omega >= np.pi / response.dt_s * (1 - 1e-9))
    turn[real_only] = 1.0
    s1 = np.where(real_only, np.sqrt(response.covariance[:, 0, 0]), s1)
    if not np.all(s1 > 0):
        at = omega[int(np.argmax(~(s1 > 0)))]
        raise ValueError(
            f"at omega = {at:.6g} rad/s the response is given as exactly known: a fit needs a covariance at "
            "every frequency, the smallest that is still honest"
        )
    weight = np.stack([1 / s1, np.where(real_only, 0.0, 1 / np.maximum(s2, THINNEST * s1))])
    frame = FrfRegression(
        z=np.exp(1j * omega * response.dt_s),
        common=front_response(omega, response.dt_s, integrators, delay_samples),
        turn=turn,
        weight=weight,
        y=np.zeros(2 * omega.size),
        feedthrough=feedthrough,
        dt_s=response.dt_s,
    )
    return replace(frame, y=frame.whiten(response.centre[:, np.newaxis])[:, 0])


@dataclass(frozen=True, eq=False)
class FrfFit:
    """Weighted least-squares fit for given poles.

    coefficients (B,), direct term, fitted response (F,), whitened residual (2 F,) and its sum of squares;
    q (2 F, K): orthonormal columns of the fit.
    """

    coefficients: RealArray
    feedthrough: float
    response: ComplexArray
    residual: RealArray
    rss: float
    q: RealArray


def fit_response(data: FrfRegression, poles: Poles) -> FrfFit:
    """theta = R^-1 Q^T y by thin QR (27), on the whitened rows."""
    responses = data.responses(poles)
    q, triangle = np.linalg.qr(data.whiten(responses))
    projected = q.T @ data.y
    residual = data.y - q @ projected
    theta = np.linalg.lstsq(triangle, projected, rcond=RANK_TOLERANCE)[0]
    return FrfFit(
        coefficients=np.asarray(theta[: poles.order], dtype=np.float64),
        feedthrough=float(theta[-1]) if data.feedthrough else 0.0,
        response=np.asarray(responses @ theta),
        residual=residual,
        rss=float(residual @ residual),
        q=q,
    )
