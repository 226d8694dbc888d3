"""Covariance of the channel responses of a model with shared poles, poles included.

At the optimum of separable least squares a first-order change of the model is a change of the coefficients
and one of the poles, the latter along the states S of every block driven by the fitted output. So plain least
squares on [Phi(u_1) Phi(u_2) ... S] has the Gauss-Newton covariance of everything, and in channel i the
response of a column of S is that of the block state times G_i: when a pole moves, it moves in all channels.
That is (U + 1) B unknowns; least squares with every pole doubled for every input, 2 U B unknowns, would
forget that the poles are shared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ident.basis.functions import basis_response, block_responses
from ident.basis.poles import Poles
from ident.basis.structure import front_response
from ident.data.arrays import RealArray
from ident.data.ellipses import spread_covariance
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record
from ident.fit.least_squares import Projection, Regression, block_states, fitted_output, project
from ident.fit.regression import prepare_inputs
from ident.identification import MisoIdentification


def response_uncertainty(
    records: Sequence[Record],
    identification: MisoIdentification,
    omega_rad_s: RealArray,
    *,
    level: float = 0.95,
) -> tuple[FrequencyUncertainty, ...]:
    """Ellipses of every channel's response, one `FrequencyUncertainty` per input.

    records : the records behind the identification
    identification : result of `identify_miso`
    omega_rad_s : (F,) strictly increasing, up to pi/dt (above 0 with integrators)

    First order in the noise, which is taken as white, and for the order that was chosen: nothing is added for
    modes that the records did not show (`ident.uncertainty.embedding` does that for a single input). Fixed
    poles count as known. Raises ValueError if the records are not those of the identification.
    """
    model = identification.model
    data = prepare_inputs(records, identification.structure)
    if data.n_samples != sum(part.size for part in identification.residuals):
        raise ValueError(
            f"the records have {data.n_samples} rows, the identification "
            f"{sum(part.size for part in identification.residuals)}: expected the records it was made from"
        )
    projection = project(data, model.poles)
    free = _free_states(identification)
    factor = _covariance_factor(data, model.poles, projection, free, identification.noise_std)
    omega = np.asarray(omega_rad_s, dtype=np.float64)
    z = np.exp(1j * omega * model.dt_s)
    centre = model.frequency_response(omega)
    basis = basis_response(model.poles, z)
    front = front_response(omega, model.dt_s, model.integrators, model.input_delay_samples)
    states = block_responses(model.poles, z)[:, free]
    result = []
    n, n_inputs = model.order, model.n_inputs
    for i in range(n_inputs):
        columns = np.zeros((omega.size, factor.shape[0]), dtype=np.complex128)
        columns[:, i * n : (i + 1) * n] = basis * front[:, None]
        if data.structure.feedthrough:
            columns[:, n_inputs * n + i] = front
        columns[:, factor.shape[0] - free.size :] = states * centre[:, i : i + 1]
        result.append(
            FrequencyUncertainty(
                omega_rad_s=omega,
                centre=centre[:, i],
                covariance=spread_covariance(columns @ factor),
                dt_s=model.dt_s,
                level=level,
                method="shared poles, first order",
            )
        )
    return tuple(result)


def _free_states(identification: MisoIdentification) -> npt.NDArray[np.intp]:
    """Indices of the block states that belong to searched poles: what was fixed comes first of each type."""
    poles = identification.model.poles
    n_real, n_pairs = identification.n_fixed
    indices = np.arange(poles.order, dtype=np.intp)
    real, pairs = indices[n_real : poles.real.size], indices[poles.real.size + 2 * n_pairs :]
    return np.concatenate([real, pairs])


def _covariance_factor(
    data: Regression, poles: Poles, projection: Projection, free: npt.NDArray[np.intp], noise_std: float
) -> RealArray:
    """F (P, P) with F F^T the covariance of [coefficients of all channels, direct terms, states' weights]."""
    states = block_states(data, poles, fitted_output(data, projection))[free]
    columns = np.vstack([projection.shared, states])
    data.take_out_local(projection.local_q, columns)
    # Columns of unit length, so that what pinv leaves out as unseen does not depend on their units.
    scale = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    triangle = np.linalg.qr((columns / scale[:, None]).T, mode="r")
    return np.asarray(noise_std * np.linalg.pinv(triangle, rcond=1e-12) / scale[:, None])
