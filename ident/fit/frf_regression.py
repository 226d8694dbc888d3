"""A measured frequency response as a weighted least-squares problem, linear in everything but the poles.

The rows of a frequency are its error, turned into the axes of its ellipse and divided by their standard
deviations: two real numbers of unit variance. They play the part of the samples in the time domain: thin QR,
residual r, J = |r|^2. `prepare_response` makes these rows; `FrfRegression` then answers what a pole search
and a refinement ask (`ident.fit.problem.PoleProblem`), and `fit_response` gives the coefficients at given
poles. It is assumed that the errors of two frequencies are independent.
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

# Least minor axis of an ellipse, as a share of its major axis. A thinner one would let one direction of one
# frequency overrule all the others. Chosen; doubled or halved, no test of these fits fails.
THINNEST = 1e-4
# How far below pi / dt, as a share, a frequency counts as pi / dt, where a response is real: rounding of
# files of ten digits.
_NYQUIST_ROUNDING = 1e-9
# Largest angle of a pair per sample that a search looks at, over pi: the box of the search
# (`ident.basis.coordinates`) ends there, too, for a mode beyond is hard to tell from one that is folded back.
_LARGEST_ANGLE_SHARE = 0.9
# Periods of the lowest measured frequency that the record has which `longest` stands for: the box of a search
# begins at two periods in the longest record (`ident.basis.coordinates`), so it begins at that frequency.
_PERIODS_OF_LOWEST = 2
# Least number of independent numbers that a residual is worth: the criterion takes its logarithm as the price
# of a free number, and a residual of one colour throughout would be worth nothing. Chosen; the price, ln 3,
# is then just above 1.
_LEAST_WORTH = 3.0


@dataclass(frozen=True, eq=False)
class FrfRegression:
    """Everything a fit of a frequency response (F,) needs but the poles.

    `prepare_response` makes and checks it; nothing is checked here.

    Attributes
    ----------
    z : ndarray of complex, shape (F,)
        exp(j omega dt) at the measured frequencies.
    common : ndarray of complex, shape (F,)
        Integrators (z / (z - 1))^k and delay z^-d, which multiply every basis function.
    turn : ndarray of complex, shape (F,)
        Factor of modulus 1 that turns an error into the axes of its ellipse.
    weight : ndarray, shape (2, F)
        One over the standard deviations along these axes; the second 0 at 0 and pi / dt, where both responses
        are real.
    y : ndarray, shape (2 F,)
        The whitened measurement: first axes of all frequencies, then second axes; no unit.
    feedthrough : bool
        Whether the fit has a direct term.
    dt_s : float
        Sampling time, s.
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
        """Square sum |y|^2 of the whitened measurement."""
        return float(self.y @ self.y)

    @cached_property
    def longest(self) -> int:
        """Samples of a record that shows two periods of the lowest measured frequency above 0.

        Raises ValueError (numpy's, of an empty array) where 0 is the only frequency.
        """
        angle_rad = np.angle(self.z)
        is_moving = angle_rad > 0
        lowest_rad = angle_rad[is_moving].min()
        return int(np.ceil(2 * _PERIODS_OF_LOWEST * np.pi / lowest_rad))

    @cached_property
    def omega_max_rad_s(self) -> float | None:
        """Last measured frequency, rad/s, at most .9 pi / dt: beyond it nothing shows where a pair is.

        0 where 0 is the only frequency; never None.
        """
        last_rad = float(np.angle(self.z).max())
        return min(last_rad, _LARGEST_ANGLE_SHARE * np.pi) / self.dt_s

    def n_parameters(self, order: int, n_fixed: int = 0) -> int:
        """Number of free real numbers of a fit with `order` poles, `n_fixed` of them known.

        Coefficients, the direct term if there is one, and the poles that are not known. Nothing is checked:
        n_fixed above the order gives too few.
        """
        n_direct = 1 if self.feedthrough else 0
        return int(2 * order - n_fixed + n_direct)

    def whiten(self, response: ComplexArray) -> RealArray:
        """Real rows (..., 2 F, K) of complex columns (..., F, K), in which the measurement has unit variance.

        First axes of all F ellipses, then second axes, zero where a response is real. ValueError (numpy's)
        for another F.
        """
        aligned = response * self.turn[:, np.newaxis]
        first_axis = aligned.real * self.weight[0][:, np.newaxis]
        second_axis = aligned.imag * self.weight[1][:, np.newaxis]
        return np.concatenate([first_axis, second_axis], axis=-2)

    def responses(self, poles: Poles) -> ComplexArray:
        """Responses (F, B or B + 1) of the basis functions and of the direct term, if there is one.

        All times the known factor `common`; whitened they are the columns of the fit. B is the order of the
        poles, which lie inside the circle, so that z is none of them.
        """
        parts = [basis_response(poles, self.z)]
        if self.feedthrough:
            parts.append(np.ones((self.z.size, 1), dtype=np.complex128))
        return np.asarray(self.common[:, np.newaxis] * np.hstack(parts))

    def columns(self, poles: Poles) -> RealArray:
        """Whitened columns (2 F, B or B + 1) of a fit with these poles; (2 F, 0) without any."""
        return self.whiten(self.responses(poles))

    def linearise(self, real: RealArray, pairs: ComplexArray, below: float = np.inf) -> Linearisation:
        """Cost and Kaufman linearisation at these poles.

        Parameters
        ----------
        real : ndarray, shape (R,)
            Real poles.
        pairs : ndarray of complex, shape (P,)
            Poles above the axis, one per pair.
        below : float
            Where the cost is not below this, or NaN, normal matrix and gradient are empty.

        Returns
        -------
        Linearisation
            rss (no unit), normal (B, B) and gradient (B,), B = R + 2 P.

        Raises
        ------
        ValueError
            By `Poles`, for one that is not inside the circle.
        """
        # By orthogonal factorisation: a response has hundreds of rows, which cost no more than products do.
        poles = Poles(real, pairs)
        fit = fit_response(self, poles)
        if not fit.rss < below:
            return Linearisation(fit.rss, np.zeros((0, 0)), np.zeros(0))
        # Each block by itself, driven by the fitted output; then off what the coefficients can re-fit.
        driven_blocks = fit.response[:, np.newaxis] * block_responses(poles, self.z)
        directions = self.whiten(driven_blocks)
        directions -= fit.q @ (fit.q.T @ directions)
        return Linearisation(fit.rss, directions.T @ directions, directions.T @ fit.residual)

    def residual(self, poles: Poles) -> RealArray:
        """Whitened residual (2 F,) that the fit with these poles leaves, no unit; see `fit_response`."""
        return fit_response(self, poles).residual

    def colour(self, residual: RealArray) -> ResidualColour:
        """Colour of a whitened residual (2 F,) over frequency; what it is worth counts measured numbers.

        The axes are two records of F numbers. At 0 and pi / dt one of the two was not measured and is zero:
        that is no number, so the share of independent ones counts of `n_samples`. Worth at least
        `_LEAST_WORTH`. A residual of zeros or with NaN: `n_samples`, not white.
        """
        count = self.z.size
        starts = np.array([0, count, 2 * count], dtype=np.int64)
        colour = residual_colour(residual, starts)
        share = colour.effective_samples / residual.size
        return ResidualColour(max(share * self.n_samples, _LEAST_WORTH), colour.white)

    def criterion(self, rss: float, order: int, worth: float) -> Callable[[float, int], float]:
        """Criterion (J, order) -> number, lower is better.

        Parameters
        ----------
        rss, order
            J and number of poles of the fit that tells how well the covariances explain the residual. Of an
            order with as many free numbers as measured ones the excess is J itself.
        worth : float
            Ne, independent numbers that its residual is worth, positive; not checked.

        Returns
        -------
        callable
            NaN for a J of NaN.

        Notes
        -----
        J / scale + (free numbers) ln Ne: a pole, of two numbers, is kept if J falls by more than 2 ln Ne (a
        pair: 4 ln Ne). J is a chi-square because the covariances are known; where it is larger than they
        explain, they are multiplied by its excess, the scale.
        """
        # Chi-square over its degrees of freedom; below 1 the covariances are wide, which is no reason for
        # more poles.
        n_free = self.n_samples - self.n_parameters(order)
        scale = max(1.0, rss / max(n_free, 1))
        share = worth / self.n_samples
        price = float(np.log(worth))

        def value(rss: float, order: int) -> float:
            """Criterion of a fit with J = rss (no unit) and this order; nothing is checked."""
            return share * rss / scale + self.n_parameters(order) * price

        return value

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        """Cost of candidates on top of frozen poles.

        Parameters
        ----------
        space : SearchSpace
            Numbers of candidate poles and the box that their unit cube stands for.
        shared : Poles
            Frozen poles, taken out of the response once, here.
        local : Poles
            Not used: a response has no free runs.

        Returns
        -------
        CandidateCost
            J (no unit) at points of the unit cube, one at a time or many. Points outside the cube, and
            shapes, are not checked.
        """
        frozen = self.columns(shared)
        q = np.linalg.qr(frozen)[0] if frozen.shape[1] else frozen
        residual = self.y - q @ (q.T @ self.y)
        # Behind the all-pass of the frozen poles the candidates' functions stay orthogonal to theirs.
        drive = self.common * all_pass_response(shared, self.z)

        def costs(units: RealArray) -> RealArray:
            """J (E,) at points (E, D), E at least 1, all in one factorisation."""
            blocks = np.stack([space.blocks(unit) for unit in units])
            rows = self.whiten(_cascade_responses(blocks, space.n_real, self.z, drive))
            new_rows = rows - q @ (q.T @ rows)
            q_new = np.linalg.qr(new_rows)[0]
            on_residual = np.einsum("enk,n->ek", q_new, residual)
            fall = np.sum(on_residual**2, axis=1)
            return np.asarray(residual @ residual - fall)

        def cost(unit: RealArray) -> float:
            """J (no unit) at a point (D,) of the unit cube; nothing is checked."""
            return float(costs(unit[np.newaxis])[0])

        return CandidateCost(space, self.power, cost, costs)


