"""N4SID: a state space from the subspace that past inputs and outputs predict of future outputs.

P. Van Overschee and B. De Moor, "N4SID: subspace algorithms for the identification of combined
deterministic-stochastic systems", Automatica 30(1), 1994, with the weighting of MOESP (M. Verhaegen,
Automatica 30(1), 1994), as common toolboxes do. The order is given; there is no search, so no local minimum.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are

from ident.comparators.innovation_model import InnovationModel, free_responses
from ident.data.arrays import RealArray
from ident.data.record import Record

# Rows of past and of future samples at least. More of them lower the variance of slow poles, and the cost
# grows with their square; 20 is a usual default.
_FEWEST_ROWS = 20
# Rows for each state at least: the method needs more rows than states. Twice as many, chosen.
_ROWS_PER_STATE = 2
# Samples for each row at least: a regression has 3 unknowns a row. Twice as many, chosen.
_SAMPLES_PER_ROW = 6


def n4sid(
    record: Record, order: int, *, feedthrough: bool = False, block_rows: int | None = None
) -> InnovationModel:
    """Fit a state space with its noise by a subspace method.

    Parameters
    ----------
    record : Record
        One input and one output; means are not removed.
    order : int
        Number of states, at least 1.
    feedthrough : bool
        The output answers within the same sample.
    block_rows : int, optional
        Past and future samples that are looked at together; more than `order`.

    Returns
    -------
    InnovationModel
        Stable or not: nothing is imposed.

    Raises
    ------
    ValueError
        Several signals, an order or rows that cannot be used, or a record that is too short for them.
    """
    record.refuse_several()
    rows = max(_FEWEST_ROWS, _ROWS_PER_STATE * order) if block_rows is None else block_rows
    for name, value, least in (("order", order, 1), ("block_rows", rows, order + 1)):
        if not (isinstance(value, (int, np.integer)) and value >= least):
            raise ValueError(f"{name} must be a whole number, at least {least}; got {value!r}")
    if record.n_samples < _SAMPLES_PER_ROW * rows:
        raise ValueError(
            f"{record.label}: {record.n_samples} samples are too few for {rows} block rows; expected at "
            f"least {_SAMPLES_PER_ROW * rows}"
        )
    u = record.input[:, 0]
    y = record.output[:, 0]

    # What the past predicts of the future, the future input set aside, and the same one sample later.
    prediction, future_input = _oblique_projection(u, y, rows, rows)
    later_prediction, _ = _oblique_projection(u, y, rows + 1, rows - 1)

    # Its column space is that of the observability matrix; MOESP takes off what lies along the future input.
    along = np.linalg.lstsq(future_input.T, prediction.T)[0]
    left, singular_values, _ = np.linalg.svd(prediction - along.T @ future_input, full_matrices=False)
    observability = left[:, :order] * np.sqrt(singular_values[:order])

    # States now and one sample later, and the matrices that lead from one to the other.
    states = np.linalg.pinv(observability) @ prediction
    later_states = np.linalg.pinv(observability[:-1]) @ later_prediction
    n_columns = states.shape[1]
    now = np.vstack([states, u[rows : rows + n_columns]])
    after = np.vstack([later_states, y[rows : rows + n_columns]])
    matrices: RealArray = np.asarray(np.linalg.lstsq(now.T, after.T)[0].T, dtype=np.float64)
    A = matrices[:order, :order]
    C = matrices[order:, :order]
    K = _innovation_gain(A, C, after - matrices @ now)

    # B and D of these are biased where the input is coloured: they are fitted again to what the model
    # predicts from sample to sample.
    B, D = _input_matrices(A, C, K, u, y, feedthrough=feedthrough)
    return InnovationModel(A, B, C, D, K, record.dt_s, "N4SID")


def _oblique_projection(
    u: RealArray, y: RealArray, n_past: int, n_future: int
) -> tuple[RealArray, RealArray]:
    """Future outputs (n_future, columns) as the past predicts them, and future inputs of that shape."""
    n_columns = u.size - n_past - n_future + 1

    def rows_of(signal: RealArray, first: int, count: int) -> RealArray:
        """Rows of a Hankel matrix (count, columns), the first beginning with that sample."""
        return np.vstack([signal[first + k : first + k + n_columns] for k in range(count)])

    past = np.vstack([rows_of(u, 0, n_past), rows_of(y, 0, n_past)])
    future_input = rows_of(u, n_past, n_future)
    future_output = rows_of(y, n_past, n_future)
    regressors = np.vstack([past, future_input])
    coefficients = np.linalg.lstsq(regressors.T, future_output.T)[0]
    return coefficients[: past.shape[0]].T @ past, future_input


def _innovation_gain(A: RealArray, C: RealArray, residual: RealArray) -> RealArray:
    """Steady Kalman gain (n, 1) of the noise whose samples (n + 1, columns) are left in states and output.

    Zero where there is none: noise-free records, or a covariance for which the equation has no solution.
    """
    n = A.shape[0]
    covariance = residual @ residual.T / residual.shape[1]
    state_noise = covariance[:n, :n]
    cross = covariance[:n, n:]
    output_noise = covariance[n:, n:]
    try:
        P = solve_discrete_are(A.T, C.T, state_noise, output_noise, s=cross)
    except (ValueError, np.linalg.LinAlgError):
        return np.zeros((n, 1))
    K = (A @ P @ C.T + cross) / (C @ P @ C.T + output_noise)
    is_stable = np.all(np.abs(np.linalg.eigvals(A - K @ C)) < 1)
    return np.asarray(K) if is_stable else np.zeros((n, 1))


def _input_matrices(
    A: RealArray, C: RealArray, K: RealArray, u: RealArray, y: RealArray, *, feedthrough: bool
) -> tuple[RealArray, RealArray]:
    """B (n, 1) and D (1, 1) with which the predictor A - K C errs least, its start fitted beside them."""
    n = A.shape[0]
    predictor = A - K @ C
    no_input = np.zeros((1, 1))

    def response(b: RealArray, signal: RealArray) -> RealArray:
        """Response (T,) of the predictor to a signal that enters its states by b (n, 1)."""
        return InnovationModel(predictor, b, C, no_input, None, 1.0).simulate(signal)

    columns = [response(unit[:, None], u) for unit in np.eye(n)]
    if feedthrough:
        columns.append(u - response(K, u))
    regressors = np.column_stack([*columns, free_responses(predictor, C[0], u.size)])
    coefficients: RealArray = np.asarray(np.linalg.lstsq(regressors, y - response(K, y))[0], dtype=np.float64)
    D = coefficients[n : n + 1, None] if feedthrough else no_input
    return coefficients[:n, None], D
