"""Balls that hold the matrix response of a model of several inputs and outputs, poles included.

To first order G - G0 = K(w) n with n of unit normals, from the Gauss-Newton covariance of poles, shapes and
free residues. With free residues at given poles it would be (noise covariance) x (input covariance P): G = G0
+ Lo D Li with Lo Lo^H the noise covariance, Li^H Li = P, D of independent complex normals. Poles and shapes
add terms that are no such product. Lo stays, P is the mean over whitened outputs, and the ball |D|_F <=
radius is as large as holds G: the quantile of a sum of weighted squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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

_AROUND = 41  # frequencies around a mode, beside those of the grid, whose largest radius stands for all
_AR_ORDER = 16  # at most, of the noise
_DRAWS = 20_000  # of the sum of squares: its 95 % quantile then is right to about 1 %


@dataclass(frozen=True, eq=False)
class MatrixUncertainty:
    """|Lo^-1 (G - G0) Li^-1|_F <= radius at every frequency.

    omega_rad_s (F,), centre (F, Y, U), output_factor Lo (Y, Y) in units of the outputs, input_factor Li
    (F, U, U), radius (F,), dt_s, level: probability of holding the response, frequency by frequency.
    """

    omega_rad_s: RealArray
    centre: ComplexArray
    output_factor: RealArray
    input_factor: ComplexArray
    radius: RealArray
    dt_s: float
    level: float

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s", "output_factor", "radius")
        lock(self, "centre", "input_factor", dtype=np.complex128)

    def distance(self, response: ComplexArray) -> RealArray:
        """|Lo^-1 (G - G0) Li^-1|_F over the radius, (F,), of responses (F, Y, U); up to 1 inside."""
        left = np.linalg.solve(self.output_factor, response - self.centre)
        inside = left @ np.linalg.inv(self.input_factor)
        return np.asarray(np.linalg.norm(inside, axis=(1, 2)) / self.radius)

    def holds(self, response: ComplexArray) -> npt.NDArray[np.bool_]:
        """Whether each response (F, Y, U) lies in its ball, (F,)."""
        return np.asarray(self.distance(response) <= 1)


@dataclass(frozen=True, eq=False, repr=False)
class MatrixPosterior(Shown):
    """What records say of a matrix response, at any frequency: `at`.

    model; output_factor Lo (Y, Y); modes, on outputs made white by it; covariance_factor of their numbers;
    level: probability of holding the response, frequency by frequency.
    """

    model: MimoModel
    output_factor: RealArray
    modes: ModalFit
    covariance_factor: RealArray
    level: float

    @property
    def dt_s(self) -> float:
        return self.model.dt_s

    def input_factor(self, lowest_rad_s: float) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """Stable state space (A, B, C, D) of Li without its radius, exact at all frequencies: Li^H Li = P.

        An integrator is one down to a thousandth of lowest_rad_s; below, its uncertainty stays as there.
        """
        a, b, rows = self.modes.response_states()
        rows = np.einsum("pyn,pq->qyn", rows, self.covariance_factor).reshape(-1, rows.shape[2])
        triangle: RealArray = np.asarray(np.linalg.qr(rows / np.sqrt(len(self.model.outputs)), mode="r"))
        n, n_inputs = b.shape
        c, d = triangle[:, :n], triangle[:, n:]
        for _ in range(self.model.integrators):
            # s+ = (1 - small) s + u, out = (1 - small) s + u: z/(z - 1 + small) in front of every input.
            kept = 1 - 1e-3 * lowest_rad_s * self.dt_s
            a = np.block([[a, kept * b], [np.zeros((n_inputs, n)), kept * np.eye(n_inputs)]])
            b, c = np.vstack([b, np.eye(n_inputs)]), np.hstack([c, kept * d])
            n += n_inputs
        return a, b, c, d

    def largest_radius(self, lowest_rad_s: float) -> float:
        """Of the balls from lowest_rad_s to the Nyquist frequency, on a grid with points around modes."""
        poles, nyquist = self.model.poles, 0.999 * np.pi / self.dt_s
        around = [
            omega * (1 + zeta * np.linspace(-5, 5, _AROUND))
            for omega, zeta in zip(poles.omega_rad_s(self.dt_s), poles.zeta(), strict=True)
        ]
        grid = np.unique(np.concatenate([np.geomspace(lowest_rad_s, nyquist, FREQUENCIES), *around]))
        return float(np.max(self.at(grid[(grid >= lowest_rad_s) & (grid <= nyquist)]).radius))

    def at(self, omega_rad_s: RealArray) -> MatrixUncertainty:
        """Balls at omega (F,), up to pi/dt (above 0 with integrators)."""
        omega, model = np.asarray(omega_rad_s, dtype=np.float64), self.model
        front = front_response(omega, model.dt_s, model.integrators, model.input_delay_samples)
        columns = self.modes.response_columns(omega) @ self.covariance_factor * front[:, None, None, None]
        covariance = np.einsum("fyup,fyvp->fuv", columns.conj(), columns) / len(model.outputs)
        try:
            upper = np.linalg.cholesky(covariance).conj().swapaxes(1, 2)
        except np.linalg.LinAlgError:
            least = omega[np.argmin(np.linalg.eigvalsh(covariance)[:, 0])]
            raise ValueError(
                f"at {least:.3g} rad/s the model leaves some input without uncertainty: poles that nearly "
                "cancel, mostly below the excited band; give n_real and n_pairs, or excite lower frequencies"
            ) from None
        turned = np.einsum("fyup,fuv->fyvp", columns, np.linalg.inv(upper))
        flat = turned.reshape(omega.size, -1, turned.shape[-1])
        weights = np.linalg.svd(np.concatenate([flat.real, flat.imag], axis=1), compute_uv=False) ** 2
        squares = np.random.default_rng(0).standard_normal((_DRAWS, weights.shape[1])) ** 2
        radius: RealArray = np.sqrt(np.quantile(weights @ squares.T, self.level, axis=1)).astype(np.float64)
        return MatrixUncertainty(
            omega, model.frequency_response(omega), self.output_factor, upper, radius, model.dt_s, self.level
        )


def matrix_posterior(
    records: Sequence[Record], identification: MimoIdentification, *, level: float = 0.95
) -> MatrixPosterior:
    """Posterior of the matrix response of an `identify_mimo`, first order in the noise, whose colour is that
    of the residuals (an autoregression of each output), for the order and the shapes that were chosen. Raises
    ValueError if the records are not its own, or poles repeat."""
    model, structure = identification.model, identification.structure
    factor: RealArray = np.linalg.cholesky(identification.noise_covariance).astype(np.float64)
    white: RealArray = np.linalg.inv(factor).astype(np.float64)
    data = prepare_outputs(whitened(records, white), structure)
    rows = sum(len(part) for part in identification.residuals)
    if data.each[0].n_samples != rows:
        raise ValueError(
            f"the records have {data.each[0].n_samples} rows, the identification {rows}: expected the "
            "records it was made from"
        )
    own = np.einsum("xy,yub->xub", white, model.coefficients)
    modes = modes_of(model.poles, own, identification.n_fixed, identification.rank_one or None)
    fit = ModalFit(data, modes)
    each = [(residual @ white.T).T for residual in identification.residuals]
    order = min(_AR_ORDER, max(1, max(one.shape[1] for one in each) // 20))
    noise = [fit_autoregression([one[k] for one in each], order) for k in range(len(white))]
    return MatrixPosterior(model, factor, fit, fit.covariance_factor(noise), level)