def _cascade_responses(blocks: RealArray, n_real: int, z: ComplexArray, drive: ComplexArray) -> ComplexArray:
    """Responses (E, F, B) of E cascades behind `drive` (F,), at the points z (F,).

    blocks (E, R + P, 4): of each cascade, `n_real` = R real poles first, as in
    `ident.basis.functions.block_parameters`; at least one block (numpy refuses to stack none). z on the unit
    circle, so that no pole is met. B = R + 2 P; the unit is that of `drive`.
    """
    entering = np.broadcast_to(drive, (len(blocks), z.size))
    columns = []
    for i in range(blocks.shape[1]):
        p0, p1, p2, p3 = (blocks[:, i, j, np.newaxis] for j in range(4))
        if i < n_real:
            # Real pole a = p0, sqrt(1 - a^2) = p1; the all-pass (1 - a z)/(z - a) drives the next block.
            columns.append(p1 / (z - p0) * entering)
            entering = entering * (1 - p0 * z) / (z - p0)
        else:
            # Pair with gamma = p0, beta = p1, sg = p2, sb = p3.
            below = z**2 - p1 * (1 + p0) * z + p0
            above = 1 - p1 * (1 + p0) * z + p0 * z**2
            columns.append(p2 * (z - p1) / below * entering)
            columns.append(p2 * p3 / below * entering)
            entering = entering * above / below
    return np.stack(columns, axis=-1)


