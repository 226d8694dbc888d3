"""OE from the usual starts: four-stage instrumental variables, and ARX.

`ident.comparators.polynomial_fits.oe` starts from Steiglitz-McBride, which finds what these miss. The paper
does not say how its toolbox started; its failures can only be judged from a start that is no better than
usual.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from ident.basis.autoregressive_noise import WHITE_NOISE, AutoregressiveNoise
from ident.basis.noise_model import NoiseModel
from ident.basis.structure import filter_input
from ident.comparators.polynomial_model import PolynomialModel
from ident.comparators.prediction_error import arx_polynomials, best_end, monic, shifted
from ident.comparators.stable_sections import stabilised
from ident.data.arrays import RealArray
from ident.data.record import Record

# The polynomial 1.
_ONE = np.ones(1)


def usual_oe(record: Record, nb: int, nf: int) -> PolynomialModel:
    """y = (B / F) u + e by prediction-error minimisation, best of the two usual starts; delay one sample."""
    u = filter_input(record.input[:, 0], 0, 1)
    y = record.output[:, 0]
    starts = [arx_polynomials(u, y, nf, nb), instrumental_variables(u, y, nf, nb)]
    stable = [PolynomialModel(_ONE, b, _ONE, stabilised(a)) for a, b in starts]
    return best_end(stable, u, y).of(record, 1, "OE")


def instrumental_variables(u: RealArray, y: RealArray, na: int, nb: int) -> tuple[RealArray, RealArray]:
    """A (na + 1,), B (nb,) of A y = B u + v by the four-stage method, u already delayed.

    ARX; instruments simulated with it; an AR(na + nb) model of the residuals; both signals filtered with it,
    and instruments simulated with the second stage. L. Ljung, System Identification, section 15.3. A model
    that makes instruments is reflected into the unit circle first: growing ones would drown everything.
    """
    a, b = arx_polynomials(u, y, na, nb)
    a, b = _instrumented(u, y, lfilter(b, stabilised(a), u), na, nb, WHITE_NOISE)
    residual = lfilter(a, _ONE, y) - lfilter(b, _ONE, u)
    order = na + nb
    tail = _solved(-shifted(residual, range(1, order + 1))[order:], residual[order:])
    return _instrumented(u, y, lfilter(b, stabilised(a), u), na, nb, AutoregressiveNoise(monic(tail)))


def _instrumented(
    u: RealArray, y: RealArray, instrument: RealArray, na: int, nb: int, noise: NoiseModel
) -> tuple[RealArray, RealArray]:
    """Coefficients of A and B by instrumental variables, behind a noise model."""
    first = max(na, nb - 1)
    u, y, x = (noise.filtered(np.asarray(signal)) for signal in (u, y, instrument))
    past_u = shifted(u, range(nb))
    columns = np.hstack([-shifted(y, range(1, na + 1)), past_u])[first:]
    instruments = np.hstack([-shifted(x, range(1, na + 1)), past_u])[first:]
    size = np.linalg.norm(instruments, axis=0)
    instruments = instruments / np.where(size > 0, size, 1.0)
    theta = _solved(instruments.T @ columns, instruments.T @ y[first:])
    return monic(theta[:na]), theta[na:]


def _solved(matrix: RealArray, target: RealArray) -> RealArray:
    return np.asarray(np.linalg.lstsq(matrix, target)[0], dtype=np.float64)
