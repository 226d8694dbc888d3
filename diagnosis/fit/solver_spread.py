"""How far two correct solvers of a machine with backlash may drift apart, measured where it is to be judged.

Contacts amplify: solvers whose impacts differ by a hair follow different sequences of contacts some bounces
later, and neither is wrong. Measured on the same records with a gap that differs in its third digit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from diagnosis.fit.coordinates import effects_at
from diagnosis.fit.descent import Fit
from diagnosis.fit.residual import ResidualModel
from diagnosis.machine.machine_protocol import Real, RecordOfMachine

# Changes of a non-smooth size, in steps of its difference quotients (one step is half a per cent of a gap).
_CHANGES = (-0.4, -0.2, 0.2, 0.4)
# Machine and model drift away from each other, each as far as such changes make the model drift.
_INDEPENDENT = 2.0
# Samples over which the squared difference is averaged: it swings through zero, the spread does not.
_WINDOW = 40
# RMS beyond the noise that may be left over it.
_MOST_LEFT = 0.75


def solver_spread(
    model: ResidualModel, end: Fit, experiments: Sequence[RecordOfMachine] | None = None
) -> Real:
    """Variance (N,) in units of the noise's that correct solvers may add to the residuals of a fit.

    Record by record, sample by sample, all outputs, as `ResidualModel.of` has them; experiments default to
    the estimation records. Zero where no effect is non-smooth.
    """
    records = model.case.estimation if experiments is None else experiments
    outputs = model.case.noise.size
    sizes = [len(record.output) * outputs for record in records]
    total = np.zeros(sum(sizes))
    non_smooth = [k for k, candidate in enumerate(end.candidates) if candidate.dependence == "non-smooth"]
    if not non_smooth:
        return total
    here = model.of(end.deviations, end.effects, records)
    for k in non_smooth:
        at = sum(len(c.axes) for c in end.candidates[:k])
        for change in _CHANGES:
            x = end.coordinates.copy()
            x[at] += change * end.candidates[k].axes[0].step
            effects = effects_at(end.candidates, x)
            total += (model.of(end.deviations, effects, records) - here) ** 2 / len(_CHANGES)
    parts = np.split(total, np.cumsum(sizes)[:-1])
    smooth = [uniform_filter1d(part.reshape(-1, outputs), _WINDOW, axis=0).ravel() for part in parts]
    return _INDEPENDENT * np.concatenate(smooth)


@dataclass(frozen=True)
class Drift:
    """What residuals gain by being judged over a noise that includes the spread of correct solvers.

    log_gain : log likelihood. size : RMS of the spread in noise deviations.
    """

    log_gain: float = 0.0
    size: float = 0.0


NO_DRIFT = Drift()


def without_drift(residuals: Real, spread: Real) -> tuple[Real, Drift]:
    """Residuals (N,) over a noise that includes the spread (N,), and what they gain by it.

    Where trajectories have drifted apart, as many samples as the spread is averaged over count as one. As
    they are where nothing is gained, and where much is left all the same: that is something else.
    """
    variance = 1.0 + spread
    e = residuals / np.sqrt(variance)
    counted = 1.0 - spread / variance * (1.0 - 1.0 / _WINDOW)
    cost = float(np.sum(counted * (e**2 + np.log(variance)) + 1.0 - counted))
    gain = 0.5 * (float(residuals @ residuals) - cost)
    if not gain > 0 or float(np.mean(e**2)) > 1.0 + _MOST_LEFT**2:
        return residuals, NO_DRIFT
    return e, Drift(gain, float(np.sqrt(np.mean(spread))))