def prepare_response(
    response: FrequencyUncertainty, *, integrators: int, delay_samples: int, feedthrough: bool
) -> FrfRegression:
    """A measured response as a least-squares problem of unit variance.

    Parameters
    ----------
    response : FrequencyUncertainty
        omega_rad_s (F,), ascending, not 0 with integrators, whose factor is infinite there; centre (F,), the
        measured response; covariance (F, 2, 2) of its real and imaginary part; dt_s.
    integrators, delay_samples : int
        Known factor (z / (z - 1))^integrators z^-delay_samples of the model; at least 0, not checked.
    feedthrough : bool
        Whether the model has a direct term.

    Returns
    -------
    FrfRegression

    Raises
    ------
    ValueError
        A frequency without any uncertainty (both axes zero). Not checked: omega = 0 with integrators gives a
        factor that is not finite. Shapes, order and finite numbers are checked by `FrequencyUncertainty`.
    """
    omega = response.omega_rad_s
    s1, s2, direction = standard_axes(response.covariance)
    turn = np.conj(direction)

    # At 0 and pi / dt a response is real: one number, with the deviation of its real part.
    nyquist_rad_s = np.pi / response.dt_s
    is_static = omega == 0
    is_nyquist = omega >= nyquist_rad_s * (1 - _NYQUIST_ROUNDING)
    real_only = is_static | is_nyquist
    turn[real_only] = 1.0
    real_std = np.sqrt(response.covariance[:, 0, 0])
    s1 = np.where(real_only, real_std, s1)
    is_uncertain = s1 > 0
    if not np.all(is_uncertain):
        at = omega[int(np.argmin(is_uncertain))]
        raise ValueError(
            f"at omega = {at:.6g} rad/s the response is given as exactly known: a fit needs a covariance at "
            "every frequency, the smallest that is still honest"
        )

    # The second axis never counts more than 1 / THINNEST times the first.
    second_weight = np.where(real_only, 0.0, 1 / np.maximum(s2, THINNEST * s1))
    regression = FrfRegression(
        z=np.exp(1j * omega * response.dt_s),
        common=front_response(omega, response.dt_s, integrators, delay_samples),
        turn=turn,
        weight=np.stack([1 / s1, second_weight]),
        y=np.zeros(2 * omega.size),
        feedthrough=feedthrough,
        dt_s=response.dt_s,
    )
    whitened = regression.whiten(response.centre[:, np.newaxis])
    return replace(regression, y=whitened[:, 0])


