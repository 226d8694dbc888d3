"""Does any linear correction of the model, from voltage to sensors, take the gap away?

Fitted to the residuals of the estimation records and judged on the held-out ones. What inertia, stiffness,
lag, delay or gain leave is linear in the voltage; friction, backlash, clipping, disturbances, drifts are not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diagnosis.machine.case import Case
from diagnosis.machine.machine_protocol import Real
from diagnosis.where.findings import LinearCorrection
from ident.basis.functions import regressor
from ident.basis.poles import Poles
from plant.modal import linear_arm

_Z95 = 1.96
# Held-out gap energy has to stand this many standard deviations clear before a share of it means anything.
_CLEAR = 5.0
# Besides the machine's own poles: dynamics that are missing in it, from a slow to a fast real pole.
_FREE_POLES = (0.98, 0.9, 0.6, 0.0, 0.0)


def linear_correction(case: Case, residuals: Mapping[str, Real]) -> LinearCorrection | None:
    """Regress the residuals on basis functions with the nominal poles taken twice, and on integrated input.

    Every pole twice spans the change of a response with any of its poles to first order; one and two
    integrators and free real poles stand for what the nominal model lacks. None if the gap of the estimation
    or of the held-out records is too small to take shares of.
    """
    if not all(_clear(residuals, [x.name for x in group]) for group in (case.estimation, case.held_out)):
        return None
    poles = _poles(case)
    estimation = [(_columns(poles, x.voltage_V), residuals[x.name]) for x in case.estimation]
    X = np.vstack([columns for columns, _ in estimation])
    scale = np.sqrt(np.mean(X**2, axis=0))
    scale[scale == 0] = 1.0
    theta, *_ = np.linalg.lstsq(X / scale, np.vstack([e for _, e in estimation]), rcond=1e-8)
    gap, taken, moved = 0.0, 0.0, 0.0
    for experiment in case.held_out:
        e = residuals[experiment.name]
        prediction = _columns(poles, experiment.voltage_V) / scale @ theta
        gap += float(np.sum(e**2)) - e.size
        taken += float(np.sum(e**2) - np.sum((e - prediction) ** 2))
        moved += float(np.sum(prediction**2))
    share = taken / gap
    # e = gap + noise: the energy taken, 2 e.p - p.p, moves with the noise by 2 |p|.
    half = _Z95 * 2 * np.sqrt(moved) / gap
    return LinearCorrection(share, (float(share - half), float(share + half)))


def _clear(residuals: Mapping[str, Real], names: list[str]) -> bool:
    squares = sum(float(np.sum(residuals[name] ** 2)) for name in names)
    count = sum(residuals[name].size for name in names)
    return bool(squares - count > _CLEAR * np.sqrt(2.0 * count))


def _poles(case: Case) -> Poles:
    dt = case.rig.sampling.dt_s
    z = np.exp(linear_arm(case.rig).poles() * dt)
    # The integrator of the hub enters as summed input: a pole inside the circle cannot stand for it.
    inside = z[np.abs(z) < 1 - 1e-7]
    real = inside.real[np.abs(inside.imag) < 1e-12]
    pairs = inside[inside.imag >= 1e-12]
    return Poles(np.concatenate([np.repeat(real, 2), _FREE_POLES]), np.repeat(pairs, 2))


def _columns(poles: Poles, voltage: Real) -> Real:
    """(T, B + 2): basis functions driven by the voltage, and the voltage summed once and twice."""
    once = np.concatenate([[0.0], np.cumsum(voltage)[:-1]])
    twice = np.concatenate([[0.0], np.cumsum(once)[:-1]])
    return np.column_stack([regressor(poles, voltage), once, twice])
