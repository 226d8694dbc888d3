"""What a model misses over a horizon, each window from the state that fits it best.

A machine with a free joint integrates: a thousandth of the torque missing becomes an angle after a while, and
a free run says little but that. In windows of a few periods of the slowest mode a drift cannot grow, neither
starts nor a controller matter, and what is left is what the model misses there and then.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diagnosis.fit.records import Records
from diagnosis.machine.machine_protocol import Real

_PERIODS, _SAMPLES_PER_STATE = 3.0, 4


def horizon_samples(records: Records) -> int:
    """Length of a window: some periods of the slowest mode, and enough to tell the states; 0 where the
    machine says neither states nor mode, or where no record holds two windows."""
    unknown, states = records.case.machine.unknown_start, records.state_spread.size
    if not (states and unknown.slowest_period_samples):
        return 0
    found = max(int(np.ceil(_PERIODS * unknown.slowest_period_samples)), _SAMPLES_PER_STATE * states)
    return found if max(len(e.output) for e in records.experiments) >= 2 * found else 0


def shares_over_horizon(records: Records, left: Sequence[Real], responses: Sequence[Real]) -> Real:
    """(Y,) RMS left beyond sensor noise over the RMS of the motion, as `Records.shares`, in windows.

    left : residuals (T, Y) of a free run of every record. responses : S arrays (>= T, Y), outputs per unit of
    a state at the start, of the linear part; nonlinear effects act along the free run.
    """
    samples, scale = horizon_samples(records), records.case.noise
    kept = []
    for e in left:
        pieces = np.array_split(e, max(len(e) // samples, 1))
        freed = []
        for piece in pieces:
            columns = np.array([(r[: len(piece)] / scale).ravel() for r in responses]).T
            seen = (piece / scale).ravel()
            state = np.linalg.lstsq(columns, seen, rcond=1e-9)[0]
            freed.append((seen - columns @ state).reshape(piece.shape) * scale)
        kept.append(np.concatenate(freed))
    return records.shares(kept)