@dataclass(frozen=True, eq=False)
class FrfFit:
    """Weighted least-squares fit for given poles.

    Attributes
    ----------
    coefficients : ndarray, shape (B,)
        One per basis function, output units per input unit.
    feedthrough : float
        Direct term; 0 where the fit has none.
    response : ndarray of complex, shape (F,)
        Fitted response.
    residual : ndarray, shape (2 F,)
        Whitened residual.
    rss : float
        Its sum of squares.
    q : ndarray, shape (2 F, B or B + 1)
        Orthonormal columns of the fit.
    """

    coefficients: RealArray
    feedthrough: float
    response: ComplexArray
    residual: RealArray
    rss: float
    q: RealArray


def fit_response(data: FrfRegression, poles: Poles) -> FrfFit:
    """Weighted least-squares fit of a response for given poles: theta = R^-1 Q^T y by thin QR (27).

    Parameters
    ----------
    data : FrfRegression
        Whitened measurement y (2 F,), weights and turns, known factor.
    poles : Poles
        B poles of the basis.

    Returns
    -------
    FrfFit
        Directions that the data do not show (`RANK_TOLERANCE`) have coefficient zero; so with more columns
        than rows, which is not refused here. (27) is the paper's equation (Ziaei and Wang, 2006).
    """
    responses = data.responses(poles)
    q, triangle = np.linalg.qr(data.whiten(responses))
    projected = q.T @ data.y
    residual = data.y - q @ projected
    # Directions that are not shown get no share: a plain solution would blow up rounding there.
    theta = np.linalg.lstsq(triangle, projected, rcond=RANK_TOLERANCE)[0]
    return FrfFit(
        coefficients=np.asarray(theta[: poles.order], dtype=np.float64),
        feedthrough=float(theta[-1]) if data.feedthrough else 0.0,
        response=np.asarray(responses @ theta),
        residual=residual,
        rss=float(residual @ residual),
        q=q,
    )
