"""Balls that hold the matrix response of a model of several inputs and outputs, poles included.

To first order G - G0 = K(w) n with n of unit normals, from the Gauss-Newton covariance of poles, shapes and
free residues. With free residues at given poles it would be (noise covariance) x (input covariance P): G = G0
+ Lo D Li with Lo Lo^H the noise covariance, Li^H Li = P, D of independent complex normals. Poles and shapes
add terms that are no such product. Lo stays, P is the mean over whitened outputs, and the ball |D|_F <=
radius is as large as holds G: the quantile of a sum of weighted squares. `matrix_posterior` makes a
`MatrixPosterior` from records and their identification; its `at` gives the balls (`MatrixUncertainty`) at any
frequency, and its `input_factor` Li as a state space for a controller's design.

Neglected: second order in the noise, and what the choice of order and shapes adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ident.basis.mimo_model import MimoModel
from ident.basis.structure import front_response
from ident.data.arrays import ComplexArray, RealArray, lock
from ident.data.frequency_uncertainty import FREQUENCIES
from ident.data.record import Record
from ident.data.shown import Shown
from ident.fit.several_outputs import prepare_outputs, whitened
from ident.identification import MimoIdentification
from ident.mode_shapes import ModalFit, modes_of
from ident.uncertainty.autoregression import fit_autoregression

# Frequencies around each mode at which `largest_radius` looks, in addition to its grid over all frequencies.
# 41 over `_HALF_WIDTHS` to either side are a quarter of a half width apart: chosen, so that a peak that is
# one wide has several. With 3 to 81 of them the largest radius of four records of a simulated structure did
# not move.
_AROUND_MODE = 41
# Half widths (zeta omega) of a mode's peak that they reach to either side: there a peak has fallen to a
# fifth. Chosen; with 2.5 or 10 the largest radius of the same records did not move.
_HALF_WIDTHS = 5
# Share of the Nyquist frequency up to which radii are looked at: at it the response is real, and its ball is
# that of half as many numbers. At .99 or .9999 the largest radius of a simulated structure is the same.
_NEAR_NYQUIST = 0.999
# Largest order of the noise model of an output; BIC chooses up to it. With half
# of it balls hold the response as often as the tests ask for (tests/ident/test_several_outputs.py).
_AR_ORDER = 16
# Rows of the longest record for each order that is tried: with `_AR_ORDER` 16 it acts on records of fewer
# than 320 rows, so that their noise model has twenty rows a coefficient. Chosen; halved or doubled, nothing
# moved where the noise is white.
_ROWS_PER_ORDER = 20
# Draws of the sum of squares: its 95 % quantile then is right to about 1 %. Halved or doubled, the largest
# radius of a simulated structure moved by half a per cent.
_DRAWS = 20_000
# Share of the lowest frequency asked for down to which an integrator is one; see `input_factor`. At the
# lowest frequency the factor is then off by 1e-3, which is far within what any ball is known to; smaller
# shares bring the pole nearer to the circle, where a design loses digits. Chosen.
_INTEGRATES_TO = 1e-3


@dataclass(frozen=True, eq=False)
class MatrixUncertainty:
    """Balls |Lo^-1 (G - G0) Li^-1|_F <= radius, one at each frequency.

    Attributes
    ----------
    omega_rad_s : ndarray, shape (F,)
        Frequencies, rad/s, in any order.
    centre : ndarray, shape (F, Y, U), complex
        G0, in units of the outputs per unit of the inputs.
    output_factor : ndarray, shape (Y, Y)
        Lo, in units of the outputs.
    input_factor : ndarray, shape (F, U, U), complex
        Li, per unit of the inputs.
    radius : ndarray, shape (F,)
        No unit; positive.
    dt_s : float
        Sampling time.
    level : float
        Probability of holding the response, frequency by frequency.
    """

    omega_rad_s: RealArray
    centre: ComplexArray
    output_factor: RealArray
    input_factor: ComplexArray
    radius: RealArray
    dt_s: float
    level: float

    def __post_init__(self) -> None:
        """Lock the arrays; shapes are not checked, `MatrixPosterior.at` makes them."""
        lock(self, "omega_rad_s", "output_factor", "radius")
        lock(self, "centre", "input_factor", dtype=np.complex128)

    def distance(self, response: ComplexArray) -> RealArray:
        """Distance |Lo^-1 (G - G0) Li^-1|_F over the radius, (F,), of responses (F, Y, U); 1 is the ball.

        NaN where a response has NaN. Raises ValueError (numpy's) for another shape, unless it broadcasts.
        """
        by_output = np.linalg.solve(self.output_factor, response - self.centre)
        normalised = by_output @ np.linalg.inv(self.input_factor)
        return np.asarray(np.linalg.norm(normalised, axis=(1, 2)) / self.radius)

    def holds(self, response: ComplexArray) -> npt.NDArray[np.bool_]:
        """Whether each response (F, Y, U) lies in its ball, (F,); False where it has NaN."""
        return np.asarray(self.distance(response) <= 1)


class InputFactor(NamedTuple):
    """Stable state space of Li: x+ = A x + B u, Li u = C x + D u, at the model's sampling time.

    a (n, n), b (n, U), c (m, n), d (m, U): as a state space Li has m outputs, up to one for each state and
    input, with the same Li^H Li = P.
    """

    a: RealArray
    b: RealArray
    c: RealArray
    d: RealArray


@dataclass(frozen=True, eq=False, repr=False)
class MatrixPosterior(Shown):
    """What records say of a matrix response, at any frequency: `at`.

    `matrix_posterior` makes and checks it.

    Attributes
    ----------
    model : MimoModel
        Centre of all balls: Y outputs, U inputs, poles, integrators, delay, dt_s.
    output_factor : ndarray, shape (Y, Y)
        Lo, in units of the outputs.
    modes : ModalFit
        On outputs made white by Lo; of it matters how each of its P numbers changes the response.
    covariance_factor : ndarray, shape (P, P')
        Of these numbers.
    level : float
        Probability of holding the response, frequency by frequency.
    """

    model: MimoModel
    output_factor: RealArray
    modes: ModalFit
    covariance_factor: RealArray
    level: float

    @property
    def dt_s(self) -> float:
        """Sampling time, s."""
        return self.model.dt_s

    def input_factor(self, lowest_rad_s: float) -> InputFactor:
        """State space of Li without its radius, exact at all frequencies: Li^H Li = P.

        Parameters
        ----------
        lowest_rad_s : float
            Lowest frequency that matters, rad/s, above 0 and far below 1 / dt_s with integrators, without
            them not used; not checked. An integrator is one down to a thousandth of it; below, its
            uncertainty stays as there, so that the state space is stable.

        Returns
        -------
        InputFactor
            n: states of the modes for every input, and one per input and integrator. The delay, which has
            modulus one, is left out.
        """
        a, b, changes = self.modes.response_states()
        n_outputs = len(self.model.outputs)
        # A triangle of the rows of all outputs and all normals has the same C^H C as they, over the outputs.
        by_normal = np.einsum("pyn,pq->qyn", changes, self.covariance_factor)
        rows = by_normal.reshape(-1, changes.shape[2])
        triangle: RealArray = np.asarray(np.linalg.qr(rows / np.sqrt(n_outputs), mode="r"))
        n, n_inputs = b.shape
        c = triangle[:, :n]
        d = triangle[:, n:]
        for _ in range(self.model.integrators):
            # s+ = (1 - small) s + u, out = (1 - small) s + u: z/(z - 1 + small) in front of every input.
            pole = 1 - _INTEGRATES_TO * lowest_rad_s * self.dt_s
            below = np.zeros((n_inputs, n))
            a = np.block([[a, pole * b], [below, pole * np.eye(n_inputs)]])
            b = np.vstack([b, np.eye(n_inputs)])
            c = np.hstack([c, pole * d])
            n += n_inputs
        return InputFactor(a, b, c, d)

    def largest_radius(self, lowest_rad_s: float) -> float:
        """Largest radius (no unit) of the balls from lowest_rad_s to the Nyquist frequency, on a grid.

        The grid has `FREQUENCIES` (400) points alike in the logarithm, and more around the modes, where the
        radius changes fast. lowest_rad_s: rad/s, above 0 and below pi / dt_s. Raises ValueError: numpy's for
        another one, that of `at` where an input has no uncertainty.
        """
        poles = self.model.poles
        nyquist = _NEAR_NYQUIST * np.pi / self.dt_s
        half_widths = np.linspace(-_HALF_WIDTHS, _HALF_WIDTHS, _AROUND_MODE)
        frequencies = [np.geomspace(lowest_rad_s, nyquist, FREQUENCIES)]
        for omega, zeta in zip(poles.omega_rad_s(self.dt_s), poles.zeta(), strict=True):
            frequencies.append(omega * (1 + zeta * half_widths))
        grid = np.unique(np.concatenate(frequencies))
        inside = (grid >= lowest_rad_s) & (grid <= nyquist)
        return float(np.max(self.at(grid[inside]).radius))

    def at(self, omega_rad_s: RealArray) -> MatrixUncertainty:
        """Balls at frequencies (F,), rad/s, up to pi/dt, and above 0 with integrators.

        Raises
        ------
        ValueError
            Where the model leaves some input without uncertainty; by `MimoModel.frequency_response` for a
            frequency beyond pi/dt, or 0 with integrators (where numpy may warn or refuse before).
        """
        model = self.model
        n_outputs = len(model.outputs)
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        front = front_response(omega, model.dt_s, model.integrators, model.input_delay_samples)

        # Change of the response (F, Y, U, P') with each unit normal, outputs white.
        changes = self.modes.response_columns(omega) @ self.covariance_factor
        changes = changes * front[:, None, None, None]
        # P, (F, U, U), the mean over outputs, and Li as its upper triangle: Li^H Li = P.
        covariance = np.einsum("fyup,fyvp->fuv", changes.conj(), changes) / n_outputs
        try:
            lower = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            smallest = np.linalg.eigvalsh(covariance)[:, 0]
            worst = omega[np.argmin(smallest)]
            raise ValueError(
                f"at {worst:.3g} rad/s the model leaves some input without uncertainty: poles that nearly "
                "cancel, mostly below the excited band; give n_real and n_pairs, or excite lower frequencies"
            ) from None
        upper = lower.conj().swapaxes(1, 2)

        # |D|_F^2 is a sum of squares of unit normals, weighted by the squared singular values of K Li^-1.
        normalised = np.einsum("fyup,fuv->fyvp", changes, np.linalg.inv(upper))
        by_normal = normalised.reshape(omega.size, -1, normalised.shape[-1])
        real_and_imaginary = np.concatenate([by_normal.real, by_normal.imag], axis=1)
        weights = np.linalg.svd(real_and_imaginary, compute_uv=False) ** 2
        # The same draws each time: equal questions have equal answers.
        normals = np.random.default_rng(0).standard_normal((_DRAWS, weights.shape[1]))
        sums = weights @ (normals**2).T
        radius: RealArray = np.sqrt(np.quantile(sums, self.level, axis=1)).astype(np.float64)
        centre = model.frequency_response(omega)
        return MatrixUncertainty(omega, centre, self.output_factor, upper, radius, model.dt_s, self.level)


def matrix_posterior(
    records: Sequence[Record], identification: MimoIdentification, *, level: float = 0.95
) -> MatrixPosterior:
    """Posterior of the matrix response of an `identify_mimo`, to first order in the noise.

    Parameters
    ----------
    records : sequence of Record
        Those that the identification was made from; that they are is checked by their number of rows alone.
    identification : MimoIdentification
        Its model, structure, noise_covariance (Y, Y), residuals (T - delay, Y) of each record, and which
        modes have one shape (`rank_one`, `n_fixed`); order and shapes are taken as right.
    level : float
        Probability of holding the response, frequency by frequency, between 0 and 1 (numpy's ValueError at
        `at` beyond). 0.95 is what all reports use.

    Returns
    -------
    MatrixPosterior

    Raises
    ------
    ValueError
        If the records have another number of rows, poles repeat, or no record is long enough for a noise
        model (more than twice its order). A noise covariance that is not positive definite: LinAlgError.

    Notes
    -----
    The colour of the noise is that of the residuals: an autoregression of each output, after Lo made them
    independent of each other.
    """
    model = identification.model
    factor: RealArray = np.linalg.cholesky(identification.noise_covariance).astype(np.float64)
    white: RealArray = np.linalg.inv(factor).astype(np.float64)
    data = prepare_outputs(whitened(records, white), identification.structure)
    n_rows = sum(len(residual) for residual in identification.residuals)
    n_given = data.each[0].n_samples
    if n_given != n_rows:
        raise ValueError(
            f"the records have {n_given} rows, the identification {n_rows}: expected the "
            "records it was made from"
        )
    white_coefficients = np.einsum("xy,yub->xub", white, model.coefficients)
    rank_one = identification.rank_one or None
    modes = modes_of(model.poles, white_coefficients, identification.n_fixed, rank_one)
    fit = ModalFit(data, modes)

    # One noise model for each output, from the residuals of all records.
    white_residuals = [(residual @ white.T).T for residual in identification.residuals]
    longest = max(residual.shape[1] for residual in white_residuals)
    order = min(_AR_ORDER, max(1, longest // _ROWS_PER_ORDER))
    noise = []
    for k in range(len(white)):
        residuals_of_output = [residual[k] for residual in white_residuals]
        noise.append(fit_autoregression(residuals_of_output, order))
    return MatrixPosterior(model, factor, fit, fit.covariance_factor(noise), level)
