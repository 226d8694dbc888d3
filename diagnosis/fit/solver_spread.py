"""How far two correct solvers of a machine with backlash may drift apart, measured where it is to be judged.

Contacts amplify: solvers whose impacts differ by a hair follow different sequences of contacts some bounces
later, and neither is wrong. Measured on the same records with a gap that differs in its third digit.

Each constant doubled leaves the answer of a backlash where it is (`python -m benchmarks.frozen_answers --only
exact --change`): they matter where contacts amplify most, as on the rigs of the tests.
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

# Changes of a non-smooth size, in steps of its difference quotients (one step is half a per cent of a gap):
# a change of 0.1 to 0.2 % of a gap makes contacts come as early or late as another solver's.
_CHANGES = (-0.4, -0.2, 0.2, 0.4)
# Variance of two trajectories' difference over that of one: machine and model drift away from each other,
# each as far as such changes make the model drift.
_INDEPENDENT = 2.0
# Samples over which the squared difference is averaged: it swings through zero, the spread does not. Some
# periods of the lowest mode of a link at 5 ms.
_AVERAGED_SAMPLES = 40
# RMS beyond the noise, in noise deviations, that may be left over the spread: more is something else.
_LARGEST_LEFT = 0.75


def solver_spread(
    model: ResidualModel, fit: Fit, experiments: Sequence[RecordOfMachine] | None = None
) -> Real:
    """Variance that correct solvers may add to the residuals of a fit.

    Parameters
    ----------
    model : ResidualModel
        Simulates; four simulations a record for every non-smooth effect, and one.
    fit : Fit
        Its effects and nominal values are those that are judged.
    experiments : sequence, optional
        Records; by default those of estimation.

    Returns
    -------
    (N,) array
        In units of the noise's, record by record, sample by sample, all outputs, as `ResidualModel.of` has
        them. Zero where no effect is non-smooth.
    """
    records = model.case.estimation if experiments is None else experiments
    outputs = model.case.noise.size
    sizes = [len(record.output) * outputs for record in records]
    squares = np.zeros(sum(sizes))
    if not fit.non_smooth:
        return squares
    residuals = model.of(fit.deviations, fit.effects, records)
    size_place = 0
    for candidate in fit.candidates:
        if candidate.dependence == "non-smooth":
            for change in _CHANGES:
                x = fit.coordinates.copy()
                x[size_place] += change * candidate.axes[0].step
                changed = model.of(fit.deviations, effects_at(fit.candidates, x), records)
                squares += (changed - residuals) ** 2 / len(_CHANGES)
        size_place += len(candidate.axes)
    by_record = np.split(squares, np.cumsum(sizes)[:-1])
    averaged = [
        uniform_filter1d(part.reshape(-1, outputs), _AVERAGED_SAMPLES, axis=0).ravel() for part in by_record
    ]
    return _INDEPENDENT * np.concatenate(averaged)


@dataclass(frozen=True)
class Drift:
    """What residuals gain by being judged over a noise that includes the spread of correct solvers.

    Attributes
    ----------
    log_gain : float
        Log likelihood.
    size : float
        RMS of the spread in noise deviations.
    """

    log_gain: float = 0.0
    size: float = 0.0


NO_DRIFT = Drift()


def without_drift(residuals: Real, spread: Real) -> tuple[Real, Drift]:
    """Residuals over a noise that includes the spread, and what they gain by it.

    Where trajectories have drifted apart, as many samples as the spread is averaged over count as one.

    Parameters
    ----------
    residuals : (N,) array
        In noise deviations.
    spread : (N,) array
        Variance in units of the noise's, from `solver_spread`.

    Returns
    -------
    (N,) array, Drift
        The residuals as they are, and no drift, where nothing is gained, and where much is left all the same:
        that is something else.
    """
    variance = 1.0 + spread
    e = residuals / np.sqrt(variance)
    counted = 1.0 - spread / variance * (1.0 - 1.0 / _AVERAGED_SAMPLES)
    cost = float(np.sum(counted * (e**2 + np.log(variance)) + 1.0 - counted))
    gain = 0.5 * (float(residuals @ residuals) - cost)
    too_much_left = float(np.mean(e**2)) > 1.0 + _LARGEST_LEFT**2
    # Written so that a gain that is not a number is none.
    if not gain > 0 or too_much_left:
        return residuals, NO_DRIFT
    return e, Drift(gain, float(np.sqrt(np.mean(spread))))
